# SPDX-License-Identifier: Apache-2.0

"""The lines of a text file of samples, read in blocks, with their numbers for messages."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
import csv
from dataclasses import dataclass
import os
import re
from typing import BinaryIO

from adxl_ros.errors import UserError
import numpy as np

_CHUNK_BYTES = 1 << 21
"""Bytes that are read at a time (chosen: bounds the memory, and large enough for numpy)."""

_LONGEST_LINE_BYTES = 1 << 20
"""Longer lines are refused, bytes (chosen: no recording has them; a file without newlines must
not fill the memory)."""

_INFO = re.compile(r'#+\s*([A-Za-z_][\w.]*)\s*:(?:\s+(.*))?$')
"""A comment line with key and value."""


@dataclass
class Lines:
    """Lines of samples."""

    data: bytes  # The lines, each with a newline
    numbers: Sequence[int]  # Their numbers in the file, from 1
    done: float  # Fraction of the file that has been read at their end
    is_open_ended: bool  # Whether the last one has no newline in the file

    def where(self, path: str, row: int, column: int) -> str:
        """Return the place of a field for messages."""
        return f'{path}:{self.numbers[row]}:{column + 1}'

    def fields(self, path: str, row: int) -> list[str]:
        """Split one line."""
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


def chunks(path: str, file: BinaryIO, info: dict[str, str], skip: int = 0,
           recode: Callable[[bytes], bytes] | None = None) -> Iterator[Lines]:
    """Yield the lines of samples; comments are added to `info`, empty lines are dropped."""
    size = os.fstat(file.fileno()).st_size
    number = 1
    for data in whole_lines(path, file):
        if number == 1:
            data = without_byte_order_mark(path, data)
        if recode is not None:
            data = recode(data)
        is_open_ended = not data.endswith(b'\n')
        if b'\r' in data:
            data = data.replace(b'\r\n', b'\n')
        data += b'\n' * is_open_ended
        is_newline = np.frombuffer(data, np.uint8) == ord('\n')
        count = int(np.count_nonzero(is_newline))
        lines = Lines(data, range(number, number + count), file.tell() / max(size, 1),
                      is_open_ended)
        number += count
        if _has_other_lines(data, is_newline):
            _drop_other_lines(path, lines, info)
        if lines.data and lines.numbers[0] <= skip:
            _drop_first_lines(lines, skip)
        if lines.data:
            yield lines


def whole_lines(path: str, file: BinaryIO) -> Iterator[bytes]:
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


def without_byte_order_mark(path: str, data: bytes) -> bytes:
    """Return the first bytes of a file without the mark of UTF-8."""
    if data[:2] in (b'\xff\xfe', b'\xfe\xff'):
        raise UserError(f'{path}:1:1: is UTF-16; save the file as UTF-8')
    return data.removeprefix(b'\xef\xbb\xbf')


def _has_other_lines(data: bytes, is_newline: np.ndarray) -> bool:
    """Return whether there may be comments or empty lines, by a mask (n,) of the n bytes."""
    # A search for one byte takes a tenth of the time of a search for two.
    return (b'#' in data or bool(is_newline[0] or (is_newline[1:] & is_newline[:-1]).any())
            or (b' ' in data and b' \n' in data) or (b'\t' in data and b'\t\n' in data))


def _drop_first_lines(lines: Lines, skip: int) -> None:
    """Remove the lines up to a number."""
    count = bisect_right(lines.numbers, skip)
    lines.data = lines.data.split(b'\n', count)[count]
    lines.numbers = lines.numbers[count:]


def _drop_other_lines(path: str, lines: Lines, info: dict[str, str]) -> None:
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
