# SPDX-License-Identifier: Apache-2.0

"""Full disks, restarted drivers, other units and settings: no pose is lost."""

import resource

from adxl_ros.files import parameter_file, sweep_journal
from graph import Graph, RELIABLE
import numpy as np
from units import drawn, nominal

FAST = ('-p', 'use_sim_time:=true')
RATE_HZ = 200.0
SPEED = ('-p', 'link.speed:=10.0')
PLAN = ('-p', 'sweep.planes_deg:=[45.0, 90.0, 135.0]', '-p',
        'sweep.step_deg:=45.0', '-p', 'sweep.dwell_s:=1.0', '-p',
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
