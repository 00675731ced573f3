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
The bridge to a real stage: its controller's joints on one side, alpha and beta on the other.

`stage/command` goes to the controller, as sensor_msgs/JointState or as
trajectory_msgs/JointTrajectory with one point, which is what ros2_control's
joint_trajectory_controller takes; the controller's joint states come back as
`stage/joint_states`. A joint's angle is sign · (stage angle − offset). Angles that the controller
wraps are unwrapped.
"""

from __future__ import annotations

from dataclasses import dataclass

from adxl_ros.nodes.support import node_support
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

_SILENT_NS = 2_000_000_000
_AGAIN_NS = 2_000_000_000
"""A command that has not been followed so long after it should have is sent once more."""
_ARRIVED_RAD = 0.01
_LEAST_S = 0.2


@dataclass
class _Joint:
    """One joint of the stage: the controller's name for it, and how its angle is counted."""

    name: str
    sign: float
    offset_rad: float
    angle_rad: float | None = None

    def to_controller(self, stage_rad: float) -> float:
        return self.sign * (stage_rad - self.offset_rad)

    def read(self, position_rad: float) -> None:
        angle = self.sign * position_rad + self.offset_rad
        if self.angle_rad is not None:
            # A controller that counts from −π to π jumps where the stage turns on.
            angle += 2 * np.pi * np.round((self.angle_rad - angle) / (2 * np.pi))
        self.angle_rad = float(angle)

    def turn_to(self, goal_rad: float) -> None:
        """
        Count from the goal where the joint has stopped whole turns off it.

        The first angle of a controller that counts from −π to π leaves open how many turns it
        has made, and such a controller may take the shorter way round.
        """
        if self.angle_rad is not None:
            turns = 2 * np.pi * round((goal_rad - self.angle_rad) / (2 * np.pi))
            if abs(self.angle_rad + turns - goal_rad) < _ARRIVED_RAD:
                self.angle_rad += turns


class Bridge:
    """
    Both ways between a stage's controller and this package's topics.

    Parameters
    ----------
    node
        Whose parameters and topics they are.
    kind
        'joint_state' or 'trajectory': what the controller takes.

    Raises
    ------
    UserError
        A parameter is missing or out of range.

    """

    def __init__(self, node: Node, kind: str) -> None:
        self._node, self._kind = node, kind
        self._joints = {name: self._declare_joint(name) for name in ('alpha', 'beta')}
        declare = node_support.declare
        states = declare(node, 'bridge.joint_states', '/joint_states',
                         "topic of the controller's joint states")
        default = '/joint_trajectory_controller/joint_trajectory' if kind == 'trajectory' else \
            '/joint_commands'
        command = declare(node, 'bridge.command', default, 'topic on which the controller listens')
        self._speed = declare(node, 'bridge.speed_rad_s', 0.3, 'of a trajectory', 'rad/s', 1e-4,
                              10.0)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._goal: dict[str, float] = {}
        self._due_ns = self._heard_ns = self._late_ns = self._asked_ns = 0
        self._names: set[str] = set()
        self._refusal = ''
        self._shown = node_support.publisher(node, JointState, 'stage/joint_states', 100)
        self._out = node_support.publisher(
            node, JointTrajectory if kind == 'trajectory' else JointState, command, 10)
        self._diagnostics = node_support.publisher(node, DiagnosticArray, '/diagnostics', 10)
        self._states = states
        node_support.subscription(node, JointState, 'stage/command', self._command, 10)
        node_support.subscription(node, JointState, states, self._state, 1000)
        node.create_timer(1.0, self._report, clock=self._steady)

    def _declare_joint(self, name: str) -> _Joint:
        declare = node_support.declare
        joint = declare(self._node, f'bridge.{name}.joint', Parameter.Type.STRING,
                        f"the controller's name of the joint {name}")
        if not joint:
            raise node_support.fail(f'bridge.{name}.joint',
                                    "is not set; name the controller's joint")
        sign = declare(self._node, f'bridge.{name}.sign', 1, 'which way it turns: 1 or -1', '',
                       -1, 1)
        if sign == 0:
            raise node_support.fail(f'bridge.{name}.sign', '0 is not 1 or -1')
        return _Joint(joint, float(sign), declare(
            self._node, f'bridge.{name}.offset_rad', 0.0,
            f"{name} where the controller's joint is at 0", 'rad', -100.0, 100.0))

    def _command(self, message: JointState) -> None:
        wanted = dict(zip(message.name, message.position))
        if set(wanted) - set(self._joints) or len(message.name) != len(message.position) \
                or not np.isfinite(list(wanted.values())).all():
            self._refuse(f'stage/command: {wanted}: expected finite positions of alpha and beta')
            return
        goal = {name: wanted.get(name, self._goal.get(name, joint.angle_rad))
                for name, joint in self._joints.items()}
        if None in goal.values():
            self._refuse('stage/command: where the stage is, is not known yet')
            return
        now_ns = self._steady.now().nanoseconds
        # It comes again and again: a controller would begin its trajectory anew each time.
        if goal == self._goal and (self._arrived() or now_ns < self._due_ns):
            return
        seconds = self._duration_s(goal)
        self._due_ns = now_ns + round(seconds * 1e9) + _AGAIN_NS
        if goal != self._goal:
            self._asked_ns, self._late_ns = now_ns, self._due_ns
        self._goal, self._refusal = goal, ''
        self._send(seconds)

    def _send(self, seconds: float) -> None:
        names = [joint.name for joint in self._joints.values()]
        positions = [float(joint.to_controller(self._goal[name]))
                     for name, joint in self._joints.items()]
        if self._kind == 'joint_state':
            message = JointState(name=names, position=positions)
            message.header.stamp = self._node.get_clock().now().to_msg()
        else:
            whole, part = divmod(round(seconds * 1e9), 10 ** 9)
            # A stamp of 0 begins it at once.
            message = JointTrajectory(joint_names=names, points=[JointTrajectoryPoint(
                positions=positions, time_from_start=Duration(sec=whole, nanosec=part))])
        self._out.publish(message)

    def _duration_s(self, goal: dict[str, float]) -> float:
        ways = [abs(goal[name] - joint.angle_rad) for name, joint in self._joints.items()
                if joint.angle_rad is not None]
        return max(max(ways, default=np.pi) / self._speed, _LEAST_S)

    def _late(self) -> bool:
        return bool(self._goal) and self._steady.now().nanoseconds > self._late_ns \
            and not self._arrived()

    def _arrived(self) -> bool:
        return all(joint.angle_rad is not None
                   and abs(joint.angle_rad - self._goal[name]) < _ARRIVED_RAD
                   for name, joint in self._joints.items())

    def _state(self, message: JointState) -> None:
        positions = dict(zip(message.name, message.position))
        self._names |= set(positions)
        known = [joint for joint in self._joints.values() if joint.name in positions
                 and np.isfinite(positions[joint.name])]
        for joint in known:
            joint.read(positions[joint.name])
        if self._late():
            for name, joint in self._joints.items():
                joint.turn_to(self._goal[name])
        if not known or any(joint.angle_rad is None for joint in self._joints.values()):
            return
        self._heard_ns = self._steady.now().nanoseconds
        shown = JointState(name=list(self._joints),
                           position=[joint.angle_rad for joint in self._joints.values()])
        shown.header.stamp = message.header.stamp
        self._shown.publish(shown)

    def _refuse(self, text: str) -> None:
        if text != self._refusal:
            self._node.get_logger().warning(text)
        self._refusal = text

    def _report(self) -> None:
        level = node_support.OK
        text = 'on the way' if self._goal and not self._arrived() else 'at rest'
        topic = self._node.resolve_topic_name(self._states)
        missing = [joint.name for joint in self._joints.values() if joint.angle_rad is None]
        if self._refusal:
            level, text = node_support.WARN, f'refused {self._refusal}'
        elif missing and self._names:
            level, text = node_support.ERROR, (
                f'{topic}: no joint {", ".join(missing)}; it has '
                f'{", ".join(sorted(self._names))}; put bridge.alpha.joint and bridge.beta.joint '
                'right')
        elif self._steady.now().nanoseconds - self._heard_ns > _SILENT_NS:
            level, text = node_support.WARN, f'nothing on {topic}; is the controller running?'
        elif not self._node.count_subscribers(self._out.topic_name):
            level, text = node_support.WARN, f'nobody listens to {self._out.topic_name}'
        elif self._late():
            for_s = (self._steady.now().nanoseconds - self._asked_ns) * 1e-9
            off = ', '.join(f'{name} is at {np.degrees(joint.angle_rad):.1f}° of '
                            f'{np.degrees(self._goal[name]):.1f}°'
                            for name, joint in self._joints.items())
            level, text = node_support.WARN, (
                f'the controller has not followed for {for_s:.0f} s: {off}')
        values = {name: joint.angle_rad for name, joint in self._joints.items()
                  if joint.angle_rad is not None}
        self._diagnostics.publish(node_support.diagnostics(self._node, node_support.status(
            level, 'stage', text, self._kind, values)))
