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

"""
The terminal, from the side of the node whose contents it shows.

A process of its own draws and reads the keys: neither delays the samples, and it restores the
terminal even when the node is killed. Both talk over a socket that never blocks. Log lines go to
the screen meanwhile, and into the terminal at its end.
"""

from __future__ import annotations

from contextlib import suppress
import os
import socket
import subprocess
import sys
import termios

from adxl_ros.calibrate.guided.screen_contents import ScreenContents

_WAIT_S = 5.0
"""Longest wait for the end of the screen, s; chosen: far above its usual end."""
RESET = '\x1b[?1049l\x1b[?25h\x1b[0m'
"""Leaves the alternate screen and shows the cursor, by the codes of xterm."""


def open_terminal() -> tuple[Terminal | None, str]:
    """Return a screen and '', or None and what must be installed, '' if there is no terminal."""
    is_terminal = all(stream and stream.isatty() for stream in (sys.stdin, sys.stdout))
    if not is_terminal or os.environ.get('TERM') == 'dumb' or _in_background():
        return None, ''
    try:
        import rich  # noqa: F401
    except ImportError:
        return None, 'no screen, plain lines: it needs rich; pip install rich'
    return Terminal(), ''


def _in_background() -> bool:
    """Return whether this process is a background job of its terminal."""
    try:
        return os.tcgetpgrp(sys.stdin.fileno()) != os.getpgrp()
    except OSError:
        # A terminal that does not control this process has no background.
        return False


class Terminal:
    """A screen in the terminal of this process."""

    def __init__(self) -> None:
        self._saved = termios.tcgetattr(sys.stdin.fileno())
        self._socket, screen_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        read, write = os.pipe()
        self._process = subprocess.Popen(
            [sys.executable, '-m', 'adxl_ros.nodes.terminal', str(screen_end.fileno()), str(read)],
            pass_fds=(screen_end.fileno(), read), env={**os.environ, 'PYTHONSAFEPATH': '1'})
        screen_end.close()
        os.close(read)
        self._socket.setblocking(False)
        os.set_blocking(write, False)
        # Lines of any library would tear the screen.
        sys.stdout.flush()
        sys.stderr.flush()
        self._outputs = [(fd, os.dup(fd)) for fd in (1, 2)]
        for fd, _ in self._outputs:
            os.dup2(write, fd)
        os.close(write)

    def alive(self) -> bool:
        """Return whether the process of the screen still runs."""
        return self._process.poll() is None

    def show(self, contents: ScreenContents) -> None:
        """Send new contents to the screen; a busy screen misses them."""
        with suppress(OSError):
            self._socket.send(contents.to_bytes())

    def pressed(self) -> list[str]:
        """Return the keys that were pressed since the last call."""
        keys = []
        with suppress(OSError):
            while data := self._socket.recv(64):
                keys.append(data.decode())
        return keys

    def close(self) -> None:
        """End the screen, and restore the terminal if the screen did not."""
        with suppress(OSError):
            sys.stdout.flush()
            sys.stderr.flush()
        for fd, original in self._outputs:
            os.dup2(original, fd)
            os.close(original)
        self._socket.close()
        try:
            tidy = self._process.wait(_WAIT_S) == 0
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            tidy = False
        if not tidy:
            with suppress(OSError, termios.error):
                os.write(1, RESET.encode())
                termios.tcsetattr(sys.stdin.fileno(), termios.TCSANOW, self._saved)
