# SPDX-License-Identifier: Apache-2.0

"""
Parameters of nodes: each is declared once, and stands beside what it is for.

Descriptors, `--help`, launch arguments and the known names all come from its `Spec`: a field of a
dataclass in the node's file or, for a link, in its module in `links`. `sensor_parameters` has
those of a sensor, `params_files` the files that give them, `parameter_checks` what is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import field, fields, is_dataclass
from itertools import chain
from types import ModuleType
from typing import Any, NamedTuple, TypeVar

from adxl_ros.errors import one_line, UserError
from adxl_ros.files.column_mapping import GRAVITY
from adxl_ros.links.support import base
from adxl_ros.nodes.params_files import parameter_error
import numpy as np
from rcl_interfaces import msg
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter

T = TypeVar('T')
Kind = Parameter.Type  # Types of ROS parameters
LINK = 'link.'  # Begin of the names of all parameters of a link; the driver alone has them
SEEDS = (0, 2**31 - 1)  # Range of seeds
_LARGEST = 3600.0
"""Largest number of a range; chosen: ten turns in degrees, and hotter than any sensor."""
SI = 'mps2'  # Unit of the accelerations of a sensor_msgs/Imu by its definition


class Spec(NamedTuple):
    """One parameter."""

    name: str
    # Its type is that of the parameter. An empty tuple stands for a list, or one text with commas,
    # and a `Kind` for a parameter without default.
    default: Any
    doc: str
    unit: str = ''
    lower: float | None = None  # In `unit`; None without limits
    upper: float | None = None
    choices: Sequence[str] = ()  # Values of a text
    live: bool = False  # Whether it can be set while the node runs
    empty: float = 0.0  # Number that stands for no value, where there is no default

    @property
    def kind(self) -> Kind:
        """Return the type of the parameter."""
        if isinstance(self.default, Kind):
            return self.default
        return Kind.from_parameter_value('' if self.default == () else self.default)

    @property
    def meaning(self) -> str:
        """Return the meaning with the unit."""
        return ', '.join(filter(None, (self.doc, self.unit)))

    @property
    def limits(self) -> str:
        """Return what values are permitted, '' for any."""
        if self.choices:
            return f'one of {", ".join(self.choices)}'
        return '' if self.lower is None else f'{self.lower:.10g} to {self.upper:.10g}'


def parameter(*spec: Any, name: str = '', **options: Any) -> Any:
    """Declare a parameter as `Spec` has it by a field of a dataclass, which gives it its name."""
    return field(metadata={'spec': Spec(name, *spec, **options)})


def sample_unit() -> Any:
    """Declare the unit of the samples of a foreign IMU by a field of a dataclass."""
    return parameter(
        SI,
        'unit of the samples on imu/data_raw, as some drivers publish g',
        choices=tuple(GRAVITY),
        name='samples.unit',
    )


def specs_of(settings: Any) -> list[Spec]:
    """Return the parameters of a dataclass."""
    return [
        spec._replace(name=spec.name or f.name)
        for f in fields(settings)
        if (spec := f.metadata.get('spec'))
    ]


def node_specs(module: ModuleType) -> list[Spec]:
    """Return the parameters that the dataclasses of a node's file declare."""
    declaring = filter(is_dataclass, vars(module).values())
    return list(chain.from_iterable(map(specs_of, declaring)))


def link_specs(link: str) -> list[Spec]:
    """Return the parameters of a link, `link.type` aside."""
    return [
        Spec(f'{LINK}{option.name}', option.default, **option.metadata)
        for option in fields(base.link_module(link).Settings)
    ]


def given_parameters(node: Node) -> dict[str, Any]:
    """
    Return all parameters that a node is started with.

    rclpy shows a given parameter only once it is declared. The keys of a provenance are free, so
    that no declaration can know their names.
    """
    return {name: given.value for name, given in node._parameter_overrides.items()}


def given_below(node: Node, begin: str) -> dict[str, Any]:
    """Return the given parameters whose names have a begin, by the rest of the name."""
    return {
        name.removeprefix(begin): value
        for name, value in given_parameters(node).items()
        if name.startswith(begin)
    }


def declare_all(node: Node, settings: type[T]) -> T:
    """Declare the parameters of a dataclass, and return it with their values."""
    return settings(*(declare(node, spec) for spec in specs_of(settings)))


def declare(node: Node, spec: Spec) -> Any:
    """Declare one parameter with its descriptor and return its value."""
    name = spec.name
    kind = spec.kind
    descriptor = msg.ParameterDescriptor(
        description=spec.meaning,
        read_only=not spec.live,
        dynamic_typing=spec.default == (),
        additional_constraints=spec.limits,
    )
    if spec.lower is not None and spec.upper is not None:
        # ROS has no range for lists.
        if kind == Kind.DOUBLE:
            descriptor.floating_point_range = [
                msg.FloatingPointRange(from_value=float(spec.lower), to_value=float(spec.upper))
            ]
        elif kind == Kind.INTEGER:
            descriptor.integer_range = [
                msg.IntegerRange(from_value=int(spec.lower), to_value=int(spec.upper))
            ]
    try:
        value = node.declare_parameter(
            name, '' if spec.default == () else spec.default, descriptor
        ).value
    except ParameterException:
        given = given_parameters(node).get(name)
        expected = ', '.join(filter(None, (kind.name, spec.limits, spec.unit)))
        hint = ''
        if kind == Kind.DOUBLE and isinstance(given, int):
            hint = f'; write {given}.0'
        elif kind == Kind.STRING:
            hint = f"""; write '{name}:="{given}"'"""
        raise parameter_error(name, f'{given!r} is refused; expected {expected}{hint}') from None
    if value is None:
        show(node, spec, None)
    elif spec.choices and value not in spec.choices:
        raise parameter_error(name, f'{value!r} is not {spec.limits}')
    return value


def show(node: Node, spec: Spec, value: Any) -> None:
    """Show a value as that of a declared parameter; None is shown as what stands for no value."""
    # rclpy answers a request for several parameters with nothing when one of them has no value,
    # and takes an empty list as a list of bytes when it declares a parameter.
    empty: dict[Kind, Any] = {
        Kind.STRING: '',
        Kind.INTEGER: round(spec.empty),
        Kind.DOUBLE: float(spec.empty),
    }
    node._parameters[spec.name] = Parameter(
        spec.name, spec.kind, empty.get(spec.kind, []) if value is None else value
    )


def numbers(name: str, given: Any, example: str) -> list[float]:
    """Return the numbers of a parameter that is a list; one number alone is one, too."""
    try:
        return [float(value) for value in np.atleast_1d(given)]
    except (TypeError, ValueError):
        raise parameter_error(name, f'{given!r} is no list of numbers; write {example}') from None


def low_and_high(name: str, given: Any, default: tuple[float, float]) -> tuple[float, float]:
    """Return the lowest and the highest number of a parameter, by default where it is empty."""
    example = '[{:.1f}, {:.1f}]'.format(*default)
    values = numbers(name, given or default, example)
    if len(values) != 2 or not -_LARGEST <= values[0] < values[1] <= _LARGEST:
        raise parameter_error(
            name, f'{values} is no lowest and highest value within {_LARGEST:g}; write {example}'
        )
    return values[0], values[1]


def on_change(
    node: Node, name: str, prepare: Callable[[Any], T], use: Callable[[T], None]
) -> None:
    """Prepare and use what is set while the node runs; an error of `prepare` refuses it."""
    prepared: list[T] = []

    def check(changed: Sequence[Parameter]) -> msg.SetParametersResult:
        prepared.clear()
        try:
            prepared.extend(prepare(p.value) for p in changed if p.name == name)
        except UserError as error:
            return msg.SetParametersResult(successful=False, reason=one_line(error))
        return msg.SetParametersResult(successful=True)

    def apply(_: Sequence[Parameter]) -> None:
        while prepared:
            use(prepared.pop())

    node.add_on_set_parameters_callback(check)
    node.add_post_set_parameters_callback(apply)
