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

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from adxl_ros.calibrate.pose_response import stage_force
from adxl_ros.calibrate.poses import Poses, reference_force
from adxl_ros.errors import UserError
from adxl_ros.model import signal_chain
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.covariance import force_covariance
from adxl_ros.model.sensor import Sensor
from adxl_ros.model.tilt import tilt
import numpy as np
from scipy.stats import chi2

Fit = Callable[[Sensor, Poses], Sensor]
"""Fits a nominal sensor to poses."""

_FOLDS = 5
_BLIND_RAD = np.radians(1.0)
"""Poses that show an angle worse than this are not scored for it (alpha near ±90° without z)."""


@dataclass(frozen=True)
class Errors:
    """
    Errors pose by pose.

    Attributes
    ----------
    alpha_rad, beta_rad
        rad, (k,), NaN where the pose does not show one.
    accel_mps2
        Along the measured axes, m/s², (k, m).
    tilt_rad
        Angle between the measured and the promised vertical, rad, (k,); NaN where the pose does
        not show alpha.
    force_mps2
        The measured specific force, m/s², (k, 3).

    """

    alpha_rad: np.ndarray
    beta_rad: np.ndarray
    accel_mps2: np.ndarray
    tilt_rad: np.ndarray
    force_mps2: np.ndarray


@dataclass(frozen=True)
class Score:
    """
    Errors of one model over held-out poses; angles in degrees, acceleration in mg.

    Attributes
    ----------
    intervals
        90 % interval of each rms, by 'tilt', 'alpha', 'beta' and 'accel'.
    errors, index
        The errors behind them, and the numbers of their poses, (k,).
    fitted, fold
        The units that were scored, and the number of that of each pose, (k,).

    """

    model: str
    poses: int
    tilt_rms_deg: float
    tilt_max_deg: float
    alpha_rms_deg: float
    alpha_max_deg: float
    beta_rms_deg: float
    beta_max_deg: float
    accel_rms_mg: float
    accel_max_mg: float
    unscored: int
    intervals: dict[str, tuple[float, float]] = field(default_factory=dict)
    errors: Errors | None = None
    index: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    fitted: tuple[Sensor, ...] = ()
    fold: np.ndarray = field(default_factory=lambda: np.zeros(0, int))


def errors(sensor: Sensor, poses: Poses, stage: Sensor | None = None) -> Errors:
    """
    Compare a calibrated sensor with the stage, pose by pose.

    Angles are taken to the equivalent pose nearest the reference: f(−α, β + π) = f(α, β), and a
    sensor without z cannot tell α from π − α. The sign of its z comes from the stage.

    Parameters
    ----------
    sensor
        The unit as it is calibrated.
    poses
        Not fitted.
    stage
        The unit with what was found of the stage (its level), which no sensor is blamed for;
        None takes the stage to be as it says.

    """
    reference = reference_force(poses, sensor.local_gravity_mps2) if stage is None else \
        stage_force(stage, poses.alpha_rad, poses.beta_rad)
    up = np.where(reference[2] < 0, -1, 1)
    force = signal_chain.inverse(sensor, up)(list(poses.volts.T), poses.environment)
    covariance = force_covariance(sensor, force, np.mean(poses.std_v, axis=0) ** 2,
                                  poses.environment)
    measures_z = 'z' in sensor.axes
    angles = tilt(force, covariance, measures_z)
    alpha = np.arctan2(np.hypot(*reference[:2]), reference[2])
    if not measures_z:
        alpha = np.minimum(alpha, np.pi - alpha)
    beta = np.arctan2(-reference[1], reference[0])
    measured = [AXES.index(a) for a in sensor.axes]
    shown = angles.alpha_std < _BLIND_RAD
    return Errors(
        np.where(shown, angles.alpha - alpha, np.nan),
        np.where(angles.beta_std < _BLIND_RAD,
                 (angles.beta - beta + np.pi) % (2 * np.pi) - np.pi, np.nan),
        np.column_stack([force[d] - reference[d] for d in measured]),
        np.where(shown, between(np.column_stack(force), np.column_stack(reference)), np.nan),
        np.column_stack(force))


def between(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the angle between vectors (k, 3), rad, (k,)."""
    across = np.linalg.norm(np.cross(one, other), axis=1)
    return np.arctan2(across, np.sum(one * other, axis=1))


def score(model: str, of: Errors, index: np.ndarray | None = None,
          fitted: Sequence[Sensor] = (), fold: np.ndarray | None = None) -> Score:
    """Sum up errors over poses, in the order of their visit; see `Score`."""
    values = {'tilt': np.degrees(of.tilt_rad), 'alpha': np.degrees(of.alpha_rad),
              'beta': np.degrees(of.beta_rad), 'accel': of.accel_mps2 / G0_MPS2 * 1e3}
    count = len(of.accel_mps2)
    tilt, alpha, beta, accel = ((_rms(one), _largest(one)) for one in values.values())
    return Score(model, count, *tilt, *alpha, *beta, *accel, int(np.isnan(values['alpha']).sum()),
                 {name: rms_interval(one) for name, one in values.items()}, of,
                 np.arange(count) if index is None else index, tuple(fitted),
                 np.zeros(count, int) if fold is None else fold)


def freedom(values: np.ndarray) -> float:
    """
    Return how many independent squares the mean square of errors is as good as, ν.

    Errors of neighbouring poses go together: they share a plane, a temperature, a fit. With the
    mean of each pose's squares, s, of variance γ₀ and correlation ρ_k over k poses of the visit,
    var(s̄) = γ₀/n·(1 + 2·Σ(1 − k/n)·ρ_k), summed up to the first ρ_k that is not positive (Geyer
    1992), and ν = 2·s̄²/var(s̄) (Satterthwaite 1946), at most the number of errors.

    Parameters
    ----------
    values
        Errors in the order of the visit, (k,) or (k, m); NaN are left out.

    """
    table = values.reshape(len(values), -1)
    table = table[np.isfinite(table).all(axis=1)]
    squares = np.mean(table ** 2, axis=1)
    count, mean = len(squares), float(np.sum(squares)) / max(len(squares), 1)
    if count < 3 or mean <= 0:
        return float(max(count, 1))
    off = squares - mean
    spread = float(np.mean(off ** 2))
    if spread <= 0:
        return float(count)
    inflated = 1.0
    for k in range(1, count // 2):
        together = float(np.sum(off[k:] * off[:-k])) / count / spread
        if together <= 0:
            break
        inflated += 2 * (1 - k / count) * together
    found = 2 * mean ** 2 / (spread / (count - 1) * inflated)
    return float(np.clip(found, 1.0, table.size))


def rms_interval(values: np.ndarray) -> tuple[float, float]:
    """Return the 90 % interval of the rms that errors are drawn with; see `freedom`."""
    with np.errstate(invalid='ignore'):
        rms, nu = _rms(values), freedom(values)
    return rms * float(np.sqrt(nu / chi2.isf(0.05, nu))), \
        rms * float(np.sqrt(nu / chi2.isf(0.95, nu)))


def held_out(fits: dict[str, Fit], sensor: Sensor, poses: Poses,
             stage: Sensor | None = None) -> list[Score]:
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
    stage
        As for `errors`.

    """
    scores = []
    for model, fit in fits.items():
        parts, index, units = [], [], []
        for out in _folds(poses):
            try:
                units.append(fit(sensor, poses.subset(~out)))
            except UserError:
                continue
            parts.append(errors(units[-1], poses.subset(out), stage))
            index.append(np.flatnonzero(out))
        if parts:
            scores.append(_joined(model, parts, index, units))
    return scores


def _joined(model: str, parts: list[Errors], index: list[np.ndarray], units: list[Sensor]
            ) -> Score:
    """Put the folds together in the order of the visit."""
    number = np.concatenate(index)
    order = np.argsort(number)
    fold = np.repeat(np.arange(len(index)), [len(one) for one in index])
    return score(model, Errors(*(np.concatenate([getattr(part, name) for part in parts])[order]
                                 for name in Errors.__dataclass_fields__)),
                 number[order], units, fold[order])


def _folds(poses: Poses) -> list[np.ndarray]:
    if poses.check.any():
        return [poses.check]
    return [np.arange(len(poses)) % _FOLDS == fold for fold in range(min(_FOLDS, len(poses)))]


def table(scores: list[Score]) -> list[str]:
    """Lay scores out for a terminal."""
    lines = [f'{"held out":9} {"poses":>5}  {"tilt rms/max deg":>16}  {"alpha rms/max deg":>17}  '
             f'{"beta rms/max deg":>16}  {"accel rms/max mg":>16}']
    for s in scores:
        lines.append(f'{s.model:9} {s.poses:5d}  {_pair(s.tilt_rms_deg, s.tilt_max_deg)}  '
                     f' {_pair(s.alpha_rms_deg, s.alpha_max_deg)}  '
                     f'{_pair(s.beta_rms_deg, s.beta_max_deg)}  '
                     f'{_pair(s.accel_rms_mg, s.accel_max_mg)}')
    if scores and scores[-1].unscored:
        lines.append(f'alpha not scored in {scores[-1].unscored} poses that show it worse than '
                     '1 deg (near +-90 deg without a z axis)')
    return lines


def _pair(rms: float, largest: float) -> str:
    return f'{"-":>16}' if np.isnan(rms) else f'{rms:7.3f} /{largest:7.3f}'


def _rms(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known ** 2))) if known.size else float('nan')


def _largest(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.abs(known).max()) if known.size else float('nan')
