# SPDX-License-Identifier: Apache-2.0

"""
Map of the clock of a device to the host's monotonic clock.

A sample arrives later than it was taken, never earlier. So the clock of the device, seen on the
host's clock, is the line just below the arrivals: it has an offset and a drift. The stamps follow
this line smoothly and never go backwards.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from enum import auto, Enum
from typing import NamedTuple

import numpy as np

# Limits and time constants without a source are chosen for links of 0.1 to 5 ms of jitter at
# 1 kHz; test_link_support measures their accuracy.
_WINDOW_S = 0.5  # Length of a window, s, of which only the earliest arrival counts
_MIN_ARRIVALS = 25  # Arrivals that a window needs, so that its earliest one is early
_MAX_WINDOW_S = 5.0  # Length at which a window ends without these arrivals, s
_SPAN_S = 25.0
"""Age at which a window is forgotten, s. A crystal's drift is constant over this time."""
_MIN_WINDOWS = 20  # Number of windows that are kept whatever their age
_FIRST_WAIT_S = 0.15
"""Time for which the samples of the first clock wait for their stamps, s. Of some arrivals one is
early."""
_LATER_WAIT_S = 0.06
"""Time for which the samples of a later clock wait, s: it is short because a robot moves."""
_FIRST_HORIZON_S = 0.3
"""Shortest time in which the stamps of a new clock follow an earlier arrival, s."""
_HORIZON_S = 2.0
"""Shortest time in which stamps approach a better line, s. So a correction is no jitter."""
_PRIOR_S2 = 1.0
"""Weight of a drift of 0, as the sum of squared window times, s². A lateness of 0.2 ms is as
likely as the 200 ppm of a crystal."""
_LATE_WEIGHT = 0.1
"""Weight of a window above the line, relative to one below it: lateness carries little
information."""
_FIT_ITERATIONS = 8
"""Iterations of the reweighted least squares. Chosen: the weights settle in fewer."""
_EARLY_NS = 20e6  # Earliness of an arrival that shows a forward step of the device's clock, ns
_LATE_NS = 20e6
"""Lateness of arrivals, ns, that shows a backward step of the device's clock if it stays."""
_SHIFT_S = 1.0  # Time after which lateness that has stayed counts as a step, s: two windows
_STOPPED_NS = 250e6
"""Lateness of an arrival, ns, after which samples wait until its cause is known."""
_SAME_NS = 5e6  # Largest change of a lateness that stays, ns
_CATCH_UP_RATIO = 1.5
"""Late samples that come this many times faster than they were taken were delayed on the way."""
_SMOOTH_NS = 50e6
"""Largest difference that the stamps take up smoothly, ns. A larger one forward is a step."""
_MAX_BEND = 0.5  # Largest difference between the slopes of stamps and device time
MAX_UNCERTAINTY_NS = 20_000
"""Uncertainty above which a reading of the system clock is ignored, ns: the process was
interrupted."""


class _Arrival(NamedTuple):
    """An arrival: device time, and its lag behind host time, ns."""

    device_ns: int
    lag_ns: int

    @property
    def host_ns(self) -> int:
        """Return the host time of the arrival, ns, without the delay of the link."""
        return self.device_ns + self.lag_ns


class ClockState(Enum):
    """What is known of the clock of a device."""

    SETTLING = auto()  # It is new: its samples wait for some arrivals
    SETTLED = auto()  # Samples get stamps
    HELD = auto()  # Samples wait until the cause of late arrivals is known


class _Windows:
    """The earliest arrival of each window of time, and the line just below them."""

    def __init__(self) -> None:
        self.drift_ppm = 0.0
        self.jitter_ns = 0.0
        self._offset_ns = 0.0  # Of the line from the lag of the newest window
        self._ended: deque[_Arrival] = deque()
        self._open: _Arrival | None = None  # That of the window that has not ended
        self._opened_ns = 0
        self._count = 0  # Arrivals in the open window

    def add(self, arrival: _Arrival) -> bool:
        """Take an arrival; return whether it is the earliest of a clock's first window."""
        is_new = self._open is None
        if is_new:
            self._opened_ns = arrival.device_ns
            self._count = 0
        self._count += 1
        if self._open is not None and arrival.lag_ns >= self._open.lag_ns:
            return False
        self._open = arrival
        return not self._ended

    def end(self, device_ns: int) -> bool:
        """End the window if it is full at a device time; return whether it is."""
        open_s = (device_ns - self._opened_ns) * 1e-9
        is_full = open_s >= _WINDOW_S and self._count >= _MIN_ARRIVALS
        if self._open is None or not (is_full or open_s >= _MAX_WINDOW_S):
            return False
        self._ended.append(self._open)
        self._open = None
        while (
            len(self._ended) > _MIN_WINDOWS
            and device_ns - self._ended[0].device_ns > _SPAN_S * 1e9
        ):
            self._ended.popleft()
        return True

    def host_ns(self, device_ns: int) -> int:
        """Return the host time of a device time by the line, ns."""
        origin = self._ended[-1] if self._ended else self._open
        assert origin is not None, 'an arrival precedes what follows from it'
        ahead_ns = self._offset_ns + self.drift_ppm * 1e-6 * (device_ns - origin.device_ns)
        return device_ns + origin.lag_ns + round(ahead_ns)

    def fit(self) -> None:
        """
        Fit the best line to the windows, by reweighted least squares.

        A window above the line counts less, and a drift of 0 is the prior.
        """
        # Device times and lags of the windows about those of the newest one
        windows = np.array(self._ended or [self._open])
        device_ns, lag_ns = (windows - windows[-1]).T
        time_s = device_ns * 1e-9
        weight = np.ones(len(windows))
        for _ in range(_FIT_ITERATIONS):
            mean_s, mean_ns = np.average([time_s, lag_ns], axis=1, weights=weight)
            spread_s2 = weight @ (time_s - mean_s) ** 2
            slope = weight @ ((time_s - mean_s) * (lag_ns - mean_ns)) / (spread_s2 + _PRIOR_S2)
            residual_ns = lag_ns - mean_ns - slope * (time_s - mean_s)
            weight = np.where(residual_ns > 0, _LATE_WEIGHT, 1.0)
        self._offset_ns = float(mean_ns - slope * mean_s)
        self.drift_ppm = float(slope) * 1e-3
        self.jitter_ns = float(np.median(np.abs(residual_ns)))


@dataclass
class _Line:
    """The line of the stamps: through a point, device time and host time, ns."""

    device_ns: int = 0
    host_ns: int = 0
    slope: float = 1.0

    def at(self, device_ns: np.ndarray) -> np.ndarray:
        """Return the stamps of device times, ns, (n,)."""
        ahead_ns = (device_ns - self.device_ns) * self.slope
        return self.host_ns + np.rint(ahead_ns).astype(np.int64)

    def aim(self, device_ns: int, host_ns: int) -> None:
        """Turn the line so that it goes through a second point, as far as it may bend."""
        slope = (host_ns - self.host_ns) / (device_ns - self.device_ns)
        self.slope = min(max(slope, 1 - _MAX_BEND), 1 + _MAX_BEND)


@dataclass
class _Clock:
    """What has been seen of one clock of a device."""

    windows: _Windows = field(default_factory=_Windows)
    line: _Line = field(default_factory=_Line)
    first: _Arrival | None = None
    # Arrivals in a row far too late: the samples were delayed, or the clock has stepped back
    late: list[_Arrival] = field(default_factory=list)
    # Lag before the clock seemed to step back, ns: the samples may have been delayed after all
    former_lag_ns: int | None = None
    steered_ns: int = 0  # Device time at which the line was turned

    def lateness_ns(self, arrival: _Arrival) -> int:
        """Return how much later than by the fit something has arrived, ns."""
        return arrival.host_ns - self.windows.host_ns(arrival.device_ns)


class ClockMap:
    """Map of a device's clock by the arrivals of its samples."""

    def __init__(self, delay_s: float, decision_s: float = _LATER_WAIT_S) -> None:
        self.steps = 0  # How often the device's clock has stepped, by its arrivals
        self.state = ClockState.SETTLING
        self._delay_ns = round(delay_s * 1e9)
        self._decision_s = decision_s
        self._wait_s = _FIRST_WAIT_S
        self._newest_stamp_ns: int | None = None
        self._clock = _Clock()

    @property
    def drift_ppm(self) -> float:
        """Drift of the device's clock, ppm; positive where it is slower than the host's."""
        return self._clock.windows.drift_ppm

    @property
    def jitter_ns(self) -> float:
        """Median distance of the windows' earliest arrivals from the fit, ns."""
        return self._clock.windows.jitter_ns

    def restart(self) -> None:
        """Begin a new clock; its stamps follow the earlier ones."""
        self.state = ClockState.SETTLING
        self._clock = _Clock()

    def observe(self, device_ns: int, arrived_ns: int) -> bool:
        """Take an arrival; return whether it shows a forward step of the device's clock."""
        arrival = _Arrival(device_ns, arrived_ns - self._delay_ns - device_ns)
        is_settling = self.state is ClockState.SETTLING
        late_ns = 0 if is_settling else self._clock.lateness_ns(arrival)
        if late_ns > _LATE_NS:
            # It stays out of the windows, until later ones explain it.
            self._clock.late.append(arrival)
            return False
        stepped = late_ns < -_EARLY_NS
        if stepped:
            former_ns = self._clock.former_lag_ns
            stepped = former_ns is None or arrival.lag_ns < former_ns - _EARLY_NS
            self.steps += stepped
            self.restart()
        self._clock.late.clear()  # the delayed samples have been delivered
        self._take(arrival)
        return stepped

    def advance(self, now_ns: int) -> bool:
        """Settle a new clock and explain late arrivals; return whether samples get stamps."""
        if self.state is not ClockState.SETTLING:
            self._look_at_late(now_ns)
        first = self._clock.first
        if (
            self.state is ClockState.SETTLING
            and first
            and self._has_passed(self._wait_s, first, now_ns)
        ):
            self.state = ClockState.SETTLED
            self._wait_s = _LATER_WAIT_S
            line = self._clock.line
            line.device_ns = self._clock.steered_ns = first.device_ns
            line.host_ns = self._clock.windows.host_ns(first.device_ns)
        return self.state is ClockState.SETTLED

    def host_ns(self, device_ns: np.ndarray) -> np.ndarray:
        """Map ascending device times, ns, (n,), to host times that ascend from call to call."""
        line = self._clock.line
        stamps = line.at(device_ns)
        if self._newest_stamp_ns is not None and stamps[0] <= self._newest_stamp_ns:
            # Continue from the stamps so far, further than a reading of the system clock may err.
            line.device_ns = int(device_ns[0])
            line.host_ns = self._newest_stamp_ns + MAX_UNCERTAINTY_NS + 1
            self._steer(line.device_ns, _HORIZON_S)
            stamps = line.at(device_ns)
        # The line turns about the newest stamp, so that what follows comes after it.
        line.device_ns = int(device_ns[-1])
        line.host_ns = int(stamps[-1])
        self._newest_stamp_ns = line.host_ns
        return stamps

    def _has_passed(self, wait_s: float, arrival: _Arrival, now_ns: int) -> bool:
        """Return whether a time, s, has passed since an arrival."""
        return now_ns - arrival.host_ns - self._delay_ns >= wait_s * 1e9

    def _take(self, arrival: _Arrival) -> None:
        """Add an arrival to the windows; an end of a window, and a better first, steer."""
        clock = self._clock
        clock.first = clock.first or arrival
        if clock.windows.add(arrival):
            self._steer(arrival.device_ns, _FIRST_HORIZON_S)
        if clock.windows.end(arrival.device_ns):
            self._steer(arrival.device_ns, _HORIZON_S)

    def _steer(self, device_ns: int, horizon_s: float) -> None:
        """Fit the clock, and turn the line so that it meets the clock at the horizon."""
        clock = self._clock
        clock.windows.fit()
        if self.state is ClockState.SETTLING:
            return
        behind_ns = clock.windows.host_ns(clock.line.device_ns) - clock.line.host_ns
        if behind_ns > _SMOOTH_NS:
            clock.line.host_ns += behind_ns
        horizon_ns = round(max(horizon_s * 1e9, 2 * (device_ns - clock.steered_ns)))
        target_ns = device_ns + horizon_ns
        clock.steered_ns = device_ns
        clock.line.aim(target_ns, clock.windows.host_ns(target_ns))

    def _look_at_late(self, now_ns: int) -> None:
        """Hold the samples while arrivals are far too late, until their cause is known."""
        late = self._clock.late
        is_stopped = bool(late) and self._clock.lateness_ns(late[0]) > _STOPPED_NS
        self.state = ClockState.HELD if is_stopped else ClockState.SETTLED
        wait_s = self._decision_s if is_stopped else _SHIFT_S
        if len(late) > 1 and self._has_passed(wait_s, late[0], now_ns):
            self._explain(late)

    def _explain(self, late: list[_Arrival]) -> None:
        """Begin a new clock if the late samples were late by the same time: it stepped back."""
        self.state = ClockState.SETTLED
        self._clock.late = []
        half = len(late) // 2
        first_ns = min(arrival.lag_ns for arrival in late[:half])
        second_ns = min(arrival.lag_ns for arrival in late[half:])
        is_same_lag = abs(second_ns - first_ns) < _SAME_NS
        taken_ns = late[-1].device_ns - late[0].device_ns
        arriving_ns = late[-1].host_ns - late[0].host_ns
        is_backlog = taken_ns >= _CATCH_UP_RATIO * arriving_ns
        if is_same_lag and not is_backlog:
            former_ns = self._clock.former_lag_ns
            if former_ns is None:
                former_ns = late[0].lag_ns - self._clock.lateness_ns(late[0])
            self.steps += 1
            self.restart()
            self._clock.former_lag_ns = former_ns
            for arrival in late:
                self._take(arrival)


class IdentityMap:
    """Map for a device that stamps by the host's own monotonic clock: it learns nothing."""

    drift_ppm = jitter_ns = 0.0

    def __init__(self) -> None:
        self.state = ClockState.SETTLED
        self.steps = 0

    def restart(self) -> None:
        """Do nothing: all its clocks are one."""

    def observe(self, device_ns: int, arrived_ns: int) -> bool:
        """Do nothing: this clock does not step."""
        return False

    def advance(self, now_ns: int) -> bool:
        """Return True: samples can be stamped at any time."""
        return True

    def host_ns(self, device_ns: np.ndarray) -> np.ndarray:
        """Return the same times, ns."""
        return device_ns


DeviceClock = ClockMap | IdentityMap
"""A map of the clock of a device to the host's monotonic clock."""
