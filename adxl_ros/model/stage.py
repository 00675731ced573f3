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

"""Kinematics of the two-axis rotary stage with a linear third joint."""

from __future__ import annotations

from adxl_ros.model.effects.base import Components, Value
import numpy as np


def specific_force(alpha_rad: Value, beta_rad: Value, gravity_mps2: float,
                   shift_acceleration_mps2: Value = 0.0) -> Components:
    """
    Specific force in the case frame of a sensor on the stage, m/s².

    At rest f = g·[sin α·cos β, −sin α·sin β, cos α]; a displacement along the sensor's x adds
    its second derivative.

    Parameters
    ----------
    alpha_rad, beta_rad
        Joint angles, rad, arrays or floats of one shape.
    gravity_mps2
        Local gravity, m/s².
    shift_acceleration_mps2
        Second derivative of the `shift` joint, m/s².

    Returns
    -------
    list
        The three components, each in the shape of the angles.

    """
    sin_alpha = np.sin(alpha_rad)
    return [gravity_mps2 * sin_alpha * np.cos(beta_rad) + shift_acceleration_mps2,
            -gravity_mps2 * sin_alpha * np.sin(beta_rad),
            gravity_mps2 * np.cos(alpha_rad)]
