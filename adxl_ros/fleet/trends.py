# SPDX-License-Identifier: Apache-2.0

"""
Levels and slopes of a quantity by unit, from repeated recordings.

The value of a recording is the level of its unit, a slope in time, a step that each calibration
may cause, a scatter from recording to recording, and the stated error of the value. Scatter and
steps have variances that all units share. They maximise the restricted likelihood of all
recordings, with levels and slopes of the units free.

A unit may scatter more than others. Its own scatter therefore moderates the shared one, and the
slope of a unit has a t distribution with the degrees of freedom of both (`moderated_variance`).
That makes a weak drift visible which the recordings of the unit alone would not show.

Scatter may be correlated in time. The correlation ρ of neighbouring recordings, which the units
share, decays as that of a first-order process. It multiplies the variances of levels and slopes
by 1 + 2cρ/(1 − ρ), where c is the share of the scatter in the variance (Bartlett 1946).

A slope is claimed only if it survives the control of the false discovery rate over all units
(Benjamini and Hochberg 1995). The intervals of claims hold for that share of the claims
(Benjamini and Yekutieli 2005).

Outliers are recordings far from the others of their unit, by median and median absolute deviation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from adxl_ros.fleet.populations import moderated
from adxl_ros.model.constants import MAD_TO_STD
import numpy as np
import pandas as pd
import scipy

FALSE_DISCOVERY_RATE = 0.05
"""Share of the claimed slopes that may be false. Chosen: the usual value."""
_INTERVAL = 0.9
"""Probability of the intervals. Chosen: that of all intervals of the package."""
_MIN_RECORDINGS = 3
"""Fewest recordings with a slope: one more than level and slope."""
_LARGEST_CORRELATION = 0.95
"""Largest correlation of neighbours. Chosen: above it a scatter is a drift of its own."""
_ROUNDS = 20
"""Rounds of the factor by correlation; it changes by less than 1e-3 after ten."""
_SMALLEST_SHARE = 1e-8
"""Smallest variance beside the stated errors, relative to that of the values."""
_FIT_TOLERANCE = 1e-3
"""Tolerance of the logarithms of both variances."""
FALSE_OUTLIERS = 0.05
"""Probability that a fleet without outliers has one on its page. Chosen."""
_MIN_OF_OUTLIERS = 5
"""Fewest recordings of a unit with outliers. Chosen: a median needs them."""
_MAD_EFFICIENCY = 0.37
"""Efficiency of that median for normal values (Rousseeuw and Croux 1993)."""
_MAD_BIAS = 0.8
"""That median of n values is too small by the factor 1 − 0.8/n (Croux and Rousseeuw 1992)."""


@dataclass(frozen=True)
class Recordings:
    """A quantity in n recordings, in the order of units and time."""

    unit: np.ndarray  # Numbers of the units from 0, (n,)
    # Numbers of the periods between calibrations from 0, which rise along the array, (n,)
    period: np.ndarray
    time: np.ndarray  # Times, in the unit of time of the slopes, (n,)
    value: np.ndarray  # Values, (n,)
    std: np.ndarray  # Stated standard deviations of the values, (n,)

    def __getitem__(self, part: np.ndarray) -> Recordings:
        return Recordings(_numbered(self.unit[part]), _numbered(self.period[part]),
                          self.time[part], self.value[part], self.std[part])


def _numbered(labels: np.ndarray) -> np.ndarray:
    """Replace sorted labels by 0, 1, ..."""
    return np.cumsum(np.diff(labels, prepend=labels[:1]) != 0)


@dataclass(frozen=True)
class Scatter:
    """What all units share."""

    recording: float  # Standard deviation from recording to recording, beyond the stated errors
    calibration: float  # Standard deviation of the steps at calibrations
    widening: float = 1.0  # Factor of the variances of levels and slopes by correlation in time


@dataclass(frozen=True)
class Trends:
    """
    Levels and slopes of m units, and lines of k periods between their calibrations.

    NaN stands for a slope that the recordings do not have.
    """

    scatter: Scatter  # What the units share
    # level, level_std: Mean of each unit over its recordings and its standard deviation, (m,)
    level: np.ndarray
    level_std: np.ndarray
    # slope, slope_std: Slope of each unit and its standard deviation, (m,)
    slope: np.ndarray
    slope_std: np.ndarray
    freedom: np.ndarray  # Degrees of freedom of the slopes, (m,)
    # period_time, period_value: A point of the line in each period, (k,). It is the same for a
    # line without a slope.
    period_time: np.ndarray
    period_value: np.ndarray
    squares: np.ndarray  # Weighted squares of the residuals of each unit, (m,)
    residual: np.ndarray  # Residuals over the expected scatter, (n,)
    log_likelihood: float  # Restricted log-likelihood of the scatter

    @property
    def p_values(self) -> np.ndarray:
        """Two-sided probability of each slope without a drift, (m,); NaN without a slope."""
        with np.errstate(invalid='ignore'):
            return 2 * scipy.special.stdtr(self.freedom, -np.abs(self.slope / self.slope_std))


def fit_trends(recordings: Recordings) -> Trends:
    """Fit levels and slopes of all units."""
    sums = _Sums(recordings)
    scatter = _shared_scatter(sums)
    fit = sums.fit(scatter)
    widening = _widening(sums, fit)
    # A line takes two independent recordings, which are so many of the correlated ones.
    remaining = sums.counts - 2 * widening
    own_freedom = np.maximum(remaining, 0.0) * sums.has_slope / widening
    with np.errstate(invalid='ignore', divide='ignore'):
        ratio = np.where(own_freedom > 0, fit.squares / remaining, np.nan)
    variance, freedom = moderated(ratio, own_freedom)
    factor = np.sqrt(variance * widening)
    return replace(
        fit, scatter=replace(scatter, widening=widening), level_std=factor * fit.level_std,
        slope_std=factor * fit.slope_std, freedom=np.where(sums.has_slope, freedom, np.nan))


class _Sums:
    """Recordings about the centre of their unit, with where units and periods begin."""

    def __init__(self, recordings: Recordings) -> None:
        self.recordings = recordings
        unit = recordings.unit
        self.counts = np.bincount(unit)
        self.period_starts = np.flatnonzero(np.diff(recordings.period, prepend=-1))
        self.unit_of_period = unit[self.period_starts]
        self.unit_starts = np.flatnonzero(np.diff(self.unit_of_period, prepend=-1))
        self.centre_time = np.bincount(unit, recordings.time) / self.counts
        self.centre_value = np.bincount(unit, recordings.value) / self.counts
        self.time = recordings.time - self.centre_time[unit]
        self.value = recordings.value - self.centre_value[unit]
        self.has_slope = (self.counts >= _MIN_RECORDINGS) & (
            np.bincount(unit, self.time ** 2) > 0)

    def fit(self, scatter: Scatter) -> Trends:
        """Fit the lines of all units for given variances, by generalised least squares."""
        step2, unit = scatter.calibration ** 2, self.recordings.unit
        weight = 1 / (self.recordings.std ** 2 + scatter.recording ** 2)
        t, y = self.time, self.value
        w, wt, wy, wtt, wty, wyy = (np.add.reduceat(weight * part, self.period_starts)
                                    for part in (np.ones_like(t), t, y, t * t, t * y, y * y))
        # The step of a period has one common part in all of its recordings (Woodbury).
        shared = step2 / (1 + step2 * w)
        a, b, c, p, q, r = (np.add.reduceat(part, self.unit_starts) for part in (
            w - shared * w * w, wt - shared * w * wt, wtt - shared * wt * wt,
            wy - shared * w * wy, wty - shared * wt * wy, wyy - shared * wy * wy))
        det = np.where(self.has_slope, a * c - b * b, 1.0)
        det = np.maximum(det, np.finfo(float).tiny)
        slope = np.where(self.has_slope, (a * q - b * p) / det, 0.0)
        intercept = (p - b * slope) / a
        squares = np.maximum(r - intercept * p - slope * q, 0.0)
        log_det = np.add.reduceat(np.log1p(step2 * w), self.unit_starts).sum() \
            - np.log(weight).sum()
        log_likelihood = -0.5 * (log_det + np.log(np.where(self.has_slope, det, a)).sum()
                                 + squares.sum())
        residual = y - intercept[unit] - slope[unit] * t
        step = shared * np.add.reduceat(weight * residual, self.period_starts)
        residual = (residual - step[self.recordings.period]) * np.sqrt(weight)
        nan = np.where(self.has_slope, 1.0, np.nan)
        with np.errstate(invalid='ignore'):
            slope_std = nan * np.sqrt(a / det)
        # A period has a step as far as its recordings show one, else the line of its unit.
        unit, share = self.unit_of_period, shared * w
        return Trends(
            scatter, self.centre_value + p / a, a ** -0.5, nan * slope, slope_std,
            np.full(len(a), np.inf),
            self.centre_time[unit] + (1 - share) * (b / a)[unit] + share * wt / w,
            self.centre_value[unit] + (1 - share) * (p / a)[unit] + share * wy / w,
            squares, residual, float(log_likelihood))


def _shared_scatter(sums: _Sums) -> Scatter:
    """Estimate the variances that all units share."""
    recordings = sums.recordings
    spread2 = float(np.mean(sums.value ** 2)) + float(np.min(recordings.std)) ** 2
    several = len(sums.period_starts) > len(sums.counts)
    if spread2 == 0 or not (sums.counts >= _MIN_RECORDINGS).any():
        return Scatter(0.0, 0.0) if recordings.std.min() > 0 else Scatter(1.0, 0.0)
    floor = np.log(_SMALLEST_SHARE * spread2)

    def scatter(logs: np.ndarray) -> Scatter:
        variances = np.exp(np.maximum(logs, floor))
        return Scatter(float(variances[0] ** 0.5),
                       float(variances[1] ** 0.5) if several else 0.0)

    start = np.log(spread2) - np.array([1.0, 2.0])[:1 + several]
    best = scipy.optimize.minimize(
        lambda logs: -sums.fit(scatter(logs)).log_likelihood, start, method='Nelder-Mead',
        options={'xatol': _FIT_TOLERANCE, 'fatol': _FIT_TOLERANCE})
    return scatter(best.x)


def _widening(sums: _Sums, fit: Trends) -> float:
    """Estimate the factor of the variances of levels and slopes by correlation in time."""
    unit, residual = sums.recordings.unit, fit.residual
    used = sums.has_slope & (sums.counts > 2 * _MIN_RECORDINGS)
    same = (unit[1:] == unit[:-1]) & used[unit[1:]]
    if not same.any() or fit.scatter.recording == 0:
        return 1.0
    variance = fit.scatter.recording ** 2
    share = float(np.mean((variance / (variance + sums.recordings.std ** 2))[used[unit]]))
    products = float((residual[1:] * residual[:-1])[same].sum())
    squares, count = float((residual ** 2)[used[unit]].sum()), int(sums.counts[used].sum())
    lines, widening = 2 * int(used.sum()), 1.0
    for _ in range(_ROUNDS):
        # A line removes as much from squares and products of its residuals.
        removed = lines * widening
        neighbours = (products * max(count - removed, 1.0) / squares + removed) / same.sum()
        correlation = float(np.clip(neighbours / share, 0.0, _LARGEST_CORRELATION))
        widening = 1 + 2 * share * correlation / (1 - correlation)
    return widening


def claims(p_values: np.ndarray) -> np.ndarray:
    """Mark the slopes that survive the control of the false discovery rate."""
    tested = np.isfinite(p_values)
    result = np.zeros(p_values.shape, bool)
    if tested.any():
        adjusted = scipy.stats.false_discovery_control(p_values[tested])
        result[tested] = adjusted <= FALSE_DISCOVERY_RATE
    return result


def interval_factor(freedom: np.ndarray, is_claimed: np.ndarray) -> np.ndarray:
    """Return half the width of the intervals of slopes, in standard deviations."""
    share = is_claimed.sum() / max(np.isfinite(freedom).sum(), 1)
    outside = (1 - _INTERVAL) * np.where(is_claimed, share, 1.0)
    return -scipy.special.stdtrit(freedom, outside / 2)


def outliers(recordings: Recordings, tests: int) -> tuple[np.ndarray, np.ndarray]:
    """
    Mark the recordings that are too far from the median of their unit and period to be chance.

    tests: number of recordings that share the chance of a false outlier; returns: the distance of
    each recording in robust standard deviations, (n,), which is 0 where a period has too few
    recordings, and whether it is an outlier, (n,) bool.
    """
    period, value = recordings.period, recordings.value
    counts = np.bincount(period)
    deviation = np.abs(value - _medians(period, value)[period])
    enough = counts >= _MIN_OF_OUTLIERS
    # Both the median of few values and that of their deviations are uncertain.
    mad = MAD_TO_STD * counts / (counts - _MAD_BIAS) * _medians(period, deviation)
    variance, freedom = moderated(mad ** 2, np.where(
        enough, _MAD_EFFICIENCY * (counts - 1), 0.0))
    stated2 = recordings.std ** 2
    worse2 = np.maximum(stated2 - _medians(period, stated2)[period], 0.0)
    scale = np.sqrt((variance * (1 + np.pi / 2 / counts))[period] + worse2)
    distance = np.divide(deviation, scale, out=np.zeros(len(value)),
                         where=(scale > 0) & enough[period])
    limits = -scipy.special.stdtrit(np.minimum(freedom[period], 1e6),
                                    FALSE_OUTLIERS / (2 * max(tests, 1)))
    return distance, distance > limits


def _medians(label: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return the median of the values with each label 0, 1, ..."""
    return pd.Series(value).groupby(label).median().to_numpy()
