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

"""Whether the sensor is mounted as it was when the poses so far were taken."""

from __future__ import annotations

from collections.abc import Sequence

from adxl_ros.files.sweep_journal import PoseRecord
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import Sensor
import numpy as np

_SAME_G = 0.003
"""A pose that is taken again after an interruption reads the same within this, g, and noise."""
_NOISE = 3.0
_ACROSS = 0.94
"""Cosine of 20°: poses whose verticals are closer than this tell the same of the mounting."""


def to_take_again(records: Sequence[PoseRecord]) -> list[PoseRecord]:
    """
    Choose the poses of a journal that tell of the mounting when they are taken again.

    The newest, and, since a turn about its vertical does not show there, the one whose vertical
    is nearest to 90° from it, if there is one.
    """
    last = max(records, key=lambda record: record.stop_ns)
    across = min(records, key=lambda record: _along(record, last))
    return [last, across] if _along(across, last) < _ACROSS else [last]


def changed(sensor: Sensor, before: PoseRecord, now: PoseRecord, tolerance_rad: float) -> str:
    """
    Refuse to go on where a pose that was taken before reads something else now.

    Parameters
    ----------
    sensor
        The nominal sensor.
    before, now
        The pose in the journal, and taken again.
    tolerance_rad
        How far the stage may be off, each time.

    """
    before_v, now_v = np.array(before.mean_v), np.array(now.mean_v)
    off_g, noise_g = (np.abs(volts) / sensor.nominal_scale_v_per_g for volts in (
        now_v - before_v, np.hypot(before.std_v, now.std_v)))
    allowed = _SAME_G + _NOISE * noise_g + 2 * tolerance_rad
    axis = int((off_g - allowed).argmax())
    if off_g[axis] <= allowed[axis]:
        return ''
    return (f'mounting changed: in pose {before.pose + 1} {sensor.axes[axis]} reads '
            f'{now_v[axis]:.4f} V, but read {before_v[axis]:.4f} V before the interruption '
            f'({off_g[axis] * 1e3:.1f} mg apart, {allowed[axis] * 1e3:.1f} mg are allowed); put '
            'the sensor back as it was, or begin anew with resume:=anew')


def _along(one: PoseRecord, other: PoseRecord) -> float:
    """Return the cosine of the angle between the verticals of two poses, without its sign."""
    up, beside = (np.array(specific_force(e.alpha_rad, e.beta_rad, 1.0))
                  for e in (one, other))
    return abs(float(up @ beside))
