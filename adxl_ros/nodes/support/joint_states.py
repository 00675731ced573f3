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

"""Messages of joints as bytes, many at once: it takes a tenth of the time of filling messages."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from adxl_ros.files import cdr
import numpy as np
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState


class JointReading(NamedTuple):
    """
    Motion of the joints at one stamp.

    Attributes
    ----------
    stamp_ns
        Stamp, ns.
    position
        Position by joint, rad or m.
    velocity
        Velocity by joint, rad/s or m/s; empty where the message has none.

    """

    stamp_ns: int
    position: dict[str, float]
    velocity: dict[str, float]


def joint_readings(messages: Sequence[bytes]) -> list[JointReading]:
    """Return the readings of serialized sensor_msgs/JointState, in their order."""
    numbered: list[tuple[int, JointReading]] = []
    for table in cdr.tables(messages, cdr.joint_state):
        names = [text for key, text in table.layout.texts.items() if key != 'frame_id']
        positions, velocities = (
            table.numbers(field).tolist() if field in table.layout.fields
            else [[]] * len(table.rows) for field in ('position', 'velocity'))
        numbered += [
            (row, JointReading(stamp_ns, dict(zip(names, position)), dict(zip(names, velocity))))
            for row, stamp_ns, position, velocity in zip(
                table.rows.tolist(), table.stamp_ns().tolist(), positions, velocities)]
    return [reading for _, reading in sorted(numbered, key=lambda item: item[0])]


class JointStateWriter:
    """
    Makes serialized messages of joints.

    Parameters
    ----------
    names
        Names of the joints.

    """

    def __init__(self, names: Sequence[str]) -> None:
        zeros = [0.0] * len(names)
        self._template = serialize_message(
            JointState(name=list(names), position=zeros, velocity=zeros))
        self._layout = cdr.joint_state(self._template)

    def messages(self, stamp_ns: np.ndarray, position: np.ndarray, velocity: np.ndarray
                 ) -> list[bytes]:
        """
        Serialize readings.

        Parameters
        ----------
        stamp_ns
            Stamps, ns, (n,).
        position
            Positions, rad or m, (n, k).
        velocity
            Velocities, rad/s or m/s, (n, k).

        Returns
        -------
        list
            One serialized sensor_msgs/JointState a reading.

        """
        data = cdr.fill(self._template, self._layout, stamp_ns,
                        {'position': position, 'velocity': velocity}).tobytes()
        size = len(self._template)
        return [data[i:i + size] for i in range(0, len(data), size)]
