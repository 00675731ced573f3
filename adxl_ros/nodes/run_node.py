# SPDX-License-Identifier: Apache-2.0

"""One node as an executable, and the processes of a job that runs several."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
from tempfile import TemporaryFile
from typing import Any, Protocol, runtime_checkable

from adxl_ros.closed_output import ended_by_closed_output
from adxl_ros.errors import UserError
from adxl_ros.nodes import rclpy_internals
from adxl_ros.nodes.node_help import NodeHelp, print_if_asked
from adxl_ros.nodes.parameters import check_params_files
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


_KILL_S = 10.0
"""Longest time that a process may take to end, s; chosen: a node ends within 1 s."""
_FIRST_DOMAIN = 60
"""First ROS domain of jobs; chosen: beyond those that robots use."""
_DOMAINS = 40
"""Number of ROS domains of jobs; chosen: the last one is below 101, the last safe one."""
_USER_TIME = 11
"""Place of the user time in /proc/PID/stat, from 0, behind the command's name (man 5 proc)."""
_SYSTEM_TIME = 12
"""Place of the system time, counted in the same way."""


def use_own_graph() -> None:
    """Give this job a ROS graph of its own on this machine, so that it cannot move a robot."""
    os.environ.setdefault('ROS_DOMAIN_ID', str(_FIRST_DOMAIN + os.getpid() % _DOMAINS))
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'


def executable(name: str) -> str:
    """Return the path of an executable, which stands beside the running one."""
    return str(Path(sys.argv[0]).with_name(name))


@contextmanager
def running(commands: Sequence[Sequence[str]]) -> Iterator[list[subprocess.Popen]]:
    """Yield the processes of commands, without their error output, and stop them at the end."""
    processes = [subprocess.Popen(command, stderr=subprocess.DEVNULL) for command in commands]
    try:
        yield processes
    finally:
        stop(processes)


def stop(processes: Sequence[subprocess.Popen]) -> None:
    """Interrupt processes, and kill those that do not end within 10 s."""
    for process in processes:
        process.send_signal(signal.SIGINT)
    for process in processes:
        try:
            process.wait(_KILL_S)
        except subprocess.TimeoutExpired:
            process.kill()


def cpu_time_s(pid: int) -> float:
    """Return the time that a process has spent on a core so far, s."""
    fields = Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1].split()
    return (int(fields[_USER_TIME]) + int(fields[_SYSTEM_TIME])) / os.sysconf('SC_CLK_TCK')


@contextmanager
def held_output() -> Iterator[None]:
    """Keep what this process prints, and print it at the end: lines would tear the screen."""
    _flush()
    with TemporaryFile() as file:
        originals = {stream: os.dup(stream) for stream in (1, 2)}
        for stream in originals:
            os.dup2(file.fileno(), stream)
        try:
            yield
        finally:
            _flush()
            for stream, original in originals.items():
                os.dup2(original, stream)
                os.close(original)
            file.seek(0)
            with suppress(OSError):
                shutil.copyfileobj(file, sys.stderr.buffer)
            _flush()


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        # A terminal that has hung up takes nothing.
        with suppress(OSError):
            stream.flush()
