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

"""What the experiments are judged by: errors against the truth, bounds, coverage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from adxl_ros.calibrate import pose_response
from adxl_ros.calibrate.fits import full_model
from adxl_ros.calibrate.poses import Poses
from adxl_ros.calibrate.stage_error import StageError
from adxl_ros.compensate import filter_inversion
from adxl_ros.model import noise, signal_chain
from adxl_ros.model.coefficients import with_neutral
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.covariance import force_covariance
from adxl_ros.model.effects.base import Components
from adxl_ros.model.sensor import Sensor
from adxl_ros.model.tilt import tilt
import numpy as np
from scipy.signal import butter, lfilter

APART_RAD = np.radians(1.0)
"""Poses whose bound exceeds this are scored apart."""
FLAT_RAD = np.radians(15.0)
"""Poses nearer to ±90° than this are left out of the reduction of the alpha error."""
_SAME_MPS2 = 1e-3
_SETTLED_S = 1.0
"""Butterworth and RC filter have forgotten their beginning by then."""


@dataclass(frozen=True)
class Angles:
    """
    Alpha and beta of poses, (k, 2) each, rad.

    Attributes
    ----------
    error
        Estimate minus truth.
    std
        What the calibration promises.
    pose_bound, bound
        Cramér-Rao bound of the noise of one pose alone; of pose and calibration together. inf
        where |f| = g has another solution that is as upright and nothing tells them apart, and
        for beta within 1° of level, where it is the level's.
    near_vertical
        Poses within 15° of alpha = ±90°, (k,).

    """

    error: np.ndarray
    std: np.ndarray
    pose_bound: np.ndarray
    bound: np.ndarray
    near_vertical: np.ndarray

    @property
    def shown(self) -> np.ndarray:
        """Tell which are scored, (k, 2): their bound is below 1°."""
        return self.bound < APART_RAD

    def ratio(self, alone: bool) -> np.ndarray:
        """Return errors by their bound, those that are scored."""
        bound = self.pose_bound if alone else self.bound
        return (self.error / bound)[self.shown]


def known_bound(truth: Sensor, swept: Poses, true_rad: np.ndarray, stage: StageError,
                terms: Sequence[str]) -> Sensor:
    """
    Return the truth with the Cramér-Rao bound of a sweep for covariance.

    Parameters
    ----------
    truth
        The unit on its stage.
    swept
        The poses of the sweep, with their settings.
    true_rad
        Where the stage really stood in them, rad, (k, 2).
    stage
        Levels of the stage's error; without any, the base is level, too.
    terms
        That are to be found.

    """
    names = full_model.fitted_coefficients(truth.axes, terms)
    at = with_neutral(truth, (*map(full_model.effect_of, terms), 'base_tilt'))
    level = full_model.LEVEL_STD_RAD if stage.total_rad else 1e-9
    there = replace(swept, alpha_rad=true_rad[:, 0], beta_rad=true_rad[:, 1])
    known = full_model.fisher_information(at, there, names, stage)
    of_base = [i for i, name in enumerate(names) if name.effect == 'base_tilt']
    known[of_base, of_base] += 1 / level ** 2 - 1 / full_model.LEVEL_STD_RAD ** 2
    covariance = np.linalg.inv(known)
    own = [i for i, name in enumerate(names) if not full_model.belongs_to_stage(name)]
    return replace(truth, covariance=covariance[np.ix_(own, own)],
                   covariance_names=tuple(names[i] for i in own))


def angles(fitted: Sensor, bound: Sensor, poses: Poses, true_rad: np.ndarray) -> Angles:
    """
    Judge the tilt of a calibrated unit in poses against the truth.

    Parameters
    ----------
    fitted
        The unit by its calibration.
    bound
        From `known_bound`.
    poses
        Not fitted.
    true_rad
        Where the stage really stood, (k, 2).

    """
    force = pose_response.stage_force(bound, *true_rad.T)
    up = np.where(np.asarray(force[2]) < 0, -1, 1)
    variance_v2 = np.mean(poses.std_v, axis=0) ** 2
    true = _angles(bound, force, up, variance_v2)
    alone = _angles(bound.without_covariance(), force, up, variance_v2)
    found = _angles(fitted, signal_chain.inverse(fitted, up)(list(poses.volts.T)), up, variance_v2)
    again = signal_chain.inverse(bound, up)(list(signal_chain.static_response(bound)(force)))
    twofold = np.abs(np.subtract(again, force)).max(axis=0) > _SAME_MPS2
    true[1][twofold] = alone[1][twofold] = np.inf
    level = np.hypot(force[0], force[1]) < np.sin(APART_RAD) * np.abs(force[2])
    true[1][level, 1] = alone[1][level, 1] = np.inf
    error = found[0] - true[0]
    error[:, 1] = (error[:, 1] + np.pi) % (2 * np.pi) - np.pi
    error[:, 1] = np.where(np.isfinite(error[:, 1]), error[:, 1], 0.0)
    inclined = np.arctan2(np.hypot(force[0], force[1]), np.abs(force[2]))
    return Angles(error, found[1], alone[1], true[1], np.pi / 2 - inclined < FLAT_RAD)


def _angles(sensor: Sensor, force: Components, up: np.ndarray, variance_v2: np.ndarray
            ) -> tuple[np.ndarray, np.ndarray]:
    """Return alpha and beta, and their standard deviations, rad, (k, 2) each."""
    covariance = force_covariance(sensor, force, variance_v2)
    found = tilt(force, covariance, 'z' in sensor.axes)
    return (np.column_stack([found.alpha, found.beta]),
            np.column_stack([found.alpha_std, found.beta_std]))


def forces(fitted: Sensor, truth: Sensor, poses: Poses, true_rad: np.ndarray
           ) -> tuple[np.ndarray, np.ndarray]:
    """Return errors of the measured axes of poses and their promised deviations, m/s², (k, m)."""
    true = pose_response.stage_force(truth, *true_rad.T)
    up = np.where(np.asarray(true[2]) < 0, -1, 1)
    found = signal_chain.inverse(fitted, up)(list(poses.volts.T))
    covariance = force_covariance(fitted, found, np.mean(poses.std_v, axis=0) ** 2)
    axes = [AXES.index(axis) for axis in fitted.axes]
    return (np.column_stack([found[d] - true[d] for d in axes]),
            np.sqrt(np.column_stack([covariance[d, d] for d in axes])))


@dataclass(frozen=True)
class Shaken:
    """Motion experiment: residual rms, mm/s², without its mean, and the mean itself, mm/s²."""

    rmse_mmps2: float
    offset_mmps2: float


def motion(fitted: Sensor, time_s: np.ndarray, volts: np.ndarray, reference_mps2: np.ndarray
           ) -> tuple[Shaken, np.ndarray, np.ndarray]:
    """
    Judge the motion experiment: RC undone, then one Butterworth of order 2, 20 Hz, on both.

    Returns
    -------
    tuple
        The figures; filtered estimate and reference, m/s², (n,) each.

    """
    before = filter_inversion.undo(volts, time_s, noise.electronics(fitted).rc_s, fitted.rate_hz)
    estimate = signal_chain.inverse(fitted)(list(before.T))[0]
    b, a = butter(2, 20.0, fs=fitted.rate_hz)
    smooth, expected = lfilter(b, a, estimate), lfilter(b, a, reference_mps2)
    off = 1e3 * (smooth - expected)[time_s > _SETTLED_S]
    return Shaken(float(off.std()), float(off.mean())), smooth, expected


def motion_bound_mmps2(nominal: Sensor) -> float:
    """Return the floor of the motion experiment: white noise through the Butterworth, mm/s²."""
    b, a = butter(2, 20.0, fs=nominal.rate_hz)
    impulse = lfilter(b, a, np.eye(1, round(nominal.rate_hz))[0])
    density = nominal.noise_density_g_per_rthz[0] * G0_MPS2
    return float(1e3 * density * np.sqrt(nominal.rate_hz / 2 * np.sum(impulse ** 2)))
