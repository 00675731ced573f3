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
MCAP files without an index, read from front to back.

A recorder that is killed, or a full disk, leaves a file without the end by which MCAP files are
read, and the fastest storage preset of ros2 bag writes no index of the messages. The records
themselves (https://mcap.dev/spec) stand one behind the other, each with its length, so they can
be read in turn until one is not whole.
"""

from __future__ import annotations

from collections.abc import Collection, Generator, Iterator
from contextlib import contextmanager
import os
from pathlib import Path
import struct
from typing import BinaryIO
import zlib

from adxl_ros.errors import UserError

_MAGIC = b'\x89MCAP0\r\n'
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 3, 4, 5, 6
_LAST_KNOWN, _FIRST_PRIVATE = 0x0F, 0x80
_RECORD_HEAD = struct.Struct('<BQ')
_CHUNK_HEAD = struct.Struct('<QQQII')  # first and last time, size, CRC-32, length of a string
_MESSAGE_HEAD_BYTES = 22  # channel, sequence, two times
_LEAST_BYTES = {_SCHEMA: 6, _CHANNEL: 8, _MESSAGE: _MESSAGE_HEAD_BYTES}

Record = tuple[int, bytes, int, int]
"""Operation code, the bytes that hold the record, and where its content begins and ends."""


def is_whole(path: Path) -> bool:
    """Tell whether an MCAP file was closed: whether the magic bytes stand at its end too."""
    try:
        with open(path, 'rb') as file:
            return _has_end(file)
    except OSError as error:
        raise UserError(f'{path}: cannot read: {error.strerror or error}') from None


def _has_end(file: BinaryIO) -> bool:
    size = os.fstat(file.fileno()).st_size
    file.seek(max(size - len(_MAGIC), 0))
    return size > len(_MAGIC) and file.read() == _MAGIC


def unpack(compression: str, data: bytes) -> bytes:
    """
    Decompress as much as is there.

    Raises
    ------
    ValueError
        The data is damaged, or compressed in a way that MCAP does not know.

    """
    from backports import zstd
    from lz4.frame import LZ4FrameDecompressor
    openers = {'': bytes,
               'zstd': lambda packed: zstd.ZstdDecompressor().decompress(packed),
               'lz4': lambda packed: LZ4FrameDecompressor().decompress(packed)}
    if compression not in openers:
        raise ValueError(f'compressed by {compression}, which is not known')
    try:
        return openers[compression](data)
    except (RuntimeError, zstd.ZstdError) as error:
        raise ValueError(f'damaged {compression} data: {error}') from None


@contextmanager
def open_scan(path: Path) -> Iterator[ScannedMcap]:
    """
    Open an MCAP file that may have no end.

    Raises
    ------
    UserError
        It is empty or no MCAP file.

    """
    with open(path, 'rb') as file:
        magic = file.read(len(_MAGIC))
        if not magic:
            raise UserError(f'{path}: is empty')
        if magic != _MAGIC:
            raise UserError(f'{path}: is no MCAP file: it does not begin as one')
        yield ScannedMcap(file)


class ScannedMcap:
    """
    An MCAP file: what can be read of it from the front.

    Attributes
    ----------
    types
        Topics that hold messages, each with its type.
    cut
        Where the file is cut off or damaged; empty if it is whole.
    done
        Fraction of the file that has been read.

    """

    def __init__(self, file: BinaryIO) -> None:
        """Look through the whole file for its channels and the cut."""
        self.done = 0.0
        self.types: set[tuple[str, str]] = set()
        self._file = file
        self._size = os.fstat(file.fileno()).st_size
        self._at = 0
        self._channels: dict[int, tuple[str, str]] = {}
        schemas: dict[int, str] = {}
        for code, data, start, _ in self._records():
            if code == _MESSAGE and (channel := self._channels.get(_u16(data, start))):
                self.types.add(channel)
            elif code == _SCHEMA:
                schemas[_u16(data, start)] = _text(data, start + 2)
            elif code == _CHANNEL:
                kind = schemas.get(_u16(data, start + 2), '')
                self._channels[_u16(data, start)] = (_text(data, start + 4), kind)
        self.cut = ''
        if self._at != self._size - len(_MAGIC) or not _has_end(file):
            self.cut = (f'cut off or damaged in the record that begins at byte {self._at} '
                        f'of {self._size}')

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, bytes]]:
        """Yield topic and CDR of each whole message of some topics, in the order of the file."""
        wanted = {key: topic for key, (topic, _) in self._channels.items() if topic in topics}
        for code, data, start, end in self._records():
            if code == _MESSAGE and (topic := wanted.get(_u16(data, start))) is not None:
                yield topic, data[start + _MESSAGE_HEAD_BYTES:end]

    def _records(self) -> Iterator[Record]:
        """Yield the whole records, those inside a chunk in place of the chunk."""
        self._at = len(_MAGIC)
        self._file.seek(self._at)
        while len(head := self._file.read(_RECORD_HEAD.size)) == _RECORD_HEAD.size:
            code, size = _RECORD_HEAD.unpack(head)
            if not _is_record(code, size):
                return
            begin = self._at + len(head)
            content = self._file.read(min(size, self._size - begin))
            is_whole = len(content) == size
            if code == _CHUNK:
                is_whole = yield from _chunk(content, is_whole)
            elif is_whole:
                yield code, content, 0, size
            if not is_whole:
                return
            self._at = begin + size
            self.done = self._at / self._size


def _chunk(content: bytes, is_whole: bool) -> Generator[Record, None, bool]:
    """Yield the records of a chunk, whose end may be missing; return whether it was whole."""
    if len(content) < _CHUNK_HEAD.size:
        return False
    _, _, _, crc, length = _CHUNK_HEAD.unpack_from(content)
    begin = _CHUNK_HEAD.size + length + 8
    try:
        data = unpack(_text(content, _CHUNK_HEAD.size - 4), content[begin:])
    except ValueError:
        return False  # what is cut here is the chunk
    if is_whole and crc and zlib.crc32(data) != crc:
        return False
    at = 0
    while at + _RECORD_HEAD.size <= len(data):
        code, size = _RECORD_HEAD.unpack_from(data, at)
        start = at + _RECORD_HEAD.size
        at = start + size
        if at > len(data) or not _is_record(code, size):
            return False
        yield code, data, start, at
    return is_whole


def _is_record(code: int, size: int) -> bool:
    is_known = 0 < code <= _LAST_KNOWN or code >= _FIRST_PRIVATE
    return is_known and size >= _LEAST_BYTES.get(code, 0)


def _u16(data: bytes, at: int) -> int:
    return data[at] | data[at + 1] << 8


def _text(data: bytes, at: int) -> str:
    start = at + 4
    end = start + int.from_bytes(data[at:start], 'little')
    return data[start:end].decode(errors='replace')
