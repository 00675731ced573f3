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

    Attributes
    ----------
    force_mps2
        Specific force in the case frame, m/s², (3, n).
    force_std_mps2
        Standard deviations of the force, m/s², (3, n).
    covariance
        Covariance of the force, (m/s²)², (3, 3, n); very large for an axis that is not measured.
    tilt
        Angles of the samples with their standard deviations, rad, (n,) each.
    at_rail
        Whether the ADC was at a rail, (n,).
    outside
        Whether temperature or force lie outside of the validity range, (n,).
    volts
        Volts of the ADC, V, (n, m).

    """

    force_mps2: np.ndarray
    force_std_mps2: np.ndarray
    covariance: np.ndarray
    tilt: Tilt
    at_rail: np.ndarray
    outside: np.ndarray
    volts: np.ndarray

    @property
    def unsolved(self) -> np.ndarray:
        """Whether no force explains the sample, (n,)."""
        return np.isnan(self.force_mps2[0])


class RecordingEstimator:
    """Estimates force and tilt of the samples of one recording."""

    def __init__(self, sensor: Sensor, first: Recording, paper: bool = False,
                 undo_filter: bool = False) -> None:
        """
        Prepare for a recording.

        Parameters
        ----------
        sensor
            The unit by its calibration, at the sample rate of the recording.
        first
            First block of the recording. It begins the time since power-on, and has the columns
            of all blocks.
        paper
            Whether the paper's approximate inverse applies instead of the exact one.
        undo_filter
            Whether the RC filter is undone. The noise then is that before the filter.

        Raises
        ------
        UserError
            The sensor lacks axes that the paper's inverse needs.

        """
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
    """
    Return the effects of a unit that act on single samples and that no inverse undoes.

    Parameters
    ----------
    sensor
        The unit by its calibration.
    undo_filter
        Whether the RC filter is undone, which undoes the effects of the filter.

    Returns
    -------
    list
        Effects on the mean of the output, without those of stage and clock.

    """
    effects = [effect_named(name) for name in sensor.effects]
    return [effect for effect in effects
            if effect.acts_on is ActsOn.MEAN and not effect.invertible
            and effect.place < Place.CLOCK and Need.STAGE not in effect.needs
            and not (undo_filter and Need.FILTER in effect.needs)]
