# SPDX-License-Identifier: Apache-2.0
"""Text for a terminal of 80 columns: tables, wrapped lines, bars, commands, coloured outcomes."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
import os
import re
import sys
import textwrap
from typing import Any, NamedTuple, TextIO, TypeVar

from adxl_ros.process import command, package_version, program

P = TypeVar('P', bound=argparse.ArgumentParser)
COLUMNS = 79  # Columns of a terminal that a tool uses
_NO_BREAK = '\N{NO-BREAK SPACE}'  # A blank at which no line is wrapped
_UNIT_AFTER_NUMBER = re.compile(r'(?<=\d) (?=[%°]|(?:mg|s|Hz)\b)')  # The blank before a unit
_LABEL_COLUMNS = 8  # Columns of the words before files and commands
_STEP_COLUMNS = _LABEL_COLUMNS + 3  # Columns before the purpose of one of several steps
_GREEN = '\x1b[32m'  # Code of xterm for what is good
_RED = '\x1b[31m'  # The same of what is bad
_YELLOW = '\x1b[33m'  # The same of what is not decided
_COLOURS = {
    'GAP EXPLAINED': _GREEN,
    'PARTLY EXPLAINED': _YELLOW,
    'NO GAP': _GREEN,
    'CAUSES NOT SEPARATED': _YELLOW,
    'UNKNOWN CAUSE': _RED,
    'TOO LITTLE DATA': _YELLOW,
    'BAD DATA': _RED,
    'NOT SHOWN': _YELLOW,
    'PASS': _GREEN,
    'FAIL': _RED,
    'NO': _RED,
    'not refuted': _YELLOW,
    'too few': _YELLOW,
}
"""Colours of outcomes in a terminal, those of several words first."""
_NO_COLOUR = '\x1b[0m'
_OUTCOME = re.compile(rf'\b({"|".join(_COLOURS)})\b')


class Tile(NamedTuple):
    """One figure at the top of a page."""

    label: str  # What it is
    text: str  # Its value with the unit
    note: str = ''  # A remark


class NextStep(NamedTuple):
    """Something that a user does next."""

    purpose: str  # What it is for, one sentence without a period
    command: str  # The command line that does it


def program_parser(
    kind: type[P], name: str, description: str | None, examples: Mapping[str, str]
) -> P:
    """Make the parser of an executable, which has `--help` with examples, and `--version`."""
    lines = ['examples:']
    for purpose, arguments in examples.items():
        lines += [f'  {purpose}:', *command_lines(command(name, arguments), 4 * ' ')]
    parser = kind(
        prog=program(name),
        description='\n'.join(wrapped(' '.join((description or '').split()))),
        formatter_class=partial(argparse.RawDescriptionHelpFormatter, width=COLUMNS),
        epilog='\n'.join(lines),
    )
    parser.add_argument(
        '--version',
        action='version',
        version=f'adxl_ros {package_version()}',
        help='show the version and exit',
    )
    return parser


def row(cells: Iterable[str], formats: Iterable[str | int]) -> str:
    """Return a line of a table; a format is the width of a column, `>` before it to the right."""
    return ''.join(f'{cell:{form}}' for cell, form in zip(cells, formats)).rstrip()


def wrapped(text: str, indent: int = 0, columns: int = COLUMNS) -> list[str]:
    """Wrap a text between words, but not between a number and its unit."""
    lines = textwrap.wrap(
        _UNIT_AFTER_NUMBER.sub(_NO_BREAK, text),
        columns,
        subsequent_indent=indent * ' ',
        break_long_words=False,
        break_on_hyphens=False,
    )
    return [line.replace(_NO_BREAK, ' ') for line in lines]


def entry_list(title: str, entries: Mapping[str, str]) -> str:
    """Return a list of names with their meanings."""
    width = max(map(len, entries)) + 2
    return '\n'.join(
        [
            f'{title}:',
            *(
                textwrap.fill(
                    f'  {name:{width}}{meaning}', COLUMNS, subsequent_indent=(width + 2) * ' '
                )
                for name, meaning in entries.items()
            ),
        ]
    )


def end_lines(
    result: Sequence[str],
    files: Sequence[str],
    following: str | Sequence[NextStep] = '',
    took_s: float | None = None,
) -> list[str]:
    """Return the end of what a tool prints: result, files and what to do next."""
    lines = []
    for line in result:
        lines += wrapped(line, 2) or ['']
    if files:
        took = ''
        if took_s is not None:
            took = f'  ({took_s:.0f} s)' if took_s >= 1 else '  (< 1 s)'
        lines += wrapped(
            f' {"wrote":{_LABEL_COLUMNS - 1}}{"  ".join(files)}{took}', _LABEL_COLUMNS
        )
    if isinstance(following, str):
        lines += command_lines(following, f' {"next":{_LABEL_COLUMNS - 1}}')
    else:
        for number, step in enumerate(following, 1):
            label = '' if number > 1 else 'next'
            lines += wrapped(
                f' {label:{_LABEL_COLUMNS - 1}}{number}  {step.purpose}', _STEP_COLUMNS
            )
            lines += command_lines(step.command, _STEP_COLUMNS * ' ')
    return [coloured(line) for line in lines]


def command_lines(text: str, start: str) -> list[str]:
    """Return the lines of a command behind the start of the first one; a backslash joins them."""
    if not text:
        return []
    if len(start + text) <= COLUMNS:
        return [start + text]
    # A line must not end within quotes.
    text = re.sub(r"'[^']*'", lambda quotes: quotes[0].replace(' ', _NO_BREAK), text)
    lines = textwrap.wrap(
        text,
        COLUMNS - 2,
        initial_indent=start,
        subsequent_indent=(len(start) + 2) * ' ',
        break_long_words=False,
        break_on_hyphens=False,
    )
    *first, last = [line.replace(_NO_BREAK, ' ') for line in lines]
    return [*(f'{line} \\' for line in first), last]


def bar(stream: TextIO, *columns: str | int, transient: bool = True) -> Any:
    """Return rich's `Progress`, or None if nothing can be drawn; a number is a bar so wide."""
    if not stream.isatty() or os.environ.get('TERM') == 'dumb':
        return None
    try:
        from rich import console, progress
    except ImportError:
        return None
    drawn: list[Any] = []
    for column in ('{task.description}', *columns):
        if isinstance(column, int):
            drawn.append(progress.BarColumn(column))
        elif column.isidentifier():
            drawn.append(getattr(progress, column)())
        else:
            drawn.append(progress.TextColumn(column, markup=False))
    screen = console.Console(file=stream, highlight=False, markup=False, emoji=False)
    return progress.Progress(*drawn, console=screen, transient=transient)


def coloured(line: str) -> str:
    """Colour the outcomes of a line in a terminal, but not where NO_COLOR is set."""
    if not sys.stdout.isatty() or 'NO_COLOR' in os.environ:
        return line
    return _OUTCOME.sub(lambda match: f'{_COLOURS[match[0]]}{match[0]}{_NO_COLOUR}', line)
