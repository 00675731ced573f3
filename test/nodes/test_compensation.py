# SPDX-License-Identifier: Apache-2.0

"""The compensation over DDS: its outputs, its refusals, and calibrations exchanged live."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
import signal

from adxl_ros.files import parameter_file
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.model import signal_chain
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.covariance import force_covariance
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import Vector3Stamped
from graph import accel, Graph, RELIABLE, stamp_ns
import numpy as np
from processes import Started
import pytest
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParametersAtomically
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu
from units import drawn, nominal

G = 9.80665
NODE = 'compensation'
Start = Callable[..., Started]


def unit(serial: str = '17', axes: str = 'xy', seed: int = 1) -> Sensor:
    sensor = drawn(np.random.default_rng(seed), nominal(axes))
    return replace(
        sensor,
        serial=serial,
        model='physical',
        provenance={'source': f'by {serial}'},
        covariance_names=tuple(Coefficient('bias', 'offset_v', axis) for axis in 'xy'),
        covariance=np.array([[2e-6, 1e-6], [1e-6, 3e-6]]),
    )


class Robot:
    """The topics of a driver, and the outputs of the compensation."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self.data = graph.listen(Imu, 'imu/data')
        self.tilt = graph.listen(Vector3Stamped, 'tilt')
        self._raw = graph.node.create_publisher(Imu, 'imu/data_raw', 100)
        self._info = graph.node.create_publisher(
            DiagnosticStatus,
            'sensor_info',
            QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL),
        )
        self._sent = 0
        self._informed = False

    def inform(self, sensor: Sensor, **changes: str) -> None:
        self._informed = True
        self._info.publish(
            DiagnosticStatus(
                values=[
                    KeyValue(key=k, value=v) for k, v in {**sensor_info(sensor), **changes}.items()
                ]
            )
        )

    def connected(self, timeout_s: float = 20.0) -> None:
        """Wait until all topics are connected, and the compensation has its info."""
        self.graph.spin_until(
            lambda: (
                self._raw.get_subscription_count()
                and self.graph.node.count_publishers('tilt')
                and self.graph.node.count_publishers('imu/data')
                and NODE in self.graph.diagnostics
                and (not self._informed or self.graph.value(NODE, 'unit') != 'not confirmed')
            ),
            timeout_s,
            'compensation connected',
        )

    def send(self, values: list[float]) -> None:
        message = Imu()
        self._sent += 1
        message.header.stamp.sec = self._sent
        message.header.frame_id = 'arm_imu'
        message.orientation_covariance[0] = message.angular_velocity_covariance[0] = -1.0
        a = message.linear_acceleration
        a.x, a.y, a.z = values
        self._raw.publish(message)

    def answer(self, values: list[float]) -> Imu:
        count, tilts = len(self.data), len(self.tilt)
        self.send(values)
        self.graph.spin_until(
            lambda: len(self.data) > count and len(self.tilt) > tilts, 10.0, 'corrected sample'
        )
        return self.data[-1]

    def assign(self, **values: object) -> str:
        """Set parameters all at once; __ stands for a dot. Return the reason of a refusal."""
        request = SetParametersAtomically.Request(
            parameters=[
                Parameter(name.replace('__', '.'), value=value).to_parameter_msg()
                for name, value in values.items()
            ]
        )
        result = self.graph.call(
            SetParametersAtomically, f'{NODE}/set_parameters_atomically', request
        ).result
        assert result.successful == (result.reason == '')
        return result.reason

    def get(self, *names: str) -> list:
        request = GetParameters.Request(names=list(names))
        values = self.graph.call(GetParameters, f'{NODE}/get_parameters', request).values
        return [parameter_value_to_python(value) for value in values]

    def level(self, level: bytes, text: str) -> None:
        self.graph.spin_until(
            lambda: self.graph.reports(NODE, text) and self.graph.diagnostics[NODE].level == level,
            10.0,
            f'{level!r} {text}',
        )


@pytest.fixture
def robot(ros_env: dict[str, str]) -> Iterator[Robot]:
    with Graph() as graph:
        yield Robot(graph)


def _saved(folder: Path, sensor: Sensor) -> Path:
    parameter_file.save(folder / 'unit.yaml', sensor)
    return folder / 'unit.yaml'


def started(start: Start, tmp_path: Path, sensor: Sensor, *args: object) -> Started:
    return start(NODE, '--ros-args', '--params-file', _saved(tmp_path, sensor), *RELIABLE, *args)


def output_of(sensor: Sensor, force: list[float]) -> list[float]:
    """Return the nominal acceleration of a sensor at a force, m/s², three floats."""
    volts = np.array([signal_chain.static_response(sensor)(force)])
    return [*to_nominal_mps2(volts, sensor)[0].tolist(), 0.0][:3]


def pose(alpha: float, beta: float) -> list[float]:
    return [float(f) for f in specific_force(alpha, beta, G)]


def test_corrected_stream(robot: Robot, start: Start, tmp_path: Path) -> None:
    sensor = unit()
    process = started(start, tmp_path, sensor)
    robot.inform(sensor)
    robot.connected()
    force = pose(0.7, -1.2)
    message = robot.answer(output_of(sensor, force))
    np.testing.assert_allclose(accel(message), force, atol=1e-7)
    assert message.header.frame_id == 'arm_imu'
    assert message.angular_velocity_covariance[0] == -1
    covariance = force_covariance(sensor, force)[:, :, 0]
    measured = message.linear_acceleration_covariance.reshape(3, 3)
    np.testing.assert_array_equal(measured, measured.T)
    # The variance of z states that z is not measured.
    noise = measured[2, 2] - covariance[2, 2]
    assert noise == pytest.approx((5.3e-3) ** 2, rel=0.2)
    np.testing.assert_allclose(measured - np.diag([0, 0, noise]), covariance, rtol=0.05, atol=2e-7)
    roll, pitch = np.arctan2(force[1], force[2]), np.arctan2(-force[0], np.hypot(*force[1:]))
    q = message.orientation
    np.testing.assert_allclose(
        [q.w, q.x, q.y, q.z],
        [
            np.cos(roll / 2) * np.cos(pitch / 2),
            np.sin(roll / 2) * np.cos(pitch / 2),
            np.cos(roll / 2) * np.sin(pitch / 2),
            -np.sin(roll / 2) * np.sin(pitch / 2),
        ],
        atol=1e-7,
    )
    about = message.orientation_covariance.reshape(3, 3)
    assert about[2, 2] == 1e6
    assert (np.diag(about)[:2] > 1e-8).all()
    assert (np.diag(about)[:2] < 1e-5).all()
    tilt = robot.tilt[-1]
    assert tilt.header == message.header
    np.testing.assert_allclose(
        [tilt.vector.x, tilt.vector.y, tilt.vector.z], [roll, pitch, 0.7], atol=1e-7
    )
    for beta in np.linspace(0, 1, 20):
        robot.answer(output_of(sensor, pose(0.7, beta)))
    robot.level(DiagnosticStatus.OK, 'compensating')
    # A report between the two counts has one of them.
    robot.graph.spin_until(
        lambda: (
            robot.graph.value(NODE, 'received') == robot.graph.value(NODE, 'published') == '21'
        ),
        5,
        'all samples',
    )
    status = robot.graph.diagnostics[NODE]
    assert status.hardware_id == '17'
    assert {pair.key: pair.value for pair in status.values}.items() >= {
        'unit': 'confirmed',
        'serial': '17',
        'model': 'physical',
        'received': '21',
        'published': '21',
        'dropped': '0',
        'provenance.source': 'by 17',
    }.items()
    process.popen.send_signal(signal.SIGINT)
    assert process.wait() == 0
    assert 'Traceback' not in process.output()
    assert stamp_ns(message) == 10**9


def test_samples_in_g_become_mps2(robot: Robot, start: Start, tmp_path: Path) -> None:
    """A parameter states the unit of a foreign IMU."""
    sensor = unit()
    started(start, tmp_path, sensor, '-p', 'samples.unit:=g')
    robot.inform(sensor)
    robot.connected()
    force = pose(0.7, -1.2)
    message = robot.answer([value / G0_MPS2 for value in output_of(sensor, force)])
    np.testing.assert_allclose(accel(message), force, atol=1e-7)


def test_without_a_file_the_nominal_sensor_applies(robot: Robot, start: Start) -> None:
    process = start(NODE, '--ros-args', *RELIABLE)
    robot.connected()
    process.wait_for('adxl203.yaml: nominal, which is not calibrated')
    np.testing.assert_allclose(
        accel(robot.answer([3.0, 4.0, 0.0])), [3, 4, (G * G - 25) ** 0.5], atol=1e-7
    )
    robot.level(DiagnosticStatus.WARN, 'unit not confirmed')
    robot.inform(nominal(serial='any'))
    robot.answer([3.0, 4.0, 0.0])
    robot.level(DiagnosticStatus.WARN, 'not calibrated')
    robot.level(DiagnosticStatus.WARN, 'no samples on /imu/data_raw')


def test_samples_of_two_drivers_are_not_mixed(robot: Robot, start: Start) -> None:
    graph = robot.graph
    slow = ('--ros-args', '-p', 'sensor.rate_hz:=100.0')
    process = start('compensation', *slow)
    start('driver', *slow)
    graph.spin_until(lambda: robot.data, 30.0, 'corrected samples')
    second = start('driver', *slow, '-r', '__node:=second')
    robot.level(DiagnosticStatus.ERROR, 'nodes publish it, and their samples mix')
    graph.spin_until(
        lambda: graph.reports('second', 'nodes publish /imu/data_raw'),
        10.0,
        'the warning of a driver',
    )
    # Samples that came before the error may be under way.
    graph.wait_for_silence('imu/data')
    count = len(robot.data)
    second.stop()
    process.wait_for('publishing again')
    graph.spin_until(lambda: len(robot.data) > count, 10.0, 'corrected samples again')


def test_calibration_loads_a_complete_file_or_nothing(
    robot: Robot, start: Start, tmp_path: Path
) -> None:
    first, second = unit(seed=1), replace(unit(seed=2), noise_density_g_per_rthz=np.full(2, 1e-3))
    second = replace(
        second,
        effects=('bias',),
        values={'bias': second.values['bias']},
        provenance={'date': '2026-02-03'},
    )
    other = tmp_path / 'other.yaml'
    parameter_file.save(other, second)
    parameter_file.save(tmp_path / 'foreign.yaml', unit('18'))
    broken = tmp_path / 'broken.yaml'
    broken.write_text(other.read_text().replace('rate_hz: 1000.0', 'rate_hz: 1000'))
    started(start, tmp_path, first)
    robot.inform(first)
    robot.connected()
    force = pose(0.6, 0.3)
    np.testing.assert_allclose(accel(robot.answer(output_of(first, force))), force, atol=1e-7)
    assert 'is of the sensor 17, but the parameters are of 18' in robot.assign(
        calibration=str(tmp_path / 'foreign.yaml')
    )
    reason = robot.assign(calibration=str(broken))
    assert f'{broken}:' in reason
    assert 'sensor.rate_hz: 1000 is not a floating-point number' in reason
    np.testing.assert_allclose(accel(robot.answer(output_of(first, force))), force, atol=1e-7)
    assert robot.assign(calibration=str(other)) == ''
    np.testing.assert_allclose(accel(robot.answer(output_of(second, force))), force, atol=1e-7)
    assert robot.get('calibration') == [str(other)]
    robot.graph.spin_until(
        lambda: robot.graph.value(NODE, 'calibration') == str(other),
        10.0,
        'calibration in diagnostics',
    )
    assert robot.graph.value(NODE, 'provenance.date') == '2026-02-03'
    reason = robot.assign(bias__offset_v=[0.0, 0.0])
    assert 'read-only' in reason and 'set calibration to FILE' in reason


def test_parameters_are_described_and_best_effort_publishers_received(
    robot: Robot, start: Start, tmp_path: Path
) -> None:
    sensor = replace(unit(), mounting={'rpy_rad': [0.1, -0.2, 0.3]})
    start(NODE, '--ros-args', '-p', f'calibration:={_saved(tmp_path, sensor)}')
    robot._raw = robot.graph.node.create_publisher(
        Imu, 'imu/data_raw', QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    )
    robot.connected()
    robot.answer(output_of(unit(), pose(0.5, 0.5)))
    names = ['sensor.serial', 'bias.offset_v', 'calibration', 'sensor.rate_hz', 'effects']
    descriptors = robot.graph.call(
        DescribeParameters, f'{NODE}/describe_parameters', DescribeParameters.Request(names=names)
    ).descriptors
    assert all(d.description for d in descriptors)
    assert [d.name for d in descriptors if not d.read_only] == ['calibration']
    assert descriptors[1].additional_constraints == '-2 to 2'
    assert descriptors[3].floating_point_range[0].to_value == 1e5
    # The parameters are those in force, as the file has them.
    assert robot.get('mounting.rpy_rad', 'effects', 'bias.offset_v') == [
        [0.1, -0.2, 0.3],
        list(sensor.effects),
        sensor.values['bias']['offset_v'].tolist(),
    ]


@pytest.mark.parametrize(
    ('right', 'wrong', 'message'),
    [
        ('format: 1', 'format: 9', ':3:13: format: version 9, but this package reads version 1'),
        ('units: V, V/g, 1/g, rad', 'units: mV', ":4:12: units: 'mV', but coefficients are in"),
        (
            '[2.0e-06, 1.0e-06, 1.0e-06, 3.0e-06]',
            '[2.0e-06, 9.0e-06, 9.0e-06, 3.0e-06]',
            'covariance: not symmetric and positive',
        ),
        ('rate_hz: 1000.0', 'rate_hz: 1000', 'rate_hz'),
        (
            'model: physical',
            'mounting.rpy_rad: [1.0, 2.0]\n    model: physical',
            'not roll, pitch',
        ),
        ('effects: [', 'effects: [[', 'not YAML'),
    ],
)
def test_a_bad_file_ends_it_with_one_line(
    refusal: Callable, tmp_path: Path, right: str, wrong: str, message: str
) -> None:
    path = _saved(tmp_path, unit())
    text = path.read_text()
    assert right in text
    path.write_text(text.replace(right, wrong))
    for arguments in (('--params-file', path), ('-p', f'calibration:={path}')):
        line = refusal(NODE, '--ros-args', *arguments)
        assert f'{path}:' in line
        assert message in line
