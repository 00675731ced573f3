# SPDX-License-Identifier: Apache-2.0

"""
The contents of the calibration screen, and the text that a topic carries them in.

- How poses are taken, and what a guided calibration waits for.
"""

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


@dataclass(frozen=True)
class AxisReading:
    """What one axis reads at present."""

    axis: str  # Name of the axis
    # mean_mps2, rms_mps2: Mean of the newest samples and their rms about it, m/s²
    mean_mps2: float
    rms_mps2: float


@dataclass(frozen=True)
class RestReading:
    """Whether the sensor is at rest."""

    at_rest: bool  # Whether both quantities of all axes are within their limits
    axis: str  # Name of the axis that moves most
    quantity: str  # 'rms' or 'drift'
    # value_mps2, limit_mps2: The quantity on that axis, and its limit, m/s²
    value_mps2: float
    limit_mps2: float


@dataclass(frozen=True)
class LiveReading:
    """What the sensor reads at present."""

    axes: tuple[AxisReading, ...]  # Reading of each measured axis
    rate_hz: float | None  # Rate of the samples by their stamps, Hz; None while they are too few
    rest: RestReading | None  # Whether the sensor is at rest; None while the samples are too few


@dataclass(frozen=True)
class Progress:
    """Progress of a calibration."""

    number: int  # Number of the next pose, from 1
    destination: str  # The pose to reach, for people
    position: str  # Where the sensor is at present, for people; '' where it is unknown
    # accepted, total, skipped: Number of accepted poses, of all poses, and of those that are left
    # out
    accepted: int
    total: int
    skipped: int = 0
    # Number of poses that a fit would miss now; 0 where the number of poses is not fixed
    open_poses: int = 0
    # Time that the open poses take, s; None where the number of poses is not fixed
    remaining_s: float | None = None
    # dwelt_s, dwell_s: Time at rest in the pose so far, and the required time, s; None without a
    # fixed dwell
    dwelt_s: float | None = None
    dwell_s: float | None = None


@dataclass(frozen=True)
class Coverage:
    """How many poses of one group are taken."""

    group: str  # Name of the group
    # accepted, total: Number of accepted poses and of all poses
    accepted: int
    total: int


@dataclass(frozen=True)
class CoefficientRow:
    """One parameter of an effect, as the poses determine it so far."""

    name: str  # Name of the parameter, with its unit
    # Most likely value and half of the 90 % interval of each axis, as text
    intervals: tuple[str, ...]
    # Relative reduction of the datasheet's standard deviation, of the worst axis, 0 to 1
    determined: float


@dataclass(frozen=True)
class Estimate:
    """What the poses determine so far."""

    coverage: tuple[Coverage, ...]  # Poses by group
    coefficients: tuple[CoefficientRow, ...]  # The parameters of the unit
    # Expected rms error of alpha and beta, degrees; None where no pose shows both
    tilt_error_deg: float | None = None
    # The same after all poses; None where the number of poses is not fixed
    final_tilt_error_deg: float | None = None
    # Expected error over a range of temperature, for people; '' for other calibrations
    range_error: str = ''


@dataclass(frozen=True)
class KeyAction:
    """What a key does."""

    key: str  # The key
    action: str  # Its action, for people
    service: str  # Name of the service of the calibration node that does it


@dataclass(frozen=True)
class ScreenContents:
    """Everything that the screen shows, except the log."""

    phase: str  # Value of the `Phase` of the calibration, which chooses the colour
    text: str  # What the calibration waits for, for people
    unit: str = ''  # Serial number and axes of the sensor; '' before they are known
    output: str = ''  # The parameter file that is to be written
    keys: tuple[KeyAction, ...] = ()  # Keys that have an action now
    live: LiveReading | None = None  # What the sensor reads; None without samples
    # progress, estimate: Progress and estimate of the running calibration; None while no
    # calibration runs
    progress: Progress | None = None
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
