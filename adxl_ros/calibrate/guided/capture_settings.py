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
    """
    How poses are taken; times are by the stamps of the samples.

    Attributes
    ----------
    dwell_s
        Time at rest for each pose, s.
    tolerance_rad
        Largest distance of a joint from the pose at which a stage that turns itself has arrived,
        rad.
    timeout_s
        Time after which an open pose is reported as late, s.
    stage_mode
        Who turns the stage.
    near_rad
        Largest distance of a joint from the pose at which a capture by hand is accepted, rad.
        The default is 2°.
    temperature_span_c
        Largest difference of the temperature from that of the first pose, °C.

    """

    dwell_s: float
    tolerance_rad: float
    timeout_s: float
    stage_mode: StageMode
    near_rad: float = 0.035
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
    """
    What a guided calibration waits for, for people.

    Attributes
    ----------
    phase
        What it waits for.
    text
        One line with the values that matter.
    late
        Whether somebody should look: it waits longer than the time-out, or refuses its input.

    """

    phase: Phase
    text: str
    late: bool
