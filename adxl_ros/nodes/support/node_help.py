# SPDX-License-Identifier: Apache-2.0

"""
The help text of a node: its parameters, topics and services, as the node itself declares them.

The node is made for that, but not run. It does not discover other nodes, so that no graph sees it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
import os
import re
import sys
import textwrap
from typing import Any, NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.files.package_version import package_version
from adxl_ros.links.support import base
from adxl_ros.nodes.support.link_parameters import LINK_TYPE, PREFIX
from adxl_ros.nodes.support.sensor_parameters import sensor_keys
import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter

_COLUMNS = 79
"""Columns of a terminal that the text uses."""
_QUIET = ('--ros-args', '--log-level', 'fatal', '--disable-rosout-logs',
          '--disable-external-lib-logs')
"""Arguments of a node that logs nothing."""
_ANY_NODE = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')
"""Begins of the names of parameters that every node has."""
_ANY_TOPIC = ('/parameter_events', '/rosout')
"""Topics that every node has."""
_LISTED_OF_SENSOR = ('sensor.', 'stage.')
"""Begins of the names of those parameters of a file that are listed one by one."""
_FEWEST_OF_FILE = 2
"""Fewest parameters of a file that are listed apart from the others."""
_TYPES = {Parameter.Type.DOUBLE: 'float', Parameter.Type.INTEGER: 'int',
          Parameter.Type.STRING: 'text', Parameter.Type.BOOL: 'bool',
          Parameter.Type.DOUBLE_ARRAY: 'floats', Parameter.Type.STRING_ARRAY: 'texts'}
"""Words for the types of parameters."""


class NodeHelp(NamedTuple):
    """What the help text of a node has beside its declarations."""

    description: str | None  # Purpose of the node
    examples: Mapping[str, str]  # Arguments of each example, by its purpose
    # Parameters `NAME:=VALUE` with which the node declares others, by a title
    variants: Mapping[str, Sequence[str]] = {}


def print_if_asked(arguments: Sequence[str], make_node: Callable[[], Node], node_help: NodeHelp
                   ) -> bool:
    """Print version or help where the command line has that option."""
    if '--version' in arguments:
        print(f'adxl_ros {package_version()}')
        return True
    if {'-h', '--help'} & set(arguments):
        name = os.path.basename(sys.argv[0])
        print('\n'.join(_help_lines(name, make_node, node_help)))
        return True
    return False


def program_parser(name: str, description: str | None, examples: Mapping[str, str]
                   ) -> argparse.ArgumentParser:
    """Make the parser of a program that starts nodes, with `--version` and examples."""
    text = NodeHelp(description, examples)
    parser = argparse.ArgumentParser(
        prog=name, description='\n'.join(_wrapped(' '.join((description or '').split()))),
        epilog='\n'.join(_example_lines(name, text)[1:]),
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--version', action='version', version=f'adxl_ros {package_version()}')
    return parser


class _Made:
    """What a node has declared."""

    def __init__(self, node: Node) -> None:
        parameters: dict[str, Any] = dict(node.get_parameters_by_prefix(''))
        descriptors = node.describe_parameters(list(parameters))
        # Parameters with their descriptors, by name
        self.parameters = {
            name: (parameter, descriptor) for (name, parameter), descriptor
            in sorted(zip(parameters.items(), descriptors), key=lambda item: item[0][0])
            if not name.startswith(_ANY_NODE)}
        # Names and types of the topics, by direction
        self.topics = {'publishes': _typed(node.publishers),
                       'subscribes': _typed(node.subscriptions)}
        # Names and types of its services, without those of every node
        self.services = {service.srv_name: _type_name(service.srv_type)
                         for service in node.services if service.srv_name.startswith('~/')}


def _typed(endpoints: Iterable[Any]) -> dict[str, str]:
    """Return the types of topics by name, without those of every node."""
    return {endpoint.topic_name.removeprefix('/'): _type_name(endpoint.msg_type)
            for endpoint in endpoints if endpoint.topic_name not in _ANY_TOPIC}


def _type_name(kind: Any) -> str:
    """Return the name of the class of a message or service, with its package."""
    return f'{kind.__module__.partition(".")[0]}/{kind.__name__}'


def _made(make_node: Callable[[], Node], given: Sequence[str] = ()) -> _Made:
    """Make a node that no other one discovers, and read what it declares."""
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'OFF'
    # A node in a terminal would open its screen.
    os.dup2(os.open(os.devnull, os.O_RDONLY), sys.stdin.fileno())
    rclpy.init(args=[*_QUIET, *(word for parameter in given for word in ('-p', parameter))])
    node = make_node()
    try:
        return _Made(node)
    finally:
        getattr(node, 'close', lambda: None)()
        node.destroy_node()
        rclpy.shutdown()


def _help_lines(name: str, make_node: Callable[[], Node], node_help: NodeHelp) -> list[str]:
    """Lay out the help text."""
    keys = sensor_keys()
    try:
        made = _made(make_node)
    except UserError as error:
        return [*_head_lines(name, node_help), '', *_wrapped(
            f'The parameters and topics can not be listed here: {error}'),
            *_example_lines(name, node_help)]
    file_keys = [key for key in made.parameters if key in keys]
    if len(file_keys) < _FEWEST_OF_FILE:
        file_keys = []
    node_keys = [key for key in made.parameters if key not in file_keys
                 and (key == LINK_TYPE or not key.startswith(PREFIX))]
    sensor = [key for key in file_keys if key.startswith(_LISTED_OF_SENSOR)]
    lines = [*_head_lines(name, node_help), '', 'parameters: type, default, meaning',
             *_declared_lines(made, node_keys)]
    for title, given in node_help.variants.items():
        variant = _made(make_node, given)
        further = [key for key in variant.parameters if key not in made.parameters]
        required = [parameter.partition(':=')[0] for parameter in given]
        lines += ['', f'with {title}', *_declared_lines(variant, further, required)]
    if LINK_TYPE in made.parameters:
        lines += _link_lines()
    if sensor:
        lines += ['', 'parameters of the sensor, usually from --params-file',
                  *_declared_lines(made, sensor),
                  *_wrapped(
                      f'and {len(file_keys) - len(sensor)} others of a parameter file: effects, '
                      'their coefficients with covariance, and the datasheet; "ros2 param '
                      f'describe /{name} NAME" shows each', 2)]
    for direction, names in (*made.topics.items(), ('services', made.services)):
        if names:
            lines += ['', direction, *(f'  {topic:28} {kind}' for topic, kind in names.items())]
    return lines + _example_lines(name, node_help)


def _head_lines(name: str, node_help: NodeHelp) -> list[str]:
    """Lay out usage and purpose."""
    return [f'usage: {name} [--help] [--version] [--ros-args -p NAME:=VALUE ...',
            f'{"":{len(name) + 8}}--params-file FILE -r FROM:=TO ...]', '',
            *_wrapped(' '.join((node_help.description or '').split()))]


def _example_lines(name: str, node_help: NodeHelp) -> list[str]:
    """Lay out the examples; a backslash joins the lines of a long one."""
    lines = ['', 'examples:']
    for purpose, arguments in node_help.examples.items():
        *first, last = _wrapped(f'ros2 run adxl_ros {name} {arguments}'.rstrip(), 4, 8, 2)
        lines += [f'  {purpose}:', *(f'{line} \\' for line in first), last]
    return lines


def _wrapped(text: str, indent: int = 0, further: int | None = None, reserve: int = 0
             ) -> list[str]:
    """Wrap a text between words, all lines or further ones with an indent."""
    return textwrap.wrap(text, _COLUMNS - reserve, initial_indent=indent * ' ',
                         subsequent_indent=(indent if further is None else further) * ' ',
                         break_long_words=False, break_on_hyphens=False)


def _declared_lines(made: _Made, names: Sequence[str], required: Sequence[str] = ()
                    ) -> list[str]:
    """Lay out some parameters of a node; those that are required have no default."""
    lines = []
    for name in names:
        parameter, descriptor = made.parameters[name]
        lines += _parameter_lines(
            name, _TYPES.get(parameter.type_, 'text'),
            None if name in required else parameter.value, descriptor.description,
            descriptor.additional_constraints)
    return lines


def _link_lines() -> list[str]:
    """Lay out the parameters of all links, from the dataclasses that the driver declares."""
    lines = []
    for link in base.link_names():
        lines += ['', f'with link.type:={link}']
        for option in base.options(base.link_module(link).Settings):
            is_list = isinstance(option.default, tuple)
            kind = 'texts' if is_list else _TYPES[
                Parameter.Type.from_parameter_value(option.default)]
            limits = '' if option.lower is None else f'{option.lower:.10g} to {option.upper:.10g}'
            lines += _parameter_lines(
                f'{PREFIX}{option.name}', kind, '' if is_list else option.default,
                ', '.join(filter(None, (option.doc, option.unit))), limits)
    return lines


def _parameter_lines(name: str, kind: str, value: Any, meaning: str, limits: str) -> list[str]:
    """Lay out one parameter: a line with type and default, and its meaning below."""
    text = _value_text(value)
    head = f'  {name}  {kind}' + (f', {text}' if text else '')
    body = meaning + (f' ({limits})' if limits else '')
    return [head, *_wrapped(body, 6)]


def _value_text(value: Any) -> str:
    """Return a default as it is written on the command line; empty without one."""
    if isinstance(value, bool):
        return 'true' if value else 'false'
    if isinstance(value, float):
        return f'{value:.6g}'
    if isinstance(value, str):
        return re.sub(f'^{re.escape(os.path.expanduser("~"))}', '~', value)
    if value is None or isinstance(value, int):
        return '' if value is None else str(value)
    items = [_value_text(item) for item in value]
    return f'[{", ".join(items)}]' if items else ''
