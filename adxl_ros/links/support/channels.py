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

"""What the channels of an ADC carry: axes of the sensor, its supply, a temperature."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from adxl_ros.errors import UserError
from adxl_ros.model.constants import AXES
import numpy as np

SUPPLY = 'supply'
"""Role of the channel with the supply voltage."""
TEMPERATURE = 'temperature'
"""Role of the channel with the temperature."""
UNUSED = '-'
"""Role of a channel that is not read."""
ROLES = (*AXES, SUPPLY, TEMPERATURE)
"""All roles of channels that are read."""
COLUMNS = {SUPPLY: 'supply_v', TEMPERATURE: 'temperature_c'}
"""Column of a recording by the role of a reference channel."""

_PERIOD_NS = 100_000_000
"""Period of the means of supply and temperature, ns. Chosen: both change slowly."""


def parse_channels(value: str | Sequence[str]) -> list[str]:
    """
    Parse `link.channels`: a list of strings, or one string with commas.

    The string is for the command line, where YAML reads a bare y in a list as a boolean.
    """
    parts = value.split(',') if isinstance(value, str) else value
    if not isinstance(parts, Sequence) or not all(isinstance(part, str) for part in parts):
        raise UserError(f'link.channels: {value!r} is not a list of strings')
    return [part.strip() for part in parts if part.strip()]


def check_roles(roles: Sequence[str], axes: str) -> None:
    """
    Check that the channels make a sensor readable.

    Parameters
    ----------
    roles
        Roles of the channels.
    axes
        Axes of the sensor.

    Raises
    ------
    UserError
        A role is unknown, is there twice, or is no axis of the sensor; or an axis has no channel.

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


def reference_columns(roles: Sequence[str]) -> tuple[str, ...]:
    """Return the columns of the references among the roles."""
    return tuple(column for role, column in COLUMNS.items() if role in roles)


@dataclass(frozen=True)
class Block:
    """
    Samples as a device sends them.

    Attributes
    ----------
    device_ns
        Device time, ns, (n,) int64, ascending.
    volts
        Output of the sensor by axis, V, (n, m).
    references : Mapping
        References by column, (n,) each.

    """

    device_ns: np.ndarray
    volts: np.ndarray
    references: Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Layout:
    """
    How the channels of a device become samples.

    Attributes
    ----------
    axes
        Axes of the sensor.
    columns
        Columns of the references; NaN where no channel has them.
    supply_scale
        Supply voltage by the voltage of its channel, V/V.

    """

    axes: str
    columns: tuple[str, ...]
    supply_scale: float

    def block(self, device_ns: np.ndarray, values: Mapping[str, np.ndarray]) -> Block:
        """
        Arrange the values of channels as samples.

        Parameters
        ----------
        device_ns
            Device time, ns, (n,) int64, ascending.
        values
            Volts, or degC for the temperature, by role, (n,) each.

        Returns
        -------
        Block
            The samples.

        """
        volts = np.column_stack([values[axis] for axis in self.axes])
        references = {column: np.full(len(volts), np.nan) for column in self.columns}
        if SUPPLY in values:
            references[COLUMNS[SUPPLY]] = values[SUPPLY] * self.supply_scale
        if TEMPERATURE in values:
            references[COLUMNS[TEMPERATURE]] = values[TEMPERATURE]
        return Block(device_ns, volts, references)


@dataclass
class _RunningMean:
    """Mean of the finite values since the last one that was taken."""

    total: float = 0.0
    count: int = 0

    def add(self, values: np.ndarray) -> None:
        """Add the finite values of an array, (n,)."""
        finite = values[np.isfinite(values)]
        self.total += float(finite.sum())
        self.count += len(finite)

    def take(self) -> float:
        """Return the mean, NaN without a value, and begin a new mean."""
        mean = self.total / self.count if self.count else np.nan
        self.total, self.count = 0.0, 0
        return mean


class PeriodMeans:
    """Replaces slow references by their means over 0.1 s, each at the first sample after it."""

    def __init__(self) -> None:
        """Begin without values."""
        self._running: dict[str, _RunningMean] = {}
        self._period = 0

    def thin(self, host_ns: np.ndarray, references: Mapping[str, np.ndarray]
             ) -> dict[str, np.ndarray]:
        """
        Return the means in a few rows, and NaN in the others.

        Parameters
        ----------
        host_ns
            Times of the samples, ns, (n,), ascending from call to call.
        references : Mapping
            References by column, (n,) each.

        Returns
        -------
        dict
            Means by column, (n,) each.

        """
        periods = host_ns // _PERIOD_NS
        begins = np.flatnonzero(np.diff(periods, prepend=self._period))
        self._period = int(periods[-1])
        means = {}
        for column, values in references.items():
            running = self._running.setdefault(column, _RunningMean())
            means[column] = np.full(len(host_ns), np.nan)
            parts = np.split(values, begins)
            running.add(parts[0])
            for begin, part in zip(begins, parts[1:]):
                means[column][begin] = running.take()
                running.add(part)
        return means
