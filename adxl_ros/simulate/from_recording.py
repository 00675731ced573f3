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

"""A recording's references as a motion that can be followed again."""

from __future__ import annotations

import os
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files import recording
from adxl_ros.files.recording_columns import JOINTS, Recording, stamped_rate_hz
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate.motion import Held, Motion, Path
from adxl_ros.simulate.smoothed_paths import ForcePath, SmoothedPath
import numpy as np

_FASTEST_RAD_S = 100.0
"""No stage turns a sensor faster; a jump in the angle is no motion."""


def motion_from_force(path: str | os.PathLike, resampled: bool) -> tuple[Motion, float]:
    """
    Make a motion of the specific force of a recording; return it and when it begins, s.

    Parameters
    ----------
    path
        Of the recording.
    resampled
        Its internal rate is that of the samples, else 1 kHz at least.

    Raises
    ------
    UserError
        There are fewer than four samples.

    """
    time_s, force = recording.read_ideal(path)
    if len(time_s) < 4:
        raise UserError(f'{path}: {len(time_s)} samples of specific force; at least 4 are needed')
    begin_s = float(time_s[0])
    duration_s = float(time_s[-1] - begin_s)
    rate = stamped_rate_hz(time_s)
    return Motion(duration_s + 1 / rate, force=ForcePath(time_s, force),
                  internal_rate_hz=rate if resampled else max(rate, 1000.0)), begin_s


def motion_from_references(read: Recording, sensor: Sensor) -> Motion:
    """
    Make the motion of a recording's references.

    Raises
    ------
    UserError
        There are no stage angles, or they jump as no stage does.

    """
    for name in ('alpha_rad', 'beta_rad'):
        if name not in read.columns or np.isnan(read.columns[name]).all():
            raise UserError(f'{read.path}: no stage angle {name} to follow; for specific force '
                            f'say simulate imu --force {read.path}')
    steps = {'alpha': sensor.stage_resolution_rad, 'beta': sensor.stage_resolution_rad,
             'shift': 0.0}
    paths: dict[str, Any] = dict(environment_paths(read))
    for joint, name in JOINTS.items():
        values = read.columns.get(name)
        if values is None or np.isnan(values).all():
            paths[joint] = Held()
            continue
        if joint != 'shift':
            _check_speed(read, name, steps[joint])
        paths[joint] = SmoothedPath(read.time_s, values, steps[joint])
    return Motion(float(read.time_s[-1] - read.time_s[0]), **paths)


def environment_paths(read: Recording) -> dict[str, Path]:
    """Return what a recording holds of temperature, °C, and supply, V, as paths by name."""
    return {name: SmoothedPath(read.time_s, read.columns[name], 0.0)
            for name in ('temperature_c', 'supply_v')
            if name in read.columns and np.isfinite(read.columns[name]).any()}


def _check_speed(read: Recording, name: str, step: float) -> None:
    known = np.flatnonzero(np.isfinite(read.columns[name]))
    moved = np.abs(np.diff(read.columns[name][known]))
    passed = np.diff(read.time_s[known])
    fast = np.flatnonzero(moved - 2 * step > _FASTEST_RAD_S * passed)
    if len(fast):
        i = fast[0]
        raise UserError(f'{read.path}: {name} jumps by {moved[i]:.3g} rad within {passed[i]:.3g} '
                        f's at {read.time_s[known[i]]:.6g} s, which no stage does; unwrap the '
                        'angle, or cut the recording there')
