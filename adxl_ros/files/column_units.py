# SPDX-License-Identifier: Apache-2.0

"""Units of the columns of foreign files, and their conversion to the units of the package."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
import re

from adxl_ros.model.constants import AXES, G0_MPS2
import numpy as np


class Quantity(Enum):
    """
    What a column measures.

    The value names the unit of the package, as `--columns` writes it.
    """

    TIME = 's'
    OUTPUT = 'mps2'
    ANGLE = 'rad'
    LENGTH = 'm'
    TEMPERATURE = 'c'
    VOLTAGE = 'v'


ROLES: Mapping[str, Quantity] = {
    'time': Quantity.TIME,
    **dict.fromkeys(AXES, Quantity.OUTPUT),
    **dict.fromkeys(('alpha', 'beta', 'roll', 'pitch'), Quantity.ANGLE),
    'shift': Quantity.LENGTH,
    'temperature': Quantity.TEMPERATURE,
    'supply': Quantity.VOLTAGE,
}
"""Quantity of each role that a column can have."""

LSB = 'lsb'
"""Unit of counts, which need the counts of 1 g."""

UNSIGNED = 'u16'
"""Unit of counts of 16 bits whose sign was lost: 65535 is −1."""


def signed(values: np.ndarray) -> np.ndarray:
    """Return counts of 16 bits with their sign, (n,)."""
    return np.where(values >= 1 << 15, values - (1 << 16), values)


@dataclass(frozen=True)
class Unit:
    """A unit: value in the unit of the package = value · factor / divisor + offset."""

    quantity: Quantity  # What it measures
    # divisor, factor, offset: The conversion. A division by a power of ten is exact where a
    # product is not.
    divisor: float = 1.0
    factor: float = 1.0
    offset: float = 0.0
    is_volts: bool = False  # Whether the output of a sensor stays in volts

    def convert(self, values: np.ndarray) -> np.ndarray:
        """Return values in the unit of the package."""
        with np.errstate(over='ignore'):  # such a value is refused afterwards
            return values * self.factor / self.divisor + self.offset


UNITS: Mapping[Quantity, Mapping[str, Unit]] = {
    Quantity.TIME: {
        's': Unit(Quantity.TIME),
        'ms': Unit(Quantity.TIME, 1e3),
        'us': Unit(Quantity.TIME, 1e6),
        'ns': Unit(Quantity.TIME, 1e9),
        'epoch': Unit(Quantity.TIME),
    },
    Quantity.OUTPUT: {
        'g': Unit(Quantity.OUTPUT, factor=G0_MPS2),
        'mg': Unit(Quantity.OUTPUT, 1e3, G0_MPS2),
        'mps2': Unit(Quantity.OUTPUT),
        LSB: Unit(Quantity.OUTPUT, factor=G0_MPS2),
        UNSIGNED: Unit(Quantity.OUTPUT, factor=G0_MPS2),
        'v': Unit(Quantity.OUTPUT, is_volts=True),
        'mv': Unit(Quantity.OUTPUT, 1e3, is_volts=True),
    },
    Quantity.ANGLE: {
        'rad': Unit(Quantity.ANGLE),
        'deg': Unit(Quantity.ANGLE, 180.0, np.pi),
    },
    Quantity.LENGTH: {
        'm': Unit(Quantity.LENGTH),
        'mm': Unit(Quantity.LENGTH, 1e3),
    },
    Quantity.TEMPERATURE: {
        'c': Unit(Quantity.TEMPERATURE),
        'k': Unit(Quantity.TEMPERATURE, offset=-273.15),
        'f': Unit(Quantity.TEMPERATURE, 9.0, 5.0, -160.0 / 9.0),
    },
    Quantity.VOLTAGE: {
        'v': Unit(Quantity.VOLTAGE),
        'mv': Unit(Quantity.VOLTAGE, 1e3),
    },
}
"""Units by quantity and name."""

_ALIASES = {
    'µs': 'us', 'μs': 'us', 'usec': 'us', 'micros': 'us', 'microseconds': 'us',
    'sec': 's', 'secs': 's', 'second': 's', 'seconds': 's',
    'msec': 'ms', 'millis': 'ms', 'milliseconds': 'ms', 'nsec': 'ns', 'nanoseconds': 'ns',
    'unix': 'epoch', 'posix': 'epoch',
    'm/s^2': 'mps2', 'm/s²': 'mps2', 'm/s2': 'mps2', 'ms2': 'mps2', 'ms^2': 'mps2',
    'm/s/s': 'mps2', 'ms-2': 'mps2', 'ms^-2': 'mps2', 'm_s2': 'mps2', 'mss': 'mps2',
    'm·s⁻²': 'mps2', 'm.s-2': 'mps2', 'm s^-2': 'mps2', 'm s-2': 'mps2',
    'millig': 'mg', 'gs': 'g',
    'counts': LSB, 'count': LSB, 'raw': LSB, 'digits': LSB,
    'volt': 'v', 'volts': 'v', 'millivolt': 'mv', 'millivolts': 'mv',
    '°': 'deg', 'degree': 'deg', 'degrees': 'deg', 'radian': 'rad', 'radians': 'rad',
    '°c': 'c', 'degc': 'c', 'celsius': 'c', 'deg_c': 'c', 'deg c': 'c',
    '°f': 'f', 'degf': 'f', 'fahrenheit': 'f', 'kelvin': 'k',
}
"""Other spellings of units, in lower case."""

_BRACKETS = re.compile(r'[(\[{]\s*([^()\[\]{}]+?)\s*[)\]}]')
"""A part of a column's name in brackets."""

_WORD_ENDS = re.compile(r'[_\s.]+|\[\d+\]|[(\[{].*[)\]}]|(?<=[a-z])(?=[A-Z])')
"""Ends of the words in a column's name; an index or a part in brackets is none."""


def unit_name(text: str, quantity: Quantity) -> str | None:
    """Return the name of a unit that is written in any way."""
    word = text.strip().lower()
    name = _ALIASES.get(word, word)
    return name if name in UNITS[quantity] else None


def unit_in_name(column: str, quantity: Quantity) -> str | None:
    """Return the unit that the name of a column states: in brackets, or as one of its words."""
    parts = [part for part in _WORD_ENDS.split(column.strip()) if part]
    # The first word names the quantity: a column `g` or `C` may be anything.
    words = [*_BRACKETS.findall(column), '_'.join(parts[-2:]), *reversed(parts[1:])]
    if quantity is Quantity.TIME:
        words += parts
    return next((name for name in (unit_name(word, quantity) for word in words) if name), None)
