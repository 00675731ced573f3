# SPDX-License-Identifier: Apache-2.0

"""
Specific force by the angles of the stage, and tilt by specific force.

The stage has two rotary axes and a linear third joint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import atan2, hypot
from typing import Any, NamedTuple

from adxl_ros.model.effects.base import ARRAYS, Components, Joint, Maths, Value
import numpy as np
import scipy

UPRIGHT = (0.0, 0.0, 1.0)  # The vertical in the frame of a level base, a unit vector


def specific_force(
    alpha_rad: Value,
    beta_rad: Value,
    gravity_mps2: float,
    shift_acceleration_mps2: Value = 0.0,
    up: Components | tuple[float, float, float] = UPRIGHT,
) -> Components:
    """
    Specific force in the case frame of a sensor on the stage, m/s².

    At rest f = g·[sin α·cos β, −sin α·sin β, cos α]; a displacement along the sensor's x adds
    its second derivative. Angles are arrays or floats; `up` is the vertical in the frame of the
    stage's base, whose y is the axis of alpha.
    """
    x, y, z = (gravity_mps2 * u for u in up)
    sin_alpha, cos_alpha = np.sin(alpha_rad), np.cos(alpha_rad)
    sin_beta, cos_beta = np.sin(beta_rad), np.cos(beta_rad)
    along = x * cos_alpha + z * sin_alpha
    return [
        along * cos_beta + y * sin_beta + shift_acceleration_mps2,
        y * cos_beta - along * sin_beta,
        z * cos_alpha - x * sin_alpha,
    ]


def stage_angles(roll_rad: np.ndarray, pitch_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return alpha, 0 to π, and beta, −π to π, of a tilt; beta is 0 where alpha is 0."""
    x = -np.sin(pitch_rad)
    y = np.sin(roll_rad) * np.cos(pitch_rad)
    z = np.cos(roll_rad) * np.cos(pitch_rad)
    return np.arctan2(np.hypot(x, y), z), np.arctan2(-y, x + 0.0)


def specific_force_in_motion(
    alpha: Joint,
    beta: Joint,
    shift: Joint,
    gravity_mps2: float,
    up: Components | tuple[float, float, float] = UPRIGHT,
) -> Components:
    """
    Specific force in the case frame of a sensor while all joints move, m/s².

    A shifted sensor is carried by the turning stage, and the Coriolis acceleration adds to its
    force. See `specific_force` for the other parameters.
    """
    force = specific_force(alpha.position, beta.position, gravity_mps2, shift.acceleration, up)
    if np.any(shift.position) and (np.any(alpha.velocity) or np.any(beta.velocity)):
        omega, omega_dot = angular_motion(alpha, beta)
        arm = [shift.position, 0.0, 0.0]
        carried = carried_acceleration(omega, omega_dot, arm)
        coriolis = cross_product(omega, [2 * shift.velocity, 0.0, 0.0])
        force = [f + c + w for f, c, w in zip(force, carried, coriolis)]
    return force


def angular_motion(alpha: Joint, beta: Joint) -> tuple[Components, Components]:
    """
    Angular velocity and acceleration of the sensor in the case frame.

    ω = β̇·[0 0 1] − α̇·[sin β, cos β, 0]. A fixed vertical then moves as in `specific_force`:
    ḟ = −ω × f.
    """
    sin_beta, cos_beta = np.sin(beta.position), np.cos(beta.position)
    along, across = sin_beta * alpha.velocity, cos_beta * alpha.velocity
    return (
        [-along, -across, beta.velocity],
        [
            -sin_beta * alpha.acceleration - across * beta.velocity,
            -cos_beta * alpha.acceleration + along * beta.velocity,
            beta.acceleration,
        ],
    )


def carried_acceleration(omega: Components, omega_dot: Components, r: Components) -> Components:
    """Acceleration of a point r that a turning body carries: ω × (ω × r) + ω̇ × r."""
    centripetal = cross_product(omega, cross_product(omega, r))
    return [c + t for c, t in zip(centripetal, cross_product(omega_dot, r))]


def cross_product(a: Components, b: Components) -> Components:
    """Return the vector product a × b."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


UNOBSERVABLE_RAD2 = 1.0  # Variance of an angle that is not shown, rad²; a guess has 1.8²
UNKNOWN_ANGLE_RAD2 = 1e6
"""Variance of an angle that is not known, rad²; yaw is never known.

π²/3, that of a uniform angle, would let a filter that fuses 1000 samples a second believe in
yaw = 0 before long. 1e6, as for an axis that is not there, never counts."""
INFINITE = float('inf')  # Variance of an angle that the force does not determine, rad²
_FORCE2_FLOOR = 1e-30
"""Square of a negligible force, (m/s²)²: it keeps divisors from 0, and is far below any noise."""


@dataclass(frozen=True)
class Tilt:
    """
    Angles of samples at rest, by the specific force a in the case frame.

    An angle that is not shown is NaN and has an infinite standard deviation. The force of a
    sensor without z axis does not determine whether it is upright, so that alpha is at most π/2.
    """

    roll: np.ndarray  # atan2(a_y, a_z), rad, (n,)
    pitch: np.ndarray  # atan2(−a_x, hypot(a_y, a_z)), rad, (n,)
    inclination: np.ndarray  # atan2(hypot(a_x, a_y), a_z), rad, (n,)
    alpha: np.ndarray  # Angle of the stage: the inclination, rad, (n,)
    beta: np.ndarray  # Angle of the stage: atan2(−a_y, a_x), rad, (n,)
    # Standard deviations of the angles, rad, (n,)
    roll_std: np.ndarray
    pitch_std: np.ndarray
    inclination_std: np.ndarray
    alpha_std: np.ndarray
    beta_std: np.ndarray


def tilt(force: Components, covariance: np.ndarray, measures_z: bool = True) -> Tilt:
    """Return the angles of forces at rest, (n,), with a covariance, (m/s²)², (3, 3, n)."""
    force = [np.asarray(f, float) for f in force]
    components = tuple(covariance[np.triu_indices(3)])
    with np.errstate(over='ignore', invalid='ignore'):
        roll, pitch, inclination, beta = map(_shown, angles(force, components, ARRAYS))
    alpha = inclination.angle_rad
    if not measures_z:
        alpha = np.minimum(alpha, np.pi - alpha)
    return Tilt(
        roll=roll.angle_rad,
        pitch=pitch.angle_rad,
        inclination=inclination.angle_rad,
        alpha=alpha,
        beta=beta.angle_rad,
        roll_std=roll.std_rad,
        pitch_std=pitch.std_rad,
        inclination_std=inclination.std_rad,
        alpha_std=inclination.std_rad,
        beta_std=beta.std_rad,
    )


class _ShownAngle(NamedTuple):
    """An angle with its standard deviation; NaN and inf where the force does not show it."""

    angle_rad: np.ndarray
    std_rad: np.ndarray


def _shown(estimate: AngleEstimate) -> _ShownAngle:
    shows = estimate.variance_rad2 < UNOBSERVABLE_RAD2
    std_rad = np.sqrt(np.maximum(estimate.variance_rad2, 0))
    return _ShownAngle(
        np.where(shows, estimate.angle_rad, np.nan), np.where(shows, std_rad, np.inf)
    )


class AngleEstimate(NamedTuple):
    """An angle by the force, with its variance: floats or arrays (n,)."""

    angle_rad: Value
    variance_rad2: Value  # To first order; inf where the angle can be anything


def angles(
    force: Components, covariance: tuple[Value, ...], maths: Maths
) -> tuple[AngleEstimate, AngleEstimate, AngleEstimate, AngleEstimate]:
    """
    Return roll, pitch, inclination and beta, in this order.

    Where noise exceeds the part of the force that shows roll or beta, the angle can be anything:
    its variance is infinite. Pitch and inclination are then the length of a small vector of any
    direction. The force is that at rest, its covariance xx, xy, xz, yy, yz, zz.
    """
    x, y, z = force
    xx, xy, xz, yy, yz, zz = covariance
    # Squares of the force in the planes xy and yz
    plane2 = x * x + y * y + _FORCE2_FLOOR
    side2 = y * y + z * z + _FORCE2_FLOOR
    return (
        AngleEstimate(maths.atan2(y, z), _turn_variance(y, z, yy, yz, zz, maths)),
        AngleEstimate(
            maths.atan2(-x, maths.sqrt(side2)),
            _tilt_variance(x, xx, y, z, yy, yz, zz, y * xy + z * xz, maths),
        ),
        AngleEstimate(
            maths.atan2(maths.sqrt(plane2), z),
            _tilt_variance(z, zz, x, y, xx, xy, yy, x * xz + y * yz, maths),
        ),
        AngleEstimate(maths.atan2(0.0 - y, x), _turn_variance(x, y, xx, xy, yy, maths)),
    )


def _turn_variance(a: Value, b: Value, aa: Value, ab: Value, bb: Value, maths: Maths) -> Value:
    """Return the variance of the angle of a vector a, b in its plane by its covariance, rad²."""
    square = a * a + b * b + _FORCE2_FLOOR
    across = b * b * aa - 2 * a * b * ab + a * a * bb
    return maths.where(square > aa + bb + _FORCE2_FLOOR, across / (square * square), INFINITE)


def _tilt_variance(
    c: Value,
    cc: Value,
    a: Value,
    b: Value,
    aa: Value,
    ab: Value,
    bb: Value,
    with_c: Value,
    maths: Maths,
) -> Value:
    """
    Return the variance of the angle between a force a, b, c and the plane of a and b, rad².

    aa, ab, bb, cc: its covariance; with_c: a·ac + b·bc.
    """
    square = a * a + b * b + _FORCE2_FLOOR
    total2 = square + c * c
    noise = aa + bb
    along = a * a * aa + 2 * a * b * ab + b * b * bb
    return maths.where(
        square > noise,
        (square * cc - 2 * c * with_c + c * c * along / square) / (total2 * total2),
        noise / total2,
    )


def quaternion(roll_rad: Value, pitch_rad: Value, maths: Maths) -> tuple[Value, ...]:
    """Return the orientation x, y, z, w of a roll and pitch, rad, at a yaw of 0."""
    sr, cr = maths.sin(roll_rad / 2), maths.cos(roll_rad / 2)
    sp, cp = maths.sin(pitch_rad / 2), maths.cos(pitch_rad / 2)
    return sr * cp, cr * sp, -sr * sp, cr * cp


Vector = tuple[float, float, float]  # Three components


@dataclass(frozen=True)
class Mounting:
    """
    Rotation of the case in the frame of the robot, as in a URDF joint.

    A vector v of the case is R·v in the frame of the robot, with R = Rz(yaw)·Ry(pitch)·Rx(roll)
    (fixed axes, REP-103).
    """

    rpy_rad: Vector = (0.0, 0.0, 0.0)  # Roll, pitch and yaw, rad

    @property
    def turns(self) -> bool:
        """Return whether the case is turned at all."""
        return any(self.rpy_rad)

    @cached_property
    def rotation(self) -> Any:
        """Return R as a `Rotation` of scipy."""
        return scipy.spatial.transform.Rotation.from_euler('xyz', self.rpy_rad)

    @cached_property
    def rows(self) -> np.ndarray:
        """Return R, (3, 3)."""
        return self.rotation.as_matrix()

    def rotate(self, vector: Sequence[float]) -> list[float]:
        """Return a vector of the case in the frame of the robot."""
        return (self.rows @ vector).tolist()

    def rotate_covariance(self, covariance: Sequence[float]) -> tuple[float, ...]:
        """Return the covariance R·C·Rᵀ; both are xx, xy, xz, yy, yz, zz."""
        xx, xy, xz, yy, yz, zz = covariance
        turned = self.rotate_matrix((xx, xy, xz, xy, yy, yz, xz, yz, zz))
        return *turned[:3], *turned[4:6], turned[8]

    def rotate_matrix(self, covariance: Sequence[float]) -> tuple[float, ...]:
        """Return the covariance R·C·Rᵀ; both have 9 numbers, row by row."""
        turned = self.rows @ np.reshape(covariance, (3, 3)) @ self.rows.T
        return tuple(turned.ravel().tolist())

    def rotate_orientation(self, quaternion: Sequence[float]) -> tuple[float, ...]:
        """Return the orientation of the robot from that of the case."""
        case = scipy.spatial.transform.Rotation.from_quat(quaternion)
        return tuple((case * self.rotation.inv()).as_quat().tolist())

    def levelled(self, force_mps2: Sequence[float]) -> Mounting:
        """Return the mounting that makes a force at rest vertical, with the yaw of this one."""
        x, y, z = force_mps2
        return Mounting((atan2(y, z), atan2(-x, hypot(y, z)), self.rpy_rad[2]))
