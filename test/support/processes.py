# SPDX-License-Identifier: Apache-2.0

"""Installed executables as processes of a test, and waits for their actions."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass
from importlib.metadata import entry_points
from io import StringIO
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import time

from ament_index_python.packages import get_package_prefix
from needs import lack
import pytest

REPO = Path(__file__).resolve().parents[2]
"""The root of the repository."""
NEEDS_ROS2 = pytest.mark.skipif(
    shutil.which('ros2') is None, reason=lack('ros2 and launch of a sourced ROS 2 Jazzy')
)
TOOLS = sorted(
    {
        point.name
        for point in entry_points(group='console_scripts')
        if point.module.startswith(('adxl_ros.tools.', 'adxl_ros_validation.'))
    }
    - {'bench'}
)
"""The command-line tools, as they are installed."""
PATIENCE = 5
"""How many times longer than on a quiet machine any action may take on a busy one."""


def wait_until(condition: Callable[[], object], timeout_s: float, purpose: str) -> None:
    """Poll `condition` until it holds; fail with `purpose` after a multiple of `timeout_s`."""
    end = time.monotonic() + PATIENCE * timeout_s
    while not condition():
        if time.monotonic() > end:
            pytest.fail(f'{purpose}: not after {PATIENCE} times {timeout_s} s')
        time.sleep(0.02)


def children(pid: int) -> list[int]:
    return [
        int(n)
        for task in Path(f'/proc/{pid}/task').iterdir()
        for n in (task / 'children').read_text().split()
    ]


@dataclass(frozen=True)
class Started:
    """A process that runs an installed executable, and the file of its output."""

    name: str
    popen: subprocess.Popen
    log: Path

    def output(self) -> str:
        return self.log.read_text(encoding='utf-8', errors='replace')

    def wait_for(self, text: str, timeout_s: float = 20.0) -> None:
        """Wait until the process has printed `text`; fail after its end or after the time."""

        def seen() -> bool:
            ended = self.popen.poll() is not None
            printed = text in self.output()
            if ended and not printed:
                pytest.fail(
                    f'{self.name} ended with {self.popen.returncode} and without '
                    f'printing {text!r}:\n{self.output()}'
                )
            return printed

        wait_until(seen, timeout_s, f'{self.name} printing {text!r}')

    def wait(self, timeout_s: float = 20.0) -> int:
        wait_until(lambda: self.popen.poll() is not None, timeout_s, f'{self.name} ending')
        return self.popen.returncode

    def interrupt(self) -> None:
        """Send SIGINT to the process and its children, if the process runs."""
        if self.popen.poll() is None:
            os.killpg(self.popen.pid, signal.SIGINT)

    def stop(self) -> int:
        """End the process and its children, first by SIGINT, and return its exit status."""
        self.interrupt()
        return self.end()

    def end(self) -> int:
        """Wait after a signal, end the process and its children, and return its exit status."""
        for number in (signal.SIGTERM, signal.SIGKILL):
            with suppress(subprocess.TimeoutExpired):
                self.popen.wait(PATIENCE * 5.0)
            if self.popen.poll() is None:
                os.killpg(self.popen.pid, number)
        with suppress(ProcessLookupError):  # children that outlived it
            os.killpg(self.popen.pid, signal.SIGKILL)
        return self.popen.wait()


def executable(name: str) -> Path:
    """Find an installed executable as `ros2 run` does."""
    return Path(get_package_prefix('adxl_ros')) / 'lib' / 'adxl_ros' / name


def run_executable(name: str, *args: object, **options: object) -> subprocess.CompletedProcess:
    return subprocess.run(
        [executable(name), *map(str, args)],
        text=True,
        capture_output=True,
        stdin=subprocess.DEVNULL,
        **{'timeout': PATIENCE * 120, **options},
    )


def run_in_process(name: str, *args: object, cwd: Path) -> subprocess.CompletedProcess:
    """
    Run a tool in this process and capture its text, which saves the second that imports take.

    test_help_and_end.py runs the installed executables.
    """
    (tool,) = entry_points(group='console_scripts', name=name)
    main = tool.load()
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    with (
        redirect_stdout(StringIO()) as out,
        redirect_stderr(StringIO()) as err,
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.chdir(cwd)
        patch.setattr(sys, 'argv', [name, *map(str, args)])
        try:
            status = main()
        except SystemExit as error:
            status = error.code
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
    return subprocess.CompletedProcess(sys.argv, status, out.getvalue(), err.getvalue())
