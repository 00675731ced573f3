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
The error of the stage's angles: one for each setting of a joint, and one for each pose.

A joint that has not moved keeps its error; after a move it has a new one. The true angles of pose
k are those of the encoder plus u[i(k)] + ε_k a joint, where i(k) numbers the settings of the
joint, u ~ N(0, σ_s²) and ε ~ N(0, σ_p²). Both joints have these levels, alpha's times r and
beta's over r. With J = ∂V/∂(α, β)·diag(r, 1/r) the volts of all poses have the
covariance

    S = diag(std²) + σ_p²·JJᵀ (block by block) + σ_s²·ZZᵀ,

where Z has a column for each setting. S is never formed for a fit: its blocks are inverted pose
by pose, and the columns of settings that several poses share come in by the formula of Woodbury
(Henderson's mixed-model equations; Searle, Casella and McCulloch 1992, chapter 7).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

from adxl_ros.calibrate.poses import Poses
import numpy as np
from scipy.linalg import solve_triangular

_NO_VARIANCE = 1e-24
"""Least variance of an angle to divide by, rad²."""


@dataclass(frozen=True)
class StageError:
    """
    Standard deviations of a joint's error, rad.

    Attributes
    ----------
    setting_rad
        Of the part that is common to the poses of one setting of the joint, σ_s.
    pose_rad
        Of the part that is new with each pose, σ_p.
    ratio
        Of alpha's levels to their geometric mean with beta's, r.

    """

    setting_rad: float
    pose_rad: float = 0.0
    ratio: float = 1.0

    @property
    def joints(self) -> np.ndarray:
        """Return the levels of alpha and beta over their geometric mean, (2,)."""
        return np.array([self.ratio, 1 / self.ratio])

    @property
    def total_rad(self) -> float:
        """Return the standard deviation of a joint's error in one pose, rad."""
        return float(np.hypot(self.setting_rad, self.pose_rad))


class SharedSettings(NamedTuple):
    """
    Settings that several poses share.

    Attributes
    ----------
    number
        Column of the setting of each joint, (k, 2); −1 where no other pose shares it.
    columns
        How many there are.

    """

    number: np.ndarray
    columns: int


class PoseCovariance:
    """
    The covariance S of the volts of all poses about the model, as an operator.

    Parameters
    ----------
    slope
        Volts by alpha and beta, V/rad, (k, m, 2).
    poses
        Their `std_v`.
    shared
        From `shared_settings` of the poses.
    error
        Standard deviations of the stage.
    kept
        Poses that count, (k,) bool; the others have no weight.

    """

    def __init__(self, slope: np.ndarray, poses: Poses, shared: SharedSettings,
                 error: StageError, kept: np.ndarray | None = None) -> None:
        # Errors of either joint in units of the common levels.
        self._slope, self._error = slope * error.joints, error
        slope = self._slope
        self._kept = np.ones(len(poses), bool) if kept is None else kept
        self._number, self._shared = shared
        # A setting of one pose is as good as an error of the pose.
        self._own_rad2 = error.pose_rad ** 2 + np.where(
            self._number < 0, error.setting_rad ** 2, 0.0)
        noise = poses.std_v[:, :, None] ** 2 * np.eye(slope.shape[1])
        self.blocks = noise + (slope * self._own_rad2[:, None, :]) @ np.swapaxes(slope, 1, 2)
        self._root = np.linalg.cholesky(self.blocks)
        self._white = np.linalg.inv(self._root)

    @cached_property
    def _settings(self) -> np.ndarray:
        """Return σ_s·Z of the shared settings, V, (k, m, q)."""
        columns = np.zeros((*self._slope.shape[:2], self._shared))
        for joint in range(2):
            rows = np.flatnonzero(self._number[:, joint] >= 0)
            columns[rows, :, self._number[rows, joint]] += self._slope[rows, :, joint]
        return self._error.setting_rad * columns

    @cached_property
    def _columns(self) -> np.ndarray:
        """Return σ_s·Z whitened block by block, (k·m, q)."""
        return self.by_blocks(self._settings)

    @cached_property
    def _joint_root(self) -> np.ndarray:
        """Return the Cholesky factor of 1 + σ_s²·Zᵀ B⁻¹ Z, (q, q)."""
        return np.linalg.cholesky(np.eye(self._shared) + self._columns.T @ self._columns)

    def _by_joint(self, products: np.ndarray) -> np.ndarray:
        return solve_triangular(self._joint_root, products, lower=True)

    def by_blocks(self, columns: np.ndarray) -> np.ndarray:
        """Whiten columns by the blocks alone, (k, m, c) to (k·m, c); 0 where a pose is out."""
        white = self._white @ columns
        white[~self._kept] = 0.0
        return white.reshape(np.prod(white.shape[:2]), white.shape[2])

    def products(self, columns: np.ndarray) -> np.ndarray:
        """Return CᵀS⁻¹C of columns C, (k, m, c) to (c, c)."""
        white = self.by_blocks(columns)
        joint = self._by_joint(self._columns.T @ white)
        return white.T @ white - joint.T @ joint

    def log_determinant(self) -> float:
        """Return log |S| of the poses that count."""
        blocks = np.diagonal(self._root, axis1=1, axis2=2)[self._kept]
        return 2 * float(np.log(blocks).sum() + np.log(np.diag(self._joint_root)).sum())

    def penalty(self, errors: AngleErrors) -> float:
        """Return the sum of squared errors of the angles over their variances."""
        of_pose, of_setting = (part / self._error.joints for part in (
            errors.of_pose_rad, errors.of_setting_rad))
        total = np.sum((of_pose ** 2 / np.maximum(self._own_rad2, _NO_VARIANCE))[self._kept])
        for joint in range(2):
            _, first = np.unique(self._number[:, joint], return_index=True)
            shared = first[self._number[first, joint] >= 0]
            total += np.sum(of_setting[shared, joint] ** 2) / max(
                self._error.setting_rad ** 2, _NO_VARIANCE)
        return float(total)

    def predicted(self, residual: np.ndarray) -> AngleErrors:
        """
        Predict the errors of the angles from what the model leaves of the volts.

        The best linear unbiased prediction.

        Parameters
        ----------
        residual
            Volts minus those of the model at the encoder's angles, V, (k, m).

        """
        joint = self._by_joint(self._columns.T @ self.by_blocks(residual[:, :, None]))
        factor = solve_triangular(self._joint_root, joint, lower=True, trans=1)[:, 0]
        setting = np.append(self._error.setting_rad * factor, 0.0)[self._number]
        left = (self._white @ (residual - self._settings @ factor)[:, :, None])[:, :, 0]
        # ε = σ²·Jᵀ·B⁻¹·(what the settings leave).
        weighted = np.swapaxes(self._white, 1, 2) @ left[:, :, None]
        own = self._own_rad2 * (np.swapaxes(self._slope, 1, 2) @ weighted)[:, :, 0]
        joints = self._error.joints
        return AngleErrors(np.where(self._number >= 0, setting, 0.0) * joints, own * joints,
                           np.sum(left ** 2, axis=1), float(factor @ factor))


@dataclass(frozen=True)
class AngleErrors:
    """
    Predicted errors of alpha and beta.

    Attributes
    ----------
    of_setting_rad, of_pose_rad
        Their parts by setting and by pose, rad, (k, 2).
    distances
        Squared Mahalanobis distance of each pose from the model, given its settings, (k,).
    setting_penalty
        Sum of the squares of the settings' errors over σ_s².

    """

    of_setting_rad: np.ndarray
    of_pose_rad: np.ndarray
    distances: np.ndarray
    setting_penalty: float

    @property
    def total_rad(self) -> np.ndarray:
        """Return both parts together, rad, (k, 2)."""
        return self.of_setting_rad + self.of_pose_rad

    def towards(self, other: AngleErrors, share: float) -> AngleErrors:
        """Return errors a share, 0 to 1, of the way to others, with the distances of these."""
        return replace(
            other,
            of_setting_rad=self.of_setting_rad + share * (
                other.of_setting_rad - self.of_setting_rad),
            of_pose_rad=self.of_pose_rad + share * (other.of_pose_rad - self.of_pose_rad))


def shared_settings(poses: Poses) -> SharedSettings:
    """Give a column to each setting that several poses share."""
    numbers, count = np.full((len(poses), 2), -1), 0
    for joint, setting in enumerate((poses.alpha_setting, poses.beta_setting)):
        _, index, size = np.unique(setting, return_inverse=True, return_counts=True)
        column = np.cumsum(size > 1) - 1 + count
        numbers[:, joint] = np.where(size[index] > 1, column[index], -1)
        count += int((size > 1).sum())
    return SharedSettings(numbers, count)
