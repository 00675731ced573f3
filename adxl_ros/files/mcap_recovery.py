# SPDX-License-Identifier: Apache-2.0

"""
MCAP files without an index, read from the front.

Readers of MCAP begin with the index at the end of a file. A killed recorder or a full disk leaves
a file without an end, and the fastest storage preset of ros2 bag writes no index. The records
(https://mcap.dev/spec) follow each other, each with its length, so that they can be read in turn
up to the first one that is not whole.
"""

from __future__ import annotations

from collections.abc import Collection, Generator, Iterator
from contextlib import contextmanager
import os
from pathlib import Path
import struct
from typing import BinaryIO, NamedTuple
import zlib

from adxl_ros.errors import UserError
from adxl_ros.files.message_pieces import collected_pieces, Piece

_MAGIC = b'\x89MCAP0\r\n'
"""First and last bytes of a whole file (specification, "Magic")."""

_SCHEMA = 3
"""Operation code of a schema record (specification, "Records"; so are the next ones)."""

_CHANNEL = 4
"""Operation code of a channel record."""

_MESSAGE = 5
"""Operation code of a message record."""

_CHUNK = 6
"""Operation code of a chunk, which holds further records."""

_LAST_CODE = 0x0F
"""Largest operation code of the specification."""

_FIRST_PRIVATE_CODE = 0x80
"""Smallest operation code of records that the specification leaves to applications."""

_LOG_TIME = struct.Struct('<Q')
"""Log time of a message, ns."""

_LOG_TIME_BYTE = 6
"""Place of the log time in a message record, after channel and sequence number."""

_RECORD_HEAD = struct.Struct('<BQ')
"""Operation code and length of a record."""

_CHUNK_HEAD = struct.Struct('<QQQII')
"""First and last time of a chunk, its size, CRC-32, and the length of its compression's name."""

_LENGTH_BYTES = 8
"""Size of the length of a chunk's records, which follows the compression's name."""

_MESSAGE_HEAD_BYTES = 22
"""Size of the beginning of a message record: channel, sequence, two times."""

_SMALLEST_BYTES = {_SCHEMA: 6, _CHANNEL: 8, _MESSAGE: _MESSAGE_HEAD_BYTES}
"""Smallest size of the content of a record, by operation code."""


class Record(NamedTuple):
    """One whole record."""

    code: int  # Operation code
    data: bytes  # Bytes that hold the record
    # start, stop: Where its content begins and ends in them
    start: int
    stop: int


def is_whole(path: Path) -> bool:
    """Return whether an MCAP file was closed, so that the magic bytes are at its end, too."""
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
    """Decompress data up to its cut, if it has one."""
    from backports import zstd
    from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]
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
    """Open an MCAP file that may have no end."""
    with open(path, 'rb') as file:
        magic = file.read(len(_MAGIC))
        if not magic:
            raise UserError(f'{path}: is empty')
        if magic != _MAGIC:
            raise UserError(f'{path}: is no MCAP file: it does not begin as one')
        yield ScannedMcap(file)


class ScannedMcap:
    """An MCAP file that is read from the front."""

    def __init__(self, file: BinaryIO) -> None:
        """Read the whole file once for its channels and the cut."""
        self.done = 0.0  # Fraction of the file that has been read
        self.types: set[tuple[str, str]] = set()  # Topics that hold messages, each with its type
        self._file = file
        self._size = os.fstat(file.fileno()).st_size
        self._offset = 0
        self._channels: dict[int, tuple[str, str]] = {}
        schemas: dict[int, str] = {}
        for record in self._records():
            data, start = record.data, record.start
            if record.code == _MESSAGE and (channel := self._channels.get(_u16(data, start))):
                self.types.add(channel)
            elif record.code == _SCHEMA:
                schemas[_u16(data, start)] = _text(data, start + 2)
            elif record.code == _CHANNEL:
                kind = schemas.get(_u16(data, start + 2), '')
                self._channels[_u16(data, start)] = (_text(data, start + 4), kind)
        self.cut = ''  # Where the file is cut off or damaged; empty if it is whole
        if self._offset != self._size - len(_MAGIC) or not _has_end(file):
            self.cut = (f'cut off or damaged in the record that begins at byte {self._offset} '
                        f'of {self._size}')

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, bytes, int]]:
        """Yield topic, CDR and log time, ns, of each whole message, in the order of the file."""
        wanted = {key: topic for key, (topic, _) in self._channels.items() if topic in topics}
        for code, data, start, stop in self._records():
            if code == _MESSAGE and (topic := wanted.get(_u16(data, start))) is not None:
                log_ns, = _LOG_TIME.unpack_from(data, start + _LOG_TIME_BYTE)
                yield topic, data[start + _MESSAGE_HEAD_BYTES:stop], log_ns

    def pieces(self, topics: Collection[str]) -> Iterator[Piece]:
        """Yield the messages in pieces, in the order of the file."""
        return collected_pieces(self.messages(topics))

    def _records(self) -> Iterator[Record]:
        """Yield the whole records, and the records of a chunk in its place."""
        self._offset = len(_MAGIC)
        self._file.seek(self._offset)
        while len(head := self._file.read(_RECORD_HEAD.size)) == _RECORD_HEAD.size:
            code, size = _RECORD_HEAD.unpack(head)
            if not _is_record(code, size):
                return
            begin = self._offset + len(head)
            # A file that is still written may have grown since it was opened.
            content = self._file.read(min(size, max(self._size - begin, 0)))
            is_whole = len(content) == size
            if code == _CHUNK:
                is_whole = yield from _chunk(content, is_whole)
            elif is_whole:
                yield Record(code, content, 0, size)
            if not is_whole:
                return
            self._offset = begin + size
            self.done = self._offset / self._size


def _chunk(content: bytes, is_whole: bool) -> Generator[Record, None, bool]:
    """Yield the records of a chunk, whose end may be missing; return whether it is whole."""
    if len(content) < _CHUNK_HEAD.size:
        return False
    _, _, _, crc, length = _CHUNK_HEAD.unpack_from(content)
    begin = _CHUNK_HEAD.size + length + _LENGTH_BYTES
    try:
        data = unpack(_text(content, _CHUNK_HEAD.size - 4), content[begin:])
    except ValueError:
        return False  # a chunk cut within compressed data cannot be decompressed
    if is_whole and crc and zlib.crc32(data) != crc:
        return False
    offset = 0
    while offset + _RECORD_HEAD.size <= len(data):
        code, size = _RECORD_HEAD.unpack_from(data, offset)
        start = offset + _RECORD_HEAD.size
        offset = start + size
        if offset > len(data) or not _is_record(code, size):
            return False
        yield Record(code, data, start, offset)
    return is_whole


def _is_record(code: int, size: int) -> bool:
    """Return whether a record may have this code and size; damaged bytes rarely look like it."""
    is_known = 0 < code <= _LAST_CODE or code >= _FIRST_PRIVATE_CODE
    return is_known and size >= _SMALLEST_BYTES.get(code, 0)


def _u16(data: bytes, offset: int) -> int:
    """Return the 16-bit number at an offset."""
    return data[offset] | data[offset + 1] << 8


def _text(data: bytes, offset: int) -> str:
    """Return the string at an offset: its length in 4 bytes, then its bytes."""
    start = offset + 4
    stop = start + int.from_bytes(data[offset:start], 'little')
    return data[start:stop].decode(errors='replace')
