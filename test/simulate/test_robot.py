# SPDX-License-Identifier: Apache-2.0

"""A robot as the reference, against closed forms."""

import adxl_ros as adxl
from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import ACCEL
from adxl_ros.files.robot_readings import JointTrack, RobotReadings
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.simulate.motion import ForcePath, Motion
from adxl_ros.simulate.response import ChainMemo, whole_response
from adxl_ros.simulate.robot import Robot, robot_path, RobotPath
import numpy as np
import pandas as pd
import pytest
from robots import encoded, urdf
import scipy
from units import nominal, with_effects

pytest.importorskip('pinocchio')
ARM_M, PENDULUM = 0.5, [('0 1 0', '0 0 1')]


def swing(time_s):
    """Return angle, rate and acceleration of a joint."""
    w, v = 2 * np.pi * 0.5, 2 * np.pi * 0.23
    return (
        0.8 * np.sin(w * time_s) + 0.5 * np.sin(v * time_s),
        0.8 * w * np.cos(w * time_s) + 0.5 * v * np.cos(v * time_s),
        -0.8 * w * w * np.sin(w * time_s) - 0.5 * v * v * np.sin(v * time_s),
    )


def pendulum_force(q, rate, acceleration):
    """Return the specific force at the end of an arm that turns about y, m/s², (n, 3)."""
    return np.column_stack(
        [
            -ARM_M * rate**2 - G0_MPS2 * np.sin(q),
            0 * q,
            -ARM_M * acceleration + G0_MPS2 * np.cos(q),
        ]
    )


@pytest.fixture
def pendulum(tmp_path):
    (tmp_path / 'robot.urdf').write_text(urdf(PENDULUM, ARM_M))
    return Robot(tmp_path / 'robot.urdf', 'imu_link')


def path_of(robot, rate_hz, step_rad, base=None, span_s=40.0):
    time_s = np.arange(0, span_s, 1 / rate_hz)
    time_s = time_s + np.random.default_rng(0).uniform(0, 2e-5, len(time_s))  # as read
    return RobotPath(
        robot,
        RobotReadings(
            'run',
            {
                'j1': JointTrack(time_s, encoded(swing(time_s)[0], step_rad)),
                'other': JointTrack(time_s, time_s),
            },
            base,
        ),
    )


@pytest.mark.parametrize(
    ('rate_hz', 'step_rad'), [(100, 0.0), (100, 1e-5), (250, 5e-5), (500, 1e-7), (500, 1e-3)]
)
def test_force_of_a_pendulum(pendulum, rate_hz, step_rad):
    """Its error is that which the steps of the encoder predict, which uneven stamps are not."""
    path, time_s = path_of(pendulum, rate_hz, step_rad), np.arange(2, 38, 0.003)
    assert path.step_rad == pytest.approx(step_rad, rel=0.3, abs=1e-7)
    error = np.array(path(time_s)).T - pendulum_force(*swing(time_s))
    predicted = np.column_stack([path.errors(time_s, c).std for c in range(3)])
    assert np.sqrt(np.mean(error**2)) < 3 * np.sqrt(np.mean(predicted**2)) + 1e-3


@pytest.mark.parametrize(('rate_hz', 'step_rad'), [(100, 1e-3), (250, 1e-4), (500, 1e-3)])
def test_memory_of_the_error(pendulum, rate_hz, step_rad):
    """What the predicted memory does not explain of the error is no larger than predicted."""
    path, step_s = path_of(pendulum, rate_hz, step_rad), 0.008
    time_s = np.arange(2, 38, step_s)
    error = np.array(path(time_s)).T - pendulum_force(*swing(time_s))
    for component in (0, 2):
        errors = path.errors(time_s, component)
        scaled, memory = (
            error[:, component] / errors.std,
            np.exp(-errors.forgetting_per_s * step_s)[1:],
        )
        fresh = (scaled[1:] - memory * scaled[:-1]) / np.sqrt(1 - memory**2)
        assert np.sqrt(np.mean(fresh**2)) < 1.5


def test_errors_of_the_robot_change_the_force_as_they_say(pendulum):
    """An offset of the joint, and links that yield: against the closed form."""
    path, offset_rad, compliance_s2 = path_of(pendulum, 250, 0.0), 0.01, 1e-4
    time_s, inner = path.time_s, slice(500, -500)
    q, rate, acceleration = swing(time_s)
    force = pendulum_force(q, rate, acceleration)
    moved = pendulum_force(q + offset_rad, rate, acceleration) - force
    assert path.modes['joint1'][inner] * offset_rad == pytest.approx(moved[inner], abs=1e-3)
    derivatives = (
        np.gradient(acceleration, time_s),
        np.gradient(np.gradient(acceleration, time_s), time_s),
    )
    yielded = pendulum_force(
        q - compliance_s2 * acceleration,
        rate - compliance_s2 * derivatives[0],
        acceleration - compliance_s2 * derivatives[1],
    )
    assert path.modes['flexible'][inner] * compliance_s2 == pytest.approx(
        (yielded - force)[inner], abs=0.02
    )


def test_an_acceleration_that_is_later_than_its_attitude(pendulum):
    """The acceleration of a time before, in the world, is turned into the frame of now."""
    path, late_s = path_of(pendulum, 250, 0.0), 1e-3
    time_s, inner = path.time_s, slice(500, -500)
    q, q_before = swing(time_s)[0], swing(time_s - late_s)[0]
    gravity = G0_MPS2 * np.column_stack([-np.sin(q_before), 0 * q, np.cos(q_before)])
    x, _, z = (pendulum_force(*swing(time_s - late_s)) - gravity).T
    cos, sin = np.cos(q - q_before), np.sin(q - q_before)
    late = np.column_stack([x * cos - z * sin, 0 * q, x * sin + z * cos])
    late += G0_MPS2 * np.column_stack([-np.sin(q), 0 * q, np.cos(q)])
    change = late - pendulum_force(*swing(time_s))
    assert np.abs(change[inner]).max() > 5e-3
    assert path.modes['late_acceleration'][inner] * late_s == pytest.approx(
        change[inner], abs=1e-3
    )


def test_rotation_and_angles_of_a_stage(pendulum):
    path, time_s = path_of(pendulum, 250, 0.0), np.arange(2, 38, 0.01)
    q, rate, acceleration = swing(time_s)
    (_, wy, _), (_, ay, _) = path.rotation(time_s)
    assert wy == pytest.approx(rate, abs=1e-3)
    assert ay == pytest.approx(acceleration, abs=1e-2)
    alpha, beta = path.angles(time_s)
    up = np.column_stack(
        [np.sin(alpha) * np.cos(beta), -np.sin(alpha) * np.sin(beta), np.cos(alpha)]
    )
    assert up == pytest.approx(np.column_stack([-np.sin(q), 0 * q, np.cos(q)]), abs=1e-6)


def test_a_moving_base(tmp_path):
    """It turns about z, and shakes along x in the world."""
    (tmp_path / 'robot.urdf').write_text(urdf([], ARM_M))
    time_s = np.arange(0, 30, 0.01)
    yaw, shift = 0.9 * np.sin(1.3 * time_s), 0.05 * np.sin(4 * time_s)
    zero = 0 * time_s
    pose = np.column_stack([shift, zero, zero, zero, zero, np.sin(yaw / 2), -np.cos(yaw / 2)])
    pose[:, 5] *= -1
    path = RobotPath(
        Robot(tmp_path / 'robot.urdf', 'imu_link', moves=True),
        RobotReadings('run', {}, JointTrack(time_s, pose)),
    )
    inner = time_s[300:-300]
    rate, acceleration = 0.9 * 1.3 * np.cos(1.3 * inner), -0.9 * 1.69 * np.sin(1.3 * inner)
    yaw, x = 0.9 * np.sin(1.3 * inner), -0.05 * 16 * np.sin(4 * inner)
    expected = np.column_stack(
        [
            -ARM_M * rate**2 + x * np.cos(yaw),
            ARM_M * acceleration - x * np.sin(yaw),
            G0_MPS2 + 0 * x,
        ]
    )
    force = np.array(path(inner)).T
    assert force == pytest.approx(expected, abs=5e-3)


@pytest.mark.parametrize(
    ('frame', 'joints', 'words'),
    [
        ('imu', 'time_s,j1_rad', 'no frame imu; it has'),
        ('imu_link', 'time_s,j2_rad', 'no position of j1, which moves imu_link'),
        ('base', 'time_s,j1_rad', 'no joint moves base'),
    ],
)
def test_wrong_names_are_told(tmp_path, frame, joints, words):
    (tmp_path / 'robot.urdf').write_text(urdf(PENDULUM))
    (tmp_path / 'run.csv').write_text(
        joints + '\n' + ''.join(f'{t},{100 * t}\n' for t in np.arange(0, 1, 0.01))
    )
    with pytest.raises(UserError) as error:
        robot_path(tmp_path / 'robot.urdf', frame, str(tmp_path / 'run.csv'), 0)
    assert words in str(error.value)


def test_joints_of_a_dataframe_are_those_of_the_robot(tmp_path):
    """Zero-g and scale factor are those of the unit, as with a file of the same columns."""
    (tmp_path / 'robot.urdf').write_text(urdf([*PENDULUM, ('1 0 0', '0 0 0')]))
    time_s = np.arange(0, 48, 0.02)
    rng = np.random.default_rng(2)
    knots_s = np.arange(0, 50, 0.5)
    knots_rad = np.repeat(rng.uniform(-2, 2, (13, 2)), 8, axis=0)[: len(knots_s)]
    joints = scipy.interpolate.PchipInterpolator(knots_s, knots_rad)
    path = np.array([joints(time_s, order) for order in range(3)])
    force = Robot(tmp_path / 'robot.urdf', 'imu_link').motion(path, None, G0_MPS2).force_mps2
    readings = 0.3 + 1.01 * force + 5e-3 * rng.normal(size=force.shape)
    table = pd.DataFrame({'time_s': time_s, **dict(zip(ACCEL, readings.T))})
    table = table.assign(j1_rad=path[0, :, 0], j2_rad=path[0, :, 1])
    found = adxl.fit(table, model='linear', urdf=tmp_path / 'robot.urdf')
    zero_g = found.sensor.values['bias']['offset_v'] * G0_MPS2
    assert zero_g == pytest.approx([0.3] * 3, abs=0.02)
    with pytest.raises(UserError, match='no position of j1, which moves imu_link'):
        adxl.fit(table.drop(columns='j1_rad'), model='linear', urdf=tmp_path / 'robot.urdf')


def test_a_file_that_is_no_urdf(tmp_path):
    (tmp_path / 'robot.urdf').write_text('<mujoco/>')
    with pytest.raises(UserError, match='no URDF that pinocchio reads'):
        Robot(tmp_path / 'robot.urdf', 'imu_link')
    (tmp_path / 'robot.urdf').write_text('<robot><xacro:include filename="a"/></robot>')
    with pytest.raises(UserError, match='is a xacro'):
        Robot(tmp_path / 'robot.urdf', 'imu_link')
    with pytest.raises(UserError, match='no such file'):
        Robot(tmp_path / 'none.urdf', 'imu_link')


def test_an_effect_of_the_rotation_shows_after_a_simulation_without_it():
    """What a recording keeps of its simulations has a rotation only where one was asked for."""

    class Turning(ForcePath):
        is_robot = True

        def rotation(self, time_s):
            ones, zeros = np.ones(len(time_s)), np.zeros(len(time_s))
            return [zeros, zeros, 2 * ones], [zeros] * 3

    time_s = np.arange(200) / 100
    motion = Motion(2.0, force=Turning(time_s, np.tile([0.0, 0.0, G0_MPS2], (200, 1))))
    sensor, memo = nominal('xyz', rate_hz=100.0), ChainMemo()
    arm = with_effects(sensor, ['lever_arm:x_m=0.1'])
    without, beside = (whole_response(s, motion, 0, time_s, memo) for s in (sensor, arm))
    change_mps2 = (beside - without)[-1, 0] / sensor.scale_v_per_g[0] * G0_MPS2
    assert change_mps2 == pytest.approx(-0.1 * 2**2, rel=0.05)
