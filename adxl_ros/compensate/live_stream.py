# SPDX-License-Identifier: Apache-2.0

"""A live stream: serialized samples come in, corrected samples and tilt go out, one by one."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from adxl_ros.compensate.inversions import DelayedInversion, noise_variance_v2, paper_inverse
from adxl_ros.files import imu_message
from adxl_ros.files.cdr import CdrError
from adxl_ros.model import noise, signal_chain
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.covariance import (
    derived_z_covariance,
    measured_covariance,
    UNMEASURED_VARIANCE,
)
from adxl_ros.model.effects.base import Components, Environment, FLOATS, NOMINAL_ENVIRONMENT
from adxl_ros.model.kinematics import (
    angles,
    Mounting,
    quaternion,
    roll_pitch_covariance,
    UNKNOWN_ANGLE_RAD2,
    UNOBSERVABLE_RAD2,
)
from adxl_ros.model.sensor import Sensor
import numpy as np

_CELL_MPS2 = 0.5
"""Width of a cell of the grid of forces, m/s²; chosen: tangent and covariance hardly vary within
it, so that its samples share them."""

_MAX_CELLS = 4096
"""Largest number of cells in memory; chosen: the forces of all poses fill about as many."""

_CELL_ENVIRONMENT = Environment(time_s=0.0, temperature_c=0.5, supply_v=0.01)
"""Change of the surroundings, °C and V, from which the cells are computed again; chosen: the
tangent hardly varies within it. Time has no limit."""

_MAX_ACCEL_MPS2 = 1e6
"""Acceleration that no sensor outputs, m/s²; chosen: far beyond any range."""

_TOLERANCE_MPS2 = 1e-8
"""Largest next step of a converged inverse, m/s²; chosen: far below any noise."""

_MAX_STEPS = 8
"""Newton steps after which the inverse starts from zero; chosen: one or two suffice usually."""

_MOTION_S = 0.5
"""Interval of the variance that separates motion from noise, s; chosen: the RC filter leaves some
24 independent samples in it."""

_PAUSE_S = 1.0
"""Time without a sample after which the variance begins again, s; chosen: two intervals."""

_NOISE_FACTOR = 2
"""Multiple of the noise variance that does not count as motion; chosen: the variance of some 24
samples hardly exceeds it by chance."""


class Estimate(NamedTuple):
    """Estimate from one sample."""

    # Specific force in the frame of the case, or of the robot where there is a mounting, m/s²,
    # three floats
    force: Components
    covariance: tuple[float, ...]  # Covariance of the force: xx, xy, xz, yy, yz, zz, (m/s²)²
    # roll, pitch, inclination: Angle, rad, and its variance, rad². The variance of an angle that
    # is not shown exceeds `tilt.UNOBSERVABLE_RAD2`.
    roll: tuple[float, float]
    pitch: tuple[float, float]
    inclination: tuple[float, float]
    roll_pitch: float  # Covariance of roll and pitch, rad²
    # Whether the ADC is at a rail; the variances are then those of an unmeasured axis
    saturated: bool
    # Texts on how the sample lies outside of the validity range; the variances include it
    outside: tuple[str, ...]


class _Cell(NamedTuple):
    """What the forces of one cell of the grid share."""

    tangent: signal_chain.Tangent  # Tangent of the inverse at the middle of the cell
    # Covariance by noise and coefficients: xx, xy, xz, yy, yz, zz, (m/s²)²
    covariance: tuple[float, ...]
    outside: tuple[str, ...]  # Texts on how the cell lies outside of the validity range


class LiveEstimator:
    """
    Estimates specific force, its covariance and tilt of a live stream, sample by sample.

    All calculations are in floats, which are ten times faster than arrays of one sample. The
    force is that of `signal_chain.inverse` to 1e-8 m/s². Near alpha = ±90°, where |f| = g may
    have no solution, it differs by a few hundredths of its standard deviation.

    Angles, and the z of equation 5, hold at rest only. Motion adds to their variances: the
    variance of the in-plane force over half a second, as far as it exceeds twice that of the
    noise. The larger of the last two half seconds counts. A derived z also gets the noise
    variance of a measured axis.
    """

    def __init__(self, sensor: Sensor, paper: bool = False, undo_filter: bool = False,
                 mounting: Mounting | None = None) -> None:
        """Prepare for a unit."""
        self.sensor, self.mounting = sensor, mounting
        self._paper_inverse = paper_inverse(sensor, FLOATS) if paper else None
        self._variance_v2 = noise_variance_v2(sensor) if undo_filter \
            else noise.sample_std_v(sensor) ** 2
        self._zero_g_v = sensor.nominal_zero_g_v.tolist()
        self._v_per_mps2 = (sensor.nominal_scale_v_per_g / G0_MPS2).tolist()
        self._rails = (0.0, sensor.adc_vref_v - sensor.lsb_v, sensor.lsb_v / 2)
        self._respond = signal_chain.analog_response(sensor)
        self._undo_adc = signal_chain.adc_inverse(sensor)
        self._newton_step = signal_chain.newton_step(
            sensor.axes, signal_chain.gravity_mps2(sensor), FLOATS)
        self._invert = signal_chain.inverse(sensor)
        self._use(sensor.without_temperature_range())
        self._cells: dict[tuple[int, int, int], _Cell] = {}
        noise_mps2 = np.sqrt(self._variance_v2) / sensor.scale_v_per_g * G0_MPS2
        self._noise_variance = (noise_mps2[:2] ** 2).tolist()
        self._derives_z = sensor.axes == 'xy'
        # The last force, and the volts at the ADC's input that respond to it.
        self._force: Components = [0.0, 0.0, 0.0]
        self._environment = self._cells_environment = NOMINAL_ENVIRONMENT
        self._last_volts = self._respond(self._force)
        self._time_s = float('-inf')

    def __call__(self, accel_mps2: Components, time_s: float) -> Estimate | None:
        """Estimate from one sample."""
        volts = self.volts(accel_mps2)
        return self.from_volts(volts, time_s) if volts else None

    def volts(self, accel_mps2: Sequence[float]) -> Components:
        """Undo the nominal conversion; an empty list if a value exceeds that of any sensor."""
        volts = [zero + a * scale for zero, a, scale in
                 zip(self._zero_g_v, accel_mps2, self._v_per_mps2) if abs(a) < _MAX_ACCEL_MPS2]
        return volts if len(volts) == len(self._v_per_mps2) else []

    def from_volts(self, volts: Components, time_s: float) -> Estimate | None:
        """
        Estimate from the volts of one sample.

        volts: volts of each measured axis, V.
        """
        force = self._inverse(volts)
        if force is None:
            return None
        saturated = self._at_a_rail(volts)
        unknown = UNMEASURED_VARIANCE if saturated else 0.0
        motion = self._motion_variance(force, time_s) + unknown
        cell = self._cell(force)
        covariance = self._covariance(force, cell, unknown, motion)
        # The angles are those of gravity, so that motion adds to the variance of each axis.
        moved: tuple[float, ...] = (
            covariance[0] + motion, covariance[1], covariance[2], covariance[3] + motion,
            covariance[4], covariance[5] if self._derives_z else covariance[5] + motion)
        if self.mounting is not None:
            force, covariance, moved = (
                self.mounting.rotate(force), self.mounting.rotate_covariance(covariance),
                self.mounting.rotate_covariance(moved))
        roll, pitch, inclination, _ = angles(force, moved, FLOATS)
        return Estimate(force, covariance, roll, pitch, inclination,
                        roll_pitch_covariance(force, moved, FLOATS), saturated, cell.outside)

    def set_environment(self, temperature_c: float | None = None, supply_v: float | None = None
                        ) -> None:
        """Set the surroundings of the samples that follow."""
        if temperature_c is not None:
            if not self._knows_temperature:
                self._use(self.sensor)
                self._cells.clear()
            self._environment = self._environment._replace(temperature_c=temperature_c)
        if supply_v is not None:
            self._environment = self._environment._replace(supply_v=supply_v)
        if any(abs(now - then) > limit for now, then, limit in zip(
                self._environment[1:], self._cells_environment[1:], _CELL_ENVIRONMENT[1:])):
            self._cells.clear()
            self._cells_environment = self._environment
        self._last_volts = self._respond(self._force, self._environment)

    def _use(self, sensor: Sensor) -> None:
        """Take covariance and validity range from the unit, with or without temperature range."""
        self._measured_covariance = measured_covariance(sensor, self._variance_v2)
        self._envelope = sensor.envelope
        self._knows_temperature = sensor is self.sensor

    def _inverse(self, volts: Components) -> Components | None:
        """Invert the chain, beginning at the force of the last sample; None without a solution."""
        if self._paper_inverse:
            self._force = self._paper_inverse(volts, self._environment)
            return self._force if abs(sum(self._force)) < float('inf') else None
        tangent = self._cell(self._force).tangent
        force, change = self._force, 0.0
        response, input_v = self._last_volts, self._undo_adc(volts)
        for _ in range(_MAX_STEPS):
            previous, previous_change = force, change
            force = self._newton_step([v - r for v, r in zip(input_v, response)], previous,
                                      tangent, self.sensor.z_sign)
            change = max(abs(f - p) for f, p in zip(force, previous))
            # Steps shrink by the same factor or faster, which bounds the next one.
            if change * change <= _TOLERANCE_MPS2 * previous_change:
                break
            response = self._respond(force, self._environment)
        else:
            force = self._invert(volts, self._environment)
        if not abs(force[0]) + abs(force[1]) + abs(force[2]) < float('inf'):
            return None
        self._force, self._last_volts = force, input_v
        return force

    def _at_a_rail(self, volts: Components) -> bool:
        low, high, half_lsb = self._rails
        return any((v < low + half_lsb and v > low - half_lsb)
                   or (v > high - half_lsb and v < high + half_lsb) for v in volts)

    def _motion_variance(self, force: Components, time_s: float) -> float:
        """Return the variance of the recent in-plane force beyond its noise, (m/s²)²."""
        if not 0 <= time_s - self._time_s < _PAUSE_S:
            self._previous_excess = 0.0
            self._begin_interval(time_s)
        elif time_s - self._begin_s > _MOTION_S:
            self._previous_excess = self._excess()
            self._begin_interval(time_s)
        self._time_s = time_s
        self._count += 1
        # Welford's recurrence of mean and sum of squares.
        for d, value in enumerate(force[:len(self._noise_variance)]):
            deviation = value - self._mean[d]
            self._mean[d] += deviation / self._count
            self._squares[d] += deviation * (value - self._mean[d])
        return max(self._excess(), self._previous_excess)

    def _begin_interval(self, time_s: float) -> None:
        self._begin_s, self._count = time_s, 0
        self._mean, self._squares = [0.0, 0.0], [0.0, 0.0]

    def _excess(self) -> float:
        """Return the variance of this interval beyond a multiple of that of the noise, (m/s²)²."""
        return max(0.0, *(squares / self._count - _NOISE_FACTOR * variance
                          for squares, variance in zip(self._squares, self._noise_variance)))

    def _covariance(self, force: Components, cell: _Cell, unknown: float, motion: float
                    ) -> tuple[float, ...]:
        """
        Return the covariance of a force: xx, xy, xz, yy, yz, zz, (m/s²)².

        Each axis gets the variance `unknown`; a derived z also gets that of noise and motion.
        """
        if not self._derives_z:
            xx, xy, xz, yy, yz, zz = cell.covariance
            return xx + unknown, xy, xz, yy + unknown, yz, zz + unknown
        xx, xy, _, yy, _, _ = cell.covariance
        xx, xy, xz, yy, yz, zz = derived_z_covariance(force, (xx, xy, yy), cell.tangent.slope,
                                                      FLOATS)
        return xx + unknown, xy, xz, yy + unknown, yz, zz + self._noise_variance[0] + motion

    def _cell(self, force: Components) -> _Cell:
        """Return the cell of a force."""
        key = (round(force[0] / _CELL_MPS2), round(force[1] / _CELL_MPS2),
               round(force[2] / _CELL_MPS2))
        cell = self._cells.get(key)
        if cell is None:
            if len(self._cells) >= _MAX_CELLS:
                self._cells.clear()
            cell = self._cells[key] = self._new_cell([float(k * _CELL_MPS2) for k in key])
        return cell

    def _new_cell(self, middle: Components) -> _Cell:
        """Compute the cell around a force, m/s², three floats."""
        measured, tangent, leverage = self._measured_covariance(middle, self._environment)
        outside = self._envelope.describe_outside(self._environment.temperature_c, middle,
                                                  float(leverage[0]))
        covariance = np.diag([0.0, UNMEASURED_VARIANCE, UNMEASURED_VARIANCE])
        axes = [AXES.index(axis) for axis in self.sensor.axes]
        covariance[np.ix_(axes, axes)] = measured[:, :, 0]
        return _Cell(tangent, tuple(covariance[np.triu_indices(3)].tolist()), outside)


COUNTS = ('received', 'published', 'dropped', 'saturated', 'outside')
"""What a stream counts: samples, and those to which something happened."""

_MAX_UNKNOWN = 5000
"""Largest number of samples that wait for their sensor; chosen: 5 s at 1 kHz."""


class _Chain(NamedTuple):
    """What corrects a sample; replaced as a whole."""

    live: LiveEstimator
    delayed: DelayedInversion
    stride: int


class LiveStream:
    """
    Corrects the samples of one stream.

    One thread calls it with samples; another one may replace the sensor and the surroundings
    meanwhile. A sample has the coefficients before or after a replacement, never some of both.

    publish_tilt: takes roll, pitch and inclination, rad, a serialized
    geometry_msgs/Vector3Stamped; publish_free: takes the acceleration without gravity of a sample
    that states an orientation, m/s², a serialized geometry_msgs/Vector3Stamped; None for no such
    output.
    """

    def __init__(self, paper: bool, undo_filter: bool, publish_imu: Callable[[bytes], None],
                 publish_tilt: Callable[[bytes], None], keep_orientation: bool = False,
                 publish_free: Callable[[bytes], None] | None = None,
                 output_rate_hz: float = 0.0) -> None:
        self._paper, self._undo_filter = paper, undo_filter
        self._keep_orientation, self._publish_free = keep_orientation, publish_free
        self._output_rate_hz, self._corrected = output_rate_hz, 0
        self._mounting, self._frame_id = Mounting(), ''
        self._sensor: tuple[Sensor, float]
        self._forces: list[Components] | None = None
        self._publish_imu, self._publish_tilt = publish_imu, publish_tilt
        self._chain: _Chain
        self._angles_rad = [0.0, 0.0, 0.0]
        self._new_surroundings: dict[str, float] = {}
        self.counts: Counter[str] = Counter()  # Samples since the start, by the names of `COUNTS`
        # What the newest sample outside of the calibrated range exceeds, in words
        self.outside: tuple[str, ...] = ()
        # Temperature, °C, and supply, V, that the inverse uses, by name; those that are known
        self.surroundings: dict[str, float] = {}
        # Whether the stream belongs to another unit; then its samples are counted only
        self.refused = False
        # Whether nobody has named the sensor. The stream is then held as soon as it has a value on
        # an axis that the sensor lacks.
        self.may_be_foreign = False
        # Newest samples of a stream that is held; None where it is not
        self.unknown: deque[bytes] | None = None

    def hold(self) -> None:
        """Keep the samples that follow and publish nothing, until `release` is called."""
        self.unknown = deque(maxlen=_MAX_UNKNOWN)

    def release(self) -> None:
        """Correct and publish the samples that follow."""
        self.unknown, self.may_be_foreign = None, False

    def use(self, sensor: Sensor, rate_hz: float) -> None:
        """Correct by a sensor from the next sample on."""
        self._sensor = sensor, rate_hz
        live = LiveEstimator(sensor, self._paper, self._undo_filter,
                             self._mounting if self._mounting.turns else None)
        live.set_environment(**self.surroundings)
        self._chain = _Chain(live, _delayed(sensor, rate_hz), self._stride(rate_hz))

    @property
    def sensor(self) -> Sensor:
        """Return the sensor that corrects the samples."""
        return self._sensor[0]

    def mount(self, mounting: Mounting, frame_id: str) -> None:
        """Turn the samples that follow into the frame of the robot."""
        self._mounting, self._frame_id = mounting, frame_id
        self.use(*self._sensor)

    def collect(self) -> None:
        """Begin to keep the corrected forces, for `collected`."""
        self._forces = []

    def collected(self) -> np.ndarray:
        """Return the forces since `collect` in the frame of the case, m/s², (n, 3)."""
        forces = self._forces or []
        return np.reshape(forces[:], (-1, 3)) @ np.array(self._mounting.rows)

    def stop_collecting(self) -> None:
        """Forget the kept forces."""
        self._forces = None

    def restart_filter(self, rate_hz: float) -> None:
        """Forget the samples that wait for their neighbours; the stream has a rate, Hz."""
        self._chain = self._chain._replace(delayed=_delayed(self._chain.live.sensor, rate_hz),
                                           stride=self._stride(rate_hz))

    def _stride(self, rate_hz: float) -> int:
        """Return which part of the samples is published: one of so many."""
        return max(1, round(rate_hz / self._output_rate_hz)) if self._output_rate_hz else 1

    def surround(self, name: str, value: float) -> None:
        """Take a temperature or supply into account, from the next sample on."""
        self._new_surroundings = {**self._new_surroundings, name: value}

    def __call__(self, raw: bytes) -> None:
        """Correct one sample, a serialized sensor_msgs/Imu, and publish the result."""
        self.counts['received'] += 1
        unknown = self.unknown
        if unknown is not None:
            unknown.append(raw)
            return
        if self.refused:
            return
        try:
            time_s, accel_mps2 = imu_message.read(raw)
        except CdrError:
            self.counts['dropped'] += 1
            return
        # Read once: another thread may replace the chain at any time.
        chain = self._chain
        if self._new_surroundings:
            new, self._new_surroundings = self._new_surroundings, {}
            chain.live.set_environment(**new)
            self.surroundings |= new
        volts = chain.live.volts(accel_mps2)
        if self.may_be_foreign and any(accel_mps2[len(volts):]):
            self.hold()
            return
        if not volts:
            self.counts['dropped'] += 1
        elif self._undo_filter:
            for ready in chain.delayed(time_s, volts, raw):
                self._correct(chain, *ready)
        else:
            self._correct(chain, time_s, volts, raw)

    def _correct(self, chain: _Chain, time_s: float, volts: list[float], raw: Any) -> None:
        live = chain.live
        estimate = live.from_volts(volts, time_s)
        if estimate is None:
            self.counts['dropped'] += 1
            return
        self.counts['saturated'] += estimate.saturated
        if estimate.outside:
            self.counts['outside'] += 1
            self.outside = estimate.outside
        xx, xy, xz, yy, yz, zz = estimate.covariance
        if self._forces is not None:
            self._forces.append(estimate.force)
        self._corrected += 1
        if self._corrected % chain.stride:
            return
        if live.mounting is not None:
            raw = imu_message.with_frame(imu_message.turned(raw, live.mounting), self._frame_id)
        orientation: Sequence[float] | None = self._orientation(estimate)
        if self._keep_orientation and imu_message.has_orientation(raw):
            orientation = None
            if self._publish_free is not None:
                self._publish_free(imu_message.vector3_stamped(raw, free_acceleration(
                    estimate.force, imu_message.orientation(raw),
                    live.sensor.local_gravity_mps2)))
        self._publish_imu(imu_message.corrected(
            raw, orientation,
            (*estimate.force, xx, xy, xz, xy, yy, yz, xz, yz, zz)))
        self._publish_tilt(imu_message.vector3_stamped(raw, self._angles_rad))
        self.counts['published'] += 1

    def _orientation(self, estimate: Estimate) -> tuple[float, ...]:
        """
        Return the quaternion with yaw 0 (x, y, z, w), and its covariance, rad², row by row.

        An angle that the pose does not show keeps its last value, with a very large variance.
        """
        variances = []
        for i, (angle, variance) in enumerate((estimate.roll, estimate.pitch,
                                               estimate.inclination)):
            observable = variance < UNOBSERVABLE_RAD2
            if observable:
                self._angles_rad[i] = angle
            variances.append(variance if observable else UNKNOWN_ANGLE_RAD2)
        roll, pitch, _ = variances
        both = estimate.roll_pitch if max(roll, pitch) < UNKNOWN_ANGLE_RAD2 else 0.0
        return (*quaternion(self._angles_rad[0], self._angles_rad[1], FLOATS),
                roll, both, 0.0, both, pitch, 0.0, 0.0, 0.0, UNKNOWN_ANGLE_RAD2)


def free_acceleration(force_mps2: Components, quaternion: Sequence[float], gravity_mps2: float
                      ) -> list[float]:
    """Return the acceleration without gravity, m/s², three floats."""
    x, y, z, w = quaternion
    vertical = (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
    return [f - gravity_mps2 * v for f, v in zip(force_mps2, vertical)]


def _delayed(sensor: Sensor, rate_hz: float) -> DelayedInversion:
    return DelayedInversion(noise.electronics(sensor).rc_s, rate_hz)
