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
from typing import Any

from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import (
    Components,
    Environment,
    NOMINAL_ENVIRONMENT,
    Parameters,
    Place,
    Signals,
    Value,
)
from adxl_ros.model.scalar_or_array import ARRAYS, Maths
from adxl_ros.model.sensor import Sensor
import numpy as np

_TOLERANCE_MPS2 = 1e-10
_LOST_MPS2 = 1e-6
"""Rounding moves the z of equation 5 by up to this near alpha = ±90°, where it is a root of 0."""
_MOST_ITERATIONS = 60
_SETTLED_V = 1e-13


def static_response(sensor: Sensor) -> Callable[..., Components]:
    """
    Prepare the chain from specific force to volts at rest: its invertible effects.

    Filter, noise, the steps of the ADC, the stage, and effects with a memory are left to
    `simulate.response`.

    Returns
    -------
    callable
        Maps the three components of specific force in the case frame, m/s² (arrays of one shape,
        or floats), and, if it is not the nominal one, an `Environment` of such a shape, to the
        volts of each measured axis.

    """
    respond, convert = analog_response(sensor), _adc(sensor)
    if convert is None:
        return respond
    return lambda force, environment=NOMINAL_ENVIRONMENT: convert(respond(force, environment))


def analog_response(sensor: Sensor) -> Callable[..., Components]:
    """Prepare `static_response` as far as the input of the ADC, whose steps have no slope."""
    run = {place: applied(sensor, place, True) for place in Place}
    zero_g_v = sensor.nominal_zero_g_v.tolist()
    scale_v_per_g = sensor.nominal_scale_v_per_g.tolist()

    def respond(force: Components, environment: Environment = NOMINAL_ENVIRONMENT) -> Components:
        signals = Signals(environment, sensed=[f / G0_MPS2 for f in force],
                          nominal_scale_v_per_g=scale_v_per_g)
        for apply, values in run[Place.MOUNTING]:
            apply(signals, values)
        signals.output = list(signals.sensed)
        for apply, values in run[Place.ELEMENT]:
            apply(signals, values)
        signals.zero_g_v, signals.scale_v_per_g = list(zero_g_v), list(scale_v_per_g)
        for apply, values in run[Place.ELECTRONICS]:
            apply(signals, values)
        return converted(signals)

    return respond


def _adc(sensor: Sensor) -> Callable[[Components], Components] | None:
    """Prepare the ADC's effects at rest, volts at its input to volts; None without any."""
    effects = applied(sensor, Place.ADC, True)
    if not effects:
        return None

    def convert(volts: Components) -> Components:
        signals = Signals(NOMINAL_ENVIRONMENT, input_v=volts, volts=list(volts),
                          vref_v=sensor.adc_vref_v)
        for apply, values in effects:
            apply(signals, values)
        return signals.volts

    return convert


def before_adc(sensor: Sensor) -> Callable[[Components], Components]:
    """
    Prepare the inverse of the ADC's effects: what it gave, V by axis, to volts at its input.

    By itself and before the rest of the inverse, for a bit of a wrong weight makes steps, in
    which Newton's method has no slope: two inputs near a step give the same volts, of which one
    is taken, or none gives them, and the middle of the gap is taken.
    """
    convert = _adc(sensor)
    if convert is None:
        return list

    def undo(volts: Components) -> Components:
        before, after = list(volts), list(volts)
        with np.errstate(all='ignore'):
            for _ in range(_MOST_ITERATIONS):
                moves = [v - c for v, c in zip(volts, convert(after))]
                # What has settled stays, so that a sample does not depend on its neighbours.
                moves = [m * (abs(m) >= _SETTLED_V) for m in moves]
                before, after = after, [a + m for a, m in zip(after, moves)]
                if not any(np.any(m) for m in moves):
                    break
        return [(a + b) / 2 for a, b in zip(after, before)]

    return undo


def converted(signals: Signals) -> Components:
    """Turn the output of the element into volts, by measured axis."""
    return [zero + scale * out for zero, scale, out in
            zip(signals.zero_g_v, signals.scale_v_per_g, signals.output)]


def applied(sensor: Sensor, place: Place, invertible: bool | None = None
            ) -> list[tuple[Callable[[Signals, Parameters], None], Parameters]]:
    """
    Return what the sensor's effects of a place apply, and with which parameters.

    Parameters
    ----------
    sensor
        The unit.
    place
        Of the chain.
    invertible
        Only those that the inverse undoes.

    """
    effects = [effect_named(name) for name in sensor.effects]
    return [(e.apply, parameters(sensor, e.name)) for e in effects
            if e.place is place and (e.invertible or not invertible)]


def parameters(sensor: Sensor, effect: str) -> Parameters:
    """Return the parameters of one of the sensor's effects as its `apply` takes them."""
    listed = {name: np.asarray(value, float).tolist()
              for name, value in sensor.values[effect].items()}
    return {name: tuple(v) if isinstance(v, list) else v for name, v in listed.items()}


def gravity_mps2(sensor: Sensor) -> float:
    """Return the local gravity with what effects add to it."""
    signals = Signals(NOMINAL_ENVIRONMENT, gravity_mps2=sensor.local_gravity_mps2)
    for apply, values in applied(sensor, Place.STAGE, True):
        apply(signals, values)
    return signals.gravity_mps2


def jacobian(respond: Callable[..., Components], force: Components,
             environment: Environment = NOMINAL_ENVIRONMENT) -> np.ndarray:
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
        columns.append([(a - b) / (2 * step) for a, b in zip(
            respond(above, environment), respond(below, environment))])
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


def tangent(respond: Callable[..., Components], axes: str, force: Components,
            environment: Environment = NOMINAL_ENVIRONMENT) -> Tangent:
    """
    Linearise the inverse of `static_response` around a force, m/s², arrays or floats.

    Parameters
    ----------
    respond
        From `analog_response`.
    axes
        Measured axes.
    force
        Three components.
    environment
        Of their shape.

    """
    by_force: Any = jacobian(respond, force, environment)
    if isinstance(force[0], float):
        by_force = by_force.tolist()
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
        Maps the volts of each axis, arrays (n,) or floats, and, if it is not the nominal one, an
        `Environment` to three components, m/s². Samples that have no solution come back as
        NaN.

    """
    respond, gravity = analog_response(sensor), gravity_mps2(sensor)
    undo_adc = before_adc(sensor)
    up = np.asarray(sensor.z_sign if z_sign is None else z_sign)

    def invert(volts: Components, environment: Environment = NOMINAL_ENVIRONMENT) -> Components:
        data = np.array(undo_adc(list(np.array(volts, float).reshape(len(volts), -1))))
        signs = np.broadcast_to(up, data.shape[1])
        force = np.zeros((3, data.shape[1]))
        lost = np.ones(data.shape[1], bool)
        left = np.flatnonzero(np.isfinite(data).all(axis=0))
        around = Environment(*(np.broadcast_to(np.asarray(e, float), data.shape[1])
                               for e in environment))
        at = tangent(respond, sensor.axes, list(force[:, left]),
                     Environment(*(e[left] for e in around)))
        with np.errstate(all='ignore'):
            for _ in range(_MOST_ITERATIONS):
                here, there = list(force[:, left]), Environment(*(e[left] for e in around))
                miss = [v - r for v, r in zip(data[:, left], respond(here, there))]
                advance = step(sensor.axes, gravity, signs[left], ARRAYS)
                after = np.array(advance(miss, here, at))
                moved = np.abs(after - here).max(axis=0)
                force[:, left], lost[left] = after, ~(moved < _LOST_MPS2)
                # Those that have become NaN or infinite fail the comparison, too.
                left = left[(moved >= _TOLERANCE_MPS2) & (moved < np.inf)]
                if not len(left):
                    break
                at = tangent(respond, sensor.axes, list(force[:, left]),
                             Environment(*(e[left] for e in around)))
        force[:, lost] = np.nan
        return list(force) if np.ndim(volts[0]) else force[:, 0].tolist()

    return invert


def quantise(volts: np.ndarray, sensor: Sensor, lsb_v: float) -> np.ndarray:
    """Round volts to steps of the ADC, V, at most its rails; unchanged without an ADC."""
    if not lsb_v:
        return volts
    highest = sensor.adc_vref_v - sensor.lsb_v
    return np.clip(np.rint(volts / lsb_v) * lsb_v, 0.0, np.floor(highest / lsb_v) * lsb_v)


def at_a_rail(volts: np.ndarray, sensor: Sensor) -> np.ndarray:
    """
    Tell samples (n, m), V, of which an axis reads the lowest or highest code of the ADC, (n,).

    Volts beyond the rails come from another ADC, or from none, and are no sign of saturation.
    """
    rails = np.array([0.0, sensor.adc_vref_v - sensor.lsb_v])
    return (np.abs(volts[:, :, None] - rails) < sensor.lsb_v / 2).any(axis=(1, 2))
