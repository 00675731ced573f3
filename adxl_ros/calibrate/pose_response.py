# SPDX-License-Identifier: Apache-2.0

"""
Predicted volts of poses on a stage, and their Jacobians.

- The error of the stage's angles: one part for each setting of a joint, one part for each pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

from adxl_ros.calibrate.poses import Poses
from adxl_ros.model import signal_chain
from adxl_ros.model.coefficients import get, parameter_of, put
from adxl_ros.model.effects.base import (
    Coefficient,
    Components,
    Joint,
    NOMINAL_ENVIRONMENT,
    Place,
    Signals,
)
from adxl_ros.model.kinematics import specific_force, UPRIGHT
from adxl_ros.model.sensor import Sensor
import numpy as np
import scipy

_MIN_VARIANCE_RAD2 = 1e-24
"""Smallest variance of an angle as a divisor, rad². Chosen: avoids 0/0 on a perfect stage."""


@dataclass(frozen=True)
class StageError:
    """Standard deviations of the error of a joint."""

    # Standard deviation of the part that the poses of one setting share, σ_s, rad
    setting_rad: float
    pose_rad: float = 0.0  # Standard deviation of the part that is new with each pose, σ_p, rad
    # Standard deviation of alpha over the geometric mean of those of alpha and beta, r
    ratio: float = 1.0

    @property
    def joints(self) -> np.ndarray:
        """Return the factors r and 1/r of alpha and beta, (2,)."""
        return np.array([self.ratio, 1 / self.ratio])

    @property
    def total_rad(self) -> float:
        """Return the standard deviation of a joint's error in one pose, rad."""
        return float(np.hypot(self.setting_rad, self.pose_rad))


class SharedSettings(NamedTuple):
    """Settings that several poses share."""

    # Column of the setting of each joint, (k, 2); −1 where no other pose shares it
    number: np.ndarray
    columns: int  # Number of shared settings, q


class NormalEquations(NamedTuple):
    """Normal equations of a generalised least-squares problem."""

    information: np.ndarray  # XᵀS⁻¹X of the design X, (p, p)
    gradient: np.ndarray  # XᵀS⁻¹r of the residuals r, (p,)


class PoseCovariance:
    """
    The covariance S of the volts of k poses with m axes about the model, as an operator.

    jacobian: derivatives of the volts by alpha and beta, V/rad, (k, m, 2); kept: poses that count,
    (k,) bool; the others have no weight.
    """

    def __init__(self, jacobian: np.ndarray, poses: Poses, shared: SharedSettings,
                 error: StageError, kept: np.ndarray | None = None) -> None:
        # Scaled by r and 1/r, so that both joints have the same standard deviations.
        self._jacobian, self._error = jacobian * error.joints, error
        self._kept = np.ones(len(poses), bool) if kept is None else kept
        self._number, self._shared = shared
        # The error of a setting with only one pose is an error of that pose.
        self._pose_rad2 = error.pose_rad ** 2 + np.where(
            self._number < 0, error.setting_rad ** 2, 0.0)
        noise = poses.std_v[:, :, None] ** 2 * np.eye(jacobian.shape[1])
        self.blocks = noise + (self._jacobian * self._pose_rad2[:, None, :]) @ np.swapaxes(
            self._jacobian, 1, 2)
        self._root = np.linalg.cholesky(self.blocks)
        self._whitening = np.linalg.inv(self._root)

    @cached_property
    def _settings(self) -> np.ndarray:
        """Return σ_s·Z of the shared settings, V, (k, m, q)."""
        columns = np.zeros((*self._jacobian.shape[:2], self._shared))
        for joint in range(2):
            rows = np.flatnonzero(self._number[:, joint] >= 0)
            columns[rows, :, self._number[rows, joint]] += self._jacobian[rows, :, joint]
        return self._error.setting_rad * columns

    @cached_property
    def _white_settings(self) -> np.ndarray:
        """Return σ_s·Z whitened block by block, (k·m, q)."""
        return self.whiten_by_pose(self._settings)

    @cached_property
    def _settings_root(self) -> np.ndarray:
        """Return the Cholesky factor of 1 + σ_s²·Zᵀ B⁻¹ Z, (q, q)."""
        return np.linalg.cholesky(
            np.eye(self._shared) + self._white_settings.T @ self._white_settings)

    def _solve_settings(self, products: np.ndarray) -> np.ndarray:
        return scipy.linalg.solve_triangular(self._settings_root, products, lower=True)

    def whiten_by_pose(self, columns: np.ndarray) -> np.ndarray:
        """Whiten columns by the blocks only, (k, m, c) to (k·m, c); 0 for poses without weight."""
        white = self._whitening @ columns
        white[~self._kept] = 0.0
        return white.reshape(np.prod(white.shape[:2]), white.shape[2])

    def products(self, columns: np.ndarray) -> np.ndarray:
        """Return CᵀS⁻¹C of columns C, (k, m, c) to (c, c)."""
        white = self.whiten_by_pose(columns)
        by_setting = self._solve_settings(self._white_settings.T @ white)
        return white.T @ white - by_setting.T @ by_setting

    def normal_equations(self, design: np.ndarray, residual: np.ndarray) -> NormalEquations:
        """
        Return the normal equations of a linear model of the volts.

        design: derivatives of the volts, (k, m, p); residual: measured volts minus predicted
        volts, V, (k, m).
        """
        products = self.products(np.concatenate([design, residual[:, :, None]], axis=2))
        return NormalEquations(products[:-1, :-1], products[:-1, -1])

    def log_determinant(self) -> float:
        """Return log |S| of the poses that count."""
        blocks = np.diagonal(self._root, axis1=1, axis2=2)[self._kept]
        return 2 * float(np.log(blocks).sum() + np.log(np.diag(self._settings_root)).sum())

    def penalty(self, errors: AngleErrors) -> float:
        """Return the sum of the squared angle errors over their variances."""
        pose_rad, setting_rad = (part / self._error.joints for part in (
            errors.pose_rad, errors.setting_rad))
        total = np.sum((pose_rad ** 2 / np.maximum(self._pose_rad2, _MIN_VARIANCE_RAD2))[
            self._kept])
        for joint in range(2):
            _, first = np.unique(self._number[:, joint], return_index=True)
            shared = first[self._number[first, joint] >= 0]
            total += np.sum(setting_rad[shared, joint] ** 2) / max(
                self._error.setting_rad ** 2, _MIN_VARIANCE_RAD2)
        return float(total)

    def predicted_errors(self, residual: np.ndarray) -> AngleErrors:
        """
        Predict the angle errors from the residuals (best linear unbiased prediction).

        residual: measured volts minus the predicted volts at the encoder's angles, V, (k, m).
        """
        by_setting = self._solve_settings(
            self._white_settings.T @ self.whiten_by_pose(residual[:, :, None]))
        factor = scipy.linalg.solve_triangular(self._settings_root, by_setting, lower=True,
                                               trans=1)[:, 0]
        setting = np.append(self._error.setting_rad * factor, 0.0)[self._number]
        white = (self._whitening @ (residual - self._settings @ factor)[:, :, None])[:, :, 0]
        weighted = np.swapaxes(self._whitening, 1, 2) @ white[:, :, None]
        pose = self._pose_rad2 * (np.swapaxes(self._jacobian, 1, 2) @ weighted)[:, :, 0]
        joints = self._error.joints
        return AngleErrors(np.where(self._number >= 0, setting, 0.0) * joints, pose * joints,
                           np.sum(white ** 2, axis=1), float(factor @ factor))


@dataclass(frozen=True)
class AngleErrors:
    """Predicted errors of alpha and beta in k poses."""

    # setting_rad, pose_rad: Parts of the error by setting and by pose, rad, (k, 2)
    setting_rad: np.ndarray
    pose_rad: np.ndarray
    # Squared Mahalanobis distance of each pose from the model, given its settings, (k,)
    squared_distances: np.ndarray
    setting_penalty: float  # Sum of the squared errors of the settings over σ_s²

    @classmethod
    def zeros(cls, count: int) -> AngleErrors:
        """Return errors of 0 in a number of poses."""
        return cls(np.zeros((count, 2)), np.zeros((count, 2)), np.zeros(count), 0.0)

    @property
    def total_rad(self) -> np.ndarray:
        """Return the sum of both parts, rad, (k, 2)."""
        return self.setting_rad + self.pose_rad

    def interpolated(self, other: AngleErrors, share: float) -> AngleErrors:
        """Return errors between these and others."""
        return replace(
            other,
            setting_rad=self.setting_rad + share * (other.setting_rad - self.setting_rad),
            pose_rad=self.pose_rad + share * (other.pose_rad - self.pose_rad))


def shared_settings(poses: Poses) -> SharedSettings:
    """Return the numbers of the settings that several poses share."""
    numbers, count = np.full((len(poses), 2), -1), 0
    for joint, setting in enumerate((poses.alpha_setting, poses.beta_setting)):
        _, index, size = np.unique(setting, return_inverse=True, return_counts=True)
        column = np.cumsum(size > 1) - 1 + count
        numbers[:, joint] = np.where(size[index] > 1, column[index], -1)
        count += int((size > 1).sum())
    return SharedSettings(numbers, count)


_ANGLE_STEP_RAD = 1e-4
"""Step of the central differences by an angle, rad. Chosen: the chain is smooth, so that the error
of the slope, of order step², is far below the noise."""
_COEFFICIENT_STEP = 1e-3
"""Step of the central differences by a coefficient, in typical sizes. Chosen: the chain is nearly
linear over a thousandth of a typical size."""


def predicted_volts(unit: Sensor, poses: Poses, shift_rad: tuple[float, float] = (0.0, 0.0)
                    ) -> np.ndarray:
    """
    Predict the mean output of a unit in poses.

    returns: volts, (k, m).
    """
    force = stage_force(unit, poses.alpha_rad + shift_rad[0], poses.beta_rad + shift_rad[1])
    return np.column_stack(signal_chain.static_response(unit)(force, poses.environment))


def stage_force(unit: Sensor, alpha_rad: np.ndarray, beta_rad: np.ndarray) -> Components:
    """
    Return the specific force at rest on a stage with the stage effects of a unit.

    alpha_rad, beta_rad: angles of the encoder, rad, (k,); returns: three components in the case
    frame, m/s², (k,).
    """
    signals = Signals(NOMINAL_ENVIRONMENT, alpha=Joint(alpha_rad), beta=Joint(beta_rad),
                      up=list(UPRIGHT), gravity_mps2=unit.local_gravity_mps2)
    signal_chain.Chain(unit)(Place.STAGE, signals)
    return specific_force(signals.alpha.position, signals.beta.position, signals.gravity_mps2,
                          0.0, signals.up)


def angle_jacobian(unit: Sensor, poses: Poses) -> np.ndarray:
    """
    Differentiate the predicted volts by alpha and beta.

    returns: jacobian, V/rad, (k, m, 2).
    """
    def slope(alpha_rad: float, beta_rad: float) -> np.ndarray:
        above = predicted_volts(unit, poses, (alpha_rad, beta_rad))
        below = predicted_volts(unit, poses, (-alpha_rad, -beta_rad))
        return (above - below) / (2 * _ANGLE_STEP_RAD)

    return np.stack([slope(_ANGLE_STEP_RAD, 0.0), slope(0.0, _ANGLE_STEP_RAD)], axis=2)


def coefficient_jacobian(unit: Sensor, poses: Poses, names: Sequence[Coefficient]) -> np.ndarray:
    """
    Differentiate the predicted volts by coefficients.

    names: coefficients, (p,); returns: jacobian, V per unit of the coefficient, (k, m, p).
    """
    def slope(name: Coefficient) -> np.ndarray:
        value, step = get(unit, [name]), _COEFFICIENT_STEP * parameter_of(name).scale
        above = predicted_volts(put(unit, [name], value + step), poses)
        below = predicted_volts(put(unit, [name], value - step), poses)
        return (above - below) / (2 * step)

    return np.stack([slope(name) for name in names], axis=2)


def volts_covariance(unit: Sensor, poses: Poses, error: StageError,
                     kept: np.ndarray | None = None) -> PoseCovariance:
    """
    Return the covariance of the volts of all poses about the model.

    kept: poses that count, (k,) bool; None for all.
    """
    return PoseCovariance(angle_jacobian(unit, poses), poses, shared_settings(poses), error, kept)
