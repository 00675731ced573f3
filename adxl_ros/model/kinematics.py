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
UNOBSERVABLE_RAD2 = 1.0  # Variance of an angle that is not shown, rad²; a guess has 1.8²
UNKNOWN_ANGLE_RAD2 = 1e6
"""Variance of an angle that is not known, rad²; yaw is never known.

π²/3, that of a uniform angle, would let a filter that fuses 1000 samples a second believe in
yaw = 0 before long. 1e6, as for an axis that is not there, never counts."""
INFINITE = float('inf')  # Variance of an angle that the force does not determine, rad²
FORCE2_FLOOR = 1e-30
"""Square of a negligible force, (m/s²)²: it keeps divisors from 0, and is far below any noise."""
_UPPER = np.triu_indices(3)  # Rows and columns of xx, xy, xz, yy, yz, zz in a matrix
Vector = tuple[float, float, float]  # Three components


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
    up_x, up_y, up_z = up
    x = gravity_mps2 * up_x
    y = gravity_mps2 * up_y
    z = gravity_mps2 * up_z
    sin_alpha, cos_alpha = np.sin(alpha_rad), np.cos(alpha_rad)
    sin_beta, cos_beta = np.sin(beta_rad), np.cos(beta_rad)
    along = x * cos_alpha + z * sin_alpha
    return [
        along * cos_beta + y * sin_beta + shift_acceleration_mps2,
        y * cos_beta - along * sin_beta,
        z * cos_alpha - x * sin_alpha,
    ]


def gravity_slopes(alpha_rad: np.ndarray, beta_rad: np.ndarray) -> np.ndarray:
    """Return the derivatives of gravity's direction in the sensor by both angles, (2, 3, n)."""
    sin_alpha, cos_alpha = np.sin(alpha_rad), np.cos(alpha_rad)
    sin_beta, cos_beta = np.sin(beta_rad), np.cos(beta_rad)
    return np.array(
        [
            [cos_alpha * cos_beta, -cos_alpha * sin_beta, -sin_alpha],
            [-sin_alpha * sin_beta, -sin_alpha * cos_beta, 0 * sin_alpha],
        ]
    )


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


def unit_vectors(vectors: np.ndarray) -> np.ndarray:
    """Return vectors, (n, 3), with the length 1."""
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def cross_product(a: Components, b: Components) -> Components:
    """Return the vector product a × b."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


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
    with np.errstate(over='ignore', invalid='ignore'):
        components = Covariance3.of(covariance)
        roll, pitch, inclination = map(_shown, angles(force, components, ARRAYS))
        beta = _shown(turn_of_stage(force, components, ARRAYS))
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


class Angles(NamedTuple):
    """The tilt by the force of one sample at rest, or of many; see `Tilt`."""

    roll: AngleEstimate
    pitch: AngleEstimate
    inclination: AngleEstimate


class Covariance3(NamedTuple):
    """Covariance of a vector x, y, z: floats or arrays (n,)."""

    xx: Value
    xy: Value
    xz: Value
    yy: Value
    yz: Value
    zz: Value

    @classmethod
    def of(cls, matrix: np.ndarray) -> Covariance3:
        """Return that of a symmetric matrix, (3, 3) or (3, 3, n)."""
        return cls(*matrix[_UPPER])

    @property
    def row_by_row(self) -> tuple[Value, ...]:
        """Return the nine elements of the matrix."""
        xx, xy, xz, yy, yz, zz = self
        return xx, xy, xz, xy, yy, yz, xz, yz, zz

    @property
    def matrix(self) -> np.ndarray:
        """Return the matrix, (3, 3) or (3, 3, n)."""
        return np.reshape(self.row_by_row, (3, 3, *np.shape(self.xx)))

    def along(self, x: Value, y: Value, z: Value) -> Value:
        """Return uᵀ·C·u with u = x, y, z: the variance of a quantity whose gradient is u."""
        xx, xy, xz, yy, yz, zz = self
        return x * (xx * x + 2 * (xy * y + xz * z)) + y * (yy * y + 2 * yz * z) + z * zz * z

    def widened(self, x: Value, y: Value, z: Value) -> Covariance3:
        """Return the covariance with further variances of the components."""
        xx, xy, xz, yy, yz, zz = self
        return Covariance3(xx + x, xy, xz, yy + y, yz, zz + z)


def angles(force: Components, covariance: Covariance3, maths: Maths) -> Angles:
    """
    Return the angles of a force at rest, whose variances follow from their gradients by it.

    Where noise exceeds the part of the force that shows roll, the angle can be anything: its
    variance is infinite. Pitch and inclination are then the length of a small vector of any
    direction.
    """
    x, y, z = force
    xx, _, _, yy, _, zz = covariance
    # Squares of the force in the planes xy and yz, and of all of it
    plane2 = x * x + y * y + FORCE2_FLOOR
    side2 = y * y + z * z + FORCE2_FLOOR
    total2 = side2 + x * x
    plane = maths.sqrt(plane2)
    side = maths.sqrt(side2)
    pitch2 = covariance.along(side, -x * y / side, -x * z / side)
    inclination2 = covariance.along(-z * x / plane, -z * y / plane, plane)
    return Angles(
        AngleEstimate(
            maths.atan2(y, z),
            _turn_variance(side2, yy + zz, covariance.along(0.0, z, -y), maths),
        ),
        AngleEstimate(
            maths.atan2(-x, side), _tilt_variance(side2, yy + zz, pitch2, total2, maths)
        ),
        AngleEstimate(
            maths.atan2(plane, z), _tilt_variance(plane2, xx + yy, inclination2, total2, maths)
        ),
    )


def turn_of_stage(force: Components, covariance: Covariance3, maths: Maths) -> AngleEstimate:
    """Return beta, the angle of the stage about its z axis, by a force at rest; see `angles`."""
    x, y, _ = force
    plane2 = x * x + y * y + FORCE2_FLOOR
    noise2 = covariance.xx + covariance.yy
    return AngleEstimate(
        maths.atan2(0.0 - y, x),
        _turn_variance(plane2, noise2, covariance.along(y, -x, 0.0), maths),
    )


def _turn_variance(square: Value, noise2: Value, across: Value, maths: Maths) -> Value:
    """
    Return the variance of the angle of a vector in its plane, rad².

    square: its square, whose variance is noise2; across: variance across it times the square.
    """
    return maths.where(square > noise2 + FORCE2_FLOOR, across / (square * square), INFINITE)


def _tilt_variance(
    square: Value, noise2: Value, across: Value, total2: Value, maths: Maths
) -> Value:
    """
    Return the variance of the angle between a force and a plane, rad².

    square: that of the part in the plane, whose variance is noise2; across: variance of the force
    across itself, towards the plane, times its square total2.
    """
    return maths.where(square > noise2, across / (total2 * total2), noise2 / total2)


def quaternion(roll_rad: Value, pitch_rad: Value, maths: Maths) -> tuple[Value, ...]:
    """Return the orientation x, y, z, w of a roll and pitch, rad, at a yaw of 0."""
    sr, cr = maths.sin(roll_rad / 2), maths.cos(roll_rad / 2)
    sp, cp = maths.sin(pitch_rad / 2), maths.cos(pitch_rad / 2)
    return sr * cp, cr * sp, -sr * sp, cr * cp


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

    def rotate_covariance(self, covariance: Covariance3) -> Covariance3:
        """Return the covariance R·C·Rᵀ."""
        xx, xy, xz, _, yy, yz, _, _, zz = self.rotate_matrix(covariance.row_by_row)
        return Covariance3(xx, xy, xz, yy, yz, zz)

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
