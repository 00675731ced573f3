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

"""A hand-turned stage, and an operator who makes mistakes: what is said, and what is taken."""

from adxl_ros.files import parameter_file, sweep_journal
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from graph import Graph, RELIABLE
import numpy as np
import pytest
from sensor_msgs.msg import Imu, JointState, Temperature
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from units import drawn, nominal

FAST = ('-p', 'use_sim_time:=true')
PLAN = ('-p', 'sweep.planes_rad:=[0.7853981633974483, 1.5707963267948966]', '-p',
        'sweep.step_rad:=1.5707963267948966', '-p', 'sweep.dwell_s:=2.0', '-p',
        'sweep.check_poses:=0', '-p', 'output:=unit.yaml', '-p', 'autostart:=true')


class Operator(Graph):
    """Turns the stage, as told or not, and asks for a capture."""

    def __enter__(self):
        super().__enter__()
        self.shown = self.listen(JointState, 'stage/joint_states')
        self.announced = self.listen(DiagnosticStatus, 'calibration/next_pose', latched=True)
        self.commands = self.node.create_publisher(JointState, 'stage/command', 10)
        return self

    def asked(self):
        """Return what is announced: number, alpha, beta, and the words."""
        newest = self.announced[-1]
        told = {pair.key: pair.value for pair in newest.values}
        return (int(told['pose']), float(told['alpha_rad']), float(told['beta_rad']),
                newest.message)

    def is_told_where(self):
        """Tell whether the newest diagnostics ask for a pose, or say how far off it is."""
        said = self.diagnostics['calibration'].message if 'calibration' in self.diagnostics else ''
        return 'then capture' in said or 'from the asked' in said

    def command(self, alpha, beta, shift=0.0):
        """Let go of the stage somewhere on its way to a pose."""
        self.commands.publish(JointState(name=['alpha', 'beta', 'shift'],
                                         position=[alpha, beta, shift]))

    def turn(self, alpha, beta):
        """Turn the stage and wait until it is there and rests."""
        def there():
            self.command(alpha, beta)
            self.spin(0.1)
            last = self.shown[-1] if self.shown else None
            return last and np.abs(last.velocity).max() < 1e-4 and np.allclose(
                last.position[:2], [alpha, beta], atol=2e-3)
        self.spin_until(there, 30, f'the stage at {alpha}, {beta}')

    def ask(self, name='capture', meanwhile=None):
        """Call a service, do something meanwhile, and return its answer."""
        client = self.node.create_client(Trigger, f'calibration/{name}')
        assert client.wait_for_service(20)
        future = client.call_async(Trigger.Request())
        if meanwhile:
            self.spin(0.25)
            meanwhile()
        self.spin_until(future.done, 40, f'answer of {name}')
        return future.result().success, future.result().message


def _bench(start, tmp_path, mode):
    base = nominal(serial='T1')
    parameter_file.save(tmp_path / 'truth.yaml', drawn(np.random.default_rng(3), base))
    parameter_file.save(tmp_path / 'bare.yaml', base)
    start('driver', '--ros-args', '--params-file', tmp_path / 'truth.yaml', '-p',
          'link.speed:=4.0', *FAST)
    start('stage', '--ros-args', '--params-file', tmp_path / 'bare.yaml', *FAST, '-p',
          'slew_rate_rad_s:=1.5', '-p', 'slew_rate_m_s:=2.0', '-p', 'settling_time_s:=0.1')
    return start('calibration', '--ros-args', '--params-file', tmp_path / 'bare.yaml', *FAST,
                 *RELIABLE, *PLAN, '-p', f'stage.mode:={mode}', '-p', 'stage.timeout_s:=3.0')


def test_an_operator_who_makes_mistakes_ends_with_a_good_file(start, tmp_path):
    """Wrong pose, too early, knocks the table, goes on too early, walks away: all is told."""
    with Operator() as operator:
        node = _bench(start, tmp_path, 'encoder')
        operator.spin_until(lambda: operator.announced, 60, 'the first pose')
        number, alpha, beta, words = operator.asked()
        assert (number, alpha, beta) == (1, np.pi / 4, 0.0)
        assert words == 'pose 1 of 20: turn the stage to alpha 45.0°, beta 0.0°, then capture'
        # A wrong pose.
        operator.turn(alpha, np.radians(3.2))
        operator.spin_until(operator.is_told_where, 20, 'an angle that calibration has heard')
        assert operator.ask() == (
            False, 'beta is 3.2° from the asked 0°; turn the stage there and capture again')
        # Too early: the stage is still turning.
        operator.turn(alpha, 4 * np.pi)
        operator.command(alpha, beta)
        early, said = operator.ask()
        assert not early and 'from the asked 0°' in said
        operator.turn(alpha, beta)
        # The table is knocked during the dwell: the pose is averaged anew, and is as good.
        done, said = operator.ask(meanwhile=lambda: (operator.command(alpha, beta, 0.02),
                                                     operator.spin(0.1),
                                                     operator.command(alpha, beta, 0.0)))
        assert done and said == 'pose 1 is on disk'
        # Goes on to the next pose before this one is taken.
        number, alpha, beta, _ = operator.asked()
        assert number == 2
        operator.turn(alpha, beta)
        done, said = operator.ask(meanwhile=lambda: operator.turn(alpha, beta + np.pi / 4))
        assert not done and f'beta is 45.0° from the asked {np.degrees(beta):.4g}°' in said
        # Walks away: nothing is lost, nothing ends, and what is waited for is still said.
        operator.turn(alpha, beta)
        operator.spin_until(operator.is_told_where, 20, 'what is waited for')
        operator.spin(2.0)
        assert node.popen.poll() is None
        # And then does it right.
        for _ in range(2, 21):
            before = alpha
            number, alpha, beta, _ = operator.asked()
            if number == 4:
                # The joint that stays, away by less than a step of its encoder, and back.
                off = 1e-4 * np.array([alpha == before, alpha != before])
                operator.command(*(off + [alpha, beta]).tolist())
            operator.turn(alpha, beta)
            done, said = operator.ask()
            assert done, said
            operator.spin_until(lambda number=number: (tmp_path / 'unit.yaml').exists()
                                or operator.asked()[0] > number, 30, 'the next pose')
        operator.spin_until((tmp_path / 'unit.yaml').exists, 60, 'the file')
    want = parameter_file.load(tmp_path / 'truth.yaml')
    found = parameter_file.load(tmp_path / 'unit.yaml')
    np.testing.assert_allclose(found.zero_g_v, want.zero_g_v, atol=0.01)
    _, entries = sweep_journal.read(tmp_path / 'unit.yaml.journal')
    poses = sweep_journal.accepted_poses(entries)
    assert all(e.samples == 2000 for e in poses)
    # Pose 2 was reached by other ways, and for pose 4 only the command tells of the second joint.
    angles = [[pose.alpha_rad, pose.beta_rad] for pose in poses]
    settings = [[pose.alpha_setting, pose.beta_setting] for pose in poses]
    turned, moved = (np.abs(np.diff(rows, axis=0)) > 0.01 for rows in (angles, settings))
    turned[2] = True
    assert (moved[1:] == turned[1:]).all()


def test_by_hand_the_next_direction_is_announced_in_words(start, tmp_path):
    """No stage: what is to point up, on the topic and in the log."""
    base = nominal('xyz', serial='T3')
    parameter_file.save(tmp_path / 'bare.yaml', base)
    with Operator() as operator:
        start('driver', '--ros-args', '--params-file', tmp_path / 'bare.yaml')
        node = start('calibration', '--ros-args', '--params-file', tmp_path / 'bare.yaml', '-p',
                     'mode:=gravity', '-p', 'autostart:=true')
        operator.spin_until(lambda: operator.announced, 60, 'the first direction')
        newest = operator.announced[-1]
        assert newest.message == 'turn it so that +z points up, and hold it still'
        told = {pair.key: float(pair.value) for pair in newest.values}
        assert [told[f'up_{axis}'] for axis in 'xyz'] == [0.0, 0.0, 1.0]
        assert operator.ask('skip') == (True, '+z up is left out')
        operator.spin_until(lambda: '+z points up' not in operator.announced[-1].message, 20,
                            'another direction')
        node.wait_for(operator.announced[-1].message)
        assert operator.ask() == (False, 'nothing to capture: hold the sensor still, and each '
                                         'rest is taken by itself')


def test_a_compensated_stream_and_a_wrong_rate_are_refused(start, tmp_path):
    """What is no raw stream of the unit is told at once, and taken again when it is right."""
    base = nominal(serial='T4')
    parameter_file.save(tmp_path / 'bare.yaml', base)
    with Operator() as operator:
        start('driver', '--ros-args', '--params-file', tmp_path / 'bare.yaml')
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
        operator.spin_until(lambda: operator.said('calibration', 'this stream is already '
                                                  'compensated'), 60, 'why')
        assert operator.ask()[1].startswith('/imu/data: this stream is already compensated')
        operator.spin_until(lambda: operator.said('other', 'samples are 500 a second'), 60, 'why')
        dead.append('x')
        operator.spin_until(lambda: operator.said('other', 'x is not a number in all samples'),
                            60, 'which axis')


def test_a_temperature_that_moved_is_refused_until_it_is_back(start, tmp_path):
    """By its figures, and what the pose had is in the journal."""
    with Operator() as operator:
        warm = operator.node.create_publisher(Temperature, 'temperature', 10)
        now = [23.0]
        # Its clock is not that of the samples.
        stamped = Header(stamp=Time(sec=2_000_000_000))
        operator.node.create_timer(0.05, lambda: warm.publish(Temperature(
            header=stamped, temperature=now[0])))
        node = _bench(start, tmp_path, 'commanded')
        operator.spin_until(lambda: any(np.isfinite(pose.temperature_c)
                                        for pose in _taken(tmp_path)),
                            60, 'a pose with its temperature')
        now[0] = 27.0
        operator.spin_until(lambda: operator.said(
            'calibration', 'temperature moved 4.0 °C since the first pose'), 30, 'why')
        now[0] = 23.5
        operator.spin_until(lambda: operator.diagnostics.get('calibration') and int(
            operator.value('calibration', 'accepted')) >= 4, 60, 'more poses')
    assert node.popen.poll() is None
    assert node.output().count('temperature is stamped ') == 1
    measured = [e.temperature_c for e in _taken(tmp_path) if np.isfinite(e.temperature_c)]
    assert measured[0] == pytest.approx(23.0) and max(measured) < 26.0


def _taken(tmp_path):
    path = tmp_path / 'unit.yaml.journal'
    begun = path.exists() and path.stat().st_size
    return sweep_journal.accepted_poses(sweep_journal.read(path)[1]) if begun else []
