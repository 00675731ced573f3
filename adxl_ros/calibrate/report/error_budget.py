# SPDX-License-Identifier: Apache-2.0

"""
Error budget of a calibration: the mean square of held-out errors, split by cause.

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

from dataclasses import dataclass, replace
from math import sqrt
from typing import NamedTuple

from adxl_ros.calibrate.fits.gravity_fit import GravityFit
from adxl_ros.calibrate.pose_response import stage_force
from adxl_ros.calibrate.poses import Poses, reference_force
from adxl_ros.calibrate.report.cross_validation import (
    angle_between,
    degrees_of_freedom,
    determining_alpha,
    HeldOutErrors,
    pose_errors,
)
from adxl_ros.model import noise
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.covariance import force_covariance
from adxl_ros.model.sensor import Sensor
import numpy as np
import scipy

_SAME_POSE_RAD = np.radians(0.5)
"""Largest distance of the joint angles of two visits of the same pose, rad; chosen."""
_MIN_PAIRS = 6
"""Smallest number of pairs of visits that show the scatter between visits; chosen."""
_PROBE_MPS2 = 1e-3 * G0_MPS2
"""Error of each axis, m/s², for which the resulting tilt error is computed: 1 mg."""
_CHANCE = 0.01
"""Probability of a model part by chance, if the errors have none; chosen."""
_UPPER_QUANTILE = 0.95
"""Probability of the upper end of a 90 % interval."""


@dataclass(frozen=True)
class ErrorBudget:
    """Parts of a mean square of errors: (m/s²)² per axis for acceleration, rad² for tilt."""

    # Mean square of the held-out errors. By chance it differs from the sum of the parts.
    measured: float
    # noise, stage, coefficients, model: The parts, as the module describes them
    noise: float
    stage: float
    coefficients: float
    model: float
    calibration_high: float  # Upper end of the 90 % interval of `coefficients + model`
    separable: bool = True  # Whether the poses separate stage and model
    # Mean square of tilt that a mean square of 1 (m/s²)² on each measured axis causes; NaN for
    # acceleration
    tilt_per_axis: float = float('nan')

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
        if not self.separable and \
                max(self.model, self.coefficients) > max(self.noise, self.stage):
            return 'stage or model'
        # Noise and stage cause the error of the coefficients, which is no limit of its own.
        causes = {'noise': self.noise, 'stage': self.stage, 'model': self.model}
        return list(causes)[int(np.argmax(list(causes.values())))]


_NO_BUDGET = ErrorBudget(measured=float('nan'), noise=float('nan'), stage=float('nan'),
                         coefficients=float('nan'), model=float('nan'),
                         calibration_high=float('nan'))
"""Budget of a quantity that no pose shows."""


class ErrorBudgets(NamedTuple):
    """The error budgets of one model."""

    accel: ErrorBudget  # Budget of acceleration, (m/s²)² per axis
    tilt: ErrorBudget  # Budget of tilt, rad²


class _Covariances(NamedTuple):
    """Covariances of the specific force by cause, (m/s²)², each (3, 3, k)."""

    # noise, coefficients, stage: Covariance by the noise of the mean, by the calibration, and by
    # the stated stage error
    noise: np.ndarray
    coefficients: np.ndarray
    stage: np.ndarray
    probe: np.ndarray  # Covariance by an independent error `_PROBE_MPS2` on each measured axis


class _PredictedParts(NamedTuple):
    """Parts of a mean square that covariances predict."""

    # noise, coefficients: As in `ErrorBudget`
    noise: float
    coefficients: float
    stated_stage: float  # Part of the stage error that the parameter file states


class _Scatter(NamedTuple):
    """Mean square of errors that no model can explain."""

    # accel, tilt: Mean square of acceleration, (m/s²)² per axis, and of tilt, rad²
    accel: float
    tilt: float
    has_noise: bool  # Whether it includes the noise of the means


def error_budgets(errors: HeldOutErrors, poses: Poses, stage: Sensor | None = None
                  ) -> ErrorBudgets:
    """Split the held-out errors of one model by cause."""
    held = poses.subset(errors.pose_index)
    sensor = errors.fitted[0]
    gravity = sensor.local_gravity_mps2
    measured = errors.errors
    reference = np.column_stack(reference_force(held, gravity))
    corrected = reference if stage is None else np.column_stack(
        stage_force(stage, held.alpha_rad, held.beta_rad))
    has_tilt = np.isfinite(measured.tilt_rad)
    axes = [AXES.index(axis) for axis in sensor.axes]
    used = determining_alpha(measured)
    covariances = _covariances(errors, held, reference)
    scatter = _scatter(sensor, poses.subset(~poses.check))
    accel = tilt = _NO_BUDGET
    if used.any():
        predicted = _PredictedParts(*(_axis_variance(covariance, axes, used)
                                    for covariance in covariances[:3]))
        accel = _budget((measured.force_mps2 - corrected)[used][:, axes],
                        float(np.mean(measured.accel_mps2[used] ** 2)), predicted,
                        _unexplainable(scatter, 'accel', predicted))
    if has_tilt.any():
        predicted = _PredictedParts(*(_tilt_variance(covariance, reference, gravity, has_tilt)
                                    for covariance in covariances[:3]))
        tilt = _budget(angle_between(measured.force_mps2, corrected)[has_tilt],
                       float(np.mean(measured.tilt_rad[has_tilt] ** 2)), predicted,
                       _unexplainable(scatter, 'tilt', predicted))
        tilt_per_axis = _tilt_variance(covariances.probe, reference, gravity, has_tilt) \
            / _PROBE_MPS2 ** 2
        tilt = replace(tilt, tilt_per_axis=tilt_per_axis)
    return ErrorBudgets(accel, tilt)


def _unexplainable(scatter: _Scatter | None, quantity: str, predicted: _PredictedParts
                   ) -> float | None:
    """Return the mean square that no model explains, without noise; None where unknown."""
    if scatter is None:
        return None
    return getattr(scatter, quantity) - (predicted.noise if scatter.has_noise else 0.0)


def _budget(errors: np.ndarray, measured: float, predicted: _PredictedParts,
            unexplainable: float | None) -> ErrorBudget:
    """
    Split a mean square of errors against the corrected reference.

    errors: errors against the corrected reference, (k,) or (k, m), in the order of the visit.
    """
    mean_square, nu = float(np.mean(errors ** 2)), degrees_of_freedom(errors)
    lower = mean_square * nu / float(scipy.special.chdtri(nu, _CHANCE))
    upper = mean_square * nu / float(scipy.special.chdtri(nu, _UPPER_QUANTILE))
    largest_stage = predicted.stated_stage if unexplainable is None else \
        max(predicted.stated_stage, unexplainable)
    explained = predicted.noise + predicted.coefficients + largest_stage
    model = mean_square - explained if lower > explained else 0.0
    stage = min(max(mean_square - predicted.noise - predicted.coefficients, 0.0), largest_stage)
    return ErrorBudget(
        measured, predicted.noise, max(measured - mean_square, 0.0) + stage,
        predicted.coefficients, model,
        predicted.coefficients + max(upper - explained, 0.0), unexplainable is not None)


def _covariances(errors: HeldOutErrors, held: Poses, reference: np.ndarray) -> _Covariances:
    """Return the covariances of the specific force in the held-out poses."""
    shape = (3, 3, len(held))
    by_noise, by_coefficients, by_probe = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    for number, sensor in enumerate(errors.fitted):
        fold = errors.fold == number
        force, environment = list(reference[fold].T), held.subset(fold).environment
        variance_v2 = np.mean(held.std_v[fold], axis=0) ** 2
        total = force_covariance(sensor, force, variance_v2, environment)
        without_noise = force_covariance(sensor, force, 0 * variance_v2, environment)
        by_noise[:, :, fold] = total - without_noise
        by_coefficients[:, :, fold] = without_noise
        exact = sensor.without_covariance()
        by_probe[:, :, fold] = force_covariance(
            exact, force, (sensor.scale_v_per_g / G0_MPS2 * _PROBE_MPS2) ** 2, environment)
    return _Covariances(by_noise, by_coefficients, _stage_covariance(errors.fitted[0], held),
                        by_probe)


def _stage_covariance(sensor: Sensor, held: Poses) -> np.ndarray:
    """Return the covariance of the reference by the stated stage error, (m/s²)², (3, 3, k)."""
    variance = (sensor.stage_std_rad * sensor.local_gravity_mps2) ** 2
    a, b, zero = held.alpha_rad, held.beta_rad, np.zeros(len(held))
    by_alpha = np.array([np.cos(a) * np.cos(b), -np.cos(a) * np.sin(b), -np.sin(a)])
    by_beta = np.array([-np.sin(a) * np.sin(b), -np.sin(a) * np.cos(b), zero])
    return variance * (np.einsum('ik,jk->ijk', by_alpha, by_alpha)
                       + np.einsum('ik,jk->ijk', by_beta, by_beta))


def _axis_variance(covariance: np.ndarray, axes: list[int], used: np.ndarray) -> float:
    """Return the mean variance of the measured axes over the poses used, (m/s²)²."""
    return float(np.mean([covariance[d, d][used] for d in axes]))


def _tilt_variance(covariance: np.ndarray, force: np.ndarray, gravity: float, used: np.ndarray
                   ) -> float:
    """Return the mean square of tilt over the poses used, rad², by the part across the force."""
    up = force / np.linalg.norm(force, axis=1, keepdims=True)
    trace = np.einsum('iik->k', covariance)
    radial = np.einsum('ki,ijk,kj->k', up, covariance, up)
    return float(np.mean((trace - radial)[used])) / gravity ** 2


def _scatter(sensor: Sensor, poses: Poses) -> _Scatter | None:
    """Return the scatter that no model can explain; None where the poses do not show it."""
    joints = np.column_stack([np.cos(poses.alpha_rad), np.sin(poses.alpha_rad),
                              np.cos(poses.beta_rad), np.sin(poses.beta_rad)])
    near = scipy.spatial.cKDTree(joints).query_pairs(_SAME_POSE_RAD)
    pairs = np.array(sorted(near), int).reshape(-1, 2)
    gravity = sensor.local_gravity_mps2
    errors = pose_errors(sensor, poses)
    reference = np.column_stack(reference_force(poses, gravity))
    if len(pairs) >= _MIN_PAIRS:
        # The difference of two visits has twice the mean square of one visit.
        accel = np.diff(errors.accel_mps2[pairs], axis=1)[:, 0]
        force = np.diff((errors.force_mps2 - reference)[pairs], axis=1)[:, 0]
        has_tilt = np.isfinite(errors.tilt_rad[pairs]).all(axis=1)
        across = np.cross(force, reference[pairs[:, 0]])[has_tilt] / gravity ** 2
        tilt = np.sum(across ** 2) / max(len(across), 1) / 2
        return _Scatter(float(np.mean(accel ** 2) / 2), float(tilt), has_noise=True)
    if sensor.axes != AXES:
        return None
    # No stage error changes |f|. A model error is as large in |f| as in any other direction.
    magnitude = np.linalg.norm(errors.force_mps2, axis=1) - gravity
    excess = max(float(np.mean(errors.accel_mps2 ** 2) - np.mean(magnitude ** 2)), 0.0)
    return _Scatter(excess, 3 * excess / gravity ** 2, has_noise=False)


def gravity_error_budgets(fit: GravityFit, fitted: Sensor, force: np.ndarray, kept: np.ndarray
                          ) -> ErrorBudgets:
    """
    Split the held-out errors of the magnitude of gravity; there is no stage part.

    The part of the coefficients is that of the force by their covariance. It includes directions
    that a magnitude does not show.

    force: specific force in all rests by the fit, m/s², (k, 3).
    """
    errors = fit.held_out_mps2[kept]
    excess = fit.excess_mps2 ** 2
    by_noise = float(np.mean(fit.expected_mps2[kept] ** 2)) - excess
    covariance = force_covariance(fitted, list(force[kept].T), np.zeros(len(fitted.axes)))
    gravity, used = fitted.local_gravity_mps2, np.ones(len(kept), bool)
    measured, nu = float(np.mean(errors ** 2)), degrees_of_freedom(errors)
    quantile = float(scipy.special.chdtri(nu, _UPPER_QUANTILE))
    upper = max(measured * nu / quantile - by_noise, excess)
    accel = _axis_variance(covariance, [0, 1, 2], used)
    tilt = _tilt_variance(covariance, force[kept], gravity, used)
    # Each of three axes has the error of a magnitude; two of the three turn the vertical.
    return ErrorBudgets(
        ErrorBudget(measured, by_noise, 0.0, accel, excess, accel + upper),
        ErrorBudget(3 * measured / gravity ** 2, 2 * by_noise / gravity ** 2, 0.0, tilt,
                    2 * excess / gravity ** 2, tilt + 2 * upper / gravity ** 2,
                    tilt_per_axis=2 / gravity ** 2))


def sample_noise_mps2(sensor: Sensor) -> float:
    """Return the noise of one sample, rms over the axes, m/s²."""
    noise_g = noise.sample_std_v(sensor) / sensor.scale_v_per_g
    return float(np.sqrt(np.mean(noise_g ** 2))) * G0_MPS2


def rms_mg(mean_square: float) -> float:
    """Return the rms in mg of a mean square in (m/s²)²; 0 for a negative one."""
    return sqrt(max(mean_square, 0.0)) / G0_MPS2 * 1e3
