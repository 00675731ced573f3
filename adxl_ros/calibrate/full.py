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
S = diag(std²) + σ²·JJᵀ, J = ∂V/∂(α, β) (errors in variables; Fuller 1987, section 3.2). The tilt
of the base is fitted beside the sensor, with its prior, and left out of the result.

Gauge: p0, q0 of (11) and (13) belong to the zero-g and r0 of (15) to the scale factor; p1 and q1
are the misalignment, `cross_axis.linear` and `cross_axis_z.linear` stay 0. At rest x² + y² + z² is
g², so that a square of the own axis is those of the others and `quadratic` stays out. The case's x
is where beta = 0 points, so that an offset of beta is part of the misalignment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from adxl_ros.calibrate import linear
from adxl_ros.calibrate.poses import Poses
from adxl_ros.errors import UserError
from adxl_ros.model import chain
from adxl_ros.model.coefficients import get, names_of, parameter_of, put, with_neutral
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Joint, Place, Signals
from adxl_ros.model.sensor import Sensor
from adxl_ros.model.stage import specific_force, UPRIGHT
import numpy as np
from scipy.optimize import minimize_scalar
from scipy.stats import chi2

TERMS = ('bias', 'scale_factor', 'misalignment', 'cross_axis', 'cross_axis_z', 'scale_factor_z',
         'nonlinearity')
GAUGE = ('cross_axis.linear', 'cross_axis_z.linear')
LEVEL_RAD = np.radians(0.1)
"""Standard deviation of the level of the base, each way: the paper's 0.1°."""
_STAGE = ('base_tilt.x_rad', 'base_tilt.y_rad')
_KNOCKED = 1e-6
"""A pose less likely than this is disturbed, as long as such poses are few."""
_MOST_KNOCKED = 0.2
_ANGLE_STEP_RAD = 1e-4
_ROUNDS = 12
_CONVERGED = 1e-4
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

    """

    fitted: Sensor
    names: tuple[str, ...]
    stage_sigma_rad: float
    stated_sigma_rad: float
    knocked: tuple[int, ...]
    information: np.ndarray
    distances: np.ndarray


def fit(sensor: Sensor, poses: Poses) -> Sensor:
    """
    Fit the full model.

    Raises
    ------
    UserError
        The poses do not determine it; see `fit_full`.

    """
    return fit_full(sensor, poses).fitted


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
        Effects to fit, of the sensor or of the stage.

    Raises
    ------
    UserError
        A coefficient is not determined; says which and which poses would help.

    """
    start = linear.fit(sensor, poses)
    unit = with_neutral(replace(start, covariance=np.zeros((0, 0)), covariance_names=()), terms)
    unit = with_neutral(unit, ['base_tilt'])
    names = coefficients(unit.axes, terms)
    stated = sensor.stage_resolution_rad / np.sqrt(12)
    kept, sigma = np.ones(len(poses), bool), stated
    require_determined(unit, poses, names, stated)
    for _ in range(4):
        before = kept, sigma
        unit = _solved(unit, poses, names, sigma, kept)
        sigma = _stage_sigma(unit, poses, names, stated, kept)
        unit = _solved(unit, poses, names, sigma, kept)
        distances = _distances(unit, poses, sigma)
        kept = distances < chi2.isf(_KNOCKED, len(unit.axes))
        if kept.mean() < 1 - _MOST_KNOCKED:
            kept = np.ones(len(poses), bool)
        if np.array_equal(kept, before[0]) and abs(sigma - before[1]) <= 1e-3 * max(sigma, 1e-9):
            break
    information = _normal(unit, poses, names, sigma, kept)[0]
    covariance = np.linalg.inv(information)
    of_sensor = [i for i, name in enumerate(names) if not _of_stage(name)]
    fitted = replace(
        _without_stage(unit), model='full',
        covariance=covariance[np.ix_(of_sensor, of_sensor)],
        covariance_names=tuple(names[i] for i in of_sensor))
    return FullFit(fitted, names, sigma, stated, tuple(np.flatnonzero(~kept).tolist()),
                   information, distances)


def coefficients(axes: str, terms: Sequence[str]) -> tuple[str, ...]:
    """Name what is fitted: the terms' coefficients but for the gauge, and the base's tilt."""
    of_sensor = [name for term in terms for name in names_of(effect_named(term), axes)
                 if name.rsplit('.', 1)[0] not in GAUGE and not parameter_of(name).shape
                 and not _of_stage(name)]
    of_stage = [name for term in terms for name in names_of(effect_named(term), axes)
                if _of_stage(name) and name not in _STAGE]
    return (*of_sensor, *_STAGE, *of_stage)


def response(unit: Sensor, alpha_rad: np.ndarray, beta_rad: np.ndarray) -> np.ndarray:
    """Return the volts that the chain promises at the stage's angles, (k, m)."""
    signals = Signals(chain.NOMINAL, alpha=Joint(alpha_rad), beta=Joint(beta_rad),
                      up=list(UPRIGHT), gravity_mps2=unit.local_gravity_mps2)
    for apply, values in chain.applied(unit, Place.STAGE):
        apply(signals, values)
    force = specific_force(signals.alpha.position, signals.beta.position, signals.gravity_mps2,
                           0.0, signals.up)
    return np.column_stack(np.broadcast_arrays(*chain.static_response(unit)(force)))


def by_angles(unit: Sensor, alpha_rad: np.ndarray, beta_rad: np.ndarray) -> np.ndarray:
    """Differentiate volts by alpha and beta, V/rad, (k, m, 2)."""
    h = _ANGLE_STEP_RAD
    return np.stack([
        (response(unit, alpha_rad + h * a, beta_rad + h * b)
         - response(unit, alpha_rad - h * a, beta_rad - h * b)) / (2 * h)
        for a, b in ((1, 0), (0, 1))], axis=2)


def by_coefficients(unit: Sensor, alpha_rad: np.ndarray, beta_rad: np.ndarray,
                    names: Sequence[str]) -> np.ndarray:
    """Differentiate volts by coefficients, V a unit, (k, m, p)."""
    columns = []
    for name in names:
        at, step = get(unit, [name]), 1e-3 * parameter_of(name).scale
        above, below = (response(put(unit, [name], at + by), alpha_rad, beta_rad)
                        for by in (step, -step))
        columns.append((above - below) / (2 * step))
    return np.stack(columns, axis=2)


def pose_covariance(unit: Sensor, poses: Poses, sigma_rad: float) -> np.ndarray:
    """Covariance of the volts of each pose about the model, V², (k, m, m); see the module."""
    slope = by_angles(unit, poses.alpha_rad, poses.beta_rad)
    noise = poses.std_v[:, :, None] ** 2 * np.eye(len(unit.axes))
    return noise + sigma_rad ** 2 * slope @ np.swapaxes(slope, 1, 2)


def priors(names: Sequence[str]) -> np.ndarray:
    """Return the inverse variances that are known beforehand: of the stage's errors, (p,)."""
    spread = np.array([LEVEL_RAD if name in _STAGE else parameter_of(name).scale * 3
                       for name in names])
    return np.where([_of_stage(name) for name in names], 1 / spread ** 2, 0.0)


def _normal(unit: Sensor, poses: Poses, names: Sequence[str], sigma: float, kept: np.ndarray
            ) -> tuple[np.ndarray, np.ndarray]:
    """Return the information matrix and the gradient of the log-likelihood with priors."""
    used = poses.subset(kept)
    white = _whitener(unit, used, sigma)
    design = white @ by_coefficients(unit, used.alpha_rad, used.beta_rad, names)
    off = (white @ (used.volts - response(unit, used.alpha_rad, used.beta_rad))[:, :, None])
    flat, residual = design.reshape(-1, len(names)), off.reshape(-1)
    known = priors(names)
    return flat.T @ flat + np.diag(known), flat.T @ residual - known * get(unit, names)


def _whitener(unit: Sensor, poses: Poses, sigma: float) -> np.ndarray:
    return np.linalg.inv(np.linalg.cholesky(pose_covariance(unit, poses, sigma)))


def _solved(unit: Sensor, poses: Poses, names: Sequence[str], sigma: float, kept: np.ndarray
            ) -> Sensor:
    """Gauss-Newton steps to the maximum; the chain is nearly linear in its coefficients."""
    for _ in range(_ROUNDS):
        information, gradient = _normal(unit, poses, names, sigma, kept)
        scale = 1 / np.sqrt(np.diag(information))
        step = scale * np.linalg.solve(information * np.outer(scale, scale), scale * gradient)
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
    off = used.volts - response(unit, used.alpha_rad, used.beta_rad)
    slope = by_angles(unit, used.alpha_rad, used.beta_rad)
    design = by_coefficients(unit, used.alpha_rad, used.beta_rad, names)
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
        information = np.einsum('kip,kij,kjq->pq', design, inverse, design) + known
        return float(np.sum(tamed) + np.linalg.slogdet(covariance)[1].sum()
                     + np.linalg.slogdet(information)[1])

    found = minimize_scalar(cost, bounds=(np.log(1e-6), np.log(0.3)), method='bounded')
    return float(np.exp(found.x))


def _distances(unit: Sensor, poses: Poses, sigma: float) -> np.ndarray:
    off = (poses.volts - response(unit, poses.alpha_rad, poses.beta_rad))[:, :, None]
    return np.sum((_whitener(unit, poses, sigma) @ off) ** 2, axis=(1, 2))


def _of_stage(name: str) -> bool:
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
    everyone = np.ones(len(poses), bool)
    information = _normal(unit, poses, names, sigma, everyone)[0]
    scale = np.array([parameter_of(name).scale for name in names])
    weak = np.linalg.inv(information * np.outer(scale, scale) + 1e-6 * np.eye(len(names)))
    lost = [name for name, variance in zip(names, np.diag(weak)) if variance > 1.0]
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
    rows = _whitener(unit, grid, sigma) @ by_coefficients(unit, alpha, beta, names) * scale
    everyone = np.ones(len(poses), bool)
    information = _normal(unit, poses, names, sigma, everyone)[0] * np.outer(scale, scale)
    chosen = []
    for _ in range(count):
        covariance = np.linalg.inv(information + 1e-6 * np.eye(len(names)))
        gain = np.linalg.slogdet(np.eye(rows.shape[1])
                                 + rows @ covariance @ np.swapaxes(rows, 1, 2))[1]
        best = int(np.argmax(gain))
        chosen.append((float(alpha[best]), float(beta[best])))
        information = information + rows[best].T @ rows[best]
    return chosen
