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

"""Errors of calibrated units against the truth, and their Cramér-Rao bounds."""

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
import scipy

MAX_BOUND_RAD = np.radians(1.0)
"""Largest bound of an angle, rad, at which a pose counts; chosen."""
NEAR_VERTICAL_RAD = np.radians(15.0)
"""Distance from ±90°, rad, below which a pose does not count for the alpha error; chosen."""
_SAME_MPS2 = 1e-3
"""Largest difference of two solutions of |f| = g that are the same, m/s²; chosen."""
_SETTLED_S = 1.0
"""Time after which the start of Butterworth and RC filter has decayed, s; chosen."""
_BUTTERWORTH_ORDER = 2
"""Order of the low-pass of the motion experiment; the paper's."""
_BUTTERWORTH_HZ = 20.0
"""Corner of that low-pass, Hz; the paper's."""


@dataclass(frozen=True)
class AngleErrors:
    """
    Errors of alpha and beta in k poses, (k, 2) each, rad.

    Attributes
    ----------
    error
        Estimate minus truth.
    std
        Standard deviation by the calibration.
    pose_bound, bound
        Cramér-Rao bound by the noise of one pose, and by pose and calibration. It is inf where
        |f| = g has two upright solutions, and for beta within 1° of level.
    near_vertical
        Poses within 15° of alpha = ±90°, (k,).

    """

    error: np.ndarray
    std: np.ndarray
    pose_bound: np.ndarray
    bound: np.ndarray
    near_vertical: np.ndarray

    @property
    def determined(self) -> np.ndarray:
        """Return whether each angle counts, (k, 2): its bound is below 1°."""
        return self.bound < MAX_BOUND_RAD

    def ratio(self, pose_only: bool) -> np.ndarray:
        """Return the errors that count over the bound of the pose only, or over the full bound."""
        bound = self.pose_bound if pose_only else self.bound
        return (self.error / bound)[self.determined]


def sweep_bound(truth: Sensor, swept: Poses, true_rad: np.ndarray, stage: StageError,
                terms: Sequence[str]) -> Sensor:
    """
    Return the true unit with the Cramér-Rao bound of a sweep as its covariance.

    Parameters
    ----------
    truth
        The unit on its stage.
    swept
        The poses of the sweep, with their settings.
    true_rad
        True angles of the stage in these poses, rad, (k, 2).
    stage
        Standard deviations of the stage's error; where they are 0, the base is level.
    terms
        Terms of the model to be fitted.

    Returns
    -------
    Sensor
        The unit.

    """
    names = full_model.fitted_coefficients(truth.axes, terms)
    unit = with_neutral(truth, (*map(full_model.effect_of, terms), 'base_tilt'))
    level = full_model.LEVEL_STD_RAD if stage.total_rad else 1e-9
    at_truth = replace(swept, alpha_rad=true_rad[:, 0], beta_rad=true_rad[:, 1])
    information = full_model.fisher_information(unit, at_truth, names, stage)
    base = [i for i, name in enumerate(names) if name.effect == 'base_tilt']
    information[base, base] += 1 / level ** 2 - 1 / full_model.LEVEL_STD_RAD ** 2
    covariance = np.linalg.inv(information)
    of_sensor = [i for i, name in enumerate(names) if not full_model.belongs_to_stage(name)]
    return replace(truth, covariance=covariance[np.ix_(of_sensor, of_sensor)],
                   covariance_names=tuple(names[i] for i in of_sensor))


def angle_errors(fitted: Sensor, bound: Sensor, poses: Poses, true_rad: np.ndarray
                 ) -> AngleErrors:
    """
    Compare the tilt by a calibrated unit with the truth.

    Parameters
    ----------
    fitted
        The calibrated unit.
    bound
        From `sweep_bound`.
    poses
        Poses that were not fitted, k of them.
    true_rad
        True angles of the stage, rad, (k, 2).

    Returns
    -------
    AngleErrors
        The errors and their bounds.

    """
    force = pose_response.stage_force(bound, *true_rad.T)
    up = np.where(np.asarray(force[2]) < 0, -1, 1)
    variance_v2 = np.mean(poses.std_v, axis=0) ** 2
    true = _angles(bound, force, up, variance_v2)
    pose_only = _angles(bound.without_covariance(), force, up, variance_v2)
    measured_force = signal_chain.inverse(fitted, up)(list(poses.volts.T))
    measured = _angles(fitted, measured_force, up, variance_v2)
    solution = signal_chain.inverse(bound, up)(list(signal_chain.static_response(bound)(force)))
    twofold = np.abs(np.subtract(solution, force)).max(axis=0) > _SAME_MPS2
    true[1][twofold] = pose_only[1][twofold] = np.inf
    level = np.hypot(force[0], force[1]) < np.sin(MAX_BOUND_RAD) * np.abs(force[2])
    true[1][level, 1] = pose_only[1][level, 1] = np.inf
    error = measured[0] - true[0]
    error[:, 1] = (error[:, 1] + np.pi) % (2 * np.pi) - np.pi
    error[:, 1] = np.where(np.isfinite(error[:, 1]), error[:, 1], 0.0)
    inclined = np.arctan2(np.hypot(force[0], force[1]), np.abs(force[2]))
    return AngleErrors(error, measured[1], pose_only[1], true[1],
                       np.pi / 2 - inclined < NEAR_VERTICAL_RAD)


def _angles(sensor: Sensor, force: Components, up: np.ndarray, variance_v2: np.ndarray
            ) -> tuple[np.ndarray, np.ndarray]:
    """Return alpha and beta, and their standard deviations, rad, (k, 2) each."""
    covariance = force_covariance(sensor, force, variance_v2)
    measured = tilt(force, covariance, 'z' in sensor.axes)
    return (np.column_stack([measured.alpha, measured.beta]),
            np.column_stack([measured.alpha_std, measured.beta_std]))


def force_errors(fitted: Sensor, truth: Sensor, poses: Poses, true_rad: np.ndarray
                 ) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the errors of the measured axes and their standard deviations by the calibration.

    Parameters
    ----------
    fitted, truth
        The calibrated and the true unit.
    poses
        The poses, k of them.
    true_rad
        True angles of the stage, rad, (k, 2).

    Returns
    -------
    tuple
        Errors and standard deviations, m/s², (k, m) each.

    """
    true = pose_response.stage_force(truth, *true_rad.T)
    up = np.where(np.asarray(true[2]) < 0, -1, 1)
    measured = signal_chain.inverse(fitted, up)(list(poses.volts.T))
    covariance = force_covariance(fitted, measured, np.mean(poses.std_v, axis=0) ** 2)
    axes = [AXES.index(axis) for axis in fitted.axes]
    return (np.column_stack([measured[d] - true[d] for d in axes]),
            np.sqrt(np.column_stack([covariance[d, d] for d in axes])))


@dataclass(frozen=True)
class MotionErrors:
    """
    Errors of the motion experiment.

    Attributes
    ----------
    rmse_mmps2
        Rms of the residual about its mean, mm/s².
    offset_mmps2
        Mean of the residual, mm/s².

    """

    rmse_mmps2: float
    offset_mmps2: float


def motion_errors(fitted: Sensor, time_s: np.ndarray, volts: np.ndarray, reference_mps2: np.ndarray
                  ) -> tuple[MotionErrors, np.ndarray, np.ndarray]:
    """
    Compare the acceleration of a calibrated unit in motion with the reference.

    The RC filter is inverted. Estimate and reference then pass the same Butterworth filter.

    Parameters
    ----------
    fitted
        The calibrated unit.
    time_s
        Stamps, s, (n,).
    volts
        Output, V, (n, m).
    reference_mps2
        Acceleration along x, m/s², (n,).

    Returns
    -------
    tuple
        The errors; filtered estimate and reference, m/s², (n,) each.

    """
    unfiltered = filter_inversion.undo(volts, time_s, noise.electronics(fitted).rc_s,
                                       fitted.rate_hz)
    estimate = signal_chain.inverse(fitted)(list(unfiltered.T))[0]
    b, a = scipy.signal.butter(_BUTTERWORTH_ORDER, _BUTTERWORTH_HZ, fs=fitted.rate_hz)
    smooth, expected = (scipy.signal.lfilter(b, a, v) for v in (estimate, reference_mps2))
    residual = 1e3 * (smooth - expected)[time_s > _SETTLED_S]
    return MotionErrors(float(residual.std()), float(residual.mean())), smooth, expected


def motion_bound_mmps2(nominal: Sensor) -> float:
    """Return the floor of the motion experiment, mm/s²: white noise after the Butterworth."""
    b, a = scipy.signal.butter(_BUTTERWORTH_ORDER, _BUTTERWORTH_HZ, fs=nominal.rate_hz)
    impulse = scipy.signal.lfilter(b, a, np.eye(1, round(nominal.rate_hz))[0])
    density = nominal.noise_density_g_per_rthz[0] * G0_MPS2
    return float(1e3 * density * np.sqrt(nominal.rate_hz / 2 * np.sum(impulse ** 2)))
