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
What the library does not hold: a flexible discrepancy beside the best hypothesis.

Splines and products over force, rate, direction, temperature, supply and time, by axis, with their
own prior; the tangents of the hypothesis are fitted beside them, so that they only take what it
cannot. They are never offered first: a flexible term would steal what an effect explains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from adxl_ros.diagnose import evidence
from adxl_ros.diagnose.baseline_comparison import Series
from adxl_ros.diagnose.evidence import Fit
from adxl_ros.diagnose.hypothesis_fit import Hypothesis, local
from adxl_ros.diagnose.linear_model import Study
from adxl_ros.diagnose.motion_history import direction, since_move_s
from adxl_ros.diagnose.noise_whitening import drifts_among
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.filters import low_pass
from adxl_ros.model.kinematics import specific_force
import numpy as np
from scipy.interpolate import BSpline

_CREEP_S = (2.0, 10.0, 50.0)
PRIOR_G = 2e-3
"""Standard deviation of what one basis function does, at the most."""
UNKNOWN_NATS = 15.0
"""Gain of a flexible term that shows something to be there."""
_ELSEWHERE, _BY_CHANCE = 0.382, 2.0
"""How far in the recording a term is moved that shall follow nothing; how much more than that one
gains the other must."""


@dataclass(frozen=True)
class Discrepancy:
    """
    What a flexible term finds beside a hypothesis.

    Attributes
    ----------
    gain
        Of the log-evidence, nats.
    rms_mps2
        Of what it adds, over samples and axes.
    where
        Dimension by dimension, what its part alone would gain, nats.

    """

    gain: float
    rms_mps2: float
    where: dict[str, float]


def discrepancy(of: Study, best: Hypothesis) -> Discrepancy:
    """
    Fit the flexible term beside the best hypothesis.

    A strong drift has not quite the colour of its model: what is slow then gains whatever it
    follows. The same term at other times, where it follows nothing, says how much that is.
    """
    bases = [flexible(one) for one in of.series]
    found = _fitted(of, best, bases)
    if not drifts_among(best.effects) or found.gain < UNKNOWN_NATS:
        return found
    elsewhere = _fitted(of, best, [{kind: np.roll(values, round(_ELSEWHERE * len(values)), axis=0)
                                    for kind, values in basis.items()} for basis in bases])
    return replace(found, gain=found.gain - _BY_CHANCE * max(elsewhere.gain, 0.0))


def _fitted(of: Study, best: Hypothesis, bases: Sequence[dict[str, np.ndarray]]) -> Discrepancy:
    here = local(of, best.effects, best.sensor,
                 [np.column_stack(list(basis.values())) for basis in bases], best.fit.walks)
    own, sd = list(range(len(here.names))), list(here.prior)
    kinds: dict[str, list[int]] = {}
    for one, basis in zip(of.series, bases):
        for scale in one.sensor.scale_v_per_g:
            for kind, columns in basis.items():
                kinds.setdefault(kind, []).extend(range(len(sd), len(sd) + columns.shape[1]))
                sd += [PRIOR_G * float(scale)] * columns.shape[1]
    prior = np.array(sd)
    most = np.concatenate([here.most, np.full(len(prior) - len(own), np.inf)])

    def fit(ids: Sequence[int], start: Fit | None = None) -> Fit:
        return evidence.fit(here.channels, ids, prior, most, None, start,
                            drifts_among(best.sensor.effects))

    alone = fit(own)
    gains, blind = {}, float(np.log(len(evidence.SIZES)))
    for kind, ids in kinds.items():
        found = fit([*own, *ids], alone)
        at = np.searchsorted(found.ids, ids)
        sizes = evidence.by_size(found.values[at], found.covariance[np.ix_(at, at)], prior[ids])
        gains[kind] = found.log_evidence + float(sizes.max()) - alone.log_evidence - blind
        prior[ids] *= evidence.SIZES[np.argmax(sizes)]
    kept = [kind for kind, gain in gains.items() if gain > 0]
    if not kept:
        return Discrepancy(0.0, 0.0, gains)
    whole = fit([*own, *(i for kind in kept for i in kinds[kind])], alone)
    value = np.zeros(len(prior))
    value[whole.ids] = whole.values
    return Discrepancy(whole.log_evidence - alone.log_evidence - blind * len(kept),
                       _rms(of, bases, value[len(own):]), gains)


def instead_of_drift(of: Study, found: Sequence[Hypothesis]) -> Discrepancy | None:
    """
    Return what a flexible term finds in place of a drift, where it is more likely than that.

    What follows force or direction by an unknown law looks like a drift to the evidence; a drift
    follows nothing. None where the most probable hypothesis does not drift.

    Parameters
    ----------
    of
        The recordings.
    found
        Hypotheses, the most probable first.

    """
    if not drifts_among(found[0].effects):
        return None
    still = next(h for h in found if not drifts_among(h.effects))
    other = discrepancy(of, still)
    gain = still.log_evidence + other.gain - found[0].log_evidence
    return replace(other, gain=gain) if gain > 0 else None


def _rms(of: Study, bases: Sequence[dict[str, np.ndarray]], value: np.ndarray) -> float:
    """Return the rms of the flexible term over samples and axes, m/s²."""
    squares, count, at = 0.0, 0, 0
    for one, mask, basis in zip(of.series, of.used, bases):
        columns = np.column_stack(list(basis.values()))
        for scale in one.scale_v_per_mps2:
            total = columns @ value[at:at + columns.shape[1]] / scale
            at += columns.shape[1]
            squares += float(np.sum((total[mask] - total[mask].mean()) ** 2))
            count += int(mask.sum())
    return float(np.sqrt(squares / max(count, 1)))


def flexible(series: Series) -> dict[str, np.ndarray]:
    """Return basis functions by dimension, (n, k) each, of size 1 about."""
    time_s, motion = series.time_s, series.motion
    out: dict[str, np.ndarray] = {}
    if series.reference == 'stage':
        alpha, beta = motion.alpha(time_s), motion.beta(time_s)
        rates = [motion.alpha(time_s, 1), motion.beta(time_s, 1)]
        f = np.array(specific_force(alpha, beta, 1.0))
        out['force'] = np.column_stack([_products(f), *(_splines(part, 12) for part in f)])
        out['alpha_rad'] = _splines(alpha, 12)
        out['beta_rad'] = np.column_stack([g(k * beta) for k in range(1, 9)
                                           for g in (np.sin, np.cos)])
        scale = [max(float(np.abs(r).max()), 1e-9) for r in rates]
        parts = [r / s for r, s in zip(rates, scale) if s > 1e-3]
        if parts:
            out['rate'] = np.column_stack([g for r in parts for g in (
                r, r * r, r * f[0], r * f[1], r * f[2], np.abs(r))])
            turns = [direction(r) for r in parts]
            out['direction'] = np.column_stack([t * g for t in turns
                                                for g in (np.ones_like(t), *f)])
            since = since_move_s(time_s, rates)
            # What creeps follows the force late, by one time or another.
            lags = [low_pass(part, tau_s, float(np.median(np.diff(time_s))), {}) - part
                    for tau_s in _CREEP_S for part in f]
            out['since_move_s'] = np.column_stack([
                *(np.exp(-since / tau) for tau in (1, 4, 16)), *lags])
    elif series.reference == 'sim' and motion.force is not None:
        f = np.array([v / G0_MPS2 for v in motion.force(time_s)])
        out['force'] = _products(f)
    for name in ('temperature_c', 'supply_v'):
        path = getattr(motion, name)
        if path is not None:
            values = path(time_s)
            if np.ptp(values) > (0.5 if name == 'temperature_c' else 0.01):
                out[name] = _splines(values, 5)
    out['time_s'] = (np.arange(1, 25)[None] * (time_s[-1] - time_s[0]) / 25 + time_s[0]
                     < time_s[:, None]).astype(float)
    return {kind: values - values.mean(axis=0) for kind, values in out.items()}


def _products(f: np.ndarray) -> np.ndarray:
    x, y, z = f
    powers = [(i, j, k) for i in range(5) for j in range(5) for k in range(5)
              if 2 <= i + j + k <= 4]
    return np.column_stack([x ** i * y ** j * z ** k for i, j, k in powers])


def _splines(values: np.ndarray, count: int) -> np.ndarray:
    low, high = float(values.min()), float(values.max())
    if high - low < 1e-6:
        return np.zeros((len(values), 0))
    inner = np.linspace(low, high, count - 2)
    knots = np.concatenate([[low] * 3, inner, [high] * 3])
    return BSpline.design_matrix(np.clip(values, low, high), knots, 3).toarray()[:, 1:]
