# SPDX-License-Identifier: Apache-2.0

"""The motion of a recording: of its stage angles, or of the specific force of a simulator."""

from __future__ import annotations

from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import ACCEL, JOINTS, Recording
from adxl_ros.files.stamps import stamped_rate_hz
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate.motion import ForcePath, INTERNAL_RATE_HZ, Motion, Path
from adxl_ros.simulate.smoothed_path import BAND_LIMITED_DEGREE, rounding_step, SmoothedPath
from adxl_ros.wording import usage
import numpy as np

_ROUNDING_OF_NOISE = 0.1
"""Force by the rounding of the shift, divided by the noise, from which it is smoothed. Chosen: it
adds half a per cent to the rms."""
_MAX_SPEED_RAD_S = 100.0  # Largest rate of a stage, rad/s; chosen: faster is a jump
_MIN_FORCE_SAMPLES = 4  # Fewest samples of specific force; a cubic spline needs them


def motion_from_force(ideal: Recording, resampled: bool) -> Motion:
    """Make a motion from the specific force of another simulator, from its first sample on."""
    time_s = ideal.time_s
    force_mps2 = np.column_stack([ideal.columns[name] for name in ACCEL])
    if len(time_s) < _MIN_FORCE_SAMPLES:
        raise UserError(
            f'{ideal.path}: {len(time_s)} samples of specific force; at least '
            f'{_MIN_FORCE_SAMPLES} are needed'
        )
    rate_hz = stamped_rate_hz(time_s)
    return Motion(
        float(time_s[-1] - time_s[0]) + 1 / rate_hz,
        force=ForcePath(time_s, force_mps2),
        internal_rate_hz=rate_hz if resampled else max(rate_hz, INTERNAL_RATE_HZ),
        **environment_paths(ideal),
    )


def motion_from_references(read: Recording, sensor: Sensor) -> Motion:
    """Make a motion from the stage angles, temperature and supply of a recording."""
    for name in ('alpha_rad', 'beta_rad'):
        if name not in read.columns or np.isnan(read.columns[name]).all():
            raise UserError(
                f'{read.path}: no stage angle {name} to follow; for specific force '
                f'say {usage("simulate", "imu", force=read.path)}'
            )
    paths: dict[str, Any] = environment_paths(read)
    for joint, name in JOINTS.items():
        if joint != 'shift':
            _check_speed(read, name, sensor.stage_resolution_rad)
        if not np.isfinite(read.columns.get(name, np.nan)).any():
            continue
        if joint == 'shift':
            paths[joint] = _shift_path(read, sensor)
        else:
            paths[joint] = SmoothedPath(
                read.time_s, read.columns[name], sensor.stage_resolution_rad, BAND_LIMITED_DEGREE
            )
    return Motion(read.span_s, **paths)


def _shift_path(read: Recording, sensor: Sensor) -> SmoothedPath:
    """
    Return the path of the shift, whose second derivative is a force.

    Its readings are exact but for their digits. Where fast readings make the rounding, twice
    differentiated, a force that shows beside the noise, the path is smoothed by as much as they
    are rounded.
    """
    readings = read.columns['shift_m']
    sampled = np.isfinite(readings)
    exact = SmoothedPath(read.time_s, readings, 0.0, BAND_LIMITED_DEGREE)
    step_m = rounding_step(readings[sampled])
    if not step_m:
        return exact
    rate_hz = stamped_rate_hz(read.time_s[sampled])
    # The rounding of a reading is step/√12 rms, and weighs 1, −2 and 1 in a second difference.
    rounding_mps2 = step_m * np.sqrt(6 / 12) * rate_hz**2
    noise_mps2 = np.min(noise.analog_std_v(sensor) / sensor.scale_v_per_g) * G0_MPS2
    if rounding_mps2 < _ROUNDING_OF_NOISE * noise_mps2:
        return exact
    return SmoothedPath(read.time_s, readings, step_m, is_seen=True, knot_s=2 / rate_hz)


def environment_paths(read: Recording) -> dict[str, Path]:
    """Return the recorded temperature, °C, and supply, V, as paths by column."""
    return {
        name: SmoothedPath(read.time_s, read.columns[name], 0.0)
        for name in ('temperature_c', 'supply_v')
        if name in read.columns and np.isfinite(read.columns[name]).any()
    }


def _check_speed(read: Recording, name: str, resolution_rad: float) -> None:
    """Refuse an angle that changes faster than a stage turns."""
    sampled = np.flatnonzero(np.isfinite(read.columns[name]))
    change_rad = np.abs(np.diff(read.columns[name][sampled]))
    interval_s = np.diff(read.time_s[sampled])
    jumps = np.flatnonzero(change_rad - 2 * resolution_rad > _MAX_SPEED_RAD_S * interval_s)
    if len(jumps):
        i = jumps[0]
        raise UserError(
            f'{read.path}: {name} jumps by {change_rad[i]:.3g} rad within '
            f'{interval_s[i]:.3g} s at {read.time_s[sampled[i]]:.6g} s, which no '
            'stage does; unwrap the angle, or cut the recording there'
        )
