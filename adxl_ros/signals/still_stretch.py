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

"""The longest part of a recording in which the sensor rests, read in blocks."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise

from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import Recording
from adxl_ros.signals.allan_deviation import AllanDeviation, AllanStream, CellMeans
from adxl_ros.signals.block_statistics import GAP_S
from adxl_ros.signals.runs import true_runs
import numpy as np

_GAP_PERIODS = 5
"""Smallest gap in sample periods. Chosen: stamps of a slow sensor scatter."""
_LONGEST_FILLED_S = 1.0
"""Longest gap that is filled by a straight line, s. Chosen: it changes no average of minutes."""
_BURSTS = 0.5
"""Median step of stamps in bursts, divided by the mean step, is below this."""
_WINDOW_S = 2.0
"""Shortest window in which a motion is looked for, s. Chosen: a knock stays visible in it."""
_WINDOW_SAMPLES = 32
"""Fewest samples of a window. Chosen: the variance of white noise is then known within 25 %."""
_QUIET_QUANTILE = 0.25
"""Quantile of the windows' variances that is the noise. Chosen: up to three quarters may move."""
_LARGEST_VARIANCE = 5.0
"""Variance of a window at rest, divided by that quantile. Chosen: never reached by white noise."""
_FEWEST_SAMPLES = 512
"""Fewest samples at rest. Chosen: fewer do not show white noise within 10 %."""
SHORTEST_S = 10.0
"""Shortest rest, s. Chosen: fewer seconds hold no average of one second."""


@dataclass(frozen=True)
class StillStretch:
    """
    The samples of the longest rest.

    Attributes
    ----------
    start_s, stop_s
        Its first and last stamp, s.
    rate_hz
        Sample rate by its stamps, Hz.
    count
        Number of its samples.
    filled
        Samples among them that were missing, and lie on a line between their neighbours.
    allan
        Their Allan deviation, m/s².
    step_s
        Length of a cell, s.
    means
        Means of the cells by axis, m/s², (k, m).
    temperature_c
        Mean temperature of the cells, °C, (k,); None where it is not measured throughout.
    sample_std
        Standard deviation of a sample within some seconds by axis, m/s², (m,).
    resolution
        Smallest change of a sample by axis, m/s², (m,).
    recorded_s
        Time of the whole recording, s.
    motion_s
        Times at which it moves or has long gaps, s, (j, 2).

    """

    start_s: float
    stop_s: float
    rate_hz: float
    count: int
    filled: int
    allan: AllanDeviation
    step_s: float
    means: np.ndarray
    temperature_c: np.ndarray | None
    sample_std: np.ndarray
    resolution: np.ndarray
    recorded_s: float
    motion_s: list[tuple[float, float]]

    @property
    def span_s(self) -> float:
        """Time of the rest, s."""
        return self.count / self.rate_hz


def longest_rest(read: Callable[[], Iterable[Recording]],
                 accel_mps2: Callable[[Recording], np.ndarray]) -> StillStretch:
    """
    Find the longest rest of a recording.

    A recording at rest throughout is read once. Any other is read twice, and the memory is
    bounded in both cases.

    Parameters
    ----------
    read
        Opens the recording and returns its blocks.
    accel_mps2
        Returns the specific force of a block, m/s², (n, m).

    Returns
    -------
    StillStretch
        The longest rest.

    Raises
    ------
    UserError
        The recording cannot be read, does not rest, or an axis does not change.

    """
    survey = _read(read, accel_mps2, -np.inf, np.inf)
    _check_axes(survey)
    moving, window = _moving(survey.longest)
    breaks = list(survey.breaks)
    if not moving.any():
        return _stretch(survey, survey, breaks)
    start, stop = max(true_runs(~moving, np.zeros(len(moving))), key=lambda run: run[1] - run[0],
                      default=(0, 0))
    # A motion may begin or end within the window before and after.
    start, stop = start + int(start > 0), stop - int(stop < len(moving))
    begin_s, length_s = survey.longest.start_s, window / survey.longest.rate_hz
    breaks += [(begin_s + first * length_s, begin_s + last * length_s)
               for first, last in true_runs(moving, np.zeros(len(moving)))]
    if (stop - start) * length_s < SHORTEST_S:
        raise UserError(f'{survey.path}: rests for {max(stop - start, 0) * length_s:.3g} s at '
                        f'most, expected {SHORTEST_S:g} s at least; record a sensor that nobody '
                        'touches')
    end_s = np.inf if stop == len(moving) else begin_s + stop * length_s
    rest = _read(read, accel_mps2, begin_s + start * length_s, end_s)
    _check_axes(rest, f' from {rest.longest.start_s:.4g} s to {rest.longest.stop_s:.4g} s')
    return _stretch(survey, rest, sorted(breaks))


class _Segment:
    """Samples without a long gap, as far as they have been read."""

    def __init__(self, columns: int, rate_hz: float) -> None:
        self.nominal_hz = rate_hz
        self.allan = AllanStream(columns - 1)
        self.cells = CellMeans(columns)
        self.resolution = np.full(columns - 1, np.inf)
        self.filled = 0
        self.start_s = self.stop_s = np.nan
        self._last: np.ndarray | None = None

    @property
    def count(self) -> int:
        """Count of the samples."""
        return self.allan.count

    @property
    def rate_hz(self) -> float:
        """Sample rate by the stamps, Hz."""
        return (self.count - 1) / (self.stop_s - self.start_s)

    def feed(self, time_s: np.ndarray, rows: np.ndarray) -> None:
        """Add rows, (n, c), whose gaps are to be filled; the last column is the temperature."""
        if not len(rows):
            return
        is_first = self._last is None
        if self._last is None:
            self.start_s = float(time_s[0])
        else:
            time_s, rows = np.append(self.stop_s, time_s), np.vstack([self._last, rows])
        changes = np.abs(np.diff(rows[:, :-1], axis=0))
        self.resolution = np.minimum(self.resolution, np.where(changes > 0, changes, np.inf).min(
            axis=0, initial=np.inf))
        self._last, self.stop_s = rows[-1], float(time_s[-1])
        rows = self._evenly(time_s, rows)[0 if is_first else 1:]
        self.allan.feed(rows[:, :-1])
        self.cells.feed(rows)

    def _evenly(self, time_s: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return the rows with gaps filled."""
        steps_s = np.diff(time_s)
        gaps = steps_s > _gap_s(self.nominal_hz)
        if not gaps.any():
            return rows
        advance = np.where(gaps, np.maximum(np.rint(steps_s * self.nominal_hz), 1), 1)
        number = np.concatenate([[0], np.cumsum(advance)])
        full = np.arange(number[-1] + 1)
        self.filled += len(full) - len(rows)
        return np.column_stack([np.interp(full, number, column) for column in rows.T])


@dataclass
class _Survey:
    """What a pass over a recording has found."""

    path: str
    names: tuple[str, ...]
    start_s: float
    stop_s: float
    longest: _Segment
    breaks: list[tuple[float, float]]


def _gap_s(rate_hz: float) -> float:
    """Return the smallest gap of a stream, s."""
    return max(GAP_S, _GAP_PERIODS / rate_hz)


def _read(read: Callable[[], Iterable[Recording]], accel_mps2: Callable[[Recording], np.ndarray],
          start_s: float, stop_s: float) -> _Survey:
    """Read the samples between two stamps, and keep the longest part without a long gap."""
    survey: _Survey | None = None
    segment: _Segment | None = None
    held = np.nan
    for block in read():
        inside = (block.time_s >= start_s) & (block.time_s <= stop_s)
        time_s = block.time_s[inside]
        temperature, held = _held(block, held)
        rows = np.column_stack([accel_mps2(block), temperature])[inside]
        if not len(rows):
            continue
        if survey is None or segment is None:
            segment = _Segment(rows.shape[1], _rate_hz(block, time_s))
            survey = _Survey(block.path, block.sensor_columns, float(time_s[0]), 0.0, segment, [])
        before_s = segment.stop_s if segment.count else time_s[0]
        steps_s = np.diff(time_s, prepend=before_s)
        longest_s = max(_LONGEST_FILLED_S, _gap_s(segment.nominal_hz))
        edges = [0, *(1 + np.flatnonzero(steps_s[1:] > longest_s)).tolist(), len(rows)]
        for first, last in pairwise(edges):
            if first or steps_s[0] > longest_s:
                stamp_s = float(time_s[first])
                survey.breaks.append((stamp_s - float(steps_s[first]), stamp_s))
                segment = _Segment(rows.shape[1], segment.nominal_hz)
            segment.feed(time_s[first:last], rows[first:last])
            if segment.count > survey.longest.count:
                survey.longest = segment
        survey.stop_s = float(time_s[-1])
    if survey is None:
        raise UserError('the recording holds no samples')
    if survey.longest.count < _FEWEST_SAMPLES or \
            survey.longest.stop_s - survey.longest.start_s < SHORTEST_S:
        segment = survey.longest
        raise UserError(f'{survey.path}: {segment.count} samples in '
                        f'{segment.stop_s - segment.start_s:.3g} s without a gap, expected '
                        f'{_FEWEST_SAMPLES} in {SHORTEST_S:g} s at least; record longer')
    return survey


def _rate_hz(block: Recording, time_s: np.ndarray) -> float:
    """Return the rate of the first samples, Hz, also where their stamps come in bursts."""
    steps_s = np.diff(time_s)
    if len(steps_s) < 1 or not (steps_s > 0).all():
        raise UserError(f'{block.path}: {len(time_s)} samples; record longer')
    median_s, mean_s = float(np.median(steps_s)), float(steps_s.mean())
    return 1 / (mean_s if median_s < _BURSTS * mean_s else median_s)


def _held(block: Recording, last: float) -> tuple[np.ndarray, float]:
    """Return the temperature, °C, (n,), which holds between its readings, and the newest one."""
    values = block.columns.get('temperature_c')
    if values is None:
        return np.full(len(block), np.nan), np.nan
    is_read = np.isfinite(values)
    if not is_read.any():
        return np.full(len(block), last), last
    place = np.maximum.accumulate(np.where(is_read, np.arange(len(values)), -1))
    first = last if np.isfinite(last) else float(values[is_read][0])
    return np.where(place < 0, first, values[place]), float(values[is_read][-1])


def _check_axes(survey: _Survey, span: str = '') -> None:
    """Refuse an axis that never changes; `span` names the part of the recording."""
    for name, resolution in zip(survey.names, survey.longest.resolution):
        if not np.isfinite(resolution):
            raise UserError(f'{survey.path}: {name} never changes{span}; the axis is stuck, or '
                            'not connected')


def _moving(segment: _Segment) -> tuple[np.ndarray, int]:
    """Return which windows move, (w,) bool, and the samples of a window."""
    cells = segment.cells
    shortest = max(_WINDOW_S * segment.nominal_hz, _WINDOW_SAMPLES)
    width = min(max(int(np.ceil(shortest / cells.size)), 1), cells.count)
    variance = _window_variance(cells, width)
    noise = np.quantile(variance, _QUIET_QUANTILE, axis=0)
    # Where the noise is below the resolution, most windows do not change at all.
    limit = np.where(noise > 0, _LARGEST_VARIANCE * noise, np.inf)
    moving = np.asarray((variance > limit).any(axis=1))
    if (_window_variance(cells, width, cells.count - width) > limit).any():
        # The motion is in the cells after the last window.
        moving = np.append(moving, True)
    return moving, width * cells.size


def _window_variance(cells: CellMeans, width: int, first: int = 0) -> np.ndarray:
    """Return the variance of the samples in windows of cells from the first by axis, (w, m)."""
    count = (cells.count - first) // width
    part = slice(first, first + count * width)
    means = cells.means[part, :-1].reshape(count, width, -1)
    squares = cells.squares[part, :-1].reshape(count, width, -1).sum(axis=1)
    between = ((means - means.mean(axis=1, keepdims=True)) ** 2).sum(axis=1) * cells.size
    return (squares + between) / max(width * cells.size - 1, 1)


def _stretch(survey: _Survey, rest: _Survey, breaks: list[tuple[float, float]]) -> StillStretch:
    """Return the rest that a pass has read."""
    segment = rest.longest
    cells, rate_hz = segment.cells, segment.rate_hz
    width = max(int(np.ceil(_WINDOW_S * rate_hz / cells.size)), 1)
    temperature = cells.means[:, -1]
    return StillStretch(
        segment.start_s, segment.stop_s, rate_hz, segment.count, segment.filled,
        segment.allan.result(rate_hz, cells), cells.size / rate_hz, cells.means[:, :-1],
        temperature if np.isfinite(temperature).all() else None,
        np.sqrt(_window_variance(cells, min(width, cells.count)).mean(axis=0)),
        segment.resolution, survey.stop_s - survey.start_s, breaks)
