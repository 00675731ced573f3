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

"""Smooth paths through recorded joints and forces."""

from __future__ import annotations

from bisect import bisect_left

from adxl_ros.model.effects.base import Components
import numpy as np
from scipy.interpolate import BSpline, CubicSpline, make_interp_spline
from scipy.linalg import solveh_banded
from scipy.ndimage import maximum_filter1d, uniform_filter1d

_DEGREE = 5
"""Degree of the splines of joints; chosen: quintic, so that the acceleration is smooth."""

_KNOT_S = 0.03
"""Distance of the knots, s; chosen: motion slower than 10 Hz is free, the penalty smooths it."""

_WINDOW_S = 60.0
"""Length of a window, s; chosen: its normal equations are small."""

_MAX_WINDOWS = 64
"""Largest number of windows in memory; chosen: an hour of motion."""

_MARGIN_S = 3.0
"""Overlap of the windows on each side, s; chosen: far beyond the range of the spline's penalty."""

_PROBES = 12
"""Windows that the strength of the penalty is matched to; chosen: enough for a median."""

_MIN_MOVING = 100
"""Fewest readings in motion that determine a strength; chosen: their rms is then within 7 %."""

_MAX_ROUNDS = 16
"""Largest number of rounds that soften the penalty; chosen: it is then nearly 0, see `_SOFTER`."""

_SOFTER = 0.2
"""Factor of the penalty where the readings deviate too much; chosen: 16 rounds give 7e-12."""

_WIDER = 15
"""Width of a softened part in knots; chosen: it begins before the move that needs it."""

_LOCAL_S = 0.3
"""Time over which deviations are averaged, s; chosen: ten knots."""

_MAX_RATIO = 1.7
"""Mean squared deviation, divided by step²/12, from which the penalty softens; chosen: above the
scatter of a mean over `_LOCAL_S`."""

_RIDGE = 1e-12
"""Addition to the diagonal of the normal matrix, divided by its largest element; chosen: it
matters only for coefficients without samples and penalty."""

_STRENGTHS = (10.0 ** np.arange(-12, 13, 0.5)).tolist()
"""Strengths of the penalty that are tried; chosen: half a decade hardly changes a spline."""

_REST_GAP = 8
"""Gap between changes of a reading, in median gaps and in samples, above which it rests; chosen:
above the gaps of a slow move."""

_THIRD_DIFFERENCE = np.array([-1.0, 3.0, -3.0, 1.0])
"""Weights of four coefficients in a third difference."""


class SmoothedPath:
    """
    A joint by the readings of its encoder: a smoothing spline matched to the encoder's step.

    It is a quintic P-spline (Eilers and Marx 1996) with a penalty on the third derivative. The
    strength is the largest for which the deviation of the readings in motion is at most that of
    an encoder, step/√12 rms. The spline then removes only the error of the encoder. Where the
    deviation is larger for a while, in a quick move among slow ones, the penalty is softer there.
    Windows of the recording are fitted when they are needed.
    """

    def __init__(self, time_s: np.ndarray, reading: np.ndarray, step: float) -> None:
        """
        Prepare for the readings of an encoder.

        Parameters
        ----------
        time_s
            Ascending times, s, (n,).
        reading
            Readings, rad or m, (n,); NaN where there is none.
        step
            Step of the encoder, in the unit of the readings; 0 for an exact encoder.

        """
        sampled = np.isfinite(reading)
        self._time_s, self._reading = time_s[sampled], reading[sampled]
        self._windows: dict[int, BSpline] = {}
        self._step, self._strength = step, self._matched_strength(step)

    def __call__(self, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        """Return a derivative; see `motion.Path`."""
        begin_s, end_s = self._time_s[0], self._time_s[-1]
        inside_s = np.clip(time_s, begin_s, end_s)
        number = ((inside_s - begin_s) // _WINDOW_S).astype(int)
        values = np.empty(len(time_s))
        for window in np.unique(number):
            chosen = number == window
            values[chosen] = self._spline(int(window))(inside_s[chosen], order)
        if order:
            values[(time_s < begin_s) | (time_s > end_s)] = 0.0
        return values

    def _spline(self, window: int) -> BSpline:
        if window not in self._windows:
            while len(self._windows) >= _MAX_WINDOWS:
                del self._windows[min(self._windows)]
            self._windows[window] = smoothing_spline(
                *self._part(window), self._strength, self._step)
        return self._windows[window]

    def _part(self, window: int) -> tuple[np.ndarray, np.ndarray]:
        """Return times, s, and readings of a window with its margins, (n,) each."""
        low_s = self._time_s[0] + window * _WINDOW_S - _MARGIN_S
        part = slice(*np.searchsorted(self._time_s, [low_s, low_s + _WINDOW_S + 2 * _MARGIN_S]))
        return self._time_s[part], self._reading[part]

    def _matched_strength(self, step: float) -> float:
        """Return the median strength that windows all over the recording need; 0 without any."""
        last = int((self._time_s[-1] - self._time_s[0]) // _WINDOW_S)
        strengths = [matched_strength(*self._part(int(window)), step)
                     for window in np.unique(np.linspace(0, last, _PROBES).round())]
        positive = [strength for strength in strengths if strength]
        return float(np.median(positive)) if positive else 0.0


def smoothing_spline(time_s: np.ndarray, reading: np.ndarray, strength: float, step: float
                     ) -> BSpline:
    """
    Fit the smoothing spline of one window; see `SmoothedPath`.

    Parameters
    ----------
    time_s
        Ascending times, s, (n,).
    reading
        Readings, rad or m, (n,), all finite.
    strength
        Strength of the penalty per sample; 0 interpolates.
    step
        Step of the encoder, in the unit of the readings.

    Returns
    -------
    BSpline
        The spline over time.

    """
    if len(time_s) <= 2 * _DEGREE or np.ptp(reading) == 0:
        return make_interp_spline(time_s, reading, k=1) if len(time_s) > 1 else \
            BSpline(np.array([0.0, 1.0]), reading, 0, extrapolate=True)
    if not strength:
        return make_interp_spline(time_s, reading, k=_DEGREE)
    window = _Window(time_s, reading)
    strengths = np.full(len(window.right) - 3, strength)
    for _ in range(_MAX_ROUNDS):
        coefficients = window.coefficients(strengths)
        deviation2 = (reading - window.mean - window.design @ coefficients) ** 2
        width = max(round(_LOCAL_S / (time_s[-1] - time_s[0]) * len(time_s)), 5)
        local = np.interp(window.centres, time_s, uniform_filter1d(deviation2, width))
        stiff = local > _MAX_RATIO * step ** 2 / 12
        if not stiff.any():
            break
        strengths[maximum_filter1d(stiff, _WIDER)] *= _SOFTER
    return BSpline(window.knots, coefficients + window.mean, _DEGREE)


def matched_strength(time_s: np.ndarray, reading: np.ndarray, step: float) -> float:
    """
    Find the largest strength whose deviation is at most that of an encoder.

    Parameters
    ----------
    time_s
        Ascending times, s, (n,).
    reading
        Readings, rad or m, (n,), all finite.
    step
        Step of the encoder, in the unit of the readings.

    Returns
    -------
    float
        Strength per sample; 0 where too few readings move.

    """
    moving = _moving(reading)
    if not step or moving.sum() < _MIN_MOVING:
        return 0.0
    window = _Window(time_s, reading)

    def too_strong(strength: float) -> bool:
        deviation = reading - window.mean - window.design @ window.coefficients(
            np.full(len(window.right) - 3, strength))
        return bool(np.sqrt(np.mean(deviation[moving] ** 2)) > step / np.sqrt(12))

    index = bisect_left(_STRENGTHS, True, key=too_strong)
    return float(_STRENGTHS[max(index - 1, 0)])


class _Window:
    """
    Normal equations of the spline of one window.

    Attributes
    ----------
    knots
        Knots of the spline, s.
    design
        Splines at the samples, (n, k), sparse.
    mean
        Mean of the readings, which the spline leaves out.
    right
        Right-hand side of the normal equations, (k,).
    centres
        Times of the third differences, s, (k − 3,).

    """

    def __init__(self, time_s: np.ndarray, reading: np.ndarray) -> None:
        duration_s = time_s[-1] - time_s[0]
        inner = np.linspace(time_s[0], time_s[-1],
                            max(int(min(duration_s / _KNOT_S, len(time_s) / 2)), 1) + 1)
        outer = (inner[1] - inner[0]) * np.arange(1, _DEGREE + 1)
        self.knots = np.concatenate([inner[0] - outer[::-1], inner, inner[-1] + outer])
        self.design = BSpline.design_matrix(time_s, self.knots, _DEGREE)
        self.mean = float(reading.mean())
        self.right = self.design.T @ (reading - self.mean)
        self._normal = _banded(self.design.T @ self.design)
        self._normal[-1] += _RIDGE * self._normal[-1].max()
        self._samples_per_coefficient = len(time_s) / len(self.right)
        # A third difference weighs four coefficients, whose splines peak between these knots.
        self.centres = np.convolve(self.knots, np.full(_DEGREE + 5, 1 / (_DEGREE + 5)), 'valid')

    def coefficients(self, strengths: np.ndarray) -> np.ndarray:
        """Return the coefficients for strengths by third difference, (k − 3,)."""
        penalty = _third_differences(strengths * self._samples_per_coefficient)
        return solveh_banded(self._normal + penalty, self.right)


def _banded(matrix: object) -> np.ndarray:
    """Return the upper diagonals of a sparse symmetric matrix as `solveh_banded` takes them."""
    count = matrix.shape[0]  # type: ignore[attr-defined]
    bands = np.zeros((_DEGREE + 1, count))
    for k in range(_DEGREE + 1):
        bands[_DEGREE - k, k:] = matrix.diagonal(k)  # type: ignore[attr-defined]
    return bands


def _third_differences(weights: np.ndarray) -> np.ndarray:
    """Return DᵀWD of third differences with their weights, (k − 3,), banded."""
    bands = np.zeros((_DEGREE + 1, len(weights) + 3))
    for i in range(4):
        for j in range(i, 4):
            product = _THIRD_DIFFERENCE[i] * _THIRD_DIFFERENCE[j]
            bands[_DEGREE - (j - i), j:j + len(weights)] += product * weights
    return bands


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


class ForcePath:
    """
    Specific force of a recording or of another simulator, as cubic splines.

    Attributes
    ----------
    time_s
        Times of the samples, s, (n,).

    """

    def __init__(self, time_s: np.ndarray, force_mps2: np.ndarray) -> None:
        """
        Interpolate samples.

        Parameters
        ----------
        time_s
            Ascending times, s, (n,).
        force_mps2
            Specific force in the case frame, m/s², (n, 3).

        """
        self.time_s = time_s
        self._force_mps2 = force_mps2
        self._spline = CubicSpline(time_s, force_mps2)

    def __call__(self, time_s: np.ndarray) -> Components:
        """Return the three components at times, s, (n,), m/s²; constant outside."""
        return list(self._spline(np.clip(time_s, self.time_s[0], self.time_s[-1])).T)

    def shifted(self, later_s: float) -> ForcePath:
        """Return the same force at later times, s."""
        return ForcePath(self.time_s + later_s, self._force_mps2)
