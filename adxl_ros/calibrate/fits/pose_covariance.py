# SPDX-License-Identifier: Apache-2.0

"""
The covariance of poses about a sensor: noise, and the errors of the stage.

The angles of the stage have an error with one part for each setting of a joint, σ_s, and one for
each pose, σ_p.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

from adxl_ros.calibrate.pose_model import angle_jacobian
from adxl_ros.calibrate.poses import Poses
from adxl_ros.model.sensor import Sensor
import numpy as np
import scipy

_MIN_VARIANCE_RAD2 = 1e-24
"""Smallest variance of an angle as a divisor, rad²: it avoids 0/0 on a stage without errors."""


@dataclass(frozen=True)
class StageError:
    """Standard deviations of the error of a joint."""

    setting_rad: float  # Of the part that the poses of one setting share, σ_s
    pose_rad: float = 0.0  # Of the part that is new with each pose, σ_p
    ratio: float = 1.0  # That of alpha over the geometric mean of both joints, r

    @property
    def joints(self) -> np.ndarray:
        """Return the factors r and 1/r of alpha and beta, (2,)."""
        return np.array([self.ratio, 1 / self.ratio])

    @property
    def total_rad(self) -> float:
        """Return the standard deviation of a joint's error in one pose, rad."""
        return float(np.hypot(self.setting_rad, self.pose_rad))


class PoseCovariance:
    """
    The covariance S of the volts of k poses with m axes about the model, as an operator.

    jacobian: derivatives of the volts by alpha and beta, V/rad, (k, m, 2); shared: the settings
    of the poses; kept: poses that count, (k,) bool; the others have no weight.
    """

    def __init__(
        self,
        jacobian: np.ndarray,
        poses: Poses,
        shared: SharedSettings,
        error: StageError,
        kept: np.ndarray | None = None,
    ) -> None:
        # Scaled by r and 1/r, so that both joints have the same standard deviations.
        self._jacobian = jacobian * error.joints
        self._error = error
        self._kept = np.ones(len(poses), bool) if kept is None else kept
        self._number = shared.number
        self._shared_count = shared.total
        # The error of a setting with only one pose is an error of that pose.
        self._pose_rad2 = error.pose_rad**2 + np.where(self._number < 0, error.setting_rad**2, 0.0)
        noise = poses.std_v[:, :, None] ** 2 * np.eye(jacobian.shape[1])
        self.blocks = noise + (self._jacobian * self._pose_rad2[:, None, :]) @ np.swapaxes(
            self._jacobian, 1, 2
        )
        self._root = np.linalg.cholesky(self.blocks)
        self._whitening = np.linalg.inv(self._root)

    @cached_property
    def _settings(self) -> np.ndarray:
        """Return σ_s·Z of the shared settings, V, (k, m, q)."""
        columns = np.zeros((*self._jacobian.shape[:2], self._shared_count))
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
            np.eye(self._shared_count) + self._white_settings.T @ self._white_settings
        )

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

    def normal_equations(
        self, design: np.ndarray, residual: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return XᵀS⁻¹X, (p, p), and XᵀS⁻¹r, (p,), of a design, (k, m, p), and residuals."""
        products = self.products(np.concatenate([design, residual[:, :, None]], axis=2))
        return products[:-1, :-1], products[:-1, -1]

    def log_determinant(self) -> float:
        """Return log |S| of the poses that count."""
        blocks = np.diagonal(self._root, axis1=1, axis2=2)[self._kept]
        return 2 * float(np.log(blocks).sum() + np.log(np.diag(self._settings_root)).sum())

    def penalty(self, errors: AngleErrors) -> float:
        """Return the sum of the squared angle errors over their variances."""
        pose_rad = errors.pose_rad / self._error.joints
        setting_rad = errors.setting_rad / self._error.joints
        total = np.sum((pose_rad**2 / np.maximum(self._pose_rad2, _MIN_VARIANCE_RAD2))[self._kept])
        for joint in range(2):
            _, first = np.unique(self._number[:, joint], return_index=True)
            shared = first[self._number[first, joint] >= 0]
            total += np.sum(setting_rad[shared, joint] ** 2) / max(
                self._error.setting_rad**2, _MIN_VARIANCE_RAD2
            )
        return float(total)

    def predicted_errors(self, residual: np.ndarray) -> AngleErrors:
        """Predict the angle errors from residuals, (k, m): the best linear unbiased prediction."""
        by_setting = self._solve_settings(
            self._white_settings.T @ self.whiten_by_pose(residual[:, :, None])
        )
        factor = scipy.linalg.solve_triangular(
            self._settings_root, by_setting, lower=True, trans=1
        )[:, 0]
        setting = np.append(self._error.setting_rad * factor, 0.0)[self._number]
        white = (self._whitening @ (residual - self._settings @ factor)[:, :, None])[:, :, 0]
        weighted = np.swapaxes(self._whitening, 1, 2) @ white[:, :, None]
        pose = self._pose_rad2 * (np.swapaxes(self._jacobian, 1, 2) @ weighted)[:, :, 0]
        joints = self._error.joints
        return AngleErrors(
            setting_rad=np.where(self._number >= 0, setting, 0.0) * joints,
            pose_rad=pose * joints,
            squared_distances=np.sum(white**2, axis=1),
            setting_penalty=float(factor @ factor),
        )


@dataclass(frozen=True)
class AngleErrors:
    """Predicted errors of alpha and beta in k poses."""

    setting_rad: np.ndarray  # Part of the error by setting, (k, 2)
    pose_rad: np.ndarray  # Part of the error by pose, (k, 2)
    # Squared Mahalanobis distance of each pose from the model, given its settings, (k,)
    squared_distances: np.ndarray
    setting_penalty: float  # Sum of the squared errors of the settings over σ_s²

    @property
    def total_rad(self) -> np.ndarray:
        """Return the sum of both parts, rad, (k, 2)."""
        return self.setting_rad + self.pose_rad

    def interpolated(self, other: AngleErrors, share: float) -> AngleErrors:
        """Return errors between these and others."""
        return replace(
            other,
            setting_rad=self.setting_rad + share * (other.setting_rad - self.setting_rad),
            pose_rad=self.pose_rad + share * (other.pose_rad - self.pose_rad),
        )


class SharedSettings(NamedTuple):
    """The settings of alpha and beta that k poses share."""

    # Number of the setting of each joint, −1 where only one pose has it, (k, 2)
    number: np.ndarray
    total: int  # Their number


def shared_settings(poses: Poses) -> SharedSettings:
    """Return the numbers of the settings that poses share."""
    numbers = np.full((len(poses), 2), -1)
    count = 0
    for joint, setting in enumerate((poses.alpha_setting, poses.beta_setting)):
        _, index, size = np.unique(setting, return_inverse=True, return_counts=True)
        column = np.cumsum(size > 1) - 1 + count
        numbers[:, joint] = np.where(size[index] > 1, column[index], -1)
        count += int((size > 1).sum())
    return SharedSettings(numbers, count)


def volts_covariance(sensor: Sensor, poses: Poses, error: StageError) -> PoseCovariance:
    """Return the covariance of the volts of poses about the model."""
    return PoseCovariance(angle_jacobian(sensor, poses), poses, shared_settings(poses), error)
