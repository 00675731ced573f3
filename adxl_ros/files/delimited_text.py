# SPDX-License-Identifier: Apache-2.0

"""
Text tables of any delimiter, decimal mark and header, read in blocks of lines.

The first lines show the form of a file, and each block of lines is rewritten to commas and decimal
points. Pandas parses a block. A block that it refuses is read a second time, field by field, which
accepts text and quotes, and finds the line and column to name in a message.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
import csv
from dataclasses import dataclass, field, replace
from io import BytesIO
import os
import re
from typing import BinaryIO

from adxl_ros.errors import UserError
import numpy as np

_CHUNK_BYTES = 1 << 22
"""Bytes that are read at a time (chosen: bounds the memory, and large enough for pandas)."""
_LONGEST_LINE_BYTES = 1 << 20
"""Longer lines are refused, bytes (chosen: no recording has them; a file without newlines must
not fill the memory)."""
_PANDAS_BYTES = 1 << 20
"""Bytes of a block from which pandas parses it (chosen: its import takes 0.4 s, in which Python
parses 2 MB)."""
_HEAD_LINES = 200
"""Lines that show the form of a file (chosen: more than any preamble seen)."""
_FEWEST_NUMBERS = 2
"""Fewest numbers of a line of samples with text (chosen: `rate, 100` is in a preamble)."""
_LONGEST_CELL = 24
"""Characters of a cell in a message. Chosen: a number with all its digits."""

_DELIMITERS = {'\t': 'tabs', ';': 'semicolons', ',': 'commas', ' ': 'blanks'}
"""Names of delimiters; the first that fits is taken."""

_INFO = re.compile(r'#+\s*([A-Za-z_][\w.]*)\s*:(?:\s+(.*))?$')
"""A comment line with key and value."""
_NO_MARKS = bytes(set(range(256)) - set(b',\n#\0'))
"""Bytes besides the ends of fields and lines, comments, and zeros, at which pandas ends a text."""
_FIELD = re.compile(r'\s*([-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?|[-+]?(nan|inf|infinity))?\s*',
                    re.ASCII | re.IGNORECASE)
"""A field that is a number, or empty."""
_NUMBER = re.compile(r'[-+]?(\d+[.,]?\d*|[.,]\d+)([eE][-+]?\d+)?|[-+]?(nan|inf)', re.IGNORECASE)
"""A number with a decimal point or comma."""
_DATE = re.compile(rb'"?(\d{4})[-/](\d\d)[-/](\d\d)[T ](\d\d:\d\d:\d\d(?:[.,]\d{1,9})?)'
                   rb'(?:Z|([-+]\d\d):?(\d\d))?"?')
"""A date and time by ISO 8601; without an offset it counts as UTC."""
_LABEL = re.compile(rb'"?[A-Za-z_][\w ]*"?\s*[:=]\s*(?=[-+.]?\d)')
"""A label before a number, as in `x: 0.1` and `"x": 0.1`."""
_COMMENT = re.compile(r'\s*(#|//|%)')
"""Begin of a comment."""


class NoNumbers(UserError):
    """A table holds no numbers; it may be a list of something."""


@dataclass(frozen=True)
class Lines:
    """Lines of samples."""

    path: str  # The file
    data: bytes  # The lines, each with a newline
    numbers: Sequence[int]  # Their numbers in the file, from 1
    done: float = 1.0  # Fraction of the file that has been read at their end
    is_open_ended: bool = False  # Whether the last one has no newline in the file
    marks: bytes = b''  # The lines without `_NO_MARKS`, where that is known

    def where(self, row: int, column: int) -> str:
        """Return the place of a field for messages."""
        return f'{self.path}:{self.numbers[row]}:{column + 1}'

    def fields(self, row: int) -> list[str]:
        """Split one line."""
        return self._split(self.data.split(b'\n', row + 1)[row], self.numbers[row])

    def rows(self) -> list[list[str]]:
        """Return the fields of all lines."""
        return [self._split(*line) for line in zip(self.data.split(b'\n'), self.numbers)]

    def _split(self, line: bytes, number: int) -> list[str]:
        try:
            return next(csv.reader([_decoded(self.path, line, number)]))
        except csv.Error as error:
            raise UserError(f'{self.path}:{number}: cannot read the line: {error}') from None

    def cut_hint(self, row: int) -> str:
        """Return what to do about the last line of a file that is cut off, else ''."""
        if self.is_open_ended and row == len(self.numbers) - 1:
            return '; the file ends in the middle of this line: delete it'
        return ''


def _decoded(path: str, line: bytes, number: int) -> str:
    try:
        return line.decode()
    except UnicodeDecodeError as error:
        raise UserError(f'{path}:{number}: byte {error.start + 1} of the line, '
                        f'0x{line[error.start]:02x}, is not UTF-8; save the file as UTF-8'
                        ) from None


@contextmanager
def _opened(path: str) -> Iterator[BinaryIO]:
    try:
        with open(path, 'rb') as file:
            yield file
    except OSError as error:
        raise UserError(f'{path}: cannot read: {error.strerror or error}') from None


def _whole_lines(path: str, file: BinaryIO) -> Iterator[bytes]:
    """Yield the bytes of a file in parts that end with a line, without the mark of UTF-8."""
    mark = file.read(3)
    if mark[:2] in (b'\xff\xfe', b'\xfe\xff'):
        raise UserError(f'{path}:1:1: is UTF-16; save the file as UTF-8')
    file.seek(3 if mark == b'\xef\xbb\xbf' else 0)
    while data := file.read(_CHUNK_BYTES):
        if not data.endswith(b'\n'):
            data += file.readline(_LONGEST_LINE_BYTES + 1)
        if len(data) > _CHUNK_BYTES + _LONGEST_LINE_BYTES:
            raise UserError(f'{path}: a line is longer than {_LONGEST_LINE_BYTES} bytes; '
                            'this is no CSV recording')
        yield data


def read_lines(path: str, info: dict[str, str], any_encoding: bool = False) -> Iterator[Lines]:
    """Yield the lines of samples; comments are added to `info`, empty lines are dropped."""
    with _opened(path) as file:
        size = max(os.fstat(file.fileno()).st_size, 1)
        number = 1
        for data in _whole_lines(path, file):
            if any_encoding:
                data = _text(data).encode()
            is_open_ended = not data.endswith(b'\n')
            if b'\r' in data:
                data = data.replace(b'\r\n', b'\n')
            data += b'\n' * is_open_ended
            marks = data.translate(None, _NO_MARKS)
            count = marks.count(b'\n')
            lines = Lines(path, data, range(number, number + count), file.tell() / size,
                          is_open_ended, marks)
            number += count
            # An empty line, or one field, follows the end of a line.
            if b'#' in marks or b'\n\n' in marks or marks.startswith(b'\n'):
                lines = _without_other_lines(lines, info)
            if lines.data:
                yield lines


def _without_other_lines(lines: Lines, info: dict[str, str]) -> Lines:
    """Remove comments and empty lines; keys and values of comments go to `info`."""
    kept, numbers = [], []
    for line, number in zip(lines.data.split(b'\n'), lines.numbers):
        text = line.strip()
        if text.startswith(b'#'):
            if entry := _INFO.match(_decoded(lines.path, text, number)):
                info[entry[1]] = (entry[2] or '').strip()
        elif text:
            kept.append(line + b'\n')
            numbers.append(number)
    return replace(lines, data=b''.join(kept), numbers=numbers, marks=b'')


def after(lines: Lines, number: int) -> Lines:
    """Return the lines after the one with a number."""
    count = bisect_right(lines.numbers, number)
    return replace(lines, data=lines.data.split(b'\n', count)[count],
                   numbers=lines.numbers[count:], marks=b'')


@dataclass
class Layout:
    """The columns of the lines."""

    # All columns, in order, each once; an empty name is a column that is not read
    names: Sequence[str]
    used: list[str]  # Columns that hold numbers so far
    # Columns in which text is an error; any other column with text is left out
    required: Collection[str]
    source: str = 'the header'  # What states the number of columns, for messages


def parse_numbers(layout: Layout, lines: Lines) -> dict[str, np.ndarray]:
    """Parse lines to arrays (n,) by column name; an empty field is NaN."""
    columns = _by_pandas(layout, lines) if len(lines.data) >= _PANDAS_BYTES else None
    return _field_by_field(layout, lines) if columns is None else columns


def _by_pandas(layout: Layout, lines: Lines) -> dict[str, np.ndarray] | None:
    """Parse all lines at once; None where one of them must be parsed field by field."""
    count = len(layout.names)
    # Pandas would fill a short line, and cut a long one.
    marks = lines.marks or lines.data.translate(None, _NO_MARKS)
    if marks != (b',' * (count - 1) + b'\n') * len(lines.numbers):
        return None
    import pandas
    # Newer versions always round correctly, and warn of the option.
    is_old = tuple(map(int, pandas.__version__.split('.')[:2])) < (3, 1)
    options = {'float_precision': 'round_trip'} if is_old else {}
    indices = [layout.names.index(name) for name in layout.used]
    try:
        frame = pandas.read_csv(
            BytesIO(lines.data), header=None, names=list(range(count)), usecols=indices,
            index_col=False, dtype=float, keep_default_na=False, na_values=[''],
            low_memory=False, **options)
    except (ValueError, OverflowError):
        return None
    if len(frame) != len(lines.numbers):
        return None
    return {name: frame[index].to_numpy() for name, index in zip(layout.used, indices)}


def _field_by_field(layout: Layout, lines: Lines) -> dict[str, np.ndarray]:
    """Parse with Python; refuse a field that is no number, and drop other columns with text."""
    rows = lines.rows()
    expected = len(layout.names)
    for i, fields in enumerate(rows):
        if len(fields) != expected:
            raise UserError(f'{lines.where(i, min(len(fields), expected))}: {len(fields)} fields, '
                            f'but {layout.source} has {expected}{lines.cut_hint(i)}')
    columns = {}
    for name in list(layout.used):
        index = layout.names.index(name)
        cells = [row[index] for row in rows]
        wrong = next((i for i, cell in enumerate(cells) if not _FIELD.fullmatch(cell)), None)
        if wrong is None:
            columns[name] = np.array([float(cell) if cell.strip() else np.nan for cell in cells])
        elif name not in layout.required:
            layout.used.remove(name)
        else:
            text = cells[wrong]
            text = text if len(text) <= _LONGEST_CELL else f'{text[:_LONGEST_CELL]}…'
            damage = '; the file is damaged here: delete the zero bytes'
            raise UserError(f'{lines.where(wrong, index)}: {name} is {text!r}, not a number'
                            f'{damage if chr(0) in text else ""}{lines.cut_hint(wrong)}')
    return columns


@dataclass(frozen=True)
class TableBlock:
    """Rows of a table."""

    columns: Mapping[str, np.ndarray]  # Arrays (n,) by column name; an empty cell is NaN
    # Returns file and place of a cell for messages, by its row in the block and its column
    where: Callable[[int, str], str]
    info: Mapping[str, str] = field(default_factory=dict)  # Keys and values that the file states
    done: float = 1.0  # Fraction of the file that has been read at the end of the rows
    cut: str = ''  # Where a damaged file ends; empty if it is whole


@dataclass(frozen=True)
class DelimitedText:
    """A text table; see `tables.Table`."""

    path: str  # The file
    # The columns as the header states them; numbers from 1 where there is none
    names: tuple[str, ...]
    has_names: bool  # Whether there is a header
    delimiter: str  # A tab, semicolon, comma or blank; several blanks are one
    decimal_comma: bool  # Whether numbers have a decimal comma
    first_line: int  # Number of the first line with samples, from 1
    is_worded: bool  # Whether lines have dates, labels or quotes, which `_plain` removes
    units: Mapping[str, str] = field(default_factory=dict)
    default_mapping: str = ''

    @property
    def form(self) -> str:
        """Describe the form for messages; empty for commas with a header."""
        parts = [f'separated by {_DELIMITERS[self.delimiter]}'] * (self.delimiter != ',')
        parts += ['decimal commas'] * self.decimal_comma + ['no header'] * (not self.has_names)
        return ', '.join(parts)

    def blocks(self, names: Collection[str]) -> Iterator[TableBlock]:
        """Yield blocks of rows; see `tables.Table`."""
        layout = self._layout(names, names)
        info: dict[str, str] = {}
        for lines in self._samples(info):
            columns = parse_numbers(layout, lines)

            def where(row: int, column: str, lines: Lines = lines) -> str:
                return f'{lines.where(row, self.names.index(column))}: {column}'

            yield TableBlock(columns, where, dict(info), lines.done)

    def sample(self) -> Mapping[str, np.ndarray]:
        """Return the first rows of the columns with numbers; see `tables.Table`."""
        lines = next(self._samples({}), None)
        if lines is None:
            return {}
        # Lines of another length, as at the end of a file, do not hide the others.
        texts = lines.data.split(b'\n')
        even = [i for i, fields in enumerate(lines.rows()) if len(fields) == len(self.names)]
        lines = replace(lines, data=b''.join(texts[i] + b'\n' for i in even),
                        numbers=[lines.numbers[i] for i in even], marks=b'')
        return parse_numbers(self._layout(self.names, ()), lines) if even else {}

    def _layout(self, used: Collection[str], required: Collection[str]) -> Layout:
        return Layout(self.names, [name for name in self.names if name in used], required,
                      'the header' if self.has_names else 'the first line')

    def _samples(self, info: dict[str, str]) -> Iterator[Lines]:
        """Yield the lines of samples, with commas and decimal points."""
        for lines in read_lines(self.path, info, any_encoding=True):
            if lines.numbers[0] < self.first_line:
                lines = after(lines, self.first_line - 1)
            data = self._rewritten(lines.data)
            if data:
                yield replace(lines, data=data, marks=b'')

    def _rewritten(self, data: bytes) -> bytes:
        """Return lines with commas between fields, and decimal points."""
        if self.is_worded:
            data = _plain(data)
        if self.delimiter == ',':
            return data
        # A comma in a text would look like a delimiter.
        data = data.replace(b',', b'.')
        if self.delimiter == ' ':
            data = re.sub(rb'(?m)^[ \t]+|[ \t]+$', b'', data)
            return re.sub(rb'[ \t]+', b',', data)
        return data.replace(self.delimiter.encode(), b',')


def open_text(path: str) -> DelimitedText:
    """Find the form of a text table."""
    with _opened(path) as file:
        data = next(_whole_lines(path, file), b'')
    if not data:
        raise UserError(f'{path}: is empty')
    table = find_form(path, [_text(line) for line in data.splitlines()[:_HEAD_LINES]])
    if table is None:
        raise NoNumbers(f'{path}: the first {_HEAD_LINES} lines hold no row of numbers; expected '
                        'a header, and a line of numbers for each sample')
    return table


def _text(data: bytes) -> str:
    """Return text that is UTF-8 or, failing that, Windows-1252."""
    try:
        return data.decode()
    except UnicodeDecodeError:
        return data.decode('cp1252', errors='replace')


def find_form(path: str, lines: Sequence[str]) -> DelimitedText | None:
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
            numbers: Counter[int] = Counter()
            first: dict[int, int] = {}
            for index, line in enumerate(rows):
                count = 0 if _COMMENT.match(line) else _numbers(line, delimiter)
                fields = _fields(line, delimiter)
                # One number with empty cells is a row, one with a text may be a preamble.
                if count >= _FEWEST_NUMBERS or (count and count == sum(map(bool, fields))):
                    numbers[len(fields)] += count
                    first.setdefault(len(fields), index)
            size = max(numbers, key=lambda size: numbers[size], default=0)
            if size and (numbers[size], -size) > best:
                best = numbers[size], -size
                form = _form(path, lines, rows, first[size], delimiter)
    return form


def _form(path: str, lines: Sequence[str], rows: Sequence[str], index: int, delimiter: str
          ) -> DelimitedText:
    """Return the form of a table whose samples begin at a line, by its lines and plain lines."""
    fields = _fields(rows[index], delimiter)
    # Quotes around the whole of a line are left out.
    header = _header([re.sub(r'^"([^"]*)"\s*$', r'\1', line) for line in lines[:index]],
                     delimiter, len(fields))
    labels = [label.decode().strip('":= ') for label in _LABEL.findall(_DATE.sub(
        b'0', lines[index].encode()))] if rows is not lines else []
    if header is None and len(labels) == len(fields):
        header = labels
    decimal_comma = delimiter != ',' and any(
        re.fullmatch(r'[-+]?\d*,\d+([eE][-+]?\d+)?', field) for line in rows[index:]
        if not _COMMENT.match(line) for field in _fields(line, delimiter))
    return DelimitedText(path, _distinct(header or [''] * len(fields)), header is not None,
                         delimiter, decimal_comma, index + 1, rows is not lines)


def _header(lines: Sequence[str], delimiter: str, count: int) -> list[str] | None:
    """Return the names of the columns by the text right before the samples; None without one."""
    units: list[str] = []
    for line in reversed(lines):
        if not line.strip():
            continue
        names = _names(line, delimiter, count)
        if names is None:
            break
        # A row of units below the names has each in brackets, or empty.
        if units or not all(not name or re.fullmatch(r'[(\[].*[)\]]', name) for name in names):
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
    return 0 if len(fields) < 2 else sum(bool(_NUMBER.fullmatch(field)) for field in fields)


def _plain(data: bytes) -> bytes:
    """Return lines without labels and quotes, and with seconds since 1970 in place of dates."""
    data = _LABEL.sub(b'', _DATE.sub(_since_1970, data))
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
