# SPDX-License-Identifier: Apache-2.0

"""The estimate of a sensor after each pose, and the quick plan: the fewest poses for an error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

from adxl_ros.calibrate.fits import full_model, optimal_poses, pose_covariance
from adxl_ros.calibrate.fits.linearisation import linearised
from adxl_ros.calibrate.fits.pose_covariance import StageError
from adxl_ros.calibrate.guided import pose_plan
from adxl_ros.calibrate.guided.pose_plan import Target
from adxl_ros.calibrate.guided.screen_contents import ScreenRow
from adxl_ros.calibrate.pose_model import coefficient_jacobian, predicted_volts
from adxl_ros.calibrate.poses import Poses
from adxl_ros.calibrate.report import error_budget
from adxl_ros.files.sweep_journal import PoseRecord
from adxl_ros.model import noise
from adxl_ros.model.constants import Z_90
from adxl_ros.model.covariance import force_covariance
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.error_sizes import stds
from adxl_ros.model.kinematics import specific_force, tilt
from adxl_ros.model.sensor import get, parameter_of, put, Sensor, with_neutral
from adxl_ros.report.quantities import signed, with_half_width
import numpy as np

_ROUNDS = 2  # Linearised fits after each pose; chosen: the estimate changes little with each pose
_EVALUATION_POSES = 48
"""Poses at which the tilt error is predicted; chosen: even over the sphere, and quick."""
_VISIBLE_RAD = np.radians(1.0)
"""Largest standard deviation of alpha by noise alone, rad, at which a pose counts."""
_LEAST_STD_V = 1e-7
"""Lower bound of the noise of a mean, V; chosen: below any ADC, so that no weight is infinite."""
_OUTLIER_STDS = 3.5  # Residual from which a pose is refused, stds; chosen: one of 2000 by chance
_MODEL_STD_G = 5e-3  # Std of further model errors; chosen: it accepts twice the datasheet limits
_SPARE_READINGS = 40
"""Readings beyond the number of coefficients; chosen: they show stage error and outliers."""
_MOST_POSES = 90  # Largest number of poses; chosen: by hand a longer plan is no longer quick


@dataclass(frozen=True)
class RunningEstimate:
    """The sensor by the poses so far and the datasheet."""

    sensor: Sensor  # With the most likely coefficients, those of the stage's base among them
    names: tuple[Coefficient, ...]  # Names of those coefficients, (p,)
    covariance: np.ndarray  # Inverse of the Fisher information of poses and datasheet, (p, p)
    prior: np.ndarray  # Standard deviation of each coefficient by the datasheet alone, (p,)
    stage: StageError
    pose_std_v: np.ndarray  # Standard deviation of the mean of one pose, (m,)

    def reading_fault(self, target: Target, volts: np.ndarray, tolerance_rad: float) -> str:
        """Refuse a pose whose mean, V, (m,), is an outlier to the prediction by earlier poses."""
        sensor = self.sensor
        pose = Poses.without_volts(
            np.array([target.alpha_rad]), np.array([target.beta_rad]), self.pose_std_v
        )
        slope = coefficient_jacobian(sensor, pose, self.names)[0]
        variance = np.diag(
            slope @ self.covariance @ slope.T
            + pose_covariance.volts_covariance(sensor, pose, self.stage).blocks[0]
        )
        expected_v = predicted_volts(sensor, pose)[0]
        slack_v = sensor.nominal_scale_v_per_g * np.hypot(_MODEL_STD_G, tolerance_rad)
        residual_stds = np.abs(volts - expected_v) / np.hypot(np.sqrt(variance), slack_v)
        if residual_stds.max() <= _OUTLIER_STDS:
            return ''
        axis = int(residual_stds.argmax())
        measured_g = (volts - sensor.zero_g_v) / sensor.scale_v_per_g
        expected_g = (expected_v - sensor.zero_g_v) / sensor.scale_v_per_g
        return (
            f'{sensor.axes[axis]} reads {signed(measured_g[axis])} g where '
            f'{signed(expected_g[axis])} g was expected: axis inverted or '
            'swapped, or another pose; check wiring, mounting and pose'
        )

    def with_poses(self, targets: Sequence[Target]) -> RunningEstimate:
        """Predict the covariance of the estimate after further poses."""
        if not targets:
            return self
        angles_rad = np.array([(target.alpha_rad, target.beta_rad) for target in targets])
        poses = Poses.without_volts(angles_rad[:, 0], angles_rad[:, 1], self.pose_std_v)
        model = linearised(self.sensor, poses, self.names, np.zeros(len(self.names)))
        return replace(
            self,
            covariance=np.linalg.inv(
                np.linalg.inv(self.covariance) + model.information(model.covariance(self.stage))
            ),
        )

    def tilt_error_rad(self) -> float:
        """Return the expected rms error of alpha and beta over the sphere, rad."""
        sensor = replace(self.sensor, covariance=self.covariance, covariance_names=self.names)
        of_unit = [not full_model.belongs_to_stage(name) for name in self.names]
        return tilt_error_rad(sensor.with_covariance_of(of_unit), self.pose_std_v)

    def rows(self) -> list[ScreenRow]:
        """Return the coefficients for the screen."""
        std = stds(self.covariance)
        return coefficient_rows(self.names, get(self.sensor, self.names), std, self.prior)


def from_records(
    sensor: Sensor,
    records: Sequence[PoseRecord],
    dwell_s: float,
    previous: RunningEstimate | None = None,
) -> RunningEstimate:
    """Estimate a sensor from the poses of a journal, check poses left out; see `from_poses`."""
    fitted = [record for record in records if not record.check]
    poses = (
        Poses.from_records(fitted)
        if fitted
        else Poses.without_volts(np.zeros(0), np.zeros(0), np.zeros(len(sensor.axes)))
    )
    return from_poses(sensor, poses, dwell_s, sensor.stage_std_rad, previous)


def from_poses(
    sensor: Sensor,
    poses: Poses,
    dwell_s: float,
    stage_rad: float,
    previous: RunningEstimate | None = None,
) -> RunningEstimate:
    """Estimate a sensor by a linearised fit of the full model with the priors of the datasheet."""
    terms = full_model.default_terms(sensor.axes)
    names = full_model.fitted_coefficients(sensor.axes, terms)
    estimated = previous.sensor if previous else with_neutral(sensor, (*terms, 'base_tilt'))
    stage = previous.stage if previous else StageError(stage_rad)
    prior = np.array(
        [
            full_model.LEVEL_STD_RAD
            if full_model.belongs_to_stage(name)
            else parameter_of(name).scale
            for name in names
        ]
    )
    information = np.diag(1 / prior**2)
    poses = replace(poses, std_v=np.maximum(poses.std_v, _LEAST_STD_V))
    for _ in range(_ROUNDS if len(poses) else 0):
        model = linearised(estimated, poses, names, 1 / prior**2)
        stage = model.stage_error(stage_rad, stage)
        step, information = model.solve(model.covariance(stage))
        estimated = put(estimated, names, get(estimated, names) + step)
    samples = noise.effective_samples(
        round(dwell_s * sensor.rate_hz), 1 / sensor.rate_hz, sensor.rc_s
    )
    pose_std_v = np.maximum(noise.sample_std_v(sensor) / np.sqrt(samples), _LEAST_STD_V)
    return RunningEstimate(
        sensor=estimated,
        names=names,
        covariance=np.linalg.inv(information),
        prior=prior,
        stage=stage,
        pose_std_v=pose_std_v,
    )


def tilt_error_rad(sensor: Sensor, pose_std_v: np.ndarray) -> float:
    """Predict the rms angle between true and measured vertical over the sphere, or NaN."""
    alpha_rad, beta_rad = np.array(
        [(target.alpha_rad, target.beta_rad) for target in pose_plan.spread(_EVALUATION_POSES)]
    ).T
    force = specific_force(alpha_rad, beta_rad, sensor.local_gravity_mps2)
    by_noise = force_covariance(sensor.without_covariance(), force, pose_std_v**2)
    by_all = force_covariance(sensor, force, pose_std_v**2)
    used = tilt(force, by_noise, 'z' in sensor.axes).alpha_std < _VISIBLE_RAD
    if not used.any():
        return float('nan')
    variance = error_budget.tilt_variance(
        by_all, np.array(force).T, sensor.local_gravity_mps2, used
    )
    return min(math.sqrt(variance), np.pi / 2)


def coefficient_rows(
    names: Sequence[Coefficient], values: np.ndarray, std: np.ndarray, prior: np.ndarray
) -> list[ScreenRow]:
    """Lay out the parameters of the sensor: how far the prior has shrunk, and 90 % intervals."""
    places: dict[Coefficient, list[int]] = {}
    for i, name in enumerate(names):
        if not full_model.belongs_to_stage(name):
            places.setdefault(name.without_axis, []).append(i)
    return [
        ScreenRow(
            str(name),
            ' '.join(
                f'{names[i].axis or names[i].parameter} '
                + with_half_width(values[i], Z_90 * std[i]).replace(' +- ', '±')
                for i in place
            ),
            float(np.min(1 - np.clip(std[place] / prior[place], 0, 1))),
        )
        for name, place in places.items()
    ]


def quick(sensor: Sensor, dwell_s: float, tilt_error_rad: float, check_poses: int) -> list[Target]:
    """Choose the fewest poses that reach a tilt error, and never more than 90."""
    start = from_records(sensor, [], dwell_s)
    fewest = math.ceil((len(start.names) + _SPARE_READINGS) / len(sensor.axes))
    grid = optimal_poses.candidate_poses(start.pose_std_v)
    rows = optimal_poses.whitened_jacobian(start.sensor, grid, start.names, start.stage)
    chosen = [
        Target(float(grid.alpha_rad[i]), float(grid.beta_rad[i]))
        for i in optimal_poses.choose_poses(
            rows, np.diag(1 / start.prior**2), max(_MOST_POSES, fewest)
        )
    ]
    for count in range(fewest, len(chosen) + 1):
        # Each pose is the nearest to the one before, from the lowest angles on.
        first = min(chosen[:count], key=lambda target: (target.alpha_rad, target.beta_rad))
        targets = [first, *pose_plan.nearest(first, [t for t in chosen[:count] if t is not first])]
        if start.with_poses(targets).tilt_error_rad() <= tilt_error_rad:
            break
    return pose_plan.with_checks(targets, check_poses)


def expected_tilt_error_rad(sensor: Sensor, dwell_s: float, targets: Sequence[Target]) -> float:
    """Predict the tilt error after a pose plan."""
    fitted = [target for target in targets if not target.check]
    return from_records(sensor, [], dwell_s).with_poses(fitted).tilt_error_rad()
