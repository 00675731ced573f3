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

"""A board of the bench: samples in wire format 1 on a pseudo-terminal, at the pace of time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
import os
from pathlib import Path
import pty
import stat
import time
import tty

from adxl_ros.errors import UserError
from adxl_ros.links.support import channels
from adxl_ros.links.support.wire_format import Encoder, Info
from adxl_ros.model.sensor import Sensor
import numpy as np

_BLOCK = 10
"""Samples of a frame, as the firmware sends them."""
_INFO_S = 1.0
_SUPPLY_SCALE = 2.0
"""As a divider would: the ADC cannot measure what is its own reference."""
_TEMPERATURE_ZERO_V, _TEMPERATURE_V_PER_C = 0.5, 0.01


@dataclass
class Board:
    """
    Sends what a sensor gives.

    Frames that nobody takes are dropped and counted, as a board does whose host is not reading.

    Attributes
    ----------
    roles
        What its channels are.

    """

    sensor: Sensor
    roles: list[str]
    fd: int

    def __post_init__(self) -> None:
        """Begin as after a reset."""
        s = self.sensor
        self._encoder = Encoder(Info(s.rate_hz, s.adc_bits, len(self.roles), s.adc_vref_v,
                                     s.serial))
        self._began_s: float | None = None
        self._index = self._overruns = 0
        self._informed_s = -_INFO_S
        self._rest = b''

    def send(self, columns: Mapping[str, np.ndarray]) -> None:
        """Send samples as their time comes: volts by axis, `supply_v`, `temperature_c`, (n,)."""
        codes = self._codes(columns)
        if self._began_s is None:
            self._began_s = time.monotonic()
        for begin in range(0, len(codes), _BLOCK):
            block = codes[begin:begin + _BLOCK]
            at_s = self._index / self.sensor.rate_hz
            if at_s - self._informed_s >= _INFO_S and self._write(self._encoder.info_frame()):
                self._informed_s = at_s
            # A board sends a block when it has the last sample of it.
            due_s = self._began_s + (self._index + len(block) - 1) / self.sensor.rate_hz
            time.sleep(max(due_s - time.monotonic(), 0))
            frame = self._encoder.data_frame(round(at_s * 1e6), self._index, block,
                                             self._overruns)
            if not self._write(frame):
                self._overruns += len(block)
            self._index += len(block)

    def _codes(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        volts = []
        for role in self.roles:
            if role == channels.SUPPLY:
                volts.append(columns['supply_v'] / _SUPPLY_SCALE)
            elif role == channels.TEMPERATURE:
                volts.append(_TEMPERATURE_ZERO_V
                             + _TEMPERATURE_V_PER_C * columns['temperature_c'])
            else:
                volts.append(columns[f'{role}_v'])
        codes = np.rint(np.column_stack(volts) / self.sensor.lsb_v)
        return codes.clip(0, 2 ** self.sensor.adc_bits - 1).astype(np.uint16)

    def _write(self, frame: bytes) -> bool:
        """Write a frame whole, what is cut with the next one; tell whether it was taken."""
        try:
            if self._rest:
                self._rest = self._rest[os.write(self.fd, self._rest):]
            if self._rest:
                return False
            self._rest = frame[os.write(self.fd, frame):]
        except BlockingIOError:
            return False
        except OSError as error:
            raise UserError(f'--port: nobody can be written to any more: {error.strerror}'
                            ) from None
        return True


def roles_of(sensor: Sensor, columns: Mapping[str, np.ndarray]) -> list[str]:
    """Name the channels for columns of samples."""
    return [*sensor.axes, *(role for role, name in (
        (channels.SUPPLY, 'supply_v'), (channels.TEMPERATURE, 'temperature_c'))
        if name in columns)]


def reading(port: str, roles: list[str]) -> str:
    """Say how the driver reads this board."""
    options = [f'-p link.type:=serial -p link.port:={port} -p link.channels:={",".join(roles)}']
    if channels.SUPPLY in roles:
        options.append(f'-p link.supply_scale:={_SUPPLY_SCALE}')
    return f'ros2 run adxl_ros driver --ros-args {" ".join(options)}'


def check(sensor: Sensor) -> None:
    """Refuse a sensor that no board can send in this format; raises `UserError`."""
    if not 1 <= sensor.adc_bits <= 16:
        raise UserError(f'sensor.adc_bits: {sensor.adc_bits}: a board sends codes of 1 to 16 bits')
    if len(sensor.serial) > 16 or not sensor.serial.isascii():
        raise UserError(f'sensor.serial: {sensor.serial!r}: a board has room for 16 ASCII '
                        'characters')


@contextmanager
def opened(port: str) -> Iterator[int]:
    """
    Give the end that a board writes to.

    Parameters
    ----------
    port
        An existing terminal device, or the name for a new pseudo-terminal, which is there as
        long as the board.

    """
    path = Path(port)
    if path.exists():
        if not stat.S_ISCHR(path.stat().st_mode):
            raise UserError(f'--port {port}: is no terminal device; name one, or a path that '
                            'does not exist for a new pseudo-terminal')
        fd = _existing(path)
        try:
            yield fd
        finally:
            os.close(fd)
        return
    ours, theirs = pty.openpty()
    try:
        tty.setraw(theirs)
        os.set_blocking(ours, False)
        path.unlink(missing_ok=True)  # a name that was left behind
        path.symlink_to(os.ttyname(theirs))
        yield ours
    except OSError as error:
        raise UserError(f'--port {port}: {error.strerror}') from None
    finally:
        if path.is_symlink() and os.readlink(path) == os.ttyname(theirs):
            path.unlink()
        os.close(ours)
        os.close(theirs)


def _existing(path: Path) -> int:
    try:
        fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(fd)
    except (OSError, tty.error) as error:
        raise UserError(f'--port {path}: cannot be opened: {error}') from None
    return fd
