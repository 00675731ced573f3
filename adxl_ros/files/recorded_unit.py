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

"""The unit that a recording or stream is of, its sample rate and its stage angles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import nominal_figures, Recording
from adxl_ros.files.unit_check import same_unit
from adxl_ros.model.sensor import Sensor, with_axes
import numpy as np


def unit_of(sensor: Sensor, info: Mapping[str, str], where: str, axes: str | None = None,
            rate_hz: float | None = None) -> Sensor:
    """
    Return the nominal sensor that a stream or recording is of: uncalibrated, with its serial.

    What a fit does not find (filter, ADC, noise, stage) stays that of `sensor`.

    Parameters
    ----------
    sensor
        What is known beforehand.
    info
        Keys of `sensor_info`.
    where
        The file or topic, for messages.
    axes, rate_hz
        As the samples show them; else those of `info`.

    Raises
    ------
    UserError
        The stream and `sensor` belong to different units, or `info` cannot be read.

    """
    serial = info.get('serial', sensor.serial)
    if not same_unit(serial, sensor.serial):
        raise UserError(f'{where}: is of the sensor {serial}, but the parameters are of '
                        f'{sensor.serial}; give the parameters of that sensor, or nominal ones')
    axes = axes or info.get('axes', sensor.axes)
    bare = with_axes(replace(sensor, model='nominal', effects=(), values={},
                             covariance=np.zeros((0, 0)), covariance_names=(), provenance={}),
                     axes)
    changes: dict[str, Any] = dict(nominal_figures(info, axes, where))
    return replace(bare, serial=sensor.serial if serial == 'nominal' else serial,
                   rate_hz=rate_hz or stated_rate_hz(info, sensor, where), **changes)


def stated_rate_hz(info: Mapping[str, str], sensor: Sensor, where: str) -> float:
    """
    Return the sample rate that a stream states, Hz, else that of the sensor.

    Parameters
    ----------
    info
        Keys of `sensor_info`.
    sensor
        What is known beforehand.
    where
        The file or topic, for messages.

    Raises
    ------
    UserError
        The rate is no number of samples a second.

    """
    text = info.get('rate_hz', str(sensor.rate_hz))
    try:
        rate = float(text)
    except ValueError:
        rate = 0.0
    if not 0 < rate < 1e6:
        raise UserError(f'{where}: rate_hz is {text!r}, expected samples a second')
    return rate


def recorded_unit(sensor: Sensor, recording: Recording) -> Sensor:
    """Return the nominal sensor that a recording is of; see `unit_of`."""
    return unit_of(sensor, recording.info, recording.path, recording.axes, rate_hz(recording))


def rate_hz(recording: Recording) -> float:
    """
    Return the sample rate from the stamps, Hz, which a gap here and there does not move.

    Raises
    ------
    UserError
        Fewer than two samples.

    """
    if len(recording) < 2:
        raise UserError(f'{recording.path}: {len(recording)} samples; at least 2 are needed')
    return round(float(1 / np.median(np.diff(recording.time_s))), 6)


def stage_angles(recording: Recording) -> np.ndarray | None:
    """Return alpha and beta, rad, (n, 2), NaN where not sampled; None without a stage."""
    names = ('alpha_rad', 'beta_rad')
    if not all(name in recording.columns for name in names):
        return None
    angles = np.column_stack([recording.columns[name] for name in names])
    return None if np.isnan(angles).all(axis=0).any() else angles
