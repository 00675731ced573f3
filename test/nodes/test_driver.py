# SPDX-License-Identifier: Apache-2.0

"""The driver over DDS: its outputs, and its messages about faults."""

import time

from adxl_ros.files.stream_info import sensor_info
from adxl_ros.model import noise
from adxl_ros.model.sensor import to_nominal_mps2, to_volts
from adxl_ros.nodes.driver import other_sensor
from adxl_ros.nodes.sample_output import imu_message, imu_writer
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from graph import accel, Graph, QUEUE, stamp_ns
import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import BatteryState, Imu, JointState, Temperature
from units import nominal

ROS = '--ros-args'
SIMULATED = 'SIMULATED sensor (link.type: sim)'


def written(path, rows=400, columns=('ax_mps2', 'ay_mps2', 'az_mps2'), dt_s=0.005):
    t = 10.0 + dt_s * np.arange(rows)
    data = {
        'ax_mps2': np.sin(t),
        'ay_mps2': np.cos(t),
        'az_mps2': 9.8 + 0 * t,
        'alpha_rad': 0.1 * t,
        'beta_rad': 0 * t,
        'temperature_c': 20 + np.floor(t),
        'supply_v': 5 + 0 * t,
    }
    lines = [','.join(['time_s', *columns])]
    lines += [
        ','.join(map(repr, [float(t[k]), *(float(data[c][k]) for c in columns)]))
        for k in range(rows)
    ]
    path.write_text('\n'.join(lines) + '\n')
    return np.column_stack([data[c] for c in columns])


@pytest.mark.parametrize(
    'given, found, is_named',
    [
        ('U73', 'UNIT-7', True),
        ('U73', 'U73', False),
        ('nominal', 'UNIT-7', False),
        ('U73', 'nominal', False),
    ],
)
def test_a_unit_that_is_not_that_of_the_parameters_is_named(given, found, is_named):
    text = other_sensor(nominal(serial=given), nominal(serial=found))
    assert (given in text and found in text) == bool(text) == is_named


@pytest.mark.parametrize('axes', ['x', 'xy', 'xyz'])
def test_serialized_samples_are_what_rclpy_serializes(axes):
    sensor = nominal(axes)
    volts = np.linspace(1.1, 3.9, 5 * len(axes)).reshape(5, -1)
    stamps = 1_700_000_000_999_999_990 + 5 * np.arange(5)
    template = imu_message(sensor, 'imu_link')
    accel = to_nominal_mps2(volts, sensor)
    messages = imu_writer(sensor, 'imu_link').messages(stamps, linear_acceleration=accel)
    for message, stamp, a in zip(messages, stamps, accel):
        template.header.stamp.sec, template.header.stamp.nanosec = map(int, divmod(stamp, 10**9))
        for axis, value in zip('xyz', [*map(float, a), 0.0, 0.0]):
            setattr(template.linear_acceleration, axis, value)
        # The 3 bytes of padding after the frame have arbitrary values.
        expected = serialize_message(template)
        assert (message[:25], message[28:]) == (expected[:25], expected[28:])
        assert deserialize_message(message, Imu) == template


def test_saturation_is_reported_at_the_rails_and_beyond_the_range():
    volts = np.array([[2.5, 2.5], [0.0, 2.5], [2.5, 5 * (1 - 2**-16)], [2.5, 4.3], [4.1, 0.9]])
    assert nominal().saturated(volts).any(axis=1).tolist() == [False, True, True, True, False]
    assert not nominal(adc_bits=0, range_g=16.0).saturated(volts).any()


def test_sim_publishes_every_sample_as_documented(start):
    driver = start(
        'driver',
        ROS,
        '-p',
        'link.type:=sim',
        '-p',
        'link.alpha_rad:=1.5707963267948966',
        '-p',
        'frame_id:=case',
        '-p',
        'sensor.serial:=A7',
        '-p',
        f'qos_overrides./imu/data_raw.publisher.depth:={QUEUE}',
    )
    sensor = nominal()
    with Graph() as graph:
        samples = graph.listen(Imu, 'imu/data_raw')
        info = graph.listen(DiagnosticStatus, 'sensor_info', latched=True)
        graph.spin_until(lambda: len(samples) >= 3000 and info, 30, '3000 samples')
        # On a busy machine the driver may miss the samples of a second, but recovers.
        graph.spin_until(
            lambda: (
                abs(graph.number('driver', 'rate_hz') - 1000) < 100
                and 0 <= graph.number('driver', 'age_s') < 1
            ),
            15,
            'the rate',
        )
        status = graph.diagnostics['driver']
        assert status.level == DiagnosticStatus.WARN
        assert SIMULATED in status.message
        assert status.hardware_id == 'A7'
        assert graph.value('driver', 'missing') == graph.value('driver', 'saturated') == '0'
    stamps = np.array([stamp_ns(message) for message in samples])
    assert (np.diff(stamps) == 1_000_000).all()
    first = samples[0]
    assert first.header.frame_id == 'case'
    assert first.orientation_covariance[0] == first.angular_velocity_covariance[0] == -1
    variance = first.linear_acceleration_covariance.reshape(3, 3)
    sigma = noise.sample_std_v(sensor) * 9.80665
    assert variance == pytest.approx(np.diag([*sigma**2, 1e6]))
    published = {pair.key: pair.value for pair in info[0].values}
    assert published == sensor_info(sensor) | {'serial': 'A7'}
    a = np.array([accel(message) for message in samples])
    assert not a[:, 2].any()
    assert a[:, :2].mean(0) == pytest.approx([9.80665, 0], abs=0.05)
    codes = to_volts(a[:, :2], sensor) / sensor.lsb_v
    assert np.abs(codes - np.rint(codes)).max() < 1e-6, 'volts are recovered exactly'
    assert driver.stop() == 0
    info, warning, *others = driver.output().splitlines()
    assert all('the clock jumped' in line for line in others), 'as on a busy machine'
    assert '[INFO]' in info
    assert 'active: link sim, unit A7, 1000 Hz, topic /imu/data_raw' in info
    assert '[WARN]' in warning
    assert SIMULATED in warning


def test_replay_publishes_a_recording_faster_than_real_time(start, tmp_path):
    columns = (
        'ax_mps2',
        'ay_mps2',
        'az_mps2',
        'alpha_rad',
        'beta_rad',
        'temperature_c',
        'supply_v',
    )
    data = written(tmp_path / 'r.csv', 1000, columns)
    with Graph() as graph:
        stage = graph.listen(JointState, 'stage/joint_states')
        temperature = graph.listen(Temperature, 'temperature')
        supply = graph.listen(BatteryState, 'supply')
        clock = graph.listen(Clock, '/clock')
        start(
            'driver',
            ROS,
            '-p',
            'link.type:=replay',
            '-p',
            'link.recording:=r.csv',
            '-p',
            'link.speed:=4.0',
        )
        graph.spin_until(lambda: all(map(graph.node.count_publishers, graph.got)), 30, 'topics')
        # The first sample waits for the subscriber of the samples, and has all others then.
        samples = graph.listen(Imu, 'imu/data_raw')
        graph.spin_until(lambda: graph.value('driver', 'link_state') == 'ended', 30, 'the end')
        # Topics are sent in the order of the samples, but each may be sent again on its own.
        graph.spin_until(
            lambda: (
                len(samples) == len(stage) == 1000
                and clock
                and supply
                and temperature[-1].temperature == 34
            ),
            10,
            'what came before the end',
        )
    stamps = np.array([stamp_ns(message) for message in samples])
    assert np.abs(stamps - 1e9 * (10 + 0.005 * np.arange(1000))).max() < 1000
    assert np.abs([accel(m) - row[:3] for m, row in zip(samples, data)]).max() < 1e-12
    assert stage[-1].name == ['alpha', 'beta']
    by_stamp = dict(zip(stamps, data[:, 3]))
    assert all(m.position[0] == by_stamp[stamp_ns(m)] for m in stage)
    assert len(stage) == 1000, 'alpha changes with each sample'
    assert sorted({m.temperature for m in temperature}) == [30, 31, 32, 33, 34]
    assert len(temperature) <= 10
    assert {m.voltage for m in supply} == {5.0}
    ticks = [c.clock.sec + c.clock.nanosec * 1e-9 for c in clock]
    assert ticks == sorted(ticks)
    assert ticks[-1] > 14.9


@pytest.mark.parametrize('option', ['use_sim_time:=true', 'link.speed:=4.0'])
def test_beside_another_clock_the_driver_follows_it(start, option):
    """Gazebo publishes /clock, for example; two clocks would tear the time of all nodes."""

    def tick():
        now_s = 50 + time.monotonic() - begin_s
        clock.publish(Clock(clock=Time(sec=int(now_s), nanosec=int(now_s % 1 * 1e9))))
        return (
            len(samples) > 50
            and graph.node.count_publishers('/clock') == 1
            and abs(stamp_ns(samples[-1]) - 1e9 * now_s) < 2e9
        )

    with Graph() as graph:
        clock = graph.node.create_publisher(Clock, '/clock', 10)
        begin_s = time.monotonic()
        samples = graph.listen(Imu, 'imu/data_raw')
        driver = start(
            'driver', ROS, '-p', 'link.type:=sim', '-p', option, '-p', 'sensor.rate_hz:=100.0'
        )
        graph.spin_until(tick, 30, '50 samples by the one clock')
        driver.wait_for('another node publishes /clock: this driver follows it')


@pytest.mark.parametrize(
    'arguments, status',
    [
        ((ROS, '-p', 'link.type:=carrier_pigeon'), 1),
        ((ROS, '-p', 'link.type:=sim', '-p', 'link.speed:=0.0'), 1),
        ((ROS, '--params-file', 'nowhere.yaml'), 1),
        (('--speed', '3'), 2),
        ((ROS, '--sped', '3'), 2),
    ],
)
def test_an_invalid_start_ends_with_one_line(refusal, arguments, status):
    assert arguments[-1].split(':=')[-1] in refusal('driver', *arguments, status=status)
