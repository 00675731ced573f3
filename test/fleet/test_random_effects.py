# SPDX-License-Identifier: Apache-2.0
"""Random effects: a published example, a closed form, and how often intervals hold the truth."""

from adxl_ros.fleet.populations import random_effects, weighted_mean
import numpy as np
import pytest

BCG = np.array(
    [
        (4, 119, 11, 128),
        (6, 300, 29, 274),
        (3, 228, 11, 209),
        (62, 13536, 248, 12619),
        (33, 5036, 47, 5761),
        (180, 1361, 372, 1079),
        (8, 2537, 10, 619),
        (505, 87886, 499, 87892),
        (29, 7470, 45, 7232),
        (17, 1699, 65, 1600),
        (186, 50448, 141, 27197),
        (5, 2493, 3, 2338),
        (27, 16886, 29, 17825),
    ],
    float,
)
"""Thirteen trials of the BCG vaccine (Colditz 1994): ill and healthy, with it or not."""


def holds(hits, share):
    """Return whether a share of hits is that of an interval, within three standard deviations."""
    return abs(np.mean(hits) - share) < 3 * np.sqrt(share * (1 - share) / len(hits))


def test_a_published_example():
    """The logarithm of the relative risk is that of DerSimonian and Kacker (2007)."""
    a, b, c, d = BCG.T
    y = np.log(a / (a + b)) - np.log(c / (c + d))
    std = np.sqrt(1 / a - 1 / (a + b) + 1 / c - 1 / (c + d))
    pooled = random_effects(y, std)
    assert pooled.units == 13
    assert (pooled.mean, pooled.spread**2) == pytest.approx((-0.7150, 0.3181), abs=5e-5)
    _, mean_variance = weighted_mean(y, std**2, pooled.spread**2)
    assert mean_variance**0.5 == pytest.approx(0.1809, abs=5e-5)
    # The spread is uncertain, too.
    assert 1 < pooled.mean_std / mean_variance**0.5 < 1.3


def test_the_closed_form_of_equal_errors():
    y = np.array([1.0, 2.0, 4.0, 5.0, 8.0])
    pooled = random_effects(y, np.full(5, 0.5))
    assert pooled.mean == pytest.approx(4.0)
    assert pooled.spread**2 == pytest.approx(np.var(y, ddof=1) - 0.25)
    _, mean_variance = weighted_mean(y, np.full(5, 0.25), pooled.spread**2)
    assert mean_variance == pytest.approx(np.var(y, ddof=1) / 5)


@pytest.mark.parametrize('count', [6, 25, 200])
def test_intervals_hold_the_truth(count):
    rng = np.random.default_rng(count)
    spreads, means, further, false = [], [], [], []
    for _ in range(300):
        std = rng.uniform(0.2, 2.0, count)
        pooled = random_effects(5 + rng.normal(size=count) + std * rng.normal(size=count), std)
        spreads.append(pooled.spread_low <= 1 <= pooled.spread_high)
        means.append(abs(pooled.mean - 5) < 1.645 * pooled.mean_std)
        further.append(abs(5 + rng.normal() - pooled.mean) < 1.645 * pooled.prediction_std)
        false.append(pooled.units < count)
    assert holds(spreads, 0.9)
    # Few units give wider intervals, because their spread is uncertain.
    assert min(np.mean(means), np.mean(further)) > 0.9 - 3 * np.sqrt(0.09 / 300)
    assert count < 200 or (holds(means, 0.9) and holds(further, 0.9))
    assert np.mean(false) < 0.05 + 3 * np.sqrt(0.05 / 300)


def test_a_unit_far_out_does_not_count():
    rng = np.random.default_rng(2)
    y, std = rng.normal(size=60), np.full(60, 0.1)
    y[17] = 12.0
    pooled = random_effects(y, std)
    assert pooled.units == 59
    others = np.delete(y, 17)
    assert pooled.spread == pytest.approx(random_effects(others, std[1:]).spread)
