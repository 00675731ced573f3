# SPDX-License-Identifier: Apache-2.0
"""The screen as a client of its own: beside a node without a terminal, before it, and after it."""

import re
import subprocess

from adxl_ros.files import parameter_file, sweep_journal
from graph import Graph, RELIABLE
import numpy as np
import pytest
from std_srvs.srv import Trigger
from units import drawn, nominal

FAST = ('-p', 'use_sim_time:=true')
PLAN = (
    '-p',
    'sweep.planes_deg:=[45.0, 90.0]',
    '-p',
    'sweep.step_deg:=15.0',
    '-p',
    'sweep.dwell_s:=0.6',
    '-p',
    'sweep.check_poses:=0',
    '-p',
    'output:=unit.yaml',
    *RELIABLE,
)


def bench(start, tmp_path):
    base = nominal('xyz', serial='T1', rate_hz=200.0)
    parameter_file.save(tmp_path / 'truth.yaml', drawn(np.random.default_rng(3), base))
    parameter_file.save(tmp_path / 'bare.yaml', base)
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
        'slew_rate_rad_s:=6.0',
        '-p',
        'settling_time_s:=0.1',
    )
    return start(
        'calibration', '--ros-args', '--params-file', tmp_path / 'bare.yaml', *FAST, *PLAN
    )


def test_a_screen_drives_the_sweep_of_a_node_without_a_terminal(start, in_terminal, tmp_path):
    node = bench(start, tmp_path)
    seen = in_terminal('screen', lines=24, columns=80)
    seen.wait_for('press b to begin', 'calibration of T1 (xyz) into unit.yaml', '200 Hz')
    seen.press('b')
    seen.wait_for(re.compile(r'\b([3-9]|[1-9]\d) done'), '45°', 's  skip')
    seen.press('s')
    seen.wait_for('1 left out')
    seen.press('a')
    seen.wait_for('aborted; its poses stay in unit.yaml.journal', 'b  begin')
    seen.press('b')
    seen.wait_for('poses of an interrupted calibration', 'y  go on')
    seen.press('y')
    text = seen.wait_for(re.compile(r'\b[1-9]\d done'), 'tilt error', 'f  finish')
    assert max(map(len, text.splitlines())) <= 79
    seen.press('f')
    # The acceptance of the fit stands in the place of the coefficients.
    seen.wait_for('wrote unit.yaml', 'limited by', timeout_s=60.0)
    assert parameter_file.load(tmp_path / 'unit.yaml').serial == 'T1'
    seen.press('q')
    assert seen.wait() == 0
    assert seen.restored()
    entries = sweep_journal.read(tmp_path / 'unit.yaml.journal').entries
    poses = sweep_journal.accepted_poses(entries)
    # The screen causes no loss: every pose has all samples.
    assert len(poses) >= 10
    assert all(e.stop_ns - e.start_ns == 5_000_000 * (e.samples - 1) for e in poses)
    assert node.popen.poll() is None
    with Graph() as graph:
        # Nobody is at a screen any more, so an interrupted calibration is resumed.
        graph.spin_until(
            lambda: not graph.node.count_clients('calibration/resume'), 30, 'no screen'
        )
        assert graph.call(Trigger, 'calibration/start', Trigger.Request()).success
    node.wait_for('resumed after')


def test_a_screen_waits_for_its_node_and_survives_it(start, in_terminal, kill):
    seen = in_terminal('screen', '--ros-args', '-r', '__ns:=/bench', '-p', 'node:=bridge')
    seen.wait_for('waiting for /bench/bridge', 'q  quit')
    names = ('--ros-args', '-r', '__ns:=/bench', '-r', '__node:=bridge')
    node = start('calibration', *names)
    seen.wait_for('press b to begin', 'b  begin')
    kill(node.popen.pid)
    seen.wait_for('waiting for /bench/bridge')
    # Keys without a node do nothing.
    seen.press('b')
    node = start('calibration', *names, '-p', 'output:=second.yaml')
    seen.wait_for('second.yaml', 'press b to begin')
    seen.press('b')
    seen.wait_for('waiting for sensor_info', 'a  abort')
    seen.press('a')
    seen.wait_for('aborted', 'b  begin')
    assert node.stop() == 0
    seen.wait_for('waiting for /bench/bridge')
    seen.press('\x03')
    assert seen.wait() == 0
    assert seen.restored()


@pytest.mark.parametrize('number', ['TERM', 'HUP'])
def test_a_signal_ends_a_screen_and_restores_its_terminal(in_terminal, number):
    seen = in_terminal('screen')
    seen.wait_for('waiting for /calibration')
    subprocess.run(['kill', f'-{number}', str(seen.popen.pid)], check=True)
    assert seen.wait() == 0
    assert seen.restored()


def test_a_screen_without_a_terminal_says_so(refusal):
    assert refusal('screen') == 'screen: the screen needs a terminal; run it in one\n'
