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
A fit linearised at its coefficients, and the levels of the stage's error by its likelihood.

About coefficients θ₀ the volts are V = h(θ₀) + X·(θ − θ₀) + error with the covariance S(σ_s, σ_p)
of `stage_error`, and θ has a normal prior. For given levels the best θ is generalised least
squares. The levels are those of the greatest restricted likelihood (Patterson and Thompson 1971):
the coefficients are integrated out, so that a level is not too small by what they have fitted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

from adxl_ros.calibrate import pose_response
from adxl_ros.calibrate.poses import Poses
from adxl_ros.calibrate.stage_error import (
    PoseCovariance,
    shared_settings,
    SharedSettings,
    StageError,
)
from adxl_ros.model.coefficients import get
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import Sensor
import numpy as np
from scipy.optimize import minimize
from scipy.stats import chi2

_LEVELS_RAD = (1e-7, 0.3)
"""Range of the levels: no encoder is as good, no stage as bad."""
_PRIOR_SPREAD = 1.0
"""Standard deviation of the logarithm of a level about the stated one: within a factor of 2.7.
It decides only where the poses do not."""
_RATIO_SPREAD = 0.35
"""Standard deviation of the logarithm of `StageError.ratio`: the joints of a stage are alike to
within a factor of two."""
_MOST_RATIO = 1.5
"""Largest logarithm of the ratio: a joint is at most twenty times as good as the other."""
_UNIT = 0.05
"""How well some hundred poses tell the logarithm of a level, and a share: the unit of a step."""
_OPTIONS = {'eps': 1e-3, 'ftol': 1e-8, 'gtol': 0.5, 'maxiter': 20, 'maxls': 5}
"""Of the search for the levels: to a tenth of the deviance, whose unit is that of χ²."""
_SURPRISE = 1e-3
"""Poses less likely than this count with the root of their distance (Huber 1964)."""


@dataclass(frozen=True)
class Linearised:
    """
    Poses of a unit about its coefficients: k poses, m axes, p coefficients.

    Attributes
    ----------
    poses
        With their noise, angles and settings.
    slope
        Volts by alpha and beta, V/rad, (k, m, 2).
    design
        Volts by coefficients, V a unit, (k, m, p).
    residual
        Measured volts minus those of the model, V, (k, m).
    values
        The coefficients, (p,).
    precision
        Inverse variances of their prior about 0, (p,).
    kept
        Poses that count, (k,) bool.

    """

    poses: Poses
    slope: np.ndarray
    design: np.ndarray
    residual: np.ndarray
    values: np.ndarray
    precision: np.ndarray
    kept: np.ndarray

    @cached_property
    def _shared(self) -> SharedSettings:
        return shared_settings(self.poses)

    def covariance(self, error: StageError) -> PoseCovariance:
        """Return the covariance of the volts for levels of the stage's error."""
        return PoseCovariance(self.slope, self.poses, self._shared, error, self.kept)

    def solve(self, covariance: PoseCovariance) -> tuple[np.ndarray, np.ndarray]:
        """Return the step to the best coefficients, (p,), and their information, (p, p)."""
        products = covariance.products(
            np.concatenate([self.design, self.residual[:, :, None]], axis=2))
        information = products[:-1, :-1] + np.diag(self.precision)
        gradient = products[:-1, -1] - self.precision * self.values
        scale = 1 / np.sqrt(np.diag(information))
        step = scale * np.linalg.solve(information * np.outer(scale, scale), scale * gradient)
        return step, information

    def without(self, left_out: np.ndarray) -> Linearised:
        """Leave coefficients out, (p,) bool, as if they were 0."""
        stay = ~left_out
        residual = self.residual + self.design[:, :, left_out] @ self.values[left_out]
        return replace(self, design=self.design[:, :, stay], residual=residual,
                       values=self.values[stay], precision=self.precision[stay])

    def misfit(self, error: StageError) -> float:
        """Return the least sum of squares: residuals by S, coefficients by their prior."""
        covariance = self.covariance(error)
        step, _ = self.solve(covariance)
        left = (self.residual - self.design @ step)[:, :, None]
        return float(covariance.products(left)[0, 0]
                     + np.sum(self.precision * (self.values + step) ** 2))

    def deviance(self, error: StageError) -> float:
        """
        Return −2 times the logarithm of the restricted likelihood of levels, but for a constant.

        Coefficients are integrated over their prior, so that models with other coefficients
        compare by it, too: half of the difference is the logarithm of the Bayes factor. Poses
        that are disturbed must not pass for a bad stage: beyond a bound a pose's surprise grows
        as its root.
        """
        covariance = self.covariance(error)
        step, information = self.solve(covariance)
        errors = covariance.predicted(self.residual - self.design @ step)
        bound = _bound(self.residual.shape[1])
        distance = errors.distances[self.kept]
        tamed = np.where(distance < bound, distance,
                         2 * np.sqrt(bound * np.maximum(distance, bound)) - bound)
        return float(np.sum(tamed) + errors.setting_penalty
                     + np.sum(self.precision * (self.values + step) ** 2)
                     + covariance.log_determinant()
                     + np.linalg.slogdet(information)[1] - np.sum(np.log(self.precision)))

    def stage_error(self, stated_rad: float, start: StageError | None = None) -> StageError:
        """
        Estimate the levels of the stage's error by restricted maximum likelihood.

        Parameters
        ----------
        stated_rad
            The stated standard deviation of a joint's error, rad; it counts where the poses do
            not tell. 0 where nothing is stated.
        start
            Where to begin; the stated error, by setting, unless given.

        """
        start = start or StageError(stated_rad)

        def cost(x: np.ndarray) -> float:
            prior = (x[0] - np.log(stated_rad)) / _PRIOR_SPREAD if stated_rad > 0 else 0.0
            return self.deviance(_levels(x)) + prior ** 2 + (x[2] / _RATIO_SPREAD) ** 2

        level = float(np.log(np.clip(start.total_rad, 10 * _LEVELS_RAD[0], _LEVELS_RAD[1])))
        share = (start.pose_rad / max(start.total_rad, _LEVELS_RAD[0])) ** 2
        bounds = np.array([np.log(_LEVELS_RAD), (0.0, 1.0), (-_MOST_RATIO, _MOST_RATIO)])
        found = minimize(lambda x: cost(x * _UNIT),
                         np.array([level, share, np.log(start.ratio)]) / _UNIT,
                         method='L-BFGS-B', options=_OPTIONS, bounds=bounds / _UNIT)
        return _levels(found.x * _UNIT)


def _levels(x: np.ndarray) -> StageError:
    """Return levels by the logarithms of total and ratio, and the poses' share in the square."""
    total = np.exp(x[0])
    return StageError(float(total * np.sqrt(1 - x[1])), float(total * np.sqrt(x[1])),
                      float(np.exp(x[2])))


@cache
def _bound(axes: int) -> float:
    """Return the squared distance beyond which a pose's surprise grows as its root."""
    return float(chi2.isf(_SURPRISE, axes))


def linearised(unit: Sensor, poses: Poses, names: Sequence[Coefficient], precision: np.ndarray,
               kept: np.ndarray | None = None) -> Linearised:
    """
    Linearise the volts of poses about a unit.

    Parameters
    ----------
    unit
        With the coefficients.
    poses
        At the angles about which the model is straight.
    names
        Coefficients, (p,).
    precision
        Inverse variances of their prior about 0, (p,).
    kept
        Poses that count, (k,) bool; None for all.

    """
    return Linearised(poses, pose_response.angle_jacobian(unit, poses),
                      pose_response.coefficient_jacobian(unit, poses, names),
                      poses.volts - pose_response.predicted_volts(unit, poses), get(unit, names),
                      precision, np.ones(len(poses), bool) if kept is None else kept)
