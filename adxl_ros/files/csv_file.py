# SPDX-License-Identifier: Apache-2.0

"""
Text tables of any delimiter, decimal mark and header, read in blocks; and CSV files, written.

The first lines show the form of a file; blocks of lines are rewritten with commas and decimal
points. Pandas parses a block. One that it refuses is read again, field by field, which accepts
text and quotes, and finds the line and column to name in a message.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
import csv
from dataclasses import dataclass
from io import BytesIO
import os
import re
from typing import Any, BinaryIO

from adxl_ros.errors import UserError
from adxl_ros.files.atomic_write import AnyPath, atomic_path, release_written
from adxl_ros.files.column_mapping import Columns, Quantity, TableBlock, unit_name
import numpy as np

_CHUNK_BYTES = 1 << 22
"""Bytes that are read at a time (chosen: bounds the memory, and large enough for pandas)."""
_PANDAS_BYTES = 1 << 20
"""Bytes of a block from which pandas parses it (chosen: its import takes 0.4 s, in which Python
parses 2 MB)."""
_HEAD_BYTES = 1 << 20  # Beginning that shows the form of a file, bytes
_HEAD_LINES = 200  # Lines of it that are looked at (chosen: more than any preamble seen)
_FEWEST_NUMBERS = 2
"""Fewest numbers of a line of samples with text (chosen: `rate, 100` is in a preamble)."""
_DELIMITERS = ('\t', ';', ',', ' ')  # Delimiters; the first that fits is taken

_INFO = re.compile(r'#+\s*([A-Za-z_][\w.]*)\s*:(?:\s+(.*))?$')  # A comment line with key and value
_NO_MARKS = bytes(set(range(256)) - set(b',\n#\0'))
"""Bytes besides the ends of fields and lines, comments, and zeros, at which pandas ends a text."""
_FIELD = re.compile(
    r'\s*([-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?|[-+]?(nan|inf|infinity))?\s*',
    re.ASCII | re.IGNORECASE,
)
"""A field that is a number, or empty."""
_NUMBER = re.compile(r'[-+]?(\d+[.,]?\d*|[.,]\d+)([eE][-+]?\d+)?|[-+]?(nan|inf)', re.IGNORECASE)
"""A number with a decimal point or comma."""
_DATE = re.compile(
    rb'"?(\d{4})[-/](\d\d)[-/](\d\d)[T ](\d\d:\d\d:\d\d(?:[.,]\d{1,9})?)'
    rb'(?:Z|([-+]\d\d):?(\d\d))?"?'
)
"""A date and time by ISO 8601; without an offset it counts as UTC."""
_LABEL = re.compile(rb'"?\b[A-Za-z_][\w ]{0,40}"?\s{0,4}[:=]\s*(?=[-+.]?\d)')
"""A label before a number, as in `x: 0.1` and `"x": 0.1`. Its length is bounded, because a search
takes that many steps at each letter of a text without labels."""
_COMMENT = re.compile(r'\s*(#|//|%)')  # Begin of a comment


@dataclass(frozen=True)
class TableForm:
    """How a text table is written."""

    # The columns as the header states them; the number from 1 of one without a name of its own
    names: tuple[str, ...]
    repeated: str  # A name that stands twice; empty for none
    header_line: int  # Number of the line with the names, from 1; 0 where there is none
    first_line: int  # Number of the first line with samples
    delimiter: str  # A tab, semicolon, comma or blank; several blanks are one
    is_worded: bool  # Whether lines have dates, labels or quotes, which `_plain` removes

    def rewritten(self, data: bytes) -> bytes:
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


def read_blocks(
    path: str, form: TableForm, names: Collection[str], required: Collection[str]
) -> Iterator[TableBlock]:
    """
    Yield some columns of numbers in blocks of rows.

    In a required column, text is an error; another column is left out from there on. Where none
    is required, rows of another length are left out, too.
    """
    used = [name for name in form.names if name in names]
    info: dict[str, str] = {}
    last = 0
    with _opened(path) as file:
        size = max(os.fstat(file.fileno()).st_size, 1)
        while data := _in_utf_8(file.read(_CHUNK_BYTES) + file.readline()):
            *preamble, data = data.split(b'\n', max(form.first_line - 1 - last, 0))
            for line in preamble:
                _add_info(line, info)
            first = last + len(preamble) + 1
            last = first - 1 + data.count(b'\n')
            numbers: Sequence[int] = range(first, last + 1)
            # An empty line, or one field, follows the end of a line.
            marks = b'\n' + data.translate(None, _NO_MARKS)
            if b'#' in marks or b'\n\n' in marks:
                rows = [
                    (line, number)
                    for line, number in zip(data.split(b'\n'), numbers)
                    if line.strip() and not _add_info(line, info)
                ]
                data = b''.join(line + b'\n' for line, _ in rows)
                numbers = [number for _, number in rows]
            if not data:
                continue
            data = form.rewritten(data)

            def place(row: int, index: int, numbers: Sequence[int] = numbers) -> str:
                return f'{path}:{numbers[row]}:{index + 1}'

            def where(row: int, name: str, place: Callable[[int, int], str] = place) -> str:
                return f'{place(row, form.names.index(name))}: {name}'

            columns = _by_pandas(data, len(numbers), form.names, used)
            if columns is None:
                columns = _field_by_field(data, form, used, required, place)
            used = list(columns)
            yield TableBlock(columns, where, dict(info), file.tell() / size)


def _add_info(line: bytes, info: dict[str, str]) -> bool:
    """Return whether a line is a comment; its key and value are added to `info`."""
    text = line.strip()
    if text.startswith(b'#') and (entry := _INFO.match(text.decode())):
        info[entry[1]] = (entry[2] or '').strip()
    return text.startswith(b'#')


@contextmanager
def _opened(path: str) -> Iterator[BinaryIO]:
    try:
        with open(path, 'rb') as file:
            yield file
    except OSError as error:
        raise UserError(f'{path}: cannot read: {error.strerror or error}') from None


def _in_utf_8(data: bytes) -> bytes:
    """Return lines in UTF-8 that end with a newline; what is not UTF-8 is Windows-1252."""
    if not data.isascii():
        try:
            data = data.decode('utf-8-sig').encode()
        except UnicodeDecodeError:
            data = data.decode('cp1252', errors='replace').encode()
    data = data.replace(b'\r\n', b'\n') if b'\r' in data else data
    return data + b'\n' if data and not data.endswith(b'\n') else data


def _by_pandas(
    data: bytes, rows: int, names: Sequence[str], used: Sequence[str]
) -> dict[str, np.ndarray] | None:
    """Parse many lines at once; None where one of them must be parsed field by field."""
    # Pandas would fill a short line, and cut a long one.
    if (
        len(data) < _PANDAS_BYTES
        or data.translate(None, _NO_MARKS) != (b',' * (len(names) - 1) + b'\n') * rows
    ):
        return None
    import pandas

    # Newer versions always round correctly, and warn of the option.
    is_old = tuple(map(int, pandas.__version__.split('.')[:2])) < (3, 1)
    options = {'float_precision': 'round_trip'} if is_old else {}
    indices = [names.index(name) for name in used]
    try:
        frame = pandas.read_csv(
            BytesIO(data),
            header=None,
            names=list(range(len(names))),
            usecols=indices,
            index_col=False,
            dtype=float,
            keep_default_na=False,
            na_values=[''],
            low_memory=False,
            **options,
        )
    except (ValueError, OverflowError):
        return None
    if len(frame) != rows:
        return None
    return {name: frame[index].to_numpy() for name, index in zip(used, indices)}


def _field_by_field(
    data: bytes,
    form: TableForm,
    used: Sequence[str],
    required: Collection[str],
    place: Callable[[int, int], str],
) -> dict[str, np.ndarray]:
    """Parse with Python; refuse a field that is no number, and drop other columns with text."""
    rows = [_fields(line, ',') for line in data.decode().split('\n')[:-1]]
    expected = len(form.names)
    if not required:
        rows = [row for row in rows if len(row) == expected]
    for i, row in enumerate(rows):
        if len(row) != expected:
            source = 'the header' if form.header_line else 'the first line'
            raise UserError(
                f'{place(i, min(len(row), expected))}: {len(row)} fields, '
                f'but {source} has {expected}'
            )
    columns = {}
    for name in used:
        index = form.names.index(name)
        cells = [row[index] for row in rows]
        wrong = next((i for i, cell in enumerate(cells) if not _FIELD.fullmatch(cell)), None)
        if wrong is None:
            columns[name] = np.array([float(cell or 'nan') for cell in cells])
        elif name in required:
            raise UserError(
                f'{place(wrong, index)}: {name} is {cells[wrong][:24]!r}, not a number'
            )
    return columns


def find_form(path: str) -> TableForm:
    """
    Return the form of a table by its first lines.

    The samples are the lines with as many fields as hold most of the numbers; of two delimiters
    the one with fewer fields counts. The header is the line with text and as many fields that is
    nearest before them.
    """
    with _opened(path) as file:
        head = file.read(_HEAD_BYTES)
    if head[:2] in (b'\xff\xfe', b'\xfe\xff'):
        raise UserError(f'{path}:1:1: is UTF-16; save the file as UTF-8')
    if len(head) == _HEAD_BYTES:
        head, is_line, _ = head.rpartition(b'\n')  # The last line may be cut
        if not is_line:
            raise UserError(
                f'{path}: a line is longer than {_HEAD_BYTES} bytes; this is no CSV recording'
            )
    lines = _in_utf_8(head).decode().split('\n')[:_HEAD_LINES]
    written = [line for line in lines if line.strip() and not line.lstrip().startswith('#')]
    if not written:
        raise UserError(f'{path}: is empty')
    plain = [_plain(line.encode()).decode() for line in lines]
    best = (0, 0)
    form = None
    for delimiter in _DELIMITERS:
        numbers: Counter[int] = Counter()
        first: dict[int, int] = {}
        for index, line in enumerate(plain):
            count = 0 if _COMMENT.match(line) else _numbers(line, delimiter)
            fields = _fields(line, delimiter)
            # One number with empty cells is a row, one with a text may be a preamble.
            is_single = 0 < count == sum(map(bool, fields))
            if count >= _FEWEST_NUMBERS or is_single:
                numbers[len(fields)] += count
                first.setdefault(len(fields), index)
        size, most = max(numbers.items(), key=lambda item: item[1], default=(0, 0))
        if (most, -size) > best:
            best = (most, -size)
            form = _form(lines, plain, first[size], delimiter)
    has_header = form is not None and form.header_line > 0
    names = _fields(written[0], ',')
    if 'time_s' in names and not has_header:
        number = lines.index(written[0]) + 1  # a recording of the package without good samples
        return _named(names, number, number + 1, ',', False)
    if form is None:
        raise UserError(
            f'{path}: the first {_HEAD_LINES} lines hold no row of numbers; expected '
            'a header, and a line of numbers for each sample'
        )
    return form


def _form(lines: Sequence[str], plain: Sequence[str], index: int, delimiter: str) -> TableForm:
    """Return the form of a table whose samples begin at a line, by its lines and plain lines."""
    count = len(_fields(plain[index], delimiter))
    header_line, header = _header(lines[:index], delimiter, count)
    labels = _LABEL.findall(_DATE.sub(b'0', lines[index].encode()))
    if not header and len(labels) == count:
        header_line = index + 1
        header = [label.decode().strip('":= ') for label in labels]
    is_worded = any(
        line != bare and not _COMMENT.match(line)
        for line, bare in zip(lines[index:], plain[index:])
    )
    return _named(header or [''] * count, header_line, index + 1, delimiter, is_worded)


def _named(names: Sequence[str], *about: Any) -> TableForm:
    """Return a form with distinct names: one that is empty or stands twice gives its number."""
    names = [' '.join(name.split()) for name in names]
    repeated = next((name for name in names if name and names.count(name) > 1), '')
    return TableForm(
        tuple(
            name if name and names.count(name) == 1 else str(i + 1) for i, name in enumerate(names)
        ),
        repeated,
        *about,
    )


def _header(lines: Sequence[str], delimiter: str, count: int) -> tuple[int, list[str]]:
    """Return number and names of the header right before the samples; 0 without one."""
    units: list[str] = []
    number = 0
    for index, line in reversed(list(enumerate(lines))):
        # Quotes around the whole of a line are left out.
        names = _names(re.sub(r'^"([^"]*)"\s*$', r'\1', line), delimiter, count)
        if names is None:
            if line.strip() and not _COMMENT.match(line):
                break
            continue
        number = index + 1
        if units or not all(map(_is_unit, names)):
            return number, [
                f'{name} {unit}'.strip() for name, unit in zip(names, units or [''] * count)
            ]
        # A row of units below the names
        units = [f'[{name}]' if name.strip('()[]') == name != '' else name for name in names]
    return number, units


def _is_unit(name: str) -> bool:
    """Return whether a field may be a unit: one that is known, in brackets, or empty."""
    if not name or re.fullmatch(r'[(\[].*[)\]]', name):
        return True
    return any(unit_name(name, quantity) for quantity in Quantity)


def _names(line: str, delimiter: str, count: int) -> list[str] | None:
    """Return the fields of a line if they can be names, also in a comment; else None."""
    text = _COMMENT.sub('', line, count=1)
    for mark in dict.fromkeys((delimiter, ',', '\t', ';')):
        fields = _fields(text, mark)
        # A row of samples may end in a delimiter, and its header not.
        if len(fields) == count - 1 > 1:
            fields.append('')
        are_names = any(fields) and not _numbers(text, mark)
        if are_names and len(fields) == count:
            return fields
    return None


def _fields(line: str, delimiter: str) -> list[str]:
    """Return the fields of a line without blanks around them."""
    if delimiter == ' ':
        return line.split()
    try:
        return [field.strip() for field in next(csv.reader([line], delimiter=delimiter), [])]
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
    parts = [part.decode() if part else '0' for part in date.groups()]
    year, month, day, time, hours, minutes = parts
    try:
        stamp = np.datetime64(f'{year}-{month}-{day}T{time.replace(",", ".")}', 'ns')
    except ValueError:
        return date[0]
    offset_s = 3600 * int(hours) + (-60 if hours.startswith('-') else 60) * int(minutes)
    since_1970_ns = int(stamp.astype(np.int64)) - offset_s * 1_000_000_000
    seconds, nanoseconds = divmod(abs(since_1970_ns), 1_000_000_000)
    sign = b'-' if since_1970_ns < 0 else b''
    return sign + b'%d.%09d' % (seconds, nanoseconds)


Append = Callable[..., None]
"""Appends rows: arrays (n,) by column name, in the order of the file, the same names every time;
and the keys and values of the comments before the header."""


@contextmanager
def csv_writer(path: AnyPath) -> Iterator[Append]:
    """
    Open a new CSV file, and yield a function that appends rows to it.

    Numbers have all the digits that bring back the same float64. NaN is written empty.
    """
    with atomic_path(path) as fresh, open(fresh, 'wb') as file:

        def append(columns: Columns, info: Mapping[str, str] | None = None) -> None:
            """Append rows, the first ones below the header."""
            if not file.tell():
                file.writelines(
                    f'# {key}: {" ".join(value.split())}\n'.encode()
                    for key, value in (info or {}).items()
                )
                file.write((','.join(columns) + '\n').encode())
            file.write(_csv_rows(columns))
            release_written(file)

        yield append


def _csv_rows(columns: Columns) -> bytes:
    """Return rows of text: by pyarrow where it is installed, which takes a tenth of the time."""
    try:
        import pyarrow.csv
    except ImportError:
        import pandas

        return pandas.DataFrame(dict(columns)).to_csv(header=False, index=False).encode()
    table = pyarrow.table(
        {name: pyarrow.array(values, from_pandas=True) for name, values in columns.items()}
    )
    sink = pyarrow.BufferOutputStream()
    pyarrow.csv.write_csv(table, sink, pyarrow.csv.WriteOptions(include_header=False))
    return sink.getvalue().to_pybytes()
