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

"""
Wrong signs and units of the stage's angles, found by the direction of gravity in the output.

At rest f = g·[sin α·cos β, −sin α·sin β, cos α]. A wrong sign of β therefore looks like an
inverted y, and one of α like inverted x and y. The explanation with fewer changes is named. Where
both have one, the zero-g decides: an inverted axis has its zero-g mirrored, too.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

from adxl_ros.diagnose.data_checks import DataFault
from adxl_ros.files.recording_columns import JOINTS, Recording
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import Sensor
import numpy as np

_SAMPLES = 4000
"""Largest number of samples that are compared. Chosen: a few for each second."""
_SMALLEST_MOTION_G = 0.05
"""Standard deviation of the output, g, from which gravity turns enough. Chosen: ten times the
noise of an ADXL203."""
_WRONG = 0.2
"""Share of the output's variance that the angles do not explain, from which they may be wrong.
Chosen: it is 0.03 where the sensor is mounted 10° off."""
_RIGHT = 0.1
"""The same share up to which changed angles explain the output. Chosen: half of `_WRONG`."""
_AGED_ZERO_G = 0.01
"""Zero-g, g, from which its sign tells an inverted axis from a wrong angle. Chosen: that of a
healthy unit ages by less."""
_TURN = 2 * np.pi
"""Largest angle, rad, that is not looked at as one in degrees."""


def find_encoder_fault(recording: Recording, sensor: Sensor) -> DataFault | None:
    """
    Find an angle with the wrong sign, or in degrees.

    Parameters
    ----------
    recording
        A recording with stage angles.
    sensor
        The baseline.

    Returns
    -------
    DataFault or None
        None where the angles fit the output, or where no change of them does.

    """
    angles_rad = recording.stage_angles
    if angles_rad is None:
        return None
    volts = recording.volts(sensor)
    rows = np.flatnonzero(np.isfinite(angles_rad).all(axis=1) & np.isfinite(volts).all(axis=1))
    if len(rows) < 2:
        return None
    rows = rows[::max(1, len(rows) // _SAMPLES)]
    angles_rad, volts = angles_rad[rows], volts[rows]
    measured_g = (volts - sensor.zero_g_v) / sensor.scale_v_per_g
    variance = float(np.sum(np.var(measured_g, axis=0)))
    if variance < _SMALLEST_MOTION_G ** 2:
        return None

    def unexplained(factors: tuple[float, float]) -> float:
        """Return the share of the variance that angles times factors do not explain."""
        force_g = _force_g(angles_rad * factors, len(sensor.axes))
        return float(np.sum(np.var(measured_g - force_g, axis=0))) / variance

    recorded = unexplained((1.0, 1.0))
    if recorded < _WRONG:
        return None
    factors = min(_factors(angles_rad), key=unexplained)
    if unexplained(factors) > min(_RIGHT, recorded / 2):
        return None
    correlation = np.sqrt(1 - unexplained(factors))
    return (_unit_fault(recording, rows, angles_rad, factors, correlation)
            or _sign_fault(angles_rad, measured_g, sensor, factors, correlation))


def _force_g(angles_rad: np.ndarray, axes: int) -> np.ndarray:
    """Return the specific force at rest, g, (n, m)."""
    return np.column_stack(specific_force(angles_rad[:, 0], angles_rad[:, 1], 1.0)[:axes])


def _factors(angles_rad: np.ndarray) -> Iterator[tuple[float, float]]:
    """Yield what alpha and beta may have to be multiplied by, the fewest changes first."""
    in_degrees = np.nanmax(np.abs(angles_rad), axis=0) > _TURN
    units = product(*([1.0, np.pi / 180] if large else [1.0] for large in in_degrees))
    for alpha_unit, beta_unit in units:
        for alpha_sign, beta_sign in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            yield alpha_sign * alpha_unit, beta_sign * beta_unit


def _unit_fault(recording: Recording, rows: np.ndarray, angles_rad: np.ndarray,
                factors: tuple[float, float], correlation: float) -> DataFault | None:
    """Name the columns in degrees."""
    names = [JOINTS[joint] for joint, factor in zip(('alpha', 'beta'), factors)
             if abs(factor) != 1]
    if not names:
        return None
    largest = {name: int(np.argmax(np.abs(recording.columns[name][rows]))) for name in names}
    reached = ' and '.join(
        f'{name} is {recording.columns[name][rows[i]]:.4g} at {recording.time_s[rows[i]]:.4g} s'
        for name, i in largest.items())
    return DataFault('unit', 'bad_data', f'{reached}: degrees in a column of radians (as degrees '
                     f'it fits the output, correlation {correlation:.2f}); multiply '
                     f'{" and ".join(names)} by π/180')


def _sign_fault(angles_rad: np.ndarray, measured_g: np.ndarray, sensor: Sensor,
                factors: tuple[float, float], correlation: float) -> DataFault | None:
    """Name the encoders that count in the opposite direction; None where an axis is simpler."""
    joints = [JOINTS[joint] for joint, factor in zip(('alpha', 'beta'), factors) if factor < 0]
    recorded_g, turned_g = (_force_g(angles_rad * f, len(sensor.axes)) for f in (1.0, factors))
    mirrored = np.flatnonzero(np.std(turned_g - recorded_g, axis=0) > _SMALLEST_MOTION_G)
    if len(mirrored) < len(joints):
        return None
    axes = ' and '.join(sensor.axes[d] for d in mirrored)
    rival = f'the sensor is mounted half a turn about z, with {axes} mirrored'
    if len(mirrored) == len(joints):
        d = int(mirrored[0])
        if _zero_g_is_mirrored(float(np.mean(measured_g[:, d] - turned_g[:, d])), d, sensor):
            return None
        rival = f'the axis {axes} is inverted'
    names = ' and '.join(joints)
    return DataFault('encoder_sign', 'bad_data', f'{names}: opposite sign of the encoder '
                     f'(correlation {correlation:.2f} with the sign changed); change the sign of '
                     f'{names}, unless {rival}')


def _zero_g_is_mirrored(offset_g: float, axis: int, sensor: Sensor) -> bool:
    """
    Determine whether the zero-g of an axis is mirrored, as that of an inverted axis is.

    Parameters
    ----------
    offset_g
        Mean of the output beyond its calibrated zero-g, g.
    axis
        Index of the axis.
    sensor
        The unit with its zero-g.

    Returns
    -------
    bool
        False where the zero-g is too small to tell.

    """
    zero_g = float((sensor.zero_g_v - sensor.nominal_zero_g_v)[axis] / sensor.scale_v_per_g[axis])
    return abs(zero_g) > _AGED_ZERO_G and abs(offset_g + 2 * zero_g) < abs(offset_g)
