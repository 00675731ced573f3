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
Nine parameters of a three-axis sensor from the magnitude of gravity over its rests.

At rest the specific force has the magnitude of local gravity, whatever the pose. Zero-g, scale
factor and three angles between the sensing axes make it so: V = zero-g + scale·(Θ·f/g₀) with
Θ of equations 18 and 19. The magnitude cannot tell how the case turns with the axes, which is
three angles: the gauge holds Θx on the case's x and Θy in its x-y plane.
"""

from __future__ import annotations

from dataclasses import dataclass

from adxl_ros.calibrate.fits.gravity_model import (
    effect_values,
    fisher_information,
    iterated,
    magnitude,
    magnitude_jacobian,
    magnitude_variance,
    NAMES,
    nominal_rests,
    Rests,
    TRIAL_STD_G,
    undetermined,
)
from adxl_ros.calibrate.fits.orientations import poses_to_add
from adxl_ros.errors import UserError
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.sensor import Sensor
import numpy as np
from scipy.optimize import brentq, least_squares
from scipy.special import gammaln, stdtrit

MIN_RESTS = len(NAMES) + 1
"""One rest more than coefficients: with fewer, nothing says how good the fit is."""
OUTLIER_CHANCE = 0.01
"""Chance that a fit without knocks takes any of its rests for one."""
STARTS = 20
"""Fits to ten rests each, that one of them may be without knocks."""
FIRST_STEPS = 4
"""Gauss-Newton steps with the ten rests of a start."""
STEPS = 11
"""Gauss-Newton steps with the rests that fit best."""
KNOCK = 0.03
"""Width of what a knock can make of a magnitude, g."""
OUTLIERS = 0.25
"""Share of the rests that may be knocks, at most."""


@dataclass(frozen=True)
class GravityFit:
    """
    What the rests say about the sensor.

    Attributes
    ----------
    values
        Effects' parameters by axis, as `Sensor.values` holds them.
    covariance
        Of the fitted coefficients in the units of NAMES, (9, 9).
    before_mps2, residual_mps2, leave_one_out_mps2
        Magnitude less local gravity at every rest, (k,): by the nominal figures, by the fit, and
        by the fit to all other rests.
    expected_mps2
        Standard deviation of a rest's magnitude, (k,): of its mean, and what the means' noise
        leaves unexplained.
    excess_mps2
        The part of it that the noise of the means leaves unexplained.
    outliers
        Numbers of the rests that do not fit the others, and were left out.
    converged
        Whether parameters and excess variance settled.

    """

    values: dict[str, dict[str, np.ndarray]]
    covariance: np.ndarray
    before_mps2: np.ndarray
    residual_mps2: np.ndarray
    leave_one_out_mps2: np.ndarray
    expected_mps2: np.ndarray
    excess_mps2: float
    outliers: tuple[int, ...]
    converged: bool = True


def fit_gravity(mean_v: np.ndarray, standard_error_v: np.ndarray, sensor: Sensor) -> GravityFit:
    """
    Fit the nine parameters by maximum likelihood.

    The likelihood is that of the magnitudes; errors across gravity change them by nothing to
    first order. Real rests scatter by more than the noise of their means (flicker, hysteresis,
    what nine parameters do not hold): a common excess variance is estimated with the fit, so
    that the covariance tells what the rests bear out.

    Parameters
    ----------
    mean_v, standard_error_v
        Mean of each rest and its standard error, V, (k, 3).
    sensor
        Nominal figures and local gravity of a three-axis sensor.

    Raises
    ------
    UserError
        If the rests do not determine the parameters: it names those, and rests to add; or if
        what they read is not gravity at all.

    """
    rests = nominal_rests(mean_v, standard_error_v, sensor)
    nominal = np.zeros(len(NAMES))
    _require_determined(rests, nominal, 0.0)
    kept = _inliers(rests, nominal)
    found, excess, converged = _fit(rests[kept], nominal)
    _require_determined(rests[kept], found, excess)
    variance = magnitude_variance(rests, found) + excess
    jacobian = magnitude_jacobian(rests[kept].mean, found) / np.sqrt(variance[kept, None])
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    covariance *= _t_factor(excess, variance[kept])
    values, to_units = effect_values(found, sensor)
    residual = magnitude(rests.mean, found) - rests.gravity
    return GravityFit(
        values=values,
        covariance=covariance * np.outer(to_units, to_units),
        before_mps2=G0_MPS2 * (np.linalg.norm(rests.mean, axis=1) - rests.gravity),
        residual_mps2=G0_MPS2 * residual,
        leave_one_out_mps2=G0_MPS2 * _leave_one_out(rests, kept, found, variance, residual),
        expected_mps2=G0_MPS2 * np.sqrt(variance),
        excess_mps2=G0_MPS2 * float(np.sqrt(excess)),
        outliers=tuple(int(i) for i in np.flatnonzero(~kept)),
        converged=converged)


def _solve(rests: Rests, start: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, bool]:
    """Fit with given variances of the magnitudes, g², (k,); tells whether it converged, too."""
    sigma = np.sqrt(variance)
    found = least_squares(lambda p: (magnitude(rests.mean, p) - rests.gravity) / sigma, start,
                          lambda p: magnitude_jacobian(rests.mean, p) / sigma[:, None],
                          method='lm', xtol=1e-12, ftol=1e-12, gtol=1e-12)
    return found.x, bool(found.success)


def _fit(rests: Rests, start: np.ndarray) -> tuple[np.ndarray, float, bool]:
    """
    Fit the parameters, and the excess variance, g², that makes chi-squared its freedom.

    Returns
    -------
    tuple
        Parameters, (9,); excess variance, g²; whether both converged.

    """
    found, excess = start, 0.0
    freedom = len(rests.mean) - len(NAMES)
    for _ in range(20):
        variance = magnitude_variance(rests, found)
        found, solved = _solve(rests, found, variance + excess)
        squares = (magnitude(rests.mean, found) - rests.gravity) ** 2
        before, excess = excess, _excess(squares, variance, freedom)
        if abs(excess - before) <= 1e-6 * (excess + variance.min()):
            return found, excess, solved
    return found, excess, False


def _excess(squares: np.ndarray, variance: np.ndarray, freedom: int) -> float:
    """Solve Σ r²/(v + excess) = freedom."""
    def surplus(excess: float) -> float:
        return float((squares / (variance + excess)).sum()) - freedom
    if surplus(0.0) <= 0:
        return 0.0
    return float(brentq(surplus, 0.0, squares.sum() / freedom, rtol=1e-9, xtol=1e-30))


def _t_factor(excess: float, variance: np.ndarray) -> float:
    """Widen the covariance for an excess that ν rests told: Student's variance, ν/(ν − 2)."""
    # The share of the variance that the noise of the means explains needs no such allowance.
    freedom = len(variance) - len(NAMES)
    return 1 + excess / variance.mean() * 2 / max(freedom - 2, 1)


def _inliers(rests: Rests, start: np.ndarray) -> np.ndarray:
    """
    Tell which rests fit the others, (k,): the rest are knocks, or were no rests.

    Rests leave or come back, one at a time, by their studentised distance from the fit to the
    others: once from all of them, and once from the best fit to most of them, where several
    knocks cannot hide one another. The likelihood tells which of the two results is right.
    """
    count = len(rests.mean)
    most = min(int(OUTLIERS * count), count - MIN_RESTS)
    everything = np.ones(count, bool)
    if most < 1:
        return everything
    results = [_exchanged(rests, begin, start, most)
               for begin in (everything, _robust_inliers(rests, start, most))]
    return min(results, key=lambda kept: _unlikeliness(rests, kept, start))


def _exchanged(rests: Rests, kept: np.ndarray, start: np.ndarray, most: int) -> np.ndarray:
    """Let rests leave or come back until each kept one fits, and each other does not, (k,)."""
    kept = kept.copy()
    for _ in range(2 * most):
        distance = _studentised(rests, kept, start)
        freedom = max(kept.sum() - MIN_RESTS, 1)
        allowed = -stdtrit(freedom, OUTLIER_CHANCE / (2 * len(kept)))
        back = np.where(kept, np.inf, distance)
        out = np.where(kept, distance, 0)
        if back.min() <= allowed:
            kept[back.argmin()] = True
        elif out.max() > allowed and (~kept).sum() < most:
            kept[out.argmax()] = False
        else:
            break
    return kept


def _unlikeliness(rests: Rests, kept: np.ndarray, start: np.ndarray) -> float:
    """Negative logarithm of the residual likelihood, knocks being anywhere within KNOCK."""
    found, excess, _ = _fit(rests[kept], start)
    variance = magnitude_variance(rests[kept], found).mean() + excess
    count, knocks = len(kept), (~kept).sum()
    ways = gammaln(count + 1) - gammaln(knocks + 1) - gammaln(count - knocks + 1)
    return float((kept.sum() - len(NAMES)) / 2 * np.log(variance * 2 * np.pi * np.e)
                 + knocks * np.log(KNOCK) + ways)


def _robust_inliers(rests: Rests, start: np.ndarray, most: int) -> np.ndarray:
    """
    Tell which rests the best fit to all but `most` of them does not leave far off, (k,).

    Least trimmed squares: from fits to a few rests each, step by step with the rests that each
    fit suits best, to the one that suits its rests best.
    """
    count = len(rests.mean)
    draw = np.random.default_rng(0)

    def nearest(values: np.ndarray) -> Rests:
        squares = (magnitude(rests.mean, values) - rests.gravity) ** 2
        return rests[np.argsort(squares)[:count - most]]

    best, least = start, np.inf
    for _ in range(STARTS):
        few = rests[draw.choice(count, MIN_RESTS, replace=False)]
        found = iterated(few, start, FIRST_STEPS)
        found = iterated(nearest, found, STEPS)
        left = np.sum((magnitude(nearest(found).mean, found) - rests.gravity) ** 2)
        if left < least:
            best, least = found, left
    freedom = max(count - most - len(NAMES), 1)
    spread = np.sqrt(least / freedom + magnitude_variance(rests, best).mean())
    return np.abs(magnitude(rests.mean, best) - rests.gravity) <= 5 * spread


def _studentised(rests: Rests, kept: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Distance of each rest from the fit to the others, in its standard deviations, (k,)."""
    found, excess, _ = _fit(rests[kept], start)
    variance = magnitude_variance(rests, found) + excess
    covariance = np.linalg.inv(fisher_information(rests[kept], found, excess))
    jacobian = magnitude_jacobian(rests.mean, found)
    leverage = np.einsum('ki,ij,kj->k', jacobian, covariance, jacobian) / variance
    distance = np.abs(magnitude(rests.mean, found) - rests.gravity) / np.sqrt(variance)
    inside = distance / np.sqrt(np.maximum(1 - leverage, 1e-9))
    # What remains of chi-squared without the rest itself; the means' noise is there in any case.
    freedom = kept.sum() - len(NAMES)
    others = (max((distance[kept] ** 2).sum(), freedom) - inside ** 2) / max(freedom - 1, 1)
    inside = inside / np.sqrt(np.maximum(others, np.median(1 - excess / variance)))
    return np.where(kept, inside, distance / np.sqrt(1 + leverage))


def _leave_one_out(rests: Rests, kept: np.ndarray, found: np.ndarray, variance: np.ndarray,
                   residual: np.ndarray) -> np.ndarray:
    """Error of each rest's magnitude by the fit to all others, g, (k,)."""
    errors = residual.copy()
    for i in np.flatnonzero(kept):
        others = kept.copy()
        others[i] = False
        without, _ = _solve(rests[others], found, variance[others])
        errors[i] = magnitude(rests.mean[i:i + 1], without)[0] - rests.gravity
    return errors


def _require_determined(rests: Rests, found: np.ndarray, excess: float) -> None:
    """Refuse rests that leave a coefficient open, or read something else than gravity."""
    information = fisher_information(rests, found, excess)
    lost, count = undetermined(information), len(rests.mean)
    read = np.median(magnitude(rests.mean, found)) if count else rests.gravity
    if not 0.5 < read / rests.gravity < 2:
        raise UserError(f'gravity: the rests read {read * G0_MPS2:.3g} m/s², not '
                        f'{rests.gravity * G0_MPS2:.3g}: put nominal_zero_g_v, '
                        'nominal_scale_v_per_g or local_gravity_mps2 right')
    if count >= MIN_RESTS and not lost:
        return
    what = 'all nine coefficients' if len(lost) == len(NAMES) else ', '.join(map(str, lost))
    lacking = f'leave {what} open' if lost else f'are too few, {MIN_RESTS} are the least'
    scatter = f' and scatter by {1e3 * np.sqrt(excess):.2g} mg' if excess else ''
    poses = poses_to_add(max(MIN_RESTS - count, 0), information, found, rests.gravity,
                         TRIAL_STD_G ** 2 + excess)
    raise UserError(f'gravity: the {count} rests that were found {lacking}{scatter}: add rests '
                    f'with {", ".join(poses)}')
