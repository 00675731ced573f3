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

"""What the channels of an ADC are: axes of the sensor, its supply, a temperature."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from adxl_ros.errors import UserError
from adxl_ros.links.support.base import Option
from adxl_ros.model.constants import AXES
from adxl_ros.model.sensor import Sensor
import numpy as np

SUPPLY, TEMPERATURE, UNUSED = 'supply', 'temperature', '-'
ROLES = (*AXES, SUPPLY, TEMPERATURE)

SUPPLY_SCALE = Option('supply_scale', 1.0, "supply by the volts of its channel: its divider's",
                      'V/V', 1e-3, 1e3)

_PERIOD_NS = 100_000_000
"""Supply and temperature change slowly: the mean of so long is published once."""
_COLUMNS = {SUPPLY: 'supply_v', TEMPERATURE: 'temperature_c'}


def listed(value: str | Sequence[str]) -> list[str]:
    """
    Read `link.channels`: a list of strings, or one string with commas.

    The string is for the command line, where YAML would take a bare y in a list for a boolean.
    """
    parts = value.split(',') if isinstance(value, str) else value
    if not isinstance(parts, Sequence) or not all(isinstance(part, str) for part in parts):
        raise UserError(f'link.channels: {value!r} is not a list of strings')
    return [part.strip() for part in parts if part.strip()]


def check_roles(roles: Sequence[str], axes: str) -> None:
    """
    Refuse channels that a sensor with these axes cannot be read from.

    Raises
    ------
    UserError
        A role is unknown, there twice, or no axis of the sensor; or an axis has no channel.

    """
    for role in roles:
        if role not in (*ROLES, UNUSED):
            raise UserError(f'link.channels: {role!r} is none of {", ".join(ROLES)}, or - for '
                            'a channel that is not used')
        if role != UNUSED and list(roles).count(role) > 1:
            raise UserError(f'link.channels: {role} is there twice')
        if role in AXES and role not in axes:
            raise UserError(f'link.channels: the sensor has no axis {role}: sensor.axes is {axes}')
    lacking = [axis for axis in axes if axis not in roles]
    if lacking:
        raise UserError(f'link.channels: no channel for {", ".join(lacking)}: the channels are '
                        f'{", ".join(roles) or "none"}, sensor.axes is {axes}')


def references_of(roles: Sequence[str]) -> tuple[str, ...]:
    """Name the columns that the channels give beside the axes."""
    return tuple(column for role, column in _COLUMNS.items() if role in roles)


def split(values: Mapping[str, np.ndarray], sensor: Sensor, columns: Sequence[str],
          supply_scale: float) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """
    Return the volts by axis, (n, m), and the references by column, (n,) each.

    Parameters
    ----------
    values
        By role, (n,) each.
    sensor
        Whose axes.
    columns
        References that are asked for; NaN where no channel gives them.
    supply_scale
        Supply by the volts of its channel.

    """
    volts = np.column_stack([values[axis] for axis in sensor.axes])
    beside = {column: np.full(len(volts), np.nan) for column in columns}
    beside |= {column: values[role] * (supply_scale if role == SUPPLY else 1.0)
               for role, column in _COLUMNS.items() if role in values}
    return volts, beside


class Seldom:
    """Thins out what changes slowly: means of 0.1 s, each at the next sample; NaN between."""

    def __init__(self) -> None:
        """Begin without a mean."""
        self._sums: dict[str, tuple[float, int]] = {}
        self._period = 0

    def __call__(self, host_ns: np.ndarray, columns: Mapping[str, np.ndarray]
                 ) -> dict[str, np.ndarray]:
        """Return the columns, (n,), with means in a few rows and NaN in the others."""
        thin = {name: np.full(len(host_ns), np.nan) for name in columns}
        periods = host_ns // _PERIOD_NS
        begins = np.flatnonzero(np.diff(periods, prepend=self._period))
        self._period = int(periods[-1])
        for name, values in columns.items():
            total, count = self._sums.get(name, (0.0, 0))
            for begin, part in zip([0, *begins], np.split(values, begins)):
                if begin in begins:
                    if count:
                        thin[name][begin] = total / count
                    total, count = 0.0, 0
                known = part[np.isfinite(part)]
                total, count = total + float(known.sum()), count + len(known)
            self._sums[name] = total, count
        return thin
