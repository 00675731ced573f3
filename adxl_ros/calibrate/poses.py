# SPDX-License-Identifier: Apache-2.0

"""
Poses: mean output at rest with the angles of the stage's encoder.

- What a unit reads in them: predicted volts and their derivatives.
- Angles that a table states.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

from adxl_ros.errors import UserError
from adxl_ros.files.sweep_journal import PoseRecord
from adxl_ros.files.tables import PoseTable
from adxl_ros.model import signal_chain
from adxl_ros.model.coefficients import get, parameter_of, put
from adxl_ros.model.effects import base
from adxl_ros.model.effects.base import Coefficient, Components, Environment, NOMINAL_ENVIRONMENT
from adxl_ros.model.kinematics import specific_force, UPRIGHT
from adxl_ros.model.noise import sample_std_v
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.rest_detection import SAME_ANGLE_RAD
import numpy as np

_SAME_PLANE_RAD = np.radians(1.0)
"""Largest difference of neighbouring angles alpha in one plane, rad."""


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

        stamps_ns = np.column_stack([column('start_ns'), column('stop_ns')])
        poses = Poses(column('mean_v'), column('std_v'), column('alpha_rad'), column('beta_rad'),
                      stamps_ns * 1e-9, column('check').astype(bool), column('temperature_c'),
                      column('supply_v'))
        # Poses of earlier versions have no numbers of settings: they get those by the angles.
        return replace(poses, **{name: column(name).astype(int) for name in (
            'alpha_setting', 'beta_setting') if None not in column(name)})

    @staticmethod
    def joined(parts: Sequence[Poses]) -> Poses:
        """Join the poses of several recordings of one unit, each with settings of its own."""
        joined = {field.name: np.concatenate([getattr(part, field.name) for part in parts])
                  for field in fields(Poses)}
        for name in ('alpha_setting', 'beta_setting'):
            settings = [getattr(part, name) for part in parts]
            first = np.cumsum([0, *(int(n.max(initial=-1)) + 1 for n in settings[:-1])])
            joined[name] = np.concatenate([numbers + f for numbers, f in zip(settings, first)])
        return Poses(**joined)

    def subset(self, chosen: np.ndarray) -> Poses:
        """Select poses by mask or by index."""
        return Poses(*(getattr(self, field.name)[chosen] for field in fields(self)))

    @property
    def environment(self) -> Environment:
        """Return temperature and supply of each rest; nominal ones where not measured."""
        measured = {name: getattr(self, name) for name in ('temperature_c', 'supply_v')}
        return NOMINAL_ENVIRONMENT._replace(**{
            name: np.where(np.isfinite(values), values, getattr(NOMINAL_ENVIRONMENT, name))
            for name, values in measured.items()})

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


def reference_force(poses: Poses, gravity_mps2: float) -> Components:
    """
    Return the specific force at the angles of the encoder, on a stage without errors.

    returns: three components in the case frame, m/s², (k,).
    """
    return specific_force(poses.alpha_rad, poses.beta_rad, gravity_mps2)


_RAIL_STDS = 3.0
"""Distance of a mean from a rail of the ADC, in standard deviations of a sample, up to which its
samples were cut off there. Chosen: beyond it one sample of 700 is."""


def at_a_rail(sensor: Sensor, poses: Poses) -> np.ndarray:
    """Return the poses, (k,) bool, whose mean is false as samples are at a rail of the ADC."""
    rails_v = np.array([0.0, sensor.adc_vref_v - sensor.lsb_v])
    reach_v = (_RAIL_STDS * sample_std_v(sensor) + sensor.lsb_v) * bool(sensor.adc_bits)
    distance_v = np.abs(poses.volts[:, :, None] - rails_v).min(axis=2)
    return (distance_v < reach_v).any(axis=1)


_SHARE = 0.5
"""Smallest share of a rest that must lie within the span of its pose (chosen: a span that was
noted by hand is not exact)."""


def with_table_angles(poses: Poses, table: PoseTable, epoch_ns: int) -> Poses:
    """Give rests the angles of a table, by the times of its poses or in their order."""
    starts = ', '.join(f'{start_s:.1f}' for start_s in poses.time_s[:, 0]) + ' s'
    angles = table.angles_rad
    if table.span_s is None and len(angles) != len(poses):
        raise UserError(
            f'{table.path}: has {len(angles)} poses, but the recording has {len(poses)} rests, '
            f'which begin at {starts}; write a row for each rest (with empty angles where they '
            'are not known), or add the columns start_s and stop_s')
    if table.span_s is not None:
        angles, length_s = np.full((len(poses), 2), np.nan), np.diff(poses.time_s, axis=1)[:, 0]
        begin_s, end_s = poses.time_s.T
        for (start_s, stop_s), pose in zip(table.span_s - epoch_ns * 1e-9, table.angles_rad):
            shared_s = np.minimum(end_s, stop_s) - np.maximum(begin_s, start_s)
            angles[shared_s >= _SHARE * length_s * (stop_s > start_s)] = pose
        if np.isnan(angles).any(axis=1).all():
            raise UserError(f'{table.path}: no pose lies at a rest of the recording; the rests '
                            f'begin at {starts}')
    return Poses(poses.volts, poses.std_v, angles[:, 0], angles[:, 1], poses.time_s, poses.check,
                 poses.temperature_c, poses.supply_v)


_ANGLE_STEP_RAD = 1e-4
"""Step of the central differences by an angle, rad. Chosen: the chain is smooth, so that the error
of the slope, of order step², is far below the noise."""
_COEFFICIENT_STEP = 1e-3
"""Step of the central differences by a coefficient, in typical sizes. Chosen: the chain is nearly
linear over a thousandth of a typical size."""


def predicted_volts(unit: Sensor, poses: Poses, shift_rad: tuple[float, float] = (0.0, 0.0)
                    ) -> np.ndarray:
    """
    Predict the mean output of a unit in poses.

    returns: volts, (k, m).
    """
    force = stage_force(unit, poses.alpha_rad + shift_rad[0], poses.beta_rad + shift_rad[1])
    return np.column_stack(signal_chain.static_response(unit)(force, poses.environment))


def stage_force(unit: Sensor, alpha_rad: np.ndarray, beta_rad: np.ndarray) -> Components:
    """
    Return the specific force at rest on a stage with the stage effects of a unit.

    alpha_rad, beta_rad: angles of the encoder, rad, (k,); returns: three components in the case
    frame, m/s², (k,).
    """
    signals = base.Signals(
        NOMINAL_ENVIRONMENT, alpha=base.Joint(alpha_rad), beta=base.Joint(beta_rad),
        up=list(UPRIGHT), gravity_mps2=unit.local_gravity_mps2)
    signal_chain.Chain(unit)(base.Place.STAGE, signals)
    return specific_force(signals.alpha.position, signals.beta.position, signals.gravity_mps2,
                          0.0, signals.up)


def angle_jacobian(unit: Sensor, poses: Poses) -> np.ndarray:
    """
    Differentiate the predicted volts by alpha and beta.

    returns: jacobian, V/rad, (k, m, 2).
    """
    def slope(alpha_rad: float, beta_rad: float) -> np.ndarray:
        above = predicted_volts(unit, poses, (alpha_rad, beta_rad))
        below = predicted_volts(unit, poses, (-alpha_rad, -beta_rad))
        return (above - below) / (2 * _ANGLE_STEP_RAD)

    return np.stack([slope(_ANGLE_STEP_RAD, 0.0), slope(0.0, _ANGLE_STEP_RAD)], axis=2)


def coefficient_jacobian(unit: Sensor, poses: Poses, names: Sequence[Coefficient]) -> np.ndarray:
    """
    Differentiate the predicted volts by coefficients.

    names: coefficients, (p,); returns: jacobian, V per unit of the coefficient, (k, m, p).
    """
    def slope(name: Coefficient) -> np.ndarray:
        value, step = get(unit, [name]), _COEFFICIENT_STEP * parameter_of(name).scale
        above = predicted_volts(put(unit, [name], value + step), poses)
        below = predicted_volts(put(unit, [name], value - step), poses)
        return (above - below) / (2 * step)

    return np.stack([slope(name) for name in names], axis=2)
