# SPDX-License-Identifier: Apache-2.0

"""
Accelerometers that a board reads.

A sensor has `rate_hz`, `bits`, `vref_v` and `channels`. `open` sets it up, `ready` says whether
there is a new sample, and `read` returns its codes: signed counts with 0 g in the middle of the
range, as in the files of params/. `self_test` switches its self-test where it `has_self_test`. A
chip with a thermometer adds a channel that reads as a TMP36 does, 0.5 V at 0 degC and 10 mV/K,
which is the default of the driver.
"""

import struct

from machine import ADC, I2C, Pin, SPI

_OVERSAMPLED = 16  # Readings of 12 bits whose sum is a code of 16 bits


class Spi:
    """Registers of a chip on SPI."""

    def __init__(self, pins, phase, read, write):
        bus, sck, mosi, miso, select = pins
        self._select = Pin(select, Pin.OUT, value=1)
        self._spi = SPI(
            bus,
            baudrate=2_000_000,
            polarity=phase,
            phase=phase,
            sck=Pin(sck),
            mosi=Pin(mosi),
            miso=Pin(miso),
        )
        self._read, self._write = read, write  # First byte of a transfer, by register

    def read(self, register, count):
        """Return some registers in a row."""
        self._select(0)
        self._spi.write(bytes([self._read(register)]))
        data = self._spi.read(count)
        self._select(1)
        return data

    def write(self, register, value):
        """Write one register."""
        self._select(0)
        self._spi.write(bytes([self._write(register), value]))
        self._select(1)


class I2c:
    """Registers of a chip on I2C."""

    def __init__(self, pins, address):
        sda, scl = pins
        self._i2c = I2C(0, sda=Pin(sda), scl=Pin(scl), freq=400_000)
        self._address = address

    def read(self, register, count):
        """Return some registers in a row; raises OSError without an answer."""
        return self._i2c.readfrom_mem(self._address, register, count)

    def write(self, register, value):
        """Write one register."""
        self._i2c.writeto_mem(self._address, register, bytes([value]))


class Chip:
    """A digital accelerometer: its registers are those of its datasheet."""

    IDENTITY = 0, 0  # Register and value by which it is known
    SETUP = ()  # Registers and values in order
    STATUS = 0, 0  # Register and bit that say that there is a new sample
    SELF_TEST = 0, 0, 0  # Register, and its values while the self-test is off and on
    channels = 4
    has_self_test = True
    has_clock = True  # It samples by itself, at about `rate_hz`

    def __init__(self, bus):
        self._bus = bus

    def open(self):
        """Set the chip up; raises OSError where it is not there."""
        register, identity = self.IDENTITY
        found = self._bus.read(register, 1)[0]
        if found != identity:
            raise OSError(f'register {register:#x} has {found:#x}, not {identity:#x}')
        for register, value in self.SETUP:
            self._bus.write(register, value)
        self.self_test(False)  # a program that has ended may have left it on

    def self_test(self, is_on):
        """Switch the self-test on or off."""
        register, off, on = self.SELF_TEST
        self._bus.write(register, on if is_on else off)

    def ready(self, now_us):
        """Return whether there is a new sample; raises OSError where nothing drives the bus."""
        register, bit = self.STATUS
        status = self._bus.read(register, 1)[0]
        if status == 0xFF:
            raise OSError('no answer')
        return status & bit

    def _centred(self, counts):
        return [count + (1 << (self.bits - 1)) for count in counts]

    def _warmth(self, degrees_c):
        """Return the code of a temperature."""
        code = int((0.5 + 0.01 * degrees_c) / self.vref_v * (1 << self.bits) + 0.5)
        return min(max(code, 0), (1 << self.bits) - 1)


class Adxl345(Chip):
    """ADXL345 on SPI, +-2 g, 100 Hz; it has no thermometer. Datasheet Rev. E, pages 23 to 27."""

    rate_hz, bits, vref_v, channels = 100.0, 10, 4.0, 3
    IDENTITY = 0x00, 0xE5  # DEVID
    SETUP = (
        (0x2D, 0x00),  # POWER_CTL: standby
        (0x31, 0x00),  # DATA_FORMAT: 10 bit, right-justified, +-2 g
        (0x2C, 0x0A),  # BW_RATE: 100 Hz, low-pass 50 Hz
        (0x2D, 0x08),  # POWER_CTL: measure
    )
    STATUS = 0x30, 0x80  # INT_SOURCE: DATA_READY
    SELF_TEST = 0x31, 0x00, 0x80  # DATA_FORMAT: SELF_TEST

    def __init__(self, pins):
        super().__init__(Spi(pins['spi'], 1, lambda r: r | 0xC0, lambda r: r))

    def read(self):
        """Return x, y, z: DATAX0 to DATAZ1, least significant byte first."""
        return self._centred(struct.unpack('<hhh', self._bus.read(0x32, 6)))


class Adxl355(Chip):
    """ADXL355 on SPI, +-2.048 g, 125 Hz, 16 of its 20 bits. Datasheet Rev. 0, pages 32 to 38."""

    rate_hz, bits, vref_v = 125.0, 16, 4.096
    IDENTITY = 0x02, 0xED  # PARTID
    SETUP = (
        (0x2D, 0x01),  # POWER_CTL: standby
        (0x2C, 0x81),  # RANGE: +-2.048 g
        (0x28, 0x05),  # FILTER: 125 Hz, low-pass 31.25 Hz
        (0x2D, 0x00),  # POWER_CTL: measure, with temperature
    )
    STATUS = 0x04, 0x01  # STATUS: DATA_RDY
    SELF_TEST = 0x2E, 0x00, 0x03  # SELF_TEST: ST1 and ST2

    def __init__(self, pins):
        super().__init__(Spi(pins['spi'], 0, lambda r: r << 1 | 1, lambda r: r << 1))

    def read(self):
        """Return x, y, z, temperature: XDATA3 to ZDATA1, 20 bits from the left; TEMP2, TEMP1."""
        data = self._bus.read(0x08, 9)
        codes = []
        for i in (0, 3, 6):
            count = data[i] << 12 | data[i + 1] << 4 | data[i + 2] >> 4
            centred = (count + 0x80000) & 0xFFFFF
            codes.append(min(centred + 8 >> 4, 0xFFFF))
        high, low = self._bus.read(0x06, 2)
        return codes + [self._warmth(25 + (1885 - ((high & 0x0F) << 8 | low)) / 9.05)]


class Lsm6dso(Chip):
    """LSM6DSO on I2C, +-2 g, 104 Hz. Datasheet DS12140; registers also by ST's driver."""

    rate_hz, bits, vref_v = 104.0, 16, 3.997696
    IDENTITY = 0x0F, 0x6C  # WHO_AM_I
    SETUP = (
        (0x12, 0x44),  # CTRL3_C: both bytes of one sample, register counts up
        (0x10, 0x40),  # CTRL1_XL: 104 Hz, +-2 g, low-pass 52 Hz
    )
    STATUS = 0x1E, 0x01  # STATUS_REG: XLDA
    SELF_TEST = 0x14, 0x00, 0x01  # CTRL5_C: ST0_XL, positive

    def __init__(self, pins):
        super().__init__(I2c(pins['i2c'], pins.get('address', 0x6A)))

    def read(self):
        """Return x, y, z, temperature: OUTX_L_A to OUTZ_H_A, OUT_TEMP_L, OUT_TEMP_H."""
        codes = self._centred(struct.unpack('<hhh', self._bus.read(0x28, 6)))
        (count,) = struct.unpack('<h', self._bus.read(0x20, 2))
        return codes + [self._warmth(25 + count / 256)]


class Mpu6050(Chip):
    """MPU-6050 on I2C, +-2 g, 100 Hz. Register Map Rev. 4.2, pages 11 to 45."""

    rate_hz, bits, vref_v = 100.0, 16, 4.0
    IDENTITY = 0x75, 0x68  # WHO_AM_I
    SETUP = (
        (0x6B, 0x01),  # PWR_MGMT_1: awake, clock of the gyroscope
        (0x1A, 0x03),  # CONFIG: low-pass 44 Hz
        (0x19, 0x09),  # SMPLRT_DIV: 1 kHz / 10
        (0x1C, 0x00),  # ACCEL_CONFIG: +-2 g
        (0x38, 0x01),  # INT_ENABLE: DATA_RDY_EN, without which its bit may stay 0
    )
    STATUS = 0x3A, 0x01  # INT_STATUS: DATA_RDY_INT
    SELF_TEST = 0x1C, 0x00, 0xE0  # ACCEL_CONFIG: XA_ST, YA_ST, ZA_ST, at +-2 g

    def __init__(self, pins):
        super().__init__(I2c(pins['i2c'], pins.get('address', 0x68)))

    def read(self):
        """Return x, y, z, temperature: ACCEL_XOUT_H to TEMP_OUT_L, high byte first."""
        *counts, warmth = struct.unpack('>hhhh', self._bus.read(0x3B, 8))
        return self._centred(counts) + [self._warmth(warmth / 340 + 36.53)]


class Analog:
    """An analog accelerometer at the ADC of the board, whose full scale is 3.3 V."""

    rate_hz, bits, vref_v = 100.0, 16, 3.3
    has_clock = False  # The board says when

    def __init__(self, pins, axes):
        self._adcs = [ADC(Pin(pin)) for pin in pins['adc'][:axes]]
        self._st = Pin(pins['st'], Pin.OUT, value=0) if 'st' in pins else None
        self.has_self_test = self._st is not None
        self.channels = axes
        self._next_us = None

    def open(self):
        """Begin with the next call of `ready`."""
        self._next_us = None
        if self.has_self_test:
            self.self_test(False)
        for adc in self._adcs:
            if hasattr(adc, 'atten'):
                adc.atten(ADC.ATTN_11DB)  # an ESP32 reads 1 V without it

    def self_test(self, is_on):
        """Switch the pin at ST of the sensor."""
        self._st(is_on)

    def ready(self, now_us):
        """Return whether the time of a sample has come; a late one is left out."""
        period_us = int(1e6 / self.rate_hz)
        if self._next_us is None:
            self._next_us = now_us
        if now_us < self._next_us:
            return False
        self._next_us += ((now_us - self._next_us) // period_us + 1) * period_us
        return True

    def read(self):
        """Return the codes of the axes."""
        return [self._code(adc) for adc in self._adcs]

    def _code(self, adc):
        if hasattr(adc, 'read_uv'):  # an ESP32 has a calibration
            volts = sum(adc.read_uv() for _ in range(_OVERSAMPLED)) / _OVERSAMPLED * 1e-6
            return min(int(volts / self.vref_v * 65536), 65535)
        total = sum(adc.read_u16() >> 4 for _ in range(_OVERSAMPLED))
        return 65535 if total == 4095 * _OVERSAMPLED else total


SENSORS = {
    'adxl203': lambda pins: Analog(pins, 2),
    'adxl335': lambda pins: Analog(pins, 3),
    'adxl345': Adxl345,
    'adxl355': Adxl355,
    'lsm6dso': Lsm6dso,
    'mpu6050': Mpu6050,
}
