# SPDX-License-Identifier: Apache-2.0

"""The messages of a rosbag2 recording, in any storage and compression, by the library rosbags."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager, ExitStack
import os
from pathlib import Path
from typing import Any, NamedTuple

from adxl_ros.errors import install_hint, one_line, UserError
from adxl_ros.files import mcap_file
from adxl_ros.files.mcap_file import Piece
from adxl_ros.files.recording_columns import NOMINAL_KEYS
from adxl_ros.model.constants import MEASURED_AXES

_ENDINGS = ('.mcap', '.db3')  # Ends of the names of files in a recording's directory


class Bag:
    """An open recording."""

    def __init__(self, path: str, storages: list[Any], is_packed: bool, cut: str) -> None:
        """Take the files of a recording, whose messages may be packed one by one."""
        self.path = path  # The file or directory, for messages
        self.cut = cut  # Where damaged files end; empty if all are whole
        # Topics that hold messages, each with its type
        self.types = {(connection.topic, connection.msgtype) for storage in storages
                      for connection in storage.connections if connection.msgcount}
        self.done = 0.0  # Fraction of the recording that has been read
        self._storages, self._is_packed = storages, is_packed

    def pieces(self, topics: Collection[str]) -> Iterator[Piece]:
        """Yield the messages of some topics in pieces, in the order of recording."""
        for number, storage in enumerate(self._storages):
            connections = [connection for connection in storage.connections
                           if connection.topic in topics and connection.msgcount]
            names = {connection.id: connection.topic for connection in connections}
            chunks = [] if self._is_packed else mcap_file.in_order(storage, names)
            pieces = (mcap_file.read_chunk(storage.bio, chunk, names) for chunk in chunks) \
                if chunks else mcap_file.collected_pieces(self._messages(storage, connections))
            total = len(chunks) or \
                sum(each.msgcount for each in connections) / mcap_file.PIECE_MESSAGES
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
        if self._is_packed:
            from backports import zstd
        # Without an index, rosbags would demand the messages in the order of time.
        read = storage.messages if getattr(storage, 'chunks', True) else storage.messages_scan
        for connection, log_ns, raw in read(connections) if connections else ():
            yield connection.topic, zstd.decompress(raw) if self._is_packed else raw, log_ns


@contextmanager
def _readable(path: str | os.PathLike) -> Iterator[None]:
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
        raise UserError('rosbag2 recordings need the Python package rosbags: '
                        + install_hint('rosbags>=0.11.8,<0.12')) from None
    return rosbags.rosbag2


@contextmanager
def open_bag(path: str | os.PathLike) -> Iterator[Bag]:
    """Open a rosbag2 directory, or one .mcap or .db3 file."""
    rosbag2, bag_path = import_rosbags(), Path(path)
    with ExitStack() as stack:
        if (bag_path / 'metadata.yaml').exists():
            with _readable(bag_path):
                reader = stack.enter_context(rosbag2.Reader(bag_path))
            yield Bag(str(path), reader.storage.storages, reader.compression_mode == 'message', '')
            return
        storages, cuts = [], []
        for file in _files(bag_path):
            with _readable(file):
                if file.suffix == '.mcap' and mcap_file.is_unfinished(file):
                    storage, cut = mcap_file.open_unfinished(file)
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
        raise UserError(f'{path}: is a directory without metadata.yaml, .mcap or .db3 files; '
                        'expected a rosbag2 recording; ros2 bag reindex writes metadata.yaml')
    return sorted(files, key=lambda file: (len(file.name), file.name))  # 10 comes behind 9


IMU, JOINT_STATE = 'sensor_msgs/msg/Imu', 'sensor_msgs/msg/JointState'
TEMPERATURE, BATTERY_STATE = 'sensor_msgs/msg/Temperature', 'sensor_msgs/msg/BatteryState'
DIAGNOSTIC_STATUS = 'diagnostic_msgs/msg/DiagnosticStatus'  # Type of `sensor_info`


class Topics(NamedTuple):
    """Full names of the topics in a bag; None where the bag does not hold it."""

    imu: str  # The sensor's output
    joints: str | None = None  # Positions of the stage
    info: str | None = None  # What the sensor states of itself
    temperature: str | None = None
    supply: str | None = None
    command: str | None = None  # Commands of the stage


def find_topics(bag: Bag, topic: str = '') -> Topics:
    """Find the topics by their names, in any namespace, and their types."""
    imu = _find_imu(bag, topic)
    is_own = imu.endswith('imu/data_raw')
    space = imu.removesuffix('imu/data_raw') if is_own else imu[:imu.rfind('/') + 1]

    def beside(name: str, kind: str) -> str | None:
        """Return a topic in the namespace of the sensor; other nodes use these names, too."""
        return space + name if (space + name, kind) in bag.types else None

    joints = beside('stage/joint_states', JOINT_STATE) or _only(bag, 'stage/joint_states',
                                                                JOINT_STATE)
    info = beside('sensor_info', DIAGNOSTIC_STATUS)
    # With several sensors, the only sensor_info may be that of another one.
    if info is None and (is_own or len(_imu_topics(bag)) == 1):
        info = _only(bag, 'sensor_info', DIAGNOSTIC_STATUS)
    temperature, supply = beside('temperature', TEMPERATURE), beside('supply', BATTERY_STATE)
    space = joints.removesuffix('joint_states') if joints else f'{space}stage/'
    return Topics(imu, joints, info, temperature, supply, beside('command', JOINT_STATE))


def find_ideal(bag: Bag) -> Topics:
    """Find another simulator's specific force: the only topic of its type, or imu/data_raw."""
    topics = _imu_topics(bag)
    return Topics(topics[0] if len(topics) == 1 else _find_imu(bag, ''))


def _find_imu(bag: Bag, named: str) -> str:
    """Return the topic that the user has named, that of this package, or the only one."""
    topics = _imu_topics(bag)
    if not topics:
        held = ', '.join(f'{topic} ({kind})' for topic, kind in sorted(bag.types))
        raise UserError(f'{bag.path}: no topic of type {IMU}; it holds {held or "no messages"}'
                        + f'; {bag.cut}' * bool(bag.cut))
    if named:
        chosen = [topic for topic in topics if topic.strip('/') == named.strip('/')]
        if not chosen:
            raise UserError(f'{bag.path}: no topic {named} of type {IMU}; name one of '
                            f'{", ".join(topics)}')
        return chosen[0]
    own = _only(bag, 'imu/data_raw', IMU)
    if not own and len(topics) > 1:
        raise UserError(f'{bag.path}: several topics of type {IMU}, none of them imu/data_raw: '
                        f'{", ".join(topics)}; choose one: --topic {topics[0]}')
    return own or topics[0]


def _imu_topics(bag: Bag) -> list[str]:
    return sorted(topic for topic, kind in bag.types if kind == IMU)


def _only(bag: Bag, name: str, kind: str) -> str | None:
    """Return the topic of this name in any namespace; None if there is none."""
    topics = sorted(topic for topic, other in bag.types
                    if other == kind and f'/{topic}'.endswith(f'/{name}'))
    if len(topics) > 1:
        raise UserError(f'{bag.path}: several topics {name}: {", ".join(topics)}; record one '
                        f'sensor, or choose one: --topic {topics[0]}')
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
                raise UserError(f'{bag.path}: topic {topic}: {key} changes from {info[key]} to '
                                f'{new.get(key)}; record each sensor by itself')
        info = new
    if info.get('axes', 'x') not in MEASURED_AXES:
        raise UserError(f"{bag.path}: topic {topic}: axes is {info['axes']!r}, "
                        'expected x, xy or xyz')
    return info
