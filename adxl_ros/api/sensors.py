# SPDX-License-Identifier: Apache-2.0

"""Sensors of the front door: datasheets, parameter files, and what a recording shows of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
import math
import os
from typing import Any, NamedTuple, Protocol, TypeAlias

from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import NO_SERIAL
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Effect
from adxl_ros.model.sensor import neutral, Sensor, typical
from adxl_ros.signals.recorded_sensor import load_sensor, measure_unstated
import numpy as np


class HasSensor(Protocol):
    """A result that has a sensor: Fit, Gap, Noise, Update or Corrected."""

    @property
    def sensor(self) -> Sensor:
        """Return the sensor."""


SensorInput: TypeAlias = Sensor | HasSensor | str | os.PathLike
"""A Sensor, a result that has one, a datasheet's name or the path of a parameter file."""
EffectInput: TypeAlias = tuple[str, Mapping[str, Any]]
"""Name of an effect, and values by parameter, such as 'gain' or 'gain.x'; none for typical."""
AddedEffects: TypeAlias = Mapping[str, Mapping[str, Any] | None] | Sequence[str]
"""Names of effects of typical size, or a dict of values by parameter for each name."""


def load(name: str | os.PathLike, *, effects: AddedEffects = ()) -> Sensor:
    """
    Load a sensor.

    Parameters
    ----------
    name
        Name of a datasheet, such as 'adxl203' or 'mpu6050', or the path of a parameter file.
    effects
        Effects that are added, for a `SensorModel` in a simulator: a list of names for typical
        sizes, or a dict of values by parameter for each name, as in `simulate`.

    Returns
    -------
    Sensor
        The sensor. Rate, noise, filter and range that the file leaves out are measured by the
        verbs, and their results say so.

    Raises
    ------
    UserError
        The file cannot be read, or a value is missing or out of bounds.

    """
    return with_effects(parameter_file.load(name, may_measure=True), effect_inputs(effects))


def effect_inputs(effects: AddedEffects) -> list[EffectInput]:
    """Return effects by their names, each with one number a key."""
    if isinstance(effects, Mapping):
        for name, values in effects.items():
            if not (values is None or isinstance(values, Mapping)):
                raise UserError(
                    f'effect {name}: {values!r} is no dict of values by parameter; write for '
                    "example {'lever_arm': {'z_m': 0.03}}, or None for typical values"
                )
        return [(name, _flat(values or {})) for name, values in effects.items()]
    return [(name, {}) for name in effect_names(effects)]


def effect_names(names: Sequence[str]) -> tuple[str, ...]:
    """Return the names of effects; refuse what is no list of names, or names no effect."""
    is_list = isinstance(names, Iterable) and not isinstance(names, (str, Mapping))
    if not is_list or not all(isinstance(name, str) for name in names):
        raise UserError(
            f"effects: {names!r} is no list of names; write for example ['misalignment']"
        )
    return tuple(effect_named(name).name for name in names)


def with_effects(sensor: Sensor, effects: Iterable[EffectInput]) -> Sensor:
    """Add effects to a sensor, or change their parameters."""
    for name, given in effects:
        try:
            effect = effect_named(name)
            values = (
                dict(sensor.values.get(name) or neutral(effect, sensor.axes))
                if given
                else typical(effect, sensor.axes)
            )
            for key, number in given.items():
                _put(effect, values, sensor.axes, key, number)
        except UserError as error:
            parts = ','.join(f'{key}={number}' for key, number in given.items())
            text = f'{name}:{parts}' if given else name
            raise UserError(f'effect {text}: {error}') from None
        names = sensor.effects if name in sensor.effects else (*sensor.effects, name)
        sensor = replace(sensor, effects=names, values={**sensor.values, name: values})
    return sensor


def _put(effect: Effect, values: dict[str, np.ndarray], axes: str, key: str, number: Any) -> None:
    """Set a parameter for all its axes, or for one, as `gain.x`; the number may be a text."""
    name, _, axis = key.partition('.')
    parameters = {parameter.name: parameter for parameter in effect.parameters}
    if name not in parameters:
        raise UserError(f'{effect.name} has no parameter {name!r}, but {", ".join(parameters)}')
    parameter = parameters[name]
    value = math.nan
    with suppress(ValueError, TypeError):
        value = float(number)
    if not parameter.lower <= value <= parameter.upper:
        raise UserError(
            f'{number!r} is not a number from {parameter.lower:g} to '
            f'{parameter.upper:g} ({parameter.unit}); a typical {name} is '
            f'{parameter.scale:g}'
        )
    chosen = [a in parameter.axes and axis in ('', a) for a in axes]
    if not any(chosen) and (parameter.axes or axis):
        raise UserError(
            f'no axis {axis!r} to act on; the sensor has {axes}, {name} acts on '
            f'{parameter.axes or "none, it is one number"}'
        )
    values[name] = np.where(chosen if parameter.axes else True, value, values[name])


def _flat(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values with one number a key: those by axis get the axis behind their names."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            flat |= {f'{key}.{axis}': number for axis, number in value.items()}
        else:
            flat[key] = value
    return flat


class GivenSensor(NamedTuple):
    """The sensor of a recording."""

    sensor: Sensor  # With the rate of the recording, and with what was measured
    file: str  # What names it on a command line; '' for the nominal sensor
    file_name: str  # Name of its parameter file, that of the nominal sensor or any IMU, too
    measured: Sequence[str]  # What was measured, as no parameter file states it, for people


def sensor_of(given: SensorInput | None, read: Recording, has_noise: bool = True) -> GivenSensor:
    """
    Return the sensor of a recording; None is the one that the recording most likely has.

    has_noise: whether what is not stated can be measured; else it stays unstated.
    """
    stated = as_input(given)
    sensor = load_sensor(stated, read)
    measured: Sequence[str] = []
    if has_noise:
        sensor, measured = measure_unstated(sensor, read)
    if isinstance(stated, Sensor):
        stated = '' if sensor.serial == NO_SERIAL else f'{sensor.serial}.yaml'
    usual = parameter_file.usual_path(read.is_of_nominal)
    return GivenSensor(sensor, stated or '', os.path.basename(stated or usual), measured)


def as_input(given: SensorInput | None) -> Sensor | str | None:
    """Return a sensor itself, or the name of its file; results hold their sensor."""
    sensor = getattr(given, 'sensor', given)
    if sensor is None or isinstance(sensor, Sensor):
        return sensor
    if not isinstance(sensor, (str, os.PathLike)):
        raise UserError(
            f'{type(given).__name__} is no sensor; expected a Sensor, a result that has one '
            "(Fit, Gap, Noise), a datasheet's name, or the path of a parameter file"
        )
    return os.fspath(sensor)
