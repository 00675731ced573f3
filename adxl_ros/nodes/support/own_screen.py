# SPDX-License-Identifier: Apache-2.0
"""The screen that the calibration node starts in its own terminal."""

from __future__ import annotations

from contextlib import ExitStack, suppress
import os
import signal
import subprocess
import sys
import termios

from adxl_ros.nodes.support.held_output import held_output
from adxl_ros.nodes.support.processes import executable

_END_S = 5.0
"""Longest wait for the end of the screen, s; chosen: far above its usual end."""
_RESET = b'\x1b[?1049l\x1b[?2004l\x1b[?25h\x1b[0m'
"""Leaves alternate screen and bracketed paste and shows the cursor, by the codes of xterm."""


def open_screen(node_name: str) -> tuple[OwnScreen | None, str]:
    """Start a screen if this process has a terminal."""
    is_terminal = all(stream and stream.isatty() for stream in (sys.stdin, sys.stdout))
    if not is_terminal or os.environ.get('TERM') == 'dumb' or _in_background():
        return None, ''
    try:
        import prompt_toolkit  # noqa: F401
    except ImportError:
        return None, 'no screen, plain lines: it needs prompt_toolkit; pip install prompt_toolkit'
    return OwnScreen(node_name), ''


def _in_background() -> bool:
    """Return whether this process is a background job of its terminal."""
    try:
        return os.tcgetpgrp(sys.stdin.fileno()) != os.getpgrp()
    except OSError:
        # A terminal that does not control this process has no background.
        return False


class OwnScreen:
    """A process of the executable `screen`, which draws where this process would print."""

    def __init__(self, node_name: str) -> None:
        self._saved = termios.tcgetattr(sys.stdin.fileno())
        # Ctrl-C during the start is for the node. The screen inherits the mask.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        self._process = subprocess.Popen([
            sys.executable, executable('screen'), '--ros-args', '-p', f'node:={node_name}', '-p',
            f'node_pid:={os.getpid()}'])
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        self._output = ExitStack()
        self._output.enter_context(held_output())

    def alive(self) -> bool:
        """Return whether the process of the screen still runs."""
        return self._process.poll() is None

    def close(self) -> None:
        """End the screen, restore the terminal if the screen did not, and print what was held."""
        self._process.terminate()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.returncode < 0:
            with suppress(OSError, termios.error):
                os.write(sys.stdin.fileno(), _RESET)
                termios.tcsetattr(sys.stdin.fileno(), termios.TCSANOW, self._saved)
        self._output.close()
