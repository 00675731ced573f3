# SPDX-License-Identifier: Apache-2.0

"""The header of a CSV recording: its columns and their units."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import ACCEL, REFERENCES, sensor_columns, TIME, VOLTS

_UNITS = (
    ('s', 'ms', 'us', 'ns', 'min', 'h', 'sec'),
    ('v', 'mv', 'uv', 'kv', 'volt', 'volts', 'lsb', 'adc', 'counts'),
    ('mps2', 'g', 'mg', 'ug', 'ms2', 'm_s2', 'mss', 'cmps2', 'mmps2', 'gal'),
    ('rad', 'deg', 'degree', 'degrees', 'mrad', 'urad', 'arcmin', 'arcsec', 'rev', 'turns'),
    ('m', 'mm', 'cm', 'um', 'nm'),
    ('c', 'k', 'f', 'degc', 'degf', 'celsius', 'kelvin', 'fahrenheit'),
)
"""Ends of column names by quantity: the unit of this package first, then other units that people
write. A column with another unit is refused, not taken for a further column."""

_SYMBOLS = {'s': 's', 'v': 'V', 'mps2': 'm/s²', 'rad': 'rad', 'm': 'm', 'c': '°C'}
"""Symbols of the package's units, for messages."""


class HeaderError(UserError):
    """The columns are not those of a recording; a mapping may read them."""


@dataclass(frozen=True)
class Header:
    """The columns of a CSV file."""

    names: tuple[str, ...]  # All columns, in order; an empty name is a column that is not read
    sensor: tuple[str, ...]  # The columns with the sensor's output

    def index(self, name: str) -> int:
        """Return the index of a column, from 0."""
        return self.names.index(name)

    @property
    def needed(self) -> tuple[str, ...]:
        """Columns that must have a number in every row."""
        return (TIME, *self.sensor)

    @property
    def references(self) -> tuple[str, ...]:
        """Columns that may be empty where the reference was not sampled."""
        return tuple(name for name in self.names if name in REFERENCES)

    def is_other(self, name: str) -> bool:
        """Return whether a column is none of the package's own, so that it may hold text."""
        return name not in self.needed and name not in REFERENCES


def parse_header(where: str, fields: list[str], needed: tuple[str, ...] | None) -> Header:
    """Check the names of the columns."""
    names = tuple(name.strip() for name in fields)
    _refuse_delimiter(where, names)
    _refuse_duplicates(where, names)
    named = [name for name in names if name]
    for column in _wanted(names):
        _refuse_other_unit(where, names, column)
    if TIME not in names:
        raise HeaderError(f'{where}: no column {TIME}; the columns are {", ".join(named)}')
    if needed is None:
        try:
            return Header(names, sensor_columns(named, where))
        except UserError as error:
            raise HeaderError(str(error)) from None
    for column in needed:
        if column not in names:
            raise HeaderError(f'{where}: no column {column}; the columns are {", ".join(named)}')
    return Header(names, needed)


def _wanted(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the columns that may stand there in other units, for one form of output only."""
    if any(name in names for name in VOLTS):
        return (TIME, *VOLTS, *REFERENCES)
    if any(name in names for name in ACCEL):
        return (TIME, *ACCEL, *REFERENCES)
    return (TIME, *VOLTS, *ACCEL, *REFERENCES)


def _refuse_delimiter(where: str, names: tuple[str, ...]) -> None:
    for mark, name in ((';', 'semicolons'), ('\t', 'tabs')):
        if len(names) == 1 and mark in names[0]:
            raise HeaderError(f'{where}: the columns are separated by {name}, expected commas '
                              'and a decimal point')


def _refuse_duplicates(where: str, names: tuple[str, ...]) -> None:
    for name, count in Counter(names).items():
        if name and count > 1:
            fields = [str(i + 1) for i, other in enumerate(names) if other == name]
            raise HeaderError(f'{where}:{fields[1]}: column {name} stands {count} times, '
                              f'in the fields {", ".join(fields)}; keep one')


def _refuse_other_unit(where: str, names: tuple[str, ...], column: str) -> None:
    if column in names:
        return
    stem, unit = column.rsplit('_', 1)
    others = next(units[1:] for units in _UNITS if units[0] == unit)
    for i, name in enumerate(names):
        if name.lower() in {f'{stem}_{other}' for other in others}:
            raise HeaderError(f'{where}:{i + 1}: column {name} is in another unit; expected '
                              f'{_SYMBOLS[unit]}, in a column named {column}')
