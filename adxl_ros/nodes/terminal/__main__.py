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

"""The process that draws the screen and reads the keys; `terminal_process` starts it."""

from __future__ import annotations

from collections import deque
from contextlib import suppress
import os
import re
import select
import signal
import socket
import sys
import termios
import time
from typing import Any

from adxl_ros.calibrate.guided.screen_contents import ScreenContents
from adxl_ros.nodes.terminal.draw import draw
from adxl_ros.nodes.terminal.keys import Keys

_FRAME_S = 0.2
"""Shortest time between two drawings, s: the node sends contents five times a second."""
_KEPT_LINES = 1000
"""Log lines that are kept for the terminal after the screen."""
_LONGEST_MESSAGE = 1 << 20
"""Largest message of contents, bytes; chosen: far above any contents."""
_LOG_BYTES = 65536
"""Most bytes of one read of the log, those of a pipe."""
_KEY_BYTES = 64
"""Most bytes of one read of the keys; chosen: many keys."""
_LOCAL_MODES = 3
"""Place of the local modes (echo, line by line) in the attributes of `termios`."""
_CONTROL_CHARACTERS = 6
"""Place of the control characters in the attributes of `termios`."""
_ESCAPES = re.compile(r'\x1b\[[0-9;]*m')
"""Colours in a line of the log."""


class Log:
    """
    Lines that arrive in pieces.

    Parameters
    ----------
    fd
        The file descriptor of the pipe.

    """

    def __init__(self, fd: int) -> None:
        self.lines: deque[str] = deque(maxlen=_KEPT_LINES)
        self._fd, self._rest = fd, b''

    def fileno(self) -> int:
        """Return the file descriptor, for `select`."""
        return self._fd

    def read(self) -> bool:
        """Take the waiting lines; return False at the end of the pipe."""
        with suppress(BlockingIOError):
            data = os.read(self._fd, _LOG_BYTES)
            if not data:
                return False
            *lines, self._rest = (self._rest + data).split(b'\n')
            self.lines.extend(_ESCAPES.sub('', line.decode(errors='replace')) for line in lines)
        return True


def run(talk: socket.socket, log: Log) -> None:
    """
    Draw and read keys until the node has ended, or a signal comes.

    Parameters
    ----------
    talk
        The socket to the node: contents come in, keys go out.
    log
        Lines of the node's log.

    """
    from rich.console import Console
    from rich.live import Live

    ended: list[bool] = []
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: ended.append(True))
    contents = ScreenContents('idle', 'starting')
    console = Console()
    drawn_s, keys = 0.0, Keys()
    sources: list[Any] = [talk, log, sys.stdin]
    with Live(console=console, screen=True, auto_refresh=False) as live:
        while not ended:
            ready = _ready(sources)
            if log in ready and not log.read():
                sources.remove(log)
            if talk in ready:
                data = _newest(talk)
                if data is None:
                    return
                if data:
                    contents = ScreenContents.from_bytes(data)
            if sys.stdin in ready and not _pass_keys(talk, keys):
                return
            if time.monotonic() - drawn_s > _FRAME_S:
                drawn_s = time.monotonic()
                live.update(draw(contents, list(log.lines), console.size), refresh=True)


def _ready(sources: list[Any]) -> list[Any]:
    return select.select(sources, [], [], _FRAME_S)[0]


def _newest(talk: socket.socket) -> bytes | None:
    """Return the newest message, b'' where there is none; None when the node has ended."""
    newest = b''
    with suppress(BlockingIOError):
        while True:
            try:
                data = talk.recv(_LONGEST_MESSAGE)
            except ConnectionError:
                return None
            if not data:
                return None
            newest = data
    return newest


def _pass_keys(talk: socket.socket, keys: Keys) -> bool:
    """Send the pressed keys to the node; return False when the terminal has ended."""
    try:
        data = os.read(sys.stdin.fileno(), _KEY_BYTES)
    except OSError:
        return False
    for key in keys.read(data, time.monotonic()):
        with suppress(OSError):
            talk.send(key.encode())
    return bool(data)


def _read_single_keys(terminal: int) -> None:
    """Let a terminal pass on each key at once, without an echo and without stop and quit."""
    attributes = termios.tcgetattr(terminal)
    attributes[_LOCAL_MODES] &= ~(termios.ICANON | termios.ECHO)
    # These keys would stop the node in the middle of a sweep and leave the screen behind.
    for name in (termios.VSUSP, termios.VQUIT):
        attributes[_CONTROL_CHARACTERS][name] = b'\0'
    termios.tcsetattr(terminal, termios.TCSANOW, attributes)


def main() -> int:
    """Run the process: arguments are the numbers of its socket and of the log's pipe."""
    # Ctrl-C is for the node; this process ends when the node has ended.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    talk = socket.socket(fileno=int(sys.argv[1]))
    talk.setblocking(False)
    log = Log(int(sys.argv[2]))
    os.set_blocking(log.fileno(), False)
    terminal = sys.stdin.fileno()
    saved = termios.tcgetattr(terminal)
    _read_single_keys(terminal)
    try:
        run(talk, log)
    finally:
        with suppress(OSError, termios.error):
            termios.tcsetattr(terminal, termios.TCSANOW, saved)
        log.read()
        with suppress(OSError):
            print('\n'.join(log.lines), flush=True)
    return 0


if __name__ == '__main__':
    sys.exit(main())
