# SPDX-License-Identifier: Apache-2.0

"""Parameters of nodes, each declared with its descriptor."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.nodes.support.params_files import place_of
from adxl_ros.nodes.support.rclpy_internals import given_parameters, store_empty
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter


def declare(node: Node, name: str, default: Any, description: str, unit: str = '',
            lower: float | None = None, upper: float | None = None,
            choices: Sequence[str] = (), live: bool = False, empty: float = 0.0) -> Any:
    """Declare one parameter with its descriptor and return its value."""
    text_or_list = isinstance(default, tuple)
    if text_or_list:
        default = ''
    constraint = '' if lower is None else f'{lower:.10g} to {upper:.10g}'
    if choices:
        constraint = f'one of {", ".join(choices)}'
    descriptor = ParameterDescriptor(
        description=', '.join(filter(None, (description, unit))), read_only=not live,
        dynamic_typing=text_or_list, additional_constraints=constraint)
    if lower is not None and upper is not None:
        _set_range(descriptor, default, lower, upper)
    try:
        value = node.declare_parameter(name, default, descriptor).value
    except ParameterException:
        given = dict(given_parameters(node)).get(name)
        reason = _type_error(given, default) or f'{given!r} is out of range; it must be ' \
            f'{constraint}{unit and f" {unit}"}'
        raise parameter_error(name, reason) from None
    if value is None:
        store_empty(node, name, default, empty)
    if choices and value is not None and value not in choices:
        raise parameter_error(name, f'{value!r} is not {constraint}')
    return value


def _type_error(given: Any, default: Any) -> str:
    """Return why a given value has a wrong type; '' where its type is right."""
    kind, expected = (Parameter.Type.from_parameter_value(given), _kind(default))
    if kind == expected:
        return ''
    if (kind, expected) == (Parameter.Type.INTEGER, Parameter.Type.DOUBLE):
        return f'{given} is a whole number (INTEGER); a DOUBLE is expected: write {given}.0'
    return f'{given!r} is of the type {kind.name}; expected {expected.name}'


def _kind(default: Any) -> Parameter.Type:
    """Return the type of a parameter by its default value, which may be the type."""
    return default if isinstance(default, Parameter.Type) else \
        Parameter.Type.from_parameter_value(default)


def _set_range(descriptor: ParameterDescriptor, default: Any, lower: float, upper: float) -> None:
    """Give the descriptor of a single number its range; ROS has no range for lists."""
    kind = _kind(default)
    if kind == Parameter.Type.DOUBLE:
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=float(lower), to_value=float(upper))]
    elif kind == Parameter.Type.INTEGER:
        descriptor.integer_range = [IntegerRange(from_value=int(lower), to_value=int(upper))]


def nearest(name: str, names: Sequence[str]) -> str:
    """Return the name that is most like a misspelled one."""
    return get_close_matches(name, names, 1, 0.0)[0]


def parameter_error(key: str, reason: str) -> UserError:
    """Make the error of a parameter, with its place where it comes from a file."""
    return UserError(f'{place_of(key)}{key}: {reason}')
