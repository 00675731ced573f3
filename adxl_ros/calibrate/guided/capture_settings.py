# SPDX-License-Identifier: Apache-2.0

"""How poses are taken, and what a guided calibration waits for."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class StageMode(Enum):
    """Who turns the stage, and which angle counts."""

    COMMANDED = 'commanded'
    """The stage turns itself to the pose; the encoder's angle counts."""
    ENCODER = 'encoder'
    """An operator turns the stage and captures; the encoder's angle counts."""
    MANUAL = 'manual'
    """An operator turns the stage by a scale and captures; the announced angle counts."""


@dataclass(frozen=True)
class CaptureSettings:
    """How poses are taken; times are by the stamps of the samples."""

    dwell_s: float  # Time at rest for each pose, s
    # Largest distance of a joint from the pose at which a stage that turns itself has arrived, rad
    tolerance_rad: float
    timeout_s: float  # Time after which an open pose is reported as late, s
    stage_mode: StageMode  # Who turns the stage
    # Largest distance of a joint from the pose at which a capture by hand is accepted, rad. The
    # default is 2°.
    near_rad: float = 0.035
    # Largest difference of the temperature from that of the first pose, °C
    temperature_span_c: float = 3.0


class Phase(Enum):
    """What a guided calibration waits for; the values are those of the diagnostics."""

    IDLE = 'idle'
    """A start."""
    INFO = 'info'
    """The sensor's data on `sensor_info`."""
    QUESTION = 'question'
    """The operator's answer on what to do with an interrupted calibration."""
    SILENT = 'silent'
    """Samples, which have stopped."""
    OPERATOR = 'operator'
    """The operator, who turns the stage and captures."""
    STAGE = 'stage'
    """The stage, which is on its way or silent."""
    REST = 'rest'
    """The sensor, which moves."""
    DWELL = 'dwell'
    """The end of the dwell."""
    REFUSED = 'refused'
    """Something to be put right."""
    FIT = 'fit'
    """The fit."""
    DONE = 'done'
    """Nothing: all poses are taken."""


@dataclass(frozen=True)
class Status:
    """What a guided calibration waits for, for people."""

    phase: Phase  # What it waits for
    text: str  # One line with the values that matter
    # Whether somebody should look: it waits longer than the time-out, or refuses its input
    late: bool
