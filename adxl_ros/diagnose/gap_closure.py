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

from collections.abc import Sequence
from dataclasses import dataclass

from adxl_ros.diagnose import evidence
from adxl_ros.diagnose.baseline_comparison import Series
from adxl_ros.diagnose.evidence import BLOCKS
from adxl_ros.diagnose.hypothesis_fit import Hypothesis, local
from adxl_ros.diagnose.linear_model import Study
from adxl_ros.diagnose.noise_floor import Floor
from adxl_ros.diagnose.noise_whitening import USUAL
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import ActsOn, Coefficient
from adxl_ros.model.sensor import Sensor
import numpy as np

_FOLDS, _RUN = 4, 2
_HARM = 1.005
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
    within_mps2
        Rms about the fit to all stretches, none held out.
    predicted
        Nats by which stretches held out are more likely with the effects than without.

    """

    before_mps2: float
    after_mps2: float
    floor_mps2: float
    closed: float
    closed_ci: tuple[float, float]
    harm: bool
    within_mps2: float
    predicted: float


@dataclass(frozen=True)
class HeldOut:
    """
    What a hypothesis leaves on stretches that it was not fitted to.

    Attributes
    ----------
    squares
        Sums over samples of the mean square over axes, (m/s²)², by block, (b,).
    log_likelihood
        Of all stretches, nats.

    """

    squares: np.ndarray
    log_likelihood: float


def held_out(of: Study, full: Sequence[Series], counted: Sequence[np.ndarray],
             effects: Sequence[str], sensor: Sensor) -> HeldOut:
    """
    Fit on three quarters of the stretches and simulate the others at the full rate, in turn.

    Parameters
    ----------
    of
        The recordings as searched.
    full, counted
        The same at their full rate, and the samples that count.
    effects, sensor
        Whose parameters are fitted anew, and which has them as fitted to all stretches.

    """
    number = np.arange(BLOCKS)
    here, free = local(of, effects, sensor), 'bias' in effects
    whole = here.fit()
    squares, log_likelihood = np.zeros(BLOCKS), 0.0
    for fold in range(_FOLDS):
        out = (number // _RUN) % _FOLDS == fold
        near = np.convolve(out, np.ones(3), 'same') > 0
        fit = here.fit(~near)
        log_likelihood += float(evidence.predicted(here.channels, fit, np.flatnonzero(out)).sum())
        refitted = here.fitted(fit, whole=whole)
        for one, mask in zip(full, counted):
            squares[out] += _by_block(one, mask, one.residual(refitted), ~near, of, free)[out]
    return HeldOut(squares, log_likelihood)


def shrunk(of: Study, full: Sequence[Series], counted: Sequence[np.ndarray], best: Hypothesis,
           without: HeldOut, floor: Floor, seed: int) -> Shrunk:
    """
    Compare a hypothesis with none, on stretches held out.

    Parameters
    ----------
    of
        The recordings as searched.
    full, counted
        The same at their full rate, and the samples that count.
    best
        Effects whose parameters are fitted anew.
    without
        What is left without effects.
    floor
        From `floor`.
    seed
        Of the bootstrap.

    """
    found = held_out(of, full, counted, best.effects, best.sensor) if best.effects else without
    before, after = without.squares, found.squares
    # What only makes noise leaves the mean, and the gap, as they are.
    if all(effect_named(effect).acts_on is not ActsOn.MEAN for effect in best.effects):
        after = before
    counts = np.zeros(BLOCKS)
    for mask in counted:
        counts += np.add.reduceat(mask, evidence.block_edges(len(mask))[:-1])
    everywhere = np.ones(BLOCKS, bool)
    within = sum(_by_block(one, mask, one.residual(best.sensor), everywhere, of,
                           'bias' in best.effects).sum() for one, mask in zip(full, counted))
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
                  (float(low), float(high)), bool(a2 > b2 * _HARM),
                  float(np.sqrt(within / counts.sum())),
                  found.log_likelihood - without.log_likelihood)


def _by_block(series: Series, used: np.ndarray, off: np.ndarray, blocks: np.ndarray, of: Study,
              free: bool) -> np.ndarray:
    """
    Return the sum over samples of the mean square over axes of what is left, (m/s²)², (b,).

    The level of a zero-g that wanders is that of the stretches that are not held out, within its
    tolerance; where it is an effect, wherever they say.
    """
    edges = evidence.block_edges(len(series))
    fitted = used & np.repeat(blocks, np.diff(edges))
    if fitted.any():
        span_s = float(series.time_s[-1] - series.time_s[0])
        drift = USUAL ** 2 * span_s / 6 * series.sensor.scale_v_per_g ** 2
        known = np.array([np.inf if free else of.tolerance(Coefficient('bias', 'offset_v', axis))
                          for axis in series.sensor.axes]) ** 2
        off = off - off[fitted].mean(axis=0) / (1 + drift / known)
    squares = ((off / series.scale_v_per_mps2) ** 2).mean(axis=1)
    return np.add.reduceat(np.where(used, squares, 0.0), edges[:-1])
