# SPDX-License-Identifier: Apache-2.0

"""Gauss-Newton iteration with step halving."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np


@dataclass(frozen=True)
class Iterate:
    """A model linearised about values of its coefficients."""

    values: np.ndarray  # Coefficients, (p,)
    step: np.ndarray  # Gauss-Newton step to the optimum of the linearised model, (p,)
    cost: float  # Quantity to minimise, at the values. A constant accepts every step.


State = TypeVar('State', bound=Iterate)


def gauss_newton(
    linearise: Callable[[np.ndarray], State],
    start: np.ndarray,
    has_converged: Callable[[State, State | None, State], bool],
    max_evaluations: int,
    max_halvings: int = 0,
    cost_tolerance: float = 0.0,
) -> State:
    """
    Iterate Gauss-Newton steps until they converge; return the last iterate that was accepted.

    The caller limits the length of a step and keeps values within their bounds, both in
    `linearise`. `scipy.optimize.least_squares` needs residuals with independent errors. Fits of
    this package have correlated errors or maximise an evidence, and stop after few evaluations.

    has_converged: takes the first iterate, the previous one (None at the first) and the present
    one; max_halvings: how often a step is halved that raises the cost by more than
    `cost_tolerance`. Halved steps count as evaluations, too.
    """
    first = present = linearise(start)
    previous = None
    evaluations = 1
    while not has_converged(first, previous, present):
        for halvings in range(max_halvings + 1):
            if evaluations >= max_evaluations:
                return present
            trial = linearise(present.values + 0.5**halvings * present.step)
            evaluations += 1
            # A cost of NaN passes, so that a caller sees it.
            if not trial.cost > present.cost + cost_tolerance:
                break
        else:
            return present
        previous, present = present, trial
    return present
