# SPDX-License-Identifier: Apache-2.0

"""An investigation on a simulated stage: verdict, limits, bag, and how it leaves the stage."""

from dataclasses import replace
from functools import partial
import json
import signal

from adxl_ros.files import parameter_file, recording
from adxl_ros.files.bag_messages import open_bag
from adxl_ros.model.sensor import with_neutral
from graph import Graph
import numpy as np
from processes import wait_until
import pytest
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from units import nominal

pytestmark = pytest.mark.long
SIM = ('-p', 'use_sim_time:=true')
FAST = (
    '-p',
    'limits.rate_deg_s:=60.0',
    '-p',
    'limits.beta_deg:=[-90.0,90.0]',
    '-p',
    'qos_overrides./imu/data_raw.subscription.reliability:=reliable',
    '-p',
    'qos_overrides./imu/data_raw.subscription.depth:=100000',
    '-p',
    'qos_overrides./stage/command.publisher.depth:=10000',
)
RATE_HZ = 50.0
RATE_RAD_S = np.radians(60)
LONG = '-p', 'limits.rate_deg_s:=3.0', '-p', 'limits.minutes:=6.0'
"""Manoeuvres of a minute of real time: a busy machine, too, sees and ends them."""
LONG_RATE_RAD_S = np.radians(3)
BETA_RAD = np.radians(90)


class Laboratory(Graph):
    """A driver and a stage, and what is commanded and measured there."""

    def __init__(self, start, folder):
        super().__init__()
        base = nominal(rate_hz=RATE_HZ)
        parameter_file.save(folder / 'nominal.yaml', base)
        unit = with_neutral(base, ['hysteresis'])
        values = unit.values['hysteresis'] | {'half_width_g': np.array([0.004, 0.003])}
        parameter_file.save(
            folder / 'unit.yaml', replace(unit, values={**unit.values, 'hysteresis': values})
        )
        self.folder, self._start = folder, start
        self.driver = start(
            'driver',
            '--ros-args',
            '--params-file',
            'unit.yaml',
            *SIM,
            '-p',
            'link.type:=sim',
            '-p',
            'link.speed:=6.0',
            '-p',
            'qos_overrides./imu/data_raw.publisher.depth:=100000',
        )
        self.stage = start('stage', '--ros-args', *SIM, '-p', 'slew_rate_rad_s:=3.0')

    def __enter__(self):
        super().__enter__()
        self.states = self.listen(JointState, 'stage/joint_states')
        self.commands = self.listen(JointState, 'stage/command')
        return self

    def investigate(self, *options, start=None):
        return (start or self._start)(
            'investigate', '--ros-args', '--params-file', 'nominal.yaml', *SIM, *FAST, *options
        )

    def wait_for_motion(self):
        del self.states[:]
        self.spin_until(
            lambda: (
                self.states
                and np.abs(np.subtract(self.states[-1].position, self.states[0].position)).max()
                > 0.1
            ),
            90,
            'motion',
        )

    def wait_for_rest(self):
        def rests():
            newest = self.states[-100:]
            return len(self.states) > 100 and max(np.abs(s.velocity).max() for s in newest) < 1e-6

        del self.states[:]
        self.spin_until(rests, 20, 'rest')
        return np.array(self.states[-1].position[:2])

    def check_commands(self, stops=0):
        """Check all commands; each stop commands the measured pose, which lags."""
        commands = np.array([c.position for c in self.commands])
        assert len(commands) > 10
        assert commands[:, 0].min() > -1e-9
        assert commands[:, 0].max() < np.pi + 1e-9
        assert np.abs(commands[:, 1]).max() < BETA_RAD + 1e-9
        # No step is longer than the limit of rate allows for the longest step in time.
        steps_rad = np.abs(np.diff(commands, axis=0)).max(axis=1)
        assert (steps_rad > 0.2 * RATE_RAD_S + 1e-9).sum() <= 2 * stops


@pytest.fixture
def laboratory(start, tmp_path):
    with Laboratory(start, tmp_path) as made:
        yield made


def messages_of(bag):
    with open_bag(bag) as opened:
        return sum(1 for _ in opened.messages('/imu/data_raw'))


def test_an_investigation_ends_with_the_effect_of_the_unit(laboratory, tmp_path):
    node = laboratory.investigate('-p', 'output:=found')
    laboratory.spin_until(lambda: node.popen.poll() is not None, 150, 'the verdict')
    output = node.output()
    assert node.popen.returncode == 0, output
    assert 'The recording shows hysteresis: 9' in output or 'hysteresis: 100 %' in output
    assert '  0.0 min  no gap' in output
    assert 'next: ' in output
    assert max(map(len, output.splitlines())) < 80
    laboratory.check_commands()
    laboratory.wait_for_rest()
    folder = tmp_path / 'found'
    read = recording.read(folder / 'bag')
    assert not read.cut
    assert np.diff(read.time_s).max() == pytest.approx(1 / RATE_HZ, abs=1e-6)
    assert {'alpha_rad', 'beta_rad', 'alpha_command_rad'} <= set(read.columns)
    report = json.loads((folder / 'report.json').read_text())
    assert report['verdict']['effects'] == ['hysteresis']
    assert 'hysteresis' in parameter_file.load(folder / 'params.yaml').effects
    for path in ('found/report.html', 'found/params.yaml', 'found/bag'):
        assert path in output
        assert (tmp_path / path).exists()
    page = (folder / 'report.html').read_text()
    assert 'ros2 run adxl_ros diagnose found/bag --params found/baseline.yaml -o' in page


def test_whatever_ends_an_investigation_leaves_the_stage_at_rest_and_the_bag_whole(
    laboratory, in_terminal, kill, tmp_path
):
    """The stage would move on for many seconds; it comes to rest near its pose at the end."""

    def killed(node):
        kill(node.popen.pid)

    def aborted(_):
        assert laboratory.call(Trigger, '/investigate/abort', Trigger.Request()).success

    def interrupted(_):
        terminal.wait_for(' s left')
        terminal.press('\x03')
        terminal.wait_for('Stopped without a verdict: Ctrl-C', ' wrote ')

    for number, end in enumerate((killed, aborted, interrupted)):
        if end is interrupted:
            terminal = node = laboratory.investigate(
                '-p', f'output:=run{number}', *LONG, start=partial(in_terminal, columns=80)
            )
            terminal.wait_for('0.0 min  no gap ', 'next: ', timeout_s=90)
        else:
            node = laboratory.investigate('-p', f'output:=run{number}', *LONG)
        laboratory.wait_for_motion()
        before = np.array(laboratory.states[-1].position[:2])
        end(node)
        rest = laboratory.wait_for_rest()
        # The topics are delayed by 1.5 s of real time at most: 9 s of the stage.
        assert np.abs(rest - before).max() < 9 * LONG_RATE_RAD_S, end.__name__
        wait_until(lambda node=node: node.popen.poll() is not None, 20, 'the end')
        bag = tmp_path / f'run{number}' / 'bag'
        if end is killed:
            assert node.popen.returncode == -signal.SIGKILL
        else:
            assert node.popen.returncode == 1
            assert end is interrupted or 'Stopped without a verdict' in node.output()
        read = recording.read(bag)
        assert bool(read.cut) is (end is killed)
        assert len(read) == messages_of(bag) > 5 * RATE_HZ
        assert np.diff(read.time_s).max() == pytest.approx(1 / RATE_HZ, abs=1e-6)
    laboratory.check_commands(3)
    assert ' s left' not in terminal.text()
    assert max(map(len, terminal.text().splitlines())) < 80


@pytest.mark.parametrize(
    'setting, reason',
    [
        (
            'limits.alpha_deg:=[90.0,10.0]',
            'limits.alpha_deg: [90.0, 10.0] is no lowest and highest',
        ),
        ('limits.beta_deg:=[0.0]', 'limits.beta_deg: [0.0] is no lowest and highest'),
        (
            'limits.rate_deg_s:=0.0',
            'limits.rate_deg_s: 0.0 is refused; expected DOUBLE, 0.1 to 180',
        ),
    ],
)
def test_limits_without_meaning_are_refused(refusal, setting, reason):
    assert reason in refusal('investigate', '--ros-args', '-p', setting)
