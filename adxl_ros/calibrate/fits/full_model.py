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
V = h(f(α + δα, β + δβ; tilt); θ) + noise of the mean. A joint has one error for each of its
settings, and may have one for each pose beside it (`stage_error`). The errors are integrated out:
poses weigh by the inverse of their common covariance S (errors in variables; Fuller 1987, section
3.2), taken at the most likely angles, so that a stage that is off by degrees is still straight.
The levels of the stage's error are those of the greatest restricted likelihood (`linearised`).
The tilt of the base is fitted beside the sensor, with its prior, and left out of the result.

Gauge: p0, q0 of (11) and (13) belong to the zero-g and r0 of (15) to the scale factor; p1 and q1
are the misalignment to first order, so that `cross_axis.linear` and `cross_axis_z.linear` stay 0.
Products tell them apart, by r1·p1·z·c and the like: where poses held out ask for it (see
`term_selection`), the two are fitted, too, with the datasheet's 1.5 % for prior. At rest
x² + y² + z² is g², so that a square of the own axis is those of the others and `quadratic` stays
out. The case's x is where beta = 0 points, so that an offset of beta is part of the misalignment.

A three-axis unit has the same kinds of terms on each axis: squares of both other axes
(`cross_axis`, `cross_axis_z`), a scale factor that depends on either (`scale_factor_cross`,
`scale_factor_z`), and a cube. A two-axis unit has those of the paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from adxl_ros.calibrate import pose_response
from adxl_ros.calibrate.fits import d_optimal, linear
from adxl_ros.calibrate.fits.linearised import Linearised, linearised
from adxl_ros.calibrate.pose_response import predicted_volts
from adxl_ros.calibrate.poses import Poses
from adxl_ros.calibrate.stage_error import AngleErrors, PoseCovariance, StageError
from adxl_ros.errors import UserError
from adxl_ros.model.coefficients import get, names_of, parameter_of, put, with_neutral
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Coefficient, Parameter, Place, Role
from adxl_ros.model.gauss_newton import gauss_newton, halve_until, Iterate, Solution
from adxl_ros.model.sensor import Sensor
import numpy as np
from scipy.stats import chi2

TERMS = ('bias', 'scale_factor', 'misalignment', 'cross_axis', 'cross_axis_z', 'scale_factor_z',
         'nonlinearity')
_THREE_AXES = ('scale_factor_cross',)
"""Terms that a three-axis unit has beside those of the paper."""
_OPTIONAL = ('nonlinearity',)
"""Terms that may stay as open as their prior leaves them: most units hardly have them."""
GAUGE = ('cross_axis.linear', 'cross_axis_z.linear')
"""Terms that are 0 unless the poses show them beside the misalignment."""
LEVEL_STD_RAD = np.radians(0.1)
"""Standard deviation of the level of the base, each way: the paper's 0.1°."""
_STAGE = (Coefficient('base_tilt', 'x_rad'), Coefficient('base_tilt', 'y_rad'))
_HARDLY = 5.0
_KNOCKED = 1e-6
"""A pose less likely than this is disturbed, as long as such poses are few."""
_MOST_KNOCKED = 0.2
_ROUNDS = 16
"""Rounds of levels, coefficients and angles."""
_STEPS = 12
"""Gauss-Newton steps to the first solution."""
_STEPS_A_ROUND = 2
_HALVINGS = 7
_SHRINK, _STRAIGHT = 0.2, 0.1
_CONVERGED = 1e-4
"""A step shorter than this, in standard deviations of each coefficient, is the last."""
_SHORT = 1e-2
"""Coefficients that move by less in a round, in standard deviations, have settled."""
_SETTLED = 1e-2
"""The levels have settled when the deviance changes by less in a round."""
_GRID_RAD = np.radians(15.0)
"""Step of the grid from which further poses are chosen."""
_SHAPE_STEP, _SHAPE_STEPS = 1.05, 60
"""Figures of shape are searched by steps of 5 %, up to 19 times the typical one each way."""
_FINE = 15
"""Values tried between the neighbours of the likeliest."""
_FEW = 3
"""Starts of a figure of shape."""
_LONGEST = 3.0
"""Longest step, in typical sizes."""


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
    stage
        Levels of the stage's error.
    stated_std_rad
        Standard deviation of a joint's error as it is stated: step/√12, rad.
    outliers
        Numbers of the poses that were left out as disturbed.
    information
        Inverse covariance of `names`, priors included.
    distances
        Squared Mahalanobis distance of each pose, given its settings, (k,).
    at
        The poses turned to the most likely angles, in which the model is straight.
    deviance
        −2 times the logarithm of the restricted likelihood, but for a constant.
    converged
        Whether coefficients, levels and the choice of disturbed poses settled.

    """

    fitted: Sensor
    unit: Sensor
    names: tuple[Coefficient, ...]
    stage: StageError
    stated_std_rad: float
    outliers: tuple[int, ...]
    information: np.ndarray
    distances: np.ndarray
    at: Poses
    deviance: float
    converged: bool

    @property
    def stage_std_rad(self) -> float:
        """Return the standard deviation of a joint's error in one pose, rad."""
        return self.stage.total_rad

    @property
    def kept(self) -> np.ndarray:
        """Tell which poses were not left out, (k,)."""
        return ~np.isin(np.arange(len(self.at)), self.outliers)


def default_terms(axes: str) -> tuple[str, ...]:
    """Return the terms of the full model for a unit with these axes."""
    return TERMS + (_THREE_AXES if axes == 'xyz' else ())


def fit_full(sensor: Sensor, poses: Poses, terms: Sequence[str] | None = None) -> FullFit:
    """
    Fit the terms to the poses; see the module.

    A term that is not convex, in a figure of shape, is started several times; the fit of the
    greatest likelihood counts.

    Parameters
    ----------
    sensor
        Nominal figures; its stage resolution is the stated error of the stage.
    poses
        Of one unit on one stage.
    terms
        Effects to fit, of the sensor or of the stage, and names of `GAUGE`; `default_terms` the
        sensor's axes unless given.

    Raises
    ------
    UserError
        A coefficient is not determined; says which and which poses would help.

    """
    terms = default_terms(sensor.axes) if terms is None else terms
    start = linear.fit(sensor, poses)
    effects = [effect_of(term) for term in terms]
    unit = with_neutral(start.without_covariance(), effects)
    unit = with_neutral(unit, ['base_tilt'])
    names = fitted_coefficients(unit.axes, terms)
    stated = StageError(sensor.stage_resolution_rad / np.sqrt(12))
    fits, failure = [], None
    for begin in _starts(unit, poses, names, effects, stated):
        try:
            require_determined(begin, poses, names, stated)
            fits.append(_fit_from(begin, poses, names, stated))
        except UserError as error:
            failure = failure or error
    if not fits:
        assert failure is not None
        raise failure
    return min(fits, key=lambda fit: fit.deviance)


def _starts(unit: Sensor, poses: Poses, names: Sequence[Coefficient], effects: Sequence[str],
            stage: StageError) -> list[Sensor]:
    """
    Return the units from which a fit begins: several where a term is not convex.

    The volts are nearly linear in all coefficients but in figures of shape (periods, time
    constants). Those are searched over their range, and the likeliest few are the starts.
    """
    starts = [unit]
    for name in effects:
        for p in effect_named(name).parameters:
            if p.role is not Role.SHAPE or p.held or not effect_named(name).invertible:
                continue
            coarse = p.scale * _SHAPE_STEP ** np.arange(-_SHAPE_STEPS, _SHAPE_STEPS + 1)
            likely = _likeliest(unit, poses, names, (name, p), coarse, stage)[:_FEW]
            fine = likely[0] * _SHAPE_STEP ** np.linspace(-1, 1, _FINE)
            best = _likeliest(unit, poses, names, (name, p), fine, stage)[0]
            starts += [_shaped(unit, (name, p), shape) for shape in (best, *likely[1:])]
    return starts


def _likeliest(unit: Sensor, poses: Poses, names: Sequence[Coefficient],
               shape: tuple[str, Parameter], values: np.ndarray, stage: StageError
               ) -> list[float]:
    """Return values of a figure of shape within its bounds, the likeliest first."""
    _, parameter = shape
    within = values[(parameter.lower <= values) & (values <= parameter.upper)]
    precision = prior_precision(names)
    misfit = [linearised(_shaped(unit, shape, value), poses, names, precision).misfit(stage)
              for value in within]
    return [float(value) for value in within[np.argsort(misfit)]]


def _shaped(unit: Sensor, shape: tuple[str, Parameter], value: float) -> Sensor:
    name, parameter = shape
    values = unit.values[name]
    changed = {**values, parameter.name: np.full(np.shape(values[parameter.name]), value)}
    return replace(unit, values={**unit.values, name: changed})


def _fit_from(unit: Sensor, poses: Poses, names: tuple[Coefficient, ...],
              stated: StageError) -> FullFit:
    """Fit from a start: levels, coefficients and angles in turn, until all of them settle."""
    known, everything = prior_precision(names), np.ones(len(poses), bool)
    kept, stage, at, std_v = everything, stated, poses, poses.std_v
    unit = put(unit, names, _solved(unit, poses, names, stage, kept, _STEPS).last.values)
    error_rad = AngleErrors(*(np.zeros((len(poses), 2)),) * 2, np.zeros(len(poses)), 0.0)
    converged, deviance = False, np.inf
    for i in range(_ROUNDS):
        kept_before, deviance_before = kept, deviance
        for _ in range(1 if i else 3):
            about = linearised(unit, replace(at, std_v=std_v), names, known, kept)
            stage = about.stage_error(stated.total_rad, stage)
            # Angles off by δ leave δ²/2 of g beside the straight line, until they are found.
            bent_v = unit.nominal_scale_v_per_g * stage.total_rad ** 2 * _SHRINK ** i
            std_v = np.hypot(poses.std_v, bent_v)
        unit, error_rad, length = _stepped(unit, poses, replace(at, std_v=std_v), names, stage,
                                           kept, error_rad)
        at = _moved(unit, poses, error_rad.total_rad)
        if np.any(bent_v > _STRAIGHT * poses.std_v.mean(axis=0)):
            continue
        about = linearised(unit, at, names, known, kept)
        deviance = about.deviance(stage)
        distances = about.covariance(stage).predicted(about.residual).distances
        kept = distances < chi2.isf(_KNOCKED, len(unit.axes))
        if kept.mean() < 1 - _MOST_KNOCKED:
            kept = everything
        if np.array_equal(kept, kept_before) and length < _SHORT and \
                abs(deviance - deviance_before) < _SETTLED:
            converged = True
            break
    about = linearised(unit, at, names, known, kept)
    covariance = about.covariance(stage)
    _, fisher = about.solve(covariance)
    of_sensor = [i for i, name in enumerate(names) if not belongs_to_stage(name)]
    fitted = replace(
        _without_stage(unit), model='full',
        covariance=np.linalg.inv(fisher)[np.ix_(of_sensor, of_sensor)],
        covariance_names=tuple(names[i] for i in of_sensor))
    return FullFit(fitted, unit, names, stage, stated.total_rad,
                   tuple(np.flatnonzero(~kept).tolist()), fisher,
                   covariance.predicted(about.residual).distances, at, about.deviance(stage),
                   converged)


def fitted_coefficients(axes: str, terms: Sequence[str]) -> tuple[Coefficient, ...]:
    """Name what is fitted: the terms' coefficients but for the gauge, and the base's tilt."""
    named = [name for effect in dict.fromkeys(map(effect_of, terms))
             for name in names_of(effect_named(effect), axes)
             if parameter_of(name).role not in (Role.SHAPE, Role.OPTIONAL)
             and term_of(name) in terms]
    return (*(n for n in named if not belongs_to_stage(n)), *_STAGE,
            *(n for n in named if belongs_to_stage(n) and n not in _STAGE))


def term_of(name: Coefficient) -> str:
    """Return the term that a coefficient belongs to: its effect, or one of `GAUGE`."""
    parameter = str(name.without_axis)
    return parameter if parameter in GAUGE else name.effect


def effect_of(term: str) -> str:
    """Return the effect of a term, which is its name or one of `GAUGE`."""
    return Coefficient.parse(term).effect if term in GAUGE else term


def prior_precision(names: Sequence[Coefficient]) -> np.ndarray:
    """
    Return the inverse variances that are known beforehand, (p,).

    The level and the gauge are known; a coefficient of the sensor is hardly ever beyond five
    times its typical size, which says nothing where the poses say anything.
    """
    spread = [LEVEL_STD_RAD if name in _STAGE else parameter_of(name).scale * (
        1 if term_of(name) in GAUGE else 3 if belongs_to_stage(name) else _HARDLY)
        for name in names]
    return 1 / np.square(spread)


def fisher_information(unit: Sensor, poses: Poses, names: Sequence[Coefficient], stage: StageError
                ) -> np.ndarray:
    """
    Fisher information of poses about coefficients, priors of the stage included, (p, p).

    Its inverse is the Cramér-Rao bound.

    Parameters
    ----------
    unit
        Where it is taken.
    poses
        With the noise of their means, angles and settings.
    names, stage
        As `FullFit` has them.

    """
    about = linearised(unit, poses, names, prior_precision(names))
    return about.solve(about.covariance(stage))[1]


@dataclass(frozen=True)
class _Iterate(Iterate):
    """An iterate with the linearised poses, their covariance, and the information, (p, p)."""

    about: Linearised
    covariance: PoseCovariance
    information: np.ndarray

    @property
    def step_std(self) -> float:
        """Return the longest component of the step in its standard deviations."""
        return float(np.abs(self.step * np.sqrt(np.diag(self.information))).max())


def _solved(unit: Sensor, poses: Poses, names: Sequence[Coefficient], stage: StageError,
            kept: np.ndarray, steps: int) -> Solution[_Iterate]:
    """Take Gauss-Newton steps; the chain is nearly linear in its coefficients."""
    sizes = np.array([parameter_of(name).scale for name in names])

    def linearise(values: np.ndarray) -> _Iterate:
        about = linearised(put(unit, names, values), poses, names, prior_precision(names), kept)
        covariance = about.covariance(stage)
        step, information = about.solve(covariance)
        step *= min(1.0, _LONGEST / np.abs(step / sizes).max())
        return _Iterate(values, step, 0.0, about, covariance, information)

    return gauss_newton(
        linearise, get(unit, names),
        lambda _, previous, __: previous is not None and previous.step_std < _CONVERGED,
        steps + 1)


def _stepped(unit: Sensor, poses: Poses, at: Poses, names: Sequence[Coefficient],
             stage: StageError, kept: np.ndarray, before: AngleErrors
             ) -> tuple[Sensor, AngleErrors, float]:
    """
    Go to the most likely coefficients and angles, or as far on the way as it gets better.

    Parameters
    ----------
    unit
        Where the round begins.
    poses, at
        As measured, and the same turned to the angles before; see `_moved`.
    names, stage, kept
        Coefficients, levels of the stage's error, and poses that count.
    before
        Errors of the angles before.

    Returns
    -------
    tuple
        The unit, the errors of the angles, and the longest step of a coefficient in its standard
        deviations.

    """
    solved = _solved(unit, at, names, stage, kept, _STEPS_A_ROUND).last
    covariance, known = solved.covariance, prior_precision(names)
    errors = covariance.predicted(solved.about.residual)
    start, end = get(unit, names), solved.values

    def between(share: float) -> tuple[np.ndarray, AngleErrors]:
        return start + share * (end - start), before.towards(errors, share)

    def cost(values: np.ndarray, angles: AngleErrors) -> float:
        left = poses.volts - predicted_volts(put(unit, names, values),
                                             _turned(poses, angles.total_rad))
        return float(np.sum((left / at.std_v)[kept] ** 2) + np.sum(known * values ** 2)
                     + covariance.penalty(angles))

    highest = cost(start, before)
    (values, angles), _, _ = halve_until(between, lambda trial: cost(*trial) <= highest, _HALVINGS)
    length = np.abs((values - start) * np.sqrt(np.diag(solved.information))).max()
    return put(unit, names, values), angles, float(length)


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
    return replace(there, volts=poses.volts + (pose_response.angle_jacobian(unit, there)
                                               @ step_rad[:, :, None])[:, :, 0])


def belongs_to_stage(name: Coefficient) -> bool:
    """Tell whether a coefficient is the stage's and not the sensor's."""
    return effect_named(name.effect).place is Place.STAGE


def _without_stage(unit: Sensor) -> Sensor:
    effects = tuple(e for e in unit.effects if effect_named(e).place is not Place.STAGE)
    return replace(unit, effects=effects, values={e: unit.values[e] for e in effects})


def require_determined(unit: Sensor, poses: Poses, names: Sequence[Coefficient],
                       stage: StageError) -> None:
    """
    Refuse poses that tell less of a coefficient than its typical size does.

    Raises
    ------
    UserError
        Names the coefficients and the poses that would determine them.

    """
    scale = np.array([parameter_of(name).scale for name in names])
    vague = [not belongs_to_stage(name) and term_of(name) not in (*GAUGE, *_OPTIONAL)
             for name in names]
    told = fisher_information(unit, poses, names, stage) - np.diag(prior_precision(names) * vague)
    known = told * np.outer(scale, scale)
    weak = np.linalg.inv(known + 1e-6 * np.eye(len(names)))
    lost = [str(name) for name, variance, need in zip(names, np.diag(weak), vague)
            if variance > 1.0 and need]
    if lost or poses.volts.size <= len(names):
        add = ', '.join(f'({np.degrees(a):.0f}, {np.degrees(b):.0f})'
                        for a, b in next_poses(unit, poses, names, stage))
        raise UserError(
            f'the full model is not determined by {len(poses)} poses: they do not tell '
            f'{", ".join(lost) or "more than they have figures"}; add poses (alpha, beta) = {add} '
            'deg, or fit --model physical or linear')


def next_poses(unit: Sensor, poses: Poses, names: Sequence[Coefficient], stage: StageError,
               count: int = 4) -> list[tuple[float, float]]:
    """
    Choose poses that would help most, one after the other: alpha and beta, rad.

    Each is the one of a grid of 15° that shrinks the volume of the joint interval of all
    coefficients, in units of their typical size, the most (D-optimality; Fedorov 1972). Each is a
    new setting of both joints.

    Parameters
    ----------
    unit, poses, names, stage
        As the fit has them.
    count
        How many.

    """
    grid = d_optimal.candidate_poses(np.median(poses.std_v, axis=0), _GRID_RAD)
    scale = np.array([parameter_of(name).scale for name in names])
    rows = d_optimal.whitened_jacobian(unit, grid, tuple(names), stage) * scale
    known = fisher_information(unit, poses, names, stage) * np.outer(scale, scale)
    return [(float(grid.alpha_rad[i]), float(grid.beta_rad[i])) for i in
            d_optimal.choose_poses(rows, known + 1e-6 * np.eye(len(names)), count)]
