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

"""Which unit a recording or stream is of, and whether given parameters are of the same unit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import FORMAT, NO_UNIT, StreamInfo
from adxl_ros.model.sensor import Sensor, with_axes
import numpy as np


def check_unit(info: StreamInfo, axes: str, sensor: Sensor) -> None:
    """
    Refuse samples of another unit than the one that `sensor` describes.

    What `info` does not state is not checked.

    Parameters
    ----------
    info
        What the stream states.
    axes
        Its measured axes.
    sensor
        The unit of the parameters.

    Raises
    ------
    UserError
        The format version is unknown, or the serial number, the axes or a nominal value differs.

    """
    if info.format_version != FORMAT:
        raise UserError(f'{info.where}: format version {info.format_version}, but this package '
                        f'reads version {FORMAT}; update the package')
    _check_serial(info, sensor)
    if axes != sensor.axes:
        raise UserError(f'{info.where}: samples of the axes {axes}, but the parameters of '
                        f'{sensor.serial} are for {sensor.axes}; name the parameter file of this '
                        'sensor')
    for key, stated in info.nominal_values(axes).items():
        expected = getattr(sensor, key)
        if not np.array_equal(stated, expected):
            raise UserError(f'{info.where}: {key} is {stated.tolist()}, but {expected.tolist()} '
                            f'in the parameters of {sensor.serial}; name the parameter file that '
                            'the samples were made with')


def _check_serial(info: StreamInfo, sensor: Sensor) -> None:
    if info.serial != sensor.serial and NO_UNIT not in (info.serial, sensor.serial):
        raise UserError(f'{info.where}: is of the sensor {info.serial}, but the parameters are of '
                        f'{sensor.serial}; give the parameters of that sensor, or nominal ones')


def uncalibrated(sensor: Sensor, info: StreamInfo, axes: str, rate_hz: float) -> Sensor:
    """
    Return the nominal sensor that a stream states, without a fitted coefficient.

    Parameters
    ----------
    sensor
        Gives what the stream does not state: filter, ADC, noise, stage.
    info
        Gives the serial number, and the nominal values where they are stated.
    axes
        Measured axes.
    rate_hz
        Sample rate, Hz.

    Returns
    -------
    Sensor
        A sensor of model `nominal`. Its serial number is that of `sensor` where the stream
        states none.

    Raises
    ------
    UserError
        A nominal value cannot be read, or those of further axes are unknown.

    """
    measured = {key: text for key, text in sensor.provenance.items() if key == 'noise_from'}
    bare = with_axes(replace(sensor.without_covariance(), model='nominal', effects=(), values={},
                             provenance=measured), axes)
    stated: dict[str, Any] = dict(info.nominal_values(axes))
    return replace(bare, serial=info.texts.get('serial', sensor.serial), rate_hz=rate_hz, **stated)


def unit_of(sensor: Sensor, info: StreamInfo, axes: str | None = None,
            rate_hz: float | None = None) -> Sensor:
    """
    Return the nominal sensor of a stream, whose serial number must not contradict `sensor`.

    Parameters
    ----------
    sensor
        Gives what the stream does not state: filter, ADC, noise, stage.
    info
        What the stream states.
    axes
        Measured axes; None takes those that the stream states.
    rate_hz
        Sample rate, Hz; None takes the stated one.

    Returns
    -------
    Sensor
        A sensor of model `nominal`; where one of both serial numbers is no unit, it has the
        other.

    Raises
    ------
    UserError
        Stream and `sensor` are of different units, or the stream states something unreadable.

    """
    _check_serial(info, sensor)
    axes = axes or info.axes or sensor.axes
    unit = uncalibrated(sensor, info, axes, rate_hz or info.rate_hz or sensor.rate_hz)
    return replace(unit, serial=sensor.serial) if info.serial == NO_UNIT else unit


def recorded_unit(sensor: Sensor, recording: Recording) -> Sensor:
    """
    Return the nominal sensor of a recording, with the sample rate of its stamps.

    Parameters
    ----------
    sensor
        Gives what the recording does not state: filter, ADC, noise, stage.
    recording
        The samples.

    Returns
    -------
    Sensor
        See `unit_of`.

    Raises
    ------
    UserError
        Recording and `sensor` are of different units, there are fewer than two samples, or the
        recording states something unreadable.

    """
    unit = unit_of(sensor, recording.stream_info, recording.axes, recording.rate_hz)
    return replace(unit, provenance={**unit.provenance, 'rate_from': Path(recording.path).name})
