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
from io import BytesIO
from itertools import islice, pairwise
import os
from pathlib import Path
import struct
from typing import Any, BinaryIO, NamedTuple
import zlib

from adxl_ros.errors import UserError
import numpy as np

_MESSAGE = 5
"""Operation code of a message record (specification, "Records"; so is the next one)."""

_MESSAGE_INDEX = 7
"""Operation code of a message index record."""

_CHUNK = 6
"""Operation code of a chunk record."""

_RECORD_HEAD_BYTES = 9
"""Size of the operation code and length of a record."""

_MESSAGE_HEAD = np.dtype([('code', 'u1'), ('size', '<u8'), ('channel', '<u2'), ('sequence', '<u4'),
                          ('log_ns', '<u8'), ('publish_ns', '<u8')])
"""Beginning of a message record; the CDR follows."""

_INDEX_HEAD = np.dtype([('code', 'u1'), ('size', '<u8'), ('channel', '<u2'), ('bytes', '<u4')])
"""Beginning of a message index record; the entries follow."""

_INDEX_ENTRY = np.dtype([('log_ns', '<u8'), ('offset', '<u8')])
"""Log time of a message, and where its record begins in the chunk."""

_CHUNK_HEAD = np.dtype([('code', 'u1'), ('size', '<u8'), ('begin_ns', '<u8'), ('end_ns', '<u8'),
                        ('unpacked_bytes', '<u8'), ('crc', '<u4'), ('compression', '<u4'),
                        ('bytes', '<u8')])
"""Beginning of a chunk record without compression and CRC-32; the records follow."""

_PLACES_HEAD = np.dtype([('begin_ns', '<u8'), ('end_ns', '<u8'), ('offset', '<u8'),
                         ('chunk_bytes', '<u8'), ('places_bytes', '<u4')])
"""Beginning of the entry of a chunk in the index of the file; places of the indices follow."""

_PLACE = np.dtype([('channel', '<u2'), ('offset', '<u8')])
"""Where the message index of a channel begins in the file."""

_PLACES_END = np.dtype([('index_bytes', '<u8'), ('compression', '<u4'), ('bytes', '<u8'),
                        ('unpacked_bytes', '<u8')])
"""End of the entry of a chunk without compression."""

_CHUNK_BYTES = 1 << 20
"""Size that a chunk hardly exceeds, bytes; that of rosbags."""

_CRC_BYTES = 4
"""Size of a CRC-32."""

_CRC_BYTE = 24
"""Place of the CRC-32 in the content of a chunk record."""

_DATA_BYTE = 40
"""Place of the data in the content of a chunk record without the name of its compression."""


Raws = Sequence[bytes] | np.ndarray
"""Messages of one type: their bytes one by one, or as rows of equal length, (n, size)."""

_LARGE_BYTES = 2 << 30
"""Size from which a file that is read leaves the cache (chosen): smaller ones are read again."""

_PIECE_MESSAGES = 4096
"""Messages that are collected to a piece (chosen: some MB)."""


@dataclass(frozen=True)
class Piece:
    """Consecutive messages of some topics."""

    messages: Mapping[str, Raws]  # The messages by topic, in the order of recording
    # Where each of them stands in the order of all, by topic, (n,), ascending
    places: Mapping[str, np.ndarray]

    def split(self, topic: str, count: int) -> tuple[Piece, Piece]:
        """Split behind a message."""
        last = self.places[topic][count - 1]
        cuts = {name: int(np.searchsorted(places, last, 'right'))
                for name, places in self.places.items()}
        return (Piece({name: raws[:cuts[name]] for name, raws in self.messages.items()},
                      {name: places[:cuts[name]] for name, places in self.places.items()}),
                Piece({name: raws[cuts[name]:] for name, raws in self.messages.items()},
                      {name: places[cuts[name]:] for name, places in self.places.items()}))


def collected_pieces(messages: Iterable[tuple[str, bytes, int]]) -> Iterator[Piece]:
    """Collect messages with topic and log time, ns, to pieces."""
    iterator = iter(messages)
    while batch := list(islice(iterator, _PIECE_MESSAGES)):
        yield collected([(topic, raw) for topic, raw, _ in batch])


def collected(messages: list[tuple[str, bytes]]) -> Piece:
    """Collect messages with their topics to one piece."""
    raws: dict[str, list[bytes]] = {topic: [] for topic, _ in messages}
    places: dict[str, list[int]] = {topic: [] for topic in raws}
    for place, (topic, raw) in enumerate(messages):
        raws[topic].append(raw)
        places[topic].append(place)
    return Piece(raws, {topic: np.array(numbers) for topic, numbers in places.items()})


class IndexFault(ValueError):
    """A message index that does not describe its chunk."""


class _Found(NamedTuple):
    """Messages of one channel in a chunk."""

    raws: Raws  # The messages
    log_ns: np.ndarray  # Their log times, ns, (n,)
    offset: np.ndarray  # Where their records begin in the chunk, (n,)


def in_order(storage: Any, topics: Mapping[int, str]) -> list[Any]:
    """Return the chunks that hold messages of some topics."""
    chunks = [chunk for chunk in getattr(storage, 'chunks', ())
              if any(chunk.channel_count.get(channel, 0) for channel in topics)]
    chunks.sort(key=lambda chunk: (chunk.message_start_time, chunk.chunk_start_offset))
    is_ordered = all(first.message_end_time <= second.message_start_time
                     and first.chunk_start_offset < second.chunk_start_offset
                     for first, second in pairwise(chunks))
    return chunks if is_ordered else []


def read_chunk(file: Any, chunk: Any, topics: Mapping[int, str]) -> Piece:
    """
    Read the messages of a chunk.

    Where its message index does not describe it, its records are read one by one.
    """
    from rosbags.rosbag2.storage_mcap import decompress, msgsrc
    try:
        file.seek(chunk.chunk_start_offset + _RECORD_HEAD_BYTES + _CRC_BYTE)
        crc = int.from_bytes(file.read(_CRC_BYTES), 'little')
        file.seek(chunk.chunk_start_offset + _RECORD_HEAD_BYTES + _DATA_BYTE
                  + len(chunk.compression))
        data = np.frombuffer(decompress(file.read(chunk.compressed_size), chunk.compression,
                                        chunk.uncompressed_size, crc), np.uint8)
        _release_read(file)
        return _ordered({topic: _messages(data, channel, _index(file, chunk, channel))
                         for channel, topic in _channels(chunk, topics).items()})
    except IndexFault:
        names: Any = dict(topics)
        records: Any = msgsrc(chunk, names, 0, chunk.message_end_time + 1, file)
        return collected([(topic, raw) for _, _, topic, raw in records if raw is not None])


def _release_read(file: BinaryIO) -> None:
    """Give back the page cache of what was read of a large file, up to the present place."""
    if os.fstat(file.fileno()).st_size > _LARGE_BYTES:
        # From its begin on, because the system keeps a large page that is only partly within.
        os.posix_fadvise(file.fileno(), 0, file.tell(), os.POSIX_FADV_DONTNEED)


def _channels(chunk: Any, topics: Mapping[int, str]) -> dict[int, str]:
    """Return the topics of a chunk by channel number; two channels of a topic are a fault."""
    channels = {channel: topic for channel, topic in topics.items()
                if channel in chunk.message_index_offsets}
    if len(set(channels.values())) < len(channels):
        raise IndexFault('several channels have one topic')
    return channels


def _ordered(parts: dict[str, _Found]) -> Piece:
    """Put the messages of a chunk, by topic, in the order of their log times."""
    order = np.lexsort((np.concatenate([part.offset for part in parts.values()]),
                        np.concatenate([part.log_ns for part in parts.values()])))
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    bounds = np.cumsum([len(part.offset) for part in parts.values()])[:-1]
    return Piece({topic: part.raws for topic, part in parts.items()},
                 dict(zip(parts, np.split(place, bounds))))


def _index(file: Any, chunk: Any, channel: int) -> np.ndarray:
    """Return the entries of the message index of a channel, (n,), in the order of time."""
    file.seek(chunk.message_index_offsets[channel])
    head = np.frombuffer(file.read(_INDEX_HEAD.itemsize), _INDEX_HEAD)
    if len(head) != 1 or head['code'] != _MESSAGE_INDEX or head['channel'] != channel:
        raise IndexFault('no message index where the file says')
    content = file.read(int(head['bytes'][0]))
    if len(content) != head['bytes'] or len(content) % _INDEX_ENTRY.itemsize:
        raise IndexFault('a message index is cut off')
    entries = np.frombuffer(content, _INDEX_ENTRY)
    return entries[np.lexsort((entries['offset'], entries['log_ns']))]


def _messages(data: np.ndarray, channel: int, entries: np.ndarray) -> _Found:
    """
    Take the messages of a channel out of a chunk.

    entries: its message index, (n,).
    """
    offset = entries['offset'].astype(np.int64)
    head_bytes = _MESSAGE_HEAD.itemsize
    if not len(offset) or offset.min() < 0 or offset.max() + head_bytes > len(data):
        raise IndexFault('a message index points out of its chunk')
    heads = _rows(data, offset, head_bytes).view(_MESSAGE_HEAD)[:, 0]
    sizes = heads['size'].astype(np.int64) + _RECORD_HEAD_BYTES - head_bytes
    if ((heads['code'] != _MESSAGE) | (heads['channel'] != channel)
            | (heads['log_ns'] != entries['log_ns']) | (sizes < 1)
            | (offset + head_bytes + sizes > len(data))).any():
        raise IndexFault('a message index does not describe its chunk')
    begin = offset + head_bytes
    raws: Raws
    if (sizes == sizes[0]).all():
        raws = _rows(data, begin, int(sizes[0]))
    else:
        raws = [data[first:last].tobytes()
                for first, last in zip(begin.tolist(), (begin + sizes).tolist())]
    return _Found(raws, entries['log_ns'], offset)


def _rows(data: np.ndarray, begin: np.ndarray, size: int) -> np.ndarray:
    """Return `size` bytes from each of the places, (n,), as rows, (n, size)."""
    return np.lib.stride_tricks.sliding_window_view(data, size)[_even(begin)]


def _put(data: np.ndarray, begin: np.ndarray, rows: np.ndarray) -> None:
    """Copy rows, (n, size), to the places, (n,)."""
    windows = np.lib.stride_tricks.sliding_window_view(data, rows.shape[1], writeable=True)
    windows[_even(begin)] = rows


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
    Append messages to an MCAP file, sample by sample, in chunks of their own.

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
    """Append a chunk with its message indices; the arguments are those of `write_messages`."""
    storage = writer.storage
    # Schemas and channels of new topics wait in the open chunk of rosbags.
    pending = storage.chunk.bio.getvalue()
    storage.chunk.bio.seek(0)
    storage.chunk.bio.truncate()
    records, offsets = _records(stamp_ns, batches, len(pending))
    content_bytes = len(pending) + len(records)
    first, last = (int(stamp_ns[pick(batch.rows[end] for batch in batches)])
                   for pick, end in ((min, 0), (max, -1)))
    chunk_begin = storage.bio.tell()
    storage.bio.write(_packed(_CHUNK_HEAD, _CHUNK, content_bytes + _CHUNK_HEAD.itemsize
                              - _RECORD_HEAD_BYTES, first, last, content_bytes, 0, 0,
                              content_bytes))
    storage.bio.write(pending)
    storage.bio.write(records)
    chunk_end = storage.bio.tell()
    places = b''
    for channel in dict.fromkeys(batch.connection.id for batch in batches):
        places += _packed(_PLACE, channel, storage.bio.tell())
        entries = _entries(stamp_ns, [
            (batch.rows, offset) for batch, offset in zip(batches, offsets)
            if batch.connection.id == channel])
        storage.bio.write(_packed(_INDEX_HEAD, _MESSAGE_INDEX, entries.nbytes
                                  + _INDEX_HEAD.itemsize - _RECORD_HEAD_BYTES, channel,
                                  entries.nbytes))
        storage.bio.write(entries)
    entry = BytesIO()
    entry.write(_packed(_PLACES_HEAD, first, last, chunk_begin, chunk_end - chunk_begin,
                        len(places)))
    entry.write(places)
    entry.write(_packed(_PLACES_END, storage.bio.tell() - chunk_end, 0, content_bytes,
                        content_bytes))
    storage.chunks.append(entry)
    _count(writer, batches, first, last)


def _entries(stamp_ns: np.ndarray, messages: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """
    Make the message index of a channel.

    stamp_ns: stamps of the samples, ns, (n,); messages: samples and places in the chunk of its
    messages, (k,) each, by batch.
    """
    rows, offset = map(np.concatenate, zip(*messages))
    order = np.argsort(offset, kind='stable')  # fast where the places rise
    entries = np.empty(len(order), _INDEX_ENTRY)
    entries['log_ns'], entries['offset'] = stamp_ns[rows[order]], offset[order]
    return entries


def _count(writer: Any, batches: list[Batch], first_ns: int, last_ns: int) -> None:
    """Count messages in what rosbags states at the end of the file; the times are in ns."""
    storage = writer.storage
    for batch in batches:
        storage.channel_stats[batch.connection.id] += len(batch.rows)
        writer.counts[batch.connection.id] += len(batch.rows)
    storage.message_start_time = min(storage.message_start_time, first_ns)
    storage.message_end_time = max(storage.message_end_time, last_ns)
    writer.min_timestamp = min(writer.min_timestamp, first_ns)
    writer.max_timestamp = max(writer.max_timestamp, last_ns)


def _records(stamp_ns: np.ndarray, batches: list[Batch], begin: int
             ) -> tuple[np.ndarray, list[np.ndarray]]:
    """
    Make the message records of a chunk, sample by sample.

    stamp_ns: stamps of the samples, ns, (n,); returns: their bytes, (size,). Where the records of
    each batch begin in the chunk.
    """
    lengths = [batch.data.shape[1] + _MESSAGE_HEAD.itemsize for batch in batches]
    counts = [len(batch.rows) for batch in batches]
    order = np.argsort(np.concatenate([batch.rows for batch in batches]), kind='stable')
    stops = np.cumsum(np.repeat(lengths, counts)[order])
    begins = np.empty(len(order), np.int64)
    begins[order] = np.concatenate([[0], stops[:-1]])
    places = np.split(begins, np.cumsum(counts)[:-1])
    records = np.empty(stops[-1], np.uint8)
    for batch, length, place in zip(batches, lengths, places):
        head = np.array([(_MESSAGE, length - _RECORD_HEAD_BYTES, batch.connection.id, 0, 0, 0)],
                        _MESSAGE_HEAD)
        heads = head.repeat(len(place))
        heads['log_ns'] = heads['publish_ns'] = stamp_ns[batch.rows]
        _put(records, place, heads.view(np.uint8).reshape(len(place), -1))
        _put(records, place + _MESSAGE_HEAD.itemsize, batch.data)
    return records, [place + begin for place in places]


def _packed(layout: np.dtype, *values: int) -> bytes:
    """Return the bytes of one record."""
    return np.array([values], layout).tobytes()


_MAGIC = b'\x89MCAP0\r\n'
"""First and last bytes of a whole file (specification, "Magic")."""

_SCHEMA = 3
"""Operation code of a schema record."""

_CHANNEL = 4
"""Operation code of a channel record."""

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

_CHUNK_BEGIN = struct.Struct('<QQQII')
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
    if len(content) < _CHUNK_BEGIN.size:
        return False
    _, _, _, crc, length = _CHUNK_BEGIN.unpack_from(content)
    begin = _CHUNK_BEGIN.size + length + _LENGTH_BYTES
    try:
        data = unpack(_text(content, _CHUNK_BEGIN.size - 4), content[begin:])
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
