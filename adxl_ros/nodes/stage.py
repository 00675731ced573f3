# SPDX-License-Identifier: Apache-2.0

"""The two-axis stage: a simulated one, or the bridge to a real one."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files import cdr
from adxl_ros.files.parameter_file import SENSOR_FIELDS
from adxl_ros.files.recording_columns import JOINTS
from adxl_ros.nodes import parameter_checks, parameters, topics
from adxl_ros.nodes.parameters import declare_all, parameter
from adxl_ros.nodes.params_files import parameter_error
from adxl_ros.nodes.run_node import run
from adxl_ros.nodes.topics import Level, Status, STEADY
from adxl_ros.simulate.simulated_stage import SimulatedStage
from builtin_interfaces.msg import Duration
import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

_RESOLUTION = SENSOR_FIELDS['stage.resolution_rad'].metadata
"""Description of the resolution of the encoders."""
_STEP_NS = 10_000_000
"""Step of the simulation, ns: 100 poses a second, as the controller of a stage sends."""
_JUMP_NS = 1_000_000_000
"""Smallest jump of ROS time after which the motion goes on from there, ns: a hundred steps. Less
is a process that was held up, and its steps are made up."""
_QUEUE = 1000  # Poses that are kept for a slow subscriber: 10 s of ROS time
_ANGLES = ('alpha', 'beta')  # Joints of a real stage
_SILENT_NS = 2_000_000_000
"""Time without joint states after which diagnostics warn, ns: controllers send at 10 Hz or more,
so that twenty are missing."""
_GRACE_NS = 2_000_000_000
"""Time that a motion may take beyond its duration before its command is sent again, ns: a
controller that settles needs less, and a lost command delays a pose by no more."""
_ARRIVED_RAD = 0.01
"""Largest distance from the goal of a joint that has arrived, rad: 0.6°. Stages without feedback
err by tenths of a degree; the angle that counts is the one that is read."""
_SHORTEST_S = 0.2
"""Shortest duration of a trajectory, s: controllers refuse one in the past, and a command is on
its way for up to 0.1 s."""
_BRIDGE_QUEUE = 100
"""Positions that are kept for a slow subscriber: 1 s of a controller at 100 Hz."""
_COMMAND_QUEUE = 10
"""Commands that are kept, of the calibration and for the controller: only the newest moves the
stage, and the others are those of seconds before."""
_STATES_QUEUE = 1000
"""Joint states of the controller that are kept: 1 s of the fastest controllers."""
_DEFAULT_COMMANDS = {
    'trajectory': '/joint_trajectory_controller/joint_trajectory',
    'joint_state': '/joint_commands',
}
"""Usual topics of the controllers' commands, by kind."""
_EXAMPLES = {
    'the bridge to a controller of ros2_control': '--ros-args -p stage.type:=trajectory '
    '-p bridge.alpha.joint:=tilt -p bridge.beta.joint:=turn'
}
"""Examples of arguments, by their purpose."""


@dataclass(frozen=True)
class StageSettings:
    """The choice of the stage."""

    kind: str = parameter(
        'simulated',
        'the simulated stage, or the bridge to a controller that '
        'takes joint states or trajectories',
        name='stage.type',
        choices=('simulated', 'joint_state', 'trajectory'),
    )


@dataclass(frozen=True)
class SimulatedStageSettings:
    """The simulated stage."""

    resolution_rad: float = parameter(
        float(np.radians(5 / 60)),
        _RESOLUTION['doc'],
        _RESOLUTION['unit'],
        _RESOLUTION['lower'],
        _RESOLUTION['upper'],
        name='stage.resolution_rad',
    )
    delay_s: float = parameter(0.1, 'time from a command to its effect', 's', 0.02, 1.0)
    slew_rate_rad_s: float = parameter(0.5, 'largest speed of a turn', 'rad/s', 1e-6, 100.0)
    slew_rate_m_s: float = parameter(0.01, 'largest speed of a shift', 'm/s', 1e-9, 10.0)
    settling_time_s: float = parameter(0.3, 'settling time of a step, to 1 %', 's', 0.01, 60.0)
    alpha_rad: float = parameter(0.0, 'position at the start', 'rad', -100.0, 100.0)
    beta_rad: float = parameter(0.0, 'position at the start', 'rad', -100.0, 100.0)
    shift_m: float = parameter(0.0, 'position at the start', 'm', -10.0, 10.0)
    seed: int = parameter(
        0, "seed of the positions within an encoder's step", '', *parameters.SEEDS
    )


def _joint(name: str) -> Any:
    return parameter(
        parameters.Kind.STRING, f"the controller's name of {name}", name=f'bridge.{name}.joint'
    )


def _sign(name: str) -> Any:
    return parameter(
        1, 'direction in which it turns: 1 or -1', '', -1, 1, name=f'bridge.{name}.sign'
    )


def _offset(name: str) -> Any:
    return parameter(
        0.0,
        f"{name} where the controller's joint is at 0",
        'rad',
        -100.0,
        100.0,
        name=f'bridge.{name}.offset_rad',
    )


@dataclass(frozen=True)
class BridgeSettings:
    """The bridge to a real stage."""

    alpha_joint: str = _joint('alpha')
    alpha_sign: int = _sign('alpha')
    alpha_offset_rad: float = _offset('alpha')
    beta_joint: str = _joint('beta')
    beta_sign: int = _sign('beta')
    beta_offset_rad: float = _offset('beta')
    joint_states: str = parameter(
        '/joint_states', "topic of the controller's joint states", name='bridge.joint_states'
    )
    command: str = parameter(
        '',
        'topic on which the controller listens; empty: /joint_commands, '
        'or /joint_trajectory_controller/joint_trajectory',
        name='bridge.command',
    )
    speed_rad_s: float = parameter(
        0.3, 'speed of a trajectory', 'rad/s', 1e-4, 10.0, name='bridge.speed_rad_s'
    )


class SimulatedStageNode:
    """
    The simulated stage: its encoders' readings on `stage/joint_states`, at 100 Hz of ROS time.

    A command takes effect after the delay of the controller. The true motion is thus known before
    it happens: `stage/true_joint_states` has it ahead of time, for a simulated sensor.
    """

    def __init__(self, node: Node) -> None:
        self.about = 'simulated stage: '  # What it is, for the log
        self._node = node
        own = declare_all(node, SimulatedStageSettings)
        self._stage = SimulatedStage(
            np.array([own.alpha_rad, own.beta_rad, own.shift_m]),
            np.array([own.slew_rate_rad_s, own.slew_rate_rad_s, own.slew_rate_m_s]),
            own.settling_time_s,
            np.array([own.resolution_rad, own.resolution_rad, 0.0]),
            own.seed,
        )
        self._delay_ns = round(1e9 * own.delay_s)
        self._unshown: deque[tuple[int, bytes]] = deque()
        zeros = [0.0] * len(JOINTS)
        self._writer = topics.MessageWriter(
            JointState(name=list(JOINTS), position=zeros, velocity=zeros), cdr.joint_state
        )
        self._simulated_ns = 0
        self._refusal_count = 0
        self._refusal = ''
        self._encoders = topics.create_publisher(node, JointState, 'stage/joint_states', _QUEUE)
        self._true = topics.create_publisher(node, JointState, 'stage/true_joint_states', _QUEUE)
        # The timer runs on ROS time: each message of a faster clock wakes the node.
        node.create_timer(_STEP_NS * 1e-9, self._tick)

    def on_command(self, message: JointState) -> None:
        """Take a command of `stage/command`."""
        positions = dict(zip(message.name, message.position))
        try:
            if len(message.name) != len(message.position):
                raise UserError(
                    f'{len(message.name)} names, but {len(message.position)} positions'
                )
            self._stage.command(positions, dict(zip(message.name, message.velocity)))
        except UserError as error:
            self._refusal_count += 1
            self._refusal = f'{self._node.resolve_topic_name("stage/command")}: {error}'
            self._node.get_logger().warning(
                f'{self._refusal}; the stage stays with the command before'
            )

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
        position, velocity, encoder = np.empty((3, len(stamps_ns), len(JOINTS)))
        for i in range(len(stamps_ns)):
            self._stage.step(_STEP_NS * 1e-9)
            position[i], velocity[i] = self._stage.position, self._stage.velocity
            encoder[i] = self._stage.encoder()
        for message in self._writer.messages(stamps_ns, position=position, velocity=velocity):
            self._true.publish(message)
        self._unshown.extend(
            zip(
                stamps_ns.tolist(),
                self._writer.messages(stamps_ns, position=encoder, velocity=velocity),
            )
        )

    def status(self) -> Status:
        """Return the state for /diagnostics."""
        level = Level.OK
        text = 'moving' if self._stage.moving() else 'at rest'
        if self._refusal:
            level = Level.WARN
            text = f'refused {self._refusal}'
            self._refusal = ''
        values = {name: float(p) for name, p in zip(JOINTS, self._stage.encoder())}
        return Status(level, text, 'simulated', {**values, 'refused': self._refusal_count})


class StageBridge:
    """
    The way from this package's topics to the controller of a stage, and back.

    Arrays have the angles of alpha and beta, NaN before the first joint state. Angle of the stage
    = sign · angle of the controller + offset; whole turns follow from the angle before.
    """

    def __init__(self, node: Node, kind: str) -> None:
        self._node = node
        self._kind = kind
        own = declare_all(node, BridgeSettings)
        self._names = [own.alpha_joint, own.beta_joint]
        self._signs = np.array([own.alpha_sign, own.beta_sign])
        self._offsets_rad = np.array([own.alpha_offset_rad, own.beta_offset_rad])
        for joint, name, sign in zip(_ANGLES, self._names, self._signs.tolist()):
            if not name:
                raise parameter_error(
                    f'bridge.{joint}.joint', "is not set; name the controller's joint"
                )
            if sign == 0:
                raise parameter_error(f'bridge.{joint}.sign', '0 is not 1 or -1')
        self._states_topic = node.resolve_topic_name(own.joint_states)
        self._speed_rad_s = own.speed_rad_s
        self._angles_rad = np.full(2, np.nan)
        self._goal_rad = np.full(2, np.nan)
        self._heard_ns = self._resend_ns = 0
        self._begun_ns = STEADY.now().nanoseconds
        self._refusal = self._fault = ''
        self._seen: set[str] = set()  # Names of the controller's joints
        self._positions = topics.create_publisher(
            node, JointState, 'stage/joint_states', _BRIDGE_QUEUE
        )
        self._commands = topics.create_publisher(
            node,
            JointTrajectory if kind == 'trajectory' else JointState,
            own.command or _DEFAULT_COMMANDS[kind],
            _COMMAND_QUEUE,
        )
        topics.create_subscription(
            node, JointState, own.joint_states, self._on_states, _STATES_QUEUE
        )
        self.about = (
            f'bridge ({kind}): commands go to {self._commands.topic_name}, positions come from '
            f'{self._states_topic}; '
        )

    def on_command(self, message: JointState) -> None:
        """Take a command of `stage/command`."""
        positions = dict(zip(message.name, message.position))
        before_rad = np.where(np.isfinite(self._goal_rad), self._goal_rad, self._angles_rad)
        goal_rad = np.array(list(map(positions.get, _ANGLES, before_rad)))
        is_of_stage = positions.keys() <= {*_ANGLES} and len(message.name) == len(message.position)
        if not (is_of_stage and np.isfinite([goal_rad, self._angles_rad]).all()):
            reason = (
                f'stage/command: {positions}: expected finite positions of alpha and beta, '
                f'and first a position on {self._states_topic}'
            )
            if reason != self._refusal:
                self._node.get_logger().warning(reason)
            self._refusal = reason
            return
        now_ns = STEADY.now().nanoseconds
        # The calibration repeats its command: a controller would begin its trajectory each time.
        if np.array_equal(goal_rad, self._goal_rad) and (
            self._arrived() or now_ns < self._resend_ns
        ):
            return
        # The longer way to the goal counts.
        duration_s = max(
            np.abs(goal_rad - self._angles_rad).max() / self._speed_rad_s, _SHORTEST_S
        )
        self._resend_ns = now_ns + round(duration_s * 1e9) + _GRACE_NS
        self._goal_rad = goal_rad
        self._refusal = ''
        self._send(duration_s)

    def _send(self, duration_s: float) -> None:
        """Send the goal to the controller, as a motion of a duration, s."""
        positions = (self._signs * (self._goal_rad - self._offsets_rad)).tolist()
        if self._kind == 'joint_state':
            message = JointState(name=self._names, position=positions)
            message.header.stamp = self._node.get_clock().now().to_msg()
        else:
            sec, nanosec = divmod(round(duration_s * 1e9), 10**9)
            # A trajectory with the stamp 0 begins at once.
            message = JointTrajectory(
                joint_names=self._names,
                points=[
                    JointTrajectoryPoint(
                        positions=positions, time_from_start=Duration(sec=sec, nanosec=nanosec)
                    )
                ],
            )
        self._commands.publish(message)

    def _arrived(self) -> bool:
        return bool((np.abs(self._angles_rad - self._goal_rad) < _ARRIVED_RAD).all())

    def _on_states(self, message: JointState) -> None:
        positions = dict(zip(message.name, message.position))
        self._seen.update(message.name)
        angles_rad = self._offsets_rad + self._signs * [
            positions.get(name, np.nan) for name in self._names
        ]
        # A controller that counts from −π to π jumps where the stage turns on.
        turns = np.round((self._angles_rad - angles_rad) / (2 * np.pi))
        angles_rad += 2 * np.pi * np.where(np.isfinite(turns), turns, 0.0)
        known = np.isfinite(angles_rad)
        self._angles_rad = np.where(known, angles_rad, self._angles_rad)
        if not known.any() or not np.isfinite(self._angles_rad).all():
            return
        self._heard_ns = STEADY.now().nanoseconds
        stage = JointState(name=list(_ANGLES), position=self._angles_rad.tolist())
        stage.header.stamp = message.header.stamp
        self._positions.publish(stage)

    def status(self) -> Status:
        """Return the state for /diagnostics."""
        values = {
            name: angle
            for name, angle in zip(_ANGLES, self._angles_rad.tolist())
            if np.isfinite(angle)
        }
        level, text = self._state()
        if level is Level.ERROR and text != self._fault:
            self._node.get_logger().error(text)
            self._fault = text
        return Status(level, text, self._kind, values)

    def _state(self) -> tuple[Level, str]:
        """Return the level and one line: the motion, or why there is none."""
        now_ns = STEADY.now().nanoseconds
        unknown = [name for name in self._names if name not in self._seen]
        # The joints of a robot may come in several messages.
        if self._seen and unknown and now_ns - self._begun_ns > _SILENT_NS:
            return Level.ERROR, (
                f'{self._states_topic} has the joints '
                f'{", ".join(sorted(self._seen))}, but no '
                f'{" and no ".join(unknown)}; correct bridge.alpha.joint and '
                'bridge.beta.joint'
            )
        if self._refusal:
            return Level.WARN, f'refused {self._refusal}'
        if now_ns - self._heard_ns > _SILENT_NS:
            return Level.WARN, (
                f'nothing on {self._states_topic} of {" and ".join(self._names)}; '
                'is the controller running?'
            )
        is_there = self._arrived() or np.isnan(self._goal_rad).any()
        return Level.OK, 'at rest' if is_there else 'on the way'


class Stage(Node):
    """The node; its parameter `stage.type` chooses what it is."""

    def __init__(self) -> None:
        super().__init__('stage')
        parameter_checks.check_given(self)
        kind = declare_all(self, StageSettings).kind
        stage = SimulatedStageNode(self) if kind == 'simulated' else StageBridge(self, kind)
        topics.DiagnosticsReporter(self, 'stage', stage.status)
        topics.create_subscription(
            self, JointState, 'stage/command', stage.on_command, _COMMAND_QUEUE
        )
        self.get_logger().info(
            f'{stage.about}waiting for {self.resolve_topic_name("stage/command")}'
        )


def main() -> int:
    """Run the node."""
    return run(Stage, __doc__, _EXAMPLES)
