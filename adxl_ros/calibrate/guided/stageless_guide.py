# SPDX-License-Identifier: Apache-2.0

"""What the guides of a sensor share that no stage carries."""

from __future__ import annotations

from collections.abc import Sequence

from adxl_ros.calibrate.guided.live_window import Surroundings
from adxl_ros.files.sweep_journal import JournalEntry, PoseRecord
from adxl_ros.model.sensor import Sensor


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
