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

"""Which terms earn their place in the full model: a comparison on poses held out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from adxl_ros.calibrate import full, posed
from adxl_ros.calibrate.poses import Poses
from adxl_ros.model.coefficients import get, with_neutral
from adxl_ros.model.effects import library
from adxl_ros.model.sensor import Sensor
import numpy as np
from scipy.stats import chi2

ALWAYS = ('bias', 'scale_factor', 'base_tilt')
"""What every fit has; other terms are judged by leaving them out, or by adding them."""
_MOVED = {'temperature_c': 0.5, 'supply_v': 0.02}
"""Surroundings that moved by more than this are asked whether the sensor follows them."""
_FOLDS = 5
_ROUNDS = 6
_GAUGE_CHANCE = 0.1
_EARNS_NATS, _EARNS_Z = 3.0, 2.0
"""What a term must gain on poses held out: "any gain" is found in most of pure noise."""


@dataclass(frozen=True)
class Term:
    """
    What a term is worth on poses held out.

    Attributes
    ----------
    inside
        Whether the fit has it.
    gain_nats
        Log-likelihood of the poses held out with the term minus that without.
    z
        The gain by its standard deviation over poses.

    """

    name: str
    inside: bool
    gain_nats: float
    z: float

    @property
    def earns(self) -> bool:
        """Tell whether the gain is more than chance gives."""
        return self.gain_nats > _EARNS_NATS and self.z > _EARNS_Z


def candidates(poses: Poses) -> tuple[str, ...]:
    """Name the terms that these poses can ask for beyond those of the model."""
    moved = {name for name, least in _MOVED.items()
             if np.ptp(getattr(poses.environment, name)) > least}
    follow = [name for name, effect in library().items()
              if effect.invertible and moved & set(effect.follows)]
    return ('stage_eccentricity', *follow)


def fit(sensor: Sensor, poses: Poses) -> Sensor:
    """Return the unit alone of `fit_judged`."""
    return fit_judged(sensor, poses)[0].fitted


def fit_judged(sensor: Sensor, poses: Poses, effects: Sequence[str] = ()
               ) -> tuple[full.FullFit, list[Term]]:
    """
    Fit the full model with the terms more that poses held out ask for.

    Parameters
    ----------
    sensor, poses
        As for `full.fit_full`.
    effects
        Terms more in any case.

    Returns
    -------
    tuple
        The fit, and what its terms, and those that it could have, are worth.

    Raises
    ------
    UserError
        See `full.fit_full`.

    """
    terms = tuple(dict.fromkeys((*full.TERMS, *effects)))
    found = full.fit_full(sensor, poses, terms)
    if gauge_shows(found):
        terms = (*terms, *full.GAUGE)
    for _ in range(_ROUNDS):
        found = full.fit_full(sensor, poses, terms)
        judged = judge(found)
        asked = [term for term in judged if not term.inside and term.earns]
        if not asked:
            break
        # One after the other: what one term explains, another need not.
        terms = (*terms, max(asked, key=lambda term: term.gain_nats).name)
    return found, judged


def judge(found: full.FullFit) -> list[Term]:
    """
    Compare the fit on poses held out with those without a term, and with one more.

    Linearised at the fit, where the chain is linear in its coefficients to far below the noise:
    a comparison is then linear least squares, in five folds.

    """
    asked = candidates(found.at)
    linear = _linear(found, asked)
    with_all = linear.held_out(linear.base)
    judged = []
    for name in dict.fromkeys(linear.term):
        if name in ALWAYS or name in full.GAUGE:
            continue
        own = linear.term == name
        if name == 'misalignment':
            # The linear cross-axis terms would stand in for it.
            own = own | (np.isin(linear.term, full.GAUGE) & linear.base)
        inside = linear.base[own].all()
        changed = linear.base & ~own if inside else linear.base | own
        gain = (linear.held_out(changed) - with_all) / 2 * (1 if inside else -1)
        spread = max(float(np.std(gain)) * np.sqrt(len(gain)), 1e-12)
        judged.append(Term(str(name), bool(inside), float(gain.sum()),
                           float(gain.sum()) / spread))
    return judged


def gauge_shows(found: full.FullFit) -> bool:
    """
    Tell whether the poses show the linear cross-axis terms apart from the misalignment.

    By the likelihood ratio of all four (two on a sensor of one axis): a fit without them is off
    by their products with the other terms, and no longer by much where the ratio is that of
    chance.
    """
    linear = _linear(found, full.GAUGE)
    apart = np.isin(linear.term, full.GAUGE)
    ratio = linear.distance(linear.base & ~apart) - linear.distance(linear.base | apart)
    return bool(ratio > chi2.isf(_GAUGE_CHANCE, apart.sum()))


@dataclass(frozen=True)
class _Linear:
    """
    The fit and terms more as linear least squares, where k poses have m axes.

    Attributes
    ----------
    design, target
        Whitened, (k, m, p) and (k, m).
    known
        Inverse prior variances, (p,).
    term, base
        Term of each coefficient, and whether the fit has it, (p,).

    """

    design: np.ndarray
    target: np.ndarray
    known: np.ndarray
    term: np.ndarray
    base: np.ndarray

    def distance(self, used: np.ndarray) -> float:
        """Return the squared distance of all poses and priors from the best fit to them."""
        best = self._best(used, np.ones(len(self.design), bool))
        off = self.target - self.design[:, :, used] @ best
        return float(np.sum(off ** 2) + np.sum(self.known[used] * best ** 2))

    def held_out(self, used: np.ndarray) -> np.ndarray:
        """Return the squared distance of each pose from a fit to the other folds, (k,)."""
        fold = np.arange(len(self.design)) % _FOLDS
        out = np.empty(len(self.design))
        for i in range(_FOLDS):
            best = self._best(used, fold != i)
            off = self.target[fold == i] - self.design[fold == i][:, :, used] @ best
            out[fold == i] = np.sum(off ** 2, axis=1)
        return out

    def _best(self, used: np.ndarray, poses: np.ndarray) -> np.ndarray:
        columns = self.design[poses][:, :, used].reshape(-1, used.sum())
        information = columns.T @ columns + np.diag(self.known[used])
        # A fold may not determine all: a billionth of each information holds the rest.
        information += np.diag(1e-9 * np.diag(information))
        return np.linalg.solve(information, columns.T @ self.target[poses].ravel())


def _linear(found: full.FullFit, asked: Sequence[str]) -> _Linear:
    kept = found.at.subset(np.setdiff1d(np.arange(len(found.at)), found.knocked))
    unit = with_neutral(found.unit, [name.split('.')[0] for name in asked])
    more = tuple(n for name in asked for n in full.coefficients(unit.axes, (name,))
                 if n not in found.names)
    names = (*found.names, *more)
    covariance = posed.pose_covariance(unit, kept, found.stage_sigma_rad)
    white = np.linalg.inv(np.linalg.cholesky(covariance))
    design = white @ posed.by_coefficients(unit, kept, names)
    off = kept.volts - posed.response(unit, kept)
    return _Linear(design, (white @ off[:, :, None])[:, :, 0] + design @ get(unit, names),
                   full.priors(names), np.array([full.term_of(name) for name in names]),
                   np.isin(names, found.names))
