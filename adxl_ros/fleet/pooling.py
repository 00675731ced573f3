# SPDX-License-Identifier: Apache-2.0

"""
Sensors from repeated recordings: levels and slopes of each, and what all of them share.

**Trends.** The value of a recording is the level of its sensor, a slope in time, a step that each
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

**Populations.** The estimate of sensor u is y = μ + b + e. Its own error e has the known standard
deviation v, and the departure b from the mean has the standard deviation τ, the spread. At
the spread the weighted squares about the mean are as large as expected (Paule and Mandel 1982),
and at the ends of its interval as large as quantiles of χ² (Viechtbauer 2007). The errors of the
mean and of a further sensor are those over all spreads by their restricted likelihood, with all
spreads equally likely before (Gelman 2006), because few sensors hardly determine the spread.

**Batches** are sensors whose serial numbers begin alike, and whose levels are not those of the
others by Welch's t test, whose chance all batches share (Bonferroni), and by more than matters.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, chain
from typing import NamedTuple

from adxl_ros.model.constants import MAD_TO_STD, TINY
from adxl_ros.model.population import PooledCoefficient
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
MIN_SENSORS = 5
"""Smallest count of sensors with a spread: with fewer, a further sensor has no finite variance."""
_GRID = (np.arange(400) + 0.5) / 400
"""Shares x of the spreads s·x/(1 − x) over which the likelihood is integrated. Chosen: more change
the integrals by less than 1e-3."""
_OUTLIER_CHANCE = 0.05
"""Probability that a sensor does not count although all sensors are of one population: one of
twenty populations is then a little too narrow."""
_MAX_ROUNDS = 10
"""Largest count of rounds of spread and outliers; a round seldom changes after the second."""
_MAX_OUTLIERS = 0.25
"""Largest share of sensors that are far out. Chosen: more are a population of their own."""
_FAR_MADS = 5.0
"""Sensors further from the median do not count in the first round. Chosen: far beyond normal."""
_MIN_BATCH = 5
"""Fewest units of a batch. Chosen: fewer have nothing in common that a test could show."""
_CHANCE = 0.01
"""Probability of a false batch among all batches. It is less than that of a slope, because a batch
is sent back."""


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


def random_effects(
    estimates: np.ndarray, std: np.ndarray, tests: int | None = None
) -> PooledCoefficient:
    """
    Estimate mean and spread of a population, without the units that are not of it.

    estimates: those of at least `MIN_SENSORS` sensors, (n,); std: their standard deviations, (n,).
    """
    chance = _OUTLIER_CHANCE / (2 * (tests or len(estimates)))
    deviation = np.abs(estimates - np.median(estimates))
    scale = MAD_TO_STD * np.median(deviation)
    kept = _largest_dropped(deviation / np.hypot(max(scale, TINY), std), _FAR_MADS)
    for _ in range(_MAX_ROUNDS):
        pooled = _of_sensors(estimates[kept], std[kept])
        distance = np.abs(estimates - pooled.mean) / np.sqrt(
            pooled.spread**2 + pooled.mean_std**2 + std**2
        )
        limit = -float(scipy.special.stdtrit(kept.sum() - 2, chance))
        now = _largest_dropped(distance, limit)
        if np.array_equal(now, kept):
            break
        kept = now
    return pooled


def _largest_dropped(distance: np.ndarray, limit: float) -> np.ndarray:
    """Mark the sensors within a limit, (n,) bool; of too many others, the nearest count, too."""
    count = len(distance)
    limit_count = min(int(_MAX_OUTLIERS * count), count - MIN_SENSORS)
    farthest = np.argsort(-distance)[:limit_count]
    kept = np.ones(count, bool)
    kept[farthest[distance[farthest] > limit]] = False
    return kept


def _of_sensors(estimates: np.ndarray, std: np.ndarray) -> PooledCoefficient:
    """Return the population of the units that count."""
    scale = max(float(np.ptp(estimates)), float(std.max()), TINY)
    y = (estimates - estimates.mean()) / scale
    variance = (std / scale) ** 2
    spread2, low, high = _spreads2(y, variance)
    mean, _ = weighted_mean(y, variance, spread2)
    mean_variance, prediction_variance = _variances(y, variance, mean)
    return PooledCoefficient(
        mean=float(estimates.mean() + scale * mean),
        mean_std=scale * mean_variance**0.5,
        spread=scale * spread2**0.5,
        spread_low=scale * low**0.5,
        spread_high=scale * high**0.5,
        prediction_std=scale * prediction_variance**0.5,
        units=len(estimates),
    )


def _variances(y: np.ndarray, variance: np.ndarray, mean: float) -> tuple[float, float]:
    """Return the variances of mean and of a further sensor, over all spreads."""
    scale = float(np.sqrt(np.var(y) + variance.mean()))
    if scale == 0:
        return 0.0, 0.0
    spread2 = (scale * _GRID / (1 - _GRID)) ** 2
    weight = 1 / (variance + spread2[:, None])
    total = weight.sum(axis=1)
    means = weight @ y / total
    squares = (weight * (y - means[:, None]) ** 2).sum(axis=1)
    log_density = 0.5 * (np.log(weight).sum(axis=1) - np.log(total) - squares) - 2 * np.log1p(
        -_GRID
    )
    density = np.exp(log_density - log_density.max())
    density /= density.sum()
    mean_variance = float(density @ (1 / total + (means - mean) ** 2))
    return mean_variance, mean_variance + float(density @ spread2)


def weighted_mean(y: np.ndarray, variance: np.ndarray, spread2: float) -> tuple[float, float]:
    """Return the mean of estimates, (n,), for a given spread, and its variance."""
    weight = 1 / (variance + spread2)
    total = float(weight.sum())
    return float(weight @ y) / total, 1 / total


def _spreads2(y: np.ndarray, variance: np.ndarray) -> list[float]:
    """Return the variance between sensors, and the ends of its 90 % interval; see the module."""

    def squares(spread2: float) -> float:
        mean, _ = weighted_mean(y, variance, spread2)
        return float(np.sum((y - mean) ** 2 / (variance + spread2)))

    floor = 1e-12 * float(np.var(y) + variance.mean())
    freedom = len(y) - 1
    spreads2 = []
    for target in (freedom, *scipy.special.chdtri(freedom, [0.05, 0.95])):
        # No weight is above 1/spread2, so that the squares are below the target at the high end.
        high = floor + len(y) * float(np.var(y)) / target
        spread2 = 0.0
        if floor > 0 and squares(floor) > target:
            spread2 = scipy.optimize.brentq(
                lambda spread2, target=target: squares(spread2) - target,
                floor,
                high,
                rtol=1e-12,
                xtol=1e-300,
            )
        spreads2.append(float(spread2))
    return spreads2


class BadBatch(NamedTuple):
    """Sensors with a serial number `prefix`…; how far their mean is above that of the others."""

    prefix: str
    members: np.ndarray
    difference: float
    low: float
    high: float


def bad_batch(
    serials: Sequence[str], level: np.ndarray, tolerance: float, tests: int
) -> BadBatch | None:
    """Return the most certain batch whose level differs by more than a tolerance."""
    prefixes = chain.from_iterable(map(accumulate, serials))
    counts = Counter(prefixes)
    batches: dict[bytes, tuple[str, np.ndarray]] = {}  # By their members, with the shortest prefix
    for prefix in sorted(counts, key=len):
        # The larger part of a fleet is what the others are compared with.
        if _MIN_BATCH <= counts[prefix] <= len(serials) / 2:
            members = np.array([name.startswith(prefix) for name in serials])
            batches.setdefault(members.tobytes(), (prefix, members))
    best = None
    lowest = _CHANCE / (max(len(batches), 1) * tests)
    for prefix, members in batches.values():
        test = scipy.stats.ttest_ind(level[members], level[~members], equal_var=False)
        difference = float(level[members].mean() - level[~members].mean())
        if test.pvalue < lowest and abs(difference) > tolerance:
            lowest = float(test.pvalue)
            best = BadBatch(
                prefix, members, difference, *map(float, test.confidence_interval(0.9))
            )
    return best
