# SPDX-License-Identifier: Apache-2.0

"""
Populations of sensors by their estimates, and batches that are not of them.

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
from itertools import accumulate, chain
from typing import NamedTuple

from adxl_ros.model.constants import MAD_TO_STD, TINY
from adxl_ros.model.population import PooledCoefficient
import numpy as np
import scipy

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
