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

"""The contents of the calibration screen, and the text that a topic carries them in."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
import json
from typing import Any


@dataclass(frozen=True)
class AxisReading:
    """
    What one axis reads at present.

    Attributes
    ----------
    axis
        Name of the axis.
    mean_mps2, rms_mps2
        Mean of the newest samples and their rms about it, m/s².

    """

    axis: str
    mean_mps2: float
    rms_mps2: float


@dataclass(frozen=True)
class RestReading:
    """
    Whether the sensor is at rest.

    Attributes
    ----------
    at_rest
        Whether both quantities of all axes are within their limits.
    axis
        Name of the axis that moves most.
    quantity
        'rms' or 'drift'.
    value_mps2, limit_mps2
        The quantity on that axis, and its limit, m/s².

    """

    at_rest: bool
    axis: str
    quantity: str
    value_mps2: float
    limit_mps2: float


@dataclass(frozen=True)
class LiveReading:
    """
    What the sensor reads at present.

    Attributes
    ----------
    axes
        Reading of each measured axis.
    rate_hz
        Rate of the samples by their stamps, Hz; None while they are too few.
    rest
        Whether the sensor is at rest; None while the samples are too few.

    """

    axes: tuple[AxisReading, ...]
    rate_hz: float | None
    rest: RestReading | None


@dataclass(frozen=True)
class Progress:
    """
    Progress of a calibration.

    Attributes
    ----------
    number
        Number of the next pose, from 1.
    destination
        The pose to reach, for people.
    position
        Where the sensor is at present, for people; '' where it is unknown.
    accepted, total, skipped
        Number of accepted poses, of all poses, and of those that are left out.
    open_poses
        Number of poses that a fit would miss now; 0 where the number of poses is not fixed.
    remaining_s
        Time that the open poses take, s; None where the number of poses is not fixed.
    dwelt_s, dwell_s
        Time at rest in the pose so far, and the required time, s; None without a fixed dwell.

    """

    number: int
    destination: str
    position: str
    accepted: int
    total: int
    skipped: int
    open_poses: int
    remaining_s: float | None
    dwelt_s: float | None
    dwell_s: float | None


@dataclass(frozen=True)
class Coverage:
    """
    How many poses of one group are taken.

    Attributes
    ----------
    group
        Name of the group.
    accepted, total
        Number of accepted poses and of all poses.

    """

    group: str
    accepted: int
    total: int


@dataclass(frozen=True)
class CoefficientRow:
    """
    One parameter of an effect, as the poses determine it so far.

    Attributes
    ----------
    name
        Name of the parameter, with its unit.
    intervals
        Most likely value and half of the 90 % interval of each axis, as text.
    determined
        Relative reduction of the datasheet's standard deviation, of the worst axis, 0 to 1.

    """

    name: str
    intervals: tuple[str, ...]
    determined: float


@dataclass(frozen=True)
class Estimate:
    """
    What the poses determine so far.

    Attributes
    ----------
    coverage
        Poses by group.
    covered_faces
        Faces of the sensor that have pointed up, for people; '' with a stage.
    coefficients
        The parameters of the unit.
    tilt_error_deg
        Expected rms error of alpha and beta, degrees; None where no pose shows both.
    final_tilt_error_deg
        The same after all poses; None where the number of poses is not fixed.
    range_error
        Expected error over a range of temperature, for people; '' for other calibrations.

    """

    coverage: tuple[Coverage, ...]
    covered_faces: str
    coefficients: tuple[CoefficientRow, ...]
    tilt_error_deg: float | None
    final_tilt_error_deg: float | None
    range_error: str = ''


@dataclass(frozen=True)
class KeyAction:
    """
    What a key does.

    Attributes
    ----------
    key
        The key.
    action
        Its action, for people.
    service
        Name of the service of the calibration node that does it.

    """

    key: str
    action: str
    service: str


@dataclass(frozen=True)
class ScreenContents:
    """
    Everything that the screen shows, except the log.

    Attributes
    ----------
    phase
        Value of the `Phase` of the calibration, which chooses the colour.
    text
        What the calibration waits for, for people.
    unit
        Serial number and axes of the sensor; '' before they are known.
    output
        The parameter file that is to be written.
    keys
        Keys that have an action now.
    live
        What the sensor reads; None without samples.
    progress, estimate
        Progress and estimate of the running calibration; None while no calibration runs.
    outcome
        Lines on the calibration that has ended.

    """

    phase: str
    text: str
    unit: str = ''
    output: str = ''
    keys: tuple[KeyAction, ...] = ()
    live: LiveReading | None = None
    progress: Progress | None = None
    estimate: Estimate | None = None
    outcome: tuple[str, ...] = ()

    def to_json(self) -> str:
        """Return the contents as text."""
        return json.dumps(asdict(self))

    @staticmethod
    def from_json(text: str) -> ScreenContents:
        """
        Return the contents of a text.

        Raises
        ------
        ValueError
            The text is no contents of this version of the package.

        """
        contents = json.loads(text, object_hook=_restore)
        if not isinstance(contents, ScreenContents):
            raise ValueError('no contents of a screen')
        return contents


_CLASSES = (AxisReading, RestReading, LiveReading, Progress, Coverage, CoefficientRow, Estimate,
            KeyAction, ScreenContents)
"""The classes of the contents."""
_KINDS: dict[frozenset[str], Any] = {
    frozenset(field.name for field in fields(kind)): kind for kind in _CLASSES}
"""The class of each object of the text, by the names of its fields."""


def _restore(values: dict[str, Any]) -> object:
    """Return the object whose fields are in an object of JSON."""
    kind = _KINDS.get(frozenset(values))
    if kind is None:
        raise ValueError(f'no object of a screen: {", ".join(values)}')
    return kind(**{name: tuple(value) if isinstance(value, list) else value
                   for name, value in values.items()})
