# SPDX-License-Identifier: Apache-2.0

"""
The numbers of a block of lines of a CSV file.

A block of lines with numbers alone is parsed as a whole: by pyarrow, if it is installed and the
block is large, else by numpy. Any other block is parsed field by field, which accepts text and
quotes, and finds the line and column to name in a message.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
import re
from typing import Any
import warnings

from adxl_ros.errors import UserError
from adxl_ros.files.csv_lines import Lines
import numpy as np

_NUMBER = re.compile(r'\s*([-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?|[-+]?(nan|inf|infinity))?\s*',
                     re.ASCII | re.IGNORECASE)
"""A field that is a number, or empty."""

_ARROW_BYTES = 1 << 19
"""Bytes of a block from which pyarrow parses it (chosen: the import takes 30 ms, in which numpy
parses 2 MB)."""

_NOT_FOR_ARROW = b'"\r('
"""Characters that pyarrow reads by other rules: quotes, line ends of their own and nan(...)."""

_BYTE_ORDER_MARK = b'\xef\xbb\xbf'
"""The mark of UTF-8, which pyarrow skips at the begin of a block."""

_LONGEST_CELL = 24
"""Characters of a cell in a message. Chosen: a number with all its digits."""


@dataclass
class Layout:
    """The columns of the lines."""

    path: str  # The file, for messages
    # All columns, in order, each once; an empty name is a column that is not read
    names: tuple[str, ...]
    used: list[str]  # Columns that hold numbers so far
    # Columns in which text is an error; any other column with text is left out
    required: frozenset[str]
    source: str = 'the header'  # What states the number of columns, for messages


def parse_numbers(layout: Layout, lines: Lines) -> dict[str, np.ndarray]:
    """
    Parse lines.

    returns: arrays (n,) by column name; an empty field is NaN.
    """
    columns = _by_arrow(layout, lines)
    if columns is not None:
        return columns
    table = _all_at_once(layout, lines)
    if table is None:
        table = _field_by_field(layout, lines)
    return {name: np.ascontiguousarray(table[:, i]) for i, name in enumerate(layout.used)}


def _by_arrow(layout: Layout, lines: Lines) -> dict[str, np.ndarray] | None:
    """
    Parse all lines by pyarrow; None where it is not installed, or refuses the lines.

    Its numbers are those of `float`, to the bit: both round correctly.
    """
    if (len(lines.data) < _ARROW_BYTES or lines.data.startswith(_BYTE_ORDER_MARK)
            or any(character in lines.data for character in _NOT_FOR_ARROW)):
        return None
    arrow = _arrow()
    if arrow is None:
        return None
    names = [str(i) for i in range(len(layout.names))]
    used = [names[layout.names.index(name)] for name in layout.used]
    try:
        table = arrow.csv.read_csv(
            arrow.py_buffer(lines.data),
            arrow.csv.ReadOptions(use_threads=False, column_names=names,
                                  block_size=len(lines.data)),
            arrow.csv.ParseOptions(quote_char=False, ignore_empty_lines=True),
            arrow.csv.ConvertOptions(column_types=dict.fromkeys(used, arrow.float64()),
                                     include_columns=used, null_values=['']))
    except arrow.ArrowInvalid:
        return None
    if len(table) != len(lines.numbers):
        return None
    return {name: _to_numpy(column) for name, column in zip(layout.used, table.columns)}


def _to_numpy(column: Any) -> np.ndarray:
    """Return a column of float64 as an array; what is empty is NaN."""
    return np.concatenate([_filled(part) for part in column.chunks])


def _filled(part: Any) -> np.ndarray:
    """Return an array of pyarrow; its own methods would import pandas, which takes 0.5 s."""
    validity, data = part.buffers()
    values = np.frombuffer(data, np.float64, len(part), part.offset * np.dtype(float).itemsize)
    if not part.null_count:
        return values
    bits = np.unpackbits(np.frombuffer(validity, np.uint8), bitorder='little')
    return np.where(bits[part.offset:part.offset + len(part)], values, np.nan)


@cache
def _arrow() -> Any:
    """Return pyarrow; None where it is not installed."""
    try:
        import pyarrow
        import pyarrow.csv
    except ImportError:
        return None
    return pyarrow


def _all_at_once(layout: Layout, lines: Lines) -> np.ndarray | None:
    """Parse all lines as one text; None where a line must be parsed field by field."""
    names = layout.names
    data = _unpadded(lines.data)
    bounds = _bounds(data, len(names))
    if bounds is None:
        return None
    used = [layout.names.index(name) for name in layout.used]
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


def _field_by_field(layout: Layout, lines: Lines) -> np.ndarray:
    """Parse with Python; refuse a field that is no number, and drop other columns with text."""
    rows = lines.rows(layout.path)
    for i, fields in enumerate(rows):
        if len(fields) != len(layout.names):
            _refuse_field_count(layout, lines, i, len(fields))
    columns = []
    for name in list(layout.used):
        index = layout.names.index(name)
        fields = [row[index] for row in rows]
        wrong = next((i for i, field in enumerate(fields) if not _NUMBER.fullmatch(field)), None)
        if wrong is None:
            columns.append([float(field) if field.strip() else np.nan for field in fields])
        elif name not in layout.required:
            layout.used.remove(name)
        else:
            raise UserError(f'{lines.where(layout.path, wrong, index)}: {name} is '
                            f'{_shortened(fields[wrong])}, not a number'
                            f'{_damage_hint(fields[wrong])}{_cut_hint(lines, wrong)}')
    return np.column_stack(columns) if columns else np.empty((len(rows), 0))


def _shortened(text: str) -> str:
    """Return a cell in quotes for a message, with its end cut where it is long."""
    return repr(text if len(text) <= _LONGEST_CELL else f'{text[:_LONGEST_CELL]}…')


def _damage_hint(text: str) -> str:
    """Return what to do about zero bytes, as a cut of the power leaves them in a file."""
    return '; the file is damaged here: delete the zero bytes' if '\x00' in text else ''


def _refuse_field_count(layout: Layout, lines: Lines, row: int, count: int) -> None:
    expected = len(layout.names)
    raise UserError(f'{lines.where(layout.path, row, min(count, expected))}: {count} fields, but '
                    f'{layout.source} has {expected}{_cut_hint(lines, row)}')


def _cut_hint(lines: Lines, row: int) -> str:
    """Return what to do about the last line of a file that is cut off, else ''."""
    if lines.is_open_ended and row == len(lines.numbers) - 1:
        return '; the file ends in the middle of this line: delete it'
    return ''
