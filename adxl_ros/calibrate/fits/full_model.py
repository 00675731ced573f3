# SPDX-License-Identifier: Apache-2.0

"""
The full model: one maximum-likelihood fit of all poses and axes, with the error of the stage.

The volts of a pose are V = h(f(α + δα, β + δβ; tilt); θ) + noise of the mean: the stage has not
quite reached the angles of the encoder. A joint has one error for each of its settings, and may
have another for each pose (`stage_error`). The errors are integrated out: the weight of the poses
is the inverse of their common covariance S (errors in variables; Fuller 1987, section 3.2). S is
taken at the most likely angles, so that the model is linear there even if the stage is degrees
off. The stage error maximises the restricted likelihood (`linearised`). The tilt of the base is a
nuisance parameter with a prior.

Gauge: p0, q0 of (11) and (13) belong to the zero-g and r0 of (15) to the scale factor. p1 and q1
are the misalignment to first order, so that `cross_axis.linear` and `cross_axis_z.linear` stay 0.
Products such as r1·p1·z·c distinguish them. Where these are significant
(`gauge_is_identifiable`), both are fitted, with the datasheet's 1.5 % as prior. At rest
x² + y² + z² is g², so that a square of the own axis equals those of the others, and `quadratic` is
not fitted. The case's x is where beta = 0 points, so that an offset of beta is part of the
misalignment.

A three-axis sensor has the same kinds of terms on each axis: squares of both other axes
(`cross_axis`, `cross_axis_z`), a scale factor that depends on either (`scale_factor_cross`,
`scale_factor_z`), and a cube. A two-axis sensor has those of the paper and a cube.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain

from adxl_ros.calibrate.fits import linear, optimal_poses, pose_covariance
from adxl_ros.calibrate.fits.linearisation import Linearised, linearised
from adxl_ros.calibrate.fits.pose_covariance import StageError
from adxl_ros.calibrate.pose_model import angle_jacobian, predicted_volts
from adxl_ros.calibrate.poses import Poses
from adxl_ros.errors import UserError
from adxl_ros.model.constants import AXES
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Coefficient, Place, Role
from adxl_ros.model.error_sizes import stds
from adxl_ros.model.gauss_newton import gauss_newton, Iterate
from adxl_ros.model.sensor import coefficients_of, get, parameter_of, put, Sensor, with_neutral
from adxl_ros.wording import usage
import numpy as np
import scipy

TERMS = (
    'bias',
    'scale_factor',
    'misalignment',
    'cross_axis',
    'cross_axis_z',
    'scale_factor_z',
    'nonlinearity',
)
"""Terms of a two-axis sensor: those of the paper, and a cube."""
_THREE_AXES = ('scale_factor_cross',)  # Terms that only a three-axis sensor has
_PRIOR_SUFFICES = ('nonlinearity',)
"""Terms that the poses need not determine: most sensors hardly have them."""
GAUGE = ('cross_axis.linear', 'cross_axis_z.linear')
"""Terms that are 0 unless the poses distinguish them from the misalignment."""
_BASE_TILT = (Coefficient('base_tilt', 'x_rad'), Coefficient('base_tilt', 'y_rad'))
"""Nuisance parameters: the level of the stage's base."""
LEVEL_STD_RAD = np.radians(0.1)
"""Prior standard deviation of the level of the base, rad: the paper's 0.1°."""
_SENSOR_PRIOR_SIZES = 5.0
"""Prior standard deviation of a coefficient of the sensor, in typical sizes. Chosen: wider than
any healthy sensor, so that the prior matters only where the poses determine nothing."""
_STAGE_PRIOR_SIZES = 3.0
"""Prior standard deviation of a coefficient of the stage, in typical sizes. Chosen: wider than any
stage that is in order."""
_GAUGE_PRIOR_SIZES = 1.0  # Prior std of a term of `GAUGE`, in typical sizes: the datasheet's 1.5 %
_NAMED_POSES = 4  # Number of further poses that a message names
_REGULARISATION = 1e-6
"""Term added to the information in typical sizes, so that it can be inverted."""
_MAX_ROUNDS = 16
"""Largest count of rounds of stage error, coefficients and angles; a fit that needs more is
reported as not converged."""
_FIRST_ROUND_LEVELS = 3
"""Number of estimates of the stage error in the first round, which starts from the stated one."""
_START_STEPS = 12  # Gauss-Newton steps before the first round
_ROUND_STEPS = 2  # Gauss-Newton steps of a round
_MAX_HALVINGS = 7  # How often the step of a round is halved
_MAX_STEP_SIZES = 3.0  # Longest step of a coefficient, in typical sizes
_LAST_STEP_STD = 1e-4  # A shorter step is the last one, in standard deviations of each coefficient
_SETTLED_STD = 1e-2  # Coefficients have converged if a round moves them by less, in stds of each
_SETTLED_DEVIANCE = 1e-2  # The stage error has converged if a round changes the deviance by less
_CURVATURE_SHRINK = 0.2  # Share of the curvature by angle errors that remains after a round
_MAX_CURVATURE = 0.1
"""Largest curvature at which convergence is checked, relative to the noise of a mean."""
_OUTLIER_CHANCE = 1e-6  # A pose less likely than this is an outlier
_MAX_OUTLIERS = 0.2  # Largest share of outliers. Chosen: more of them are a fault of the model
_SHAPE_STEP = 1.05  # Ratio of neighbouring trial values of a shape parameter
_SHAPE_STEPS = 60
"""Number of trial values on each side of the typical one: from 1/19 to 19 times that value."""
_FINE_SHAPES = 15  # Number of trial values between the neighbours of the likeliest value
MAX_OPEN = 3
"""Largest number of the twelve coefficients that their priors may give. Chosen: an axis that never
points up or down leaves its scale factor and two misalignments open."""


@dataclass(frozen=True)
class FullFit:
    """Result of the fit of k poses."""

    fitted: Sensor  # The sensor with its covariance, without effects of the stage
    with_stage: Sensor  # The sensor with the fitted effects of the stage
    names: tuple[Coefficient, ...]  # Fitted coefficients, (p,)
    stage: StageError
    stated_std_rad: float  # Stated standard deviation of a joint's error: step/√12
    outliers: tuple[int, ...]  # Indices of the outliers, which the fit leaves out
    information: np.ndarray  # Inverse covariance of `names`, priors included, (p, p)
    squared_distances: np.ndarray  # Mahalanobis, of each pose, given its settings, (k,)
    linear_poses: Poses  # The poses at the most likely angles, about which the model is linear
    deviance: float  # −2 times the logarithm of the restricted likelihood, up to a constant
    converged: bool  # Whether coefficients, stage error and outliers have converged

    @property
    def kept(self) -> np.ndarray:
        """Mark the poses that are no outliers, (k,) bool."""
        return ~np.isin(np.arange(len(self.linear_poses)), self.outliers)


def default_terms(axes: str) -> tuple[str, ...]:
    """Return the terms of the full model for a sensor with these axes."""
    return TERMS + (_THREE_AXES if axes == AXES else ())


def fit_full(
    sensor: Sensor, poses: Poses, terms: Sequence[str] | None = None, max_open: int = 0
) -> FullFit:
    """
    Fit the terms to the poses by maximum likelihood.

    Parameters
    ----------
    sensor
        Nominal values of the sensor. Its stage resolution states the error of the stage.
    poses
        k poses of one sensor on one stage.
    terms
        Effects to fit, of the sensor or of the stage, and names of `GAUGE`. By default
        `default_terms` of the sensor's axes.
    max_open
        Largest number of coefficients that the poses may leave to their priors.

    Returns
    -------
    FullFit
        The fit, converged or not.

    Raises
    ------
    UserError
        The poses do not determine a coefficient. The message names it and poses to add.

    """
    terms = default_terms(sensor.axes) if terms is None else terms
    effects = [effect_of(term) for term in terms]
    try:
        start = linear.fit(sensor, poses).without_covariance()
    except UserError:
        # An open coefficient may not allow a linear fit.
        if not max_open:
            raise
        start = sensor
    start = with_neutral(with_neutral(start, effects), ['base_tilt'])
    names = fitted_coefficients(start.axes, terms)
    stated = StageError(sensor.stage_std_rad)
    start = _likeliest_shapes(start, poses, names, stated, effects)
    require_determined(start, poses, names, stated, max_open)
    return _StageSearch(start, poses, names, stated).run()


def _likeliest_shapes(
    sensor: Sensor,
    poses: Poses,
    names: tuple[Coefficient, ...],
    stated: StageError,
    effects: Sequence[str],
) -> Sensor:
    """
    Give the shape parameters (periods, time constants) of effects their likeliest values.

    The volts are nearly linear in all other coefficients. The likelihood by a shape parameter has
    several maxima, so that its whole range is searched, and then the interval of the best value.
    """
    precision = prior_precision(names)

    def misfit(trial: Sensor) -> float:
        return linearised(trial, poses, names, precision).misfit(stated)

    coarse = np.arange(-_SHAPE_STEPS, _SHAPE_STEPS + 1)
    fine = np.linspace(-1, 1, _FINE_SHAPES)
    for effect in map(effect_named, effects):
        for parameter in effect.parameters if effect.invertible else ():
            if parameter.role is not Role.SHAPE or parameter.held:
                continue
            value = parameter.scale
            for steps in (coarse, fine):
                values = value * _SHAPE_STEP**steps
                trials = [
                    _with_shape(sensor, effect.name, parameter.name, trial)
                    for trial in values
                    if parameter.lower <= trial <= parameter.upper
                ]
                sensor = min(trials, key=misfit)
                value = float(np.ravel(sensor.values[effect.name][parameter.name])[0])
    return sensor


def _with_shape(sensor: Sensor, effect: str, name: str, value: float) -> Sensor:
    """Give a shape parameter of a sensor the same value on each axis."""
    of_effect = sensor.values[effect]
    shape = np.full(np.shape(of_effect[name]), value)
    return replace(sensor, values={**sensor.values, effect: {**of_effect, name: shape}})


class _StageSearch:
    """The fit from one start: stage error, coefficients and angles in turn until all converge."""

    def __init__(
        self, sensor: Sensor, poses: Poses, names: tuple[Coefficient, ...], stated: StageError
    ) -> None:
        self._measured = poses
        self._names = names
        self._stated = stated
        self._precision = prior_precision(names)  # Inverse prior variances, (p,)
        self._sensor, self._stage = sensor, stated  # Sensor with coefficients, and stage error
        # Predicted errors of the angles, and the poses turned by them; see `_turned_linearly`
        none_rad = np.zeros((len(poses), 2))
        self._errors = pose_covariance.AngleErrors(none_rad, none_rad, none_rad[:, 0], 0.0)
        self._poses = poses
        self._kept = np.ones(len(poses), bool)  # Poses that are no outliers
        # Volts by which the model departs from its linearisation, (m,)
        self._curvature_v = np.zeros(len(sensor.axes))

    def run(self) -> FullFit:
        """Iterate until all converge."""
        start = self._solved(self._measured, _START_STEPS)
        self._sensor = put(self._sensor, self._names, start.values)
        converged = False
        deviance = np.inf
        noise_v = self._measured.std_v.mean(axis=0)
        for number in range(_MAX_ROUNDS):
            self._estimate_stage(number)
            step_std = self._step()
            if np.any(self._curvature_v > _MAX_CURVATURE * noise_v):
                continue
            about = self._about(self._sensor, self._poses)
            kept_before = self._kept
            deviance_before = deviance
            deviance = about.deviance(self._stage)
            self._kept = _inliers(about, self._stage)
            converged = (
                np.array_equal(self._kept, kept_before)
                and step_std < _SETTLED_STD
                and abs(deviance - deviance_before) < _SETTLED_DEVIANCE
            )
            if converged:
                break
        return self._result(converged)

    def _about(self, sensor: Sensor, poses: Poses) -> Linearised:
        return linearised(sensor, poses, self._names, self._precision, self._kept)

    def _weighted(self) -> Poses:
        """Return the turned poses with the curvature as further noise."""
        return replace(self._poses, std_v=np.hypot(self._measured.std_v, self._curvature_v))

    def _estimate_stage(self, number: int) -> None:
        """Estimate the stage error of a round."""
        for _ in range(1 if number else _FIRST_ROUND_LEVELS):
            about = self._about(self._sensor, self._weighted())
            self._stage = about.stage_error(self._stated.total_rad, self._stage)
            # Angle errors δ that are not predicted yet change the force by δ²/2 of g.
            self._curvature_v = (
                self._sensor.nominal_scale_v_per_g
                * self._stage.total_rad**2
                * _CURVATURE_SHRINK**number
            )

    def _solved(self, poses: Poses, steps: int) -> _Iterate:
        """Take Gauss-Newton steps without step control: the chain is nearly linear in them."""
        sizes = typical_sizes(self._names)

        def linearise(values: np.ndarray) -> _Iterate:
            about = self._about(put(self._sensor, self._names, values), poses)
            covariance = about.covariance(self._stage)
            step, information = about.solve(covariance)
            step *= min(1.0, _MAX_STEP_SIZES / np.abs(step / sizes).max())
            return _Iterate(values, step, 0.0, about, covariance, information)

        def is_last(_: _Iterate, previous: _Iterate | None, __: _Iterate) -> bool:
            return previous is not None and previous.step_std < _LAST_STEP_STD

        return gauss_newton(linearise, get(self._sensor, self._names), is_last, steps + 1)

    def _step(self) -> float:
        """Move coefficients and angles to likelier ones; return the longest step, in stds."""
        weighted = self._weighted()
        solved = self._solved(weighted, _ROUND_STEPS)
        errors = solved.covariance.predicted_errors(solved.about.residual)
        start = get(self._sensor, self._names)

        def cost(values: np.ndarray, angles: pose_covariance.AngleErrors) -> float:
            residual = self._measured.volts - predicted_volts(
                put(self._sensor, self._names, values), _turned(self._measured, angles.total_rad)
            )
            return float(
                np.sum((residual / weighted.std_v)[self._kept] ** 2)
                + np.sum(self._precision * values**2)
                + solved.covariance.penalty(angles)
            )

        # The step is halved until it does not raise the cost.
        before = self._errors
        cost_before = cost(start, before)
        for share in 0.5 ** np.arange(_MAX_HALVINGS + 1):
            values = start + share * (solved.values - start)
            self._errors = before.interpolated(errors, share)
            if cost(values, self._errors) <= cost_before:
                break
        self._sensor = put(self._sensor, self._names, values)
        self._poses = _turned_linearly(self._sensor, self._measured, self._errors.total_rad)
        return float(np.abs((values - start) * stds(solved.information)).max())

    def _result(self, converged: bool) -> FullFit:
        """Return the fit, with the covariance of the sensor's coefficients."""
        about = self._about(self._sensor, self._poses)
        over_levels = about.covariance_over_levels(self._stage, self._stated.total_rad)
        of_sensor = [i for i, name in enumerate(self._names) if not belongs_to_stage(name)]
        effects = tuple(
            effect
            for effect in self._sensor.effects
            if effect_named(effect).place is not Place.STAGE
        )
        fitted = replace(
            self._sensor,
            model='full',
            effects=effects,
            values={name: self._sensor.values[name] for name in effects},
            covariance=over_levels[np.ix_(of_sensor, of_sensor)],
            covariance_names=tuple(self._names[i] for i in of_sensor),
        )
        errors = about.covariance(self._stage).predicted_errors(about.residual)
        return FullFit(
            fitted=fitted,
            with_stage=self._sensor,
            names=self._names,
            stage=self._stage,
            stated_std_rad=self._stated.total_rad,
            outliers=tuple(np.flatnonzero(~self._kept).tolist()),
            information=np.linalg.inv(over_levels),
            squared_distances=errors.squared_distances,
            linear_poses=self._poses,
            deviance=about.deviance(self._stage),
            converged=converged,
        )


@dataclass(frozen=True)
class _Iterate(Iterate):
    """An iterate with the linearised poses, their covariance, and the information, (p, p)."""

    about: Linearised
    covariance: pose_covariance.PoseCovariance
    information: np.ndarray

    @property
    def step_std(self) -> float:
        """Return the longest component of the step in its standard deviations."""
        return float(np.abs(self.step * stds(self.information)).max())


def _inliers(about: Linearised, stage: StageError) -> np.ndarray:
    """Mark the poses that are no outliers, (k,) bool; all poses if too many are outliers."""
    errors = about.covariance(stage).predicted_errors(about.residual)
    kept = errors.squared_distances < scipy.special.chdtri(
        about.residual.shape[1], _OUTLIER_CHANCE
    )
    return kept if kept.mean() >= 1 - _MAX_OUTLIERS else np.ones(len(kept), bool)


def fitted_coefficients(axes: str, terms: Sequence[str]) -> tuple[Coefficient, ...]:
    """Name the coefficients of terms: of the sensor, the base's tilt, then of the stage."""
    effects = dict.fromkeys(map(effect_of, terms))
    names = [
        name
        for name in coefficients_of(effects, axes)
        if parameter_of(name).role not in (Role.SHAPE, Role.OPTIONAL) and term_of(name) in terms
    ]
    of_stage = [name for name in names if belongs_to_stage(name) and name not in _BASE_TILT]
    return (*(name for name in names if not belongs_to_stage(name)), *_BASE_TILT, *of_stage)


def term_of(name: Coefficient) -> str:
    """Return the term that a coefficient belongs to: its effect, or one of `GAUGE`."""
    parameter = str(name.without_axis)
    return parameter if parameter in GAUGE else name.effect


def effect_of(term: str) -> str:
    """Return the effect of a term, which is its name or one of `GAUGE`."""
    return term.partition('.')[0]


def prior_precision(names: Sequence[Coefficient]) -> np.ndarray:
    """Return the inverse prior variances of coefficients about 0, (p,)."""
    return 1 / np.square([_prior_std(name) for name in names])


def _prior_std(name: Coefficient) -> float:
    """Return the prior standard deviation of a coefficient."""
    if name in _BASE_TILT:
        return LEVEL_STD_RAD
    sizes = _STAGE_PRIOR_SIZES if belongs_to_stage(name) else _SENSOR_PRIOR_SIZES
    if term_of(name) in GAUGE:
        sizes = _GAUGE_PRIOR_SIZES
    return parameter_of(name).scale * sizes


def fisher_information(
    sensor: Sensor, poses: Poses, names: Sequence[Coefficient], stage: StageError
) -> np.ndarray:
    """Return the Fisher information, priors included, (p, p); the Cramér-Rao bound inverted."""
    about = linearised(sensor, poses, names, prior_precision(names))
    return about.information(about.covariance(stage))


def typical_sizes(names: Sequence[Coefficient]) -> np.ndarray:
    """Return the typical sizes of coefficients, (p,)."""
    return np.array([parameter_of(name).scale for name in names])


def _turned(poses: Poses, errors_rad: np.ndarray) -> Poses:
    """Add angle errors, (k, 2), to the angles of the encoder."""
    return replace(
        poses,
        alpha_rad=poses.alpha_rad + errors_rad[:, 0],
        beta_rad=poses.beta_rad + errors_rad[:, 1],
    )


def _turned_linearly(sensor: Sensor, poses: Poses, errors_rad: np.ndarray) -> Poses:
    """Turn poses by errors, (k, 2), and add their linear effect to the volts: a linear model."""
    turned = _turned(poses, errors_rad)
    effect_v = (angle_jacobian(sensor, turned) @ errors_rad[:, :, None])[:, :, 0]
    return replace(turned, volts=poses.volts + effect_v)


def belongs_to_stage(name: Coefficient) -> bool:
    """Return whether a coefficient describes the stage, not the sensor."""
    return effect_named(name.effect).place is Place.STAGE


def open_coefficients(
    sensor: Sensor, poses: Poses, names: Sequence[Coefficient], stage: StageError
) -> list[Coefficient]:
    """Return the sensor's coefficients that poses leave as uncertain as their typical size."""
    scale = typical_sizes(names)
    is_required = np.array(
        [
            not belongs_to_stage(name) and term_of(name) not in (*GAUGE, *_PRIOR_SUFFICES)
            for name in names
        ]
    )
    # The poses must determine a required coefficient without its prior.
    of_priors = np.where(is_required, prior_precision(names), 0.0)
    information = fisher_information(sensor, poses, names, stage) - np.diag(of_priors)
    # In typical sizes, of which 1 is the size of the coefficient itself
    scaled = information * np.outer(scale, scale) + _REGULARISATION * np.eye(len(names))
    is_open = is_required & (np.diag(np.linalg.inv(scaled)) > 1.0)
    return [name for name, leaves_open in zip(names, is_open) if leaves_open]


def require_determined(
    sensor: Sensor,
    poses: Poses,
    names: Sequence[Coefficient],
    stage: StageError,
    max_open: int = 0,
) -> None:
    """Refuse poses that leave more coefficients open; the message names poses that help."""
    undetermined = open_coefficients(sensor, poses, names, stage)
    if len(undetermined) <= max_open and poses.volts.size > len(names) - max_open:
        return
    reason = f'they have {poses.volts.size} values for {len(names)} coefficients'
    if undetermined:
        reason = f'they do not determine {", ".join(map(str, undetermined))}'
    follows = set(chain.from_iterable(effect_named(name.effect).follows for name in undetermined))
    if follows:
        advice = f'poses with other values of {" and ".join(sorted(follows))}'
    else:
        advice = f'poses (alpha, beta) = {next_poses(sensor, poses, names, stage)} deg'
    raise UserError(
        f'the full model is not determined by {len(poses)} poses: {reason}; add '
        f'{advice}, or {usage("fit", model="physical")} or linear'
    )


def next_poses(
    sensor: Sensor, poses: Poses, names: Sequence[Coefficient], stage: StageError
) -> str:
    """Name the poses of a 15° grid that would help most (D-optimality; Fedorov 1972), in deg."""
    grid = optimal_poses.candidate_poses(np.median(poses.std_v, axis=0))
    scale = typical_sizes(names)
    rows = optimal_poses.whitened_jacobian(sensor, grid, tuple(names), stage) * scale
    information = fisher_information(sensor, poses, names, stage) * np.outer(scale, scale)
    chosen = optimal_poses.choose_poses(
        rows, information + _REGULARISATION * np.eye(len(names)), _NAMED_POSES
    )
    return ', '.join(
        f'({np.degrees(grid.alpha_rad[i]):.0f}, {np.degrees(grid.beta_rad[i]):.0f})'
        for i in chosen
    )
