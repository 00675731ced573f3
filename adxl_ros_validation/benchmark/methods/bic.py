# SPDX-License-Identifier: Apache-2.0
"""
The set of effects of the library with the smallest Bayesian information criterion.

Noise is independent from sample to sample, effects are linear in their parameters, and sets grow
one effect at a time, to three at most.
"""

import math

from adxl_ros.model.effects import library
from adxl_ros.model.effects.base import ActsOn, Coefficient
from adxl_ros_validation.benchmark.case import Case, Finding, linear_fit, LinearFit
import numpy as np

_MOST = 3
"""Largest number of effects in a set; chosen: run time."""


def _criterion(case: Case, fit: LinearFit) -> float:
    """Return the Bayesian information criterion of a fit."""
    return fit.samples * math.log(fit.squares / fit.samples) + len(fit.changes) * math.log(
        fit.samples
    )


def method(case: Case) -> Finding:
    """Add the effect that lowers the criterion most, until none does."""
    names = [name for name, effect in library().items() if effect.acts_on is ActsOn.MEAN]
    columns: dict[str, dict[Coefficient, np.ndarray]] = {}
    for coefficient, change in case.tangents(names).items():
        if np.isfinite(change).all() and np.any(change[case.known]):
            columns.setdefault(coefficient.effect, {})[coefficient] = change
    rest = case.residual_mps2()[case.known]
    found: dict[Coefficient, np.ndarray] = {}
    fit = LinearFit({}, {}, float(np.sum(rest**2)), rest.size)
    best, chances = _criterion(case, fit), np.zeros(1)
    for _ in range(_MOST):
        others = [name for name in columns if name not in {each.effect for each in found}]
        fits = [linear_fit(case, found | columns[name]) for name in others]
        criteria = np.array([_criterion(case, each) for each in fits])
        chosen = int(np.argmin(criteria))
        if criteria[chosen] >= best:
            break
        chances = np.exp(-(criteria - criteria[chosen]) / 2)
        best, fit, found = criteria[chosen], fits[chosen], found | columns[others[chosen]]
    sensor = case.with_changes(fit.changes)
    causes = frozenset(name.effect for name in found)
    return Finding(causes, float(1 / max(chances.sum(), 1.0)), sensor)
