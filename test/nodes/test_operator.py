# SPDX-License-Identifier: Apache-2.0

"""A stage turned by hand, and an operator who makes mistakes: messages and taken poses."""

from contextlib import contextmanager
import os
import re
import signal

from adxl_ros.files import parameter_file, sweep_journal
from diagnostic_msgs.msg import DiagnosticStatus
from graph import Graph, RELIABLE
import numpy as np
from sensor_msgs.msg import Imu, JointState
from std_srvs.srv import Trigger
from units import drawn, nominal

FAST = ('-p', 'use_sim_time:=true')
PLAN = ('-p', 'sweep.planes_deg:=[45.0, 90.0]', '-p',
        'sweep.step_deg:=90.0', '-p', 'sweep.dwell_s:=2.0', '-p',
        'sweep.check_poses:=0', '-p', 'output:=unit.yaml', '-p', 'autostart:=true')


class Operator(Graph):
    """An operator who turns the stage and calls the services."""

    def __enter__(self):
        super().__enter__()
        self.stage_states = self.listen(JointState, 'stage/joint_states')
        self.announced = self.listen(DiagnosticStatus, 'calibration/next_pose', latched=True)
        self.commands = self.node.create_publisher(JointState, 'stage/command', 10)
        return self

    def request(self):
        """Return the announced pose: number, alpha, beta, and the text."""
        newest = self.announced[-1]
        values = {pair.key: pair.value for pair in newest.values}
        return (int(values['pose']), float(values['alpha_rad']), float(values['beta_rad']),
                newest.message)

    def has_request(self):
        """Return whether the newest diagnostics request a pose, or state its error."""
        return (self.reports('calibration', 'then capture')
                or self.reports('calibration', 'from the target'))

    def command(self, alpha, beta, shift=0.0):
        """Command the stage without waiting for its arrival."""
        self.commands.publish(JointState(name=['alpha', 'beta', 'shift'],
                                         position=[alpha, beta, shift]))

    def turn(self, alpha, beta):
        """Turn the stage and wait until it is there and rests."""
        def there():
            self.command(alpha, beta)
            self.spin(0.1)
            last = self.stage_states[-1] if self.stage_states else None
            return last and np.abs(last.velocity).max() < 1e-4 and np.allclose(
                last.position[:2], [alpha, beta], atol=2e-3)
        self.spin_until(there, 30, f'the stage at {alpha}, {beta}')

    def ask(self, name='capture', meanwhile=None):
        """Call a service, do something meanwhile, and return its answer."""
        future = self.request_of(name)
        if meanwhile:
            self.spin(0.25)
            meanwhile()
        return self.answer(future)

    def request_of(self, name):
        """Call a service and return the future of its answer."""
        client = self.node.create_client(Trigger, f'calibration/{name}')
        assert client.wait_for_service(100)
        return client.call_async(Trigger.Request())

    def answer(self, future):
        """Wait for the answer of a service."""
        self.spin_until(future.done, 40, 'the answer')
        return future.result().success, future.result().message


@contextmanager
def time_stopped(driver):
    """Stop sensor and stage, so that a busy machine delays no action of the operator."""
    os.kill(driver.popen.pid, signal.SIGSTOP)
    yield
    os.kill(driver.popen.pid, signal.SIGCONT)


def _bench(start, tmp_path, mode):
    base = nominal(serial='T1', rate_hz=200.0)
    parameter_file.save(tmp_path / 'truth.yaml', drawn(np.random.default_rng(3), base))
    parameter_file.save(tmp_path / 'bare.yaml', base)
    driver = start('driver', '--ros-args', '--params-file', tmp_path / 'truth.yaml', '-p',
                   'link.type:=sim', '-p', 'link.speed:=4.0', *FAST)
    start('stage', '--ros-args', '--params-file', tmp_path / 'bare.yaml', *FAST, '-p',
          'slew_rate_rad_s:=1.5', '-p', 'slew_rate_m_s:=2.0', '-p', 'settling_time_s:=0.1')
    return driver, start(
        'calibration', '--ros-args', '--params-file', tmp_path / 'bare.yaml', *FAST, *RELIABLE,
        *PLAN, '-p', f'stage.mode:={mode}', '-p', 'stage.timeout_s:=3.0')


def test_a_calibration_with_mistakes_of_the_operator_is_right(start, tmp_path):
    """Wrong poses, early captures, knocks and pauses are reported, and the file is right."""
    with Operator() as operator:
        driver, node = _bench(start, tmp_path, 'encoder')
        operator.spin_until(lambda: operator.announced, 60, 'the first pose')
        number, alpha, beta, words = operator.request()
        assert (number, alpha, beta) == (1, np.pi / 4, 0.0)
        assert words == 'pose 1 of 20: turn the stage to alpha 45.0°, beta 0.0°, then capture'
        # A wrong pose.
        operator.turn(alpha, np.radians(3.2))
        operator.spin_until(operator.has_request, 20, 'an angle in the calibration')
        assert operator.ask() == (
            False, 'beta is 3.2° from the target 0°; turn the stage there and capture again')
        # Too early: the stage is still turning.
        operator.turn(alpha, 4 * np.pi)
        with time_stopped(driver):
            operator.command(alpha, beta)
            capture = operator.request_of('capture')
        early, answer = operator.answer(capture)
        assert not early and 'from the target 0°' in answer
        operator.turn(alpha, beta)
        # A knock during the dwell restarts the average of the pose.
        done, answer = operator.ask(meanwhile=lambda: (operator.command(alpha, beta, 0.02),
                                                       operator.spin(0.1),
                                                       operator.command(alpha, beta, 0.0)))
        assert done and answer == 'pose 1 is on disk'
        operator.spin_until(lambda: operator.request()[0] == 2, 20, 'the second pose')
        # The operator turns to the next pose before this one is taken.
        _, alpha, beta, _ = operator.request()
        operator.turn(alpha, beta)
        with time_stopped(driver):
            capture = operator.request_of('capture')
            operator.command(alpha, beta + np.pi / 4)
        operator.turn(alpha, beta + np.pi / 4)
        done, answer = operator.answer(capture)
        # It states the angle at which it noticed, which is on the way or at the end.
        away = re.match(rf'beta is (\S+)° from the target {np.degrees(beta):.4g}°', answer)
        assert not done and away and 2.0 < float(away[1]) < 45.1, answer
        # A pause: the calibration continues and repeats its request.
        operator.turn(alpha, beta)
        operator.spin_until(operator.has_request, 20, 'what is waited for')
        operator.spin(2.0)
        assert node.popen.poll() is None
        # All other poses are right.
        for _ in range(2, 21):
            before = alpha
            number, alpha, beta, _ = operator.request()
            if number == 4:
                # The joint that stays moves by less than a step of its encoder, and back.
                step = 1e-4 * np.array([alpha == before, alpha != before])
                operator.command(*(step + [alpha, beta]).tolist())
            operator.turn(alpha, beta)
            done, answer = operator.ask()
            assert done, answer
            operator.spin_until(lambda number=number: (tmp_path / 'unit.yaml').exists()
                                or operator.request()[0] > number, 30, 'the next pose')
        operator.spin_until((tmp_path / 'unit.yaml').exists, 60, 'the file')
    truth = parameter_file.load(tmp_path / 'truth.yaml')
    fitted = parameter_file.load(tmp_path / 'unit.yaml')
    np.testing.assert_allclose(fitted.zero_g_v, truth.zero_g_v, atol=0.01)
    _, entries = sweep_journal.read(tmp_path / 'unit.yaml.journal')
    poses = sweep_journal.accepted_poses(entries)
    assert all(e.samples == 400 for e in poses)
    # Pose 2 was reached on a detour, and before pose 4 only the command shows the second joint.
    angles = [[pose.alpha_rad, pose.beta_rad] for pose in poses]
    settings = [[pose.alpha_setting, pose.beta_setting] for pose in poses]
    turned, moved = (np.abs(np.diff(rows, axis=0)) > 0.01 for rows in (angles, settings))
    turned[2] = True
    assert (moved[1:] == turned[1:]).all()


def test_a_compensated_stream_and_a_wrong_rate_are_refused(start, tmp_path):
    """A stream of compensated samples or with missing samples is reported at once."""
    base = nominal(serial='T4')
    parameter_file.save(tmp_path / 'bare.yaml', base)
    with Operator() as operator:
        start('driver', '--ros-args', '--params-file', tmp_path / 'bare.yaml', '-p',
              'link.type:=sim')
        start('compensation', '--ros-args', '--params-file', tmp_path / 'bare.yaml')
        start('calibration', '--ros-args', '--params-file', tmp_path / 'bare.yaml', *PLAN, '-p',
              'stage.mode:=manual', '-r', 'imu/data_raw:=imu/data')
        start('calibration', '--ros-args', '--params-file', tmp_path / 'bare.yaml', *PLAN, '-p',
              'stage.mode:=manual', '-r', '__node:=other', '-r', 'imu/data_raw:=half',
              '-p', 'journal:=other.journal')
        raw = operator.listen(Imu, 'imu/data_raw')
        half = operator.node.create_publisher(Imu, 'half', 1000)

        dead = []

        def feed_half():
            for message in raw[::2]:
                if dead:
                    message.linear_acceleration.x = float('nan')
                half.publish(message)
            raw.clear()
        operator.node.create_timer(0.1, feed_half)
        operator.spin_until(lambda: operator.reports('calibration', 'this stream is already '
                                                     'compensated'), 60, 'why')
        assert operator.ask()[1].startswith('/imu/data: this stream is already compensated')
        operator.spin_until(lambda: operator.reports('other', 'samples are 500 a second'), 60,
                            'the reason')
        dead.append('x')
        operator.spin_until(lambda: operator.reports('other', 'x is not a number in all samples'),
                            60, 'which axis')
