# SPDX-License-Identifier: Apache-2.0

"""
Fit of nine parameters of a three-axis sensor to the magnitude of gravity over its rests.

At rest the specific force has the magnitude of local gravity in every pose. Zero-g, scale factor
and three angles between the sensing axes are fitted: V = zero-g + scale·(Θ·f/g₀) with Θ of
equations 18 and 19. A common turn of all three axes, which has three angles, does not change the
magnitude. The gauge therefore holds Θx on the case's x and Θy in its x-y plane.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

from adxl_ros.calibrate.fits import gravity_model
from adxl_ros.calibrate.fits.gravity_model import magnitude_variance, NAMES, NominalRests
from adxl_ros.errors import UserError
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.sensor import Sensor
import numpy as np
import scipy

MIN_RESTS = len(NAMES) + 1
"""Smallest count of rests: one more than coefficients, so that residuals show the error."""
_TOLERANCE = 1e-12
"""Relative tolerance of `leastsq` in cost, parameters and gradient."""
_UNSCALED = np.ones(len(NAMES))
"""Weights of the parameters in the trust region of `leastsq`: none."""
_CONVERGED = (1, 2, 3, 4)
"""States of `leastsq` in which it has converged (MINPACK, lmder)."""
STRETCHES = 5
"""Stretches of time that are held out in turn. Chosen: the usual number of folds."""
_MAX_ROUNDS = 20
"""Largest count of rounds of parameters and excess variance."""
_EXCESS_TOLERANCE = 1e-6
"""The excess variance has converged if it changes by less, relative to the variance."""

_OUTLIER_CHANCE = 0.01
"""Probability of a false outlier among all rests of a fit without outliers."""
_MAX_OUTLIERS = 0.25
"""Largest share of outliers. Chosen: more of them are a fault of the recording."""
_MAX_DEVIATIONS = 5.0
"""Largest residual of a rest with which the search for outliers begins, standard deviations."""
_MIN_REMAINDER = 1e-9
"""Lower bound of 1 − leverage, as a divisor."""
_MIN_GRAVITY_RATIO = 0.5
"""Smallest ratio of the measured magnitude to local gravity; a smaller one is a wrong unit."""
_MAX_GRAVITY_RATIO = 2.0
"""Largest ratio of the measured magnitude to local gravity; a larger one is a wrong unit."""


@dataclass(frozen=True)
class GravityFit:
    """Result of the fit of k rests."""

    # Parameters of effects by axis, as `Sensor.values` has them
    values: dict[str, dict[str, np.ndarray]]
    covariance: np.ndarray  # Covariance of the coefficients NAMES, in their units, (9, 9)
    # before_mps2, residual_mps2, held_out_mps2: Magnitude minus local gravity, m/s², (k,): by
    # nominal values, by the fit, and by the fit to the rests outside of the rest's own stretch of
    # time
    before_mps2: np.ndarray
    residual_mps2: np.ndarray
    held_out_mps2: np.ndarray
    # Standard deviation of a rest's magnitude, m/s², (k,): noise of the mean and excess
    expected_mps2: np.ndarray
    # Part of `expected_mps2` that the noise of the means does not explain, m/s²
    excess_mps2: float
    outliers: tuple[int, ...]  # Indices of the outliers, which the fit leaves out
    converged: bool = True  # Whether parameters and excess variance have converged


class _Estimate(NamedTuple):
    """An estimate of the parameters."""

    parameters: np.ndarray  # The nine parameters, (9,)
    excess_g2: float  # Variance of the magnitudes beyond the noise of the means, g²
    converged: bool  # Whether parameters and excess have converged


def fit_gravity(mean_v: np.ndarray, std_v: np.ndarray, sensor: Sensor,
                stretches: int = STRETCHES) -> GravityFit:
    """
    Fit the nine parameters by maximum likelihood of the magnitudes.

    Errors across gravity do not change the magnitude to first order. Real rests scatter by more
    than the noise of their means (flicker, hysteresis, effects beyond nine parameters). A common
    excess variance is therefore estimated with the parameters, and widens the covariance.

    Parameters
    ----------
    mean_v, std_v
        Mean of each rest and its standard deviation, V, (k, 3), in the order of time.
    sensor
        Nominal values and local gravity of a three-axis sensor.
    stretches
        Groups of successive rests that are held out together: neighbours share temperature and
        time, so that a rest that is held out alone shows no drift.

    Returns
    -------
    GravityFit
        The fit, converged or not.

    Raises
    ------
    UserError
        The rests do not determine the parameters, or do not read gravity. The message names the
        coefficients.

    """
    rests = gravity_model.nominal_rests(mean_v, std_v, sensor)
    _require_determined(rests, np.zeros(len(NAMES)), 0.0)
    fits = cache(lambda mask: _fit(rests[np.frombuffer(mask, bool)]))

    def fit(kept: np.ndarray) -> _Estimate:
        """Fit the rests of a mask, (k,) bool, once for each mask."""
        return fits(kept.tobytes())

    kept = _inliers(rests, fit)
    parameters, excess_g2, converged = fit(kept)
    _require_determined(rests[kept], parameters, excess_g2)
    variance = magnitude_variance(rests, parameters) + excess_g2
    covariance = np.linalg.inv(
        gravity_model.fisher_information(rests[kept], parameters, excess_g2))
    # An excess that ν rests determine widens its share of the variance by ν/(ν − 2).
    covariance *= 1 + excess_g2 / variance[kept].mean() * 2 / max(
        kept.sum() - len(NAMES) - 2, 1)
    values, units = gravity_model.effect_values(parameters, sensor)
    residual = _residual(rests, parameters)
    return GravityFit(
        values=values, covariance=covariance * np.outer(units, units),
        before_mps2=G0_MPS2 * (np.linalg.norm(rests.mean, axis=1) - rests.gravity_g),
        residual_mps2=G0_MPS2 * residual,
        held_out_mps2=G0_MPS2 * _held_out(rests, kept, parameters, variance, residual, stretches),
        expected_mps2=G0_MPS2 * np.sqrt(variance),
        excess_mps2=G0_MPS2 * float(np.sqrt(excess_g2)),
        outliers=tuple(int(i) for i in np.flatnonzero(~kept)),
        converged=converged)


def _residual(rests: NominalRests, parameters: np.ndarray) -> np.ndarray:
    """Return magnitude minus local gravity, g, (k,), or (s, k) for s sets of parameters."""
    return gravity_model.magnitude(rests.mean, parameters) - rests.gravity_g


def _solve(rests: NominalRests, start: np.ndarray, variance: np.ndarray
           ) -> tuple[np.ndarray, bool]:
    """Fit with given variances of the magnitudes, g², (k,); also return whether it converged."""
    std = np.sqrt(variance)
    # `least_squares` calls the same routine of MINPACK, and takes twice the time around it.
    parameters, _, _, _, status = scipy.optimize.leastsq(
        lambda p: _residual(rests, p) / std, start,
        Dfun=lambda p: gravity_model.magnitude_jacobian(rests.mean, p) / std[:, None],
        full_output=True, xtol=_TOLERANCE, ftol=_TOLERANCE, gtol=_TOLERANCE, diag=_UNSCALED)
    return parameters, status in _CONVERGED


def _fit(rests: NominalRests) -> _Estimate:
    """Fit the parameters, and the excess variance that makes χ² equal its degrees of freedom."""
    parameters, excess_g2 = np.zeros(len(NAMES)), 0.0
    freedom = len(rests.mean) - len(NAMES)
    for _ in range(_MAX_ROUNDS):
        variance = magnitude_variance(rests, parameters)
        parameters, converged = _solve(rests, parameters, variance + excess_g2)
        squares = _residual(rests, parameters) ** 2
        before_g2, excess_g2 = excess_g2, _excess(squares, variance, freedom)
        if abs(excess_g2 - before_g2) <= _EXCESS_TOLERANCE * (excess_g2 + variance.min()):
            return _Estimate(parameters, excess_g2, converged)
    return _Estimate(parameters, excess_g2, False)


def _excess(squares: np.ndarray, variance: np.ndarray, freedom: int) -> float:
    """Solve Σ r²/(v + excess) = freedom."""
    def surplus(excess_g2: float) -> float:
        return float((squares / (variance + excess_g2)).sum()) - freedom
    if surplus(0.0) <= 0:
        return 0.0
    return float(scipy.optimize.brentq(surplus, 0.0, squares.sum() / freedom, rtol=1e-9,
                                       xtol=1e-30))


def _inliers(rests: NominalRests, fit: Callable[[np.ndarray], _Estimate]) -> np.ndarray:
    """
    Mark the rests that fit the others, (k,) bool.

    The search begins with the rests near the fit with the least sum of absolute errors, where
    outliers cannot mask one another. Then rests leave or return, one at a time, by their
    studentised distance from the fit to the others, until each kept rest fits and each other does
    not.
    """
    count = len(rests.mean)
    max_outliers = min(int(_MAX_OUTLIERS * count), count - MIN_RESTS)
    if max_outliers < 1:
        return np.ones(count, bool)
    robust = scipy.optimize.least_squares(
        lambda p: _residual(rests, p), np.zeros(len(NAMES)),
        lambda p: gravity_model.magnitude_jacobian(rests.mean, p), loss='soft_l1',
        f_scale=gravity_model.TRIAL_STD_G)
    size = np.abs(robust.fun)
    freedom = max(count - max_outliers - len(NAMES), 1)
    variance = np.sum(np.sort(size)[:count - max_outliers] ** 2) / freedom
    kept = size <= _MAX_DEVIATIONS * np.sqrt(
        variance + magnitude_variance(rests, robust.x).mean())
    for _ in range(2 * max_outliers):
        distance = _studentised(rests, kept, fit(kept))
        limit = -scipy.special.stdtrit(max(kept.sum() - MIN_RESTS, 1),
                                       _OUTLIER_CHANCE / (2 * count))
        excluded, included = np.where(kept, np.inf, distance), np.where(kept, distance, 0)
        if excluded.min() <= limit:
            kept[excluded.argmin()] = True
        elif included.max() > limit and (~kept).sum() < max_outliers:
            kept[included.argmax()] = False
        else:
            break
    return kept


def _studentised(rests: NominalRests, kept: np.ndarray, estimate: _Estimate) -> np.ndarray:
    """Return the distance of each rest from the fit to the others by its std, (k,)."""
    parameters, excess_g2, _ = estimate
    variance = magnitude_variance(rests, parameters) + excess_g2
    covariance = np.linalg.inv(
        gravity_model.posterior_information(rests[kept], parameters, excess_g2))
    jacobian = gravity_model.magnitude_jacobian(rests.mean, parameters)
    leverage = np.einsum('ki,ij,kj->k', jacobian, covariance, jacobian) / variance
    distance = np.abs(_residual(rests, parameters)) / np.sqrt(variance)
    inside = distance / np.sqrt(np.maximum(1 - leverage, _MIN_REMAINDER))
    # χ² per degree of freedom of the other rests, at least that of the noise of the means.
    freedom = kept.sum() - len(NAMES)
    others = (max((distance[kept] ** 2).sum(), freedom) - inside ** 2) / max(freedom - 1, 1)
    inside = inside / np.sqrt(np.maximum(others, np.median(1 - excess_g2 / variance)))
    return np.where(kept, inside, distance / np.sqrt(1 + leverage))


def _held_out(rests: NominalRests, kept: np.ndarray, parameters: np.ndarray,
              variance: np.ndarray, residual: np.ndarray, stretches: int) -> np.ndarray:
    """Return magnitude minus gravity by the fit to the other stretches of rests, g, (k,)."""
    errors, used = residual.copy(), rests[kept]
    count = len(used.mean)
    stretches = min(stretches, count)
    stretch = np.arange(count) * stretches // count
    for number in range(stretches):
        others = stretch != number
        # Of nine rests the other eight determine no fit.
        without = parameters if others.sum() < len(NAMES) else _solve(
            used[others], parameters, variance[kept][others])[0]
        errors[np.flatnonzero(kept)[~others]] = _residual(used[~others], without)
    return errors


def _require_determined(rests: NominalRests, parameters: np.ndarray, excess_g2: float) -> None:
    """Refuse rests that do not determine a coefficient, or that do not read gravity."""
    count = len(rests.mean)
    measured = np.median(_residual(rests, parameters)) + rests.gravity_g if count else \
        rests.gravity_g
    if not _MIN_GRAVITY_RATIO < measured / rests.gravity_g < _MAX_GRAVITY_RATIO:
        raise UserError(f'gravity: the rests read {measured * G0_MPS2:.3g} m/s², not '
                        f'{rests.gravity_g * G0_MPS2:.3g}: correct nominal_zero_g_v, '
                        'nominal_scale_v_per_g or local_gravity_mps2')
    information = gravity_model.posterior_information(rests, parameters, excess_g2)
    missing = gravity_model.undetermined(information)
    if count >= MIN_RESTS and not missing:
        return
    names = 'all nine coefficients' if len(missing) == len(NAMES) else \
        ', '.join(map(str, missing))
    reason = f'do not determine {names}' if missing else f'are too few, at least {MIN_RESTS}'
    scatter = f' and scatter by {1e3 * np.sqrt(excess_g2):.2g} mg' if excess_g2 else ''
    raise UserError(f'gravity: without their angles (fit --poses), the {count} rests {reason}'
                    f'{scatter}; add rests with each axis up and down, and '
                    'with two axes equally up')
