# SPDX-License-Identifier: Apache-2.0

"""The parameters of a sensor in a node, which are those of its parameter file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from adxl_ros.files import parameter_file
from adxl_ros.model.effects import library
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import Sensor, without_self_test
from adxl_ros.nodes.parameters import declare, given_parameters, Kind, show, Spec
from adxl_ros.nodes.params_files import parameter_error
from rclpy.node import Node

_FIELD_KINDS = {
    'np.ndarray': Kind.DOUBLE_ARRAY,
    'tuple[float, ...]': Kind.DOUBLE_ARRAY,
    'float': Kind.DOUBLE,
    'int': Kind.INTEGER,
    'str': Kind.STRING,
}
"""Parameter types by the annotations of `Sensor`'s fields."""
_DATASHEET_KINDS = {'name': Kind.STRING, 'figures': Kind.STRING_ARRAY}
"""Parameter types of `datasheet.*`; the others are arrays of numbers."""


def declare_sensor(node: Node) -> dict[str, Any]:
    """
    Declare everything that a parameter file holds and return what is given.

    Where `format` is given the parameters come from a parameter file, and `make_sensor` refuses
    what the file lacks. Otherwise the installed nominal sensor gives the default values.
    """
    axes = given_parameters(node).get('sensor.axes', '')
    specs = sensor_specs() if is_from_file(node) else nominal_specs(axes)
    flat = {spec.name: declare(node, spec) for spec in specs}
    return {name: value for name, value in flat.items() if value is not None}


def nominal_specs(axes: str = '') -> list[Spec]:
    """
    Return the parameters of a sensor, with the values of the nominal one as defaults.

    axes: those that are given, '' for those of the nominal sensor; others have no default of a
    self-test.
    """
    nominal = parameter_file.load(parameter_file.nominal_path())
    if axes not in ('', nominal.axes):
        nominal = without_self_test(nominal)
    flat = parameter_file.to_flat(nominal)
    return [spec._replace(default=flat.get(spec.name, spec.default)) for spec in sensor_specs()]


def is_from_file(node: Node) -> bool:
    """Return whether the given parameters are those of a parameter file, which has a format."""
    return 'format' in given_parameters(node)


def sensor_specs() -> Iterator[Spec]:
    """Yield the parameters of a parameter file."""
    yield Spec('format', parameter_file.FORMAT, 'version of the parameter file')
    yield Spec('units', parameter_file.COEFFICIENT_UNITS, 'units of the coefficients')
    for name, described in parameter_file.SENSOR_FIELDS.items():
        about = described.metadata
        yield Spec(
            name=name,
            default=_FIELD_KINDS[str(described.type)],
            doc=about['doc'],
            unit=about['unit'],
            lower=about['lower'],
            upper=about['upper'],
            choices=about['choices'],
        )
    yield Spec('effects', Kind.STRING_ARRAY, 'effects that this unit has')
    for effect in library().values():
        for p in effect.parameters:
            yield Spec(
                name=str(Coefficient(effect.name, p.name)),
                default=Kind.DOUBLE_ARRAY if p.axes else Kind.DOUBLE,
                doc=f'{p.doc}, by axis' if p.axes else p.doc,
                unit=p.unit,
                lower=p.lower,
                upper=p.upper,
                empty=p.neutral,
            )
    yield Spec('covariance_names', Kind.STRING_ARRAY, 'coefficients in the covariance')
    yield Spec('covariance', Kind.DOUBLE_ARRAY, 'covariance of the coefficients, rows flattened')
    for name, description in parameter_file.ENVELOPE.items():
        kind = Kind.DOUBLE_ARRAY if name in parameter_file.ENVELOPE_LISTS else Kind.DOUBLE
        yield Spec(f'envelope.{name}', kind, description)
    for name, about in parameter_file.GYRO.items():
        yield Spec(f'gyro.{name}', Kind.DOUBLE_ARRAY, about['doc'], about['unit'])
    for name, description in parameter_file.DATASHEET.items():
        yield Spec(f'datasheet.{name}', _DATASHEET_KINDS.get(name, Kind.DOUBLE_ARRAY), description)


def show_sensor(node: Node, sensor: Sensor) -> None:
    """Let the parameters of a node be those of the sensor in force: `ros2 param dump` has them."""
    flat = parameter_file.to_flat(sensor)
    for spec in sensor_specs():
        show(node, spec, flat.get(spec.name))


def make_sensor(flat: Mapping[str, Any], may_measure: bool = False) -> Sensor:
    """Check the parameters of a sensor and make it; effects that are not listed do not count."""
    used = dict(flat)
    for effect in library().values():
        if effect.name not in flat.get('effects', []):
            for p in effect.parameters:
                used.pop(str(Coefficient(effect.name, p.name)), None)
    return parameter_file.from_flat(used, parameter_error, may_measure)


def anonymous_sensor(node: Node, flat: Mapping[str, Any]) -> Sensor:
    """Return the sensor of a stream that states nothing of itself."""
    if is_from_file(node):
        return make_sensor(flat, may_measure=True)
    any_imu = parameter_file.usual(is_nominal=False)
    given = {name: flat[name] for name in given_parameters(node) if name in flat}
    return make_sensor(parameter_file.to_flat(any_imu) | given, may_measure=True)


def given_sensor(node: Node) -> dict[str, Any]:
    """Declare what a parameter file holds; return what is given, its provenance among it."""
    # The keys of a provenance are free, so that they cannot be declared.
    return declare_sensor(node) | {
        name: str(value)
        for name, value in given_parameters(node).items()
        if name.startswith('provenance.')
    }
