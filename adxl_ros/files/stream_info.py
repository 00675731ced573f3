# SPDX-License-Identifier: Apache-2.0

"""What a stream states about its sensor: topic `sensor_info`, or the head of a CSV file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
import re

from adxl_ros.errors import UserError
from adxl_ros.model.sensor import Sensor
import numpy as np

FORMAT = '1'
"""Version of the recording format, the key `format`."""

NO_UNIT = 'nominal'
"""Serial number that stands for no particular unit."""

NOMINAL_KEYS = ('nominal_zero_g_v', 'nominal_scale_v_per_g')
"""Keys of the nominal values, V and V/g; each is a field of `Sensor`, too."""

_HIGHEST_RATE_HZ = 1e6
"""Sample rates from here on are refused, Hz (chosen: ten times the limit of a parameter file)."""


@dataclass(frozen=True)
class StreamInfo:
    """
    What a stream or recording states about its sensor. Every key may be missing.

    Values are checked when they are asked for: a wrong one matters only where it is needed.
    """

    texts: Mapping[str, str]  # Values by key, as text
    where: str  # The file or topic, for messages

    @property
    def format_version(self) -> str:
        """Return the version of the recording format."""
        return self.texts.get('format', FORMAT)

    @property
    def serial(self) -> str:
        """Return the serial number of the unit; `NO_UNIT` where none is stated."""
        return self.texts.get('serial', NO_UNIT)

    @property
    def axes(self) -> str | None:
        """Measured axes; None where they are not stated."""
        return self.texts.get('axes')

    @property
    def rate_hz(self) -> float | None:
        """Sample rate, Hz; None where it is not stated."""
        if 'rate_hz' not in self.texts:
            return None
        text = self.texts['rate_hz']
        try:
            rate_hz = float(text)
        except ValueError:
            rate_hz = 0.0
        if not 0 < rate_hz < _HIGHEST_RATE_HZ:
            raise UserError(f'{self.where}: rate_hz is {text!r}, expected samples a second')
        return rate_hz

    def nominal_values(self, axes: str) -> dict[str, np.ndarray]:
        """
        Return the nominal zero-g, V, and scale factor, V/g, as far as they are stated.

        returns: arrays (m,) by the name of the field of `Sensor`.
        """
        values = {}
        for key in NOMINAL_KEYS:
            if key in self.texts:
                numbers = _numbers(self.texts[key])
                if len(numbers) != len(axes) or not np.isfinite(numbers).all():
                    raise UserError(f'{self.where}: {key} is {self.texts[key]!r}, expected '
                                    f'{len(axes)} numbers, one for each axis')
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
        'nominal_zero_g_v': _listed(sensor.nominal_zero_g_v),
        'nominal_scale_v_per_g': _listed(sensor.nominal_scale_v_per_g),
        'rate_hz': repr(float(sensor.rate_hz)),
        'format': FORMAT,
    }


def _listed(values: np.ndarray) -> str:
    """Return numbers as text, each with all its digits."""
    return ', '.join(map(repr, np.asarray(values, dtype=float).tolist()))


def converted_info(texts: Mapping[str, str], sensor: Sensor) -> dict[str, str]:
    """Return what a recording states after a conversion by the nominal values of `sensor`."""
    unchanged = {key: texts[key] for key in ('serial', 'rate_hz') if key in texts}
    return {**texts, **sensor_info(sensor), **unchanged}
