# SPDX-License-Identifier: Apache-2.0

"""
A fit linearised at the coefficients of a sensor, and the error of the stage by its likelihood.

About coefficients θ₀ the volts are V = h(θ₀) + X·(θ − θ₀) + error with the covariance S(σ_s, σ_p)
of `pose_covariance`, and θ has a normal prior. For a given stage error the best θ is generalised
least squares. The stage error maximises the restricted likelihood (Patterson and Thompson 1971):
the coefficients are integrated out, so that it is not too small by what they have fitted. The
covariance of the coefficients in turn is that over all levels of the error (Kackar and Harville
1984): a joint that is set few times leaves its level uncertain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from adxl_ros.calibrate.fits.pose_covariance import (
    PoseCovariance,
    shared_settings,
    SharedSettings,
    StageError,
)
from adxl_ros.calibrate.pose_model import angle_jacobian, coefficient_jacobian, predicted_volts
from adxl_ros.calibrate.poses import Poses
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.error_sizes import stds
from adxl_ros.model.sensor import get, Sensor
import numpy as np
import scipy

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
