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

"""A whole recording from a manoeuvre: what the sensor says and what the encoder says."""

from __future__ import annotations

from adxl_ros.model import chain
from adxl_ros.model.sensor import Sensor
from adxl_ros.model.stage import specific_force
from adxl_ros.model.trajectory import Motion
import numpy as np


def simulate(sensor: Sensor, motion: Motion, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """
    Run a manoeuvre through the chain and read the stage by its encoder.

    Returns
    -------
    dict
        Columns of a recording by canonical name, each (n,): `time_s`, volts, `alpha_rad`,
        `beta_rad`, and `shift_m` where it moves.

    """
    force = specific_force(motion.alpha_rad, motion.beta_rad, sensor.local_gravity_mps2,
                           motion.shift_acceleration_mps2)
    state = chain.settled(sensor, [float(f[0]) for f in force], rng)
    volts = chain.sample(sensor, force, state, rng)
    columns = {'time_s': motion.time_s}
    columns.update({f'{axis}_v': volts[:, d] for d, axis in enumerate(sensor.axes)})
    columns['alpha_rad'] = encoder(motion.alpha_rad, sensor.stage_resolution_rad)
    columns['beta_rad'] = encoder(motion.beta_rad, sensor.stage_resolution_rad)
    if motion.shift_m.any():
        columns['shift_m'] = motion.shift_m
    return columns


def encoder(angle_rad: np.ndarray, resolution_rad: float) -> np.ndarray:
    """Round angles to the encoder's steps; unchanged for a resolution of 0."""
    if not resolution_rad:
        return angle_rad
    return np.rint(angle_rad / resolution_rad) * resolution_rad
