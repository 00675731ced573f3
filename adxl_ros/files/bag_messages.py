# SPDX-License-Identifier: Apache-2.0

"""
The messages of a rosbag2 recording, in any storage and compression.

The library rosbags reads the files. An MCAP file without its end, which a killed recorder leaves,
is read record by record up to the cut. metadata.yaml gives only the list of the files: a killed
recorder leaves none, and the bytes of files and messages show their compression.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager, ExitStack
from dataclasses import dataclass, replace
import os
from pathlib import Path
import re
import shutil
from tempfile import TemporaryDirectory
from typing import Any

from adxl_ros.errors import install_hint, one_line, UserError
from adxl_ros.files import mcap_file
from adxl_ros.files.mcap_file import collected_pieces, Piece, Raws
from adxl_ros.model.constants import MEASURED_AXES
import numpy as np
import yaml

_ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
"""First bytes of data that zstd compressed (RFC 8878, section 3.1.1)."""

_ENDINGS = ('.mcap', '.db3', '.mcap.zstd', '.db3.zstd')
"""Ends of the names of files in a recording's directory."""


class Bag:
    """An open recording."""

    def __init__(self, path: str, parts: list[Part], cut: str) -> None:
        """Take the files of a recording."""
        self.path = path  # The file or directory, for messages
        self.cut = cut  # Where damaged files end; empty if all are whole
        # Topics that hold messages, each with its type
        self.types: set[tuple[str, str]] = set().union(*(part.types for part in parts))
        self._parts = parts
        self._read = 0

    @property
    def done(self) -> float:
        """Fraction of the recording that has been read."""
        if self._read == len(self._parts):
            return 1.0
        return (self._read + self._parts[self._read].done) / len(self._parts)

    def pieces(self, topics: Collection[str]) -> Iterator[Piece]:
        """Yield the messages of some topics in pieces, in the order of recording."""
        self._read = 0
        for part in self._parts:
            for piece in part.pieces(topics):
                yield replace(piece, messages={topic: self._all_unpacked(topic, raws)
                                               for topic, raws in piece.messages.items()})
            self._read += 1

    def messages(self, topic: str) -> Iterator[bytes]:
        """Yield the CDR of each message of a topic, in the order of recording."""
        for piece in self.pieces([topic]):
            yield from map(bytes, piece.messages.get(topic, ()))

    def _all_unpacked(self, topic: str, raws: Raws) -> Raws:
        if isinstance(raws, np.ndarray):
            if not (raws[:, :len(_ZSTD_MAGIC)] == list(_ZSTD_MAGIC)).all(axis=1).any():
                return raws
            raws = [row.tobytes() for row in raws]
        return [self._unpacked(topic, raw) for raw in raws]

    def _unpacked(self, topic: str, raw: bytes) -> bytes:
        """Unpack a message of `--compression-mode message`: no CDR begins as packed data does."""
        try:
            return mcap_file.unpack('zstd', raw) if raw[:4] == _ZSTD_MAGIC else raw
        except ValueError as error:
            raise UserError(f'{self.path}: topic {topic}: {error}') from None


class _RosbagsPart:
    """A file that rosbags reads."""

    def __init__(self, path: Path, reader: Any) -> None:
        self.done = 0.0
        self.types = {(c.topic, c.msgtype) for c in reader.connections if c.msgcount}
        self._path = path
        self._reader = reader

    def _connections(self, topics: Collection[str]) -> list[Any]:
        """Return the connections of some topics; refuse those without CDR."""
        connections = [c for c in self._reader.connections if c.topic in topics and c.msgcount]
        for connection in connections:
            if connection.ext.serialization_format != 'cdr':
                raise UserError(f'{self._path}: topic {connection.topic} is serialized as '
                                f'{connection.ext.serialization_format}, expected cdr')
        return connections

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, bytes, int]]:
        connections = self._connections(topics)
        if not connections:
            return  # for rosbags, an empty choice means all connections
        share = 1 / sum(c.msgcount for c in connections)
        count = 0
        try:
            for connection, log_ns, raw in self._reader.messages(connections):
                count += 1
                self.done = count * share
                yield connection.topic, raw, log_ns
        except Exception as error:
            # In a damaged file, rosbags can raise errors of any kind.
            raise _unreadable(self._path, error) from error

    def pieces(self, topics: Collection[str]) -> Iterator[Piece]:
        storage = self._reader.storage
        names = {c.id: c.topic for c in self._connections(topics)}
        chunks = mcap_file.in_order(storage, names)
        if not chunks:
            yield from collected_pieces(self.messages(topics))
        for number, chunk in enumerate(chunks):
            self.done = (number + 1) / len(chunks)
            try:
                yield mcap_file.read_chunk(storage.bio, chunk, names)
            except Exception as error:
                # In a damaged file, rosbags can raise errors of any kind.
                raise _unreadable(self._path, error) from error


Part = _RosbagsPart | mcap_file.ScannedMcap
"""A file of a recording: its topics, how much of it was read, and its messages."""


def _unreadable(path: Path, error: Exception) -> UserError:
    """Return the error of a file that rosbags cannot read."""
    reason = one_line(error) or f'damaged ({type(error).__name__})'
    return UserError(f'{path}: cannot read it as a rosbag2 recording: {reason}')


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
    bag_path = Path(path)
    rosbag2 = import_rosbags()
    with ExitStack() as stack:
        parts: list[Part] = []
        cuts = []
        for name in _files(bag_path):
            file = _unzipped(stack, name) if name.suffix == '.zstd' else name
            part = _opened(stack, rosbag2, name, file)
            parts.append(part)
            if isinstance(part, mcap_file.ScannedMcap) and part.cut:
                cuts.append(f'{name}: {part.cut}')
        yield Bag(str(bag_path), parts, '; '.join(cuts))


def _opened(stack: ExitStack, rosbag2: Any, name: Path, file: Path) -> Part:
    """Open a file; `name` is its packed form, for messages. `stack` closes it."""
    is_mcap = file.suffix == '.mcap'
    if is_mcap and not mcap_file.is_whole(file):
        return stack.enter_context(mcap_file.open_scan(file))
    try:
        reader = stack.enter_context(rosbag2.Reader(file))
    except Exception as error:
        raise _unreadable(name, error) from error
    if is_mcap and not reader.storage.chunks:
        # Without an index, rosbags demands the messages of all topics in the order of time.
        return stack.enter_context(mcap_file.open_scan(file))
    return _RosbagsPart(name, reader)


def _unzipped(stack: ExitStack, path: Path) -> Path:
    """Unpack a file of `--compression-mode file`, up to its cut if it has one."""
    from backports import zstd
    folder = stack.enter_context(TemporaryDirectory())
    file = Path(folder, path.stem)
    try:
        with zstd.open(path, 'rb') as packed, open(file, 'wb') as unpacked:
            shutil.copyfileobj(packed, unpacked)
    except EOFError:
        pass  # the packed file is cut off; the unpacked one shows the cut again
    except (OSError, zstd.ZstdError) as error:
        raise _unreadable(path, error) from error
    return file


def _files(path: Path) -> list[Path]:
    """Return the files of a recording in the order of time, as metadata.yaml lists them."""
    if not path.is_dir():
        return [path]
    metadata = path / 'metadata.yaml'
    if not metadata.exists():
        files = sorted((file for file in path.iterdir() if file.name.endswith(_ENDINGS)),
                       key=_file_number)
        if not files:
            raise UserError(f'{path}: is a directory without metadata.yaml, .mcap or .db3 files; '
                            'expected a rosbag2 recording')
        return files
    try:
        with metadata.open('rb') as file:  # so that an error names it
            content = yaml.safe_load(file)
        names = content['rosbag2_bagfile_information']['relative_file_paths']
        files = [path / Path(name).name for name in names]
    except (OSError, ValueError, TypeError, KeyError, yaml.YAMLError) as error:
        raise UserError(f'{metadata}: does not list the files of a recording: '
                        f'{one_line(error)}; run ros2 bag reindex') from None
    missing = [file.name for file in files if not file.exists()]
    if missing or not files:
        raise UserError(f'{path}: metadata.yaml names {missing[0] if missing else "no file"}, '
                        'which is not there')
    return files


def _file_number(path: Path) -> tuple[int, str]:
    """Return a key that sorts name_10.mcap behind name_9.mcap, as ros2 bag numbers files."""
    number = re.search(r'_(\d+)\.(mcap|db3)', path.name)
    return (int(number[1]) if number else 0, path.name)


IMU = 'sensor_msgs/msg/Imu'
"""Type of the sensor's output."""

JOINT_STATE = 'sensor_msgs/msg/JointState'
"""Type of the positions and commands of the stage."""

DIAGNOSTIC_STATUS = 'diagnostic_msgs/msg/DiagnosticStatus'
"""Type of `sensor_info`."""

TEMPERATURE = 'sensor_msgs/msg/Temperature'
"""Type of the temperature."""

BATTERY_STATE = 'sensor_msgs/msg/BatteryState'
"""Type of the supply."""

_IDENTITY = ('serial', 'axes', 'nominal_zero_g_v', 'nominal_scale_v_per_g')
"""Keys of sensor_info that must not change within a recording."""


@dataclass(frozen=True)
class Topics:
    """Full names of the topics in a bag; None where the bag does not hold it."""

    imu: str  # The sensor's output
    joints: str | None = None  # Positions of the stage
    info: str | None = None  # What the sensor states of itself
    temperature: str | None = None
    supply: str | None = None
    command: str | None = None  # Commands of the stage

    def sampled(self) -> list[str]:
        """Return the topics to read sample by sample."""
        return [topic for topic in (self.imu, self.joints, self.temperature, self.supply,
                                    self.command) if topic]


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
    if named:
        same = {name: kind for name, kind in sorted(bag.types)
                if name.lstrip('/') == named.lstrip('/')}
        chosen = next((name for name in same if name in topics), None)
        if chosen is None:
            kinds = f'topic {named} is of type {", ".join(same.values())}, expected {IMU}' \
                if same else f'no topic {named}'
            raise UserError(f'{bag.path}: {kinds}; ' + (
                f'name one of {", ".join(topics)}' if topics else f'it holds {_contents(bag)}'))
        return chosen
    own = _only(bag, 'imu/data_raw', IMU)
    if own or len(topics) == 1:
        return own or topics[0]
    if topics:
        raise UserError(f'{bag.path}: several topics of type {IMU}, none of them imu/data_raw: '
                        f'{", ".join(topics)}; choose one: --topic {topics[0]}')
    raise UserError(f'{bag.path}: no topic of type {IMU}; it holds {_contents(bag)}')


def _imu_topics(bag: Bag) -> list[str]:
    return sorted(topic for topic, kind in bag.types if kind == IMU)


def _only(bag: Bag, name: str, kind: str) -> str | None:
    """Return the topic of this name in any namespace; None if there is none."""
    candidates = sorted(item for item in bag.types if f'/{item[0]}'.endswith(f'/{name}'))
    for topic, other in candidates:
        if other != kind:
            raise UserError(f'{bag.path}: topic {topic} is of type {other}, expected {kind}')
    if len(candidates) > 1:
        raise UserError(f'{bag.path}: several topics {name}: '
                        f'{", ".join(topic for topic, _ in candidates)}; record one sensor'
                        + f', or choose one: --topic {candidates[0][0]}' * (kind == IMU))
    return candidates[0][0] if candidates else None


def _contents(bag: Bag) -> str:
    """Return topics and types of a bag, and its cut, for messages."""
    listed = ', '.join(f'{topic} ({kind})' for topic, kind in sorted(bag.types))
    return (listed or 'no messages') + (f'; {bag.cut}' if bag.cut else '')


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
        try:
            message = types.deserialize_cdr(raw, DIAGNOSTIC_STATUS)
        except Exception as error:
            # In damaged bytes, the decoder of rosbags can raise errors of any kind.
            raise UserError(f'{bag.path}: topic {topic}: damaged message: {error}') from error
        new = {pair.key: pair.value for pair in message.values}
        for key in _IDENTITY:
            if info.get(key, new.get(key)) != new.get(key):
                raise UserError(f'{bag.path}: topic {topic}: {key} changes from {info[key]} to '
                                f'{new.get(key)}; record each sensor by itself')
        info = new
    if info.get('axes', 'x') not in MEASURED_AXES:
        raise UserError(f"{bag.path}: topic {topic}: axes is {info['axes']!r}, "
                        'expected x, xy or xyz')
    return info
