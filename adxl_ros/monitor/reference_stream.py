# SPDX-License-Identifier: Apache-2.0

"""The reference, stage, simulator or robot, of the newest time, and samples minus prediction."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from itertools import takewhile

from adxl_ros.files.recording_columns import JOINTS
from adxl_ros.files.robot_readings import JointTrack, RobotReadings
from adxl_ros.model import noise
from adxl_ros.model.constants import NOMINAL_SUPPLY_V, NOMINAL_TEMPERATURE_C
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Concern
from adxl_ros.model.kinematics import gravity_slopes
from adxl_ros.model.sensor import noiseless, Sensor, to_nominal_mps2
from adxl_ros.simulate.motion import ForcePath, Held, INTERNAL_RATE_HZ, Motion, Path
from adxl_ros.simulate.response import Response
from adxl_ros.simulate.robot import Robot, RobotPath
from adxl_ros.simulate.smoothed_path import SmoothedPath
import numpy as np
import scipy

BEFORE_NS = 2_000_000_000
"""Readings before a block that its path follows, ns. Chosen: many knots of the spline."""
AFTER_NS = 250_000_000
"""Readings after a block that its path needs, ns. Chosen: some knots of the spline, and more than
the delay of a sensor."""
_LONGEST_GAP_NS = 500_000_000
"""Longest time between readings that a path bridges, ns. Chosen: five readings at 10 Hz."""
_FEWEST = 6  # Fewest readings of a path; a quintic spline needs them
_STILL_STEPS = 1.5
"""Change of a reading, in steps of the encoder, by which a resting joint may change. Chosen: a
reading between two steps changes by one."""
_STILL_RAD = 1e-4
"""The same for an exact encoder, rad and m. Chosen: 0.1 mg, as the noise of a mean of 1 s."""
_SURROUNDINGS_NS = 20_000_000_000
"""Time around a block whose temperatures and supplies count, ns. Chosen: slow thermometers."""
_USUAL = {'temperature_c': NOMINAL_TEMPERATURE_C, 'supply_v': NOMINAL_SUPPLY_V}
"""Surroundings by their columns, and their values where nobody publishes them."""
_STILL_MPS2 = 0.05
"""Range of the force of a simulator at rest, m/s². Chosen: noise of a simulator that adds some."""
_MOST_ROWS = 4_000_000
"""Largest number of rows in memory; chosen: an hour at 1 kHz, 130 MB with three columns."""
_TRIMMED = 0.05
"""Share of the samples on each side that does not count in the mean of a block. Chosen: spikes are
rarer, and the mean of normal noise is as good within 2 %."""
_PARTS = 10
"""Most parts of a block. Chosen: a part of 0.1 s holds many time constants of a usual filter, and
a step is in one part."""
_FEWEST_OF_PART = 8
"""Fewest samples of a part; chosen: its variance is then known within a factor of two."""
_ROBOT_NS = 1_000_000_000
"""Time whose forces of a robot are computed at once, ns: that of a block, so that each is computed
once."""
_MARGIN_NS = 500_000_000
"""Time of further readings on both sides, ns. Chosen: the ends of the splines then add less than a
tenth to the error."""
_HISTORY_NS = 10_000_000_000
"""Time of readings by which a robot is smoothed, ns. Chosen: a joint moves at some time in it."""
_GRID_NS = 4_000_000
"""Distance of the forces of a robot, ns. Chosen: an encoder shows nothing faster."""
_SMALLEST_MPS2 = 1e-9
"""Smallest standard deviation of a block, m/s²; a simulated sensor may have no noise."""
BlockMotion = tuple[bool, np.ndarray]
"""Whether the reference moves in a block, and what its encoders make of the force, m/s², (3,)."""


class StreamBuffer:
    """Keeps the newest rows of a stream, in the pieces in which they came; stamps ascend."""

    def __init__(self, columns: int, span_ns: int) -> None:
        self._span_ns = span_ns
        self._rows = 0
        # It gives parts without rows their shape.
        self._nothing = np.zeros(0, np.int64), np.zeros((0, columns))
        self._pieces: deque[tuple[np.ndarray, np.ndarray]] = deque()

    @property
    def newest_ns(self) -> int | None:
        """Return the newest stamp, ns; None without rows."""
        return int(self._pieces[-1][0][-1]) if self._pieces else None

    def add(self, stamp_ns: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Append rows, (n, k), whose stamps, ns, (n,), increase; return these stamps."""
        newest_ns = np.iinfo(np.int64).min if self.newest_ns is None else self.newest_ns
        later = stamp_ns > np.maximum.accumulate(np.append(newest_ns, stamp_ns))[:-1]
        stamp_ns = stamp_ns[later]
        rows = rows[later]
        if len(stamp_ns):
            self._pieces.append((stamp_ns, rows))
            self._rows += len(stamp_ns)
            while self._pieces[0][0][-1] < stamp_ns[-1] - self._span_ns or self._rows > max(
                _MOST_ROWS, len(stamp_ns)
            ):
                self._rows -= len(self._pieces.popleft()[0])
        return stamp_ns

    def between(self, begin_ns: int, end_ns: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the stamps, ns, (n,), and rows, (n, k), of a time."""
        pieces = [*takewhile(lambda piece: piece[0][-1] >= begin_ns, reversed(self._pieces))]
        stamps, rows = map(np.concatenate, zip(self._nothing, *pieces[::-1]))
        part = slice(*np.searchsorted(stamps, [begin_ns, end_ns]))
        return stamps[part], rows[part]

    def clear(self) -> None:
        """Forget all rows."""
        self._pieces.clear()
        self._rows = 0


class ReferenceKind(Enum):
    """What the sensor is compared with."""

    STAGE = 'stage'
    IMU = 'imu'
    ROBOT = 'robot'


class ReferenceStream:
    """Follows the reference and the surroundings; `motion` is of the newest prepared block."""

    def __init__(self, kind: ReferenceKind, sensor: Sensor, span_ns: int) -> None:
        self.kind = kind  # As given
        self._sensor = sensor
        # Joints in the order of `JOINTS`, rad and m, or force, m/s²
        self.readings = StreamBuffer(3, span_ns)
        self.surroundings = {name: StreamBuffer(1, span_ns) for name in _USUAL}
        self.error_mps2 = np.zeros(3)  # Standard deviation of the newest forces by their source
        self._held = [0.0, 0.0, 0.0]
        self._origin_ns = 0
        self._paths: list[Path] = [Held(), Held(), Held()]
        self._force: ForcePath

    def add_joints(
        self, stamps_ns: Sequence[int], positions: Sequence[Mapping[str, float]]
    ) -> None:
        """Add messages of the stage; a joint that one does not name is where it was before."""
        rows = []
        for position in positions:
            values = list(map(position.get, JOINTS, self._held))
            self._held = values if np.isfinite(values).all() else self._held
            rows.append(values)
        self.add_readings(np.array(stamps_ns, np.int64), np.array(rows).reshape(-1, len(JOINTS)))

    def add_readings(self, stamp_ns: np.ndarray, readings: np.ndarray) -> None:
        """Add joints, rad and m, or force, m/s², (n, 3), with their stamps, ns, (n,)."""
        _add_finite(self.readings, stamp_ns, readings, _LONGEST_GAP_NS)

    def add_surroundings(self, name: str, stamp_ns: np.ndarray, values: np.ndarray) -> None:
        """Add temperatures or supplies, (n, 1), with their stamps, ns, (n,)."""
        _add_finite(self.surroundings[name], stamp_ns, values, BEFORE_NS)

    def motion(self, origin_ns: int) -> Motion:
        """Return the motion whose time begins at a stamp, ns; it follows the prepared blocks."""
        self._origin_ns = origin_ns
        motion = Motion(
            duration_s=np.inf,
            alpha=partial(self._joint, 0),
            beta=partial(self._joint, 1),
            shift=partial(self._joint, 2),
            temperature_c=partial(self._surrounding, 'temperature_c'),
            supply_v=partial(self._surrounding, 'supply_v'),
        )
        if self.kind is ReferenceKind.STAGE:
            return motion
        return replace(
            motion,
            force=lambda time_s: self._force(time_s),
            internal_rate_hz=max(INTERNAL_RATE_HZ, self._sensor.rate_hz),
        )

    def prepare(self, begin_ns: int, end_ns: int) -> BlockMotion | None:
        """Make the paths of a block."""
        stamps_ns, readings = self.readings.between(begin_ns - BEFORE_NS, end_ns + AFTER_NS)
        first = max(int(np.searchsorted(stamps_ns, begin_ns, 'right')) - 1, 0)
        gaps_ns = np.diff([begin_ns, *stamps_ns[first:], end_ns])
        if len(stamps_ns) < _FEWEST or gaps_ns.max() > _LONGEST_GAP_NS:
            return None
        time_s = (stamps_ns - self._origin_ns) * 1e-9
        changes = np.ptp(readings[first:], axis=0)
        if self.kind is not ReferenceKind.STAGE:
            self._force = ForcePath(time_s, readings)
            return bool((changes > _STILL_MPS2).any()), self.error_mps2
        step_rad = self._sensor.stage_resolution_rad
        self._paths = [
            SmoothedPath(time_s, values, step)
            for values, step in zip(readings.T, (step_rad, step_rad, 0.0))
        ]
        largest = max(_STILL_STEPS * step_rad, _STILL_RAD)
        time_s = (np.linspace(begin_ns, end_ns, 3) - self._origin_ns) * 1e-9
        alpha = self._paths[0](time_s)
        beta = self._paths[1](time_s)
        stds = [
            errors.std
            if isinstance(path, SmoothedPath) and (errors := path.errors(time_s))
            else 0.0
            for path in self._paths[:2]
        ]
        squares = np.sum(
            [(slope * std) ** 2 for slope, std in zip(gravity_slopes(alpha, beta), stds)], axis=0
        )
        return bool((changes > largest).any()), self._sensor.local_gravity_mps2 * np.sqrt(
            squares.mean(axis=1)
        )

    def _joint(self, number: int, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        return self._paths[number](time_s, order)

    def _surrounding(self, name: str, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        """Return the temperature or the supply at times of the motion, s, (n,)."""
        buffer = self.surroundings[name]
        if buffer.newest_ns is None:
            return np.full(len(time_s), _USUAL[name])
        at_ns = self._origin_ns + time_s * 1e9
        stamps_ns, values = buffer.between(
            min(int(at_ns[0]) - _SURROUNDINGS_NS, buffer.newest_ns),
            max(int(at_ns[-1]) + _SURROUNDINGS_NS, buffer.newest_ns + 1),
        )
        return np.interp(at_ns, stamps_ns, values[:, 0])


class RobotForce:
    """Turns the joint readings of a robot with a base at rest into the force in one frame."""

    def __init__(self, robot: Robot, gravity_mps2: float) -> None:
        self._robot = robot
        self._gravity_mps2 = gravity_mps2
        self._joints = StreamBuffer(len(robot.joints), _HISTORY_NS)
        self._given_ns = 0  # Newest stamp whose force was returned

    def add(self, stamps_ns: Sequence[int], positions: Sequence[Mapping[str, float]]) -> None:
        """Add messages; those that do not name all joints of the robot are another device's."""
        named = [
            (stamp_ns, [position[joint] for joint in self._robot.joints])
            for stamp_ns, position in zip(stamps_ns, positions)
            if set(self._robot.joints) <= set(position)
        ]
        if named:
            stamp_ns, rows = zip(*named)
            _add_finite(self._joints, np.array(stamp_ns), np.array(rows), _LONGEST_GAP_NS)

    def send(self, reference: ReferenceStream) -> None:
        """Give the force of the newest second, once it is complete, and its error."""
        newest_ns = self._joints.newest_ns
        if newest_ns is None:
            return
        stamp_ns, rows = self._joints.between(newest_ns - _HISTORY_NS, newest_ns + 1)
        begin_ns = max(
            self._given_ns if self._given_ns < newest_ns else 0, int(stamp_ns[0]) + _MARGIN_NS
        )
        at_ns = _GRID_NS * np.arange(
            -(-begin_ns // _GRID_NS), (newest_ns - _MARGIN_NS) // _GRID_NS
        )
        if len(at_ns) * _GRID_NS < _ROBOT_NS:
            return
        time_s = (stamp_ns - begin_ns) * 1e-9
        path = RobotPath(
            self._robot,
            RobotReadings(
                'the robot',
                {
                    name: JointTrack(time_s, values)
                    for name, values in zip(self._robot.joints, rows.T)
                },
            ),
            self._gravity_mps2,
            since_s=-0.1,
        )
        inside = (path.time_s > 0) & (path.time_s < time_s[-1] - 1e-9 * _MARGIN_NS)
        self._given_ns = int(at_ns[-1]) + _GRID_NS
        reference.error_mps2 = np.sqrt(np.mean(path.error_mps2[inside] ** 2, axis=0))
        reference.add_readings(at_ns, np.column_stack(path((at_ns - begin_ns) * 1e-9)))


def _add_finite(
    buffer: StreamBuffer, stamp_ns: np.ndarray, rows: np.ndarray, longest_ns: int
) -> None:
    """Add the finite rows; stamps that jump back by more than a time begin a new stream."""
    finite = np.isfinite(rows).all(axis=1)
    stamp_ns = stamp_ns[finite]
    newest_ns = buffer.newest_ns
    if len(stamp_ns) and newest_ns is not None and stamp_ns[-1] < newest_ns - longest_ns:
        buffer.clear()
    buffer.add(stamp_ns, rows[finite])


@dataclass(frozen=True)
class ComparedBlock:
    """The comparison of one block; m axes."""

    end_ns: int  # End of the block, ns
    mean_mps2: np.ndarray  # Trimmed mean of the residual, m/s², (m,)
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
        # Effects that need the angles of a stage, which the reference has not
        self.left_out: tuple[str, ...] = ()
        if reference.kind is not ReferenceKind.STAGE:
            self.left_out = tuple(
                name for name in sensor.effects if effect_named(name).concern is Concern.STAGE
            )
        effects = tuple(name for name in sensor.effects if name not in self.left_out)
        self._sensor = sensor
        self._reference = reference
        self._origin_ns = 0
        self._sensors = [
            noiseless(replace(sensor, effects=effects)),
            noiseless(replace(sensor, effects=(), values={})),
        ]
        self._responses: list[Response] = []

    def restart(self) -> None:
        """Let the next block be the first one."""
        self._responses = []

    def prepare(self, begin_ns: int, end_ns: int) -> BlockMotion | None:
        """Return what the reference shows of a block; before the first one the sensor rests."""
        if not self._responses:
            self._origin_ns = begin_ns
            self._motion = self._reference.motion(begin_ns)
        return self._reference.prepare(begin_ns, end_ns)

    def block(
        self, stamp_ns: np.ndarray, accel_mps2: np.ndarray, motion: BlockMotion, end_ns: int
    ) -> ComparedBlock | None:
        """
        Compare the samples of one prepared block; None for the first, in which filters settle.

        stamp_ns: stamps, ns, (n,); accel_mps2: samples by nominal conversion, m/s², (n, m).
        """
        is_first = not self._responses
        if is_first:
            self._responses = [Response(sensor, self._motion, 0) for sensor in self._sensors]
        time_s = (stamp_ns - self._origin_ns) * 1e-9
        modelled, datasheet = [
            accel_mps2 - to_nominal_mps2(respond(time_s), self._sensor)
            for respond in self._responses
        ]
        if is_first:
            return None
        mean_mps2 = scipy.stats.trim_mean(modelled, _TRIMMED, axis=0)
        moves, error_mps2 = motion
        independent = float(
            noise.effective_samples(len(stamp_ns), 1 / self._sensor.rate_hz, self._sensor.rc_s)
        )
        freedom = max(1 - 1 / max(independent, 1.0), 0.5)
        return ComparedBlock(
            end_ns=end_ns,
            mean_mps2=mean_mps2,
            square=(modelled**2).mean(axis=0),
            noise_square=modelled.var(axis=0) / freedom + _SMALLEST_MPS2**2,
            log_noise=_log_noise(modelled),
            datasheet_square=(datasheet**2).mean(axis=0),
            reference_square=error_mps2[: len(mean_mps2)] ** 2,
            moves=moves,
        )


def _log_noise(residual: np.ndarray) -> np.ndarray:
    """Return the log of the median standard deviation of parts of columns, (n, m), (m,)."""
    parts = np.array_split(residual, max(min(_PARTS, len(residual) // _FEWEST_OF_PART), 1))
    variances = np.median([part.var(axis=0) for part in parts], axis=0)
    return np.asarray(0.5 * np.log(variances + _SMALLEST_MPS2**2))
