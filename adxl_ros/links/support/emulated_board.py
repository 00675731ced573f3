# SPDX-License-Identifier: Apache-2.0

"""An emulated board: samples in wire format 1 on a terminal, in real time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
import os
from pathlib import Path
import pty
import time
import tty

from adxl_ros.errors import UserError
from adxl_ros.files.column_mapping import Columns
from adxl_ros.links.support import wire_format
from adxl_ros.links.support.base import COLUMNS, samples_within, SUPPLY, TEMPERATURE
from adxl_ros.links.support.self_test import EmulatedLine
from adxl_ros.model.sensor import Sensor
from adxl_ros.process import command
import numpy as np

_FRAME_S = 0.002  # Duration of the samples of a frame, s: the usual latency of a driver
_MOST_BYTES = 4096  # Bytes of commands that are read at once
_INFO_S = 1.0  # Period of the info frames, s, as the firmware sends them
_SUPPLY_SCALE = 2.0
"""Ratio of the supply's divider, V/V, as in the firmware: the ADC cannot measure its own
reference."""
_TEMPERATURE_ZERO_V = 0.5  # Output of the temperature sensor at 0 degC, V, as a TMP36 has it
_TEMPERATURE_V_PER_C = 0.01  # Slope of the temperature sensor, V/degC, as a TMP36 has it


class Board:
    """
    Sends the samples of a sensor, and obeys the commands of its self-test.

    Frames that nobody reads are dropped and counted, as on a board without a host.
    """

    def __init__(self, sensor: Sensor, roles: list[str], fd: int) -> None:
        self._sensor = sensor
        self._roles = roles
        self._fd = fd
        self._line = EmulatedLine(sensor)
        self._received = wire_format.Splitter()
        flags = wire_format.HAS_SELF_TEST if self._line.has_step else 0
        self._encoder = wire_format.Encoder(
            wire_format.BoardInfo(
                sensor.rate_hz,
                sensor.adc_bits,
                len(roles),
                sensor.adc_vref_v,
                sensor.serial,
                flags,
            )
        )
        self._began_s: float | None = None
        self._index = self._overruns = 0
        self._informed_s = -_INFO_S
        self._unsent = b''
        self._frame_samples = samples_within(_FRAME_S, sensor.rate_hz)

    def send(self, columns: Columns) -> None:
        """Send the samples of columns, (n,) each, every frame at the time of its last sample."""
        volts = np.column_stack([_volts(role, columns) for role in self._roles])
        if self._began_s is None:
            self._began_s = time.monotonic()
        while len(volts):
            block, volts = volts[: self._frame_samples], volts[self._frame_samples :]
            first_s = self._index / self._sensor.rate_hz
            self._obey(first_s)
            is_in_test = self._line.add(
                first_s + np.arange(len(block)) / self._sensor.rate_hz,
                block[:, : len(self._sensor.axes)],
            )
            if first_s - self._informed_s >= _INFO_S and self._write(self._encoder.info_frame()):
                self._informed_s = first_s
            due_s = self._began_s + (self._index + len(block) - 1) / self._sensor.rate_hz
            time.sleep(max(due_s - time.monotonic(), 0))
            frame = self._encoder.sample_frame(
                round(first_s * 1e6),
                self._index,
                self._codes(block),
                self._overruns,
                wire_format.IN_SELF_TEST if is_in_test.any() else 0,
            )
            if not self._write(frame):
                self._overruns += len(block)
            self._index += len(block)

    def _codes(self, volts: np.ndarray) -> np.ndarray:
        codes = np.rint(volts / self._sensor.lsb_v).clip(0, 2**self._sensor.adc_bits - 1)
        return codes.astype(np.uint16)

    def _obey(self, now_s: float) -> None:
        """Take the commands of the host at a time of the board, s."""
        with suppress(OSError):  # nothing has come, or the terminal is gone
            for raw in self._received.split(os.read(self._fd, _MOST_BYTES)):
                with suppress(wire_format.WireError):
                    command = wire_format.decode_command(raw)
                    if command.kind == wire_format.SELF_TEST_TYPE:
                        self._line.hold(now_s, command.time_us * 1e-6)

    def _write(self, frame: bytes) -> bool:
        """Write a frame, after the rest of a previous one; return whether it was taken."""
        try:
            if self._unsent:
                self._unsent = self._unsent[os.write(self._fd, self._unsent) :]
            if self._unsent:
                return False
            self._unsent = frame[os.write(self._fd, frame) :]
        except BlockingIOError:
            return False
        except OSError as error:
            raise UserError(f'--port: the terminal is gone: {error.strerror}') from None
        return True


def _volts(role: str, columns: Columns) -> np.ndarray:
    if role == SUPPLY:
        return columns[COLUMNS[role]] / _SUPPLY_SCALE
    if role == TEMPERATURE:
        return _TEMPERATURE_ZERO_V + _TEMPERATURE_V_PER_C * columns[COLUMNS[role]]
    return columns[f'{role}_v']


def roles_of(sensor: Sensor, columns: Columns) -> list[str]:
    """Return the roles of the channels for columns of samples."""
    references = [role for role, column in COLUMNS.items() if column in columns]
    return [*sensor.axes, *references]


def driver_command(port: str, roles: list[str]) -> str:
    """Return the command of a driver that reads this board."""
    options = [f'-p link.type:=serial -p link.port:={port} -p link.channels:={",".join(roles)}']
    if SUPPLY in roles:
        options.append(f'-p link.supply_scale:={_SUPPLY_SCALE}')
    return command('driver', f'--ros-args {" ".join(options)}')


def check_sensor(sensor: Sensor) -> None:
    """Raise `UserError` for a sensor that wire format 1 cannot describe."""
    if not 1 <= sensor.adc_bits <= wire_format.MAX_BITS:
        raise UserError(
            f'sensor.adc_bits: {sensor.adc_bits}: a board sends codes of 1 to '
            f'{wire_format.MAX_BITS} bits'
        )
    if len(sensor.serial) > wire_format.MAX_SERIAL or not sensor.serial.isascii():
        raise UserError(
            f'sensor.serial: {sensor.serial!r}: a board has room for '
            f'{wire_format.MAX_SERIAL} ASCII characters'
        )


@contextmanager
def open_terminal(port: str) -> Iterator[int]:
    """Open the end of a new terminal that a board writes to; the other end gets a name."""
    path = Path(port)
    (board_fd, driver_fd) = pty.openpty()
    name = os.ttyname(driver_fd)
    try:
        tty.setraw(driver_fd)
        os.set_blocking(board_fd, False)
        if not path.exists():
            path.unlink(missing_ok=True)  # the name of an earlier board
        path.symlink_to(name)
        yield board_fd
    except OSError as error:
        raise UserError(f'--port {port}: cannot be made: {error.strerror}') from None
    finally:
        if path.is_symlink() and os.readlink(path) == name:
            path.unlink()
        os.close(board_fd)
        os.close(driver_fd)
