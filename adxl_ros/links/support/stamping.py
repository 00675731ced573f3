# SPDX-License-Identifier: Apache-2.0

"""
Stamps of samples: from the clock of a device to the host's monotonic clock, and to ROS time.

A sample arrives later than it was taken, never earlier. So the clock of the device, seen on the
host's clock, is the line just below the arrivals: it has an offset and a drift. The stamps follow
this line smoothly and never go backwards.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
import time
from typing import Any, NamedTuple

from adxl_ros.files.column_mapping import Columns
from adxl_ros.links.support.base import Event, no_samples, Samples
from adxl_ros.model.sensor import Sensor
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


class _Arrival(NamedTuple):
    """An arrival: device time, and its lag behind host time, ns."""

    device_ns: int
    lag_ns: int

    @property
    def host_ns(self) -> int:
        """Return the host time of the arrival, ns, without the delay of the link."""
        return self.device_ns + self.lag_ns


class ClockMap:
    """
    Map of a device's clock by the arrivals of its samples.

    drift_ppm: drift of the device's clock, ppm; positive where it is slower than the host's;
    jitter_ns: median distance of the windows' earliest arrivals from the fit, ns; settled:
    whether samples get stamps. They wait in the first instants of a new clock.
    """

    def __init__(self, delay_s: float, decision_s: float = _LATER_WAIT_S) -> None:
        self.steps = 0  # How often the device's clock has stepped, by its arrivals
        self._delay_ns, self._decision_s = round(delay_s * 1e9), decision_s
        self._newest_stamp_ns: int | None = None
        self._wait_s = _FIRST_WAIT_S
        self.restart()

    def restart(self) -> None:
        """Begin a new clock; its stamps follow the earlier ones."""
        self.drift_ppm = self.jitter_ns = self._offset_ns = 0.0
        self.settled = False
        self._first: _Arrival | None = None
        self._windows: deque[_Arrival] = deque()  # The earliest arrival of each window
        self._open: _Arrival | None = None  # That of the window that has not ended
        # Lag before the clock seemed to step back, ns: the samples may have been delayed after all
        self._former_lag_ns: int | None = None
        self._opened_ns = self._steered_ns = self._count = 0
        # Arrivals in a row far too late: the samples were delayed, or the clock has stepped back.
        self._late: list[_Arrival] = []
        # The stamps lie on a line through this point, device time and host time, ns.
        self._line_device_ns = self._line_host_ns = 0
        self._slope = 1.0

    def observe(self, device_ns: int, arrived_ns: int) -> bool:
        """Take an arrival; return whether it shows a forward step of the device's clock."""
        arrival = _Arrival(device_ns, arrived_ns - self._delay_ns - device_ns)
        late_ns = self._lateness_ns(arrival) if self.settled else 0
        if late_ns > _LATE_NS:
            # It stays out of the windows, until later ones explain it.
            self._late.append(arrival)
            return False
        stepped = late_ns < -_EARLY_NS
        if stepped:
            former_ns = self._former_lag_ns
            stepped = former_ns is None or arrival.lag_ns < former_ns - _EARLY_NS
            self.steps += stepped
            self.restart()
        self._late.clear()  # the delayed samples have been delivered
        self._take(arrival)
        return stepped

    def ready(self, now_ns: int) -> bool:
        """Return whether samples can be stamped at a host time, ns."""
        is_held = bool(self._late) and self._lateness_ns(self._late[0]) > _STOPPED_NS
        if len(self._late) > 1 and self._has_passed(
            self._decision_s if is_held else _SHIFT_S, self._late[0], now_ns
        ):
            is_held = False
            self._explain_lateness()
        first = self._first
        if not self.settled and first and self._has_passed(self._wait_s, first, now_ns):
            self.settled, self._wait_s = True, _LATER_WAIT_S
            self._line_device_ns = self._steered_ns = first.device_ns
            self._line_host_ns = self._clock_ns(first.device_ns)
        return self.settled and not is_held

    def host_ns(self, device_ns: np.ndarray) -> np.ndarray:
        """Map ascending device times, ns, (n,), to host times that ascend from call to call."""
        stamps = self._stamps(device_ns)
        if self._newest_stamp_ns is not None and stamps[0] <= self._newest_stamp_ns:
            # Continue from the stamps so far, further than a reading of the system clock may err.
            self._line_device_ns = int(device_ns[0])
            self._line_host_ns = self._newest_stamp_ns + _MAX_UNCERTAINTY_NS + 1
            self._steer(self._line_device_ns, _HORIZON_S)
            stamps = self._stamps(device_ns)
        # The line turns about the newest stamp, so that what follows comes after it.
        self._line_device_ns, self._line_host_ns = int(device_ns[-1]), int(stamps[-1])
        self._newest_stamp_ns = self._line_host_ns
        return stamps

    def _stamps(self, device_ns: np.ndarray) -> np.ndarray:
        ahead_ns = (device_ns - self._line_device_ns) * self._slope
        return self._line_host_ns + np.rint(ahead_ns).astype(np.int64)

    def _clock_ns(self, device_ns: int) -> int:
        """Return the host time of a device time by the fit, ns."""
        origin = self._windows[-1] if self._windows else self._open
        assert origin is not None, 'an arrival precedes what follows from it'
        ahead_ns = self._offset_ns + self.drift_ppm * 1e-6 * (device_ns - origin.device_ns)
        return device_ns + origin.lag_ns + round(ahead_ns)

    def _lateness_ns(self, arrival: _Arrival) -> int:
        return arrival.host_ns - self._clock_ns(arrival.device_ns)

    def _has_passed(self, wait_s: float, arrival: _Arrival, now_ns: int) -> bool:
        """Return whether a time, s, has passed since an arrival."""
        return now_ns - arrival.host_ns - self._delay_ns >= wait_s * 1e9

    def _take(self, arrival: _Arrival) -> None:
        """Add an arrival to the open window; an end of a window, and a better first, steer."""
        device_ns, lag_ns = arrival
        self._first = self._first or arrival
        if self._open is None:
            self._opened_ns, self._count = device_ns, 0
        if self._open is None or lag_ns < self._open.lag_ns:
            self._open = arrival
            if not self._windows:
                self._steer(device_ns, _FIRST_HORIZON_S)
        self._count += 1
        open_s = (device_ns - self._opened_ns) * 1e-9
        if (open_s >= _WINDOW_S and self._count >= _MIN_ARRIVALS) or open_s >= _MAX_WINDOW_S:
            self._windows.append(self._open)
            self._open = None
            while (
                len(self._windows) > _MIN_WINDOWS
                and device_ns - self._windows[0].device_ns > _SPAN_S * 1e9
            ):
                self._windows.popleft()
            self._steer(device_ns, _HORIZON_S)

    def _steer(self, device_ns: int, horizon_s: float) -> None:
        """Fit the clock, and turn the line so that it meets the clock at the horizon."""
        self._fit()
        if not self.settled:
            return
        behind_ns = self._clock_ns(self._line_device_ns) - self._line_host_ns
        if behind_ns > _SMOOTH_NS:
            self._line_host_ns += behind_ns
        target_ns = device_ns + round(max(horizon_s * 1e9, 2 * (device_ns - self._steered_ns)))
        self._steered_ns = device_ns
        rise_ns = self._clock_ns(target_ns) - self._line_host_ns
        slope = rise_ns / (target_ns - self._line_device_ns)
        self._slope = min(max(slope, 1 - _MAX_BEND), 1 + _MAX_BEND)

    def _fit(self) -> None:
        """
        Fit the best line to the windows, by reweighted least squares.

        A window above the line counts less, and a drift of 0 is the prior.
        """
        # Device times and lags of the windows about those of the newest one
        windows = np.array(self._windows or [self._open])
        device_ns, lag_ns = (windows - windows[-1]).T
        time_s = device_ns * 1e-9
        weight = np.ones(len(windows))
        for _ in range(_FIT_ITERATIONS):
            mean_s, mean_ns = np.average([time_s, lag_ns], axis=1, weights=weight)
            spread_s2 = weight @ (time_s - mean_s) ** 2
            slope = weight @ ((time_s - mean_s) * (lag_ns - mean_ns)) / (spread_s2 + _PRIOR_S2)
            residual_ns = lag_ns - mean_ns - slope * (time_s - mean_s)
            weight = np.where(residual_ns > 0, _LATE_WEIGHT, 1.0)
        self._offset_ns, self.drift_ppm = float(mean_ns - slope * mean_s), float(slope) * 1e-3
        self.jitter_ns = float(np.median(np.abs(residual_ns)))

    def _explain_lateness(self) -> None:
        """Begin a new clock if the late samples were late by the same time: it stepped back."""
        late, self._late = self._late, []
        taken_ns, half = late[-1].device_ns - late[0].device_ns, len(late) // 2
        first_ns = min(arrival.lag_ns for arrival in late[:half])
        second_ns = min(arrival.lag_ns for arrival in late[half:])
        is_same_lag = abs(second_ns - first_ns) < _SAME_NS
        arriving_ns = late[-1].host_ns - late[0].host_ns
        is_backlog = taken_ns >= _CATCH_UP_RATIO * arriving_ns
        if is_same_lag and not is_backlog:
            former_ns = self._former_lag_ns
            if former_ns is None:
                former_ns = late[0].lag_ns - self._lateness_ns(late[0])
            self.steps += 1
            self.restart()
            self._former_lag_ns = former_ns
            for arrival in late:
                self._take(arrival)


class IdentityMap(ClockMap):
    """Map for a device that stamps by the host's own monotonic clock: it learns nothing."""

    def observe(self, device_ns: int, arrived_ns: int) -> bool:
        """Do nothing: this clock does not step."""
        return False

    def ready(self, now_ns: int) -> bool:
        """Return True: samples can be stamped at any time."""
        self.settled = True
        return True

    def host_ns(self, device_ns: np.ndarray) -> np.ndarray:
        """Return the same times, ns."""
        return device_ns


_STEP_NS = 1_000_000
"""Change of the system clock's offset that counts as a step, ns. Chosen: slewing by NTP is slower.
"""
_TRIES = 3  # Readings of which the least interrupted one counts
_MAX_UNCERTAINTY_NS = 20_000
"""Uncertainty above which a reading is ignored, ns: the process was interrupted."""


def _system_offset() -> tuple[int, int]:
    """Return uncertainty and offset of the system clock from the monotonic clock, ns."""
    readings = []
    for _ in range(_TRIES):
        before_ns, system_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        readings.append((after_ns - before_ns, system_ns - (before_ns + after_ns) // 2))
    return min(readings)


_PERIOD_NS = 100_000_000
"""Time between two means of supply and temperature, ns. Chosen: both change slowly."""


@dataclass(frozen=True)
class Block:
    """Samples as a device sends them."""

    device_ns: np.ndarray  # Device time, ns, (n,) int64, ascending
    volts: np.ndarray  # Output of the sensor by axis, V, (n, m)
    references: Columns  # References that the device has, by column, (n,) each
    lost: int | None = None  # Samples lost before it; None where only time shows them
    in_self_test: bool = False  # Whether a self-test of the sensor has changed them


_FOLLOW_NS = 10_000_000
"""Time between two readings of the system clock, ns; chosen: a reading takes several microseconds,
and nobody sees a clock that was set 10 ms later."""
_FOREVER_NS = 2**63 - 1  # Largest time, ns: any waiting time is over by then


class Stamper:
    """Holds samples until the device's clock is known, stamps them and counts lost ones."""

    def __init__(self, clock: ClockMap, references: Sequence[str]) -> None:
        self.clock = clock  # Map of the device's clock
        self.period_ns = 0.0  # Sample period, ns; 0 before the first `restart`
        # ROS time, the system clock, beyond the monotonic clock, which is never set, ns
        self._ros_offset_ns = _system_offset()[1]
        self._system_steps = self._followed_ns = 0
        self._references, self._period = references, 0
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
        if self.clock.ready(arrived_ns):
            self._stamp()

    def flush(self) -> bool:
        """Stamp all samples now, by what is known of the clock; return whether there are any."""
        if self._unstamped:
            self.clock.ready(_FOREVER_NS)
            self._stamp()
        return bool(self._stamped)

    def take(self, sensor: Sensor) -> Samples:
        """Return the samples of a sensor that were stamped since the last call."""
        if self._unstamped and self.clock.ready(time.monotonic_ns()):
            self._stamp()
        if not self._stamped:
            return no_samples(sensor, time.time_ns())
        parts, self._stamped = self._stamped, []
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
            'clock': 'settled' if clock.settled else 'settling',
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
            if uncertainty_ns <= _MAX_UNCERTAINTY_NS:
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
