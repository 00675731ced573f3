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

"""
Tests of each effect alone: gain of evidence, its probability without a gap, and visibility.

They use the linear model at the baseline, with the noise of the null hypothesis. A chi-square test
does not hold for the best of many effects, or where a shape parameter is undefined without the
effect. A parametric bootstrap gives the probability instead, from the largest gain of all
candidates in drawn recordings without a gap. In a linear model, drawing the products of columns
and noise is enough.
"""

from __future__ import annotations

from dataclasses import dataclass

from adxl_ros.diagnose.evidence import fit_columns
from adxl_ros.diagnose.linear_model import LinearModel
import numpy as np

_DRAWS = 2000
"""Number of drawn recordings. Chosen: probabilities down to 0.0005."""


@dataclass(frozen=True)
class SingleEffectTest:
    """
    One effect alone.

    Attributes
    ----------
    log_bayes_factor
        Gain of the log evidence over no gap, on the linear model.
    p
        Probability that any effect gains as much without a gap.
    visibility
        Share of the effect's whitened signal that nuisance parameters cannot imitate, 0 to 1.

    """

    log_bayes_factor: float
    p: float
    visibility: float


def single_effect_tests(linear_model: LinearModel, seed: int) -> dict[str, SingleEffectTest]:
    """
    Test every effect that has something to act on in these recordings.

    Parameters
    ----------
    linear_model
        The recordings and their sensitivities at the baseline.
    seed
        Seed of the draws.

    Returns
    -------
    dict
        Tests by the name of the effect.

    """
    gram, marginal, product = _marginal_products(linear_model)
    std = linear_model.prior_std
    eigenvalues, vectors = np.linalg.eigh(marginal * np.outer(std, std))
    drawn = vectors * np.sqrt(np.maximum(eigenvalues, 0.0)) @ np.random.default_rng(
        seed).standard_normal((len(std), _DRAWS))
    gains: dict[str, float] = {}
    visibility: dict[str, float] = {}
    largest = np.full(_DRAWS, -np.inf)
    for variant, ids in zip(linear_model.variants, linear_model.column_ids):
        prior_std = std[ids]
        factor = np.linalg.cholesky(marginal[np.ix_(ids, ids)] * np.outer(prior_std, prior_std)
                                    + np.eye(len(ids)))
        half_log_det = float(np.log(np.diag(factor)).sum())
        whitened = np.linalg.solve(factor, np.column_stack([prior_std * product[ids],
                                                            drawn[ids]]))
        gain = 0.5 * (whitened ** 2).sum(axis=0) - half_log_det
        largest = np.maximum(largest, gain[1:])
        name = variant.effect
        gains[name] = max(gains.get(name, -np.inf), float(gain[0]))
        # An effect that changes no sample cannot be seen.
        square = float(prior_std ** 2 @ np.diag(gram)[ids])
        share = float(prior_std ** 2 @ np.diag(marginal)[ids]) / square if square else 0.0
        visibility[name] = max(visibility.get(name, 0.0), float(np.clip(share, 0.0, 1.0)))
    return {name: SingleEffectTest(gain, float((1 + np.sum(largest >= gain)) / (1 + _DRAWS)),
                                   visibility[name])
            for name, gain in gains.items()}


def _marginal_products(linear_model: LinearModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Return products of the whitened columns with the noise of the null hypothesis.

    Return the Gram matrix of the columns, this matrix with the nuisance parameters eliminated, and
    the products of the columns and the residual with the nuisance parameters eliminated.
    """
    prior_std = linear_model.prior(())
    nuisances = np.array(linear_model.nuisance_ids())
    null_fit = fit_columns(linear_model.channels, linear_model.nuisance_ids(), prior_std)
    count = len(linear_model.names)
    gram, product = np.zeros((count, count)), np.zeros(count)
    for c, f, variance in zip(linear_model.channels, null_fit.filter_indices,
                              null_fit.innovation_variance_v2):
        total = c.total_grams[f] / variance
        gram[np.ix_(c.column_ids, c.column_ids)] += total[1:, 1:]
        product[c.column_ids] += total[1:, 0]
    precision = gram[np.ix_(nuisances, nuisances)] + np.diag(prior_std[nuisances] ** -2.0)
    regression = np.linalg.solve(precision, gram[nuisances]).T
    return (gram, gram - regression @ gram[nuisances],
            product - regression @ product[nuisances])
