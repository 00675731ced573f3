# SPDX-License-Identifier: Apache-2.0

"""The next pose of a calibration: announced to people and programs, commanded to a stage."""

from __future__ import annotations

from collections.abc import Mapping

from adxl_ros.calibrate.guided.guide import NextPose
from adxl_ros.nodes.support.diagnostics import Level, Status, status_message
from adxl_ros.nodes.support.topics import create_publisher
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import JointState

_REPEAT_NS = 500_000_000
"""Time between two commands of the same pose, ns; chosen: a late stage loses little time."""
_COMMAND_QUEUE = 10
"""Commands that are kept for a recorder that stalls: a bag then has every command."""


class Announcer:
    """
    Announces the next pose.

    `~/next_pose` has the pose for people and programs, latched. `stage/command` has the command
    for a stage that turns itself. It is repeated, so that a stage that starts later or loses a
    message gets it, too.
    """

    def __init__(self, node: Node, has_stage: bool) -> None:
        self._node = node
        self._command = create_publisher(node, JointState, 'stage/command', _COMMAND_QUEUE) \
            if has_stage else None
        self._next = create_publisher(node, DiagnosticStatus, '~/next_pose', 1, latched=True)
        self._clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._announced = ''
        self._commanded, self._commanded_ns = '', 0

    def announce(self, pose: NextPose) -> None:
        """Announce a pose if it is new, and command the stage if it turns itself."""
        if pose.text != self._announced:
            self._node.get_logger().info(pose.text)
            self._publish(pose.text, pose.values)
        self._announced = pose.text
        now_ns = self._clock.now().nanoseconds
        if self._command and pose.command_rad is not None and (
                pose.text != self._commanded or now_ns - self._commanded_ns >= _REPEAT_NS):
            self._commanded, self._commanded_ns = pose.text, now_ns
            command = JointState(name=['alpha', 'beta'], position=list(pose.command_rad))
            # The clock of a simulation may lag behind samples that have come.
            stamp_ns = max(self._node.get_clock().now().nanoseconds, pose.newest_ns)
            command.header.stamp = Time(nanoseconds=stamp_ns).to_msg()
            self._command.publish(command)

    def withdraw(self, reason: str) -> None:
        """Take back the pose that was announced, if one was: the topic is latched."""
        if self._announced:
            self._publish(f'no pose: {reason}', {})
        self._announced = ''

    def _publish(self, text: str, values: Mapping[str, str | float]) -> None:
        self._next.publish(status_message('next_pose', Status(Level.OK, text, '', values)))
