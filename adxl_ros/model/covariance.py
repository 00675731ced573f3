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
Covariance of the specific force of samples: noise and uncertain coefficients.

Outside of the validity range of the calibration, `validity` adds to the covariance.
"""

from __future__ import annotations

from collections.abc import Callable

from adxl_ros.model import coefficients, noise, signal_chain
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.effects.base import Components, Environment, NOMINAL_ENVIRONMENT, Value
from adxl_ros.model.scalar_or_array import ARRAYS, Maths
from adxl_ros.model.sensor import Sensor
import numpy as np

UNMEASURED_VARIANCE = 1e6
"""Variance of an axis that the sensor does not have, (m/s²)²; chosen: far above any force."""

_FORCE2_FLOOR = 1e-30
"""Square of a negligible force, (m/s²)²; chosen: below any noise, it keeps divisors from 0."""

_OVERHANG_MPS2 = -0.5
"""Lowest z of a sensor that is stated to be upright, m/s²; chosen: it may lean over by 3°."""

_RELATIVE_STEP = 1e-3
"""Step of the central differences by coefficients, in typical sizes; chosen: the chain is smooth
and nearly linear in them."""

_ROOT_MEAN = 1.25
"""Factor of the term that keeps the divisor of derived z from 0 where the in-plane force is g.
Derived: there z² = 2·σ·g·n for normal noise n > 0, and the variance of z is 0.8·σ·g = σ·g/1.25."""


def force_covariance(sensor: Sensor, force: Components,
                     sample_variance_v2: np.ndarray | None = None,
                     environment: Environment = NOMINAL_ENVIRONMENT) -> np.ndarray:
    """
    Return the covariance of the specific force that `signal_chain.inverse` estimates.

    Noise and covariance of the coefficients go through the tangent of the inverse. The z of an
    x/y sensor is derived from |f| = g; see `derived_z_covariance`.

    Parameters
    ----------
    sensor
        Calibrated unit with the covariance of its coefficients.
    force
        Specific force in the case frame, m/s², three components (n,).
    sample_variance_v2
        Variance of the volts by axis, V², (m,); that of the noise of one sample unless given.
    environment
        Surroundings of the samples.

    Returns
    -------
    ndarray
        Covariance, (m/s²)², (3, 3, n).

    """
    force = [np.atleast_1d(np.asarray(f, float)) for f in force]
    measured, tangent = measured_covariance(sensor, sample_variance_v2)(force, environment)
    axes = [AXES.index(axis) for axis in sensor.axes]
    covariance = np.zeros((3, 3, len(force[0])))
    covariance[1, 1] = covariance[2, 2] = UNMEASURED_VARIANCE
    covariance[np.ix_(axes, axes)] = measured
    if sensor.axes == 'xy':
        in_plane = measured[0, 0], measured[0, 1], measured[1, 1]
        xx, xy, xz, yy, yz, zz = derived_z_covariance(force, in_plane, tangent.slope, ARRAYS)
        covariance = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return covariance


def measured_covariance(sensor: Sensor, sample_variance_v2: np.ndarray | None = None
                        ) -> Callable[..., tuple[np.ndarray, signal_chain.Tangent]]:
    """
    Prepare the covariance of the measured axes, given the others.

    Parameters
    ----------
    sensor
        Calibrated unit with the covariance of its coefficients.
    sample_variance_v2
        Variance of the volts by axis, V², (m,); that of the noise of one sample unless given.

    Returns
    -------
    callable
        Maps specific force, m/s², three components (n,) or floats, and an `Environment` (the
        nominal one unless given) to the covariance, (m/s²)², (m, m, n), and to the
        `signal_chain.Tangent` at the force.

    """
    if sample_variance_v2 is None:
        sample_variance_v2 = noise.sample_std_v(sensor) ** 2
    m = len(sensor.axes)
    respond = signal_chain.analog_response(sensor)
    by_coefficient = coefficient_tangent(sensor)
    force_leverage = leverage(sensor)

    def covariance(force: Components, environment: Environment = NOMINAL_ENVIRONMENT
                   ) -> tuple[np.ndarray, signal_chain.Tangent]:
        tangent = signal_chain.tangent(respond, sensor.axes, force, environment)
        volts = np.diag(sample_variance_v2)
        if len(sensor.covariance):
            slope = by_coefficient(force, environment).reshape(m, len(sensor.covariance), -1)
            slope = np.moveaxis(slope, 2, 0)
            volts = volts + slope @ sensor.covariance @ np.swapaxes(slope, 1, 2)
        back: np.ndarray = np.moveaxis(np.array(tangent.back).reshape(m, m, -1), 2, 0)
        measured = np.moveaxis(back @ volts @ np.swapaxes(back, 1, 2), 0, 2)
        envelope = sensor.envelope
        if envelope.temperature_c or envelope.leverage:
            extrapolation = envelope.extrapolation(
                force, force_leverage(force) if envelope.leverage else 0.0)
            for d, axis in enumerate(sensor.axes):
                measured[d, d] += envelope.added_variance(
                    force[AXES.index(axis)], environment.temperature_c, extrapolation, G0_MPS2)
        return measured, tangent

    return covariance


def leverage(sensor: Sensor) -> Callable[[Components], np.ndarray]:
    """
    Prepare the leverage of forces: the trace of their covariance by the coefficients alone.

    Returns
    -------
    callable
        Maps specific force, m/s², three components (n,) or floats, to the trace over the
        measured axes in the nominal environment, (m/s²)², (n,); 0 without a covariance.

    """
    m = len(sensor.axes)
    respond = signal_chain.analog_response(sensor)
    by_coefficient = coefficient_tangent(sensor)

    def force_leverage(force: Components) -> np.ndarray:
        if not sensor.covariance_names:
            return np.zeros(np.shape(force[0]) or 1)
        slope = np.moveaxis(by_coefficient(force).reshape(m, len(sensor.covariance), -1), 2, 0)
        tangent = signal_chain.tangent(respond, sensor.axes, force)
        back: np.ndarray = np.moveaxis(np.array(tangent.back).reshape(m, m, -1), 2, 0)
        force_slope = back @ slope
        return np.einsum('nap,pq,naq->n', force_slope, sensor.covariance, force_slope)

    return force_leverage


def derived_z_covariance(force: Components, measured: tuple[Value, Value, Value],
                         slope: Components, maths: Maths) -> tuple[Value, ...]:
    """
    Propagate the in-plane covariance to z = √(g² − x² − y²), equation 5.

    With x = x₀ + s·z, dz = −(x·dx₀ + y·dy₀)/(z + x·s). Where the divisor vanishes, at alpha =
    ±90°, the error of z is the root of the noise and not its multiple. Its variance is 0.8·σ·g,
    and it hardly correlates with dx₀ and dy₀. Near alpha = ±90°, |f|² = g² has a second solution,
    z − 2·divisor/(1 + s²). Where that is upright, too, either may be true, so that half the
    square of their distance is added.

    Parameters
    ----------
    force
        Specific force, m/s², three components.
    measured
        Variances xx, xy and yy of the force given z, (m/s²)².
    slope
        Derivative s of the estimates of x and y by z; see `signal_chain.Tangent`.
    maths
        Functions for arrays or for floats.

    Returns
    -------
    tuple
        xx, xy, xz, yy, yz and zz, (m/s²)².

    """
    x, y, z = force
    xx, xy, yy = measured
    along = maths.sqrt(maths.maximum(x * x * xx + 2 * x * y * xy + y * y * yy, 0.0))
    divisor = z + x * slope[0] + y * slope[1]
    blunted2 = divisor * divisor + _ROOT_MEAN * along + _FORCE2_FLOOR
    by_x, by_y = -x * divisor / blunted2, -y * divisor / blunted2
    distance = 2 * divisor / (1 + slope[0] ** 2 + slope[1] ** 2)
    upright = maths.where(divisor < 0, -1.0, 1.0) * (z - distance) > _OVERHANG_MPS2
    independent = (_ROOT_MEAN * along * along * along / (blunted2 * blunted2)
                   + maths.where(upright, distance * distance / 2, 0.0))
    rows = ((1 + slope[0] * by_x, slope[0] * by_y, slope[0]),
            (slope[1] * by_x, 1 + slope[1] * by_y, slope[1]), (by_x, by_y, 1.0))
    return tuple(a * c * xx + (a * d + b * c) * xy + b * d * yy + e * f * independent
                 for i, (a, b, e) in enumerate(rows) for c, d, f in rows[i:])


def coefficient_tangent(sensor: Sensor) -> Callable[..., np.ndarray]:
    """
    Prepare the derivatives of the volts by the coefficients in `sensor.covariance_names`.

    Returns
    -------
    callable
        Maps specific force, m/s², three components (n,) or floats, and an `Environment` (the
        nominal one unless given) to derivatives by axis and coefficient, V by the unit of the
        coefficient, (m, k, n). They are central differences.

    """
    differences = []
    for name in sensor.covariance_names:
        value = coefficients.get(sensor, [name])
        step = _RELATIVE_STEP * coefficients.parameter_of(name).scale
        above, below = (
            signal_chain.static_response(coefficients.put(sensor, [name], value + change))
            for change in (step, -step))
        differences.append((above, below, 2 * step))

    def by_coefficient(force: Components,
                       environment: Environment = NOMINAL_ENVIRONMENT) -> np.ndarray:
        columns = [[(a - b) / distance for a, b in zip(above(force, environment),
                                                       below(force, environment))]
                   for above, below, distance in differences]
        return np.swapaxes(np.array(columns), 0, 1)

    return by_coefficient
