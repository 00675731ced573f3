# SPDX-License-Identifier: Apache-2.0

"""Gauss-Newton iteration with step halving, which reports whether it has converged."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np


@dataclass(frozen=True)
class Iterate:
    """A model linearised about values of its coefficients."""

    values: np.ndarray  # Coefficients, (p,)
    step: np.ndarray  # Gauss-Newton step to the optimum of the linearised model, (p,)
    cost: float  # Quantity to minimise, at the values. A constant accepts every step.


State = TypeVar('State', bound=Iterate)
Trial = TypeVar('Trial')


@dataclass(frozen=True)
class Solution(Generic[State]):
    """Result of a Gauss-Newton iteration."""

    last: State  # The last iterate that was accepted
    # False if the iteration ended by its count of evaluations, or if no share of a step lowered
    # the cost
    converged: bool
    evaluations: int  # How often the model was linearised


def gauss_newton(linearise: Callable[[np.ndarray], State], start: np.ndarray,
                 has_converged: Callable[[State, State | None, State], bool],
                 max_evaluations: int, max_halvings: int = 0,
                 cost_tolerance: float = 0.0) -> Solution[State]:
    """
    Iterate Gauss-Newton steps until they converge.

    The caller limits the length of a step and keeps values within their bounds, both in
    `linearise`. `scipy.optimize.least_squares` needs residuals with independent errors. Fits of
    this package have correlated errors or maximise an evidence, and stop after few evaluations.

    has_converged: takes the first iterate, the previous one (None at the first) and the present
    one; max_halvings: how often a step is halved that raises the cost by more than
    `cost_tolerance`. Halved steps count as evaluations, too.
    """
    first = present = linearise(start)
    previous, evaluations = None, 1
    while not has_converged(first, previous, present):
        halvings = min(max_halvings, max_evaluations - evaluations - 1)
        if halvings < 0:
            return Solution(present, False, evaluations)

        def attempt(share: float, origin: State = present) -> State:
            return linearise(origin.values + share * origin.step)

        def lowers_cost(trial: State, highest: float = present.cost + cost_tolerance) -> bool:
            # A cost of NaN passes, so that a caller sees it.
            return not trial.cost > highest

        trial, accepted, trials = halve_until(attempt, lowers_cost, halvings)
        evaluations += trials
        if not accepted:
            return Solution(present, False, evaluations)
        previous, present = present, trial
    return Solution(present, True, evaluations)


def halve_until(attempt: Callable[[float], Trial], accept: Callable[[Trial], bool],
                max_halvings: int) -> tuple[Trial, bool, int]:
    """Attempt a share of 1, 1/2, 1/4 ...; return the result, if it is accepted, and the count."""
    share = 1.0
    result = attempt(share)
    for count in range(1, max_halvings + 1):
        if accept(result):
            return result, True, count
        share /= 2
        result = attempt(share)
    return result, accept(result), max_halvings + 1
