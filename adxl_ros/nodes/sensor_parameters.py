# SPDX-License-Identifier: Apache-2.0

"""The parameters of a sensor: those of its parameter file, which a node reads at the start."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from adxl_ros.errors import one_line, UserError
from adxl_ros.files import parameter_file
from adxl_ros.model.effects import library
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import Sensor
from adxl_ros.nodes.parameters import declare, Kind, parameter_error, Spec
from adxl_ros.nodes.rclpy_internals import given_parameters
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

_FIELD_KINDS = {'np.ndarray': Kind.DOUBLE_ARRAY, 'float': Kind.DOUBLE, 'int': Kind.INTEGER,
                'str': Kind.STRING}
"""Parameter types by the annotations of `Sensor`'s fields."""
_DATASHEET_KINDS = {'name': Kind.STRING, 'figures': Kind.STRING_ARRAY}
"""Parameter types of `datasheet.*`; the others are arrays of numbers."""


def declare_sensor(node: Node) -> dict[str, Any]:
    """
    Declare everything that a parameter file holds and return what is given.

    Where `format` is given the parameters come from a parameter file, and `make_sensor` refuses
    what the file lacks. Otherwise the installed nominal sensor gives the default values.
    """
    specs = sensor_specs() if is_from_file(node) else nominal_specs()
    flat = {spec.name: declare(node, spec) for spec in specs}
    return {name: value for name, value in flat.items() if value is not None}


def nominal_specs() -> list[Spec]:
    """Return the parameters of a sensor, with the values of the nominal one as defaults."""
    nominal = parameter_file.to_flat(parameter_file.load(parameter_file.nominal_path()))
    return [spec._replace(default=nominal.get(spec.name, spec.default))
            for spec in sensor_specs()]


def is_from_file(node: Node) -> bool:
    """Return whether the given parameters are those of a parameter file, which has a format."""
    return any(name == 'format' for name, _ in given_parameters(node))


def sensor_keys() -> set[str]:
    """Return the names of all parameters that `declare_sensor` declares."""
    return {spec.name for spec in sensor_specs()}


def sensor_specs() -> Iterator[Spec]:
    """Yield the parameters of a parameter file."""
    yield Spec('format', parameter_file.FORMAT, 'version of the parameter file')
    yield Spec('units', parameter_file.UNITS, 'units of the coefficients')
    for name, field in parameter_file.SENSOR_FIELDS.items():
        about = field.metadata
        yield Spec(name, _FIELD_KINDS[str(field.type)], about['doc'], about['unit'],
                   about['lower'], about['upper'], about['choices'])
    yield Spec('effects', Kind.STRING_ARRAY, 'effects that this unit has')
    for effect in library().values():
        for p in effect.parameters:
            yield Spec(str(Coefficient(effect.name, p.name)),
                       Kind.DOUBLE_ARRAY if p.axes else Kind.DOUBLE,
                       f'{p.doc}, by axis' if p.axes else p.doc, p.unit, p.lower, p.upper,
                       empty=p.neutral)
    yield Spec('covariance_names', Kind.STRING_ARRAY, 'coefficients in the covariance')
    yield Spec('covariance', Kind.DOUBLE_ARRAY, 'covariance of the coefficients, rows flattened')
    for name, description in parameter_file.ENVELOPE.items():
        kind = Kind.DOUBLE_ARRAY if name in parameter_file.ENVELOPE_LISTS else Kind.DOUBLE
        yield Spec(f'envelope.{name}', kind, description)
    for name, description in parameter_file.DATASHEET.items():
        yield Spec(f'datasheet.{name}', _DATASHEET_KINDS.get(name, Kind.DOUBLE_ARRAY), description)


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
    any_imu = parameter_file.load(parameter_file.any_imu_path(), may_measure=True)
    given = {name: flat[name] for name, _ in given_parameters(node) if name in flat}
    return make_sensor(parameter_file.to_flat(any_imu) | given, may_measure=True)


class ExchangeableSensor:
    """
    The sensor by which a node works: that of its parameters, or of the file of `calibration`.

    The parameter `calibration` exchanges a calibration as a whole while the node runs. A file that
    cannot be used is refused, and changes nothing.
    """

    def __init__(self, node: Node, calibration: str, check: Callable[[Sensor], None],
                 use: Callable[[Sensor, str], None]) -> None:
        self._node, self._check_use, self._use = node, check, use
        # The keys of a provenance are free, so that they cannot be declared.
        self._flat = declare_sensor(node) | {
            name: str(value) for name, value in given_parameters(node)
            if name.startswith('provenance.')}
        sensor = make_sensor(self._flat, may_measure=True)
        self._new: Sensor | None = None
        if calibration:
            sensor = parameter_file.load(calibration)
            check(sensor)
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._apply)
        use(sensor, calibration or ('the parameters given' if is_from_file(node) else
                                    f'the nominal {parameter_file.nominal_path()}'))

    def anonymous(self) -> Sensor:
        """Return the sensor of a stream that states nothing of itself, where none is named."""
        return anonymous_sensor(self._node, self._flat)

    def _check(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        """Load the file of `calibration`; refuse it where the node cannot use it."""
        path = _calibration(parameters)
        try:
            self._new = parameter_file.load(path) if path else None
            if self._new is not None:
                self._check_use(self._new)
        except UserError as error:
            return SetParametersResult(successful=False, reason=one_line(error))
        return SetParametersResult(successful=True)

    def _apply(self, parameters: Sequence[Parameter]) -> None:
        sensor, self._new = self._new, None
        if sensor is not None:
            self._use(sensor, _calibration(parameters))


def _calibration(parameters: Sequence[Parameter]) -> str:
    """Return the path of a calibration among parameters that are set, or ''."""
    return next((str(p.value) for p in parameters if p.name == 'calibration'), '')
