# SPDX-License-Identifier: Apache-2.0

"""
Chips behind the buses of a board, for the unix port of MicroPython, which runs this file.

It is started with a sensor's name, a rate, a sample at which the wires come off, the number of
samples for which they do, the folder of the firmware, and the kind of time. Sample k has
x = k % 100 steps, y = -300 counts, z = 1 g. The self-test adds 500 steps to y, or 0.1 V.
"""

import sys
import time as real_time

NAME = sys.argv[1]
RATE_HZ = float(sys.argv[2])
LOOSE, LOOSE_SAMPLES = int(sys.argv[3]), int(sys.argv[4])
FIRMWARE = sys.argv[5]
IS_REAL_TIME = sys.argv[6] == 'real'
WARM_C = 31.5
ONE_G = {'adxl345': 256, 'adxl355': 256000, 'lsm6dso': 16393, 'mpu6050': 16384}.get(NAME, 0)
SELF_TEST = {  # Register, and its bits
    'adxl345': (0x31, 0x80),
    'adxl355': (0x2E, 0x03),
    'lsm6dso': (0x14, 0x01),
    'mpu6050': (0x1C, 0xE0),
}.get(NAME, (0, 0))
ST_PIN = 15
STEP = 16 if NAME == 'adxl355' else 1  # Counts of the chip in a step of the codes


class Time:
    """A clock that passes by its calls alone, so that a busy machine does not matter."""

    WRAP = 1 << 30  # As on an RP2040
    now_us = WRAP - 1_500_000  # It wraps after some frames

    @classmethod
    def ticks_us(cls):
        cls.now_us += 10
        return cls.now_us % cls.WRAP

    @classmethod
    def ticks_diff(cls, end, start):
        return (end - start + cls.WRAP // 2) % cls.WRAP - cls.WRAP // 2

    @classmethod
    def sleep_us(cls, pause):
        cls.now_us += pause

    @classmethod
    def sleep_ms(cls, pause):
        cls.now_us += pause * 1000


time = real_time if IS_REAL_TIME else Time
START_US = real_time.ticks_us() if IS_REAL_TIME else Time.now_us


def sample():
    """Return the number of the newest sample."""
    now_us = real_time.ticks_us() if IS_REAL_TIME else Time.now_us
    return int((now_us - START_US) * RATE_HZ / 1e6)


def is_loose():
    return 0 <= sample() - LOOSE < LOOSE_SAMPLES


def little(count):
    return [count & 0xFF, count >> 8 & 0xFF]


def big(count):
    return [count >> 8 & 0xFF, count & 0xFF]


def left(count):
    """Return 20 bits from the left in three bytes."""
    return [count >> 12 & 0xFF, count >> 4 & 0xFF, count << 4 & 0xF0]


class Chip:
    """Registers by the datasheet: what measures, says so once for each sample."""

    def __init__(self, identity, needed, status, data, layout, warmth):
        self.identity, self.needed, self.status = identity, needed, status
        self.data, self.layout, self.warmth = data, layout, warmth
        self.registers, self.read_sample, self.was_loose = {}, -1, False

    def write(self, register, value):
        self.registers[register] = value

    def read(self, register, count):
        if is_loose():
            self.registers = {}  # without power it forgets
        known = dict([self.identity])
        k = sample()
        register_of_test, bits = SELF_TEST
        is_in_test = self.registers.get(register_of_test, 0) & bits == bits
        settings = dict(self.registers)
        settings[register_of_test] = settings.get(register_of_test, 0) & ~bits
        works = all(settings.get(r) == v for r, v in self.needed)
        known[self.status[0]] = self.status[1] if works and k != self.read_sample else 0
        if works:
            y = -300 + 500 * STEP * is_in_test
            for i, byte in enumerate(self.layout(k % 100 * STEP, y, ONE_G)):
                known[self.data + i] = byte
            for i, byte in enumerate(self.warmth[1]):
                known[self.warmth[0] + i] = byte
        if register == self.data:
            self.read_sample = k
        return bytes([known.get(r, 0) for r in range(register, register + count)])


def joined(encode):
    return lambda x, y, z: encode(x) + encode(y) + encode(z)


CHIPS = {
    'adxl345': lambda: Chip(
        (0x00, 0xE5),
        [(0x2D, 0x08), (0x2C, 0x0A), (0x31, 0)],
        (0x30, 0x80),
        0x32,
        joined(little),
        (0, []),
    ),
    'adxl355': lambda: Chip(
        (0x02, 0xED),
        [(0x2D, 0x00), (0x28, 0x05), (0x2C, 0x81)],
        (0x04, 0x01),
        0x08,
        joined(left),
        (0x06, big(int(1885 - (WARM_C - 25) * 9.05 + 0.5))),
    ),
    'lsm6dso': lambda: Chip(
        (0x0F, 0x6C),
        [(0x10, 0x40), (0x12, 0x44)],
        (0x1E, 0x01),
        0x28,
        joined(little),
        (0x20, little(int((WARM_C - 25) * 256))),
    ),
    'mpu6050': lambda: Chip(
        (0x75, 0x68),
        [(0x6B, 0x01), (0x1A, 0x03), (0x19, 0x09), (0x1C, 0x00), (0x38, 0x01)],
        (0x3A, 0x01),
        0x3B,
        joined(big),
        (0x41, big(int((WARM_C - 36.53) * 340) & 0xFFFF)),
    ),
}
chip = CHIPS[NAME]() if NAME in CHIPS else None


class Pin:
    OUT = 1
    selected = False

    def __init__(self, number, mode=None, value=None):
        self.number = number

    def __call__(self, value):
        if self.number == ST_PIN:
            ADC.step_v = 0.1 * value
        SPI.register = None


class SPI:
    register = None

    def __init__(self, bus, baudrate, polarity, phase, sck, mosi, miso):
        # The ADXL345 wants mode 3 and at most 5 MHz, the ADXL355 mode 0 and at most 10 MHz.
        assert polarity == phase == (NAME == 'adxl345') and baudrate <= 5_000_000

    def write(self, raw):
        first = raw[0]
        if NAME == 'adxl345':
            SPI.register, is_read, several = first & 0x3F, first & 0x80, first & 0x40
        else:
            SPI.register, is_read, several = first >> 1, first & 1, True
        if len(raw) > 1:
            assert not is_read
            chip.write(SPI.register, raw[1])
        else:
            assert is_read and several

    def read(self, count):
        return b'\xff' * count if is_loose() else chip.read(SPI.register, count)


class I2C:
    def __init__(self, bus, sda, scl, freq):
        assert freq <= 400_000

    def _check(self, address):
        if is_loose():
            chip.registers = {}
            raise OSError(5)
        assert address == (0x68 if NAME == 'mpu6050' else 0x6A)

    def readfrom_mem(self, address, register, count):
        self._check(address)
        return chip.read(register, count)

    def writeto_mem(self, address, register, raw):
        self._check(address)
        chip.write(register, raw[0])


class ADC:
    """Volts of an ADXL335 at 3.3 V, by pin, in 12 bits that are repeated to 16."""

    step_v = 0.0

    def __init__(self, pin):
        self.number = pin.number

    def read_u16(self):
        volts = {26: 1.65, 27: 1.60 + self.step_v, 28: 1.98}[self.number]
        code = int(volts / 3.3 * 4096)
        return code << 4 | code >> 8


class machine:
    ADC, I2C, Pin, SPI = ADC, I2C, Pin, SPI


sys.modules['machine'] = machine
sys.modules['time'] = time
sys.path.insert(0, FIRMWARE)
with open(FIRMWARE + '/main.py') as file:
    program = file.read().replace("SENSOR = 'adxl345'", f'SENSOR = {NAME!r}')
    program = program.replace('SELF_TEST_PIN = None', f'SELF_TEST_PIN = {ST_PIN}')
exec(program)
