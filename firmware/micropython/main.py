# SPDX-License-Identifier: Apache-2.0

"""
Send an accelerometer to the driver of adxl_ros. This program starts with the board.

Change the first four lines after the imports. `mpremote` stops the program.
"""

import sys

from adxl_board import Board
from adxl_sensors import SENSORS

SENSOR = 'adxl345'  # adxl203, adxl335, adxl345, adxl355, lsm6dso or mpu6050
SERIAL_NUMBER = 'adxl-0001'  # of the sensor on this board, at most 16 characters
ADDRESS = None  # on I2C; None is the usual one: 0x68, of an LSM6DSO 0x6A
SELF_TEST_PIN = None  # at ST of an ADXL203 or ADXL335; a chip on SPI or I2C has a register

# Numbers of the pins. ADC: x, y, z. SPI: bus, clock, data out, data in, select. I2C: data, clock.
PINS = {
    'rp2': {'adc': (26, 27, 28), 'spi': (0, 18, 19, 16, 17), 'i2c': (4, 5)},
    'esp32': {'adc': (36, 39, 34), 'spi': (2, 18, 23, 19, 5), 'i2c': (21, 22)},
}

pins = dict(PINS.get(sys.platform, PINS['rp2']))
if ADDRESS is not None:
    pins['address'] = ADDRESS
if SELF_TEST_PIN is not None:
    pins['st'] = SELF_TEST_PIN
Board(SENSORS[SENSOR](pins), SERIAL_NUMBER).run()
