# SPDX-License-Identifier: Apache-2.0

"""Predicted volts of poses on a stage, and their Jacobians."""

from __future__ import annotations

from collections.abc import Sequence

from adxl_ros.calibrate.poses import Poses
from adxl_ros.calibrate.stage_error import PoseCovariance, shared_settings, StageError
from adxl_ros.model import analog_stages, signal_chain
from adxl_ros.model.coefficients import get, parameter_of, put
from adxl_ros.model.effects.base import (
    Coefficient,
    Components,
    Joint,
    NOMINAL_ENVIRONMENT,
    Place,
    Signals,
)
from adxl_ros.model.kinematics import specific_force, UPRIGHT
from adxl_ros.model.sensor import Sensor
import numpy as np

_ANGLE_STEP_RAD = 1e-4
"""Step of the central differences by an angle, rad. Chosen: the chain is smooth, so that the error
of the slope, of order step², is far below the noise."""
_COEFFICIENT_STEP = 1e-3
"""Step of the central differences by a coefficient, in typical sizes. Chosen: the chain is nearly
linear over a thousandth of a typical size."""


def predicted_volts(unit: Sensor, poses: Poses, shift_rad: tuple[float, float] = (0.0, 0.0)
                    ) -> np.ndarray:
    """
    Predict the mean output of a unit in poses.

    returns: volts, (k, m).
    """
    force = stage_force(unit, poses.alpha_rad + shift_rad[0], poses.beta_rad + shift_rad[1])
    return np.column_stack(signal_chain.static_response(unit)(force, poses.environment))


def stage_force(unit: Sensor, alpha_rad: np.ndarray, beta_rad: np.ndarray) -> Components:
    """
    Return the specific force at rest on a stage with the stage effects of a unit.

    alpha_rad, beta_rad: angles of the encoder, rad, (k,); returns: three components in the case
    frame, m/s², (k,).
    """
    signals = Signals(NOMINAL_ENVIRONMENT, alpha=Joint(alpha_rad), beta=Joint(beta_rad),
                      up=list(UPRIGHT), gravity_mps2=unit.local_gravity_mps2)
    for apply, values in analog_stages.effects_at(unit, Place.STAGE):
        apply(signals, values)
    return specific_force(signals.alpha.position, signals.beta.position, signals.gravity_mps2,
                          0.0, signals.up)


def angle_jacobian(unit: Sensor, poses: Poses) -> np.ndarray:
    """
    Differentiate the predicted volts by alpha and beta.

    returns: jacobian, V/rad, (k, m, 2).
    """
    def slope(alpha_rad: float, beta_rad: float) -> np.ndarray:
        above = predicted_volts(unit, poses, (alpha_rad, beta_rad))
        below = predicted_volts(unit, poses, (-alpha_rad, -beta_rad))
        return (above - below) / (2 * _ANGLE_STEP_RAD)

    return np.stack([slope(_ANGLE_STEP_RAD, 0.0), slope(0.0, _ANGLE_STEP_RAD)], axis=2)


def coefficient_jacobian(unit: Sensor, poses: Poses, names: Sequence[Coefficient]) -> np.ndarray:
    """
    Differentiate the predicted volts by coefficients.

    names: coefficients, (p,); returns: jacobian, V per unit of the coefficient, (k, m, p).
    """
    def slope(name: Coefficient) -> np.ndarray:
        value, step = get(unit, [name]), _COEFFICIENT_STEP * parameter_of(name).scale
        above = predicted_volts(put(unit, [name], value + step), poses)
        below = predicted_volts(put(unit, [name], value - step), poses)
        return (above - below) / (2 * step)

    return np.stack([slope(name) for name in names], axis=2)


def volts_covariance(unit: Sensor, poses: Poses, error: StageError,
                     kept: np.ndarray | None = None) -> PoseCovariance:
    """
    Return the covariance of the volts of all poses about the model.

    kept: poses that count, (k,) bool; None for all.
    """
    return PoseCovariance(angle_jacobian(unit, poses), poses, shared_settings(poses), error, kept)
