# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The last lines of a tool: its result, the files that it wrote, and the next command."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import os
from pathlib import Path
import re
import shlex
import sys
import textwrap

from adxl_ros.tools.command_line import COLUMNS

_LABEL_COLUMNS = 8
"""Columns of the words before files and commands."""
_COLOURS = {'PASS': '\x1b[32m', 'FAIL': '\x1b[31m', 'NO': '\x1b[31m', 'NOT SHOWN': '\x1b[33m',
            'not refuted': '\x1b[33m', 'too few': '\x1b[33m'}
"""Colours of outcomes in a terminal: green, red and yellow."""
_NO_COLOUR = '\x1b[0m'
_OUTCOME = re.compile(r'\b(NOT SHOWN|PASS|FAIL|NO|not refuted|too few)\b')
"""Outcomes, the longer ones first."""


def _wrapped(text: str, indent: int = 0) -> list[str]:
    """Wrap a text between words; further lines have an indent."""
    return textwrap.wrap(text, COLUMNS, subsequent_indent=indent * ' ', break_long_words=False,
                         break_on_hyphens=False)


def print_end(result: Sequence[str], files: Iterable[str | os.PathLike], next_command: str = ''
              ) -> None:
    """
    Print the end of a tool within 79 columns; outcomes are coloured in a terminal.

    Parameters
    ----------
    result
        Lines of the result; longer ones are wrapped.
    files
        The files that were written. One that does not exist is left out.
    next_command
        The command that follows; empty for none.

    """
    lines = [part for line in result for part in _wrapped(line, 2) or ['']]
    written = '  '.join(str(path) for path in files if Path(path).exists())
    if written:
        lines += _wrapped(f' {"wrote":{_LABEL_COLUMNS - 1}}{written}', _LABEL_COLUMNS)
    if next_command:
        lines += _command_lines(next_command)
    print('\n'.join(map(_coloured, lines)))


def quoted(*words: str | os.PathLike) -> str:
    """Return words of a command line as a shell reads them."""
    return shlex.join(str(word) for word in words)


def _command_lines(text: str) -> list[str]:
    """Return the lines of the next command, which continue with a backslash."""
    *first, last = textwrap.wrap(f' {"next":{_LABEL_COLUMNS - 1}}{text}', COLUMNS - 2,
                                 subsequent_indent=(_LABEL_COLUMNS + 2) * ' ',
                                 break_long_words=False, break_on_hyphens=False)
    return [*(f'{line} \\' for line in first), last]


def _coloured(line: str) -> str:
    """Colour the outcomes of a line in a terminal, but not where NO_COLOR is set."""
    if not sys.stdout.isatty() or 'NO_COLOR' in os.environ:
        return line
    return _OUTCOME.sub(lambda match: f'{_COLOURS[match[0]]}{match[0]}{_NO_COLOUR}', line)
