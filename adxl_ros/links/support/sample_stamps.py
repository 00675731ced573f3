# SPDX-License-Identifier: Apache-2.0

"""Stamps in ROS time for samples with device time, and the number of samples that are missing."""

from __future__ import annotations

from dataclasses import dataclass
import time

from adxl_ros.links.support.base import Event, Samples
from adxl_ros.links.support.channels import Block, PeriodMeans
from adxl_ros.links.support.clock_sync import ClockMap, IdentityMap, SystemClockMap
import numpy as np

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
