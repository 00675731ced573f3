# SPDX-License-Identifier: Apache-2.0

"""The screen in a real terminal: its contents, its keys, and its end."""

from functools import partial
import os
from pathlib import Path
import re
import signal

from adxl_ros.files import parameter_file, sweep_journal
from graph import Graph, RELIABLE
import numpy as np
from processes import children
import pytest
from sensor_msgs.msg import JointState
from units import drawn, nominal

FAST = ('-p', 'use_sim_time:=true')
PLAN = (
    '-p',
    'sweep.planes_deg:=[45.0, 90.0]',
    '-p',
    'sweep.step_deg:=90.0',
    '-p',
    'sweep.dwell_s:=1.5',
    '-p',
    'sweep.check_poses:=2',
    '-p',
    'output:=unit.yaml',
    *RELIABLE,
)
OTHERS = '\x1b[A\x1b[1;5A\x1bOA\x1bOS\x1b[[A\x1b[M af\x1b[<65;10;10M\x1b[15~\x1bq'
"""Arrow up, with Ctrl, of keypad mode; F4; F1 of a console; a mouse's wheel twice; F5; Alt-q."""


@pytest.fixture
def terminal(in_terminal, tmp_path):
    base = nominal('xyz', serial='T1', rate_hz=200.0)
    parameter_file.save(tmp_path / 'truth.yaml', drawn(np.random.default_rng(3), base))
    parameter_file.save(tmp_path / 'bare.yaml', base)

    return partial(
        in_terminal, 'calibration', '--ros-args', '--params-file', tmp_path / 'bare.yaml', *PLAN
    )


class Hands(Graph):
    """An operator who turns the stage."""

    def __enter__(self):
        super().__enter__()
        self.stage_states = self.listen(JointState, 'stage/joint_states')
        self.command = self.node.create_publisher(JointState, 'stage/command', 10)
        return self

    def turn(self, alpha_deg, beta_deg):
        def there():
            self.command.publish(
                JointState(
                    name=['alpha', 'beta'], position=[np.radians(alpha_deg), np.radians(beta_deg)]
                )
            )
            self.spin(0.1)
            last = self.stage_states[-1] if self.stage_states else None
            return (
                last
                and np.abs(last.velocity).max() < 1e-4
                and np.allclose(np.degrees(last.position[:2]), [alpha_deg, beta_deg], atol=0.1)
            )

        self.spin_until(there, 30, f'the stage at {alpha_deg}, {beta_deg}')


def bench(start, tmp_path):
    start(
        'driver',
        '--ros-args',
        '--params-file',
        tmp_path / 'truth.yaml',
        '-p',
        'link.type:=sim',
        '-p',
        'link.speed:=4.0',
        *FAST,
    )
    start(
        'stage',
        '--ros-args',
        '--params-file',
        tmp_path / 'bare.yaml',
        *FAST,
        '-p',
        'slew_rate_rad_s:=3.0',
    )


def test_the_screen_guides_an_operator_through_a_sweep(start, terminal, tmp_path):
    bench(start, tmp_path)
    (tmp_path / 'unit.yaml').write_text('the earlier one\n')
    with Hands() as hands:
        seen = terminal(*FAST, '-p', 'stage.mode:=encoder')
        seen.wait_for(
            'press b to begin; plan full: 22 poses, about 2 min, expected tilt error',
            'calibration of T1 (xyz) into unit.yaml',
            '200 Hz',
        )
        seen.press('b')
        screen = seen.wait_for(
            'turn the stage to alpha 45.0°, beta 0.0°, then capture',
            'alpha 0.00° (-45.00°)',
            '0 done, 22 left',
            'tilt error',
            'must be below',
            'misalignment.beta_rad',
            '45° 0/10',
            'c  capture',
        )
        assert 'check poses 0/2' in ' '.join(screen.split())
        # Arrows, a wheel and function keys have no effect. The key c follows them.
        seen.press(OTHERS)
        for byte in OTHERS:
            seen.press(byte)
        seen.press('c')
        seen.wait_for('alpha is 45.0° from the target 45°')
        before = _tilt(screen)
        for number, (alpha, beta) in enumerate(((45, 0), (90, 0), (90, 90), (45, 90)), 1):
            hands.turn(alpha, beta)
            seen.wait_for(
                f'{number} of 22', f'alpha {alpha:.2f}° (+0.00°)', f'beta {beta:.2f}° (+0.00°)'
            )
            seen.press('c')
            seen.wait_for(f'{number} done', timeout_s=40)
        screen = seen.wait_for('45° 2/10', 'beta forth 1/4', 'at rest')
        assert _tilt(screen) < before / 2
        seen.press('s')
        seen.wait_for('1 left out', 'alpha 90.0°, beta 180.0°')
        seen.press('r')
        seen.wait_for('turn the stage to alpha 45.0°, beta 180.0°')
        seen.press('a')
        seen.wait_for('aborted; its poses stay in unit.yaml.journal', 'b  begin')
        seen.press('b')
        seen.wait_for('unit.yaml.journal holds 4 poses of an interrupted calibration', 'y  go on')
        seen.press('y')
        seen.wait_for(
            'once more, to see that the mounting is', 'alpha 45.0°, beta 90.0°', 'c  capture'
        )
        seen.press('c')
        seen.wait_for('turn the stage to alpha 45.0°, beta 180.0°')
        seen.press('s')
        seen.wait_for('alpha 90.0°, beta 180.0°')
        hands.turn(90, 180)
        seen.press('c')
        seen.wait_for('5 done')
        seen.resize(24, 80)
        screen = seen.wait_for('5 done', 'c  capture')
        # The line is complete: each axis with its interval.
        assert re.search(r'(?m)^bias.* x \S+±\S+ y \S+±\S+ z \S+±\d\S*$', screen), screen
        seen.press('f')
        seen.wait_for('wrote unit.yaml', 'NOT SHOWN  no pose was kept out of the fit', 'b  begin')
        seen.press('b')
        seen.wait_for('unit.yaml.journal holds 5 poses of an interrupted calibration', 'y  go on')
        seen.press('q')
        assert seen.wait() == 0
        assert seen.restored()
        assert 'pose 6 is on disk' in seen.raw.decode().split('\x1b[?1049l')[-1]
    assert parameter_file.load(tmp_path / 'unit.yaml').serial == 'T1'
    assert (tmp_path / 'unit.yaml.previous').read_text() == 'the earlier one\n'
    entries = sweep_journal.read(tmp_path / 'unit.yaml.journal').entries
    poses = sweep_journal.accepted_poses(entries)
    assert len(poses) == 5 and sweep_journal.skipped_poses(entries) == {4}
    # The screen causes no loss: every pose has all samples.
    assert all(e.stop_ns - e.start_ns == 5_000_000 * (e.samples - 1) for e in poses)


def _tilt(screen):
    line = next(line for line in screen.splitlines() if line.startswith('tilt error'))
    return float(line.split()[2].rstrip('°'))


@pytest.mark.parametrize('how', ['ctrl-c', 'term', 'kill', 'kill of the screen'])
def test_the_terminal_is_restored(terminal, kill, how):
    seen = terminal()
    seen.wait_for('press b to begin')
    (screen,) = children(seen.popen.pid)
    if how == 'ctrl-c':
        seen.press('\x03')
    elif how == 'kill of the screen':
        kill(screen)
        seen.wait_for('the screen has ended; plain lines from here on')
        assert seen.restored() and seen.popen.poll() is None
        seen.press('\x03')
    elif how == 'kill':
        kill(seen.popen.pid)
    else:
        os.kill(seen.popen.pid, signal.SIGTERM)
    assert seen.wait() == (-signal.SIGKILL if how == 'kill' else 0)
    with Graph() as graph:
        graph.spin_until(
            lambda: seen.restored() and not Path(f'/proc/{screen}').exists(),
            20,
            'the terminal as it was',
        )
