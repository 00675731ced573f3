# SPDX-License-Identifier: Apache-2.0

"""CSV recordings in the columns and units of the package, read and written in blocks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
import os
import re
from typing import NoReturn

from adxl_ros.errors import UserError
from adxl_ros.files.atomic_write import atomic_path, release_written
from adxl_ros.files.delimited_text import after, Layout, Lines, parse_numbers, read_lines
from adxl_ros.files.recording_columns import (
    ACCEL,
    LIMIT,
    Recording,
    REFERENCES,
    sensor_columns,
    TIME,
    VOLTS,
)
import numpy as np

TIME_LIMIT_S = 9e9
"""Largest magnitude of a time, s: in nanoseconds it fits into 64 bits (9.2e18)."""

_UNITS = {
    's': ('s', ('ms', 'us', 'ns', 'min', 'h', 'sec')),
    'v': ('V', ('mv', 'uv', 'kv', 'volt', 'volts', 'lsb', 'adc', 'counts')),
    'mps2': ('m/s²', ('g', 'mg', 'ug', 'ms2', 'm_s2', 'mss', 'cmps2', 'mmps2', 'gal')),
    'rad': ('rad', ('deg', 'degree', 'degrees', 'mrad', 'urad', 'arcmin', 'arcsec', 'rev',
                    'turns')),
    'm': ('m', ('mm', 'cm', 'um', 'nm')),
    'c': ('°C', ('k', 'f', 'degc', 'degf', 'celsius', 'kelvin', 'fahrenheit')),
}
"""Symbols of the package's units by the end of a column's name, and other ends that people write.
A column with another unit is refused, not taken for a further column."""


class HeaderError(UserError):
    """The columns are not those of a recording; a mapping may read them."""


def blocks(path: str | os.PathLike, rows: int,
           needed: tuple[str, ...] | None = None) -> Generator[Recording, None, None]:
    """Read a CSV recording in blocks of at most `rows` samples."""
    path = str(path)
    info: dict[str, str] = {}
    reader = None
    count = 0
    for lines in read_lines(path, info):
        if reader is None:
            reader = _Reader(lines, info, needed)
            lines = after(lines, lines.numbers[0])
        if not lines.data:
            continue
        columns = reader.columns(lines)
        part = Recording(path, columns.pop(TIME), columns, dict(info), epoch_ns=reader.epoch_ns,
                         done=lines.done)
        for start in range(0, len(part), rows):
            yield part.rows(start, start + rows)
        count += len(part)
    if reader is None:
        raise UserError(f'{path}: is empty; a recording has a header and a line for each sample')
    if not count:
        raise UserError(f'{path}: has a header, but no samples')


def epoch_ns(path: str, info: Mapping[str, str]) -> int:
    """Return the origin of the times that comments state, ns; else 0."""
    text = info.get('epoch_ns', '0')
    if not re.fullmatch(r'-?\d{1,19}', text) or abs(int(text)) >= 1 << 63:
        raise UserError(f'{path}: epoch_ns is {text!r}, expected whole nanoseconds')
    return int(text)


class _Reader:
    """Parses and checks blocks of lines, one after the other."""

    def __init__(self, lines: Lines, info: Mapping[str, str], needed: tuple[str, ...] | None
                 ) -> None:
        """Parse the header, the first of the lines."""
        try:
            fields = lines.fields(0)
        except UserError as error:
            raise HeaderError(str(error)) from None
        names = tuple(name.strip() for name in fields)
        sensor = _sensor_columns(f'{lines.path}:{lines.numbers[0]}', names, needed)
        self.epoch_ns = epoch_ns(lines.path, info)
        self._needed = (TIME, *sensor)
        self._references = [name for name in names if name in REFERENCES]
        self._layout = Layout(names, [name for name in names if name],
                              {*self._needed, *self._references})
        self._last_time_s, self._last_line = -np.inf, 0

    def columns(self, lines: Lines) -> dict[str, np.ndarray]:
        """Parse and check the samples of some lines; return the columns that are numbers."""
        columns = parse_numbers(self._layout, lines)
        self._check_values(lines, columns)
        self._check_time(lines, columns[TIME])
        return columns

    def _check_values(self, lines: Lines, columns: Mapping[str, np.ndarray]) -> None:
        """Refuse the first row with a number that no sensor, reference or clock gives."""
        refused: list[tuple[int, str]] = []
        for name in (*self._needed, *self._references):
            wrong = ~(np.abs(columns[name]) <= _limit(name))
            if name in self._references:
                wrong &= ~np.isnan(columns[name])
            if wrong.any():
                refused.append((int(wrong.argmax()), name))
        if refused:
            row, name = min(refused)
            self._refuse(lines, row, name, columns[name][row])

    def _refuse(self, lines: Lines, row: int, name: str, value: float) -> NoReturn:
        """Raise the error of a number that is empty, not finite or too large."""
        index = self._layout.names.index(name)
        text = lines.fields(row)[index].strip()
        reason = f'is {text}, beyond ±{_limit(name):g}; delete the line or correct its unit'
        if not text:
            reason = 'is empty; every sample needs it'
        elif not np.isfinite(value):
            reason = f'is {text}, not a finite number; delete the line'
        raise UserError(f'{lines.where(row, index)}: {name} {reason}')

    def _check_time(self, lines: Lines, time_s: np.ndarray) -> None:
        """Refuse times, s, (n,), that do not increase; remember the last one."""
        earlier = np.concatenate([[self._last_time_s], time_s[:-1]])
        wrong = ~(time_s > earlier)
        if wrong.any():
            row = int(wrong.argmax())
            before = lines.numbers[row - 1] if row else self._last_line
            verb = 'stands still' if time_s[row] == earlier[row] else 'runs backwards'
            where = lines.where(row, self._layout.names.index(TIME))
            raise UserError(f'{where}: time {verb}: {TIME} is {float(time_s[row])!r} after '
                            f'{float(earlier[row])!r} on line {before}')
        self._last_time_s, self._last_line = float(time_s[-1]), lines.numbers[-1]


def _limit(name: str) -> float:
    """Return the largest magnitude of a column, in its unit."""
    return TIME_LIMIT_S if name == TIME else LIMIT


def _sensor_columns(where: str, names: Sequence[str], needed: tuple[str, ...] | None
                    ) -> tuple[str, ...]:
    """Check the names of the columns, and return those with the output of the sensor."""
    for mark, text in ((';', 'semicolons'), ('\t', 'tabs')):
        if len(names) == 1 and mark in names[0]:
            raise HeaderError(f'{where}: the columns are separated by {text}, expected commas '
                              'and a decimal point')
    for name, count in Counter(names).items():
        if name and count > 1:
            fields = [str(i + 1) for i, other in enumerate(names) if other == name]
            raise HeaderError(f'{where}:{fields[1]}: column {name} stands {count} times, '
                              f'in the fields {", ".join(fields)}; keep one')
    # Where one form of output is there, the other may stand there in any unit.
    outputs = next((kind for kind in (VOLTS, ACCEL) if set(kind) & set(names)), (*VOLTS, *ACCEL))
    for column in (TIME, *outputs, *REFERENCES):
        if column not in names:
            _refuse_other_unit(where, names, column)
    named = [name for name in names if name]
    for column in (TIME, *(needed or ())):
        if column not in names:
            raise HeaderError(f'{where}: no column {column}; the columns are {", ".join(named)}')
    try:
        return needed or sensor_columns(named, where)
    except UserError as error:
        raise HeaderError(str(error)) from None


def _refuse_other_unit(where: str, names: Sequence[str], column: str) -> None:
    stem, unit = column.rsplit('_', 1)
    symbol, others = _UNITS[unit]
    for i, name in enumerate(names):
        if name.lower() in {f'{stem}_{other}' for other in others}:
            raise HeaderError(f'{where}:{i + 1}: column {name} is in another unit; expected '
                              f'{symbol}, in a column named {column}')


Append = Callable[..., None]
"""Appends rows: arrays (n,) by column name, in the order of the file, the same names every time;
and the keys and values of the comments before the header."""


@contextmanager
def csv_writer(path: str | os.PathLike, digits: int | None = None) -> Iterator[Append]:
    """
    Open a new CSV file, and yield a function that appends rows to it.

    The file appears under its name when the block ends without an error. Numbers have all the
    digits that bring back the same float64, or all but those of the first column are rounded to
    some significant digits. NaN is written empty.
    """
    has_header = False
    with atomic_path(path) as fresh, open(fresh, 'wb') as file:
        def append(columns: Mapping[str, np.ndarray], info: Mapping[str, str] | None = None
                   ) -> None:
            nonlocal has_header
            if not has_header:
                file.writelines(f'# {key}: {" ".join(value.split())}\n'.encode()
                                for key, value in (info or {}).items())
                file.write((','.join(columns) + '\n').encode())
                has_header = True
            arrays = {name: np.asarray(values) for name, values in columns.items()}
            if digits is not None:
                arrays = {name: values if i == 0 else _rounded(values, digits)
                          for i, (name, values) in enumerate(arrays.items())}
            file.write(_rows(arrays))
            release_written(file)

        yield append


def _rows(columns: dict[str, np.ndarray]) -> bytes:
    """Return rows of text: by pyarrow where it is installed, which takes a tenth of the time."""
    try:
        import pyarrow.csv
    except ImportError:
        import pandas
        return pandas.DataFrame(columns).to_csv(header=False, index=False).encode()
    table = pyarrow.table({name: pyarrow.array(values, from_pandas=True)
                           for name, values in columns.items()})
    sink = pyarrow.BufferOutputStream()
    pyarrow.csv.write_csv(table, sink, pyarrow.csv.WriteOptions(include_header=False))
    return sink.getvalue().to_pybytes()


def _rounded(values: np.ndarray, digits: int) -> np.ndarray:
    """Round numbers to significant digits."""
    with np.errstate(all='ignore'):  # zero, NaN and infinity stay as they are
        scale = 10.0 ** (digits - 1 - np.floor(np.log10(np.abs(values))))
        rounded = np.rint(values * scale) / scale
    return np.where(np.isfinite(rounded), rounded, values)
