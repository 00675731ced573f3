# SPDX-License-Identifier: Apache-2.0

"""Overlapping Allan deviation and cell means of a stream of any length, in bounded memory."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

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

    def variance(self, width: int) -> np.ndarray:
        """Return the variance of the rows in windows of so many cells, by column, (w, c)."""
        count = self.count // width
        means = self.means[:count * width].reshape(count, width, -1)
        squares = self.squares[:count * width].reshape(count, width, -1).sum(axis=1)
        between = ((means - means.mean(axis=1, keepdims=True)) ** 2).sum(axis=1) * self.size
        return (squares + between) / max(width * self.size - 1, 1)

    def _join(self) -> None:
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
    """

    def __init__(self, axes: int) -> None:
        # Sum of squared second differences by axis, and their number, by octave
        self._sums: list[np.ndarray] = []
        self._counts: list[int] = []
        # Running sums of the samples, of which the newest are kept
        self._phase = np.zeros((axes, 3 * _LONGEST))
        self._kept = 1
        self._offset: np.ndarray | None = None
        self.count = 0

    def feed(self, samples: np.ndarray) -> None:
        """Add the next samples of the stream, (n, m)."""
        for begin in range(0, len(samples), _LONGEST):
            part = samples[begin:begin + _LONGEST]
            if self._offset is None:
                self._offset = part[0].copy()
            if self._kept + len(part) > self._phase.shape[1]:
                # The longest octave needs twice its length.
                self._phase[:, :2 * _LONGEST] = \
                    self._phase[:, self._kept - 2 * _LONGEST:self._kept].copy()
                self._kept = 2 * _LONGEST
            last, self._kept = self._kept - 1, self._kept + len(part)
            self._phase[:, last + 1:self._kept] = (
                np.cumsum((part - self._offset).T, axis=1) + self._phase[:, [last]])
            self.count += len(part)
            size = 1
            while 2 * size <= self.count and size <= _LONGEST:
                self._add(size, len(part))
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
    """Return the sum of squares of second differences of sums of samples, (n,)."""
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


_WINDOW_S = 2.0
"""Window of the standard deviation of a sample, s. Chosen: noise at low frequency is slower."""
_LARGEST_END_S = 0.2
"""Longest time before the first rest or after the last that is no motion, s. Chosen: rests are
found in blocks of 0.05 s, of which one is left out."""
_FILLED_GAPS = 20
"""Longest gap that is filled by a straight line, in smallest gaps. Chosen: no rest has longer
ones, and a line of days would fill the memory."""
_FEWEST_SAMPLES = 512
"""Fewest samples at rest. Chosen: fewer do not show white noise within 10 %."""
SHORTEST_S = 10.0
"""Shortest rest, s. Chosen: fewer seconds hold no average of one second."""


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
    # Mean temperature of the cells, °C, (k,); None where it is not measured throughout
    temperature_c: np.ndarray | None
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


def longest_rest(read: Callable[[], Iterable[Recording]], unit: Sensor) -> StillStretch:
    """
    Find the longest rest of a recording.

    A recording at rest throughout is read once. Any other is read twice, and the memory is
    bounded in both cases.
    """
    survey = _read(read, unit, None)
    rests = [rest for rest, _ in survey.rests.detected]
    rest = max(rests, key=lambda rest: rest.span_s, default=Rest(0, 0, 0.0, 0.0))
    shortest_s = shortest_rest_s(survey.nominal_hz)
    if rest.span_s < shortest_s:
        raise UserError(f'{survey.path}: rests for {rest.span_s:.4g} s at most, expected '
                        f'{shortest_s:.3g} s at least; record longer, and do not touch the sensor')
    edges_s = np.array([survey.first_s, *(time_s for each in rests for time_s in
                                          (each.time_start_s, each.time_stop_s)), survey.last_s])
    motion_s = [(start_s, stop_s) for start_s, stop_s in edges_s.reshape(-1, 2).tolist()
                if stop_s - start_s > _LARGEST_END_S]
    still, span = survey, ''
    if motion_s or rest.disturbed_s:
        still = _read(read, unit, rest)
        span = f' from {rest.time_start_s:.4g} s to {rest.time_stop_s:.4g} s'
    return still.stretch(span, survey.last_s - survey.first_s, motion_s)


class _Samples:
    """The samples of a recording, or of one of its rests; gaps are filled by straight lines."""

    def __init__(self, block: Recording, unit: Sensor) -> None:
        if len(block) < 2:
            raise UserError(f'{block.path}: {len(block)} samples; record longer')
        self.path, self._names, self.nominal_hz = block.path, block.sensor_columns, block.rate_hz
        columns = len(self._names)
        self.rests = RecordedRests(unit, block)
        self.first_s = self.last_s = np.nan  # Stamps of all samples
        self._allan = AllanStream(columns)
        self._cells = CellMeans(columns + 1)
        self._resolution = np.full(columns, np.inf)
        self._filled = 0
        self._is_whole = True
        # Stamps and newest row of the samples until a gap that is too long to be filled
        self._start_s = self._stop_s = np.nan
        self._last: np.ndarray | None = None

    def feed(self, time_s: np.ndarray, rows: np.ndarray) -> None:
        """Add rows, (n, c), whose gaps are to be filled; the last column is the temperature."""
        is_first = self._last is None
        self.last_s = float(time_s[-1])
        if is_first:
            self.first_s = self._start_s = float(time_s[0])
        steps_s = np.diff(time_s, prepend=time_s[0] if is_first else self._stop_s)
        self._is_whole &= bool((steps_s <= _FILLED_GAPS * gap_s(self.nominal_hz)).all())
        if not self._is_whole:
            return
        if self._last is not None:
            time_s, rows = np.append(self._stop_s, time_s), np.vstack([self._last, rows])
        changes = np.abs(np.diff(rows[:, :-1], axis=0))
        self._resolution = np.minimum(self._resolution, np.where(
            changes > 0, changes, np.inf).min(axis=0, initial=np.inf))
        self._last, self._stop_s = rows[-1], float(time_s[-1])
        rows = self._evenly(time_s, rows)[0 if is_first else 1:]
        self._allan.feed(rows[:, :-1])
        self._cells.feed(rows)

    def _evenly(self, time_s: np.ndarray, rows: np.ndarray) -> np.ndarray:
        steps_s = np.diff(time_s)
        gaps = steps_s > gap_s(self.nominal_hz)
        if not gaps.any():
            return rows
        advance = np.where(gaps, np.maximum(np.rint(steps_s * self.nominal_hz), 1), 1)
        number = np.concatenate([[0], np.cumsum(advance)])
        full = np.arange(number[-1] + 1)
        self._filled += len(full) - len(rows)
        return np.column_stack([np.interp(full, number, column) for column in rows.T])

    def stretch(self, span: str, recorded_s: float, motion_s: list[tuple[float, float]]
                ) -> StillStretch:
        """Return the samples as a rest; refuse an axis that never changes in a span, in words."""
        for name, resolution in zip(self._names, self._resolution):
            if not np.isfinite(resolution):
                raise UserError(f'{self.path}: {name} never changes{span}; the axis is stuck, or '
                                'not connected')
        cells, count = self._cells, self._allan.count
        rate_hz = (count - 1) / (self._stop_s - self._start_s)
        width = min(max(int(np.ceil(_WINDOW_S * rate_hz / cells.size)), 1), cells.count)
        temperature = cells.means[:, -1]
        return StillStretch(
            self._start_s, self._stop_s, rate_hz, count, self._filled,
            self._allan.result(rate_hz, cells), cells.size / rate_hz, cells.means[:, :-1],
            temperature if np.isfinite(temperature).all() else None,
            np.sqrt(cells.variance(width)[:, :-1].mean(axis=0)), self._resolution, recorded_s,
            motion_s)


def _read(read: Callable[[], Iterable[Recording]], unit: Sensor, rest: Rest | None) -> _Samples:
    """Read the undisturbed samples of a rest; those of the whole recording where it is None."""
    samples: _Samples | None = None
    held = np.nan
    for block in read():
        time_s = block.time_s
        temperature, held = _held(block, held)
        rows = np.column_stack([block.accel_mps2(unit), temperature])
        if rest is not None:
            inside = (time_s >= rest.time_start_s) & (time_s <= rest.time_stop_s)
            for start_s, stop_s in rest.disturbed_s:
                inside &= (time_s <= start_s) | (time_s >= stop_s)
            time_s, rows = time_s[inside], rows[inside]
        if not len(rows):
            continue
        samples = samples or _Samples(block, unit)
        samples.feed(time_s, rows)
        if rest is None:
            samples.rests.feed(block)
    if samples is None:
        raise UserError('the recording holds no samples')
    if rest is None:
        samples.rests.take()
    return samples


def _held(block: Recording, last: float) -> tuple[np.ndarray, float]:
    """Return the temperature, °C, (n,), which holds between its readings, and the newest one."""
    values = block.columns.get('temperature_c', np.full(len(block), np.nan))
    is_read = np.isfinite(values)
    if not is_read.any():
        return np.full(len(block), last), last
    place = np.maximum.accumulate(np.where(is_read, np.arange(len(values)), -1))
    first = last if np.isfinite(last) else float(values[is_read][0])
    return np.where(place < 0, first, values[place]), float(values[is_read][-1])
