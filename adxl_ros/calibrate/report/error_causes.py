# SPDX-License-Identifier: Apache-2.0

"""The causes of the errors on poses that a fit has not seen: the parts of `ErrorBudget`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import nan
from typing import NamedTuple

from adxl_ros.calibrate.pose_model import reference_force
from adxl_ros.calibrate.poses import Poses
from adxl_ros.calibrate.report.error_budget import (
    axis_variance,
    coefficient_spread,
    ErrorBudget,
    ErrorBudgets,
    tilt_variance,
    UPPER_QUANTILE,
)
from adxl_ros.calibrate.report.held_out import (
    angle_between,
    corrected_reference,
    degrees_of_freedom,
    determining_alpha,
    HeldOutErrors,
    pose_errors,
)
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.covariance import force_covariance
from adxl_ros.model.sensor import Sensor
import numpy as np
import scipy

_SAME_POSE_RAD = np.radians(0.5)
"""Largest distance of the joint angles of two visits of the same pose, rad: above the step of any
encoder, and a tenth of the smallest usual distance of two poses, 5°."""
_MIN_PAIRS = 6
"""Smallest number of pairs of visits that show the scatter between visits: its standard deviation
is then known within 30 %."""
_PROBE_MPS2 = 1e-3 * G0_MPS2
"""Error of each axis, m/s², for which the resulting tilt error is computed: 1 mg."""
_CHANCE = 0.01
"""Probability of a model part by chance, if the errors have none: one of 100 good calibrations is
said to lack a term."""
_NO_BUDGET = ErrorBudget(
    measured=nan, noise=nan, stage=nan, coefficients=nan, model=nan, calibration_high=nan
)
"""Budget of a quantity that no pose shows."""


class PredictedParts(NamedTuple):
    """Mean squares that are known before any error is measured, in the units of a budget."""

    noise: float  # By the noise of the means
    coefficients: float
    stage: float  # By the stated stage error


class Covariances(NamedTuple):
    """Covariances of the specific force in k held-out poses, (m/s²)², (3, 3, k) each."""

    by_noise: np.ndarray  # By the noise of the mean
    by_coefficients: np.ndarray
    by_stage: np.ndarray  # By the stated stage error
    by_probe: np.ndarray  # By an independent error `_PROBE_MPS2` on each measured axis

    def mean_squares(self, mean_square: Callable[[np.ndarray], float]) -> PredictedParts:
        """Return the parts of a mean square, which a function gives for one covariance."""
        return PredictedParts(
            noise=mean_square(self.by_noise),
            coefficients=mean_square(self.by_coefficients),
            stage=mean_square(self.by_stage),
        )


def error_budgets(
    errors: HeldOutErrors, poses: Poses, stage: Sensor | None = None
) -> ErrorBudgets:
    """Split the held-out errors of one model by cause."""
    held = poses.subset(errors.pose_index)
    sensor = errors.fitted[0]
    measured = errors.pose_errors
    gravity = sensor.local_gravity_mps2
    reference = np.column_stack(reference_force(held, gravity))
    corrected = np.column_stack(corrected_reference(held, sensor, stage))
    has_tilt = np.isfinite(measured.tilt_rad)
    used = determining_alpha(measured)
    axes = sensor.axis_indices
    by_cause = covariances(errors, held, reference)
    scatter = _scatter(sensor, poses.subset(~poses.check))
    spread = coefficient_spread(sensor, list(reference.T), held.environment)
    accel = tilt = _NO_BUDGET
    if used.any():
        predicted = by_cause.mean_squares(lambda part: axis_variance(part, axes, used))
        accel = _budget(
            (measured.force_mps2 - corrected)[used][:, axes],
            float(np.mean(measured.accel_mps2[used] ** 2)),
            predicted,
            scatter.without_noise(scatter.accel, predicted),
            spread,
        )
    if has_tilt.any():

        def mean_tilt2(covariance: np.ndarray) -> float:
            return tilt_variance(covariance, reference, gravity, has_tilt)

        predicted = by_cause.mean_squares(mean_tilt2)
        tilt = _budget(
            angle_between(measured.force_mps2, corrected)[has_tilt],
            float(np.mean(measured.tilt_rad[has_tilt] ** 2)),
            predicted,
            scatter.without_noise(scatter.tilt, predicted),
            spread,
        )
        tilt = replace(tilt, tilt_per_axis=mean_tilt2(by_cause.by_probe) / _PROBE_MPS2**2)
    return ErrorBudgets(accel, tilt)


def _budget(
    errors: np.ndarray,
    measured: float,
    predicted: PredictedParts,
    unexplainable: float,
    spread: float,
) -> ErrorBudget:
    """
    Split a mean square of errors against the corrected reference.

    errors: the errors, (k,) or (k, m), in the order of the visit; unexplainable: mean square that
    no model explains, without noise; NaN where it is unknown; spread: see `coefficient_spread`.
    """
    mean_square = float(np.mean(errors**2))
    # What the fitted errors of the stage explain is no part of the mean square.
    by_fitted_stage = max(measured - mean_square, 0.0)
    nu = degrees_of_freedom(errors)
    lower = mean_square * nu / float(scipy.special.chdtri(nu, _CHANCE))
    upper = mean_square * nu / float(scipy.special.chdtri(nu, UPPER_QUANTILE))
    largest_stage = float(np.fmax(predicted.stage, unexplainable))
    explained = predicted.noise + predicted.coefficients + largest_stage
    model = mean_square - explained if lower > explained else 0.0
    left = mean_square - predicted.noise - predicted.coefficients
    by_random_stage = min(max(left, 0.0), largest_stage)
    return ErrorBudget(
        measured=measured,
        noise=predicted.noise,
        stage=by_fitted_stage + by_random_stage,
        coefficients=predicted.coefficients,
        model=model,
        calibration_high=spread * predicted.coefficients + max(upper - explained, 0.0),
        separable=bool(np.isfinite(unexplainable)),
    )


def covariances(errors: HeldOutErrors, held: Poses, reference: np.ndarray) -> Covariances:
    """Return the covariances of the specific force in the held-out poses, by their causes."""
    shape = (3, 3, len(held))
    by_noise = np.zeros(shape)
    by_coefficients = np.zeros(shape)
    by_probe = np.zeros(shape)
    for number, sensor in enumerate(errors.fitted):
        fold = errors.fold == number
        force = list(reference[fold].T)
        environment = held.subset(fold).environment
        exact = sensor.without_covariance()
        none_v2 = np.zeros(len(sensor.axes))
        noise_v2 = np.mean(held.std_v[fold], axis=0) ** 2
        probe_v2 = (sensor.scale_v_per_g / G0_MPS2 * _PROBE_MPS2) ** 2
        total = force_covariance(sensor, force, noise_v2, environment)
        without_noise = force_covariance(sensor, force, none_v2, environment)
        # Without both the doubt is left on which side of 90° alpha is, but the stage knows it.
        by_side = force_covariance(exact, force, none_v2, environment)
        probed = force_covariance(exact, force, probe_v2, environment)
        by_noise[:, :, fold] = total - without_noise
        by_coefficients[:, :, fold] = without_noise - by_side
        by_probe[:, :, fold] = probed - by_side
    by_stage = _stage_covariance(errors.fitted[0], held)
    return Covariances(by_noise, by_coefficients, by_stage, by_probe)


def _stage_covariance(sensor: Sensor, held: Poses) -> np.ndarray:
    """Return the covariance of the reference by the stated stage error, (m/s²)², (3, 3, k)."""
    variance = (sensor.stage_std_rad * sensor.local_gravity_mps2) ** 2
    a = held.alpha_rad
    b = held.beta_rad
    zero = np.zeros(len(held))
    by_alpha = np.array([np.cos(a) * np.cos(b), -np.cos(a) * np.sin(b), -np.sin(a)])
    by_beta = np.array([-np.sin(a) * np.sin(b), -np.sin(a) * np.cos(b), zero])
    return variance * (
        np.einsum('ik,jk->ijk', by_alpha, by_alpha) + np.einsum('ik,jk->ijk', by_beta, by_beta)
    )


class _Scatter(NamedTuple):
    """Mean squares that no model can explain; NaN where the poses do not show them."""

    accel: float  # (m/s²)² per axis
    tilt: float  # rad²
    has_noise: bool  # Whether they include the noise of the means

    def without_noise(self, mean_square: float, predicted: PredictedParts) -> float:
        """Return one of the mean squares without the noise of the means."""
        return mean_square - predicted.noise if self.has_noise else mean_square


def _scatter(sensor: Sensor, poses: Poses) -> _Scatter:
    """Return the mean squares of acceleration and tilt that no model can explain."""
    joints = np.column_stack(
        [
            np.cos(poses.alpha_rad),
            np.sin(poses.alpha_rad),
            np.cos(poses.beta_rad),
            np.sin(poses.beta_rad),
        ]
    )
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
        across = np.cross(force, reference[pairs[:, 0]])[has_tilt] / gravity**2
        tilt = np.sum(across**2) / max(len(across), 1) / 2
        return _Scatter(float(np.mean(accel**2) / 2), float(tilt), has_noise=True)
    if sensor.axes != AXES:
        return _Scatter(nan, nan, has_noise=False)
    # No stage error changes |f|. A model error is as large in |f| as in any other direction.
    magnitude = np.linalg.norm(errors.force_mps2, axis=1) - gravity
    excess = max(float(np.mean(errors.accel_mps2**2) - np.mean(magnitude**2)), 0.0)
    # A turn of the force has three times the mean square that one of its three components has.
    return _Scatter(excess, 3 * excess / gravity**2, has_noise=False)
