# SPDX-License-Identifier: Apache-2.0

"""Full disks, restarted drivers, other units and settings: no pose is lost."""

import os
import resource

from adxl_ros.calibrate.guided.capture_settings import CaptureSettings, StageMode
from adxl_ros.calibrate.guided.session_settings import SessionSettings
from adxl_ros.files import parameter_file, sweep_journal
from graph import Graph, RELIABLE
import numpy as np
import pytest
from std_srvs.srv import Trigger
from units import drawn, nominal, pose_record

FAST = ('-p', 'use_sim_time:=true')
RATE_HZ = 200.0
SPEED = ('-p', 'link.speed:=10.0')
PLAN = ('-p', 'sweep.planes_rad:=[0.785, 1.5707963267948966, 2.356]', '-p',
        'sweep.step_rad:=0.7853981633974483', '-p', 'sweep.dwell_s:=1.0', '-p',
        'sweep.check_poses:=4', '-p', 'output:=unit.yaml', '-p', 'autostart:=true', *RELIABLE)


def _driver(start, tmp_path, serial='N1'):
    base = nominal(serial=serial, rate_hz=RATE_HZ)
    parameter_file.save(tmp_path / f'{serial}.yaml', drawn(np.random.default_rng(3), base))
    return start('driver', '--ros-args', '--params-file', tmp_path / f'{serial}.yaml', '-p',
                 'link.type:=sim', *SPEED, *FAST)


def _stage(start, tmp_path):
    parameter_file.save(tmp_path / 'bare.yaml', nominal(rate_hz=RATE_HZ))
    return start('stage', '--ros-args', '--params-file', tmp_path / 'bare.yaml', *FAST, '-p',
                 'slew_rate_rad_s:=3.0')


def _calibration(start, tmp_path, *options):
    return start('calibration', '--ros-args', '--params-file', tmp_path / 'bare.yaml', *FAST,
                 *PLAN, *options)


def _accepted(graph):
    return int(graph.value('calibration', 'accepted')) if 'calibration' in graph.diagnostics else 0


def _on_disk(tmp_path):
    return sweep_journal.accepted_poses(sweep_journal.read(tmp_path / 'unit.yaml.journal')[1])


def _begun(graph, start, tmp_path, poses):
    """Begin a sweep, and return driver and calibration after some poses."""
    driver = _driver(start, tmp_path)
    _stage(start, tmp_path)
    node = _calibration(start, tmp_path)
    graph.spin_until(lambda: _accepted(graph) >= poses, 60, f'{poses} poses')
    return driver, node


def test_a_full_disk_is_reported_and_the_sweep_continues_with_room(start, tmp_path):
    """A pose that is not on disk is not acknowledged. With room the sweep continues."""
    with Graph() as graph:
        _, node = _begun(graph, start, tmp_path, 2)
        size = (tmp_path / 'unit.yaml.journal').stat().st_size
        # A limit of the file size acts on the journal as a full disk, without root.
        unlimited = resource.prlimit(node.popen.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(node.popen.pid, resource.RLIMIT_FSIZE, (size + 100, unlimited[1]))
        node.wait_for('cannot write the journal: the disk is full; make room and try again')
        full = len(_on_disk(tmp_path))
        graph.spin(2.0)
        assert len(_on_disk(tmp_path)) == full
        resource.prlimit(node.popen.pid, resource.RLIMIT_FSIZE, unlimited)
        graph.spin_until(lambda: _accepted(graph) >= full + 3, 60, 'more poses')
        assert node.popen.poll() is None and 'Traceback' not in node.output()
    assert [entry.pose for entry in _on_disk(tmp_path)][:full + 3] == list(range(full + 3))


def test_a_restarted_driver_is_accepted_and_another_unit_is_not(start, tmp_path):
    """The clock of a new driver may be behind. The present pose restarts, the others are kept."""
    with Graph() as graph:
        driver, node = _begun(graph, start, tmp_path, 2)
        driver.stop()
        before = _on_disk(tmp_path)
        graph.spin_until(lambda: graph.reports('calibration', 'nothing on /imu/data_raw'), 20,
                         'the reason')
        assert 'and nobody publishes it' in graph.diagnostics['calibration'].message
        driver = _driver(start, tmp_path)
        graph.spin_until(lambda: _accepted(graph) >= len(before) + 3, 60, 'more poses')
        assert _on_disk(tmp_path)[:len(before)] == before
        driver.stop()
        _driver(start, tmp_path, 'N2')
        node.wait_for('serial was N1, is N2: changed during the calibration')
    assert len(_on_disk(tmp_path)) >= len(before) + 3


def test_a_failed_fit_waits_for_a_decision_and_another_unit_ends_the_session(start, tmp_path):
    """Redo, finish and abort are possible. The journal has no pose of the other unit."""
    base = nominal(serial='N1', rate_hz=RATE_HZ)
    parameter_file.save(tmp_path / 'bare.yaml', base)
    capture = CaptureSettings(0.5, np.radians(0.2), 60.0, StageMode.MANUAL, np.radians(2))
    settings = SessionSettings(
        'stage', 'full', (np.pi / 2,), np.pi / 2, float(np.radians(0.1)), 0, capture,
        tmp_path / 'unit.yaml', tmp_path / 'unit.yaml.journal', '', '')
    interrupted = sweep_journal.Journal(settings.journal, settings.head(base))
    for i, target in enumerate(settings.targets(base)):
        interrupted.append(pose_record(
            i, alpha_rad=target.alpha_rad, beta_rad=target.beta_rad, samples=100,
            # No fit accepts an inverted unit.
            mean_v=(2.5 - np.cos(target.beta_rad), 2.5 - np.sin(target.beta_rad))))
    interrupted.close()
    with Graph() as graph:
        driver = _driver(start, tmp_path)
        node = start(
            'calibration', '--ros-args', '--params-file', tmp_path / 'bare.yaml', *FAST, '-p',
            'output:=unit.yaml', '-p', 'autostart:=true', '-p', 'stage.mode:=manual', '-p',
            f'sweep.planes_rad:=[{np.pi / 2}]', '-p', f'sweep.step_rad:={np.pi / 2}', '-p',
            'sweep.dwell_s:=0.5', '-p', 'sweep.check_poses:=0')
        graph.spin_until(lambda: graph.reports('calibration', 'cannot finish: '), 60, 'why')
        assert graph.reports('calibration', '; finish again, redo or abort')
        assert node.output().count('fitting 10 poses') == 1
        answer = graph.call(Trigger, 'calibration/redo', Trigger.Request())
        assert answer.success and answer.message == 'pose 10 will be taken again'
        driver.stop()
        _driver(start, tmp_path, 'N2')
        node.wait_for('sensor_info: is of the sensor N2, but the parameters are of N1; give the '
                      'parameters of that sensor, or nominal ones; the poses are kept', 60)
        answer = graph.call(Trigger, 'calibration/capture', Trigger.Request())
        assert (answer.success, answer.message) == (False, 'no calibration is running')
    assert len(_on_disk(tmp_path)) == 9 and not (tmp_path / 'unit.yaml').exists()
    assert 'Traceback' not in node.output()


@pytest.mark.kills
def test_a_new_start_resumes_or_names_the_change_or_starts_over(start, tmp_path):
    """Without a terminal it resumes, refuses other settings, and starts over with resume:=anew."""
    with Graph() as graph:
        _, first = _begun(graph, start, tmp_path, 3)
        os.kill(first.popen.pid, 9)
        first.wait()
        poses = _on_disk(tmp_path)

        other = _calibration(start, tmp_path, '-p', 'sweep.step_rad:=0.5235987755982988')
        other.wait_for('holds an unfinished calibration of another kind')
        assert 'sweep.step_rad was 0.7853981633974483, is 0.5235987755982988' in other.output()
        assert 'resume:=anew' in other.output()
        other.stop()
        assert _on_disk(tmp_path) == poses

        again = _calibration(start, tmp_path)
        again.wait_for(f'resumed after {len(poses)} poses (the last one first, to see that the '
                       'mounting is as it was); resume:=anew puts them aside')
        again.wait_for('the sensor is mounted as it was')
        again.wait_for(f'pose {len(poses) + 1} is on disk')
        again.stop()
        assert _on_disk(tmp_path)[:len(poses)] == poses

        anew = _calibration(start, tmp_path, '-p', 'resume:=anew')
        anew.wait_for('pose 1 is on disk', 60)
        kept, = tmp_path.glob('unit.yaml.journal.2*')
        assert sweep_journal.accepted_poses(sweep_journal.read(kept)[1])[:len(poses)] == poses


@pytest.mark.kills
def test_another_mounting_stops_before_a_pose_is_taken(start, tmp_path):
    """The sensor is mounted again with a turn of 2°, and the last pose shows it."""
    with Graph() as graph:
        driver = _driver(start, tmp_path)
        _stage(start, tmp_path)
        first = _calibration(start, tmp_path)
        graph.spin_until(lambda: _accepted(graph) >= 3, 60, 'three poses')
        os.kill(first.popen.pid, 9)
        driver.stop()
        poses = _on_disk(tmp_path)
        unit = parameter_file.load(tmp_path / 'N1.yaml')
        unit.values['misalignment']['beta_rad'] += np.radians([-2.0, 2.0])
        parameter_file.save(tmp_path / 'N1.yaml', unit)
        start('driver', '--ros-args', '--params-file', tmp_path / 'N1.yaml', '-p',
              'link.type:=sim', *SPEED, *FAST)
        again = _calibration(start, tmp_path)
        again.wait_for(f'mounting changed: in pose {len(poses)} ', 60)
        assert 'before the interruption' in again.output()
    assert _on_disk(tmp_path) == poses
