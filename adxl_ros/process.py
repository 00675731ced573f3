# SPDX-License-Identifier: Apache-2.0

"""What the processes of all executables share; it must load before numpy, and quickly."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
import hashlib
from importlib.metadata import PackageNotFoundError, version
import os
from pathlib import Path
import select
import signal
import sys

from adxl_ros.wording import option as option, usage as usage

NODES = (
    'driver',
    'stage',
    'calibration',
    'compensation',
    'keep_calibrated',
    'investigate',
    'monitor',
    'screen',
)
"""The nodes, which set a handler of SIGINT of their own once they have loaded."""
STARTED_BY = 'ADXL_ROS_COMMAND'
"""Environment variable with the words before the name of a tool, as its user wrote them."""
ONE_COMMAND = 'adxl_ros'  # The command of a package that pip has installed


def release_version() -> str:
    """Return the version of this package; 'unknown' when it runs from its source."""
    try:
        return version('adxl_ros')
    except PackageNotFoundError:
        return 'unknown'


@lru_cache(maxsize=1)
def package_version() -> str:
    """Return version and commit, '0.1.0 (1a2b3c4)'; the commit is known to builds from git."""
    try:
        commit = Path(__file__).with_name('commit.txt').read_text('utf-8').strip()
    except FileNotFoundError:
        return release_version()
    return f'{release_version()} ({commit})'


@lru_cache(maxsize=1)
def code_version() -> str:
    """Return the SHA-256 of version and code of this package."""
    code = [
        path.name.encode() + path.read_bytes()
        for path in sorted(Path(__file__).parent.rglob('*.py'))
    ]
    return hashlib.sha256(release_version().encode() + b''.join(code)).hexdigest()


def program(tool: str) -> str:
    """Return how messages call a tool: with the one command, where it was started by that."""
    started_by = os.environ.get(STARTED_BY, '')
    return f'{started_by} {tool}' if started_by.endswith(ONE_COMMAND) else tool


def command(tool: str, arguments: str = '') -> str:
    """Return the command line that runs a tool in the way in which this process was started."""
    usual = 'ros2 run adxl_ros' if 'AMENT_PREFIX_PATH' in os.environ else 'adxl_ros'
    return f'{os.environ.get(STARTED_BY, usual)} {tool} {arguments}'.rstrip()


def use_one_thread() -> None:
    """
    Keep OpenBLAS to one thread, unless the user chooses a number; call it before numpy is loaded.

    On busy cores its threads wait for each other: a fit of 614 poses took 35 s instead of 2 s.
    """
    os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')


def end_silently_while_loading() -> None:
    """Let SIGINT end a node that loads without a traceback; others keep their handler."""
    path = Path(sys.argv[0])
    is_node = path.name in NODES and path.parent.parts[-2:] == ('lib', 'adxl_ros')
    if is_node and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)


@contextmanager
def ended_by_closed_output() -> Iterator[None]:
    """End with status 1 and without a message when the reader of stdout is gone (`| head -1`)."""
    try:
        try:
            yield
        finally:
            if sys.stdout is not None:
                sys.stdout.flush()
    except BrokenPipeError:
        poll = select.poll()
        poll.register(sys.stdout, 0)
        # A pipe to another process that breaks is an error.
        if not any(event & select.POLLERR for _, event in poll.poll(0)):
            raise
        # Python flushes once more at exit, and would report the pipe then.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
