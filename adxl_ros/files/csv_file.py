# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
CSV recordings, read in blocks.

A block of lines that holds nothing but numbers is parsed in one go. Where that fails, it is read
field by field, which takes text and quotes, and finds the line and column to name.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import csv
from dataclasses import dataclass
import os
import re
from typing import BinaryIO
import warnings

from adxl_ros.errors import UserError
from adxl_ros.files.csv_header import Header, parse_header
from adxl_ros.files.recording_columns import LIMIT, Recording, TIME
import numpy as np

_CHUNK_BYTES = 1 << 22
_LONGEST_LINE_BYTES = 1 << 20

# As nanoseconds, a stamp has to fit in 64 bits.
_TIME_LIMIT_S = 9e9

_INFO = re.compile(r'#+\s*([A-Za-z_][\w.]*)\s*:(?:\s+(.*))?$')
_NUMBER = re.compile(r'\s*([-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?|[-+]?(nan|inf|infinity))?\s*',
                     re.ASCII | re.IGNORECASE)


@dataclass
class _Lines:
    """Lines of samples, each with its newline, their numbers in the file, and what follows."""

    data: bytes
    numbers: Sequence[int]
    done: float
    open_end: bool

    def where(self, path: str, row: int, column: int) -> str:
        return f'{path}:{self.numbers[row]}:{column + 1}'

    def fields(self, path: str, row: int) -> list[str]:
        """Return the fields of one line."""
        return _split(path, self.data.split(b'\n', row + 1)[row], self.numbers[row])

    def rows(self, path: str) -> list[list[str]]:
        """Return the fields of all lines."""
        return [_split(path, line, number)
                for line, number in zip(self.data.split(b'\n'), self.numbers)]


def _split(path: str, line: bytes, number: int) -> list[str]:
    try:
        return next(csv.reader([_decode(path, line, number)]))
    except csv.Error as error:
        raise UserError(f'{path}:{number}: cannot read the line: {error}') from None


def _decode(path: str, line: bytes, number: int) -> str:
    try:
        return line.decode()
    except UnicodeDecodeError as error:
        raise UserError(f'{path}:{number}: byte {error.start + 1} of the line, '
                        f'0x{line[error.start]:02x}, is not UTF-8; save the file as UTF-8'
                        ) from None


@dataclass
class _State:
    """What reading the earlier blocks left behind."""

    path: str
    header: Header
    used: list[str]
    epoch_ns: int
    last_time_s: float = -np.inf
    last_line: int = 0


def blocks(path: str | os.PathLike, rows: int,
           needed: tuple[str, ...] | None = None) -> Iterator[Recording]:
    """
    Read a CSV recording in blocks of at most `rows` samples.

    Parameters
    ----------
    path
        The file.
    rows
        Largest number of samples of a block.
    needed
        Columns beside `time_s` that must have a number in every row; None is the sensor's output
        in any form.

    Raises
    ------
    UserError
        With file, line and column of what is wrong.

    """
    path = str(path)
    try:
        with open(path, 'rb') as file:
            yield from _blocks(path, file, rows, needed)
    except OSError as error:
        raise UserError(f'{path}: cannot read: {error.strerror or error}') from None


def _blocks(path: str, file: BinaryIO, rows: int,
            needed: tuple[str, ...] | None) -> Iterator[Recording]:
    info: dict[str, str] = {}
    state = None
    count = 0
    for lines in _chunks(path, file, info):
        if state is None:
            state = _begin(path, lines, info, needed)
        if not lines.data:
            continue
        columns = _columns(state, lines)
        time_s = columns.pop(TIME)
        for start in range(0, len(time_s), rows):
            part = slice(start, start + rows)
            yield Recording(path, time_s[part], {k: v[part] for k, v in columns.items()},
                            dict(info), epoch_ns=state.epoch_ns, done=lines.done)
        count += len(time_s)
    if state is None:
        raise UserError(f'{path}: is empty; a recording has a header and a line for each sample')
    if not count:
        raise UserError(f'{path}: has a header, but no samples')


def _begin(path: str, lines: _Lines, info: dict[str, str],
           needed: tuple[str, ...] | None) -> _State:
    """Take the header off the first lines."""
    header = parse_header(f'{path}:{lines.numbers[0]}', lines.fields(path, 0), needed)
    lines.data = lines.data.split(b'\n', 1)[1]
    lines.numbers = lines.numbers[1:]
    return _State(path, header, [name for name in header.names if name], _epoch_ns(path, info))


def _epoch_ns(path: str, info: dict[str, str]) -> int:
    text = info.get('epoch_ns', '0')
    if not re.fullmatch(r'-?\d{1,19}', text) or abs(int(text)) >= 1 << 63:
        raise UserError(f'{path}: epoch_ns is {text!r}, expected whole nanoseconds')
    return int(text)


def _chunks(path: str, file: BinaryIO, info: dict[str, str]) -> Iterator[_Lines]:
    """Cut the file into whole lines; comments go to `info`, empty lines nowhere."""
    size = os.fstat(file.fileno()).st_size
    number = 1
    for data in _whole_lines(path, file):
        if number == 1:
            data = _without_mark(path, data)
        open_end = not data.endswith(b'\n')
        data = data.replace(b'\r\n', b'\n') + b'\n' * open_end
        count = data.count(b'\n')
        lines = _Lines(data, range(number, number + count), file.tell() / max(size, 1), open_end)
        number += count
        if _has_other_lines(data):
            _drop_other_lines(path, lines, info)
        if lines.data:
            yield lines


def _whole_lines(path: str, file: BinaryIO) -> Iterator[bytes]:
    rest = b''
    while data := file.read(_CHUNK_BYTES):
        data = rest + data
        end = data.rfind(b'\n') + 1
        rest = data[end:]
        if len(rest) > _LONGEST_LINE_BYTES:
            raise UserError(f'{path}: a line is longer than {_LONGEST_LINE_BYTES} bytes; '
                            'this is no CSV recording')
        if end:
            yield data[:end]
    if rest:
        yield rest


def _without_mark(path: str, data: bytes) -> bytes:
    if data[:2] in (b'\xff\xfe', b'\xfe\xff'):
        raise UserError(f'{path}:1:1: is UTF-16; save the file as UTF-8')
    return data.removeprefix(b'\xef\xbb\xbf')


def _has_other_lines(data: bytes) -> bool:
    """Tell whether there may be comments or empty lines."""
    return data.startswith(b'\n') or any(
        mark in data for mark in (b'#', b'\n\n', b' \n', b'\t\n'))


def _drop_other_lines(path: str, lines: _Lines, info: dict[str, str]) -> None:
    kept, numbers = [], []
    for line, number in zip(lines.data.split(b'\n'), lines.numbers):
        text = line.strip()
        if text.startswith(b'#'):
            if found := _INFO.match(_decode(path, text, number)):
                info[found[1]] = (found[2] or '').strip()
        elif text:
            kept.append(line + b'\n')
            numbers.append(number)
    lines.data, lines.numbers = b''.join(kept), numbers


def _columns(state: _State, lines: _Lines) -> dict[str, np.ndarray]:
    """Parse and check the samples of some lines; return the columns that are numbers."""
    table = _fast(state, lines)
    if table is None:
        table = _field_by_field(state, lines)
    columns = {name: np.ascontiguousarray(table[:, i]) for i, name in enumerate(state.used)}
    _check_values(state, lines, columns)
    _check_time(state, lines, columns[TIME])
    return columns


def _fast(state: _State, lines: _Lines) -> np.ndarray | None:
    """Parse all lines in one go; None where a line needs a closer look."""
    names = state.header.names
    data = _unpadded(lines.data)
    bounds = _bounds(data, len(names))
    if bounds is None:
        return None
    used = [state.header.index(name) for name in state.used]
    data = _blanked(data, bounds, sorted(set(range(len(names))) - set(used)))
    # numpy reads a field of nothing but white space as -1.
    if any(space in data for space in b' \t\v\f\r'):
        return None
    text = data.replace(b'\n', b',')
    if text.startswith(b','):
        text = b'nan' + text
    # Of three commas in a row, one pass sees only the first pair.
    while b',,' in text:
        text = text.replace(b',,', b',nan,')
    with warnings.catch_warnings():
        # Older numpy only warns of text, and stops there.
        warnings.simplefilter('error')
        try:
            values = np.fromstring(text, sep=',')
        except (ValueError, DeprecationWarning):
            return None
    size = len(names) * len(lines.numbers)
    return values.reshape(-1, len(names))[:, used] if len(values) == size else None


def _unpadded(data: bytes) -> bytes:
    """Take out the spaces beside commas and newlines."""
    if b'\t' in data:
        data = data.replace(b'\t', b' ')
    if b' ' in data:
        for padded in (b', ', b' ,', b'\n ', b' \n'):
            while padded in data:
                data = data.replace(padded, padded.strip(b' '))
    return data


def _bounds(data: bytes, count: int) -> np.ndarray | None:
    """
    Return where the fields are bounded, by line; None where a line has not `count` fields.

    Field k stands between bounds k and k + 1, the places of the commas and newlines beside it.
    """
    characters = np.frombuffer(data, np.uint8)
    ends = np.flatnonzero(characters == ord('\n'))
    commas = np.flatnonzero(characters == ord(','))
    if len(commas) != (count - 1) * len(ends):
        return None
    starts = np.concatenate([[-1], ends[:-1]])
    bounds = np.column_stack([starts, commas.reshape(len(ends), count - 1), ends])
    return bounds if (np.diff(bounds, axis=1) > 0).all() else None


def _blanked(data: bytes, bounds: np.ndarray, unused: list[int]) -> bytes:
    """Take out the text of unused fields."""
    if not unused:
        return data
    change = np.zeros(len(data) + 1, np.int8)
    for k in unused:
        change[bounds[:, k] + 1] += 1
        change[bounds[:, k + 1]] -= 1
    kept = np.cumsum(change[:-1], dtype=np.int8) == 0
    return np.frombuffer(data, np.uint8)[kept].tobytes()


def _field_by_field(state: _State, lines: _Lines) -> np.ndarray:
    """Parse with Python, naming what is no number and dropping other columns with text."""
    header = state.header
    rows = lines.rows(state.path)
    for i, fields in enumerate(rows):
        if len(fields) != len(header.names):
            _refuse_field_count(state, lines, i, len(fields))
    columns = []
    for name in list(state.used):
        index = header.index(name)
        fields = [row[index] for row in rows]
        wrong = next((i for i, one in enumerate(fields) if not _NUMBER.fullmatch(one)), None)
        if wrong is None:
            columns.append([float(one) if one.strip() else np.nan for one in fields])
        elif header.is_other(name):
            state.used.remove(name)
        else:
            raise UserError(f'{lines.where(state.path, wrong, index)}: {name} is '
                            f'{fields[wrong]!r}, not a number{_cut_hint(lines, wrong)}')
    return np.column_stack(columns)


def _refuse_field_count(state: _State, lines: _Lines, row: int, count: int) -> None:
    expected = len(state.header.names)
    raise UserError(f'{lines.where(state.path, row, min(count, expected))}: {count} fields, but '
                    f'the header has {expected}{_cut_hint(lines, row)}')


def _cut_hint(lines: _Lines, row: int) -> str:
    if lines.open_end and row == len(lines.numbers) - 1:
        return '; the file ends in the middle of this line: delete it'
    return ''


def _check_values(state: _State, lines: _Lines, columns: dict[str, np.ndarray]) -> None:
    """Refuse the first row with a number that no sensor, reference or clock gives."""
    first: tuple[int, str] | None = None
    for name in (*state.header.needed, *state.header.references):
        limit = _TIME_LIMIT_S if name == TIME else LIMIT
        size = np.abs(columns[name])
        wrong = size > limit if name in state.header.references else ~(size <= limit)
        if wrong.any():
            row = int(wrong.argmax())
            first = (row, name) if first is None else min(first, (row, name))
    if first is None:
        return
    row, name = first
    index = state.header.index(name)
    text = lines.fields(state.path, row)[index].strip()
    value = columns[name][row]
    where = lines.where(state.path, row, index)
    if not text:
        raise UserError(f'{where}: {name} is empty; every sample needs it')
    if not np.isfinite(value):
        raise UserError(f'{where}: {name} is {text}, not a finite number; delete the line')
    limit = _TIME_LIMIT_S if name == TIME else LIMIT
    raise UserError(f'{where}: {name} is {text}, beyond ±{limit:g}; delete the line or mend '
                    'its unit')


def _check_time(state: _State, lines: _Lines, time_s: np.ndarray) -> None:
    earlier = np.concatenate([[state.last_time_s], time_s[:-1]])
    wrong = ~(time_s > earlier)
    if wrong.any():
        row = int(wrong.argmax())
        before = lines.numbers[row - 1] if row else state.last_line
        verb = 'stands still' if time_s[row] == earlier[row] else 'runs backwards'
        where = lines.where(state.path, row, state.header.index(TIME))
        raise UserError(f'{where}: time {verb}: {TIME} is {float(time_s[row])!r} after '
                        f'{float(earlier[row])!r} on line {before}')
    state.last_time_s = float(time_s[-1])
    state.last_line = lines.numbers[len(time_s) - 1]
