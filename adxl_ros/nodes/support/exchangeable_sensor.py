# SPDX-License-Identifier: Apache-2.0

"""A sensor's parameters that can be exchanged while a node runs: all of them or none."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from adxl_ros.errors import one_line, UserError
from adxl_ros.files import parameter_file
from adxl_ros.model.effects import library
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import Sensor
from adxl_ros.nodes.support.parameters import declare
from adxl_ros.nodes.support.rclpy_internals import given_parameters, on_set_request
from adxl_ros.nodes.support.sensor_parameters import (
    anonymous_sensor,
    declare_sensor,
    is_from_file,
    make_sensor,
)
from rcl_interfaces.msg import ParameterType, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

_FILE_KEYS = {'format', 'units', *parameter_file.SENSOR_FIELDS,
              *(f'envelope.{key}' for key in parameter_file.ENVELOPE),
              *(f'datasheet.{key}' for key in parameter_file.DATASHEET)}
"""Parameters that belong to a file and change with it alone."""
_EFFECT_OF = {str(Coefficient(effect.name, p.name)): effect.name
              for effect in library().values() for p in effect.parameters}
"""Effect by the name of a parameter."""
_NEUTRAL = {str(Coefficient(effect.name, p.name)): p.neutral
            for effect in library().values() for p in effect.parameters}
"""Neutral value by the name of a parameter."""
_COEFFICIENT_KEYS = {'effects', 'covariance_names', 'covariance', *_EFFECT_OF}
"""Parameters that can be set one by one, or several at once."""
_NUMBERS = (ParameterType.PARAMETER_DOUBLE, ParameterType.PARAMETER_DOUBLE_ARRAY)
"""Types of numbers."""
_CHANGED = ', with coefficients set since'
"""Appended to the source of coefficients when some of them are set."""


class ExchangeableSensor:
    """
    The sensor that a node's parameters describe.

    Coefficients can be set, several at once by `set_parameters_atomically`. The nominal values
    belong to the file and come with it, when the parameter `calibration` is set to its path, or
    when `ros2 param load` sends all that it holds; then all parameters are those of the file. A
    set that is refused changes nothing.
    """

    def __init__(self, node: Node, check: Callable[[Sensor], None],
                 use: Callable[[Sensor, str], None]) -> None:
        self._node, self._check_use, self._use = node, check, use
        self._flat = declare_sensor(node, live=True)
        make_sensor(self._flat, may_measure=True)
        self._source = 'the parameters given' if is_from_file(node) else \
            f'the nominal {parameter_file.nominal_path()}'
        self._declare_provenance(given_parameters(node))
        path = declare(
            node, 'calibration', '', 'parameter file to use; setting it loads the whole file or '
            'nothing of it', live=True)
        # A set of `calibration` that is under way: what its file holds, or why it is refused.
        self._file: dict[str, Any] | None = None
        self._file_error: UserError | None = None
        self._loaded: dict[str, Any] | None = None
        self._declaring = False
        on_set_request(node, self._load)
        node.add_pre_set_parameters_callback(self._add_file)
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._apply)
        if not path:
            use(_sensor_of(self._flat), self._source)
            return
        result = node.set_parameters([Parameter('calibration', value=path)])[0]
        if not result.successful:
            raise UserError(result.reason)

    def anonymous(self) -> Sensor:
        """Return the sensor of a stream that states nothing of itself, where none is named."""
        return anonymous_sensor(self._node, self._flat)

    def _declare_provenance(self, given: Iterable[tuple[str, Any]]) -> None:
        """Declare what is given of a provenance, whose keys are free."""
        self._declaring = True
        for name, value in given:
            if name.startswith('provenance.') and name not in self._flat:
                self._flat[name] = declare(self._node, name, str(value),
                                           'where the coefficients come from', live=True)
        self._declaring = False

    def _load(self, parameters: list[Parameter]) -> SetParametersResult | None:
        """Use the file that `ros2 param load` sends; None where they are no whole file."""
        changes = _changes(parameters)
        if 'format' not in changes:
            return None
        try:
            changes = {name: self._as_declared(name, value) for name, value in changes.items()}
            self._loaded = parameter_file.to_flat(_sensor_of(changes))
            return self._node.set_parameters_atomically([Parameter('calibration', value='')])
        except UserError as error:
            return SetParametersResult(successful=False, reason=one_line(error))
        finally:
            self._loaded = None

    def _as_declared(self, name: str, value: Any) -> Any:
        """Return a value with its declared type: rclpy makes a text of a file's number 3.0e-05."""
        kind = self._node.describe_parameter(name).type if self._node.has_parameter(name) else 0
        if not isinstance(value, str) or kind not in _NUMBERS:
            return value
        try:
            numbers = [float(part) for part in value.strip('[]').split(',')]
        except ValueError:
            raise UserError(f'{name}: {value!r} is not a number') from None
        return numbers[0] if kind == ParameterType.PARAMETER_DOUBLE else numbers

    def _add_file(self, parameters: list[Parameter]) -> list[Parameter]:
        """Add everything that the file of `calibration` holds to a set."""
        self._file, self._file_error = self._loaded, None
        if self._file is None:
            if not any(p.name == 'calibration' and p.value for p in parameters):
                return parameters
            try:
                if len(parameters) > 1:
                    raise UserError('calibration: cannot be set together with other parameters: '
                                    'its file holds all of them')
                self._file = parameter_file.to_flat(parameter_file.load(parameters[0].value))
            except UserError as error:
                self._file_error = error
                return parameters
        names = [*_FILE_KEYS, *_COEFFICIENT_KEYS,
                 *(name for name in self._flat if name.startswith('provenance.'))]
        return parameters + [self._parameter(name, self._file.get(name)) for name in names]

    def _parameter(self, name: str, value: Any) -> Parameter:
        """Return a parameter with its declared type; None becomes the empty value of the type."""
        kind = Parameter.Type(self._node.describe_parameter(name).type)
        # A number cannot be empty; that of an effect which is not listed has no meaning.
        empty: Any = {Parameter.Type.STRING: '', Parameter.Type.DOUBLE: _NEUTRAL.get(name, 0.0)}
        return Parameter(name, kind, empty.get(kind, []) if value is None else value)

    def _check(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        """Refuse a set that leads to no sensor, or to one that the node cannot use."""
        if self._declaring:
            return SetParametersResult(successful=True)
        try:
            if self._file_error is not None:
                raise self._file_error
            changes = _changes(parameters)
            if self._file is None:
                _refuse_others(changes, self._flat | changes)
            if changes:
                self._check_use(_sensor_of(self._flat | changes))
        except UserError as error:
            return SetParametersResult(successful=False, reason=one_line(error))
        return SetParametersResult(successful=True)

    def _apply(self, parameters: Sequence[Parameter]) -> None:
        """Use what has been set."""
        changes = _changes(parameters)
        if self._declaring or not changes:
            return
        self._flat |= changes
        if self._file is not None:
            self._source = self._node.get_parameter('calibration').value or 'the file loaded'
            self._declare_provenance(self._file.items())
        else:
            # The leverage is that of the fit; other coefficients have another.
            self._flat['envelope.leverage'] = 0.0
            self._source = f'{self._source.removesuffix(_CHANGED)}{_CHANGED}'
        self._use(_sensor_of(self._flat), self._source)


def _changes(parameters: Sequence[Parameter]) -> dict[str, Any]:
    """Return the values of a set that describe the sensor, by name."""
    return {p.name: p.value.tolist() if isinstance(p.value, array) else p.value
            for p in parameters
            if p.name in _FILE_KEYS or p.name in _COEFFICIENT_KEYS
            or p.name.startswith('provenance.')}


def _refuse_others(changes: Mapping[str, Any], flat: Mapping[str, Any]) -> None:
    """Refuse what only a file can change, and coefficients that would do nothing."""
    for name, value in changes.items():
        if name in _FILE_KEYS or name.startswith('provenance.'):
            raise UserError(f'{name}: belongs to the parameter file; set calibration to the path '
                            'of another file')
        effect = _EFFECT_OF.get(name)
        if effect and value and effect not in (flat.get('effects') or []):
            raise UserError(f'{name}: effects does not list {effect}; set effects with it')


def _sensor_of(flat: Mapping[str, Any]) -> Sensor:
    """Make the sensor of parameters, where an empty value stands for none."""
    filled = {name: value for name, value in flat.items() if value not in ([], '', None)}
    return make_sensor(filled, lambda key, reason: UserError(f'{key}: {reason}'),
                       may_measure=True)
