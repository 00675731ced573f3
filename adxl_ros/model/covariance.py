# SPDX-License-Identifier: Apache-2.0

"""
Covariance of the specific force of samples: noise and uncertain coefficients.

Outside of the validity range of the calibration, `validity` adds to the covariance.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from adxl_ros.model import noise, signal_chain
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.effects.base import (
    ARRAYS,
    Coefficient,
    Components,
    Environment,
    Maths,
    NOMINAL_ENVIRONMENT,
    Value,
)
from adxl_ros.model.kinematics import Covariance3, FORCE2_FLOOR
from adxl_ros.model.sensor import get, parameter_of, put, Sensor
from adxl_ros.model.signal_chain import analog_response, static_response
import numpy as np

UNMEASURED_VARIANCE = 1e6  # Of an axis that is not there, (m/s²)²; chosen: above any force
NOT_MEASURED = np.array([-1.0, *[0.0] * 8])
"""Covariance, row by row, of a quantity that is not measured (sensor_msgs/Imu, REP-145)."""
_OVERHANG_MPS2 = -0.5  # Lowest z of an upright sensor, m/s²; chosen: 3° over
_ROOT_MEAN = 1.25
"""Factor of the term that keeps the divisor of derived z from 0 where the in-plane force is g.
Derived: there z² = 2·σ·g·n for normal noise n > 0, and the variance of z is 0.8·σ·g = σ·g/1.25."""
_RELATIVE_STEP = 1e-3  # Step by coefficients, typical sizes; chosen: nearly linear


def imu_covariance(sensor: Sensor) -> np.ndarray:
    """Return the covariance of the acceleration of a sample by rows, as sensor_msgs/Imu has it."""
    variance = np.full(3, UNMEASURED_VARIANCE)
    std_mps2 = noise.sample_std_v(sensor) / sensor.nominal_scale_v_per_g * G0_MPS2
    variance[: len(sensor.axes)] = std_mps2**2
    return np.diag(variance).ravel()


def force_covariance(
    sensor: Sensor,
    force: Components,
    sample_variance_v2: np.ndarray | None = None,
    environment: Environment = NOMINAL_ENVIRONMENT,
) -> np.ndarray:
    """
    Return the covariance of the specific force that `signal_chain.inverse` estimates.

    Noise and covariance of the coefficients go through the tangent of the inverse. The z of an
    x/y sensor is derived from |f| = g; see `derived_z_covariance`. The variance of the volts is
    that of one sample unless given, V², (m,). Returned in (m/s²)², (3, 3, n).
    """
    force = [np.atleast_1d(np.asarray(f, float)) for f in force]
    return of_three_axes(
        sensor, force, *measured_covariance(sensor, sample_variance_v2)(force, environment)
    )


def of_three_axes(
    sensor: Sensor, force: Components, measured: np.ndarray, tangent: signal_chain.Tangent
) -> np.ndarray:
    """Complete the result of `measured_covariance` to `force_covariance`."""
    if sensor.axes == 'xy':
        in_plane = measured[0, 0], measured[0, 1], measured[1, 1]
        return derived_z_covariance(force, in_plane, tangent.slope, ARRAYS).matrix
    covariance = np.zeros((3, 3, len(force[0])))
    covariance[1, 1] = covariance[2, 2] = UNMEASURED_VARIANCE
    axes = sensor.axis_indices
    covariance[np.ix_(axes, axes)] = measured
    return covariance


def measured_covariance(
    sensor: Sensor, sample_variance_v2: np.ndarray | None = None, is_upright_certain: bool = True
) -> Callable[..., tuple[np.ndarray, signal_chain.Tangent]]:
    """
    Prepare the covariance of the measured axes, given the others; see `force_covariance`.

    It maps specific force and an `Environment` (nominal unless given) to the covariance, (m/s²)²,
    (m, m, n), and the tangent of the inverse at the force. Where it is not certain which way up a
    sensor is whose z is derived, half the square of what x and y are for the other sign is added,
    because either may be true.
    """
    if sample_variance_v2 is None:
        sample_variance_v2 = noise.sample_std_v(sensor) ** 2
    respond = analog_response(sensor)
    by_coefficient = coefficient_tangent(sensor)
    envelope = sensor.envelope

    def covariance(
        force: Components, environment: Environment = NOMINAL_ENVIRONMENT
    ) -> tuple[np.ndarray, signal_chain.Tangent]:
        tangent = signal_chain.tangent(respond, sensor.axes, force, environment)
        variance_v2 = np.diag(sample_variance_v2)[:, :, None]
        if len(sensor.covariance):
            variance_v2 = variance_v2 + _propagated(
                by_coefficient(force, environment), sensor.covariance
            )
        measured = _propagated(tangent.back, variance_v2)
        extrapolation = envelope.extrapolation(force)
        for d, axis in enumerate(sensor.axes):
            measured[d, d] += envelope.added_variance(
                force[AXES.index(axis)], environment.temperature_c, extrapolation
            )
        if tangent.slope and not is_upright_certain:
            other_v = respond([*force[:2], -force[2]], environment)
            change_v = list(map(np.subtract, respond(force, environment), other_v))
            apart = np.einsum(
                'ijn,jn->in',
                np.asarray(tangent.back).reshape(2, 2, -1),
                np.reshape(change_v, (2, -1)),
            )
            measured += np.einsum('in,jn->ijn', apart, apart) / 2
        for d, std_g in enumerate(envelope.zero_g_std_g(environment.temperature_c)):
            measured[d, d] += (G0_MPS2 * std_g) ** 2
        return measured, tangent

    return covariance


def _propagated(slope: Any, covariance: np.ndarray) -> np.ndarray:
    """Propagate a covariance, (k, k) or (k, k, n), by slopes, (m, k, n): (m, m, n)."""
    slope = np.asarray(slope).reshape(len(slope), len(covariance), -1)
    spread = (
        np.tensordot(covariance, slope, (1, 1))
        if covariance.ndim == 2
        else np.einsum('abn,jbn->ajn', covariance, slope)
    )
    return np.einsum('ian,ajn->ijn', slope, spread)


def derived_z_covariance(
    force: Components, measured: tuple[Value, Value, Value], slope: Components, maths: Maths
) -> Covariance3:
    """
    Propagate the in-plane covariance to z = √(g² − x² − y²), equation 5.

    With x = x₀ + s·z, dz = −(x·dx₀ + y·dy₀)/(z + x·s). Where the divisor vanishes, at alpha =
    ±90°, the error of z is the root of the noise and not its multiple. Its variance is 0.8·σ·g,
    and it hardly correlates with dx₀ and dy₀. Near alpha = ±90°, |f|² = g² has a second solution,
    z − 2·divisor/(1 + s²). Where that is upright, too, either may be true, so that half the
    square of their distance is added.

    measured: variances xx, xy and yy of the force given z; slope: derivative s of the estimates
    of x and y by z; returns: (m/s²)².
    """
    x, y, z = force
    xx, xy, yy = measured
    along = maths.sqrt(maths.maximum(x * x * xx + 2 * x * y * xy + y * y * yy, 0.0))
    divisor = z + x * slope[0] + y * slope[1]
    blunted2 = divisor * divisor + _ROOT_MEAN * along + FORCE2_FLOOR
    by_x, by_y = -x * divisor / blunted2, -y * divisor / blunted2
    distance = 2 * divisor / (1 + slope[0] ** 2 + slope[1] ** 2)
    upright = maths.where(divisor < 0, -1.0, 1.0) * (z - distance) > _OVERHANG_MPS2
    independent = _ROOT_MEAN * along * along * along / (blunted2 * blunted2) + maths.where(
        upright, distance * distance / 2, 0.0
    )
    xz, yz = by_x * xx + by_y * xy, by_x * xy + by_y * yy
    zz = by_x * xz + by_y * yz + independent
    # The error of z goes on to x and y.
    by_zz = [by_z * zz for by_z in slope]
    return Covariance3(
        xx + slope[0] * (2 * xz + by_zz[0]),
        xy + slope[0] * yz + slope[1] * (xz + by_zz[0]),
        xz + by_zz[0],
        yy + slope[1] * (2 * yz + by_zz[1]),
        yz + by_zz[1],
        zz,
    )


def coefficient_tangent(sensor: Sensor) -> Callable[..., np.ndarray]:
    """
    Prepare the derivatives of the volts by the coefficients in `sensor.covariance_names`.

    They are central differences. They map a force and an `Environment` (nominal unless given) to
    derivatives, (m, k, n).
    """
    names = sensor.covariance_names
    steps = _RELATIVE_STEP * np.array([parameter_of(name).scale for name in names])

    def response_at(name: Coefficient, change: float) -> Callable[..., Components]:
        return static_response(put(sensor, [name], get(sensor, [name]) + change))

    above = list(map(response_at, names, steps))
    below = list(map(response_at, names, -steps))

    def by_coefficient(
        force: Components, environment: Environment = NOMINAL_ENVIRONMENT
    ) -> np.ndarray:
        slopes = np.zeros((len(sensor.axes), len(names), np.size(force[0])))
        for row, step in enumerate(steps):
            high, low = above[row](force, environment), below[row](force, environment)
            for axis, (a, b) in enumerate(zip(high, low)):
                slopes[axis, row] = (a - b) / (2 * step)
        return slopes

    return by_coefficient
