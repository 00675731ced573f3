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

"""Samples by device time, given stamps in ROS time; what lacks between them is counted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
import time
from typing import Any

from adxl_ros.links.support.base import Samples
from adxl_ros.links.support.channels import Seldom
from adxl_ros.links.support.clock_sync import ClockMap, HostStamps, RosClock
import numpy as np

_FOR_EVER_NS = 2 ** 63 - 1


@dataclass(frozen=True)
class Block:
    """
    Samples as they come from a device.

    Attributes
    ----------
    device_ns
        Device time, ns, (n,) int64, ascending.
    volts
        By axis, V, (n, m).
    references : mapping
        What was sampled beside the axes, (n,) by column.

    """

    device_ns: np.ndarray
    volts: np.ndarray
    references: Mapping[str, np.ndarray]


class Timeline:
    """
    Holds samples until the device's clock is known, and counts what is lost.

    Attributes
    ----------
    clock
        The map of the device's clock, or what stands in for it.

    """

    def __init__(self, clock: ClockMap | HostStamps) -> None:
        """Begin without samples."""
        self.clock = clock
        self.period_ns = 0.0
        self._ros = RosClock()
        self._seldom = Seldom()
        self._held: list[Block] = []
        self._given: list[Samples] = []
        self._last_ns: int | None = None
        self._last_device_ns: int | None = None
        self._new = True
        self._counted = self._estimated = 0

    @property
    def waiting(self) -> bool:
        """Whether there are samples that `take` would return."""
        return bool(self._given)

    def restart(self, period_ns: float) -> None:
        """
        Begin a new clock, or a new device; what was lost up to then is estimated by time.

        Parameters
        ----------
        period_ns
            Between two samples, ns.

        """
        self.flush()
        self.clock.restart()
        self.period_ns = period_ns
        self._new = True

    def step(self) -> None:
        """Begin a new clock for samples that follow on those before without a loss."""
        self.flush()
        self.clock.restart()

    def put(self, block: Block, arrived_ns: int, lost: int | None) -> None:
        """
        Take samples.

        Parameters
        ----------
        block
            The samples.
        arrived_ns
            When the newest was here, by the host's monotonic clock.
        lost
            How many lack before them; None where the device does not count.

        """
        stepped = self.clock.observe(int(block.device_ns[-1]), arrived_ns)
        if lost is None:
            self._new |= stepped
            if not self._new:
                self._estimated += self._gaps(block.device_ns)
            self._last_device_ns = int(block.device_ns[-1])
        else:
            self._counted += lost
        self._held.append(block)
        if self.clock.ready(arrived_ns):
            self._stamp()

    def flush(self) -> None:
        """Give what is held its stamps now, however little is known of the clock."""
        if self._held:
            self.clock.ready(_FOR_EVER_NS)
            self._stamp()

    def take(self) -> Samples | None:
        """Return what has got its stamps since the last call, if there is any."""
        if self._held and self.clock.ready(time.monotonic_ns()):
            self._stamp()
        if not self._given:
            return None
        given, self._given = self._given, []
        names = given[0].references
        return Samples(
            np.concatenate([s.stamp_ns for s in given]), np.concatenate([s.volts for s in given]),
            time.time_ns(), sum(s.missing for s in given),
            {name: np.concatenate([s.references[name] for s in given]) for name in names},
            sum(s.estimated for s in given))

    def values(self) -> dict[str, Any]:
        """Say for diagnostics how the clocks are."""
        clock = self.clock
        return {'clock': 'settled' if clock.settled else 'settling',
                'clock_drift_ppm': round(clock.drift_ppm, 2),
                'clock_jitter_us': round(clock.jitter_ns * 1e-3, 1),
                'clock_steps': clock.steps, 'system_clock_steps': self._ros.steps}

    def _stamp(self) -> None:
        self._ros.watch()
        for block in self._held:
            host_ns = self.clock(block.device_ns)
            if self._new and self._last_ns is not None:
                periods = (int(host_ns[0]) - self._last_ns) / self.period_ns
                self._estimated += max(round(periods) - 1, 0)
            self._new = False
            self._last_ns = int(host_ns[-1])
            self._given.append(Samples(
                self._ros(host_ns), block.volts, 0, self._counted + self._estimated,
                self._seldom(host_ns, block.references), self._estimated))
            self._counted = self._estimated = 0
        self._held.clear()

    def _gaps(self, device_ns: np.ndarray) -> int:
        """Count the samples that lack by the device's stamps."""
        steps = np.rint(np.diff(device_ns, prepend=self._last_device_ns) / self.period_ns)
        return int((steps - 1).clip(0).sum())
