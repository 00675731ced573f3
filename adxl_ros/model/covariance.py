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
Covariance of a sample's specific force: its noise and what the calibration left unknown.

Where a sample lies outside of what was calibrated, `validity` adds to it.
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
"""Variance of an axis that the sensor does not have, (m/s²)²."""

_NOTHING = 1e-30
"""Square of a force that is none, (m/s²)²; keeps a divisor from 0."""

_OVERHANG_MPS2 = -0.5
"""A sensor that is said to be upright may still lean over by 3°."""


def force_covariance(sensor: Sensor, force: Components,
                     sample_variance_v2: np.ndarray | None = None,
                     environment: Environment = NOMINAL_ENVIRONMENT) -> np.ndarray:
    """
    Covariance of the specific force that `signal_chain.inverse` gives, (m/s²)², (3, 3, n).

    Noise and parameter covariance go through the inverse's tangent. For an x/y sensor, z comes
    from |f| = g; see `equation_5`.

    Parameters
    ----------
    sensor
        Calibrated figures with their covariance.
    force
        Specific force in the case frame, m/s², three components (n,).
    sample_variance_v2
        Variance of the volts by axis, V², (m,); that of one sample's noise unless given.
    environment
        Around the samples.

    """
    force = [np.atleast_1d(np.asarray(f, float)) for f in force]
    measured, at = measured_covariance(sensor, sample_variance_v2)(force, environment)
    axes = [AXES.index(a) for a in sensor.axes]
    full = np.zeros((3, 3, len(force[0])))
    full[1, 1] = full[2, 2] = UNMEASURED_VARIANCE
    full[np.ix_(axes, axes)] = measured
    if sensor.axes == 'xy':
        xx, xy, xz, yy, yz, zz = equation_5(force, (measured[0, 0], measured[0, 1],
                                                    measured[1, 1]), at.slope, ARRAYS)
        full = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return full


def measured_covariance(sensor: Sensor, sample_variance_v2: np.ndarray | None = None
                        ) -> Callable[..., tuple[np.ndarray, signal_chain.Tangent]]:
    """
    Prepare the covariance of the measured axes, given the others.

    Parameters
    ----------
    sensor, sample_variance_v2
        As for `force_covariance`.

    Returns
    -------
    callable
        Maps specific force, m/s², three arrays (n,) or floats, and an `Environment`, if it is
        not the nominal one, to the covariance, (m/s²)²,
        (m, m, n), and the `signal_chain.Tangent` there.

    """
    if sample_variance_v2 is None:
        sample_variance_v2 = noise.sigma_v(sensor) ** 2
    m = len(sensor.axes)
    respond, by_parameter = signal_chain.analog_response(sensor), _parameter_tangent(sensor)
    at_leverage = leverage(sensor)

    def covariance(force: Components, environment: Environment = NOMINAL_ENVIRONMENT
                   ) -> tuple[np.ndarray, signal_chain.Tangent]:
        at = signal_chain.tangent(respond, sensor.axes, force, environment)
        volts = np.diag(sample_variance_v2)
        if len(sensor.covariance):
            of = by_parameter(force, environment).reshape(m, len(sensor.covariance), -1)
            of = np.moveaxis(of, 2, 0)
            volts = volts + of @ sensor.covariance @ np.swapaxes(of, 1, 2)
        back: np.ndarray = np.moveaxis(np.array(at.back).reshape(m, m, -1), 2, 0)
        found = np.moveaxis(back @ volts @ np.swapaxes(back, 1, 2), 0, 2)
        if sensor.envelope.temperature_c or sensor.envelope.leverage:
            far = sensor.envelope.reach(
                force, at_leverage(force) if sensor.envelope.leverage else 0.0)
            for d, axis in enumerate(sensor.axes):
                found[d, d] += sensor.envelope.added(
                    force[AXES.index(axis)], environment.temperature_c, far, G0_MPS2)
        return found, at

    return covariance


def leverage(sensor: Sensor) -> Callable[[Components], np.ndarray]:
    """
    Prepare what the calibration's covariance alone makes of a force; see `validity`.

    Returns
    -------
    callable
        Maps specific force, m/s², three arrays (n,) or floats, to the trace of its covariance
        over the measured axes at nominal surroundings, (m/s²)², (n,); 0 without a covariance.

    """
    m = len(sensor.axes)
    respond, by_parameter = signal_chain.analog_response(sensor), _parameter_tangent(sensor)

    def of(force: Components) -> np.ndarray:
        if not sensor.covariance_names:
            return np.zeros(np.shape(force[0]) or 1)
        slope = np.moveaxis(by_parameter(force).reshape(m, len(sensor.covariance), -1), 2, 0)
        at = signal_chain.tangent(respond, sensor.axes, force)
        back: np.ndarray = np.moveaxis(np.array(at.back).reshape(m, m, -1), 2, 0)
        by_force = back @ slope
        return np.einsum('nap,pq,naq->n', by_force, sensor.covariance, by_force)

    return of


def equation_5(force: Components, measured: tuple[Value, Value, Value], slope: Components,
               maths: Maths) -> tuple[Value, ...]:
    """
    Spread the in-plane covariance to z = √(g² − x² − y²).

    x = x₀ + s·z, hence dz = −(x·dx₀ + y·dy₀)/(z + x·s). Where the divisor vanishes, at alpha =
    ±90°, the error of z is the root of the noise, z² = 2·σ·g·n where n > 0, not its multiple: its
    variance is 0.8·σ·g there, and hardly any of it goes with dx₀ and dy₀. Near there |f|² = g²
    has a second solution, z − 2·divisor/(1 + s²). Where that is upright, too, nothing tells the
    two apart, so that half the square of their distance is added.

    Parameters
    ----------
    force
        Specific force, m/s², three components.
    measured
        Its variances xx, xy and yy given z, (m/s²)².
    slope
        What z adds to x and y, s; see `signal_chain.Tangent`.
    maths
        For arrays or for floats.

    Returns
    -------
    tuple
        xx, xy, xz, yy, yz, zz, (m/s²)².

    """
    x, y, z = force
    xx, xy, yy = measured
    along = maths.sqrt(maths.most(x * x * xx + 2 * x * y * xy + y * y * yy, 0.0))
    divisor = z + x * slope[0] + y * slope[1]
    blunted2 = divisor * divisor + 1.25 * along + _NOTHING
    by_x, by_y = -x * divisor / blunted2, -y * divisor / blunted2
    apart = 2 * divisor / (1 + slope[0] ** 2 + slope[1] ** 2)
    upright = maths.where(divisor < 0, -1.0, 1.0) * (z - apart) > _OVERHANG_MPS2
    own = (1.25 * along * along * along / (blunted2 * blunted2)
           + maths.where(upright, apart * apart / 2, 0.0))
    rows = ((1 + slope[0] * by_x, slope[0] * by_y, slope[0]),
            (slope[1] * by_x, 1 + slope[1] * by_y, slope[1]), (by_x, by_y, 1.0))
    return tuple(a * c * xx + (a * d + b * c) * xy + b * d * yy + e * f * own
                 for i, (a, b, e) in enumerate(rows) for c, d, f in rows[i:])


def parameter_tangent(sensor: Sensor, force: Components) -> np.ndarray:
    """
    Differentiate volts by the parameters in `sensor.covariance_names`, V a unit, (m, k, n).

    Central differences by a thousandth of the parameter's scale.
    """
    return _parameter_tangent(sensor)(force)


def _parameter_tangent(sensor: Sensor) -> Callable[..., np.ndarray]:
    differences = []
    for name in sensor.covariance_names:
        at, step = coefficients.get(sensor, [name]), 1e-3 * coefficients.parameter_of(name).scale
        above, below = (signal_chain.static_response(coefficients.put(sensor, [name], at + by))
                        for by in (step, -step))
        differences.append((above, below, 2 * step))

    def by_parameter(force: Components,
                     environment: Environment = NOMINAL_ENVIRONMENT) -> np.ndarray:
        columns = [[(a - b) / apart for a, b in zip(above(force, environment),
                                                    below(force, environment))]
                   for above, below, apart in differences]
        return np.swapaxes(np.array(columns), 0, 1)

    return by_parameter
