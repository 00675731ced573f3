# SPDX-License-Identifier: Apache-2.0

"""Cross-validation of calibration models: errors on poses that a fit has not seen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

from adxl_ros.calibrate.pose_response import stage_force
from adxl_ros.calibrate.poses import Poses, reference_force
from adxl_ros.errors import UserError
from adxl_ros.model import signal_chain
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.covariance import force_covariance
from adxl_ros.model.kinematics import tilt
from adxl_ros.model.sensor import Sensor
import numpy as np
import scipy

Fit = Callable[[Sensor, Poses], Sensor]
"""A function that fits a nominal sensor to poses and returns the fitted unit."""

_FOLDS = 5
"""Number of folds where no pose is marked as a check pose; chosen: the usual number."""
_MAX_ANGLE_STD_RAD = np.radians(1.0)
"""Largest standard deviation of an angle, rad, at which its error counts.

Chosen: it leaves out poses near ±90°, which determine alpha poorly without z.
"""


@dataclass(frozen=True)
class PoseErrors:
    """Errors of a calibrated sensor, measured minus reference, pose by pose."""

    # alpha_rad, beta_rad: Errors of the angles, rad, (k,). NaN where the pose does not determine
    # the angle.
    alpha_rad: np.ndarray
    beta_rad: np.ndarray
    accel_mps2: np.ndarray  # Errors along the measured axes, m/s², (k, m)
    # Angle between the measured and the reference vertical, rad, (k,). NaN where the pose does not
    # determine alpha.
    tilt_rad: np.ndarray
    force_mps2: np.ndarray  # The measured specific force, m/s², (k, 3)


@dataclass(frozen=True)
class ErrorStatistic:
    """Size of one kind of error over all poses; NaN where no pose shows it."""

    rms: float  # Root mean square
    largest: float  # Largest magnitude
    interval: tuple[float, float]  # 90 % interval of the rms


@dataclass(frozen=True)
class HeldOutErrors:
    """Errors of one model over held-out poses."""

    model: str  # Name of the model
    # tilt_deg, alpha_deg, beta_deg: Errors of the angles, degrees
    tilt_deg: ErrorStatistic
    alpha_deg: ErrorStatistic
    beta_deg: ErrorStatistic
    accel_mg: ErrorStatistic  # Error of acceleration over the measured axes, mg
    errors: PoseErrors  # The errors of all held-out poses
    pose_index: np.ndarray  # Index of each held-out pose among all poses, (k,)
    fitted: tuple[Sensor, ...]  # The fitted sensor of each fold
    fold: np.ndarray  # Index in `fitted` of the sensor that measured each pose, (k,)

    @property
    def pose_count(self) -> int:
        """Return the number of held-out poses."""
        return len(self.errors.accel_mps2)

    @property
    def poses_without_alpha(self) -> int:
        """Return the number of held-out poses that do not determine alpha."""
        return int(np.isnan(self.errors.alpha_rad).sum())


def pose_errors(sensor: Sensor, poses: Poses, stage: Sensor | None = None) -> PoseErrors:
    """
    Compare a calibrated sensor with the stage, pose by pose.

    As f(−α, β + π) = f(α, β), the angles of the reference are those with 0 ≤ α ≤ π. A sensor
    without z cannot distinguish α from π − α: its alpha is at most π/2, and the reference gives
    the sign of its z.
    """
    reference = reference_force(poses, sensor.local_gravity_mps2) if stage is None else \
        stage_force(stage, poses.alpha_rad, poses.beta_rad)
    z_sign = np.where(reference[2] < 0, -1, 1)
    force = signal_chain.inverse(sensor, z_sign)(list(poses.volts.T), poses.environment)
    covariance = force_covariance(sensor, force, np.mean(poses.std_v, axis=0) ** 2,
                                  poses.environment)
    measures_z = 'z' in sensor.axes
    angles = tilt(force, covariance, measures_z)
    alpha = np.arctan2(np.hypot(*reference[:2]), reference[2])
    if not measures_z:
        alpha = np.minimum(alpha, np.pi - alpha)
    beta = np.arctan2(-reference[1], reference[0])
    measured = [AXES.index(axis) for axis in sensor.axes]
    alpha_determined = angles.alpha_std < _MAX_ANGLE_STD_RAD
    beta_determined = angles.beta_std < _MAX_ANGLE_STD_RAD
    beta_error = (angles.beta - beta + np.pi) % (2 * np.pi) - np.pi
    tilt_error = angle_between(np.column_stack(force), np.column_stack(reference))
    return PoseErrors(
        np.where(alpha_determined, angles.alpha - alpha, np.nan),
        np.where(beta_determined, beta_error, np.nan),
        np.column_stack([force[d] - reference[d] for d in measured]),
        np.where(alpha_determined, tilt_error, np.nan),
        np.column_stack(force))


def angle_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """
    Return the angles between pairs of vectors.

    first, second: the vectors, of any length, (k, 3); returns: angles from 0 to π, rad, (k,).
    """
    across = np.linalg.norm(np.cross(first, second), axis=1)
    return np.arctan2(across, np.sum(first * second, axis=1))


def summarise(model: str, errors: PoseErrors, pose_index: np.ndarray | None = None,
              fitted: Sequence[Sensor] = (), fold: np.ndarray | None = None) -> HeldOutErrors:
    """
    Summarise the errors of one model over held-out poses.

    pose_index: index of each pose among all poses, (k,); None is 0 to k − 1; fold: index in
    `fitted` of the sensor of each pose, (k,); None is 0 for all.
    """
    count = len(errors.accel_mps2)
    accel_mg = errors.accel_mps2[determining_alpha(errors)] / G0_MPS2 * 1e3
    return HeldOutErrors(
        model, _statistic(np.degrees(errors.tilt_rad)), _statistic(np.degrees(errors.alpha_rad)),
        _statistic(np.degrees(errors.beta_rad)), _statistic(accel_mg),
        errors, np.arange(count) if pose_index is None else pose_index, tuple(fitted),
        np.zeros(count, int) if fold is None else fold)


def determining_alpha(errors: PoseErrors) -> np.ndarray:
    """
    Mark the poses whose errors of acceleration count, (k,) bool: those that determine alpha.

    Without z, a wrong root of equation (5) shifts x and y of the others.
    """
    has_tilt = np.isfinite(errors.tilt_rad)
    return has_tilt if has_tilt.any() else np.isfinite(errors.accel_mps2).all(axis=1)


def _statistic(values: np.ndarray) -> ErrorStatistic:
    finite = values[np.isfinite(values)]
    largest = float(np.abs(finite).max()) if finite.size else float('nan')
    return ErrorStatistic(_rms(values), largest, rms_interval(values))


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
    squares = np.mean(table ** 2, axis=1)
    count, mean = len(squares), float(np.sum(squares)) / max(len(squares), 1)
    if count < 3 or mean <= 0:
        return float(max(count, 1))
    deviation = squares - mean
    variance = float(np.mean(deviation ** 2))
    if variance <= 0:
        return float(count)
    inflation = 1.0
    for k in range(1, count // 2):
        correlation = float(np.sum(deviation[k:] * deviation[:-k])) / count / variance
        if correlation <= 0:
            break
        inflation += 2 * (1 - k / count) * correlation
    freedom = 2 * mean ** 2 / (variance / (count - 1) * inflation)
    return float(np.clip(freedom, 1.0, table.size))


def rms_interval(values: np.ndarray) -> tuple[float, float]:
    """Return the 90 % interval of the rms of correlated errors; see `degrees_of_freedom`."""
    with np.errstate(invalid='ignore'):
        rms, nu = _rms(values), degrees_of_freedom(values)
    return rms * float(np.sqrt(nu / scipy.special.chdtri(nu, 0.05))), \
        rms * float(np.sqrt(nu / scipy.special.chdtri(nu, 0.95)))


def cross_validate(fits: dict[str, Fit], sensor: Sensor, poses: Poses,
                   stage: Sensor | None = None) -> list[HeldOutErrors]:
    """
    Return the errors of models on poses that are held out of their fit.

    Poses marked `check` are held out of a fit to all others. Without check poses, every pose
    belongs to one of five folds, and each fold is held out of a fit to the others. A fold is
    skipped for a model whose fit fails.
    """
    models = []
    for model, fit in fits.items():
        errors, pose_index, units = [], [], []
        for held_out in _folds(poses):
            try:
                units.append(fit(sensor, poses.subset(~held_out)))
            except UserError:
                continue
            errors.append(pose_errors(units[-1], poses.subset(held_out), stage))
            pose_index.append(np.flatnonzero(held_out))
        if errors:
            models.append(_joined(model, errors, pose_index, units))
    return models


def _joined(model: str, parts: list[PoseErrors], pose_index: list[np.ndarray],
            units: list[Sensor]) -> HeldOutErrors:
    """Join the folds in the order of the visit."""
    index = np.concatenate(pose_index)
    order = np.argsort(index)
    fold = np.repeat(np.arange(len(pose_index)), [len(part) for part in pose_index])
    joined = [np.concatenate([getattr(part, field.name) for part in parts])[order]
              for field in fields(PoseErrors)]
    return summarise(model, PoseErrors(*joined), index[order], units, fold[order])


def _folds(poses: Poses) -> list[np.ndarray]:
    """Return a mask of the held-out poses for each fold, (k,) bool each."""
    if poses.check.any():
        return [poses.check]
    return [np.arange(len(poses)) % _FOLDS == fold for fold in range(min(_FOLDS, len(poses)))]


def table(models: Sequence[HeldOutErrors]) -> list[str]:
    """Return the errors of all models as lines for a terminal."""
    lines = [f'{"held out":9} {"poses":>5}  {"tilt rms/max deg":>16}  {"alpha rms/max deg":>17}  '
             f'{"beta rms/max deg":>16}  {"accel rms/max mg":>16}']
    for errors in models:
        lines.append(f'{errors.model:9} {errors.pose_count:5d}  {_cell(errors.tilt_deg)}  '
                     f' {_cell(errors.alpha_deg)}  {_cell(errors.beta_deg)}  '
                     f'{_cell(errors.accel_mg)}')
    if models and models[-1].poses_without_alpha:
        lines.append(f'alpha does not count in {models[-1].poses_without_alpha} poses: its '
                     'standard deviation is over 1 deg there (near +-90 deg without a z axis)')
    return lines


def _cell(statistic: ErrorStatistic) -> str:
    if np.isnan(statistic.rms):
        return f'{"-":>16}'
    return f'{statistic.rms:7.3f} /{statistic.largest:7.3f}'


def _rms(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite ** 2))) if finite.size else float('nan')
