# SPDX-License-Identifier: Apache-2.0

"""The signal chain at rest, from specific force to volts, and its exact inverse."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from adxl_ros.model.analog_stages import analog_response, effects_at
from adxl_ros.model.constants import AXES
from adxl_ros.model.effects.base import (
    Components,
    Environment,
    NOMINAL_ENVIRONMENT,
    Place,
    Signals,
    Value,
)
from adxl_ros.model.scalar_or_array import ARRAYS, Maths
from adxl_ros.model.sensor import Sensor
import numpy as np

_TOLERANCE_MPS2 = 1e-10
"""Newton step below which the inverse has converged, m/s²; chosen: near rounding."""

_UNSOLVED_MPS2 = 1e-6
"""Last Newton step from which a sample has no solution, m/s²; chosen: near alpha = ±90°, the z of
equation 5 is a root of 0, and rounding moves it by up to this."""

_MAX_ITERATIONS = 60
"""Largest number of iterations of either inverse; chosen: samples with a
solution need far fewer."""

_CHORD_STEPS = 8
"""Steps with the tangent at rest without gravity before Newton's method; chosen: each leaves a few
percent of the error of a real sensor, and takes a seventh of the time of a Newton step."""

_CLEAR_Z_MPS2 = 1.0
"""Magnitude of a derived z, m/s², from which |f| = g determines it well; chosen: 6° from alpha =
±90°, far beyond any noise."""

_SETTLED_V = 1e-13
"""Change below which the inverse of the ADC's effects has converged, V; chosen: near rounding."""

_DIFFERENCE_MPS2 = 1e-3
"""Half step of the central differences by force, m/s²; chosen: the chain is smooth and nearly
linear, so that a wide step loses nothing."""


def static_response(sensor: Sensor) -> Callable[..., Components]:
    """
    Prepare the chain from specific force to volts at rest, by its invertible effects.

    `simulate.response` adds filter, noise, quantisation, stage, and effects with a memory.

    Returns
    -------
    callable
        Maps the three components of specific force in the case frame, m/s² (arrays of one shape,
        or floats), and an `Environment` of that shape (the nominal one unless given) to the
        volts of each measured axis.

    """
    respond, convert = analog_response(sensor), _adc(sensor)
    if convert is None:
        return respond

    def respond_with_adc(force: Components, environment: Environment = NOMINAL_ENVIRONMENT
                         ) -> Components:
        return convert(respond(force, environment))

    return respond_with_adc


def _adc(sensor: Sensor) -> Callable[[Components], Components] | None:
    """Prepare the ADC's effects at rest, from volts at its input to volts; None without any."""
    effects = effects_at(sensor, Place.ADC, True)
    if not effects:
        return None

    def convert(volts: Components) -> Components:
        signals = Signals(NOMINAL_ENVIRONMENT, input_v=volts, volts=list(volts),
                          vref_v=sensor.adc_vref_v)
        for apply, values in effects:
            apply(signals, values)
        return signals.volts

    return convert


def adc_inverse(sensor: Sensor) -> Callable[[Components], Components]:
    """
    Prepare the inverse of the ADC's effects: volts of the ADC to volts at its input, by axis.

    A bit of a wrong weight makes steps, in which Newton's method has no slope. The ADC is
    therefore inverted apart from the rest of the chain. Where two inputs near a step give the
    same volts, one of them is returned; where none does, the middle of the gap.
    """
    convert = _adc(sensor)
    if convert is None:
        return list

    def undo(volts: Components) -> Components:
        previous, current = list(volts), list(volts)
        with np.errstate(all='ignore'):
            for _ in range(_MAX_ITERATIONS):
                changes = [v - c for v, c in zip(volts, convert(current))]
                # A converged sample stays, so that it does not depend on its neighbours.
                changes = [change * (abs(change) >= _SETTLED_V) for change in changes]
                previous, current = current, [v + change for v, change in zip(current, changes)]
                if not any(np.any(change) for change in changes):
                    break
        return [(a + b) / 2 for a, b in zip(current, previous)]

    return undo


def gravity_mps2(sensor: Sensor) -> float:
    """Return local gravity with the effects on it, m/s²."""
    signals = Signals(NOMINAL_ENVIRONMENT, gravity_mps2=sensor.local_gravity_mps2)
    for apply, values in effects_at(sensor, Place.STAGE, True):
        apply(signals, values)
    return signals.gravity_mps2


def jacobian(respond: Callable[..., Components], force: Components,
             environment: Environment = NOMINAL_ENVIRONMENT) -> np.ndarray:
    """
    Differentiate volts by specific force, by central differences.

    Parameters
    ----------
    respond
        From `analog_response`.
    force
        Specific force in the case frame, m/s², three components (n,) or floats.
    environment
        Surroundings in the shape of the force.

    Returns
    -------
    ndarray
        Derivatives, V/(m/s²), (m, 3), or (m, 3, n) for arrays.

    """
    columns = []
    for c in range(3):
        above, below = list(force), list(force)
        above[c], below[c] = above[c] + _DIFFERENCE_MPS2, below[c] - _DIFFERENCE_MPS2
        columns.append([(a - b) / (2 * _DIFFERENCE_MPS2) for a, b in zip(
            respond(above, environment), respond(below, environment))])
    return np.swapaxes(np.array(columns), 0, 1)


@dataclass(frozen=True)
class Tangent:
    """The inverse of the chain to first order, around one or many forces."""

    # Derivatives of the force along the measured axes by the volts, (m/s²)/V, m rows of m
    # components
    back: list[Components]
    # Derivatives of the estimates of x and y by z; empty unless z is derived (equation 5)
    slope: Components


def tangent(respond: Callable[..., Components], axes: str, force: Components,
            environment: Environment = NOMINAL_ENVIRONMENT) -> Tangent:
    """
    Linearise the inverse of `static_response` around a force.

    Parameters
    ----------
    respond
        From `analog_response`.
    axes
        Measured axes.
    force
        Specific force in the case frame, m/s², three components (n,) or floats.
    environment
        Surroundings in the shape of the force.

    Returns
    -------
    Tangent
        Derivatives at the force, in its shape.

    """
    by_force: Any = jacobian(respond, force, environment)
    if isinstance(force[0], float):
        by_force = by_force.tolist()
    return _inverted(by_force, axes)


def _inverted(by_force: Any, axes: str) -> Tangent:
    """Invert derivatives by force, m rows of three components, along the measured axes."""
    measured = [AXES.index(a) for a in axes]
    back = _inverse_matrix([[row[c] for c in measured] for row in by_force])
    if axes != 'xy':
        return Tangent(back, [])
    return Tangent(back, [-sum(b * row[2] for b, row in zip(line, by_force)) for line in back])


def _inverse_matrix(a: list[Components]) -> list[Components]:
    """Invert 1×1 to 3×3 matrices by their minors, component by component."""
    if len(a) == 1:
        return [[1 / a[0][0]]]
    if len(a) == 2:
        determinant = a[0][0] * a[1][1] - a[0][1] * a[1][0]
        return [[a[1][1] / determinant, -a[0][1] / determinant],
                [-a[1][0] / determinant, a[0][0] / determinant]]
    next_two = ((1, 2), (2, 0), (0, 1))
    minors = [[a[i][p] * a[j][q] - a[i][q] * a[j][p] for p, q in next_two] for i, j in next_two]
    determinant = sum(v * m for v, m in zip(a[0], minors[0]))
    return [[minors[d][c] / determinant for d in range(3)] for c in range(3)]


def newton_step(axes: str, gravity_mps2: float, up: Value, maths: Maths
                ) -> Callable[..., Components]:
    """
    Prepare one Newton step of the inverse.

    Parameters
    ----------
    axes
        Measured axes.
    gravity_mps2
        |f| at rest, m/s², for the z of equation 5.
    up
        Sign of that z, 1 or −1.
    maths
        Functions for arrays or for floats.

    Returns
    -------
    callable
        Maps volts minus the response to a force, V, that force, m/s², and a `Tangent` near it to
        the next force, m/s².

    """
    measured = [AXES.index(a) for a in axes]

    def next_force(residual_v: Components, force: Components, tangent: Tangent) -> Components:
        force = list(force)
        for d, row in zip(measured, tangent.back):
            for by_volt, r in zip(row, residual_v):
                force[d] = force[d] + by_volt * r
        if tangent.slope:
            _derive_z(force, tangent.slope, gravity_mps2, up, maths)
        return force

    return next_force


def _derive_z(force: Components, slope: Components, gravity: float, up: Value,
              maths: Maths) -> None:
    """Set z by |f| = g, and remove its contribution from x and y (equation 5)."""
    x, y = force[0] - slope[0] * force[2], force[1] - slope[1] * force[2]
    a = 1 + slope[0] * slope[0] + slope[1] * slope[1]
    half_b = x * slope[0] + y * slope[1]
    discriminant = half_b * half_b - a * (x * x + y * y - gravity * gravity)
    z = (up * maths.sqrt(maths.maximum(discriminant, 0.0)) - half_b) / a
    force[:] = [x + slope[0] * z, y + slope[1] * z, z]


def inverse(sensor: Sensor, z_sign: np.ndarray | None = None) -> Callable[..., Components]:
    """
    Prepare the exact inverse of `static_response`: volts to specific force, by Newton's method.

    The z of an x/y sensor is derived from |f| = g (equation 5), which holds at rest only. The
    in-plane force is linear in z near the solution, so that |f|² = g² is quadratic in z. Where
    noise puts the in-plane force beyond g, the z of the smallest |f| is taken: there is no jump
    and no NaN at alpha = ±90°. A sensor of one axis gets 0 for the others.

    Parameters
    ----------
    sensor
        The unit with the effects to undo.
    z_sign
        Sign of z by sample, (n,), where it is known better than by `sensor.z_sign`.

    Returns
    -------
    callable
        Maps the volts of each axis, arrays (n,) or floats, and an `Environment` (the nominal one
        unless given) to three components, m/s². Samples without a solution are NaN.

    """
    respond, gravity = analog_response(sensor), gravity_mps2(sensor)
    undo_adc = adc_inverse(sensor)
    up = np.asarray(sensor.z_sign if z_sign is None else z_sign)

    def invert(volts: Components, environment: Environment = NOMINAL_ENVIRONMENT) -> Components:
        input_v = np.array(undo_adc(list(np.array(volts, float).reshape(len(volts), -1))))
        count = input_v.shape[1]
        finite = np.flatnonzero(np.isfinite(input_v).all(axis=0))
        force = np.full((3, count), np.nan)
        with np.errstate(all='ignore'):
            force[:, finite] = search(
                input_v[:, finite],
                Environment(*(np.broadcast_to(np.asarray(e, float), count)[finite]
                              for e in environment)), np.broadcast_to(up, count)[finite])
        return list(force) if np.ndim(volts[0]) else force[:, 0].tolist()

    def search(input_v: np.ndarray, environment: Environment, signs: np.ndarray) -> np.ndarray:
        step = partial(newton_step, sensor.axes, gravity, maths=ARRAYS)
        force, is_solved = _chord_steps(respond, sensor.axes, step(signs), input_v, environment)
        if sensor.axes == 'xy':
            is_solved &= _is_clear_of_the_fold(force, gravity)
        further = np.flatnonzero(~is_solved)
        if len(further):
            force[:, further] = _newton_steps(
                respond, sensor.axes, step, input_v[:, further], signs[further],
                _select(environment, further))
        return force

    return invert


def _is_clear_of_the_fold(force: np.ndarray, gravity: float) -> np.ndarray:
    """
    Return where |f| = g clearly has a z, so that every tangent leads to the same one.

    force: forces, m/s², (3, n); gravity: |f| at rest, m/s²; returns: whether z is clear, (n,).
    """
    x, y, z = force
    excess = x * x + y * y + z * z - gravity * gravity
    return (np.abs(z) > _CLEAR_Z_MPS2) & (np.abs(excess) < _TOLERANCE_MPS2 * gravity)


def _chord_steps(respond: Callable[..., Components], axes: str, advance: Callable[..., Components],
                 input_v: np.ndarray, environment: Environment
                 ) -> tuple[np.ndarray, np.ndarray]:
    """
    Take steps from no force with the tangent at rest, which cost one response each.

    returns: last forces, m/s², (3, n), and which of them have converged, (n,).
    """
    begin = tangent(respond, axes, [np.zeros(1)] * 3, NOMINAL_ENVIRONMENT)
    force, moves = np.zeros((3, input_v.shape[1])), np.ones(input_v.shape[1], bool)
    for _ in range(_CHORD_STEPS):
        current = list(force)
        residual_v = [v - r for v, r in zip(input_v, respond(current, environment))]
        new = np.array(advance(residual_v, current, begin))
        change = np.abs(new - force).max(axis=0)
        # A converged sample stays, so that it does not depend on its neighbours.
        force = np.where(moves, new, force)
        moves &= ~(change < _TOLERANCE_MPS2)
        if not moves.any():
            break
    return force, ~moves


def _newton_steps(respond: Callable[..., Components], axes: str,
                  step: Callable[[np.ndarray], Callable[..., Components]], input_v: np.ndarray,
                  signs: np.ndarray, environment: Environment) -> np.ndarray:
    """
    Take Newton's steps from no force, with a tangent of each sample, until it has converged.

    input_v: volts to reach, (m, n); signs: sign of a derived z, (n,); returns: forces, m/s²,
    (3, n); NaN where there is no solution.
    """
    count = input_v.shape[1]
    force, unsolved = np.zeros((3, count)), np.ones(count, bool)
    active = np.arange(count)
    for _ in range(_MAX_ITERATIONS):
        # Most samples need equally many steps, and a slice costs less than their numbers.
        samples = slice(None) if len(active) == count else active
        current = list(force[:, samples])
        surroundings = _select(environment, samples)
        residual_v = [v - r for v, r in zip(input_v[:, samples], respond(current, surroundings))]
        following = np.array(step(signs[samples])(
            residual_v, current, tangent(respond, axes, current, surroundings)))
        change = np.abs(following - current).max(axis=0)
        force[:, samples], unsolved[samples] = following, ~(change < _UNSOLVED_MPS2)
        # NaN and infinity fail the comparison, too.
        active = active[(change >= _TOLERANCE_MPS2) & (change < np.inf)]
        if not len(active):
            break
    force[:, unsolved] = np.nan
    return force


def _select(environment: Environment, samples: np.ndarray | slice) -> Environment:
    """Return the surroundings of some samples, given by number, (k,), or of a slice."""
    return Environment(*(values[samples] for values in environment))


def quantise(volts: np.ndarray, sensor: Sensor, lsb_v: np.ndarray) -> np.ndarray:
    """
    Round volts to the steps of the ADC, within its rails.

    Parameters
    ----------
    volts
        Volts at the ADC, V, (n, m).
    sensor
        The unit with the rails of its ADC.
    lsb_v
        Step by axis, V, (m,), which may be coarser than that of the ADC; 0 does not quantise.

    Returns
    -------
    ndarray
        Rounded volts, V, (n, m).

    """
    if not np.any(lsb_v):
        return volts
    highest = sensor.adc_vref_v - sensor.lsb_v
    codes = volts / lsb_v
    np.rint(codes, out=codes)
    return np.clip(codes * lsb_v, 0.0, np.floor(highest / lsb_v) * lsb_v)


def at_a_rail(volts: np.ndarray, sensor: Sensor) -> np.ndarray:
    """
    Return the samples of which an axis reads the lowest or highest code of the ADC.

    Volts beyond the rails come from another ADC, or from none, and do not indicate saturation.

    Parameters
    ----------
    volts
        Volts of the ADC, V, (n, m).
    sensor
        The unit with the rails of its ADC.

    Returns
    -------
    ndarray
        Whether each sample is at a rail, (n,).

    """
    rails_v = 0.0, sensor.adc_vref_v - sensor.lsb_v
    return np.logical_or.reduce([np.abs(axis_v - rail_v) < sensor.lsb_v / 2
                                 for axis_v in volts.T for rail_v in rails_v])
