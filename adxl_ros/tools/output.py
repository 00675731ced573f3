# SPDX-License-Identifier: Apache-2.0

"""What the tools print: exit status, messages, progress, and the last lines."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
import os
from pathlib import Path
import re
import shlex
import signal
import sys
import textwrap
from types import FrameType
from typing import NamedTuple, Protocol

from adxl_ros.closed_output import ended_by_closed_output
from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import Recording
from adxl_ros.tools.command_line import COLUMNS

_NO_BREAK = '\N{NO-BREAK SPACE}'
"""A blank at which no line is wrapped."""

_LABEL_COLUMNS = 8
"""Columns of the words before files and commands."""
_STEP_COLUMNS = _LABEL_COLUMNS + 3
"""Columns before the purpose of one of several steps."""
_GREEN, _RED, _YELLOW = '\x1b[32m', '\x1b[31m', '\x1b[33m'
"""Codes of xterm: good, bad, and not decided."""
_COLOURS = {'GAP EXPLAINED': _GREEN, 'PARTLY EXPLAINED': _YELLOW, 'NO GAP': _GREEN,
            'CAUSES NOT SEPARATED': _YELLOW, 'UNKNOWN CAUSE': _RED,
            'TOO LITTLE DATA': _YELLOW, 'BAD DATA': _RED, 'NOT SHOWN': _YELLOW,
            'PASS': _GREEN, 'FAIL': _RED, 'NO': _RED,
            'not refuted': _YELLOW, 'too few': _YELLOW}
"""Colours of outcomes in a terminal, those of several words first."""
_NO_COLOUR = '\x1b[0m'
_OUTCOME = re.compile(rf'\b({"|".join(_COLOURS)})\b')


class NextStep(NamedTuple):
    """Something that a user does next."""

    purpose: str  # What it is for, one sentence without a period
    command: str  # The command line that does it


def wrapped(text: str, indent: int = 0) -> list[str]:
    """Wrap a text between words."""
    return textwrap.wrap(text, COLUMNS, subsequent_indent=indent * ' ', break_long_words=False,
                         break_on_hyphens=False)


def print_end(result: Sequence[str], files: Iterable[str | os.PathLike],
              following: str | Sequence[NextStep] = '', took_s: float | None = None) -> None:
    """Print the end of a tool within 79 columns; outcomes are coloured in a terminal."""
    lines = [part for line in result for part in wrapped(line, 2) or ['']]
    written = '  '.join(str(path) for path in files if Path(path).exists())
    if written:
        written += _duration_text(took_s)
        lines += wrapped(f' {"wrote":{_LABEL_COLUMNS - 1}}{written}', _LABEL_COLUMNS)
    if isinstance(following, str):
        lines += _command_lines(following, f' {"next":{_LABEL_COLUMNS - 1}}')
    else:
        lines += _step_lines(following)
    print('\n'.join(map(_coloured, lines)))


def _duration_text(took_s: float | None) -> str:
    """Return a run time in brackets; a no-break space keeps number and unit in one line."""
    if took_s is None:
        return ''
    duration = '< 1' if took_s < 1 else f'{took_s:.0f}'
    return f'  ({duration} s)'.replace(' s)', '\N{NO-BREAK SPACE}s)')


def quoted(*words: str | os.PathLike) -> str:
    """Return words of a command line as a shell reads them."""
    return shlex.join(str(word) for word in words)


def _step_lines(steps: Sequence[NextStep]) -> list[str]:
    """Return numbered steps, each with its command below its purpose."""
    lines = []
    for number, step in enumerate(steps, 1):
        label = '' if number > 1 else 'next'
        lines += wrapped(f' {label:{_LABEL_COLUMNS - 1}}{number}  {step.purpose}', _STEP_COLUMNS)
        lines += _command_lines(step.command, _STEP_COLUMNS * ' ')
    return lines


def _command_lines(text: str, start: str) -> list[str]:
    """Return the lines of a command behind the start of the first one; a backslash joins them."""
    if not text:
        return []
    if len(start + text) <= COLUMNS:
        return [start + text]
    # A line must not end within quotes.
    text = re.sub(r"'[^']*'", lambda quotes: quotes[0].replace(' ', _NO_BREAK), text)
    lines = textwrap.wrap(text, COLUMNS - 2, initial_indent=start,
                          subsequent_indent=(len(start) + 2) * ' ',
                          break_long_words=False, break_on_hyphens=False)
    *first, last = [line.replace(_NO_BREAK, ' ') for line in lines]
    return [*(f'{line} \\' for line in first), last]


def _coloured(line: str) -> str:
    """Colour the outcomes of a line in a terminal, but not where NO_COLOR is set."""
    if not sys.stdout.isatty() or 'NO_COLOR' in os.environ:
        return line
    return _OUTCOME.sub(lambda match: f'{_COLOURS[match[0]]}{match[0]}{_NO_COLOUR}', line)


_UNITS = {'rad': 'rad', 'm': 'm', 'c': 'degC', 'v': 'V'}
"""Units of references by the end of their columns' names."""
_BAR_COLUMNS = 24
"""Columns of a progress bar: names of stages and times stand beside it in 80 columns."""


@ended_by_closed_output()
def run(parser: argparse.ArgumentParser, command: Callable[[argparse.Namespace], int]) -> int:
    """Parse the command line and run a tool."""
    signal.signal(signal.SIGTERM, _terminated)
    try:
        return command(parser.parse_args())
    except UserError as error:
        note(f'{parser.prog}: {" ".join(str(error).split())}', error.paste)
        return 1
    except KeyboardInterrupt:
        note(f'{parser.prog}: interrupted; nothing was written')
        return 130


def note(text: str, paste: str = '') -> None:
    """Print a message on stderr: one line, which a terminal gets wrapped between words."""
    if sys.stderr.isatty():
        text = textwrap.fill(text.removesuffix(paste), COLUMNS, subsequent_indent='  ',
                             break_long_words=False, break_on_hyphens=False)
        text += f'\n{paste}' * bool(paste)
    print(text, file=sys.stderr)


def _terminated(number: int, frame: FrameType | None) -> None:
    """End by an exception, so that unfinished files are removed."""
    sys.exit(128 + number)


def make_folder(folder: Path) -> None:
    """Create a folder for the output of a tool, if it does not exist."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f'{folder}: cannot be made: {error.strerror}') from None


def report_reading(tool: str, recording: Recording) -> None:
    """Report on stderr what was assumed in reading, the cut, and the alignment of references."""
    for line in (*recording.remarks, *[recording.cut] * bool(recording.cut)):
        note(f'{tool}: {line}')
    for name, alignment in recording.alignments.items():
        # References with the stamps of the samples need no alignment.
        if alignment.gap_s:
            unit = _UNITS[name.rsplit('_', 1)[1]]
            note(f'{tool}: {recording.path}: {name} aligned by its stamps: residual '
                 f'{alignment.residual:.3g} {unit} rms, nearest message at most '
                 f'{alignment.gap_s:.3g} s away')


class ShowDone(Protocol):
    """Shows how much is done."""

    def __call__(self, done: float, stage: str = '') -> None:
        """Show a fraction."""


def _show_nothing(done: float, stage: str = '') -> None:
    """Show nothing; see `ShowDone`."""


@contextmanager
def progress(title: str) -> Iterator[ShowDone]:
    """Show a progress bar on a terminal where rich is installed, else nothing."""
    try:
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            Progress,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )
    except ImportError:
        yield _show_nothing
        return
    console = Console(stderr=True)
    columns = (TextColumn('{task.description}'), BarColumn(_BAR_COLUMNS),
               TextColumn('{task.percentage:3.0f} %'), TimeElapsedColumn(),
               TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True,
                  disable=not console.is_terminal) as bar:
        task = bar.add_task(title, total=1.0)

        def show(done: float, stage: str = '') -> None:
            """Show a fraction; see `ShowDone`."""
            # A plan that grows does not take the bar back.
            bar.update(task, completed=max(done, bar.tasks[task].completed),
                       description=stage or title)

        yield show


@contextmanager
def staged_progress(work: Mapping[str, float]) -> Iterator[Callable[[str, float], None]]:
    """Show a progress bar over stages of different length, as `progress` does."""
    names, total = list(work), sum(work.values())
    with progress(f'1/{len(names)} {names[0]}') as show:
        def show_stage(stage: str, share: float = 0.0) -> None:
            number = names.index(stage)
            before = sum(work[name] for name in names[:number])
            show((before + share * work[stage]) / total,
                 f'{number + 1}/{len(names)} {stage}')

        yield show_stage
