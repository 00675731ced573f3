# SPDX-License-Identifier: Apache-2.0

"""
The messages of a rosbag2 recording, in any storage and compression, by the library rosbags.

MCAP files (https://mcap.dev/spec) are read and written by chunk. A chunk is followed by the places
of its messages, so that those of one length are taken from it, and put into it, as the rows of one
array. A killed recorder leaves a file without its index, which is read up to the last whole
record.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, ExitStack
from dataclasses import dataclass
from itertools import chain, islice, pairwise
import os
from pathlib import Path
import struct
from typing import Any, NamedTuple

from adxl_ros.errors import install_hint, one_line, UserError
from adxl_ros.files.atomic_write import AnyPath
from adxl_ros.files.stream_info import NOMINAL_KEYS
from adxl_ros.model.constants import MEASURED_AXES
from adxl_ros.wording import option
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

_MESSAGE = 5  # Operation code of a message record (specification, "Records")
_MESSAGE_INDEX = 7  # That of a message index record
_RECORD_HEAD = struct.Struct('<BQ')  # Operation code and length of a record
_CHUNK_HEAD = struct.Struct('<QQQII')
"""First and last time of a chunk, its size, CRC-32, and the length of its compression's name; the
name and the 8 bytes of the length of its records follow."""
_MESSAGE_HEAD = np.dtype(
    [
        ('code', 'u1'),
        ('size', '<u8'),
        ('channel', '<u2'),
        ('sequence', '<u4'),
        ('log_ns', '<u8'),
        ('publish_ns', '<u8'),
    ]
)
"""Beginning of a message record; the CDR follows."""
_INDEX_HEAD = struct.Struct('<BQHI')
"""Code and size of a message index record, its channel and the size of its entries, bytes."""
_INDEX_ENTRY = np.dtype([('log_ns', '<u8'), ('offset', '<u8')])
"""Log time of a message, and where its record begins in the chunk."""
_INDEX_OFFSET = struct.Struct('<HQ')  # A channel, and where its message index begins in the file
_INDEX_BYTE = 32
"""Place of the length of the message index offsets in a chunk index record. They follow, and the
size of the message indices."""
_CHUNK_BYTES = 1 << 20  # Size that a chunk hardly exceeds, bytes; that of rosbags
_LARGE_BYTES = 2 << 30
"""Size from which a file that is read leaves the cache. Smaller ones are read again by the next
tool; larger ones would push out what other programs have there."""
_PIECE_MESSAGES = 4096  # Messages that are collected to a piece (chosen: some MB)

Raws = Sequence[bytes] | np.ndarray
"""Messages of one type: their bytes one by one, or as rows of equal length, (n, size)."""
_MAGIC = b'\x89MCAP0\r\n'  # First and last bytes of a whole file (specification, "Magic")
_ENDINGS = ('.mcap', '.db3')  # Ends of the names of files in a recording's directory
IMU = 'sensor_msgs/msg/Imu'
JOINT_STATE = 'sensor_msgs/msg/JointState'
TEMPERATURE = 'sensor_msgs/msg/Temperature'
BATTERY_STATE = 'sensor_msgs/msg/BatteryState'
DIAGNOSTIC_STATUS = 'diagnostic_msgs/msg/DiagnosticStatus'  # Type of `sensor_info`


@dataclass(frozen=True)
class Piece:
    """Consecutive messages of some topics."""

    messages: Mapping[str, Raws]  # The messages by topic, in the order of recording
    log_ns: Mapping[str, np.ndarray]  # Their log times by topic, ns, (n,)


def _collected_pieces(messages: Iterable[tuple[str, bytes, int]]) -> Iterator[Piece]:
    """Collect messages with topic and log time, ns, to pieces."""
    iterator = iter(messages)
    while batch := list(islice(iterator, _PIECE_MESSAGES)):
        raws: dict[str, list[bytes]] = {}
        log_ns: dict[str, list[int]] = {}
        for topic, raw, time_ns in batch:
            raws.setdefault(topic, []).append(raw)
            log_ns.setdefault(topic, []).append(time_ns)
        yield Piece(raws, {topic: np.array(times) for topic, times in log_ns.items()})


def _in_order(storage: Any, topics: Mapping[int, str]) -> list[Any]:
    """Return the chunks with messages of some topics, if `_read_chunk` can read all of them."""
    chunks = [
        chunk
        for chunk in getattr(storage, 'chunks', ())
        if any(chunk.channel_count.get(channel, 0) for channel in topics)
    ]
    chunks.sort(key=lambda chunk: (chunk.message_start_time, chunk.chunk_start_offset))
    is_ordered = all(
        first.message_end_time <= second.message_start_time
        and first.chunk_start_offset < second.chunk_start_offset
        for first, second in pairwise(chunks)
    )
    return chunks if is_ordered and len(set(topics.values())) == len(topics) else []


def _read_chunk(file: Any, chunk: Any, topics: Mapping[int, str]) -> Piece:
    """Read the messages of a chunk, each topic of one channel, by its message indices."""
    from rosbags.rosbag2.storage_mcap import decompress

    file.seek(chunk.chunk_start_offset + _RECORD_HEAD.size)
    *_, crc, name_bytes = _CHUNK_HEAD.unpack(file.read(_CHUNK_HEAD.size))
    file.seek(name_bytes + 8, os.SEEK_CUR)
    data = np.frombuffer(
        decompress(
            file.read(chunk.compressed_size), chunk.compression, chunk.uncompressed_size, crc
        ),
        np.uint8,
    )
    if os.fstat(file.fileno()).st_size > _LARGE_BYTES:
        # From its begin on, because the system keeps a large page that is only partly within.
        os.posix_fadvise(file.fileno(), 0, file.tell(), os.POSIX_FADV_DONTNEED)
    indices = {
        channel: _index(file, chunk, channel)
        for channel in topics
        if chunk.channel_count.get(channel, 0)
    }
    raws = {topics[channel]: _messages(data, channel, index) for channel, index in indices.items()}
    return Piece(
        raws,
        {topics[channel]: index['log_ns'].astype(np.int64) for channel, index in indices.items()},
    )


def _index(file: Any, chunk: Any, channel: int) -> np.ndarray:
    """Return the entries of the message index of a channel, (n,), in the order of time."""
    file.seek(chunk.message_index_offsets[channel])
    code, _, number, size = _INDEX_HEAD.unpack(file.read(_INDEX_HEAD.size))
    if (code, number) != (_MESSAGE_INDEX, channel):
        raise ValueError('no message index where the file says')
    entries = np.frombuffer(file.read(size), _INDEX_ENTRY)
    return entries[np.lexsort((entries['offset'], entries['log_ns']))]


def _messages(data: np.ndarray, channel: int, entries: np.ndarray) -> Raws:
    """Take the messages of a channel out of a chunk by its message index, (n,)."""
    offset = entries['offset'].astype(np.int64)
    head_bytes = _MESSAGE_HEAD.itemsize
    if offset.min() < 0 or offset.max() + head_bytes > len(data):
        raise ValueError('a message index points out of its chunk')
    heads = sliding_window_view(data, head_bytes)[offset].view(_MESSAGE_HEAD)[:, 0]
    begin = offset + head_bytes
    sizes = heads['size'].astype(np.int64) + _RECORD_HEAD.size - head_bytes
    if (
        (heads['code'] != _MESSAGE)
        | (heads['channel'] != channel)
        | (heads['log_ns'] != entries['log_ns'])
        | (sizes < 1)
        | (begin + sizes > len(data))
    ).any():
        raise ValueError('a message index does not describe its chunk')
    if (sizes == sizes[0]).all():
        return sliding_window_view(data, int(sizes[0]))[begin]
    return [
        data[first:last].tobytes() for first, last in zip(begin.tolist(), (begin + sizes).tolist())
    ]


class Batch(NamedTuple):
    """Messages of one topic and one length."""

    connection: Any  # Their topic, as rosbags states it
    stamp_ns: np.ndarray  # Their times, ns, rising, (n,)
    data: np.ndarray  # Their bytes, (n, size)


def write_messages(writer: Any, batches: Sequence[Batch]) -> None:
    """Append messages in chunks of their own; the first batch has all stamps that occur."""
    if writer.storage.chunk.msgs:
        writer.storage.close_chunk()
    size = sum(batch.data.shape[1] + _MESSAGE_HEAD.itemsize for batch in batches)
    stamps = batches[0].stamp_ns
    for begin, end in pairwise([*stamps[:: max(_CHUNK_BYTES // size, 1)], stamps[-1] + 1]):
        parts = []
        for connection, stamp_ns, data in batches:
            within = slice(*np.searchsorted(stamp_ns, (begin, end)))
            parts.append(Batch(connection, stamp_ns[within], data[within]))
        _write_chunk(writer, [part for part in parts if len(part.data)])


def _write_chunk(writer: Any, batches: list[Batch]) -> None:
    """Append a chunk with its message indices, which rosbags would write message by message."""
    storage = writer.storage
    indices: dict[int, bytes] = {}
    for batch in batches:
        channel = batch.connection.id
        indices[channel] = indices.get(channel, b'') + _append_batch(writer, batch)
    writer.min_timestamp = min(writer.min_timestamp, storage.message_start_time)
    writer.max_timestamp = max(writer.max_timestamp, storage.message_end_time)
    storage.close_chunk()
    _write_indices(storage, indices)


def _append_batch(writer: Any, batch: Batch) -> bytes:
    """Append messages of one size to the chunk; return their entries in the index."""
    storage = writer.storage
    chunk = storage.chunk
    connection, stamp_ns, data = batch
    head = np.zeros(len(data), _MESSAGE_HEAD)
    head['code'] = _MESSAGE
    head['channel'] = connection.id
    head['size'] = head.itemsize + data.shape[1] - _RECORD_HEAD.size
    head['log_ns'] = head['publish_ns'] = stamp_ns
    records = np.hstack([head.view(np.uint8).reshape(len(data), -1), data])
    entries = np.empty(len(data), _INDEX_ENTRY)
    entries['log_ns'] = stamp_ns
    entries['offset'] = chunk.bio.tell() + np.arange(len(data)) * records.shape[1]
    chunk.bio.write(records)
    storage.channel_stats[connection.id] += len(data)
    writer.counts[connection.id] += len(data)
    for counter in (chunk, storage):
        counter.message_start_time = min(counter.message_start_time, int(stamp_ns[0]))
        counter.message_end_time = max(counter.message_end_time, int(stamp_ns[-1]))
    return entries.tobytes()


def _write_indices(storage: Any, indices: Mapping[int, bytes]) -> None:
    """Write the message index of each channel behind the chunk, and state where they are."""
    begin = storage.bio.tell()
    offsets = b''
    for channel, index in indices.items():
        offsets += _INDEX_OFFSET.pack(channel, storage.bio.tell())
        storage.bio.write(
            _INDEX_HEAD.pack(_MESSAGE_INDEX, len(index) + 6, channel, len(index)) + index
        )
    # The entry of the chunk in the index of the file states no message index yet.
    entry = storage.chunks[-1]
    text = entry.getvalue()
    entry.seek(_INDEX_BYTE)
    entry.write(
        len(offsets).to_bytes(4, 'little')
        + offsets
        + (storage.bio.tell() - begin).to_bytes(8, 'little')
        + text[_INDEX_BYTE + 12 :]
    )


def _is_unfinished(path: Path) -> bool:
    """Return whether an MCAP file has no end, because its recorder was killed, or still runs."""
    with open(path, 'rb') as file:
        begins = file.read(len(_MAGIC)) == _MAGIC
        file.seek(max(os.fstat(file.fileno()).st_size - len(_MAGIC), 1))
        return begins and file.read() != _MAGIC


def _open_unfinished(path: Path) -> tuple[Any, str]:
    """Return a reader of rosbags up to the last whole record of a file, and where that ends."""
    from rosbags.rosbag2.storage_mcap import McapReader

    reader = McapReader(path)
    reader.bio = file = open(path, 'rb')  # noqa: SIM115 (closed with the reader)
    size = os.fstat(file.fileno()).st_size
    end = reader.data_start = file.seek(len(_MAGIC))
    while end <= size:
        reader.data_end = file.seek(end)
        head = file.read(_RECORD_HEAD.size).ljust(_RECORD_HEAD.size, b'\0')
        code, length = _RECORD_HEAD.unpack(head)
        end = file.tell() + length if code else size + 1
    reader.meta_scan()
    counts = reader.statistics.channel_message_counts if reader.statistics else {}
    reader.connections = [each._replace(msgcount=counts[each.id]) for each in reader.connections]
    return reader, f'{path}: cut off at byte {reader.data_end} of {size}'


class Bag:
    """An open recording."""

    def __init__(self, path: str, storages: list[Any], is_packed: bool, cut: str) -> None:
        """Take the files of a recording, whose messages may be packed one by one."""
        self.path = path  # The file or directory, for messages
        self.cut = cut  # Where damaged files end; empty if all are whole
        # Topics that hold messages, each with its type
        self.types = {
            (connection.topic, connection.msgtype)
            for connection in chain.from_iterable(storage.connections for storage in storages)
            if connection.msgcount
        }
        self.done = 0.0  # Fraction of the recording that has been read
        self._storages = storages
        self._is_packed = is_packed

    def pieces(self, topics: Collection[str]) -> Iterator[Piece]:
        """Yield the messages of some topics in pieces, in the order of recording."""
        for number, storage in enumerate(self._storages):
            connections = [
                connection
                for connection in storage.connections
                if connection.topic in topics and connection.msgcount
            ]
            names = {connection.id: connection.topic for connection in connections}
            chunks = [] if self._is_packed else _in_order(storage, names)
            pieces = (
                (_read_chunk(storage.bio, chunk, names) for chunk in chunks)
                if chunks
                else _collected_pieces(self._messages(storage, connections))
            )
            total = len(chunks) or sum(each.msgcount for each in connections) / _PIECE_MESSAGES
            with _readable(self.path):
                for count, piece in enumerate(pieces, 1):
                    self.done = (number + min(count / total, 1.0)) / len(self._storages)
                    yield piece
        self.done = 1.0

    def messages(self, topic: str) -> Iterator[bytes]:
        """Yield the CDR of each message of a topic, in the order of recording."""
        for piece in self.pieces([topic]):
            yield from map(bytes, piece.messages[topic])

    def _messages(self, storage: Any, connections: list[Any]) -> Iterator[tuple[str, bytes, int]]:
        """Yield topic, CDR and log time, ns, of the messages of some connections."""
        if self._is_packed:
            from backports import zstd
        # Without an index, rosbags would demand the messages in the order of time.
        read = storage.messages if getattr(storage, 'chunks', True) else storage.messages_scan
        for connection, log_ns, raw in read(connections) if connections else ():
            yield connection.topic, zstd.decompress(raw) if self._is_packed else raw, log_ns


@contextmanager
def _readable(path: AnyPath) -> Iterator[None]:
    """Refuse a file that rosbags cannot read: it can raise errors of any kind."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        reason = one_line(error) or f'damaged ({type(error).__name__})'
        raise UserError(f'{path}: cannot read it as a rosbag2 recording: {reason}') from error


def import_rosbags() -> Any:
    """Return the module rosbags.rosbag2."""
    try:
        import rosbags.rosbag2
    except ImportError:
        raise UserError(
            'rosbag2 recordings need the Python package rosbags: '
            + install_hint('rosbags>=0.11.8,<0.12')
        ) from None
    return rosbags.rosbag2


@contextmanager
def open_bag(path: AnyPath) -> Iterator[Bag]:
    """Open a rosbag2 directory, or one .mcap or .db3 file."""
    rosbag2 = import_rosbags()
    bag_path = Path(path)
    with ExitStack() as stack:
        if (bag_path / 'metadata.yaml').exists():
            with _readable(bag_path):
                reader = stack.enter_context(rosbag2.Reader(bag_path))
            yield Bag(str(path), reader.storage.storages, reader.compression_mode == 'message', '')
            return
        storages = []
        cuts = []
        for file in _files(bag_path):
            with _readable(file):
                if file.suffix == '.mcap' and _is_unfinished(file):
                    storage, cut = _open_unfinished(file)
                    cuts.append(cut)
                else:
                    storage = rosbag2.Reader(file).storage
                    storage.open()
            stack.callback(storage.close)
            storages.append(storage)
        yield Bag(str(path), storages, False, '; '.join(cuts))


def _files(path: Path) -> list[Path]:
    """Return the files of a recording without metadata.yaml, in the order of their numbers."""
    if not path.is_dir():
        return [path]
    files = [file for file in path.iterdir() if file.suffix in _ENDINGS]
    if not files:
        raise UserError(
            f'{path}: is a directory without metadata.yaml, .mcap or .db3 files; '
            'expected a rosbag2 recording; ros2 bag reindex writes metadata.yaml'
        )
    return sorted(files, key=lambda file: (len(file.name), file.name))  # 10 comes behind 9


class Topics(NamedTuple):
    """Full names of the topics in a bag; None where the bag does not hold it."""

    imu: str  # The sensor's output
    joints: str | None = None  # Positions of the stage
    info: str | None = None  # What the sensor states of itself
    temperature: str | None = None
    supply: str | None = None
    command: str | None = None  # Commands of the stage


def find_topics(bag: Bag, topic: str = '', has_stage: bool = True) -> Topics:
    """
    Find the topics by their names, in any namespace, and their types.

    has_stage: whether joints, commands and `sensor_info` are looked for, too.
    """
    imu = find_imu(bag, topic)
    is_own = imu.endswith('imu/data_raw')
    space = imu.removesuffix('imu/data_raw') if is_own else imu[: imu.rfind('/') + 1]

    def beside(name: str, kind: str) -> str | None:
        """Return a topic in the namespace of the sensor; other nodes use these names, too."""
        return space + name if (space + name, kind) in bag.types else None

    temperature = beside('temperature', TEMPERATURE)
    supply = beside('supply', BATTERY_STATE)
    if not has_stage:
        return Topics(imu, temperature=temperature, supply=supply)
    joints = beside('stage/joint_states', JOINT_STATE) or _only(
        bag, 'stage/joint_states', JOINT_STATE
    )
    info = beside('sensor_info', DIAGNOSTIC_STATUS)
    # With several sensors, the only sensor_info may be that of another one.
    is_alone = is_own or [kind for _, kind in bag.types].count(IMU) == 1
    if info is None and is_alone:
        info = _only(bag, 'sensor_info', DIAGNOSTIC_STATUS)
    space = joints.removesuffix('joint_states') if joints else f'{space}stage/'
    return Topics(
        imu=imu,
        joints=joints,
        info=info,
        temperature=temperature,
        supply=supply,
        command=beside('command', JOINT_STATE),
    )


def choose_topic(bag: Bag, kind: str, own: str, named: str, argument: str = 'topic') -> str:
    """Return the topic of a type that the user has named, that of the usual name, or the only."""
    topics = sorted(topic for topic, other in bag.types if other == kind)
    if not topics:
        held = ', '.join(f'{topic} ({kind})' for topic, kind in sorted(bag.types))
        cut = f'; {bag.cut}' if bag.cut else ''
        raise UserError(
            f'{bag.path}: no topic of type {kind}; it holds {held or "no messages"}{cut}'
        )
    chosen = (
        [topic for topic in topics if topic.strip('/') == named.strip('/')]
        if named
        else [topic for topic in topics if f'/{topic}'.endswith(f'/{own}')] or topics
    )
    if len(chosen) != 1:
        raise UserError(
            f'{bag.path}: {len(chosen) or "no"} topics {named or kind}; choose one '
            f'with {option(argument)}: {", ".join(chosen or topics)}'
        )
    return chosen[0]


def find_imu(bag: Bag, named: str = '') -> str:
    """Return the topic of the sensor's output."""
    return choose_topic(bag, IMU, 'imu/data_raw', named)


def _only(bag: Bag, name: str, kind: str) -> str | None:
    """Return the topic of this name in any namespace; None if there is none."""
    topics = sorted(
        topic for topic, other in bag.types if other == kind and f'/{topic}'.endswith(f'/{name}')
    )
    if len(topics) > 1:
        raise UserError(
            f'{bag.path}: several topics {name}: {", ".join(topics)}; record one '
            f'sensor, or choose one: {option(topic=topics[0])}'
        )
    return topics[0] if topics else None


def typestore() -> Any:
    """Return the message definitions of ROS 2 Jazzy."""
    from rosbags.typesys import get_typestore, Stores

    return get_typestore(Stores.ROS2_JAZZY)


def read_info(bag: Bag, topic: str | None) -> dict[str, str]:
    """Return what the sensor states in the last message of `sensor_info`."""
    info: dict[str, str] = {}
    if topic is None:
        return info
    types = typestore()
    for raw in bag.messages(topic):
        with _readable(f'{bag.path}: topic {topic}'):
            message = types.deserialize_cdr(raw, DIAGNOSTIC_STATUS)
        new = {pair.key: pair.value for pair in message.values}
        for key in ('serial', 'axes', *NOMINAL_KEYS):
            if info.get(key, new.get(key)) != new.get(key):
                raise UserError(
                    f'{bag.path}: topic {topic}: {key} changes from {info[key]} to '
                    f'{new.get(key)}; record each sensor by itself'
                )
        info = new
    if info.get('axes', 'x') not in MEASURED_AXES:
        raise UserError(
            f'{bag.path}: topic {topic}: axes is {info["axes"]!r}, expected x, xy or xyz'
        )
    return info
