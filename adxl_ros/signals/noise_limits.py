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

"""Limits of variance and drift that noise explains, from the datasheet or learned."""

from __future__ import annotations

from dataclasses import dataclass

from adxl_ros.model.noise import effective_samples, sample_std_v
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.block_statistics import block_samples, Blocks
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.special import chdtri

_WINDOW_S = 0.25
"""Length of the window of a variance, s."""
_WINDOW_SAMPLES = 8
"""Smallest count of samples in that window."""
_HALF_S = 0.5
"""Length of the shortest neighbouring halves whose means are compared, s."""
DRIFT_OCTAVES = 4
"""Octaves of that length: 0.5, 1, 2 and 4 s. Chosen: beyond, a sensor's flicker dominates."""
_MIN_VARIANCE_RATIO = 2.25
"""Smallest limit of a variance, relative to that of the noise: 1.5 times its rms."""
_MAX_VARIANCE_RATIO = 9.0
"""Largest limit of a variance, relative to that of the noise: 3 times its rms."""
_FALSE_ALARM = 1e-6
"""Probability that the variance of noise exceeds its limit."""
_QUIETEST_SHARE = 0.05
"""Share of the windows at whose greatest variance the search for the noise begins."""
_QUIET_RATIO = 3.0
"""Windows up to this many times the noise's variance are quiet ones."""
_QUIET_STEPS = 50
"""Largest count of steps of that search."""
_QUIET_DEVIATIONS = 5.0
"""The limit is this many standard deviations of ln(variance) above the noise."""
_MAD_TO_STD = 1.4826
"""Standard deviation of a normal deviate by the median of its magnitude."""
_QUARTILE_TO_STD = 0.3186
"""Quartile of a normal deviate's magnitude, by its standard deviation."""
_ROUNDING = 1e-9
"""Relative rounding error of samples without noise."""
END_SIGMAS = 3.5
"""The ends of a rest are cut if they differ from its middle by more standard deviations."""


@dataclass(frozen=True)
class Noise:
    """
    Noise of one sample.

    Attributes
    ----------
    sigma
        Standard deviation by axis, in the unit of the samples, (m,).
    tau_s
        Time constant of the filter that correlates it, s.

    """

    sigma: np.ndarray
    tau_s: float = 0.0


def datasheet_noise(sensor: Sensor) -> Noise:
    """Return the noise of a sample by the datasheet values of a sensor, V."""
    return Noise(sample_std_v(sensor), sensor.rc_s)


@dataclass(frozen=True)
class Spans:
    """
    Lengths of windows in blocks.

    Attributes
    ----------
    size, dt_s
        Samples in a block, and the time between them, s.
    window
        Blocks of the window of a variance; odd, so that one is in the middle.
    half
        Blocks of the shortest halves whose means are compared.

    """

    size: int
    dt_s: float
    window: int
    half: int

    @staticmethod
    def at(rate_hz: float) -> Spans:
        """Return the lengths for a sample rate, Hz."""
        size = block_samples(rate_hz)
        block_s = size / rate_hz
        window = max(round(_WINDOW_S / block_s), -(-_WINDOW_SAMPLES // size)) // 2 * 2 + 1
        return Spans(size, 1 / rate_hz, window, max(round(_HALF_S / block_s), 4))

    @property
    def block_s(self) -> float:
        """Return the time of a block, s."""
        return self.size * self.dt_s

    @property
    def longest(self) -> int:
        """Return the count of blocks of both longest halves."""
        return self.half << DRIFT_OCTAVES


@dataclass(frozen=True)
class NoiseLimits:
    """
    Limits of what noise explains, for m axes.

    Attributes
    ----------
    variance
        Largest variance within a window, (m,).
    drift
        Standard deviation of the difference of two neighbouring halves, by octaves of their
        length, (DRIFT_OCTAVES, m).
    step
        Largest change of a mean by rounding of the ADC, where the input does not change, (m,).

    """

    variance: np.ndarray
    drift: np.ndarray
    step: np.ndarray

    def larger(self, other: NoiseLimits) -> NoiseLimits:
        """Return the larger of each limit."""
        return NoiseLimits(np.maximum(self.variance, other.variance),
                           np.maximum(self.drift, other.drift), np.maximum(self.step, other.step))

    @property
    def flicker(self) -> np.ndarray:
        """Return the noise of the difference of two very long means, (m,)."""
        white = self.drift[0] ** 2 / (1 << DRIFT_OCTAVES - 1)
        return np.sqrt(np.maximum(self.drift[-1] ** 2 - white, 0))

    def block_noise(self, spans: Spans) -> np.ndarray:
        """Return the standard deviation of the mean of one block, (m,)."""
        return self.drift[0] * np.sqrt(spans.half / 2)

    def differ(self, before: np.ndarray, after: np.ndarray, spans: Spans, sigmas: float) -> bool:
        """
        Return whether two sequences of blocks differ by more than noise.

        Parameters
        ----------
        before, after
            Means of blocks, (k, m) each.
        spans
            Lengths for the rate of the stream.
        sigmas
            Standard deviations up to which a difference is noise.

        Returns
        -------
        bool
            True if the means of an axis differ by more.

        """
        white = self.block_noise(spans) ** 2 * (1 / len(before) + 1 / len(after))
        allowed = sigmas * np.sqrt(white + self.flicker ** 2) + self.step
        return bool((np.abs(before.mean(axis=0) - after.mean(axis=0)) > allowed).any())


def stated_limits(noise: Noise, step: np.ndarray, spans: Spans) -> NoiseLimits:
    """
    Return the limits for a given noise. A variance of samples is chi-squared.

    A first-order filter correlates neighbours by a = exp(−dt/τ). The variance of n such samples
    scatters as that of n·(1 − a²)/(1 + a²) independent ones.

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
    ratio = max(chdtri(freedom, _FALSE_ALARM) / freedom, _MIN_VARIANCE_RATIO)
    sigma = np.hypot(noise.sigma, step / np.sqrt(12))
    halves = spans.half * spans.size << np.arange(DRIFT_OCTAVES)
    drift = np.sqrt(2 / effective_samples(halves, spans.dt_s, noise.tau_s))[:, None] * sigma
    return NoiseLimits(ratio * sigma ** 2, drift, undithered(step, sigma))


def learned_limits(blocks: Blocks, windows: np.ndarray, step: np.ndarray,
                   spans: Spans) -> NoiseLimits | None:
    """
    Learn the limits from the quietest windows, at least those of the ADC's step.

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


def _drift_noise(moved: np.ndarray, valid: np.ndarray, half: int) -> np.ndarray | None:
    """
    Learn the standard deviation of the differences of halves, (m,); None if there are none.

    A steady turn changes all of them by the same, which differences of differences remove. The
    quartile of the magnitude is valid even if most quiet blocks are no rest.
    """
    both = valid[:-2 * half] & valid[2 * half:]
    if both.any():
        differences = (moved[2 * half:] - moved[:-2 * half])[both] / np.sqrt(2)
    elif valid.any():
        differences = moved[valid]
    else:
        return None
    return np.quantile(np.abs(differences), 0.25, axis=0) / _QUARTILE_TO_STD


def quiet_variance(blocks: Blocks, windows: np.ndarray,
                   step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Learn the variance that the quietest windows have in common, and its limit.

    Noise below the ADC's step shows as two neighbouring codes in equal parts at most. Samples
    without any noise still have a rounding error.

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
    smallest = step ** 2 / 4 + (_ROUNDING * middle) ** 2 + 1e-300
    variance, ratio = np.array([_quietest(variances, limit)
                                for variances, limit in zip(windows.T, smallest)]).T
    return variance, ratio * variance


def _quietest(variances: np.ndarray, smallest: float) -> tuple[float, float]:
    """
    Return the variance that the quiet windows have in common, and the ratio of its limit.

    The search begins at the 5 % of lowest variance. It moves to the median of all variances
    below three times the present one: motion spreads over decades, noise does not.
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
    scatter = _MAD_TO_STD * np.median(np.abs(logs - np.log(centre)))
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
    Return the error of a mean by rounding that noise does not average out.

    Noise reduces the first harmonic of the rounding error to exp(−2π²σ²/step²) of itself
    (Widrow's quantisation theorem). A scatter of up to half a step does not show the noise: the
    codes may flicker between two values without any.

    Parameters
    ----------
    step
        Step of the ADC, (m,).
    sigma
        Standard deviation of the samples, (m,).

    Returns
    -------
    ndarray
        Error, (m,).

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
    Mark the blocks whose surroundings have the variance of noise.

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
        True where the window around a block is within the limit, (k,) bool.

    """
    quiet: np.ndarray = np.all(windows <= limit, axis=1)
    if not len(quiet):
        return np.zeros(len(blocks), bool)
    # At the ends of a run the outermost window counts, which is not centred.
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
    # Only usable blocks are summed: a spike of 1e38 would erase all that is added to it.
    centre = np.median(blocks.mean[usable], axis=0) if usable.any() else 0.0
    total = np.zeros((len(blocks) + 1, blocks.mean.shape[1]))
    np.cumsum(np.where(usable[:, None], blocks.mean - centre, 0), axis=0, out=total[1:])
    moved = (total[2 * half:] - 2 * total[half:-half] + total[:-2 * half]) / half
    bad = np.concatenate([[0], np.cumsum(~usable)])
    gapless = blocks.run[2 * half - 1:] == blocks.run[:places]
    return moved, gapless & (bad[2 * half:] == bad[:-2 * half])


def unlike_beginning(means: np.ndarray, longest: int, white: np.ndarray, flicker: np.ndarray,
                     step: np.ndarray) -> int:
    """
    Count the blocks at the beginning that differ from what follows.

    Parameters
    ----------
    means
        Means of the blocks of a rest, (k, m).
    longest
        Largest count of blocks to cut.
    white, flicker, step
        Standard deviation of a block's mean, of the difference of very long means, and largest
        change by the ADC, (m,).

    Returns
    -------
    int
        Count of blocks.

    """
    total = np.cumsum(means, axis=0)
    lengths = 1 << np.arange(max(longest, 1).bit_length())
    cut = 0
    while (lengths := lengths[cut + lengths <= longest]).size:
        after = len(means) - cut - lengths
        upto = total[cut + lengths - 1]
        begin = (upto - (total[cut - 1] if cut else 0.0)) / lengths[:, None]
        bulk = (total[-1] - upto) / after[:, None]
        noise = np.sqrt(white ** 2 * (1 / lengths + 1 / after)[:, None] + flicker ** 2)
        differs = (np.abs(begin - bulk) > END_SIGMAS * noise + step).any(axis=1)
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
