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

from collections.abc import Iterator

from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate.motion import Held, Motion
from adxl_ros.simulate.response import Response
import numpy as np

Columns = dict[str, np.ndarray]
_BLOCK = 32768


def simulate(sensor: Sensor, motion: Motion, seed: int) -> Columns:
    """
    Run a manoeuvre through the chain and read the stage by its encoder.

    Returns
    -------
    dict
        Columns of a recording by canonical name, each (n,): `time_s`, volts, the joints'
        encoders, temperature and supply where the manoeuvre has them.

    """
    parts = list(simulate_blocks(sensor, motion, seed))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def simulate_blocks(sensor: Sensor, motion: Motion, seed: int, begin_s: float = 0.0
           ) -> Iterator[Columns]:
    """
    Run a manoeuvre block by block; see `simulate`.

    Parameters
    ----------
    sensor
        The unit, sampled at its rate.
    motion
        What it feels.
    seed
        Of all randomness: the same gives the same to the bit.
    begin_s
        Time of the first sample.

    """
    respond = Response(sensor, motion, seed, begin_s)
    count = max(int(round(motion.duration_s * sensor.rate_hz, 6)), 1)
    for begin in range(0, count, _BLOCK):
        time_s = begin_s + np.arange(begin, min(begin + _BLOCK, count)) / sensor.rate_hz
        volts = respond(time_s)
        yield {'time_s': time_s,
               **{f'{axis}_v': volts[:, d] for d, axis in enumerate(sensor.axes)},
               **reference_columns(sensor, motion, time_s)}


def reference_columns(sensor: Sensor, motion: Motion, time_s: np.ndarray) -> Columns:
    """Return what is recorded beside the sensor at the stamps, (n,) by column."""
    columns = {}
    if motion.force is None:
        columns['alpha_rad'] = encoder_reading(motion.alpha(time_s), sensor.stage_resolution_rad)
        columns['beta_rad'] = encoder_reading(motion.beta(time_s), sensor.stage_resolution_rad)
        if not isinstance(motion.shift, Held):
            columns['shift_m'] = motion.shift(time_s)
    if motion.temperature_c:
        columns['temperature_c'] = motion.temperature_c(time_s)
    if motion.supply_v:
        columns['supply_v'] = motion.supply_v(time_s)
    return columns


def encoder_reading(angle_rad: np.ndarray, resolution_rad: float) -> np.ndarray:
    """Round angles to the encoder's steps; unchanged for a resolution of 0."""
    if not resolution_rad:
        return angle_rad
    return np.rint(angle_rad / resolution_rad) * resolution_rad
