# SPDX-License-Identifier: Apache-2.0

"""What a stream states of its sensor, and the nominal sensor that it states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
import re
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.model.sensor import Sensor, with_axes
import numpy as np

FORMAT = '1'  # Version of the recording format, the key `format`
NO_SERIAL = 'nominal'  # Serial number that stands for no particular unit
NOMINAL_KEYS = ('nominal_zero_g_v', 'nominal_scale_v_per_g')
"""Keys of the nominal values, V and V/g; each is a field of `Sensor`, too."""
_HIGHEST_RATE_HZ = 1e6
"""Sample rates from here on are refused, Hz (chosen: ten times the limit of a parameter file)."""


@dataclass(frozen=True)
class StreamInfo:
    """What a stream states of its sensor; values are checked when they are asked for."""

    texts: Mapping[str, str]  # Values by key, as text
    where: str  # The file or topic, for messages

    @property
    def serial(self) -> str:
        """Return the serial number of the unit; `NO_SERIAL` where none is stated."""
        return self.texts.get('serial', NO_SERIAL)

    @property
    def axes(self) -> str | None:
        """Measured axes; None where they are not stated."""
        return self.texts.get('axes')

    @property
    def rate_hz(self) -> float | None:
        """Sample rate, Hz; None where it is not stated."""
        if 'rate_hz' not in self.texts:
            return None
        rate_hz = _numbers(self.texts['rate_hz'])
        if len(rate_hz) != 1 or not 0 < rate_hz[0] < _HIGHEST_RATE_HZ:
            raise UserError(
                f'{self.where}: rate_hz is {self.texts["rate_hz"]!r}, expected samples a second'
            )
        return float(rate_hz[0])

    def nominal_values(self, axes: str) -> dict[str, np.ndarray]:
        """Return the stated nominal values, (m,), by the name of the field of `Sensor`."""
        values = {}
        for key in NOMINAL_KEYS:
            if key in self.texts:
                numbers = _numbers(self.texts[key])
                if len(numbers) != len(axes) or not np.isfinite(numbers).all():
                    raise UserError(
                        f'{self.where}: {key} is {self.texts[key]!r}, expected '
                        f'{len(axes)} numbers, one for each axis'
                    )
                values[key] = numbers
        return values


def _numbers(text: str) -> np.ndarray:
    """Return the numbers of a list; none if one of them cannot be read."""
    try:
        return np.array([float(word) for word in re.split(r'[\s,;\[\]()]+', text) if word])
    except ValueError:
        return np.zeros(0)


def sensor_info(sensor: Sensor) -> dict[str, str]:
    """Return the keys and values that a stream of `sensor` states."""
    return {
        'serial': sensor.serial,
        'axes': sensor.axes,
        **{key: ', '.join(map(repr, getattr(sensor, key).tolist())) for key in NOMINAL_KEYS},
        'rate_hz': repr(float(sensor.rate_hz)),
        'format': FORMAT,
    }


def converted_info(texts: Mapping[str, str], sensor: Sensor) -> dict[str, str]:
    """Return what a recording states after a conversion by the nominal values of `sensor`."""
    unchanged = {key: texts[key] for key in ('serial', 'rate_hz') if key in texts}
    return {**texts, **sensor_info(sensor), **unchanged}


def check_same_sensor(info: StreamInfo, axes: str, sensor: Sensor) -> None:
    """Refuse samples of another sensor, or with other axes or nominal values."""
    version = info.texts.get('format', FORMAT)
    if version != FORMAT:
        raise UserError(
            f'{info.where}: format version {version}, but this package reads version '
            f'{FORMAT}; update the package'
        )
    _check_serial(info, sensor)
    if axes != sensor.axes:
        raise UserError(
            f'{info.where}: samples of the axes {axes}, but the parameters of '
            f'{sensor.serial} are for {sensor.axes}; name the file of this sensor'
        )
    for key, stated in info.nominal_values(axes).items():
        expected = getattr(sensor, key)
        if not np.array_equal(stated, expected):
            raise UserError(
                f'{info.where}: {key} is {stated.tolist()}, but {expected.tolist()} '
                f'in the parameters of {sensor.serial}; name the parameter file that '
                'the samples were made with'
            )


def _check_serial(info: StreamInfo, sensor: Sensor) -> None:
    if info.serial != sensor.serial and NO_SERIAL not in (info.serial, sensor.serial):
        raise UserError(
            f'{info.where}: is of the sensor {info.serial}, but the parameters are of '
            f'{sensor.serial}; give the parameters of that sensor, or nominal ones'
        )


def uncalibrated(sensor: Sensor, info: StreamInfo, axes: str, rate_hz: float) -> Sensor:
    """Return the nominal sensor that a stream states, without a fitted coefficient."""
    measured = {key: text for key, text in sensor.provenance.items() if key == 'noise_from'}
    bare = with_axes(
        replace(
            sensor.without_covariance(),
            model='nominal',
            effects=(),
            values={},
            provenance=measured,
        ),
        axes,
    )
    stated: dict[str, Any] = dict(info.nominal_values(axes))
    return replace(bare, serial=info.texts.get('serial', sensor.serial), rate_hz=rate_hz, **stated)


def nominal_of(
    sensor: Sensor, info: StreamInfo, axes: str | None = None, rate_hz: float | None = None
) -> Sensor:
    """Return the nominal sensor of a stream, whose serial number must not contradict `sensor`."""
    _check_serial(info, sensor)
    axes = axes or info.axes or sensor.axes
    nominal = uncalibrated(sensor, info, axes, rate_hz or info.rate_hz or sensor.rate_hz)
    return replace(nominal, serial=sensor.serial) if info.serial == NO_SERIAL else nominal
