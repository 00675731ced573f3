# SPDX-License-Identifier: Apache-2.0

"""A real terminal for a program under test: a pty and a terminal emulator."""

import fcntl
import os
import pty
import re
import signal
import struct
import subprocess
import termios
import threading
import time

from processes import PATIENCE
import pytest

pyte = pytest.importorskip('pyte')


class Terminal:
    """A program in a terminal of its own; by default the terminal controls it."""

    def __init__(self, command, env, cwd, lines=40, columns=110, controls=True):
        self.screen = pyte.Screen(columns, lines)
        self._stream = pyte.ByteStream(self.screen)
        self._lock = threading.Lock()
        self.raw = b''
        self._master, slave = pty.openpty()
        self._size(lines, columns)
        # The test keeps the other end, to compare its settings afterwards.
        self.slave = slave
        self.before = termios.tcgetattr(slave)
        self.popen = subprocess.Popen(
            command,
            env={**env, 'TERM': 'xterm-256color'},
            cwd=cwd,
            stdin=slave,
            stdout=slave,
            stderr=slave,
            start_new_session=True,
            preexec_fn=(lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0)) if controls else None,
        )
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _size(self, lines, columns):
        fcntl.ioctl(self._master, termios.TIOCSWINSZ, struct.pack('HHHH', lines, columns, 0, 0))

    def _read(self):
        while True:
            try:
                data = os.read(self._master, 65536)
            except OSError:
                return
            with self._lock:
                self.raw += data
                self._stream.feed(data)

    def resize(self, lines, columns):
        with self._lock:
            self.screen.resize(lines, columns)
        self._size(lines, columns)
        os.killpg(os.tcgetpgrp(self._master), signal.SIGWINCH)

    def text(self):
        with self._lock:
            return '\n'.join(line.rstrip() for line in self.screen.display)

    def press(self, key):
        os.write(self._master, key.encode())

    def wait_for(self, *texts, timeout_s=30.0):
        """
        Return the screen when it shows all of some texts; wait for a multiple of the time.

        A text may be a compiled pattern: a number that goes on is not waited for alone.
        """
        end_s = time.monotonic() + PATIENCE * timeout_s
        # The terminal folds long lines.
        expected = [
            text if isinstance(text, re.Pattern) else re.compile(re.escape(' '.join(text.split())))
            for text in texts
        ]
        while True:
            screen = self.text()
            unfolded = ' '.join(screen.split())
            if all(text.search(unfolded) for text in expected):
                return screen
            if time.monotonic() > end_s:
                pytest.fail(
                    f'no {texts} on the screen after {PATIENCE} times {timeout_s} s:\n{screen}'
                )
            time.sleep(0.05)

    def wait(self, timeout_s=20.0):
        return self.popen.wait(PATIENCE * timeout_s)

    def restored(self):
        """Return whether settings, screen and cursor are as before the program."""
        with self._lock:
            # On a busy machine the node leaves it, too, while the screen still ends.
            left_alternate = self.raw.count(b'\x1b[?1049h') <= self.raw.count(b'\x1b[?1049l')
            hidden = self.screen.cursor.hidden
        return left_alternate and not hidden and termios.tcgetattr(self.slave) == self.before

    def close(self):
        if self.popen.poll() is None:
            os.killpg(self.popen.pid, signal.SIGKILL)
            self.popen.wait()
        os.close(self.slave)
        # The reader ends with the last process on the terminal. After a close its number could be
        # that of another file, from which a reader that still runs would take.
        self._thread.join(PATIENCE * 5.0)
        if not self._thread.is_alive():
            os.close(self._master)
