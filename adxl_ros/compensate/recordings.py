# SPDX-License-Identifier: Apache-2.0

"""Specific force and tilt of whole recordings, with standard deviations, block by block."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from adxl_ros.compensate import filter_inversion, paper_inverse
from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import Recording
from adxl_ros.model import noise, signal_chain
from adxl_ros.model.covariance import prepared_covariance
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import (
    ActsOn,
    Effect,
    Environment,
    Need,
    NOMINAL_ENVIRONMENT,
    Place,
)
from adxl_ros.model.sensor import Sensor
from adxl_ros.model.tilt import Tilt, tilt
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
        self._inverse = (paper_inverse if paper else signal_chain).inverse(sensor)
        self._covariance = prepared_covariance(
            sensor, filter_inversion.noise_variance_v2(sensor) if undo_filter else None)

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
        return filter_inversion.undo_blocks(
            ((pair, pair[0].time_s, pair[1]) for pair in measured),
            noise.electronics(self._sensor).rc_s, self._sensor.rate_hz)

    def _environment(self, block: Recording) -> Environment:
        """Return the surroundings of the samples; nominal where they are not measured."""
        environment = NOMINAL_ENVIRONMENT._replace(time_s=block.time_s - self._begin_s)
        for name in ('temperature_c', 'supply_v'):
            values = block.columns.get(name)
            if values is not None:
                nominal = getattr(NOMINAL_ENVIRONMENT, name)
                environment = environment._replace(
                    **{name: np.where(np.isfinite(values), values, nominal)})
        return environment

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
            and effect.place < Place.CLOCK and Need.STAGE not in effect.needs
            and not (undo_filter and Need.FILTER in effect.needs)]
