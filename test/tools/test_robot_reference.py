# SPDX-License-Identifier: Apache-2.0

"""A robot in place of the stage, by its URDF and a bag with its joint states."""

import json

from adxl_ros.files import parameter_file
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import get, to_nominal_mps2
from adxl_ros.simulate.motion import ForcePath, Motion
from adxl_ros.simulate.response import Response
from adxl_ros.simulate.robot import Robot
from bags import bag_of, EPOCH_NS, imu, joints
import numpy as np
import pytest
from robots import encoded, urdf
from units import nominal, with_effects

pytest.importorskip('pinocchio')
RATE_HZ, STEP_RAD, SPAN_S = 50.0, 1e-5, 60.0
WRIST = [('0 0 1', '0 0 0.3'), ('0 1 0', '0.2 0 0.1'), ('1 0 0', '0.3 0 0')]
FILE = {'rate_hz': RATE_HZ, 'noise_density_g_per_rthz': np.full(3, 1e-4)}


def poses(time_s):
    """Return angle, rate and acceleration of three joints that turn and rest, (3, n, 3)."""
    time_s = np.clip(time_s, 0, SPAN_S)
    out = np.zeros((3, len(time_s), 3))
    rng = np.random.default_rng(4)
    for joint in range(3):
        for step in range(int(SPAN_S / 2)):
            u = np.clip(time_s - 2 * step, 0, 1)
            turn = rng.uniform(-1.2, 1.2) - (out[0, -1, joint] if step % 2 else 0)
            for order, values in enumerate(
                (
                    u**4 * (35 - 84 * u + 70 * u**2 - 20 * u**3),
                    140 * u**3 * (1 - u) ** 3,
                    420 * u**2 * (1 - u) ** 2 * (1 - 2 * u),
                )
            ):
                out[order, :, joint] += turn * values
    return out


@pytest.fixture(scope='module')
def robot(tmp_path_factory):
    """Give a function that writes a bag of the robot with a sensor of some effects."""
    folder = tmp_path_factory.mktemp('robot')
    (folder / 'robot.urdf').write_text(urdf(WRIST, 0.1, '0.3 0.2 -0.4'))
    parameter_file.save(folder / 'unit.yaml', nominal('xyz', **FILE), [])
    fine_s = np.arange(0, SPAN_S, 1e-3)
    arm = Robot(folder / 'robot.urdf', 'imu_link')
    force = arm.motion(poses(fine_s), None, 9.80665).force_mps2

    def record(name, *effects, joint_offset_rad=0.0):
        sensor = with_effects(nominal('xyz', **FILE), effects)
        time_s = np.arange(1, SPAN_S - 1, 1 / RATE_HZ)
        volts = Response(sensor, Motion(SPAN_S, force=ForcePath(fine_s, force)), 1, 1.0)(time_s)
        readings = encoded(poses(fine_s[::4])[0] - [0, joint_offset_rad, 0], STEP_RAD)
        bag_of(
            folder / name,
            [
                *(
                    imu(EPOCH_NS + round(t * 1e9), a, variance=(1e-4,) * 3)
                    for t, a in zip(time_s, to_nominal_mps2(volts, sensor))
                ),
                *(
                    joints(
                        EPOCH_NS + round(t * 1e9),
                        '/joint_states',
                        gripper=0.1,
                        **{f'j{k + 1}': q for k, q in enumerate(row)},
                    )
                    for t, row in zip(fine_s[::4], readings)
                ),
            ],
        )
        return folder / name

    return record


@pytest.mark.long
@pytest.mark.parametrize(
    ('effects', 'offset_rad', 'status', 'named'),
    [
        ((), 0.0, 'no_gap', []),
        (('scale_factor:offset_v_per_g=0.01',), 0.0, 'explained', ['scale_factor']),
        ((), 0.005, 'explained', ['joint_offset']),
    ],
    ids=['none', 'scale_factor', 'joint_offset'],
)
def test_diagnose_names_what_is_wrong(robot, run_tool, effects, offset_rad, status, named):
    """Of sensor and robot, and nothing where nothing is."""
    bag = robot(f'run{len(effects)}{offset_rad}', *effects, joint_offset_rad=offset_rad)
    done = run_tool(
        'diagnose',
        bag,
        '--urdf',
        bag.parent / 'robot.urdf',
        '--params',
        bag.parent / 'unit.yaml',
        '--in',
        'tilt',
        '-o',
        bag.parent / 'gap',
        '--json',
    )
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    verdict = report['verdict']
    assert (verdict['status'], verdict['effects']) == (status, named)
    assert report['gap_in']['unit'] == 'deg'
    assert report['gap_in']['after'] < 1.3 * report['gap_in']['floor']


def test_fit_takes_poses_of_the_robot(robot, run_tool):
    """Zero-g and scale factor are those of the unit."""
    bag = robot('poses', 'bias:offset_v=0.02', 'scale_factor:offset_v_per_g=0.01')
    output = bag.parent / 'fitted.yaml'
    done = run_tool(
        'fit',
        bag,
        '--urdf',
        bag.parent / 'robot.urdf',
        '--params',
        bag.parent / 'unit.yaml',
        '--model',
        'linear',
        '-o',
        output,
    )
    assert done.returncode == 0, done.stderr
    fitted = parameter_file.load(output)
    names = [Coefficient('bias', 'offset_v', axis) for axis in 'xyz']
    assert get(fitted, names) == pytest.approx(0.02, abs=2e-3)
    assert fitted.scale_v_per_g == pytest.approx(1.01, abs=2e-3)


def test_a_recording_without_joints_is_refused(robot, run_tool, tmp_path):
    """It is named as well where it is the earlier one of a comparison."""
    accel = np.random.default_rng(3).normal([0, 0, 9.8], 0.05, (400, 3))
    messages = [imu(EPOCH_NS + k * 10_000_000, tuple(row)) for k, row in enumerate(accel)]
    bag_of(tmp_path / 'bare', messages)
    bag = robot('any')
    urdf = '--urdf', bag.parent / 'robot.urdf'
    done = run_tool('diagnose', tmp_path / 'bare', *urdf, '-o', 'gap')
    assert done.returncode == 1
    assert 'no topic of type sensor_msgs/msg/JointState' in done.stderr
    assert len(done.stderr.splitlines()) == 1
    done = run_tool('check', bag, '--against', tmp_path / 'bare', *urdf, '--fail-on', 'rate')
    assert 'no topic of type sensor_msgs/msg/JointState' in ' '.join(done.stdout.split())
