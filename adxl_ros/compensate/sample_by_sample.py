# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""One sample after the other: the inverse, the covariance and the tilt of a live stream."""

from __future__ import annotations

from typing import NamedTuple

from adxl_ros.compensate import filter_inversion, paper_inverse
from adxl_ros.model import noise, signal_chain
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.covariance import (
    equation_5,
    leverage,
    measured_covariance,
    UNMEASURED_VARIANCE,
)
from adxl_ros.model.effects.base import Components, Environment, NOMINAL_ENVIRONMENT
from adxl_ros.model.scalar_or_array import FLOATS
from adxl_ros.model.sensor import Sensor
from adxl_ros.model.tilt import angles, roll_pitch_covariance
import numpy as np

_CELL_MPS2 = 0.5
"""Forces this near share a tangent and the covariance of the calibration, which vary slowly."""
_MOST_CELLS = 4096
_NEAR = Environment(0.0, 0.5, 0.01)
"""Surroundings this near, °C and V, share them, too."""
_LIMIT_MPS2 = 1e6
"""No sensor gives as much."""
_TOLERANCE_MPS2 = 1e-8
"""What the next step of the inverse would add at most."""
_MOST_STEPS = 8
_MOTION_S = 0.5
"""Time over which motion is told from noise: some 24 independent samples behind the filter."""
_PAUSE_S = 1.0
"""Time without a sample after which motion is learnt anew."""


class Estimate(NamedTuple):
    """
    What one sample says.

    Attributes
    ----------
    force
        Specific force in the case frame, m/s².
    covariance
        Of the force: xx, xy, xz, yy, yz, zz, (m/s²)².
    roll, pitch, inclination
        Angle, rad, and its variance, rad²; those of an angle that is not shown pass
        `tilt.UNOBSERVABLE_RAD2`.
    roll_pitch
        Covariance of roll and pitch, rad².
    saturated
        Whether the ADC was at a rail, so that the variances are those of no measurement.
    outside
        What lies outside of what was calibrated, in words; the variances have it.

    """

    force: Components
    covariance: tuple[float, ...]
    roll: tuple[float, float]
    pitch: tuple[float, float]
    inclination: tuple[float, float]
    roll_pitch: float
    saturated: bool
    outside: tuple[str, ...]


class _Cell(NamedTuple):
    at: signal_chain.Tangent
    measured: tuple[float, ...]
    outside: tuple[str, ...]


class Live:
    """
    Follows one sensor sample by sample, in floats.

    The force is that of `signal_chain.inverse`: to 1e-8 m/s² where |f| = g has a solution, and to
    a few hundredths of its standard deviation at alpha = ±90° where it has none.

    What moves is not only under gravity, so that the z of equation 5 and the angles are off: the
    variance of the in-plane force over half a second, of the last two half seconds the larger,
    is added to theirs as far as it exceeds twice that of the noise. A derived z also gets the
    noise variance of a measured axis.
    """

    def __init__(self, sensor: Sensor, paper: bool = False, undo_filter: bool = False) -> None:
        """
        Prepare for a sensor.

        Parameters
        ----------
        sensor
            The unit.
        paper
            By the paper's approximate inverse instead of the exact one.
        undo_filter
            The samples come from `filter_inversion.Delayed`, so that their noise is that before
            the filter.

        """
        self.sensor = sensor
        self._paper = paper_inverse.inverse(sensor, maths=FLOATS) if paper else None
        variance_v2 = filter_inversion.variance_v2(sensor) if undo_filter \
            else noise.sigma_v(sensor) ** 2
        self._zero_v = sensor.nominal_zero_g_v.tolist()
        self._volts = (sensor.nominal_scale_v_per_g / G0_MPS2).tolist()
        self._rails = (0.0, sensor.adc_vref_v - sensor.lsb_v, sensor.lsb_v / 2)
        self._respond = signal_chain.analog_response(sensor)
        self._before_adc = signal_chain.before_adc(sensor)
        self._step = signal_chain.step(sensor.axes, signal_chain.gravity_mps2(sensor),
                                       sensor.z_sign, FLOATS)
        self._invert = signal_chain.inverse(sensor)
        self._variance_v2 = variance_v2
        self._within(sensor.without_temperature_range())
        self._cells: dict[tuple[int, int, int], _Cell] = {}
        quiet = np.sqrt(variance_v2) / sensor.scale_v_per_g * G0_MPS2
        self._noise = (quiet[:2] ** 2).tolist()
        self._derives_z = sensor.axes == 'xy'
        # A force, and the volts at the ADC's input that respond to it.
        self._force: Components = [0.0, 0.0, 0.0]
        self._around = self._cells_around = NOMINAL_ENVIRONMENT
        self._last_volts = self._respond(self._force)
        self._time_s = float('-inf')

    def __call__(self, accel_mps2: Components, time_s: float) -> Estimate | None:
        """
        Estimate from one sample; None if no force explains it.

        Parameters
        ----------
        accel_mps2
            Nominally converted specific force, m/s², three floats, of which those of the
            measured axes count.
        time_s
            Stamp of the sample, s.

        """
        volts = self.volts(accel_mps2)
        return self.of_volts(volts, time_s) if volts else None

    def volts(self, accel_mps2: Components) -> Components:
        """Undo the nominal conversion; empty if no sensor gives as much."""
        volts = [zero + a * scale for zero, a, scale in
                 zip(self._zero_v, accel_mps2, self._volts) if abs(a) < _LIMIT_MPS2]
        return volts if len(volts) == len(self._volts) else []

    def of_volts(self, volts: Components, time_s: float) -> Estimate | None:
        """Estimate from the volts of one sample; see the call."""
        force = self._inverse(volts)
        if force is None:
            return None
        saturated = self._at_a_rail(volts)
        unknown = UNMEASURED_VARIANCE if saturated else 0.0
        motion = self._motion(force, time_s) + unknown
        spread = self._covariance(force, unknown, motion)
        # Of the angles, all of gravity is the signal and all motion is noise.
        loose = (spread[0] + motion, spread[1], spread[2], spread[3] + motion, spread[4],
                 spread[5] if self._derives_z else spread[5] + motion)
        roll, pitch, inclination, _ = angles(force, loose, FLOATS)
        return Estimate(force, spread, roll, pitch, inclination,
                        roll_pitch_covariance(force, loose, FLOATS), saturated,
                        self._cell(force).outside)

    def surround(self, temperature_c: float | None = None, supply_v: float | None = None
                 ) -> None:
        """
        Take the surroundings from now on; those that are not named stay.

        Parameters
        ----------
        temperature_c
            Of the sensor, °C.
        supply_v
            Of the sensor, V.

        """
        if temperature_c is not None and not self._knows_temperature:
            self._within(self.sensor)
            self._cells.clear()
        self._around = self._around._replace(**{name: value for name, value in (
            ('temperature_c', temperature_c), ('supply_v', supply_v)) if value is not None})
        if any(abs(now - then) > near for now, then, near in zip(
                self._around[1:], self._cells_around[1:], _NEAR[1:])):
            self._cells.clear()
            self._cells_around = self._around
        self._last_volts = self._respond(self._force, self._around)

    def _within(self, sensor: Sensor) -> None:
        self._measured = measured_covariance(sensor, self._variance_v2)
        self._leverage, self._envelope = leverage(sensor), sensor.envelope
        self._knows_temperature = sensor is self.sensor

    def _inverse(self, volts: Components) -> Components | None:
        """Start where the last sample ended: its volts are the response to its force."""
        if self._paper:
            self._force = self._paper(volts, self._around)
            return self._force if abs(sum(self._force)) < float('inf') else None
        at = self._cell(self._force).at
        force, moved = self._force, 0.0
        response, input_v = self._last_volts, self._before_adc(volts)
        for _ in range(_MOST_STEPS):
            before, moved_before = force, moved
            force = self._step([v - r for v, r in zip(input_v, response)], before, at)
            moved = max(abs(f - b) for f, b in zip(force, before))
            # Each step is shorter than the one before by the same factor, or a smaller one.
            if moved * moved <= _TOLERANCE_MPS2 * moved_before:
                break
            response = self._respond(force, self._around)
        else:
            force = self._invert(volts, self._around)
        if not abs(force[0]) + abs(force[1]) + abs(force[2]) < float('inf'):
            return None
        self._force, self._last_volts = force, input_v
        return force

    def _at_a_rail(self, volts: Components) -> bool:
        low, high, half_lsb = self._rails
        return any((v < low + half_lsb and v > low - half_lsb)
                   or (v > high - half_lsb and v < high + half_lsb) for v in volts)

    def _motion(self, force: Components, time_s: float) -> float:
        """Return how far the in-plane force of late has varied beyond its noise, (m/s²)²."""
        if not 0 <= time_s - self._time_s < _PAUSE_S:
            self._motion_before = 0.0
            self._begin(time_s)
        elif time_s - self._began_s > _MOTION_S:
            self._motion_before = self._excess()
            self._begin(time_s)
        self._time_s = time_s
        self._count += 1
        for d, value in enumerate(force[:len(self._noise)]):
            off = value - self._mean[d]
            self._mean[d] += off / self._count
            self._squares[d] += off * (value - self._mean[d])
        return max(self._excess(), self._motion_before)

    def _begin(self, time_s: float) -> None:
        self._began_s, self._count = time_s, 0
        self._mean, self._squares = [0.0, 0.0], [0.0, 0.0]

    def _excess(self) -> float:
        return max(0.0, *(squares / self._count - 2 * quiet
                          for squares, quiet in zip(self._squares, self._noise)))

    def _covariance(self, force: Components, unknown: float, motion: float) -> tuple[float, ...]:
        cell = self._cell(force)
        if not self._derives_z:
            xx, xy, xz, yy, yz, zz = cell.measured
            return xx + unknown, xy, xz, yy + unknown, yz, zz + unknown
        xx, xy, _, yy, _, _ = cell.measured
        xx, xy, xz, yy, yz, zz = equation_5(force, (xx, xy, yy), cell.at.slope, FLOATS)
        return xx + unknown, xy, xz, yy + unknown, yz, zz + self._noise[0] + motion

    def _cell(self, force: Components) -> _Cell:
        """Return the tangent and the covariance of the measured axes at the nearest grid point."""
        key = (round(force[0] / _CELL_MPS2), round(force[1] / _CELL_MPS2),
               round(force[2] / _CELL_MPS2))
        cell = self._cells.get(key)
        if cell is None:
            if len(self._cells) >= _MOST_CELLS:
                self._cells.clear()
            middle = [float(k * _CELL_MPS2) for k in key]
            covariance, at = self._measured(middle, self._around)
            outside = self._envelope.outside(self._around.temperature_c, middle,
                                             float(self._leverage(middle)[0]))
            full = np.diag([0.0, UNMEASURED_VARIANCE, UNMEASURED_VARIANCE])
            axes = [AXES.index(a) for a in self.sensor.axes]
            full[np.ix_(axes, axes)] = covariance[:, :, 0]
            cell = self._cells[key] = _Cell(at, tuple(full[np.triu_indices(3)].tolist()),
                                            outside)
        return cell
