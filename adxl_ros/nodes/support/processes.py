# SPDX-License-Identifier: Apache-2.0

"""Processes of a job that runs executables of this package: start, stop and load."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
import os
from pathlib import Path
import signal
import subprocess
import sys

_END_S = 10.0
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
            process.wait(_END_S)
        except subprocess.TimeoutExpired:
            process.kill()


def cpu_time_s(pid: int) -> float:
    """Return the time that a process has spent on a core so far, s."""
    fields = Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1].split()
    return (int(fields[_USER_TIME]) + int(fields[_SYSTEM_TIME])) / os.sysconf('SC_CLK_TCK')
