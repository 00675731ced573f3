# SPDX-License-Identifier: Apache-2.0

"""The check that the sensor is mounted as it was when earlier poses were taken."""

from __future__ import annotations

from collections.abc import Sequence

from adxl_ros.files.sweep_journal import PoseRecord
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import Sensor
import numpy as np

_CHANGE_G = 0.003
"""Largest change of a repeated pose beyond noise and stage error, g; chosen: a turn of 0.17°."""
_NOISE_STDS = 3.0
"""Standard deviations of the noise in the limit of a change; chosen: exceeded once in 400."""
_ACROSS_COSINE = 0.94
"""Cosine of 20°: two poses whose verticals are closer do not show each turn of the mounting."""


def to_take_again(records: Sequence[PoseRecord]) -> list[PoseRecord]:
    """
    Choose the poses of a journal that show the mounting when they are taken again.

    A turn about the vertical of the newest pose does not show there. The pose whose vertical is
    nearest to 90° from it comes second, if there is one.
    """
    newest = max(records, key=lambda record: record.stop_ns)
    across = min(records, key=lambda record: _alignment(record, newest))
    return [newest, across] if _alignment(across, newest) < _ACROSS_COSINE else [newest]


def changed(sensor: Sensor, before: PoseRecord, now: PoseRecord, tolerance_rad: float) -> str:
    """Compare two readings of the same pose, before and after an interruption."""
    before_v, now_v = np.array(before.mean_v), np.array(now.mean_v)
    change_g = np.abs(now_v - before_v) / sensor.nominal_scale_v_per_g
    noise_g = np.hypot(before.std_v, now.std_v) / sensor.nominal_scale_v_per_g
    # The stage may be off by its tolerance both times.
    limit_g = _CHANGE_G + _NOISE_STDS * noise_g + 2 * tolerance_rad
    axis = int((change_g - limit_g).argmax())
    if change_g[axis] <= limit_g[axis]:
        return ''
    return (f'mounting changed: in pose {before.pose + 1} {sensor.axes[axis]} reads '
            f'{now_v[axis]:.4f} V, but read {before_v[axis]:.4f} V before the interruption '
            f'({change_g[axis] * 1e3:.1f} mg apart, {limit_g[axis] * 1e3:.1f} mg are allowed); '
            'put the sensor back as it was, or begin again with resume:=anew')


def _alignment(first: PoseRecord, second: PoseRecord) -> float:
    """Return the cosine of the angle between the verticals of two poses, without its sign."""
    first_up = np.array(specific_force(first.alpha_rad, first.beta_rad, 1.0))
    second_up = np.array(specific_force(second.alpha_rad, second.beta_rad, 1.0))
    return abs(float(first_up @ second_up))
