# SPDX-License-Identifier: Apache-2.0

"""What flexible functions take up, and drifts, on figures with closed forms."""

from adxl_ros.diagnose.random_drift import between_rests_p, increments_p
from adxl_ros.diagnose.remainder import FunctionProducts, largest_evidence_levels
import numpy as np
import pytest

RATE_HZ = 50.0
COUNT = 20_000
RESTING = np.arange(COUNT) // 1000 % 4 == 0  # 20 s of 80 s


def levels(products, dimensions, variance=1.0):
    return largest_evidence_levels(products, np.array(dimensions), variance)


@pytest.mark.parametrize('value', [0.5, 1.0, 3.0])
def test_the_level_of_one_function_is_its_square_without_the_error(value):
    """The evidence of a coefficient b with error s is largest at a prior variance of b² − s²."""
    squares = 100.0
    products = FunctionProducts(np.array([[squares]]), np.array([squares * value]))
    assert levels(products, ['force']) == pytest.approx([value**2 - 1 / squares], rel=1e-4)


def test_the_functions_of_a_dimension_share_a_level():
    squares = np.array([100.0, 100.0, 100.0])
    values = np.array([1.0, 0.0, 0.02])
    products = FunctionProducts(np.diag(squares), squares * values)
    first, second, other = levels(products, ['force', 'force', 'time_s'])
    assert first == second == pytest.approx(0.5 - 0.01, rel=1e-3)
    assert other < 0.005


def test_functions_lower_the_squares_by_what_they_explain():
    """The right coefficients explain all of r = F·b; twice of them nothing."""
    rng = np.random.default_rng(1)
    functions, values = rng.normal(size=(50, 3)), np.array([1.0, -2.0, 0.5])
    residual = functions @ values
    products = FunctionProducts(functions.T @ functions, functions.T @ residual)
    assert products.decrease(values) == pytest.approx(residual @ residual)
    assert products.decrease(2 * values) == pytest.approx(0.0, abs=1e-9)
    by_part = FunctionProducts(
        np.array([products.functions, products.functions]), np.array([products.residual] * 2)
    )
    assert by_part.decrease(values) == pytest.approx([residual @ residual] * 2)


def walk(seed):
    rng = np.random.default_rng(seed)
    return np.cumsum(0.05 * rng.normal(size=COUNT)) + rng.normal(size=COUNT)


def test_the_increments_of_a_walk_are_gaussian():
    """At most about one of ten walks has a probability below 0.1."""
    used = np.ones(COUNT, bool)
    p = [increments_p(walk(seed), used, RATE_HZ, RESTING) for seed in range(20)]
    assert np.mean(np.array(p) < 0.1) <= 0.25
    assert min(p) > 0.001


def test_a_walk_may_change_its_power_slowly():
    power = np.exp(np.interp(np.arange(COUNT), np.linspace(0, COUNT, 6), [-1, 1, 0, 1, -1, 0]))
    used = np.ones(COUNT, bool)
    for seed in range(5):
        rng = np.random.default_rng(seed)
        uneven = np.cumsum(0.05 * power * rng.normal(size=COUNT)) + 0.3 * rng.normal(size=COUNT)
        assert increments_p(uneven, used, RATE_HZ, RESTING) > 0.001


def test_jumps_and_lines_are_no_walk():
    used = np.ones(COUNT, bool)
    noise = np.random.default_rng(1).normal(size=COUNT)
    jumps = 4.0 * (np.arange(COUNT) // 5000 % 2)
    line = 4.0 * np.sin(2 * np.pi * np.arange(COUNT) / 2000)
    assert increments_p(noise + jumps, used, RATE_HZ, RESTING) < 0.001
    assert increments_p(noise + line, used, RATE_HZ, RESTING) < 0.001


def test_what_drifts_in_motion_alone_is_no_drift():
    noise = np.random.default_rng(1).normal(size=COUNT)
    moved = np.where(RESTING, 0.0, walk(1) - walk(1).mean())
    assert increments_p(noise + moved, np.ones(COUNT, bool), RATE_HZ, RESTING) < 0.001


def test_what_a_motor_does_is_no_drift_that_hides_in_the_noise():
    """It shakes as fast as it turns, which averages out over seconds."""
    used = np.ones(COUNT, bool)
    noise = np.random.default_rng(1).normal(size=COUNT)
    turns = np.cumsum(2 + np.sin(np.arange(COUNT) / 300)) / RATE_HZ
    shakes = np.where(RESTING, 0.0, 0.4 * np.sin(2 * np.pi * turns))
    assert increments_p(noise, used, RATE_HZ, RESTING) > 0.001
    assert increments_p(noise + shakes, used, RATE_HZ, RESTING) < 0.001


def test_too_few_increments_say_nothing():
    assert increments_p(np.arange(10.0), np.ones(10, bool), RATE_HZ, np.zeros(10, bool)) == 1.0


def test_a_drift_goes_on_within_rests():
    """Where poses are stated at rests alone, errors of a stand change in moves alone."""
    rng = np.random.default_rng(5)
    count = 30 * 600
    used = np.arange(count) % 600 < 400
    walk = np.cumsum(rng.normal(0, 0.01, count))
    of_poses = np.repeat(rng.normal(0, 1.0, 30), 600)
    noise = rng.normal(0, 0.1, count)
    assert between_rests_p(walk + noise, used, 100.0) > 0.01
    assert between_rests_p(of_poses + noise, used, 100.0) < 1e-4
    assert between_rests_p(of_poses + noise, np.ones(count, bool), 100.0) == 1.0
