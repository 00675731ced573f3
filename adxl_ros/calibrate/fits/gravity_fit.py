# SPDX-License-Identifier: Apache-2.0

"""
Fit of nine parameters of a three-axis sensor to the magnitude of gravity over its rests.

At rest the specific force has the magnitude of local gravity in every pose. Zero-g, scale factor
and three angles between the sensing axes are fitted: V = zero-g + scale·(Θ·f/g₀) with Θ of
equations 18 and 19. A common turn of all three axes, which has three angles, does not change the
magnitude. The gauge therefore holds Θx on the case's x and Θy in its x-y plane.

Rests that determine zero-g and scale factor, but not the angles, give a fit of these six. The
angles then stay as their prior says, and their uncertainty is that of the prior.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from adxl_ros.calibrate.fits.cube_directions import AXES_UP, covered, points_up
from adxl_ros.errors import UserError
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.error_sizes import variances_of
from adxl_ros.model.kinematics import unit_vectors
from adxl_ros.model.sensor import parameter_of, Sensor
from adxl_ros.report.quantities import mg
from adxl_ros.wording import option, usage
import numpy as np
import scipy

NAMES = (
    *(Coefficient('bias', 'offset_v', axis) for axis in AXES),
    *(Coefficient('scale_factor', 'offset_v_per_g', axis) for axis in AXES),
    Coefficient('misalignment', 'beta_rad', 'y'),
    Coefficient('misalignment', 'alpha_rad', 'z'),
    Coefficient('misalignment', 'beta_rad', 'z'),
)
"""The nine coefficients. In the fits of gravity they are zero-g shifts in g, relative changes of
the scale factor and angles in rad: the "parameters" below, (9,)."""
PRIOR_STD = 0.1
"""Prior standard deviation of each parameter. Chosen: ten times the tolerances of datasheets."""
DETERMINED_STD = 0.01
"""Standard deviation below which a parameter counts as determined: 10 mg, 1 % or 0.6°, the usual
tolerances of datasheets."""
TRIAL_STD_G = 1e-4  # Standard deviation of a rest's magnitude before the excess is estimated, g
_ROUNDING_STD_G = 1e-9  # Std of a mean by rounding alone, so that no weight is infinite
_MAX_VALUE = 0.5  # Largest magnitude of a parameter in an iteration; chosen: five prior stds
_PRIOR_INFORMATION = np.eye(len(NAMES)) / PRIOR_STD**2
"""Inverse covariance of the prior about 0, (9, 9)."""
_TOLERANCE = 1e-12  # Relative tolerance of `leastsq` in cost, parameters and gradient
_UNSCALED = np.ones(len(NAMES))  # Weights of the parameters in the trust region of `leastsq`: none
_CONVERGED = (1, 2, 3, 4)  # States of `leastsq` in which it has converged (MINPACK, lmder)
_STRETCHES = 5
"""Stretches of time that are held out in turn: neighbours share temperature and time, so that a
rest that is held out alone shows no drift. Chosen: the usual number of folds."""
_MAX_ROUNDS = 20  # Largest count of rounds of parameters and excess variance
_EXCESS_TOLERANCE = 1e-6
"""The excess variance has converged if it changes by less, relative to the variance."""
_OUTLIER_CHANCE = 0.01  # Probability of a false outlier among all rests of a fit without outliers
_MAX_OUTLIERS = 0.25
"""Largest share of outliers. Chosen: more of them are a fault of the recording."""
_MAX_DEVIATIONS = 5.0  # Largest residual of a rest with which the search for outliers begins, stds
_MIN_REMAINDER = 1e-9  # Lower bound of 1 − leverage, as a divisor
_NAMED = 3  # Directions between the axes that advice names; chosen: a line holds them
_MIN_GRAVITY_RATIO = 0.5
"""Smallest ratio of the measured magnitude to local gravity; a smaller one is a wrong unit."""
_MAX_GRAVITY_RATIO = 2.0
"""Largest ratio of the measured magnitude to local gravity; a larger one is a wrong unit."""


class GravityParameters(NamedTuple):
    """The parts of the parameters."""

    zero_g_g: np.ndarray  # Zero-g minus the nominal one, g, (3,)
    scale: np.ndarray  # Relative change of the scale factor, (3,)
    angles_rad: np.ndarray  # beta of y, alpha of z and beta of z, rad, (3,)

    @classmethod
    def of(cls, parameters: np.ndarray) -> GravityParameters:
        """Return the parts of a vector, (9,)."""
        return cls(parameters[:3], parameters[3:6], parameters[6:])

    @property
    def vector(self) -> np.ndarray:
        """Return all of them, (9,)."""
        return np.concatenate(self)


class Rung(NamedTuple):
    """A rung of the ladder of fits: which parameters the rests determine."""

    text: str  # The parameters, for people
    determined: int  # The first ones of `NAMES`, as many as the rests determine
    precision: np.ndarray  # Inverse variance of the prior of the others, (9,); 0 without one

    @property
    def min_rests(self) -> int:
        """Fewest rests: one more than parameters, so that residuals show the error."""
        return self.determined + 1

    @property
    def left_out(self) -> tuple[Coefficient, ...]:
        """Coefficients that are known by their prior alone."""
        return NAMES[self.determined :]

    @property
    def left_out_std_rad(self) -> float:
        """Return the standard deviation of the prior of an angle that is left out, rad."""
        return float(self.precision[-1] ** -0.5)


NINE = Rung('nine parameters', len(NAMES), np.zeros(len(NAMES)))
SIX = Rung(
    'zero-g and scale factor',
    6,
    np.array([0.0] * 6 + [parameter_of(name).scale ** -2.0 for name in NAMES[6:]]),
)
LADDER = (NINE, SIX)
"""Fits from the one with the most parameters on."""


@dataclass(frozen=True)
class NominalRests:
    """k rests, converted by the nominal zero-g and scale factor."""

    mean: np.ndarray  # Means, g, (k, 3)
    variance: np.ndarray  # Variances of the means, g², (k, 3)
    gravity_g: float  # Local gravity, g

    def __getitem__(self, part: np.ndarray) -> NominalRests:
        return NominalRests(self.mean[part], self.variance[part], self.gravity_g)


def nominal_rests(mean_v: np.ndarray, std_v: np.ndarray, sensor: Sensor) -> NominalRests:
    """Convert means of rests and their standard deviations, V, (k, 3), by nominal values."""
    scale = sensor.nominal_scale_v_per_g
    return NominalRests(
        (mean_v - sensor.nominal_zero_g_v) / scale,
        (std_v / scale) ** 2 + _ROUNDING_STD_G**2,
        sensor.local_gravity_mps2 / G0_MPS2,
    )


def effect_values(
    parameters: np.ndarray, sensor: Sensor
) -> tuple[dict[str, dict[str, np.ndarray]], np.ndarray]:
    """Return the values of the effects, and the factor from each parameter to its coefficient."""
    scale = sensor.nominal_scale_v_per_g
    units = np.concatenate([scale, scale, np.ones(3)])
    values = GravityParameters.of(parameters * units)
    beta_y, alpha_z, beta_z = values.angles_rad
    return {
        'bias': {'offset_v': values.zero_g_g},
        'scale_factor': {'offset_v_per_g': values.scale},
        'misalignment': {
            'alpha_rad': np.array([0.0, 0.0, alpha_z]),
            'beta_rad': np.array([0.0, beta_y, beta_z]),
        },
    }, units


def _sensing_axes(angles_rad: np.ndarray) -> np.ndarray:
    """Return the directions of the sensing axes in the gauge, rows Θx, Θy, Θz, (3, 3)."""
    sy, sa, sb = np.sin(angles_rad)
    cy, ca, cb = np.cos(angles_rad)
    return np.array([[1.0, 0.0, 0.0], [-sy, cy, 0.0], [sb, -sa * cb, ca * cb]])


def force_g(mean: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Return the specific force of rests in the case, g, (k, 3), by their means, g, (k, 3)."""
    part = GravityParameters.of(parameters)
    sensed = (mean - part.zero_g_g) / (1 + part.scale)
    return np.asarray(sensed @ np.linalg.inv(_sensing_axes(part.angles_rad)).T)


def magnitude(mean: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Return the magnitudes of rests, g, (k,), by their means, g, (k, 3)."""
    return np.linalg.norm(force_g(mean, parameters), axis=1)


class LinearisedRests(NamedTuple):
    """Magnitudes of k rests to first order."""

    magnitude: np.ndarray  # g, (k,)
    by_output: np.ndarray  # Derivatives by the means, (k, 3)
    jacobian: np.ndarray  # Derivatives by the parameters, (k, 9)


def linearised(mean: np.ndarray, parameters: np.ndarray) -> LinearisedRests:
    """Return the magnitudes with their derivatives; `mean` by nominal values, g, (k, 3)."""
    part = GravityParameters.of(parameters)
    scale = 1 + part.scale
    sensed = (mean - part.zero_g_g) / scale
    inverse = np.linalg.inv(_sensing_axes(part.angles_rad))
    force = sensed @ inverse.T
    length = np.linalg.norm(force, axis=1)
    by_sensed = force / length[:, None] @ inverse
    by_output = by_sensed / scale
    # ∂Θ/∂angle: of Θy by its angle, of Θz by both of its angles.
    sy, sa, sb = np.sin(part.angles_rad)
    cy, ca, cb = np.cos(part.angles_rad)
    turned = np.array([[-cy, -sy, 0.0], [0.0, -ca * cb, -sa * cb], [cb, sa * sb, -ca * sb]])
    by_angle = -by_sensed[:, [1, 2, 2]] * (force @ turned.T)
    return LinearisedRests(
        length, by_output, np.hstack([-by_output, -by_output * sensed, by_angle])
    )


def magnitude_variance(rests: NominalRests, parameters: np.ndarray) -> np.ndarray:
    """Return the variance of each magnitude by the noise of the means, g², (k,)."""
    return np.sum(linearised(rests.mean, parameters).by_output ** 2 * rests.variance, axis=1)


def regularised_fit(rests: NominalRests, steps: int) -> np.ndarray:
    """Fit rests with the prior by Gauss-Newton steps from 0; return the parameters."""
    parameters = np.zeros(len(NAMES))
    for _ in range(steps):
        at = linearised(rests.mean, parameters)
        variance = magnitude_variance(rests, parameters).mean() + TRIAL_STD_G**2
        weighted = at.jacobian.T / variance
        gradient = weighted @ (rests.gravity_g - at.magnitude) - parameters / PRIOR_STD**2
        step = np.linalg.solve(weighted @ at.jacobian + _PRIOR_INFORMATION, gradient)
        parameters = np.clip(parameters + step, -_MAX_VALUE, _MAX_VALUE)
    return parameters


def fisher_information(
    rests: NominalRests, parameters: np.ndarray, excess_g2: float
) -> np.ndarray:
    """Return the Fisher information of rests about the parameters, without the prior, (9, 9)."""
    rows = linearised(rests.mean, parameters).jacobian
    return rows.T @ (rows / (magnitude_variance(rests, parameters) + excess_g2)[:, None])


def posterior_information(
    rests: NominalRests, parameters: np.ndarray, excess_g2: float
) -> np.ndarray:
    """Return the information of prior and rests about the parameters, (9, 9)."""
    return _PRIOR_INFORMATION + fisher_information(rests, parameters, excess_g2)


@dataclass(frozen=True)
class GravityFit:
    """Result of the fit of k rests."""

    values: dict[str, dict[str, np.ndarray]]  # As in `Sensor.values`
    covariance: np.ndarray  # Of the coefficients NAMES, in their units, (9, 9)
    before_mps2: np.ndarray  # Magnitude minus local gravity by nominal values, (k,)
    residual_mps2: np.ndarray  # The same by the fit
    held_out_mps2: np.ndarray  # By the fit to the rests of the other stretches of time
    expected_mps2: np.ndarray  # Standard deviation of a magnitude: noise of the mean and excess
    excess_mps2: float  # Part of it that the noise of the means does not explain
    outliers: tuple[int, ...]  # Indices of the outliers, which the fit leaves out
    rung: Rung  # Which parameters the rests determine
    note: str  # What is left out and what would determine it, for people; '' if nothing is
    converged: bool = True  # Whether parameters and excess variance have converged


class _Estimate(NamedTuple):
    """A fit of parameters and excess variance."""

    parameters: np.ndarray  # (9,)
    excess_g2: float  # Variance beyond the noise of the means, g²
    converged: bool


def fit_gravity(mean_v: np.ndarray, std_v: np.ndarray, sensor: Sensor) -> GravityFit:
    """
    Fit nine parameters, or as many as the rests determine, by the likelihood of the magnitudes.

    Errors across gravity do not change the magnitude to first order. Real rests scatter by more
    than the noise of their means (flicker, hysteresis, effects beyond nine parameters). A common
    excess variance is therefore estimated with the parameters, and widens the covariance.

    Parameters
    ----------
    mean_v, std_v
        Mean of each rest and its standard deviation, V, (k, 3), in the order of time.
    sensor
        Nominal values and local gravity of a three-axis sensor.

    Returns
    -------
    GravityFit
        The fit, converged or not.

    Raises
    ------
    UserError
        The rests do not determine zero-g and scale factor, or do not read gravity. The message
        names the coefficients, and the directions that are missing.

    """
    rests = nominal_rests(mean_v, std_v, sensor)
    _require_gravity(rests, np.zeros(len(NAMES)))
    for rung in LADDER:
        try:
            return _fitted(rests, sensor, rung)
        except _UndeterminedError as error:
            refusal = error
    raise refusal


class _UndeterminedError(UserError):
    """The rests do not determine the parameters of a rung."""


def _fitted(rests: NominalRests, sensor: Sensor, rung: Rung) -> GravityFit:
    """Fit the parameters of one rung."""
    _require_determined(rests, np.zeros(len(NAMES)), 0.0, rung)
    kept = _inliers(rests, rung)
    used = rests[kept]
    estimate = _fit(used, rung)
    parameters = estimate.parameters
    excess_g2 = estimate.excess_g2
    _require_gravity(used, parameters)
    _require_determined(used, parameters, excess_g2, rung)
    variance = magnitude_variance(rests, parameters) + excess_g2
    information = fisher_information(used, parameters, excess_g2)
    # An excess that ν rests determine widens its share of the variance by ν/(ν − 2).
    share = excess_g2 / variance[kept].mean()
    freedom = kept.sum() - rung.determined
    widened = 1 + share * 2 / max(freedom - 2, 1)
    covariance = np.linalg.inv(information / widened + np.diag(rung.precision))
    covariance += _second_order(rung)
    values, units = effect_values(parameters, sensor)
    residual = _residual(rests, parameters)
    return GravityFit(
        values=values,
        covariance=covariance * np.outer(units, units),
        before_mps2=G0_MPS2 * (np.linalg.norm(rests.mean, axis=1) - rests.gravity_g),
        residual_mps2=G0_MPS2 * residual,
        held_out_mps2=G0_MPS2 * _held_out(rests, kept, parameters, variance, residual, rung),
        expected_mps2=G0_MPS2 * np.sqrt(variance),
        excess_mps2=G0_MPS2 * float(np.sqrt(excess_g2)),
        outliers=tuple(int(i) for i in np.flatnonzero(~kept)),
        rung=rung,
        note=_note(used, parameters, rung),
        converged=estimate.converged,
    )


def _second_order(rung: Rung) -> np.ndarray:
    """
    Return the covariance by the squares of angles that the rests do not determine, (9, 9).

    Turned by β a sensing axis reads gravity along it by cos β = 1 − β²/2 too small, as by its
    scale factor. The mean square of β²/2 is 3σ⁴/4, that of two such angles 2σ⁴.
    """
    by_y, by_z = 0.0, 0.0
    if rung.left_out:
        fourth_power = rung.left_out_std_rad**4
        by_y = 0.75 * fourth_power
        by_z = 2 * fourth_power
    none = np.zeros(3)
    return np.diag(GravityParameters(none, np.array([0.0, by_y, by_z]), none).vector)


def _note(rests: NominalRests, parameters: np.ndarray, rung: Rung) -> str:
    if not rung.left_out:
        return ''
    names = ', '.join(map(str, rung.left_out))
    std_deg = np.degrees(rung.left_out_std_rad)
    return (
        f'the rests determine {rung.text} only; left out, by their prior of 0 ± '
        f'{std_deg:.2g}° (standard deviation): {names}; {_advice(rests, parameters)}'
    )


def _residual(rests: NominalRests, parameters: np.ndarray) -> np.ndarray:
    """Return magnitude minus local gravity, g, (k,), or (s, k) for s sets of parameters."""
    return magnitude(rests.mean, parameters) - rests.gravity_g


class _Solution(NamedTuple):
    """The best parameters for given variances."""

    parameters: np.ndarray  # (9,)
    converged: bool


def _solve(rests: NominalRests, start: np.ndarray, variance: np.ndarray, rung: Rung) -> _Solution:
    """Fit with given variances of the magnitudes, g², (k,)."""
    std = np.sqrt(variance)
    prior = np.diag(np.sqrt(rung.precision))
    # `least_squares` calls the same routine of MINPACK, and takes twice the time around it.
    parameters, _, _, _, status = scipy.optimize.leastsq(
        lambda p: np.concatenate([_residual(rests, p) / std, prior @ p]),
        start,
        Dfun=lambda p: np.vstack([linearised(rests.mean, p).jacobian / std[:, None], prior]),
        full_output=True,
        xtol=_TOLERANCE,
        ftol=_TOLERANCE,
        gtol=_TOLERANCE,
        diag=_UNSCALED,
    )
    return _Solution(parameters, status in _CONVERGED)


def _fit(rests: NominalRests, rung: Rung) -> _Estimate:
    """Fit the parameters, and the excess variance that makes χ² equal its degrees of freedom."""
    parameters = np.zeros(len(NAMES))
    excess_g2 = 0.0
    freedom = len(rests.mean) - rung.determined
    for _ in range(_MAX_ROUNDS):
        variance = magnitude_variance(rests, parameters)
        parameters, converged = _solve(rests, parameters, variance + excess_g2, rung)
        squares = _residual(rests, parameters) ** 2
        before_g2 = excess_g2
        excess_g2 = _excess(squares, variance, freedom)
        if abs(excess_g2 - before_g2) <= _EXCESS_TOLERANCE * (excess_g2 + variance.min()):
            return _Estimate(parameters, excess_g2, converged)
    return _Estimate(parameters, excess_g2, converged=False)


def _excess(squares: np.ndarray, variance: np.ndarray, freedom: int) -> float:
    """Solve Σ r²/(v + excess) = freedom."""

    def surplus(excess_g2: float) -> float:
        return float((squares / (variance + excess_g2)).sum()) - freedom

    if surplus(0.0) <= 0:
        return 0.0
    return float(
        scipy.optimize.brentq(surplus, 0.0, squares.sum() / freedom, rtol=1e-9, xtol=1e-30)
    )


def _inliers(rests: NominalRests, rung: Rung) -> np.ndarray:
    """
    Mark the rests that fit the others, (k,) bool.

    The search begins with the rests near the fit with the least sum of absolute errors, where
    outliers cannot mask one another. Then rests leave or return, one at a time, by their
    studentised distance from the fit to the others, until each kept rest fits and each other does
    not.
    """
    count = len(rests.mean)
    max_outliers = min(int(_MAX_OUTLIERS * count), count - rung.min_rests)
    if max_outliers < 1:
        return np.ones(count, bool)
    prior = TRIAL_STD_G * np.diag(np.sqrt(rung.precision))
    robust = scipy.optimize.least_squares(
        lambda p: np.concatenate([_residual(rests, p), prior @ p]),
        np.zeros(len(NAMES)),
        lambda p: np.vstack([linearised(rests.mean, p).jacobian, prior]),
        loss='soft_l1',
        f_scale=TRIAL_STD_G,
    )
    size = np.abs(robust.fun[:count])
    freedom = max(count - max_outliers - rung.determined, 1)
    variance = np.sum(np.sort(size)[: count - max_outliers] ** 2) / freedom
    kept = size <= _MAX_DEVIATIONS * np.sqrt(variance + magnitude_variance(rests, robust.x).mean())
    for _ in range(2 * max_outliers):
        distance = _studentised(rests, kept, _fit(rests[kept], rung), rung)
        limit = -scipy.special.stdtrit(
            max(kept.sum() - rung.min_rests, 1), _OUTLIER_CHANCE / (2 * count)
        )
        excluded = np.where(kept, np.inf, distance)
        included = np.where(kept, distance, 0)
        if excluded.min() <= limit:
            kept[excluded.argmin()] = True
        elif included.max() > limit and (~kept).sum() < max_outliers:
            kept[included.argmax()] = False
        else:
            break
    return kept


def _studentised(
    rests: NominalRests, kept: np.ndarray, estimate: _Estimate, rung: Rung
) -> np.ndarray:
    """Return the distance of each rest from the fit to the others by its std, (k,)."""
    parameters = estimate.parameters
    excess_g2 = estimate.excess_g2
    variance = magnitude_variance(rests, parameters) + excess_g2
    covariance = np.linalg.inv(
        posterior_information(rests[kept], parameters, excess_g2) + np.diag(rung.precision)
    )
    jacobian = linearised(rests.mean, parameters).jacobian
    leverage = variances_of(jacobian, covariance) / variance
    distance = np.abs(_residual(rests, parameters)) / np.sqrt(variance)
    inside = distance / np.sqrt(np.maximum(1 - leverage, _MIN_REMAINDER))
    # χ² per degree of freedom of the other rests, at least that of the noise of the means.
    freedom = kept.sum() - rung.determined
    others = (max((distance[kept] ** 2).sum(), freedom) - inside**2) / max(freedom - 1, 1)
    inside = inside / np.sqrt(np.maximum(others, np.median(1 - excess_g2 / variance)))
    return np.where(kept, inside, distance / np.sqrt(1 + leverage))


def _held_out(
    rests: NominalRests,
    kept: np.ndarray,
    parameters: np.ndarray,
    variance: np.ndarray,
    residual: np.ndarray,
    rung: Rung,
) -> np.ndarray:
    """Return magnitude minus gravity by the fit to the other stretches of rests, g, (k,)."""
    errors = residual.copy()
    used = rests[kept]
    count = len(used.mean)
    stretch = np.arange(count) * _STRETCHES // count
    for number in np.unique(stretch):
        others = stretch != number
        # A stretch may hold the only rests that determine a parameter.
        is_open = _undetermined(used[others], parameters, 0.0, rung)
        without = (
            parameters
            if is_open or others.sum() < rung.determined
            else _solve(used[others], parameters, variance[kept][others], rung).parameters
        )
        errors[np.flatnonzero(kept)[~others]] = _residual(used[~others], without)
    return errors


def _require_gravity(rests: NominalRests, parameters: np.ndarray) -> None:
    """Refuse rests that do not read gravity; readings in another unit were refused before."""
    measured_g = (
        np.median(magnitude(rests.mean, parameters)) if len(rests.mean) else rests.gravity_g
    )
    if not _MIN_GRAVITY_RATIO < measured_g / rests.gravity_g < _MAX_GRAVITY_RATIO:
        raise UserError(
            f'gravity: the rests read {float(measured_g * G0_MPS2):.3g} m/s², not '
            f'{rests.gravity_g * G0_MPS2:.3g}: correct nominal_zero_g_v, '
            'nominal_scale_v_per_g or local_gravity_mps2'
        )


def _undetermined(
    rests: NominalRests, parameters: np.ndarray, excess_g2: float, rung: Rung
) -> list[Coefficient]:
    """Return the coefficients of a rung that rests do not determine."""
    covariance = np.linalg.inv(
        posterior_information(rests, parameters, excess_g2) + np.diag(rung.precision)
    )
    return [
        name
        for name, variance in zip(NAMES[: rung.determined], np.diag(covariance))
        if variance > DETERMINED_STD**2
    ]


def _require_determined(
    rests: NominalRests, parameters: np.ndarray, excess_g2: float, rung: Rung
) -> None:
    """Refuse rests that do not determine a coefficient of a rung; say what is missing."""
    count = len(rests.mean)
    missing = _undetermined(rests, parameters, excess_g2, rung)
    if count >= rung.min_rests and not missing:
        return
    reason = (
        f'do not determine {", ".join(map(str, missing))}'
        if missing
        else f'are too few, at least {rung.min_rests} in different directions are needed'
    )
    scatter = f' and scatter by {mg(G0_MPS2 * np.sqrt(excess_g2)):.2g} mg' if excess_g2 else ''
    raise _UndeterminedError(
        f'gravity: without their angles ({usage("fit", poses=None)}), the {count} rests '
        f'{reason}{scatter}; '
        f'{_advice(rests, parameters)}; if they have them, {option("sensor")} '
        'needs the file of this sensor'
    )


def _advice(rests: NominalRests, parameters: np.ndarray) -> str:
    """Return which directions are missing among rests, for people: faces first, then others."""
    force = force_g(rests.mean, parameters)
    has = covered(unit_vectors(force))
    faces = np.flatnonzero(~has & (AXES_UP == 1))
    edges = np.flatnonzero(~has & (AXES_UP == 2))
    if len(faces):
        return f'add rests in which {", or ".join(map(points_up, faces.tolist()))}'
    if len(edges):
        return (
            f'add rests with two axes equally up, such as those in which '
            f'{", or ".join(map(points_up, edges[:_NAMED].tolist()))}'
        )
    return 'add rests with each axis up and down, and with two axes equally up'
