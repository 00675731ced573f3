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
Which terms the full model holds: a comparison by Bayes factors.

A term is weighed by the marginal likelihood of the poses with it and without it: coefficients are
integrated over their priors, at the levels of the stage's error of the richer of the two models.
A candidate gets levels of its own, so that what it explains is no error of the stage.
Poses that share a setting of a joint share its error, so that a term that follows alpha, which is
set a few times only, must explain more than that error does by chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from adxl_ros.calibrate.fits import full_model
from adxl_ros.calibrate.fits.linearised import Linearised, linearised
from adxl_ros.calibrate.poses import Poses
from adxl_ros.model.coefficients import with_neutral
from adxl_ros.model.effects import library
from adxl_ros.model.sensor import Sensor
import numpy as np
from scipy.stats import chi2

ALWAYS = ('bias', 'scale_factor')
"""What every fit has; other terms are weighed by leaving them out, or by adding them."""
_MOVED = {'temperature_c': 0.5, 'supply_v': 0.02}
"""Surroundings that moved by more than this, °C and V, may have moved the sensor."""
_ROUNDS = 6
"""Terms that are added at most."""
_GAUGE_CHANCE = 0.01
"""Chance at which the linear cross-axis terms are freed although they are 0."""


@dataclass(frozen=True)
class Term:
    """
    What a term is worth.

    Attributes
    ----------
    name
        Effect, or one of `full_model.GAUGE`.
    inside
        Whether the fit has it.
    log_bayes_factor
        Log marginal likelihood of the poses with the term minus that without, nats.

    """

    name: str
    inside: bool
    log_bayes_factor: float

    @property
    def earns(self) -> bool:
        """Tell whether the poses are more likely with the term than without it."""
        return self.log_bayes_factor > 0.0


def candidates(poses: Poses) -> tuple[str, ...]:
    """Name the terms that these poses can ask for beyond those of the model."""
    moved = {name for name, least in _MOVED.items()
             if np.ptp(getattr(poses.environment, name)) > least}
    follow = [name for name, effect in library().items()
              if effect.invertible and moved & set(effect.follows)]
    return ('stage_eccentricity', *follow)


def fit(sensor: Sensor, poses: Poses) -> Sensor:
    """Return the unit alone of `fit_selected`."""
    return fit_selected(sensor, poses)[0].fitted


def fit_selected(sensor: Sensor, poses: Poses, effects: Sequence[str] = ()
               ) -> tuple[full_model.FullFit, list[Term]]:
    """
    Fit the full model with the further terms that the poses speak for.

    Parameters
    ----------
    sensor, poses
        As for `full_model.fit_full`.
    effects
        Further terms in any case.

    Returns
    -------
    tuple
        The fit, and what its terms, and those that it could have, are worth.

    Raises
    ------
    UserError
        See `full_model.fit_full`.

    """
    terms = tuple(dict.fromkeys((*full_model.default_terms(sensor.axes), *effects)))
    found = full_model.fit_full(sensor, poses, terms)
    if gauge_is_identifiable(found):
        terms = (*terms, *full_model.GAUGE)
        found = full_model.fit_full(sensor, poses, terms)
    judged = compare_terms(found)
    for _ in range(_ROUNDS):
        asked = [term for term in judged if not term.inside and term.earns]
        if not asked:
            break
        # One after the other: what one term explains, another need not.
        terms = (*terms, max(asked, key=lambda term: term.log_bayes_factor).name)
        found = full_model.fit_full(sensor, poses, terms)
        judged = compare_terms(found)
    return found, judged


def compare_terms(found: full_model.FullFit) -> list[Term]:
    """
    Compare the fit with those without a term, and with one more.

    Linearised at the fit, where the chain is linear in its coefficients to far below the noise.
    """
    about, term = _linearised(found, ())
    inside = -about.deviance(found.stage) / 2
    judged = []
    for name in dict.fromkeys(term):
        if name in ALWAYS or name in full_model.GAUGE:
            continue
        own = term == name
        if name == 'misalignment':
            # The linear cross-axis terms would stand in for it.
            own = own | np.isin(term, full_model.GAUGE)
        poorer = -about.without(own).deviance(found.stage) / 2
        judged.append(Term(str(name), True, inside - poorer))
    for name in candidates(found.at):
        if name not in term:
            richer, _ = _linearised(found, [name])
            stage = richer.stage_error(found.stated_std_rad, found.stage)
            judged.append(Term(name, False, -richer.deviance(stage) / 2 - inside))
    return judged


def gauge_is_identifiable(found: full_model.FullFit) -> bool:
    """
    Tell whether the poses show the linear cross-axis terms apart from the misalignment.

    By the likelihood ratio of all of them (two an axis): a fit without them is off by their
    products with the other terms, and no longer by much where the ratio is that of chance.
    """
    about, term = _linearised(found, full_model.GAUGE)
    gauge = np.isin(term, full_model.GAUGE)
    ratio = about.without(gauge).misfit(found.stage) - about.misfit(found.stage)
    return bool(ratio > chi2.isf(_GAUGE_CHANCE, gauge.sum()))


def _linearised(found: full_model.FullFit, more: Sequence[str]) -> tuple[Linearised, np.ndarray]:
    """Linearise the fit with further terms; returns the term of each coefficient, too."""
    unit = with_neutral(found.unit, map(full_model.effect_of, more))
    names = (*found.names, *(n for name in more
                             for n in full_model.fitted_coefficients(unit.axes, (name,))
                             if n not in found.names))
    return (linearised(unit, found.at, names, full_model.prior_precision(names), found.kept),
            np.array([full_model.term_of(name) for name in names]))
