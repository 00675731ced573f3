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

"""Specific force at rest to angles, each with its variance and what it does not show."""

from __future__ import annotations

from dataclasses import dataclass

from adxl_ros.model.effects.base import Components, Value
from adxl_ros.model.scalar_or_array import ARRAYS, Maths
import numpy as np

UNOBSERVABLE_RAD2 = 1.0
"""An angle whose variance passes this is not shown: even a guess is 1.8 rad off, rms."""

INFINITE = float('inf')

_NOTHING = 1e-30
"""Square of a force that is none, (m/s²)²; keeps divisors from 0 and is lost beside any noise."""


@dataclass(frozen=True)
class Tilt:
    """
    Angles of one or many samples, rad, (n,): NaN with standard deviation inf where not shown.

    roll = atan2(a_y, a_z), pitch = atan2(−a_x, hypot(a_y, a_z)), inclination and the stage's
    alpha = atan2(hypot(a_x, a_y), a_z), beta = atan2(−a_y, a_x). A sensor without z cannot tell
    alpha from π − alpha: there alpha is at most π/2.
    """

    roll: np.ndarray
    pitch: np.ndarray
    inclination: np.ndarray
    alpha: np.ndarray
    beta: np.ndarray
    roll_std: np.ndarray
    pitch_std: np.ndarray
    inclination_std: np.ndarray
    alpha_std: np.ndarray
    beta_std: np.ndarray


def tilt(force: Components, covariance: np.ndarray, measures_z: bool = True) -> Tilt:
    """
    Angles with first-order standard deviations.

    Parameters
    ----------
    force
        Specific force at rest in the case frame, m/s², three components (n,).
    covariance
        Of the force, (m/s²)², (3, 3, n).
    measures_z
        Whether the sensor has a z axis.

    """
    force = [np.asarray(f, float) for f in force]
    spread = tuple(covariance[i, j] for i in range(3) for j in range(i, 3))
    with np.errstate(over='ignore', invalid='ignore'):
        shown = [_shown(*one) for one in angles(force, spread, ARRAYS)]
    (roll, roll_std), (pitch, pitch_std), (inclination, inclination_std), (beta, beta_std) = shown
    alpha = inclination if measures_z else np.minimum(inclination, np.pi - inclination)
    return Tilt(roll, pitch, inclination, alpha, beta, roll_std, pitch_std, inclination_std,
                inclination_std, beta_std)


def _shown(angle: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Give the angle its standard deviation, or NaN and inf where it cannot be seen."""
    seen = variance < UNOBSERVABLE_RAD2
    return np.where(seen, angle, np.nan), np.where(seen, np.sqrt(np.maximum(variance, 0)), np.inf)


def angles(force: Components, covariance: tuple[Value, ...],
           maths: Maths) -> tuple[tuple[Value, Value], ...]:
    """
    Angles with first-order variances.

    Where the component of the force that shows an angle is lost in its noise, roll and beta can
    be anything: their variance is inf. Pitch and inclination are then the length of a small
    vector of any direction.

    Parameters
    ----------
    force
        Specific force at rest in the case frame, m/s², three components.
    covariance
        Of the force, (m/s²)²: xx, xy, xz, yy, yz, zz.
    maths
        For arrays or for floats.

    Returns
    -------
    tuple
        Angle, rad, and variance, rad², of roll, pitch, inclination and beta.

    """
    x, y, z = force
    xx, xy, xz, yy, yz, zz = covariance
    plane2, side2 = x * x + y * y + _NOTHING, y * y + z * z + _NOTHING
    total2 = plane2 + z * z
    total4 = total2 * total2
    in_plane, in_side = xx + yy, yy + zz
    along = y * y * yy + 2 * y * z * yz + z * z * zz
    roll = maths.where(side2 > in_side + _NOTHING,
                       (z * z * yy - 2 * y * z * yz + y * y * zz) / (side2 * side2), INFINITE)
    pitch = maths.where(
        side2 > in_side,
        (side2 * xx - 2 * x * (y * xy + z * xz) + x * x * along / side2) / total4,
        in_side / total2)
    along = x * x * xx + 2 * x * y * xy + y * y * yy
    inclination = maths.where(
        plane2 > in_plane,
        (z * z * along / plane2 - 2 * z * (x * xz + y * yz) + plane2 * zz) / total4,
        in_plane / total2)
    beta = maths.where(plane2 > in_plane + _NOTHING,
                       (y * y * xx - 2 * x * y * xy + x * x * yy) / (plane2 * plane2), INFINITE)
    return ((maths.atan2(y, z), roll), (maths.atan2(-x, maths.sqrt(side2)), pitch),
            (maths.atan2(maths.sqrt(plane2), z), inclination), (maths.atan2(0.0 - y, x), beta))


def roll_pitch_covariance(force: Components, covariance: tuple[Value, ...],
                          maths: Maths) -> Value:
    """Covariance of roll and pitch to first order, rad²; arguments as for `angles`."""
    x, y, z = force
    _, xy, xz, yy, yz, zz = covariance
    side2 = y * y + z * z + _NOTHING
    by_pitch = x * (y * (z * yy - y * yz) + z * (z * yz - y * zz)) / side2 - (z * xy - y * xz)
    return by_pitch / (maths.sqrt(side2) * (x * x + side2))
