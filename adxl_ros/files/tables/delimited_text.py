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
Text tables of any delimiter, decimal mark and header.

The first lines show the form of the file. Each block of lines is then rewritten to commas and
decimal points, which the parser of CSV recordings reads.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
import csv
from dataclasses import dataclass, replace
import re
from typing import BinaryIO

from adxl_ros.errors import UserError
from adxl_ros.files import csv_lines
from adxl_ros.files.csv_lines import Lines
from adxl_ros.files.csv_numbers import Layout, parse_numbers
from adxl_ros.files.tables.base import NoNumbers, TableBlock
import numpy as np

NAME = 'delimited_text'
"""Name of the format."""

_HEAD_LINES = 200
"""Lines that show the form of a file (chosen: more than any preamble seen)."""

_DELIMITERS = {'\t': 'tabs', ';': 'semicolons', ',': 'commas', ' ': 'blanks'}
"""Names of delimiters; the first that fits is taken."""

_NUMBER = re.compile(r'[-+]?(\d+[.,]?\d*|[.,]\d+)([eE][-+]?\d+)?|[-+]?(nan|inf)', re.IGNORECASE)
"""A number with a decimal point or comma."""

_COMMENT = re.compile(r'\s*(#|//|%)')
"""Begin of a comment."""


@dataclass(frozen=True)
class Form:
    """
    How a text table is written.

    Attributes
    ----------
    delimiter
        A tab, semicolon, comma or blank; several blanks are one.
    decimal_comma
        Whether numbers have a decimal comma.
    names
        The columns as the header states them; numbers from 1 where there is none.
    has_header
        Whether there is a header.
    first_line
        Number of the first line with samples, from 1.

    """

    delimiter: str
    decimal_comma: bool
    names: tuple[str, ...]
    has_header: bool
    first_line: int

    def describe(self) -> str:
        """Return the form for messages; empty for commas with a header."""
        parts = [f'separated by {_DELIMITERS[self.delimiter]}'] * (self.delimiter != ',')
        parts += ['decimal commas'] * self.decimal_comma + ['no header'] * (not self.has_header)
        return ', '.join(parts)


class DelimitedText:
    """A text table; see `Table`."""

    def __init__(self, path: str, form: Form) -> None:
        self.path = path
        self.names = form.names
        self.has_names = form.has_header
        self.form = form.describe()
        self.units: Mapping[str, str] = {}
        self.default_mapping = ''
        self._form = form

    def blocks(self, names: Collection[str]) -> Iterator[TableBlock]:
        """Yield blocks of rows; see `Table`."""
        layout = self._layout(names, frozenset(names))
        with _opened(self.path) as file:
            info: dict[str, str] = {}
            for lines in _samples(self.path, file, info, self._form):
                columns = parse_numbers(layout, lines)
                yield TableBlock(columns, _Places(self.path, lines, self.names), dict(info),
                                 lines.done)

    def sample(self) -> Mapping[str, np.ndarray]:
        """Return the first rows of the columns with numbers; see `Table`."""
        layout = self._layout(self.names, frozenset())
        with _opened(self.path) as file:
            lines = next(_samples(self.path, file, {}, self._form), None)
            if lines is None:
                return {}
            # Lines of another length, as at the end of a file, do not hide the others.
            texts = lines.data.split(b'\n')
            even = [i for i, fields in enumerate(lines.rows(self.path))
                    if len(fields) == len(self.names)]
            lines = replace(lines, data=b''.join(texts[i] + b'\n' for i in even),
                            numbers=[lines.numbers[i] for i in even])
            return parse_numbers(layout, lines) if even else {}

    def _layout(self, used: Collection[str], required: frozenset[str]) -> Layout:
        source = 'the header' if self.has_names else 'the first line'
        return Layout(self.path, self.names, [name for name in self.names if name in used],
                      required, source)


@dataclass(frozen=True)
class _Places:
    """Names line and column of a cell."""

    path: str
    lines: Lines
    names: Sequence[str]

    def __call__(self, row: int, column: str) -> str:
        return f'{self.lines.where(self.path, row, self.names.index(column))}: {column}'


def open_table(path: str, topic: str = '') -> DelimitedText:
    """
    Find the form of a text table.

    Parameters
    ----------
    path
        The file.
    topic
        Must be empty: a text file holds one table.

    Returns
    -------
    DelimitedText
        The open table.

    Raises
    ------
    UserError
        The file cannot be read, or holds no numbers.

    """
    if topic:
        raise UserError(f'--topic {topic}: {path} is no bag; leave --topic out')
    with _opened(path) as file:
        head = _head(path, file)
    if not head:
        raise UserError(f'{path}: is empty')
    form = find_form(head)
    if form is None:
        raise NoNumbers(f'{path}: the first {_HEAD_LINES} lines hold no row of numbers; expected '
                        'a header, and a line of numbers for each sample')
    return DelimitedText(path, form)


@contextmanager
def _opened(path: str) -> Iterator[BinaryIO]:
    try:
        with open(path, 'rb') as file:
            yield file
    except OSError as error:
        raise UserError(f'{path}: cannot read: {error.strerror or error}') from None


def _head(path: str, file: BinaryIO) -> list[str]:
    """Return the first lines with their comments."""
    data = next(csv_lines.whole_lines(path, file), b'')
    return [_text(line) for line in
            csv_lines.without_byte_order_mark(path, data).splitlines()[:_HEAD_LINES]]


def _text(data: bytes) -> str:
    """Return text that is UTF-8 or, failing that, Windows-1252."""
    try:
        return data.decode()
    except UnicodeDecodeError:
        return data.decode('cp1252', errors='replace')


def _as_utf8(data: bytes) -> bytes:
    return _text(data).encode()


def find_form(lines: Sequence[str]) -> Form | None:
    """
    Return the form of a table by its first lines; None where they hold no row of numbers.

    The samples begin with the first of two lines that have the same number of numbers. The header
    is the line with text and as many fields that is nearest before them.
    """
    for index, line in enumerate(lines):
        if not line.strip() or _COMMENT.match(line):
            continue
        following = next((text for text in lines[index + 1:] if text.strip()), line)
        for delimiter in _DELIMITERS:
            count = _numbers(line, delimiter)
            # A second line may have empty cells, but no more numbers than fields.
            if count and len(_fields(line, delimiter)) == len(_fields(following, delimiter)) and \
                    _numbers(following, delimiter):
                return _form(lines, index, delimiter)
    return None


def _form(lines: Sequence[str], index: int, delimiter: str) -> Form:
    """Return the form of a table whose samples begin at a line."""
    fields = _fields(lines[index], delimiter)
    header = _header(lines[:index], delimiter, len(fields))
    names = _distinct(header or [''] * len(fields))
    sample = [line for line in lines[index:] if not _COMMENT.match(line)]
    decimal_comma = delimiter != ',' and any(
        re.fullmatch(r'[-+]?\d*,\d+([eE][-+]?\d+)?', field)
        for line in sample for field in _fields(line, delimiter))
    return Form(delimiter, decimal_comma, names, header is not None, index + 1)


def _header(lines: Sequence[str], delimiter: str, count: int) -> list[str] | None:
    """Return the names of the columns by the text right before the samples; None without one."""
    units: list[str] = []
    for line in reversed(lines):
        if not line.strip():
            continue
        names = _names(line, delimiter, count)
        if names is None:
            break
        if units or not _are_units(names):
            return [f'{name} {unit}'.strip() for name, unit in zip(names, units or [''] * count)]
        units = names
    return units or None


def _names(line: str, delimiter: str, count: int) -> list[str] | None:
    """Return the fields of a line if they can be names, also in a comment; else None."""
    text = _COMMENT.sub('', line, count=1)
    for mark in dict.fromkeys((delimiter, ',', '\t', ';')):
        fields = _fields(text, mark)
        # A row of samples may end in a delimiter, and its header not.
        fields += [''] * (len(fields) == count - 1 and count > 2)
        if len(fields) == count and any(fields) and not _numbers(text, mark):
            return fields
    return None


def _are_units(fields: Sequence[str]) -> bool:
    """Return whether fields are a row of units below the names: each in brackets, or empty."""
    return all(not field or re.fullmatch(r'[(\[].*[)\]]', field) for field in fields)


def _distinct(names: Sequence[str]) -> tuple[str, ...]:
    """Return names that are distinct: a name that is empty or stands twice gives its number."""
    names = [' '.join(name.split()) for name in names]
    counts = Counter(names)
    return tuple(name if name and counts[name] == 1 else str(i + 1)
                 for i, name in enumerate(names))


def _fields(line: str, delimiter: str) -> list[str]:
    """Return the fields of a line without blanks around them."""
    text = line.strip('\r\n')
    if delimiter == ' ':
        return text.split()
    try:
        return [field.strip() for field in next(csv.reader([text], delimiter=delimiter), [])]
    except csv.Error:
        return []


def _numbers(line: str, delimiter: str) -> int:
    """Return how many numbers a line has; 0 where it has one field only."""
    fields = _fields(line, delimiter)
    if len(fields) < 2:
        return 0
    return sum(bool(_NUMBER.fullmatch(field)) for field in fields)


def _samples(path: str, file: BinaryIO, info: dict[str, str], form: Form) -> Iterator[Lines]:
    """Yield the lines of samples, with commas and decimal points."""
    for lines in csv_lines.chunks(path, file, info, form.first_line - 1, _as_utf8):
        lines.data = _rewritten(lines.data, form)
        if lines.data:
            yield lines


def _rewritten(data: bytes, form: Form) -> bytes:
    """Return lines with commas between fields, and decimal points."""
    if form.delimiter == ',':
        return data
    # A comma in a text would look like a delimiter.
    data = data.replace(b',', b'.')
    if form.delimiter == ' ':
        data = re.sub(rb'(?m)^[ \t]+|[ \t]+$', b'', data)
        return re.sub(rb'[ \t]+', b',', data)
    return data.replace(form.delimiter.encode(), b',')
