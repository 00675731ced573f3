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

"""The noise of each axis of a sensor at rest: fitted terms, drift, and what limits them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.noise_drift import Drift, find_drift
from adxl_ros.signals.noise_parameters import (
    coefficient_variances,
    Estimate,
    fit_noise,
    needed_time_s,
    NoiseFit,
)
from adxl_ros.signals.still_stretch import StillStretch
import numpy as np

TERMS = ('white', 'instability', 'walk')
"""The terms N, B and K, as the fields of `NoiseFit`."""

_UNFILTERED = 0.8
"""Variance of a sample, divided by that of unfiltered white noise, from which there is no filter.
Chosen: a filter at a third of the sample rate."""
_FILTER_OHM = 1.0e4
"""Resistance of the filter that stands for an unknown one, Ω. Chosen: only the product with the
capacitor matters."""


@dataclass(frozen=True)
class AxisNoise:
    """
    The noise of one axis.

    Attributes
    ----------
    axis
        Its letter.
    fit
        White noise, bias instability and random walk, in m/s².
    drift
        A drift that is no noise; None where there is none.
    sample_std
        Standard deviation of a sample, m/s².
    resolution
        Smallest change of a sample, m/s².
    lowest_s, lowest
        Time, s, and value, m/s², of the lowest point of the Allan deviation.
    needed_s
        Time that would show half of a term's upper limit, s, by name of the terms that are not
        seen.

    """

    axis: str
    fit: NoiseFit
    drift: Drift | None
    sample_std: float
    resolution: float
    lowest_s: float
    lowest: float
    needed_s: dict[str, float]

    @property
    def estimates(self) -> tuple[Estimate, Estimate, Estimate]:
        """N in m/s²/√Hz, B in m/s², and K in m/s²/√s."""
        return self.fit.white, self.fit.instability, self.fit.walk


@dataclass(frozen=True)
class RecordingNoise:
    """
    The noise of a recording.

    Attributes
    ----------
    path
        The recording.
    rest
        Its samples at rest.
    axes
        The noise by axis.

    """

    path: str
    rest: StillStretch
    axes: list[AxisNoise]


def recording_noise(path: str, rest: StillStretch, axes: str, show: Callable[[float], None]
                    ) -> RecordingNoise:
    """
    Fit the noise of all axes.

    Parameters
    ----------
    path
        The recording.
    rest
        The samples at rest.
    axes
        Letters of the axes.
    show
        Shows which share of the axes is done.

    Returns
    -------
    RecordingNoise
        The noise by axis.

    """
    variances = coefficient_variances(len(rest.means), rest.step_s)
    noises = []
    for i, axis in enumerate(axes):
        means = rest.means[:, i]
        fit = fit_noise(means, rest.step_s, variances)
        drift = find_drift(means, rest.step_s, variances, fit, rest.temperature_c)
        needed_s = {name: needed_time_s(fit, term, rest.span_s) for term, name in enumerate(TERMS)
                    if not getattr(fit, name).is_seen}
        deviation = rest.allan.deviation[:, i]
        lowest = int(np.argmin(deviation))
        noises.append(AxisNoise(axis, fit, drift, float(rest.sample_std[i]),
                                float(rest.resolution[i]), float(rest.allan.tau_s[lowest]),
                                float(deviation[lowest]), needed_s))
        show((i + 1) / len(axes))
    return RecordingNoise(path, rest, noises)


def density_g_per_rthz(noise: AxisNoise) -> float:
    """
    Return the density of white noise as datasheets state it, g/√Hz.

    Theirs is over positive frequencies alone, so its square is twice N².
    """
    return float(np.sqrt(2)) * noise.fit.white.value / G0_MPS2


def with_noise(sensor: Sensor, noises: list[AxisNoise]) -> Sensor:
    """
    Give a sensor the measured noise.

    White noise is its density. Bias instability is the effect `flicker`, whose density over
    positive frequencies is B²/(π·f), and random walk is `bias_walk`. A term that is not seen on
    an axis is 0 there.

    Where the filter is not stated, it is the first-order one that gives a sample the measured
    noise: white noise of the density 2·N² over positive frequencies has the variance N²/(2·RC)
    behind it. A rest shows neither range nor resolution: where they are not stated, the
    placeholders of `Sensor` stay, which limit and round nothing.

    Parameters
    ----------
    sensor
        The sensor, with the axes and the rate of the recording.
    noises
        The noise by axis.

    Returns
    -------
    Sensor
        The sensor with its other values as they were.

    """
    values = {name: value for name, value in sensor.values.items()
              if name not in ('noise_excess', 'flicker', 'bias_walk')}
    flicker, walk = (np.array([noise.estimates[term].value * noise.estimates[term].is_seen
                               for noise in noises]) / G0_MPS2 for term in (1, 2))
    if flicker.any():
        values['flicker'] = {'density_g_per_rthz': flicker / np.sqrt(np.pi)}
    if walk.any():
        values['bias_walk'] = {'density_g_per_rts': walk}
    kept = [name for name in sensor.effects if name in values]
    changed: dict[str, Any] = {
        'effects': (*kept, *(name for name in values if name not in kept)), 'values': values,
        'noise_density_g_per_rthz': np.array(list(map(density_g_per_rthz, noises)))}
    if 'rc_capacitance_f' in sensor.unstated:
        changed |= {'rc_resistance_ohm': _FILTER_OHM,
                    'rc_capacitance_f': _filter_s(noises, sensor.rate_hz) / _FILTER_OHM}
    return replace(sensor, unstated=(), **changed)


def _filter_s(noises: list[AxisNoise], rate_hz: float) -> float:
    """Return the time constant that the noise of a sample shows, s; 0 for no filter."""
    white = float(np.mean([noise.fit.white.value ** 2 for noise in noises]))
    variance = float(np.mean([noise.sample_std ** 2 for noise in noises]))
    return white / (2 * variance) if variance < _UNFILTERED * white * rate_hz else 0.0
