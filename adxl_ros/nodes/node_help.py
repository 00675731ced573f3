# SPDX-License-Identifier: Apache-2.0

"""
The help text of a node: its parameters by their description, and its topics and services.

The node is made for the topics, but not run. It does not discover other nodes, so that no graph
sees it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import chain
import os
import re
import sys
import textwrap
from typing import Any, NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.links.support import base
from adxl_ros.nodes.parameters import Kind, Spec, specs_of
from adxl_ros.nodes.sensor_parameters import nominal_specs
from adxl_ros.nodes.settings import DriverSettings, link_specs
from adxl_ros.package_version import package_version
import rclpy
from rclpy.node import Node

_COLUMNS = 79
"""Columns of a terminal that the text uses."""
_QUIET = ('--ros-args', '--log-level', 'fatal', '--disable-rosout-logs',
          '--disable-external-lib-logs')
"""Arguments of a node that logs nothing."""
_ANY_TOPIC = ('/parameter_events', '/rosout')
"""Topics that every node has."""
_LISTED_OF_SENSOR = ('sensor.', 'stage.')
"""Begins of the names of those parameters of a file that are listed one by one."""
_TYPES = {Kind.DOUBLE: 'float', Kind.INTEGER: 'int', Kind.STRING: 'text', Kind.BOOL: 'bool',
          Kind.DOUBLE_ARRAY: 'floats', Kind.STRING_ARRAY: 'texts'}
"""Words for the types of parameters."""


class NodeHelp(NamedTuple):
    """What the help text of a node has beside its topics."""

    description: str | None  # Purpose of the node
    examples: Mapping[str, str]  # Arguments of each example, by its purpose
    settings: Sequence[type] = ()  # Dataclasses of its parameters
    has_sensor: bool = True  # Whether it has those of a sensor, too
    variants: Mapping[str, type] = {}  # Dataclasses of further parameters, by what needs them


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


def _help_lines(name: str, make_node: Callable[[], Node], node_help: NodeHelp) -> list[str]:
    """Lay out the help text."""
    own = list(chain.from_iterable(map(specs_of, node_help.settings)))
    lines = [*_head_lines(name, node_help), '', 'parameters: type, default, meaning',
             *_spec_lines(own)]
    variants = {title: specs_of(part) for title, part in node_help.variants.items()}
    if DriverSettings in node_help.settings:
        variants |= {f'link.type:={link}': link_specs(link) for link in base.link_names()}
    for title, specs in variants.items():
        lines += ['', f'with {title}', *_spec_lines(specs)]
    if node_help.has_sensor:
        of_file = nominal_specs()
        listed = [spec for spec in of_file if spec.name.startswith(_LISTED_OF_SENSOR)]
        lines += ['', 'parameters of the sensor, usually from --params-file', *_spec_lines(listed),
                  *_wrapped(
                      f'and {len(of_file) - len(listed)} others of a parameter file: effects, '
                      'their coefficients with covariance, and the datasheet; "ros2 param '
                      f'describe /{name} NAME" shows each', 2)]
    try:
        topics = _topics(make_node)
    except UserError as error:
        lines += ['', *_wrapped(f'The topics can not be listed here: {error}')]
        topics = {}
    for direction, names in topics.items():
        if names:
            lines += ['', direction, *(f'  {topic:28} {kind}' for topic, kind in names.items())]
    return lines + _example_lines(name, node_help)


def _topics(make_node: Callable[[], Node]) -> dict[str, dict[str, str]]:
    """Make a node that no other one discovers; return types by topic or service, by direction."""
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'OFF'
    # A node in a terminal would open its screen.
    os.dup2(os.open(os.devnull, os.O_RDONLY), sys.stdin.fileno())
    rclpy.init(args=list(_QUIET))
    node = make_node()
    try:
        return {'publishes': _typed(node.publishers), 'subscribes': _typed(node.subscriptions),
                'services': {service.srv_name: _type_name(service.srv_type)
                             for service in node.services if service.srv_name.startswith('~/')}}
    finally:
        getattr(node, 'close', lambda: None)()
        node.destroy_node()
        rclpy.shutdown()


def _typed(endpoints: Iterable[Any]) -> dict[str, str]:
    """Return the types of topics by name, without those of every node."""
    return {endpoint.topic_name.removeprefix('/'): _type_name(endpoint.msg_type)
            for endpoint in endpoints if endpoint.topic_name not in _ANY_TOPIC}


def _type_name(kind: Any) -> str:
    """Return the name of the class of a message or service, with its package."""
    return f'{kind.__module__.partition(".")[0]}/{kind.__name__}'


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


def _spec_lines(specs: Iterable[Spec]) -> list[str]:
    """Lay out parameters: for each a line with type and default, and its meaning below."""
    lines = []
    for spec in sorted(specs):
        kind = 'texts' if spec.default == () and not spec.unit else \
            'floats' if spec.default == () else _TYPES[spec.kind]
        default = '' if isinstance(spec.default, Kind) else _value_text(spec.default)
        limits = f' ({spec.limits})' if spec.limits else ''
        lines += [f'  {spec.name}  {kind}' + (f', {default}' if default else ''),
                  *_wrapped(spec.meaning + limits, 6)]
    return lines


def _value_text(value: Any) -> str:
    """Return a default as it is written on the command line; empty without one."""
    if isinstance(value, bool):
        return 'true' if value else 'false'
    if isinstance(value, float):
        return f'{value:.6g}'
    if isinstance(value, str):
        return re.sub(f'^{re.escape(os.path.expanduser("~"))}', '~', value)
    if isinstance(value, int):
        return str(value)
    items = [_value_text(item) for item in value]
    return f'[{", ".join(items)}]' if items else ''
