# SPDX-License-Identifier: Apache-2.0

"""Order of frames by the device's own count of samples and by its clock."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

from adxl_ros.links.support.wire_format import AFTER_RESET, SampleFrame

_REMEMBERED = 20_000
"""Frames that are recognised when they come twice. Chosen: 40 s of frames of 2 ms."""
_TOLERANCE_US = 1000.0
"""Absolute tolerance between the device's clock and its count, µs."""
_TOLERANCE = 0.002
"""Relative tolerance between the device's clock and its count. Chosen: a real rate differs from
the stated one by less."""
_RESTART_US = 500e3
"""Duration of known frames at the pace of time that shows a board which begins again, µs."""
_RESTART_TOLERANCE = 0.1
"""Relative tolerance of that pace."""
_AWAY_TOLERANCE_US = 250e3
"""Tolerance between the clocks of device and host while a port was closed, µs."""


@dataclass(frozen=True)
class AcceptedFrame:
    """A frame whose samples are published."""

    frame: SampleFrame  # The frame
    # Number of samples that are missing before it, exactly; None where a new count begins
    lost: int | None
    stepped: bool = False  # Whether the device's clock has stepped since the previous frame


class _Repetition(NamedTuple):
    """First of a run of repeated frames: its lag behind host time and its arrival, µs."""

    lag_us: float
    arrived_us: float


class FrameCounter:
    """
    Decides for each frame: the next one, one after a gap, a repeated one, or a new count.

    repeated: samples of frames that came twice or late; overruns: samples that the device itself
    dropped.
    """

    def __init__(self) -> None:
        """Begin without a count."""
        self.repeated = self.overruns = 0
        self._period_us = 0.0
        self._next_index = self._next_time_us = self._device_overruns = 0
        self._begun = False
        self._closed_us: float | None = None
        self._arrived_us = 0.0
        self._pending: SampleFrame | None = None
        self._repetition: _Repetition | None = None
        self._checks: set[int] = set()
        self._check_order: deque[int] = deque()

    def restart(self, rate_hz: float) -> None:
        """Let the next frame begin a new count, at a sample rate, Hz."""
        self._period_us = 1e6 / rate_hz
        self._begun = False
        self._pending = None
        self._forget()

    def reopened(self) -> None:
        """Take note that the next frames may come from another device."""
        if self._closed_us is None:
            self._closed_us = self._arrived_us
        self._pending = None
        self._forget()

    def accept(self, frame: SampleFrame, arrived_ns: int) -> list[AcceptedFrame]:
        """Take the next frame of the stream."""
        arrived_us = arrived_ns * 1e-3
        is_repeated = frame.check in self._checks
        pending, self._pending = self._pending, None
        accepted = self._after_restart(frame, arrived_us) if is_repeated \
            else self._after_previous(frame, arrived_us)
        if accepted is None and pending is not None and self._are_consecutive(pending, frame):
            # Two frames in a row have another count: the device was reset without a message.
            self._register(pending, arrived_us, True)
            following = self._after_previous(frame, arrived_us)
            self._register(frame, arrived_us)
            first = AcceptedFrame(pending, None)
            return [first] if following is None else [first, following]
        if pending is not None:
            self.repeated += len(pending.codes)
        if accepted is not None:
            self._register(frame, arrived_us, accepted.lost is None)
            return [accepted]
        if is_repeated and not frame.flags & AFTER_RESET:
            self.repeated += len(frame.codes)
        else:
            self._pending = frame
        return []

    def _after_restart(self, frame: SampleFrame, arrived_us: float) -> AcceptedFrame | None:
        """Accept a repeated frame only where such frames come at the pace of time."""
        lag_us = arrived_us - frame.time_us
        if self._repetition is None:
            self._repetition = _Repetition(lag_us, arrived_us)
        duration_us = arrived_us - self._repetition.arrived_us
        if duration_us < _RESTART_US \
                or abs(lag_us - self._repetition.lag_us) > _RESTART_TOLERANCE * duration_us:
            return None
        # An emulated board does after its reset exactly what it did before.
        return AcceptedFrame(frame, None)

    def _after_previous(self, frame: SampleFrame, arrived_us: float) -> AcceptedFrame | None:
        """Compare a frame with the previous one; None where the next one must decide."""
        if not self._begun or frame.flags & AFTER_RESET:
            return AcceptedFrame(frame, None)
        ahead = _signed(frame.index - self._next_index)
        passed_us = frame.time_us - self._next_time_us
        in_step = self._agree(ahead, passed_us)
        if ahead == 0:
            return AcceptedFrame(frame, 0, not in_step)
        if self._closed_us is not None:
            away_us = arrived_us - self._closed_us
            in_step &= abs(away_us - passed_us) < _AWAY_TOLERANCE_US + _TOLERANCE * away_us
        elif ahead < 0:
            return None
        return AcceptedFrame(frame, ahead if ahead > 0 and in_step else None)

    def _are_consecutive(self, first: SampleFrame, second: SampleFrame) -> bool:
        """Return whether count and clock lead from the first frame to the second."""
        count = len(first.codes)
        ahead = _signed(second.index - first.index - count)
        passed_us = second.time_us - first.time_us - count * self._period_us
        return ahead >= 0 and self._agree(ahead, passed_us)

    def _agree(self, samples: int, passed_us: float) -> bool:
        """Return whether a number of samples fits a time by the device's clock, µs."""
        tolerance_us = _TOLERANCE_US + 0.5 * self._period_us + _TOLERANCE * abs(passed_us)
        return abs(passed_us - samples * self._period_us) < tolerance_us

    def _register(self, frame: SampleFrame, arrived_us: float, is_new: bool = False) -> None:
        """Make a frame the previous one; `is_new` begins a new count with it."""
        if is_new:
            self._forget()
        self._repetition = None
        count = len(frame.codes)
        resumed = self._begun and not frame.flags & AFTER_RESET
        self.overruns += (frame.overruns - self._device_overruns) % 2 ** 16 if resumed else 0
        self._device_overruns = frame.overruns
        self._next_index = (frame.index + count) % 2 ** 32
        self._next_time_us = frame.time_us + round(count * self._period_us)
        self._begun, self._closed_us, self._arrived_us = True, None, arrived_us
        self._checks.add(frame.check)
        self._check_order.append(frame.check)
        if len(self._check_order) > _REMEMBERED:
            self._checks.discard(self._check_order.popleft())

    def _forget(self) -> None:
        self._checks.clear()
        self._check_order.clear()


def _signed(difference: int) -> int:
    """Return a difference of numbers that wrap at 2^32, from -2^31 to 2^31 - 1."""
    return (difference + 2 ** 31) % 2 ** 32 - 2 ** 31
