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

"""What the poses so far tell of a unit: each coefficient's interval, and the tilt to expect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from adxl_ros.calibrate import pose_response
from adxl_ros.calibrate.fits import full_model
from adxl_ros.calibrate.fits.linearised import linearised
from adxl_ros.calibrate.guided.pose_plan import spread, Target
from adxl_ros.calibrate.poses import Poses
from adxl_ros.calibrate.stage_error import StageError
from adxl_ros.model import noise
from adxl_ros.model.coefficients import get, parameter_of, put, with_neutral
from adxl_ros.model.constants import Z_90
from adxl_ros.model.covariance import force_covariance
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import Sensor
from adxl_ros.model.tilt import tilt
import numpy as np

_ROUNDS = 2
_JUDGED = 48
_SHOWN_RAD = np.radians(1.0)
"""Poses that not even a perfect calibration shows better than this are not judged by."""
_LEAST_STD_V = 1e-7
_LOOKED_RAD, _LONGEST_RAD, _TURNS, _EXPLAINED = np.radians(60.0), 0.3, 25, 3.0


@dataclass(frozen=True)
class Known:
    """
    The unit as the poses so far and the datasheet tell it.

    Attributes
    ----------
    unit
        With the most likely coefficients, those of the stage's base among them.
    names, covariance
        Of those coefficients; the inverse of their Fisher information and the datasheet's.
    prior
        Standard deviation of each by the datasheet alone, (p,).
    stage
        Levels of the stage's error, by the stated one and by the poses.
    pose_std_v
        Noise of the mean of one pose, (m,).
    poses
        How many there are.

    """

    unit: Sensor
    names: tuple[Coefficient, ...]
    covariance: np.ndarray
    prior: np.ndarray
    stage: StageError
    pose_std_v: np.ndarray
    poses: int

    @property
    def std(self) -> np.ndarray:
        """Return the standard deviation of each coefficient, (p,)."""
        return np.sqrt(np.diag(self.covariance))

    def reading(self, alpha_rad: float, beta_rad: float) -> tuple[np.ndarray, np.ndarray]:
        """Predict the volts of a pose and their standard deviations, (m,) each."""
        pose = Poses.without_volts(np.array([alpha_rad]), np.array([beta_rad]), self.pose_std_v)
        slope = pose_response.coefficient_jacobian(self.unit, pose, self.names)[0]
        covariance = slope @ self.covariance @ slope.T + pose_response.volts_covariance(
            self.unit, pose, self.stage).blocks[0]
        return pose_response.predicted_volts(self.unit, pose)[0], np.sqrt(np.diag(covariance))

    def seen_at(self, alpha_rad: float, beta_rad: float, volts: np.ndarray, slack_v: np.ndarray
                ) -> tuple[float, float] | None:
        """
        Find the angles near a pose at which volts, (m,), would be read, rad.

        Where a pose does not show an angle, it stays. None if no angles explain the volts to
        within about `slack_v`, (m,).
        """
        step, by = np.zeros(2), 1 / _LOOKED_RAD ** 2
        for _ in range(_TURNS):
            pose = Poses.without_volts(np.array([alpha_rad + step[0]]),
                                       np.array([beta_rad + step[1]]), self.pose_std_v)
            off = (volts - pose_response.predicted_volts(self.unit, pose)[0]) / slack_v
            slope = pose_response.angle_jacobian(self.unit, pose)[0] / slack_v[:, None]
            more = np.linalg.solve(slope.T @ slope + by * np.eye(2), slope.T @ off - by * step)
            step = step + np.clip(more, -_LONGEST_RAD, _LONGEST_RAD)
        if np.abs(off).max() > _EXPLAINED:
            return None
        return alpha_rad + float(step[0]), beta_rad + float(step[1])

    def after(self, targets: Sequence[Target]) -> Known:
        """Return what will be known once those poses are taken, too."""
        if not targets:
            return self
        poses = Poses.without_volts(np.array([t.alpha_rad for t in targets]),
                                    np.array([t.beta_rad for t in targets]), self.pose_std_v)
        nothing = np.zeros(len(self.names))
        about = linearised(self.unit, poses, self.names, nothing)
        told = about.solve(about.covariance(self.stage))[1]
        return replace(self, covariance=np.linalg.inv(np.linalg.inv(self.covariance) + told))

    def sensor(self) -> Sensor:
        """Return the unit with the covariance of its own coefficients."""
        own = [i for i, name in enumerate(self.names) if not full_model.belongs_to_stage(name)]
        return replace(self.unit, covariance=self.covariance[np.ix_(own, own)],
                       covariance_names=tuple(self.names[i] for i in own))

    def tilt_error_rad(self) -> float:
        """Return the rms error of alpha and beta to expect; see `tilt_error_rad`."""
        return tilt_error_rad(self.sensor(), self.pose_std_v)


def from_poses(sensor: Sensor, poses: Poses, dwell_s: float, stage_rad: float,
               before: Known | None = None) -> Known:
    """
    Learn from the poses so far: one linearised fit of the full model, with the datasheet's priors.

    Parameters
    ----------
    sensor
        Nominal figures.
    poses
        As many as there are, also none.
    dwell_s
        Time that a pose is averaged, s.
    stage_rad
        Stated standard deviation of a joint's error, rad.
    before
        What was known before the last of them: the fit begins there.

    """
    terms = full_model.default_terms(sensor.axes)
    names = full_model.fitted_coefficients(sensor.axes, terms)
    unit = before.unit if before else with_neutral(sensor, (*terms, 'base_tilt'))
    prior = np.array([full_model.LEVEL_STD_RAD if full_model.belongs_to_stage(name)
                      else parameter_of(name).scale for name in names])
    information, stage = np.diag(1 / prior ** 2), before.stage if before else StageError(stage_rad)
    poses = replace(poses, std_v=np.maximum(poses.std_v, _LEAST_STD_V))
    for _ in range(_ROUNDS if len(poses) else 0):
        about = linearised(unit, poses, names, 1 / prior ** 2)
        stage = about.stage_error(stage_rad, stage)
        step, information = about.solve(about.covariance(stage))
        unit = put(unit, names, get(unit, names) + step)
    count = noise.effective_samples(round(dwell_s * sensor.rate_hz), 1 / sensor.rate_hz,
                                    sensor.rc_s)
    return Known(unit, names, np.linalg.inv(information), prior, stage,
                 np.maximum(noise.sample_std_v(sensor) / np.sqrt(count), _LEAST_STD_V), len(poses))


def tilt_error_rad(sensor: Sensor, pose_std_v: np.ndarray) -> float:
    """
    Return the rms error to expect of alpha and beta over the sphere, rad.

    NaN where no pose shows them, as for a sensor of one axis.

    Parameters
    ----------
    sensor
        With the covariance of its coefficients.
    pose_std_v
        Noise of the readings, V, (m,).

    """
    alpha, beta = np.array([(t.alpha_rad, t.beta_rad) for t in spread(_JUDGED)]).T
    force = specific_force(alpha, beta, sensor.local_gravity_mps2)

    def stds(of: Sensor) -> np.ndarray:
        found = tilt(force, force_covariance(of, force, pose_std_v ** 2), 'z' in of.axes)
        return np.column_stack([found.alpha_std, found.beta_std])

    perfect = stds(sensor.without_covariance())
    errors = np.minimum(stds(sensor)[perfect < _SHOWN_RAD], np.pi / 2)
    return float(np.sqrt(np.mean(errors ** 2))) if errors.size else float('nan')


def in_g(sensor: Sensor, volts: np.ndarray) -> np.ndarray:
    """Return what volts read in g by the figures of a unit, (m,)."""
    return (volts - sensor.zero_g_v) / sensor.scale_v_per_g


def by_term(names: Sequence[Coefficient], values: np.ndarray, std: np.ndarray, prior: np.ndarray
            ) -> list[tuple[str, list[str], float]]:
    """
    Sum coefficients up for a display, term by term.

    Returns
    -------
    list
        Name of the parameter and its unit; its value and half of its 90 % interval, axis by axis;
        how much of what the datasheet leaves open is determined, 0 to 1, of the worst axis.

    """
    rows: dict[Coefficient, list[int]] = {}
    for i, name in enumerate(names):
        rows.setdefault(name.without_axis, []).append(i)
    table = []
    for term, at in rows.items():
        if full_model.belongs_to_stage(names[at[0]]):
            continue
        unit = parameter_of(names[at[0]]).unit
        shown = [f'{names[i].axis or names[i].parameter} {values[i]:+.2g} ± '
                 f'{Z_90 * std[i]:.1g}' for i in at]
        worst = float(np.min(1 - np.clip(std[at] / prior[at], 0, 1)))
        table.append((f'{term}, {unit}' if unit else str(term), shown, worst))
    return table
