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

"""
From the clock of a device to that of the host, and from there to ROS time.

A sample arrives later than it was taken, never earlier. So the line that goes below the arrivals,
close to the earliest of them, is the clock of the device seen on the host's: its offset and its
drift. Stamps follow that line smoothly, and never go backwards.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
import time

import numpy as np

_WINDOW_S = 0.5
_ENOUGH = 25
"""Arrivals that a window should have, for its earliest to be early ..."""
_LONGEST_WINDOW_S = 5.0
"""... unless that takes longer than this."""
_SPAN_S = 25.0
_FEW = 20
"""So many windows are kept however old they are."""
_FIRST_S = 0.15
_SETTLE_S = 0.06
"""Samples of the first clock, and of a later one, which must not keep a robot waiting, wait so
long for their stamps: of some arrivals one is early."""
_QUICK_S = 0.3
"""Within this the stamps of a new clock follow an arrival that is earlier than those before."""
_HORIZON_S = 2.0
"""Stamps approach a better line within this, so that its corrections are no jitter."""
_PRIOR_S2 = 1.0
"""That there is no drift counts like windows whose times have this sum of squares: a lateness of
0.2 ms is as likely as the 200 ppm of a crystal."""
_LATE = 0.1
"""Weight of an arrival above the line, one below it having 1: lateness says little."""
_EARLY_NS = 20e6
"""An arrival that is early by this shows that the device's clock has stepped forward."""
_SHIFT_NS = 20e6
"""A clock that has stepped back shows in two windows whose earliest are late alike."""
_STOOD_NS = 250e6
"""After an arrival that is late by this, the next ones tell whether the clock stood still."""
_SMOOTH_NS = 50e6
"""Differences up to this are taken up smoothly; a larger one forward is a step of the stamps."""
_BEND = 0.05
_HARD_BEND = 0.5
_LEAST_SLOPE = 1e-3
"""Stamps go forward, however fast a device that is none may send."""


@dataclass(frozen=True)
class _Window:
    """The earliest arrival of a window: device time, and its distance to host time, ns."""

    device_ns: int
    lag_ns: int


@dataclass
class _Doubt:
    """Arrivals that are far too late: the samples were on their way, or the clock stood still."""

    first_ns: int
    first_device_ns: int
    last_device_ns: int
    last_ns: int
    least_ns: int
    count: int = 1


class ClockMap:
    """
    Follows the clock of a device by the arrivals of its samples.

    Attributes
    ----------
    steps
        How often the device's clock has stepped, by what the arrivals show.
    drift_ppm
        How much slower the device's clock goes than the host's.
    jitter_ns
        Half of the windows' earliest arrivals are farther from the line than this.
    settled
        Whether samples get stamps: not in the first instants of a new clock.

    """

    def __init__(self, delay_s: float) -> None:
        """Begin; `delay_s` is what the link takes at least, from sample to arrival."""
        self.steps = 0
        self._delay_ns = round(delay_s * 1e9)
        self._out_ns: int | None = None
        self._settle_s = _FIRST_S
        self.restart()

    def restart(self) -> None:
        """Begin a new clock; stamps do not go back behind those that were given."""
        self.drift_ppm = self.jitter_ns = 0.0
        self.settled = False
        self._windows: deque[_Window] = deque()
        self._open: _Window | None = None
        self._opened_ns = self._seen_ns = self._count = 0
        self._first_arrived_ns: int | None = None
        self._doubt: _Doubt | None = None
        # The stamps' line: passes through a point, ns, with a slope.
        self._at_ns = self._to_ns = 0
        self._slope = 1.0

    def observe(self, device_ns: int, arrived_ns: int) -> bool:
        """
        Take an arrival; return whether the clock has stepped, and a new one has begun with it.

        Parameters
        ----------
        device_ns
            Device time of the newest sample that arrived.
        arrived_ns
            When that was, host time.

        """
        lag_ns = arrived_ns - self._delay_ns - device_ns
        if (self.settled and arrived_ns - self._delay_ns - self._line(device_ns) < -_EARLY_NS) \
                or self._shifted(lag_ns):
            self.steps += 1
            self.restart()
            self.observe(device_ns, arrived_ns)
            return True
        if self.settled and self._is_doubtful(device_ns, arrived_ns, lag_ns):
            return False
        if self._first_arrived_ns is None:
            self._first_arrived_ns = arrived_ns
        if self._open is None or lag_ns < self._open.lag_ns:
            if self._open is None:
                self._opened_ns, self._count = device_ns, 0
            self._open = _Window(device_ns, lag_ns)
            if self.settled and not self._windows:
                self._steer(device_ns, max(_QUICK_S, 2e-9 * (device_ns - self._seen_ns)))
        self._count += 1
        self._seen_ns = device_ns
        open_s = (device_ns - self._opened_ns) * 1e-9
        if (open_s >= _WINDOW_S and self._count >= _ENOUGH) or open_s >= _LONGEST_WINDOW_S:
            self._windows.append(self._open)
            self._open = None
            while len(self._windows) > _FEW \
                    and device_ns - self._windows[0].device_ns > _SPAN_S * 1e9:
                self._windows.popleft()
            self._steer(device_ns, max(_HORIZON_S, 2 * open_s))
        return False

    def ready(self, now_ns: int) -> bool:
        """Tell whether stamps can be given now."""
        if self._doubt is not None and self._doubt.count > 1 \
                and now_ns - self._doubt.first_ns >= _SETTLE_S * 1e9:
            self._resolve(self._doubt)
        if not self.settled and self._open is not None \
                and now_ns - self._first_arrived_ns >= self._settle_s * 1e9:
            self.settled = True
            self._settle_s = _SETTLE_S
            self._at_ns = self._open.device_ns
            self._to_ns = self._at_ns + self._fit(self._at_ns)
        return self.settled and self._doubt is None

    def __call__(self, device_ns: np.ndarray) -> np.ndarray:
        """Return host times, ns, (n,) int64, ascending with the device's and from call to call."""
        stamps = np.rint(self._line(device_ns)).astype(np.int64)
        if self._out_ns is not None and stamps[0] <= self._out_ns:
            # A new clock that begins behind the stamps of the old: go on from those.
            self._to_ns += self._out_ns + 1 - int(stamps[0])
            self._steer(int(device_ns[0]), _HORIZON_S)
            stamps = np.maximum(np.rint(self._line(device_ns)).astype(np.int64),
                                self._out_ns + 1 + np.arange(len(stamps)))
        self._out_ns = int(stamps[-1])
        return stamps

    def _line(self, device_ns: np.ndarray | int) -> np.ndarray | float:
        return self._to_ns + (device_ns - self._at_ns) * self._slope

    def _steer(self, device_ns: int, horizon_s: float) -> None:
        """Let the stamps go on from where they are, to meet the best line at the horizon."""
        here_ns = round(self._line(device_ns))
        ahead_ns = round(horizon_s * 1e9)
        off_ns = device_ns + self._fit(device_ns) - here_ns
        if off_ns > _SMOOTH_NS:
            here_ns, off_ns = here_ns + off_ns, 0
        bend = _BEND if abs(off_ns) < _SMOOTH_NS else _HARD_BEND
        slope = (device_ns + ahead_ns + self._fit(device_ns + ahead_ns) - here_ns) / ahead_ns
        drift = 1 + self.drift_ppm * 1e-6
        self._slope = max(min(max(slope, drift - bend), drift + bend), _LEAST_SLOPE)
        self._at_ns, self._to_ns = device_ns, here_ns

    def _fit(self, device_ns: int) -> int:
        """Return how far host time is ahead of a device time by the windows, ns."""
        windows = [*self._windows] or [self._open]
        origin = windows[-1]
        at_s = np.array([w.device_ns - origin.device_ns for w in windows]) * 1e-9
        lag_ns = np.array([w.lag_ns - origin.lag_ns for w in windows], float)
        weight = np.ones(len(windows))
        offset_ns = slope = 0.0
        for _ in range(8):
            mean_s = np.average(at_s, weights=weight)
            mean_ns = np.average(lag_ns, weights=weight)
            spread = weight @ (at_s - mean_s) ** 2
            slope = weight @ ((at_s - mean_s) * (lag_ns - mean_ns)) / (spread + _PRIOR_S2)
            offset_ns = mean_ns - slope * mean_s
            off = lag_ns - offset_ns - slope * at_s
            weight = np.where(off > 0, _LATE, 1.0)
            self.jitter_ns = float(np.median(np.abs(off)))
        self.drift_ppm = float(slope) * 1e-3
        ahead_s = (device_ns - origin.device_ns) * 1e-9
        return origin.lag_ns + round(offset_ns + slope * ahead_s)

    def _is_doubtful(self, device_ns: int, arrived_ns: int, lag_ns: int) -> bool:
        """Keep an arrival that is far too late out of the windows, until the next ones tell."""
        late_ns = arrived_ns - self._delay_ns - self._line(device_ns)
        doubt = self._doubt
        if doubt is None:
            if late_ns < _STOOD_NS:
                return False
            self._doubt = _Doubt(arrived_ns, device_ns, device_ns, arrived_ns, lag_ns)
        elif late_ns < _SHIFT_NS:
            # What was stuck on its way has been delivered: the clock is what it was.
            self._doubt = None
            return False
        else:
            doubt.last_device_ns, doubt.last_ns = device_ns, arrived_ns
            doubt.least_ns = min(doubt.least_ns, lag_ns)
            doubt.count += 1
        return True

    def _resolve(self, doubt: _Doubt) -> None:
        """Begin a new clock, unless samples come faster than they were taken: late ones do."""
        self._doubt = None
        paced_ns = doubt.last_device_ns - doubt.first_device_ns
        if paced_ns > 1.5 * (doubt.last_ns - doubt.first_ns):
            return
        self.steps += 1
        self.restart()
        self._first_arrived_ns = doubt.first_ns
        self._open = _Window(doubt.last_device_ns, doubt.least_ns)
        self._opened_ns, self._count = doubt.last_device_ns, 1

    def _shifted(self, lag_ns: int) -> bool:
        """Tell whether the last windows are late alike, far behind what was before them."""
        if len(self._windows) < 3 or lag_ns - self._windows[-1].lag_ns < -_SHIFT_NS / 4:
            return False
        before, first, second = (self._windows[i].lag_ns for i in (-3, -2, -1))
        return first - before > _SHIFT_NS and abs(second - first) < _SHIFT_NS / 4


class HostStamps:
    """Stands in for the map where a device stamps by the host's own monotonic clock."""

    steps = 0
    settled = True
    drift_ppm = jitter_ns = 0.0

    def restart(self) -> None:
        """Nothing is learnt, nothing is forgotten."""

    def observe(self, device_ns: int, arrived_ns: int) -> bool:
        """See `ClockMap.observe`: this clock does not step."""
        return False

    def ready(self, now_ns: int) -> bool:
        """Say yes."""
        return True

    def __call__(self, device_ns: np.ndarray) -> np.ndarray:
        """Return the same times."""
        return device_ns


class RosClock:
    """
    From the host's monotonic clock, which nobody sets, to ROS time, which is the system's.

    Attributes
    ----------
    steps
        How often the system's clock was set while it was watched.

    """

    _STEP_NS = 1_000_000
    _TRIES = 3
    _SHARP_NS = 20_000

    def __init__(self) -> None:
        """Look at both clocks."""
        self.steps = 0
        self._offset_ns = float(self._look()[1])

    def watch(self) -> int:
        """Follow the system's clock; return by how much it was set since the last call, or 0."""
        uncertain_ns, seen_ns = self._look()
        if uncertain_ns > self._SHARP_NS:
            return 0
        off_ns = seen_ns - self._offset_ns
        if abs(off_ns) < self._STEP_NS:
            self._offset_ns += 0.05 * off_ns
            return 0
        self._offset_ns += off_ns
        self.steps += 1
        return round(off_ns)

    def __call__(self, host_ns: np.ndarray) -> np.ndarray:
        """Return ROS times, ns, of monotonic ones."""
        return host_ns + round(self._offset_ns)

    def _look(self) -> tuple[int, int]:
        """Return how sure it is and the offset, ns: of some looks the least interrupted one."""
        looks = []
        for _ in range(self._TRIES):
            before, system, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
            looks.append((after - before, system - (before + after) // 2))
        return min(looks)
