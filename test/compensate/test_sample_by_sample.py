# SPDX-License-Identifier: Apache-2.0

"""Compensation sample by sample equals that of blocks, and its messages are right."""

from collections.abc import Callable
from dataclasses import replace

from adxl_ros.compensate.estimators import Estimate, LiveEstimator, RecordingEstimator
from adxl_ros.files import imu_message
from adxl_ros.files.recording_columns import Recording
from adxl_ros.model import signal_chain
from adxl_ros.model.covariance import force_covariance
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.kinematics import Mounting, specific_force, tilt
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from geometry_msgs.msg import Vector3Stamped
import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Imu
from units import drawn, Fed, nominal

G = 9.80665


def unit(axes: str) -> Sensor:
    sensor = drawn(np.random.default_rng(1), nominal(axes))
    names = tuple(Coefficient('bias', 'offset_v', axis) for axis in axes)
    return replace(sensor, covariance_names=names, covariance=1e-6 * (np.eye(len(axes)) + 0.3))


def samples(sensor: Sensor, force: list[np.ndarray]) -> list[list[float]]:
    """Apply a force to the sensor at its rate; return nominal acceleration, (n, 3)."""
    volts = Fed(sensor, 2)(force)
    accel = np.zeros((len(volts), 3))
    accel[:, : len(sensor.axes)] = to_nominal_mps2(volts, sensor)
    return accel.tolist()


def turning(seconds: float) -> list[np.ndarray]:
    time_s = np.arange(round(seconds * 1000)) / 1000
    return specific_force(0.7 + 0.3 * np.sin(time_s), 0.5 * time_s, G)


def at_rest(alpha: float, beta: float, count: int) -> list[np.ndarray]:
    return [np.full(count, f) for f in specific_force(alpha, beta, G)]


def follower(sensor: Sensor) -> Callable[[list[float], float], Estimate | None]:
    live = LiveEstimator(sensor)

    def follow(accel_mps2: list[float], time_s: float) -> Estimate | None:
        volts = live.volts(accel_mps2)
        return live(volts, time_s) if volts else None

    return follow


@pytest.mark.parametrize('axes', ['x', 'xy', 'xyz'])
def test_agrees_with_blocks(axes: str) -> None:
    sensor = unit(axes)
    accel = samples(sensor, turning(2.0))
    follow = follower(sensor)
    outputs = [follow(a, i / 1000) for i, a in enumerate(accel)]
    volts = (
        sensor.nominal_zero_g_v
        + np.array(accel)[:, : len(axes)] / G * sensor.nominal_scale_v_per_g
    )
    force = signal_chain.inverse(sensor)(list(volts.T))
    np.testing.assert_allclose([f.force for f in outputs], np.array(force).T, rtol=0, atol=2e-8)
    covariance = force_covariance(sensor, force)
    measured = np.sqrt(covariance[[0, 0], [0, 0]] if axes == 'x' else covariance[[0, 1], [0, 1]]).T
    std = np.sqrt([[f.covariance[0], f.covariance[0 if axes == 'x' else 3]] for f in outputs])
    np.testing.assert_allclose(std, measured, rtol=0.05)
    angles = tilt(force, covariance, 'z' in axes)
    finite = np.isfinite(angles.roll)
    np.testing.assert_allclose(
        np.array([f.roll[0] for f in outputs])[finite], angles.roll[finite], rtol=0, atol=1e-7
    )
    np.testing.assert_allclose(
        [f.inclination[0] for f in outputs if axes != 'x'],
        angles.inclination[np.full(len(outputs), axes != 'x')],
        rtol=0,
        atol=1e-7,
    )


def test_motion_raises_the_variance_of_z_and_angles_while_it_lasts() -> None:
    """A vibration of 2 m/s² rms along x raises the variances of z and tilt while it lasts."""
    sensor = unit('xy')
    force = at_rest(0.6, 1.0, 9000)
    shaken = slice(2000, 5000)
    force[0][shaken] += 2 * 2**0.5 * np.sin(2 * np.pi * 3 * np.arange(3000) / 1000)
    follow = follower(sensor)
    outputs = [follow(a, i / 1000) for i, a in enumerate(samples(sensor, force))]
    std = np.sqrt([f.covariance[5] for f in outputs])
    assert 1.5 < np.median(std[3500:5000]) < 3
    assert np.sqrt(np.median([f.pitch[1] for f in outputs[3500:5000]])) > 0.15
    # The x axis is measured also in motion.
    assert max(f.covariance[0] for f in outputs) < 1.1 * outputs[0].covariance[0]
    assert std[-1] < 1.1 * std[1900]
    three_axes = follower(unit('xyz'))
    for i, a in enumerate(samples(unit('xyz'), force)[:4000]):
        last = three_axes(a, i / 1000)
    assert last.covariance[5] < 1e-3
    assert np.sqrt(last.pitch[1]) > 0.15


@pytest.mark.parametrize(
    'change',
    [
        lambda force: force / G,
        lambda force: force / 1000,
        lambda force: 0.02 * force,
        lambda force: 0.68 * force,
    ],
)
def test_the_tilt_of_a_force_whose_length_is_not_gravity_states_a_deviation_that_covers(
    change: Callable[[np.ndarray], np.ndarray],
) -> None:
    sensor, true_rad = unit('xyz'), 0.6
    force = change(np.array(specific_force(true_rad, 1.0, G)))
    accel = samples(sensor, [np.full(50, f) for f in force])
    follow = follower(sensor)
    live = [follow(a, i / 1000) for i, a in enumerate(accel)][-1]
    columns = dict(zip(('ax_mps2', 'ay_mps2', 'az_mps2'), np.array(accel).T))
    block = Recording('made.csv', np.arange(50) / 1000, columns)
    ((_, estimates),) = RecordingEstimator(sensor, block).blocks([block])
    length_error = abs(float(np.linalg.norm(force)) - G) / G
    for variance in (
        live.roll[1],
        live.pitch[1],
        float(estimates.tilt.roll_std[-1]) ** 2,
        float(estimates.tilt.pitch_std[-1]) ** 2,
    ):
        assert np.sqrt(variance) > 0.8 * length_error


@pytest.mark.parametrize('bad', [float('nan'), float('inf'), -1e300])
@pytest.mark.parametrize('axes', ['x', 'xy', 'xyz'])
def test_a_sample_without_a_solution_is_none_and_changes_no_other(axes: str, bad: float) -> None:
    sensor = unit(axes)
    accel = samples(sensor, at_rest(0.6, 1.0, 40))
    follow, again = follower(sensor), follower(sensor)
    for i, a in enumerate(accel):
        if i % 10 == 5:
            assert again([bad, *a[1:]], i / 1000) is None
        assert follow(a, i / 1000) == again(a, i / 1000)


def imu(frame_id: str) -> Imu:
    message = Imu()
    message.header.frame_id = frame_id
    message.header.stamp.sec, message.header.stamp.nanosec = -3, 500_000_000
    message.angular_velocity.z = 0.25
    message.angular_velocity_covariance[0] = message.orientation_covariance[0] = -1.0
    a = message.linear_acceleration
    a.x, a.y, a.z = 1.0, -2.0, 9.0
    return message


def big_endian(raw: bytes) -> bytes:
    """Swap the bytes of every number of a serialized Imu or Vector3Stamped."""
    length = int.from_bytes(raw[12:16], 'little')
    numbers = 4 + (12 + length + 7) // 8 * 8
    head = b''.join(raw[i : i + 4][::-1] for i in (4, 8, 12))
    return (
        b'\0\0'
        + raw[2:4]
        + head
        + raw[16:numbers]
        + np.frombuffer(raw[numbers:], '<f8').astype('>f8').tobytes()
    )


@pytest.mark.parametrize('frame_id', ['', 'a', 'abc', 'imu_link', 'arm/imu_of_the_left_hand'])
@pytest.mark.parametrize('order', ['little', 'big'])
def test_written_bytes_equal_the_serialized_messages(frame_id: str, order: str) -> None:
    message = imu(frame_id)
    raw = serialize_message(message)
    if order == 'big':
        raw = big_endian(raw)
    assert imu_message.read(raw) == (-2.5, (1.0, -2.0, 9.0))
    orientation, acceleration = [float(v) for v in range(13)], [float(v) for v in range(20, 32)]
    made = imu_message.corrected(raw, orientation, acceleration)
    o, a = message.orientation, message.linear_acceleration
    o.x, o.y, o.z, o.w = orientation[:4]
    a.x, a.y, a.z = acceleration[:3]
    message.orientation_covariance = orientation[4:]
    message.linear_acceleration_covariance = acceleration[3:]
    assert deserialize_message(made, Imu) == message
    tilted = imu_message.vector3_stamped(raw, (0.1, 0.2, 0.3))
    expected = Vector3Stamped(header=message.header)
    v = expected.vector
    v.x, v.y, v.z = 0.1, 0.2, 0.3
    assert deserialize_message(tilted, Vector3Stamped) == expected
    if order == 'little' and frame_id == 'abc':  # without padding, whose bytes are arbitrary
        assert made == serialize_message(message)
        assert tilted == serialize_message(expected)


@pytest.mark.parametrize('alpha_deg', [100.0, 125.0, 150.0])
def test_x_and_y_cover_both_signs_of_z_unless_it_is_given(alpha_deg: float) -> None:
    """Upside down, a sensor that is taken for upright is wrong by its own z in x and y."""
    inside, certain = [], []
    for seed in range(20):
        known = drawn(np.random.default_rng(seed), nominal('xy'))
        force = specific_force(np.radians(alpha_deg), 0.7, G)
        volts = signal_chain.static_response(known)(force)
        for sensor, results in (
            (replace(known, z_sign=0), inside),
            (replace(known, z_sign=-1), certain),
        ):
            estimate = LiveEstimator(sensor)([float(v) for v in volts], 0.0)
            assert estimate is not None
            error = np.abs(np.array(estimate.force[:2]) - np.ravel(force[:2]))
            std = np.sqrt([estimate.covariance[0], estimate.covariance[3]])
            results.append(error <= 1.645 * std)
            if sensor.z_sign:
                assert (std < 0.02).all()
    assert np.mean(inside) >= 0.87 and np.mean(certain) >= 0.87


def test_a_mounting_says_which_way_up_the_case_is() -> None:
    sensor = replace(
        drawn(np.random.default_rng(3), nominal('xy')), z_sign=0, provenance={'reference': 'stage'}
    )
    live = LiveEstimator(sensor, mounting=Mounting((np.pi, 0.0, 0.0)))
    volts = signal_chain.static_response(sensor)(specific_force(np.radians(150), 0.7, G))
    estimate = live([float(v) for v in volts], 0.0)
    assert estimate is not None and estimate.force[2] > 0
    assert np.sqrt(estimate.covariance[0]) < 0.02


def test_the_yaw_that_a_level_leaves_is_in_the_covariance() -> None:
    """A level shows roll and pitch of the axes in the case; their yaw turns roll into pitch."""
    sensor, rng = nominal('xyz'), np.random.default_rng(4)
    live = LiveEstimator(sensor, mounting=Mounting((0.02, -0.03, 0.0)))
    inside = []
    for _ in range(60):
        yaw, roll, pitch = rng.normal(0, 0.0175), *rng.uniform(-0.8, 0.8, 2)
        robot = G * np.array(
            [-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)]
        )
        turned = [
            np.cos(yaw) * robot[0] + np.sin(yaw) * robot[1],
            np.cos(yaw) * robot[1] - np.sin(yaw) * robot[0],
            robot[2],
        ]
        volts = signal_chain.static_response(sensor)(list(live.mounting.rows.T @ turned))
        estimate = live([float(v) for v in volts], 10.0 * len(inside))
        for (angle, variance), true in ((estimate.roll, roll), (estimate.pitch, pitch)):
            inside.append(abs(angle - true) <= 1.645 * np.sqrt(variance))
    assert np.mean(inside) >= 0.87
    level = live(
        [
            float(v)
            for v in signal_chain.static_response(sensor)(
                list(live.mounting.rows.T @ [0.0, 0.0, G])
            )
        ],
        1e4,
    )
    staged = LiveEstimator(
        replace(sensor, provenance={'reference': 'stage'}), mounting=live.mounting
    )
    assert max(np.sqrt([level.roll[1], level.pitch[1]])) < 1e-3
    assert staged([float(v) for v in volts], 0.0).roll[1] < estimate.roll[1]
