# SPDX-License-Identifier: Apache-2.0

"""
Budget of the errors on poses that a fit has not seen: their mean square, split by cause.

The mean runs over axes and over the poses that determine alpha. Squares add:

    measured = noise + stage + coefficients + model

- noise: the noise of the pose's mean, propagated through the linearised inverse.
- stage: the random error of each joint. It is at most the stated σ = step/√12, or the scatter
  between visits of the same pose if that is larger. The level of the base and the eccentricity
  that the full model fits are corrected in the reference.
- coefficients: the covariance of the calibration, which noise and stage error cause.
- model: the remainder. It counts if chance explains it less than once in a hundred, by the degrees
  of freedom of correlated poses. The scatter between visits of the same pose is no part of it.
  Where no pose was visited twice, a sensor with z separates stage and model by |f|, which no
  stage can change.

The error of the calibration itself is √(coefficients + model).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import nan, sqrt
from typing import NamedTuple

from adxl_ros.model import signal_chain
from adxl_ros.model.covariance import coefficient_tangent
from adxl_ros.model.effects.base import Components, Environment, NOMINAL_ENVIRONMENT
from adxl_ros.model.kinematics import unit_vectors
from adxl_ros.model.sensor import Sensor
from adxl_ros.report.quantities import mg
import numpy as np
import scipy

UPPER_QUANTILE = 0.95  # Probability of the upper end of a 90 % interval


@dataclass(frozen=True)
class ErrorBudget:
    """Parts of a mean square of errors: (m/s²)² per axis for acceleration, rad² for tilt."""

    measured: float  # By chance it differs from the sum of the parts
    noise: float
    stage: float
    coefficients: float
    model: float
    # Upper end of the 90 % interval of the error of this calibration, of which
    # `coefficients + model` is the mean over many calibrations
    calibration_high: float
    separable: bool = True  # Whether the poses separate stage and model
    # Mean square of tilt that a mean square of 1 (m/s²)² on each measured axis causes; NaN for
    # acceleration
    tilt_per_axis: float = nan

    @property
    def calibration(self) -> float:
        """Return the mean square of the error of the calibration itself."""
        return self.coefficients + self.model

    @property
    def expected(self) -> float:
        """Return the sum of all parts."""
        return self.noise + self.stage + self.coefficients + self.model

    @property
    def limited_by(self) -> str:
        """Return the cause of the largest part: noise, stage, model, or 'stage or model'."""
        if not self.separable and max(self.model, self.coefficients) > max(self.noise, self.stage):
            return 'stage or model'
        # Noise and stage cause the error of the coefficients, which is no limit of its own.
        parts = {'noise': self.noise, 'stage': self.stage, 'model': self.model}
        return max(parts, key=lambda part: parts[part])


class ErrorBudgets(NamedTuple):
    """The error budgets of one model."""

    accel: ErrorBudget  # (m/s²)² per axis
    tilt: ErrorBudget  # rad²


def coefficient_spread(
    sensor: Sensor, force: Components, environment: Environment = NOMINAL_ENVIRONMENT
) -> float:
    """
    Return how far the mean square by the coefficients may exceed its mean: the 95 % quantile.

    The error by the coefficients of one fit is drawn once, and few of its directions matter. Its
    mean square over the poses has the mean Σλ and the degrees of freedom (Σλ)²/Σλ² (Satterthwaite
    1946), with the eigenvalues λ of its covariance.
    """
    if not sensor.covariance_names:
        return 1.0
    tangent = signal_chain.tangent(
        signal_chain.analog_response(sensor), sensor.axes, force, environment
    )
    slope = np.einsum(
        'iak,apk->ipk', np.array(tangent.back), coefficient_tangent(sensor)(force, environment)
    )
    product = np.einsum('ipk,iqk->pq', slope, slope) @ sensor.covariance
    nu = float(np.trace(product) ** 2 / np.trace(product @ product))
    return float(scipy.special.chdtri(nu, 1 - UPPER_QUANTILE)) / nu


def axis_variance(covariance: np.ndarray, axes: list[int], used: np.ndarray) -> float:
    """Return the mean variance of the measured axes over the poses used, (m/s²)²."""
    return float(np.mean([covariance[d, d][used] for d in axes]))


def tilt_variance(
    covariance: np.ndarray, force: np.ndarray, gravity: float, used: np.ndarray
) -> float:
    """Return the mean square of tilt over the poses used, rad², by the part across the force."""
    up = unit_vectors(force)
    trace = np.einsum('iik->k', covariance)
    radial = np.einsum('ki,ijk,kj->k', up, covariance, up)
    return float(np.mean((trace - radial)[used])) / gravity**2


def rms_mg(mean_square: float) -> float:
    """Return the rms in mg of a mean square in (m/s²)²; 0 for a negative one."""
    return float(mg(sqrt(max(mean_square, 0.0))))
