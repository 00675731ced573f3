# SPDX-License-Identifier: Apache-2.0

"""
MCAP files: whole ones chunk by chunk, and those without an index from the front.

A chunk is followed by the places of its messages (https://mcap.dev/spec, "Message Index").
Messages of one length are therefore taken from it, and put into it, as the rows of one array.

A killed recorder or a full disk leaves a file without an end, where the index is, and the fastest
storage preset of ros2 bag writes no index. The records follow each other, each with its length, so
that they can be read in turn up to the first one that is not whole.
"""

from __future__ import annotations

from collections.abc import Collection, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice, pairwise
import os
from pathlib import Path
import struct
from typing import Any, BinaryIO, NamedTuple
import zlib

from adxl_ros.errors import UserError
import numpy as np

_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX = 3, 4, 5, 6, 7
"""Operation codes of records (specification, "Records")."""

_RECORD_HEAD = struct.Struct('<BQ')
"""Operation code and length of a record."""

_CHUNK_HEAD = struct.Struct('<QQQII')
"""First and last time of a chunk, its size, CRC-32, and the length of its compression's name; the
name and the 8 bytes of the length of its records follow."""

_MESSAGE_HEAD = np.dtype([('code', 'u1'), ('size', '<u8'), ('channel', '<u2'), ('sequence', '<u4'),
                          ('log_ns', '<u8'), ('publish_ns', '<u8')])
"""Beginning of a message record; the CDR follows."""

_INDEX_HEAD = np.dtype([('code', 'u1'), ('size', '<u8'), ('channel', '<u2'), ('bytes', '<u4')])
"""Beginning of a message index record; the entries follow."""

_INDEX_ENTRY = np.dtype([('log_ns', '<u8'), ('offset', '<u8')])
"""Log time of a message, and where its record begins in the chunk."""

_INDEX_OFFSET = struct.Struct('<HQ')
"""A channel, and where its message index begins in the file."""

_INDEX_BYTE = 32
"""Place of the length of the message index offsets in a chunk index record. They follow, and the
size of the message indices."""

_CHUNK_BYTES = 1 << 20
"""Size that a chunk hardly exceeds, bytes; that of rosbags."""

_LARGE_BYTES = 2 << 30
"""Size from which a file that is read leaves the cache (chosen): smaller ones are read again."""

_PIECE_MESSAGES = 4096
"""Messages that are collected to a piece (chosen: some MB)."""

Raws = Sequence[bytes] | np.ndarray
"""Messages of one type: their bytes one by one, or as rows of equal length, (n, size)."""


@dataclass(frozen=True)
class Piece:
    """Consecutive messages of some topics."""

    messages: Mapping[str, Raws]  # The messages by topic, in the order of recording
    # Where each of them stands in the order of all, by topic, (n,), ascending
    places: Mapping[str, np.ndarray]
    log_ns: Mapping[str, np.ndarray]  # Their log times by topic, ns, (n,)


def collected_pieces(messages: Iterable[tuple[str, bytes, int]]) -> Iterator[Piece]:
    """Collect messages with topic and log time, ns, to pieces."""
    iterator = iter(messages)
    while batch := list(islice(iterator, _PIECE_MESSAGES)):
        topics = np.array([topic for topic, _, _ in batch])
        logged = np.array([log_ns for _, _, log_ns in batch])
        places = {str(topic): np.flatnonzero(topics == topic) for topic in np.unique(topics)}
        yield Piece({topic: [batch[i][1] for i in rows] for topic, rows in places.items()}, places,
                    {topic: logged[rows] for topic, rows in places.items()})


def in_order(storage: Any, topics: Mapping[int, str]) -> list[Any]:
    """Return the chunks with messages of some topics, if `read_chunk` can read all of them."""
    chunks = [chunk for chunk in getattr(storage, 'chunks', ())
              if any(chunk.channel_count.get(channel, 0) for channel in topics)]
    chunks.sort(key=lambda chunk: (chunk.message_start_time, chunk.chunk_start_offset))
    is_ordered = all(first.message_end_time <= second.message_start_time
                     and first.chunk_start_offset < second.chunk_start_offset
                     for first, second in pairwise(chunks))
    return chunks if is_ordered and len(set(topics.values())) == len(topics) else []


def read_chunk(file: Any, chunk: Any, topics: Mapping[int, str]) -> Piece:
    """Read the messages of a chunk, each topic of one channel, by its message indices."""
    from rosbags.rosbag2.storage_mcap import decompress
    file.seek(chunk.chunk_start_offset + _RECORD_HEAD.size)
    *_, crc, name_bytes = _CHUNK_HEAD.unpack(file.read(_CHUNK_HEAD.size))
    file.seek(name_bytes + 8, os.SEEK_CUR)
    data = np.frombuffer(decompress(file.read(chunk.compressed_size), chunk.compression,
                                    chunk.uncompressed_size, crc), np.uint8)
    if os.fstat(file.fileno()).st_size > _LARGE_BYTES:
        # From its begin on, because the system keeps a large page that is only partly within.
        os.posix_fadvise(file.fileno(), 0, file.tell(), os.POSIX_FADV_DONTNEED)
    indices = {channel: _index(file, chunk, channel) for channel in topics
               if chunk.channel_count.get(channel, 0)}
    raws = {topics[channel]: _messages(data, channel, index) for channel, index in indices.items()}
    entries = np.concatenate(list(indices.values()))
    places = np.empty(len(entries), np.int64)
    places[np.lexsort((entries['offset'], entries['log_ns']))] = np.arange(len(entries))
    bounds = np.cumsum([len(index) for index in indices.values()])[:-1]
    return Piece(raws, dict(zip(raws, np.split(places, bounds))), {
        topics[channel]: index['log_ns'].astype(np.int64) for channel, index in indices.items()})


def _index(file: Any, chunk: Any, channel: int) -> np.ndarray:
    """Return the entries of the message index of a channel, (n,), in the order of time."""
    file.seek(chunk.message_index_offsets[channel])
    head = np.frombuffer(file.read(_INDEX_HEAD.itemsize), _INDEX_HEAD)[0]
    if head['code'] != _MESSAGE_INDEX or head['channel'] != channel:
        raise ValueError('no message index where the file says')
    entries = np.frombuffer(file.read(int(head['bytes'])), _INDEX_ENTRY)
    return entries[np.lexsort((entries['offset'], entries['log_ns']))]


def _messages(data: np.ndarray, channel: int, entries: np.ndarray) -> Raws:
    """Take the messages of a channel out of a chunk by its message index, (n,)."""
    offset = entries['offset'].astype(np.int64)
    head_bytes = _MESSAGE_HEAD.itemsize
    if offset.min() < 0 or offset.max() + head_bytes > len(data):
        raise ValueError('a message index points out of its chunk')
    heads = _windows(data, head_bytes)[_even(offset)].view(_MESSAGE_HEAD)[:, 0]
    begin = offset + head_bytes
    sizes = heads['size'].astype(np.int64) + _RECORD_HEAD.size - head_bytes
    if ((heads['code'] != _MESSAGE) | (heads['channel'] != channel)
            | (heads['log_ns'] != entries['log_ns']) | (sizes < 1)
            | (begin + sizes > len(data))).any():
        raise ValueError('a message index does not describe its chunk')
    if (sizes == sizes[0]).all():
        return _windows(data, int(sizes[0]))[_even(begin)]
    return [data[first:last].tobytes()
            for first, last in zip(begin.tolist(), (begin + sizes).tolist())]


def _windows(data: np.ndarray, size: int) -> np.ndarray:
    """Return a view of `size` bytes from each place on, (n, size)."""
    return np.lib.stride_tricks.sliding_window_view(data, size, writeable=data.flags.writeable)


def _even(begin: np.ndarray) -> slice | np.ndarray:
    """Return rising places, (n,), as a slice where they are evenly spaced: it copies faster."""
    steps = np.diff(begin)
    if not len(steps) or steps[0] < 1 or (steps != steps[0]).any():
        return begin
    return slice(int(begin[0]), int(begin[-1]) + 1, int(steps[0]))


class Batch(NamedTuple):
    """Messages of one topic and one length."""

    connection: Any  # Their topic, as rosbags states it
    rows: np.ndarray  # Samples that they belong to, rising, (n,)
    data: np.ndarray  # Their bytes, (n, size)


def write_messages(writer: Any, stamp_ns: np.ndarray, batches: Sequence[Batch]) -> None:
    """
    Append messages to an MCAP file by rosbags' writer, sample by sample, in chunks of their own.

    stamp_ns: stamps of the samples, ns, (n,), rising.
    """
    if writer.storage.chunk.msgs:
        writer.storage.close_chunk()
    sample_bytes = sum(batch.data.shape[1] + _MESSAGE_HEAD.itemsize for batch in batches)
    step = max(_CHUNK_BYTES // sample_bytes, 1)
    for begin in range(0, len(stamp_ns), step):
        parts = []
        for connection, rows, data in batches:
            part = slice(*np.searchsorted(rows, (begin, begin + step)))
            if len(rows[part]):
                parts.append(Batch(connection, rows[part], data[part]))
        if parts:
            _write_chunk(writer, stamp_ns, parts)


def _write_chunk(writer: Any, stamp_ns: np.ndarray, batches: list[Batch]) -> None:
    """Append a chunk with its message indices, which rosbags would write message by message."""
    storage, chunk = writer.storage, writer.storage.chunk
    stamps = stamp_ns[np.concatenate([batch.rows for batch in batches])]
    first, last = int(stamps.min()), int(stamps.max())
    for counter in (chunk, storage):
        counter.message_start_time = min(counter.message_start_time, first)
        counter.message_end_time = max(counter.message_end_time, last)
    writer.min_timestamp = min(writer.min_timestamp, first)
    writer.max_timestamp = max(writer.max_timestamp, last)
    records, places = _records(stamp_ns, batches)
    indices: dict[int, list[np.ndarray]] = {}
    for (connection, rows, _), place in zip(batches, places):
        entries = np.empty(len(rows), _INDEX_ENTRY)
        entries['log_ns'], entries['offset'] = stamp_ns[rows], place + chunk.bio.tell()
        indices.setdefault(connection.id, []).append(entries)
        storage.channel_stats[connection.id] += len(rows)
        writer.counts[connection.id] += len(rows)
    chunk.bio.write(records)
    storage.close_chunk()
    begin, offsets = storage.bio.tell(), b''
    for channel, parts in indices.items():
        entries = np.concatenate(parts)
        entries = entries[np.argsort(entries['offset'], kind='stable')]  # fast where it rises
        offsets += _INDEX_OFFSET.pack(channel, storage.bio.tell())
        storage.bio.write(np.array([(_MESSAGE_INDEX, entries.nbytes + 6, channel, entries.nbytes)],
                                   _INDEX_HEAD).tobytes())
        storage.bio.write(entries)
    # The entry of the chunk in the index of the file states no message index yet.
    entry = storage.chunks[-1]
    text = entry.getvalue()
    entry.seek(_INDEX_BYTE)
    entry.write(len(offsets).to_bytes(4, 'little') + offsets
                + (storage.bio.tell() - begin).to_bytes(8, 'little') + text[_INDEX_BYTE + 12:])


def _records(stamp_ns: np.ndarray, batches: list[Batch]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the bytes of message records, (size,), sample by sample; and their places."""
    lengths = [batch.data.shape[1] + _MESSAGE_HEAD.itemsize for batch in batches]
    counts = [len(batch.rows) for batch in batches]
    order = np.argsort(np.concatenate([batch.rows for batch in batches]), kind='stable')
    stops = np.cumsum(np.repeat(lengths, counts)[order])
    begins = np.empty(len(order), np.int64)
    begins[order] = np.concatenate([[0], stops[:-1]])
    places = np.split(begins, np.cumsum(counts)[:-1])
    records = np.empty(stops[-1], np.uint8)
    for batch, length, place in zip(batches, lengths, places):
        heads = np.zeros(len(place), _MESSAGE_HEAD)
        heads['code'], heads['size'] = _MESSAGE, length - _RECORD_HEAD.size
        heads['channel'] = batch.connection.id
        heads['log_ns'] = heads['publish_ns'] = stamp_ns[batch.rows]
        for begin, rows in ((place, heads.view(np.uint8).reshape(len(place), -1)),
                            (place + _MESSAGE_HEAD.itemsize, batch.data)):
            _windows(records, rows.shape[1])[_even(begin)] = rows
    return records, places


_MAGIC = b'\x89MCAP0\r\n'
"""First and last bytes of a whole file (specification, "Magic")."""

_LAST_CODE = 0x0F
"""Largest operation code of the specification."""

_FIRST_PRIVATE_CODE = 0x80
"""Smallest operation code of records that the specification leaves to applications."""

_MESSAGE_BEGIN = struct.Struct('<HIQQ')
"""Beginning of the content of a message record: channel, sequence number, log and publish time."""

_SMALLEST_BYTES = {_SCHEMA: 6, _CHANNEL: 8, _MESSAGE: _MESSAGE_BEGIN.size}
"""Smallest size of the content of a record, by operation code."""

Record = tuple[int, bytes]
"""Operation code and content of a whole record."""


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
        if magic != _MAGIC:
            raise UserError(f'{path}: is no MCAP file: it does not begin as one' if magic
                            else f'{path}: is empty')
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
        for code, content in self._records():
            number = int.from_bytes(content[:2], 'little')
            if code == _MESSAGE and number in self._channels:
                self.types.add(self._channels[number])
            elif code == _SCHEMA:
                schemas[number] = _text(content, 2)
            elif code == _CHANNEL:
                kind = schemas.get(int.from_bytes(content[2:4], 'little'), '')
                self._channels[number] = (_text(content, 4), kind)
        self.cut = ''  # Where the file is cut off or damaged; empty if it is whole
        if self._offset != self._size - len(_MAGIC) or not _has_end(file):
            self.cut = (f'cut off or damaged in the record that begins at byte {self._offset} '
                        f'of {self._size}')

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, bytes, int]]:
        """Yield topic, CDR and log time, ns, of each whole message, in the order of the file."""
        for code, content in self._records():
            if code == _MESSAGE:
                channel, _, log_ns, _ = _MESSAGE_BEGIN.unpack_from(content)
                topic, _ = self._channels.get(channel, ('', ''))
                if topic in topics:
                    yield topic, content[_MESSAGE_BEGIN.size:], log_ns

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
                yield code, content
            if not is_whole:
                return
            self._offset = begin + size
            self.done = self._offset / self._size


def _chunk(content: bytes, is_whole: bool) -> Generator[Record, None, bool]:
    """Yield the records of a chunk, whose end may be missing; return whether it is whole."""
    if len(content) < _CHUNK_HEAD.size:
        return False
    *_, crc, name_bytes = _CHUNK_HEAD.unpack_from(content)
    try:
        data = unpack(_text(content, _CHUNK_HEAD.size - 4),
                      content[_CHUNK_HEAD.size + name_bytes + 8:])
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
        yield code, data[start:offset]
    return is_whole


def _is_record(code: int, size: int) -> bool:
    """Return whether a record may have this code and size; damaged bytes rarely look like it."""
    is_known = 0 < code <= _LAST_CODE or code >= _FIRST_PRIVATE_CODE
    return is_known and size >= _SMALLEST_BYTES.get(code, 0)


def _text(data: bytes, offset: int) -> str:
    """Return the string at an offset: its length in 4 bytes, then its bytes."""
    start = offset + 4
    stop = start + int.from_bytes(data[offset:start], 'little')
    return data[start:stop].decode(errors='replace')
