# SPDX-License-Identifier: Apache-2.0

"""A recording that is played as a live sensor, in real time or faster."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace

from adxl_ros.errors import UserError
from adxl_ros.files import recording
from adxl_ros.files.recording_columns import Recording, REFERENCES
from adxl_ros.files.stream_info import uncalibrated
from adxl_ros.links.support import base
from adxl_ros.model.sensor import Sensor
import numpy as np

_ROWS = 2000
"""Rows of a block. Chosen: reading a block takes some milliseconds, so samples leave in time."""
_MAX_CLOCK_NS = 2**31 * 10**9  # Largest time of a ROS clock, ns: its seconds are an int32


@dataclass(frozen=True)
class Settings(base.PacedSettings):
    """Settings of the link."""

    recording: str = base.option('', 'the recording to play: a rosbag2 directory, .mcap or CSV')
    loop: bool = base.option(False, 'whether the recording starts again at its end')


def open_link(sensor: Sensor, settings: Settings) -> Replay:
    """Open the recording."""
    if not settings.recording:
        raise UserError(
            'link.recording: names no recording; set it to a rosbag2 directory, an '
            '.mcap or a CSV file'
        )
    return Replay(sensor, settings)


class Replay(base.Link):
    """
    The samples of a recording at the pace of a clock.

    The stamps keep their distances; the first one is the time at which the replay begins.
    """

    live = False
    waits_for_listener = True
    sensor: Sensor
    _block: Recording | None
    _row: int
    _stamps: np.ndarray
    _volts: np.ndarray

    def __init__(self, sensor: Sensor, settings: Settings) -> None:
        self._path = settings.recording
        self._loop = settings.loop
        self._blocks = self._all_blocks()
        first = next(self._blocks)
        self.sensor = _recorded_sensor(sensor, first)
        self.references = tuple(name for name in REFERENCES if name in first.columns)
        self._period_ns = round(1e9 / self.sensor.rate_hz)
        self._load(first)
        self._first_ns = int(self._stamps[0])
        # A recording may hold times that a clock of ROS cannot show, such as times before 0.
        self.start_ns = self._first_ns if 0 <= self._first_ns < _MAX_CLOCK_NS else None
        self._offset_ns = 0
        self._last_ns = self._first_ns - self._period_ns
        self._has_ended = False

    def begin(self, now_ns: int) -> int:
        """Make the next sample due now; no sample is lost."""
        if self._block is not None:
            self._offset_ns = now_ns - int(self._stamps[self._row])
            self._last_ns = now_ns - self._period_ns
        return 0

    def read(self, now_ns: int) -> base.Samples:
        """Return the rows that are due, at most to the end of a block."""
        block = self._block
        # The samples of the read before this one are out: what they end has ended now.
        self._has_ended = block is None
        if block is None:
            return base.no_samples(self.sensor, now_ns)
        end = int(np.searchsorted(self._stamps, now_ns - self._offset_ns, 'right'))
        rows = slice(self._row, max(end, self._row))
        stamps = self._stamps[rows] + self._offset_ns
        periods = np.rint(np.diff(stamps, prepend=self._last_ns) / self._period_ns)
        samples = base.Samples(
            stamps,
            self._volts[rows],
            now_ns,
            int((periods - 1).clip(0).sum()),
            {name: block.columns[name][rows] for name in self.references},
        )
        self._row = rows.stop
        if len(stamps):
            self._last_ns = int(stamps[-1])
        if self._row == len(block):
            self._load(next(self._blocks, None))
            if self._block is not None and self._stamps[0] + self._offset_ns <= now_ns:
                samples = replace(samples, until_ns=self._last_ns)
        return samples

    def status(self) -> base.LinkStatus:
        """Return whether the recording plays; it has ended once a read found no row."""
        return base.LinkStatus(base.Level.OK, 'ended' if self._has_ended else 'playing')

    def close(self) -> None:
        """Close the file."""
        self._blocks.close()

    def _load(self, block: Recording | None) -> None:
        """Make a block the present one; None after the last one."""
        self._block = block
        self._row = 0
        if block is not None:
            self._stamps = block.stamp_ns
            self._volts = block.volts(self.sensor)

    def _all_blocks(self) -> Generator[Recording, None, None]:
        """Yield the blocks of the recording, again and again where it starts again at its end."""
        yield from recording.blocks(self._path, _ROWS)
        while self._loop:
            self._offset_ns = self._last_ns + self._period_ns - self._first_ns
            yield from recording.blocks(self._path, _ROWS)


def _recorded_sensor(sensor: Sensor, first: Recording) -> Sensor:
    """Return the nominal sensor of a recording; what it does not state is as in the parameters."""
    rate_hz = first.stream_info.rate_hz or (first.rate_hz if len(first) > 1 else sensor.rate_hz)
    return uncalibrated(sensor, first.stream_info, first.axes, rate_hz)
