# SPDX-License-Identifier: Apache-2.0

"""What a guide is: it leads through the poses of one calibration, with a stage or by hand."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Protocol

from adxl_ros.calibrate.guided.capture_settings import Status
from adxl_ros.calibrate.guided.live_window import NewestSamples, Surroundings
from adxl_ros.calibrate.guided.screen_contents import Estimate, Progress
from adxl_ros.files.sweep_journal import JournalEntry, PoseRecord
from adxl_ros.signals.rest_detection import Stillness
import numpy as np


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
