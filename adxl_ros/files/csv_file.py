# SPDX-License-Identifier: Apache-2.0

"""CSV recordings in the columns and units of the package, read in blocks."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass
import os
import re
from typing import BinaryIO

from adxl_ros.errors import UserError
from adxl_ros.files.csv_header import Header, HeaderError, parse_header
from adxl_ros.files.csv_lines import chunks, Lines
from adxl_ros.files.csv_numbers import Layout, parse_numbers
from adxl_ros.files.recording_columns import LIMIT, Recording, TIME
import numpy as np

TIME_LIMIT_S = 9e9
"""Largest magnitude of a time, s: in nanoseconds it fits into 64 bits (9.2e18)."""


@dataclass
class _State:
    """What earlier blocks leave behind."""

    path: str  # The file, for messages
    header: Header  # Its columns
    layout: Layout  # Which of them hold numbers so far
    epoch_ns: int  # Origin of the times, ns
    last_time_s: float = -np.inf  # Time of the newest sample, s
    last_line: int = 0  # Number of its line


def blocks(path: str | os.PathLike, rows: int,
           needed: tuple[str, ...] | None = None) -> Generator[Recording, None, None]:
    """Read a CSV recording in blocks of at most `rows` samples."""
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
    for lines in chunks(path, file, info):
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


def _begin(path: str, lines: Lines, info: dict[str, str],
           needed: tuple[str, ...] | None) -> _State:
    """Parse the header, and remove it from the first lines."""
    try:
        fields = lines.fields(path, 0)
    except UserError as error:
        raise HeaderError(str(error)) from None
    header = parse_header(f'{path}:{lines.numbers[0]}', fields, needed)
    lines.data = lines.data.split(b'\n', 1)[1]
    lines.numbers = lines.numbers[1:]
    layout = Layout(path, header.names, [name for name in header.names if name],
                    frozenset(name for name in header.names if not header.is_other(name)))
    return _State(path, header, layout, epoch_ns(path, info))


def epoch_ns(path: str, info: dict[str, str]) -> int:
    """Return the origin of the times that comments state, ns; else 0."""
    text = info.get('epoch_ns', '0')
    if not re.fullmatch(r'-?\d{1,19}', text) or abs(int(text)) >= 1 << 63:
        raise UserError(f'{path}: epoch_ns is {text!r}, expected whole nanoseconds')
    return int(text)


def _columns(state: _State, lines: Lines) -> dict[str, np.ndarray]:
    """Parse and check the samples of some lines; return the columns that are numbers."""
    columns = parse_numbers(state.layout, lines)
    _check_values(state, lines, columns)
    _check_time(state, lines, columns[TIME])
    return columns


def _check_values(state: _State, lines: Lines, columns: dict[str, np.ndarray]) -> None:
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
    return TIME_LIMIT_S if name == TIME else LIMIT


def _refuse_value(state: _State, lines: Lines, row: int, name: str, value: float) -> None:
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


def _check_time(state: _State, lines: Lines, time_s: np.ndarray) -> None:
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
