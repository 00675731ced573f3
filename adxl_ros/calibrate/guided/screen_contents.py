# SPDX-License-Identifier: Apache-2.0

"""The contents of the calibration screen, and the text that a topic carries them in."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import Enum
import json
import math
from typing import NamedTuple


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

    dwell_s: float  # Time at rest for each pose
    tolerance_rad: float  # Largest distance of a stage that turns itself and has arrived
    timeout_s: float  # Time after which an open pose is reported as late
    stage_mode: StageMode
    near_rad: float = 0.035  # Largest distance at which a capture by hand is accepted: 2°
    temperature_span_c: float = 3.0  # Largest difference from the first pose


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
class GuideStatus:
    """What a guided calibration waits for, for people."""

    phase: Phase  # What it waits for
    text: str  # One line with the values that matter
    late: bool = False  # Whether somebody should look: it waits for long, or refuses its input


@dataclass(frozen=True)
class ScreenRow:
    """A line of the screen."""

    label: str
    text: str
    share: float | None = None  # Of a bar before the text that is full; None without a bar
    style: str = ''  # Of prompt_toolkit


class EstimateRows(NamedTuple):
    """What the poses so far show."""

    expected: list[ScreenRow]  # What is covered, and the expected error
    coefficients: list[ScreenRow]


def tilt_row(now_rad: float, final_rad: float = math.nan) -> ScreenRow:
    """Return the expected rms tilt error now, and after all poses if their number is fixed."""
    if not math.isfinite(now_rad):
        return ScreenRow('tilt error', 'one axis does not show the vertical')
    final = f', {math.degrees(final_rad):.2g}° after all poses' if math.isfinite(final_rad) else ''
    return ScreenRow(
        'tilt error', f'{math.degrees(now_rad):.2g}° expected now{final}', style='bold'
    )


@dataclass(frozen=True)
class KeyAction:
    """What a key does."""

    key: str
    action: str  # For people
    service: str  # Of the calibration node


@dataclass(frozen=True)
class ScreenContents:
    """Everything that the screen shows, except the log."""

    phase: Phase  # It chooses the colour
    text: str  # What the calibration waits for, for people
    unit: str = ''  # Serial number and axes of the sensor; '' before they are known
    output: str = ''  # The parameter file that is to be written
    keys: tuple[KeyAction, ...] = ()  # Keys that have an action now
    rows: tuple[ScreenRow, ...] = ()  # What the sensor reads, and the progress
    coefficients: tuple[ScreenRow, ...] = ()  # As the poses determine them so far
    outcome: tuple[str, ...] = ()  # Lines on the calibration that has ended

    def to_json(self) -> str:
        """Return the contents as text."""
        return json.dumps({**asdict(self), 'phase': self.phase.value})

    @staticmethod
    def from_json(text: str) -> ScreenContents:
        """
        Return the contents of a text of this version.

        That of another version raises LookupError, TypeError or ValueError.
        """
        values = json.loads(text)
        return ScreenContents(
            **{
                **values,
                'phase': Phase(values['phase']),
                'keys': tuple(KeyAction(**key) for key in values['keys']),
                'rows': tuple(ScreenRow(**row) for row in values['rows']),
                'coefficients': tuple(ScreenRow(**row) for row in values['coefficients']),
                'outcome': tuple(values['outcome']),
            }
        )
