# SPDX-License-Identifier: Apache-2.0

"""
The covariance of poses about a sensor, a fit linearised at its coefficients, and D-optimal poses.

About coefficients θ₀ the volts are V = h(θ₀) + X·(θ − θ₀) + error with a covariance S(σ_s, σ_p),
and θ has a normal prior. The angles of the stage have an error with one part for each setting of a
joint, σ_s, and one for each pose, σ_p. For a given stage error the best θ is generalised least
squares. The stage error maximises the restricted likelihood (Patterson and Thompson 1971): the
coefficients are integrated out, so that it is not too small by what they have fitted. The
covariance of the coefficients in turn is that over all levels of the error (Kackar and Harville
1984): a joint that is set few times leaves its level uncertain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

from adxl_ros.calibrate.pose_model import angle_jacobian, coefficient_jacobian, predicted_volts
from adxl_ros.calibrate.poses import Poses
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import get, Sensor
from adxl_ros.model.statistics import stds
import numpy as np
import scipy

_MIN_VARIANCE_RAD2 = 1e-24
"""Smallest variance of an angle as a divisor, rad²: it avoids 0/0 on a stage without errors."""
_MIN_TOTAL_RAD = 1e-7
"""Smallest standard deviation of an angle error, rad. Chosen: no encoder is as good."""
_MAX_TOTAL_RAD = 0.3  # Largest standard deviation of an angle error; chosen: no stage is as bad
_TOTAL_PRIOR_STD = 1.0
"""Prior standard deviation of ln(total/stated): a factor of 2.7. Chosen: the prior decides only
where the poses do not."""
_RATIO_PRIOR_STD = 0.35
"""Prior standard deviation of ln(ratio). Chosen: the errors of two joints agree within a factor of
two."""
_MAX_LOG_RATIO = 1.5
"""Largest |ln(ratio)|. Chosen: a joint is at most twenty times as good as the other."""
_SEARCH_STEP = 0.05
"""Step of the search that counts as 1, in ln(total), share and ln(ratio): the accuracy with which
some hundred poses determine them."""
_SEARCH_OPTIONS = {'eps': 1e-3, 'ftol': 1e-8, 'gtol': 0.5, 'maxiter': 20, 'maxls': 5}
"""Options of L-BFGS-B. Chosen: the deviance is found to 0.1, where χ² has the unit 1."""
_HUBER_CHANCE = 1e-3
"""Poses less likely than this have less weight: their squared distance grows linearly (Huber
1964)."""
_LEVELS = np.linspace(-1.5, 1.5, 13)
"""Logarithms of the levels of a joint's error over which coefficients are integrated, relative to
the estimate. Chosen: a factor of 4.5 is three standard deviations of a level that five settings
show, and steps of 0.25 change the standard deviations by less than 1 %."""
_LEAST_WEIGHT = 1e-3  # Least posterior probability of a level that counts
GRID_RAD = np.radians(15.0)
"""Step of the grid of candidates in alpha and beta, rad. Chosen: such angles can be set by hand on
a scale."""


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


@dataclass(frozen=True)
class Linearised:
    """Poses of a sensor about its coefficients: k poses, m axes, p coefficients."""

    poses: Poses  # Poses with their noise, angles and settings
    angle_jacobian: np.ndarray  # Derivatives of the volts by alpha and beta, V/rad, (k, m, 2)
    # Derivatives of the volts by coefficients, V per unit of the coefficient, (k, m, p)
    design: np.ndarray
    residual: np.ndarray  # Measured volts minus predicted volts, V, (k, m)
    values: np.ndarray  # The coefficients, (p,)
    precision: np.ndarray  # Inverse variances of their prior about 0, (p,)
    kept: np.ndarray  # Poses that count, (k,) bool

    @cached_property
    def _shared(self) -> SharedSettings:
        return shared_settings(self.poses)

    def covariance(self, error: StageError) -> PoseCovariance:
        """Return the covariance of the volts for a stage error."""
        return PoseCovariance(self.angle_jacobian, self.poses, self._shared, error, self.kept)

    def solve(self, covariance: PoseCovariance) -> tuple[np.ndarray, np.ndarray]:
        """Return the step to the best coefficients, (p,), and their information, (p, p)."""
        information, gradient = covariance.normal_equations(self.design, self.residual)
        information = information + np.diag(self.precision)
        gradient = gradient - self.precision * self.values
        scale = 1 / stds(information)
        step = scale * np.linalg.solve(information * np.outer(scale, scale), scale * gradient)
        return step, information

    def information(self, covariance: PoseCovariance) -> np.ndarray:
        """Return the information of the coefficients and of their prior, (p, p)."""
        return covariance.products(self.design) + np.diag(self.precision)

    def without(self, excluded: np.ndarray) -> Linearised:
        """Return the poses with some coefficients at 0 and not fitted, (p,) bool."""
        fitted = ~excluded
        residual = self.residual + self.design[:, :, excluded] @ self.values[excluded]
        return replace(
            self,
            design=self.design[:, :, fitted],
            residual=residual,
            values=self.values[fitted],
            precision=self.precision[fitted],
        )

    def misfit(self, error: StageError) -> float:
        """Return the minimum of rᵀS⁻¹r plus the prior's sum of squares."""
        covariance = self.covariance(error)
        step, _ = self.solve(covariance)
        return float(
            covariance.products((self.residual - self.design @ step)[:, :, None])[0, 0]
            + np.sum(self.precision * (self.values + step) ** 2)
        )

    def deviance(self, error: StageError) -> float:
        """
        Return −2 times the logarithm of the restricted likelihood, up to a constant.

        Coefficients are integrated over their prior. Half of the difference of two models is
        therefore their log Bayes factor. Outliers must not enlarge the stage error: beyond a
        bound the squared distance of a pose grows linearly with the distance.
        """
        covariance = self.covariance(error)
        step, information = self.solve(covariance)
        errors = covariance.predicted_errors(self.residual - self.design @ step)
        bound = float(scipy.special.chdtri(self.residual.shape[1], _HUBER_CHANCE))
        distance = errors.squared_distances[self.kept]
        robust = np.where(
            distance < bound, distance, 2 * np.sqrt(bound * np.maximum(distance, bound)) - bound
        )
        return float(
            np.sum(robust)
            + errors.setting_penalty
            + np.sum(self.precision * (self.values + step) ** 2)
            + covariance.log_determinant()
            + np.linalg.slogdet(information)[1]
            - np.sum(np.log(self.precision))
        )

    def stage_error(self, stated_rad: float, start: StageError | None = None) -> StageError:
        """Estimate the stage error by restricted maximum likelihood."""
        start = start or StageError(stated_rad)
        # Searched are ln(total), the poses' share of its square, and ln(ratio).
        log_total = np.log(np.clip(start.total_rad, 10 * _MIN_TOTAL_RAD, _MAX_TOTAL_RAD))
        share = (start.pose_rad / max(start.total_rad, _MIN_TOTAL_RAD)) ** 2
        of_start = np.array([log_total, share, np.log(start.ratio)])
        lowest = np.array([np.log(_MIN_TOTAL_RAD), 0.0, -_MAX_LOG_RATIO])
        highest = np.array([np.log(_MAX_TOTAL_RAD), 1.0, _MAX_LOG_RATIO])
        search = scipy.optimize.minimize(
            lambda x: self._level_deviance(_from_search(x * _SEARCH_STEP), stated_rad),
            of_start / _SEARCH_STEP,
            method='L-BFGS-B',
            options=_SEARCH_OPTIONS,
            bounds=np.column_stack([lowest, highest]) / _SEARCH_STEP,
        )
        return _from_search(search.x * _SEARCH_STEP)

    def _level_deviance(self, error: StageError, stated_rad: float) -> float:
        """Return −2 times the log posterior of a stage error, up to a constant."""
        prior = np.log(error.total_rad / stated_rad) / _TOTAL_PRIOR_STD if stated_rad > 0 else 0.0
        return float(
            self.deviance(error) + prior**2 + (np.log(error.ratio) / _RATIO_PRIOR_STD) ** 2
        )

    def covariance_over_levels(self, error: StageError, stated_rad: float) -> np.ndarray:
        """
        Return the covariance of the coefficients with the stage error integrated out, (p, p).

        A joint that is set few times hardly shows how large its errors are. The level of each
        joint therefore is integrated over its posterior; by the law of total variance this adds
        the mean change of the covariance and the covariance of the best coefficients.
        """
        best, information = self.solve(self.covariance(error))
        at_estimate = np.linalg.inv(information)
        total = at_estimate.copy()
        for sign in (1, -1):
            # The level of one joint changes, and that of the other one stays.
            levels = [
                StageError(
                    error.setting_rad * np.exp(d / 2),
                    error.pose_rad * np.exp(d / 2),
                    error.ratio * np.exp(sign * d / 2),
                )
                for d in _LEVELS
            ]
            deviance = np.array([self._level_deviance(e, stated_rad) for e in levels])
            weight = np.exp((deviance.min() - deviance) / 2)
            for level, share in zip(levels, weight / weight.sum()):
                if share > _LEAST_WEIGHT:
                    step, information = self.solve(self.covariance(level))
                    total += share * (
                        np.linalg.inv(information)
                        - at_estimate
                        + np.outer(step - best, step - best)
                    )
        return total


def _from_search(x: np.ndarray) -> StageError:
    """Return the stage error from ln(total), the poses' share of its square, and ln(ratio)."""
    log_total, pose_share, log_ratio = x
    total_rad = np.exp(log_total)
    return StageError(
        setting_rad=float(total_rad * np.sqrt(1 - pose_share)),
        pose_rad=float(total_rad * np.sqrt(pose_share)),
        ratio=float(np.exp(log_ratio)),
    )


def linearised(
    sensor: Sensor,
    poses: Poses,
    names: Sequence[Coefficient],
    precision: np.ndarray,
    kept: np.ndarray | None = None,
) -> Linearised:
    """Linearise the volts of poses about the coefficients of a sensor; see `Linearised`."""
    return Linearised(
        poses=poses,
        angle_jacobian=angle_jacobian(sensor, poses),
        design=coefficient_jacobian(sensor, poses, names),
        residual=poses.volts - predicted_volts(sensor, poses),
        values=get(sensor, names),
        precision=precision,
        kept=np.ones(len(poses), bool) if kept is None else kept,
    )


def choose_poses(rows: np.ndarray, information: np.ndarray, count: int) -> list[int]:
    """
    Choose poses one by one, each with the greatest gain in log |information|.

    rows: whitened Jacobian of each of n candidates, (n, m, p); information: that before the first
    choice, (p, p), of full rank; returns: indices of the candidates, which may repeat.
    """
    chosen = []
    identity = np.eye(rows.shape[1])
    for _ in range(count):
        covariance = np.linalg.inv(information)
        gain = np.linalg.slogdet(identity + rows @ covariance @ np.swapaxes(rows, 1, 2))[1]
        chosen.append(int(np.argmax(gain)))
        information = information + rows[chosen[-1]].T @ rows[chosen[-1]]
    return chosen


def candidate_poses(std_v: np.ndarray) -> Poses:
    """Return a grid over the sphere with a noise, (m,); each pose sets both joints anew."""
    alpha, beta = np.meshgrid(
        np.arange(round(np.pi / GRID_RAD) + 1) * GRID_RAD,
        np.arange(round(2 * np.pi / GRID_RAD)) * GRID_RAD,
    )
    settings = np.arange(alpha.size)
    return replace(
        Poses.without_volts(alpha.ravel(), beta.ravel(), std_v),
        alpha_setting=settings,
        beta_setting=settings,
    )


def whitened_jacobian(
    sensor: Sensor, poses: Poses, names: tuple[Coefficient, ...], stage: StageError
) -> np.ndarray:
    """Return the Jacobian, (k, m, p), whitened by noise and stage error, without settings."""
    design = coefficient_jacobian(sensor, poses, names)
    return volts_covariance(sensor, poses, stage).whiten_by_pose(design).reshape(design.shape)
