# SPDX-License-Identifier: Apache-2.0

"""
Levels, slopes and outliers of sensors in repeated recordings, and what all of them share.

The value of a recording is the level of its sensor, a slope in time, a step that each
calibration may cause, a scatter from recording to recording, and the stated error of the value.
Scatter and steps have variances that all sensors share. They maximise the restricted likelihood of
all recordings, with levels and slopes of the sensors free. A sensor's own scatter moderates the
shared one, as variances with a scaled inverse χ² distribution over sensors (Smyth 2004, section
6.2), and its slope has a t distribution. So a weak drift shows that the recordings of the sensor
alone would not show. The correlation ρ of neighbouring recordings, which the sensors share,
multiplies the variances of levels and slopes by 1 + 2cρ/(1 − ρ), where c is the share of the
scatter in the variance (Bartlett 1946). A slope is claimed only if it survives the control of the
false discovery rate (Benjamini and Hochberg 1995); intervals of claims hold for that share of them
(Benjamini and Yekutieli 2005).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

from adxl_ros.model.constants import MAD_TO_STD, TINY
import numpy as np
import pandas as pd
import scipy

FALSE_DISCOVERY_RATE = 0.05
"""Share of the claimed slopes that may be false: of twenty that are looked into, one is none. That
is the usual value."""
_INTERVAL = 0.9  # Probability of the intervals. Chosen: that of all intervals of the package
_MIN_RECORDINGS = 3  # Fewest recordings with a slope: one more than level and slope
_LARGEST_CORRELATION = 0.95
"""Largest correlation of neighbours. Chosen: above it a scatter is a drift of its own."""
_ROUNDS = 20  # Rounds of the factor by correlation; it changes by less than 1e-3 after ten
_SMALLEST_SHARE = 1e-8
"""Smallest variance beside the stated errors, relative to that of the values."""
_FIT_TOLERANCE = 1e-3  # Tolerance of the logarithms of both variances
FALSE_OUTLIERS = 0.05
"""Probability that a fleet without outliers has one on its page: as that of a false slope."""
_MIN_OF_OUTLIERS = 5  # Fewest recordings of a sensor with outliers. Chosen: a median needs them
_MAD_EFFICIENCY = 0.37  # Efficiency of that median for normal values (Rousseeuw and Croux 1993)
_MAD_BIAS = 0.8
"""That median of n values is too small by the factor 1 − 0.8/n (Croux and Rousseeuw 1992)."""
_EQUAL_VARIANCES = 1e6
"""Degrees of freedom of the common variance where sensors do not differ. Chosen: infinite."""
_NO_FREEDOM = 1e-6
"""Degrees of freedom of the common variance of one sensor, which moderates none. Chosen: small."""


@dataclass(frozen=True)
class Recordings:
    """A quantity in n recordings, in the order of sensors and time."""

    sensor: np.ndarray  # Numbers of the sensors from 0, (n,)
    # Numbers of the periods between calibrations from 0, which rise along the array, (n,)
    period: np.ndarray
    time: np.ndarray  # Times, in the unit of time of the slopes, (n,)
    value: np.ndarray  # Values, (n,)
    std: np.ndarray  # Stated standard deviations of the values, (n,)

    def __getitem__(self, part: np.ndarray) -> Recordings:
        return Recordings(
            _numbered(self.sensor[part]),
            _numbered(self.period[part]),
            self.time[part],
            self.value[part],
            self.std[part],
        )


def _numbered(labels: np.ndarray) -> np.ndarray:
    """Replace sorted labels by 0, 1, ..."""
    return np.cumsum(np.diff(labels, prepend=labels[:1]) != 0)


@dataclass(frozen=True)
class Scatter:
    """What all sensors share."""

    recording: float  # Standard deviation from recording to recording, beyond the stated errors
    calibration: float  # Standard deviation of the steps at calibrations
    widening: float = 1.0  # Factor of the variances of levels and slopes by correlation in time


@dataclass(frozen=True)
class Trends:
    """Levels and slopes of m sensors; NaN stands for a slope that the recordings do not have."""

    scatter: Scatter  # What the sensors share
    # level, level_std: Mean of each sensor over its recordings and its standard deviation, (m,)
    level: np.ndarray
    level_std: np.ndarray
    # slope, slope_std: Slope of each sensor and its standard deviation, (m,)
    slope: np.ndarray
    slope_std: np.ndarray
    freedom: np.ndarray  # Degrees of freedom of the slopes, (m,)
    squares: np.ndarray  # Weighted squares of the residuals of each sensor, (m,)
    residual: np.ndarray  # Residuals over the expected scatter, (n,)
    log_likelihood: float  # Restricted log-likelihood of the scatter

    @property
    def p_values(self) -> np.ndarray:
        """Two-sided probability of each slope without a drift, (m,); NaN without a slope."""
        with np.errstate(invalid='ignore'):
            return 2 * scipy.special.stdtr(self.freedom, -np.abs(self.slope / self.slope_std))


def fit_trends(recordings: Recordings) -> Trends:
    """Fit levels and slopes of all sensors."""
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
        fit,
        scatter=replace(scatter, widening=widening),
        level_std=factor * fit.level_std,
        slope_std=factor * fit.slope_std,
        freedom=np.where(sums.has_slope, freedom, np.nan),
    )


class _Lines(NamedTuple):
    """The line of each of m sensors, about the centre of its recordings."""

    mean: np.ndarray  # Weighted mean, (m,)
    mean_std: np.ndarray  # Its standard deviation, (m,)
    intercept: np.ndarray  # Value at the centre in time, (m,)
    slope: np.ndarray  # Slope, (m,); 0 where there is none
    slope_std: np.ndarray  # Its standard deviation, (m,)
    squares: np.ndarray  # Weighted squares of the residuals, (m,)
    log_det: float  # Logarithm of the determinant of the normal equations


class _Sums:
    """Recordings about the centre of their sensor, with where sensors and periods begin."""

    def __init__(self, recordings: Recordings) -> None:
        self.recordings = recordings
        sensor = recordings.sensor
        self.counts = np.bincount(sensor)
        self.period_starts = np.flatnonzero(np.diff(recordings.period, prepend=-1))
        self.sensor_starts = np.flatnonzero(np.diff(sensor[self.period_starts], prepend=-1))
        self.centre_value = np.bincount(sensor, recordings.value) / self.counts
        self.time = recordings.time - (np.bincount(sensor, recordings.time) / self.counts)[sensor]
        self.value = recordings.value - self.centre_value[sensor]
        self.has_slope = (self.counts >= _MIN_RECORDINGS) & (np.bincount(sensor, self.time**2) > 0)

    def fit(self, scatter: Scatter) -> Trends:
        """Fit the lines of all sensors for given variances, by generalised least squares."""
        step2 = scatter.calibration**2
        weight = 1 / (self.recordings.std**2 + scatter.recording**2)
        t = self.time
        y = self.value
        # Weighted sums over each period of the products of 1, t and y
        products = self._by_period(weight * [np.ones_like(t), t, t * t, y, t * y, y * y])
        # The step of a period has one common part in all of its recordings (Woodbury).
        shared = step2 / (1 + step2 * products[0])
        lines = self._lines(products, shared)
        log_det = self._by_sensor(np.log1p(step2 * products[0])).sum() - np.log(weight).sum()
        nan = np.where(self.has_slope, 1.0, np.nan)
        return Trends(
            scatter=scatter,
            level=self.centre_value + lines.mean,
            level_std=lines.mean_std,
            slope=nan * lines.slope,
            slope_std=nan * lines.slope_std,
            freedom=np.full(len(nan), np.inf),
            squares=lines.squares,
            residual=self._residual(lines, shared, weight),
            log_likelihood=float(-0.5 * (log_det + lines.log_det + lines.squares.sum())),
        )

    def _lines(self, products: np.ndarray, shared: np.ndarray) -> _Lines:
        """
        Solve the normal equations of all sensors.

        products: sums over each period of the products of 1, t and y, (6, k); shared: weight of
        the product of two sums, by which the step of a period lowers them, (k,).
        """
        w, wt, _, wy, _, _ = products
        first = np.array([w, w, wt, w, wt, wy])
        second = np.array([w, wt, wt, wy, wy, wy])
        # They are a·intercept + b·slope = p and b·intercept + c·slope = q.
        a, b, c, p, q, r = self._by_sensor(products - shared * first * second)
        det = np.where(self.has_slope, np.maximum(a * c - b * b, TINY), 1.0)
        slope = np.where(self.has_slope, (a * q - b * p) / det, 0.0)
        intercept = (p - b * slope) / a
        with np.errstate(invalid='ignore'):
            slope_std = np.sqrt(a / det)
        return _Lines(
            mean=p / a,
            mean_std=a**-0.5,
            intercept=intercept,
            slope=slope,
            slope_std=slope_std,
            squares=np.maximum(r - intercept * p - slope * q, 0.0),
            log_det=float(np.log(np.where(self.has_slope, det, a)).sum()),
        )

    def _residual(self, lines: _Lines, shared: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Return what lines and steps leave, in standard deviations, (n,)."""
        sensor = self.recordings.sensor
        residual = self.value - lines.intercept[sensor] - lines.slope[sensor] * self.time
        step = shared * self._by_period(weight * residual)
        return (residual - step[self.recordings.period]) * np.sqrt(weight)

    def _by_period(self, values: np.ndarray) -> np.ndarray:
        """Sum values of recordings, (..., n), within each period."""
        return np.add.reduceat(values, self.period_starts, axis=-1)

    def _by_sensor(self, values: np.ndarray | list[np.ndarray]) -> np.ndarray:
        """Sum values of periods, (..., k), within each sensor."""
        return np.add.reduceat(values, self.sensor_starts, axis=-1)


def _shared_scatter(sums: _Sums) -> Scatter:
    """Estimate the variances that all sensors share."""
    recordings = sums.recordings
    spread2 = float(np.mean(sums.value**2)) + float(np.min(recordings.std)) ** 2
    several = len(sums.period_starts) > len(sums.counts)
    if spread2 == 0 or not (sums.counts >= _MIN_RECORDINGS).any():
        return Scatter(0.0, 0.0) if recordings.std.min() > 0 else Scatter(1.0, 0.0)
    floor = np.log(_SMALLEST_SHARE * spread2)

    def scatter(logs: np.ndarray) -> Scatter:
        variances = np.exp(np.maximum(logs, floor))
        return Scatter(float(variances[0] ** 0.5), float(variances[1] ** 0.5) if several else 0.0)

    start = np.log(spread2) - np.array([1.0, 2.0])[: 1 + several]
    best = scipy.optimize.minimize(
        lambda logs: -sums.fit(scatter(logs)).log_likelihood,
        start,
        method='Nelder-Mead',
        options={'xatol': _FIT_TOLERANCE, 'fatol': _FIT_TOLERANCE},
    )
    return scatter(best.x)


def _widening(sums: _Sums, fit: Trends) -> float:
    """Estimate the factor of the variances of levels and slopes by correlation in time."""
    sensor = sums.recordings.sensor
    residual = fit.residual
    used = sums.has_slope & (sums.counts > 2 * _MIN_RECORDINGS)
    same = (sensor[1:] == sensor[:-1]) & used[sensor[1:]]
    if not same.any() or fit.scatter.recording == 0:
        return 1.0
    variance = fit.scatter.recording**2
    share = float(np.mean((variance / (variance + sums.recordings.std**2))[used[sensor]]))
    products = float((residual[1:] * residual[:-1])[same].sum())
    squares = float((residual**2)[used[sensor]].sum())
    count = int(sums.counts[used].sum())
    lines = 2 * int(used.sum())
    widening = 1.0
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
    Mark the recordings that are too far from the median of their sensor and period to be chance.

    tests: number of recordings that share the chance of a false outlier; returns: the distance of
    each recording in robust standard deviations, (n,), which is 0 where a period has too few
    recordings, and whether it is an outlier, (n,) bool.
    """
    period = recordings.period
    value = recordings.value
    counts = np.bincount(period)
    deviation = np.abs(value - _medians(period, value)[period])
    enough = counts >= _MIN_OF_OUTLIERS
    # Both the median of few values and that of their deviations are uncertain.
    mad = MAD_TO_STD * counts / (counts - _MAD_BIAS) * _medians(period, deviation)
    variance, freedom = moderated(mad**2, np.where(enough, _MAD_EFFICIENCY * (counts - 1), 0.0))
    stated2 = recordings.std**2
    worse2 = np.maximum(stated2 - _medians(period, stated2)[period], 0.0)
    scale = np.sqrt((variance * (1 + np.pi / 2 / counts))[period] + worse2)
    distance = np.divide(
        deviation, scale, out=np.zeros(len(value)), where=(scale > 0) & enough[period]
    )
    limits = -scipy.special.stdtrit(
        np.minimum(freedom[period], 1e6), FALSE_OUTLIERS / (2 * max(tests, 1))
    )
    return distance, distance > limits


def _medians(label: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return the median of the values with each label 0, 1, ..."""
    return pd.Series(value).groupby(label).median().to_numpy()


def moderated(variance: np.ndarray, freedom: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Moderate the variances of sensors, (m,), by their degrees of freedom, (m,), 0 for none.

    returns: moderated variances and their degrees of freedom. Without any variance all are 1.
    """
    determined = freedom > 0
    common, common_freedom = _common_variance(variance[determined], freedom[determined])
    squares = np.where(determined, freedom * np.nan_to_num(variance), 0.0)
    total = common_freedom + freedom
    # What all sensors share is no better known than from all of their recordings (limma).
    largest = float(freedom[determined].sum())
    return (common_freedom * common + squares) / total, np.minimum(total, largest or np.inf)


def _common_variance(variance: np.ndarray, freedom: np.ndarray) -> tuple[float, float]:
    """Return the scale of the inverse χ² distribution and its degrees of freedom."""
    freedom = freedom[variance > 0]
    variance = variance[variance > 0]
    if len(variance) < 2:
        return (float(variance[0]), _NO_FREEDOM) if len(variance) else (1.0, _EQUAL_VARIANCES)
    log_variance = np.log(variance) - scipy.special.digamma(freedom / 2) + np.log(freedom / 2)
    mean = float(log_variance.mean())
    excess = float(log_variance.var(ddof=1) - scipy.special.polygamma(1, freedom / 2).mean())
    if excess <= 2 / _EQUAL_VARIANCES:
        return float(np.exp(mean)), _EQUAL_VARIANCES
    # trigamma(x) is above 1/x², and near 1/x where x is large.
    half = scipy.optimize.brentq(
        lambda x: float(scipy.special.polygamma(1, x)) - excess,
        excess**-0.5,
        _EQUAL_VARIANCES,
        xtol=1e-300,
        rtol=1e-14,
    )
    return float(np.exp(mean + scipy.special.digamma(half) - np.log(half))), 2 * half
