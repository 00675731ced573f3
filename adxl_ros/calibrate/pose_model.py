# SPDX-License-Identifier: Apache-2.0

"""What a sensor should put out in poses on a stage, and the derivatives of it for the fits."""

from __future__ import annotations

from collections.abc import Sequence

from adxl_ros.calibrate.poses import Poses
from adxl_ros.model import signal_chain
from adxl_ros.model.effects import base, effect_named
from adxl_ros.model.effects.base import Coefficient, Components, NOMINAL_ENVIRONMENT
from adxl_ros.model.kinematics import specific_force, UPRIGHT
from adxl_ros.model.sensor import get, parameter_of, put, Sensor
import numpy as np

_ANGLE_STEP_RAD = 1e-4
"""Step of the central differences by an angle, rad. The error of a slope by
curvature is then 2e-9 of it, and that by rounding 1e-12: both are far below the noise."""
_COEFFICIENT_STEP = 1e-3
"""Step of the central differences by a coefficient, in typical sizes. The error of a
slope by curvature is of the order step², 1e-6 of it, and that by rounding is smaller."""


def reference_force(poses: Poses, gravity_mps2: float) -> Components:
    """Return the specific force at the angles of the encoder, on a stage without errors."""
    return specific_force(poses.alpha_rad, poses.beta_rad, gravity_mps2)


def predicted_volts(sensor: Sensor, poses: Poses, force: Components | None = None) -> np.ndarray:
    """Predict the mean output in poses, V, (k, m); the force is that at the angles by default."""
    force = force or stage_force(sensor, poses.alpha_rad, poses.beta_rad)
    return np.column_stack(signal_chain.static_response(sensor)(force, poses.environment))


def residual_g(sensor: Sensor, poses: Poses) -> np.ndarray:
    """Return measured minus predicted output in poses, g, (k, m)."""
    return (poses.volts - predicted_volts(sensor, poses)) / sensor.scale_v_per_g


def stage_force(sensor: Sensor, alpha_rad: np.ndarray, beta_rad: np.ndarray) -> Components:
    """Return the specific force at rest on a stage with the stage effects of a sensor."""
    signals = base.Signals(
        NOMINAL_ENVIRONMENT,
        alpha=base.Joint(alpha_rad),
        beta=base.Joint(beta_rad),
        up=list(UPRIGHT),
        gravity_mps2=sensor.local_gravity_mps2,
    )
    signal_chain.Chain(sensor, filter(_is_of_stage, sensor.effects))(base.Place.STAGE, signals)
    return specific_force(
        signals.alpha.position, signals.beta.position, signals.gravity_mps2, 0.0, signals.up
    )


def _is_of_stage(effect: str) -> bool:
    return effect_named(effect).place is base.Place.STAGE


def angle_jacobian(sensor: Sensor, poses: Poses) -> np.ndarray:
    """Differentiate the predicted volts by alpha and beta, V/rad, (k, m, 2)."""

    def shifted(alpha_rad: float, beta_rad: float) -> np.ndarray:
        force = stage_force(sensor, poses.alpha_rad + alpha_rad, poses.beta_rad + beta_rad)
        return predicted_volts(sensor, poses, force)

    def slope(alpha_rad: float, beta_rad: float) -> np.ndarray:
        change = shifted(alpha_rad, beta_rad) - shifted(-alpha_rad, -beta_rad)
        return change / (2 * _ANGLE_STEP_RAD)

    return np.stack([slope(_ANGLE_STEP_RAD, 0.0), slope(0.0, _ANGLE_STEP_RAD)], axis=2)


def coefficient_jacobian(sensor: Sensor, poses: Poses, names: Sequence[Coefficient]) -> np.ndarray:
    """Differentiate the predicted volts by coefficients, V per their unit, (k, m, p)."""
    force = stage_force(sensor, poses.alpha_rad, poses.beta_rad)

    def slope(name: Coefficient) -> np.ndarray:
        value = get(sensor, [name])
        step = _COEFFICIENT_STEP * parameter_of(name).scale
        shared = None if _is_of_stage(name.effect) else force
        above = predicted_volts(put(sensor, [name], value + step), poses, shared)
        below = predicted_volts(put(sensor, [name], value - step), poses, shared)
        return (above - below) / (2 * step)

    return np.stack([slope(name) for name in names], axis=2)
