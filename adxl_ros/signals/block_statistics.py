# SPDX-License-Identifier: Apache-2.0

"""
Statistics of a stream of samples in short blocks, from which rests and noise are found.

A window is some blocks in a row. It is quiet if the variance in it is that of the noise, which the
quietest windows of a stream have in common.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import pairwise
from math import ceil

from adxl_ros.model.constants import MAD_TO_STD
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

DITHERED_STEPS = 0.6
"""Noise from which rounding adds step²/12 and shifts no mean, steps. Chosen: exact within 0.4 % by
the first harmonic of the rounding error (Widrow and Kollár 2008, section 4.4)."""
BLOCK_S = 0.05  # Length of a block, s. Chosen: far below a rest, above most sample periods
_GAP_S = 0.1  # Smallest time without a sample that ends a block, s. Chosen: two blocks
_GAP_PERIODS = 5  # Smallest gap, sample periods. Chosen: a few lost samples are none
_CHUNK = 1 << 13  # Rows that are processed at once. Chosen: they fit into the cache
_WINDOW_S = 0.25  # Length of the window of a variance, s. Chosen: under half of the shortest rest
_WINDOW_SAMPLES = 8  # Fewest samples of that window. Chosen: fewer show no variance
_HALF_S = 0.5  # Shortest halves whose means are compared, s. Chosen: two windows
DRIFT_OCTAVES = 4  # Lengths of halves: 0.5, 1, 2, 4 s. Chosen: beyond, flicker dominates
MIN_VARIANCE_RATIO = 2.25  # Smallest limit of a variance, by that of noise: 1.5 times its rms
_MAX_VARIANCE_RATIO = 9.0  # Largest limit of a variance, by that of noise: 3 times its rms
_QUIETEST_SHARE = 0.05  # Quantile of variances at which the search for noise begins
_QUIET_RATIO = 3.0  # Largest variance of a quiet window, relative to that of the noise
_QUIET_STEPS = 50  # Largest number of steps of that search
_QUIET_DEVIATIONS = 5.0  # Distance of the limit from the noise, stds of ln(variance)
_ROUNDING = 1e-9  # Relative rounding error of samples without noise
_CONSTANT_SHARE = 0.25
"""Share of the windows in which the others rest, above which an axis is constant by its steps.
Chosen: far below all of them. Where the others never rest, axes are stuck or clipped in turn."""
_TINY_VARIANCE = 1e-300  # Lower bound of a variance, for its logarithm


def gap_s(rate_hz: float) -> float:
    """Return the smallest time without a sample that is a gap, s."""
    return max(_GAP_S, _GAP_PERIODS / rate_hz)


@dataclass(frozen=True)
class Blocks:
    """Sums over k blocks of equally many rows."""

    start: np.ndarray  # Row of the stream at which each block begins, (k,)
    time_s: np.ndarray  # Time of the first and last row, s, (k, 2)
    run: np.ndarray  # Number of the gapless run that the block belongs to, (k,)
    mean: np.ndarray  # Mean of the rows by axis, (k, m)
    squares: np.ndarray  # Sum of the squared deviations from the mean, (k, m)
    # Smallest change between consecutive rows that is not 0, (k, m); inf if nothing changes. It is
    # the step of the ADC if the noise exceeds that step.
    step: np.ndarray
    # Lowest and highest encoder angle, rad, (k, 2, a); NaN where none was sampled
    angle: np.ndarray

    def __len__(self) -> int:
        return len(self.start)

    def __getitem__(self, part: slice | np.ndarray) -> Blocks:
        return Blocks(*(getattr(self, f.name)[part] for f in fields(self)))

    @staticmethod
    def join(parts: list[Blocks]) -> Blocks:
        """Concatenate the blocks of several parts of one stream."""
        return Blocks(
            *(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Blocks))
        )


class BlockCutter:
    """
    Cuts a stream into blocks; the portions in which it is fed do not change the blocks.

    A gap in time, or time that runs backwards, begins a new run. The incomplete block before it
    is dropped.
    """

    def __init__(self, rate_hz: float, axes: int, angles: int = 0):
        self.size = Spans(rate_hz).size
        self._axes = axes
        self._gap_s = gap_s(rate_hz)
        self._leftover = np.empty((1 + axes + angles, 0))
        self._row = 0
        self._run = -1
        self._last_time_s = -np.inf

    def feed(
        self, time_s: np.ndarray, samples: np.ndarray, angles_rad: np.ndarray | None = None
    ) -> Blocks:
        """Add finite samples, (n, m), and encoder angles, (n, a), NaN where not sampled."""
        columns = [time_s[:, None], samples]
        if angles_rad is not None:
            columns.append(angles_rad)
        parts = [self.none()]
        for begin in range(0, len(time_s), _CHUNK):
            rows = slice(begin, begin + _CHUNK)
            parts.append(self._cut(np.concatenate([column[rows].T for column in columns])))
        return Blocks.join(parts)

    def none(self) -> Blocks:
        """Return an empty sequence of blocks, of the right shape."""
        return self._summed(self._leftover, np.empty(0, int), np.empty(0, int))

    def _cut(self, columns: np.ndarray) -> Blocks:
        """Cut the leftover rows and further rows, (1 + m + a, n), into blocks."""
        columns = np.concatenate([self._leftover, columns], axis=1)
        count = columns.shape[1]
        step_s = np.diff(columns[0], prepend=self._last_time_s)
        begins = np.flatnonzero(~((step_s >= 0) & (step_s <= self._gap_s)))
        edges = np.unique(np.concatenate([[0], begins, [count]]))
        # Between two edges are as many whole blocks as fit, from the first row on.
        complete = np.diff(edges) // self.size
        first_row = np.repeat(edges[:-1], complete)
        blocks_before = np.repeat(np.cumsum(complete) - complete, complete)
        start = first_row + self.size * (np.arange(len(first_row)) - blocks_before)
        run = self._run + np.searchsorted(begins, start, side='right')
        blocks = self._summed(columns, start, run)
        # The next call counts a gap within the leftover rows.
        used = int(edges[-2] + self.size * complete[-1])
        self._run += int(np.searchsorted(begins, used))
        self._row += used
        if used:
            self._last_time_s = columns[0, used - 1]
        self._leftover = columns[:, used:]
        return blocks

    def _summed(self, columns: np.ndarray, start: np.ndarray, run: np.ndarray) -> Blocks:
        """Return the blocks that begin at some rows, (k,), with their runs, (k,)."""
        block = columns[:, start[:, None] + np.arange(self.size)]
        samples = block[1 : 1 + self._axes]
        angles = block[1 + self._axes :]
        change = np.abs(np.diff(samples, axis=2))
        step = np.where(change > 0, change, np.inf).min(axis=2, initial=np.inf)
        mean = samples.mean(axis=2)
        squares = ((samples - mean[..., None]) ** 2).sum(axis=2)
        bounds = np.stack([np.fmin.reduce(angles, axis=2), np.fmax.reduce(angles, axis=2)])
        return Blocks(
            start=self._row + start,
            time_s=block[0][:, [0, -1]],
            run=run,
            mean=mean.T,
            squares=squares.T,
            step=step.T,
            angle=bounds.transpose(2, 0, 1),
        )


def angle_bounds(blocks: Blocks) -> np.ndarray:
    """
    Return the bounds of the encoder angles of each block as (−lowest, highest), rad, (k, 2, a).

    With this sign the bounds of several blocks are the maximum of their bounds. The readings
    before and after a block count too: an encoder that is read less often than the sensor may turn
    between two readings.
    """
    bounds = blocks.angle * np.array([[-1.0], [1.0]])
    has_angle = np.isfinite(bounds).all(axis=(1, 2))
    place = np.arange(len(has_angle))
    last = len(has_angle) - 1
    # The newest block with an angle up to each place, and the next one from it on
    newest = np.maximum.accumulate(np.where(has_angle, place, 0))
    following = np.minimum.accumulate(np.where(has_angle, place, last)[::-1])[::-1]
    before = bounds[newest[np.maximum(place - 1, 0)]]
    after = bounds[following[np.minimum(place + 1, last)]]
    return np.fmax(bounds, np.fmax(before, after))


def true_runs(mask: np.ndarray, group: np.ndarray | None = None) -> list[tuple[int, int]]:
    """List the runs of True in a mask, (k,); a run ends where the number of its group changes."""
    number = np.where(mask, 0 if group is None else group, -1)
    edges = np.flatnonzero(np.diff(number, prepend=-2, append=-2))
    return [(int(first), int(stop)) for first, stop in pairwise(edges) if mask[first]]


def bridged(data: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Replace rows, (n, k), that are not used by straight lines between those that are."""
    if used.all() or not used.any():
        return data
    number, kept = np.arange(len(used)), np.flatnonzero(used)
    return np.array([np.interp(number, kept, column[kept]) for column in data.T]).T


def held_values(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Hold each known value until the next one, (n,); NaN before the first."""
    last = np.maximum.accumulate(np.where(known, np.arange(len(known)), -1))
    return np.where(last >= 0, values[last], np.nan)


class Spans:
    """Lengths of windows in blocks, for a sample rate."""

    def __init__(self, rate_hz: float) -> None:
        self.rate_hz = rate_hz
        self.size = max(1, round(BLOCK_S * rate_hz))  # Samples of a block
        self.block_s = self.size / rate_hz  # Length of a block, s
        # Blocks of the window of a variance; odd, so that one is in the middle
        by_samples = ceil(_WINDOW_SAMPLES / self.size)
        fewest = max(round(_WINDOW_S / self.block_s), by_samples)
        self.window = fewest if fewest % 2 else fewest + 1
        # Blocks of the shortest halves whose means are compared, and of both longest halves
        self.half = max(round(_HALF_S / self.block_s), 4)
        self.longest = self.half << DRIFT_OCTAVES


def quiet_variance(
    blocks: Blocks, windows: np.ndarray, step: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """
    Learn the variance that the quietest windows have in common, and its limit, (m,) each.

    Noise below the ADC's step, (m,), makes at most two codes equally frequent: a variance of
    step²/4. Samples without any noise still have a rounding error.
    """
    smallest = step**2 / 4 + _rounding(blocks)
    variance, ratio = np.transpose(list(map(_quietest, windows.T, smallest)))
    return variance, ratio * variance


def _rounding(blocks: Blocks) -> np.ndarray:
    """Return the variance of samples that do not change, (m,)."""
    return (_ROUNDING * np.median(np.abs(blocks.mean), axis=0)) ** 2 + _TINY_VARIANCE


def without_stuck(blocks: Blocks, windows: np.ndarray, step: np.ndarray) -> np.ndarray:
    """
    Return the variances of windows, which are infinite where an axis is stuck or at its limit.

    There it does not change, although it mostly does while the other axes rest.
    """
    if windows.shape[1] == 1 or not len(windows):
        return windows
    constant = windows <= _rounding(blocks)
    if not constant.any():
        return windows
    is_quiet = windows <= quiet_variance(blocks, windows, step)[1]
    out = windows.copy()
    for axis in np.flatnonzero(constant.any(axis=0)):
        others_rest = np.delete(is_quiet, axis, axis=1).all(axis=1)
        if constant[others_rest, axis].sum() <= _CONSTANT_SHARE * others_rest.sum():
            out[constant[:, axis], axis] = np.inf
    return out


def _quietest(variances: np.ndarray, smallest: float) -> tuple[float, float]:
    """
    Return the variance that the quiet windows have in common, and the ratio of its limit.

    The search begins at the 5 % quantile. Each step goes to the median of all variances below
    three times the present one. Variances of motion spread over decades, those of noise do not.
    """
    values = np.sort(np.maximum(variances[np.isfinite(variances)], smallest))
    if not len(values):
        return smallest, MIN_VARIANCE_RATIO
    centre = values[int(_QUIETEST_SHARE * len(values))]
    for _ in range(_QUIET_STEPS):
        near = values[: np.searchsorted(values, _QUIET_RATIO * centre)]
        before = centre
        centre = np.median(near)
        if centre == before:
            break
    logs = np.log(values[: np.searchsorted(values, _QUIET_RATIO * centre)])
    scatter = MAD_TO_STD * np.median(np.abs(logs - np.log(centre)))
    return float(centre), float(
        np.clip(np.exp(_QUIET_DEVIATIONS * scatter), MIN_VARIANCE_RATIO, _MAX_VARIANCE_RATIO)
    )


def smallest_change(changes: np.ndarray) -> np.ndarray:
    """Return the smallest change that is not 0 by axis, (n, m) to (m,); inf where none is."""
    return np.where(changes > 0, changes, np.inf).min(axis=0, initial=np.inf)


def adc_step(blocks: Blocks) -> np.ndarray:
    """Return the smallest change of the samples, (m,); 0 where they never change."""
    changes = blocks.step
    if not np.isfinite(changes).any():  # also where a block is one sample
        changes = np.abs(np.diff(blocks.mean, axis=0))
    smallest = smallest_change(changes)
    return np.where(np.isfinite(smallest), smallest, 0.0)


def undithered(step: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """
    Return the rounding error of a mean that noise does not average out, (m,).

    Noise of a standard deviation, (m,), multiplies the first harmonic of the rounding error by
    exp(−2π²σ²/step²) (Widrow's quantisation theorem). A scatter of up to half a step is no
    evidence of noise: without noise the codes may alternate between two values.
    """
    noise = np.maximum(sigma**2 - step**2 / 4, 0)
    return step * np.exp(-2 * np.pi**2 * noise / np.where(step > 0, step, np.inf) ** 2)


def window_variance(blocks: Blocks, spans: Spans) -> np.ndarray:
    """Return the variance of the samples in each window, (k − window + 1, m); inf across a gap."""
    window = spans.window
    if len(blocks) < window:
        return np.empty((0, blocks.mean.shape[1]))
    between = window * spans.size * sliding_window_view(blocks.mean, window, axis=0).var(axis=2)
    within = sliding_window_view(blocks.squares, window, axis=0).sum(axis=2)
    gapless = blocks.run[window - 1 :] == blocks.run[: len(blocks) - window + 1]
    return np.where(gapless[:, None], (within + between) / (window * spans.size - 1), np.inf)


def quiet_blocks(
    blocks: Blocks, windows: np.ndarray, limit: np.ndarray, window: int
) -> np.ndarray:
    """Mark the blocks, (k,), in whose window no variance is above the limit, (m,)."""
    quiet: np.ndarray = np.all(windows <= limit, axis=1)
    if not len(quiet):
        return np.zeros(len(blocks), bool)
    # A block near an end of its run takes the outermost window, which is not centred on it.
    begin = np.searchsorted(blocks.run, blocks.run, side='left')
    end = np.searchsorted(blocks.run, blocks.run, side='right')
    first = np.clip(np.arange(len(blocks)) - window // 2, begin, np.maximum(end - window, begin))
    return (end - begin >= window) & quiet[np.minimum(first, len(quiet) - 1)]


def half_differences(
    blocks: Blocks, usable: np.ndarray, half: int
) -> tuple[np.ndarray, np.ndarray]:
    """
    Compare the means of `half` blocks before and after each place.

    Returns differences, (k − 2·half + 1, m), the first one at block `half`; and whether all blocks
    of both halves are marked as usable, (k,) bool, and without a gap.
    """
    middle = np.median(blocks.mean[usable], axis=0) if usable.any() else 0.0
    total = np.zeros((len(blocks) + 1, blocks.mean.shape[1]))
    np.cumsum(np.where(usable[:, None], blocks.mean - middle, 0), axis=0, out=total[1:])
    differences = (total[2 * half :] - 2 * total[half:-half] + total[: -2 * half]) / half
    unusable = np.concatenate([[0], np.cumsum(~usable)])
    gapless = blocks.run[2 * half - 1 :] == blocks.run[: len(differences)]
    return differences, gapless & (unusable[2 * half :] == unusable[: -2 * half])
