# SPDX-License-Identifier: Apache-2.0

"""Specific force and tilt of whole recordings, with standard deviations, block by block."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from adxl_ros.compensate.inversions import (
    noise_variance_v2,
    paper_inverse,
    undo_filter_blocks,
)
from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import Recording
from adxl_ros.model import noise, signal_chain
from adxl_ros.model.covariance import prepared_covariance, UNMEASURED_VARIANCE
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import (
    ActsOn,
    ARRAYS,
    Concern,
    Effect,
    Environment,
    Need,
    NOMINAL_ENVIRONMENT,
    Place,
)
from adxl_ros.model.kinematics import (
    quaternion,
    roll_pitch_covariance,
    Tilt,
    tilt,
    UNKNOWN_ANGLE_RAD2,
)
from adxl_ros.model.sensor import Sensor
import numpy as np


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

    def __init__(self, sensor: Sensor, first: Recording, paper: bool = False,
                 undo_filter: bool = False) -> None:
        """Prepare for a recording."""
        if paper and sensor.axes == 'x':
            raise UserError('--inverse paper: needs the axes x and y, the sensor has x; leave it '
                            'out')
        if 'temperature_c' not in first.columns:
            sensor = sensor.without_temperature_range()
        self._sensor, self._undo_filter = sensor, undo_filter
        self._begin_s = float(first.time_s[0])
        self._inverse = (paper_inverse if paper else signal_chain.inverse)(sensor)
        self._covariance = prepared_covariance(
            sensor, noise_variance_v2(sensor) if undo_filter else None)

    def blocks(self, recording: Iterable[Recording]) -> Iterator[tuple[Recording, Estimates]]:
        """Yield each block of the recording with its estimates."""
        measured = ((block, block.volts(self._sensor)) for block in recording)
        for (block, volts), input_v in self._before_filter(measured):
            yield block, self._estimate(volts, input_v, self._environment(block))

    def _before_filter(self, measured: Iterable[tuple[Recording, np.ndarray]]
                       ) -> Iterator[tuple[tuple[Recording, np.ndarray], np.ndarray]]:
        """Return blocks and volts, (n, m), with the volts before the RC filter if it is undone."""
        if not self._undo_filter:
            return ((pair, pair[1]) for pair in measured)
        return undo_filter_blocks(
            ((pair, pair[0].time_s, pair[1]) for pair in measured),
            noise.electronics(self._sensor).rc_s, self._sensor.rate_hz)

    def _environment(self, block: Recording) -> Environment:
        """Return the surroundings of the samples; nominal where they are not measured."""
        measured = {name: block.columns[name] for name in ('temperature_c', 'supply_v')
                    if name in block.columns}
        return NOMINAL_ENVIRONMENT._replace(time_s=block.time_s - self._begin_s, **{
            name: np.where(np.isfinite(values), values, getattr(NOMINAL_ENVIRONMENT, name))
            for name, values in measured.items()})

    def _estimate(self, volts: np.ndarray, input_v: np.ndarray, environment: Environment
                  ) -> Estimates:
        """Estimate from volts of the ADC and before the filter; rails determine no quantity."""
        sensor = self._sensor
        at_rail = signal_chain.at_a_rail(volts, sensor)
        with np.errstate(all='ignore'):  # some volts have no solution
            force = self._inverse(list(input_v.T), environment)
            covariance, leverage = self._covariance(force, environment)
            outside = np.isfinite(force[0]) & sensor.envelope.is_outside(
                environment.temperature_c, force, leverage)
            covariance[:, :, at_rail] = np.inf
            angles = tilt(force, covariance, 'z' in sensor.axes)
        force_mps2 = np.array(force)
        force_std_mps2 = np.sqrt([covariance[d, d] for d in range(3)])
        if sensor.axes == 'x':
            force_mps2[1:] = np.nan
        force_std_mps2[np.isnan(force_mps2)] = np.inf
        return Estimates(force_mps2, force_std_mps2, covariance, angles, at_rail, outside, volts)


def effects_left(sensor: Sensor, undo_filter: bool) -> list[Effect]:
    """Return the effects of a unit that act on single samples and that no inverse undoes."""
    effects = [effect_named(name) for name in sensor.effects]
    return [effect for effect in effects
            if effect.acts_on is ActsOn.MEAN and not effect.invertible
            and effect.place < Place.CLOCK and effect.concern is not Concern.STAGE
            and not (undo_filter and Need.FILTER in effect.needs)]


class ImuFields:
    """
    Makes the fields of `imu/data` and `tilt`, block by block.

    An angle that a sample does not show keeps its last value, 0 before the first, with a very
    large variance. So has a force that the sample does not determine.
    """

    def __init__(self) -> None:
        """Begin with angles of 0."""
        self._last_rad = np.zeros(3)

    def __call__(self, estimates: Estimates) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """
        Return the fields of sensor_msgs/Imu and the tilt of the samples that have a solution.

        returns: fields by name, (n, k) each. The yaw of the orientation is 0 and unknown. Roll,
        pitch and inclination, rad, (n, 3).
        """
        unsolved = estimates.unsolved
        solved = ~unsolved if unsolved.any() else slice(None)  # a slice copies nothing
        force = estimates.force_mps2[:, solved]
        force = np.where(np.isnan(force), 0.0, force)
        covariance = _known(estimates.covariance[:, :, solved])
        tilt = estimates.tilt
        shown_rad = np.stack([tilt.roll, tilt.pitch, tilt.inclination])[:, solved]
        std_rad = np.stack([tilt.roll_std, tilt.pitch_std])[:, solved]
        angles_rad = self._held(shown_rad)
        variance = np.where(np.isfinite(std_rad), std_rad ** 2, UNKNOWN_ANGLE_RAD2)
        return {'linear_acceleration': force.T,
                'linear_acceleration_covariance': covariance.reshape(9, -1).T,
                'orientation': np.stack(quaternion(angles_rad[0], angles_rad[1], ARRAYS)).T,
                'orientation_covariance': _orientation_covariance(force, covariance, *variance).T
                }, angles_rad.T

    def _held(self, angles_rad: np.ndarray) -> np.ndarray:
        """Return angles, rad, (3, n), with the last known value in place of NaN."""
        if angles_rad.size and not np.isnan(angles_rad).any():
            self._last_rad = angles_rad[:, -1]
            return angles_rad
        angles_rad = np.concatenate([self._last_rad[:, None], angles_rad], axis=1)
        rows = np.where(np.isnan(angles_rad), 0, np.arange(angles_rad.shape[1]))
        held = np.take_along_axis(angles_rad, np.maximum.accumulate(rows, axis=1), axis=1)
        self._last_rad = held[:, -1]
        return held[:, 1:]


def _known(covariance: np.ndarray) -> np.ndarray:
    """Return covariances, (m/s²)², (3, 3, n), with a very large one in place of infinite ones."""
    unknown = np.diag(np.full(3, UNMEASURED_VARIANCE))[:, :, None]
    return np.where(np.isfinite(covariance).all(axis=(0, 1)), covariance, unknown)


def _orientation_covariance(force: np.ndarray, covariance: np.ndarray, roll_rad2: np.ndarray,
                            pitch_rad2: np.ndarray) -> np.ndarray:
    """
    Return the elements of the covariance of roll, pitch and yaw, row after row.

    force: specific force, m/s², (3, n); covariance: its covariance, (m/s²)², (3, 3, n); roll_rad2,
    pitch_rad2: variances, rad², (n,); returns: the covariance, rad², (9, n).
    """
    components = tuple(covariance[i, j] for i in range(3) for j in range(i, 3))
    both = roll_pitch_covariance(list(force), components, ARRAYS)
    is_known = np.maximum(roll_rad2, pitch_rad2) < UNKNOWN_ANGLE_RAD2
    elements = np.zeros((9, len(roll_rad2)))
    elements[0], elements[4], elements[8] = roll_rad2, pitch_rad2, UNKNOWN_ANGLE_RAD2
    elements[1] = elements[3] = np.where(is_known, both, 0.0)
    return elements
