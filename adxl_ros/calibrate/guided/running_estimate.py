# SPDX-License-Identifier: Apache-2.0

"""
The estimate of a unit after each pose: coefficients and expected tilt error.

- The quick plan: the fewest poses that reach a stated tilt error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from math import ceil

from adxl_ros.calibrate import pose_response
from adxl_ros.calibrate.fits import full_model, linearisation
from adxl_ros.calibrate.fits.linearisation import linearised
from adxl_ros.calibrate.guided.pose_plan import nearest, spread, Target, with_checks
from adxl_ros.calibrate.guided.screen_contents import CoefficientRow
from adxl_ros.calibrate.pose_response import StageError
from adxl_ros.calibrate.poses import Poses
from adxl_ros.model import noise
from adxl_ros.model.coefficients import get, parameter_of, put, with_neutral
from adxl_ros.model.constants import Z_90
from adxl_ros.model.covariance import force_covariance
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.kinematics import specific_force, tilt
from adxl_ros.model.sensor import Sensor
import numpy as np

_ROUNDS = 2
"""Linearised fits after each pose; chosen: the estimate changes little with each pose."""
_EVALUATION_POSES = 48
"""Poses at which the tilt error is predicted; chosen: even over the sphere, and quick."""
_VISIBLE_RAD = np.radians(1.0)
"""Largest standard deviation of an angle by noise alone, rad, at which a pose counts."""
_LEAST_STD_V = 1e-7
"""Lower bound of the noise of a mean, V; chosen: below any ADC, so that no weight is infinite."""
_SEARCH_STD_RAD = np.radians(60.0)
"""Prior standard deviation of the angles in `angles_of`, rad; chosen: a wrong pose is likely."""
_LONGEST_STEP_RAD = 0.3
"""Longest step of the search of `angles_of`, rad; chosen: the response is nearly linear in it."""
_SEARCH_STEPS = 25
"""Steps of the search of `angles_of`; chosen: several turns at the longest step."""
_MOST_DECIMALS = 6
"""Most decimals of a coefficient on the screen; chosen: 1 µV."""
_EXPLAINED_STDS = 3.0
"""Largest residual of angles that explain volts, standard deviations; chosen: the usual 3."""


@dataclass(frozen=True)
class RunningEstimate:
    """The unit by the poses so far and the datasheet."""

    # The unit with the most likely coefficients, those of the stage's base among them
    unit: Sensor
    names: tuple[Coefficient, ...]  # Names of those coefficients, (p,)
    # Their covariance, the inverse of the Fisher information of poses and datasheet, (p, p)
    covariance: np.ndarray
    prior: np.ndarray  # Standard deviation of each coefficient by the datasheet alone, (p,)
    stage: StageError  # Levels of the stage's error, by the stated one and by the poses
    pose_std_v: np.ndarray  # Standard deviation of the mean of one pose, V, (m,)
    poses: int  # Number of poses

    @property
    def std(self) -> np.ndarray:
        """Return the standard deviation of each coefficient, (p,)."""
        return np.sqrt(np.diag(self.covariance))

    def predicted(self, alpha_rad: float, beta_rad: float) -> tuple[np.ndarray, np.ndarray]:
        """
        Predict the volts of a pose.

        returns: the volts and their standard deviations, V, (m,) each.
        """
        pose = Poses.without_volts(np.array([alpha_rad]), np.array([beta_rad]), self.pose_std_v)
        slope = pose_response.coefficient_jacobian(self.unit, pose, self.names)[0]
        covariance = slope @ self.covariance @ slope.T + pose_response.volts_covariance(
            self.unit, pose, self.stage).blocks[0]
        return pose_response.predicted_volts(self.unit, pose)[0], np.sqrt(np.diag(covariance))

    def angles_of(self, alpha_rad: float, beta_rad: float, volts: np.ndarray, slack_v: np.ndarray
                  ) -> tuple[float, float] | None:
        """
        Find the angles near a pose that explain volts, by damped Gauss-Newton steps.

        An angle that the volts do not show stays as it is.

        volts: the volts that are read, V, (m,); slack_v: their standard deviation about the model,
        V, (m,); returns: angles alpha and beta, rad; None if no angles explain the volts.
        """
        change_rad, damping = np.zeros(2), 1 / _SEARCH_STD_RAD ** 2
        for _ in range(_SEARCH_STEPS):
            pose = Poses.without_volts(np.array([alpha_rad + change_rad[0]]),
                                       np.array([beta_rad + change_rad[1]]), self.pose_std_v)
            residual = (volts - pose_response.predicted_volts(self.unit, pose)[0]) / slack_v
            slope = pose_response.angle_jacobian(self.unit, pose)[0] / slack_v[:, None]
            step_rad = np.linalg.solve(slope.T @ slope + damping * np.eye(2),
                                       slope.T @ residual - damping * change_rad)
            change_rad = change_rad + np.clip(step_rad, -_LONGEST_STEP_RAD, _LONGEST_STEP_RAD)
        if np.abs(residual).max() > _EXPLAINED_STDS:
            return None
        return alpha_rad + float(change_rad[0]), beta_rad + float(change_rad[1])

    def with_poses(self, targets: Sequence[Target]) -> RunningEstimate:
        """Predict the covariance of the estimate after further poses."""
        if not targets:
            return self
        alpha_rad = np.array([target.alpha_rad for target in targets])
        beta_rad = np.array([target.beta_rad for target in targets])
        poses = Poses.without_volts(alpha_rad, beta_rad, self.pose_std_v)
        no_prior = np.zeros(len(self.names))
        model = linearised(self.unit, poses, self.names, no_prior)
        information = model.information(model.covariance(self.stage))
        return replace(self, covariance=np.linalg.inv(
            np.linalg.inv(self.covariance) + information))

    def sensor(self) -> Sensor:
        """Return the unit with the covariance of its coefficients, without those of the stage."""
        of_unit = [i for i, name in enumerate(self.names)
                   if not full_model.belongs_to_stage(name)]
        return replace(self.unit, covariance=self.covariance[np.ix_(of_unit, of_unit)],
                       covariance_names=tuple(self.names[i] for i in of_unit))

    def tilt_error_rad(self) -> float:
        """Return the expected rms error of alpha and beta over the sphere, rad."""
        return tilt_error_rad(self.sensor(), self.pose_std_v)

    def rows(self) -> tuple[CoefficientRow, ...]:
        """Return the coefficients for the screen."""
        return coefficient_rows(self.names, get(self.unit, self.names), self.std, self.prior)


def from_poses(sensor: Sensor, poses: Poses, dwell_s: float, stage_rad: float,
               previous: RunningEstimate | None = None) -> RunningEstimate:
    """Estimate a unit by a linearised fit of the full model with the priors of the datasheet."""
    terms = full_model.default_terms(sensor.axes)
    names = full_model.fitted_coefficients(sensor.axes, terms)
    unit = previous.unit if previous else with_neutral(sensor, (*terms, 'base_tilt'))
    stage = previous.stage if previous else StageError(stage_rad)
    prior = np.array([full_model.LEVEL_STD_RAD if full_model.belongs_to_stage(name)
                      else parameter_of(name).scale for name in names])
    information = np.diag(1 / prior ** 2)
    poses = replace(poses, std_v=np.maximum(poses.std_v, _LEAST_STD_V))
    for _ in range(_ROUNDS if len(poses) else 0):
        model = linearised(unit, poses, names, 1 / prior ** 2)
        stage = model.stage_error(stage_rad, stage)
        step, information = model.solve(model.covariance(stage))
        unit = put(unit, names, get(unit, names) + step)
    samples = noise.effective_samples(round(dwell_s * sensor.rate_hz), 1 / sensor.rate_hz,
                                      sensor.rc_s)
    pose_std_v = np.maximum(noise.sample_std_v(sensor) / np.sqrt(samples), _LEAST_STD_V)
    return RunningEstimate(unit, names, np.linalg.inv(information), prior, stage, pose_std_v,
                           len(poses))


def no_poses(axes: int) -> Poses:
    """Return the poses of a unit before its first pose, for a number of axes."""
    return Poses.without_volts(np.zeros(0), np.zeros(0), np.zeros(axes))


def tilt_error_rad(sensor: Sensor, pose_std_v: np.ndarray) -> float:
    """
    Predict the rms error of alpha and beta over the sphere.

    pose_std_v: standard deviation of the readings, V, (m,).
    """
    alpha_rad, beta_rad = np.array([(target.alpha_rad, target.beta_rad)
                                    for target in spread(_EVALUATION_POSES)]).T
    force_mps2 = specific_force(alpha_rad, beta_rad, sensor.local_gravity_mps2)

    def tilt_stds_rad(unit: Sensor) -> np.ndarray:
        covariance = force_covariance(unit, force_mps2, pose_std_v ** 2)
        estimate = tilt(force_mps2, covariance, 'z' in unit.axes)
        return np.column_stack([estimate.alpha_std, estimate.beta_std])

    is_visible = tilt_stds_rad(sensor.without_covariance()) < _VISIBLE_RAD
    errors_rad = np.minimum(tilt_stds_rad(sensor)[is_visible], np.pi / 2)
    return float(np.sqrt(np.mean(errors_rad ** 2))) if errors_rad.size else float('nan')


def degrees_or_none(angle_rad: float) -> float | None:
    """Return an angle in degrees; None for NaN."""
    return float(np.degrees(angle_rad)) if np.isfinite(angle_rad) else None


def in_g(sensor: Sensor, volts: np.ndarray) -> np.ndarray:
    """
    Convert volts by zero-g and scale factor of a unit.

    volts: the volts, (m,); returns: specific force, g, (m,).
    """
    return (volts - sensor.zero_g_v) / sensor.scale_v_per_g


def coefficient_rows(names: Sequence[Coefficient], values: np.ndarray, std: np.ndarray,
                     prior: np.ndarray) -> tuple[CoefficientRow, ...]:
    """
    Lay out coefficients for the screen, one row for each parameter of the unit.

    names: names of the coefficients, (p,); values, std, prior: their values, their standard
    deviations, and those by the datasheet alone, (p,).
    """
    indices: dict[Coefficient, list[int]] = {}
    for i, name in enumerate(names):
        if not full_model.belongs_to_stage(name):
            indices.setdefault(name.without_axis, []).append(i)
    return tuple(_row(name, names, values, std, prior, rows) for name, rows in indices.items())


def _row(name: Coefficient, names: Sequence[Coefficient], values: np.ndarray, std: np.ndarray,
         prior: np.ndarray, rows: list[int]) -> CoefficientRow:
    unit = parameter_of(names[rows[0]]).unit
    intervals = tuple(f'{names[i].axis or names[i].parameter} '
                      f'{_interval(values[i], Z_90 * std[i])}' for i in rows)
    determined = float(np.min(1 - np.clip(std[rows] / prior[rows], 0, 1)))
    return CoefficientRow(f'{name}, {unit}' if unit else str(name), intervals, determined)


def _interval(value: float, half_width: float) -> str:
    """Return a value, with the decimals of one digit of the half width of its interval."""
    decimals = -math.floor(math.log10(half_width)) if half_width > 0 else _MOST_DECIMALS
    decimals = min(max(decimals, 0), _MOST_DECIMALS)
    # A sum with 0 has no negative zero.
    return f'{round(value, decimals) + 0.0:+.{decimals}f} ± {half_width:.{decimals}f}'


_SPARE_READINGS = 40
"""Readings beyond the number of coefficients; chosen: they show stage error and outliers."""
_MOST_POSES = 90
"""Largest number of poses; chosen: by hand a longer plan is no longer quick."""


def quick(sensor: Sensor, dwell_s: float, tilt_error_rad: float, check_poses: int
          ) -> list[Target]:
    """Choose the fewest poses that reach a tilt error, and never more than 90."""
    start = datasheet_estimate(sensor, dwell_s)
    fewest = ceil((len(start.names) + _SPARE_READINGS) / len(sensor.axes))
    grid = linearisation.candidate_poses(start.pose_std_v)
    rows = linearisation.whitened_jacobian(start.unit, grid, start.names, start.stage)
    chosen = [Target(float(grid.alpha_rad[i]), float(grid.beta_rad[i])) for i in
              linearisation.choose_poses(rows, np.diag(1 / start.prior ** 2),
                                         max(_MOST_POSES, fewest))]
    for count in range(fewest, len(chosen) + 1):
        targets = _short_path(chosen[:count])
        if start.with_poses(targets).tilt_error_rad() <= tilt_error_rad:
            break
    return with_checks(targets, check_poses)


def datasheet_estimate(sensor: Sensor, dwell_s: float) -> RunningEstimate:
    """Return the estimate of a unit before its first pose, by the datasheet alone."""
    return from_poses(
        sensor, no_poses(len(sensor.axes)), dwell_s,
        sensor.stage_std_rad)


def expected_tilt_error_rad(sensor: Sensor, dwell_s: float, targets: Sequence[Target]) -> float:
    """Predict the rms error of alpha and beta after a pose plan."""
    fitted = [target for target in targets if not target.check]
    return datasheet_estimate(sensor, dwell_s).with_poses(fitted).tilt_error_rad()


def _short_path(targets: list[Target]) -> list[Target]:
    """Order poses so that each one is the nearest to the pose before, from the lowest angles."""
    first = min(targets, key=lambda target: (target.alpha_rad, target.beta_rad))
    others = list(targets)
    others.remove(first)
    return [first, *nearest(first, others)]
