# SPDX-License-Identifier: Apache-2.0

"""Overlapping Allan deviation and cell means of a stream of any length, in bounded memory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_LONGEST = 1 << 20
"""Largest number of samples of an averaging time with all overlaps. Chosen: 17 min at 1 kHz, and
25 MB an axis."""
_MOST_CELLS = 1 << 17
"""Cells of a stream at most; then neighbours are joined. Chosen: 24 h at 1 kHz are cells of 1 s.
"""
_AT_ONCE = 1 << 13
"""Differences that are summed at a time. Chosen: they stay in the cache of a core."""
_FEWEST_AVERAGES = 3
"""Averages side by side at the longest time. Chosen: two differences."""


@dataclass(frozen=True)
class AllanDeviation:
    """The overlapping Allan deviation of a stream; u is its unit."""

    tau_s: np.ndarray  # Averaging times, s, (k,)
    deviation: np.ndarray  # Allan deviation by time and axis, u, (k, m)
    # Number of averages side by side, (k,): the time of the stream divided by `tau_s`
    averages: np.ndarray

    @property
    def relative_error(self) -> np.ndarray:
        """Return the relative standard deviation of a point, (k,) (IEEE Std 952, C.1.6)."""
        return 1 / np.sqrt(2 * (self.averages - 1))


class CellMeans:
    """
    Means and squared deviations of cells of equal length.

    Where there are too many cells, neighbours are joined. The memory is bounded so, and cells of
    a short stream are short.

    Parameters
    ----------
    columns
        Number of columns of the stream.

    """

    def __init__(self, columns: int) -> None:
        self.size = 1  # Samples of a cell
        self.count = 0  # Complete cells
        self._means = np.empty((_MOST_CELLS, columns))
        self._squares = np.empty((_MOST_CELLS, columns))
        self._leftover = np.empty((0, columns))

    @property
    def means(self) -> np.ndarray:
        """Means by cell and column, (k, c)."""
        return self._means[:self.count]

    @property
    def squares(self) -> np.ndarray:
        """Squared deviations from the mean, summed by cell and column, (k, c)."""
        return self._squares[:self.count]

    def feed(self, rows: np.ndarray) -> None:
        """Add the next rows of the stream, (n, c)."""
        rows = np.concatenate([self._leftover, rows])
        while len(rows) >= self.size:
            count = min(len(rows) // self.size, _MOST_CELLS - self.count)
            cells = rows[:count * self.size].reshape(count, self.size, -1)
            rows = rows[count * self.size:]
            part = slice(self.count, self.count + count)
            self._means[part] = cells.mean(axis=1)
            self._squares[part] = ((cells - self._means[part, None]) ** 2).sum(axis=1)
            self.count += count
            if self.count == _MOST_CELLS:
                self._join()
        self._leftover = rows.copy()

    def _join(self) -> None:
        """Join each cell with its neighbour."""
        half = self.count // 2
        pairs = self.means.reshape(half, 2, -1)
        differences = pairs[:, 1] - pairs[:, 0]
        self._squares[:half] = (self.squares.reshape(half, 2, -1).sum(axis=1)
                                + differences ** 2 * (self.size / 2))
        self._means[:half] = pairs.mean(axis=1)
        self.count = half
        self.size *= 2


class AllanStream:
    """
    Computes the overlapping Allan deviation at octaves of time while the samples come in.

    Up to an averaging time of 2²⁰ samples, all overlaps are used. Longer times come from the
    means of cells, in steps of a cell, which is less than a hundredth of such a time.

    Parameters
    ----------
    axes
        Number of axes, m.

    """

    def __init__(self, axes: int) -> None:
        self._sums: list[np.ndarray] = []
        self._counts: list[int] = []
        self._phase = np.zeros((axes, 1))
        self._kept = 1
        self._offset: np.ndarray | None = None
        self.count = 0

    def feed(self, samples: np.ndarray) -> None:
        """Add the next samples of the stream, (n, m)."""
        if not len(samples):
            return
        if self._offset is None:
            self._offset = samples[0].copy()
        steps = np.cumsum((samples - self._offset).T, axis=1)
        self._append(steps)
        self.count += len(samples)
        size = 1
        while 2 * size <= self.count and size <= _LONGEST:
            self._add(size, len(samples))
            size *= 2

    def result(self, rate_hz: float, cells: CellMeans) -> AllanDeviation:
        """Return the Allan deviation of the samples so far."""
        sizes = [1 << i for i in range(len(self._sums))
                 if _FEWEST_AVERAGES << i <= self.count]
        variances = [sums / (2 * size ** 2 * count) for size, sums, count
                     in zip(sizes, self._sums, self._counts)]
        size = 2 * _LONGEST
        while _FEWEST_AVERAGES * size <= self.count:
            sizes.append(size)
            variances.append(_from_cells(cells, size // cells.size, len(self._phase)))
            size *= 2
        tau = np.array(sizes) / rate_hz
        return AllanDeviation(tau, np.sqrt(np.array(variances)), self.count / np.array(sizes))

    def _append(self, steps: np.ndarray) -> None:
        """Append sums (m, n), counted from the last one; forget what no octave needs."""
        new = steps.shape[1]
        if self._kept + new > self._phase.shape[1]:
            keep = min(self._kept, 2 * _LONGEST)
            capacity = min(2 * (keep + new), 3 * _LONGEST + new)
            larger = np.empty((len(self._phase), max(capacity, keep + new)))
            larger[:, :keep] = self._phase[:, self._kept - keep:self._kept]
            self._phase, self._kept = larger, keep
        self._phase[:, self._kept:self._kept + new] = steps + self._phase[:, [self._kept - 1]]
        self._kept += new

    def _add(self, size: int, new: int) -> None:
        """Add the second differences over `size` samples that end in the `new` newest ones."""
        octave = size.bit_length() - 1
        if octave == len(self._sums):
            # An octave begins late: all earlier samples are still there.
            self._sums.append(np.zeros(len(self._phase)))
            self._counts.append(0)
            new = self.count
        stop = self._kept
        start = max(stop - new, stop - self.count - 1 + 2 * size)
        for axis, phase in enumerate(self._phase):
            self._sums[octave][axis] += _sum_of_squares(phase, size, start, stop)
        self._counts[octave] += stop - start


def _sum_of_squares(phase: np.ndarray, size: int, start: int, stop: int) -> float:
    """
    Return the sum of squares of second differences.

    phase: sums of the samples, (n,).
    """
    total = 0.0
    for begin in range(start, stop, _AT_ONCE):
        end = min(begin + _AT_ONCE, stop)
        middle = phase[begin - size:end - size]
        difference = phase[begin:end] - middle
        difference -= middle - phase[begin - 2 * size:end - 2 * size]
        total += float(difference @ difference)
    return total


def _from_cells(cells: CellMeans, size: int, axes: int) -> np.ndarray:
    """Return the Allan variance over `size` cells by axis, u², (m,)."""
    means = cells.means[:, :axes]
    phase = np.cumsum(np.vstack([np.zeros(axes), means - means[0]]), axis=0)
    differences = phase[2 * size:] - 2 * phase[size:-size] + phase[:-2 * size]
    return (differences ** 2).mean(axis=0) / (2 * size ** 2)
