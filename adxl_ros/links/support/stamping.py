# SPDX-License-Identifier: Apache-2.0

"""Stamps of samples: by the clock of a device, in ROS time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import time
from typing import Any

from adxl_ros.files.column_mapping import Columns
from adxl_ros.links.support.base import Event, FOREVER_NS, no_samples, Samples
from adxl_ros.links.support.clock_map import ClockState, DeviceClock, MAX_UNCERTAINTY_NS
from adxl_ros.model.sensor import Sensor
import numpy as np

_STEP_NS = 1_000_000
"""Change of the system clock's offset that counts as a step, ns. Chosen: slewing by NTP is slower.
"""
_TRIES = 3  # Readings of which the least interrupted one counts
_PERIOD_NS = 100_000_000
"""Time between two means of supply and temperature, ns. Chosen: both change slowly."""
_FOLLOW_NS = 10_000_000
"""Time between two readings of the system clock, ns; chosen: a reading takes several microseconds,
and nobody sees a clock that was set 10 ms later."""


def _system_offset() -> tuple[int, int]:
    """Return uncertainty and offset of the system clock from the monotonic clock, ns."""
    readings = []
    for _ in range(_TRIES):
        before_ns = time.monotonic_ns()
        system_ns = time.time_ns()
        after_ns = time.monotonic_ns()
        readings.append((after_ns - before_ns, system_ns - (before_ns + after_ns) // 2))
    return min(readings)


@dataclass(frozen=True)
class Block:
    """Samples as a device sends them."""

    device_ns: np.ndarray  # Device time, ns, (n,) int64, ascending
    volts: np.ndarray  # Output of the sensor by axis, V, (n, m)
    references: Columns  # References that the device has, by column, (n,) each
    lost: int | None = None  # Samples lost before it; None where only time shows them
    in_self_test: bool = False  # Whether a self-test of the sensor has changed them


class Stamper:
    """Holds samples until the device's clock is known, stamps them and counts lost ones."""

    def __init__(self, clock: DeviceClock, references: Sequence[str]) -> None:
        self.clock = clock  # Map of the device's clock
        self.period_ns = 0.0  # Sample period, ns; 0 before the first `restart`
        # ROS time, the system clock, beyond the monotonic clock, which is never set, ns
        self._ros_offset_ns = _system_offset()[1]
        self._system_steps = self._followed_ns = 0
        self._references = references
        self._period = 0
        self._unstamped: list[Block] = []
        self._stamped: list[Samples] = []
        self._last_ns: int | None = None
        self._last_device_ns = 0
        self._new_clock = True
        self._counted = self._estimated = 0

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
                self._estimated += sum(
                    max(round(step_ns / self.period_ns) - 1, 0) for step_ns in steps_ns.tolist()
                )
            self._last_device_ns = newest_ns
        else:
            self._counted += block.lost
        self._unstamped.append(block)
        if self.clock.advance(arrived_ns):
            self._stamp()

    def flush(self) -> bool:
        """Stamp all samples now, by what is known of the clock; return whether there are any."""
        if self._unstamped:
            self.clock.advance(FOREVER_NS)
            self._stamp()
        return bool(self._stamped)

    def take(self, sensor: Sensor) -> Samples:
        """Return the samples of a sensor that were stamped since the last call."""
        if self._unstamped and self.clock.advance(time.monotonic_ns()):
            self._stamp()
        if not self._stamped:
            return no_samples(sensor, time.time_ns())
        parts = self._stamped
        self._stamped = []
        marks = np.concatenate([part.in_self_test for part in parts])
        return Samples(
            stamp_ns=np.concatenate([part.stamp_ns for part in parts]),
            volts=np.concatenate([part.volts for part in parts]),
            until_ns=time.time_ns(),
            missing=sum(part.missing for part in parts),
            references={
                name: np.concatenate([part.references[name] for part in parts])
                for name in parts[0].references
            },
            estimated=sum(part.estimated for part in parts),
            in_self_test=marks if marks.any() else None,
        )

    def statistics(self) -> dict[str, Any]:
        """Return how the clocks work, as diagnostics show it."""
        clock = self.clock
        return {
            'clock': 'settling' if clock.state is ClockState.SETTLING else 'settled',
            'clock_drift_ppm': round(clock.drift_ppm, 2),
            'clock_jitter_us': round(clock.jitter_ns * 1e-3, 1),
            'clock_steps': clock.steps,
            'system_clock_steps': self._system_steps,
        }

    def events(self) -> tuple[Event, Event]:
        """Return the events of the clocks, for the status of a link."""
        return (
            Event('the clock of the device has stepped: a new map of it begins', self.clock.steps),
            Event('the system clock was set: the stamps follow it', self._system_steps),
        )

    def _stamp(self) -> None:
        """Stamp the waiting samples, with the number of samples that are missing before them."""
        now_ns = time.monotonic_ns()
        if now_ns - self._followed_ns >= _FOLLOW_NS:
            self._followed_ns = now_ns
            uncertainty_ns, offset_ns = _system_offset()
            if uncertainty_ns <= MAX_UNCERTAINTY_NS:
                self._system_steps += abs(offset_ns - self._ros_offset_ns) >= _STEP_NS
                self._ros_offset_ns = offset_ns
        for block in self._unstamped:
            host_ns = self.clock.host_ns(block.device_ns)
            if self._new_clock and self._last_ns is not None:
                periods = (int(host_ns[0]) - self._last_ns) / self.period_ns
                self._estimated += max(round(periods) - 1, 0)
            self._new_clock = False
            self._last_ns = int(host_ns[-1])
            self._stamped.append(
                Samples(
                    stamp_ns=host_ns + self._ros_offset_ns,
                    volts=block.volts,
                    until_ns=time.time_ns(),
                    missing=self._counted + self._estimated,
                    references=self._thin(host_ns, block.references),
                    estimated=self._estimated,
                    in_self_test=np.full(len(host_ns), block.in_self_test),
                )
            )
            self._counted = self._estimated = 0
        self._unstamped.clear()

    def _thin(self, host_ns: np.ndarray, references: Columns) -> dict[str, np.ndarray]:
        """Return each reference by its mean in the first row after a period, and NaN elsewhere."""
        thinned = {column: np.full(len(host_ns), np.nan) for column in self._references}
        if (period := int(host_ns[-1]) // _PERIOD_NS) != self._period:
            self._period = period
            for column, values in references.items():
                thinned[column][0] = values.mean()
        return thinned
