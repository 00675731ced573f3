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
How far the gap shrinks: the effect is fitted on one part and simulated on another.

Stretches are held out in turn, with a stretch between them and what is fitted left out. The gap is
the rms over held-out samples and axes, zero-g and scale at their posterior from the other part.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from adxl_ros.gap import evidence
from adxl_ros.gap.evidence import BLOCKS
from adxl_ros.gap.floor import Floor
from adxl_ros.gap.search import Hypothesis, refined, Study
import numpy as np

_FOLDS = 2
_DRAWS = 400


@dataclass(frozen=True)
class Shrunk:
    """
    The gap before, after and at the floor, rms m/s², and the closed share with its interval.

    Attributes
    ----------
    closed
        (before² − after²)/(before² − floor²), held out; nan where there is no gap to close.
    harm
        Whether after is more than before.

    """

    before_mps2: float
    after_mps2: float
    floor_mps2: float
    closed: float
    closed_ci: tuple[float, float]
    harm: bool


def shrunk(of: Study, best: Hypothesis, floor: Floor, seed: int) -> Shrunk:
    """
    Fit on half of the stretches and simulate the other, both ways.

    Parameters
    ----------
    of
        The recordings.
    best
        Effects whose parameters are fitted anew.
    floor
        From `floor`.
    seed
        Of the bootstrap.

    """
    number = np.arange(BLOCKS)
    before, after, counts = np.zeros(BLOCKS), np.zeros(BLOCKS), np.zeros(BLOCKS)
    start = dict(zip(best.names, best.values))
    for fold in range(_FOLDS):
        out = (number // 3) % _FOLDS == fold
        near = np.convolve(out, np.ones(3), 'same') > 0
        fitted = refined(of, best.effects, start, {}, ~near if (~near).sum() > 6 else ~out)
        plain = refined(of, (), {}, {}, ~near if (~near).sum() > 6 else ~out)
        for one, mask in zip(of.series, of.used):
            edges = np.linspace(0, len(one), BLOCKS + 1).astype(int)
            for sensor, total in ((plain.sensor, before), (fitted.sensor, after)):
                off = one.volts - one.simulated(replace(sensor, rate_hz=one.sensor.rate_hz))
                squares = np.where(mask[:, None], (off / one.scale_v_per_mps2) ** 2,
                                   0.0).mean(axis=1)
                total[out] += np.add.reduceat(squares, edges[:-1])[out]
            counts[out] += np.add.reduceat(mask, edges[:-1])[out]
    f2 = floor.rms_mps2 ** 2
    b2, a2 = before.sum() / counts.sum(), after.sum() / counts.sum()
    rng = np.random.default_rng(seed)
    drawn = rng.integers(0, BLOCKS, (_DRAWS, BLOCKS))
    b_drawn = before[drawn].sum(axis=1) / counts[drawn].sum(axis=1)
    a_drawn = after[drawn].sum(axis=1) / counts[drawn].sum(axis=1)
    # The floor in the sense of the same samples: after can be below it by chance.
    with np.errstate(all='ignore'):
        shares = (b_drawn - a_drawn) / (b_drawn - np.minimum(f2, a2))
    closed = (b2 - a2) / (b2 - min(f2, a2)) if b2 > f2 else float('nan')
    low, high = np.quantile(np.clip(np.nan_to_num(shares), -1, 1), [0.05, 0.95])
    return Shrunk(float(np.sqrt(b2)), float(np.sqrt(a2)), floor.rms_mps2, float(min(closed, 1.0)),
                  (float(low), float(high)), bool(a2 > b2 * 1.001))


def predicts(of: Study, best: Hypothesis) -> float:
    """Return how much more likely held-out stretches are with the effect, nats."""
    return float(best.log_evidence - evidence.fit(
        of.channels, sorted(of.nuisances()), of.priors(())).log_evidence)
