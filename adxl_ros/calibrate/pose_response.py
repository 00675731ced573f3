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

"""The volts that the chain promises in poses of the stage, and how they follow what is unknown."""

from __future__ import annotations

from collections.abc import Sequence

from adxl_ros.calibrate.poses import Poses
from adxl_ros.calibrate.stage_error import PoseCovariance, shared_settings, StageError
from adxl_ros.model import signal_chain
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


def predicted_volts(unit: Sensor, poses: Poses, off_rad: tuple[float, float] = (0.0, 0.0)
                    ) -> np.ndarray:
    """Return the volts that the chain promises at the stage's angles and `off_rad`, (k, m)."""
    force = stage_force(unit, poses.alpha_rad + off_rad[0], poses.beta_rad + off_rad[1])
    return np.column_stack(signal_chain.static_response(unit)(force, poses.environment))


def stage_force(unit: Sensor, alpha_rad: np.ndarray, beta_rad: np.ndarray) -> Components:
    """Return the specific force at rest on the unit's stage with its errors, m/s², three (k,)."""
    signals = Signals(NOMINAL_ENVIRONMENT, alpha=Joint(alpha_rad), beta=Joint(beta_rad),
                      up=list(UPRIGHT), gravity_mps2=unit.local_gravity_mps2)
    for apply, values in signal_chain.effects_at(unit, Place.STAGE):
        apply(signals, values)
    return specific_force(signals.alpha.position, signals.beta.position, signals.gravity_mps2,
                          0.0, signals.up)


def angle_jacobian(unit: Sensor, poses: Poses) -> np.ndarray:
    """Differentiate volts by alpha and beta, V/rad, (k, m, 2)."""
    h = _ANGLE_STEP_RAD
    ends = [[predicted_volts(unit, poses, (side * a, side * b)) for side in (h, -h)]
            for a, b in ((1, 0), (0, 1))]
    return np.stack([(above - below) / (2 * h) for above, below in ends], axis=2)


def coefficient_jacobian(unit: Sensor, poses: Poses, names: Sequence[Coefficient]) -> np.ndarray:
    """Differentiate volts by coefficients, V a unit, (k, m, p)."""
    columns = []
    for name in names:
        at, step = get(unit, [name]), 1e-3 * parameter_of(name).scale
        above, below = (predicted_volts(put(unit, [name], at + by), poses) for by in (step, -step))
        columns.append((above - below) / (2 * step))
    return np.stack(columns, axis=2)


def volts_covariance(unit: Sensor, poses: Poses, error: StageError,
               kept: np.ndarray | None = None) -> PoseCovariance:
    """
    Return the covariance of the volts of all poses about the model.

    Parameters
    ----------
    unit
        Where the volts are differentiated by the angles.
    poses
        Noise of the means, angles and settings.
    error
        Standard deviations of the stage.
    kept
        Poses that count, (k,) bool; None for all.

    """
    return PoseCovariance(angle_jacobian(unit, poses), poses, shared_settings(poses), error, kept)
