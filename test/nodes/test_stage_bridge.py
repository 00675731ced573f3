# SPDX-License-Identifier: Apache-2.0

"""The bridge to a real stage, with a controller that the test simulates."""

import math

from graph import Graph
import numpy as np
import pytest
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

NAMES = ('-p', 'bridge.alpha.joint:=tilt', '-p', 'bridge.beta.joint:=turn')
MOUNTED = ('-p', 'bridge.beta.sign:=-1', '-p', 'bridge.alpha.offset_rad:=0.5')


class Controller(Graph):
    """A controller of two joints, which counts in (-pi, pi] and obeys at once, and a user."""

    def __init__(self, kind):
        super().__init__()
        self.kind = kind
        self.angles = {'gripper': 0.2, 'turn': 0.0, 'tilt': 0.0}

    def __enter__(self):
        super().__enter__()
        make = self.node.create_publisher
        self.states = make(JointState, '/joint_states', 10)
        self.command = make(JointState, 'stage/command', 10)
        self.stage_states = self.listen(JointState, 'stage/joint_states')
        self.commands = self.listen(
            *(
                (JointTrajectory, '/joint_trajectory_controller/joint_trajectory')
                if self.kind == 'trajectory'
                else (JointState, '/joint_commands')
            )
        )
        self.node.create_timer(0.02, self.publish)
        return self

    def publish(self):
        message = JointState(
            name=list(self.angles),
            position=[math.remainder(angle, 2 * math.pi) for angle in self.angles.values()],
        )
        message.header.stamp = self.node.get_clock().now().to_msg()
        self.states.publish(message)

    def goal(self):
        newest = self.commands[-1]
        return (
            dict(zip(newest.joint_names, newest.points[0].positions))
            if self.kind == 'trajectory'
            else dict(zip(newest.name, newest.position))
        )

    def send_command(self, alpha, beta):
        self.command.publish(JointState(name=['alpha', 'beta'], position=[alpha, beta]))

    def command_until(self, alpha, beta, condition, purpose):
        """Repeat a command until a condition holds, because the first ones may be lost."""

        def holds():
            if condition():
                return True
            self.send_command(alpha, beta)
            return False

        self.spin_until(holds, 20, purpose)

    def at(self):
        if not self.stage_states:
            return {}
        return dict(zip(self.stage_states[-1].name, self.stage_states[-1].position))


@pytest.mark.parametrize('kind', ['trajectory', 'joint_state'])
def test_commands_and_states_pass_with_names_signs_and_offsets(start, kind):
    with Controller(kind) as graph:
        start('stage', '--ros-args', '-p', f'stage.type:={kind}', *NAMES, *MOUNTED)
        graph.spin_until(graph.at, 30, 'the stage')
        assert graph.at() == {'alpha': 0.5, 'beta': 0.0}
        graph.command_until(0.7, 0.3, lambda: graph.commands, 'a command')
        assert graph.goal() == pytest.approx({'tilt': 0.2, 'turn': -0.3})
        if kind == 'trajectory':
            point = graph.commands[0].points[0]
            seconds = point.time_from_start.sec + point.time_from_start.nanosec * 1e-9
            assert seconds == pytest.approx(0.3 / 0.3)  # the longer way at 0.3 rad/s
            assert graph.commands[0].header.stamp.sec == 0  # at once
        graph.angles.update(graph.goal())
        graph.spin_until(lambda: graph.at()['beta'] > 0.29, 10, 'the new place')
        assert graph.at() == pytest.approx({'alpha': 0.7, 'beta': 0.3})
        count = len(graph.commands)
        for _ in range(10):
            graph.send_command(0.7, 0.3)
            graph.spin(0.1)
        assert len(graph.commands) == count, 'a command that is followed was sent again'


def test_a_turn_beyond_half_a_turn_is_unwrapped(start):
    """A controller that counts in (-pi, pi] is tracked through a complete turn."""
    with Controller('trajectory') as graph:
        start('stage', '--ros-args', '-p', 'stage.type:=trajectory', *NAMES)
        for beta in np.arange(0, 6.5, 0.5):
            graph.angles['turn'] = beta
            graph.spin_until(
                lambda wanted=beta: abs(graph.at().get('beta', -1) - wanted) < 1e-9,
                20,
                f'beta {beta}',
            )


def test_a_command_that_is_lost_is_sent_again(start):
    with Controller('trajectory') as graph:
        start(
            'stage',
            '--ros-args',
            '-p',
            'stage.type:=trajectory',
            *NAMES,
            '-p',
            'bridge.speed_rad_s:=10.0',
        )
        start(
            'stage',
            '--ros-args',
            '-p',
            'stage.type:=trajectory',
            *NAMES,
            '-p',
            'bridge.alpha.joint:=tlit',
            '-r',
            '__node:=misspelt',
        )
        graph.spin_until(graph.at, 30, 'the stage')

        def commanded_twice():
            graph.send_command(0.4, 0.0)
            return len(graph.commands) >= 2

        graph.spin_until(commanded_twice, 20, 'a second time')
        graph.spin_until(lambda: graph.reports('stage', 'on the way'), 20, 'the state')
        graph.spin_until(
            lambda: graph.reports(
                'misspelt', '/joint_states has the joints gripper, tilt, turn, but no tlit'
            ),
            20,
            'the name of the joint',
        )


@pytest.mark.parametrize(
    'options, words',
    [
        (('-p', 'bridge.alpha.joint:=tilt'), 'bridge.beta.joint: is not set'),
        ((*NAMES, '-p', 'bridge.beta.sign:=0'), 'bridge.beta.sign: 0 is not 1 or -1'),
    ],
)
def test_missing_names_end_the_node(refusal, options, words):
    assert words in refusal('stage', '--ros-args', '-p', 'stage.type:=joint_state', *options)
