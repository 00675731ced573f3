# SPDX-License-Identifier: Apache-2.0

"""What the channels of an ADC carry: axes of the sensor, its supply, a temperature."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

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
_KEPT_COUNTS = 8
"""Numbers of samples for which absent values are kept. Chosen: a device has one or two."""


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
    """Check that the channels make a sensor readable."""
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


@lru_cache(_KEPT_COUNTS)
def absent(count: int) -> np.ndarray:
    """Return values that are not there: NaN, (count,), not to be written."""
    values = np.full(count, np.nan)
    values.flags.writeable = False
    return values


@dataclass(frozen=True)
class Block:
    """Samples as a device sends them."""

    device_ns: np.ndarray  # Device time, ns, (n,) int64, ascending
    volts: np.ndarray  # Output of the sensor by axis, V, (n, m)
    references: Mapping[str, np.ndarray]  # References by column, (n,) each


@dataclass(frozen=True)
class Layout:
    """How the channels of a device become samples."""

    axes: str  # Axes of the sensor
    columns: tuple[str, ...]  # Columns of the references; NaN where no channel has them
    supply_scale: float  # Supply voltage by the voltage of its channel, V/V

    def block(self, device_ns: np.ndarray, values: Mapping[str, np.ndarray]) -> Block:
        """
        Arrange the values of channels as samples.

        device_ns: device time, ns, (n,) int64, ascending; values: volts, or degC for the
        temperature, by role, (n,) each.
        """
        volts = np.array([values[axis] for axis in self.axes]).T
        references = {column: absent(len(device_ns)) for column in self.columns}
        if SUPPLY in values:
            references[COLUMNS[SUPPLY]] = values[SUPPLY] * self.supply_scale
        if TEMPERATURE in values:
            references[COLUMNS[TEMPERATURE]] = values[TEMPERATURE]
        return Block(device_ns, volts, references)


class PeriodMeans:
    """Replaces slow references by their means over 0.1 s, each at the first sample after it."""

    def __init__(self) -> None:
        """Begin without values."""
        self._parts: dict[str, list[np.ndarray]] = {}
        self._period = 0

    def thin(self, host_ns: np.ndarray, references: Mapping[str, np.ndarray]
             ) -> dict[str, np.ndarray]:
        """
        Return the means in a few rows, and NaN in the others.

        host_ns: times of the samples, ns, (n,), ascending from call to call; references:
        references by column, (n,) each; returns: means by column, (n,) each.
        """
        begins: list[int] = []
        if int(host_ns[-1]) // _PERIOD_NS != self._period:
            periods = host_ns // _PERIOD_NS
            begins = np.flatnonzero(np.diff(periods, prepend=self._period)).tolist()
            self._period = int(periods[-1])
        means = {}
        for column, values in references.items():
            means[column] = np.full(len(host_ns), np.nan) if begins else absent(len(host_ns))
            parts = self._parts.setdefault(column, [])
            stops = [*begins, len(values)]
            parts.append(values[:stops[0]])
            for begin, stop in zip(begins, stops[1:]):
                means[column][begin] = _finite_mean(parts)
                parts[:] = [values[begin:stop]]
        return means


def _finite_mean(parts: list[np.ndarray]) -> float:
    """Return the mean of the finite values of some arrays; NaN without any."""
    values = np.concatenate([*parts, np.zeros(0)])
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else np.nan
