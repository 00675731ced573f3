# SPDX-License-Identifier: Apache-2.0

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

_FEWEST_NUMBERS = 2
"""Fewest numbers of a line of samples with text (chosen: `rate, 100` is in a preamble)."""

_DELIMITERS = {'\t': 'tabs', ';': 'semicolons', ',': 'commas', ' ': 'blanks'}
"""Names of delimiters; the first that fits is taken."""

_NUMBER = re.compile(r'[-+]?(\d+[.,]?\d*|[.,]\d+)([eE][-+]?\d+)?|[-+]?(nan|inf)', re.IGNORECASE)
"""A number with a decimal point or comma."""

_DATE = re.compile(rb'"?(\d{4})[-/](\d\d)[-/](\d\d)[T ](\d\d:\d\d:\d\d(?:[.,]\d{1,9})?)'
                   rb'(?:Z|([-+]\d\d):?(\d\d))?"?')
"""A date and time by ISO 8601; without an offset it counts as UTC."""

_LABEL = re.compile(rb'"?[A-Za-z_][\w ]*"?\s*[:=]\s*(?=[-+.]?\d)')
"""A label before a number, as in `x: 0.1` and `"x": 0.1`."""

_COMMENT = re.compile(r'\s*(#|//|%)')
"""Begin of a comment."""


@dataclass(frozen=True)
class Form:
    """How a text table is written."""

    delimiter: str  # A tab, semicolon, comma or blank; several blanks are one
    decimal_comma: bool  # Whether numbers have a decimal comma
    # The columns as the header states them; numbers from 1 where there is none
    names: tuple[str, ...]
    has_header: bool  # Whether there is a header
    first_line: int  # Number of the first line with samples, from 1
    is_worded: bool = False  # Whether lines have dates, labels or quotes, which `_plain` removes

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
    """Find the form of a text table."""
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

    The samples are the lines with as many fields as hold most of the numbers. Of two such forms
    the one with fewer fields counts, as with labels and quotes left out and dates as numbers. The
    header is the line with text and as many fields that is nearest before them.
    """
    plain = [_plain(line.encode()).decode() for line in lines]
    best, form = (0, 0), None
    for rows in (lines, plain) if plain != list(lines) else (lines,):
        for delimiter in _DELIMITERS:
            numbers: dict[int, int] = {}
            first: dict[int, int] = {}
            for index, line in enumerate(rows):
                count = 0 if _COMMENT.match(line) else _numbers(line, delimiter)
                fields = _fields(line, delimiter)
                # One number with empty cells is a row, one with a text may be a preamble.
                if count >= _FEWEST_NUMBERS or (count and count == sum(map(bool, fields))):
                    size = len(fields)
                    numbers[size] = numbers.get(size, 0) + count
                    first.setdefault(size, index)
            size = max(numbers, key=lambda size: numbers[size], default=0)
            if size and (numbers[size], -size) > best:
                best = numbers[size], -size
                form = _form(lines, rows, first[size], delimiter)
    return form


def _form(lines: Sequence[str], rows: Sequence[str], index: int, delimiter: str) -> Form:
    """Return the form of a table whose samples begin at a line, by its lines and plain lines."""
    fields = _fields(rows[index], delimiter)
    header = _header([_unquoted(line) for line in lines[:index]], delimiter, len(fields))
    labels = [label.decode().strip('":= ') for label in _LABEL.findall(_DATE.sub(
        b'0', lines[index].encode()))] if rows is not lines else []
    if header is None and len(labels) == len(fields):
        header = labels
    names = _distinct(header or [''] * len(fields))
    sample = [line for line in rows[index:] if not _COMMENT.match(line)]
    decimal_comma = delimiter != ',' and any(
        re.fullmatch(r'[-+]?\d*,\d+([eE][-+]?\d+)?', field)
        for line in sample for field in _fields(line, delimiter))
    return Form(delimiter, decimal_comma, names, header is not None, index + 1,
                rows is not lines)


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


def _unquoted(line: str) -> str:
    """Return a line without quotes around the whole of it."""
    return re.sub(r'^"([^"]*)"\s*$', r'\1', line)


def _plain(data: bytes) -> bytes:
    """Return lines without labels and quotes, and with seconds since 1970 in place of dates."""
    data = _DATE.sub(_since_1970, data)
    data = _LABEL.sub(b'', data)
    data = re.sub(rb'(?m)^\s*"([^"\n]*)"[ \t\r]*$', rb'\1', data)
    return re.sub(rb'(?m)^[ \t]*\{|\}[,\s]*?$', b'', data)


def _since_1970(date: re.Match[bytes]) -> bytes:
    """Return the seconds since 1970 of a date and time, in nanoseconds."""
    year, month, day, time, hours, minutes = (part.decode() if part else '0'
                                              for part in date.groups())
    try:
        stamp = np.datetime64(f'{year}-{month}-{day}T{time.replace(",", ".")}', 'ns')
    except ValueError:
        return date[0]
    offset_s = 3600 * int(hours) + (-60 if hours.startswith('-') else 60) * int(minutes)
    seconds, nanoseconds = divmod(int(stamp.astype(np.int64)), 1_000_000_000)
    return b'%d.%09d' % (seconds - offset_s, nanoseconds)


def _rewritten(data: bytes, form: Form) -> bytes:
    """Return lines with commas between fields, and decimal points."""
    if form.is_worded:
        data = _plain(data)
    if form.delimiter == ',':
        return data
    # A comma in a text would look like a delimiter.
    data = data.replace(b',', b'.')
    if form.delimiter == ' ':
        data = re.sub(rb'(?m)^[ \t]+|[ \t]+$', b'', data)
        return re.sub(rb'[ \t]+', b',', data)
    return data.replace(form.delimiter.encode(), b',')
