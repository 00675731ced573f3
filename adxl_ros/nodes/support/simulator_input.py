# SPDX-License-Identifier: Apache-2.0

"""The topics of a simulator, for a link that emulates a sensor on them."""

from __future__ import annotations

import time

from adxl_ros.files import cdr
from adxl_ros.links.support.base import ImuLink
from adxl_ros.links.support.watchdog import Watchdog
from adxl_ros.nodes.support.receive_thread import ReceiveTurn
from adxl_ros.nodes.support.topics import create_subscription
import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import Imu, Temperature

_QUEUE = 1000
"""Samples that are kept while the node is busy: 1 s at 1 kHz."""
_FIELDS = ('orientation', 'orientation_covariance', 'angular_velocity',
           'angular_velocity_covariance', 'linear_acceleration')
"""Number fields of sensor_msgs/Imu."""
_PAUSE_S = 0.004
"""Time between two looks at the samples, s. At 1 kHz four of them then share a run of the chain,
which costs as much as ten samples."""
_FOREIGN_NS = 60_000_000_000
"""Largest distance of stamps from the clock of the node, ns; chosen: a larger one is another
clock."""
_CLOCK_WAIT_S = 5.0
"""Time for which samples may be of another clock before a warning, s; chosen: within it nodes find
each other, and a reset of the simulator reaches samples and /clock."""
_COUNT_S = 1.0
"""Time after which the publishers of the samples are counted again, s; chosen."""
_LONGEST_TURN_S = 0.25
"""Longest time that counts from one look at the samples to the next, s."""


class SimulatorInput:
    """Gives the messages of a simulator to a link."""

    def __init__(self, node: Node, link: ImuLink) -> None:
        self._node, self._link = node, link
        self._raw: list[bytes] = []
        self.frame_id = ''  # Frame of the newest samples
        self._foreign = Watchdog(_LONGEST_TURN_S)
        self._is_warned = False
        self._due_s = self._counted_s = time.monotonic()
        self._turn = ReceiveTurn(node, Imu, link.imu_topic, self._raw.append, _QUEUE)
        self._temperature = create_subscription(
            node, Temperature, link.temperature_topic,
            lambda message: link.sense_temperature(message.temperature), 1)

    def destroy(self) -> None:
        """Remove the subscriptions; the thread that waits must have ended."""
        self._turn.destroy()
        self._node.destroy_subscription(self._temperature)

    def wait(self) -> None:
        """Pause after the last samples, wait for others for up to 0.1 s, give all to the link."""
        time.sleep(max(self._due_s - time.monotonic(), 0))
        self._turn()
        self._due_s = time.monotonic() + _PAUSE_S
        raws = self._raw[:]
        self._raw.clear()
        if not raws or self._due_s > self._counted_s + _COUNT_S:
            topic = self._node.resolve_topic_name(self._link.imu_topic)
            self._link.sense_publishers(self._node.count_publishers(topic), self._turn.fault())
            self._counted_s = self._due_s
        if not raws:
            return
        stamps_ns = np.empty(len(raws), np.int64)
        fields: dict[str, np.ndarray] = {}
        for table in cdr.tables(raws, cdr.imu):
            stamps_ns[table.rows] = table.stamp_ns()
            for name in _FIELDS:
                numbers = table.numbers(name)
                fields.setdefault(name, np.empty((len(raws), numbers.shape[1])))[table.rows] = \
                    numbers
            self.frame_id = table.layout.texts['frame_id']
        self._warn_of_clock(int(stamps_ns[-1]))
        self._link.sense_imu(stamps_ns, fields)

    def _warn_of_clock(self, stamp_ns: int) -> None:
        """Warn once of samples that belong to another clock than the node's and go on to."""
        away_ns = self._node.get_clock().now().nanoseconds - stamp_ns
        if abs(away_ns) <= _FOREIGN_NS:
            self._foreign.feed()
        if self._foreign.check() > _CLOCK_WAIT_S and not self._is_warned:
            self._is_warned = True
            self._node.get_logger().warning(
                f'{self._link.imu_topic}: stamps are {away_ns * 1e-9:+.0f} s from the clock of '
                'this node; set use_sim_time:=true, and let the simulator publish /clock')
