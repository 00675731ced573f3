# SPDX-License-Identifier: Apache-2.0

"""Overlapping Allan deviation and cell means of a stream of any length, in bounded memory."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import Recording
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.block_statistics import gap_s
from adxl_ros.signals.rest_detection import RecordedRests, Rest
import numpy as np

_LONGEST = 1 << 20
"""Largest number of samples of an averaging time with all overlaps. Chosen: 17 min at 1 kHz, and
25 MB an axis."""
_MOST_CELLS = 1 << 17
"""Cells of a stream at most; then neighbours are joined. Chosen: 24 h at 1 kHz are cells of 1 s.
"""
_AT_ONCE = 1 << 13  # Samples that are added at a time. Chosen: they stay in the cache of a core
_FEWEST_AVERAGES = 3  # Averages side by side at the longest time. Chosen: two differences


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
    Means of cells of equal length.

    Where there are too many cells, neighbours are joined. The memory is bounded so, and cells of
    a short stream are short.
    """

    def __init__(self, columns: int) -> None:
        self.size = 1  # Samples of a cell
        self.means = np.empty((0, columns))  # Means by cell and column, (k, c)
        self._leftover = np.empty((0, columns))

    def feed(self, rows: np.ndarray) -> None:
        """Add the next rows of the stream, (n, c)."""
        rows = np.concatenate([self._leftover, rows])
        stop = len(rows) // self.size * self.size
        cells = rows[:stop].reshape(-1, self.size, rows.shape[1]).mean(axis=1)
        self.means, self._leftover = np.concatenate([self.means, cells]), rows[stop:].copy()
        while len(self.means) >= _MOST_CELLS:
            even = len(self.means) // 2 * 2
            odd = np.repeat(self.means[even:], self.size, axis=0)
            self._leftover = np.concatenate([odd, self._leftover])
            self.means = self.means[:even].reshape(-1, 2, rows.shape[1]).mean(axis=1)
            self.size *= 2


class AllanStream:
    """
    Computes the overlapping Allan deviation at octaves of time while the samples come in.

    Up to an averaging time of 2²⁰ samples, all overlaps are used. Longer times come from the
    means of cells, in steps of a cell, which is less than a hundredth of such a time.
    """

    def __init__(self, axes: int) -> None:
        # Sum of squared second differences by octave and axis, and their number by octave
        self._sums = np.zeros((_LONGEST.bit_length(), axes))
        self._counts = [0] * _LONGEST.bit_length()
        # Running sums of the samples, of which the newest are kept
        self._phase = np.zeros((axes, 3 * _LONGEST))
        self._kept = 1
        self._offset: np.ndarray | None = None
        self.count = 0

    def feed(self, samples: np.ndarray) -> None:
        """Add the next samples of the stream, (n, m)."""
        if self._offset is None:
            self._offset = samples[0].copy()
        for begin in range(0, len(samples), _AT_ONCE):
            part = samples[begin:begin + _AT_ONCE]
            if self._kept + len(part) > self._phase.shape[1]:
                # The longest octave needs twice its length.
                self._phase[:, :2 * _LONGEST] = \
                    self._phase[:, self._kept - 2 * _LONGEST:self._kept].copy()
                self._kept = 2 * _LONGEST
            last, self._kept = self._kept - 1, self._kept + len(part)
            self._phase[:, last + 1:self._kept] = (
                np.cumsum((part - self._offset).T, axis=1) + self._phase[:, [last]])
            self.count += len(part)
            for octave, before in enumerate(self._counts):
                size = 1 << octave
                new = self.count + 1 - 2 * size - before  # differences that end in `part`
                if new <= 0:
                    break
                late, middle, early = (self._phase[:, self._kept - new - lag:self._kept - lag]
                                       for lag in (0, size, 2 * size))
                difference = late - middle - (middle - early)
                self._sums[octave] += np.einsum('ij,ij->i', difference, difference)
                self._counts[octave] += new

    def result(self, rate_hz: float, cells: CellMeans) -> AllanDeviation:
        """Return the Allan deviation of the samples so far."""
        sizes = [1 << octave for octave in range((self.count // _FEWEST_AVERAGES).bit_length())]
        squares = [sums / count for _, sums, count in zip(sizes, self._sums, self._counts)]
        squares += [_from_cells(cells, size // cells.size) * cells.size ** 2
                    for size in sizes[len(squares):]]
        size = np.array(sizes)
        return AllanDeviation(size / rate_hz, np.sqrt(np.array(squares) / 2) / size[:, None],
                              self.count / size)


def _from_cells(cells: CellMeans, size: int) -> np.ndarray:
    """Return the mean square of second differences over `size` cells by axis, u², (m,)."""
    phase = np.cumsum(np.vstack([np.zeros_like(cells.means[0]), cells.means - cells.means[0]]), 0)
    differences = phase[2 * size:] - 2 * phase[size:-size] + phase[:-2 * size]
    return (differences ** 2).mean(axis=0)


_WINDOW_S = 2.0  # Shortest window of the std of a sample, s. Chosen: slow noise is slower
_LARGEST_END_S = 0.2  # Longest end without a rest that is no motion, s. Chosen: some blocks
_FEWEST_SAMPLES = 512  # Fewest samples at rest. Chosen: fewer do not show white noise within 10 %
SHORTEST_S = 10.0  # Shortest rest, s. Chosen: fewer seconds hold no average of one second


@dataclass(frozen=True)
class StillStretch:
    """The samples of the longest rest."""

    start_s: float  # Its first stamp, s
    stop_s: float  # Its last stamp, s
    rate_hz: float  # Sample rate by its stamps, Hz
    count: int  # Number of its samples
    filled: int  # Samples among them that were missing, and lie on a line between their neighbours
    allan: AllanDeviation  # Their Allan deviation, m/s²
    step_s: float  # Length of a cell, s
    means: np.ndarray  # Means of the cells by axis, m/s², (k, m)
    # Standard deviation of a sample within some seconds by axis, m/s², (m,)
    sample_std: np.ndarray
    resolution: np.ndarray  # Smallest change of a sample by axis, m/s², (m,)
    recorded_s: float  # Time of the whole recording, s
    motion_s: list[tuple[float, float]]  # Times at which it moves or has long gaps, s, (j, 2)

    @property
    def span_s(self) -> float:
        """Time of the rest, s."""
        return self.count / self.rate_hz


def shortest_rest_s(rate_hz: float) -> float:
    """Return the shortest rest that shows noise, from its first to its last sample, s."""
    return max(SHORTEST_S, _FEWEST_SAMPLES / rate_hz) - 1 / rate_hz


def longest_rest(read: Callable[[], Iterable[Recording]], unit: Sensor, first: Recording
                 ) -> StillStretch:
    """Find the longest rest of a recording, which is read twice; the memory is bounded."""
    if len(first) < 2:
        raise UserError(f'{first.path}: {len(first)} samples; record longer')
    survey, first_s = RecordedRests(unit, first), float(first.time_s[0])
    for block in read():
        survey.feed(block)
        last_s = float(block.time_s[-1])
    survey.take()
    rests = [rest for rest, _ in survey.detected]
    rest = max(rests, key=lambda rest: rest.span_s, default=Rest(0, 0, 0.0, 0.0))
    shortest_s = shortest_rest_s(first.rate_hz)
    if rest.span_s < shortest_s:
        raise UserError(f'{first.path}: rests for {rest.span_s:.4g} s at most, expected '
                        f'{shortest_s:.3g} s at least; record longer, and do not touch the sensor')
    edges_s = np.array([first_s, *(time_s for each in rests for time_s in
                                   (each.time_start_s, each.time_stop_s)), last_s])
    motion_s = [(start_s, stop_s) for start_s, stop_s in edges_s.reshape(-1, 2).tolist()
                if stop_s - start_s > _LARGEST_END_S]
    if not motion_s:
        rest = replace(rest, time_start_s=first_s, time_stop_s=last_s)
    samples = _Samples(first)
    for block in read():
        samples.feed(block, unit, rest)
    return samples.stretch(last_s - first_s, motion_s)


class _Samples:
    """The undisturbed samples of a rest; gaps are filled by straight lines."""

    def __init__(self, first: Recording) -> None:
        self._first, columns = first, len(first.sensor_columns)
        self._allan = AllanStream(columns)
        self._cells = CellMeans(columns)
        self._resolution = np.full(columns, np.inf)
        self._filled = 0
        # Stamps of the first and the newest sample, and the newest row
        self._start_s = self._stop_s = np.nan
        self._last: np.ndarray | None = None

    def feed(self, block: Recording, unit: Sensor, rest: Rest) -> None:
        """Add the samples of a block that are part of the rest."""
        time_s = block.time_s
        inside = (time_s >= rest.time_start_s) & (time_s <= rest.time_stop_s)
        for start_s, stop_s in rest.disturbed_s:
            inside &= (time_s <= start_s) | (time_s >= stop_s)
        if not inside.any():
            return
        rows, time_s = block.accel_mps2(unit)[inside], time_s[inside]
        new = int(self._last is not None)
        if self._last is None:
            self._start_s = float(time_s[0])
        else:
            time_s, rows = np.append(self._stop_s, time_s), np.vstack([self._last, rows])
        self._last, self._stop_s = rows[-1], float(time_s[-1])
        changes = np.abs(np.diff(rows, axis=0))
        self._resolution = np.minimum(self._resolution, np.where(
            changes > 0, changes, np.inf).min(axis=0, initial=np.inf))
        steps_s, rate_hz = np.diff(time_s), self._first.rate_hz
        advance = np.where(steps_s > gap_s(rate_hz), np.rint(steps_s * rate_hz), 1)
        number = np.concatenate([[0], np.cumsum(advance)])
        full = np.arange(number[-1] + 1)
        if len(full) > len(rows):
            self._filled += len(full) - len(rows)
            rows = np.column_stack([np.interp(full, number, column) for column in rows.T])
        self._allan.feed(rows[new:])
        self._cells.feed(rows[new:])

    def stretch(self, recorded_s: float, motion_s: list[tuple[float, float]]) -> StillStretch:
        """Return the samples as a rest; refuse an axis that never changes."""
        for name, resolution in zip(self._first.sensor_columns, self._resolution):
            if not np.isfinite(resolution):
                raise UserError(f'{self._first.path}: {name} never changes from '
                                f'{self._start_s:.4g} s to {self._stop_s:.4g} s; the axis is '
                                'stuck, or not connected')
        cells, count = self._cells, self._allan.count
        rate_hz = (count - 1) / (self._stop_s - self._start_s)
        allan = self._allan.result(rate_hz, cells)
        # The variance within 2^k samples is that of the octaves of Haar's wavelets in it.
        octaves = max(int(np.ceil(np.log2(_WINDOW_S * rate_hz))), 1)
        variance = (allan.deviation[:octaves] ** 2).sum(axis=0) / 2 / (1 - 0.5 ** octaves)
        return StillStretch(
            self._start_s, self._stop_s, rate_hz, count, self._filled, allan,
            cells.size / rate_hz, cells.means, np.sqrt(variance), self._resolution, recorded_s,
            motion_s)
