# SPDX-License-Identifier: Apache-2.0
"""
How much later another simulator is stamped than a recording: one shift, a step of it, or a drift.

Both motions are compared at even instants, a shift by the correlation of parts of the recording.
A shift that steps leaves far less as two shifts than as one; a drift leaves far less as a line.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

from adxl_ros.files.recording_columns import Recording
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.stage_angles import SMALLEST_MOTION_G
from adxl_ros.simulate.motion import ForcePath
import numpy as np
import scipy

SHORTEST_S = 30.0
"""Shortest time, s, that the recordings of a moving sensor last together. Chosen: a few turns of
the stage."""
LARGEST_LATENCY_S = 0.1
"""Largest shift, s, that may be a latency of the sensor. Chosen: twenty times the typical delay of
`time_offset`; a buffer of ten samples at 100 Hz has it."""
CORRELATED = 0.9
"""Correlation from which two motions are the same one. Chosen: noise of half the motion."""
LARGEST_ERROR_RATIO = 0.5
"""A shift shows if it reduces what is left, or 1 − correlation, below this share. Chosen: noise
that is not shifted keeps it."""
FINE_SAMPLES = 20_000  # Largest number of samples of the fine search. Chosen: run time
_LARGEST_DRIFT_S = 2 * LARGEST_LATENCY_S
"""Change of a shift, s, up to which one shift leaves no more than a latency at either end. The
effect of a clock skew describes what is left."""
_DRIFT_ACCURACY_S = 1e-4  # Accuracy of its ends, s. Chosen: far below a sample
_SEARCH_STEP_S = 0.02
"""Step of the first search of a shift, s. Chosen: well below the largest latency."""
_LONGEST_SEARCH = 1 << 20  # Largest number of its steps. Chosen: six hours
_PART_S = 15.0
"""Shortest part of a recording whose shift is looked for, s. Chosen: half of the shortest
recording, so that each has two."""
_OVERLAP_OF_PART = 0.5
"""Share of a part that must overlap. Chosen: the ends of both recordings differ, and a clock may
step by half of a part."""
_MOST_PARTS = 8  # Most parts. Chosen: a step then shows in all but an eighth at either end
_LARGEST_STEP_S = 4.0
"""Largest step of a clock that is looked for anywhere, s; of a larger one, the parts tell the
shifts. Chosen: a quarter of a part."""
_COARSE_S = 0.05  # Step of the search for a step, s. Chosen: below a period of most motion
_SMALLEST_STEP_S = 5e-3  # Smallest step of a clock, s. Chosen: less is jitter


class Shifts(NamedTuple):
    """How well two motions fit, by shift, (lags,) each."""

    lags_s: np.ndarray  # How much later the second one is, s
    overlap: np.ndarray  # Number of samples that overlap
    correlation: np.ndarray  # −1 where too few overlap, or one does not move

    @property
    def late_s(self) -> float:
        """Return the best shift, s."""
        return float(self.lags_s[np.argmax(self.correlation)])

    @property
    def fits(self) -> bool:
        """Return whether both are the same motion at their best shift."""
        return bool(self.correlation.max() > CORRELATED)


def correlate(first: np.ndarray, second: np.ndarray, step_s: float, smallest: int) -> Shifts:
    """
    Correlate two motions, g, (n, m) and (n', m), at all lags, each over the samples that overlap.

    step_s: time between two samples; at least `smallest` samples must overlap.
    """

    def products(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return scipy.signal.correlate(b, a, method='fft')

    one, two = np.ones(len(first)), np.ones(len(second))
    overlap = np.maximum(np.rint(products(one, two)), 1)
    covariance = np.zeros(len(overlap))
    squares = np.zeros((2, len(overlap)))
    for a, b in zip((first - first.mean(axis=0)).T, (second - second.mean(axis=0)).T):
        sum_a, sum_b = products(a, two), products(one, b)
        covariance += np.abs(products(a, b) - sum_a * sum_b / overlap)
        squares[0] += products(a * a, two) - sum_a**2 / overlap
        squares[1] += products(one, b * b) - sum_b**2 / overlap
    smallest_square = SMALLEST_MOTION_G**2 * overlap
    compared = (overlap >= smallest) & (squares > smallest_square).all(axis=0)
    correlation = covariance / np.sqrt(np.maximum(squares, smallest_square).prod(axis=0))
    lags = scipy.signal.correlation_lags(len(second), len(first))
    return Shifts(lags * step_s, overlap, np.where(compared, correlation, -1.0))


class Part(NamedTuple):
    """A part of a recording that fits a simulator at one shift."""

    time_s: np.ndarray  # Instants of the part, s, (k,)
    late_s: float  # How much later the simulator is stamped, s


class Motions(NamedTuple):
    """The motion of a recording, and that of a simulator, at even instants."""

    measured_s: np.ndarray  # Instants of the recording, s, (n,)
    measured_g: np.ndarray  # Its readings, g, (n, m)
    stated_s: np.ndarray  # Instants of the simulator, s, (n',)
    stated_g: np.ndarray  # Its force, g, (n', m)
    step_s: float  # Time between two instants, s

    @classmethod
    def of(cls, recording: Recording, sensor: Sensor, force: ForcePath) -> Motions | None:
        """Return both, coarse enough for a search over all shifts; None without samples."""
        read_g = (recording.volts(sensor) - sensor.zero_g_v) / sensor.scale_v_per_g
        finite = np.isfinite(read_g).all(axis=1)
        if finite.sum() < 2:
            return None
        read_s = recording.time_s[finite]
        span_s = np.ptp(read_s) + np.ptp(force.time_s)
        step_s = max(_SEARCH_STEP_S, span_s / _LONGEST_SEARCH)
        measured_s = np.arange(read_s[0], read_s[-1], step_s)
        stated_s = np.arange(force.time_s[0], force.time_s[-1], step_s)
        stated_g = np.column_stack(force(stated_s)) / G0_MPS2
        return cls(
            measured_s,
            _columns_at(measured_s, read_s, read_g[finite]),
            stated_s,
            stated_g[:, : read_g.shape[1]],
            step_s,
        )

    def shifts(self, rows: np.ndarray, smallest: int) -> Shifts:
        """Correlate a part of the recording, rows, with the simulator at all shifts."""
        found = correlate(self.measured_g[rows], self.stated_g, self.step_s, smallest)
        begin_s = self.stated_s[0] - self.measured_s[rows[0]]
        return found._replace(lags_s=begin_s + found.lags_s)

    def fitting_parts(self) -> list[Part]:
        """Return the parts of the recording that fit the simulator at one shift each."""
        time_s = self.measured_s
        count = max(min(int(np.ptp(time_s) / _PART_S), _MOST_PARTS), 1)
        parts = []
        for rows in np.array_split(np.arange(len(time_s)), count):
            shifts = self.shifts(rows, round(_OVERLAP_OF_PART * len(rows)))
            if shifts.fits:
                parts.append(Part(time_s[rows], shifts.late_s))
        return parts

    def stated_at(self, late_s: np.ndarray | float) -> np.ndarray:
        """Return the simulator beside the recording, g, (n, m), at shifts, s, (n,) or ()."""
        return _columns_at(self.measured_s + late_s, self.stated_s, self.stated_g)

    def overlap(self, late_s: np.ndarray | float) -> np.ndarray:
        """Return which instants the simulator has at shifts, s, (n,) or (), (n,) bool."""
        instants_s = self.measured_s + late_s
        return (instants_s >= self.stated_s[0]) & (instants_s <= self.stated_s[-1])

    def squares_g2(self, late_s: float) -> np.ndarray:
        """Return the squared difference at a shift, s, summed over axes, g², (n,)."""
        return ((self.measured_g - self.stated_at(late_s)) ** 2).sum(axis=1)

    def left_g2(self, late_s: np.ndarray | float) -> float:
        """Return the mean square, g², that shifts, s, (n,) or (), leave where both overlap."""
        overlap = self.overlap(late_s)
        if overlap.mean() < _OVERLAP_OF_PART:
            return np.inf
        left = left_by_lines(self.measured_g[overlap], self.stated_at(late_s)[overlap])
        return left / int(overlap.sum())

    def part(self, rows: np.ndarray | slice) -> Motions:
        """Return the part of the recording that has these rows."""
        return self._replace(measured_s=self.measured_s[rows], measured_g=self.measured_g[rows])

    def best_shift_s(self, near_s: np.ndarray) -> float:
        """Return the shift that leaves least, near some, s, (k,)."""
        best_s = min(near_s.tolist(), key=self.left_g2)
        ends_s = best_s - _COARSE_S, best_s + _COARSE_S
        found = scipy.optimize.minimize_scalar(self.left_g2, bounds=ends_s, method='bounded')
        return float(found.x)


def _columns_at(instants_s: np.ndarray, time_s: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Interpolate columns, (k, m), that are known at times, s, (k,), at instants, s, (n,)."""
    return np.column_stack([np.interp(instants_s, time_s, column) for column in columns.T])


def left_by_lines(measured: np.ndarray, stated: np.ndarray) -> float:
    """Return the squares, summed, that zero-g and scale factor of each axis leave, (n, m) each."""
    left = 0.0
    for own, other in zip(measured.T, stated.T):
        line = np.column_stack([np.ones(len(other)), other])
        left += float(np.sum((own - line @ np.linalg.lstsq(line, own)[0]) ** 2))
    return left


class Drift(NamedTuple):
    """Shifts of a simulator that change evenly from begin to end of a recording."""

    begin_s: float  # How much later the simulator is stamped at the begin, s
    end_s: float  # The same at the end, s

    @property
    def change_s(self) -> float:
        """Return how much the shift changes, s."""
        return self.end_s - self.begin_s

    def left_g2(self, motions: Motions) -> float:
        """Return the mean square that it leaves, g²."""
        return motions.left_g2(np.linspace(*self, len(motions.measured_s)))

    def explains(self, part: Part, motions: Motions) -> bool:
        """Return whether the shift of a part is that of an instant in it, to half a step."""
        ends_s = np.interp(part.time_s[[0, -1]], motions.measured_s[[0, -1]], self)
        resolution_s = motions.step_s / 2
        return bool(ends_s.min() - resolution_s <= part.late_s <= ends_s.max() + resolution_s)


def _fit_drift(motions: Motions, ends_s: np.ndarray) -> Drift:
    """Fit the shifts at begin and end, from rough ones, s, (2,)."""
    fitted = scipy.optimize.minimize(
        lambda ends: Drift(*ends).left_g2(motions),
        ends_s,
        method='Nelder-Mead',
        options={
            'initial_simplex': ends_s + motions.step_s * np.array([[0, 0], [1, 0], [0, 1]]),
            'xatol': _DRIFT_ACCURACY_S,
            'fatol': 0.0,
        },
    )
    return Drift(*map(float, fitted.x))


def find_drift(motions: Motions, parts: Sequence[Part]) -> Drift | None:
    """
    Return the drift that explains the shifts of all parts.

    None where one shift is near enough for all, or explains as much, or a step explains more.
    """
    if len(parts) < 2:
        return None
    time_s = motions.measured_s
    line = np.polynomial.Polynomial.fit(
        [part.time_s.mean() for part in parts], [part.late_s for part in parts], 1
    )
    ends_s = line(time_s[[0, -1]])
    change_s = abs(np.ptp(ends_s))
    # No part shows its shift better than that of one of its instants.
    uncertain_s = motions.step_s + change_s * np.ptp(parts[0].time_s) / np.ptp(time_s)
    if change_s + uncertain_s < _LARGEST_DRIFT_S:
        return None
    drift = _fit_drift(motions, ends_s)
    explains = all(drift.explains(part, motions) for part in parts)
    if abs(drift.change_s) < _LARGEST_DRIFT_S or not explains:
        return None
    left_g2 = drift.left_g2(motions)
    by_one_shift = scipy.optimize.minimize_scalar(
        motions.left_g2, bounds=sorted(drift), method='bounded'
    )
    step = _step_between(motions, parts[0].late_s, parts[-1].late_s)
    by_step_g2 = motions.left_g2(np.where(time_s < step.at_s, step.before_s, step.after_s))
    is_better = left_g2 < min(LARGEST_ERROR_RATIO * by_one_shift.fun, by_step_g2)
    return drift if is_better else None


class ClockStep(NamedTuple):
    """A clock that steps from one shift to another."""

    before_s: float  # How much later the simulator is stamped before the step, s
    after_s: float  # The same after it, s
    at_s: float  # Time of the step, s


def _step_between(motions: Motions, before_s: float, after_s: float) -> ClockStep:
    """Return the step from when on the second of two shifts explains the recording better."""
    loses_g2 = np.cumsum(motions.squares_g2(before_s) - motions.squares_g2(after_s))
    last = int(np.argmin(loses_g2))
    # In the middle of a gap
    at_s = float(motions.measured_s[last : last + 2].mean())
    return ClockStep(before_s, after_s, at_s)


def find_step(
    motions: Motions, recording: Recording, about_s: float, parts: Sequence[Part]
) -> ClockStep | None:
    """
    Find where the shift steps, if it does.

    A step shows if two shifts leave far less than one, and than shifts that drift. It needs no
    whole parts on both sides: a recording may move for some seconds only before its step.
    The shifts that are tried lie within seconds of `about_s`, which fits best, and within a
    latency of 0 and of those at which single parts fit.
    """
    centers_s = {about_s, 0.0, *(part.late_s for part in parts)}
    motions = _with_reference(motions, recording, centers_s)
    rows = np.arange(len(motions.measured_s))
    if not len(rows):
        return None
    latencies_s = np.arange(-LARGEST_LATENCY_S, LARGEST_LATENCY_S, motions.step_s)
    near_s = np.concatenate(
        [
            about_s + np.arange(-_LARGEST_STEP_S, _LARGEST_STEP_S, _COARSE_S),
            *(late_s + latencies_s for late_s in centers_s),
        ]
    )
    one_s = motions.best_shift_s(near_s)
    zero_g = (motions.measured_g - motions.stated_at(one_s))[motions.overlap(one_s)].mean(axis=0)
    motions = motions._replace(measured_g=motions.measured_g - zero_g)
    first = _first_row_behind(motions, one_s, near_s)
    if min(first, len(rows) - first) * motions.step_s < LARGEST_LATENCY_S:
        return None
    before_s = motions.part(slice(first)).best_shift_s(near_s)
    after_s = motions.part(slice(first, None)).best_shift_s(near_s)
    drift = _fit_drift(motions, np.full(2, one_s))
    others_g2 = min(motions.left_g2(one_s), drift.left_g2(motions))
    left_g2 = motions.left_g2(np.where(rows < first, before_s, after_s))
    is_step = abs(after_s - before_s) > _SMALLEST_STEP_S
    if not is_step or left_g2 >= LARGEST_ERROR_RATIO * others_g2:
        return None
    return _step_between(motions, before_s, after_s)


def _with_reference(
    motions: Motions, recording: Recording, shifts_s: Collection[float]
) -> Motions:
    """Return instants that have a reference at one of some shifts, s, and lie in no gap."""
    inside = np.any([motions.overlap(late_s) for late_s in shifts_s], axis=0)
    before = np.searchsorted(recording.time_s, motions.measured_s, 'right') - 1
    steps_s = np.diff(recording.time_s, append=np.inf)[before]
    compared = np.flatnonzero(inside & (steps_s < _COARSE_S + 2 / recording.rate_hz))
    return motions.part(compared[:: 1 + len(compared) // FINE_SAMPLES])


def _first_row_behind(motions: Motions, one_s: float, near_s: np.ndarray) -> int:
    """Return the row on one side of which another shift gains most, of some, s, (k,)."""
    squares_g2 = motions.squares_g2(one_s)
    overlap = motions.overlap(one_s)
    most_g2 = 0.0
    first = 0
    for other_s in near_s:
        gains_g2 = squares_g2 - motions.squares_g2(other_s)
        gained_g2 = np.cumsum(gains_g2 * overlap * motions.overlap(other_s))
        up_to = int(gained_g2.argmax())
        behind = int(gained_g2.argmin())
        for row, side_g2 in (
            (up_to, gained_g2[up_to]),
            (behind, gained_g2[-1] - gained_g2[behind]),
        ):
            if side_g2 > most_g2:
                most_g2 = side_g2
                first = row + 1
    return first
