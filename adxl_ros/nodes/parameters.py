# SPDX-License-Identifier: Apache-2.0

"""
Parameters of nodes: each is declared once, and stands beside what it is for.

Descriptors, `--help`, launch arguments and the known names all come from its `Spec`: a field of a
dataclass in the node's file or, for a link, in its module in `links`. `sensor_specs` are those of
a sensor, which are those of its parameter file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import field, fields, is_dataclass
from difflib import get_close_matches
from importlib import import_module
from itertools import chain, pairwise
from pathlib import Path
import re
import sys
from types import ModuleType
from typing import Any, NamedTuple, TypeVar

from adxl_ros.errors import one_line, UserError
from adxl_ros.files import parameter_file
from adxl_ros.files.atomic_write import write_text
from adxl_ros.files.column_mapping import GRAVITY
from adxl_ros.links.support import base
from adxl_ros.model.effects import library
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import Sensor
from adxl_ros.process import NODES
import numpy as np
from rcl_interfaces import msg
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter
import yaml

T = TypeVar('T')
Kind = Parameter.Type  # Types of ROS parameters
LINK = 'link.'  # Begin of the names of all parameters of a link; the driver alone has them
SEEDS = (0, 2**31 - 1)  # Range of seeds
_ANY_NODE = ('use_sim_time', 'start_type_description_service')  # Parameters of every node of rclpy
_QOS = 'qos_overrides.'  # Begin of the names of parameters that override the QoS of a topic
_FREE_PREFIXES = ('provenance.', LINK)
"""Prefixes whose names are not known here: free keys, and what the driver checks."""
QOS_POLICIES = ('history', 'depth', 'reliability', 'durability')
"""Policies that parameters can override: those that a publisher and a subscription share."""
_QOS_NAME = re.compile(rf'{_QOS}(/.+)\.(publisher|subscription)\.({"|".join(QOS_POLICIES)})')
_READ_ONLY = 'read-only'  # Word of rclpy's refusal
_DIAGNOSTICS = '/diagnostics'  # The only topic of a node that is not configured
_FILE_FLAG = '--params-file'  # Argument of rcl before a parameter file
_RULE_FLAGS = ('-p', '--param')  # Arguments of rcl before one parameter
_OF_LAUNCH = 'launch_params_'
"""Begin of the names of files in which launch_ros gives the parameters of a launch."""
_LARGEST = 3600.0
"""Largest number of a range; chosen: ten turns in degrees, and hotter than any sensor."""


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


SI = 'mps2'  # Unit of the accelerations of a sensor_msgs/Imu by its definition


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


def check_given(node: Node) -> None:
    """Refuse parameters that no node of this package has, and files that name other nodes."""
    name = node.get_fully_qualified_name()
    for path in _paths():
        sections = dict.fromkeys(section for section, _, _ in _entries(path))
        if sections and not any(_matches(section, name) for section in sections):
            raise UserError(
                f'{path}: has parameters of {", ".join(sections)}, but none of the '
                f'node {name}; begin the file with /**: or {name}:'
            )
    known = {
        *_ANY_NODE,
        *(
            spec.name
            for spec in (*sensor_specs(), *node_specs(sys.modules[type(node).__module__]))
        ),
    }
    # One file may serve all nodes: a node ignores what another one has. The others are loaded one
    # after the other, and only until one has the name.
    broken: list[str] = []
    others = _names_of_nodes(broken)
    for name in given_parameters(node):
        if name.startswith(_QOS) and not _QOS_NAME.fullmatch(name):
            raise parameter_error(
                name,
                f'expected {_QOS}/TOPIC.ENTITY.POLICY, ENTITY publisher '
                f'or subscription, POLICY {", ".join(QOS_POLICIES)}',
            )
        if name in known or name.startswith((*_FREE_PREFIXES, _QOS)):
            continue
        for other in others:
            known.add(other)
            if other == name:
                break
        else:
            like = get_close_matches(name, sorted(known), 1, 0.0)[0]
            unread = f' ({"; ".join(broken)})' if broken else ''
            raise parameter_error(
                name, f'no node has a parameter of this name{unread}; did you mean {like}?'
            )


def _names_of_nodes(broken: list[str]) -> Iterator[str]:
    """Yield the parameters of all nodes; add what is wrong with those that do not load."""
    for node in NODES:
        try:
            module = import_module(f'adxl_ros.nodes.{node}')
        # A fault of another node, whatever it is, must not hide the misspelt name of this one.
        except Exception as error:
            broken.append(f'{node} does not load: {one_line(error)}')
            continue
        yield from (spec.name for spec in node_specs(module))


def warn_of_unused_qos(node: Node) -> None:
    """Warn of the given QoS of topics that a node does not have; other nodes may have them."""
    given, own = (
        {match[1] for name in names if (match := _QOS_NAME.fullmatch(name))}
        for names in (given_parameters(node), node._parameters)
    )
    if own != {_DIAGNOSTICS} and given - own:
        node.get_logger().warning(
            f'qos_overrides of {", ".join(sorted(given - own))}: not used; the topics of this '
            f'node are {", ".join(sorted(own))}'
        )


def explain_read_only(node: Node) -> None:
    """Let the refusal of a read-only parameter say how it can be given; rclpy's does not."""
    refuse_or_set = node.set_parameters_atomically
    calibration = (
        '; set calibration to FILE for a whole calibration'
        if node.has_parameter('calibration')
        else ''
    )

    def set_parameters_atomically(given: list[Parameter]) -> msg.SetParametersResult:
        result = refuse_or_set(given)
        if _READ_ONLY in result.reason:
            result.reason += f' Start the node with it, or with --params-file FILE{calibration}.'
        return result

    # The services call it by the node.
    node.set_parameters_atomically = set_parameters_atomically  # type: ignore[assignment]


def declare_all(node: Node, settings: type[T]) -> T:
    """Declare the parameters of a dataclass, and return it with their values."""
    return settings(*(declare(node, spec) for spec in specs_of(settings)))


def declare(node: Node, spec: Spec) -> Any:
    """Declare one parameter with its descriptor and return its value."""
    name, kind = spec.name, spec.kind
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
        _show(node, spec, None)
    elif spec.choices and value not in spec.choices:
        raise parameter_error(name, f'{value!r} is not {spec.limits}')
    return value


def _show(node: Node, spec: Spec, value: Any) -> None:
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


def parameter_error(key: str, reason: str) -> UserError:
    """Make the error of a parameter, with its place where it comes from a file."""
    return UserError(f'{_place_of(key)}{key}: {reason}')


def _place_of(key: str) -> str:
    """
    Return the place of a parameter in the files: 'file:line:column: ', or ''.

    A parameter that no argument gives belongs to the last file.
    """
    path = file_of(key)
    if path:
        mark = next(value.start_mark for _, name, value in _entries(path) if name == key)
        return f'{path}:{mark.line + 1}:{mark.column + 1}: '
    return f'{_paths()[-1]}: ' if _paths() and path is None else ''


def file_of(key: str) -> str | None:
    """
    Return the file that gives a parameter, '' where another argument does, None where none does.

    The last argument that gives a parameter counts.
    """
    for flag, value in reversed(list(pairwise(sys.argv))):
        # A rule is [NODE:]NAME:=VALUE.
        if flag in _RULE_FLAGS and value.split(':=')[0].rsplit(':')[-1] == key:
            return ''
        if flag == _FILE_FLAG and any(name == key for _, name, _ in _entries(value)):
            return value if value in _paths() else ''
    return None


def _paths() -> list[str]:
    """Return the files of `--params-file` in the order of the command line, without a launch's."""
    return [
        path
        for flag, path in pairwise(sys.argv)
        if flag == _FILE_FLAG and not Path(path).name.startswith(_OF_LAUNCH)
    ]


def _entries(path: str) -> Iterator[tuple[str, str, yaml.Node]]:
    """Yield the pattern of the node's name, the parameter's name and its value in a file."""

    def inside(tree: yaml.Node, keys: list[str]) -> Iterator[tuple[str, yaml.Node]]:
        if isinstance(tree, yaml.MappingNode):
            for key, value in tree.value:
                yield from inside(value, [*keys, key.value])
        else:
            yield '.'.join(keys), tree

    for section, parameters in _sections(path):
        for name, value in inside(parameters, []):
            yield section, name, value


def _sections(path: str) -> Iterator[tuple[str, yaml.MappingNode]]:
    """Yield the pattern of the node's name and the parameters of each section of a file."""

    def inside(tree: yaml.Node | None, keys: list[str]) -> Iterator[tuple[str, yaml.MappingNode]]:
        for key, value in tree.value if isinstance(tree, yaml.MappingNode) else ():
            if key.value != 'ros__parameters':
                yield from inside(value, [*keys, key.value.strip('/')])
            elif isinstance(value, yaml.MappingNode):
                yield ''.join(f'/{part}' for part in keys), value

    return inside(parameter_file.compose(path), [])


def write_into(path: str, node_name: str, values: Mapping[str, str]) -> None:
    """
    Write parameters of a node into its file; all else in the file stays as it is.

    values: YAML of the values by name. Raises `UserError` where the file cannot be written.
    """
    section = next(
        (parameters for pattern, parameters in _sections(path) if _matches(pattern, node_name)),
        None,
    )
    if section is None:
        raise UserError(f'{path}: has no parameters of the node {node_name}')
    text = Path(path).read_text(encoding='utf-8')
    present = {
        name: value for pattern, name, value in _entries(path) if _matches(pattern, node_name)
    }
    begin = section.value[0][0].start_mark
    after = ', ' if section.flow_style else f'\n{" " * begin.column}'
    edits = [
        (present[name].start_mark.index, present[name].end_mark.index, value)
        if name in present
        else (begin.index, begin.index, f'{name}: {value}{after}')
        for name, value in values.items()
    ]
    for start, stop, new in sorted(edits, reverse=True):
        text = text[:start] + new + text[stop:]
    write_text(Path(path).resolve(), text)


def check_params_files() -> None:
    """Check the syntax of all parameter files; rcl would name neither line nor column."""
    for path in _paths():
        parameter_file.compose(path)


def has_section(path: str, node_name: str) -> bool:
    """Return whether a parameter file has a section for a node."""
    return any(_matches(section, node_name) for section, _, _ in _entries(path))


def given_text(path: str, node_name: str, key: str) -> str:
    """Return the text of a parameter in the sections of a file for a node."""
    return next(
        (
            str(value.value)
            for section, name, value in _entries(path)
            if name == key and _matches(section, node_name)
        ),
        '',
    )


def _matches(pattern: str, node_name: str) -> bool:
    """Return whether a pattern means a node; * is one part of a name, and ** any number."""
    wild = {'*': r'/[^/]+', '**': r'(/[^/]+)*'}
    parts = [wild.get(part, f'/{re.escape(part)}') for part in pattern.strip('/').split('/')]
    return bool(re.fullmatch(''.join(parts), node_name))


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
    specs = sensor_specs() if is_from_file(node) else nominal_specs()
    flat = {spec.name: declare(node, spec) for spec in specs}
    return {name: value for name, value in flat.items() if value is not None}


def nominal_specs() -> list[Spec]:
    """Return the parameters of a sensor, with the values of the nominal one as defaults."""
    nominal = parameter_file.to_flat(parameter_file.load(parameter_file.nominal_path()))
    return [spec._replace(default=nominal.get(spec.name, spec.default)) for spec in sensor_specs()]


def is_from_file(node: Node) -> bool:
    """Return whether the given parameters are those of a parameter file, which has a format."""
    return 'format' in given_parameters(node)


def sensor_specs() -> Iterator[Spec]:
    """Yield the parameters of a parameter file."""
    yield Spec('format', parameter_file.FORMAT, 'version of the parameter file')
    yield Spec('units', parameter_file.UNITS, 'units of the coefficients')
    for name, described in parameter_file.SENSOR_FIELDS.items():
        about = described.metadata
        yield Spec(
            name,
            _FIELD_KINDS[str(described.type)],
            about['doc'],
            about['unit'],
            about['lower'],
            about['upper'],
            about['choices'],
        )
    yield Spec('effects', Kind.STRING_ARRAY, 'effects that this unit has')
    for effect in library().values():
        for p in effect.parameters:
            yield Spec(
                str(Coefficient(effect.name, p.name)),
                Kind.DOUBLE_ARRAY if p.axes else Kind.DOUBLE,
                f'{p.doc}, by axis' if p.axes else p.doc,
                p.unit,
                p.lower,
                p.upper,
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
        _show(node, spec, flat.get(spec.name))


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
