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

"""
Checks of a drift: whether the noise is the same all the time, and has the spectrum of the drift.

The evidence alone cannot distinguish a drift from other slow changes. A drift has the same power
in all blocks, and a random walk has its expected power in every octave. A warm draught or a floor
that sways has most of its power in a few octaves. A drift also goes on while the stage rests. What
the form of another effect lacks is new after each move, and then stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

from adxl_ros.diagnose.evidence import block_edges
from adxl_ros.diagnose.noise_whitening import before_filters, RANDOM_WALKS_G_PER_RTS, Whitener
from adxl_ros.model import noise
from adxl_ros.model.diagnosis_hints import DriftSpectrum
from adxl_ros.model.effects import effect_named
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.runs import true_runs
import numpy as np
import scipy

_OCTAVE_RATIO = 4.0
"""Power in a run of octaves, divided by that of the random walk, differs too much above this ratio
or below its inverse. Tuned by hand on simulated recordings of the working seeds of the blind
check."""
_INDEPENDENT_SHARE = 0.6
"""Share of neighbouring frequencies under a Hann window that are independent (Harris 1978)."""
_CORRELATION_S = 0.1
"""Time over which strong noise of another colour than the filter's stays correlated, s. Tuned by
hand on simulated flicker noise of another form than the library's."""
_SHORTEST_REST_S = 1.0
"""Shortest rest within which a drift can show, s. Chosen: the noise then has some independent
samples."""
_LOG_LEVEL_RANGE = 3.0
"""Largest magnitude of the logarithm of a walk's power, relative to that of its filter. Chosen:
wider than the grid."""
_BAND_OCTAVES = 4
"""Highest frequency of the fit of a walk's power, divided by the highest one at which the walk
dominates. Chosen: two octaves more."""


@dataclass(frozen=True)
class ResidualChannel:
    """
    The residual of a hypothesis on one axis of one recording.

    Attributes
    ----------
    residual_v
        Residual, bridged over samples that are not used, V, (n,).
    used
        Samples that are used, (n,) bool.
    rate_hz
        Sample rate, Hz.
    whitener
        The filter of the hypothesis.
    weakest_walk
        The filter of the weakest random walk, which stands for no drift.
    innovation_variance_v2
        Variance of the whitened residual, V².

    """

    residual_v: np.ndarray
    used: np.ndarray
    rate_hz: float
    whitener: Whitener
    weakest_walk: Whitener
    innovation_variance_v2: float

    def whitened_v(self) -> np.ndarray:
        """Return the whitened residual, V, (n,), zero where samples are not used."""
        series = before_filters([self.whitener], self.residual_v[None])
        white = self.whitener(series)[0] * self.used
        # The first sample is a step from zero.
        white[0] = 0.0
        return white


def weakest_walk(filters: Sequence[Whitener]) -> Whitener:
    """Return the filter of the weakest random walk."""
    return next(f for f in filters if f.density == RANDOM_WALKS_G_PER_RTS[0])


def unevenness(channels: Sequence[ResidualChannel]) -> float:
    """
    Return how much the power of the noise differs between blocks.

    It is the rms, over blocks, of the deviation of each block's squares from the mean. Its unit is
    the standard deviation of such a sum (of correlated samples by Bartlett 1946). The axis with
    the largest value counts. Noise that is the same all the time has about 1.
    """
    largest = 0.0
    for channel in channels:
        white, used = channel.whitened_v(), channel.used
        if not white.any():
            continue
        spectrum = np.abs(np.fft.rfft(white, 2 * len(white))) ** 2
        autocovariance = np.fft.irfft(spectrum)[:1 + int(_CORRELATION_S * channel.rate_hz)]
        variance_factor = 1 + 2 * float(np.sum((autocovariance[1:] / autocovariance[0]) ** 2))
        edges = block_edges(len(white))[:-1]
        counts = np.add.reduceat(used, edges).astype(float)
        squares = np.add.reduceat(white ** 2, edges)[counts > 0]
        counts = counts[counts > 0]
        deviation = (squares / counts * used.sum() / squares.sum() - 1) \
            * np.sqrt(counts / 2 / variance_factor)
        largest = max(largest, float(np.sqrt(np.mean(deviation ** 2))))
    return largest


def log_bayes_factor_within_rests(channel: ResidualChannel, at_rest: np.ndarray, sensor: Sensor,
                                  axis: int) -> float:
    """
    Return the log Bayes factor of a drift over that of a healthy unit, within rests.

    It compares the mean of the last third of each rest of length T with that of the first third.
    The variance of their difference is w²·T·5/9 for a random walk of density w, and 3·h² for 1/f
    noise of density h, besides that of the noise.

    Parameters
    ----------
    channel
        Residual of one axis, with the filter of the drift.
    at_rest
        Samples that rest, (n,) bool.
    sensor
        The baseline at the rate of the residual.
    axis
        Index of the axis.

    Returns
    -------
    float
        The log Bayes factor; 0 where nothing rests, or where the drift is that of a healthy unit.

    """
    if channel.whitener.healthy:
        return 0.0
    dt_s, rc_s = 1 / sensor.rate_hz, float(noise.electronics(sensor).rc_s[axis])
    noise_v2 = float(noise.sample_std_v(sensor)[axis]) ** 2
    scale_v_per_g = float(sensor.scale_v_per_g[axis])
    healthy = effect_named(channel.whitener.effect).diagnosis.healthy_density
    walks = channel.whitener.spectrum is DriftSpectrum.RANDOM_WALK
    total = 0.0
    for first, stop in true_runs(at_rest & channel.used):
        length_s, third = (stop - first) * dt_s, (stop - first) // 3
        if length_s < _SHORTEST_REST_S:
            continue
        change_v = channel.residual_v[stop - third:stop].mean() \
            - channel.residual_v[first:first + third].mean()
        mean_v2 = 2 * noise_v2 / float(noise.effective_samples(third, dt_s, rc_s))
        factor = length_s * 5 / 9 if walks else 3.0
        drift_v2, healthy_v2 = (mean_v2 + factor * (density * scale_v_per_g) ** 2
                                for density in (channel.whitener.density, healthy))
        total += 0.5 * float(np.log(healthy_v2 / drift_v2)
                             + change_v ** 2 * (1 / healthy_v2 - 1 / drift_v2))
    return total


def walk_log_bayes_factor(channels: Sequence[ResidualChannel]) -> float:
    """
    Return the log Bayes factor against random walks by the power in their octaves.

    It is Whittle's likelihood ratio of the whitened residual, summed over the axes that walk more
    than a healthy unit's. The alternative has another power in one run of octaves. Without a
    random walk it is 0.
    """
    return sum(_octaves_log_bayes_factor(*_octaves(channel)) for channel in channels
               if channel.whitener.spectrum is DriftSpectrum.RANDOM_WALK
               and not channel.whitener.healthy)


def _octaves(channel: ResidualChannel) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the number of frequencies in each octave, and their power divided by the expected one.

    The octaves reach up to the frequency where the walk no longer dominates.
    """
    white = channel.whitened_v()
    taper = np.sqrt(8 / 3) * np.hanning(len(white))
    power = np.abs(np.fft.rfft(white * taper)) ** 2 \
        / (channel.used.sum() * channel.innovation_variance_v2)
    angle = 2 * np.pi * np.arange(len(power)) / len(white)
    gain, healthy_gain = (np.abs(scipy.signal.sosfreqz(f.sections, angle)[1]) ** 2
                          for f in (channel.whitener, channel.weakest_walk))
    # Share of the whitened power that does not walk.
    share = np.zeros(len(power))
    share[1:] = np.minimum(gain[1:] / healthy_gain[1:] * (healthy_gain[-1] / gain[-1]), 1.0)
    top = int(np.argmax(share > 0.5))
    band = slice(1, _BAND_OCTAVES * top)

    def negative_log_likelihood(log_level: float) -> float:
        mean = share[band] + np.exp(log_level) * (1 - share[band])
        return float(np.sum(np.log(mean) + power[band] / mean))

    # The grid of filters is coarse, so that the power of the walk is fitted.
    level = np.exp(scipy.optimize.minimize_scalar(negative_log_likelihood, method='bounded',
                                                  bounds=(-_LOG_LEVEL_RANGE, _LOG_LEVEL_RANGE)).x)
    power = power / (share + level * (1 - share))
    edges = np.unique(np.minimum(2 ** np.arange(int(np.log2(max(top, 1))) + 2), top))
    return np.diff(edges), np.array([power[i:j].mean() for i, j in pairwise(edges)])


def _octaves_log_bayes_factor(counts: np.ndarray, means: np.ndarray) -> float:
    """Return the largest log likelihood ratio of another power in a run of octaves."""
    largest = 0.0
    for begin, end in combinations(range(len(counts) + 1), 2):
        count = counts[begin:end].sum()
        mean = max(float(np.average(means[begin:end], weights=counts[begin:end])), 1e-9)
        if not 1 / _OCTAVE_RATIO < mean < _OCTAVE_RATIO:
            largest = max(largest, _INDEPENDENT_SHARE * count * (mean - 1 - np.log(mean)))
    return largest
