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

"""A recording played as if it were sensed now, in real time or faster."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files import recording
from adxl_ros.files.recording_columns import Recording, REFERENCES
from adxl_ros.files.stream_unit import uncalibrated
from adxl_ros.links.support.base import nothing, Option, Samples, State
from adxl_ros.model.sensor import Sensor
import numpy as np

OPTIONS = (
    Option('recording', '', 'the recording to play: a rosbag2 directory, .mcap or CSV'),
    Option('loop', False, 'whether to start again at its end'),
    Option('speed', 1.0, 'sensor time by real time; other than 1 with /clock', '', 0.01, 1000.0),
)

_ROWS = 2000
"""Rows read at once: some milliseconds, so that samples leave in time."""
_LAST_NS = 2 ** 31 * 10 ** 9


def open_link(sensor: Sensor, options: Mapping[str, Any]) -> Replay:
    """Open the recording; raises `UserError` when it cannot be read."""
    if not options['recording']:
        raise UserError('link.recording: names no recording; set it to a rosbag2 directory, an '
                        '.mcap or a CSV file')
    return Replay(sensor, options['recording'], options['loop'])


class Replay:
    """
    The samples of a recording at the pace of a clock, with the figures that it carries.

    Its stamps are kept relative to each other; the first is when the replay begins.
    """

    live = False
    waits = True

    def __init__(self, sensor: Sensor, path: str, loop: bool) -> None:
        """Read the first rows."""
        self._path, self._loop = path, loop
        self._blocks: Iterator[Recording] = recording.blocks(path, _ROWS)
        first = next(self._blocks)
        self.sensor = _unit(sensor, first)
        self.references = tuple(name for name in REFERENCES if name in first.columns)
        self._period_ns = round(1e9 / self.sensor.rate_hz)
        self._load(first)
        self._first_ns = int(self._stamps[0])
        # A clock of ROS cannot show what a recording may hold, such as times before 0.
        self.start_ns = self._first_ns if 0 <= self._first_ns < _LAST_NS else None
        self._offset_ns = 0
        self._last_ns = self._first_ns - self._period_ns

    def begin(self, now_ns: int) -> int:
        """Let the next sample be due now; none is lost by that."""
        if self._block is not None:
            self._offset_ns = now_ns - int(self._stamps[self._row])
            self._last_ns = now_ns - self._period_ns
        return 0

    def read(self, now_ns: int) -> Samples:
        """Return the rows that are due, at most to the end of a block."""
        if self._block is None:
            return nothing(self.sensor, now_ns)
        end = int(np.searchsorted(self._stamps, now_ns - self._offset_ns, 'right'))
        rows = slice(self._row, max(end, self._row))
        stamps = self._stamps[rows] + self._offset_ns
        steps = np.rint(np.diff(stamps, prepend=self._last_ns) / self._period_ns)
        given = Samples(stamps, self._volts[rows], now_ns, int((steps - 1).clip(0).sum()),
                        {name: self._block.columns[name][rows] for name in self.references})
        self._row = rows.stop
        if len(stamps):
            self._last_ns = int(stamps[-1])
        if self._row == len(self._stamps):
            self._turn()
            if self._block is not None and self._stamps[0] + self._offset_ns <= now_ns:
                given = replace(given, until_ns=self._last_ns)
        return given

    def state(self) -> State:
        """Say whether it plays."""
        return State('ok', 'playing' if self._block is not None else 'ended')

    def close(self) -> None:
        """Close the file."""
        self._blocks.close()

    def _load(self, block: Recording | None) -> None:
        self._block, self._row = block, 0
        if block is not None:
            self._stamps, self._volts = block.stamp_ns, block.volts(self.sensor)

    def _turn(self) -> None:
        """Go to the next block, or to the first again, or to the end."""
        self._load(next(self._blocks, None))
        if self._block is None and self._loop:
            self._blocks = recording.blocks(self._path, _ROWS)
            self._load(next(self._blocks))
            self._offset_ns = self._last_ns + self._period_ns - self._first_ns


def _unit(sensor: Sensor, first: Recording) -> Sensor:
    """
    Return the nominal sensor of a recording: what it states, the rest as the parameters.

    Calibrated coefficients have no part in the nominal conversion.
    """
    rate_hz = first.stream_info.rate_hz or (first.rate_hz if len(first) > 1 else sensor.rate_hz)
    return uncalibrated(sensor, first.stream_info, first.axes, rate_hz)
