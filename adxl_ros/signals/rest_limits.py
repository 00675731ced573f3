# SPDX-License-Identifier: Apache-2.0

"""Limits of what noise explains in a stream at rest: from a datasheet, or learned from it."""

from __future__ import annotations

from dataclasses import dataclass, fields

from adxl_ros.model.noise import effective_samples, sample_std_v
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals import block_statistics as stats
from adxl_ros.signals.block_statistics import Blocks, Spans
import numpy as np
import scipy

_FALSE_ALARM = 1e-6  # Probability that the variance of noise exceeds its limit
_QUARTILE_TO_STD = 0.3186  # First quartile of |normal deviate|, stds
_END_SIGMAS = 3.5  # Difference of an end of a rest that is cut, stds


@dataclass(frozen=True)
class SampleNoise:
    """Noise of one sample."""

    sigma: np.ndarray  # Standard deviation by axis, in the unit of the samples, (m,)
    tau_s: float = 0.0  # Time constant of the filter that correlates it, s


def datasheet_noise(sensor: Sensor) -> SampleNoise:
    """Return the noise of a sample by the datasheet values of a sensor, V."""
    return SampleNoise(sample_std_v(sensor), sensor.rc_s)


@dataclass(frozen=True)
class NoiseLimits:
    """Limits of what noise explains, for m axes."""

    variance: np.ndarray  # Largest variance within a window, (m,)
    # Standard deviation of the difference of two neighbouring halves, by octaves of their length,
    # (DRIFT_OCTAVES, m)
    drift: np.ndarray
    # Largest change of a mean by rounding of the ADC, where the input does not change, (m,)
    step: np.ndarray

    @property
    def flicker(self) -> np.ndarray:
        """Return the standard deviation of the difference of two very long means, (m,)."""
        # The longest halves have 2^(DRIFT_OCTAVES − 1) times the length of the shortest.
        white = self.drift[0] ** 2 / (1 << stats.DRIFT_OCTAVES - 1)
        return np.sqrt(np.maximum(self.drift[-1] ** 2 - white, 0))

    def block_noise(self, spans: Spans) -> np.ndarray:
        """Return the standard deviation of the mean of one block, (m,)."""
        return self.drift[0] * np.sqrt(spans.half / 2)

    def differ(self, before: np.ndarray, after: np.ndarray, spans: Spans) -> bool:
        """Return whether two sequences of means of blocks, (k, m), differ by more than noise."""
        white = self.block_noise(spans) ** 2 * (1 / len(before) + 1 / len(after))
        allowed = _END_SIGMAS * np.sqrt(white + self.flicker**2) + self.step
        return bool((np.abs(before.mean(axis=0) - after.mean(axis=0)) > allowed).any())


def largest_limits(first: NoiseLimits | None, second: NoiseLimits | None) -> NoiseLimits | None:
    """Return the larger limits of two; None where there are none."""
    if first is None or second is None:
        return first or second
    larger = {
        field.name: np.maximum(getattr(first, field.name), getattr(second, field.name))
        for field in fields(NoiseLimits)
    }
    return NoiseLimits(**larger)


def stated_limits(noise: SampleNoise, step: np.ndarray, spans: Spans) -> NoiseLimits:
    """
    Return the limits for a given noise, whose sample variance is chi-squared.

    A first-order filter correlates neighbours by a = exp(−dt/τ). The variance of n such samples
    scatters as the variance of n·(1 − a²)/(1 + a²) independent samples.
    """
    a = np.exp(-1 / (spans.rate_hz * noise.tau_s)) if noise.tau_s else 0.0
    freedom = max((spans.window * spans.size - 1) * (1 - a * a) / (1 + a * a), 1.0)
    ratio = max(scipy.special.chdtri(freedom, _FALSE_ALARM) / freedom, stats.MIN_VARIANCE_RATIO)
    sigma = np.hypot(noise.sigma, step / np.sqrt(12))
    halves = spans.half * spans.size << np.arange(stats.DRIFT_OCTAVES)
    drift = np.sqrt(2 / effective_samples(halves, 1 / spans.rate_hz, noise.tau_s))[:, None] * sigma
    return NoiseLimits(ratio * sigma**2, drift, stats.undithered(step, sigma))


def learned_limits(
    blocks: Blocks, windows: np.ndarray, step: np.ndarray, spans: Spans
) -> NoiseLimits | None:
    """Learn the limits from the quietest windows; None while the stream is too short."""
    if len(blocks) < max(spans.window, 2 * spans.half):
        return None
    variance, limit = stats.quiet_variance(blocks, windows, step)
    quiet = stats.quiet_blocks(blocks, windows, limit, spans.window)
    drift = np.empty((stats.DRIFT_OCTAVES, len(step)))
    for octave in range(stats.DRIFT_OCTAVES):
        half = spans.half << octave
        noise = _drift_noise(*stats.half_differences(blocks, quiet, half), half)
        white = np.sqrt(2 * variance / (half * spans.size))
        if octave:
            # Noise falls with the length, by no more than that of white noise.
            shorter = drift[octave - 1]
            noise = shorter / np.sqrt(2) if noise is None else np.minimum(noise, shorter)
        drift[octave] = white if noise is None else np.maximum(noise, white)
    return NoiseLimits(limit, drift, stats.undithered(step, np.sqrt(variance)))


def _drift_noise(differences: np.ndarray, valid: np.ndarray, half: int) -> np.ndarray | None:
    """
    Learn the standard deviation of the valid differences of halves, (m,); None if none is valid.

    A steady turn adds the same to all differences. Differences of two differences remove it. The
    first quartile of the magnitude is right even if most quiet blocks are no rest.
    """
    both = valid[: -2 * half] & valid[2 * half :]
    if both.any():
        noise = (differences[2 * half :] - differences[: -2 * half])[both] / np.sqrt(2)
    elif valid.any():
        noise = differences[valid]
    else:
        return None
    return np.quantile(np.abs(noise), 0.25, axis=0) / _QUARTILE_TO_STD


def differing_start(means: np.ndarray, longest: int, limits: NoiseLimits, spans: Spans) -> int:
    """
    Count the blocks at the start of a rest whose mean differs from the mean of the others.

    Starts of 1, 2, 4, … of the means of blocks, (k, m), are compared with the remainder of the
    rest. A start that differs is cut, up to `longest` blocks, and the search begins again after
    it.
    """
    white = limits.block_noise(spans)
    total = np.cumsum(means, axis=0)
    lengths = 1 << np.arange(max(longest, 1).bit_length())
    cut = 0
    while (lengths := lengths[cut + lengths <= longest]).size:
        remaining = len(means) - cut - lengths
        start_total = total[cut + lengths - 1]
        start_mean = (start_total - (total[cut - 1] if cut else 0.0)) / lengths[:, None]
        remaining_mean = (total[-1] - start_total) / remaining[:, None]
        noise = np.sqrt(white**2 * (1 / lengths + 1 / remaining)[:, None] + limits.flicker**2)
        differs = (np.abs(start_mean - remaining_mean) > _END_SIGMAS * noise + limits.step).any(
            axis=1
        )
        if not differs.any():
            break
        cut += int(lengths[differs.argmax()])
    return cut
