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

"""Shares and statistics with their intervals, and the curve of detection against strength."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import math
from typing import Any

import numpy as np
import scipy

LEVEL = 0.9
"""Probability of all intervals."""
RANK_BINS = 10
"""Number of bins of a rank histogram; chosen: some ten ranks fall into each."""
_RESAMPLES = 1000
"""Number of bootstrap samples; chosen."""


def share(hits: Sequence[bool] | np.ndarray) -> dict[str, Any]:
    """Return the share of hits with Wilson's interval; None without trials."""
    count, true = len(hits), int(np.sum(hits))
    if not count:
        return {'value': None, 'ci': None, 'count': 0}
    ci = scipy.stats.binomtest(true, count).proportion_ci(LEVEL, 'wilson')
    return {'value': true / count, 'ci': [float(ci.low), float(ci.high)], 'count': count}


def resampled(rows: Sequence[Any], statistic: Callable[[list[Any]], float]) -> dict[str, Any]:
    """
    Return a statistic of rows with its interval over resampled rows.

    Parameters
    ----------
    rows
        One for each trial.
    statistic
        Function of rows.

    Returns
    -------
    dict
        `value`, `ci` and `count`.

    """
    if not len(rows):
        return {'value': None, 'ci': None, 'count': 0}
    rng = np.random.default_rng(0)
    drawn = [statistic([rows[i] for i in rng.integers(len(rows), size=len(rows))])
             for _ in range(_RESAMPLES)]
    low, high = np.nanquantile(drawn, ((1 - LEVEL) / 2, (1 + LEVEL) / 2))
    return {'value': float(statistic(list(rows))), 'ci': [float(low), float(high)],
            'count': len(rows)}


def curve(strength: np.ndarray, detected: np.ndarray, by_chance: float) -> dict[str, Any]:
    """
    Fit detection against the logarithm of strength, and find where it reaches 50 and 90 %.

    Parameters
    ----------
    strength
        Strength in each trial, m/s², (n,).
    detected
        Whether each was detected, (n,).
    by_chance
        Share of false alarms, at which the curve starts.

    Returns
    -------
    dict
        `at_50` and `at_90`: strength and interval, None where the curve stays below; `bins`.

    """
    x, y = np.log(np.maximum(strength, 1e-9)), np.asarray(detected, float)
    if len(x) < 8 or y.all() or not y.any():
        return {'at_50': None, 'at_90': None, 'bins': bins(strength, detected)}
    rng = np.random.default_rng(0)
    fitted = _logistic(x, y, by_chance, [float(q) for q in np.quantile(x, (0.2, 0.5))])
    drawn = []
    for _ in range(200):
        take = rng.integers(len(x), size=len(x))
        drawn.append(_logistic(x[take], y[take], by_chance, fitted[:1]))
    result: dict[str, Any] = {'bins': bins(strength, detected), 'by_chance': by_chance,
                              'middle': fitted[0], 'width': fitted[1], 'missed': fitted[2]}
    for level in (0.5, 0.9):
        value = _reaches(fitted, by_chance, level)
        resampled_levels = [_reaches(fit, by_chance, level) for fit in drawn]
        low, high = np.quantile(resampled_levels, (0.05, 0.95), method='nearest')
        result[f'at_{round(100 * level)}'] = None if math.isinf(value) else {
            'value': value, 'ci': [float(low), None if math.isinf(high) else float(high)]}
    return result


def detection(x: np.ndarray, middle: float, width: float, missed: float,
              by_chance: float) -> np.ndarray:
    """
    Return the fitted probability of detection.

    Parameters
    ----------
    x
        Logarithms of the strength, (n,).
    middle, width, missed
        The fitted curve: its middle, its width, and the share that it never detects.
    by_chance
        Share of false alarms.

    Returns
    -------
    numpy.ndarray
        Probabilities, (n,).

    """
    return by_chance + (1 - by_chance - missed) / (1 + np.exp(-(x - middle) / width))


def _logistic(x: np.ndarray, y: np.ndarray, by_chance: float,
              starts: Sequence[float]) -> tuple[float, float, float]:
    def cost(p: np.ndarray) -> float:
        chance = np.clip(detection(x, p[0], math.exp(p[1]), p[2], by_chance), 1e-6, 1 - 1e-6)
        return float(-np.sum(y * np.log(chance) + (1 - y) * np.log(1 - chance)))

    best = min((scipy.optimize.minimize(
        cost, [middle, math.log(0.5), 0.02], method='L-BFGS-B',
        bounds=[(x.min() - 2, x.max() + 2), (math.log(0.05), math.log(5)), (0, 0.5)])
        for middle in starts), key=lambda fit: fit.fun)
    return float(best.x[0]), math.exp(best.x[1]), float(best.x[2])


def _reaches(fit: tuple[float, float, float], by_chance: float, level: float) -> float:
    middle, width, missed = fit
    part = (level - by_chance) / (1 - by_chance - missed)
    return math.exp(middle + width * math.log(part / (1 - part))) if 0 < part < 1 else math.inf


def bins(strength: np.ndarray, detected: np.ndarray, count: int = 8) -> list[dict[str, Any]]:
    """
    Return the share detected in bins of strength with equal numbers of trials.

    Parameters
    ----------
    strength
        Strength in each trial, m/s², (n,).
    detected
        Whether each was detected, (n,).
    count
        Largest number of bins.

    Returns
    -------
    list of dict
        Strength and share of each bin.

    """
    order = np.argsort(strength)
    return [{'strength': float(np.median(strength[part])), **share(detected[part])}
            for part in np.array_split(order, min(count, max(len(order) // 3, 1))) if len(part)]


def calibration_error(rows: Sequence[tuple[float, bool]]) -> float:
    """Return the mean distance of confidence and share right, over the bins of `reliability`."""
    return sum(row['count'] * abs(row['right'] - row['confidence'])
               for row in reliability(rows)) / max(len(rows), 1)


def reliability(rows: Sequence[tuple[float, bool]]) -> list[dict[str, Any]]:
    """Return the share right in bins of confidence, from pairs (confidence, right)."""
    table = np.asarray(rows, float).reshape(-1, 2)
    edges = np.array([0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 1.0 + 1e-9])
    index = np.digitize(table[:, 0], edges) - 1
    return [{'confidence': float(table[index == k, 0].mean()),
             'right': float(table[index == k, 1].mean()), 'count': int(np.sum(index == k))}
            for k in range(len(edges) - 1) if np.any(index == k)]


def rank_histogram(groups: Sequence[Sequence[float]]) -> dict[str, Any]:
    """
    Return the histogram of ranks, and whether it is uniform.

    Talts and others show how ranks of the truth reveal posteriors that are too narrow (a high
    count at both ends), too wide (in the middle) or biased (at one end) ("Validating Bayesian
    inference algorithms with simulation-based calibration", arXiv:1804.06788, 2018). The ranks of
    one trial are not independent. Each trial therefore has the same weight in the distance of
    Kolmogorov and Smirnov, and the number of trials is its sample size.

    Parameters
    ----------
    groups
        Ranks from 0 to 1 of each trial.

    Returns
    -------
    dict
        `bins`: number of ranks in bins of equal width; `count` of ranks and of `trials`; the
        largest `distance` between the shares and uniform ones, and its `p`, None without ranks.

    """
    groups = [group for group in groups if len(group)]
    ranks = np.concatenate([np.asarray(group, float) for group in groups] or [np.zeros(0)])
    bins = np.histogram(ranks, RANK_BINS, (0, 1))[0].tolist()
    if not len(ranks):
        return {'bins': bins, 'count': 0, 'trials': 0, 'distance': None, 'p': None}
    weights = np.concatenate([np.full(len(group), 1 / len(group) / len(groups))
                              for group in groups])
    order = np.argsort(ranks)
    above = np.cumsum(weights[order])
    distance = max(np.max(above - ranks[order]), np.max(ranks[order] - above + weights[order]))
    return {'bins': bins, 'count': len(ranks), 'trials': len(groups),
            'distance': float(distance), 'p': float(scipy.stats.kstwo.sf(distance, len(groups)))}
