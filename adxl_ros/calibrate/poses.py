# SPDX-License-Identifier: Apache-2.0

"""
Poses: mean output at rest with the angles of the encoder, by setting of each joint.

This is their data alone. `recorded_poses` finds them in recordings, `joint_settings` numbers the
settings of the joints, and `pose_model` predicts their output.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

from adxl_ros.files.sweep_journal import PoseRecord
from adxl_ros.model.constants import SAME_ANGLE_RAD
from adxl_ros.model.effects.base import Environment, NOMINAL_ENVIRONMENT
import numpy as np

_SAME_PLANE_RAD = np.radians(1.0)  # Largest difference of neighbouring angles alpha in one plane


NOT_GIVEN = np.zeros(0)  # In place of temperatures, supplies or settings that are not given


@dataclass(frozen=True)
class Poses:
    """k poses of one sensor with m measured axes."""

    volts: np.ndarray  # Mean output of each measured axis, V, (k, m)
    std_v: np.ndarray  # Standard deviation of that mean, V, (k, m)
    alpha_rad: np.ndarray  # Of the stage's encoder, unwrapped, (k,); NaN without a stage
    beta_rad: np.ndarray
    time_s: np.ndarray  # Beginning and end of each rest, s, (k, 2)
    # True for a pose that the fit does not use, so that it can show the error, (k,)
    check: np.ndarray
    # temperature_c, supply_v: Means over each rest, (k,); NaN where they were not measured
    temperature_c: np.ndarray = field(default_factory=lambda: NOT_GIVEN)
    supply_v: np.ndarray = field(default_factory=lambda: NOT_GIVEN)
    # Number of the setting of each joint, (k,) int. Poses of one setting share the error of the
    # joint. By default each change of the angle from one pose to the next begins a setting.
    alpha_setting: np.ndarray = field(default_factory=lambda: NOT_GIVEN)
    beta_setting: np.ndarray = field(default_factory=lambda: NOT_GIVEN)

    def __post_init__(self) -> None:
        """Fill in the fields that are not given."""
        for name in ('temperature_c', 'supply_v'):
            if not len(getattr(self, name)):
                object.__setattr__(self, name, np.full(len(self.volts), np.nan))
        for joint in ('alpha', 'beta'):
            if not len(getattr(self, f'{joint}_setting')):
                settings = _settings_by_angle(getattr(self, f'{joint}_rad'), self.time_s[:, 0])
                object.__setattr__(self, f'{joint}_setting', settings)

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.volts)

    @classmethod
    def without_volts(
        cls, alpha_rad: np.ndarray, beta_rad: np.ndarray, std_v: np.ndarray
    ) -> Poses:
        """Make poses that have not been measured, with a noise, (m,) or (k, m), of their means."""
        count = len(alpha_rad)
        noise_v = np.broadcast_to(std_v, (count, np.shape(std_v)[-1])).copy()
        return cls(
            volts=np.zeros_like(noise_v),
            std_v=noise_v,
            alpha_rad=alpha_rad,
            beta_rad=beta_rad,
            time_s=np.zeros((count, 2)),
            check=np.zeros(count, bool),
        )

    @staticmethod
    def from_records(records: Sequence[PoseRecord]) -> Poses:
        """Return the poses of a journal."""

        def column(name: str) -> np.ndarray:
            return np.array([getattr(record, name) for record in records])

        def settings(name: str) -> np.ndarray:
            numbers = column(name)
            return NOT_GIVEN if None in numbers else numbers.astype(int)

        stamps_ns = np.column_stack([column('start_ns'), column('stop_ns')])
        return Poses(
            volts=column('mean_v'),
            std_v=column('std_v'),
            alpha_rad=column('alpha_rad'),
            beta_rad=column('beta_rad'),
            time_s=stamps_ns * 1e-9,
            check=column('check').astype(bool),
            temperature_c=column('temperature_c'),
            supply_v=column('supply_v'),
            alpha_setting=settings('alpha_setting'),
            beta_setting=settings('beta_setting'),
        )

    @staticmethod
    def joined(parts: Sequence[Poses]) -> Poses:
        """Join the poses of several recordings of one sensor, each with settings of its own."""
        joined = {
            field.name: np.concatenate([getattr(part, field.name) for part in parts])
            for field in fields(Poses)
        }
        for name in ('alpha_setting', 'beta_setting'):
            renumbered = []
            begin = 0
            for part in parts:
                settings = getattr(part, name)
                renumbered.append(begin + settings)
                begin += int(settings.max(initial=-1)) + 1
            joined[name] = np.concatenate(renumbered)
        return Poses(**joined)

    def subset(self, chosen: np.ndarray) -> Poses:
        """Select poses by mask or by index."""
        return Poses(*(getattr(self, field.name)[chosen] for field in fields(self)))

    @property
    def environment(self) -> Environment:
        """Return temperature and supply of each rest; nominal ones where not measured."""
        known = {}
        for name in ('temperature_c', 'supply_v'):
            measured = getattr(self, name)
            nominal = getattr(NOMINAL_ENVIRONMENT, name)
            known[name] = np.where(np.isfinite(measured), measured, nominal)
        return NOMINAL_ENVIRONMENT._replace(**known)

    def with_temperature(self) -> Poses:
        """Return the poses with a temperature, in the order of time."""
        order = np.argsort(self.time_s[:, 0], kind='stable')
        return self.subset(order[np.isfinite(self.temperature_c[order])])

    @property
    def has_angles(self) -> np.ndarray:
        """Return which poses have both angles, (k,) bool."""
        return np.isfinite(self.alpha_rad) & np.isfinite(self.beta_rad)


def _settings_by_angle(angle_rad: np.ndarray, start_s: np.ndarray) -> np.ndarray:
    """Return numbers of settings by changes of the angle in the order of time, (k,) int."""
    order = np.argsort(start_s, kind='stable')
    settings = np.zeros(len(order), int)
    settings[order[1:]] = np.cumsum(np.abs(np.diff(angle_rad[order])) > SAME_ANGLE_RAD)
    return settings


def planes(alpha_rad: np.ndarray) -> list[np.ndarray]:
    """Group poses by plane: indices of those whose alpha agree within 1°."""
    order = np.argsort(alpha_rad, kind='stable')
    cuts = np.flatnonzero(np.diff(alpha_rad[order]) > _SAME_PLANE_RAD) + 1
    return np.split(order, cuts) if len(order) else []
