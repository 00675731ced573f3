# SPDX-License-Identifier: Apache-2.0

"""
Random effects: the mean and the spread of a coefficient over units, and what they say of each.

The estimate of unit u is y = μ + b + e. Its own error e has the known standard deviation v, and
the unit's departure b from the mean has the standard deviation τ, the spread. At the spread the
weighted squares about the mean are as large as expected (Paule and Mandel 1982), and at the ends
of its interval as large as quantiles of χ² (Viechtbauer 2007). Few units hardly determine the
spread. The errors of the mean and of a further unit therefore are those over all spreads by their
restricted likelihood, with all spreads equally likely before (Gelman 2006).

Variances that units share moderate each other: they have a scaled inverse χ² distribution over
units, whose two parameters the units determine (Smyth 2004, section 6.2).

Batches are units whose serial numbers begin alike, and whose coefficient is not that of the
others. Levels are compared by Welch's t test, whose chance all batches share (Bonferroni). A
difference that no one would notice is no bad batch, however certain it is.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from adxl_ros.model.constants import MAD_TO_STD
from adxl_ros.model.population import PooledCoefficient
import numpy as np
import scipy

_EQUAL_VARIANCES = 1e6
"""Degrees of freedom of the common variance where units do not differ. Chosen: infinite."""
_NO_FREEDOM = 1e-6
"""Degrees of freedom of the common variance of one unit, which moderates none. Chosen: small."""
MIN_UNITS = 5
"""Smallest count of units with a spread: with fewer, a further unit has no finite variance."""
_GRID = (np.arange(400) + 0.5) / 400
"""Shares x of the spreads s·x/(1 − x) over which the likelihood is integrated. Chosen: more change
the integrals by less than 1e-3."""
_OUTLIER_CHANCE = 0.05
"""Probability that a page names a unit although all units are of one population. Chosen."""
_MAX_ROUNDS = 10
"""Largest count of rounds of spread and outliers; a round seldom changes after the second."""
_MAX_OUTLIERS = 0.25
"""Largest share of units that are far out. Chosen: more of them are a population of their own."""
_FAR_MADS = 5.0
"""Units further from the median do not count in the first round. Chosen: far beyond normal."""
MIN_GROUP = 5
"""Fewest units of a group. Chosen: fewer have nothing in common that a test could show."""
CHANCE = 0.01
"""Probability of a false group among all groups. Chosen."""


def moderated(variance: np.ndarray, freedom: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Moderate the variances of units.

    variance: variances of the units, (m,). Those without a degree of freedom may be NaN.; freedom:
    their degrees of freedom, (m,); 0 for none; returns: moderated variances and their degrees of
    freedom, (m,) each. Without any variance all are 1.
    """
    determined = freedom > 0
    common, common_freedom = _common_variance(variance[determined], freedom[determined])
    squares = np.where(determined, freedom * np.nan_to_num(variance), 0.0)
    total = common_freedom + freedom
    # What all units share is no better known than from all of their recordings (limma).
    largest = float(freedom[determined].sum())
    return (common_freedom * common + squares) / total, np.minimum(total, largest or np.inf)


def _common_variance(variance: np.ndarray, freedom: np.ndarray) -> tuple[float, float]:
    """Return the scale of the inverse χ² distribution and its degrees of freedom."""
    freedom, variance = freedom[variance > 0], variance[variance > 0]
    if len(variance) < 2:
        return (float(variance[0]), _NO_FREEDOM) if len(variance) else (1.0, _EQUAL_VARIANCES)
    log_variance = np.log(variance) - scipy.special.digamma(freedom / 2) + np.log(freedom / 2)
    mean = float(log_variance.mean())
    excess = float(log_variance.var(ddof=1) - scipy.special.polygamma(1, freedom / 2).mean())
    if excess <= 2 / _EQUAL_VARIANCES:
        return float(np.exp(mean)), _EQUAL_VARIANCES
    # trigamma(x) is above 1/x², and near 1/x where x is large.
    half = scipy.optimize.brentq(lambda x: float(scipy.special.polygamma(1, x)) - excess,
                                 excess ** -0.5, _EQUAL_VARIANCES, xtol=1e-300, rtol=1e-14)
    return float(np.exp(mean + scipy.special.digamma(half) - np.log(half))), 2 * half


@dataclass(frozen=True)
class RandomEffects:
    """A coefficient over n units."""

    pooled: PooledCoefficient  # Mean and spread of the population
    # estimates, std: The units' own estimates and their standard deviations, (n,)
    estimates: np.ndarray
    std: np.ndarray
    is_far_out: np.ndarray  # Units that are not of this population, (n,) bool. They do not count.

    def shrunken(self) -> tuple[np.ndarray, np.ndarray]:
        """Return estimates of the units that use the population, and their std, (n,) each."""
        precision = 1 / np.maximum(self.std, np.finfo(float).tiny) ** 2
        prior2 = max(self.pooled.spread, np.finfo(float).tiny) ** 2
        share = 1 / (1 + precision * prior2)
        value = share * self.pooled.mean + (1 - share) * self.estimates
        std = np.sqrt((1 - share) * self.std ** 2 + (share * self.pooled.mean_std) ** 2)
        return (np.where(self.is_far_out, self.estimates, value),
                np.where(self.is_far_out, self.std, std))

    def distances(self) -> np.ndarray:
        """Return the distances of the units from the mean, in standard deviations, (n,)."""
        pooled = self.pooled
        return (self.estimates - pooled.mean) / np.sqrt(
            pooled.spread ** 2 + pooled.mean_std ** 2 + self.std ** 2)


def random_effects(estimates: np.ndarray, std: np.ndarray, tests: int | None = None
                   ) -> RandomEffects:
    """
    Estimate mean and spread of a population, without the units that are not of it.

    estimates: estimates of at least `MIN_UNITS` units, (n,); std: their standard deviations, (n,).
    """
    chance = _OUTLIER_CHANCE / (2 * (tests or len(estimates)))
    deviation = np.abs(estimates - np.median(estimates))
    scale = MAD_TO_STD * np.median(deviation)
    kept = _largest_dropped(deviation / np.hypot(max(scale, np.finfo(float).tiny), std), _FAR_MADS)
    for _ in range(_MAX_ROUNDS):
        population = _of_units(estimates, std, kept)
        limit = -float(scipy.special.stdtrit(kept.sum() - 2, chance))
        now = _largest_dropped(np.abs(population.distances()), limit)
        if np.array_equal(now, kept):
            break
        kept = now
    return population


def _largest_dropped(distance: np.ndarray, limit: float) -> np.ndarray:
    """Mark the units within a limit, (n,) bool; of too many others, the nearest count, too."""
    count = len(distance)
    limit_count = min(int(_MAX_OUTLIERS * count), count - MIN_UNITS)
    farthest = np.argsort(-distance)[:limit_count]
    kept = np.ones(count, bool)
    kept[farthest[distance[farthest] > limit]] = False
    return kept


def _of_units(estimates: np.ndarray, std: np.ndarray, kept: np.ndarray) -> RandomEffects:
    """Return the population of the units that count."""
    y, variance = estimates[kept], std[kept] ** 2
    unit = max(float(np.ptp(y)), float(std[kept].max()), np.finfo(float).tiny)
    y, variance = (y - y.mean()) / unit, variance / unit ** 2
    spread2, low, high = _spreads2(y, variance)
    mean, _ = weighted_mean(y, variance, spread2)
    mean_variance, prediction_variance = _variances(y, variance, mean)
    pooled = PooledCoefficient(
        mean=float(estimates[kept].mean() + unit * mean), mean_std=unit * mean_variance ** 0.5,
        spread=unit * spread2 ** 0.5, spread_low=unit * low ** 0.5,
        spread_high=unit * high ** 0.5, prediction_std=unit * prediction_variance ** 0.5,
        units=int(kept.sum()))
    return RandomEffects(pooled, estimates, std, is_far_out=~kept)


def _variances(y: np.ndarray, variance: np.ndarray, mean: float) -> tuple[float, float]:
    """Return the variances of mean and of a further unit, over all spreads."""
    scale = float(np.sqrt(np.var(y) + variance.mean()))
    if scale == 0:
        return 0.0, 0.0
    spread2 = (scale * _GRID / (1 - _GRID)) ** 2
    weight = 1 / (variance + spread2[:, None])
    total = weight.sum(axis=1)
    means = weight @ y / total
    squares = (weight * (y - means[:, None]) ** 2).sum(axis=1)
    log_density = 0.5 * (np.log(weight).sum(axis=1) - np.log(total) - squares) \
        - 2 * np.log1p(-_GRID)
    density = np.exp(log_density - log_density.max())
    density /= density.sum()
    mean_variance = float(density @ (1 / total + (means - mean) ** 2))
    return mean_variance, mean_variance + float(density @ spread2)


def weighted_mean(y: np.ndarray, variance: np.ndarray, spread2: float) -> tuple[float, float]:
    """
    Return the mean of a population for a given spread.

    y: estimates, (n,); variance: their own variances, (n,).
    """
    weight = 1 / (variance + spread2)
    total = float(weight.sum())
    return float(weight @ y) / total, 1 / total


def _spreads2(y: np.ndarray, variance: np.ndarray) -> list[float]:
    """
    Return the variance between units, and the ends of its 90 % interval.

    Each is the one at which the weighted squares about the mean have a value: that which they are
    expected to have, or a quantile of their χ² distribution; 0 where they are below it everywhere.
    """
    def squares(spread2: float) -> float:
        mean, _ = weighted_mean(y, variance, spread2)
        return float(np.sum((y - mean) ** 2 / (variance + spread2)))

    floor, freedom, spreads2 = 1e-12 * float(np.var(y) + variance.mean()), len(y) - 1, []
    for target in (freedom, *scipy.special.chdtri(freedom, [0.05, 0.95])):
        # No weight is above 1/spread2, so that the squares are below the target at the high end.
        high = floor + len(y) * float(np.var(y)) / target
        is_below = floor == 0 or squares(floor) <= target
        spreads2.append(0.0 if is_below else float(scipy.optimize.brentq(
            lambda spread2, target=target: squares(spread2) - target, floor, high,
            rtol=1e-12, xtol=1e-300)))
    return spreads2


class BadBatch(NamedTuple):
    """Units with a serial number `prefix`…, and how far their mean is above that of the others."""

    prefix: str
    members: np.ndarray
    difference: float
    low: float
    high: float


def by_prefix(names: Sequence[str]) -> dict[str, np.ndarray]:
    """Return the groups whose names begin alike, (m,) bool each, by the shortest beginning."""
    counts = Counter(name[:length] for name in names for length in range(1, len(name) + 1))
    groups: dict[bytes, tuple[str, np.ndarray]] = {}
    for prefix in sorted(counts, key=len):
        if MIN_GROUP <= counts[prefix] < len(names):
            members = np.array([name.startswith(prefix) for name in names])
            groups.setdefault(members.tobytes(), (prefix, members))
    return dict(groups.values())


def bad_batch(serials: Sequence[str], level: np.ndarray, tolerance: float, tests: int
              ) -> BadBatch | None:
    """
    Return the most certain batch whose level differs by more than a tolerance.

    serials, level: serial number and level of each unit, (m,).
    """
    # The larger part of a fleet is what the others are compared with.
    groups = {prefix: members for prefix, members in by_prefix(serials).items()
              if members.sum() <= len(serials) / 2}
    best, lowest = None, CHANCE / (max(len(groups), 1) * tests)
    for prefix, members in groups.items():
        test = scipy.stats.ttest_ind(level[members], level[~members], equal_var=False)
        difference = float(level[members].mean() - level[~members].mean())
        if test.pvalue < lowest and abs(difference) > tolerance:
            lowest = float(test.pvalue)
            best = BadBatch(prefix, members, difference,
                            *map(float, test.confidence_interval(0.9)))
    return best
