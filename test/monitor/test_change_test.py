# SPDX-License-Identifier: Apache-2.0

"""The sequential test: its rate of false alarms on drifting noise, its delay, and its restarts."""

from __future__ import annotations

from adxl_ros.monitor.changes import Change, ChangeTest
import numpy as np
import pytest
from scipy.stats import poisson
from still_noise import flicker

DAY_S = 86400


def series(kind: str, blocks: int, channels: int, seed: int) -> np.ndarray:
    """Return means of seconds, µg, (blocks, channels), of an ADXL203 with drift of a kind."""
    rng = np.random.default_rng(seed)
    values = 78 * rng.standard_normal((blocks, channels))
    if kind in ('flicker', 'all'):
        values += np.column_stack([177 * flicker(rng, blocks) for _ in range(channels)])
    if kind in ('walk', 'all'):
        values += np.cumsum(rng.standard_normal((blocks, channels)), axis=0)
    if kind == 'all':
        values += 300 * np.sin(
            2 * np.pi * (np.arange(blocks)[:, None] / DAY_S + rng.random(channels))
        )
    return values


def run(test: ChangeTest, values: np.ndarray, moves: bool = False) -> list[tuple[int, Change]]:
    """Return the changes that a test reports, each with the number of its block."""
    return [(i, change) for i, row in enumerate(values) for change in test.add(row, moves)]


@pytest.mark.long
@pytest.mark.parametrize('kind', ['white', 'all'])
def test_false_alarms_are_no_more_than_stated(kind: str) -> None:
    """Ten sensors of four series for six hours, with one false alarm a day each."""
    hours, sensors, rate = 6, 10, 1.0
    test = ChangeTest(4 * sensors, rate * sensors)
    alarms = run(test, series(kind, hours * 3600, 4 * sensors, 3))
    assert len(alarms) <= poisson.isf(1e-3, rate * sensors * hours / 24)


@pytest.mark.parametrize(
    'kind, size, delay_s',
    [('white', 1000.0, 2), ('white', 300.0, 20), ('white', 100.0, 200), ('all', 3000.0, 5)],
)
def test_a_step_is_found_in_time(kind: str, size: float, delay_s: int) -> None:
    test = ChangeTest(6, 1 / 30)
    values = series(kind, 5400, 6, 5)
    values[3600:, 2] += size
    (block, change), *others = run(test, values)
    assert not others
    assert (change.channel, 3600 <= block < 3600 + delay_s) == (2, True)
    assert change.size == pytest.approx(size, abs=500 if kind == 'all' else 150)
    assert abs(block + 1 - change.blocks - 3600) < 0.3 * delay_s + 2


def test_motion_is_compared_with_motion() -> None:
    """A first move with errors of its own is no change of the sensor."""
    rng = np.random.default_rng(1)
    test = ChangeTest(1, 1 / 30)
    assert not run(test, rng.standard_normal((3000, 1)))
    assert not run(test, 30 * rng.standard_normal((40, 1)), moves=True)
    assert not run(test, rng.standard_normal((3000, 1)))


WALK, DRIFT = 30.0, 300.0  # Of a healthy ADXL203, µg/√s and µg
BLOCK_S = 10.0
HOUR = 360  # Blocks of an hour


def slow_series(blocks: int, channels: int, seed: int) -> np.ndarray:
    """Return means of 10 s, µg, (blocks, channels): white noise, flicker, walk and daily swing."""
    rng = np.random.default_rng(seed)
    values = 78 / np.sqrt(BLOCK_S) * rng.standard_normal((blocks, channels))
    values += np.column_stack([100 * flicker(rng, blocks) for _ in range(channels)])
    values += np.sqrt(BLOCK_S) * np.cumsum(rng.standard_normal((blocks, channels)), axis=0)
    day = np.arange(blocks)[:, None] / (24 * HOUR)
    return values + 300 * np.sin(2 * np.pi * (day + rng.random(channels)))


@pytest.mark.long
def test_false_alarms_of_a_test_that_knows_slow_ramps() -> None:
    """Ten sensors for two days, with one false alarm a day each."""
    sensors, rate, days = 10, 1.0, 2
    test = ChangeTest(3 * sensors, rate * sensors, BLOCK_S, walks=(WALK,), drifts=(DRIFT,))
    alarms = run(test, slow_series(days * 24 * HOUR, 3 * sensors, 7))
    assert len(alarms) <= poisson.isf(1e-3, rate * sensors * days)


@pytest.mark.parametrize('mg_per_hour', [1.0, 4.0])
def test_a_ramp_that_takes_hours_is_found(mg_per_hour: float) -> None:
    """It goes on from the first second, so that nothing else is usual."""
    test = ChangeTest(2, 1 / 30, BLOCK_S, walks=(WALK,), drifts=(DRIFT,))
    values = slow_series(8 * HOUR, 2, 4)
    values[:, 1] += np.arange(8 * HOUR) * mg_per_hour * 1e3 / HOUR
    found = run(test, values)
    assert {change.channel for _, change in found} == {1}
    assert all(change.size > 1000 for _, change in found)
