# SPDX-License-Identifier: Apache-2.0

"""Bags: the references are read first, then the sensor's samples in blocks, aligned with them."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping
from functools import partial
from itertools import chain
from typing import NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.files import cdr
from adxl_ros.files.atomic_write import AnyPath
from adxl_ros.files.bag_messages import (
    Bag,
    find_imu,
    find_topics,
    open_bag,
    Raws,
    read_info,
    Topics,
)
from adxl_ros.files.column_mapping import (
    AS_IT_IS,
    drop_samples,
    GRAVITY,
    LSB,
    Quantity,
    ReadingOptions,
    UNITS,
)
from adxl_ros.files.recording_columns import (
    ACCEL,
    COMMANDS,
    GYRO,
    JOINTS,
    LIMIT,
    limits,
    Recording,
)
from adxl_ros.files.reference_track import LONGEST_MOVE_NS, seconds, Track
from adxl_ros.files.stamp_check import StampCheck
from adxl_ros.model.constants import AXES, MEASURED_AXES
from adxl_ros.wording import option
import numpy as np

_ABSENT_VARIANCE = 1e5
"""Variance from which an axis counts as absent, (m/s²)²; absent axes are written with 1e6."""

_EXACT_NS = 1 << 53  # Largest time, ns, that float64 resolves to single nanoseconds


def blocks(
    path: AnyPath, rows: int, ideal: bool = False, reading: ReadingOptions = AS_IT_IS
) -> Generator[Recording, None, None]:
    """Read a bag in blocks of at most `rows` samples."""
    with open_bag(path) as bag:
        if reading.mapping is not None:
            raise UserError(
                f'{bag.path}: is a bag, which has no columns; leave {option("columns")} out: '
                f'{option("topic")} names a topic, and {option("unit")} states its unit'
            )
        topics = find_topics(bag, reading.topic, has_stage=not ideal)
        info = read_info(bag, topics.info)
        tracks = _tracks(bag, topics)
        commands = _commands(bag, topics)
        samples = _WaitingSamples(
            f'{bag.path}: topic {topics.imu}', AXES if ideal else info.get('axes'), reading
        )
        for piece in bag.pieces([topics.imu]):
            samples.add(piece.messages[topics.imu])
            while len(samples.waiting.stamp_ns) > rows:
                yield _block(bag, samples, tracks, commands, info, rows)
        if not samples.count:
            raise UserError(f'{samples.where}: holds no message')
        yield _block(bag, samples, tracks, commands, info, rows)


class _Rows(NamedTuple):
    """Some samples of the sensor."""

    stamp_ns: np.ndarray  # Stamps, ns, (n,)
    force_mps2: np.ndarray  # Specific force, m/s², (n, 3)
    gyro_radps: np.ndarray  # Angular velocity, rad/s, (n, 3)

    def part(self, rows: slice | np.ndarray) -> _Rows:
        """Return some of them."""
        return _Rows(self.stamp_ns[rows], self.force_mps2[rows], self.gyro_radps[rows])

    def followed_by(self, later: _Rows) -> _Rows:
        """Return these samples and later ones."""
        return _Rows(*map(np.concatenate, zip(self, later)))


class _WaitingSamples:
    """The sensor's samples that have been read but not yet handed on."""

    def __init__(self, where: str, axes: str | None, reading: ReadingOptions) -> None:
        self.where = where  # File and topic, for messages
        self.stamps = StampCheck(where, reading.drop_bad_stamps)
        # Measured axes; None before the first sample, if sensor_info does not state them
        self.axes = axes
        self.epoch_ns = 0  # Origin of the times, ns
        self.count = 0  # Messages so far
        self.incomplete = 0  # Those of them that were left out, because an axis has no number
        self.waiting = _Rows(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
        self.has_gyro = False  # Whether the messages state an angular velocity
        self._reading = reading
        self._unit = reading.unit or 'mps2'  # Unit of the accelerations of the topic
        if UNITS[Quantity.OUTPUT][self._unit].is_volts:
            raise UserError(
                f'{option(unit=self._unit)}: {where} has accelerations; write one of '
                f'{", ".join((*GRAVITY, LSB))}'
            )
        reading.check_counts(where, dict.fromkeys(ACCEL, self._unit))
        self._first_ns = 0

    def add(self, raws: Raws) -> None:
        """Decode and check further messages."""
        stamp_ns, columns = _columns(
            self.where,
            raws,
            cdr.imu,
            lambda table: {
                **dict(zip(ACCEL, table.numbers('linear_acceleration').T)),
                **dict(zip(GYRO, table.numbers('angular_velocity').T)),
            },
        )
        readings = np.column_stack([columns[name] for name in ACCEL])
        force_mps2 = self._reading.outputs(readings, 3 * [self._unit])
        gyro_radps = np.column_stack([columns[name] for name in GYRO])
        # A value beyond every gyroscope is no reading.
        gyro_radps[~(np.abs(gyro_radps) <= LIMIT)] = np.nan
        if not self.count:
            self._begin(raws[:1], int(stamp_ns[0]))
            self.has_gyro &= bool(gyro_radps.any())
        if self._reading.rate_hz is not None:
            number = self.count + np.arange(len(stamp_ns))
            since_first_ns = np.rint(number * 1e9 / self._reading.rate_hz)
            stamp_ns = self._first_ns + since_first_ns.astype(np.int64)
        rows = _Rows(stamp_ns, force_mps2, gyro_radps)
        is_kept = self._checked(rows)
        self.count += len(stamp_ns)
        self.waiting = self.waiting.followed_by(rows.part(is_kept))

    def _checked(self, rows: _Rows) -> np.ndarray:
        """Return which messages are samples, (n,); refuse those with values of no sensor."""
        stamp_ns, force_mps2, _ = rows

        def place(row: int) -> str:
            number = self.count + row + 1
            return f'{self.where}: message {number}, stamped {seconds(stamp_ns[row])}'

        is_sample = np.ones(len(stamp_ns), bool)
        if self._reading.drop_bad_samples:
            is_sample = np.isfinite(force_mps2).all(axis=1)
            self.incomplete += int((~is_sample).sum())
        is_kept = self.stamps.increasing((stamp_ns - self.epoch_ns) / 1e9, is_sample, place)
        wrong = is_kept[:, None] & ~(np.abs(force_mps2) <= LIMIT)
        if wrong.any():
            row, axis = np.argwhere(wrong)[0]
            value = force_mps2[row, axis]
            advice = '' if np.isfinite(value) else f'; {drop_samples()}'
            raise UserError(
                f'{place(row)}: linear_acceleration.{AXES[axis]} is {value:g} m/s², expected a '
                f'number within ±{LIMIT:g}{advice}'
            )
        return is_kept

    def take(self, rows: int) -> _Rows:
        """Take the first ones that wait."""
        taken = self.waiting.part(slice(rows))
        self.waiting = self.waiting.part(slice(rows, None))
        return taken

    @property
    def remarks(self) -> tuple[str, ...]:
        """Return what was left out, for people."""
        if not self.incomplete:
            return self.stamps.remarks
        return (
            f'{self.where}: left out, samples without a number on each axis: {self.incomplete}',
            *self.stamps.remarks,
        )

    def _begin(self, first: Raws, stamp_ns: int) -> None:
        """Take origin, axes and gyroscope of the first message."""
        self._first_ns = stamp_ns
        if stamp_ns > _EXACT_NS:
            self.epoch_ns = stamp_ns // 1_000_000_000 * 1_000_000_000
        table = next(cdr.tables(first, cdr.imu))
        # REP-145; messages that are all 0 are of a driver that never sets it.
        self.has_gyro = bool(table.numbers('angular_velocity_covariance')[0, 0] != -1)
        variance = table.numbers('linear_acceleration_covariance')[0, [0, 4, 8]]
        if self.axes is None:
            is_there = (variance < _ABSENT_VARIANCE) & (variance[0] != -1)
            self.axes = ''.join(np.array(list(AXES))[is_there])
        if self.axes not in MEASURED_AXES:
            raise UserError(
                f'{self.where}: linear_acceleration_covariance gives the axes '
                f'{self.axes or "none"}, expected x, xy or xyz; record sensor_info'
            )


Values = Callable[[cdr.MessageTable], Mapping[str, np.ndarray]]
"""Returns the columns of messages, (k,) each, by name."""


def _columns(
    where: str, raws: Raws, find: Callable[[bytes], cdr.Layout], values: Values
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return stamps, ns, (k,), and columns, (k,) each; NaN where a message has no value."""
    stamp_ns = np.empty(len(raws), np.int64)
    columns: dict[str, np.ndarray] = {}
    try:
        for table in cdr.tables(raws, find):
            stamp_ns[table.rows] = table.stamp_ns()
            for name, column in values(table).items():
                columns.setdefault(name, np.full(len(raws), np.nan))[table.rows] = column
    except cdr.CdrError as error:
        raise UserError(f'{where}: a message is damaged: {error}') from None
    return stamp_ns, columns


class Series(NamedTuple):
    """All k messages of a topic, by the time of their records."""

    stamp_ns: np.ndarray  # Stamps, ns, (k,)
    log_ns: np.ndarray  # Times of their records, ns, (k,), rising
    columns: dict[str, np.ndarray]  # Values by name, (k,); NaN where a message has none


def series(bag: Bag, topic: str, find: Callable[[bytes], cdr.Layout], values: Values) -> Series:
    """Return all messages of a topic."""
    where = f'{bag.path}: topic {topic}'
    logs = []
    stamps = []
    parts = []
    for piece in bag.pieces([topic]):
        stamp_ns, columns = _columns(where, piece.messages[topic], find, values)
        logs.append(piece.log_ns[topic])
        stamps.append(stamp_ns)
        parts.append(columns)
    log_ns = np.concatenate(logs)
    order = np.argsort(log_ns, kind='stable')  # A file that was cut off has no index by time
    joined = {}
    for name in dict.fromkeys(chain.from_iterable(parts)):
        known = [part.get(name, np.full(len(log), np.nan)) for part, log in zip(parts, logs)]
        joined[name] = np.concatenate(known)[order]
    return Series(np.concatenate(stamps)[order], log_ns[order], joined)


def positions(
    table: cdr.MessageTable, names: Mapping[str, str] | None = None
) -> dict[str, np.ndarray]:
    """Return the positions of joints by column, or of all joints by name."""
    if 'position' not in table.layout.fields:
        return {}
    values = dict(zip(table.joints, table.numbers('position').T))
    return (
        values
        if names is None
        else {column: values[joint] for joint, column in names.items() if joint in values}
    )


def _tracks(bag: Bag, topics: Topics) -> dict[str, Track]:
    """Return the references by column; none of a joint without a position."""

    def of_topic(
        topic: str | None,
        find: Callable[[bytes], cdr.Layout],
        values: Values,
        longest_ns: float = np.inf,
    ) -> dict[str, Track]:
        """Return the references of a topic, if there is one."""
        if topic is None:
            return {}
        where = f'{bag.path}: topic {topic}'
        return _tracks_of(where, series(bag, topic, find, values), longest_ns)

    return {
        **of_topic(
            topics.joints, cdr.joint_state, partial(positions, names=JOINTS), LONGEST_MOVE_NS
        ),
        **of_topic(
            topics.temperature,
            cdr.temperature,
            lambda table: {'temperature_c': table.numbers('temperature')[:, 0]},
        ),
        **of_topic(
            topics.supply,
            cdr.battery_state,
            lambda table: {'supply_v': table.numbers('voltage')[:, 0]},
        ),
    }


def _tracks_of(where: str, found: Series, longest_ns: float) -> dict[str, Track]:
    """Return the references of a topic by column; refuse values that none has."""
    tracks = {}
    for name, value in found.columns.items():
        lowest, highest = limits(name)
        wrong = (value < lowest) | (value > highest)
        if wrong.any():
            row = wrong.argmax()
            raise UserError(
                f'{where}: {name} is {value[row]:g} at {seconds(found.stamp_ns[row])}, '
                f'expected {lowest:g} to {highest:g}'
            )
        tracks[name] = Track(where, found.stamp_ns, value, longest_ns)
    return tracks


class _Commands(NamedTuple):
    """The k commands of a joint."""

    stamp_ns: np.ndarray  # Stamps, ns, (k,), rising
    position_rad: np.ndarray  # Positions, rad, (k,)


def _commands(bag: Bag, topics: Topics) -> dict[str, _Commands]:
    """
    Return the commands of joints by column.

    One without a stamp counts from the time of its record. A value that is no angle is left out,
    because the stage refuses it.
    """
    if not topics.command:
        return {}
    stamp_ns, log_ns, columns = series(
        bag, topics.command, cdr.joint_state, partial(positions, names=COMMANDS)
    )
    stamp_ns = np.where(stamp_ns == 0, log_ns, stamp_ns)
    commands = {}
    for name, value in columns.items():
        is_given = np.abs(value) <= LIMIT
        order = np.argsort(stamp_ns[is_given], kind='stable')
        commands[name] = _Commands(stamp_ns[is_given][order], value[is_given][order])
    return commands


def _block(
    bag: Bag,
    samples: _WaitingSamples,
    tracks: Mapping[str, Track],
    commands: Mapping[str, _Commands],
    info: Mapping[str, str],
    rows: int,
) -> Recording:
    """Take a block of waiting samples, with references and commands at their stamps."""
    stamp_ns, force_mps2, gyro_radps = samples.take(rows)
    columns = dict(zip(ACCEL[: len(samples.axes or '')], force_mps2.T.copy()))
    if samples.has_gyro:
        columns |= dict(zip(GYRO, gyro_radps.T.copy()))
    columns |= {name: track.interpolate(stamp_ns) for name, track in tracks.items()}
    alignments = {name: track.alignment for name, track in tracks.items()}
    for name, given in commands.items():
        # Each is in force until the next one; before the first it is NaN.
        latest = np.searchsorted(given.stamp_ns, stamp_ns, 'right') - 1
        columns[name] = np.append(given.position_rad, np.nan)[latest]
    # A division gives the float64 nearest to the decimal number, a product with 1e-9 does not.
    time_s = (stamp_ns - samples.epoch_ns) / 1e9
    cut = f'{bag.cut}; the last sample read is at {seconds(stamp_ns[-1])}' if bag.cut else ''
    return Recording(
        path=bag.path,
        time_s=time_s,
        columns=columns,
        info=dict(info),
        alignments=alignments,
        cut=cut,
        epoch_ns=samples.epoch_ns,
        done=bag.done,
        remarks=samples.remarks,
        bad_stamps=samples.stamps.bad,
    )


def log_times(path: AnyPath, topic: str) -> Iterator[np.ndarray]:
    """Yield header stamp and log time of the samples of a bag, ns, (k, 2), in blocks."""
    with open_bag(path) as bag:
        imu = find_imu(bag, topic)
        for piece in bag.pieces([imu]):
            stamp_ns, _ = _columns(
                f'{bag.path}: topic {imu}', piece.messages[imu], cdr.header, lambda table: {}
            )
            yield np.column_stack([stamp_ns, piece.log_ns[imu]])
