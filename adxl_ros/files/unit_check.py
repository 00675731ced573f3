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

"""Whether parameters belong to the unit whose samples they are to correct."""

from __future__ import annotations

from collections.abc import Mapping

from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import FORMAT, nominal_figures
from adxl_ros.model.sensor import Sensor
import numpy as np


def same_unit(serial: str, other: str) -> bool:
    """Tell whether serial numbers may be of one unit: `nominal` is none in particular."""
    return serial == other or 'nominal' in (serial, other)


def check_unit(info: Mapping[str, str], axes: str, sensor: Sensor, where: str) -> None:
    """
    Refuse samples of another unit than `sensor` describes.

    What `info` does not say is not checked.

    Parameters
    ----------
    info
        Keys of `sensor_info`.
    axes
        Measured axes.
    sensor
        What the parameters describe.
    where
        The recording or topic, for messages.

    Raises
    ------
    UserError
        The format version is unknown, or the serial numbers, the axes or the nominal figures
        differ.

    """
    version = info.get('format', FORMAT)
    if version != FORMAT:
        raise UserError(f'{where}: format version {version}, but this package reads version '
                        f'{FORMAT}; update the package')
    serial = info.get('serial', 'nominal')
    if not same_unit(serial, sensor.serial):
        raise UserError(f'{where}: samples of the sensor with serial number {serial}, but the '
                        f'parameters are those of {sensor.serial}; name the parameter file of '
                        f'{serial}')
    if axes != sensor.axes:
        raise UserError(f'{where}: samples of the axes {axes}, but the parameters of '
                        f'{sensor.serial} are for {sensor.axes}; name the parameter file of this '
                        'sensor')
    for key, figures in nominal_figures(info, axes, where).items():
        own = getattr(sensor, key)
        if not np.array_equal(figures, own):
            raise UserError(f'{where}: {key} is {figures.tolist()}, but {own.tolist()} in the '
                            f'parameters of {sensor.serial}; name the parameter file that the '
                            'samples were made with')
