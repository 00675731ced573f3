# SPDX-License-Identifier: Apache-2.0

"""Gauss-Newton: certified results of NIST, convergence, steps that would raise the cost."""

from collections.abc import Callable

from adxl_ros.model.gauss_newton import gauss_newton, Iterate
import numpy as np
import pytest

# NIST Statistical Reference Datasets, Misra1a: y = b1·(1 − exp(−b2·x)), lower difficulty.
MISRA_X = np.array(
    [
        77.6,
        114.9,
        141.1,
        190.8,
        239.9,
        289.0,
        332.8,
        378.4,
        434.8,
        477.3,
        536.8,
        593.1,
        689.1,
        760.0,
    ]
)
MISRA_Y = np.array(
    [
        10.07,
        14.73,
        17.94,
        23.93,
        29.61,
        35.18,
        40.02,
        44.82,
        50.76,
        55.05,
        61.01,
        66.40,
        75.47,
        81.78,
    ]
)
MISRA_CERTIFIED = (2.3894212918e2, 5.5015643181e-4)
MISRA_STARTS = ([500.0, 1e-4], [250.0, 5e-4])


def misra(values: np.ndarray) -> Iterate:
    decay = np.exp(-values[1] * MISRA_X)
    residual = MISRA_Y - values[0] * (1 - decay)
    jacobian = np.column_stack([1 - decay, values[0] * MISRA_X * decay])
    step = np.linalg.lstsq(jacobian, residual, rcond=None)[0]
    return Iterate(values, step, float(np.sum(residual**2)))


def is_short(_: Iterate, __: Iterate | None, present: Iterate) -> bool:
    return bool(np.all(np.abs(present.step) <= 1e-10 * np.abs(present.values)))


def solve(
    linearise: Callable[[np.ndarray], Iterate],
    start: list[float],
    evaluations: int,
    halvings: int = 0,
) -> Iterate:
    # At the end the cost changes by rounding errors only, and may rise by these.
    return gauss_newton(linearise, np.array(start), is_short, evaluations, halvings, 1e-12)


@pytest.mark.parametrize('start', MISRA_STARTS)
def test_certified_values(start):
    solution = solve(misra, start, 50, 8)
    np.testing.assert_allclose(solution.values, MISRA_CERTIFIED, rtol=1e-9)
    assert solution.cost == pytest.approx(1.2455138894e-1, rel=1e-9)


def test_it_stays_where_no_share_of_a_step_lowers_the_cost():
    tried = []

    def uphill(values: np.ndarray) -> Iterate:
        tried.append(float(values[0]))
        return Iterate(values, np.ones(1), float(values[0]))

    assert solve(uphill, [1.0], 50, 3).values == [1.0]
    assert tried == [1.0, 2.0, 1.5, 1.25, 1.125]
