# SPDX-License-Identifier: Apache-2.0

"""Simulated recordings: samples of a sensor during a manoeuvre, and the stage's encoders."""

from __future__ import annotations

from collections.abc import Iterator

from adxl_ros.files.recording_columns import Recording, REFERENCES
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate.motion import Held, Motion
from adxl_ros.simulate.response import Response
import numpy as np

Columns = dict[str, np.ndarray]
"""Columns of a recording by canonical name, (n,) each."""

_BLOCK_ROWS = 32768
"""Samples of a block; chosen: its arrays stay smaller than the internal grid."""


def simulate(sensor: Sensor, motion: Motion, seed: int) -> Columns:
    """
    Simulate a whole recording.

    returns: columns by canonical name, (n,) each: `time_s`, volts by axis, readings of the
    encoders, and temperature and supply if the manoeuvre has them.
    """
    parts = list(simulate_blocks(sensor, motion, seed))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def simulate_blocks(sensor: Sensor, motion: Motion, seed: int, begin_s: float = 0.0
                    ) -> Iterator[Columns]:
    """Simulate a recording block by block."""
    respond = Response(sensor, motion, seed, begin_s)
    count = max(int(round(motion.duration_s * sensor.rate_hz, 6)), 1)
    for begin in range(0, count, _BLOCK_ROWS):
        time_s = begin_s + np.arange(begin, min(begin + _BLOCK_ROWS, count)) / sensor.rate_hz
        volts = respond(time_s)
        yield {'time_s': time_s,
               **{f'{axis}_v': volts[:, d] for d, axis in enumerate(sensor.axes)},
               **reference_columns(sensor, motion, time_s)}


def simulate_at_stamps(sensor: Sensor, motion: Motion, recording: Recording, seed: int
                       ) -> Iterator[Columns]:
    """
    Simulate samples at the stamps of a recording, block by block.

    yields: columns of the next samples by canonical name, (n,) each: `time_s`, volts by axis, and
    the references of the recording.
    """
    respond = Response(sensor, motion, seed, float(recording.time_s[0]))
    references = [name for name in REFERENCES if name in recording.columns]
    for begin in range(0, len(recording), _BLOCK_ROWS):
        part = slice(begin, begin + _BLOCK_ROWS)
        volts = respond(recording.time_s[part])
        yield {'time_s': recording.time_s[part],
               **{f'{axis}_v': volts[:, d] for d, axis in enumerate(sensor.axes)},
               **{name: recording.columns[name][part] for name in references}}


def reference_columns(sensor: Sensor, motion: Motion, time_s: np.ndarray) -> Columns:
    """
    Return the columns of a recording that are not those of the sensor.

    time_s: stamps, s, (n,); returns: readings of the encoders, temperature and supply by canonical
    name, (n,) each.
    """
    columns = {}
    if motion.force is None:
        resolution_rad = sensor.stage_resolution_rad
        columns['alpha_rad'] = encoder_reading(motion.alpha(time_s), resolution_rad)
        columns['beta_rad'] = encoder_reading(motion.beta(time_s), resolution_rad)
        if not isinstance(motion.shift, Held):
            columns['shift_m'] = motion.shift(time_s)
    if motion.temperature_c:
        columns['temperature_c'] = motion.temperature_c(time_s)
    if motion.supply_v:
        columns['supply_v'] = motion.supply_v(time_s)
    return columns


def encoder_reading(angle_rad: np.ndarray, resolution_rad: float) -> np.ndarray:
    """
    Round angles to the steps of an encoder.

    angle_rad: angles, rad, (n,); returns: readings, rad, (n,).
    """
    if not resolution_rad:
        return angle_rad
    return np.rint(angle_rad / resolution_rad) * resolution_rad
