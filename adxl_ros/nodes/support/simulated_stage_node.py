# SPDX-License-Identifier: Apache-2.0

"""The simulated stage as topics: it follows commands and publishes its encoders."""

from __future__ import annotations

from collections import deque

from adxl_ros.errors import UserError
from adxl_ros.files.parameter_file import SENSOR_FIELDS
from adxl_ros.nodes.support.diagnostics import DiagnosticsReporter, Level, Status
from adxl_ros.nodes.support.joint_states import JointStateWriter
from adxl_ros.nodes.support.parameters import declare
from adxl_ros.nodes.support.topics import create_publisher, create_subscription
from adxl_ros.simulate.simulated_stage import JOINTS, SimulatedStage
import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import JointState

_STEP_NS = 10_000_000
"""Step of the simulation, ns; chosen: 100 poses a second, as a controller of a stage sends."""
_JUMP_NS = 1_000_000_000
"""Smallest jump of ROS time after which the motion goes on from there, ns; chosen."""
_QUEUE = 1000
"""Poses that are kept for a slow subscriber: 10 s of ROS time."""
_COMMAND_QUEUE = 10
"""Commands that are kept while the node is busy; chosen."""
_RESOLUTION_RAD = float(5 / 60 * np.pi / 180)
"""Default resolution of the encoders, rad: 5 minutes of arc, as on the paper's stage."""
_START = (('alpha_rad', 'rad', 100.0), ('beta_rad', 'rad', 100.0), ('shift_m', 'm', 10.0))
"""Parameters of the joints' start: name, unit, largest position either way."""
_LIMITS = ('slew_rate_rad_s', 'slew_rate_m_s', 'settling_time_s', 'stage.resolution_rad')
"""Parameters that the log states at the start."""


class SimulatedStageNode:
    """
    The simulated stage: its encoders' readings on `stage/joint_states`, at 100 Hz of ROS time.

    A command takes effect after the delay of the controller. The true motion is thus known before
    it happens: `stage/true_joint_states` has it ahead of time, for a simulated sensor.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._stage = _declare_stage(node)
        self._delay_ns = round(1e9 * declare(node, 'delay_s', 0.1, 'time from a command to its '
                                             'effect', 's', 0.02, 1.0))
        self._unshown: deque[tuple[int, bytes]] = deque()
        self._writer = JointStateWriter(JOINTS)
        self._simulated_ns = 0
        self._is_commanded = False
        self._refusal_count = 0
        self._refusal = ''
        self._encoders = create_publisher(node, JointState, 'stage/joint_states', _QUEUE)
        self._true = create_publisher(node, JointState, 'stage/true_joint_states', _QUEUE)
        self._diagnostics = DiagnosticsReporter(node, {'stage': self._status})
        create_subscription(node, JointState, 'stage/command', self._on_command,
                            _COMMAND_QUEUE)
        limits = (f'{name} {node.get_parameter(name).value:g}' for name in _LIMITS)
        pose = ', '.join(f'{name} {p:.4g}' for name, p in zip(JOINTS, self._stage.encoder()))
        node.get_logger().info(
            f'simulated stage at {pose} (rad, rad, m): {", ".join(limits)}; waiting for '
            f'{node.resolve_topic_name("stage/command")}')
        # The timer runs on ROS time: each message of a faster clock wakes the node.
        node.create_timer(_STEP_NS * 1e-9, self._tick)

    def _on_command(self, message: JointState) -> None:
        try:
            if len(message.name) != len(message.position):
                raise UserError(f'{len(message.name)} names, but {len(message.position)} '
                                'positions')
            positions = dict(zip(message.name, message.position))
            self._stage.command(positions, dict(zip(message.name, message.velocity)))
            if not self._is_commanded:
                self._is_commanded = True
                self._node.get_logger().info(f'first command: {positions}')
        except UserError as error:
            self._refusal_count += 1
            self._refusal = f'{self._node.resolve_topic_name("stage/command")}: {error}'
            self._node.get_logger().warning(
                f'{self._refusal}; the stage stays with the command before')
            self._diagnostics.notice('stage', Level.WARN)

    def _tick(self) -> None:
        """Simulate up to the time at which a new command may take effect; show what is due."""
        now_ns = self._node.get_clock().now().nanoseconds
        if not now_ns:
            return
        if not -_JUMP_NS < now_ns + self._delay_ns - self._simulated_ns < _JUMP_NS:
            self._simulated_ns = now_ns // _STEP_NS * _STEP_NS
            self._unshown.clear()
        self._simulate(now_ns + self._delay_ns)
        while self._unshown and self._unshown[0][0] <= now_ns:
            self._encoders.publish(self._unshown.popleft()[1])

    def _simulate(self, until_ns: int) -> None:
        """Simulate the steps up to a ROS time, ns; publish the true motion, keep the encoders."""
        stamps_ns = np.arange(self._simulated_ns + _STEP_NS, until_ns + 1, _STEP_NS)
        if not len(stamps_ns):
            return
        self._simulated_ns = int(stamps_ns[-1])
        position, velocity, encoder = (np.empty((len(stamps_ns), len(JOINTS))) for _ in range(3))
        for i in range(len(stamps_ns)):
            self._stage.step(_STEP_NS * 1e-9)
            position[i], velocity[i] = self._stage.position, self._stage.velocity
            encoder[i] = self._stage.encoder()
        for message in self._writer.messages(stamps_ns, position, velocity):
            self._true.publish(message)
        self._unshown.extend(zip(stamps_ns.tolist(),
                                 self._writer.messages(stamps_ns, encoder, velocity)))

    def _status(self) -> Status:
        level, text = Level.OK, 'moving' if self._stage.moving() else 'at rest'
        if self._refusal:
            level, text = Level.WARN, f'refused {self._refusal}'
        self._refusal = ''
        values = {name: float(p) for name, p in zip(JOINTS, self._stage.encoder())}
        return Status(level, text, 'simulated', {**values, 'refused': self._refusal_count})


def _declare_stage(node: Node) -> SimulatedStage:
    """Declare the parameters of the stage and make it."""
    about = SENSOR_FIELDS['stage.resolution_rad'].metadata
    resolution_rad = declare(node, 'stage.resolution_rad', _RESOLUTION_RAD, about['doc'],
                             about['unit'], about['lower'], about['upper'])
    turn_rad_s = declare(node, 'slew_rate_rad_s', 0.5, 'largest speed of a turn', 'rad/s', 1e-6,
                         100.0)
    shift_m_s = declare(node, 'slew_rate_m_s', 0.01, 'largest speed of a shift', 'm/s', 1e-9, 10.0)
    settling_s = declare(node, 'settling_time_s', 0.3, 'settling time of a step, to 1 %', 's',
                         0.01, 60.0)
    start = [declare(node, name, 0.0, 'position at the start', unit, -reach, reach)
             for name, unit, reach in _START]
    seed = declare(node, 'seed', 0, "seed of the positions within the encoder's step", '', 0,
                   2 ** 31 - 1)
    return SimulatedStage(np.array(start), np.array([turn_rad_s, turn_rad_s, shift_m_s]),
                          settling_s, np.array([resolution_rad, resolution_rad, 0.0]), seed)
