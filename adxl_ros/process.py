# SPDX-License-Identifier: Apache-2.0

"""What the processes of all executables share; it must load before numpy, and quickly."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache
import hashlib
from importlib.metadata import PackageNotFoundError, version
import os
from pathlib import Path
import re
import select
import shlex
import signal
import sys
from typing import Any

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
NAMES_OPTIONS = 'ADXL_ROS_NAMES_OPTIONS'
"""Environment variable of tools and nodes, and of their workers: texts name options of tools."""
_OPTIONS = {
    'certificate': 'dcc',
    'effects': 'effect',
    'quantity': 'in',
    'sensor': 'params',
}
"""Options of tools that are not called as the argument of a verb, by that argument."""
_UNQUOTED = re.compile(r'[-+]?\d[\d.]*(e[-+]?\d+)?|[A-Z]{2,}')
"""What has no quotes in Python: numbers, and words in capitals, which stand for values."""
_METHODS = ('certificate', 'report')  # Options of `fit` that are methods of its result in Python
READING = (
    'topic',
    'columns',
    'unit',
    'lsb_per_g',
    'lsb_at_0g',
    'rate',
    'axes',
    'drop_bad_stamps',
    'drop_bad_samples',
)
"""Arguments of `read`, which are options of the tools that read recordings."""
_READER = ContextVar('reader', default='read or from_arrays')
"""What reads recordings, as texts in Python call it."""


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


@contextmanager
def read_by(verb: str) -> Iterator[None]:
    """Let texts name the verb that reads a recording; others do not know it."""
    token = _READER.set(verb)
    try:
        yield
    finally:
        _READER.reset(token)


@contextmanager
def options_named() -> Iterator[None]:
    """Let texts name options of tools, because a tool or a node is running."""
    before = os.environ.get(NAMES_OPTIONS)
    os.environ[NAMES_OPTIONS] = '1'
    try:
        yield
    finally:
        del os.environ[NAMES_OPTIONS]
        if before:
            os.environ[NAMES_OPTIONS] = before


def names_options() -> bool:
    """Return whether a tool or a node is running, and no program in Python."""
    return NAMES_OPTIONS in os.environ


def option(*names: str, **values: Any) -> str:
    """
    Return how a text names what its reader may give: `--unit g` to a tool, `unit='g'` to a verb.

    names: what is named without a value; values: True for a switch, a list for an option that may
    be repeated. Both have the names of the arguments in Python.
    """
    given = {**dict.fromkeys(names), **values}
    if names_options():
        return ' '.join(_of_tool(name, value) for name, value in given.items())
    arguments = _arguments(given)
    # Other verbs take recordings as they were read.
    return f'{_READER.get()}(..., {arguments})' if given.keys() <= {*READING} else arguments


def usage(verb: str, *inputs: str, **values: Any) -> str:
    """Return how a verb is used with an option: `fit --means` as a tool, `fit(means=True)`."""
    if names_options():
        return ' '.join((verb, *inputs, option(**values)))
    return f'{verb}({", ".join((*map(repr, inputs), _arguments(values)))})'


def pasted(columns: str, **values: Any) -> str:
    """Return options with a mapping of columns, which a shell or Python reads as they are."""
    if names_options():
        quoted = shlex.quote(columns)
        columns = quoted if quoted != columns else f"'{columns}'"
    return option(columns=columns, **values)


def _of_tool(name: str, value: Any) -> str:
    """Return an option of a tool."""
    flag = f'--{_OPTIONS.get(name, name).replace("_", "-")}'
    if isinstance(value, list):
        return ' '.join(f'{flag} {each}' for each in value)
    return flag if value is None or value is True else f'{flag} {value}'


def _arguments(given: Mapping[str, Any]) -> str:
    """Return arguments of a verb."""
    return ', '.join(_of_verb(name, value) for name, value in given.items())


def _of_verb(name: str, value: Any) -> str:
    """Return an argument of a verb, or a method of its result."""
    text = '' if value is None else repr(value)
    if _UNQUOTED.fullmatch(str(value)):
        text = str(value)
    return f'{name}({text})' if name in _METHODS else f'{name}={text}'


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
