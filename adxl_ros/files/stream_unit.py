# SPDX-License-Identifier: Apache-2.0

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
    """Return the nominal sensor that a stream states, without a fitted coefficient."""
    measured = {key: text for key, text in sensor.provenance.items() if key == 'noise_from'}
    bare = with_axes(replace(sensor.without_covariance(), model='nominal', effects=(), values={},
                             provenance=measured), axes)
    stated: dict[str, Any] = dict(info.nominal_values(axes))
    return replace(bare, serial=info.texts.get('serial', sensor.serial), rate_hz=rate_hz, **stated)


def unit_of(sensor: Sensor, info: StreamInfo, axes: str | None = None,
            rate_hz: float | None = None) -> Sensor:
    """Return the nominal sensor of a stream, whose serial number must not contradict `sensor`."""
    _check_serial(info, sensor)
    axes = axes or info.axes or sensor.axes
    unit = uncalibrated(sensor, info, axes, rate_hz or info.rate_hz or sensor.rate_hz)
    return replace(unit, serial=sensor.serial) if info.serial == NO_UNIT else unit


def recorded_unit(sensor: Sensor, recording: Recording) -> Sensor:
    """Return the nominal sensor of a recording, with the sample rate of its stamps."""
    unit = unit_of(sensor, recording.stream_info, recording.axes, recording.rate_hz)
    return replace(unit, provenance={**unit.provenance, 'rate_from': Path(recording.path).name})
