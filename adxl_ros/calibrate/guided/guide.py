# SPDX-License-Identifier: Apache-2.0

"""
What a guide is: it leads through the poses of one calibration, with a stage or by hand.

- The newest samples of a stream, and readings of temperature and supply over time.
- What the guides of a sensor share that no stage carries.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

from adxl_ros.calibrate.guided.screen_contents import Estimate, Progress, Status
from adxl_ros.files.recording_columns import stamped_rate_hz
from adxl_ros.files.sweep_journal import JournalEntry, PoseRecord
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from adxl_ros.signals.rest_detection import datasheet_noise, RestFinder, Stillness
import numpy as np

_REST_WINDOW_S = 1.2
"""Newest samples that stay in memory, s; chosen: more than the rest detection looks at."""
_SHOWN_S = 0.5
"""Newest samples whose mean is shown, s; chosen: steady to read and still quick."""
_FEWEST_SAMPLES = 20
"""Samples that stay at the lowest rates; chosen: they give the rate."""
_BACK_NS = 1_000_000_000
"""A stamp that is earlier than the one before by more is of another clock, ns.

Chosen: messages in wrong order differ by less.
"""
_KEPT_READINGS = 100_000
"""Readings that stay in memory; chosen: 1000 s at 100 Hz."""
STALE_NS = 60_000_000_000
"""A reading counts for samples up to this far from its stamp, ns.

Chosen: temperature and supply hardly change in a minute.
"""


def went_back(newest_ns: int, stamp_ns: int) -> bool:
    """Return whether stamps go back, since the driver was restarted or a clock was set."""
    return stamp_ns < newest_ns - _BACK_NS


class NewestSamples:
    """The newest 1.2 s of a stream, and at least twenty samples."""

    def __init__(self, sensor: Sensor) -> None:
        self._sensor = sensor
        self._keep = max(round(_REST_WINDOW_S * sensor.rate_hz), _FEWEST_SAMPLES)
        self._show = max(round(_SHOWN_S * sensor.rate_hz), _FEWEST_SAMPLES)
        self.stamps_ns = np.zeros(0, np.int64)  # Stamps, ns, (n,)
        self.volts = np.zeros((0, len(sensor.axes)))  # Samples, V, (n, m)

    def feed(self, stamps_ns: np.ndarray, volts: np.ndarray) -> None:
        """
        Take samples.

        stamps_ns: their stamps, ns, (n,); volts: the samples, V, (n, m).
        """
        self.stamps_ns = np.concatenate([self.stamps_ns, stamps_ns])[-self._keep:]
        self.volts = np.concatenate([self.volts, volts])[-self._keep:]

    def mean_mps2(self) -> list[float]:
        """Return the mean of each axis, m/s², (m,)."""
        return self._shown().mean(axis=0).tolist()

    def rms_mps2(self) -> list[float]:
        """Return the rms of each axis about its mean, m/s², (m,)."""
        return self._shown().std(axis=0).tolist()

    def stillness(self) -> Stillness | None:
        """Return whether the samples are at rest, by the datasheet's noise; None if too few."""
        finder = RestFinder(self._sensor.rate_hz, len(self._sensor.axes),
                            datasheet_noise(self._sensor), learn=False)
        if len(self.stamps_ns):
            finder.feed((self.stamps_ns - self.stamps_ns[0]) * 1e-9, self.volts)
        return finder.stillness()

    def rate_hz(self) -> float:
        """Return the rate of the stamps, Hz; NaN while there are too few of them."""
        if len(self.stamps_ns) < _FEWEST_SAMPLES:
            return float('nan')
        return stamped_rate_hz((self.stamps_ns - self.stamps_ns[0]) * 1e-9)

    def _shown(self) -> np.ndarray:
        return to_nominal_mps2(self.volts[-self._show:], self._sensor)


class Readings:
    """Readings of one quantity over time."""

    def __init__(self) -> None:
        self._stamps_ns: deque[int] = deque(maxlen=_KEPT_READINGS)
        self._values: deque[float] = deque(maxlen=_KEPT_READINGS)

    def add(self, stamp_ns: int, value: float) -> None:
        """Take a reading; one that is not finite is left out."""
        if not np.isfinite(value):
            return
        if self._stamps_ns and stamp_ns < self._stamps_ns[-1]:
            self._stamps_ns.clear()
            self._values.clear()
        self._stamps_ns.append(stamp_ns)
        self._values.append(value)

    def mean(self, first_ns: int, last_ns: int) -> float:
        """Average the readings between two stamps, or return the last reading before."""
        begin = bisect_left(self._stamps_ns, first_ns)
        end = bisect_right(self._stamps_ns, last_ns)
        if begin == end and end and first_ns - self._stamps_ns[end - 1] < STALE_NS:
            begin = end - 1
        if begin == end:
            return float('nan')
        return float(np.mean([self._values[i] for i in range(begin, end)]))


class Surroundings:
    """Temperature and supply over time."""

    def __init__(self) -> None:
        self.temperature_c = Readings()  # Readings of the temperature, °C
        self.supply_v = Readings()  # Readings of the supply, V


class NextPose(NamedTuple):
    """The pose to go to, as it is announced."""

    text: str  # One line for people
    values: Mapping[str, str | float]  # Values for programs, by key
    # Angles alpha and beta for a stage that turns itself, rad; None for others
    command_rad: tuple[float, float] | None
    newest_ns: int = 0  # Stamp of the newest sample, ns: a command is given after it


class Guide(Protocol):
    """Leads through the poses of one calibration: samples go in, accepted poses come out."""

    accepted: dict[int, PoseRecord]  # Accepted poses by number
    surroundings: Surroundings  # Temperature and supply over time
    newest_ns: int | None  # Stamp of the newest sample, ns; None before the first

    @property
    def moves_itself(self) -> bool:
        """Return whether a stage turns itself, so that nobody captures."""

    @property
    def is_over(self) -> bool:
        """Return whether no pose is open; a hand-held calibration ends by `finish` only."""

    @property
    def open_poses(self) -> int:
        """Return the number of open poses; 0 where the number of poses is not fixed."""

    @property
    def poses_to_verify(self) -> int:
        """Return how many poses are still to be taken again for the check of the mounting."""

    @property
    def pose_number(self) -> int:
        """Return the number of the next pose, from 1."""

    @property
    def previous(self) -> int | None:
        """Return the number of the previous pose, from 0; None where there is none."""

    def feed(self, stamps_ns: np.ndarray, volts: np.ndarray) -> None:
        """
        Take samples.

        stamps_ns: their stamps, ns, (n,); volts: the samples, V, (n, m).
        """

    def read_encoder(self, stamp_ns: int, alpha_rad: float, beta_rad: float) -> None:
        """Take the angles of the stage."""

    def read_command(self, alpha_rad: float, beta_rad: float) -> None:
        """Take a command that somebody gave the stage."""

    def accept(self) -> PoseRecord | None:
        """Return the next pose for the journal, if one is complete."""

    def take(self, record: PoseRecord) -> None:
        """Count a pose that is on disk, and go on to the next one."""

    def retry(self) -> None:
        """Take the same pose again, since its record is not on disk."""

    def capture(self) -> str:
        """Take the pose in which the operator has put the sensor; return an obstacle or ''."""

    def verify(self) -> None:
        """Take earlier poses again, to check that the mounting is as it was."""

    def skip_entry(self) -> JournalEntry | None:
        """Return the entry that the journal needs before `skip`; None for none."""

    def skip(self) -> str:
        """Leave out the open pose; return a line for people."""

    def redo(self) -> str:
        """Forget the previous pose; return a line for people, or '' where there is none."""

    def poses_to_fit(self) -> list[PoseRecord]:
        """Return the poses for the fit."""

    def new_refusal(self) -> str:
        """Return why a pose was refused since the last call, or ''."""

    def status(self) -> Status:
        """Return what the guide waits for."""

    def destination(self) -> str:
        """Name the pose to reach, for people."""

    def next_pose(self) -> NextPose | None:
        """Return the pose to announce; None where no pose is open."""

    def values(self) -> dict[str, str | float]:
        """Return further values for programs, by key."""

    def tilt_error_rad(self) -> float:
        """Return the expected rms error of alpha and beta by the poses so far, rad."""

    def stillness(self, newest: NewestSamples) -> Stillness | None:
        """Return whether the newest samples are at rest; None while they are too few."""

    def progress(self) -> Progress:
        """Return the progress of the calibration, for the screen."""

    def estimate_contents(self) -> Estimate:
        """Return what the poses determine so far, for the screen; this costs some time."""


class StagelessGuide:
    """
    The part of a `Guide` that is the same for all sensors without a stage.

    No pose is known before it is taken, so that none is open, and none can be taken again to
    check the mounting.
    """

    moves_itself = False
    open_poses = 0
    poses_to_verify = 0

    def __init__(self, sensor: Sensor, accepted: Sequence[PoseRecord]) -> None:
        self.sensor = sensor
        self.accepted = {record.pose: record for record in accepted}
        self.surroundings = Surroundings()
        self.newest_ns: int | None = None
        self._new_refusal = ''

    @property
    def pose_number(self) -> int:
        """Return the number of the next pose, from 1."""
        return len(self.accepted) + 1

    @property
    def previous(self) -> int | None:
        """Return the number of the newest pose, from 0; None where there is none."""
        return max(self.accepted, default=None)

    @property
    def next_number(self) -> int:
        """Return the number that the journal gives the next pose, from 0."""
        return max(self.accepted, default=-1) + 1

    def verify(self) -> None:
        """Do nothing: no pose can be taken again."""

    def read_encoder(self, stamp_ns: int, alpha_rad: float, beta_rad: float) -> None:
        """Do nothing: no stage carries the sensor."""

    def read_command(self, alpha_rad: float, beta_rad: float) -> None:
        """Do nothing: no stage carries the sensor."""

    def skip_entry(self) -> JournalEntry | None:
        """Return None: what is left out has no entry in the journal."""
        return None

    def new_refusal(self) -> str:
        """Return why a pose was refused since the last call, or ''."""
        text, self._new_refusal = self._new_refusal, ''
        return text

    def _accepted_records(self) -> list[PoseRecord]:
        """Return the accepted poses, by number."""
        return [self.accepted[number] for number in sorted(self.accepted)]

    def _saturated(self, part: str) -> str:
        """Return that a part of the stream, 'rest' or 'block', is refused as saturated."""
        return (f'saturated: samples of the {part} are beyond the range of '
                f'±{self.sensor.range_g:g} g or at a rail of the ADC; check supply and wiring')
