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

"""The order of the signal chain: forward, and its exact inverse."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import exp

from adxl_ros.model import noise
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Components, Place, Signals, Value
from adxl_ros.model.maths import ARRAYS, Maths
from adxl_ros.model.sensor import Sensor
import numpy as np
from scipy.signal import lfilter

_TOLERANCE_MPS2 = 1e-10
_LOST_MPS2 = 1e-6
"""Rounding moves the z of equation 5 by up to this near alpha = ±90°, where it is a root of 0."""
_MOST_ITERATIONS = 60


def static_response(sensor: Sensor) -> Callable[[Components], Components]:
    """
    Prepare the chain from specific force to volts, without filter, noise and ADC.

    Returns
    -------
    callable
        Maps the three components of specific force in the case frame, m/s² (arrays of one shape,
        or floats), to the volts of each measured axis.

    """
    effects = [effect_named(name) for name in sensor.effects]
    steps = {place: [(e.apply, {k: tuple(map(float, v)) for k, v in
                                sensor.values[e.name].items()})
                     for e in effects if e.place is place] for place in Place}
    zero_g_v = sensor.nominal_zero_g_v.tolist()
    scale_v_per_g = sensor.nominal_scale_v_per_g.tolist()

    def respond(force: Components) -> Components:
        signals = Signals([f / G0_MPS2 for f in force])
        for apply, values in steps[Place.MOUNTING]:
            apply(signals, values)
        signals.output = list(signals.sensed)
        for apply, values in steps[Place.ELEMENT]:
            apply(signals, values)
        signals.zero_g_v, signals.scale_v_per_g = list(zero_g_v), list(scale_v_per_g)
        for apply, values in steps[Place.ELECTRONICS]:
            apply(signals, values)
        return [zero + scale * out for zero, scale, out in
                zip(signals.zero_g_v, signals.scale_v_per_g, signals.output)]

    return respond


def jacobian(respond: Callable[[Components], Components], force: Components) -> np.ndarray:
    """
    Differentiate volts by specific force at one or many points, V/(m/s²).

    Central differences; the chain is smooth and nearly linear, so a wide step of 1 mm/s² loses
    nothing. Returns (m, 3), or (m, 3, n) for arrays.
    """
    step = 1e-3
    columns = []
    for c in range(3):
        above, below = list(force), list(force)
        above[c], below[c] = above[c] + step, below[c] - step
        columns.append([(a - b) / (2 * step) for a, b in zip(respond(above), respond(below))])
    return np.swapaxes(np.array(columns), 0, 1)


@dataclass(frozen=True)
class Tangent:
    """
    The inverse of the chain to first order, around one or many forces.

    Attributes
    ----------
    back
        Force along the measured axes by volts, (m/s²)/V, m rows of m components.
    slope
        What z adds to the estimate of x and y; empty unless z is derived (equation 5).

    """

    back: list[Components]
    slope: Components


def tangent(respond: Callable[[Components], Components], axes: str,
            force: Components) -> Tangent:
    """
    Linearise the inverse of `static_response` around a force, m/s², arrays or floats.

    Parameters
    ----------
    respond
        From `static_response`.
    axes
        Measured axes.
    force
        Three components.

    """
    by_force = jacobian(respond, force).tolist() if isinstance(force[0], float) \
        else jacobian(respond, force)
    measured = [AXES.index(a) for a in axes]
    back = _inverted([[row[c] for c in measured] for row in by_force])
    if axes != 'xy':
        return Tangent(back, [])
    return Tangent(back, [-sum(b * row[2] for b, row in zip(line, by_force)) for line in back])


def _inverted(a: list[Components]) -> list[Components]:
    """Invert 1×1 to 3×3 matrices by their minors, component by component."""
    if len(a) == 1:
        return [[1 / a[0][0]]]
    if len(a) == 2:
        whole = a[0][0] * a[1][1] - a[0][1] * a[1][0]
        return [[a[1][1] / whole, -a[0][1] / whole], [-a[1][0] / whole, a[0][0] / whole]]
    next_two = ((1, 2), (2, 0), (0, 1))
    minors = [[a[i][p] * a[j][q] - a[i][q] * a[j][p] for p, q in next_two] for i, j in next_two]
    whole = sum(v * m for v, m in zip(a[0], minors[0]))
    return [[minors[d][c] / whole for d in range(3)] for c in range(3)]


def step(axes: str, gravity_mps2: float, up: Value, maths: Maths) -> Callable[..., Components]:
    """
    Prepare one Newton step of the inverse.

    Parameters
    ----------
    axes
        Measured axes.
    gravity_mps2
        |f| at rest, for the z of equation 5.
    up
        The sign of that z.
    maths
        For arrays or for floats.

    Returns
    -------
    callable
        Maps what the volts miss of the response to a force, V, that force, m/s², and a
        `Tangent` near it to the next force.

    """
    measured = [AXES.index(a) for a in axes]

    def next_force(miss: Components, force: Components, at: Tangent) -> Components:
        force = list(force)
        for d, row in zip(measured, at.back):
            for by_volt, m in zip(row, miss):
                force[d] = force[d] + by_volt * m
        if at.slope:
            _complete(force, at.slope, gravity_mps2, up, maths)
        return force

    return next_force


def _complete(force: Components, slope: Components, gravity: float, up: Value,
              maths: Maths) -> None:
    """Put z in by |f| = g and take what it adds to x and y out of them (equation 5)."""
    x, y = force[0] - slope[0] * force[2], force[1] - slope[1] * force[2]
    a = 1 + slope[0] * slope[0] + slope[1] * slope[1]
    half_b = x * slope[0] + y * slope[1]
    rest = half_b * half_b - a * (x * x + y * y - gravity * gravity)
    z = (up * maths.sqrt(maths.most(rest, 0.0)) - half_b) / a
    force[:] = [x + slope[0] * z, y + slope[1] * z, z]


def inverse(sensor: Sensor, z_sign: np.ndarray | None = None) -> Callable[..., Components]:
    """
    Prepare the exact inverse of `static_response`: volts to specific force, by Newton's method.

    An x/y sensor gets its z from |f| = g (equation 5), at rest only: with the in-plane force a
    linear function of z near the solution, |f|² = g² is quadratic in z; where noise puts the
    in-plane force beyond g, the z of the smallest |f| is taken, so that there is no jump and no
    NaN at alpha = ±90°. A sensor of one axis gets 0 for the others.

    Parameters
    ----------
    sensor
        The figures and effects to undo.
    z_sign
        Which way up, by sample, (n,), where it is known better than `sensor.z_sign`.

    Returns
    -------
    callable
        Maps the volts of each axis, arrays (n,) or floats, to three components, m/s². Samples
        that have no solution come back as NaN.

    """
    respond = static_response(sensor)
    up = np.asarray(sensor.z_sign if z_sign is None else z_sign)

    def invert(volts: Components) -> Components:
        data = np.array(volts, float).reshape(len(volts), -1)
        signs = np.broadcast_to(up, data.shape[1])
        force = np.zeros((3, data.shape[1]))
        lost = np.ones(data.shape[1], bool)
        left = np.flatnonzero(np.isfinite(data).all(axis=0))
        at = tangent(respond, sensor.axes, [0.0, 0.0, 0.0])
        with np.errstate(all='ignore'):
            for _ in range(_MOST_ITERATIONS):
                here = list(force[:, left])
                miss = [v - r for v, r in zip(data[:, left], respond(here))]
                advance = step(sensor.axes, sensor.local_gravity_mps2, signs[left], ARRAYS)
                after = np.array(advance(miss, here, at))
                moved = np.abs(after - here).max(axis=0)
                force[:, left], lost[left] = after, ~(moved < _LOST_MPS2)
                # Those that have become NaN or infinite fail the comparison, too.
                left = left[(moved >= _TOLERANCE_MPS2) & (moved < np.inf)]
                if not len(left):
                    break
                at = tangent(respond, sensor.axes, list(force[:, left]))
        force[:, lost] = np.nan
        return list(force) if np.ndim(volts[0]) else force[:, 0].tolist()

    return invert


@dataclass
class FilterState:
    """What the filter and the noise carry from one block to the next, V, each (m,)."""

    last_input: np.ndarray
    filtered: np.ndarray
    noise: np.ndarray


def settled(sensor: Sensor, force: Components, rng: np.random.Generator) -> FilterState:
    """Return the state of a sensor that has felt one force, m/s² (three floats), for long."""
    volts = np.array(static_response(sensor)(force), float)
    white = noise.analog_sigma_v(sensor) if sensor.rc_s else np.zeros_like(volts)
    return FilterState(volts, volts, white * rng.standard_normal(len(volts)))


def sample(sensor: Sensor, force: Components, state: FilterState,
           rng: np.random.Generator) -> np.ndarray:
    """
    Run a block through the whole chain: effects, RC filter, noise, ADC.

    The filter is discretised exactly for an input that is linear between samples, and the noise
    behind it is the exactly sampled AR(1) sequence, so that neither depends on the rate.

    Parameters
    ----------
    sensor
        The unit.
    force
        Three components, m/s², each (n,), at `sensor.rate_hz`.
    state
        From `settled` or the block before; updated in place.
    rng
        Source of the noise.

    Returns
    -------
    ndarray
        Volts that the ADC gives, (n, m).

    """
    count = len(np.asarray(force[0]))
    volts = np.column_stack([np.broadcast_to(v, count) for v in static_response(sensor)(force)])
    sigma = noise.analog_sigma_v(sensor)
    white = rng.standard_normal(volts.shape)
    if sensor.rc_s:
        volts = _filtered(volts, 1 / (sensor.rate_hz * sensor.rc_s), state)
        a = exp(-1 / (sensor.rate_hz * sensor.rc_s))
        coloured, _ = lfilter([1.0], [1.0, -a], white * sigma * (1 - a * a) ** 0.5, axis=0,
                              zi=(a * state.noise)[None])
        state.noise = coloured[-1]
    else:
        coloured = white * sigma
    return quantise(volts + coloured, sensor)


def _filtered(volts: np.ndarray, ratio: float, state: FilterState) -> np.ndarray:
    a = exp(-ratio)
    new = 1 - (1 - a) / ratio
    old = (1 - a) / ratio - a
    drive = new * volts + old * np.vstack([state.last_input, volts[:-1]])
    out, _ = lfilter([1.0], [1.0, -a], drive, axis=0, zi=(a * state.filtered)[None])
    state.last_input, state.filtered = volts[-1], out[-1]
    return out


def quantise(volts: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Round volts to the ADC's codes, at most its rails; unchanged without an ADC."""
    if not sensor.lsb_v:
        return volts
    codes = np.clip(np.rint(volts / sensor.lsb_v), 0, 2 ** sensor.adc_bits - 1)
    return codes * sensor.lsb_v


def at_a_rail(volts: np.ndarray, sensor: Sensor) -> np.ndarray:
    """
    Tell samples (n, m), V, of which an axis reads the lowest or highest code of the ADC, (n,).

    Volts beyond the rails come from another ADC, or from none, and are no sign of saturation.
    """
    rails = np.array([0.0, sensor.adc_vref_v - sensor.lsb_v])
    return (np.abs(volts[:, :, None] - rails) < sensor.lsb_v / 2).any(axis=(1, 2))
