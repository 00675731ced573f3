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
What each effect alone would gain, how rare that is without a gap, and how visible it is.

All on the tangents at the baseline, with the noise that was found there. Chi-square is wrong
where one looks for the best of many and where a width or a frequency means nothing at zero, so
that the probability comes from the largest gain of all candidates in drawn recordings without a
gap (parametric bootstrap); for linear columns only their products with the noise need be drawn.
"""

from __future__ import annotations

from dataclasses import dataclass

from adxl_ros.diagnose.evidence import fit
from adxl_ros.diagnose.linear_model import Study
import numpy as np

_DRAWS = 2000


@dataclass(frozen=True)
class Score:
    """
    One effect alone.

    Attributes
    ----------
    gain
        Of the log-evidence over no gap, nats, on tangents.
    p
        Probability that any effect gains as much without a gap.
    visibility
        Part of its whitened signal that zero-g and scale factor cannot imitate, 0 to 1.

    """

    gain: float
    p: float
    visibility: float


def scores(of: Study, seed: int) -> dict[str, Score]:
    """
    Score every effect that has something to act on in these recordings.

    Parameters
    ----------
    of
        The recordings and the tangents at the baseline.
    seed
        Of the draws.

    """
    none = fit(of.channels, of.nuisances(), *of.priors(()))
    count = len(of.names)
    gram, pull = np.zeros((count, count)), np.zeros(count)
    for c, walk, variance in zip(of.channels, none.walks, none.variance):
        whole = c.whole[walk] / variance
        gram[np.ix_(c.ids, c.ids)] += whole[1:, 1:]
        pull[c.ids] += whole[1:, 0]
    nuisances = np.array(of.nuisances())
    held = gram[np.ix_(nuisances, nuisances)] + np.diag(of.priors(())[0][nuisances] ** -2.0)
    taken = np.linalg.solve(held, gram[nuisances]).T
    left = gram - taken @ gram[nuisances]
    pull = pull - taken @ pull[nuisances]
    size, turn = np.linalg.eigh(left * np.outer(of.prior, of.prior))
    drawn = turn * np.sqrt(np.maximum(size, 0.0)) @ np.random.default_rng(seed).standard_normal(
        (count, _DRAWS))
    gains: dict[str, float] = {}
    visible: dict[str, float] = {}
    largest = np.full(_DRAWS, -np.inf)
    for variant, ids in zip(of.variants, of.ids):
        prior = of.prior[ids]
        factor = np.linalg.cholesky(left[np.ix_(ids, ids)] * np.outer(prior, prior)
                                    + np.eye(len(ids)))
        cost = float(np.log(np.diag(factor)).sum())
        whitened = np.linalg.solve(factor, np.column_stack([prior * pull[ids], drawn[ids]]))
        gain = 0.5 * (whitened ** 2).sum(axis=0) - cost
        largest = np.maximum(largest, gain[1:])
        name = variant.effect
        gains[name] = max(gains.get(name, -np.inf), float(gain[0]))
        share = (prior ** 2 @ np.diag(left)[ids]) / (prior ** 2 @ np.diag(gram)[ids])
        visible[name] = max(visible.get(name, 0.0), float(np.clip(share, 0.0, 1.0)))
    return {name: Score(gain, float((1 + np.sum(largest >= gain)) / (1 + _DRAWS)), visible[name])
            for name, gain in gains.items()}
