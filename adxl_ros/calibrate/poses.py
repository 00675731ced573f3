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

"""Poses: the mean output at rest beside the stage angles that the encoder gave."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

from adxl_ros.errors import UserError
from adxl_ros.files.sweep_journal import PoseRecord
from adxl_ros.model import signal_chain
from adxl_ros.model.constants import AXES
from adxl_ros.model.effects.base import Components, Environment, NOMINAL_ENVIRONMENT, Value
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import Sensor
import numpy as np

SAME_ANGLE_RAD = 1e-5
"""Angles that differ by less are the same, rad: rounding in a file is no motion."""


@dataclass(frozen=True)
class Poses:
    """
    Rests of one unit, (k,) of them.

    Attributes
    ----------
    volts, std_v
        Mean output of each measured axis and the standard deviation of that mean, V, (k, m).
    alpha_rad, beta_rad
        What the stage's encoder said, unwrapped, (k,); NaN without a stage.
    time_s
        Beginning and end of each rest, s, (k, 2).
    check
        True for a pose that is kept out of the fit to judge it, (k,).
    temperature_c, supply_v
        Means over each rest, (k,); NaN where they were not measured.
    alpha_setting, beta_setting
        Number of the setting of each joint, (k,) int. Poses of one setting were taken without a
        move of the joint between them, so that they share its error; see `joint_settings`. Where
        they are not given, each change of the angle from one pose to the next in time is a move.

    """

    volts: np.ndarray
    std_v: np.ndarray
    alpha_rad: np.ndarray
    beta_rad: np.ndarray
    time_s: np.ndarray
    check: np.ndarray
    temperature_c: np.ndarray = None  # type: ignore[assignment]
    supply_v: np.ndarray = None  # type: ignore[assignment]
    alpha_setting: np.ndarray = None  # type: ignore[assignment]
    beta_setting: np.ndarray = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        """Take what was not measured as unknown, and settings from changes of the angles."""
        for name in ('temperature_c', 'supply_v'):
            if getattr(self, name) is None:
                object.__setattr__(self, name, np.full(len(self.volts), np.nan))
        for joint in ('alpha', 'beta'):
            if getattr(self, f'{joint}_setting') is None:
                object.__setattr__(self, f'{joint}_setting', _settings_by_angle(
                    getattr(self, f'{joint}_rad'), self.time_s[:, 0]))

    def __len__(self) -> int:
        """Count the poses."""
        return len(self.volts)

    @staticmethod
    def from_records(records: Sequence[PoseRecord]) -> Poses:
        """Take the poses of a journal."""
        def column(name: str) -> np.ndarray:
            return np.array([getattr(record, name) for record in records])

        def settings(name: str) -> np.ndarray:
            return np.array([-1 if getattr(record, name) is None else getattr(record, name)
                             for record in records], int)

        stamps_ns = np.array([[record.start_ns, record.stop_ns] for record in records])
        check = np.array([record.check for record in records], bool)
        poses = Poses(column('mean_v'), column('std_v'), column('alpha_rad'), column('beta_rad'),
                      stamps_ns * 1e-9, check, column('temperature_c'), column('supply_v'))
        # Journals of earlier versions have no numbers of settings.
        numbers = {name: _numbered(settings(name), getattr(poses, name))
                   for name in ('alpha_setting', 'beta_setting')}
        return replace(poses, **numbers)

    def subset(self, chosen: np.ndarray) -> Poses:
        """Keep some of the poses, by mask or index."""
        return Poses(*(getattr(self, field.name)[chosen] for field in fields(self)))

    @property
    def environment(self) -> Environment:
        """Temperature and supply of each rest; the nominal ones where they were not measured."""
        return NOMINAL_ENVIRONMENT._replace(
            temperature_c=_known(self.temperature_c, NOMINAL_ENVIRONMENT.temperature_c),
            supply_v=_known(self.supply_v, NOMINAL_ENVIRONMENT.supply_v))


def join_poses(parts: list[Poses]) -> Poses:
    """Join the poses of several recordings of one unit; no setting outlasts its recording."""
    joined = {field.name: np.concatenate([getattr(part, field.name) for part in parts])
              for field in fields(Poses)}
    for name in ('alpha_setting', 'beta_setting'):
        first = 0
        numbers = []
        for part in parts:
            setting = getattr(part, name)
            numbers.append(setting + first)
            first += int(setting.max(initial=-1)) + 1
        joined[name] = np.concatenate(numbers)
    return Poses(**joined)


def _settings_by_angle(angle_rad: np.ndarray, start_s: np.ndarray) -> np.ndarray:
    """Tell settings apart by the changes of the angle, in the order of time, (k,) int."""
    order = np.argsort(start_s, kind='stable')
    settings = np.zeros(len(order), int)
    settings[order[1:]] = np.cumsum(np.abs(np.diff(angle_rad[order])) > SAME_ANGLE_RAD)
    return settings


def _numbered(given: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """Return numbers of settings; a negative one gives way to a number that no other has."""
    missing = given < 0
    return np.where(missing, otherwise, given + otherwise.max() + 1) if missing.any() else given


def _known(values: np.ndarray, otherwise: Value) -> np.ndarray:
    return np.where(np.isfinite(values), values, otherwise)


def reference_force(poses: Poses, gravity_mps2: float) -> Components:
    """Return the specific force that the stage angles promise, m/s², three components (k,)."""
    return specific_force(poses.alpha_rad, poses.beta_rad, gravity_mps2)


def pose_variance(sensor: Sensor, poses: Poses) -> np.ndarray:
    """
    Variance of a pose's volts about the model, V², (k, m): noise of the mean and the encoder's.

    An encoder of step r leaves the true angle uniform within it: variance r²/12 a joint.
    """
    respond = signal_chain.static_response(sensor)
    variance = poses.std_v ** 2
    step = 1e-4
    for joint in range(2):
        ends = []
        for side in (step, -step):
            ends.append(np.column_stack(respond(specific_force(
                poses.alpha_rad + side * (joint == 0), poses.beta_rad + side * (joint == 1),
                sensor.local_gravity_mps2))))
        slope = (ends[0] - ends[1]) / (2 * step)
        variance = variance + slope ** 2 * sensor.stage_resolution_rad ** 2 / 12
    return variance


def check_polarity(sensor: Sensor, poses: Poses) -> None:
    """
    Refuse a unit whose axes do not follow the stage as the frames say.

    Raises
    ------
    UserError
        An axis moves against its reference, or with that of another axis: inverted or swapped.

    """
    if len(poses) < 2:
        return
    reference = np.column_stack(reference_force(poses, sensor.local_gravity_mps2))
    for d, axis in enumerate(sensor.axes):
        with np.errstate(invalid='ignore', divide='ignore'):
            strength = np.array([np.corrcoef(poses.volts[:, d], reference[:, c])[0, 1]
                                 for c in range(3)])
        own = AXES.index(axis)
        if not np.isfinite(strength[own]) or (abs(strength[own]) > 0.9 and strength[own] > 0):
            continue
        if strength[own] < -0.9:
            raise UserError(f'{axis}: reads against the stage (correlation {strength[own]:.2f}):'
                            ' the axis is inverted; correct its sign or the mounting')
        other = int(np.nanargmax(np.abs(strength)))
        if other != own and abs(strength[other]) > 0.9:
            sign = 'against' if strength[other] < 0 else 'with'
            raise UserError(f"{axis}: moves {sign} the stage's {AXES[other]} (correlation "
                            f'{strength[other]:.2f}): axes are swapped; correct the wiring or '
                            'the mounting')
