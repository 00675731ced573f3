# SPDX-License-Identifier: Apache-2.0

"""Topics of what is sampled beside the axes: stage angles, temperature, supply."""

from __future__ import annotations

from collections.abc import Mapping

from adxl_ros.files.recording_columns import JOINTS
from adxl_ros.nodes.support.topics import create_publisher, stamp
import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import BatteryState, JointState, Temperature

_REFERENCE_QUEUE = 1000
"""References that are kept for a slow subscriber: 10 s of stage angles."""
_STAGE_PERIOD_NS = 10_000_000
"""Longest time between two messages with the same stage angles, ns; chosen: 100 Hz, as a stage's
controller sends."""
_SCALAR_PERIOD_NS = 1_000_000_000
"""Longest time between two messages with the same temperature or supply, ns; chosen."""

_STAGE = 'stage'
"""Key of the publisher of the stage angles, which have several columns."""
_KINDS = {'temperature_c': (Temperature, 'temperature'), 'supply_v': (BatteryState, 'supply')}
"""Message type and topic of what has one value a sample, by the column of a recording."""


class References:
    """Publishes what was recorded beside the sensor: stage angles, temperature, supply."""

    def __init__(self, node: Node, frame_id: str, columns: tuple[str, ...]) -> None:
        self._node, self._frame_id = node, frame_id
        self._published: dict[str, tuple[int, np.ndarray]] = {}
        self._joints = {column: joint for joint, column in JOINTS.items() if column in columns}
        self._publishers = {}
        if self._joints:
            self._publishers[_STAGE] = create_publisher(
                node, JointState, 'stage/joint_states', _REFERENCE_QUEUE)
        for column, (kind, topic) in _KINDS.items():
            if column in columns:
                self._publishers[column] = create_publisher(node, kind, topic, _REFERENCE_QUEUE)

    def destroy(self) -> None:
        """Remove the topics."""
        for publisher in self._publishers.values():
            self._node.destroy_publisher(publisher)

    def publish(self, stamps_ns: np.ndarray, columns: Mapping[str, np.ndarray]) -> None:
        """
        Publish values that have changed, and others once in a period.

        stamps_ns: stamps, ns, (n,); columns: values by column, (n,); NaN where there is none.
        """
        if not len(stamps_ns):
            return
        for name, publisher in self._publishers.items():
            if name == _STAGE:
                values = np.column_stack([columns[column] for column in self._joints])
                for i in self._new_rows(name, stamps_ns, values, _STAGE_PERIOD_NS):
                    publisher.publish(self._joint_state(stamps_ns[i], values[i]))
            else:
                values = columns[name][:, None]
                for i in self._new_rows(name, stamps_ns, values, _SCALAR_PERIOD_NS):
                    publisher.publish(self._scalar(name, stamps_ns[i], float(values[i, 0])))

    def _new_rows(self, name: str, stamps_ns: np.ndarray, values: np.ndarray, period_ns: int
                  ) -> np.ndarray:
        """Return the rows of values, (n, k), that differ from the row before or begin a period."""
        rows = np.flatnonzero(np.isfinite(values).any(axis=1))
        if not len(rows):
            return rows
        values, period = values[rows], stamps_ns[rows] // period_ns
        last_period, last = self._published.get(name, (-1, np.full(values.shape[1], np.inf)))
        changed = (np.diff(values, axis=0, prepend=last[None]) != 0).any(axis=1)
        self._published[name] = int(period[-1]), values[-1]
        return rows[changed | (np.diff(period, prepend=last_period) != 0)]

    def _joint_state(self, stamp_ns: int, values: np.ndarray) -> JointState:
        """Make the message of the joints that have a value, rad or m, (k,)."""
        angles = {joint: float(value) for joint, value in zip(self._joints.values(), values)
                  if np.isfinite(value)}
        message = JointState(name=list(angles), position=list(angles.values()))
        message.header.stamp = stamp(stamp_ns)
        return message

    def _scalar(self, name: str, stamp_ns: int, value: float) -> Temperature | BatteryState:
        """Make the message of a temperature, °C, or supply, V, by the column of a recording."""
        message = Temperature(temperature=value) if name == 'temperature_c' else \
            BatteryState(voltage=value, present=True)
        message.header.stamp, message.header.frame_id = stamp(stamp_ns), self._frame_id
        return message
