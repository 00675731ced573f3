# SPDX-License-Identifier: Apache-2.0

"""The subscriptions of the monitor, whose messages it takes many at a time."""

from __future__ import annotations

from collections.abc import Callable

from adxl_ros.files import cdr
from adxl_ros.monitor.live_gap import LiveGap
from adxl_ros.monitor.reference_stream import ReferenceKind
from adxl_ros.nodes.support.joint_states import joint_readings
from adxl_ros.nodes.support.polled_subscription import PolledSubscription
import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import BatteryState, Imu, JointState, Temperature

_QUEUE = 10000
"""Messages that are kept while the node is busy: 10 s at 1 kHz."""


class MonitorStreams:
    """Takes samples, reference and surroundings."""

    def __init__(self, node: Node, kind: ReferenceKind, reference_topic: str) -> None:
        self._kind = kind
        reference = JointState if kind is ReferenceKind.STAGE else Imu
        self._samples, self._reference, self._temperature, self._supply = (
            PolledSubscription(node, message, topic, _QUEUE) for message, topic in (
                (Imu, 'imu/data_raw'), (reference, reference_topic),
                (Temperature, 'temperature'), (BatteryState, 'supply')))

    def take_samples(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the samples that wait: stamps, ns, (n,), and acceleration, m/s², (n, 3)."""
        return _imu(self._samples)

    def fault(self) -> str:
        """Return that several nodes publish samples or reference, so that none count, or ''."""
        return self._samples.fault() or self._reference.fault()

    def take_others(self, live: LiveGap) -> int:
        """Give reference and surroundings that wait to a comparison; return how many came."""
        reference = live.reference
        for name, field, subscription, layout in (
                ('temperature_c', 'temperature', self._temperature, cdr.temperature),
                ('supply_v', 'voltage', self._supply, cdr.battery_state)):
            stamps_ns, values = _table(subscription, layout, field, 1)
            for stamp_ns, value in zip(stamps_ns.tolist(), values[:, 0].tolist()):
                reference.add_surroundings(name, stamp_ns, value)
        if self._kind is ReferenceKind.IMU:
            stamps_ns, force = _imu(self._reference)
            reference.add_readings(stamps_ns, force)
            return len(stamps_ns)
        raws = self._reference.take()
        for reading in joint_readings(raws):
            if reading.position:
                reference.add_joints(reading.stamp_ns, reading.position)
        return len(raws)


def _imu(subscription: PolledSubscription) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps, ns, (n,), and acceleration, m/s², (n, 3), of the messages that wait."""
    return _table(subscription, cdr.imu, 'linear_acceleration', 3)


def _table(subscription: PolledSubscription, layout: Callable[[bytes], cdr.Layout], field: str,
           count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps, ns, (n,), and a field, (n, count), of the messages that wait."""
    raws = subscription.take()
    stamps_ns, values = np.empty(len(raws), np.int64), np.empty((len(raws), count))
    for table in cdr.tables(raws, layout):
        stamps_ns[table.rows] = table.stamp_ns()
        values[table.rows] = table.numbers(field)
    return stamps_ns, values
