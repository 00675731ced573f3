# SPDX-License-Identifier: Apache-2.0

"""The driver of another project, `witmotion`, on an emulated board, for the benchmark."""

from __future__ import annotations

from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
import os
import struct
import time
from typing import Any

from adxl_ros.links.support.emulated_board import open_terminal
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Imu

TOPIC = 'rival'
"""Topic of the node."""
_HEAD = b'\x55\x51'
"""Begin of a frame of acceleration (manual of WitMotion WT901: 0x55, then the kind)."""
_FIELDS = struct.Struct('<hhhh')
"""Its fields: three accelerations and a temperature; a byte with the sum of all follows."""
_MPS2_PER_CODE = 16 * 9.8 / 32768
"""Acceleration by its code, m/s²: the library takes 9.8 m/s² for g."""
_CLOCK_BITS = 48
"""Bits of the clock that the three accelerations carry."""
_BAUD = 115200
"""Baud rate, which a pseudo-terminal ignores."""


def is_installed() -> bool:
    """Return whether the library is there."""
    return find_spec('witmotion') is not None


def run_board(port: str, rate_hz: float) -> int:
    """
    Send samples until a signal ends it: one a frame, as these boards do.

    The accelerations of a sample are its time, because the frame has no field for it.
    """
    with suppress(KeyboardInterrupt), open_terminal(port) as fd:
        began_s = time.monotonic()
        count = 0
        while True:
            count += 1
            time.sleep(max(began_s + count / rate_hz - time.monotonic(), 0))
            # A frame that nobody reads is lost.
            with suppress(BlockingIOError):
                os.write(fd, _frame(time.time_ns() // 1000))
    return 0


def _frame(time_us: int) -> bytes:
    """Return the frame whose accelerations are a time, µs."""
    clock = (time_us % 2 ** _CLOCK_BITS).to_bytes(_CLOCK_BITS // 8, 'little')
    frame = _HEAD + clock + b'\0\0'
    return frame + bytes([sum(frame) % 256])


def _time_us(accel_mps2: tuple[float, ...], now_us: int) -> int:
    """Return the time that accelerations are, µs; it is before now."""
    codes = (round(value / _MPS2_PER_CODE) for value in accel_mps2)
    clock = int.from_bytes(_FIELDS.pack(*codes, 0)[:_CLOCK_BITS // 8], 'little')
    return now_us - (now_us - clock) % 2 ** _CLOCK_BITS


class RivalDriver(Node):
    """The smallest node on the library: it publishes each sample, stamped by its time."""

    def __init__(self, port: str, depth: int) -> None:
        super().__init__('rival')
        witmotion = import_module('witmotion')
        self._message = Imu()
        self._publisher = self.create_publisher(Imu, TOPIC, QoSProfile(depth=depth))
        self._imu = witmotion.IMU(port, _BAUD)
        self._imu.subscribe(self._on_sample, witmotion.protocol.AccelerationMessage)

    def close(self) -> None:
        """End the thread of the library."""
        self._imu.close()

    def _on_sample(self, sample: Any) -> None:
        accel, stamp = self._message.linear_acceleration, self._message.header.stamp
        accel.x, accel.y, accel.z = sample.a
        stamp.sec, time_us = divmod(_time_us(sample.a, time.time_ns() // 1000), 10 ** 6)
        stamp.nanosec = 1000 * time_us
        self._publisher.publish(self._message)


def run_driver(port: str, depth: int) -> int:
    """Run the node until a signal ends it."""
    rclpy.init()
    node = RivalDriver(port, depth)
    try:
        with suppress(KeyboardInterrupt, ExternalShutdownException):
            rclpy.spin(node)
    finally:
        node.close()
    return 0
