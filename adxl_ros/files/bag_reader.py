# SPDX-License-Identifier: Apache-2.0

"""Bags, read in blocks: the sensor's samples with references aligned with their stamps."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping
import itertools
import os
from pathlib import Path

from adxl_ros.errors import UserError
from adxl_ros.files import cdr
from adxl_ros.files.bag_messages import Bag, find_ideal, find_topics, open_bag, read_info, Topics
from adxl_ros.files.column_mapping import AS_IT_IS, ReadingOptions
from adxl_ros.files.mcap_file import Piece, Raws
from adxl_ros.files.recording_columns import (
    ACCEL,
    Alignment,
    BadStamps,
    COMMANDS,
    describe_bursts,
    JOINTS,
    LIMIT,
    Recording,
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
        _refuse_mapping(bag, reading)
        topics = find_ideal(bag) if ideal else find_topics(bag, reading.topic)
        info = read_info(bag, topics.info)
        samples = _Samples(f'{bag.path}: topic {topics.imu}', AXES if ideal else info.get('axes'),
                           reading)
        tracks = _tracks(bag, topics)
        commands = {column: Command() for column in COMMANDS.values() if topics.command}
        for batch, is_last in _batches(bag, topics, rows):
            samples.add(batch.messages.pop(topics.imu, []))
            if topics.command:
                _add_commands(f'{bag.path}: topic {topics.command}', commands,
                              batch.messages.pop(topics.command),
                              samples.arrived_ns[batch.samples_before])
            _add_references(bag, topics, tracks, batch.messages)
            ready = len(samples.stamp_ns) if is_last else samples.ready(tracks)
            for start in range(0, ready, rows):
                yield _block(bag, samples, tracks, commands, info,
                             slice(start, min(start + rows, ready)))
            samples.drop(ready)
    if not samples.count:
        raise UserError(f'{samples.where}: holds no message')


def _refuse_mapping(bag: Bag, reading: ReadingOptions) -> None:
    """Refuse options that only tables have."""
    if reading.mapping is not None:
        raise UserError(f'{reading.mapping.where}: {bag.path} is a bag, which has topics; name '
                        'one with --topic')
    if reading.lsb_per_g or reading.lsb_at_0g:
        raise UserError(f'--lsb-per-g: {bag.path} is a bag, whose readings are in m/s²')


class _Batch:
    """Messages in the order of recording."""

    def __init__(self, topics: Topics) -> None:
        self._topics = topics
        # Their bytes by topic, in parts
        self.messages: dict[str, list[Raws]] = {name: [] for name in topics.sampled()}
        # How many samples of the batch precede each command, (k,)
        self.samples_before: list[int] = []
        self.count = 0  # Samples of the batch

    def add(self, piece: Piece) -> None:
        """Append messages."""
        samples = piece.places.get(self._topics.imu, np.zeros(0, np.int64))
        commands = piece.places.get(self._topics.command or '')
        if commands is not None:
            self.samples_before += (self.count + np.searchsorted(samples, commands)).tolist()
        for topic, raws in piece.messages.items():
            if len(raws):
                self.messages[topic].append(raws)
        self.count += len(samples)


def _batches(bag: Bag, topics: Topics, rows: int) -> Iterator[tuple[_Batch, bool]]:
    """Yield batches, each with `rows` samples of the sensor, and whether it is the last."""
    batch = _Batch(topics)
    for piece in bag.pieces(topics.sampled()):
        while batch.count + len(piece.places.get(topics.imu, ())) >= rows:
            head, piece = piece.split(topics.imu, rows - batch.count)
            batch.add(head)
            yield batch, False
            batch = _Batch(topics)
        batch.add(piece)
    yield batch, True


class _Samples:
    """The sensor's samples that have been read but not yet handed on."""

    def __init__(self, where: str, axes: str | None, reading: ReadingOptions) -> None:
        self.where = where  # File and topic, for messages
        self._reading = reading
        self._first_ns = 0
        self.bad_stamps = BadStamps(0, 0)
        # Measured axes; None before the first sample, if sensor_info does not state them
        self.axes = axes
        self.epoch_ns = 0  # Origin of the times, ns
        self.count = 0  # Samples so far
        self.stamp_ns = np.zeros(0, np.int64)  # Stamps of the waiting samples, ns, (n,)
        self.accel = np.zeros((0, 3))  # Their specific force, m/s², (n, 3)
        # Stamps of the newest batch after the stamp of the sample before it, ns; 0 is none
        self.arrived_ns = np.zeros(1, np.int64)
        self._last_ns: int | None = None
        self._frame: str | None = None

    def add(self, parts: list[Raws]) -> None:
        """Decode and check further messages."""
        if not parts:
            self.arrived_ns = self.arrived_ns[-1:]
            return
        stamp_ns, accel = _values(self.where, parts, cdr.imu, 'linear_acceleration', 3,
                                  self._check_frame)
        size = len(stamp_ns)
        if self._last_ns is None:
            self._begin(parts[0][:1], int(stamp_ns[0]))
            self._first_ns = int(stamp_ns[0])
        if self._reading.rate_hz is not None:
            number = self.count + np.arange(size)
            stamp_ns = self._first_ns + np.rint(number * 1e9 / self._reading.rate_hz).astype(
                np.int64)
        self.arrived_ns = np.concatenate([self.arrived_ns[-1:], stamp_ns])
        is_kept = self._increasing(stamp_ns)
        stamp_ns, accel = stamp_ns[is_kept], accel[is_kept]
        self._last_ns = int(stamp_ns[-1]) if len(stamp_ns) else self._last_ns
        self._check_values(stamp_ns, accel)
        self.count += len(stamp_ns)
        self.stamp_ns = np.concatenate([self.stamp_ns, stamp_ns])
        self.accel = np.concatenate([self.accel, accel])

    @property
    def remarks(self) -> tuple[str, ...]:
        """Return what was left out, for people."""
        left_out = sum(self.bad_stamps)
        if not left_out:
            return ()
        return (f'{self.where}: left out, messages whose stamp does not increase: '
                f'{left_out}',)

    def _increasing(self, stamp_ns: np.ndarray) -> np.ndarray:
        """Return which stamps, ns, (n,), increase; refuse the others unless they are left out."""
        latest = np.maximum.accumulate(np.concatenate([
            [stamp_ns[0] - 1 if self._last_ns is None else self._last_ns], stamp_ns]))[:-1]
        is_kept = stamp_ns > latest
        if not is_kept.all() and not self._reading.drop_bad_stamps:
            i = int(is_kept.argmin())
            verb = 'stands still' if stamp_ns[i] == latest[i] else 'runs backwards'
            raise UserError(f'{self.where}: time {verb}: message {self.count + i + 1} is stamped '
                            f'{seconds(stamp_ns[i])} after {seconds(latest[i])}'
                            f'{describe_bursts((stamp_ns - stamp_ns[0]) / 1e9)}; '
                            '--drop-bad-stamps leaves such messages out')
        duplicates = int((stamp_ns == latest).sum())
        self.bad_stamps = BadStamps(
            self.bad_stamps.duplicates + duplicates,
            self.bad_stamps.backward + int((~is_kept).sum()) - duplicates)
        return is_kept

    def ready(self, tracks: dict[str, Track]) -> int:
        """Return how many samples have all their references; the last one always waits."""
        known_until_ns = min([track.known_until_ns for track in tracks.values()]
                             or [self.stamp_ns[-1]])
        count = int(np.searchsorted(self.stamp_ns, known_until_ns, 'right'))
        return max(min(count, len(self.stamp_ns) - 1), len(self.stamp_ns) - _HOLD_ROWS)

    def drop(self, count: int) -> None:
        """Forget the oldest samples."""
        self.stamp_ns, self.accel = self.stamp_ns[count:], self.accel[count:]

    def _begin(self, first: Raws, stamp_ns: int) -> None:
        if stamp_ns > _EXACT_NS:
            self.epoch_ns = stamp_ns // 1_000_000_000 * 1_000_000_000
        table = next(_tables(self.where, [first], cdr.imu))
        variance = table.numbers('linear_acceleration_covariance')[0, [0, 4, 8]]
        if variance[0] == -1:
            raise UserError(f'{self.where}: states no linear acceleration: '
                            'linear_acceleration_covariance[0] is -1')
        if self.axes is None:
            present = variance < _ABSENT_VARIANCE
            self.axes = ''.join(axis for axis, is_there in zip(AXES, present) if is_there)
        if self.axes not in MEASURED_AXES:
            raise UserError(f'{self.where}: linear_acceleration_covariance gives the axes '
                            f'{self.axes or "none"}, expected x, xy or xyz; record sensor_info')

    def _check_frame(self, table: cdr.Table) -> None:
        frame = table.layout.texts['frame_id']
        if self._frame not in (None, frame):
            raise UserError(f'{self.where}: frame_id changes from {self._frame!r} to {frame!r}; '
                            'record each sensor on a topic of its own')
        self._frame = frame

    def _check_values(self, stamp_ns: np.ndarray, accel: np.ndarray) -> None:
        wrong = ~(np.abs(accel) <= LIMIT)
        if wrong.any():
            i, axis = np.argwhere(wrong)[0].tolist()
            raise UserError(f'{self.where}: message {self.count + i + 1}, stamped '
                            f'{seconds(stamp_ns[i])}: linear_acceleration.{AXES[axis]} is '
                            f'{accel[i, axis]:g} m/s², expected a number within ±{LIMIT:g}')


def _tables(where: str, parts: list[Raws],
            find: Callable[[bytes], cdr.Layout]) -> Iterator[cdr.Table]:
    """Group messages by layout; a damaged one is an error that names file and topic."""
    try:
        yield from cdr.joined_tables(parts, find)
    except cdr.CdrError as error:
        raise UserError(f'{where}: a message is damaged: {error}') from None


def _values(where: str, parts: list[Raws], find: Callable[[bytes], cdr.Layout], name: str,
            size: int = 1, look: Callable[[cdr.Table], None] = lambda table: None
            ) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps, ns, (k,), and a field, (k, size), of messages; `look` sees each layout."""
    count = sum(map(len, parts))
    stamp_ns, values = np.empty(count, np.int64), np.empty((count, size))
    for table in _tables(where, parts, find):
        stamp_ns[table.rows] = table.stamp_ns()
        values[table.rows] = table.numbers(name)
        look(table)
    return stamp_ns, values


def _joints(where: str, parts: list[Raws], names: Mapping[str, str]
            ) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return stamps and positions by column; a joint that a message does not name is NaN there."""
    count = sum(map(len, parts))
    stamp_ns = np.empty(count, np.int64)
    values = {column: np.full(count, np.nan) for column in names.values()}
    for table in _tables(where, parts, cdr.joint_state):
        stamp_ns[table.rows] = table.stamp_ns()
        joints = [text for key, text in table.layout.texts.items() if key != 'frame_id']
        if 'position' in table.layout.fields:
            for joint, value in zip(joints, table.numbers('position').T):
                if joint in names:
                    values[names[joint]][table.rows] = value
    return {column: (stamp_ns, value) for column, value in values.items()}


_SCALARS = {'temperature_c': (cdr.temperature, 'temperature'),
            'supply_v': (cdr.battery_state, 'voltage')}
"""Layout and field of the messages of a reference that is one number."""


def _tracks(bag: Bag, topics: Topics) -> dict[str, Track]:
    """Return a track for each reference column that the bag can fill."""
    columns: dict[str, str | None] = dict.fromkeys(JOINTS.values(), topics.joints)
    columns.update(temperature_c=topics.temperature, supply_v=topics.supply)
    return {column: Track(f'{bag.path}: topic {topic}',
                          LONGEST_MOVE_NS if topic == topics.joints else np.inf)
            for column, topic in columns.items() if topic}


def _add_references(bag: Bag, topics: Topics, tracks: dict[str, Track],
                    messages: dict[str, list[Raws]]) -> None:
    """Decode the messages of references, by topic, and add them to the tracks of their columns."""
    for topic, parts in messages.items():
        where = f'{bag.path}: topic {topic}'
        if topic == topics.joints:
            columns = _joints(where, parts, JOINTS)
        else:
            column = 'temperature_c' if topic == topics.temperature else 'supply_v'
            stamp_ns, values = _values(where, parts, *_SCALARS[column])
            columns = {column: (stamp_ns, values[:, 0])}
        for column, (stamp_ns, value) in columns.items():
            wrong = np.abs(value) > LIMIT
            if wrong.any():
                raise UserError(f'{where}: {column} is {value[wrong.argmax()]:g} at '
                                f'{seconds(stamp_ns[wrong.argmax()])}, beyond ±{LIMIT:g}')
            tracks[column].add(stamp_ns, value)


def _add_commands(where: str, commands: dict[str, Command], parts: list[Raws],
                  arrived_ns: np.ndarray) -> None:
    """
    Add commands; one without a stamp counts from the newest sample that was recorded before it.

    A value that is no angle is left out, because the stage refuses it.
    """
    for column, (stamp_ns, value) in _joints(where, parts, COMMANDS).items():
        commands[column].add(np.where(stamp_ns == 0, arrived_ns, stamp_ns),
                             np.where(np.abs(value) <= LIMIT, value, np.nan))


def _block(bag: Bag, samples: _Samples, tracks: dict[str, Track], commands: dict[str, Command],
           info: dict[str, str], part: slice) -> Recording:
    """Make a block of waiting samples, with references and commands at their stamps."""
    stamp_ns = samples.stamp_ns[part]
    accel = samples.accel[part]
    columns = {name: np.ascontiguousarray(accel[:, i])
               for i, name in enumerate(ACCEL[:len(samples.axes or '')])}
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
                     bag.done, samples.remarks, samples.bad_stamps)


def drop_unsampled(recording: Recording) -> None:
    """Remove the columns of joints without a single position or command."""
    for column in (*JOINTS.values(), *COMMANDS.values()):
        if column in recording.columns and np.isnan(recording.columns[column]).all():
            del recording.columns[column]
            recording.alignments.pop(column, None)


_ROWS = 65536
"""Messages of a block (chosen: some MB)."""


def has_log_times(path: str | os.PathLike) -> bool:
    """Return whether a recording is a bag."""
    return Path(path).is_dir() or Path(path).suffix in ('.mcap', '.db3')


def log_times(path: str | os.PathLike, topic: str) -> Iterator[np.ndarray]:
    """Yield header stamp and log time of the samples of a bag, ns, (k, 2), in blocks."""
    with open_bag(path) as bag:
        imu = find_topics(bag, topic).imu
        messages = bag.logged_messages([imu])
        while block := list(itertools.islice(messages, _ROWS)):
            stamp_ns = np.empty(len(block), np.int64)
            for table in _tables(f'{bag.path}: topic {imu}', [[raw for _, raw, _ in block]],
                                 cdr.header):
                stamp_ns[table.rows] = table.stamp_ns()
            yield np.column_stack([stamp_ns, [log_ns for _, _, log_ns in block]])
