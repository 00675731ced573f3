# SPDX-License-Identifier: Apache-2.0

"""Smooth paths of joints through the readings of their encoders, with their errors."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass
from itertools import pairwise
from math import factorial

from adxl_ros.files.stamps import stamped_rate_hz
from adxl_ros.model.error_sizes import rms
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
import scipy

_DEGREE = 5  # Degree of the splines of joints; chosen: quintic, so that the acceleration is smooth
BAND_LIMITED_DEGREE = 11
"""Degree of the spline through exact readings of a motion that is nearly as fast as its sampling;
chosen: the acceleration of 40 Hz, sampled at 100 Hz, is exact to 0.1 %, by quintic splines to
3 %."""
_MAX_UNEVENNESS = 3.0
"""Longest interval of readings, divided by the median, that splines of a higher degree bridge;
chosen: they overshoot in longer ones."""
KNOT_S = 0.03  # Distance of the knots, s; chosen: below 10 Hz motion is free
_WINDOW_S = 60.0  # Length of a window, s; chosen: its normal equations are small
_MARGIN_S = 3.0  # Overlap of windows, s; chosen: beyond the range of the penalty
_PROBES = 12  # Windows that the strength of the penalty is matched to; chosen: enough for a median
_MIN_MOVING = 100  # Fewest readings in motion for a strength; chosen: rms within 7 %
_USUAL_STRENGTH = 1.0  # Strength where too few move; chosen: of quick moves
_BOUNDED_SHARE = 0.03
"""Strength of the penalty within bounds, divided by the matched one. Tuned, with `_REST_WEIGHT`,
on manoeuvres of the package from 25 to 250 Hz behind encoders of 0.083 and 0.01°: 0.01 to 1
differ by 10 %."""
_REST_WEIGHT = 0.1  # Weight of a reading at rest beside its bounds; tuned as `_BOUNDED_SHARE`
_BOUND_ROUNDS = 40  # Iterations over the bounds; chosen: 100 change the error in motion by 5 %
_ERROR_FACTOR = 2.0
"""Error in motion, times readings per second, divided by step and corner frequency; measured on
the same manoeuvres: 0.3 to 2."""
_RIDGE = 1e-12  # Relative addition to the diagonal; chosen: for empty coefficients only
_STRENGTHS = (10.0 ** np.arange(-12, 13, 0.5)).tolist()  # Tried strengths; chosen: half decades
_REST_GAP = 8  # Median gaps and samples between changes at rest; chosen: above a slow move
_SMALLEST_CHANGE = 1e-6  # Change in steps that is a rounding error; chosen: above floats
_WHOLE = 0.05  # Deviation from whole steps; chosen: 5 steps of 0.083° for 1/12°
_FINER = 0.03  # Largest step of a finer reference, steps; interpolated readings have 0.08
_READING_QUANTILE = 0.9
"""Quantile of the distances between bends that is the distance of two readings. Chosen: a reading
between two samples bends the line at both of them, so that half of the distances are 1."""


@dataclass(frozen=True)
class PathErrors:
    """What is to be expected of the error of a smoothed path, at n times."""

    std: np.ndarray  # Standard deviation, in the unit of the path, (n,)
    # Rate at which the error forgets its past value, 1/s, (n,); 0 at rest
    forgetting_per_s: np.ndarray


class SmoothedPath:
    """
    A joint by the readings of its encoder: a smoothing spline matched to the encoder's step.

    It is a quintic P-spline (Eilers and Marx 1996) with a penalty on the third derivative. The
    strength is first matched: it is the largest for which the deviation of the readings in motion
    is at most that of an encoder, step/√12 rms. Then a spline with a weaker penalty is fitted that
    deviates from no reading by more than half a step. Where the joint moves through many steps,
    these bounds say more than squares of deviations do. The error in motion becomes smaller by a
    third on average.

    Lines between the readings of a slow encoder say nothing new: only their ends count.

    Windows of the recording are fitted when they are needed.
    """

    def __init__(
        self,
        time_s: np.ndarray,
        reading: np.ndarray,
        step: float,
        degree: int = _DEGREE,
        is_seen: bool = False,
        knot_s: float = KNOT_S,
    ) -> None:
        """
        Prepare for the readings of an encoder at ascending times, NaN where there is none.

        is_seen: whether the step is that of the readings, and not stated.
        """
        sampled = np.isfinite(reading)
        self._time_s = time_s[sampled]
        self._reading = reading[sampled]
        self._step = step if is_seen else visible_step(self._reading, step)
        if not is_seen and self._step == step and _is_interpolated(self._reading, step):
            kept = _places_of_readings(self._reading, _SMALLEST_CHANGE * step)
            self._time_s = self._time_s[kept]
            self._reading = self._reading[kept]
        self._windows: dict[int, scipy.interpolate.PPoly] = {}
        self._knot_s = knot_s
        self._is_seen = is_seen
        self._degree = degree
        self._strength = self._matched_strength()

    def __call__(self, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        """Return a derivative; see `motion.Path`."""
        begin_s, end_s = self._time_s[0], self._time_s[-1]
        inside_s = np.clip(time_s, begin_s, end_s)
        numbers = ((inside_s - begin_s) / _WINDOW_S).astype(int)
        values = np.empty(len(time_s))
        edges = [0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist(), len(time_s)]
        for first, end in pairwise(edges):
            if end > first:
                spline = self._spline(int(numbers[first]))
                values[first:end] = spline(inside_s[first:end], order)
        if order:
            values[(time_s < begin_s) | (time_s > end_s)] = 0.0
        return values

    def errors(self, time_s: np.ndarray) -> PathErrors | None:
        """
        Predict the error of the path by the steps of its encoder.

        At rest it is that of one reading, step/√12 rms, and stays. In motion it is smaller and
        changes quickly, because many readings bound the path within the time that the spline
        averages over. Its corner is 1/(2π·h·s^(1/6)) with the distance h of the knots and the
        matched strength s.
        """
        if not self._step or len(self._time_s) <= 2 * _DEGREE:
            return None
        inside_s = np.clip(time_s, self._time_s[0], self._time_s[-1])
        rate_hz = stamped_rate_hz(self._time_s)
        knot_s = max(self._knot_s, 2 / rate_hz)
        corner_hz = min(self._strength ** (-1 / 6) / (2 * np.pi * knot_s), 1 / (2 * knot_s))
        place = np.clip(np.searchsorted(self._time_s, inside_s), 0, len(self._time_s) - 1)
        # The reading changes at most once in a sample.
        changes_hz = np.where(
            _moving(self._reading)[place],
            np.minimum(np.abs(self(inside_s, 1)) / self._step, rate_hz),
            0.0,
        )
        ratio = _ERROR_FACTOR * corner_hz / np.maximum(changes_hz, 1e-9)
        # Noise behind a first-order filter with as much power as below the corner forgets at
        # four times the corner.
        return PathErrors(
            self._step * np.minimum(ratio, 1 / np.sqrt(12)), np.minimum(4 * corner_hz, changes_hz)
        )

    def _spline(self, number: int) -> scipy.interpolate.PPoly:
        if number not in self._windows:
            self._windows[number] = _pieces(self._fitted(number))
        return self._windows[number]

    def _fitted(self, number: int) -> scipy.interpolate.BSpline:
        """Fit the smoothing spline of a window."""
        time_s, reading = self._part(number)
        if len(time_s) > 1 and not np.ptp(reading):
            time_s, reading = time_s[[0, -1]], reading[[0, -1]]
        if len(time_s) <= 2 * _DEGREE:
            return (
                scipy.interpolate.make_interp_spline(time_s, reading, k=1)
                if len(time_s) > 1
                else scipy.interpolate.BSpline(np.array([0.0, 1.0]), reading, 0, extrapolate=True)
            )
        if not self._step:
            interval_s = np.diff(time_s)
            even = interval_s.max() < _MAX_UNEVENNESS * np.median(interval_s)
            return scipy.interpolate.make_interp_spline(
                time_s, reading, k=self._degree if even else _DEGREE
            )
        window = _Window(time_s, reading, self._knot_s)
        if self._is_seen:
            # The noise of readings with a step of their own has no bounds.
            coefficients = window.coefficients(self._strength)
        else:
            weights = np.where(_moving(reading), 0.0, _REST_WEIGHT)
            coefficients = window.bounded_coefficients(self._strength, weights, self._step / 2)
        return scipy.interpolate.BSpline(window.knots, window.mean + coefficients, _DEGREE)

    def _part(self, window: int) -> tuple[np.ndarray, np.ndarray]:
        """Return times, s, and readings of a window with its margins, (n,) each."""
        low_s = self._time_s[0] + window * _WINDOW_S - _MARGIN_S
        part = slice(*np.searchsorted(self._time_s, [low_s, low_s + _WINDOW_S + 2 * _MARGIN_S]))
        return self._time_s[part], self._reading[part]

    def _matched_strength(self) -> float:
        """Return the median strength that windows all over the recording need."""
        last = int((self._time_s[-1] - self._time_s[0]) // _WINDOW_S)
        strengths = [
            self._strength_of(int(number))
            for number in np.unique(np.linspace(0, last, _PROBES).round())
        ]
        return float(np.median(list(filter(None, strengths)) or _USUAL_STRENGTH))

    def _strength_of(self, number: int) -> float:
        """Find the largest strength whose deviation in a window is at most that of an encoder."""
        time_s, reading = self._part(number)
        moving = _moving(reading)
        if not self._step or moving.sum() < _MIN_MOVING:
            return 0.0
        window = _Window(time_s, reading, self._knot_s)

        def too_strong(strength: float) -> bool:
            deviation = reading - window.mean - window.design @ window.coefficients(strength)
            return rms(deviation[moving]) > self._step / np.sqrt(12)

        index = bisect_left(_STRENGTHS, True, key=too_strong)
        return float(_STRENGTHS[max(index - 1, 0)]) if index < len(_STRENGTHS) else 0.0


def _pieces(spline: scipy.interpolate.BSpline) -> scipy.interpolate.PPoly:
    """
    Return a spline as polynomials between its knots, which take a tenth of the time of its basis.

    `PPoly.from_spline` overruns its memory above degree 5.
    """
    knots = np.unique(spline.t)
    derivative = spline
    coefficients = [spline(knots[:-1])]
    for order in range(1, spline.k + 1):
        derivative = derivative.derivative()
        coefficients.append(derivative(knots[:-1]) / factorial(order))
    return scipy.interpolate.PPoly(np.array(coefficients[::-1]), knots)


def visible_step(reading: np.ndarray, step: float) -> float:
    """
    Find the step that readings have where it is much finer than the stated one.

    An encoder changes by whole steps. Readings that do not, and whose noise is far below that of
    the steps, are those of a finer reference. The noise is taken from fifth differences, because
    motion hardly shows in them. Where lines connect the readings of a slow encoder, it is taken
    at the distance of these readings: there is no noise on a line.
    """
    if not _is_interpolated(reading, step):
        return step
    # The usual distance of the samples at which lines through readings bend.
    bends = np.flatnonzero(np.abs(np.diff(reading, 2)) > _SMALLEST_CHANGE * step)
    thinned = reading[
        :: int(np.quantile(np.diff(bends), _READING_QUANTILE)) if len(bends) > 1 else 1
    ]
    if noise_step(thinned, _SMALLEST_CHANGE * step) > _FINER * step:
        return step
    finer = noise_step(reading, _SMALLEST_CHANGE * step)
    return finer if finer > _SMALLEST_CHANGE * step else 0.0


def rounding_step(reading: np.ndarray) -> float:
    """Return the step to which readings, (n,), are rounded; 0 where they show none."""
    changes = np.abs(np.diff(reading))
    changes = changes[changes > 0]
    if len(changes) < _MIN_MOVING:
        return 0.0
    steps = changes / changes.min()
    return float(changes.min()) if np.all(np.abs(steps - np.rint(steps)) < _WHOLE) else 0.0


def _is_interpolated(reading: np.ndarray, step: float) -> bool:
    """Return whether readings, (n,), change often, and not by whole steps."""
    changes = np.abs(np.diff(reading))
    steps = changes[changes > _SMALLEST_CHANGE * step] / step if step else changes[:0]
    by_steps = (np.abs(steps - np.rint(steps)) < _WHOLE) & (steps > 0.5)
    return len(steps) >= _MIN_MOVING and by_steps.mean() <= 0.5


def _places_of_readings(reading: np.ndarray, smallest: float) -> np.ndarray:
    """Return where the readings are that lines connect: at the bends, and evenly between them."""
    bends = np.flatnonzero(np.abs(np.diff(reading, 2)) > smallest) + 1
    bends = bends[np.diff(bends, prepend=-1) > 1]
    if len(bends) < 2:
        return np.arange(len(reading))
    distance = max(int(np.quantile(np.diff(bends), 1 - _READING_QUANTILE)), 1)
    corners = np.unique([0, *bends, len(reading) - 1])
    return np.unique(
        np.concatenate(
            [
                np.linspace(a, b, max(round((b - a) / distance), 1) + 1).round().astype(int)
                for a, b in pairwise(corners.tolist())
            ]
        )
    )


def noise_step(reading: np.ndarray, smallest: float, time_s: np.ndarray | None = None) -> float:
    """
    Return the encoder step that has as much noise as readings in motion, (n,), have.

    Divided differences at their times, s, (n,), do not take uneven stamps for noise.
    """
    if len(reading) <= 5:
        return 0.0
    times = sliding_window_view(np.arange(len(reading)) if time_s is None else time_s, 6).T
    weights = np.array(
        [1 / np.prod(np.delete(own - times, i, 0), axis=0) for i, own in enumerate(times)]
    )
    differences = np.sum(weights * sliding_window_view(reading, 6).T, axis=0) / np.linalg.norm(
        weights, axis=0
    )
    moving = differences[np.abs(np.diff(reading))[4:] > smallest]
    return float(np.sqrt(12 * np.mean(moving**2))) if len(moving) else 0.0


class _Window:
    """Normal equations of the spline of one window."""

    def __init__(self, time_s: np.ndarray, reading: np.ndarray, knot_s: float) -> None:
        duration_s = time_s[-1] - time_s[0]
        inner = np.linspace(
            time_s[0], time_s[-1], max(int(min(duration_s / knot_s, len(time_s) / 2)), 1) + 1
        )
        outer = (inner[1] - inner[0]) * np.arange(1, _DEGREE + 1)
        # Knots of the spline, s
        self.knots = np.concatenate([inner[0] - outer[::-1], inner, inner[-1] + outer])
        # Splines at the samples, (n, k), sparse
        self.design = scipy.interpolate.BSpline.design_matrix(time_s, self.knots, _DEGREE)
        self.mean = float(reading.mean())  # Mean of the readings, which the spline leaves out
        self._values = reading - self.mean
        self.right = self.design.T @ self._values  # Right-hand side of the normal equations, (k,)
        self._normal = _banded(self.design.T @ self.design)
        self._normal[-1] += _RIDGE * self._normal[-1].max()
        count = len(self.right)
        third = scipy.sparse.diags([-1.0, 3.0, -3.0, 1.0], [0, 1, 2, 3], (count - 3, count))
        # Matrix of the penalty for a strength of 1, banded
        self._penalty = len(time_s) / count * _banded(third.T @ third)

    def coefficients(self, strength: float) -> np.ndarray:
        """Return the coefficients of least squares with a penalty, (k,)."""
        return scipy.linalg.solveh_banded(self._normal + strength * self._penalty, self.right)

    def bounded_coefficients(
        self, strength: float, weights: np.ndarray, bound: float
    ) -> np.ndarray:
        """
        Return the coefficients whose spline deviates from no reading by more than a bound.

        They are found by alternating directions (Boyd et al. 2011, section 5.2). Where no spline
        fits the bounds, the deviation becomes as small as it can. Readings have weights, (n,),
        of their squared deviations beside the bounds.
        """
        transposed = self.design.T.tocsr()
        weighted = self.design.multiply(1 + weights[:, None]).tocsr()
        normal = _banded(transposed @ weighted)
        normal[-1] += _RIDGE * normal[-1].max()
        factor = scipy.linalg.cholesky_banded(normal + _BOUNDED_SHARE * strength * self._penalty)
        low = self._values - bound
        high = self._values + bound
        pulled = weights * self._values
        within = self._values
        excess = np.zeros(len(self._values))
        for _ in range(_BOUND_ROUNDS):
            coefficients = scipy.linalg.cho_solve_banded(
                (factor, False), transposed @ (pulled + within - excess)
            )
            excess = excess + self.design @ coefficients
            within = np.clip(excess, low, high)
            excess = excess - within
        return coefficients


def _banded(matrix: scipy.sparse.spmatrix) -> np.ndarray:
    """Return the upper diagonals of a sparse symmetric matrix as `solveh_banded` takes them."""
    return np.array([np.pad(matrix.diagonal(k), (k, 0)) for k in range(_DEGREE, -1, -1)])


def _moving(reading: np.ndarray) -> np.ndarray:
    """Return which readings are in motion, (n,): between two changes that are close in time."""
    edges = np.zeros(len(reading) + 1, int)
    changes = np.flatnonzero(np.diff(reading))
    gaps = np.diff(changes)
    if len(gaps):
        close = gaps <= max(_REST_GAP * np.median(gaps), _REST_GAP)
        np.add.at(edges, changes[:-1][close], 1)
        np.add.at(edges, changes[1:][close] + 1, -1)
    return np.cumsum(edges[:-1]) > 0
