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

"""A sensor's parameters that can be exchanged while a node runs: all of them or none."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.model.effects import library
from adxl_ros.model.sensor import Sensor
from adxl_ros.nodes.support import node_support
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

_FIXED = {'format', 'units', *parameter_file.FIGURES,
          *(f'{kind}.{key}' for kind, keys in (('envelope', parameter_file.ENVELOPE),
                                               ('datasheet', parameter_file.DATASHEET))
            for key in keys)}
_EFFECTS = {f'{effect.name}.{p.name}': effect.name
            for effect in library().values() for p in effect.parameters}
_NEUTRAL = {f'{effect.name}.{p.name}': p.neutral
            for effect in library().values() for p in effect.parameters}
_CHANGED = ', with coefficients set since'
_COEFFICIENTS = {'effects', 'covariance_names', 'covariance', *_EFFECTS}


class LiveSensor:
    """
    The sensor that a node's parameters describe.

    Coefficients can be set, several at once by `set_parameters_atomically`; the stated figures
    belong to the file and come with it, when the parameter `calibration` is set to its path.
    Then the parameters are those of the file. A set that is refused changes nothing.
    """

    def __init__(self, node: Node, fits: Callable[[Sensor], None],
                 use: Callable[[Sensor, str], None]) -> None:
        """
        Declare the parameters and take what is given.

        Parameters
        ----------
        node
            Whose parameters they are.
        fits
            Raises `UserError` if the node cannot use that sensor.
        use
            Called with the first and with each new sensor, and with where it comes from.

        Raises
        ------
        UserError
            What is given describes no sensor.

        """
        self._node, self._fits, self._use = node, fits, use
        self._flat = node_support.declare_sensor(node, live=True)
        node_support.make_sensor(self._flat)
        given = node.get_parameter_or('format').value is not None
        self._source = 'the parameters given' if given else \
            f'the nominal {node_support.nominal_path()}'
        # Names that no declaration knows are not in the node's public interface.
        self._declare_provenance(node._parameter_overrides)
        path = node_support.declare(
            node, 'calibration', '', 'parameter file to use; setting it loads the whole file or '
            'nothing of it', live=True)
        # What the set that is under way loads, and whether it is a declaration instead.
        self._file: dict[str, Any] | UserError | None = None
        self._declaring = False
        node.add_pre_set_parameters_callback(self._with_file)
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._apply)
        if not path:
            use(_made(self._flat), self._source)
            return
        result = node.set_parameters([Parameter('calibration', value=path)])[0]
        if not result.successful:
            raise UserError(result.reason)

    def _declare_provenance(self, given: Mapping[str, Any]) -> None:
        self._declaring = True
        for name in given:
            if name.startswith('provenance.') and name not in self._flat:
                value = given[name].value if isinstance(given[name], Parameter) else given[name]
                self._flat[name] = node_support.declare(
                    self._node, name, str(value), 'where the coefficients come from', live=True)
        self._declaring = False

    def _with_file(self, parameters: list[Parameter]) -> list[Parameter]:
        """Let `calibration` stand for all that its file holds."""
        self._file = None
        if not any(p.name == 'calibration' and p.value for p in parameters):
            return parameters
        try:
            if len(parameters) > 1:
                raise UserError('calibration: cannot be set together with other parameters: its '
                                'file holds all of them')
            self._file = parameter_file.to_flat(parameter_file.load(parameters[0].value))
        except UserError as error:
            self._file = error
            return parameters
        names = [*_FIXED, *_COEFFICIENTS, *(n for n in self._flat if n.startswith('provenance.'))]
        return parameters + [self._parameter(name, self._file.get(name)) for name in names]

    def _parameter(self, name: str, value: Any) -> Parameter:
        kind = Parameter.Type(self._node.describe_parameter(name).type)
        # One figure cannot be empty; that of an effect which is not listed means nothing.
        nothing: Any = {Parameter.Type.STRING: '', Parameter.Type.DOUBLE: _NEUTRAL.get(name, 0.0)}
        return Parameter(name, kind, nothing.get(kind, []) if value is None else value)

    def _check(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        """Say whether a set leads to a sensor that the node can use."""
        if self._declaring:
            return SetParametersResult(successful=True)
        try:
            if isinstance(self._file, UserError):
                raise self._file
            changes = self._changes(parameters)
            if self._file is None:
                _refuse_others(changes, self._flat | changes)
            if changes:
                self._fits(_made(self._flat | changes))
        except UserError as error:
            return SetParametersResult(successful=False, reason=' '.join(str(error).split()))
        return SetParametersResult(successful=True)

    def _changes(self, parameters: Sequence[Parameter]) -> dict[str, Any]:
        return {p.name: p.value.tolist() if isinstance(p.value, array) else p.value
                for p in parameters
                if p.name in _FIXED or p.name in _COEFFICIENTS
                or p.name.startswith('provenance.')}

    def _apply(self, parameters: Sequence[Parameter]) -> None:
        """Use what has been set."""
        changes = self._changes(parameters)
        if self._declaring or not changes:
            return
        self._flat |= changes
        if self._file is None:
            # The leverage is that of the fit; other coefficients have another.
            self._flat['envelope.leverage'] = 0.0
            self._source = f'{self._source.removesuffix(_CHANGED)}{_CHANGED}'
        else:
            self._source = self._node.get_parameter('calibration').value
            self._declare_provenance(self._file)
        self._use(_made(self._flat), self._source)


def _refuse_others(changes: dict[str, Any], after: dict[str, Any]) -> None:
    """Refuse what only a file can change, and coefficients that would do nothing."""
    for name, value in changes.items():
        if name in _FIXED or name.startswith('provenance.'):
            raise UserError(f'{name}: belongs to the parameter file; set calibration to the path '
                            'of another file')
        effect = _EFFECTS.get(name)
        if effect and value and effect not in (after.get('effects') or []):
            raise UserError(f'{name}: effects does not list {effect}; set effects with it')


def _made(flat: dict[str, Any]) -> Sensor:
    known = {name: value for name, value in flat.items() if value not in ([], '', None)}
    return node_support.make_sensor(known, lambda key, why: UserError(f'{key}: {why}'))
