# SPDX-License-Identifier: Apache-2.0

"""What the channels of an ADC carry: axes of the sensor, its supply, a temperature."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
import time

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


_FOLLOW_NS = 10_000_000
"""Time between two readings of the system clock, ns; chosen: a reading takes several microseconds,
and nobody sees a clock that was set 10 ms later."""
_FOREVER_NS = 2 ** 63 - 1
"""Largest time, ns: any waiting time is over by then."""


@dataclass(frozen=True)
class ClockStatistics:
    """How the clocks work, as diagnostics show it."""

    clock: str  # `settled` or `settling`
    clock_drift_ppm: float  # Drift of the device's clock against the host's, ppm
    clock_jitter_us: float  # Median distance of the earliest arrivals from the line of the map, µs
    clock_steps: int  # How often the device's clock has stepped
    system_clock_steps: int  # How often the system clock was set


def clock_events(clock: ClockStatistics) -> tuple[Event, Event]:
    """Return the events of the clocks, for the status of a link."""
    return (Event('the clock of the device has stepped: a new map of it begins',
                  clock.clock_steps),
            Event('the system clock was set: the stamps follow it', clock.system_clock_steps))


class Stamper:
    """Holds samples until the device's clock is known, stamps them and counts lost ones."""

    def __init__(self, clock: ClockMap | IdentityMap) -> None:
        """Begin without samples."""
        self.clock = clock  # Map of the device's clock
        self.period_ns = 0.0  # Sample period, ns; 0 before the first `restart`
        self._system_clock = SystemClockMap()
        self._followed_ns = 0
        self._means = PeriodMeans()
        self._unstamped: list[Block] = []
        self._stamped: list[Samples] = []
        self._last_ns: int | None = None
        self._last_device_ns: int | None = None
        self._new_clock = True
        self._counted = self._estimated = 0

    @property
    def waiting(self) -> bool:
        """Whether `take` would return samples."""
        return bool(self._stamped)

    def restart(self, period_ns: float) -> None:
        """Begin a new clock or device; time gives an estimate of the samples lost before."""
        self.flush()
        self.clock.restart()
        self.period_ns = period_ns
        self._new_clock = True

    def step(self) -> None:
        """Begin a new clock for samples that follow the previous ones without a loss."""
        self.flush()
        self.clock.restart()

    def add(self, block: Block, arrived_ns: int, lost: int | None) -> None:
        """Take samples."""
        stepped = self.clock.observe(int(block.device_ns[-1]), arrived_ns)
        if lost is None:
            self._new_clock |= stepped
            if not self._new_clock:
                self._estimated += self._gaps(block.device_ns)
            self._last_device_ns = int(block.device_ns[-1])
        else:
            self._counted += lost
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

    def statistics(self) -> ClockStatistics:
        """Return how the clocks work."""
        clock = self.clock
        return ClockStatistics(
            'settled' if clock.settled else 'settling', round(clock.drift_ppm, 2),
            round(clock.jitter_ns * 1e-3, 1), clock.steps, self._system_clock.steps)

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

    def _gaps(self, device_ns: np.ndarray) -> int:
        """Count the samples that are missing by the device's stamps."""
        assert self._last_device_ns is not None, 'gaps are counted after a first block'
        before_ns, missing = self._last_device_ns, 0
        for stamp_ns in device_ns.tolist():
            missing += max(round((stamp_ns - before_ns) / self.period_ns) - 1, 0)
            before_ns = stamp_ns
        return missing
