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

"""Coefficients of a sensor by name: `effect.parameter.axis`, or `effect.parameter` of no axis."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Effect, Parameter
from adxl_ros.model.sensor import Sensor
import numpy as np


def names_of(effect: Effect, axes: str) -> tuple[str, ...]:
    """
    Name the coefficients of an effect on a sensor with these axes.

    Parameters
    ----------
    effect
        From the library.
    axes
        Measured axes; those that a parameter means nothing for are left out.

    """
    return tuple(f'{effect.name}.{p.name}{end}' for p in effect.parameters
                 for end in ([f'.{a}' for a in axes if a in p.axes] if p.axes else ['']))


def fitted_of(effect: Effect, axes: str) -> tuple[str, ...]:
    """Name the coefficients of an effect that a fit of its own finds."""
    return names_of(replace(effect, parameters=tuple(
        p for p in effect.parameters if not p.held)), axes)


def parameter_of(name: str) -> Parameter:
    """Return the description of a coefficient."""
    effect, parameter = name.split('.')[:2]
    return next(p for p in effect_named(effect).parameters if p.name == parameter)


def neutral(effect: Effect, axes: str) -> dict[str, np.ndarray]:
    """Return the values that leave the chain as it is, (m,) or () by parameter."""
    return {p.name: np.full(len(axes), p.neutral) if p.axes else np.array(p.neutral)
            for p in effect.parameters}


def typical(effect: Effect, axes: str) -> dict[str, np.ndarray]:
    """Return typical values, (m,) or () by parameter, for the axes that they mean something."""
    values = neutral(effect, axes)
    for p in effect.parameters:
        chosen = [a in p.axes for a in axes] if p.axes else ()
        values[p.name][chosen] = p.scale if p.typical is None else p.typical
    return values


def with_neutral(sensor: Sensor, effects: Iterable[str]) -> Sensor:
    """Add the effects that the sensor does not have, at their neutral values."""
    new = [name for name in dict.fromkeys(effects) if name not in sensor.effects]
    values = {name: neutral(effect_named(name), sensor.axes) for name in new}
    return replace(sensor, effects=(*sensor.effects, *new), values={**sensor.values, **values})


def get(sensor: Sensor, names: Sequence[str]) -> np.ndarray:
    """Return the values of coefficients, (k,)."""
    return np.array([sensor.values[name.split('.')[0]][name.split('.')[1]][_at(sensor, name)]
                     for name in names], float)


def put(sensor: Sensor, names: Sequence[str], coefficients: Sequence[float] | np.ndarray
        ) -> Sensor:
    """
    Return the sensor with other values of some coefficients.

    Parameters
    ----------
    sensor
        Has the effects.
    names
        Which, (k,).
    coefficients
        Their values, (k,).

    """
    values = {effect: dict(of) for effect, of in sensor.values.items()}
    fresh = set()
    for name, value in zip(names, coefficients):
        effect, parameter = key = tuple(name.split('.')[:2])
        if key not in fresh:
            values[effect][parameter] = np.array(values[effect][parameter], float)
            fresh.add(key)
        values[effect][parameter][_at(sensor, name)] = value
    return replace(sensor, values=values)


def _at(sensor: Sensor, name: str) -> int | tuple[()]:
    parts = name.split('.')
    return sensor.axes.index(parts[2]) if len(parts) == 3 else ()
