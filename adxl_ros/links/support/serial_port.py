# SPDX-License-Identifier: Apache-2.0

"""The bytes of a device path or a pyserial URL, which opens again after each loss."""

from __future__ import annotations

from contextlib import suppress
import errno
from math import inf
import os
from pathlib import Path
import select
import stat
import termios
import time
from typing import Any

from adxl_ros.errors import install_hint, UserError
from adxl_ros.links.support.base import Backoff, reason

SILENT = 'silent, the board sends nothing'  # Error of a port that is open but delivers nothing
_WAIT_MS = 50  # Longest wait for bytes, ms, so that the driver reacts to its end
_MAX_READ = 65536  # Most bytes of one read: more than a terminal or a socket usually holds
_BITS_PER_BYTE = 10  # Bits of a byte on a UART: 8 and start and stop bit
_SYSFS = Path('/sys/dev/char')  # Devices of the kernel by their numbers
_USB_DRIVER = 'cdc_acm'
"""Driver of boards that are USB devices themselves: they ignore the baud rate."""
_LOCKED = (errno.EAGAIN, errno.EBUSY)  # Errors of a port that another process has locked
_RECONNECT_S = 3.0
"""Silence after which a network connection is made again, s: a lost peer sends no error."""


class Port:
    """
    Bytes from a device path or a pyserial URL.

    connections: how often the port was opened; opened_s: monotonic time of the last opening, s;
    received_bytes: bytes so far; last_byte_s: monotonic time of the last bytes, s.
    """

    def __init__(self, name: str, baud: int) -> None:
        self.connections = self.received_bytes = 0
        self.last_byte_s = self.opened_s = 0.0
        # Bytes that the open port carries per second; infinite where the baud rate has no meaning
        self.uart_bytes_per_s = inf
        self._name = name
        self._baud = baud
        self._pyserial = import_pyserial()
        self._port: Any = None
        self._poll: Any = None
        self.backoff = Backoff()  # Of the attempts to open it; bytes that make sense reset it
        # Why the port is not open, in one line; '' while it is open and before the first attempt
        self.error = ''

    def read(self) -> bytes | None:
        """Return the bytes that have come, b'' after 50 ms; None where the port was not open."""
        if self._port is None:
            if self.backoff.wait():
                self._open()
            return None
        try:
            chunk = self._read()
            if not chunk:
                self._check_device()
        except OSError as error:
            self._lose(f'unplugged: {error.strerror or error}')
            return None
        if chunk:
            self.received_bytes += len(chunk)
            self.last_byte_s = time.monotonic()
        return chunk

    def write(self, raw: bytes) -> None:
        """Send bytes without waiting; what does not fit in the port's buffer is lost."""
        # A port that is gone shows in the next read.
        with suppress(OSError):
            if self._poll is not None:
                os.write(self._port.fileno(), raw)
            elif self._port is not None:
                self._port.write(raw)

    def close(self) -> None:
        """Close the port."""
        port = self._port
        self._port = None
        self._poll = None
        if port is not None:
            with suppress(OSError):  # an unplugged port may not close
                port.close()

    def _open(self) -> None:
        try:
            self._port = self._pyserial.serial_for_url(
                self._name, self._baud, timeout=0, exclusive=True
            )
        except (OSError, ValueError, termios.error) as error:
            self._lose(
                'in use: another process has locked it'
                if getattr(error, 'errno', None) in _LOCKED
                else reason(error)
            )
            return
        self.connections += 1
        self.opened_s = time.monotonic()
        self.error = ''
        # An FTDI chip would keep bytes for 16 ms. Most other devices have no such setting.
        with suppress(OSError, ValueError, AttributeError):
            self._port.set_low_latency_mode(True)
        try:
            number = os.fstat(self._port.fileno()).st_rdev
            self._poll = select.poll()
            self._poll.register(self._port.fileno(), select.POLLIN)
        except (OSError, AttributeError):
            # A URL without a file: pyserial's own time-out applies.
            self._port.timeout = self._port.write_timeout = _WAIT_MS * 1e-3
            return
        # A pseudo-terminal and a network port have no driver, and need no baud rate.
        driver = _SYSFS / f'{os.major(number)}:{os.minor(number)}' / 'device' / 'driver'
        is_uart = driver.exists() and driver.resolve().name != _USB_DRIVER
        self.uart_bytes_per_s = self._baud / _BITS_PER_BYTE if is_uart else inf

    def _read(self) -> bytes:
        """Wait for bytes; raises `OSError` where the device or the other side is gone."""
        if self._poll is None:
            first = self._port.read(1)
            return first and first + self._port.read(min(self._port.in_waiting, _MAX_READ))
        if not self._poll.poll(_WAIT_MS):
            return b''
        # pyserial's own read takes one byte at a time from a socket.
        try:
            chunk = os.read(self._port.fileno(), _MAX_READ)
        except (BlockingIOError, InterruptedError):
            return b''
        if not chunk:
            raise OSError('the other side has closed')
        return chunk

    def _lose(self, why: str) -> None:
        """Close the port for a reason; the next `read` opens it again."""
        self.error = f'{self._name}: {why}'
        self.close()
        self.backoff.fail()

    def _check_device(self) -> None:
        """Close a silent port whose name stands for another device, or for none."""
        if self._poll is None:
            return
        opened = os.fstat(self._port.fileno())
        if stat.S_ISSOCK(opened.st_mode):
            if time.monotonic() - max(self.last_byte_s, self.opened_s) > _RECONNECT_S:
                self._lose(SILENT)
        elif not os.path.exists(self._name) or os.stat(self._name).st_rdev != opened.st_rdev:
            self._lose('unplugged: its name is gone, or stands for another device now')


def import_pyserial() -> Any:
    """Return the module serial; raises `UserError` where it is not installed."""
    try:
        import serial
    except ImportError:
        raise UserError(
            'link.type serial needs the Python package pyserial: ' + install_hint('pyserial')
        ) from None
    return serial
