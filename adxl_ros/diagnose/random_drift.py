# SPDX-License-Identifier: Apache-2.0
"""
Whether what a set of effects leaves drifts at random.

A random drift follows time alone. Its increments are without jumps, as large at rest as in motion,
and without a line; those of jumps between levels, of motors and of slow oscillations are not.
"""

from __future__ import annotations

from typing import NamedTuple, TYPE_CHECKING

from adxl_ros.signals.block_statistics import bridged, true_runs
import numpy as np
import scipy

if TYPE_CHECKING:
    from adxl_ros.diagnose.held_out import HeldOutFits

_FIRST_MEAN_S = 0.1
"""Shortest mean in which a drift is looked for, s. Chosen: noise of sensors is white below it."""
_FEWEST_MEANS = 16  # Fewest means of the longest length. Chosen: their increments show a form
_FEWEST_STEPS = 12  # Fewest increments that show a form. Chosen: a kurtosis scatters by 1.4
_FEWEST_GAPS = 8
"""Fewest gaps whose steps are compared with the changes within the runs about them. Chosen: eight
steps and nine changes have 24 310 orders, so that chance explains one in so many."""
_AROUND = 5  # Increments on each side of one. Chosen: a power that changes is the same within them
_PARTS = (np.arange(1000) + 0.5) / 1000  # Probabilities over which a mean is taken
_LOCAL_ORDINATES = 101  # Ordinates of the level around a line. Chosen: much wider than a line


def drift_p(fits: HeldOutFits) -> float:
    """Return how probable the residuals of all channels are if they drift; 1 without a drift."""
    if not fits.drifts:
        return 1.0
    smallest = 1.0
    for columns, (comparison, _) in zip(fits.linearised.columns, fits.model.places):
        residual_v = columns.values @ columns.combination(fits.full_departures)
        used, rate_hz = comparison.used, comparison.sensor.rate_hz
        p = increments_p(residual_v, used, rate_hz, comparison.at_rest)
        p = min(p, between_rests_p(residual_v, used, rate_hz))
        smallest = min(smallest, len(fits.model.places) * p)
    return smallest


def increments_p(
    values: np.ndarray, used: np.ndarray, rate_hz: float, at_rest: np.ndarray
) -> float:
    """
    Return how probable the increments of a residual are if they are those of a random drift.

    A drift has no jump in means over the time from which it exceeds the noise, that of the
    smallest Allan deviation, or longer; increments as large at rest as in motion (test of Mann and
    Whitney 1947); and no line. Jumps, what a motor does, and slow oscillations have not.
    """
    longest = int(used.sum()) // _FEWEST_MEANS
    lengths = np.unique(
        np.geomspace(max(1.0, _FIRST_MEAN_S * rate_hz), max(longest, 1), 12).astype(int)
    )
    if not longest or len(lengths) < 2:
        return 1.0

    def increments(length: int) -> _Increments:
        def sums(samples: np.ndarray) -> np.ndarray:
            return samples[: len(values) // length * length].reshape(-1, length).sum(axis=1)

        count = sums(used)
        total = sums(np.where(used, values, 0.0))
        means = np.where(count > length / 2, total / np.maximum(count, 1), np.nan)
        steps = np.diff(means)
        still = sums(used & at_rest) > count / 2
        known = np.isfinite(steps)
        return _Increments(
            steps[known], (still[1:] & still[:-1])[known], ~(still[1:] | still[:-1])[known]
        )

    by_length = [increments(length) for length in lengths.tolist()]
    quietest = min(range(len(lengths)), key=lambda i: np.mean(by_length[i].values ** 2))
    steps = [each.values for each in by_length[quietest:]]
    jumps = [_jump_p(s) for s in steps if len(s) >= _FEWEST_STEPS and np.ptp(s)]
    # The longest means that are often at rest show the drift best, if it exceeds the noise there.
    # Where it does not, what seems to be a drift may be what a motor does.
    often = [i for i, each in enumerate(by_length) if each.fewest >= _FEWEST_STEPS]
    shown = often[-1:] if often and often[-1] >= quietest else often
    alike = [by_length[i].alike_p for i in shown]
    line = _line_p(values, used, lengths[0])
    return _smallest_p([line, _smallest_p(jumps), _smallest_p(alike)])


def _smallest_p(tests: list[float]) -> float:
    """Return how probable the smallest of some probabilities is; 1 of none."""
    return min([1.0, *(len(tests) * p for p in tests)])


def between_rests_p(values: np.ndarray, used: np.ndarray, rate_hz: float) -> float:
    """
    Return how probable the steps of a residual over gaps are, by its changes between them.

    A drift goes on within rests. Errors of the stated poses, as of a stand, change in moves alone.
    The variance of a random walk grows by the time from mean to mean, a third of each mean's own.
    """
    runs = [(a, b) for a, b in true_runs(used) if b - a >= rate_hz]
    if len(runs) <= _FEWEST_GAPS:
        return 1.0
    start, stop = np.array(runs).T
    middle = (start + stop) // 2
    half_s = (stop - start) / 2 / rate_hz
    gap_s = (start[1:] - stop[:-1]) / rate_hz
    first = np.array([np.mean(values[a:b]) for a, b in zip(start, middle)])
    last = np.array([np.mean(values[a:b]) for a, b in zip(middle, stop)])
    within = (last - first) / np.sqrt(2 / 3 * half_s)
    between = (first[1:] - last[:-1]) / np.sqrt(gap_s + (half_s[1:] + half_s[:-1]) / 3)
    test = scipy.stats.mannwhitneyu(np.abs(between), np.abs(within), alternative='greater')
    return float(test.pvalue)


def _jump_p(steps: np.ndarray) -> float:
    """
    Return how probable the largest increment with five on each side is, if none is a jump.

    A walk may change its power slowly. The median of an even number of Gaussian sizes is between
    two of them, which are order statistics of a beta distribution.
    """
    sizes = np.abs(steps)
    around = np.lib.stride_tricks.sliding_window_view(sizes, 2 * _AROUND + 1)
    median_size = np.median(np.delete(around, _AROUND, axis=1), axis=1)
    largest = np.max(sizes[_AROUND:-_AROUND] / median_size)
    part = scipy.stats.beta.ppf(_PARTS, _AROUND + 0.5, _AROUND + 0.5)
    median = scipy.stats.norm.ppf((1 + part) / 2)
    return float(min(1.0, len(steps) * np.mean(2 * scipy.stats.norm.sf(largest * median))))


def _line_p(values: np.ndarray, used: np.ndarray, length: int) -> float:
    """Return how probable the strongest line of a residual without lines is, in slow means."""
    changes = np.diff(bridged(values[:, None], used)[:, 0])
    power = scipy.signal.periodogram(changes, window='hann')[1][1:-1]
    # A spectrum that is smooth over frequency has exponential ordinates about its local level.
    level = scipy.ndimage.median_filter(power, _LOCAL_ORDINATES, mode='reflect') / np.log(2)
    ratios = (power / np.maximum(level, np.finfo(float).tiny))[: max(len(power) // length, 1)]
    return float(min(1.0, len(ratios) * np.exp(-ratios.max())))


class _Increments(NamedTuple):
    """Increments between neighbouring means of a residual."""

    values: np.ndarray  # (k,)
    resting: np.ndarray  # Those between means at rest, (k,) bool
    moving: np.ndarray  # Those between means in motion, (k,) bool

    @property
    def fewest(self) -> int:
        """Return the smaller number of those at rest and those in motion."""
        return int(min(self.resting.sum(), self.moving.sum()))

    @property
    def alike_p(self) -> float:
        """Return how probable they are if they are as large at rest as in motion."""
        sizes = np.abs(self.values)
        return float(scipy.stats.mannwhitneyu(sizes[self.resting], sizes[self.moving]).pvalue)
