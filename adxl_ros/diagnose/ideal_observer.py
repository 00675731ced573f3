# SPDX-License-Identifier: Apache-2.0
"""
How surely an ideal observer could have named the effects of a verdict.

It knows the forms of the library and the noise. Of an effect, at its fitted size, a rival leaves
the whitened distance d: another effect in its place, or none, beside which everything is free that
a hypothesis has free. The observer confuses both with the probability Φ(−d/2). It errs no less
often than beside the nearest rival alone, and no more often than beside each of them together.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import replace
from typing import NamedTuple

from adxl_ros.diagnose import evidence
from adxl_ros.diagnose.linear_model import LinearModel
from adxl_ros.diagnose.search import Hypothesis
from adxl_ros.model.sensor import with_neutral
import numpy as np
import scipy


class Surest(NamedTuple):
    """Bounds of the probability with which an ideal observer names the same effects."""

    low: float  # It is right at least so often
    high: float  # Nobody is right more often


def bounds(left_by_rivals: Iterable[float]) -> Surest:
    """Return the bounds by what each rival leaves of an effect: squares, whitened."""
    distances = np.sqrt(np.maximum([*left_by_rivals], 0.0))
    confused = scipy.special.ndtr(-distances / 2)
    return Surest(max(1 - float(confused.sum()), 0.0), 1 - float(confused.max()))


def surest(model: LinearModel, hypothesis: Hypothesis, named: Collection[str]) -> Surest | None:
    """
    Return how surely effects on the mean are named at their fitted sizes; None without any.

    Those that are named beside others which the recordings do not separate are no rivals.
    """
    products = _products(model, hypothesis)
    count = len(hypothesis.effects)
    rivals = {name.effect for name in model.names}.difference(named)
    left = []
    for i in (i for i, effect in enumerate(hypothesis.effects) if effect in named):
        beside = [k for k in range(count) if k != i]
        for rival in ('', *rivals):
            present = {rival, *(hypothesis.effects[k] for k in beside)}
            chosen = [k for k, v in enumerate(model.variants) if v.effect in present]
            free = [
                count + k
                for k, name in enumerate(model.names)
                if name.effect in present or k in model.nuisance_ids
            ]
            # The sizes of the other effects are open, too.
            prior_std = np.append(np.ones(count), model.prior(chosen))
            left.append(evidence.left_beside(products, [*beside, *free], prior_std)[i])
    return bounds(left) if left else None


def _products(model: LinearModel, hypothesis: Hypothesis) -> np.ndarray:
    """Return products of what each effect changes, then of all columns, in units of the noise."""
    effects, fit = hypothesis.effects, hypothesis.fit
    file_values = with_neutral(model.baseline, effects).values
    products = np.zeros((len(effects) + len(model.names),) * 2)
    for number, (comparison, axis) in enumerate(model.places):
        sensor = hypothesis.sensor
        rows = []
        for effect in effects:
            without = replace(sensor, values={**sensor.values, effect: file_values[effect]})
            change_v = comparison.simulated_v(sensor) - comparison.simulated_v(without)
            rows.append(change_v[:, axis])
        columns = model.columns[number]
        whitener = hypothesis.linearised.filters[number][fit.filter_indices[number]]
        design = np.array([*rows, *columns.values()]).T
        white = next(evidence.white_rows(design, comparison.used, [whitener]))
        ids = [*range(len(effects)), *(len(effects) + k for k in columns)]
        products[np.ix_(ids, ids)] += white @ white.T / fit.innovation_variance_v2[number]
    return products
