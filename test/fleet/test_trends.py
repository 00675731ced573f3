# SPDX-License-Identifier: Apache-2.0
"""Slopes of units: least squares, the share of false claims, weak drifts, and recalibrations."""

from adxl_ros.fleet.trends import claims, fit_trends, interval_factor, outliers, Recordings
import numpy as np
import pytest
from scipy.stats import false_discovery_control, linregress

pytestmark = pytest.mark.long

FLEETS = 40


def fleet(
    rng,
    counts=(5, 60),
    units=200,
    scatter=1.0,
    stated=0.3,
    correlation=0.0,
    step=0.0,
    unequal=0.0,
    drift=None,
):
    """Draw recordings of units over a year; `step` is that of two calibrations of each unit."""
    parts, periods = [], 0
    for unit in range(units):
        n = int(rng.integers(*counts))
        time = np.sort(rng.uniform(size=n))
        noise = rng.normal(size=n)
        for i in range(1, n):
            noise[i] = correlation * noise[i - 1] + np.sqrt(1 - correlation**2) * noise[i]
        period = np.searchsorted(np.sort(rng.uniform(size=2)) if step else [], time)
        std = stated * rng.lognormal(0, 0.3, n)
        value = (
            rng.normal(0, 5)
            + scatter * rng.lognormal(0, unequal) * noise
            + step * rng.normal(size=3)[period]
            + std * rng.normal(size=n)
        )
        value += 0.0 if drift is None else drift[unit] * time
        numbers = np.unique(period, return_inverse=True)[1]
        parts.append((np.full(n, unit), periods + numbers, time, value, std))
        periods += numbers[-1] + 1
    return Recordings(*map(np.concatenate, zip(*parts)))


def test_one_unit_has_the_slope_of_least_squares():
    """Without others and without stated errors, line and error are those of a regression."""
    rng = np.random.default_rng(0)
    time = np.sort(rng.uniform(size=30))
    value = 3 + 2 * time + rng.normal(size=30)
    zeros = np.zeros(30, int)
    trends = fit_trends(Recordings(zeros, zeros, time, value, np.zeros(30)))
    expected = linregress(time, value)
    widening = trends.scatter.widening
    assert trends.slope[0] == pytest.approx(expected.slope)
    assert trends.slope_std[0] == pytest.approx(
        expected.stderr * np.sqrt(widening * 28 / (30 - 2 * widening)), rel=1e-3
    )
    assert trends.level[0] == pytest.approx(value.mean())


@pytest.mark.parametrize(
    'changes',
    [
        {},
        {'counts': (3, 6)},
        {'counts': (60, 150), 'correlation': 0.8},
        {'step': 3.0},
        {'unequal': 0.5},
        {'units': 8},
    ],
    ids=str,
)
def test_the_share_of_false_claims(changes):
    """Among the claimed slopes 5 % or less are false, whatever the scatter is like."""
    rng = np.random.default_rng(1)
    shares, hits, inside = [], [], []
    for _ in range(FLEETS):
        units = changes.get('units', 200)
        drift = np.where(np.arange(units) < max(units // 10, 1), 6.0, 0.0)
        trends = fit_trends(fleet(rng, drift=drift, **changes))
        named = claims(trends.p_values)
        shares.append((named & (drift == 0)).sum() / max(named.sum(), 1))
        hits.append(named[drift > 0].mean())
        half = trends.slope_std * interval_factor(trends.freedom, np.zeros(units, bool))
        inside.append(np.nanmean(np.abs(trends.slope - drift) < half))
    error = np.std(shares) / np.sqrt(FLEETS)
    assert np.mean(shares) < 0.05 + 3 * max(error, 0.002)
    assert np.mean(inside) > 0.9 - 3 * np.std(inside) / np.sqrt(FLEETS) - 0.005
    assert np.mean(hits) > 0.2


def test_a_recalibration_is_no_drift():
    rng = np.random.default_rng(4)
    drift = np.where(np.arange(60) == 7, 8.0, 0.0)
    recordings = fleet(rng, counts=(40, 60), units=60, step=5.0, drift=drift)
    trends = fit_trends(recordings)
    assert np.flatnonzero(claims(trends.p_values)).tolist() == [7]
    assert trends.scatter.calibration == pytest.approx(5.0, rel=0.3)
    # A line through all recordings of a unit would call most steps a drift.
    lines = [
        linregress(recordings.time[part], recordings.value[part]).pvalue
        for part in (recordings.sensor == unit for unit in range(60))
    ]
    assert (false_discovery_control(lines) < 0.05).sum() > 30


@pytest.mark.parametrize('changes', [{}, {'counts': (5, 8)}, {'unequal': 0.7}], ids=str)
def test_the_rate_of_false_outliers(changes):
    rng = np.random.default_rng(6)
    false = []
    for _ in range(100):
        recordings = fleet(rng, **changes)
        false.append(outliers(recordings, len(recordings.value))[1].any())
    assert np.mean(false) < 0.05 + 3 * np.sqrt(0.05 * 0.95 / 100)
