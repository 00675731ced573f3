# SPDX-License-Identifier: Apache-2.0

"""
Serialized sensor_msgs/Imu messages, read and corrected one by one.

A corrected message differs from the raw one in some numbers only, so that these are replaced in
its bytes. That takes a tenth of the time of a conversion to a message object and back. Byte order
and header stay.
"""

from __future__ import annotations

from collections.abc import Sequence
import struct
from typing import NamedTuple

from adxl_ros.files import cdr
from adxl_ros.model.kinematics import Mounting

_STAMP_OFFSET = 4
"""Offset of the header's stamp, bytes."""

_FRAME_LENGTH = slice(12, 16)
"""Bytes with the length of the frame's name, which follows the stamp."""

_COVARIANCE_BYTES = 72
"""Size of a covariance: nine float64."""

_QUATERNION = 4
"""Numbers of a quaternion, which stand before the orientation's covariance."""

_UNSET = (0.0, 0.0, 0.0, 1.0, *[0.0] * 9)
"""Quaternion and covariance of an orientation that nobody has set."""

_MAX_LAYOUTS = 64
"""Layouts that are kept (chosen: a stream has one; bounds the memory for any input)."""


class _Layout(NamedTuple):
    """Where the numbers of an Imu are, and how they are packed."""

    order: str  # Byte order, < or >
    stamp: struct.Struct  # Two integers: s, ns
    vector: struct.Struct  # Three float64: x, y, z
    orientation: struct.Struct  # Thirteen float64: quaternion and covariance
    acceleration: struct.Struct  # Twelve float64: x, y, z and covariance
    # orientation_offset, acceleration_offset: Offsets in the message, bytes
    orientation_offset: int
    acceleration_offset: int
    size: int  # Length of the message, bytes


_layouts: dict[bytes, _Layout] = {}
"""Known layouts, by byte order and length of the frame's name."""


def read(raw: bytes) -> tuple[float, Sequence[float]]:
    """Return the stamp, s, and the linear acceleration, m/s², of a sensor_msgs/Imu."""
    layout = _layout(raw)
    sec, nanosec = layout.stamp.unpack_from(raw, _STAMP_OFFSET)
    return sec + nanosec * 1e-9, layout.vector.unpack_from(raw, layout.acceleration_offset)


def has_orientation(raw: bytes) -> bool:
    """
    Return whether a sensor_msgs/Imu, serialized, that `read` accepted, states an orientation.

    It states none where the first covariance is -1 (REP-145), and where nobody has set it: the
    default of the message is the identity with covariances of 0.
    """
    layout = _layout(raw)
    values = layout.orientation.unpack_from(raw, layout.orientation_offset)
    return values[_QUATERNION] != -1.0 and any(values[:_QUATERNION]) and values != _UNSET


def with_frame(raw: bytes, frame_id: str) -> bytes:
    """Return an Imu with another frame in its header."""
    layout = _layout(raw)
    name = frame_id.encode() + b'\0'
    length = struct.pack(layout.order + 'I', len(name))
    # The numbers behind the header begin at a multiple of 8 bytes behind the encapsulation.
    padding = -(_FRAME_LENGTH.stop - _STAMP_OFFSET + len(name)) % 8
    return (raw[:_FRAME_LENGTH.start] + length + name + bytes(padding)
            + raw[layout.orientation_offset:])


def turned(raw: bytes, mounting: Mounting) -> bytes:
    """
    Return an Imu with angular velocity and orientation in the frame of the robot.

    A part that is not there (its first covariance is -1) stays as it is.
    """
    layout = _layout(raw)
    message = bytearray(raw)
    if has_orientation(raw):
        values = layout.orientation.unpack_from(raw, layout.orientation_offset)
        layout.orientation.pack_into(
            message, layout.orientation_offset,
            *mounting.rotate_orientation(values[:_QUATERNION]), *values[_QUATERNION:])
    # Angular velocity has twelve numbers, as the acceleration has, and stands before it.
    offset = layout.acceleration_offset - layout.acceleration.size
    rate = layout.acceleration.unpack_from(raw, offset)
    if rate[3] != -1.0:
        layout.acceleration.pack_into(message, offset, *mounting.rotate(rate[:3]),
                                      *mounting.rotate_matrix(rate[3:]))
    return bytes(message)


def orientation(raw: bytes) -> tuple[float, ...]:
    """Return the quaternion x, y, z, w of a sensor_msgs/Imu, serialized, that `read` accepted."""
    layout = _layout(raw)
    values = layout.orientation.unpack_from(raw, layout.orientation_offset)
    return tuple(values[:_QUATERNION])


def corrected(raw: bytes, orientation: Sequence[float] | None, acceleration: Sequence[float]
              ) -> bytes:
    """
    Return an Imu with another orientation and acceleration.

    orientation: quaternion x, y, z, w and the covariance by rows, rad², (13,); None keeps that of
    `raw`; acceleration: x, y, z, m/s², and the covariance by rows, (m/s²)², (12,).
    """
    layout = _layout(raw)
    message = bytearray(raw)
    if orientation is not None:
        layout.orientation.pack_into(message, layout.orientation_offset, *orientation)
    layout.acceleration.pack_into(message, layout.acceleration_offset, *acceleration)
    return bytes(message)


def vector3_stamped(raw: bytes, vector: Sequence[float]) -> bytes:
    """
    Return a geometry_msgs/Vector3Stamped with the header of an Imu.

    vector: x, y, z, (3,).
    """
    layout = _layout(raw)
    # In both messages, numbers of eight bytes follow the header.
    return raw[:layout.orientation_offset] + layout.vector.pack(*vector)


def _layout(raw: bytes) -> _Layout:
    """Return the layout of a message; byte order and length of the frame's name determine it."""
    head = raw[:2] + raw[_FRAME_LENGTH]
    layout = _layouts.get(head)
    if layout is None or len(raw) < layout.size:
        layout = _find_layout(raw)
        if len(_layouts) >= _MAX_LAYOUTS:
            _layouts.clear()
        _layouts[head] = layout
    return layout


def _find_layout(raw: bytes) -> _Layout:
    imu = cdr.imu(raw)
    return _Layout(
        imu.order, struct.Struct(imu.order + 'iI'), struct.Struct(imu.order + '3d'),
        struct.Struct(imu.order + '13d'), struct.Struct(imu.order + '12d'),
        imu.fields['orientation'].offset, imu.fields['linear_acceleration'].offset,
        imu.fields['linear_acceleration_covariance'].offset + _COVARIANCE_BYTES)
