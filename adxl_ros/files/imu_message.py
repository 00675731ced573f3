# SPDX-License-Identifier: Apache-2.0

"""
Serialized sensor_msgs/Imu messages, read and corrected one by one.

Numbers are replaced in the bytes, in a tenth of the time of a conversion to an object and back.
"""

from __future__ import annotations

from collections.abc import Sequence
import struct

from adxl_ros.files import cdr
from adxl_ros.files.column_mapping import GRAVITY
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.kinematics import Mounting

_STAMP_OFFSET = 4  # First byte of the header's stamp
_FRAME_LENGTH = slice(12, 16)  # Bytes of the length of the frame's name
_ANGULAR_VELOCITY = 13 * 8
"""Offset behind the header, bytes. First come a quaternion and its covariance, then each vector
with its covariance, all float64."""
_ACCELERATION = 25 * 8  # The same of the linear acceleration
_END = 37 * 8  # The same of the end
_QUATERNION = 4  # Numbers of a quaternion, which stand before the orientation's covariance
_VECTOR = 3  # Numbers of a vector, which stand before its covariance
_WITH_COVARIANCE = 12  # Numbers of a vector and its covariance
_DIAGONAL = 4  # Distance of the variances of two axes in a covariance of three
_UNSET = (0.0, 0.0, 0.0, 1.0, *[0.0] * 9)
"""Quaternion and covariance of an orientation that nobody has set."""


def _numbers_begin(raw: bytes) -> tuple[str, int]:
    """Return the byte order of an Imu, and where the numbers behind its header begin."""
    order = cdr.ORDERS.get(raw[:2])
    if order is None or len(raw) < _FRAME_LENGTH.stop:
        raise cdr.CdrError(f'{raw[:16].hex()} is no header in plain CDR')
    (length,) = struct.unpack(order + 'I', raw[_FRAME_LENGTH])
    begin = _FRAME_LENGTH.stop + length
    begin += (_STAMP_OFFSET - begin) % 8  # a multiple of 8 bytes behind the encapsulation
    if len(raw) < begin + _END:
        raise cdr.CdrError(f'{len(raw)} bytes are too few for it')
    return order, begin


def _numbers(raw: bytes, offset: int, count: int) -> tuple[float, ...]:
    """Return numbers of an Imu at an offset behind its header."""
    order, begin = _numbers_begin(raw)
    return struct.unpack_from(f'{order}{count}d', raw, begin + offset)


def _with_numbers(raw: bytes, offset: int, numbers: Sequence[float]) -> bytes:
    """Return an Imu with other numbers at an offset behind its header."""
    order, begin = _numbers_begin(raw)
    message = bytearray(raw)
    struct.pack_into(f'{order}{len(numbers)}d', message, begin + offset, *numbers)
    return bytes(message)


def read(raw: bytes) -> tuple[float, Sequence[float]]:
    """Return the stamp, s, and the linear acceleration, m/s², of a sensor_msgs/Imu."""
    order, _ = _numbers_begin(raw)
    sec, nanosec = struct.unpack_from(order + 'iI', raw, _STAMP_OFFSET)
    return sec + nanosec * 1e-9, _numbers(raw, _ACCELERATION, _VECTOR)


def in_mps2(raw: bytes, unit: str) -> bytes:
    """Return an Imu with the acceleration in m/s² that has it in a unit, a key of `GRAVITY`."""
    factor = G0_MPS2 / GRAVITY[unit]
    values = [factor * value for value in _numbers(raw, _ACCELERATION, _VECTOR)]
    return _with_numbers(raw, _ACCELERATION, values)


def has_orientation(raw: bytes) -> bool:
    """
    Return whether an Imu that `read` accepted states an orientation.

    It states none where the first covariance is -1 (REP-145), nor by the default of the message.
    """
    values = _numbers(raw, 0, len(_UNSET))
    is_stated = values[_QUATERNION] != -1.0 and values != _UNSET
    return is_stated and any(values[:_QUATERNION])


def with_frame(raw: bytes, frame_id: str) -> bytes:
    """Return an Imu with another frame in its header."""
    order, begin = _numbers_begin(raw)
    name = frame_id.encode() + b'\0'
    padding = bytes((_STAMP_OFFSET - _FRAME_LENGTH.stop - len(name)) % 8)
    length = struct.pack(order + 'I', len(name))
    return raw[: _FRAME_LENGTH.start] + length + name + padding + raw[begin:]


def turned(raw: bytes, mounting: Mounting) -> bytes:
    """Return an Imu with angular velocity and orientation, if any, in the frame of the robot."""
    message = raw
    if has_orientation(raw):
        message = _with_numbers(message, 0, mounting.rotate_orientation(orientation(raw)))
    rate = _numbers(raw, _ANGULAR_VELOCITY, _WITH_COVARIANCE)
    if rate[_VECTOR] == -1.0:
        return message
    turned_rate = (*mounting.rotate(rate[:_VECTOR]), *mounting.rotate_matrix(rate[_VECTOR:]))
    return _with_numbers(message, _ANGULAR_VELOCITY, turned_rate)


def less_bias(raw: bytes, bias_radps: Sequence[float], variances: Sequence[float]) -> bytes:
    """
    Return an Imu whose angular velocity is less by a bias, rad/s; one without any stays.

    variances: those of the bias, (rad/s)², which a covariance that is stated grows by.
    """
    rate = list(_numbers(raw, _ANGULAR_VELOCITY, _WITH_COVARIANCE))
    if rate[_VECTOR] == -1.0:
        return raw
    is_stated = any(rate[_VECTOR:])
    for axis, (bias, variance) in enumerate(zip(bias_radps, variances)):
        rate[axis] -= bias
        if is_stated:
            rate[_VECTOR + _DIAGONAL * axis] += variance
    return _with_numbers(raw, _ANGULAR_VELOCITY, rate)


def orientation(raw: bytes) -> tuple[float, ...]:
    """Return the quaternion x, y, z, w of an Imu that `read` accepted."""
    return _numbers(raw, 0, _QUATERNION)


def corrected(
    raw: bytes, orientation: Sequence[float] | None, acceleration: Sequence[float]
) -> bytes:
    """
    Return an Imu with another orientation, if any, and acceleration.

    Each is followed by its covariance by rows, rad² and (m/s²)²: (13,) and (12,).
    """
    if orientation is not None:
        raw = _with_numbers(raw, 0, orientation)
    return _with_numbers(raw, _ACCELERATION, acceleration)


def vector3_stamped(raw: bytes, vector: Sequence[float]) -> bytes:
    """Return a geometry_msgs/Vector3Stamped with the header of an Imu."""
    order, begin = _numbers_begin(raw)
    # In both messages, numbers of eight bytes follow the header.
    return raw[:begin] + struct.pack(order + '3d', *vector)
