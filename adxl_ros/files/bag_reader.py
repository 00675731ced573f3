# SPDX-License-Identifier: Apache-2.0

"""Bags, read in blocks: the sensor's samples with references aligned with their stamps."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
import os
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files import cdr
from adxl_ros.files.bag_messages import (
    Bag,
    BATTERY_STATE,
    find_ideal,
    find_topics,
    JOINT_STATE,
    open_bag,
    read_info,
    TEMPERATURE,
    Topics,
)
from adxl_ros.files.column_mapping import AS_IT_IS, ReadingOptions
from adxl_ros.files.mcap_file import Piece, Raws
from adxl_ros.files.recording_columns import (
    ACCEL,
    Alignment,
    COMMANDS,
    JOINTS,
    LIMIT,
    Recording,
    StampCheck,
)
from adxl_ros.files.reference_alignment import Command, LONGEST_MOVE_NS, seconds, Track
from adxl_ros.model.constants import AXES, MEASURED_AXES
import numpy as np

_HOLD_ROWS = 1 << 19
"""Samples that wait for references; more samples go on without them (chosen: 17 MB)."""

_ABSENT_VARIANCE = 1e5
"""Variance from which an axis counts as absent, (m/s²)²; absent axes are written with 1e6."""

_EXACT_NS = 1 << 53
"""Largest time, ns, that float64 resolves to single nanoseconds."""


def blocks(path: str | os.PathLike, rows: int, ideal: bool = False,
           reading: ReadingOptions = AS_IT_IS) -> Generator[Recording, None, None]:
    """Read a bag in blocks of at most `rows` samples."""
    with open_bag(path) as bag:
        if reading.mapping is not None or reading.lsb_per_g or reading.lsb_at_0g:
            raise UserError(f'{bag.path}: is a bag, with topics in m/s²; leave --columns and '
                            '--lsb-per-g out, or name a topic with --topic')
        topics = find_ideal(bag) if ideal else find_topics(bag, reading.topic)
        info = read_info(bag, topics.info)
        samples = _Samples(f'{bag.path}: topic {topics.imu}', AXES if ideal else info.get('axes'),
                           reading)
        tracks, kinds = _tracks(bag, topics), dict(bag.types)
        commands = {column: Command() for column in COMMANDS.values() if topics.command}
        for pieces, is_last in _batches(bag, topics, rows, samples):
            for topic in topics.sampled():
                found = [piece for piece in pieces if len(piece.messages.get(topic, ()))]
                parts = [piece.messages[topic] for piece in found]
                where = f'{bag.path}: topic {topic}'
                if topic == topics.imu:
                    samples.add(parts)
                elif topic == topics.command:
                    _add_commands(where, commands, parts, [p.log_ns[topic] for p in found])
                else:
                    _add_references(where, _REFERENCES[kinds[topic]], parts, tracks)
            ready = len(samples.stamp_ns) if is_last else samples.ready(tracks) // rows * rows
            for start in range(0, ready, rows):
                yield _block(bag, samples, tracks, commands, info,
                             slice(start, min(start + rows, ready)))
            samples.drop(ready)
    if not samples.count:
        raise UserError(f'{samples.where}: holds no message')


def _batches(bag: Bag, topics: Topics, rows: int, samples: _Samples
             ) -> Iterator[tuple[list[Piece], bool]]:
    """Yield pieces that make a block with the waiting samples, and whether they are the last."""
    batch: list[Piece] = []
    count = 0
    for piece in bag.pieces(topics.sampled()):
        if len(samples.stamp_ns) % rows + count > rows:
            yield batch, False
            batch, count = [], 0
        batch.append(piece)
        count += len(piece.messages.get(topics.imu, ()))
    yield batch, True


class _Samples:
    """The sensor's samples that have been read but not yet handed on."""

    def __init__(self, where: str, axes: str | None, reading: ReadingOptions) -> None:
        self.where = where  # File and topic, for messages
        self.stamps = StampCheck(where, reading.drop_bad_stamps)
        # Measured axes; None before the first sample, if sensor_info does not state them
        self.axes = axes
        self.epoch_ns = 0  # Origin of the times, ns
        self.count = 0  # Messages so far
        self.stamp_ns = np.zeros(0, np.int64)  # Stamps of the waiting samples, ns, (n,)
        # Their specific force, m/s², (n,) by column
        self.force: dict[str, np.ndarray] = dict.fromkeys(ACCEL, np.zeros(0))
        self._rate_hz = reading.rate_hz
        self._first_ns = 0
        self._frame: str | None = None

    def add(self, parts: list[Raws]) -> None:
        """Decode and check further messages."""
        if not parts:
            return
        stamp_ns, force = _columns(self.where, parts, cdr.imu, ACCEL, self._force)
        if not self.count:
            self._begin(parts[0][:1], int(stamp_ns[0]))
        if self._rate_hz is not None:
            number = self.count + np.arange(len(stamp_ns))
            stamp_ns = self._first_ns + np.rint(number * 1e9 / self._rate_hz).astype(np.int64)

        def place(row: int) -> str:
            number = self.count + row + 1
            return f'{self.where}: message {number}, stamped {seconds(stamp_ns[row])}'

        is_kept = self.stamps.increasing((stamp_ns - self.epoch_ns) / 1e9,
                                         np.ones(len(stamp_ns), bool), place)
        for axis, values in zip(AXES, force.values()):
            wrong = is_kept & ~(np.abs(values) <= LIMIT)
            if wrong.any():
                raise UserError(f'{place(int(wrong.argmax()))}: linear_acceleration.{axis} is '
                                f'{values[wrong.argmax()]:g} m/s², expected a number within '
                                f'±{LIMIT:g}')
        self.count += len(stamp_ns)
        self.stamp_ns = np.concatenate([self.stamp_ns, stamp_ns[is_kept]])
        self.force = {name: np.concatenate([self.force[name], values[is_kept]])
                      for name, values in force.items()}

    def ready(self, tracks: dict[str, Track]) -> int:
        """Return how many samples have all their references; the last one always waits."""
        known_until_ns = min([track.known_until_ns for track in tracks.values()]
                             or [self.stamp_ns[-1]])
        count = int(np.searchsorted(self.stamp_ns, known_until_ns, 'right'))
        return max(min(count, len(self.stamp_ns) - 1), len(self.stamp_ns) - _HOLD_ROWS)

    def drop(self, count: int) -> None:
        """Forget the oldest samples."""
        self.stamp_ns = self.stamp_ns[count:]
        self.force = {name: values[count:] for name, values in self.force.items()}

    def _begin(self, first: Raws, stamp_ns: int) -> None:
        self._first_ns = stamp_ns
        if stamp_ns > _EXACT_NS:
            self.epoch_ns = stamp_ns // 1_000_000_000 * 1_000_000_000
        table = next(_tables(self.where, [first], cdr.imu))
        variance = table.numbers('linear_acceleration_covariance')[0, [0, 4, 8]]
        if self.axes is None:
            is_there = (variance < _ABSENT_VARIANCE) & (variance[0] != -1)
            self.axes = ''.join(np.array(list(AXES))[is_there])
        if self.axes not in MEASURED_AXES:
            raise UserError(f'{self.where}: linear_acceleration_covariance gives the axes '
                            f'{self.axes or "none"}, expected x, xy or xyz; record sensor_info')

    def _force(self, table: cdr.Table) -> dict[str, np.ndarray]:
        frame = table.layout.texts['frame_id']
        if self._frame not in (None, frame):
            raise UserError(f'{self.where}: frame_id changes from {self._frame!r} to {frame!r}; '
                            'record each sensor on a topic of its own')
        self._frame = frame
        return dict(zip(ACCEL, table.numbers('linear_acceleration').T))


def _tables(where: str, parts: list[Raws],
            find: Callable[[bytes], cdr.Layout]) -> Iterator[cdr.Table]:
    """Group messages by layout; a damaged one is an error that names file and topic."""
    try:
        yield from cdr.joined_tables(parts, find)
    except cdr.CdrError as error:
        raise UserError(f'{where}: a message is damaged: {error}') from None


def _columns(where: str, parts: list[Raws], find: Callable[[bytes], cdr.Layout],
             names: Iterable[str], values: Callable[[cdr.Table], Mapping[str, np.ndarray]]
             ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return stamps, ns, (k,), and columns, (k,) each; NaN where a message has no value."""
    count = sum(map(len, parts))
    stamp_ns = np.empty(count, np.int64)
    columns = {name: np.full(count, np.nan) for name in names}
    for table in _tables(where, parts, find):
        stamp_ns[table.rows] = table.stamp_ns()
        for name, column in values(table).items():
            if name in columns:
                columns[name][table.rows] = column
    return stamp_ns, columns


def _positions(table: cdr.Table, names: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Return the positions of joints by column."""
    if 'position' not in table.layout.fields:
        return {}
    joints = [text for key, text in table.layout.texts.items() if key != 'frame_id']
    return {names[joint]: values for joint, values in zip(joints, table.numbers('position').T)
            if joint in names}


_REFERENCES: Mapping[str, tuple[Any, ...]] = {
    JOINT_STATE: (cdr.joint_state, JOINTS.values(), lambda table: _positions(table, JOINTS)),
    TEMPERATURE: (cdr.temperature, ['temperature_c'],
                  lambda table: {'temperature_c': table.numbers('temperature')[:, 0]}),
    BATTERY_STATE: (cdr.battery_state, ['supply_v'],
                    lambda table: {'supply_v': table.numbers('voltage')[:, 0]}),
}
"""Layout, columns and values of the messages of a reference by their type."""


def _tracks(bag: Bag, topics: Topics) -> dict[str, Track]:
    """Return a track for each reference column that the bag can fill."""
    columns: dict[str, str | None] = dict.fromkeys(JOINTS.values(), topics.joints)
    columns.update(temperature_c=topics.temperature, supply_v=topics.supply)
    return {column: Track(f'{bag.path}: topic {topic}',
                          LONGEST_MOVE_NS if topic == topics.joints else np.inf)
            for column, topic in columns.items() if topic}


def _add_references(where: str, kind: tuple[Any, ...], parts: list[Raws],
                    tracks: dict[str, Track]) -> None:
    """Decode the messages of references, and add them to the tracks of their columns."""
    stamp_ns, columns = _columns(where, parts, *kind)
    for column, value in columns.items():
        wrong = np.abs(value) > LIMIT
        if wrong.any():
            raise UserError(f'{where}: {column} is {value[wrong.argmax()]:g} at '
                            f'{seconds(stamp_ns[wrong.argmax()])}, beyond ±{LIMIT:g}')
        tracks[column].add(stamp_ns, value)


def _add_commands(where: str, commands: dict[str, Command], parts: list[Raws],
                  log_ns: list[np.ndarray]) -> None:
    """
    Add commands; one without a stamp counts from the time of its record.

    A value that is no angle is left out, because the stage refuses it.
    """
    stamp_ns, columns = _columns(where, parts, cdr.joint_state, commands,
                                 lambda table: _positions(table, COMMANDS))
    for column, value in columns.items():
        if len(value):
            commands[column].add(np.where(stamp_ns == 0, np.concatenate(log_ns), stamp_ns),
                                 np.where(np.abs(value) <= LIMIT, value, np.nan))


def _block(bag: Bag, samples: _Samples, tracks: dict[str, Track], commands: dict[str, Command],
           info: dict[str, str], part: slice) -> Recording:
    """Make a block of waiting samples, with references and commands at their stamps."""
    stamp_ns = samples.stamp_ns[part]
    columns = {name: samples.force[name][part] for name in ACCEL[:len(samples.axes or '')]}
    alignments = {}
    for name, track in tracks.items():
        columns[name] = track.interpolate(stamp_ns)
        track.forget(int(stamp_ns[-1]))
        alignments[name] = Alignment(*track.alignment)
    for name, command in commands.items():
        columns[name] = command.in_force(stamp_ns)
        command.forget(int(stamp_ns[-1]))
    # A division gives the float64 nearest to the decimal number, a product with 1e-9 does not.
    time_s = (stamp_ns - samples.epoch_ns) / 1e9
    cut = f'{bag.cut}; the last sample read is at {seconds(stamp_ns[-1])}' if bag.cut else ''
    return Recording(bag.path, time_s, columns, dict(info), alignments, cut, samples.epoch_ns,
                     bag.done, samples.stamps.remarks, samples.stamps.bad)


def drop_unsampled(recording: Recording) -> None:
    """Remove the columns of joints without a single position or command."""
    for column in (*JOINTS.values(), *COMMANDS.values()):
        if column in recording.columns and np.isnan(recording.columns[column]).all():
            del recording.columns[column]
            recording.alignments.pop(column, None)


def log_times(path: str | os.PathLike, topic: str) -> Iterator[np.ndarray]:
    """Yield header stamp and log time of the samples of a bag, ns, (k, 2), in blocks."""
    with open_bag(path) as bag:
        imu = find_topics(bag, topic).imu
        for piece in bag.pieces([imu]):
            stamp_ns, _ = _columns(f'{bag.path}: topic {imu}', [piece.messages[imu]], cdr.header,
                                   (), lambda table: {})
            yield np.column_stack([stamp_ns, piece.log_ns[imu]])
