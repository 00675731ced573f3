# SPDX-License-Identifier: Apache-2.0

"""Coefficients of a sensor by name: `effect.parameter.axis`, or `effect.parameter` of no axis."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Coefficient, Effect, Parameter
from adxl_ros.model.sensor import Sensor
import numpy as np


def names_of(effect: Effect, axes: str) -> tuple[Coefficient, ...]:
    """Name the coefficients of an effect: by parameter, for those measured axes that it has."""
    return tuple(name for p in effect.parameters for name in _names_of_parameter(effect, p, axes))


def _names_of_parameter(effect: Effect, parameter: Parameter, axes: str) -> list[Coefficient]:
    if not parameter.axes:
        return [Coefficient(effect.name, parameter.name)]
    return [Coefficient(effect.name, parameter.name, a) for a in axes if a in parameter.axes]


def fitted_of(effect: Effect, axes: str) -> tuple[Coefficient, ...]:
    """Name the coefficients as `names_of`, without those of parameters that fits hold."""
    return tuple(name for p in effect.parameters if not p.held
                 for name in _names_of_parameter(effect, p, axes))


def parameter_of(name: Coefficient) -> Parameter:
    """Return the description of a coefficient's parameter."""
    return next(p for p in effect_named(name.effect).parameters if p.name == name.parameter)


def neutral(effect: Effect, axes: str) -> dict[str, np.ndarray]:
    """Return the neutral values of an effect by parameter, (m,) or (), each in its unit."""
    return {p.name: np.full(len(axes), p.neutral) if p.axes else np.array(p.neutral)
            for p in effect.parameters}


def typical(effect: Effect, axes: str) -> dict[str, np.ndarray]:
    """
    Return the typical values of an effect by parameter, (m,) or (), each in its unit.

    Axes that a parameter does not have keep the neutral value.
    """
    values = neutral(effect, axes)
    for p in effect.parameters:
        has_axis = [a in p.axes for a in axes] if p.axes else ()
        values[p.name][has_axis] = p.scale if p.typical is None else p.typical
    return values


def with_neutral(sensor: Sensor, effects: Iterable[str]) -> Sensor:
    """Add effects to a sensor at their neutral values; those that it has stay as they are."""
    added = [name for name in dict.fromkeys(effects) if name not in sensor.effects]
    values = {name: neutral(effect_named(name), sensor.axes) for name in added}
    return replace(sensor, effects=(*sensor.effects, *added), values={**sensor.values, **values})


def get(sensor: Sensor, names: Sequence[Coefficient]) -> np.ndarray:
    """Return the values of coefficients, (k,), each in the unit of its parameter."""
    return np.array([sensor.values[name.effect][name.parameter][_index(sensor, name)]
                     for name in names], float)


def put(sensor: Sensor, names: Sequence[Coefficient],
        coefficients: Sequence[float] | np.ndarray) -> Sensor:
    """
    Return the sensor with other values of some coefficients, (k,), each in its unit.

    It is a copy with arrays of its own for the parameters that change.
    """
    values = {effect: dict(by_parameter) for effect, by_parameter in sensor.values.items()}
    copied = set()
    for name, value in zip(names, coefficients):
        by_parameter = values[name.effect]
        if name.without_axis not in copied:
            by_parameter[name.parameter] = np.array(by_parameter[name.parameter], float)
            copied.add(name.without_axis)
        by_parameter[name.parameter][_index(sensor, name)] = value
    return replace(sensor, values=values)


def _index(sensor: Sensor, name: Coefficient) -> int | tuple[()]:
    """Return where a coefficient stands in the array of its parameter."""
    return sensor.axes.index(name.axis) if name.axis else ()
