# SPDX-License-Identifier: Apache-2.0

"""One node as an executable: its start and end, its errors, and its help text."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
import os
from pathlib import Path
import re
import signal
import sys
import traceback
from typing import Any

from adxl_ros.errors import one_line, UserError
from adxl_ros.links.support import base
from adxl_ros.nodes import parameter_checks, parameters, params_files, sensor_parameters
from adxl_ros.nodes.parameters import Kind, Spec
from adxl_ros.process import ended_by_closed_output
from adxl_ros.report.screen import program_parser
from adxl_ros.wording import options_named
import rclpy
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.utilities import remove_ros_args

_WITHOUT_SENSOR = ('stage', 'screen')  # Nodes without the parameters of a sensor
_LISTED_OF_SENSOR = ('sensor.', 'stage.')
"""Begins of the names of those parameters of a file that are listed one by one."""
_TYPES = {
    Kind.DOUBLE: 'float',
    Kind.INTEGER: 'int',
    Kind.STRING: 'text',
    Kind.BOOL: 'bool',
    Kind.DOUBLE_ARRAY: 'floats',
    Kind.STRING_ARRAY: 'texts',
}
"""Words for the types of parameters."""
_USAGE = '%(prog)s [--ros-args -p NAME:=VALUE ... --params-file FILE\n    -r FROM:=TO ...]'
"""Usage of a node."""
_SWITCH_S = 0.0005
"""Time after which a thread of Python gives way to one that waits, s. A sample that comes while
the executor works shall wait for less than its frame, 1 ms at 1 kHz; Python's 5 ms are longer."""
_TIMER_SLACK = Path('/proc/self/timerslack_ns')
"""File that sets by how much the kernel may delay a wake-up of this process (man 5 proc)."""
_SLACK_NS = '1000'
"""Largest such delay, ns: a thousandth of a period at 1 kHz. The default is 50 µs, a twentieth."""
_PLACE = r', at /\S+:\d+'  # Places in rcl within the text of its refusals
_WITH_COLON = r"rule: '-p ([^:]+):=(.*:.*)'\. Error"
"""An argument in the text of rcl's refusal, whose value has a colon: name and value."""
_QUOTES = """; a text with a colon needs quotes of its own: -p '{}:="{}"'"""


def _parameter_groups(name: str, own: Iterable[Spec]) -> Iterator[tuple[str, list[Spec]]]:
    """Yield title and parameters of each group of parameters of a node."""
    yield 'parameters', sorted(own)
    for link in base.link_names() if name == 'driver' else ():
        yield f'with link.type:={link}', sorted(parameters.link_specs(link))
    if name not in _WITHOUT_SENSOR:
        yield (
            'parameters of the sensor, usually from --params-file',
            sorted(
                spec
                for spec in sensor_parameters.nominal_specs()
                if spec.name.startswith(_LISTED_OF_SENSOR)
            ),
        )


def _help(spec: Spec) -> str:
    """Return type, default, meaning and limits of a parameter."""
    of_list = 'floats' if spec.unit else 'texts'
    kind = of_list if spec.default == () else _TYPES[spec.kind]
    default = '' if isinstance(spec.default, Kind) else _value_text(spec.default)
    limits = f' ({spec.limits})' if spec.limits else ''
    return f'{kind}{default and f", {default}"}: {spec.meaning}{limits}'.replace('%', '%%')


def _value_text(value: Any) -> str:
    """Return a default as it is written on the command line; empty without one."""
    if isinstance(value, list | tuple):
        return f'[{", ".join(map(_value_text, value))}]' if value else ''
    return (
        f'{value:.6g}'
        if isinstance(value, float)
        else str(value).replace(os.path.expanduser('~'), '~')
    )


@options_named()
@ended_by_closed_output()
def run(
    make_node: Callable[[], Node],
    description: str | None,
    examples: Mapping[str, str],
    work: Callable[[Any, Executor], None] = lambda _, executor: executor.spin(),
) -> int:
    """
    Run one node until SIGINT or SIGTERM, or show version or help.

    description: purpose of the node; examples: arguments of each, by its purpose.
    """
    name = Path(sys.argv[0]).name
    is_initialised = False
    interrupts: list[int] = []
    try:
        # It names a fault of a file by its place; rclpy does not.
        params_files.check_params_files()
        parser = program_parser(argparse.ArgumentParser, name, description, examples)
        parser.usage = _USAGE
        # People ask for help behind --ros-args, too.
        asked = [word for word in sys.argv if word in ('-h', '--help', '--version')]
        if asked:
            own = parameters.node_specs(sys.modules[make_node.__module__])
            for title, specs in _parameter_groups(name, own):
                group = parser.add_argument_group(title)
                for spec in specs:
                    group.add_argument(spec.name, help=_help(spec))
        parser.parse_args(asked or remove_ros_args(sys.argv)[1:])
        # rclpy's own handler ends the context; Python's would raise in the middle of a statement.
        signal.signal(signal.SIGINT, lambda number, _: interrupts.append(number))
        # No thread of this process waits longer than it must.
        sys.setswitchinterval(_SWITCH_S)
        with suppress(OSError):
            _TIMER_SLACK.write_text(_SLACK_NS)
        rclpy.init()
        is_initialised = True
        if interrupts:
            # The signal came before rclpy's handler.
            rclpy.try_shutdown()
        node = make_node()
        parameter_checks.warn_of_unused_qos(node)
        parameter_checks.explain_read_only(node)
    except Exception as error:
        if is_initialised and not rclpy.ok():
            # A signal has ended the context during the start.
            return 0
        # The errors of rclpy have no common base class, and one is in its C++ module alone.
        if not isinstance(error, UserError) and not type(error).__module__.startswith('rclpy'):
            raise
        text = re.sub(_PLACE, '', one_line(error))
        if with_colon := re.search(_WITH_COLON, text):
            text += _QUOTES.format(*with_colon.groups())
        print(f'{name}: {text}', file=sys.stderr)
        return 2 if 'ROSArgs' in type(error).__name__ else 1
    try:
        _spin(node, work)
    except Exception:
        # A launch starts the node again; a refused start, with the status 1, ends it.
        traceback.print_exc()
        return os.EX_SOFTWARE
    return 0


def _spin(node: Node, work: Callable[[Any, Executor], None]) -> None:
    """Run a node until the context ends, and close it."""
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
    finally:
        if hasattr(node, 'close'):
            node.close()
        rclpy.try_shutdown()
        # A launch passes Ctrl-C on, although the terminal has sent it too. The second signal may
        # come after Python has removed its handlers.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
