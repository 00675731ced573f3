# SPDX-License-Identifier: Apache-2.0

"""
Recorded noise compared with simulated noise: power by band, Allan deviation, likelihood.

The rms of a gap does not show noise-like effects. The residual is therefore compared with noise
that the simulator draws.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy

_BANDS = 5
"""Number of bands of frequency. Chosen: some half a decade each."""
_LOWEST_EDGE_HZ = 0.05
"""Smallest frequency from which the edges of the bands are spaced, Hz. Chosen: a period of 20 s.
The lowest band begins at 0."""
_TIMES_S = (0.1, 1.0, 10.0)
"""Averaging times of the Allan deviation, s. Chosen: one for each decade."""
_SEGMENT_S = 16.0
"""Length of a segment of the simulated spectrum, s. Chosen: some ten segments in three minutes."""
_LOWEST_POWER = 1e-6
"""Smallest power of the simulated spectrum, divided by its largest. Chosen: above rounding
errors."""


@dataclass(frozen=True)
class NoiseComparison:
    """Recorded noise relative to simulated noise, all axes together."""

    band_edges_hz: tuple[float, ...]  # Edges of the k bands of frequency, Hz, (k + 1,)
    # Recorded power divided by simulated power, for each band, (k,)
    power_ratio: tuple[float, ...]
    averaging_times_s: tuple[float, ...]  # Averaging times of the Allan deviation, s, (j,)
    allan_ratio: tuple[float, ...]  # Recorded Allan deviation divided by the simulated one, (j,)
    # Log likelihood of the recorded spectrum under the simulated one (Whittle 1953)
    log_likelihood: float
    simulated_std_mps2: float  # Rms of the simulated noise over samples and axes, m/s²


def compare_noise(residual_v: np.ndarray, simulated_v: np.ndarray, rate_hz: float,
                  scale_v_per_mps2: np.ndarray) -> NoiseComparison:
    """
    Compare a residual with drawn noise.

    residual_v: residual, bridged over samples that are not used, V, (n, m); simulated_v: drawn
    noise, V, (n, m); scale_v_per_mps2: scale factor by axis, V/(m/s²), (m,).
    """
    recorded = (residual_v - residual_v.mean(axis=0)) / scale_v_per_mps2
    simulated = (simulated_v - simulated_v.mean(axis=0)) / scale_v_per_mps2
    frequency_hz, power = scipy.signal.periodogram(recorded, rate_hz, axis=0)
    _, simulated_power = scipy.signal.periodogram(simulated, rate_hz, axis=0)
    edges_hz = np.geomspace(max(frequency_hz[1], _LOWEST_EDGE_HZ), rate_hz / 2, _BANDS + 1)
    edges_hz[0] = 0.0
    bands = [(frequency_hz > low) & (frequency_hz <= high) for low, high in pairwise(edges_hz)]
    length = min(round(_SEGMENT_S * rate_hz), len(simulated))
    welch_hz, level = scipy.signal.welch(simulated, rate_hz, nperseg=max(length, 8), axis=0)
    expected = np.column_stack([np.interp(frequency_hz[1:], welch_hz[1:], v[1:])
                                for v in level.T])
    expected = np.maximum(expected, _LOWEST_POWER * expected.max())
    times_s = [t for t in _TIMES_S
               if t * rate_hz >= 2 and t * 10 < len(recorded) / rate_hz]
    return NoiseComparison(
        band_edges_hz=tuple(edges_hz.tolist()),
        power_ratio=tuple(float(power[band].sum() / simulated_power[band].sum())
                          for band in bands),
        averaging_times_s=tuple(times_s),
        allan_ratio=tuple(_allan_ratio(recorded, simulated, round(t * rate_hz))
                          for t in times_s),
        log_likelihood=-float(np.sum(power[1:] / expected + np.log(expected))),
        simulated_std_mps2=float(np.sqrt(np.mean(simulated ** 2))))


def _allan_ratio(recorded: np.ndarray, simulated: np.ndarray, count: int) -> float:
    """Return the rms over axes of the ratio of Allan deviations of `count` samples."""
    ratio = allan_deviation(recorded, count) / allan_deviation(simulated, count)
    return float(np.sqrt(np.mean(ratio ** 2)))


def allan_deviation(values: np.ndarray, count: int) -> np.ndarray:
    """
    Compute the overlapping Allan deviation of means of `count` samples (IEEE 1554).

    values: series of m axes, (n, m); returns: allan deviation by axis, in the unit of the values,
    (m,).
    """
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    second_difference = total[2 * count:] - 2 * total[count:-count] + total[:-2 * count]
    return np.sqrt(np.mean(second_difference ** 2, axis=0) / 2) / count
