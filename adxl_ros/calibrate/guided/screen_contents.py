# SPDX-License-Identifier: Apache-2.0

"""The contents of the calibration screen, and the text that a topic carries them in."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import Enum
import json
from typing import Any, get_args, get_type_hints


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
class Status:
    """What a guided calibration waits for, for people."""

    phase: Phase  # What it waits for
    text: str  # One line with the values that matter
    late: bool  # Whether somebody should look: it waits for long, or refuses its input


@dataclass(frozen=True)
class AxisReading:
    """What one axis reads at present."""

    axis: str
    mean_mps2: float  # Of the newest samples
    rms_mps2: float  # About the mean


@dataclass(frozen=True)
class RestReading:
    """Whether the sensor is at rest."""

    at_rest: bool  # Whether both quantities of all axes are within their limits
    axis: str  # The one that moves most
    quantity: str  # 'rms' or 'drift'
    value_mps2: float  # The quantity on that axis
    limit_mps2: float


@dataclass(frozen=True)
class LiveReading:
    """What the sensor reads at present."""

    axes: tuple[AxisReading, ...]
    rate_hz: float | None  # By the stamps; None while the samples are too few
    rest: RestReading | None  # None while the samples are too few


@dataclass(frozen=True)
class Progress:
    """Progress of a calibration."""

    number: int  # Number of the next pose, from 1
    destination: str  # The pose to reach, for people
    position: str  # Where the sensor is at present, for people; '' where it is unknown
    accepted: int  # Number of accepted poses
    total: int
    skipped: int = 0
    open_poses: int = 0  # That a fit would miss now; 0 where the number of poses is not fixed
    remaining_s: float | None = None  # For the open poses; None where their number is not fixed
    dwelt_s: float | None = None  # Time at rest in the pose so far; None without a fixed dwell
    dwell_s: float | None = None  # The required time


@dataclass(frozen=True)
class Coverage:
    """How many poses of one group are taken."""

    group: str
    accepted: int
    total: int


@dataclass(frozen=True)
class CoefficientRow:
    """One parameter of an effect, as the poses determine it so far."""

    name: str  # With its unit
    intervals: tuple[str, ...]  # Value and half of the 90 % interval of each axis
    determined: float  # Share of the datasheet's standard deviation that is gone, worst axis


@dataclass(frozen=True)
class Estimate:
    """What the poses determine so far."""

    coverage: tuple[Coverage, ...]
    coefficients: tuple[CoefficientRow, ...]
    tilt_error_deg: float | None = None  # Expected rms; None where no pose shows both angles
    final_tilt_error_deg: float | None = None  # After all poses, if their number is fixed
    range_error: str = ''  # Expected error over a range of temperature, if that is calibrated


@dataclass(frozen=True)
class KeyAction:
    """What a key does."""

    key: str
    action: str  # For people
    service: str  # Of the calibration node


@dataclass(frozen=True)
class ScreenContents:
    """Everything that the screen shows, except the log."""

    phase: str  # Value of the `Phase` of the calibration, which chooses the colour
    text: str  # What the calibration waits for, for people
    unit: str = ''  # Serial number and axes of the sensor; '' before they are known
    output: str = ''  # The parameter file that is to be written
    keys: tuple[KeyAction, ...] = ()  # Keys that have an action now
    live: LiveReading | None = None  # None without samples
    progress: Progress | None = None  # Of the running calibration, if one runs
    estimate: Estimate | None = None
    outcome: tuple[str, ...] = ()  # Lines on the calibration that has ended

    def to_json(self) -> str:
        """Return the contents as text."""
        return json.dumps(asdict(self))

    @staticmethod
    def from_json(text: str) -> ScreenContents:
        """Return the contents of a text."""
        try:
            contents: ScreenContents = _restored(ScreenContents, dict(json.loads(text)))
        except (LookupError, TypeError, ValueError) as error:
            raise ValueError(f'no contents of a screen: {error}') from None
        return contents


def _restored(kind: Any, value: Any) -> Any:
    """Return a value of JSON as the type that its field states."""
    if isinstance(value, list):
        return tuple(_restored(get_args(kind)[0], part) for part in value)
    if not isinstance(value, dict):
        return value
    kind = next(iter(get_args(kind)), kind)  # Of `Kind | None`
    kinds = get_type_hints(kind)
    return kind(**{name: _restored(kinds[name], part) for name, part in value.items()})
