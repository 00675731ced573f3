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

"""Effects as the command line states them: NAME[:key=value,...]."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from difflib import get_close_matches

from adxl_ros.errors import UserError
from adxl_ros.model import coefficients
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Coefficient, Effect, Parameter
from adxl_ros.model.sensor import Sensor
import numpy as np

SYNTAX = ('NAME alone takes typical values; KEY=VALUE sets a parameter for all its axes, '
          'KEY.AXIS=VALUE for one; those that are not named are neutral')


def with_effects(sensor: Sensor, texts: Sequence[str]) -> Sensor:
    """
    Add effects, or change their parameters, as the command line states them.

    Parameters
    ----------
    sensor
        The effects of its parameter file stay.
    texts
        One an option `--effect`.

    Raises
    ------
    UserError
        Unknown effect, parameter or axis (the nearest is suggested), no number, out of bounds,
        or stated twice.

    """
    stated: dict[Coefficient, str] = {}
    for text in texts:
        name, _, rest = text.partition(':')
        effect = _effect(name, text)
        if not rest:
            values = coefficients.typical(effect, sensor.axes)
            sensor = _with(sensor, effect, values)
        for part in filter(None, rest.split(',')):
            key, _, figure = part.partition('=')
            coefficient = Coefficient(name, *key.strip().split('.', 1))
            if coefficient in stated:
                raise UserError(f'--effect {text}: {key} of {name} is stated twice, in '
                                f'{stated[coefficient]}, too; keep one')
            stated[coefficient] = text
            sensor = _set(sensor, effect, key.strip(), figure.strip(), text)
    return sensor


def _effect(name: str, text: str) -> Effect:
    try:
        return effect_named(name)
    except UserError as error:
        raise UserError(f'--effect {text}: {error}') from None


def _with(sensor: Sensor, effect: Effect, values: dict[str, np.ndarray]) -> Sensor:
    effects = sensor.effects if effect.name in sensor.effects else (*sensor.effects, effect.name)
    return replace(sensor, effects=effects, values={**sensor.values, effect.name: values})


def _set(sensor: Sensor, effect: Effect, key: str, figure: str, text: str) -> Sensor:
    name, _, axis = key.partition('.')
    parameter = _parameter(effect, name, text)
    value = _number(parameter, figure, text)
    values = dict(sensor.values.get(effect.name) or coefficients.neutral(effect, sensor.axes))
    if not parameter.axes:
        if axis:
            raise UserError(f'--effect {text}: {name} is one figure without axes; write '
                            f'{name}={figure}')
        return _with(sensor, effect, {**values, name: np.array(value)})
    chosen = [i for i, a in enumerate(sensor.axes) if a in parameter.axes and axis in ('', a)]
    if not chosen:
        raise UserError(f'--effect {text}: no axis {axis!r} to act on; the sensor has '
                        f'{sensor.axes}, {name} acts on {parameter.axes}')
    changed = np.array(values[name], float)
    changed[chosen] = value
    return _with(sensor, effect, {**values, name: changed})


def _parameter(effect: Effect, name: str, text: str) -> Parameter:
    by_name = {p.name: p for p in effect.parameters}
    if name not in by_name:
        near = get_close_matches(name, by_name, 1, 0.4) or list(by_name)
        raise UserError(f'--effect {text}: {effect.name} has no parameter {name!r}; did you mean '
                        f'{near[0]}?')
    return by_name[name]


def _number(parameter: Parameter, figure: str, text: str) -> float:
    try:
        value = float(figure)
    except ValueError:
        raise UserError(f'--effect {text}: {figure!r} is not a number; {parameter.name} is in '
                        f'{parameter.unit}, written without the unit') from None
    if not parameter.lower <= value <= parameter.upper:
        raise UserError(f'--effect {text}: {value:g} {parameter.unit} is outside '
                        f'{parameter.lower:g} to {parameter.upper:g} {parameter.unit}; a typical '
                        f'{parameter.name} is {parameter.scale:g}')
    return value
