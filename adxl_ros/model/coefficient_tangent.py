# SPDX-License-Identifier: Apache-2.0

"""
Derivatives of the volts by the coefficients of a sensor.

Many samples share what the coefficients of one effect do not change. Whether that holds for the
effects of a sensor is tried out on drawn forces.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

from adxl_ros.model import analog_stages, coefficients, signal_chain
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import (
    Coefficient,
    Components,
    Effect,
    Environment,
    NOMINAL_ENVIRONMENT,
    Parameters,
    Place,
    Signals,
)
from adxl_ros.model.sensor import Sensor
import numpy as np

_RELATIVE_STEP = 1e-3
"""Step of the central differences by coefficients, in typical sizes; chosen: the chain is smooth
and nearly linear in them."""

_MANY = 1024
"""Samples from which the parts of the chain are shared (chosen: the trial takes as long as 500
samples)."""

_DRAWN = 64
"""Forces on which the shared parts are tried out (chosen: the trial takes 5 ms)."""

_AGREEMENT = 1e-6
"""Largest relative difference of the shared parts from the complete chain; chosen: far above
rounding, and far below the derivative that a missing part would change."""

Slopes = Callable[[Components, Environment], np.ndarray]
"""Maps forces and environment to derivatives by coefficient and axis, (k, m, n)."""

Difference = Callable[[Signals, Components, Environment], Components]
"""Maps signals of the chain, forces and environment to a difference of volts by axis, V."""


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
    complete = _complete_chain(sensor)
    shared = cache(lambda: _shared_chain(sensor, complete))

    def by_coefficient(force: Components,
                       environment: Environment = NOMINAL_ENVIRONMENT) -> np.ndarray:
        slopes = complete if np.size(force[0]) < _MANY else shared()
        return np.swapaxes(slopes(force, environment), 0, 1)

    return by_coefficient


def _step(name: Coefficient) -> float:
    """Return the half step of the central difference by a coefficient, in its unit."""
    return _RELATIVE_STEP * coefficients.parameter_of(name).scale


def _changed(sensor: Sensor, names: tuple[Coefficient, ...], sign: float) -> Sensor:
    """Return the sensor with coefficients that are larger or smaller by their steps."""
    values = coefficients.get(sensor, names)
    return coefficients.put(sensor, names, values + sign * np.array(list(map(_step, names))))


def _complete_chain(sensor: Sensor) -> Slopes:
    """Prepare the differences of the complete chain, one coefficient after the other."""
    pairs = [tuple(signal_chain.static_response(_changed(sensor, (name,), sign))
                   for sign in (1, -1)) for name in sensor.covariance_names]
    distances = [2 * _step(name) for name in sensor.covariance_names]

    def slopes(force: Components, environment: Environment) -> np.ndarray:
        return np.array([[(a - b) / distance for a, b in zip(above(force, environment),
                                                             below(force, environment))]
                         for (above, below), distance in zip(pairs, distances)])

    return slopes


def _shared_chain(sensor: Sensor, complete: Slopes) -> Slopes:
    """
    Prepare the differences with the parts of the chain that the coefficients share.

    Coefficients of one parameter are changed together if each changes its own axis only.
    """
    if analog_stages.effects_at(sensor, Place.ADC, True):
        return complete  # a step of the ADC shows at some forces only
    force, environment = _drawn()
    expected = complete(force, environment)
    stages = analog_stages.AnalogStages(sensor)
    groups = [(rows, _difference(sensor, tuple(sensor.covariance_names[row] for row in rows)))
              for rows in _groups(sensor, expected)]
    distances = [2 * _step(name) for name in sensor.covariance_names]
    axes = [sensor.axes.find(name.axis) for name in sensor.covariance_names]

    def slopes(force: Components, environment: Environment) -> np.ndarray:
        signals = stages.sense(force, environment)
        stages.respond(signals)
        stages.amplify(signals)
        columns = np.zeros((len(distances), len(sensor.axes), np.size(force[0])))
        for rows, difference in groups:
            volts = difference(signals, force, environment)
            for row in rows:
                changed = range(len(volts)) if len(rows) == 1 else (axes[row],)
                for axis in changed:
                    columns[row, axis] = volts[axis] / distances[row]
        return columns

    largest = np.abs(expected).max(axis=(1, 2), keepdims=True)
    error = np.abs(slopes(force, environment) - expected)
    return slopes if (error <= _AGREEMENT * largest).all() else complete


def _drawn() -> tuple[Components, Environment]:
    """Return forces, m/s², three components (n,), and surroundings for a trial."""
    rng = np.random.default_rng(0)
    environment = Environment(rng.uniform(0, 1e4, _DRAWN), rng.uniform(-40, 85, _DRAWN),
                              rng.uniform(3, 6, _DRAWN))
    return list(rng.normal(size=(3, _DRAWN)) * G0_MPS2), environment


def _groups(sensor: Sensor, slopes: np.ndarray) -> list[list[int]]:
    """
    Return which coefficients are changed together, by number.

    slopes: derivatives by coefficient and axis, (k, m, n).
    """
    groups: dict[Coefficient, list[int]] = {}
    for row, name in enumerate(sensor.covariance_names):
        others = [axis != name.axis for axis in sensor.axes]
        is_own = bool(name.axis) and not slopes[row, others].any()
        groups.setdefault(name.without_axis if is_own else name, []).append(row)
    return list(groups.values())


def _difference(sensor: Sensor, names: tuple[Coefficient, ...]) -> Difference:
    """Prepare the difference that coefficients make when they are larger and smaller by a step."""
    effect = effect_named(names[0].effect)
    above, below = (_changed(sensor, names, sign) for sign in (1, -1))
    if effect.place is Place.ELEMENT:
        return _difference_of_element(effect, analog_stages.parameters(above, effect.name),
                                      analog_stages.parameters(below, effect.name))
    if effect.place is Place.ELECTRONICS:
        return _difference_of_electronics(analog_stages.AnalogStages(above),
                                          analog_stages.AnalogStages(below))
    responses = signal_chain.static_response(above), signal_chain.static_response(below)

    def difference(signals: Signals, force: Components, environment: Environment) -> Components:
        first, second = (respond(force, environment) for respond in responses)
        return [a - b for a, b in zip(first, second)]

    return difference


def _difference_of_element(effect: Effect, above: Parameters, below: Parameters) -> Difference:
    """Prepare a difference in the output of the element, to which its effects add."""
    def difference(signals: Signals, force: Components, environment: Environment) -> Components:
        first, second = (replace(signals, output=[0.0] * len(signals.output)) for _ in range(2))
        effect.apply(first, above)
        effect.apply(second, below)
        return [scale * (a - b)
                for scale, a, b in zip(signals.scale_v_per_g, first.output, second.output)]

    return difference


def _difference_of_electronics(above: analog_stages.AnalogStages,
                               below: analog_stages.AnalogStages) -> Difference:
    """Prepare a difference in zero-g and scale factor."""
    def difference(signals: Signals, force: Components, environment: Environment) -> Components:
        first, second = replace(signals), replace(signals)
        above.amplify(first)
        below.amplify(second)
        zeros = zip(first.zero_g_v, second.zero_g_v)
        scales = zip(first.scale_v_per_g, second.scale_v_per_g)
        return [zero - zero_below + (scale - scale_below) * output
                for (zero, zero_below), (scale, scale_below), output in zip(
                    zeros, scales, signals.output)]

    return difference
