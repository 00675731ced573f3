# SPDX-License-Identifier: Apache-2.0

"""One node as an executable: a clean start, and a clean end by a signal."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
import signal
import sys
from typing import Any, Protocol, runtime_checkable

from adxl_ros.closed_output import ended_by_closed_output
from adxl_ros.errors import UserError
from adxl_ros.nodes.support import rclpy_internals
from adxl_ros.nodes.support.node_help import NodeHelp, print_if_asked
from adxl_ros.nodes.support.params_files import check_params_files
import rclpy
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.utilities import remove_ros_args

_SWITCH_S = 0.0005
"""Time after which a thread of Python gives way to one that waits, s. Chosen: a sample that comes
while the executor works shall wait for less than its frame; Python's 5 ms are longer."""
_TIMER_SLACK = Path('/proc/self/timerslack_ns')
"""File that sets by how much the kernel may delay a wake-up of this process (man 5 proc)."""
_SLACK_NS = '1000'
"""Largest such delay, ns; chosen: far below the period of samples. The default is 50 µs."""
_USAGE = '%(prog)s [--ros-args -p NAME:=VALUE ... --params-file FILE -r FROM:=TO ...]'
"""Usage that follows an unknown argument."""


@runtime_checkable
class Closable(Protocol):
    """A node that holds something open."""

    def close(self) -> None:
        """Close it."""


@ended_by_closed_output()
def run(make_node: Callable[[], Node], node_help: NodeHelp,
        work: Callable[[Any, Executor], None] = lambda _, executor: executor.spin()) -> int:
    """Run one node until SIGINT or SIGTERM."""
    name = Path(sys.argv[0]).name
    is_initialised = False
    interrupts: list[int] = []
    try:
        # It names a fault of a file by its place; rclpy does not.
        check_params_files()
        # People ask for help behind --ros-args, too.
        if print_if_asked(sys.argv[1:], make_node, node_help):
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
        if not isinstance(error, UserError) and not rclpy_internals.is_rclpy_error(error):
            raise
        print(f'{name}: {rclpy_internals.start_error_text(error)}', file=sys.stderr)
        return 2 if rclpy_internals.is_usage_error(error) else 1
    try:
        _spin(node, work)
    finally:
        if isinstance(node, Closable):
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
