# SPDX-License-Identifier: Apache-2.0

"""The option `--effect` of a command line: NAME[:key=value,...]."""

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

SYNTAX = ('NAME alone has typical values, KEY=VALUE sets a parameter for all its axes, '
          'KEY.AXIS=VALUE for one; parameters without a value are neutral')
"""What an option may be, for help texts."""
_SIMILARITY = 0.4
"""Smallest similarity of a suggested name, as `difflib` counts it; chosen."""


def with_effects(sensor: Sensor, texts: Sequence[str]) -> Sensor:
    """Add effects to a sensor, or change their parameters."""
    stated: dict[Coefficient, str] = {}
    for text in texts:
        name, _, rest = text.partition(':')
        effect = _effect(name, text)
        if not rest:
            values = coefficients.typical(effect, sensor.axes)
            sensor = _with_values(sensor, effect, values)
        for part in filter(None, rest.split(',')):
            key, _, number = part.partition('=')
            coefficient = Coefficient(name, *key.strip().split('.', 1))
            if coefficient in stated:
                raise UserError(f'--effect {text}: {key} of {name} is stated twice, also in '
                                f'{stated[coefficient]}; keep one')
            stated[coefficient] = text
            sensor = _with_value(sensor, effect, key.strip(), number.strip(), text)
    return sensor


def _effect(name: str, text: str) -> Effect:
    try:
        return effect_named(name)
    except UserError as error:
        raise UserError(f'--effect {text}: {error}') from None


def _with_values(sensor: Sensor, effect: Effect, values: dict[str, np.ndarray]) -> Sensor:
    """Return the sensor with an effect that has these values by parameter."""
    effects = sensor.effects if effect.name in sensor.effects else (*sensor.effects, effect.name)
    return replace(sensor, effects=effects, values={**sensor.values, effect.name: values})


def _with_value(sensor: Sensor, effect: Effect, key: str, number: str, text: str) -> Sensor:
    """Set one parameter, for all its axes or one; `text` is the option, for messages."""
    name, _, axis = key.partition('.')
    parameter = _parameter(effect, name, text)
    value = _number(parameter, number, text)
    values = dict(sensor.values.get(effect.name) or coefficients.neutral(effect, sensor.axes))
    if not parameter.axes:
        if axis:
            raise UserError(f'--effect {text}: {name} is one number without axes; write '
                            f'{name}={number}')
        return _with_values(sensor, effect, {**values, name: np.array(value)})
    chosen = [i for i, a in enumerate(sensor.axes) if a in parameter.axes and axis in ('', a)]
    if not chosen:
        raise UserError(f'--effect {text}: no axis {axis!r} to act on; the sensor has '
                        f'{sensor.axes}, {name} acts on {parameter.axes}')
    changed = np.array(values[name], float)
    changed[chosen] = value
    return _with_values(sensor, effect, {**values, name: changed})


def _parameter(effect: Effect, name: str, text: str) -> Parameter:
    by_name = {p.name: p for p in effect.parameters}
    if name not in by_name:
        near = get_close_matches(name, by_name, 1, _SIMILARITY) or list(by_name)
        raise UserError(f'--effect {text}: {effect.name} has no parameter {name!r}; did you mean '
                        f'{near[0]}?')
    return by_name[name]


def _number(parameter: Parameter, number: str, text: str) -> float:
    """Read the value of a parameter, within its bounds; `text` is the option, for messages."""
    try:
        value = float(number)
    except ValueError:
        raise UserError(f'--effect {text}: {number!r} is not a number; {parameter.name} is in '
                        f'{parameter.unit}, written without the unit') from None
    if not parameter.lower <= value <= parameter.upper:
        raise UserError(f'--effect {text}: {value:g} {parameter.unit} is outside '
                        f'{parameter.lower:g} to {parameter.upper:g} {parameter.unit}; a typical '
                        f'{parameter.name} is {parameter.scale:g}')
    return value
