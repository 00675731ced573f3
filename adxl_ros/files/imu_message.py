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
One serialized sensor_msgs/Imu after the other: what is read of it, and what is made of it.

A corrected message differs from the raw one in some numbers only, so that these are replaced in
the bytes: a tenth of the cost of making messages of them and back. Byte order and header stay.
"""

from __future__ import annotations

from collections.abc import Sequence
import struct
from typing import NamedTuple

from adxl_ros.files import cdr

_ORIENTATION, _ACCELERATION = 'orientation', 'linear_acceleration'
_MOST_LAYOUTS = 64


class _Layout(NamedTuple):
    stamp: struct.Struct
    vector: struct.Struct
    orientation: struct.Struct
    acceleration: struct.Struct
    orientation_at: int
    acceleration_at: int
    size: int


_layouts: dict[bytes, _Layout] = {}


def read(raw: bytes) -> tuple[float, Sequence[float]]:
    """
    Return the stamp, s, and the linear acceleration, m/s², of a sensor_msgs/Imu.

    Raises
    ------
    CdrError
        It is too short or in another encoding.

    """
    layout = _layout(raw)
    sec, nanosec = layout.stamp.unpack_from(raw, 4)
    return sec + nanosec * 1e-9, layout.vector.unpack_from(raw, layout.acceleration_at)


def corrected(raw: bytes, orientation: Sequence[float], acceleration: Sequence[float]) -> bytes:
    """
    Return an Imu with other numbers.

    Parameters
    ----------
    raw
        The message, serialized, that `read` has read.
    orientation
        x, y, z, w and the covariance by rows, rad², (13,).
    acceleration
        x, y, z, m/s², and the covariance by rows, (m/s²)², (12,).

    """
    layout = _layout(raw)
    made = bytearray(raw)
    layout.orientation.pack_into(made, layout.orientation_at, *orientation)
    layout.acceleration.pack_into(made, layout.acceleration_at, *acceleration)
    return bytes(made)


def vector3_stamped(raw: bytes, vector: Sequence[float]) -> bytes:
    """Return a geometry_msgs/Vector3Stamped under the header of the Imu `raw`."""
    layout = _layout(raw)
    # In both messages, numbers of eight bytes follow the header.
    return raw[:layout.orientation_at] + layout.vector.pack(*vector)


def _layout(raw: bytes) -> _Layout:
    # The byte order and the length of the frame's name decide where everything is.
    head = raw[:2] + raw[12:16]
    layout = _layouts.get(head)
    if layout is None or len(raw) < layout.size:
        layout = _found(raw)
        if len(_layouts) >= _MOST_LAYOUTS:
            _layouts.clear()
        _layouts[head] = layout
    return layout


def _found(raw: bytes) -> _Layout:
    whole = cdr.imu(raw)
    fields = whole.fields
    return _Layout(*(struct.Struct(whole.order + code) for code in ('iI', '3d', '13d', '12d')),
                   fields[_ORIENTATION][0], fields[_ACCELERATION][0],
                   fields[f'{_ACCELERATION}_covariance'][0] + 72)
