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

"""A serial port that may go and come back: opened for ever, read without waiting long."""

from __future__ import annotations

from contextlib import suppress
import os
import select
import stat
import termios
import time
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.links.support.backoff import Retry

_WAIT_MS = 50
_MOST = 65536
_LOOK_S = 0.1
"""A silent port is looked after this often: the device may be another one by now."""
SILENT = 'silent, the board sends nothing'
_DEAD_S = 3.0
"""A network connection that is silent for so long is made anew."""


class Port:
    """
    Bytes from a device path or a pyserial URL.

    Attributes
    ----------
    trouble
        Why there is none, in one line; '' while it is open, and before the first try.
    opened
        How often it was.
    opened_s
        When it was the last time, by the monotonic clock.
    received
        Bytes so far.
    heard_s
        When the last ones came, by the monotonic clock.

    """

    def __init__(self, name: str, baud: int) -> None:
        """Name the port; the first `read` opens it."""
        self.opened = self.received = 0
        self.heard_s = self.opened_s = 0.0
        self._name, self._baud = name, baud
        self._serial = _pyserial()
        self._open: Any = None
        self._poll: Any = None
        self._retry = Retry()
        self._looked_s = 0.0
        self.trouble = ''

    def read(self) -> bytes | None:
        """Return what has come, b'' after 50 ms without; None where the port was not open."""
        if self._open is None:
            if self._retry.wait():
                self._reopen()
            return None
        try:
            chunk = self._read()
        except OSError as error:
            self._lose(f'unplugged: {error.strerror or error}')
            return None
        now_s = time.monotonic()
        if chunk:
            self.received += len(chunk)
            self.heard_s = now_s
        elif now_s - max(self.heard_s, self._looked_s) > _LOOK_S:
            self._looked_s = now_s
            self._look_after(now_s)
        return chunk

    def worked(self) -> None:
        """Take note that what has come made sense: be quick again after the next failure."""
        self._retry.worked()

    def close(self) -> None:
        """Let go of it."""
        if self._open is not None:
            with suppress(OSError):  # what was unplugged may not close
                self._open.close()
            self._open = None

    def _reopen(self) -> None:
        serial = self._serial
        try:
            self._open = serial.serial_for_url(self._name, self._baud, timeout=0, exclusive=True)
        except (OSError, ValueError, termios.error) as error:
            self._open = None
            self._retry.failed()
            self.trouble = f'{self._name}: {_reason(error)}'
            return
        self.opened += 1
        self.opened_s = time.monotonic()
        self.trouble = ''
        try:
            self._poll = select.poll()
            self._poll.register(self._open.fileno(), select.POLLIN)
        except (OSError, AttributeError):
            self._poll = None  # a URL without a file: its own time-out serves
            self._open.timeout = _WAIT_MS * 1e-3

    def _read(self) -> bytes:
        if self._poll is None:
            first = self._open.read(1)
            return first + self._open.read(min(self._open.in_waiting, _MOST)) if first else b''
        if not self._poll.poll(_WAIT_MS):
            return b''
        # pyserial's own read takes a byte at a time from a socket.
        try:
            chunk = os.read(self._open.fileno(), _MOST)
        except (BlockingIOError, InterruptedError):
            return b''
        if not chunk:
            raise OSError('the other side has closed')
        return chunk

    def _lose(self, why: str) -> None:
        self.trouble = f'{self._name}: {why}'
        self.close()
        self._retry.failed()

    def _look_after(self, now_s: float) -> None:
        """Let go of a silent port whose name stands for another device, or for none."""
        try:
            held = os.fstat(self._open.fileno())
        except (OSError, AttributeError):
            return
        if stat.S_ISSOCK(held.st_mode):
            if now_s - max(self.heard_s, self.opened_s) > _DEAD_S:
                self._lose(SILENT)
            return
        try:
            there = os.stat(self._name)
        except OSError:
            self._lose('unplugged: its name is gone')
            return
        if there.st_rdev != held.st_rdev:
            self._lose('its name stands for another device now')


def _reason(error: Exception) -> str:
    """Say in stable words why a port does not open."""
    code = getattr(error, 'errno', None)
    if code in (11, 16):  # EAGAIN of the lock, EBUSY
        return 'in use: another process has locked it'
    if code:
        return os.strerror(code)
    return ' '.join(str(error).split())


def _pyserial() -> Any:
    try:
        import serial
    except ImportError:
        raise UserError('link.type serial needs the Python packages pyserial and cobs: '
                        'pip install pyserial cobs') from None
    return serial
