# SPDX-License-Identifier: Apache-2.0

"""A job that runs nodes in processes of their own, and what a terminal shows of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
from tempfile import TemporaryFile
import time
from typing import IO

from adxl_ros.report.screen import bar

_KILL_S = 10.0
"""Longest time that a process may take to end, s: ten times what a node needs on a busy
machine."""
_FIRST_DOMAIN = 60
"""First ROS domain of jobs: robots use low numbers, 0 by default."""
_DOMAINS = 40
"""Number of ROS domains of jobs: the last one is 99, and 101 the last safe one on Linux."""
_BAR_WIDTH = 30  # Columns of the bar. A line with its bar has 79 columns
_NAME_WIDTH = 11  # Columns of the name of a step
_TEXT_WIDTH = 16  # Columns of the text beside a bar
_LINE_WIDTH = 69  # Columns of a line without a bar, before its time


def use_own_graph() -> None:
    """Give this job a ROS graph of its own on this machine, so that it cannot move a robot."""
    os.environ.setdefault('ROS_DOMAIN_ID', str(_FIRST_DOMAIN + os.getpid() % _DOMAINS))
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'


def executable(name: str) -> str:
    """Return the path of an executable, which stands beside the running one."""
    return str(Path(sys.argv[0]).with_name(name))


@contextmanager
def running(
    commands: Sequence[Sequence[str]], errors: int | IO[bytes] = subprocess.DEVNULL
) -> Iterator[list[subprocess.Popen]]:
    """Yield the processes of commands, and end them: interrupt, and kill what stays for 10 s."""
    processes = [subprocess.Popen(command, stderr=errors) for command in commands]
    try:
        yield processes
    finally:
        for process in processes:
            process.send_signal(signal.SIGINT)
        for process in processes:
            try:
                process.wait(_KILL_S)
            except subprocess.TimeoutExpired:
                process.kill()


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


class LiveLine:
    """Prints lines; in a terminal that can draw, a last one shows what happens now."""

    def __init__(self, *columns: str | int, total: int = 0) -> None:
        self._progress = bar(sys.stdout, *columns, transient=not columns)
        if self._progress is not None:
            self._task = self._progress.add_task('', total=total or None)
            self._progress.start()

    def add(self, *lines: str) -> None:
        """Print lines above the one that changes."""
        for line in lines:
            if self._progress is None:
                print(line, flush=True)
            else:
                self._progress.console.print(line, soft_wrap=True)

    def show(self, text: str, done: int = 0) -> None:
        """Show what happens now."""
        if self._progress is not None:
            self._progress.update(self._task, description=text, completed=done)

    def close(self) -> None:
        """Stop drawing."""
        if self._progress is not None:
            self._progress.stop()
            self._progress = None


class Step(LiveLine):
    """
    One step of a job while it runs: a line with the time and, where the total is known, a bar.

    Where nothing can be drawn, there is one line at the end.
    """

    def __init__(self, name: str, text: str, total: int = 0) -> None:
        columns = (_BAR_WIDTH, '{task.percentage:3.0f} %') if total else ()
        super().__init__(*columns, '{task.elapsed:4.0f} s', total=total)
        self._name = name
        self._begin_s = time.monotonic()
        self._width = _TEXT_WIDTH if total else _LINE_WIDTH - _NAME_WIDTH - 2
        self.show(text)

    def __enter__(self) -> Step:
        return self

    def show(self, text: str, done: int = 0) -> None:
        """Show how far the step is."""
        self._line = f' {self._name:{_NAME_WIDTH}} {text:{self._width}}'
        super().show(self._line, done)

    def __exit__(self, kind: object, *_: object) -> None:
        """Stop drawing; a step that has failed leaves no line."""
        if kind is None and self._progress is None:
            print(f'{self._line} {time.monotonic() - self._begin_s:4.0f} s', flush=True)
        self.close()
