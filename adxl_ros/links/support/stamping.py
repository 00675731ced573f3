# SPDX-License-Identifier: Apache-2.0

"""
Stamps of samples: from the clock of a device to the host's monotonic clock, and to ROS time.

A sample arrives later than it was taken, never earlier. So the clock of the device, seen on the
host's clock, is the line just below the arrivals: it has an offset and a drift. The stamps follow
this line smoothly and never go backwards.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import time
from typing import Any, NamedTuple

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
_SHIFT_NS = 20e6
"""Common lateness of two windows that shows a backward step of the device's clock, ns."""
_STOPPED_NS = 250e6
"""Lateness of an arrival after which the next arrivals decide whether the clock stopped, ns."""
_CATCH_UP_RATIO = 1.5
"""Late samples that come this many times faster than they were taken were delayed on the way."""
_SMOOTH_NS = 50e6
"""Largest difference that the stamps take up smoothly, ns. A larger one forward is a step."""
_MAX_BEND = 0.05  # Largest change of slope for a small difference, relative to the drift
_MAX_STEEP_BEND = 0.5  # Largest change of slope for a difference beyond `_SMOOTH_NS`
_MIN_SLOPE = 1e-3  # Smallest slope of the stamps: they go forward whatever a faulty device sends
_SHIFT_TOLERANCE_NS = _SHIFT_NS / 4
"""Largest difference between two windows that are late by the same amount, ns."""
_SHIFT_WINDOWS = 3  # Windows that a backward step needs: one before it and two after it


class _Window(NamedTuple):
    """The earliest arrival of a window: device time, and its lag behind host time, ns."""

    device_ns: int
    lag_ns: int


class ClockMap:
    """
    Map of a device's clock by the arrivals of its samples.

    drift_ppm: drift of the device's clock, ppm; positive where it is slower than the host's;
    jitter_ns: median distance of the windows' earliest arrivals from the line, ns; settled:
    whether samples get stamps. They wait in the first instants of a new clock.
    """

    def __init__(self, delay_s: float, decision_s: float = _LATER_WAIT_S) -> None:
        self._decision_s = decision_s
        self.steps = 0  # How often the device's clock has stepped, by its arrivals
        self._delay_ns = round(delay_s * 1e9)
        self._newest_stamp_ns: int | None = None
        self._wait_s = _FIRST_WAIT_S
        self.restart()

    def restart(self) -> None:
        """Begin a new clock; its stamps follow the earlier ones."""
        self.drift_ppm = self.jitter_ns = 0.0
        self.settled = False
        self._windows: deque[_Window] = deque()
        self._open: _Window | None = None
        self._opened_ns = self._seen_ns = self._count = 0
        self._first_arrived_ns: int | None = None
        # Arrivals far too late, device time and host time, ns: their samples were delayed, or the
        # device's clock stopped
        self._late: list[tuple[int, int]] = []
        self._former_lag_ns: float | None = None
        # The stamps lie on a line through this point, device time and host time, ns.
        self._line_device_ns = self._line_host_ns = 0
        self._slope = 1.0

    def observe(self, device_ns: int, arrived_ns: int) -> bool:
        """Take an arrival."""
        lag_ns = arrived_ns - self._delay_ns - device_ns
        # How far the arrival lies above the line; far below it, the device's clock stepped forward
        lateness_ns = lag_ns + device_ns - self._line(device_ns)
        is_early = self.settled and lateness_ns < -_EARLY_NS
        if is_early or self._is_shifted(lag_ns):
            former_ns = self._former_lag_ns
            # Samples that a busy host read late have looked like those of a clock that stopped.
            was_delayed = is_early and former_ns is not None and lag_ns > former_ns - _EARLY_NS
            self.steps += not was_delayed
            self.restart()
            self._former_lag_ns = former_ns if was_delayed else None
            self.observe(device_ns, arrived_ns)
            return not was_delayed
        if self.settled:
            if lateness_ns > (_SHIFT_NS if self._late else _STOPPED_NS):
                # It stays out of the windows, until later ones explain it.
                self._late.append((device_ns, arrived_ns))
                return False
            self._late.clear()  # the delayed samples have been delivered
        if self._first_arrived_ns is None:
            self._first_arrived_ns = arrived_ns
        self._update_window(device_ns, lag_ns)
        return False

    def ready(self, now_ns: int) -> bool:
        """Return whether samples can be stamped at a host time, ns."""
        if len(self._late) > 1 and now_ns - self._late[0][1] >= self._decision_s * 1e9:
            self._resolve()
        if not self.settled and self._open is not None and self._first_arrived_ns is not None \
                and now_ns - self._first_arrived_ns >= self._wait_s * 1e9:
            self.settled = True
            self._wait_s = _LATER_WAIT_S
            self._line_device_ns = self._open.device_ns
            self._line_host_ns = self._line_device_ns + self._fit(self._line_device_ns)
        return self.settled and not self._late

    def host_ns(self, device_ns: np.ndarray) -> np.ndarray:
        """Map ascending device times, ns, (n,), to host times that ascend from call to call."""
        stamps = np.rint(self._line(device_ns)).astype(np.int64)
        newest_ns = self._newest_stamp_ns
        if newest_ns is not None and stamps[0] <= newest_ns:
            # Continue from the stamps so far, further than a reading of the system clock may err.
            newest_ns += _MAX_UNCERTAINTY_NS
            self._line_host_ns += newest_ns + 1 - int(stamps[0])
            self._steer(int(device_ns[0]), _HORIZON_S)
            stamps = np.maximum(np.rint(self._line(device_ns)).astype(np.int64),
                                newest_ns + 1 + np.arange(len(stamps)))
        self._newest_stamp_ns = int(stamps[-1])
        return stamps

    def _line(self, device_ns: Any) -> Any:
        return self._line_host_ns + (device_ns - self._line_device_ns) * self._slope

    def _update_window(self, device_ns: int, lag_ns: int) -> None:
        """Add an arrival to the open window; a window that ends corrects the line."""
        if self._open is None:
            self._opened_ns, self._count = device_ns, 0
        if self._open is None or lag_ns < self._open.lag_ns:
            self._open = _Window(device_ns, lag_ns)
            if self.settled and not self._windows:
                self._steer(device_ns, max(_FIRST_HORIZON_S, 2e-9 * (device_ns - self._seen_ns)))
        self._count += 1
        self._seen_ns = device_ns
        open_s = (device_ns - self._opened_ns) * 1e-9
        complete = open_s >= _WINDOW_S and self._count >= _MIN_ARRIVALS
        if complete or open_s >= _MAX_WINDOW_S:
            self._windows.append(self._open)
            self._open = None
            while len(self._windows) > _MIN_WINDOWS \
                    and device_ns - self._windows[0].device_ns > _SPAN_S * 1e9:
                self._windows.popleft()
            self._steer(device_ns, max(_HORIZON_S, 2 * open_s))

    def _steer(self, device_ns: int, horizon_s: float) -> None:
        """Turn the line so that it meets the best line at the horizon."""
        host_ns = round(self._line(device_ns))
        horizon_ns = round(horizon_s * 1e9)
        difference_ns = device_ns + self._fit(device_ns) - host_ns
        if difference_ns > _SMOOTH_NS:
            host_ns, difference_ns = host_ns + difference_ns, 0
        bend = _MAX_BEND if abs(difference_ns) < _SMOOTH_NS else _MAX_STEEP_BEND
        target_ns = device_ns + horizon_ns
        slope = (target_ns + self._fit(target_ns) - host_ns) / horizon_ns
        drift = 1 + self.drift_ppm * 1e-6
        self._slope = max(min(max(slope, drift - bend), drift + bend), _MIN_SLOPE)
        self._line_device_ns, self._line_host_ns = device_ns, host_ns

    def _fit(self, device_ns: int) -> int:
        """
        Fit the best line to the windows; return the lag of a device time on it, ns.

        A window above the line counts less, and a drift of 0 is the prior.
        """
        windows = [self._open] if self._open and not self._windows else [*self._windows]
        origin = windows[-1]
        time_s = np.array([w.device_ns - origin.device_ns for w in windows]) * 1e-9
        lag_ns = np.array([w.lag_ns - origin.lag_ns for w in windows], float)
        weight = np.ones(len(windows))
        offset_ns = slope = 0.0
        for _ in range(_FIT_ITERATIONS):
            mean_s = np.average(time_s, weights=weight)
            mean_ns = np.average(lag_ns, weights=weight)
            spread_s2 = weight @ (time_s - mean_s) ** 2
            slope = weight @ ((time_s - mean_s) * (lag_ns - mean_ns)) / (spread_s2 + _PRIOR_S2)
            offset_ns = mean_ns - slope * mean_s
            residual_ns = lag_ns - offset_ns - slope * time_s
            weight = np.where(residual_ns > 0, _LATE_WEIGHT, 1.0)
            self.jitter_ns = float(np.median(np.abs(residual_ns)))
        self.drift_ppm = float(slope) * 1e-3
        ahead_s = (device_ns - origin.device_ns) * 1e-9
        return origin.lag_ns + round(offset_ns + slope * ahead_s)

    def _resolve(self) -> None:
        """Begin a new clock if the late samples come at the pace of time: the clock stopped."""
        late, self._late = self._late, []
        (first_device_ns, first_ns), (last_device_ns, last_ns) = late[0], late[-1]
        if last_device_ns - first_device_ns > _CATCH_UP_RATIO * (last_ns - first_ns):
            return
        self.steps += 1
        former_ns = self._former_lag_ns
        if former_ns is None:
            former_ns = self._line(first_device_ns) - first_device_ns
        self.restart()
        self._former_lag_ns = former_ns
        self._first_arrived_ns = first_ns
        self._open = _Window(last_device_ns, min(
            arrived_ns - self._delay_ns - device_ns for device_ns, arrived_ns in late))
        self._opened_ns, self._count = last_device_ns, 1

    def _is_shifted(self, lag_ns: int) -> bool:
        """Return whether the last two windows are late by the same amount: a backward step."""
        if len(self._windows) < _SHIFT_WINDOWS \
                or lag_ns - self._windows[-1].lag_ns < -_SHIFT_TOLERANCE_NS:
            return False
        before_ns, first_ns, second_ns = (self._windows[i].lag_ns for i in (-3, -2, -1))
        return first_ns - before_ns > _SHIFT_NS and abs(second_ns - first_ns) < _SHIFT_TOLERANCE_NS


class IdentityMap:
    """Map for a device that stamps by the host's own monotonic clock."""

    # As those of `ClockMap`, and constant
    steps = 0
    settled = True
    drift_ppm = jitter_ns = 0.0

    def restart(self) -> None:
        """Do nothing: this map learns nothing."""

    def observe(self, device_ns: int, arrived_ns: int) -> bool:
        """Do nothing: this clock does not step."""
        return False

    def ready(self, now_ns: int) -> bool:
        """Return True: samples can be stamped at any time."""
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


class SystemClockMap:
    """Map from the host's monotonic clock, which is never set, to ROS time, the system clock."""

    def __init__(self) -> None:
        self.steps = 0  # How often the system clock was set since the map began
        self._offset_ns = _system_offset()[1]

    def update(self) -> None:
        """Follow the system clock."""
        uncertainty_ns, offset_ns = _system_offset()
        if uncertainty_ns > _MAX_UNCERTAINTY_NS:
            return
        self.steps += abs(offset_ns - self._offset_ns) >= _STEP_NS
        self._offset_ns = offset_ns

    def ros_ns(self, host_ns: np.ndarray) -> np.ndarray:
        """Return the ROS times of monotonic times, ns."""
        return host_ns + self._offset_ns


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
    references: Mapping[str, np.ndarray]  # References that the device has, by column, (n,) each
    lost: int | None = None  # Samples lost before it; None where only time shows them


_FOLLOW_NS = 10_000_000
"""Time between two readings of the system clock, ns; chosen: a reading takes several microseconds,
and nobody sees a clock that was set 10 ms later."""
_FOREVER_NS = 2 ** 63 - 1  # Largest time, ns: any waiting time is over by then


class Stamper:
    """Holds samples until the device's clock is known, stamps them and counts lost ones."""

    def __init__(self, clock: ClockMap | IdentityMap, references: Sequence[str]) -> None:
        self.clock = clock  # Map of the device's clock
        self.period_ns = 0.0  # Sample period, ns; 0 before the first `restart`
        self._system_clock = SystemClockMap()
        self._followed_ns = 0
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
                self._estimated += sum(max(round(step_ns / self.period_ns) - 1, 0)
                                       for step_ns in steps_ns.tolist())
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
                self._counted + self._estimated, self._thin(host_ns, block.references),
                self._estimated))
            self._counted = self._estimated = 0
        self._unstamped.clear()

    def _thin(self, host_ns: np.ndarray, references: Mapping[str, np.ndarray]
              ) -> dict[str, np.ndarray]:
        """Return each reference by its mean in the first row after a period, and NaN elsewhere."""
        thinned = {column: np.full(len(host_ns), np.nan) for column in self._references}
        if (period := int(host_ns[-1]) // _PERIOD_NS) != self._period:
            self._period = period
            for column, values in references.items():
                thinned[column][0] = values.mean()
        return thinned
