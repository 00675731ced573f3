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

"""A stream of samples cut into short blocks: all that the search for rests keeps of it."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

BLOCK_S = 0.05
"""Length of a block, s: well below a rest, well above the time between samples where it can be."""
GAP_S = 0.1
"""Time without a sample that ends a block and a rest, s (or five samples, if that is longer)."""
CHUNK = 1 << 16
"""Samples worked on at once: what fits a cache, so that long recordings cost no memory."""


def block_samples(rate_hz: float) -> int:
    """Count the samples in a block at `rate_hz`."""
    return max(1, round(BLOCK_S * rate_hz))


@dataclass(frozen=True)
class Blocks:
    """
    Sums over k blocks of equally many rows.

    Attributes
    ----------
    start
        Row of the stream at which each block begins, (k,).
    time_s
        Time of the first and last row, s, (k, 2).
    run
        Number of the gapless run that the block is a part of, (k,).
    count
        Rows without NaN, (k,).
    mean
        Mean by axis, (k, m); NaN where half the rows are missing.
    squares
        Sum of the squared deviations from the mean, (k, m).
    step
        Smallest change between consecutive rows that is not 0, (k, m): the step of the ADC if
        the noise reaches it; inf if nothing changes.
    angle
        Lowest and highest encoder angle, rad, (k, 2, a); NaN where none was sampled.

    """

    start: np.ndarray
    time_s: np.ndarray
    run: np.ndarray
    count: np.ndarray
    mean: np.ndarray
    squares: np.ndarray
    step: np.ndarray
    angle: np.ndarray

    def __len__(self) -> int:
        """Count the blocks."""
        return len(self.start)

    def __getitem__(self, part: slice | np.ndarray) -> Blocks:
        """Take the blocks of `part`."""
        return Blocks(*(getattr(self, f.name)[part] for f in fields(self)))

    @staticmethod
    def join(parts: list[Blocks]) -> Blocks:
        """Put the blocks of several parts of one stream in a row."""
        return Blocks(*(np.concatenate([getattr(p, f.name) for p in parts])
                        for f in fields(Blocks)))


class BlockCutter:
    """
    Cuts a stream into blocks; how the stream is portioned makes no difference to them.

    A gap in time, or time that runs backwards, begins a new run, and what is left of the block
    before it is not used.

    Parameters
    ----------
    rate_hz
        Nominal sample rate, Hz.
    axes, angles
        Number of measured axes m and of encoder angles a.

    """

    def __init__(self, rate_hz: float, axes: int, angles: int = 0):
        self.size = block_samples(rate_hz)
        self._axes = axes
        self._gap_s = max(GAP_S, 5 / rate_hz)
        self._rest = np.empty((0, 1 + axes + angles))
        self._row = 0
        self._run = -1
        self._last_time_s = -np.inf

    def feed(self, time_s: np.ndarray, samples: np.ndarray,
             angles_rad: np.ndarray | None = None) -> Blocks:
        """
        Take the next rows of the stream and return the blocks that they complete.

        Parameters
        ----------
        time_s
            Time of each row, s, (n,).
        samples
            Rows of the stream, (n, m); a row with a NaN is left out.
        angles_rad
            Encoder angles, rad, (n, a), NaN where not sampled.

        """
        columns = [time_s, samples] if angles_rad is None else [time_s, samples, angles_rad]
        rows = np.column_stack([np.asarray(c, float) for c in columns])
        return Blocks.join([self._cut(rows[i:i + CHUNK])
                            for i in range(0, max(len(rows), 1), CHUNK)])

    def none(self) -> Blocks:
        """Give no blocks, of the right shape."""
        return self._summed(self._rest, np.empty(0, int), np.empty(0, int))

    def _cut(self, rows: np.ndarray) -> Blocks:
        rows = np.concatenate([self._rest, rows])
        step_s = np.diff(rows[:, 0], prepend=self._last_time_s)
        broken = ~((step_s >= 0) & (step_s <= self._gap_s))
        begins = np.flatnonzero(broken)
        edges = np.unique(np.concatenate([[0], begins, [len(rows)]]))
        whole = np.diff(edges) // self.size
        first = np.repeat(edges[:-1] + self.size * (whole - np.cumsum(whole)), whole)
        start = first + self.size * np.arange(len(first))
        run = self._run + np.searchsorted(begins, start, side='right')
        kept = len(rows) if not len(whole) else edges[-2] + self.size * whole[-1]
        blocks = self._summed(rows, start, run)
        # Breaks within what is kept for later are seen again then, with the same time before.
        self._run += int(np.searchsorted(begins, kept))
        self._row += kept
        if kept:
            self._last_time_s = rows[kept - 1, 0]
        self._rest = rows[kept:]
        return blocks

    def _summed(self, rows: np.ndarray, start: np.ndarray, run: np.ndarray) -> Blocks:
        block = rows[start[:, None] + np.arange(self.size)]
        samples, angles = block[:, :, 1:1 + self._axes], block[:, :, 1 + self._axes:]
        good = np.isfinite(samples).all(axis=2)
        count = good.sum(axis=1)
        enough = 2 * count > self.size
        # Spikes of 1e38 and worse overflow here: such a block is not at rest, whatever it holds.
        with np.errstate(over='ignore', invalid='ignore'):
            total = np.where(good[..., None], samples, 0).sum(axis=1)
            mean = np.where(enough, 1.0, np.nan)[:, None] * total / np.maximum(count, 1)[:, None]
            deviation = np.where(good[..., None], samples - mean[:, None], 0)
            change = np.abs(np.diff(samples, axis=1))
            squares = (deviation ** 2).sum(axis=1)
        step = np.where(change > 0, change, np.inf).min(axis=1, initial=np.inf)
        angle = np.stack([np.fmin.reduce(angles, axis=1), np.fmax.reduce(angles, axis=1)], axis=1)
        return Blocks(self._row + start, block[:, [0, -1], 0], run, count, mean, squares, step,
                      angle)
