# SPDX-License-Identifier: Apache-2.0

"""How texts name what their reader may give: options of tools, or arguments of verbs."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
import os
import re
import shlex
from typing import Any, NamedTuple

NAMES_OPTIONS = 'ADXL_ROS_NAMES_OPTIONS'
"""
Environment variable that is set while a tool or a node runs: texts name options.

Workers inherit it. Without it a program in Python runs, and texts name arguments.
"""


class _Argument(NamedTuple):
    """How an argument differs from the rule: a verb takes `its_name=`, and a tool `--its-name`."""

    option: str = ''  # Option of the tools
    in_python: str = '{}={}'  # Name and value for a verb, or for a method of its result
    is_of_read: bool = False  # Whether `read` or `from_arrays` takes it before the verb


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
_METHOD = '{}({})'
_ARGUMENTS = {
    **dict.fromkeys(READING, _Argument(is_of_read=True)),
    'certificate': _Argument('--dcc', _METHOD),
    'report': _Argument(in_python=_METHOD),
    'effects': _Argument('--effect'),
    'quantity': _Argument('--in'),
    'sensor': _Argument('--params'),
}
"""Arguments that differ from the rule, by name."""
_UNQUOTED = re.compile(r'[-+]?\d[\d.]*(e[-+]?\d+)?|[A-Z]{2,}')
"""Values without quotes in Python: numbers, and words in capitals, which stand for values."""


@contextmanager
def options_named() -> Iterator[None]:
    """Let texts name options, because a tool or a node is running."""
    is_inner = names_options()
    os.environ[NAMES_OPTIONS] = '1'
    try:
        yield
    finally:
        if not is_inner:
            del os.environ[NAMES_OPTIONS]


def names_options() -> bool:
    """Return whether texts name options, and no arguments."""
    return NAMES_OPTIONS in os.environ


def option(*names: str, **values: Any) -> str:
    """
    Return how a text names what its reader may give: `--unit g` to a tool, `unit='g'` to a verb.

    names: what is named without a value; values: True for a switch, a list for an option that may
    be repeated. Both have the names of the arguments in Python.
    """
    given = {**dict.fromkeys(names), **values}
    if names_options():
        return _options(given)
    arguments = _arguments(given)
    is_of_read = all(_argument(name).is_of_read for name in given)
    return f'read or from_arrays(..., {arguments})' if is_of_read else arguments


def usage(verb: str, *inputs: str, **values: Any) -> str:
    """Return how a verb is used with an option: `fit --means` as a tool, `fit(means=True)`."""
    if names_options():
        return ' '.join((verb, *inputs, _options(values)))
    return f'{verb}({", ".join((*map(repr, inputs), _arguments(values)))})'


def pasted(columns: str, **values: Any) -> str:
    """Return options with a mapping of columns, which a shell or Python reads as they are."""
    if names_options():
        quoted = shlex.quote(columns)
        columns = quoted if quoted != columns else f"'{columns}'"
    return option(columns=columns, **values)


def _argument(name: str) -> _Argument:
    """Return how an argument differs from the rule."""
    return _ARGUMENTS.get(name, _Argument())


def _options(given: Mapping[str, Any]) -> str:
    """Return values by argument as options of a tool."""
    words: list[str] = []
    for name, value in given.items():
        flag = _argument(name).option or f'--{name.replace("_", "-")}'
        if isinstance(value, list):
            words += [f'{flag} {each}' for each in value]
        else:
            words.append(flag if value is None or value is True else f'{flag} {value}')
    return ' '.join(words)


def _arguments(given: Mapping[str, Any]) -> str:
    """Return values by argument as Python has them; a result has them in parentheses."""
    words: list[str] = []
    for name, value in given.items():
        text = '' if value is None else repr(value)
        if _UNQUOTED.fullmatch(str(value)):
            text = str(value)
        words.append(_argument(name).in_python.format(name, text))
    return ', '.join(words)
