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

"""Recorded motion to be followed again: joints and forces as smooth paths."""

from __future__ import annotations

from bisect import bisect_left

from adxl_ros.model.effects.base import Components
import numpy as np
from scipy.interpolate import BSpline, CubicSpline, make_interp_spline
from scipy.linalg import solveh_banded
from scipy.ndimage import maximum_filter1d, uniform_filter1d

_DEGREE = 5
_KNOT_S = 0.03
"""Distance of the knots: motion slower than 10 Hz is free, the penalty does the rest."""
_WINDOW_S = 60.0
_WINDOWS = 64
"""So many are held in memory."""
_MARGIN_S = 3.0
"""Windows of a long recording overlap by this on each side, which is far beyond the spline's
memory."""
_PROBES = 12
_FEWEST = 100
_ROUNDS, _SOFTER, _WIDER = 16, 0.2, 15
_LOCAL_S, _ALLOWED = 0.3, 1.7
_STRENGTHS = (10.0 ** np.arange(-12, 13, 0.5)).tolist()


class SmoothedPath:
    """
    A joint behind its encoder: a smoothing spline matched to the encoder's step.

    A quintic P-spline (Eilers and Marx 1996) with a penalty on the third derivative. Its
    strength is the greatest with which the readings in motion are off by no more than an encoder
    leaves, step/√12 rms, so that what it smooths away is the encoder's and nothing else; where
    they are off by more for a while, in a quick move among slow ones, it gives way there. Built
    window by window where it is asked for.
    """

    def __init__(self, time_s: np.ndarray, reading: np.ndarray, step: float) -> None:
        """
        Take the readings of an encoder.

        Parameters
        ----------
        time_s
            Ascending, s, (n,).
        reading
            rad or m, (n,); NaN where it was not sampled.
        step
            Of the encoder, in the unit of the reading; 0 where it is exact.

        """
        known = np.isfinite(reading)
        self._time_s, self._reading = time_s[known], reading[known]
        self._windows: dict[int, BSpline] = {}
        self._step, self._strength = step, self._matched(step)

    def __call__(self, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        """See `motion.Path`."""
        begin, end = self._time_s[0], self._time_s[-1]
        inside = np.clip(time_s, begin, end)
        number = ((inside - begin) // _WINDOW_S).astype(int)
        out = np.empty(len(time_s))
        for window in np.unique(number):
            chosen = number == window
            out[chosen] = self._spline(int(window))(inside[chosen], order)
        if order:
            out[(time_s < begin) | (time_s > end)] = 0.0
        return out

    def _spline(self, window: int) -> BSpline:
        if window not in self._windows:
            while len(self._windows) >= _WINDOWS:
                del self._windows[min(self._windows)]
            self._windows[window] = smoothing_spline(
                *self._part(window), self._strength, self._step)
        return self._windows[window]

    def _part(self, window: int) -> tuple[np.ndarray, np.ndarray]:
        low = self._time_s[0] + window * _WINDOW_S - _MARGIN_S
        part = slice(*np.searchsorted(self._time_s, [low, low + _WINDOW_S + 2 * _MARGIN_S]))
        return self._time_s[part], self._reading[part]

    def _matched(self, step: float) -> float:
        """Return the median of what windows over the recording ask for."""
        last = int((self._time_s[-1] - self._time_s[0]) // _WINDOW_S)
        found = [matched_strength(*self._part(int(window)), step)
                 for window in np.unique(np.linspace(0, last, _PROBES).round())]
        known = [strength for strength in found if strength]
        return float(np.median(known)) if known else 0.0


def smoothing_spline(time_s: np.ndarray, reading: np.ndarray, strength: float, step: float
                     ) -> BSpline:
    """
    Fit one window; see `SmoothedPath`.

    Parameters
    ----------
    time_s, reading
        s and rad or m, (n,), all known.
    strength
        Of the penalty, by sample; 0 interpolates.
    step
        Of the encoder, in the unit of the reading.

    """
    if len(time_s) <= 2 * _DEGREE or np.ptp(reading) == 0:
        return make_interp_spline(time_s, reading, k=1) if len(time_s) > 1 else \
            BSpline(np.array([0.0, 1.0]), reading, 0, extrapolate=True)
    if not strength:
        return make_interp_spline(time_s, reading, k=_DEGREE)
    window = _Window(time_s, reading)
    strengths = np.full(len(window.right) - 3, strength)
    for _ in range(_ROUNDS):
        coefficients = window.coefficients(strengths)
        off2 = (reading - window.middle - window.design @ coefficients) ** 2
        near = max(round(_LOCAL_S / (time_s[-1] - time_s[0]) * len(time_s)), 5)
        local = np.interp(window.centres, time_s, uniform_filter1d(off2, near))
        stiff = local > _ALLOWED * step ** 2 / 12
        if not stiff.any():
            break
        # A softer stretch begins before the move that asks for it.
        strengths[maximum_filter1d(stiff, _WIDER)] *= _SOFTER
    return BSpline(window.knots, coefficients + window.middle, _DEGREE)


def matched_strength(time_s: np.ndarray, reading: np.ndarray, step: float) -> float:
    """
    Find the greatest strength that an encoder's step allows; 0 where nothing moves.

    Parameters
    ----------
    time_s, reading
        As for `smoothing_spline`.
    step
        Of the encoder, in the unit of the reading.

    """
    moving = _moving(reading)
    if not step or moving.sum() < _FEWEST:
        return 0.0
    window = _Window(time_s, reading)

    def too_strong(strength: float) -> bool:
        off = reading - window.middle - window.design @ window.coefficients(
            np.full(len(window.right) - 3, strength))
        return bool(np.sqrt(np.mean(off[moving] ** 2)) > step / np.sqrt(12))

    index = bisect_left(_STRENGTHS, True, key=too_strong)
    return float(_STRENGTHS[max(index - 1, 0)])


class _Window:
    """The normal equations of one window."""

    def __init__(self, time_s: np.ndarray, reading: np.ndarray) -> None:
        span = time_s[-1] - time_s[0]
        inner = np.linspace(time_s[0], time_s[-1],
                            max(int(min(span / _KNOT_S, len(time_s) / 2)), 1) + 1)
        outer = (inner[1] - inner[0]) * np.arange(1, _DEGREE + 1)
        self.knots = np.concatenate([inner[0] - outer[::-1], inner, inner[-1] + outer])
        self.design = BSpline.design_matrix(time_s, self.knots, _DEGREE)
        self.middle = float(reading.mean())
        self.right = self.design.T @ (reading - self.middle)
        self._normal = _banded(self.design.T @ self.design)
        # Where there is no sample and no penalty, the spline is held by next to nothing.
        self._normal[-1] += 1e-12 * self._normal[-1].max()
        self._by_sample = len(time_s) / len(self.right)
        # A third difference weighs four coefficients, whose splines peak between these knots.
        self.centres = np.convolve(self.knots, np.full(_DEGREE + 5, 1 / (_DEGREE + 5)), 'valid')

    def coefficients(self, strengths: np.ndarray) -> np.ndarray:
        """Fit with a strength of the penalty by third difference, (k − 3,)."""
        penalty = _third_differences(strengths * self._by_sample)
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
    row = np.array([-1.0, 3.0, -3.0, 1.0])
    for i in range(4):
        for j in range(i, 4):
            bands[_DEGREE - (j - i), j:j + len(weights)] += row[i] * row[j] * weights
    return bands


def _moving(reading: np.ndarray) -> np.ndarray:
    """Tell which readings lie between changes that follow each other: rests tell nothing."""
    edges = np.zeros(len(reading) + 1, int)
    changes = np.flatnonzero(np.diff(reading))
    gaps = np.diff(changes)
    if len(gaps):
        near = gaps <= max(8 * np.median(gaps), 8)
        np.add.at(edges, changes[:-1][near], 1)
        np.add.at(edges, changes[1:][near] + 1, -1)
    return np.cumsum(edges[:-1]) > 0


class ForcePath:
    """Specific force that was recorded or simulated elsewhere, as cubic splines, m/s²."""

    def __init__(self, time_s: np.ndarray, force_mps2: np.ndarray) -> None:
        """Take samples: s, (n,) and m/s², (n, 3)."""
        self._spline = CubicSpline(time_s, force_mps2)
        self._begin_s, self._end_s = time_s[0], time_s[-1]

    def __call__(self, time_s: np.ndarray) -> Components:
        """Return the three components at times, s, (n,); held outside."""
        return list(self._spline(np.clip(time_s, self._begin_s, self._end_s)).T)
