# SPDX-License-Identifier: Apache-2.0

"""Limits of variance and drift that noise explains, from the datasheet or learned."""

from __future__ import annotations

from dataclasses import dataclass

from adxl_ros.model.constants import MAD_TO_STD
from adxl_ros.model.noise import effective_samples, sample_std_v
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.block_statistics import block_samples, Blocks
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
import scipy

_WINDOW_S = 0.25
"""Length of the window of a variance, s. Chosen: under half of the shortest rest."""
_WINDOW_SAMPLES = 8
"""Smallest number of samples in that window. Chosen: fewer do not show a variance."""
_HALF_S = 0.5
"""Shortest length of the neighbouring halves whose means are compared, s. Chosen: two windows."""
DRIFT_OCTAVES = 4
"""Number of lengths of halves: 0.5, 1, 2 and 4 s. Chosen: beyond, a sensor's flicker dominates."""
_MIN_VARIANCE_RATIO = 2.25
"""Smallest limit of a variance, relative to that of the noise: 1.5 times its rms."""
_MAX_VARIANCE_RATIO = 9.0
"""Largest limit of a variance, relative to that of the noise: 3 times its rms."""
_FALSE_ALARM = 1e-6
"""Probability that the variance of noise exceeds its limit."""
_QUIETEST_SHARE = 0.05
"""Quantile of the windows' variances at which the search for the variance of noise begins."""
_QUIET_RATIO = 3.0
"""Largest variance of a quiet window, relative to that of the noise."""
_QUIET_STEPS = 50
"""Largest number of steps of that search."""
_QUIET_DEVIATIONS = 5.0
"""Distance of a variance's limit from the noise, standard deviations of ln(variance)."""
_QUARTILE_TO_STD = 0.3186
"""First quartile of a normal deviate's magnitude, relative to its standard deviation."""
_ROUNDING = 1e-9
"""Relative rounding error of samples without noise."""
_TINY_VARIANCE = 1e-300
"""Lower bound of a variance, in squares of any unit, so that its logarithm is finite."""
END_SIGMAS = 3.5
"""Difference of an end of a rest from its middle beyond which it is cut, standard deviations."""


@dataclass(frozen=True)
class Noise:
    """Noise of one sample."""

    sigma: np.ndarray  # Standard deviation by axis, in the unit of the samples, (m,)
    tau_s: float = 0.0  # Time constant of the filter that correlates it, s


def datasheet_noise(sensor: Sensor) -> Noise:
    """Return the noise of a sample by the datasheet values of a sensor, V."""
    return Noise(sample_std_v(sensor), sensor.rc_s)


@dataclass(frozen=True)
class Spans:
    """Lengths of windows in blocks."""

    # size, dt_s: Samples in a block, and the time between them, s
    size: int
    dt_s: float
    window: int  # Blocks of the window of a variance; odd, so that one is in the middle
    half: int  # Blocks of the shortest halves whose means are compared

    @staticmethod
    def for_rate(rate_hz: float) -> Spans:
        """Return the lengths for a sample rate, Hz."""
        size = block_samples(rate_hz)
        block_s = size / rate_hz
        window = max(round(_WINDOW_S / block_s), -(-_WINDOW_SAMPLES // size)) // 2 * 2 + 1
        return Spans(size, 1 / rate_hz, window, max(round(_HALF_S / block_s), 4))

    @property
    def block_s(self) -> float:
        """Return the length of a block, s."""
        return self.size * self.dt_s

    @property
    def longest(self) -> int:
        """Return the number of blocks in both longest halves together."""
        return self.half << DRIFT_OCTAVES


@dataclass(frozen=True)
class NoiseLimits:
    """Limits of what noise explains, for m axes."""

    variance: np.ndarray  # Largest variance within a window, (m,)
    # Standard deviation of the difference of two neighbouring halves, by octaves of their length,
    # (DRIFT_OCTAVES, m)
    drift: np.ndarray
    # Largest change of a mean by rounding of the ADC, where the input does not change, (m,)
    step: np.ndarray

    def larger(self, other: NoiseLimits) -> NoiseLimits:
        """Return the larger of each limit."""
        return NoiseLimits(np.maximum(self.variance, other.variance),
                           np.maximum(self.drift, other.drift), np.maximum(self.step, other.step))

    @property
    def flicker(self) -> np.ndarray:
        """Return the standard deviation of the difference of two very long means, (m,)."""
        # The longest halves have 2^(DRIFT_OCTAVES − 1) times the length of the shortest.
        white = self.drift[0] ** 2 / (1 << DRIFT_OCTAVES - 1)
        return np.sqrt(np.maximum(self.drift[-1] ** 2 - white, 0))

    def block_noise(self, spans: Spans) -> np.ndarray:
        """Return the standard deviation of the mean of one block, (m,)."""
        return self.drift[0] * np.sqrt(spans.half / 2)

    def differ(self, before: np.ndarray, after: np.ndarray, spans: Spans, sigmas: float) -> bool:
        """
        Return whether two sequences of blocks differ by more than noise.

        before, after: means of blocks, (k, m) each.
        """
        white = self.block_noise(spans) ** 2 * (1 / len(before) + 1 / len(after))
        allowed = sigmas * np.sqrt(white + self.flicker ** 2) + self.step
        return bool((np.abs(before.mean(axis=0) - after.mean(axis=0)) > allowed).any())


def stated_limits(noise: Noise, step: np.ndarray, spans: Spans) -> NoiseLimits:
    """
    Return the limits for a given noise, whose sample variance is chi-squared.

    A first-order filter correlates neighbours by a = exp(−dt/τ). The variance of n such samples
    scatters as the variance of n·(1 − a²)/(1 + a²) independent samples.

    Parameters
    ----------
    noise
        Noise of one sample.
    step
        Step of the ADC, (m,).
    spans
        Lengths for the rate of the stream.

    Returns
    -------
    NoiseLimits
        Limits in the unit of the noise.

    """
    a = np.exp(-spans.dt_s / noise.tau_s) if noise.tau_s else 0.0
    freedom = max((spans.window * spans.size - 1) * (1 - a * a) / (1 + a * a), 1.0)
    ratio = max(scipy.special.chdtri(freedom, _FALSE_ALARM) / freedom, _MIN_VARIANCE_RATIO)
    sigma = np.hypot(noise.sigma, step / np.sqrt(12))
    halves = spans.half * spans.size << np.arange(DRIFT_OCTAVES)
    drift = np.sqrt(2 / effective_samples(halves, spans.dt_s, noise.tau_s))[:, None] * sigma
    return NoiseLimits(ratio * sigma ** 2, drift, undithered(step, sigma))


def learned_limits(blocks: Blocks, windows: np.ndarray, step: np.ndarray,
                   spans: Spans) -> NoiseLimits | None:
    """
    Learn the limits from the quietest windows; they are at least the limits of the ADC's step.

    Parameters
    ----------
    blocks, windows
        Blocks of a stream and their `window_variance`.
    step
        Step of the ADC, (m,).
    spans
        Lengths for the rate of the stream.

    Returns
    -------
    NoiseLimits or None
        None while the stream is too short.

    """
    if len(blocks) < max(spans.window, 2 * spans.half) or not blocks.count.any():
        return None
    variance, limit = quiet_variance(blocks, windows, step)
    quiet = quiet_blocks(blocks, windows, limit, spans.window)
    drift = np.empty((DRIFT_OCTAVES, len(step)))
    for octave in range(DRIFT_OCTAVES):
        half = spans.half << octave
        noise = _drift_noise(*half_differences(blocks, quiet, half), half)
        white = np.sqrt(2 * variance / (half * spans.size))
        if octave:
            # Noise falls with the length, by no more than that of white noise.
            shorter = drift[octave - 1]
            noise = shorter / np.sqrt(2) if noise is None else np.minimum(noise, shorter)
        drift[octave] = white if noise is None else np.maximum(noise, white)
    return NoiseLimits(limit, drift, undithered(step, np.sqrt(variance)))


def _drift_noise(differences: np.ndarray, valid: np.ndarray, half: int) -> np.ndarray | None:
    """
    Learn the standard deviation of the valid differences of halves, (m,); None if none is valid.

    A steady turn adds the same to all differences. Differences of two differences remove it. The
    first quartile of the magnitude is right even if most quiet blocks are no rest.
    """
    both = valid[:-2 * half] & valid[2 * half:]
    if both.any():
        noise = (differences[2 * half:] - differences[:-2 * half])[both] / np.sqrt(2)
    elif valid.any():
        noise = differences[valid]
    else:
        return None
    return np.quantile(np.abs(noise), 0.25, axis=0) / _QUARTILE_TO_STD


def quiet_variance(blocks: Blocks, windows: np.ndarray,
                   step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Learn the variance that the quietest windows have in common, and its limit.

    Noise below the ADC's step makes at most two neighbouring codes equally frequent: a variance
    of a quarter of the squared step. Samples without any noise still have a rounding error.

    Parameters
    ----------
    blocks, windows
        Blocks of a stream and their `window_variance`.
    step
        Step of the ADC, (m,).

    Returns
    -------
    tuple
        Variance of the noise and limit of a variance, (m,) each.

    """
    middle = np.median(np.abs(blocks.mean), axis=0)
    smallest = step ** 2 / 4 + (_ROUNDING * middle) ** 2 + _TINY_VARIANCE
    variance, ratio = np.array([_quietest(variances, limit)
                                for variances, limit in zip(windows.T, smallest)]).T
    return variance, ratio * variance


def _quietest(variances: np.ndarray, smallest: float) -> tuple[float, float]:
    """
    Return the variance that the quiet windows have in common, and the ratio of its limit.

    The search begins at the 5 % quantile. Each step goes to the median of all variances below
    three times the present one. Variances of motion spread over decades, those of noise do not.
    """
    values = np.sort(np.maximum(variances[np.isfinite(variances)], smallest))
    if not len(values):
        return smallest, _MIN_VARIANCE_RATIO
    centre = values[int(_QUIETEST_SHARE * len(values))]
    for _ in range(_QUIET_STEPS):
        near = values[:np.searchsorted(values, _QUIET_RATIO * centre)]
        centre, before = np.median(near), centre
        if centre == before:
            break
    logs = np.log(values[:np.searchsorted(values, _QUIET_RATIO * centre)])
    scatter = MAD_TO_STD * np.median(np.abs(logs - np.log(centre)))
    return float(centre), float(np.clip(np.exp(_QUIET_DEVIATIONS * scatter),
                                        _MIN_VARIANCE_RATIO, _MAX_VARIANCE_RATIO))


def adc_step(blocks: Blocks) -> np.ndarray:
    """Return the smallest change of the samples, (m,); 0 where they never change."""
    changes = blocks.step
    if len(blocks) > 1 and (blocks.count <= 1).all():
        changes = np.abs(np.diff(blocks.mean, axis=0))
    changes = np.where(changes > 0, changes, np.inf)
    smallest = changes.min(axis=0, initial=np.inf)
    return np.where(np.isfinite(smallest), smallest, 0.0)


def undithered(step: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """
    Return the rounding error of a mean that noise does not average out.

    Noise multiplies the first harmonic of the rounding error by exp(−2π²σ²/step²) (Widrow's
    quantisation theorem). A scatter of up to half a step is no evidence of noise: without noise
    the codes may alternate between two values.

    Parameters
    ----------
    step
        Step of the ADC, (m,).
    sigma
        Standard deviation of the samples, (m,).

    Returns
    -------
    ndarray
        Error in the unit of the samples, (m,).

    """
    noise = np.maximum(sigma ** 2 - step ** 2 / 4, 0)
    return step * np.exp(-2 * np.pi ** 2 * noise / np.where(step > 0, step, np.inf) ** 2)


def window_variance(blocks: Blocks, spans: Spans) -> np.ndarray:
    """
    Return the variance of the samples in every window.

    Parameters
    ----------
    blocks
        Blocks of a stream.
    spans
        Lengths for the rate of the stream.

    Returns
    -------
    ndarray
        Variance, (k − window + 1, m); inf across a gap or where half of the samples are missing.

    """
    window = spans.window
    if len(blocks) < window:
        return np.empty((0, blocks.mean.shape[1]))
    means = sliding_window_view(blocks.mean, window, axis=0)
    counts = sliding_window_view(blocks.count, window)[:, None, :]
    rows = counts.sum(axis=2)
    with np.errstate(over='ignore', invalid='ignore'):
        centre = (means * counts).sum(axis=2) / np.maximum(rows, 1)
        between = (counts * (means - centre[..., None]) ** 2).sum(axis=2)
        within = sliding_window_view(blocks.squares, window, axis=0).sum(axis=2)
        variance = (within + between) / np.maximum(rows - 1, 1)
    gapless = blocks.run[window - 1:] == blocks.run[:len(blocks) - window + 1]
    usable = gapless[:, None] & (2 * rows > window * spans.size)
    return np.where(usable & np.isfinite(variance), variance, np.inf)


def quiet_blocks(blocks: Blocks, windows: np.ndarray, limit: np.ndarray,
                 window: int) -> np.ndarray:
    """
    Mark the blocks in whose window the variance is that of noise.

    Parameters
    ----------
    blocks, windows
        Blocks of a stream and their `window_variance`.
    limit
        Largest variance of noise, (m,).
    window
        Blocks of a window.

    Returns
    -------
    ndarray
        Whether the window around each block is within the limit, (k,) bool.

    """
    quiet: np.ndarray = np.all(windows <= limit, axis=1)
    if not len(quiet):
        return np.zeros(len(blocks), bool)
    # A block near an end of its run takes the outermost window, which is not centred on it.
    begin = np.searchsorted(blocks.run, blocks.run, side='left')
    end = np.searchsorted(blocks.run, blocks.run, side='right')
    first = np.clip(np.arange(len(blocks)) - window // 2, begin, np.maximum(end - window, begin))
    return (end - begin >= window) & quiet[np.minimum(first, len(quiet) - 1)]


def half_differences(blocks: Blocks, usable: np.ndarray,
                     half: int) -> tuple[np.ndarray, np.ndarray]:
    """
    Compare the means of the blocks before and after each place.

    Parameters
    ----------
    blocks
        Blocks of a stream.
    usable
        Blocks that may be compared, (k,) bool.
    half
        Blocks of each half.

    Returns
    -------
    tuple
        Differences, (k − 2·half + 1, m), the first one at block `half`; and whether all blocks of
        both halves are usable and without a gap.

    """
    places = len(blocks) - 2 * half + 1
    if places < 1:
        return np.empty((0, blocks.mean.shape[1])), np.zeros(0, bool)
    # Only usable blocks are summed: a spike of 1e38 would absorb all later terms.
    centre = np.median(blocks.mean[usable], axis=0) if usable.any() else 0.0
    total = np.zeros((len(blocks) + 1, blocks.mean.shape[1]))
    np.cumsum(np.where(usable[:, None], blocks.mean - centre, 0), axis=0, out=total[1:])
    differences = (total[2 * half:] - 2 * total[half:-half] + total[:-2 * half]) / half
    unusable = np.concatenate([[0], np.cumsum(~usable)])
    gapless = blocks.run[2 * half - 1:] == blocks.run[:places]
    return differences, gapless & (unusable[2 * half:] == unusable[:-2 * half])


def differing_start(means: np.ndarray, longest: int, white: np.ndarray, flicker: np.ndarray,
                    step: np.ndarray) -> int:
    """
    Count the blocks at the start of a rest whose mean differs from the mean of the others.

    Starts of 1, 2, 4, … blocks are compared with the remainder of the rest. A start that differs
    is cut, and the search begins again after it.

    Parameters
    ----------
    means
        Means of the blocks of a rest, (k, m).
    longest
        Largest number of blocks to cut.
    white, flicker, step
        Standard deviation of a block's mean, the same of the difference of very long means, and
        largest change by rounding of the ADC, (m,) each.

    Returns
    -------
    int
        Number of blocks to cut.

    """
    total = np.cumsum(means, axis=0)
    lengths = 1 << np.arange(max(longest, 1).bit_length())
    cut = 0
    while (lengths := lengths[cut + lengths <= longest]).size:
        remaining = len(means) - cut - lengths
        start_total = total[cut + lengths - 1]
        start_mean = (start_total - (total[cut - 1] if cut else 0.0)) / lengths[:, None]
        remaining_mean = (total[-1] - start_total) / remaining[:, None]
        noise = np.sqrt(white ** 2 * (1 / lengths + 1 / remaining)[:, None] + flicker ** 2)
        differs = (np.abs(start_mean - remaining_mean) > END_SIGMAS * noise + step).any(axis=1)
        if not differs.any():
            break
        cut += int(lengths[differs.argmax()])
    return cut


def batch_scatter(means: np.ndarray, length: int) -> tuple[np.ndarray, int]:
    """
    Return the scatter of batches of blocks about their mean.

    Parameters
    ----------
    means
        Means of blocks, (k, m).
    length
        Blocks of a batch.

    Returns
    -------
    tuple
        Sum of squared deviations times `length`, (m,), and its degrees of freedom. Their ratio is
        the long-run variance of a block's mean.

    """
    count = len(means) // length
    if count < 2:
        return np.zeros(means.shape[1]), 0
    batches = means[:count * length].reshape(count, length, -1).mean(axis=1)
    return length * ((batches - batches.mean(axis=0)) ** 2).sum(axis=0), count - 1
