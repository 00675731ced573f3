# SPDX-License-Identifier: Apache-2.0

"""
Errors on poses that a fit has not seen, and their budget: the mean square, split by cause.

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

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from math import sqrt
from typing import NamedTuple

from adxl_ros.calibrate.pose_model import reference_force, stage_force
from adxl_ros.calibrate.poses import Poses
from adxl_ros.errors import UserError
from adxl_ros.model import signal_chain
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.covariance import coefficient_tangent, force_covariance
from adxl_ros.model.effects.base import Components, Environment, NOMINAL_ENVIRONMENT
from adxl_ros.model.kinematics import tilt
from adxl_ros.model.sensor import Sensor
from adxl_ros.report.quantities import mg
import numpy as np
import scipy

Fit = Callable[[Sensor, Poses], Sensor]
"""A function that fits a nominal sensor to poses and returns the fitted sensor."""

_FOLDS = 5  # Number of folds where no pose is marked as a check pose; chosen: the usual number
_MAX_ALPHA_STD_RAD = np.radians(1.0)
"""Largest standard deviation of alpha, rad, at which the tilt error of a pose counts; chosen:
without z poses near ±90° determine alpha poorly."""


@dataclass(frozen=True)
class PoseErrors:
    """Errors of a calibrated sensor, measured minus reference, pose by pose."""

    accel_mps2: np.ndarray  # Along the measured axes, (k, m)
    # Angle between measured and reference vertical, (k,); NaN where the pose determines no alpha
    tilt_rad: np.ndarray
    force_mps2: np.ndarray  # The measured specific force, (k, 3)


@dataclass(frozen=True)
class ErrorStatistic:
    """Size of one kind of error over all poses; NaN where no pose shows it."""

    rms: float
    largest: float  # Magnitude
    interval: tuple[float, float]  # 90 % interval of the rms


@dataclass(frozen=True)
class HeldOutErrors:
    """Errors of one model over held-out poses."""

    model: str
    tilt_deg: ErrorStatistic
    accel_mg: ErrorStatistic  # Over the measured axes
    errors: PoseErrors  # The errors of all held-out poses
    pose_index: np.ndarray  # Index of each held-out pose among all poses, (k,)
    fitted: tuple[Sensor, ...]  # The fitted sensor of each fold
    fold: np.ndarray  # Index in `fitted` of the sensor that measured each pose, (k,)

    @property
    def pose_count(self) -> int:
        """Return the number of held-out poses."""
        return len(self.errors.accel_mps2)


def pose_errors(sensor: Sensor, poses: Poses, stage: Sensor | None = None) -> PoseErrors:
    """
    Compare a calibrated sensor with the stage, pose by pose.

    A sensor without z cannot distinguish α from π − α: the reference gives the sign of its z.
    """
    reference = _reference(poses, sensor, stage)
    z_sign = np.where(reference[2] < 0, -1, 1)
    force = signal_chain.inverse(sensor, z_sign)(list(poses.volts.T), poses.environment)
    covariance = force_covariance(
        sensor, force, np.mean(poses.std_v, axis=0) ** 2, poses.environment
    )
    shows_tilt = tilt(force, covariance, 'z' in sensor.axes).alpha_std < _MAX_ALPHA_STD_RAD
    measured = sensor.axis_indices
    tilt_error = angle_between(np.column_stack(force), np.column_stack(reference))
    return PoseErrors(
        np.column_stack([force[d] - reference[d] for d in measured]),
        np.where(shows_tilt, tilt_error, np.nan),
        np.column_stack(force),
    )


def _reference(poses: Poses, sensor: Sensor, stage: Sensor | None) -> Components:
    """Return the specific force at the angles, on a stage with its fitted errors if there are."""
    if stage is None:
        return reference_force(poses, sensor.local_gravity_mps2)
    return stage_force(stage, poses.alpha_rad, poses.beta_rad)


def angle_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the angles between pairs of vectors, (k, 3), of any length: 0 to π, (k,)."""
    across = np.linalg.norm(np.cross(first, second), axis=1)
    return np.arctan2(across, np.sum(first * second, axis=1))


def summarise(
    model: str,
    errors: PoseErrors,
    pose_index: np.ndarray | None = None,
    fitted: Sequence[Sensor] = (),
    fold: np.ndarray | None = None,
) -> HeldOutErrors:
    """Summarise the errors of one model; the arrays as in `HeldOutErrors`, None for one fold."""
    count = len(errors.accel_mps2)
    accel_mg = mg(errors.accel_mps2[determining_alpha(errors)])
    return HeldOutErrors(
        model=model,
        tilt_deg=statistic(np.degrees(errors.tilt_rad)),
        accel_mg=statistic(accel_mg),
        errors=errors,
        pose_index=np.arange(count) if pose_index is None else pose_index,
        fitted=tuple(fitted),
        fold=np.zeros(count, int) if fold is None else fold,
    )


def determining_alpha(errors: PoseErrors) -> np.ndarray:
    """
    Mark the poses whose errors of acceleration count, (k,) bool: those that determine alpha.

    Without z, a wrong root of equation (5) shifts x and y of the others.
    """
    has_tilt = np.isfinite(errors.tilt_rad)
    return has_tilt if has_tilt.any() else np.isfinite(errors.accel_mps2).all(axis=1)


def statistic(values: np.ndarray) -> ErrorStatistic:
    """Return the size of errors, (k,) or (k, m), in the order of the visit."""
    sizes, nu = np.abs(values[np.isfinite(values)]), degrees_of_freedom(values)
    if not sizes.size:
        return ErrorStatistic(np.nan, np.nan, (np.nan, np.nan))
    rms = float(np.sqrt(np.mean(sizes**2)))
    low, high = (rms * float(np.sqrt(nu / scipy.special.chdtri(nu, p))) for p in (0.05, 0.95))
    return ErrorStatistic(rms, float(sizes.max()), (low, high))


def degrees_of_freedom(values: np.ndarray) -> float:
    """
    Return the effective degrees of freedom ν of a mean square of correlated errors.

    Errors of neighbouring poses are correlated: the poses share a plane, a temperature, a fit.
    Let s be the mean of each pose's squares, γ₀ its variance and ρ_k its correlation over k poses.
    Then var(s̄) = γ₀/n·(1 + 2·Σ(1 − k/n)·ρ_k), summed up to the first ρ_k that is not positive
    (Geyer 1992), and ν = 2·s̄²/var(s̄) (Satterthwaite 1946), at most the number of errors.

    values: errors in the order of the visit, (k,) or (k, m). Rows with NaN do not count.
    """
    table = values.reshape(len(values), -1)
    table = table[np.isfinite(table).all(axis=1)]
    squares = np.mean(table**2, axis=1)
    count, mean = len(squares), float(np.sum(squares)) / max(len(squares), 1)
    if count < 3 or mean <= 0:
        return float(max(count, 1))
    deviation = squares - mean
    variance = float(np.mean(deviation**2))
    if variance <= 0:
        return float(count)
    inflation = 1.0
    for k in range(1, count // 2):
        correlation = float(np.sum(deviation[k:] * deviation[:-k])) / count / variance
        if correlation <= 0:
            break
        inflation += 2 * (1 - k / count) * correlation
    freedom = 2 * mean**2 / (variance / (count - 1) * inflation)
    return float(np.clip(freedom, 1.0, table.size))


def cross_validate(
    fits: dict[str, Fit], sensor: Sensor, poses: Poses, stage: Sensor | None = None
) -> list[HeldOutErrors]:
    """
    Return the errors of models on poses that are held out of their fit.

    Poses marked `check` are held out of a fit to all others. Without check poses, every pose
    belongs to one of five folds, and each fold is held out of a fit to the others. A fold is
    skipped for a model whose fit fails.
    """
    number = np.arange(len(poses))
    folds = (
        [poses.check]
        if poses.check.any()
        else [number % _FOLDS == fold for fold in range(min(_FOLDS, len(poses)))]
    )
    models = []
    for model, fit in fits.items():
        parts, units, index = [], [], []
        for held_out in folds:
            try:
                units.append(fit(sensor, poses.subset(~held_out)))
            except UserError:
                continue
            parts.append(pose_errors(units[-1], poses.subset(held_out), stage))
            index.append(number[held_out])
        if parts:
            # The poses in the order of the visit.
            order = np.argsort(np.concatenate(index))
            joined = [
                np.concatenate([getattr(part, field.name) for part in parts])[order]
                for field in fields(PoseErrors)
            ]
            fold = np.repeat(np.arange(len(index)), [len(part) for part in index])
            models.append(
                summarise(
                    model, PoseErrors(*joined), np.concatenate(index)[order], units, fold[order]
                )
            )
    return models


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
_UPPER_QUANTILE = 0.95  # Probability of the upper end of a 90 % interval


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
        if not self.separable and max(self.model, self.coefficients) > max(self.noise, self.stage):
            return 'stage or model'
        # Noise and stage cause the error of the coefficients, which is no limit of its own.
        parts = ('noise', 'stage', 'model')
        return parts[int(np.argmax([getattr(self, part) for part in parts]))]


_NO_BUDGET = ErrorBudget(*(float('nan'),) * 6)  # Budget of a quantity that no pose shows


class ErrorBudgets(NamedTuple):
    """The error budgets of one model."""

    accel: ErrorBudget  # (m/s²)² per axis
    tilt: ErrorBudget  # rad²


def error_budgets(
    errors: HeldOutErrors, poses: Poses, stage: Sensor | None = None
) -> ErrorBudgets:
    """Split the held-out errors of one model by cause."""
    held, sensor, measured = poses.subset(errors.pose_index), errors.fitted[0], errors.errors
    gravity = sensor.local_gravity_mps2
    reference = np.column_stack(reference_force(held, gravity))
    corrected = np.column_stack(_reference(held, sensor, stage))
    has_tilt, used = np.isfinite(measured.tilt_rad), determining_alpha(measured)
    axes = sensor.axis_indices
    *by_cause, probe = covariances(errors, held, reference)
    accel_scatter, tilt_scatter, has_noise = _scatter(sensor, poses.subset(~poses.check))
    spread = coefficient_spread(sensor, list(reference.T), held.environment)
    accel = tilt = _NO_BUDGET
    if used.any():
        parts = [axis_variance(covariance, axes, used) for covariance in by_cause]
        accel = _budget(
            (measured.force_mps2 - corrected)[used][:, axes],
            float(np.mean(measured.accel_mps2[used] ** 2)),
            parts,
            accel_scatter - parts[0] * has_noise,
            spread,
        )
    if has_tilt.any():
        parts = [
            tilt_variance(covariance, reference, gravity, has_tilt) for covariance in by_cause
        ]
        tilt = _budget(
            angle_between(measured.force_mps2, corrected)[has_tilt],
            float(np.mean(measured.tilt_rad[has_tilt] ** 2)),
            parts,
            tilt_scatter - parts[0] * has_noise,
            spread,
        )
        tilt = replace(
            tilt, tilt_per_axis=tilt_variance(probe, reference, gravity, has_tilt) / _PROBE_MPS2**2
        )
    return ErrorBudgets(accel, tilt)


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
    return float(scipy.special.chdtri(nu, 1 - _UPPER_QUANTILE)) / nu


def _budget(
    errors: np.ndarray,
    measured: float,
    predicted: Sequence[float],
    unexplainable: float,
    spread: float,
) -> ErrorBudget:
    """
    Split a mean square of errors against the corrected reference.

    errors: the errors, (k,) or (k, m), in the order of the visit; predicted: the parts by noise,
    coefficients and stated stage error; unexplainable: mean square that no model explains, without
    noise; NaN where it is unknown; spread: see `coefficient_spread`.
    """
    by_noise, by_coefficients, by_stated_stage = predicted
    mean_square, nu = float(np.mean(errors**2)), degrees_of_freedom(errors)
    lower = mean_square * nu / float(scipy.special.chdtri(nu, _CHANCE))
    upper = mean_square * nu / float(scipy.special.chdtri(nu, _UPPER_QUANTILE))
    largest_stage = float(np.fmax(by_stated_stage, unexplainable))
    explained = by_noise + by_coefficients + largest_stage
    model = mean_square - explained if lower > explained else 0.0
    stage = min(max(mean_square - by_noise - by_coefficients, 0.0), largest_stage)
    return ErrorBudget(
        measured=measured,
        noise=by_noise,
        stage=max(measured - mean_square, 0.0) + stage,
        coefficients=by_coefficients,
        model=model,
        calibration_high=spread * by_coefficients + max(upper - explained, 0.0),
        separable=bool(np.isfinite(unexplainable)),
    )


class Covariances(NamedTuple):
    """Covariances of the specific force in k held-out poses, (m/s²)², (3, 3, k) each."""

    by_noise: np.ndarray  # By the noise of the mean
    by_coefficients: np.ndarray
    by_stage: np.ndarray  # By the stated stage error
    by_probe: np.ndarray  # By an independent error `_PROBE_MPS2` on each measured axis


def covariances(errors: HeldOutErrors, held: Poses, reference: np.ndarray) -> Covariances:
    """Return the covariances of the specific force in the held-out poses, by their causes."""
    shape = (3, 3, len(held))
    by_noise, by_coefficients, by_probe = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    for number, sensor in enumerate(errors.fitted):
        fold = errors.fold == number
        force, environment = list(reference[fold].T), held.subset(fold).environment
        exact, none_v2 = sensor.without_covariance(), np.zeros(len(sensor.axes))
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
    a, b, zero = held.alpha_rad, held.beta_rad, np.zeros(len(held))
    by_alpha = np.array([np.cos(a) * np.cos(b), -np.cos(a) * np.sin(b), -np.sin(a)])
    by_beta = np.array([-np.sin(a) * np.sin(b), -np.sin(a) * np.cos(b), zero])
    return variance * (
        np.einsum('ik,jk->ijk', by_alpha, by_alpha) + np.einsum('ik,jk->ijk', by_beta, by_beta)
    )


def axis_variance(covariance: np.ndarray, axes: list[int], used: np.ndarray) -> float:
    """Return the mean variance of the measured axes over the poses used, (m/s²)²."""
    return float(np.mean([covariance[d, d][used] for d in axes]))


def tilt_variance(
    covariance: np.ndarray, force: np.ndarray, gravity: float, used: np.ndarray
) -> float:
    """Return the mean square of tilt over the poses used, rad², by the part across the force."""
    up = force / np.linalg.norm(force, axis=1, keepdims=True)
    trace = np.einsum('iik->k', covariance)
    radial = np.einsum('ki,ijk,kj->k', up, covariance, up)
    return float(np.mean((trace - radial)[used])) / gravity**2


def _scatter(sensor: Sensor, poses: Poses) -> tuple[float, float, bool]:
    """
    Return the mean squares of acceleration and tilt that no model can explain.

    returns: both, in the units of `ErrorBudgets`, NaN where the poses do not show them; and
    whether they include the noise of the means.
    """
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
        return float(np.mean(accel**2) / 2), float(tilt), True
    if sensor.axes != AXES:
        return np.nan, np.nan, False
    # No stage error changes |f|. A model error is as large in |f| as in any other direction.
    magnitude = np.linalg.norm(errors.force_mps2, axis=1) - gravity
    excess = max(float(np.mean(errors.accel_mps2**2) - np.mean(magnitude**2)), 0.0)
    return excess, 3 * excess / gravity**2, False


def rms_mg(mean_square: float) -> float:
    """Return the rms in mg of a mean square in (m/s²)²; 0 for a negative one."""
    return float(mg(sqrt(max(mean_square, 0.0))))
