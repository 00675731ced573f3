# SPDX-License-Identifier: Apache-2.0

"""Kinematics of the two-axis rotary stage with a linear third joint."""

from __future__ import annotations

from adxl_ros.model.effects.base import Components, Joint, Value
import numpy as np

UPRIGHT = (0.0, 0.0, 1.0)
"""The vertical in the frame of a level base, a unit vector."""


def specific_force(alpha_rad: Value, beta_rad: Value, gravity_mps2: float,
                   shift_acceleration_mps2: Value = 0.0,
                   up: Components | tuple[float, float, float] = UPRIGHT) -> Components:
    """
    Specific force in the case frame of a sensor on the stage, m/s².

    At rest f = g·[sin α·cos β, −sin α·sin β, cos α]; a displacement along the sensor's x adds
    its second derivative.

    Parameters
    ----------
    alpha_rad, beta_rad
        Joint angles, rad, arrays or floats of one shape.
    gravity_mps2
        Local gravity, m/s².
    shift_acceleration_mps2
        Second derivative of the `shift` joint, m/s².
    up
        The vertical in the frame of the stage's base; its y is the axis of alpha.

    Returns
    -------
    list
        The three components, each in the shape of the angles.

    """
    x, y, z = (gravity_mps2 * u for u in up)
    sin_alpha, cos_alpha = np.sin(alpha_rad), np.cos(alpha_rad)
    sin_beta, cos_beta = np.sin(beta_rad), np.cos(beta_rad)
    along = x * cos_alpha + z * sin_alpha
    return [along * cos_beta + y * sin_beta + shift_acceleration_mps2,
            y * cos_beta - along * sin_beta,
            z * cos_alpha - x * sin_alpha]


def stage_angles(roll_rad: np.ndarray, pitch_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the stage angles that hold the sensor at a tilt.

    Parameters
    ----------
    roll_rad, pitch_rad
        Tilt by REP-103, rad, (n,): roll = atan2(fy, fz), pitch = atan2(−fx, hypot(fy, fz)).

    Returns
    -------
    alpha_rad, beta_rad : ndarray
        Stage angles, rad, (n,): alpha from 0 to π, beta from −π to π, 0 where alpha is 0.

    """
    x = -np.sin(pitch_rad)
    y = np.sin(roll_rad) * np.cos(pitch_rad)
    z = np.cos(roll_rad) * np.cos(pitch_rad)
    return np.arctan2(np.hypot(x, y), z), np.arctan2(-y, x + 0.0)


def specific_force_in_motion(alpha: Joint, beta: Joint, shift: Joint, gravity_mps2: float,
                             up: Components | tuple[float, float, float] = UPRIGHT
                             ) -> Components:
    """
    Specific force in the case frame of a sensor while all joints move, m/s².

    A shifted sensor is carried by the turning stage, and the Coriolis acceleration adds to its
    force.

    Parameters
    ----------
    alpha, beta, shift
        Joints with their derivatives, rad and m, arrays or floats of one shape.
    gravity_mps2
        Local gravity, m/s².
    up
        The vertical in the frame of the stage's base; its y is the axis of alpha.

    Returns
    -------
    list
        The three components, each in the shape of the joints.

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

    Parameters
    ----------
    alpha, beta
        Joints with their derivatives, rad, arrays or floats of one shape.

    Returns
    -------
    tuple
        Angular velocity, rad/s, and angular acceleration, rad/s², three components each.

    """
    sin_beta, cos_beta = np.sin(beta.position), np.cos(beta.position)
    along, across = sin_beta * alpha.velocity, cos_beta * alpha.velocity
    return ([-along, -across, beta.velocity],
            [-sin_beta * alpha.acceleration - across * beta.velocity,
             -cos_beta * alpha.acceleration + along * beta.velocity,
             beta.acceleration])


def carried_acceleration(omega: Components, omega_dot: Components, r: Components) -> Components:
    """
    Acceleration of a point that a turning body carries: ω × (ω × r) + ω̇ × r.

    Parameters
    ----------
    omega
        Angular velocity of the body in its frame, rad/s, three components.
    omega_dot
        Angular acceleration of the body in its frame, rad/s², three components.
    r
        Vector from the axis to the point in the frame of the body, m, three components.

    Returns
    -------
    list
        Acceleration in the frame of the body, m/s², three components.

    """
    centripetal = cross_product(omega, cross_product(omega, r))
    return [c + t for c, t in zip(centripetal, cross_product(omega_dot, r))]


def cross_product(a: Components, b: Components) -> Components:
    """
    Return the vector product a × b.

    Parameters
    ----------
    a, b
        Vectors of three components, arrays or floats of one shape.

    Returns
    -------
    list
        Three components.

    """
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
