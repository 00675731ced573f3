# SPDX-License-Identifier: Apache-2.0

"""Errors on poses that a fit has not seen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from adxl_ros.calibrate.pose_model import reference_force, stage_force
from adxl_ros.calibrate.poses import Poses
from adxl_ros.errors import UserError
from adxl_ros.model import signal_chain
from adxl_ros.model.covariance import force_covariance
from adxl_ros.model.effects.base import Components
from adxl_ros.model.error_sizes import rms
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

    @classmethod
    def joined(cls, parts: Sequence[PoseErrors], order: np.ndarray) -> PoseErrors:
        """Return the errors of all parts in an order of their poses, (k,)."""
        return cls(
            accel_mps2=np.concatenate([part.accel_mps2 for part in parts])[order],
            tilt_rad=np.concatenate([part.tilt_rad for part in parts])[order],
            force_mps2=np.concatenate([part.force_mps2 for part in parts])[order],
        )


@dataclass(frozen=True)
class ErrorStatistic:
    """Size of one kind of error over all poses, in the unit of its field, as `tilt_deg`."""

    rms: float  # Root mean square; NaN where no pose shows the error
    largest: float  # Largest magnitude
    interval: tuple[float, float]  # Low and high end of the 90 % interval of the rms


@dataclass(frozen=True)
class HeldOutErrors:
    """Errors of one model over held-out poses."""

    model: str  # Name of the model
    tilt_deg: ErrorStatistic  # Tilt, degrees
    accel_mg: ErrorStatistic  # Acceleration over the measured axes, mg
    pose_errors: PoseErrors  # The errors of all held-out poses
    pose_index: np.ndarray  # Index of each held-out pose among all poses, (k,)
    fitted: tuple[Sensor, ...]  # The fitted sensor of each fold
    fold: np.ndarray  # Index in `fitted` of the sensor that measured each pose, (k,)

    @property
    def pose_count(self) -> int:
        """Return the number of held-out poses."""
        return len(self.pose_errors.accel_mps2)


def pose_errors(sensor: Sensor, poses: Poses, stage: Sensor | None = None) -> PoseErrors:
    """
    Compare a calibrated sensor with the stage, pose by pose.

    A sensor without z cannot distinguish α from π − α: the reference gives the sign of its z.
    """
    reference = corrected_reference(poses, sensor, stage)
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


def corrected_reference(poses: Poses, sensor: Sensor, stage: Sensor | None) -> Components:
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
        pose_errors=errors,
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
    sizes = np.abs(values[np.isfinite(values)])
    nu = degrees_of_freedom(values)
    if not sizes.size:
        return ErrorStatistic(np.nan, np.nan, (np.nan, np.nan))
    size = rms(sizes)

    def bound(probability: float) -> float:
        return size * float(np.sqrt(nu / scipy.special.chdtri(nu, probability)))

    return ErrorStatistic(size, float(sizes.max()), (bound(0.05), bound(0.95)))


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
    count = len(squares)
    mean = float(np.sum(squares)) / max(count, 1)
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


class _Fold(NamedTuple):
    """Poses that were held out together, and the fit to the others."""

    pose_index: np.ndarray  # Index of each among all poses, (k,)
    sensor: Sensor  # The fitted sensor
    errors: PoseErrors


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
        fitted = []
        for held_out in folds:
            try:
                unit = fit(sensor, poses.subset(~held_out))
            except UserError:
                continue
            errors = pose_errors(unit, poses.subset(held_out), stage)
            fitted.append(_Fold(number[held_out], unit, errors))
        if fitted:
            models.append(_joined(model, fitted))
    return models


def _joined(model: str, folds: Sequence[_Fold]) -> HeldOutErrors:
    """Summarise the errors of all folds, in the order of the visit."""
    pose_index = np.concatenate([fold.pose_index for fold in folds])
    order = np.argsort(pose_index)
    fold_index = np.repeat(np.arange(len(folds)), [len(fold.pose_index) for fold in folds])
    return summarise(
        model,
        PoseErrors.joined([fold.errors for fold in folds], order),
        pose_index[order],
        [fold.sensor for fold in folds],
        fold_index[order],
    )
