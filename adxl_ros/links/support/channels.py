# SPDX-License-Identifier: Apache-2.0

"""What the channels of an ADC carry: axes of the sensor, its supply, a temperature."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
import time
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.links.support.base import Event, Samples
from adxl_ros.links.support.clock_sync import ClockMap, IdentityMap, SystemClockMap
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
    references: Mapping[str, np.ndarray]  # References that the device has, by column, (n,) each
    lost: int | None = None  # Samples lost before it; None where only time shows them


class PeriodMeans:
    """Replaces slow references by their means over 0.1 s, each at the next sample that comes."""

    def __init__(self, columns: Sequence[str]) -> None:
        """Begin without values."""
        self._held: dict[str, list[np.ndarray]] = {column: [] for column in columns}
        self._period = 0

    def thin(self, host_ns: np.ndarray, references: Mapping[str, np.ndarray]
             ) -> dict[str, np.ndarray]:
        """
        Return the means of all columns in the first row of a period, and NaN in other rows.

        host_ns: times of the samples, ns, (n,), ascending from call to call; references: values by
        column, (n,) each.
        """
        period = int(host_ns[-1]) // _PERIOD_NS
        means = dict.fromkeys(self._held, absent(len(host_ns)))
        if period != self._period:
            self._period = period
            for column, parts in self._held.items():
                values = np.concatenate([*parts, absent(1)])
                values = values[np.isfinite(values)]
                parts.clear()
                if len(values):
                    means[column] = np.full(len(host_ns), np.nan)
                    means[column][0] = values.mean()
        for column, values in references.items():
            self._held[column].append(values)
        return means


_FOLLOW_NS = 10_000_000
"""Time between two readings of the system clock, ns; chosen: a reading takes several microseconds,
and nobody sees a clock that was set 10 ms later."""
_FOREVER_NS = 2 ** 63 - 1
"""Largest time, ns: any waiting time is over by then."""


class Stamper:
    """Holds samples until the device's clock is known, stamps them and counts lost ones."""

    def __init__(self, clock: ClockMap | IdentityMap, references: Sequence[str]) -> None:
        """Begin without samples; `references` are the columns that all samples have."""
        self.clock = clock  # Map of the device's clock
        self.period_ns = 0.0  # Sample period, ns; 0 before the first `restart`
        self._system_clock = SystemClockMap()
        self._followed_ns = 0
        self._means = PeriodMeans(references)
        self._unstamped: list[Block] = []
        self._stamped: list[Samples] = []
        self._last_ns: int | None = None
        self._last_device_ns = 0
        self._new_clock = True
        self._counted = self._estimated = 0

    @property
    def waiting(self) -> bool:
        """Whether `take` would return samples."""
        return bool(self._stamped)

    def restart(self, period_ns: float) -> None:
        """Begin a new clock or device; time gives an estimate of the samples lost before."""
        self.step()
        self.period_ns = period_ns
        self._new_clock = True

    def step(self) -> None:
        """Begin a new clock for samples that follow the previous ones without a loss."""
        self.flush()
        self.clock.restart()

    def add(self, block: Block, arrived_ns: int) -> None:
        """Take samples."""
        newest_ns = int(block.device_ns[-1])
        stepped = self.clock.observe(newest_ns, arrived_ns)
        if block.lost is None:
            self._new_clock |= stepped
            if not self._new_clock:
                steps_ns = np.diff(block.device_ns, prepend=self._last_device_ns)
                self._estimated += sum(max(round(step_ns / self.period_ns) - 1, 0)
                                       for step_ns in steps_ns.tolist())
            self._last_device_ns = newest_ns
        else:
            self._counted += block.lost
        self._unstamped.append(block)
        if self.clock.ready(arrived_ns):
            self._stamp()

    def flush(self) -> None:
        """Stamp all samples now, by what is known of the clock."""
        if self._unstamped:
            self.clock.ready(_FOREVER_NS)
            self._stamp()

    def take(self) -> Samples | None:
        """Return the samples stamped since the last call; None without any."""
        if self._unstamped and self.clock.ready(time.monotonic_ns()):
            self._stamp()
        if not self._stamped:
            return None
        parts, self._stamped = self._stamped, []
        if len(parts) == 1:
            return parts[0]
        return Samples(
            np.concatenate([part.stamp_ns for part in parts]),
            np.concatenate([part.volts for part in parts]),
            time.time_ns(), sum(part.missing for part in parts),
            {name: np.concatenate([part.references[name] for part in parts])
             for name in parts[0].references},
            sum(part.estimated for part in parts))

    def statistics(self) -> dict[str, Any]:
        """Return how the clocks work, as diagnostics show it."""
        clock = self.clock
        return {'clock': 'settled' if clock.settled else 'settling',
                'clock_drift_ppm': round(clock.drift_ppm, 2),
                'clock_jitter_us': round(clock.jitter_ns * 1e-3, 1),
                'clock_steps': clock.steps, 'system_clock_steps': self._system_clock.steps}

    def events(self) -> tuple[Event, Event]:
        """Return the events of the clocks, for the status of a link."""
        return (Event('the clock of the device has stepped: a new map of it begins',
                      self.clock.steps),
                Event('the system clock was set: the stamps follow it', self._system_clock.steps))

    def _stamp(self) -> None:
        """Stamp the waiting samples, with the number of samples that are missing before them."""
        now_ns = time.monotonic_ns()
        if now_ns - self._followed_ns >= _FOLLOW_NS:
            self._followed_ns = now_ns
            self._system_clock.update()
        for block in self._unstamped:
            host_ns = self.clock.host_ns(block.device_ns)
            if self._new_clock and self._last_ns is not None:
                periods = (int(host_ns[0]) - self._last_ns) / self.period_ns
                self._estimated += max(round(periods) - 1, 0)
            self._new_clock = False
            self._last_ns = int(host_ns[-1])
            self._stamped.append(Samples(
                self._system_clock.ros_ns(host_ns), block.volts, time.time_ns(),
                self._counted + self._estimated, self._means.thin(host_ns, block.references),
                self._estimated))
            self._counted = self._estimated = 0
        self._unstamped.clear()
