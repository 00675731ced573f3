# SPDX-License-Identifier: Apache-2.0

"""The argument parsers of the tools: examples, list of effects, and version in each help text."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping
import shutil
import textwrap
from typing import Any

from adxl_ros.model.effects.base import Effect

COLUMNS = 79
"""Columns of a terminal that a tool uses."""


class _HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Keeps the lines of the epilog, and all lines within `COLUMNS`."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, width=min(shutil.get_terminal_size().columns - 2, COLUMNS))


class _ShowVersion(argparse.Action):
    """Prints the version and ends; only then it is looked up, which takes its time."""

    def __init__(self, option_strings: list[str], dest: str, **options: Any) -> None:
        super().__init__(option_strings, argparse.SUPPRESS, nargs=0, **options)

    def __call__(self, parser: argparse.ArgumentParser, namespace: argparse.Namespace,
                 values: Any, option_string: str | None = None) -> None:
        from adxl_ros.files.package_version import package_version
        print(f'adxl_ros {package_version()}')
        parser.exit()


class _Parser(argparse.ArgumentParser):
    """A parser whose epilog is made for the help text only; effects may fail to load."""

    details: Callable[[], str] | None = None

    def format_help(self) -> str:
        if self.details is not None:
            self.epilog, self.details = f'{self.epilog}\n\n{self.details()}', None
        return super().format_help()


def argument_parser(tool: str, description: str | None, examples: Mapping[str, str],
                    details: Callable[[], str] | None = None) -> argparse.ArgumentParser:
    """Make the parser of a tool, which has `--help` with examples, and `--version`."""
    lines = [f'  {purpose}:\n    {command(tool, arguments)}'
             for purpose, arguments in examples.items()]
    parse = _Parser(
        prog=tool, description=textwrap.fill(' '.join((description or '').split()), COLUMNS),
        formatter_class=_HelpFormatter, epilog='\n'.join(['examples:', *lines]))
    parse.details = details
    parse.add_argument('--version', action=_ShowVersion, help='show the version and exit')
    return parse


def command(tool: str, arguments: str) -> str:
    """Return the command line that runs a tool, for examples and next steps."""
    return f'ros2 run adxl_ros {tool} {arguments}'


def effect_list(effects: Iterable[Effect]) -> str:
    """Return a list of effects with their causes for a help text, by name."""
    causes = {effect.name: effect.cause.partition(';')[0].rstrip('.') for effect in effects}
    return entry_list('effects', dict(sorted(causes.items())))


def entry_list(title: str, entries: Mapping[str, str]) -> str:
    """Return a list for a help text."""
    width = max(map(len, entries)) + 2
    return '\n'.join([f'{title}:', *(
        textwrap.fill(f'  {name:{width}}{meaning}', COLUMNS, subsequent_indent=(width + 2) * ' ')
        for name, meaning in entries.items())])
