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

"""How good a calibration is, on poses that it has not seen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from adxl_ros.calibrate.poses import Poses, reference_force
from adxl_ros.errors import UserError
from adxl_ros.model import chain
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.sensor import Sensor
from adxl_ros.model.tilt import tilt
from adxl_ros.model.uncertainty import force_covariance
import numpy as np

Fit = Callable[[Sensor, Poses], Sensor]
"""Fits a nominal sensor to poses."""

NINETY = 1.6449
"""Half of a 90 % interval, in standard deviations."""
_FOLDS = 5
_BLIND_RAD = np.radians(1.0)
"""Poses that show an angle worse than this are not scored for it (alpha near ±90° without z)."""


@dataclass(frozen=True)
class Score:
    """Errors of one model over held-out poses; angles in degrees, acceleration in mg."""

    model: str
    poses: int
    alpha_rms_deg: float
    alpha_max_deg: float
    beta_rms_deg: float
    beta_max_deg: float
    accel_rms_mg: float
    accel_max_mg: float
    unscored: int


@dataclass(frozen=True)
class Errors:
    """Errors pose by pose: angles in rad, NaN where the pose does not show one; m/s²."""

    alpha_rad: np.ndarray
    beta_rad: np.ndarray
    accel_mps2: np.ndarray


def errors(sensor: Sensor, poses: Poses) -> Errors:
    """
    Compare a calibrated sensor with the stage, pose by pose.

    Angles are taken to the equivalent pose nearest the reference: f(−α, β + π) = f(α, β), and a
    sensor without z cannot tell α from π − α. The sign of its z comes from the stage.
    """
    up = np.where(np.cos(poses.alpha_rad) < 0, -1, 1)
    force = chain.inverse(sensor, up)(list(poses.volts.T), poses.environment)
    covariance = force_covariance(sensor, force, np.mean(poses.std_v, axis=0) ** 2,
                                  poses.environment)
    measures_z = 'z' in sensor.axes
    angles = tilt(force, covariance, measures_z)
    turned = poses.alpha_rad - 2 * np.pi * np.round(poses.alpha_rad / (2 * np.pi))
    alpha = np.abs(turned)
    if not measures_z:
        alpha = np.minimum(alpha, np.pi - alpha)
    beta = poses.beta_rad + np.where(turned < 0, np.pi, 0.0)
    reference = reference_force(poses, sensor.local_gravity_mps2)
    measured = [AXES.index(a) for a in sensor.axes]
    return Errors(
        np.where(angles.alpha_std < _BLIND_RAD, angles.alpha - alpha, np.nan),
        np.where(angles.beta_std < _BLIND_RAD,
                 (angles.beta - beta + np.pi) % (2 * np.pi) - np.pi, np.nan),
        np.column_stack([force[d] - reference[d] for d in measured]))


def score(model: str, of: Errors) -> Score:
    """Sum up errors over poses."""
    alpha, beta = np.degrees(of.alpha_rad), np.degrees(of.beta_rad)
    accel = of.accel_mps2 / G0_MPS2 * 1e3
    return Score(model, len(accel), _rms(alpha), _largest(alpha), _rms(beta), _largest(beta),
                 _rms(accel), _largest(accel), int(np.isnan(alpha).sum()))


def held_out(fits: dict[str, Fit], sensor: Sensor,
             poses: Poses) -> list[Score]:
    """
    Score models on poses kept out of their fit.

    Poses marked `check` are scored by fits to the others. Without any, each fifth of the poses
    is scored by fits to the rest; a fold whose rest does not determine a model is left out of
    that model's score.

    Parameters
    ----------
    fits
        Fit functions by the name of their model.
    sensor
        The nominal sensor that they start from.
    poses
        All of them, check poses too.

    """
    scores = []
    for model, fit in fits.items():
        parts = []
        for out in _folds(poses):
            try:
                fitted = fit(sensor, poses.subset(~out))
            except UserError:
                continue
            parts.append(errors(fitted, poses.subset(out)))
        if parts:
            scores.append(score(model, Errors(*(
                np.concatenate([getattr(part, name) for part in parts])
                for name in Errors.__dataclass_fields__))))
    return scores


def _folds(poses: Poses) -> list[np.ndarray]:
    if poses.check.any():
        return [poses.check]
    return [np.arange(len(poses)) % _FOLDS == fold for fold in range(_FOLDS)]


def table(scores: list[Score]) -> list[str]:
    """Lay scores out for a terminal."""
    lines = [f'{"held out":10} {"poses":>5}  {"alpha rms/max deg":>18}  '
             f'{"beta rms/max deg":>18}  {"accel rms/max mg":>18}']
    for s in scores:
        lines.append(f'{s.model:10} {s.poses:5d}  {_pair(s.alpha_rms_deg, s.alpha_max_deg)}  '
                     f'{_pair(s.beta_rms_deg, s.beta_max_deg)}  '
                     f'{_pair(s.accel_rms_mg, s.accel_max_mg)}')
    if scores and scores[-1].unscored:
        lines.append(f'alpha not scored in {scores[-1].unscored} poses that show it worse than '
                     '1 deg (near +-90 deg without a z axis)')
    return lines


def _pair(rms: float, largest: float) -> str:
    return f'{rms:9.3f} /{largest:8.3f}'


def _rms(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known ** 2))) if known.size else float('nan')


def _largest(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.abs(known).max()) if known.size else float('nan')
