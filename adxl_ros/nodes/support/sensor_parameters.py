# SPDX-License-Identifier: Apache-2.0

"""The parameters of a node that describe a sensor: those of a parameter file."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.model.effects import library
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import Sensor
from adxl_ros.nodes.support.parameters import declare, parameter_error
from adxl_ros.nodes.support.rclpy_internals import given_parameters
from rclpy.node import Node
from rclpy.parameter import Parameter

Kind = Parameter.Type
"""Types of ROS parameters."""

_FIELD_KINDS = {'np.ndarray': Kind.DOUBLE_ARRAY, 'float': Kind.DOUBLE, 'int': Kind.INTEGER,
                'str': Kind.STRING}
"""Parameter types by the annotations of `Sensor`'s fields."""
_DATASHEET_KINDS = {'name': Kind.STRING, 'figures': Kind.STRING_ARRAY}
"""Parameter types of `datasheet.*`; the others are arrays of numbers."""


class _Key(NamedTuple):
    """One key of a parameter file, as a parameter without a default value."""

    name: str
    kind: Kind
    description: str
    unit: str = ''
    lower: float | None = None
    upper: float | None = None
    choices: tuple[str, ...] = ()
    empty: float = 0.0


def declare_sensor(node: Node, live: bool = False) -> dict[str, Any]:
    """
    Declare everything that a parameter file holds and return what is given.

    Where `format` is given the parameters come from a parameter file, and `make_sensor` refuses
    what the file lacks. Otherwise the installed nominal sensor gives the default values.
    """
    nominal = {} if is_from_file(node) else parameter_file.to_flat(
        parameter_file.load(parameter_file.nominal_path()))
    flat = {'format': declare(node, 'format', parameter_file.FORMAT,
                              'version of the parameter file', live=live),
            'units': declare(node, 'units', parameter_file.UNITS, 'units of the coefficients',
                             live=live)}
    for key in _keys():
        flat[key.name] = declare(node, key.name, nominal.get(key.name, key.kind), *key[2:7], live,
                                 key.empty)
    return {name: value for name, value in flat.items() if value is not None}


def is_from_file(node: Node) -> bool:
    """Return whether the given parameters are those of a parameter file, which has a format."""
    return any(name == 'format' for name, _ in given_parameters(node))


def sensor_keys() -> set[str]:
    """Return the names of all parameters that `declare_sensor` declares."""
    return {'format', 'units', *(key.name for key in _keys())}


def _keys() -> Iterator[_Key]:
    """Yield the keys of a parameter file behind `format` and `units`."""
    for name, field in parameter_file.SENSOR_FIELDS.items():
        about = field.metadata
        yield _Key(name, _FIELD_KINDS[str(field.type)], about['doc'], about['unit'],
                   about['lower'], about['upper'], about['choices'])
    yield _Key('effects', Kind.STRING_ARRAY, 'effects that this unit has')
    for effect in library().values():
        for p in effect.parameters:
            yield _Key(str(Coefficient(effect.name, p.name)),
                       Kind.DOUBLE_ARRAY if p.axes else Kind.DOUBLE,
                       f'{p.doc}, by axis' if p.axes else p.doc, p.unit, p.lower, p.upper,
                       empty=p.neutral)
    yield _Key('covariance_names', Kind.STRING_ARRAY, 'coefficients in the covariance')
    yield _Key('covariance', Kind.DOUBLE_ARRAY, 'covariance of the coefficients, rows flattened')
    for name, description in parameter_file.ENVELOPE.items():
        kind = Kind.DOUBLE_ARRAY if name in parameter_file.ENVELOPE_LISTS else Kind.DOUBLE
        yield _Key(f'envelope.{name}', kind, description)
    for name, description in parameter_file.DATASHEET.items():
        yield _Key(f'datasheet.{name}', _DATASHEET_KINDS.get(name, Kind.DOUBLE_ARRAY), description)


def anonymous_sensor(node: Node, flat: Mapping[str, Any]) -> Sensor:
    """Return the sensor of a stream that states nothing of itself."""
    if is_from_file(node):
        return make_sensor(flat, may_measure=True)
    any_imu = parameter_file.load(parameter_file.any_imu_path(), may_measure=True)
    given = {name: flat[name] for name, _ in given_parameters(node) if name in flat}
    return make_sensor(parameter_file.to_flat(any_imu) | given, may_measure=True)


def make_sensor(flat: Mapping[str, Any],
                make_error: Callable[[str, str], UserError] = parameter_error,
                may_measure: bool = False) -> Sensor:
    """Check the parameters of a sensor and make it."""
    listed = flat.get('effects', [])
    used = dict(flat)
    for effect in library().values():
        if effect.name not in listed:
            for p in effect.parameters:
                used.pop(str(Coefficient(effect.name, p.name)), None)
    return parameter_file.from_flat(used, make_error, may_measure)
