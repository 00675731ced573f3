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
The full model: one maximum-likelihood fit of all poses, all axes, with errors of the stage.

The volts of a pose are the chain's at angles that the stage has not quite reached,
V = h(f(α + δα, β + δβ; tilt); θ) + noise of the mean, with δ ~ N(0, σ²) a joint and pose, and the
level of the base known to `LEVEL_RAD`. The δ are integrated out: a pose weighs by the inverse of
S = diag(std²) + σ²·JJᵀ, J = ∂V/∂(α, β) (errors in variables; Fuller 1987, section 3.2), where J is
taken at the most likely angles, so that a stage that is off by degrees is still straight. The tilt
of the base is fitted beside the sensor, with its prior, and left out of the result.

Gauge: p0, q0 of (11) and (13) belong to the zero-g and r0 of (15) to the scale factor; p1 and q1
are the misalignment to first order, so that `cross_axis.linear` and `cross_axis_z.linear` stay 0.
Products tell them apart, by r1·p1·z·c and the like: where poses held out ask for it (see
`full_terms`), the two are fitted, too, with the datasheet's 1.5 % for prior. At rest x² + y² + z²
is g², so that a square of the own axis is those of the others and `quadratic` stays out. The
case's x is where beta = 0 points, so that an offset of beta is part of the misalignment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from adxl_ros.calibrate import linear
from adxl_ros.calibrate.posed import (
    by_angles,
    by_coefficients,
    pose_covariance,
    response,
)
from adxl_ros.calibrate.poses import Poses
from adxl_ros.errors import UserError
from adxl_ros.model.coefficients import get, names_of, parameter_of, put, with_neutral
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Place
from adxl_ros.model.sensor import Sensor
import numpy as np
from scipy.optimize import minimize_scalar
from scipy.stats import chi2

TERMS = ('bias', 'scale_factor', 'misalignment', 'cross_axis', 'cross_axis_z', 'scale_factor_z',
         'nonlinearity')
GAUGE = ('cross_axis.linear', 'cross_axis_z.linear')
LEVEL_RAD = np.radians(0.1)
"""Standard deviation of the level of the base, each way: the paper's 0.1°."""
_STAGE = ('base_tilt.x_rad', 'base_tilt.y_rad')
_HARDLY = 5.0
_KNOCKED = 1e-6
"""A pose less likely than this is disturbed, as long as such poses are few."""
_MOST_KNOCKED = 0.2
_ROUNDS, _STEPS = 16, 12
_SHRINK, _STRAIGHT = 0.2, 0.1
_CONVERGED = 1e-4
_LONGEST = 3.0
"""Longest step, in typical sizes."""
_FEWEST_SPARE = 40
"""Residuals beyond the parameters that are needed to judge the stage's errors by them."""


@dataclass(frozen=True)
class FullFit:
    """
    What the fit found beside the sensor.

    Attributes
    ----------
    fitted
        The unit with its covariance.
    unit
        The same with what was fitted of the stage, which belongs to no sensor.
    names
        Fitted coefficients, those of the stage last.
    stage_sigma_rad
        Standard deviation of a joint's error from pose to pose; the stated one is step/√12.
    stated_sigma_rad
        That.
    knocked
        Numbers of the poses that were left out as disturbed.
    information
        Inverse covariance of `names`, priors included.
    distances
        Squared Mahalanobis distance of each pose, (k,).
    at
        The poses turned to the most likely angles, in which the model is straight.

    """

    fitted: Sensor
    unit: Sensor
    names: tuple[str, ...]
    stage_sigma_rad: float
    stated_sigma_rad: float
    knocked: tuple[int, ...]
    information: np.ndarray
    distances: np.ndarray
    at: Poses


def fit_full(sensor: Sensor, poses: Poses, terms: Sequence[str] = TERMS) -> FullFit:
    """
    Fit the terms to the poses; see the module.

    Parameters
    ----------
    sensor
        Nominal figures; its stage resolution is the stated error of the stage.
    poses
        Of one unit on one stage.
    terms
        Effects to fit, of the sensor or of the stage, and names of `GAUGE`.

    Raises
    ------
    UserError
        A coefficient is not determined; says which and which poses would help.

    """
    start = linear.fit(sensor, poses)
    effects = [term.split('.')[0] for term in terms]
    unit = with_neutral(replace(start, covariance=np.zeros((0, 0)), covariance_names=()), effects)
    unit = with_neutral(unit, ['base_tilt'])
    names = coefficients(unit.axes, terms)
    stated = sensor.stage_resolution_rad / np.sqrt(12)
    require_determined(unit, poses, names, stated)
    kept, sigma, at, used = np.ones(len(poses), bool), stated, poses, poses
    unit = _solved(unit, poses, names, sigma, kept)
    for i in range(_ROUNDS):
        before = kept, sigma
        for _ in range(1 if i else 3):
            sigma = _stage_sigma(unit, used, names, stated, kept)
            # Angles off by δ leave δ²/2 of g beside the straight line, until they are found.
            bent = sensor.nominal_scale_v_per_g * sigma ** 2 * _SHRINK ** i
            used = replace(at, std_v=np.hypot(at.std_v, bent))
        unit, at = _stepped(unit, poses, used, names, sigma, kept)
        if np.any(bent > _STRAIGHT * poses.std_v.mean(axis=0)):
            continue
        distances = _distances(unit, at, sigma)
        kept = distances < chi2.isf(_KNOCKED, len(unit.axes))
        if kept.mean() < 1 - _MOST_KNOCKED:
            kept = np.ones(len(poses), bool)
        if np.array_equal(kept, before[0]) and abs(sigma - before[1]) <= 1e-3 * max(sigma, 1e-9):
            break
    known = information(unit, at.subset(kept), names, sigma)
    covariance = np.linalg.inv(known)
    of_sensor = [i for i, name in enumerate(names) if not of_stage(name)]
    fitted = replace(
        _without_stage(unit), model='full',
        covariance=covariance[np.ix_(of_sensor, of_sensor)],
        covariance_names=tuple(names[i] for i in of_sensor))
    return FullFit(fitted, unit, names, sigma, stated, tuple(np.flatnonzero(~kept).tolist()),
                   known, distances, at)


def coefficients(axes: str, terms: Sequence[str]) -> tuple[str, ...]:
    """Name what is fitted: the terms' coefficients but for the gauge, and the base's tilt."""
    named = [name for effect in dict.fromkeys(term.split('.')[0] for term in terms)
             for name in names_of(effect_named(effect), axes)
             if not parameter_of(name).shape and not parameter_of(name).optional
             and term_of(name) in terms]
    return (*(n for n in named if not of_stage(n)), *_STAGE,
            *(n for n in named if of_stage(n) and n not in _STAGE))


def term_of(name: str) -> str:
    """Return the term that a coefficient belongs to: its effect, or one of `GAUGE`."""
    effect, parameter = name.split('.')[:2]
    return f'{effect}.{parameter}' if f'{effect}.{parameter}' in GAUGE else effect


def priors(names: Sequence[str]) -> np.ndarray:
    """
    Return the inverse variances that are known beforehand, (p,).

    The level and the gauge are known; a coefficient of the sensor is hardly ever beyond five
    times its typical size, which says nothing where the poses say anything.
    """
    spread = [LEVEL_RAD if name in _STAGE else parameter_of(name).scale * (
        1 if term_of(name) in GAUGE else 3 if of_stage(name) else _HARDLY) for name in names]
    return 1 / np.square(spread)


def information(unit: Sensor, poses: Poses, names: Sequence[str], sigma_rad: float) -> np.ndarray:
    """
    Fisher information of poses about coefficients, priors of the stage included, (p, p).

    Its inverse is the Cramér-Rao bound.

    Parameters
    ----------
    unit
        Where it is taken.
    poses, names, sigma_rad
        As `FullFit` has them.

    """
    return _normal(unit, poses, names, sigma_rad, np.ones(len(poses), bool))[0]


def _normal(unit: Sensor, poses: Poses, names: Sequence[str], sigma: float, kept: np.ndarray
            ) -> tuple[np.ndarray, np.ndarray]:
    """Return the information matrix and the gradient of the log-likelihood with priors."""
    used = poses.subset(kept)
    white = _whitener(unit, used, sigma)
    design = white @ by_coefficients(unit, used, names)
    off = (white @ (used.volts - response(unit, used))[:, :, None])
    flat, residual = design.reshape(-1, len(names)), off.reshape(-1)
    known = priors(names)
    return flat.T @ flat + np.diag(known), flat.T @ residual - known * get(unit, names)


def _whitener(unit: Sensor, poses: Poses, sigma: float) -> np.ndarray:
    return np.linalg.inv(np.linalg.cholesky(pose_covariance(unit, poses, sigma)))


def _solved(unit: Sensor, poses: Poses, names: Sequence[str], sigma: float, kept: np.ndarray
            ) -> Sensor:
    """Gauss-Newton steps to the maximum; the chain is nearly linear in its coefficients."""
    typical = np.array([parameter_of(name).scale for name in names])
    for _ in range(_STEPS):
        information, gradient = _normal(unit, poses, names, sigma, kept)
        scale = 1 / np.sqrt(np.diag(information))
        step = scale * np.linalg.solve(information * np.outer(scale, scale), scale * gradient)
        step *= min(1.0, _LONGEST / np.abs(step / typical).max())
        unit = put(unit, names, get(unit, names) + step)
        if np.abs(step / scale).max() < _CONVERGED:
            break
    return unit


def _stage_sigma(unit: Sensor, poses: Poses, names: Sequence[str], stated: float,
                 kept: np.ndarray) -> float:
    """
    Estimate the stage's error from the residuals: restricted maximum likelihood.

    The stated one stands where too few residuals are left to judge it. Poses that are knocked
    must not pass for a bad stage: while a few are far off, the middle of the rest decides.
    """
    if kept.sum() * len(unit.axes) - len(names) < _FEWEST_SPARE:
        return stated
    used = poses.subset(kept)
    off = used.volts - response(unit, used)
    slope = by_angles(unit, used)
    design = by_coefficients(unit, used, names)
    noise = used.std_v[:, :, None] ** 2 * np.eye(len(unit.axes))
    spread = slope @ np.swapaxes(slope, 1, 2)
    known = np.diag(priors(names))
    bound = chi2.isf(1e-3, len(unit.axes))

    def cost(log_sigma: float) -> float:
        covariance = noise + np.exp(2 * log_sigma) * spread
        inverse = np.linalg.inv(covariance)
        distance = np.einsum('ki,kij,kj->k', off, inverse, off)
        # Beyond the bound a pose's surprise grows as its root (Huber 1964).
        tamed = np.where(distance < bound, distance,
                         2 * np.sqrt(bound * np.maximum(distance, bound)) - bound)
        information = np.tensordot(design, inverse @ design, ((0, 1), (0, 1))) + known
        return float(np.sum(tamed) + np.linalg.slogdet(covariance)[1].sum()
                     + np.linalg.slogdet(information)[1])

    found = minimize_scalar(cost, bounds=(np.log(1e-6), np.log(0.3)), method='bounded')
    return float(np.exp(found.x))


def _stepped(unit: Sensor, poses: Poses, at: Poses, names: Sequence[str], sigma: float,
             kept: np.ndarray) -> tuple[Sensor, Poses]:
    """
    Go to the most likely coefficients and angles, or as far on the way as it gets better.

    `poses` are as measured, `at` the same about the angles before, see `_moved`.
    """
    before = get(unit, names), np.column_stack([at.alpha_rad - poses.alpha_rad,
                                                at.beta_rad - poses.beta_rad])
    solved = _solved(unit, at, names, sigma, kept)
    slope = by_angles(solved, at)
    off = (at.volts - response(solved, at))[:, :, None]
    inverse = np.linalg.inv(pose_covariance(solved, at, sigma))
    after = get(solved, names), (sigma ** 2 * np.swapaxes(slope, 1, 2) @ inverse @ off)[:, :, 0]
    known = priors(names)

    def cost(values: np.ndarray, step: np.ndarray) -> float:
        left = poses.volts - response(put(unit, names, values), _turned(poses, step))
        return float(np.sum((left / at.std_v)[kept] ** 2) + np.sum(known * values ** 2)
                     + np.sum((step / max(sigma, 1e-9))[kept] ** 2))

    worst = cost(*before)
    for share in 0.5 ** np.arange(8):
        values, step = (b + share * (a - b) for b, a in zip(before, after))
        if cost(values, step) <= worst:
            break
    unit = put(unit, names, values)
    return unit, _moved(unit, poses, step)


def _turned(poses: Poses, step_rad: np.ndarray) -> Poses:
    return replace(poses, alpha_rad=poses.alpha_rad + step_rad[:, 0],
                   beta_rad=poses.beta_rad + step_rad[:, 1])


def _moved(unit: Sensor, poses: Poses, step_rad: np.ndarray) -> Poses:
    """
    Turn poses to more likely angles, (k, 2) of steps.

    What the model makes of the steps is added to the volts, so that they are linear in the error
    of the measured angles.
    """
    there = _turned(poses, step_rad)
    return replace(there, volts=poses.volts + (by_angles(unit, there)
                                               @ step_rad[:, :, None])[:, :, 0])


def _distances(unit: Sensor, poses: Poses, sigma: float) -> np.ndarray:
    off = (poses.volts - response(unit, poses))[:, :, None]
    return np.sum((_whitener(unit, poses, sigma) @ off) ** 2, axis=(1, 2))


def of_stage(name: str) -> bool:
    """Tell whether a coefficient is the stage's and not the sensor's."""
    return effect_named(name.split('.')[0]).place is Place.STAGE


def _without_stage(unit: Sensor) -> Sensor:
    effects = tuple(e for e in unit.effects if effect_named(e).place is not Place.STAGE)
    return replace(unit, effects=effects, values={e: unit.values[e] for e in effects})


def require_determined(unit: Sensor, poses: Poses, names: Sequence[str], sigma: float) -> None:
    """
    Refuse poses that tell less of a coefficient than its typical size does.

    Raises
    ------
    UserError
        Names the coefficients and the poses that would determine them.

    """
    scale = np.array([parameter_of(name).scale for name in names])
    vague = [not of_stage(name) and term_of(name) not in GAUGE for name in names]
    told = information(unit, poses, names, sigma) - np.diag(priors(names) * vague)
    known = told * np.outer(scale, scale)
    weak = np.linalg.inv(known + 1e-6 * np.eye(len(names)))
    lost = [name for name, variance, need in zip(names, np.diag(weak), vague)
            if variance > 1.0 and need]
    if lost or poses.volts.size <= len(names):
        add = ', '.join(f'({np.degrees(a):.0f}, {np.degrees(b):.0f})'
                        for a, b in next_poses(unit, poses, names, sigma))
        raise UserError(
            f'the full model is not determined by {len(poses)} poses: they do not tell '
            f'{", ".join(lost) or "more than they have figures"}; add poses (alpha, beta) = {add} '
            'deg, or fit --model physical or linear')


def next_poses(unit: Sensor, poses: Poses, names: Sequence[str], sigma: float, count: int = 4
               ) -> list[tuple[float, float]]:
    """
    Choose poses that would help most, one after the other: alpha and beta, rad.

    Each is the one of a grid of 15° that shrinks the volume of the joint interval of all
    coefficients, in units of their typical size, the most (D-optimality; Fedorov 1972).

    Parameters
    ----------
    unit, poses, names, sigma
        As the fit has them.
    count
        How many.

    """
    alpha, beta = (g.ravel() for g in np.meshgrid(np.radians(np.arange(0, 181, 15.0)),
                                                  np.radians(np.arange(0, 360, 15.0))))
    grid = Poses(np.zeros((len(alpha), len(unit.axes))),
                 np.tile(np.median(poses.std_v, axis=0), (len(alpha), 1)), alpha, beta,
                 np.zeros((len(alpha), 2)), np.zeros(len(alpha), bool))
    scale = np.array([parameter_of(name).scale for name in names])
    rows = _whitener(unit, grid, sigma) @ by_coefficients(unit, grid, names) * scale
    known = information(unit, poses, names, sigma) * np.outer(scale, scale)
    chosen = []
    for _ in range(count):
        covariance = np.linalg.inv(known + 1e-6 * np.eye(len(names)))
        gain = np.linalg.slogdet(np.eye(rows.shape[1])
                                 + rows @ covariance @ np.swapaxes(rows, 1, 2))[1]
        best = int(np.argmax(gain))
        chosen.append((float(alpha[best]), float(beta[best])))
        known = known + rows[best].T @ rows[best]
    return chosen
