# SPDX-License-Identifier: Apache-2.0

"""Motions that follow the references of a recording."""

from __future__ import annotations

import os
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files import recording
from adxl_ros.files.recording_columns import JOINTS, Recording
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate.motion import Held, INTERNAL_RATE_HZ, Motion, Path
from adxl_ros.simulate.smoothed_paths import BAND_LIMITED_DEGREE, ForcePath, SmoothedPath
import numpy as np

_MAX_SPEED_RAD_S = 100.0
"""Largest angular velocity of a stage, rad/s; chosen: a faster change is a jump of the reading."""

_MIN_FORCE_SAMPLES = 4
"""Fewest samples of specific force; a cubic spline needs them."""


def motion_from_force(path: str | os.PathLike, resampled: bool, epoch_ns: int = 0
                      ) -> tuple[Motion, float]:
    """
    Make a motion from the specific force of a recording.

    path: recording with specific force in the case frame, m/s²; returns: the motion, and the time
    at which it begins, s.
    """
    time_s, force_mps2 = recording.read_ideal(path, epoch_ns)
    if len(time_s) < _MIN_FORCE_SAMPLES:
        raise UserError(f'{path}: {len(time_s)} samples of specific force; at least '
                        f'{_MIN_FORCE_SAMPLES} are needed')
    begin_s = float(time_s[0])
    duration_s = float(time_s[-1] - begin_s)
    rate_hz = round(1 / float(np.median(np.diff(time_s))), 6)
    return Motion(
        duration_s + 1 / rate_hz, force=ForcePath(time_s, force_mps2),
        internal_rate_hz=rate_hz if resampled else max(rate_hz, INTERNAL_RATE_HZ)), begin_s


def motion_from_references(read: Recording, sensor: Sensor) -> Motion:
    """Make a motion from the stage angles, temperature and supply of a recording."""
    for name in ('alpha_rad', 'beta_rad'):
        if name not in read.columns or np.isnan(read.columns[name]).all():
            raise UserError(f'{read.path}: no stage angle {name} to follow; for specific force '
                            f'say simulate imu --force {read.path}')
    resolution = {'alpha': sensor.stage_resolution_rad, 'beta': sensor.stage_resolution_rad,
                  'shift': 0.0}
    paths: dict[str, Any] = dict(environment_paths(read))
    for joint, name in JOINTS.items():
        values = read.columns.get(name)
        if values is None or np.isnan(values).all():
            paths[joint] = Held()
            continue
        if joint != 'shift':
            _check_speed(read, name, resolution[joint])
        paths[joint] = SmoothedPath(read.time_s, values, resolution[joint],
                                    BAND_LIMITED_DEGREE)
    return Motion(float(read.time_s[-1] - read.time_s[0]), **paths)


def environment_paths(read: Recording) -> dict[str, Path]:
    """Return the recorded temperature, °C, and supply, V, as paths by column."""
    return {name: SmoothedPath(read.time_s, read.columns[name], 0.0)
            for name in ('temperature_c', 'supply_v')
            if name in read.columns and np.isfinite(read.columns[name]).any()}


def _check_speed(read: Recording, name: str, resolution_rad: float) -> None:
    """Refuse an angle that changes faster than a stage turns."""
    sampled = np.flatnonzero(np.isfinite(read.columns[name]))
    change_rad = np.abs(np.diff(read.columns[name][sampled]))
    interval_s = np.diff(read.time_s[sampled])
    jumps = np.flatnonzero(change_rad - 2 * resolution_rad > _MAX_SPEED_RAD_S * interval_s)
    if len(jumps):
        i = jumps[0]
        raise UserError(f'{read.path}: {name} jumps by {change_rad[i]:.3g} rad within '
                        f'{interval_s[i]:.3g} s at {read.time_s[sampled[i]]:.6g} s, which no '
                        'stage does; unwrap the angle, or cut the recording there')
