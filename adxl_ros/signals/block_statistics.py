# SPDX-License-Identifier: Apache-2.0

"""Statistics of a stream of samples in short blocks, from which rests are found."""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np

BLOCK_S = 0.05
"""Length of a block, s. Chosen: well below a rest, and above the sample period of most sensors."""
_GAP_S = 0.1
"""Smallest time without a sample that ends a block, s. Chosen: two blocks."""
_GAP_PERIODS = 5
"""Smallest gap in sample periods. Chosen: at low rates a few lost samples are no gap."""
_CHUNK = 1 << 13
"""Rows processed at once. Chosen: they fit into the cache, whatever the length of a recording."""


def gap_s(rate_hz: float) -> float:
    """Return the smallest time without a sample that is a gap, s."""
    return max(_GAP_S, _GAP_PERIODS / rate_hz)


def block_samples(rate_hz: float) -> int:
    """Return the number of samples in a block at a sample rate, Hz."""
    return max(1, round(BLOCK_S * rate_hz))


@dataclass(frozen=True)
class Blocks:
    """Sums over k blocks of equally many rows."""

    start: np.ndarray  # Row of the stream at which each block begins, (k,)
    time_s: np.ndarray  # Time of the first and last row, s, (k, 2)
    run: np.ndarray  # Number of the gapless run that the block belongs to, (k,)
    count: np.ndarray  # Number of rows without NaN, (k,); 0 if these are at most half of the rows
    # Mean of these rows by axis, (k, m); without such rows the mean of the block before
    mean: np.ndarray
    squares: np.ndarray  # Sum of the squared deviations from the mean, (k, m)
    # Smallest change between consecutive rows that is not 0, (k, m); inf if nothing changes. It is
    # the step of the ADC if the noise exceeds that step.
    step: np.ndarray
    # Lowest and highest encoder angle, rad, (k, 2, a); NaN where none was sampled
    angle: np.ndarray

    def __len__(self) -> int:
        """Return the number of blocks."""
        return len(self.start)

    def __getitem__(self, part: slice | np.ndarray) -> Blocks:
        """Return the blocks that a slice or an index array selects."""
        return Blocks(*(getattr(self, f.name)[part] for f in fields(self)))

    @staticmethod
    def join(parts: list[Blocks]) -> Blocks:
        """Concatenate the blocks of several parts of one stream."""
        return Blocks(*(np.concatenate([getattr(p, f.name) for p in parts])
                        for f in fields(Blocks)))


class BlockCutter:
    """
    Cuts a stream into blocks; the portions in which it is fed do not change the blocks.

    A gap in time, or time that runs backwards, begins a new run. The incomplete block before it
    is dropped.
    """

    def __init__(self, rate_hz: float, axes: int, angles: int = 0):
        self.size = block_samples(rate_hz)
        self._axes = axes
        self._gap_s = gap_s(rate_hz)
        self._leftover = np.empty((1 + axes + angles, 0))
        self._mean = np.zeros((axes, 1))
        self._row = 0
        self._run = -1
        self._last_time_s = -np.inf

    def feed(self, time_s: np.ndarray, samples: np.ndarray,
             angles_rad: np.ndarray | None = None) -> Blocks:
        """
        Add the next rows of the stream.

        time_s: time of each row, s, (n,); samples: rows of the stream, (n, m); a row with a NaN is
        left out; angles_rad: encoder angles, rad, (n, a), NaN where not sampled.
        """
        columns = [time_s[:, None], samples] + ([] if angles_rad is None else [angles_rad])
        return Blocks.join([self.none()] + [
            self._cut(np.concatenate([part[i:i + _CHUNK].T for part in columns]))
            for i in range(0, len(time_s), _CHUNK)])

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
        complete = np.diff(edges) // self.size
        start = np.repeat(edges[:-1] + self.size * (complete - np.cumsum(complete)), complete)
        start += self.size * np.arange(len(start))
        blocks = self._summed(columns, start,
                              self._run + np.searchsorted(begins, start, side='right'))
        # The next call counts a gap within the leftover rows.
        used = int(edges[-2] + self.size * complete[-1])
        self._run += int(np.searchsorted(begins, used))
        self._row += used
        if used:
            self._last_time_s = columns[0, used - 1]
        self._leftover = columns[:, used:]
        return blocks

    def _summed(self, columns: np.ndarray, start: np.ndarray, run: np.ndarray) -> Blocks:
        """Compute the statistics of the blocks that begin at the columns `start`."""
        block = columns[:, start[:, None] + np.arange(self.size)]
        samples, angles = block[1:1 + self._axes], block[1 + self._axes:]
        finite = np.isfinite(samples).all(axis=0)
        if not finite.all():
            finite &= 2 * finite.sum(axis=1, keepdims=True) > self.size
            samples = np.where(finite, samples, np.nan)
        count = finite.sum(axis=1)
        change = np.abs(np.diff(samples, axis=2))
        step = np.where(change > 0, change, np.inf).min(axis=2, initial=np.inf)
        # Spikes of 1e38 and more overflow here; such a block is never at rest.
        with np.errstate(over='ignore', invalid='ignore'):
            mean = np.where(finite, samples, 0).sum(axis=2) / np.maximum(count, 1)
            squares = (np.where(finite, samples - mean[..., None], 0) ** 2).sum(axis=2)
        # A block without samples takes the mean of the newest block before it.
        mean = np.concatenate([self._mean, mean], axis=1)
        mean = mean[:, np.maximum.accumulate(np.where(count, np.arange(1, len(count) + 1), 0))]
        if len(count):
            self._mean = mean[:, -1:]
        bounds = np.stack([np.fmin.reduce(angles, axis=2), np.fmax.reduce(angles, axis=2)])
        return Blocks(self._row + start, block[0][:, [0, -1]], run, count, mean.T, squares.T,
                      step.T, bounds.transpose(2, 0, 1))


def angle_bounds(blocks: Blocks) -> np.ndarray:
    """
    Return the bounds of the encoder angles of each block as (−lowest, highest), rad, (k, 2, a).

    With this sign the bounds of several blocks are the maximum of their bounds. The readings
    before and after a block count too: an encoder that is read less often than the sensor may turn
    between two readings.
    """
    bounds = blocks.angle * np.array([[-1.0], [1.0]])
    has_angle = np.isfinite(bounds).all(axis=(1, 2))
    place, last = np.arange(len(has_angle)), len(has_angle) - 1
    before = np.maximum.accumulate(np.where(has_angle, place, 0))
    after = np.minimum.accumulate(np.where(has_angle, place, last)[::-1])[::-1]
    return np.fmax(bounds, np.fmax(bounds[before[np.maximum(place - 1, 0)]],
                                   bounds[after[np.minimum(place + 1, last)]]))


def true_runs(mask: np.ndarray, group: np.ndarray | None = None) -> list[tuple[int, int]]:
    """
    List the runs of True in a mask.

    mask: booleans, (k,); group: numbers, not negative, (k,). A run ends where the number changes.
    None for one group.
    """
    number = np.where(mask, 0 if group is None else group, -1)
    edges = np.flatnonzero(np.diff(number, prepend=-2, append=-2))
    return [(int(first), int(stop)) for first, stop in pairwise(edges) if mask[first]]
