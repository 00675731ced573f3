# SPDX-License-Identifier: Apache-2.0

"""The reference, stage or simulator, of the newest time, and samples minus their prediction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum

from adxl_ros.diagnose.comparison import noiseless
from adxl_ros.files.recording_columns import JOINTS
from adxl_ros.model import noise
from adxl_ros.model.constants import MAD_TO_STD, NOMINAL_SUPPLY_V, NOMINAL_TEMPERATURE_C
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Concern
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from adxl_ros.simulate.motion import Held, INTERNAL_RATE_HZ, Motion, Path
from adxl_ros.simulate.response import Response
from adxl_ros.simulate.smoothed_paths import ForcePath, SmoothedPath
import numpy as np

BEFORE_NS = 2_000_000_000
"""Readings before a block that its path follows, ns. Chosen: many knots of the spline."""
AFTER_NS = 250_000_000
"""Readings after a block that its path needs, ns. Chosen: some knots of the spline, and more than
the delay of a sensor."""
_LONGEST_GAP_NS = 500_000_000
"""Longest time between readings that a path bridges, ns. Chosen: five readings at 10 Hz."""
_FEWEST = 6
"""Fewest readings of a path; a quintic spline needs them."""
_STILL_STEPS = 1.5
"""Change of a reading, in steps of the encoder, by which a resting joint may change. Chosen: a
reading between two steps changes by one."""
_STILL_RAD = 1e-4
"""The same for an exact encoder, rad and m. Chosen: 0.1 mg, as the noise of a mean of 1 s."""
_SURROUNDINGS_NS = 20_000_000_000
"""Time around a block whose temperatures and supplies count, ns. Chosen: slow thermometers."""
_STILL_MPS2 = 0.05
"""Range of the force of a simulator at rest, m/s². Chosen: noise of a simulator that adds some."""
_MOST_ROWS = 4_000_000
"""Largest number of rows in memory; chosen: an hour at 1 kHz, 130 MB with three columns."""
_FIRST_ROWS = 1024
"""Rows that have a place from the beginning; chosen."""
_OUTLIER = 6.0
"""Distance from the median, in standard deviations, from which a sample does not count in the mean
of a block. Chosen: one of 10⁹ samples of normal noise."""
_PARTS = 10
"""Most parts of a block. Chosen: a part of 0.1 s holds many time constants of a usual filter, and
a step is in one part."""
_FEWEST_OF_PART = 8
"""Fewest samples of a part; chosen: its variance is then known within a factor of two."""
_SMALLEST_MPS2 = 1e-9
"""Smallest standard deviation of a block, m/s²; a simulated sensor may have no noise."""


class StreamBuffer:
    """Keeps the newest rows of a stream; stamps ascend."""

    def __init__(self, columns: int, span_ns: int) -> None:
        self._span_ns = span_ns
        self._stamps = np.zeros(_FIRST_ROWS, np.int64)
        self._rows = np.zeros((_FIRST_ROWS, columns))
        self._begin = self._end = 0

    def __len__(self) -> int:
        """Return the number of rows."""
        return self._end - self._begin

    @property
    def newest_ns(self) -> int | None:
        """Return the newest stamp, ns; None without rows."""
        return int(self._stamps[self._end - 1]) if len(self) else None

    def add(self, stamp_ns: np.ndarray, rows: np.ndarray) -> int:
        """
        Append rows, and drop those whose stamp does not increase.

        stamp_ns: stamps, ns, (n,); rows: numbers, (n, k).
        """
        if not len(stamp_ns):
            return 0
        newest_ns = self.newest_ns
        before = np.concatenate([[stamp_ns[0] - 1 if newest_ns is None else newest_ns], stamp_ns])
        later = stamp_ns > np.maximum.accumulate(before)[:-1]
        stamps, rows = stamp_ns[later][-_MOST_ROWS:], rows[later][-_MOST_ROWS:]
        self._make_room(len(stamps))
        part = slice(self._end, self._end + len(stamps))
        self._stamps[part], self._rows[part] = stamps, rows
        self._end += len(stamps)
        return int((~later).sum())

    def between(self, begin_ns: int, end_ns: int) -> tuple[np.ndarray, np.ndarray]:
        """
        Return copies of the rows of a time.

        returns: stamps, ns, (n,), and rows, (n, k).
        """
        kept = self._stamps[self._begin:self._end]
        part = slice(*(self._begin + np.searchsorted(kept, [begin_ns, end_ns])))
        return self._stamps[part].copy(), self._rows[part].copy()

    def clear(self) -> None:
        """Forget all rows."""
        self._begin = self._end = 0

    def _make_room(self, count: int) -> None:
        """Forget old rows, and make room for new ones."""
        if self._end + count <= len(self._stamps):
            return
        newest_ns = self.newest_ns
        if newest_ns is not None:
            kept = self._stamps[self._begin:self._end]
            self._begin += int(np.searchsorted(kept, newest_ns - self._span_ns))
        self._begin = max(self._begin, self._end - (_MOST_ROWS - count))
        size = max(2 * (len(self) + count), _FIRST_ROWS)
        stamps = np.zeros(size, np.int64)
        rows = np.zeros((size, self._rows.shape[1]))
        stamps[:len(self)] = self._stamps[self._begin:self._end]
        rows[:len(self)] = self._rows[self._begin:self._end]
        self._stamps, self._rows, self._begin, self._end = stamps, rows, 0, len(self)


class ReferenceKind(Enum):
    """What the sensor is compared with."""

    STAGE = 'stage'
    IMU = 'imu'


@dataclass(frozen=True)
class BlockMotion:
    """What the reference shows of one block."""

    moves: bool  # Whether it moves
    # Standard deviation of the force by the steps of an encoder, m/s², (3,)
    error_mps2: np.ndarray


class ReferenceStream:
    """Follows the reference and the surroundings; `motion` is of the newest prepared block."""

    def __init__(self, kind: ReferenceKind, sensor: Sensor, span_ns: int) -> None:
        self.kind = kind  # As given
        self._sensor = sensor
        # Joints in the order of `JOINTS`, rad and m, or force, m/s²
        self.readings = StreamBuffer(3, span_ns)
        self.surroundings = {'temperature_c': StreamBuffer(1, span_ns),
                             'supply_v': StreamBuffer(1, span_ns)}
        self._held = np.zeros(3)
        self._origin_ns = 0
        self._paths: list[Path] = [Held(), Held(), Held()]
        self._force: ForcePath | None = None

    def add_joints(self, stamp_ns: int, positions: Mapping[str, float]) -> None:
        """Add one message of the stage."""
        values = np.array([positions.get(joint, held)
                           for joint, held in zip(JOINTS, self._held.tolist())])
        if np.isfinite(values).all():
            self._held = values
            self.add_readings(np.array([stamp_ns]), values[None])

    def add_readings(self, stamp_ns: np.ndarray, readings: np.ndarray) -> None:
        """
        Add readings; stamps that jump back begin a new reference.

        stamp_ns: stamps, ns, (n,); readings: joints, rad and m, or force, m/s², (n, 3).
        """
        finite = np.isfinite(readings).all(axis=1)
        stamp_ns, readings = stamp_ns[finite], readings[finite]
        newest_ns = self.readings.newest_ns
        if len(stamp_ns) and newest_ns is not None \
                and stamp_ns[-1] < newest_ns - _LONGEST_GAP_NS:
            self.readings.clear()
        self.readings.add(stamp_ns, readings)

    def add_surroundings(self, name: str, stamp_ns: int, value: float) -> None:
        """Add a temperature or a supply."""
        if np.isfinite(value):
            buffer = self.surroundings[name]
            newest_ns = buffer.newest_ns
            if newest_ns is not None and stamp_ns < newest_ns - BEFORE_NS:
                buffer.clear()
            buffer.add(np.array([stamp_ns]), np.array([[value]]))

    def motion(self, origin_ns: int) -> Motion:
        """Return the motion whose time begins at a stamp, ns; it follows the prepared blocks."""
        self._origin_ns = origin_ns
        temperature_c = _Surrounding(self, 'temperature_c', NOMINAL_TEMPERATURE_C)
        supply_v = _Surrounding(self, 'supply_v', NOMINAL_SUPPLY_V)
        if self.kind is ReferenceKind.IMU:
            return Motion(np.inf, force=self._force_at, internal_rate_hz=max(
                INTERNAL_RATE_HZ, self._sensor.rate_hz), temperature_c=temperature_c,
                          supply_v=supply_v)
        alpha, beta, shift = (_Joint(self, joint) for joint in range(3))
        return Motion(np.inf, alpha, beta, shift, temperature_c=temperature_c, supply_v=supply_v)

    def prepare(self, begin_ns: int, end_ns: int) -> BlockMotion | None:
        """Make the paths of a block."""
        stamps_ns, readings = self.readings.between(begin_ns - BEFORE_NS, end_ns + AFTER_NS)
        first = max(int(np.searchsorted(stamps_ns, begin_ns, 'right')) - 1, 0)
        gaps_ns = np.diff([begin_ns, *stamps_ns[first:], end_ns])
        if len(stamps_ns) < _FEWEST or gaps_ns.max() > _LONGEST_GAP_NS:
            return None
        time_s = (stamps_ns - self._origin_ns) * 1e-9
        changes = np.ptp(readings[first:], axis=0)
        if self.kind is ReferenceKind.IMU:
            self._force = ForcePath(time_s, readings)
            return BlockMotion(bool((changes > _STILL_MPS2).any()), np.zeros(3))
        step_rad = self._sensor.stage_resolution_rad
        self._paths = [SmoothedPath(time_s, values, step)
                       for values, step in zip(readings.T, (step_rad, step_rad, 0.0))]
        largest = max(_STILL_STEPS * step_rad, _STILL_RAD)
        return BlockMotion(bool((changes > largest).any()), self._encoder_error_mps2(
            (begin_ns - self._origin_ns) * 1e-9, (end_ns - self._origin_ns) * 1e-9))

    def path(self, joint: int) -> Path:
        """Return the path of a joint in the newest prepared block."""
        return self._paths[joint]

    def _encoder_error_mps2(self, begin_s: float, end_s: float) -> np.ndarray:
        """Return what the steps of the encoder make of the force in a block, m/s², (3,)."""
        time_s = np.linspace(begin_s, end_s, 3)
        gravity_mps2 = self._sensor.local_gravity_mps2
        alpha, beta = (path(time_s) for path in self._paths[:2])
        alpha_std, beta_std = (_path_std(path, time_s) for path in self._paths[:2])
        force = np.array(specific_force(alpha, beta, gravity_mps2))
        by_alpha = np.array(specific_force(alpha + alpha_std, beta, gravity_mps2)) - force
        by_beta = np.array(specific_force(alpha, beta + beta_std, gravity_mps2)) - force
        return np.asarray(np.sqrt((by_alpha ** 2 + by_beta ** 2).mean(axis=1)))

    def _force_at(self, time_s: np.ndarray) -> list[np.ndarray]:
        """Return the force of a simulator at times, s, (n,): three components, m/s²."""
        assert self._force is not None, 'a block is prepared before it is simulated'
        return list(self._force(time_s))

    def surrounding(self, name: str, time_s: np.ndarray, default: float) -> np.ndarray:
        """
        Return the temperature or the supply at times.

        time_s: times of the motion, s, (n,); returns: values, (n,).
        """
        buffer = self.surroundings[name]
        if not len(buffer):
            return np.full(len(time_s), default)
        at_ns = self._origin_ns + time_s * 1e9
        stamps_ns, values = buffer.between(int(at_ns[0]) - _SURROUNDINGS_NS,
                                           int(at_ns[-1]) + _SURROUNDINGS_NS)
        if not len(stamps_ns):
            newest_ns = buffer.newest_ns or 0
            stamps_ns, values = buffer.between(newest_ns, newest_ns + 1)
        return np.interp(at_ns, stamps_ns, values[:, 0])


def _path_std(path: Path, time_s: np.ndarray) -> np.ndarray:
    """Return the standard deviation of a path at times, s, (n,), by the steps of its encoder."""
    errors = path.errors(time_s) if isinstance(path, SmoothedPath) else None
    return np.zeros(len(time_s)) if errors is None else errors.std


@dataclass(frozen=True)
class _Surrounding:
    """Temperature or supply over time."""

    stream: ReferenceStream
    name: str
    default: float

    def __call__(self, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        """Return the values at times, s, (n,)."""
        return self.stream.surrounding(self.name, time_s, self.default)


@dataclass(frozen=True)
class _Joint:
    """The path of one joint, which changes from block to block."""

    stream: ReferenceStream
    joint: int

    def __call__(self, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        """Return a derivative; see `simulate.motion.Path`."""
        return self.stream.path(self.joint)(time_s, order)


@dataclass(frozen=True)
class Block:
    """The comparison of one block; m axes."""

    end_ns: int  # End of the block, ns
    mean_mps2: np.ndarray  # Mean of the residual without outliers, m/s², (m,)
    square: np.ndarray  # Mean square of the residual, (m/s²)², (m,)
    # Mean square about the mean, with its lost degrees of freedom, (m/s²)², (m,)
    noise_square: np.ndarray
    # Logarithm of the standard deviation within short parts of the block, (m,): a step of the mean
    # hardly changes it
    log_noise: np.ndarray
    # Mean square of the residual to the sensor without effects, (m/s²)², (m,)
    datasheet_square: np.ndarray
    # Mean square of the force by the steps of an encoder, (m/s²)², (m,)
    reference_square: np.ndarray
    moves: bool  # Whether the reference moves


class Prediction:
    """The output of a sensor on the reference, from block to block."""

    def __init__(self, sensor: Sensor, reference: ReferenceStream) -> None:
        stage = [name for name in sensor.effects if _needs_stage(name)]
        # Effects that need the angles of a stage, which the reference has not
        self.left_out = tuple(stage) if reference.kind is ReferenceKind.IMU else ()
        effects = tuple(name for name in sensor.effects if name not in self.left_out)
        self._sensor, self._reference = sensor, reference
        self._modelled = noiseless(replace(sensor, effects=effects))
        self._datasheet = noiseless(replace(sensor, effects=(), values={}))
        self._responses: tuple[Response, Response] | None = None
        self._origin_ns = 0

    def restart(self) -> None:
        """Let the next block be the first one."""
        self._responses = None

    @property
    def is_running(self) -> bool:
        """Return whether a block has been predicted since the last start."""
        return self._responses is not None

    def start(self, begin_ns: int) -> None:
        """Put the sensors, settled, at the begin of a block, ns; it is to be prepared then."""
        self._origin_ns = begin_ns
        self._motion = self._reference.motion(begin_ns)

    def block(self, stamp_ns: np.ndarray, accel_mps2: np.ndarray, motion: BlockMotion,
              end_ns: int) -> Block:
        """
        Compare the samples of one prepared block.

        stamp_ns: stamps, ns, (n,); accel_mps2: samples by nominal conversion, m/s², (n, m).
        """
        if self._responses is None:
            self._responses = (Response(self._modelled, self._motion, 0),
                               Response(self._datasheet, self._motion, 0))
        time_s = (stamp_ns - self._origin_ns) * 1e-9
        modelled, datasheet = (accel_mps2 - to_nominal_mps2(respond(time_s), self._sensor)
                               for respond in self._responses)
        mean_mps2 = _clean_mean(modelled)
        count = len(stamp_ns)
        independent = float(noise.effective_samples(count, 1 / self._sensor.rate_hz,
                                                    self._sensor.rc_s))
        freedom = max(1 - 1 / max(independent, 1.0), 0.5)
        return Block(
            end_ns, mean_mps2, (modelled ** 2).mean(axis=0),
            modelled.var(axis=0) / freedom + _SMALLEST_MPS2 ** 2, _log_noise(modelled),
            (datasheet ** 2).mean(axis=0), motion.error_mps2[:len(mean_mps2)] ** 2, motion.moves)


def _needs_stage(name: str) -> bool:
    """Return whether an effect needs the angles of a stage."""
    effect = effect_named(name)
    return effect.concern is Concern.STAGE


def _log_noise(residual: np.ndarray) -> np.ndarray:
    """Return the log of the median standard deviation of parts of columns, (n, m), (m,)."""
    parts = np.array_split(residual, max(min(_PARTS, len(residual) // _FEWEST_OF_PART), 1))
    variances = np.median([part.var(axis=0) for part in parts], axis=0)
    return np.asarray(0.5 * np.log(variances + _SMALLEST_MPS2 ** 2))


def _clean_mean(residual: np.ndarray) -> np.ndarray:
    """Return the means of columns, (n, m), without outliers, (m,)."""
    centre = np.median(residual, axis=0)
    distance = np.abs(residual - centre)
    limit = _OUTLIER * MAD_TO_STD * np.median(distance, axis=0) + _SMALLEST_MPS2
    counts = distance <= limit
    return np.asarray((residual * counts).sum(axis=0) / counts.sum(axis=0))
