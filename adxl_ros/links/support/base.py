# SPDX-License-Identifier: Apache-2.0

"""
What a link is: a source of samples; how it waits for a device, and what its channels carry.

Each module of the package `links` is one link, found by its file name. It holds the dataclass
`Settings` and the function `open_link`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
import os
import pkgutil
import time
from typing import Any, cast, Protocol, runtime_checkable

from adxl_ros.errors import one_line, UserError
from adxl_ros.files.column_mapping import Columns
from adxl_ros.model.sensor import Sensor
from adxl_ros.report.level import Level
import numpy as np

DEFAULT_LINK = 'sim'
"""Link of a driver whose parameters name neither a link nor a unit: it simulates a sensor."""

_LINKS = 'adxl_ros.links'
"""Package whose modules are the links; its folder `support` holds no link."""
_MAX_SHARE = 1e-3
"""Largest share of a sample that a latency may lack: a float32 of a firmware is not exact."""
FOREVER_NS = 2**63 - 1  # Largest time, ns: nothing bounds it
_FIRST_S = 0.01  # First waiting time, s; each failure doubles it
_LONGEST_S = 0.08  # Longest waiting time, s: a device that is back is noticed within it
_SLOW_S = 1.0  # Waiting time for a device that is there but does not fit the parameters, s
_MAX_WAIT_S = 0.05  # Longest wait of one call, s, so that the driver reacts to its end
SUPPLY = 'supply'  # Role of the channel with the supply voltage
TEMPERATURE = 'temperature'  # Role of the channel with the temperature
UNUSED = '-'  # Role of a channel that is not read
COLUMNS = {SUPPLY: 'supply_v', TEMPERATURE: 'temperature_c'}
"""Column of a recording by the role of a reference channel."""


def option(
    default: bool | int | float | str | tuple[()],
    doc: str,
    unit: str = '',
    lower: float | None = None,
    upper: float | None = None,
) -> Any:
    """
    Declare a field of a link's `Settings`, which is the parameter `link.<name>` of the driver.

    Its type is that of the default; an empty tuple stands for a list of strings, or one string
    with commas. The permitted range is in `unit`.
    """
    return field(
        default=default, metadata={'doc': doc, 'unit': unit, 'lower': lower, 'upper': upper}
    )


@dataclass(frozen=True)
class LatencySettings:
    """Settings of every link of this package."""

    latency_ms: float = option(
        2.0,
        'longest time for which samples are collected before they '
        'are passed on together; 0: each sample alone',
        'ms',
        0.0,
        1000.0,
    )

    def samples_together(self, rate_hz: float) -> int:
        """Return how many samples at a rate, Hz, are passed on together."""
        return samples_within(self.latency_ms * 1e-3, rate_hz)


@dataclass(frozen=True)
class PacedSettings(LatencySettings):
    """Settings of a link that makes its own time."""

    speed: float = option(
        1.0, 'sensor time by real time; other than 1 the driver publishes /clock', '', 0.01, 1000.0
    )


@dataclass(frozen=True)
class DeviceSettings(LatencySettings):
    """Settings of a link that reads a device."""

    delay: float = option(0.0, 'shortest time from a sample to its arrival', 's', 0.0, 1.0)
    supply_scale: float = option(
        1.0,
        'supply voltage by the voltage of its channel: the ratio of its divider',
        'V/V',
        1e-3,
        1e3,
    )


@dataclass(frozen=True)
class SimulatorSettings:
    """Settings of a link whose samples have time and frame of a simulator."""


def samples_within(latency_s: float, rate_hz: float) -> int:
    """Return how many samples at a rate, Hz, are collected within a time, s: at least one."""
    return max(int(latency_s * rate_hz + _MAX_SHARE), 1)


@dataclass(frozen=True)
class Event:
    """Something that happens to a device now and then."""

    message: str  # What a user is told
    count: int  # How often it has happened


@dataclass(frozen=True)
class LinkStatus:
    """How a link works."""

    level: Level  # How well
    text: str  # Some words, or one line with the reason; it changes with the condition only
    statistics: Mapping[str, Any] = field(default_factory=dict)  # Counts by name
    events: tuple[Event, ...] = ()  # Events that are logged when their count rises


@dataclass(frozen=True)
class Samples:
    """What one read of a link returns."""

    stamp_ns: np.ndarray  # Times of the samples, ns, (n,) int64, ascending
    volts: np.ndarray  # Output of the sensor by axis, V, (n, m), finite
    until_ns: int  # Time up to which the link has no further samples, ns
    missing: int = 0  # Samples lost since the last call
    # References by the column names of a recording, (n,) each; NaN where a reference was not
    # sampled
    references: Columns = field(default_factory=dict)
    estimated: int = 0  # Part of `missing` that is estimated from time, not counted
    # Further fields of sensor_msgs/Imu by name, (n, k) each, such as `angular_velocity`
    imu_fields: Columns = field(default_factory=dict)
    # Samples that a self-test of the sensor has changed, (n,) bool; None for none
    in_self_test: np.ndarray | None = None

    def finite(self) -> Samples:
        """Return the samples whose volts are finite; others are missing."""
        finite = np.isfinite(self.volts)
        if finite.all():
            return self
        rows = finite.all(axis=1)
        return replace(self.where(rows), missing=self.missing + int((~rows).sum()))

    def where(self, rows: np.ndarray) -> Samples:
        """Return some of the samples."""
        return replace(
            self,
            stamp_ns=self.stamp_ns[rows],
            volts=self.volts[rows],
            references={name: values[rows] for name, values in self.references.items()},
            imu_fields={name: values[rows] for name, values in self.imu_fields.items()},
            in_self_test=None,
        )


def no_samples(sensor: Sensor, until_ns: int) -> Samples:
    """Return no samples of a sensor, up to a time, ns."""
    return Samples(np.zeros(0, np.int64), np.zeros((0, len(sensor.axes))), until_ns)


class Link(Protocol):
    """A source of samples, as `open_link` returns it; the defaults are those of a device."""

    # Sensor that makes the samples readable; None until the device has described itself
    sensor: Sensor | None = None
    # Whether a device sends the samples. Then `read` waits for them for about 50 ms and their
    # stamps are final. Otherwise `read` returns at once what is due.
    live: bool = True
    references: tuple[str, ...] = ()  # Names of the references that come with the samples
    waits_for_listener: bool = False  # Whether the first sample waits for the first subscriber
    # Time of the first sample, ns, where the link has a time of its own; else None
    start_ns: int | None = None

    def begin(self, now_ns: int) -> int:
        """Make the next sample due now, also after a jump of the clock; return the lost ones."""
        return 0

    def read(self, now_ns: int) -> Samples:
        """Return the samples that are due; raises `UserError` when there will be no more."""

    def status(self) -> LinkStatus:
        """
        Return how the link works.

        Another thread may ask while the samples of the last read are not published yet. A link
        that ends says so after the next read, so that the end comes after its samples.
        """

    def hold_self_test(self, hold_s: float) -> None:
        """
        Keep the self-test of the sensor on for a time from now, s; 0 ends it.

        `read` marks the samples that it changes. Raises `UserError` where the link has none.
        """
        raise UserError(
            'this link reaches no self-test of a sensor; serial (a board that has its line) and '
            'sim do'
        )

    def close(self) -> None:
        """Close what the link holds open."""
        return


@runtime_checkable
class StageLink(Protocol):
    """A link whose sensor senses the motion of the stage."""

    joint_state_topic: str  # Topic with the true motion of the stage

    def sense_stage(
        self, stamp_ns: int, position: Mapping[str, float], velocity: Mapping[str, float]
    ) -> None:
        """Take the true motion of named joints, in rad, m and s, at a stamp that may lie ahead."""


@runtime_checkable
class ImuLink(Protocol):
    """A link that gets the ideal samples of a simulator."""

    imu_topic: str  # Topic of the ideal sensor_msgs/Imu
    imu_unit: str  # Unit of its accelerations, a key of `GRAVITY`
    temperature_topic: str  # Topic of the temperature of the sensor

    def sense_imu(self, stamp_ns: np.ndarray, fields: Columns) -> None:
        """Take samples: stamps, ns, (n,), and number fields of sensor_msgs/Imu, (n, k) each."""

    def sense_temperature(self, temperature_c: float) -> None:
        """Use a temperature, °C, from the next sample on."""

    def sense_publishers(self, count: int, mixture: str) -> None:
        """Take how many nodes publish the samples, and that several mix, in words, or ''."""


class LinkModule(Protocol):
    """What a module of `links` contains."""

    Settings: type  # Frozen dataclass whose fields are declared by `option`

    def open_link(self, sensor: Sensor, settings: Any) -> Link:
        """Open the link; raise `UserError` for settings that cannot work. `read` opens devices."""


def link_names() -> tuple[str, ...]:
    """Return the names of all links, the default one first."""
    modules = pkgutil.iter_modules(import_module(_LINKS).__path__)
    names = [module.name for module in modules if not module.ispkg]
    return tuple(sorted(names, key=lambda name: (name != DEFAULT_LINK, name)))


def link_module(name: str) -> LinkModule:
    """Import the module of a link."""
    return cast(LinkModule, import_module(f'{_LINKS}.{name}'))


def reason(error: Exception) -> str:
    """Return why a device does not open, in one line; error numbers of libiio are negative."""
    code = getattr(error, 'errno', None)
    return os.strerror(abs(code)) if code else one_line(error)


class Backoff:
    """An exponential back-off that a success resets."""

    def __init__(self) -> None:
        self._wait_s = _FIRST_S
        self._due_s = 0.0

    def wait(self) -> bool:
        """Wait for the next attempt, at most 50 ms; return whether it is due."""
        remaining_s = self._due_s - time.monotonic()
        if remaining_s > 0:
            time.sleep(min(remaining_s, _MAX_WAIT_S))
        return remaining_s <= _MAX_WAIT_S

    def fail(self, slow: bool = False) -> None:
        """Schedule the next attempt; `slow` where an early one is not likely to help."""
        self._due_s = time.monotonic() + (_SLOW_S if slow else self._wait_s)
        self._wait_s = min(2 * self._wait_s, _LONGEST_S)

    def reset(self) -> None:
        """Retry soon after the next failure."""
        self._wait_s = _FIRST_S


class Watchdog:
    """
    Measures for how long nothing has come, in time during which the node could listen.

    A turn counts as `longest_turn_s` at most: a node that was held up finds its messages waiting.
    """

    def __init__(self, longest_turn_s: float) -> None:
        self._longest_turn_s = longest_turn_s
        self._checked_s = time.monotonic()
        self.silent_s = 0.0  # Time without a message until the last check

    def feed(self) -> None:
        """Note that a message has come; any thread may call this."""
        self.silent_s = 0.0

    def check(self) -> float:
        """Return for how long nothing has come, s; to be called in every turn of the node."""
        now_s = time.monotonic()
        self.silent_s += min(now_s - self._checked_s, self._longest_turn_s)
        self._checked_s = now_s
        return self.silent_s


def parse_channels(value: str | Sequence[str]) -> list[str]:
    """Parse `link.channels`: a list, or a string with commas, as YAML reads a bare y as true."""
    parts = value.split(',') if isinstance(value, str) else value
    if not isinstance(parts, Sequence) or not all(isinstance(part, str) for part in parts):
        raise UserError(f'link.channels: {value!r} is not a list of strings')
    return [part.strip() for part in parts if part.strip()]


def check_roles(roles: Sequence[str], axes: str) -> None:
    """Check that the channels make a sensor readable."""
    used = [role for role in roles if role != UNUSED]
    if not set(axes) <= set(used) <= {*axes, SUPPLY, TEMPERATURE} or len(set(used)) < len(used):
        raise UserError(
            f'link.channels: the channels are {", ".join(roles) or "none"}; expected each of '
            f'{", ".join(axes)} (sensor.axes) once, supply and temperature at most once, and - '
            'for a channel that is not used'
        )
