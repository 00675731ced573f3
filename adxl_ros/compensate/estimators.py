# SPDX-License-Identifier: Apache-2.0

"""Specific force and tilt with their errors: of recordings block by block, and of live samples."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

from adxl_ros.compensate.inversions import noise_variance_v2, PaperInverse, undo_filter_blocks
from adxl_ros.compensate.motion_measure import length_excess, MotionMeasure
from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.surroundings import Surroundings
from adxl_ros.model import covariance as force_errors, noise, signal_chain
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.covariance import UNMEASURED_VARIANCE
from adxl_ros.model.effects.base import (
    ARRAYS,
    Coefficient,
    Components,
    Environment,
    FLOATS,
    NOMINAL_ENVIRONMENT,
)
from adxl_ros.model.kinematics import AngleEstimate, angles, Covariance3, Mounting, Tilt, tilt
from adxl_ros.model.sensor import parameter_of, Sensor
from adxl_ros.wording import option
import numpy as np

_CELL_MPS2 = 0.5
"""Width of a cell of the grid of forces, m/s²; chosen: tangent and covariance hardly vary within
it, so that its samples share them."""
_MAX_CELLS = 4096  # Most cells in memory; chosen: the forces of all poses fill about as many
_CELL_C = 0.5  # The same of temperature, °C
_CELL_V = 0.01  # The same of the supply, V
_MAX_ACCEL_MPS2 = 1e6  # Acceleration that no sensor outputs, m/s²; chosen: far beyond any range
_TOLERANCE_MPS2 = 1e-8  # Largest next step of a converged inverse; chosen: far below any noise
_MAX_STEPS = 8
"""Newton steps after which the inverse starts from zero; chosen: one or two suffice usually."""


@dataclass(frozen=True)
class Estimates:
    """
    Estimates of the samples of one block.

    A quantity that a sample does not determine is NaN and has an infinite standard deviation.
    """

    force_mps2: np.ndarray  # Specific force in the case frame, m/s², (3, n)
    force_std_mps2: np.ndarray  # Standard deviations of the force, m/s², (3, n)
    # Covariance of the force, (m/s²)², (3, 3, n); very large for an axis that is not measured
    covariance: np.ndarray
    tilt: Tilt  # Angles of the samples with their standard deviations, rad, (n,) each
    at_rail: np.ndarray  # Whether the ADC was at a rail, (n,)
    outside: np.ndarray  # Whether temperature or force lie outside of the validity range, (n,)
    volts: np.ndarray  # Volts of the ADC, V, (n, m)

    @property
    def unsolved(self) -> np.ndarray:
        """Whether no force explains the sample, (n,)."""
        return np.isnan(self.force_mps2[0])


class RecordingEstimator:
    """Estimates force and tilt of the samples of one recording."""

    def __init__(
        self, sensor: Sensor, first: Recording, paper: bool = False, undo_filter: bool = False
    ) -> None:
        """Prepare for a recording."""
        if paper and sensor.axes == 'x':
            raise UserError(
                f'{option(inverse="paper")}: needs the axes x and y, the sensor has x; '
                'leave it out'
            )
        if 'temperature_c' not in first.columns:
            sensor = sensor.without_temperature_range()
        self._sensor = sensor
        self._undo_filter = undo_filter
        self._surroundings = Surroundings()
        self._begin_s = float(first.time_s[0])
        self._gravity_mps2 = signal_chain.gravity_mps2(sensor)
        self._inverse = (PaperInverse if paper else signal_chain.inverse)(sensor)
        self._measured_covariance = force_errors.measured_covariance(
            sensor, noise_variance_v2(sensor) if undo_filter else None, bool(sensor.z_sign)
        )

    def blocks(self, recording: Iterable[Recording]) -> Iterator[tuple[Recording, Estimates]]:
        """Yield each block of the recording with its estimates."""
        measured = ((block, block.volts(self._sensor)) for block in recording)
        if not self._undo_filter:
            for block, volts in measured:
                yield block, self._estimate(volts, volts, self._environment(block))
            return
        stamped = ((pair, pair[0].time_s, pair[1]) for pair in measured)
        rc_s = noise.electronics(self._sensor).rc_s
        for (block, volts), input_v in undo_filter_blocks(stamped, rc_s, self._sensor.rate_hz):
            yield block, self._estimate(volts, input_v, self._environment(block))

    @property
    def assumed(self) -> list[str]:
        """Return what was assumed of the surroundings so far, one line each, for people."""
        sensor = self._sensor
        lines = self._surroundings.assumed(self._sensor.effects)
        if sensor.axes == 'xy' and sensor.effects and not sensor.z_sign:
            lines = [
                *lines,
                'the sensor is taken as upright, and the deviations of x and y hold '
                'that it may not be; sensor.z_sign states which way up it is',
            ]
        return lines

    def _environment(self, block: Recording) -> Environment:
        """Return the surroundings of the samples."""
        return NOMINAL_ENVIRONMENT._replace(
            time_s=block.time_s - self._begin_s, **self._surroundings(block)
        )

    def _estimate(
        self, volts: np.ndarray, input_v: np.ndarray, environment: Environment
    ) -> Estimates:
        """Estimate from volts of the ADC and before the filter; rails determine no quantity."""
        sensor = self._sensor
        at_rail = signal_chain.at_a_rail(volts, sensor)
        with np.errstate(all='ignore'):  # some volts have no solution
            force = self._inverse(list(input_v.T), environment)
            covariance = force_errors.of_three_axes(
                sensor, force, *self._measured_covariance(force, environment)
            )
            outside = np.isfinite(force[0]) & sensor.envelope.is_outside(
                environment.temperature_c, force
            )
            covariance[:, :, at_rail] = np.inf
            tilting = covariance + self._excess_variance(force, covariance) * np.eye(3)[:, :, None]
            angles = tilt(force, tilting, 'z' in sensor.axes)
        force_mps2 = np.array(force)
        force_std_mps2 = np.sqrt([covariance[d, d] for d in range(3)])
        if sensor.axes == 'x':
            force_mps2[1:] = np.nan
        force_std_mps2[np.isnan(force_mps2)] = np.inf
        return Estimates(
            force_mps2=force_mps2,
            force_std_mps2=force_std_mps2,
            covariance=covariance,
            tilt=angles,
            at_rail=at_rail,
            outside=outside,
            volts=volts,
        )

    def _excess_variance(self, force: Components, covariance: np.ndarray) -> np.ndarray:
        """Return the square of what a force is beyond gravity and its error, (m/s²)², (n,)."""
        if self._sensor.axes != AXES:
            return np.zeros(len(force[0]))
        error2 = np.max([covariance[d, d] for d in range(3)], axis=0)
        return np.asarray(
            length_excess(np.linalg.norm(force, axis=0), error2, self._gravity_mps2, ARRAYS) ** 2
        )


class Estimate(NamedTuple):
    """Estimate from one sample."""

    # Specific force in the frame of the case, or of the robot where there is a mounting, m/s²,
    # three floats
    force: Components
    covariance: Covariance3  # Covariance of the force, (m/s²)²
    # roll, pitch, inclination: The variance of an angle that is not shown exceeds
    # `kinematics.UNOBSERVABLE_RAD2`.
    roll: AngleEstimate
    pitch: AngleEstimate
    inclination: AngleEstimate
    # Whether the ADC is at a rail; the variances are then those of an unmeasured axis
    saturated: bool
    # Texts on how the sample lies outside of the validity range; the variances include it
    outside: tuple[str, ...]


def alignment_std_rad(sensor: Sensor) -> float:
    """Return the alignment of the sensing axes in the case, rad, of the datasheet or typical."""
    name = Coefficient('misalignment', 'beta_rad', 'x')
    typical, _ = sensor.datasheet.get(name.without_axis, (0.0, 0.0))
    return typical or parameter_of(name).scale


class _GridCell(NamedTuple):
    """What the forces of one cell of the grid share."""

    tangent: signal_chain.Tangent  # Tangent of the inverse at the middle of the cell
    covariance: Covariance3  # By noise and coefficients, (m/s²)²
    outside: tuple[str, ...]  # Texts on how the cell lies outside of the validity range


class LiveEstimator:
    """
    Estimates specific force, its covariance and tilt of a live stream, sample by sample.

    All calculations are in floats, which are ten times faster than arrays of one sample. The
    force is that of `signal_chain.inverse` to 1e-8 m/s². Near alpha = ±90°, where |f| = g may
    have no solution, it differs by a few hundredths of its standard deviation.

    Angles, and the z of equation 5, hold at rest only: `MotionMeasure` adds to their variances.
    A derived z also gets the noise variance of a measured axis.
    """

    def __init__(
        self,
        sensor: Sensor,
        paper: bool = False,
        undo_filter: bool = False,
        mounting: Mounting | None = None,
    ) -> None:
        """Prepare for a sensor."""
        if mounting is not None and not sensor.z_sign:
            # A robot stands upright, so that its mounting says which way up the case is.
            sensor = replace(sensor, z_sign=-1 if mounting.rows[2, 2] < 0 else 1)
        self.sensor = sensor
        self.mounting = mounting
        # Only a stage shows the yaw of the axes in the case. Gravity and a level robot do not.
        self._yaw_rad2 = (
            0.0
            if sensor.provenance.get('reference') == 'stage'
            else alignment_std_rad(sensor) ** 2
        )
        self._paper_inverse = PaperInverse(sensor, FLOATS) if paper else None
        self._variance_v2 = (
            noise_variance_v2(sensor) if undo_filter else noise.sample_std_v(sensor) ** 2
        )
        self._zero_g_v = sensor.nominal_zero_g_v.tolist()
        self._v_per_mps2 = (sensor.nominal_scale_v_per_g / G0_MPS2).tolist()
        self._rails_v = 0.0, sensor.adc_vref_v - sensor.lsb_v
        self._half_lsb_v = sensor.lsb_v / 2
        self._respond = signal_chain.analog_response(sensor)
        self._undo_adc = signal_chain.adc_inverse(sensor)
        self._newton_step = signal_chain.newton_step(
            sensor.axes, signal_chain.gravity_mps2(sensor), FLOATS
        )
        self._invert = signal_chain.inverse(sensor)
        self._use(sensor.without_temperature_range())
        self._cells: dict[tuple[int, ...], _GridCell] = {}
        noise_mps2 = np.sqrt(self._variance_v2) / sensor.scale_v_per_g * G0_MPS2
        self._noise_variance = (noise_mps2[:2] ** 2).tolist()
        self._derives_z = sensor.axes == 'xy'
        self._motion = MotionMeasure(self._noise_variance, signal_chain.gravity_mps2(sensor))
        # The last force, and the volts at the ADC's input that respond to it.
        self._force: Components = [0.0, 0.0, 0.0]
        self._environment = NOMINAL_ENVIRONMENT
        self._last_volts = self._respond(self._force)

    def volts(self, accel_mps2: Sequence[float]) -> Components:
        """Undo the nominal conversion; an empty list if a value exceeds that of any sensor."""
        volts = [
            zero + a * scale
            for zero, a, scale in zip(self._zero_g_v, accel_mps2, self._v_per_mps2)
            if abs(a) < _MAX_ACCEL_MPS2
        ]
        return volts if len(volts) == len(self._v_per_mps2) else []

    def __call__(self, volts: Components, time_s: float) -> Estimate | None:
        """Estimate from the volts of one sample, V; None where no force explains it."""
        force = self._inverse(volts)
        if force is None:
            return None
        saturated = any(
            abs(v - rail) < self._half_lsb_v for v, rail in product(volts, self._rails_v)
        )
        unknown = UNMEASURED_VARIANCE if saturated else 0.0
        motion = self._motion.changes(force, time_s) + unknown
        cell = self._cell(force)
        covariance = self._covariance(force, cell, unknown, motion)
        # The angles are those of gravity, so that motion adds to the variance of each axis.
        if self.sensor.axes == AXES:
            error2 = max(covariance.xx, covariance.yy, covariance.zz)
            motion = max(motion, self._motion.of_length(force, error2))
        moved = covariance.widened(motion, motion, 0.0 if self._derives_z else motion)
        if self.mounting is not None:
            force = self.mounting.rotate(force)
            turned = self.mounting.rotate_covariance
            covariance = self._with_yaw(force, turned(covariance))
            moved = self._with_yaw(force, turned(moved))
        shown = angles(force, moved, FLOATS)
        return Estimate(
            force=force,
            covariance=covariance,
            roll=shown.roll,
            pitch=shown.pitch,
            inclination=shown.inclination,
            saturated=saturated,
            outside=cell.outside,
        )

    def set_environment(
        self, temperature_c: float | None = None, supply_v: float | None = None
    ) -> None:
        """Set the surroundings of the samples that follow."""
        if temperature_c is not None:
            if not self._knows_temperature:
                self._use(self.sensor)
                self._cells.clear()
            self._environment = self._environment._replace(temperature_c=temperature_c)
        if supply_v is not None:
            self._environment = self._environment._replace(supply_v=supply_v)
        self._last_volts = self._respond(self._force, self._environment)

    def _use(self, sensor: Sensor) -> None:
        """Take covariance and range of validity from the sensor, of temperature as well or not."""
        self._measured_covariance = force_errors.measured_covariance(
            sensor, self._variance_v2, bool(self.sensor.z_sign)
        )
        self._envelope = sensor.envelope
        self._knows_temperature = sensor is self.sensor

    def _inverse(self, volts: Components) -> Components | None:
        """Invert the chain, beginning at the force of the last sample; None without a solution."""
        if self._paper_inverse:
            self._force = self._paper_inverse(volts, self._environment)
            return self._force if abs(sum(self._force)) < float('inf') else None
        tangent = self._cell(self._force).tangent
        force = self._force
        change = 0.0
        response = self._last_volts
        input_v = self._undo_adc(volts)
        for _ in range(_MAX_STEPS):
            previous, previous_change = force, change
            force = self._newton_step(
                [v - r for v, r in zip(input_v, response)], previous, tangent, self.sensor.up
            )
            change = max(abs(f - p) for f, p in zip(force, previous))
            # Steps shrink by the same factor or faster, which bounds the next one.
            if change * change <= _TOLERANCE_MPS2 * previous_change:
                break
            response = self._respond(force, self._environment)
        else:
            force = self._invert(volts, self._environment)
        if not abs(force[0]) + abs(force[1]) + abs(force[2]) < float('inf'):
            return None
        self._force = force
        self._last_volts = input_v
        return force

    def _with_yaw(self, force: Components, covariance: Covariance3) -> Covariance3:
        """Add the error of a turn ψ about the robot's vertical, ψ·(−y, x, 0), to a covariance."""
        x, y, _ = force
        xx, xy, xz, yy, yz, zz = covariance
        variance = self._yaw_rad2
        return Covariance3(
            xx + variance * y * y, xy - variance * x * y, xz, yy + variance * x * x, yz, zz
        )

    def _covariance(
        self, force: Components, cell: _GridCell, unknown: float, motion: float
    ) -> Covariance3:
        """
        Return the covariance of a force, (m/s²)².

        Each axis gets the variance `unknown`; a derived z also gets that of noise and motion.
        """
        covariance = cell.covariance
        further = unknown
        if self._derives_z:
            in_plane = covariance.xx, covariance.xy, covariance.yy
            covariance = force_errors.derived_z_covariance(
                force, in_plane, cell.tangent.slope, FLOATS
            )
            further = self._noise_variance[0] + motion
        return covariance.widened(unknown, unknown, further)

    def _cell(self, force: Components) -> _GridCell:
        around = self._environment
        key = (
            round(force[0] / _CELL_MPS2),
            round(force[1] / _CELL_MPS2),
            round(force[2] / _CELL_MPS2),
            round(around.temperature_c / _CELL_C),
            round(around.supply_v / _CELL_V),
        )
        cell = self._cells.get(key)
        if cell is None:
            if len(self._cells) >= _MAX_CELLS:
                self._cells.clear()
            middle = [float(k * _CELL_MPS2) for k in key[:3]]
            measured, tangent = self._measured_covariance(middle, around)
            outside = self._envelope.describe_outside(around.temperature_c, middle)
            covariance = np.diag([0.0, UNMEASURED_VARIANCE, UNMEASURED_VARIANCE])
            axes = self.sensor.axis_indices
            covariance[np.ix_(axes, axes)] = measured[:, :, 0]
            cell = self._cells[key] = _GridCell(
                tangent, Covariance3(*covariance[np.triu_indices(3)].tolist()), outside
            )
        return cell
