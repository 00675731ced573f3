# SPDX-License-Identifier: Apache-2.0

"""The case of the sensor in the frame of the robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import atan2, cos, hypot, sin

import numpy as np

Vector = tuple[float, float, float]
"""Three components."""


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
    def rows(self) -> tuple[Vector, Vector, Vector]:
        """Return the rows of R."""
        roll, pitch, yaw = self.rpy_rad
        sr, cr, sp, cp = sin(roll), cos(roll), sin(pitch), cos(pitch)
        sy, cy = sin(yaw), cos(yaw)
        return ((cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
                (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
                (-sp, cp * sr, cp * cr))

    @cached_property
    def inverse_quaternion(self) -> tuple[float, float, float, float]:
        """Return the quaternion x, y, z, w of Rᵀ, from the robot to the case."""
        roll, pitch, yaw = (angle / 2 for angle in self.rpy_rad)
        sr, cr, sp, cp = sin(roll), cos(roll), sin(pitch), cos(pitch)
        sy, cy = sin(yaw), cos(yaw)
        return (-(sr * cp * cy - cr * sp * sy), -(cr * sp * cy + sr * cp * sy),
                -(cr * cp * sy - sr * sp * cy), cr * cp * cy + sr * sp * sy)

    def rotate(self, vector: Sequence[float]) -> list[float]:
        """Return a vector of the case in the frame of the robot."""
        x, y, z = vector
        return [a * x + b * y + c * z for a, b, c in self.rows]

    def rotate_covariance(self, covariance: Sequence[float]) -> tuple[float, ...]:
        """Return the covariance R·C·Rᵀ; both are xx, xy, xz, yy, yz, zz."""
        xx, xy, xz, yy, yz, zz = covariance
        half = [(a * xx + b * xy + c * xz, a * xy + b * yy + c * yz, a * xz + b * yz + c * zz)
                for a, b, c in self.rows]
        return tuple(sum(h * r for h, r in zip(half[i], self.rows[j]))
                     for i in range(3) for j in range(i, 3))

    def rotate_matrix(self, covariance: Sequence[float]) -> tuple[float, ...]:
        """Return the covariance R·C·Rᵀ; both have 9 numbers, row by row."""
        matrix = np.reshape(covariance, (3, 3))
        rotation = np.array(self.rows)
        return tuple((rotation @ matrix @ rotation.T).ravel().tolist())

    def rotate_orientation(self, quaternion: Sequence[float]) -> tuple[float, ...]:
        """Return the orientation of the robot from that of the case."""
        ax, ay, az, aw = quaternion
        bx, by, bz, bw = self.inverse_quaternion
        return (aw * bx + ax * bw + ay * bz - az * by, aw * by - ax * bz + ay * bw + az * bx,
                aw * bz + ax * by - ay * bx + az * bw, aw * bw - ax * bx - ay * by - az * bz)

    def levelled(self, force_mps2: Sequence[float]) -> Mounting:
        """
        Return the mounting that makes a force at rest vertical, with the yaw of this one.

        force_mps2: mean specific force in the frame of the case, on level ground, m/s², (3,).
        """
        x, y, z = force_mps2
        return Mounting((atan2(y, z), atan2(-x, hypot(y, z)), self.rpy_rad[2]))
