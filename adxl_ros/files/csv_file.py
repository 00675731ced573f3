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

A block of lines with numbers alone is parsed as a whole. Any other block is parsed field by
field, which accepts text and quotes, and finds the line and column to name in a message.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
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
"""Bytes that are read at a time (chosen: bounds the memory, and large enough for numpy)."""

_LONGEST_LINE_BYTES = 1 << 20
"""Longer lines are refused, bytes (chosen: no recording has them; a file without newlines must
not fill the memory)."""

_TIME_LIMIT_S = 9e9
"""Largest magnitude of a time, s: in nanoseconds it fits into 64 bits (9.2e18)."""

_INFO = re.compile(r'#+\s*([A-Za-z_][\w.]*)\s*:(?:\s+(.*))?$')
"""A comment line with key and value."""

_NUMBER = re.compile(r'\s*([-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?|[-+]?(nan|inf|infinity))?\s*',
                     re.ASCII | re.IGNORECASE)
"""A field that is a number, or empty."""


@dataclass
class _Lines:
    """
    Lines of samples.

    Attributes
    ----------
    data
        The lines, each with a newline.
    numbers
        Their numbers in the file, from 1.
    done
        Fraction of the file that has been read at their end.
    is_open_ended
        Whether the last one has no newline in the file.

    """

    data: bytes
    numbers: Sequence[int]
    done: float
    is_open_ended: bool

    def where(self, path: str, row: int, column: int) -> str:
        """Return file, line and column of a field, for messages."""
        return f'{path}:{self.numbers[row]}:{column + 1}'

    def fields(self, path: str, row: int) -> list[str]:
        """Return the fields of one line."""
        return _split(path, self.data.split(b'\n', row + 1)[row], self.numbers[row])

    def rows(self, path: str) -> list[list[str]]:
        """Return the fields of all lines."""
        return [_split(path, line, number)
                for line, number in zip(self.data.split(b'\n'), self.numbers)]


def _split(path: str, line: bytes, number: int) -> list[str]:
    """Return the fields of the line with a number."""
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
    """
    What earlier blocks leave behind.

    Attributes
    ----------
    path
        The file, for messages.
    header
        Its columns.
    used
        Columns that hold numbers so far.
    epoch_ns
        Origin of the times, ns.
    last_time_s
        Time of the newest sample, s.
    last_line
        Number of its line.

    """

    path: str
    header: Header
    used: list[str]
    epoch_ns: int
    last_time_s: float = -np.inf
    last_line: int = 0


def blocks(path: str | os.PathLike, rows: int,
           needed: tuple[str, ...] | None = None) -> Generator[Recording, None, None]:
    """
    Read a CSV recording in blocks of at most `rows` samples.

    Parameters
    ----------
    path
        The file.
    rows
        Largest number of samples of a block.
    needed
        Columns besides `time_s` that must have a number in every row; None is the sensor's output
        in any form.

    Yields
    ------
    Recording
        The blocks in the order of time.

    Raises
    ------
    UserError
        The file cannot be read, or a field is wrong. The message names file, line and column.

    """
    path = str(path)
    try:
        with open(path, 'rb') as file:
            yield from _blocks(path, file, rows, needed)
    except OSError as error:
        raise UserError(f'{path}: cannot read: {error.strerror or error}') from None


def _blocks(path: str, file: BinaryIO, rows: int,
            needed: tuple[str, ...] | None) -> Iterator[Recording]:
    """Yield the blocks of an open file; the arguments are those of `blocks`."""
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
    """Parse the header, and remove it from the first lines."""
    header = parse_header(f'{path}:{lines.numbers[0]}', lines.fields(path, 0), needed)
    lines.data = lines.data.split(b'\n', 1)[1]
    lines.numbers = lines.numbers[1:]
    return _State(path, header, [name for name in header.names if name], _epoch_ns(path, info))


def _epoch_ns(path: str, info: dict[str, str]) -> int:
    """Return the origin of the times, ns, that the comments state; else 0."""
    text = info.get('epoch_ns', '0')
    if not re.fullmatch(r'-?\d{1,19}', text) or abs(int(text)) >= 1 << 63:
        raise UserError(f'{path}: epoch_ns is {text!r}, expected whole nanoseconds')
    return int(text)


def _chunks(path: str, file: BinaryIO, info: dict[str, str]) -> Iterator[_Lines]:
    """Yield the lines of samples; comments are added to `info`, empty lines are dropped."""
    size = os.fstat(file.fileno()).st_size
    number = 1
    for data in _whole_lines(path, file):
        if number == 1:
            data = _without_byte_order_mark(path, data)
        is_open_ended = not data.endswith(b'\n')
        data = data.replace(b'\r\n', b'\n') + b'\n' * is_open_ended
        count = data.count(b'\n')
        lines = _Lines(data, range(number, number + count), file.tell() / max(size, 1),
                       is_open_ended)
        number += count
        if _has_other_lines(data):
            _drop_other_lines(path, lines, info)
        if lines.data:
            yield lines


def _whole_lines(path: str, file: BinaryIO) -> Iterator[bytes]:
    """Yield the bytes of a file in parts that end with a line."""
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


def _without_byte_order_mark(path: str, data: bytes) -> bytes:
    if data[:2] in (b'\xff\xfe', b'\xfe\xff'):
        raise UserError(f'{path}:1:1: is UTF-16; save the file as UTF-8')
    return data.removeprefix(b'\xef\xbb\xbf')


def _has_other_lines(data: bytes) -> bool:
    """Return whether there may be comments or empty lines."""
    return data.startswith(b'\n') or any(
        mark in data for mark in (b'#', b'\n\n', b' \n', b'\t\n'))


def _drop_other_lines(path: str, lines: _Lines, info: dict[str, str]) -> None:
    """Remove comments and empty lines; keys and values of comments go to `info`."""
    kept, numbers = [], []
    for line, number in zip(lines.data.split(b'\n'), lines.numbers):
        text = line.strip()
        if text.startswith(b'#'):
            if entry := _INFO.match(_decode(path, text, number)):
                info[entry[1]] = (entry[2] or '').strip()
        elif text:
            kept.append(line + b'\n')
            numbers.append(number)
    lines.data, lines.numbers = b''.join(kept), numbers


def _columns(state: _State, lines: _Lines) -> dict[str, np.ndarray]:
    """Parse and check the samples of some lines; return the columns that are numbers."""
    table = _all_at_once(state, lines)
    if table is None:
        table = _field_by_field(state, lines)
    columns = {name: np.ascontiguousarray(table[:, i]) for i, name in enumerate(state.used)}
    _check_values(state, lines, columns)
    _check_time(state, lines, columns[TIME])
    return columns


def _all_at_once(state: _State, lines: _Lines) -> np.ndarray | None:
    """Parse all lines as one text; None where a line must be parsed field by field."""
    names = state.header.names
    data = _unpadded(lines.data)
    bounds = _bounds(data, len(names))
    if bounds is None:
        return None
    used = [state.header.index(name) for name in state.used]
    data = _blanked(data, bounds, sorted(set(range(len(names))) - set(used)))
    # numpy reads a field of white space as -1.
    if any(space in data for space in b' \t\v\f\r'):
        return None
    text = data.replace(b'\n', b',')
    if text.startswith(b','):
        text = b'nan' + text
    # Of three commas in a row, one pass sees only the first pair.
    while b',,' in text:
        text = text.replace(b',,', b',nan,')
    with warnings.catch_warnings():
        # Older numpy warns of text and stops there; an error leads to the other parser.
        warnings.simplefilter('error')
        try:
            values = np.fromstring(text, sep=',')
        except (ValueError, DeprecationWarning):
            return None
    size = len(names) * len(lines.numbers)
    return values.reshape(-1, len(names))[:, used] if len(values) == size else None


def _unpadded(data: bytes) -> bytes:
    """Remove the spaces next to commas and newlines."""
    if b'\t' in data:
        data = data.replace(b'\t', b' ')
    if b' ' in data:
        for padded in (b', ', b' ,', b'\n ', b' \n'):
            while padded in data:
                data = data.replace(padded, padded.strip(b' '))
    return data


def _bounds(data: bytes, count: int) -> np.ndarray | None:
    """
    Return the bounds of the fields, (lines, count + 1); None if a line has not `count` fields.

    Field k is between bounds k and k + 1, the positions of the commas and newlines next to it.
    """
    characters = np.frombuffer(data, np.uint8)
    newlines = np.flatnonzero(characters == ord('\n'))
    commas = np.flatnonzero(characters == ord(','))
    if len(commas) != (count - 1) * len(newlines):
        return None
    starts = np.concatenate([[-1], newlines[:-1]])
    bounds = np.column_stack([starts, commas.reshape(len(newlines), count - 1), newlines])
    return bounds if (np.diff(bounds, axis=1) > 0).all() else None


def _blanked(data: bytes, bounds: np.ndarray, unused: list[int]) -> bytes:
    """Remove the text of unused fields."""
    if not unused:
        return data
    change = np.zeros(len(data) + 1, np.int8)
    for k in unused:
        change[bounds[:, k] + 1] += 1
        change[bounds[:, k + 1]] -= 1
    is_kept = np.cumsum(change[:-1], dtype=np.int8) == 0
    return np.frombuffer(data, np.uint8)[is_kept].tobytes()


def _field_by_field(state: _State, lines: _Lines) -> np.ndarray:
    """Parse with Python; refuse a field that is no number, and drop other columns with text."""
    header = state.header
    rows = lines.rows(state.path)
    for i, fields in enumerate(rows):
        if len(fields) != len(header.names):
            _refuse_field_count(state, lines, i, len(fields))
    columns = []
    for name in list(state.used):
        index = header.index(name)
        fields = [row[index] for row in rows]
        wrong = next((i for i, field in enumerate(fields) if not _NUMBER.fullmatch(field)), None)
        if wrong is None:
            columns.append([float(field) if field.strip() else np.nan for field in fields])
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
    """Return what to do about the last line of a file that is cut off, else ''."""
    if lines.is_open_ended and row == len(lines.numbers) - 1:
        return '; the file ends in the middle of this line: delete it'
    return ''


def _check_values(state: _State, lines: _Lines, columns: dict[str, np.ndarray]) -> None:
    """Refuse the first row with a number that no sensor, reference or clock gives."""
    refused: list[tuple[int, str]] = []
    for name in (*state.header.needed, *state.header.references):
        magnitude = np.abs(columns[name])
        wrong = magnitude > _limit(name) if name in state.header.references else \
            ~(magnitude <= _limit(name))
        if wrong.any():
            refused.append((int(wrong.argmax()), name))
    if refused:
        row, name = min(refused)
        _refuse_value(state, lines, row, name, columns[name][row])


def _limit(name: str) -> float:
    """Return the largest magnitude of a column, in its unit."""
    return _TIME_LIMIT_S if name == TIME else LIMIT


def _refuse_value(state: _State, lines: _Lines, row: int, name: str, value: float) -> None:
    """Raise the error of a number that is empty, not finite or too large."""
    index = state.header.index(name)
    text = lines.fields(state.path, row)[index].strip()
    where = lines.where(state.path, row, index)
    if not text:
        raise UserError(f'{where}: {name} is empty; every sample needs it')
    if not np.isfinite(value):
        raise UserError(f'{where}: {name} is {text}, not a finite number; delete the line')
    raise UserError(f'{where}: {name} is {text}, beyond ±{_limit(name):g}; delete the line or '
                    'correct its unit')


def _check_time(state: _State, lines: _Lines, time_s: np.ndarray) -> None:
    """Refuse times, s, (n,), that do not increase; remember the last one."""
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
