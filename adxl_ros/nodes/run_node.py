# SPDX-License-Identifier: Apache-2.0

"""
One node as an executable: its start and end, its errors, and its help text.

The help text states parameters by their description, and topics and services of a node that is
made, but not run. It does not discover other nodes, so that no graph sees it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from itertools import chain
import os
from pathlib import Path
import signal
import sys
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.links.support import base
from adxl_ros.nodes.parameters import check_params_files, Kind, nominal_specs, Spec, specs_of
from adxl_ros.nodes.rclpy_internals import start_error_text
from adxl_ros.nodes.settings import DriverSettings, link_specs, NODES
from adxl_ros.nodes.topics import type_name
from adxl_ros.process import ended_by_closed_output, package_version
from adxl_ros.report.screen import command_lines, wrapped
import rclpy
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.utilities import remove_ros_args

_QUIET = ('--ros-args', '--log-level', 'fatal', '--disable-rosout-logs',
          '--disable-external-lib-logs')
"""Arguments of a node that logs nothing."""
_ANY_TOPIC = ('/parameter_events', '/rosout')
"""Topics that every node has."""
_WITHOUT_SENSOR = ('stage', 'screen')
"""Nodes without the parameters of a sensor."""
_LISTED_OF_SENSOR = ('sensor.', 'stage.')
"""Begins of the names of those parameters of a file that are listed one by one."""
_TYPES = {Kind.DOUBLE: 'float', Kind.INTEGER: 'int', Kind.STRING: 'text', Kind.BOOL: 'bool',
          Kind.DOUBLE_ARRAY: 'floats', Kind.STRING_ARRAY: 'texts'}
"""Words for the types of parameters."""


def program_parser(name: str, description: str | None, examples: Mapping[str, str]
                   ) -> argparse.ArgumentParser:
    """Make the parser of a program that starts nodes, with `--version` and examples."""
    parser = argparse.ArgumentParser(
        prog=name, description='\n'.join(_wrapped(description or '')),
        epilog='\n'.join(_example_lines(name, examples)[1:]),
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--version', action='version', version=f'adxl_ros {package_version()}')
    return parser


def _help_lines(name: str, make_node: Callable[[], Node], description: str | None,
                examples: Mapping[str, str]) -> list[str]:
    """Lay out the help text."""
    own = chain.from_iterable(map(specs_of, NODES[name]))
    lines = [f'usage: {name} [--help] [--version] [--ros-args -p NAME:=VALUE ...',
             f'{"":{len(name) + 8}}--params-file FILE -r FROM:=TO ...]', '',
             *_wrapped(description or ''), '',
             'parameters: type, default, meaning', *_spec_lines(own)]
    for link in base.link_names() if DriverSettings in NODES[name] else ():
        lines += ['', f'with link.type:={link}', *_spec_lines(link_specs(link))]
    if name not in _WITHOUT_SENSOR:
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
    return lines + _example_lines(name, examples)


def _topics(make_node: Callable[[], Node]) -> dict[str, dict[str, str]]:
    """Make a node that no other one discovers; return types by topic or service, by direction."""
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'OFF'
    # A node in a terminal would open its screen.
    os.dup2(os.open(os.devnull, os.O_RDONLY), sys.stdin.fileno())
    rclpy.init(args=list(_QUIET))
    node = make_node()
    try:
        return {'publishes': _typed(node.publishers), 'subscribes': _typed(node.subscriptions),
                'services': {service.srv_name: type_name(service.srv_type)
                             for service in node.services if service.srv_name.startswith('~/')}}
    finally:
        if hasattr(node, 'close'):
            node.close()
        node.destroy_node()
        rclpy.shutdown()


def _typed(endpoints: Iterable[Any]) -> dict[str, str]:
    """Return the types of topics by name, without those of every node."""
    return {endpoint.topic_name.removeprefix('/'): type_name(endpoint.msg_type)
            for endpoint in endpoints if endpoint.topic_name not in _ANY_TOPIC}


def _example_lines(name: str, examples: Mapping[str, str]) -> list[str]:
    """Lay out the examples."""
    lines = ['', 'examples:']
    for purpose, arguments in examples.items():
        command = f'ros2 run adxl_ros {name} {arguments}'.rstrip()
        lines += [f'  {purpose}:', *command_lines(command, 4 * ' ')]
    return lines


def _wrapped(text: str, indent: int = 0) -> list[str]:
    """Wrap a text between words, with an indent of all lines."""
    return wrapped(indent * ' ' + ' '.join(text.split()), indent)


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
    if isinstance(value, list | tuple):
        return f'[{", ".join(map(_value_text, value))}]' if value else ''
    return f'{value:.6g}' if isinstance(value, float) else \
        str(value).replace(os.path.expanduser('~'), '~')


_SWITCH_S = 0.0005
"""Time after which a thread of Python gives way to one that waits, s. Chosen: a sample that comes
while the executor works shall wait for less than its frame; Python's 5 ms are longer."""
_TIMER_SLACK = Path('/proc/self/timerslack_ns')
"""File that sets by how much the kernel may delay a wake-up of this process (man 5 proc)."""
_SLACK_NS = '1000'
"""Largest such delay, ns; chosen: far below the period of samples. The default is 50 µs."""
_USAGE = '%(prog)s [--ros-args -p NAME:=VALUE ... --params-file FILE -r FROM:=TO ...]'
"""Usage that follows an unknown argument."""


@ended_by_closed_output()
def run(make_node: Callable[[], Node], description: str | None, examples: Mapping[str, str],
        work: Callable[[Any, Executor], None] = lambda _, executor: executor.spin()) -> int:
    """
    Run one node until SIGINT or SIGTERM, or show version or help.

    description: purpose of the node; examples: arguments of each, by its purpose.
    """
    name = Path(sys.argv[0]).name
    is_initialised = False
    interrupts: list[int] = []
    try:
        # It names a fault of a file by its place; rclpy does not.
        check_params_files()
        # People ask for help behind --ros-args, too.
        if '--version' in sys.argv:
            print(f'adxl_ros {package_version()}')
            return 0
        if {'-h', '--help'} & set(sys.argv):
            print('\n'.join(_help_lines(name, make_node, description, examples)))
            return 0
        argparse.ArgumentParser(prog=name, usage=_USAGE).parse_args(remove_ros_args(sys.argv)[1:])
        # rclpy's own handler ends the context; Python's would raise in the middle of a statement.
        signal.signal(signal.SIGINT, lambda number, _: interrupts.append(number))
        _wake_in_time()
        rclpy.init()
        is_initialised = True
        if interrupts:
            # The signal came before rclpy's handler.
            rclpy.try_shutdown()
        node = make_node()
    except Exception as error:
        if is_initialised and not rclpy.ok():
            # A signal has ended the context during the start.
            return 0
        # The errors of rclpy have no common base class, and one is in its C++ module alone.
        if not isinstance(error, UserError) and not type(error).__module__.startswith('rclpy'):
            raise
        print(f'{name}: {start_error_text(error)}', file=sys.stderr)
        return 2 if 'ROSArgs' in type(error).__name__ else 1
    try:
        _spin(node, work)
    finally:
        if hasattr(node, 'close'):
            node.close()
        rclpy.try_shutdown()
        # A launch passes Ctrl-C on, although the terminal has sent it too. The second signal may
        # come after Python has removed its handlers.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
    return 0


def _wake_in_time() -> None:
    """Let no thread of this process wait longer than it must."""
    sys.setswitchinterval(_SWITCH_S)
    with suppress(OSError):
        _TIMER_SLACK.write_text(_SLACK_NS)


def _spin(node: Node, work: Callable[[Any, Executor], None]) -> None:
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        work(node, executor)
    except ExternalShutdownException:
        pass
    except Exception:
        # After the signal nothing can be published: a failure then belongs to the end.
        if rclpy.ok():
            raise
