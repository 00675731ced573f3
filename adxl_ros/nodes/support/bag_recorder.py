# SPDX-License-Identifier: Apache-2.0

"""The bag of a running node: the sensor's samples and everything that belongs to them."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from adxl_ros.files.live_bag import LiveBag
from adxl_ros.links.support.watchdog import Watchdog
from adxl_ros.nodes.support.receive_thread import ReceiveTurn, RepeatingThread
from adxl_ros.nodes.support.topics import create_subscription
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import BatteryState, Imu, JointState, Temperature

_SAMPLES = 'imu/data_raw'
"""Topic of the samples."""
_QUEUE = 20000
"""Samples that are kept while the thread is busy: 20 s at 1 kHz."""
_SLOW_QUEUE = 1000
"""Messages of a slow topic that wait meanwhile; chosen: 10 s of a stage."""
_KINDS = {'stage/joint_states': (JointState, 'sensor_msgs/msg/JointState'),
          'stage/command': (JointState, 'sensor_msgs/msg/JointState'),
          'temperature': (Temperature, 'sensor_msgs/msg/Temperature'),
          'supply': (BatteryState, 'sensor_msgs/msg/BatteryState'),
          'sensor_info': (DiagnosticStatus, 'diagnostic_msgs/msg/DiagnosticStatus')}
"""Class and name of the type of each topic beside the samples."""


class BagRecorder:
    """Writes the topics of the package into a bag. A thread of its own takes the samples."""

    def __init__(self, node: Node, watchdog: Watchdog) -> None:
        """Subscribe; nothing is kept before `start`."""
        self._node = node
        self.has_samples = False  # Whether a sample has come
        self._bag: LiveBag | None = None
        self._thread: RepeatingThread | None = None
        self._system = Clock(clock_type=ClockType.SYSTEM_TIME)
        self._watchdog = watchdog
        # Its message comes once, perhaps before the bag is open.
        self._early: list[tuple[str, str, bytes]] = []
        for topic, (kind, name) in _KINDS.items():
            create_subscription(node, kind, topic, partial(self._write, topic, name), _SLOW_QUEUE,
                                latched=topic == 'sensor_info', raw=True)
        self._samples = ReceiveTurn(node, Imu, _SAMPLES, self._write_sample, _QUEUE)

    @property
    def is_writing(self) -> bool:
        """Return whether there is a bag."""
        return self._bag is not None

    def listen(self) -> None:
        """Take samples, so that `has_samples` shows them."""
        self._thread = RepeatingThread(self._node, self._samples, _SAMPLES)

    def start(self, path: Path) -> None:
        """Begin to write."""
        self._bag = LiveBag(path)
        for topic, kind, data in self._early:
            self._write(topic, kind, data)

    def fault(self) -> str:
        """Return that several nodes publish samples, so that none is written, or ''."""
        return self._samples.fault()

    def flush(self) -> None:
        """Write the messages so far to the file."""
        if self._bag is not None:
            self._bag.flush()

    def close(self) -> None:
        """End the thread, and write the end of the bag."""
        if self._thread is not None:
            self._thread.close()
            self._thread = None
        if self._bag is not None:
            self._bag.close()

    def _write_sample(self, data: bytes) -> None:
        self.has_samples = True
        self._watchdog.feed()
        self._write(_SAMPLES, 'sensor_msgs/msg/Imu', data)

    def _write(self, topic: str, kind: str, data: bytes) -> None:
        if self._bag is None:
            if topic == 'sensor_info':
                self._early = [(topic, kind, data)]
            return
        self._bag.write(self._node.resolve_topic_name(topic), kind, data,
                        self._system.now().nanoseconds)
