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

"""A simulated two-axis stage that follows commands, by `links.support.simulated_stage`."""

from __future__ import annotations

from collections import deque

from adxl_ros.errors import UserError
from adxl_ros.files.parameter_file import FIGURES
from adxl_ros.links.support.simulated_stage import JOINTS, SimulatedStage
from adxl_ros.nodes.support import node_support
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import JointState

_STEP_NS = 10_000_000
_JUMP_NS = 1_000_000_000
_QUEUE = 1000


class Simulated:
    """
    The simulated stage: 100 poses a second of ROS time, on `stage/joint_states`, by its encoders.

    A command takes effect after the delay of the controller. The true motion is thus known
    ahead, and goes ahead of time to `stage/true_joint_states`, for a simulated sensor to feel.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        declare = node_support.declare
        about = FIGURES['stage.resolution_rad'].metadata
        nominal = 5 / 60 * np.pi / 180
        step = declare(node, 'stage.resolution_rad', float(nominal), about['doc'], about['unit'],
                       about['lower'], about['upper'])
        slew = declare(node, 'slew_rate_rad_s', 0.5, 'fastest turn', 'rad/s', 1e-6, 100.0)
        shift_slew = declare(node, 'slew_rate_m_s', 0.01, 'fastest shift', 'm/s', 1e-9, 10.0)
        settling = declare(node, 'settling_time_s', 0.3, 'of a step, to 1 %', 's', 0.01, 60.0)
        self._delay_ns = round(1e9 * declare(node, 'delay_s', 0.1, 'from a command to its effect',
                                             's', 0.02, 1.0))
        pose = [declare(node, f'{name}_{unit}', 0.0, 'where it begins', unit, -reach, reach)
                for name, unit, reach in (('alpha', 'rad', 100.0), ('beta', 'rad', 100.0),
                                          ('shift', 'm', 10.0))]
        seed = declare(node, 'seed', 0, "of where in the encoder's step it comes to rest", '',
                       0, 2 ** 31 - 1)
        self._stage = SimulatedStage(np.array(pose), np.array([slew, slew, shift_slew]), settling,
                                     np.array([step, step, 0.0]), seed)
        self._due: deque[tuple[int, JointState]] = deque()
        self._known_ns = self._refusals = 0
        self._refusal = ''
        self._connect()

    def _connect(self) -> None:
        node = self._node
        self._shown = node_support.publisher(node, JointState, 'stage/joint_states', _QUEUE)
        self._true = node_support.publisher(node, JointState, 'stage/true_joint_states', _QUEUE)
        self._diagnostics = node_support.publisher(node, DiagnosticArray, '/diagnostics', 10)
        node_support.subscription(node, JointState, 'stage/command', self._command, 10)
        # On ROS time: a clock that runs faster wakes the node with each of its messages.
        node.create_timer(_STEP_NS * 1e-9, self._tick)
        node.create_timer(1.0, self._report, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _command(self, message: JointState) -> None:
        try:
            if len(message.name) != len(message.position):
                raise UserError(f'{len(message.name)} names, but {len(message.position)} '
                                'positions')
            self._stage.command(dict(zip(message.name, message.position)))
        except UserError as error:
            self._refusals += 1
            self._refusal = f'{self._node.resolve_topic_name("stage/command")}: {error}'
            self._node.get_logger().warning(
                f'{self._refusal}; the stage goes where it was told before')

    def _tick(self) -> None:
        """Go on to the time up to which the motion is certain, and show what is due."""
        now_ns = self._node.get_clock().now().nanoseconds
        if not now_ns:
            return
        if not -_JUMP_NS < now_ns + self._delay_ns - self._known_ns < _JUMP_NS:
            self._known_ns = now_ns // _STEP_NS * _STEP_NS
            self._due.clear()
        while self._known_ns + _STEP_NS <= now_ns + self._delay_ns:
            self._known_ns += _STEP_NS
            self._stage.step(_STEP_NS * 1e-9)
            self._true.publish(self._message(self._stage.position))
            self._due.append((self._known_ns, self._message(self._stage.encoder())))
        while self._due and self._due[0][0] <= now_ns:
            self._shown.publish(self._due.popleft()[1])

    def _message(self, position: np.ndarray) -> JointState:
        message = JointState(name=JOINTS, position=position, velocity=self._stage.velocity)
        sec, nanosec = divmod(self._known_ns, 10 ** 9)
        message.header.stamp = Time(sec=sec, nanosec=nanosec)
        return message

    def _report(self) -> None:
        level, text = node_support.OK, 'moving' if self._stage.moving() else 'at rest'
        if self._refusal:
            level, text = node_support.WARN, f'refused {self._refusal}'
        values = {name: float(p) for name, p in zip(JOINTS, self._stage.encoder())}
        self._diagnostics.publish(node_support.diagnostics(self._node, node_support.status(
            level, 'stage', text, 'simulated', {**values, 'refused': self._refusals})))
        self._refusal = ''
