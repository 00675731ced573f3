# SPDX-License-Identifier: Apache-2.0

"""
Poses: mean output at rest with the angles of the stage's encoder.

- Poses whose angles a table states, and poses without angles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

from adxl_ros.errors import UserError
from adxl_ros.files.sweep_journal import PoseRecord
from adxl_ros.files.tables import PoseTable
from adxl_ros.model.constants import AXES
from adxl_ros.model.effects.base import Components, Environment, NOMINAL_ENVIRONMENT, Value
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.recorded_sensor import CERTAIN_CORRELATION, find_polarity_fault
from adxl_ros.signals.rest_detection import SAME_ANGLE_RAD
import numpy as np


@dataclass(frozen=True)
class Poses:
    """k poses of one unit with m measured axes."""

    # volts, std_v: Mean output of each measured axis and the standard deviation of that mean, V,
    # (k, m)
    volts: np.ndarray
    std_v: np.ndarray
    # alpha_rad, beta_rad: Angles of the stage's encoder, unwrapped, (k,); NaN without a stage
    alpha_rad: np.ndarray
    beta_rad: np.ndarray
    time_s: np.ndarray  # Beginning and end of each rest, s, (k, 2)
    # True for a pose that the fit does not use, so that it can show the error, (k,)
    check: np.ndarray
    # temperature_c, supply_v: Means over each rest, (k,); NaN where they were not measured
    temperature_c: np.ndarray = None  # type: ignore[assignment]
    supply_v: np.ndarray = None  # type: ignore[assignment]
    # alpha_setting, beta_setting: Number of the setting of each joint, (k,) int. Poses of one
    # setting share the error of the joint; see `joint_settings`. By default each change of the
    # angle from one pose to the next in time begins a setting.
    alpha_setting: np.ndarray = None  # type: ignore[assignment]
    beta_setting: np.ndarray = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        """Fill in the fields that are not given."""
        for name in ('temperature_c', 'supply_v'):
            if getattr(self, name) is None:
                object.__setattr__(self, name, np.full(len(self.volts), np.nan))
        for joint in ('alpha', 'beta'):
            if getattr(self, f'{joint}_setting') is None:
                object.__setattr__(self, f'{joint}_setting', _settings_by_angle(
                    getattr(self, f'{joint}_rad'), self.time_s[:, 0]))

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.volts)

    @classmethod
    def without_volts(cls, alpha_rad: np.ndarray, beta_rad: np.ndarray, std_v: np.ndarray,
                      setting: np.ndarray | None = None) -> Poses:
        """
        Make poses that have not been measured: their volts and times are 0.

        alpha_rad, beta_rad: joint angles, (k,); std_v: noise of the mean of a pose, V, (m,), or of
        each pose, (k, m); setting: number of the setting of both joints, (k,) int. By default each
        change of an angle begins a setting.
        """
        count = len(alpha_rad)
        noise_v = np.broadcast_to(std_v, (count, np.shape(std_v)[-1])).copy()
        poses = cls(np.zeros_like(noise_v), noise_v, alpha_rad, beta_rad, np.zeros((count, 2)),
                    np.zeros(count, bool))
        return poses if setting is None else replace(
            poses, alpha_setting=setting, beta_setting=setting)

    @staticmethod
    def from_records(records: Sequence[PoseRecord]) -> Poses:
        """Return the poses of a journal."""
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
        numbers = {name: _with_missing(settings(name), getattr(poses, name))
                   for name in ('alpha_setting', 'beta_setting')}
        return replace(poses, **numbers)

    def subset(self, chosen: np.ndarray) -> Poses:
        """Select poses by mask or by index."""
        return Poses(*(getattr(self, field.name)[chosen] for field in fields(self)))

    @property
    def environment(self) -> Environment:
        """Return temperature and supply of each rest; nominal ones where not measured."""
        return NOMINAL_ENVIRONMENT._replace(
            temperature_c=_finite_or(self.temperature_c, NOMINAL_ENVIRONMENT.temperature_c),
            supply_v=_finite_or(self.supply_v, NOMINAL_ENVIRONMENT.supply_v))


def join_poses(parts: list[Poses]) -> Poses:
    """Join the poses of several recordings of one unit; each recording has settings of its own."""
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
    """Return numbers of settings by changes of the angle in the order of time, (k,) int."""
    order = np.argsort(start_s, kind='stable')
    settings = np.zeros(len(order), int)
    settings[order[1:]] = np.cumsum(np.abs(np.diff(angle_rad[order])) > SAME_ANGLE_RAD)
    return settings


def _with_missing(numbers: np.ndarray, default: np.ndarray) -> np.ndarray:
    """Replace negative numbers of settings by numbers that no other pose has, (k,) int."""
    missing = numbers < 0
    return np.where(missing, default, numbers + default.max() + 1) if missing.any() else numbers


def _finite_or(values: np.ndarray, default: Value) -> np.ndarray:
    return np.where(np.isfinite(values), values, default)


def reference_force(poses: Poses, gravity_mps2: float) -> Components:
    """
    Return the specific force at the angles of the encoder, on a stage without errors.

    returns: three components in the case frame, m/s², (k,).
    """
    return specific_force(poses.alpha_rad, poses.beta_rad, gravity_mps2)


def check_polarity(sensor: Sensor, poses: Poses) -> None:
    """Refuse a unit with an inverted axis or with swapped axes."""
    if len(poses) < 2:
        return
    reference = reference_force(poses, sensor.local_gravity_mps2)
    with np.errstate(invalid='ignore', divide='ignore'):
        correlation = np.array([[np.corrcoef(volts, force)[0, 1] for force in reference]
                                for volts in poses.volts.T])
    fault = find_polarity_fault(correlation, [AXES.index(axis) for axis in sensor.axes],
                                CERTAIN_CORRELATION)
    if fault is not None:
        raise UserError(fault.describe(sensor.axes[fault.axis], AXES[fault.follows]))


_SHARE = 0.5
"""Smallest share of a rest that must lie within the span of its pose (chosen: a span that was
noted by hand is not exact)."""


def with_table_angles(poses: Poses, table: PoseTable, epoch_ns: int) -> Poses:
    """Give rests the angles of a table."""
    if table.span_s is None:
        if len(table.angles_rad) != len(poses):
            raise UserError(
                f'{table.path}: has {len(table.angles_rad)} poses, but the recording has '
                f'{len(poses)} rests, which begin at {_starts(poses)}; write a row for each rest '
                '(with empty angles where they are not known), or add the columns start_s and '
                'stop_s')
        angles = table.angles_rad
    else:
        angles = _by_time(poses, table, table.span_s - epoch_ns * 1e-9)
        if np.isnan(angles).any(axis=1).all():
            raise UserError(f'{table.path}: no pose lies at a rest of the recording; the rests '
                            f'begin at {_starts(poses)}')
    return Poses(poses.volts, poses.std_v, angles[:, 0], angles[:, 1], poses.time_s, poses.check,
                 poses.temperature_c, poses.supply_v)


def _by_time(poses: Poses, table: PoseTable, span_s: np.ndarray) -> np.ndarray:
    """Return the angles of each rest, (k, 2), by the times of the poses."""
    angles = np.full((len(poses), 2), np.nan)
    for (start_s, stop_s), pose in zip(span_s, table.angles_rad):
        shared_s = np.minimum(poses.time_s[:, 1], stop_s) - np.maximum(poses.time_s[:, 0], start_s)
        length_s = np.diff(poses.time_s, axis=1)[:, 0] if stop_s > start_s else 0.0
        angles[shared_s >= _SHARE * length_s] = pose
    return angles


def _starts(poses: Poses) -> str:
    return ', '.join(f'{start_s:.1f}' for start_s in poses.time_s[:, 0]) + ' s'


def has_angles(poses: Poses) -> np.ndarray:
    """Return which poses have both angles, (k,) bool."""
    return np.isfinite(poses.alpha_rad) & np.isfinite(poses.beta_rad)
