# SPDX-License-Identifier: Apache-2.0

"""
The terms of the full model that poses support, and what a full fit shows, for people.

Terms are selected by Bayes factors: the ratio of the marginal likelihoods of the poses with a term
and without it. Coefficients are integrated over their priors, and both models have the stage error
of the richer one. A candidate has a stage error of its own, so that what it explains is no error
of the stage. Poses that share a setting of a joint share its error. A term that follows alpha,
which is set a few times only, must therefore explain more than that error does by chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple

from adxl_ros.calibrate.fits.full_model import (
    belongs_to_stage,
    default_terms,
    effect_of,
    fit_full,
    fitted_coefficients,
    FullFit,
    GAUGE,
    next_poses,
    prior_precision,
    term_of,
    typical_sizes,
)
from adxl_ros.calibrate.fits.linearisation import Linearised, linearised
from adxl_ros.calibrate.poses import Poses
from adxl_ros.model.constants import Z_90
from adxl_ros.model.effects import library
from adxl_ros.model.error_sizes import stds
from adxl_ros.model.sensor import get, parameter_of, Sensor, with_neutral
from adxl_ros.report.quantities import with_half_width
from adxl_ros.wording import usage
import numpy as np
import scipy

ALWAYS = ('bias', 'scale_factor')  # Terms that every fit has and that are not compared
_MIN_CHANGE = {'temperature_c': 0.5, 'supply_v': 0.02}
"""Smallest range of temperature, °C, and supply, V, for which effects that follow them are
candidates. Chosen: 0.5 °C changes the zero-g by 0.05 mg, about the noise of a mean."""
_MAX_ADDED = 6  # Largest count of added terms
_GAUGE_CHANCE = 0.01  # Probability of freeing the linear cross-axis terms although they are 0
NOT_CONVERGED = (
    'the fit did not converge: coefficients and intervals are those of its last '
    'step; add poses, or leave out terms'
)
"""Line of a fit that did not converge."""
_MAX_WARMING_K = 3.0
"""Range of temperature beyond which the report warns, K: 0.3 mg by the datasheet's 0.1 mg/°C."""
_BAD_STAGE_RATIO = 1.5
"""Ratio of the estimated to the stated stage error from which the report warns."""
_MIN_STAGE_EXCESS_RAD = 1e-5
"""Excess over that ratio from which the report warns, rad, for a stage without a stated error."""
_MAX_PARTS = 4  # Largest count of components of the weakest direction in the report
_MIN_PART = 0.2  # Smallest component of the weakest direction, a unit vector, in the report


@dataclass(frozen=True)
class Term:
    """Evidence for a term."""

    name: str  # Effect, or one of `GAUGE`
    is_fitted: bool  # Whether the fit has the term
    # Log marginal likelihood of the poses with the term minus that without, nats
    log_bayes_factor: float

    @property
    def is_supported(self) -> bool:
        """Return whether the poses are more likely with the term than without it."""
        return self.log_bayes_factor > 0.0


def candidates(poses: Poses) -> tuple[str, ...]:
    """Name the terms that these poses may need beyond the default ones."""
    changed = {
        name
        for name, change in _MIN_CHANGE.items()
        if np.ptp(getattr(poses.environment, name)) > change
    }
    following = [
        name
        for name, effect in library().items()
        if effect.invertible and changed & set(effect.follows)
    ]
    return ('stage_eccentricity', *following)


def fit(sensor: Sensor, poses: Poses, effects: Sequence[str] = ()) -> Sensor:
    """Fit the full model with selected terms, and with some effects in any case."""
    return fit_selected(sensor, poses, effects).fit.fitted


class SelectedFit(NamedTuple):
    """A full fit, and the evidence for its terms and for those that it does not have."""

    fit: FullFit
    terms: list[Term]


def fit_selected(sensor: Sensor, poses: Poses, effects: Sequence[str] = ()) -> SelectedFit:
    """Fit the full model and effects as `fit_full` does, and add terms that the poses support."""
    terms = tuple(dict.fromkeys((*default_terms(sensor.axes), *effects)))
    full = fit_full(sensor, poses, terms)
    if gauge_is_identifiable(full):
        terms = (*terms, *GAUGE)
        full = fit_full(sensor, poses, terms)
    compared = compare_terms(full)
    for _ in range(_MAX_ADDED):
        supported = [term for term in compared if not term.is_fitted and term.is_supported]
        if not supported:
            break
        # One at a time: what one term explains, another need not.
        terms = (*terms, max(supported, key=lambda term: term.log_bayes_factor).name)
        full = fit_full(sensor, poses, terms)
        compared = compare_terms(full)
    return SelectedFit(full, compared)


def compare_terms(full: FullFit) -> list[Term]:
    """Compare the fit, linearised there, with models that have one term less or one term more."""
    about, term = _linearised(full, ())
    log_likelihood = -about.deviance(full.stage) / 2
    compared = []
    for name in dict.fromkeys(term):
        if name in ALWAYS or name in GAUGE:
            continue
        excluded = term == name
        if name == 'misalignment':
            # The linear cross-axis terms would take its place.
            excluded = excluded | np.isin(term, GAUGE)
        poorer = -about.without(excluded).deviance(full.stage) / 2
        compared.append(Term(str(name), True, log_likelihood - poorer))
    for name in candidates(full.linear_poses):
        if name not in term:
            richer, _ = _linearised(full, [name])
            stage = richer.stage_error(full.stated_std_rad, full.stage)
            compared.append(Term(name, False, -richer.deviance(stage) / 2 - log_likelihood))
    return compared


def gauge_is_identifiable(full: FullFit) -> bool:
    """
    Test whether the poses distinguish the linear cross-axis terms from the misalignment.

    The test is the likelihood ratio of all of these terms, two for each axis. A fit without them
    has errors of the size of their products with other terms.
    """
    about, term = _linearised(full, GAUGE)
    gauge = np.isin(term, GAUGE)
    ratio = about.without(gauge).misfit(full.stage) - about.misfit(full.stage)
    return bool(ratio > scipy.special.chdtri(gauge.sum(), _GAUGE_CHANCE))


def _linearised(full: FullFit, added: Sequence[str]) -> tuple[Linearised, np.ndarray]:
    """Linearise the fit with further terms; also return the term of each coefficient, (p,)."""
    sensor = with_neutral(full.with_stage, map(effect_of, added))
    further = chain.from_iterable(fitted_coefficients(sensor.axes, (term,)) for term in added)
    names = (*full.names, *(name for name in further if name not in full.names))
    return (
        linearised(sensor, full.linear_poses, names, prior_precision(names), full.kept),
        np.array([term_of(name) for name in names]),
    )


def report_lines(full: FullFit, poses: Poses, terms: Sequence[Term]) -> list[str]:
    """Report the stage, the weakest direction and the terms of a fit of poses."""
    helpful = next_poses(full.with_stage, poses, full.names, full.stage)
    setting_deg = np.degrees(full.stage.setting_rad * full.stage.joints)
    pose_deg = np.degrees(full.stage.pose_rad * full.stage.joints)
    std = stds(np.linalg.inv(full.information))
    values = [
        f'{name} {with_half_width(float(value), Z_90 * value_std)} {parameter_of(name).unit}'
        for name, value, value_std in zip(full.names, get(full.with_stage, full.names), std)
        if belongs_to_stage(name)
    ]
    lines = [
        f'stage error: alpha {setting_deg[0]:.2g}, beta {setting_deg[1]:.2g} deg rms by setting, '
        f'{pose_deg[0]:.2g} and {pose_deg[1]:.2g} deg by pose (stated '
        f'{np.degrees(full.stated_std_rad):.2g} deg)',
        f'stage: {", ".join(values)} (90 % intervals)',
        _weakest_direction(full.fitted),
        f'next poses that would help most, (alpha, beta) in deg: {helpful}',
    ]
    if terms:
        lines.append('log Bayes factor of each term, nats; above 0 the poses support it:')
    for term in terms:
        note = '' if term.is_supported else '   not supported by these poses'
        lines.append(f'  {term.name:20} {term.log_bayes_factor:10.1f}{note}')
    return lines


def _weakest_direction(fitted: Sensor) -> str:
    """Name the direction that the poses determine least, in typical sizes, and the condition."""
    names = fitted.covariance_names
    scale = typical_sizes(fitted.covariance_names)
    values, vectors = np.linalg.eigh(fitted.covariance / np.outer(scale, scale))
    weakest = vectors[:, -1]
    parts = ' '.join(
        f'{weakest[i]:+.2f} {names[i]}'
        for i in np.argsort(-np.abs(weakest))[:_MAX_PARTS]
        if abs(weakest[i]) > _MIN_PART
    )
    return (
        f'least determined: {parts}, std {np.sqrt(values[-1]):.2g} typical sizes (condition '
        f'number {np.sqrt(values[-1] / values[0]):.0f})'
    )


def warnings(full: FullFit, poses: Poses) -> list[str]:
    """Return what is wrong with the poses or the fit, one line each."""
    lines = [] if full.converged else [NOT_CONVERGED]
    if full.stage.total_rad > _BAD_STAGE_RATIO * full.stated_std_rad + _MIN_STAGE_EXCESS_RAD:
        lines.append(
            'the reference is worse than stated, or the model lacks an effect that looks '
            'like a stage error; poses are weighted accordingly'
        )
    if full.outliers:
        named = [
            f'{i + 1} (alpha {np.degrees(poses.alpha_rad[i]):.1f}, beta '
            f'{np.degrees(poses.beta_rad[i]):.1f} deg, from {poses.time_s[i, 0]:.1f} s, '
            f'{np.sqrt(full.squared_distances[i]):.0f} sigma)'
            for i in full.outliers
        ]
        lines.append(f'outliers, left out: pose {", ".join(named)}')
    change_k = np.ptp(poses.environment.temperature_c)
    if change_k > _MAX_WARMING_K and 'temperature_bias' not in full.fitted.effects:
        lines.append(
            f'temperature moved by {change_k:.1f} degC, which the model ignores; keep it '
            f'steady, or {usage("fit", effects=["temperature_bias"])}'
        )
    return lines
