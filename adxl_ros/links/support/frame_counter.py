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

"""How frames follow each other by the device's own count of samples and its clock."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from adxl_ros.links.support.wire_format import AFTER_RESET, Data

_REMEMBERED = 4096
"""Frames that are known again when they come twice."""
_SLACK_US = 1000.0
_SLACK = 0.002
"""Device clock and count may differ by this part, as a stated rate and the real one do."""
_REPLAY_US = 500e3
"""Known frames that come at the pace of time for so long are a board that begins again."""
_AWAY_US = 250e3
"""How far the clocks of device and host may differ over the time that a link was closed."""


@dataclass(frozen=True)
class Next:
    """
    A frame whose samples go on.

    Attributes
    ----------
    data
        The frame.
    lost
        Samples that lack before it, exactly; None where a new count begins.
    stepped
        Whether the device's clock has stepped since the frame before.

    """

    data: Data
    lost: int | None
    stepped: bool = False


class Count:
    """
    Judges frame by frame: the next one, one after a gap, a repeated one, or a new count.

    Attributes
    ----------
    repeated
        Samples of frames that came twice or late.
    overruns
        Samples that the device says it dropped itself.

    """

    def __init__(self) -> None:
        """Begin with no count."""
        self.repeated = self.overruns = 0
        self._period_us = 0.0
        self._index = self._time_us = self._dropped = 0
        self._begun = False
        self._closed_us: float | None = None
        self._arrived_us = 0.0
        self._doubtful: Data | None = None
        self._again_us: tuple[float, float] | None = None
        self._known: set[int] = set()
        self._order: deque[int] = deque()

    def restart(self, rate_hz: float) -> None:
        """Let the next frame begin a new count, at a sample rate."""
        self._period_us = 1e6 / rate_hz
        self._begun = False
        self._doubtful = None
        self._forget()

    def reopened(self) -> None:
        """Take that frames which come now may be those of another device."""
        if self._closed_us is None:
            self._closed_us = self._arrived_us
        self._doubtful = None
        self._forget()

    def _forget(self) -> None:
        self._known.clear()
        self._order.clear()

    def __call__(self, data: Data, arrived_ns: int) -> list[Next]:
        """Return what can be taken, in order: nothing, this frame, or one held back and this."""
        arrived_us = arrived_ns * 1e-3
        doubtful, self._doubtful = self._doubtful, None
        found = self._again(data, arrived_us) if data.check in self._known else \
            self._follow(data, arrived_us)
        if found is None and doubtful is not None and self._is_next(doubtful, data):
            # Two frames in a row of another count: the device was reset, and nobody heard it.
            self._accept(doubtful, arrived_us, True)
            after = self._follow(data, arrived_us)
            self._accept(data, arrived_us)
            return [Next(doubtful, None), *filter(None, [after])]
        if doubtful is not None:
            self.repeated += len(doubtful.codes)
        if found is not None:
            self._accept(data, arrived_us, found.lost is None)
            return [found]
        if data.check not in self._known or data.flags & AFTER_RESET:
            self._doubtful = data
        else:
            self.repeated += len(data.codes)
        return []

    def _again(self, data: Data, arrived_us: float) -> Next | None:
        """Judge a frame that is known: repeated, unless such ones come at the pace of time."""
        if self._again_us is None:
            self._again_us = arrived_us - data.time_us, arrived_us
        off_us, since_us = self._again_us
        ran_us = arrived_us - since_us
        if ran_us < _REPLAY_US or abs(arrived_us - data.time_us - off_us) > 0.1 * ran_us:
            return None
        # A board of the bench that does after its reset what it did before.
        return Next(data, None)

    def _follow(self, data: Data, arrived_us: float) -> Next | None:
        """Judge a frame by the one before; None where another must tell."""
        if not self._begun or data.flags & AFTER_RESET:
            return Next(data, None)
        ahead = _signed(data.index - self._index)
        passed_us = data.time_us - self._time_us
        off_us = abs(passed_us - ahead * self._period_us)
        in_step = off_us < _SLACK_US + 0.5 * self._period_us + _SLACK * abs(passed_us)
        if ahead == 0:
            return Next(data, 0, not in_step)
        if self._closed_us is not None:
            away_us = arrived_us - self._closed_us
            in_step &= abs(away_us - passed_us) < _AWAY_US + _SLACK * away_us
        elif ahead < 0:
            return None
        return Next(data, ahead) if ahead > 0 and in_step else Next(data, None)

    def _is_next(self, first: Data, second: Data) -> bool:
        """Tell whether two frames follow each other, with what may lack between."""
        count = len(first.codes)
        ahead = _signed(second.index - first.index - count)
        passed_us = second.time_us - first.time_us - count * self._period_us
        return ahead >= 0 and abs(passed_us - ahead * self._period_us) < \
            _SLACK_US + 0.5 * self._period_us + _SLACK * abs(passed_us)

    def _accept(self, data: Data, arrived_us: float, is_new: bool = False) -> None:
        if is_new:
            self._forget()
        self._again_us = None
        count = len(data.codes)
        resumed = self._begun and not data.flags & AFTER_RESET
        self.overruns += (data.overruns - self._dropped) % 2 ** 16 if resumed else 0
        self._dropped = data.overruns
        self._index = (data.index + count) % 2 ** 32
        self._time_us = data.time_us + round(count * self._period_us)
        self._begun, self._closed_us, self._arrived_us = True, None, arrived_us
        self._known.add(data.check)
        self._order.append(data.check)
        if len(self._order) > _REMEMBERED:
            self._known.discard(self._order.popleft())


def _signed(difference: int) -> int:
    """Return a difference of numbers that wrap at 2^32, from -2^31 to 2^31 - 1."""
    return (difference + 2 ** 31) % 2 ** 32 - 2 ** 31
