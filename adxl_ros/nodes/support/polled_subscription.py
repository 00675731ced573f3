# SPDX-License-Identifier: Apache-2.0

"""A subscription whose messages wait until they are asked for."""

from __future__ import annotations

from typing import Any

from adxl_ros.nodes.support.rclpy_internals import NotForExecutors, take_messages
from adxl_ros.nodes.support.topics import create_subscription, OnePublisher
from rclpy.node import Node
from sensor_msgs.msg import Imu


class PolledSubscription:
    """
    Keeps the serialized messages of a topic until a node takes them, without waking it.

    Samples (sensor_msgs/Imu) of several publishers are withheld.

    At 1 kHz an executor that wakes for each message takes a tenth of a core.
    """

    def __init__(self, node: Node, kind: Any, topic: str, depth: int) -> None:
        self._kind, self._depth = kind, depth
        self._publishers = OnePublisher(node, topic)
        self._subscription = create_subscription(
            node, kind, topic, lambda _: None, depth, raw=True, group=NotForExecutors())

    def take(self) -> list[bytes]:
        """Return the messages since the last call, at most as many as are kept."""
        accept = (self._publishers,) if self._kind is Imu else ()
        return list(take_messages(self._subscription, self._kind, True, self._depth, *accept))

    def fault(self) -> str:
        """Return that several nodes publish on the topic, so that nothing is taken, or ''."""
        return self._publishers.fault()
