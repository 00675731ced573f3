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

"""What noise explains of a stream: figures over windows of blocks, known or learned limits."""

from __future__ import annotations

from dataclasses import dataclass

from adxl_ros.model.noise import effective_samples, sample_std_v
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.block_statistics import block_samples, Blocks
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.special import chdtri

WINDOW_S, WINDOW_SAMPLES = 0.25, 8
"""A variance is judged over this time, s, and no fewer samples."""
HALF_S = 0.5
"""The shortest halves whose means are compared for a drift, s."""
DRIFT_OCTAVES = 4
"""Neighbouring halves of 0.5, 1, 2 and 4 s are compared: beyond, a sensor's flicker decides."""
SPREAD_RATIO = (2.25, 9.0)
"""A variance counts as noise up to 2.25 to 9 times the noise's: 1.5 to 3 times its rms."""
END_SIGMAS = 3.5
"""The ends of a rest are cut where they differ from the rest of it by more than this."""


@dataclass(frozen=True)
class Noise:
    """
    Noise of one sample as a parameter file states it.

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
    """Return the noise that the figures of a sensor promise, V."""
    return Noise(sample_std_v(sensor), sensor.rc_s)


@dataclass(frozen=True)
class Spans:
    """
    Lengths of what is looked at, in blocks.

    Attributes
    ----------
    size, dt_s
        Samples in a block, and the time between them, s.
    window
        A variance is judged over this many, odd, so that one is in the middle.
    half
        The shortest halves whose means are compared.

    """

    size: int
    dt_s: float
    window: int
    half: int

    @staticmethod
    def at(rate_hz: float) -> Spans:
        """Choose them for a sample rate, Hz."""
        size = block_samples(rate_hz)
        block_s = size / rate_hz
        window = max(round(WINDOW_S / block_s), -(-WINDOW_SAMPLES // size)) // 2 * 2 + 1
        return Spans(size, 1 / rate_hz, window, max(round(HALF_S / block_s), 4))

    @property
    def block_s(self) -> float:
        """Time of a block, s."""
        return self.size * self.dt_s

    @property
    def longest(self) -> int:
        """Count the blocks of both halves, where they are longest."""
        return self.half << DRIFT_OCTAVES


@dataclass(frozen=True)
class NoiseLimits:
    """
    What noise explains, by axis, (m,).

    Attributes
    ----------
    variance
        Largest variance within a window.
    drift
        Standard deviation of the difference of two neighbouring halves, (DRIFT_OCTAVES, m),
        by octaves of their length.
    step
        Change of a mean that the ADC makes of none.

    """

    variance: np.ndarray
    drift: np.ndarray
    step: np.ndarray

    def or_more(self, other: NoiseLimits) -> NoiseLimits:
        """Take the larger of each limit."""
        return NoiseLimits(np.maximum(self.variance, other.variance),
                      np.maximum(self.drift, other.drift), np.maximum(self.step, other.step))

    @property
    def flicker(self) -> np.ndarray:
        """Noise of the difference of two means that is there however long they are, (m,)."""
        white = self.drift[0] ** 2 / (1 << DRIFT_OCTAVES - 1)
        return np.sqrt(np.maximum(self.drift[-1] ** 2 - white, 0))

    def block_noise(self, spans: Spans) -> np.ndarray:
        """Noise of the mean of one block, (m,)."""
        return self.drift[0] * np.sqrt(spans.half / 2)

    def tells_apart(self, before: np.ndarray, after: np.ndarray, spans: Spans,
                    sigmas: float) -> bool:
        """Tell whether the means of two rows of blocks, (k, m) each, differ by more than noise."""
        white = self.block_noise(spans) ** 2 * (1 / len(before) + 1 / len(after))
        allowed = sigmas * np.sqrt(white + self.flicker ** 2) + self.step
        return bool((np.abs(before.mean(axis=0) - after.mean(axis=0)) > allowed).any())


def known_limits(noise: Noise, step: np.ndarray, spans: Spans) -> NoiseLimits:
    """
    NoiseLimits from known noise, and the ADC's step, (m,): a variance of samples is chi-squared.

    A first-order filter correlates neighbours by a = exp(−dt/τ), and the variance of n such
    samples scatters as that of n·(1 − a²)/(1 + a²) independent ones.
    """
    a = np.exp(-spans.dt_s / noise.tau_s) if noise.tau_s else 0.0
    freedom = max((spans.window * spans.size - 1) * (1 - a * a) / (1 + a * a), 1.0)
    ratio = max(chdtri(freedom, 1e-6) / freedom, SPREAD_RATIO[0])
    sigma = np.hypot(noise.sigma, step / np.sqrt(12))
    halves = spans.half * spans.size << np.arange(DRIFT_OCTAVES)
    drift = np.sqrt(2 / effective_samples(halves, spans.dt_s, noise.tau_s))[:, None] * sigma
    return NoiseLimits(ratio * sigma ** 2, drift, undithered(step, sigma))


def learned_limits(blocks: Blocks, windows: np.ndarray, step: np.ndarray,
                   spans: Spans) -> NoiseLimits | None:
    """
    Learn the limits from the quietest windows, never below what the ADC's step explains.

    Parameters
    ----------
    blocks, windows
        All of a stream, and its `window_variance`.
    step
        Step of the ADC, (m,).
    spans
        Those of the stream's rate.

    Returns
    -------
    limits
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

    A steady turn moves all of them by the same: where there are differences to subtract, it does
    not count. The quartile of a normal deviate's magnitude, 0.3186 of its standard deviation,
    stands even where most of what is quiet is no rest.
    """
    both = valid[:-2 * half] & valid[2 * half:]
    if both.any():
        differences = (moved[2 * half:] - moved[:-2 * half])[both] / np.sqrt(2)
    elif valid.any():
        differences = moved[valid]
    else:
        return None
    return np.quantile(np.abs(differences), 0.25, axis=0) / 0.3186


def quiet_variance(blocks: Blocks, windows: np.ndarray,
                   step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Learn the variance that the quietest windows have in common, and its upper limit, (m,) each.

    Two neighbouring codes in equal parts are what noise below the ADC's step shows at most, and
    samples without any noise still have rounding.
    """
    middle = np.median(np.abs(blocks.mean), axis=0)
    least = step ** 2 / 4 + (1e-9 * middle) ** 2 + 1e-300
    found = [_quietest(v, low) for v, low in zip(windows.T, least)]
    variance, ratio = np.array(found).T
    return variance, ratio * variance


def _quietest(variances: np.ndarray, least: float) -> tuple[float, float]:
    """
    Find the variance that the quiet windows have in common, and by how much theirs scatters.

    From the 5 % of lowest variance the search climbs, or descends, to the median of all that is
    below three times it: motion spreads over decades, noise does not. The second figure is the
    ratio up to which a variance still belongs to them.
    """
    values = np.sort(np.maximum(variances[np.isfinite(variances)], least))
    if not len(values):
        return least, SPREAD_RATIO[0]
    centre = values[len(values) // 20]
    for _ in range(50):
        near = values[:np.searchsorted(values, 3 * centre)]
        centre, before = np.median(near), centre
        if centre == before:
            break
    logs = np.log(values[:np.searchsorted(values, 3 * centre)])
    scatter = 1.4826 * np.median(np.abs(logs - np.log(centre)))
    return float(centre), float(np.clip(np.exp(5 * scatter), *SPREAD_RATIO))


def adc_step(blocks: Blocks) -> np.ndarray:
    """Find the smallest change of the samples, (m,); 0 where nothing ever changes."""
    changes = blocks.step
    if len(blocks) > 1 and (blocks.count <= 1).all():
        changes = np.abs(np.diff(blocks.mean, axis=0))
    changes = np.where(changes > 0, changes, np.inf)
    smallest = changes.min(axis=0, initial=np.inf)
    return np.where(np.isfinite(smallest), smallest, 0.0)


def undithered(step: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """
    Error of a mean that rounding to `step` leaves when samples scatter by `sigma`, (m,).

    Noise dithers the first harmonic of the rounding error down to exp(−2π²σ²/step²) of itself
    (Widrow's quantisation theorem): nothing from a step of noise on, all of it with none. A
    scatter of up to half a step says nothing about the noise: two codes may just flicker.
    """
    noise = np.maximum(sigma ** 2 - step ** 2 / 4, 0)
    return step * np.exp(-2 * np.pi ** 2 * noise / np.where(step > 0, step, np.inf) ** 2)


def window_variance(blocks: Blocks, spans: Spans) -> np.ndarray:
    """
    Variance of the samples in every window, (k − window + 1, m).

    It is inf across a gap, and where half the samples are missing.
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
    """Tell which blocks have a variance up to `limit` (m,) in the window around them, (k,)."""
    quiet: np.ndarray = np.all(windows <= limit, axis=1)
    if not len(quiet):
        return np.zeros(len(blocks), bool)
    # At the ends of a run the window cannot be centred: the outermost one counts there.
    begin = np.searchsorted(blocks.run, blocks.run, side='left')
    end = np.searchsorted(blocks.run, blocks.run, side='right')
    first = np.clip(np.arange(len(blocks)) - window // 2, begin, np.maximum(end - window, begin))
    return (end - begin >= window) & quiet[np.minimum(first, len(quiet) - 1)]


def half_differences(blocks: Blocks, usable: np.ndarray,
                     half: int) -> tuple[np.ndarray, np.ndarray]:
    """
    Compare the means of the `half` blocks before and after each place.

    Returns
    -------
    moved, valid
        Differences (k − 2·half + 1, m), the first at block `half`, and whether both halves are
        `usable` (k,) throughout and without a gap.

    """
    places = len(blocks) - 2 * half + 1
    if places < 1:
        return np.empty((0, blocks.mean.shape[1])), np.zeros(0, bool)
    # Sums of what is usable only: a spike of 1e38 would erase everything that is added to it.
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
        Blocks that may be cut at most.
    white, flicker, step
        Noise of a block's mean, noise of the difference of very long ones, and the ADC's share
        of a change, (m,).

    """
    total = np.cumsum(means, axis=0)
    lengths = 1 << np.arange(max(longest, 1).bit_length())
    cut = 0
    while (lengths := lengths[cut + lengths <= longest]).size:
        after = len(means) - cut - lengths
        upto, whole = total[cut + lengths - 1], total[-1]
        begin = (upto - (total[cut - 1] if cut else 0.0)) / lengths[:, None]
        bulk = (whole - upto) / after[:, None]
        noise = np.sqrt(white ** 2 * (1 / lengths + 1 / after)[:, None] + flicker ** 2)
        differs = (np.abs(begin - bulk) > END_SIGMAS * noise + step).any(axis=1)
        if not differs.any():
            break
        cut += int(lengths[differs.argmax()])
    return cut


def batch_scatter(means: np.ndarray, length: int) -> tuple[np.ndarray, int]:
    """
    Scatter of batches of `length` blocks about their mean.

    Returns
    -------
    squares, freedom
        Sum of squared deviations times `length`, (m,): over `freedom` degrees of freedom, the
        long-run variance of a block's mean.

    """
    count = len(means) // length
    if count < 2:
        return np.zeros(means.shape[1]), 0
    batches = means[:count * length].reshape(count, length, -1).mean(axis=1)
    return length * ((batches - batches.mean(axis=0)) ** 2).sum(axis=0), count - 1
