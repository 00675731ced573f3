# SPDX-License-Identifier: Apache-2.0

"""The steps of a job in a terminal: name, progress and time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import os
import sys
import time
from typing import Any

_BAR_WIDTH = 30
"""Columns of the bar. A line with its bar has 79 columns."""
_NAME_WIDTH = 11
"""Columns of the name of a step."""
_TEXT_WIDTH = 16
"""Columns of the text beside a bar."""
_LINE_WIDTH = 69
"""Columns of a line without a bar, before its time."""
_TENTHS = 10
"""Largest number of lines of a step where there is no terminal."""


@contextmanager
def step(name: str, text: str, total: int = 0) -> Iterator[Step]:
    """
    Show one step of a job while it runs.

    A terminal shows one line with the time and, where the total is known, a bar. Elsewhere, and
    without rich, there is a line for each tenth of the total and one at the end.
    """
    shown = Step(name, text, total)
    try:
        yield shown
        shown.end()
    finally:
        shown.close()


def drawable() -> bool:
    """Return whether stdout is a terminal that can draw, and rich is installed."""
    if not sys.stdout.isatty() or os.environ.get('TERM') == 'dumb':
        return False
    try:
        import rich  # noqa: F401
    except ImportError:
        return False
    return True


class Step:
    """One step, wherever it is shown."""

    def __init__(self, name: str, text: str, total: int) -> None:
        self._name, self._text, self._total, self._done = name, text, total, 0
        self._begin_s, self._tenth = time.monotonic(), 0
        self._bar: Any = None
        if drawable():
            self._bar = self._drawn()

    def _drawn(self) -> Any:
        """Draw a line again ten times a second, also while the caller waits."""
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn
        columns: list[Any] = [TextColumn('{task.description}', markup=False)]
        if self._total:
            columns += [BarColumn(_BAR_WIDTH), TextColumn('{task.percentage:3.0f} %')]
        bar = Progress(*columns, TextColumn('{task.elapsed:4.0f} s'),
                       console=Console(file=sys.stdout, highlight=False))
        self._task = bar.add_task(self._line(), total=self._total or None)
        bar.start()
        return bar

    def show(self, text: str, done: int = 0) -> None:
        """Show how far the step is: a line for each tenth where nothing is drawn."""
        self._text, self._done = text, done
        if self._bar is not None:
            self._bar.update(self._task, description=self._line(),
                             completed=done if self._total else None)
            return
        tenth = _TENTHS * done // self._total if self._total else 0
        if self._tenth < tenth < _TENTHS:
            self._print()
        self._tenth = max(tenth, self._tenth)

    def end(self) -> None:
        """Show that the step has succeeded."""
        if self._bar is None:
            self._print()

    def close(self) -> None:
        """Stop drawing, whether it has succeeded or not."""
        if self._bar is not None:
            self._bar.stop()

    def _print(self) -> None:
        share = f' {100 * self._done / self._total:3.0f} %' if self._total else ''
        print(f'{self._line()}{share} {time.monotonic() - self._begin_s:4.0f} s', flush=True)

    def _line(self) -> str:
        """Return name and text of the step, with spaces up to the bar or the time."""
        width = _TEXT_WIDTH if self._total else _LINE_WIDTH - _NAME_WIDTH - 2
        return f' {self._name:{_NAME_WIDTH}} {self._text:{width}}'
