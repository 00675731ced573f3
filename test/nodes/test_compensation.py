# SPDX-License-Identifier: Apache-2.0

"""The compensation over DDS: its outputs, its refusals, and coefficients set live."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path
import signal

from adxl_ros.calibrate.poses import Poses
from adxl_ros.calibrate.provenance import envelope
from adxl_ros.compensate import filter_inversion, paper_inverse
from adxl_ros.files import calibration_store, parameter_file
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.model import signal_chain
from adxl_ros.model.coefficients import put, with_neutral
from adxl_ros.model.covariance import force_covariance
from adxl_ros.model.effects.base import Coefficient, NOMINAL_ENVIRONMENT
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.scalar_or_array import FLOATS
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Vector3Stamped
from graph import accel, Graph, RELIABLE, stamp_ns
import numpy as np
from processes import Started
import pytest
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParametersAtomically
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import BatteryState, Imu, Temperature
from units import drawn, nominal

G = 9.80665
NODE = 'compensation'
Start = Callable[..., Started]


def unit(serial: str = '17', axes: str = 'xy', seed: int = 1) -> Sensor:
    sensor = drawn(np.random.default_rng(seed), nominal(axes))
    return replace(sensor, serial=serial, model='physical', provenance={'source': f'by {serial}'},
                   covariance_names=tuple(Coefficient('bias', 'offset_v', axis) for axis in 'xy'),
                   covariance=np.array([[2e-6, 1e-6], [1e-6, 3e-6]]))


class Robot:
    """The topics of a driver, and the outputs of the compensation."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self.data = graph.listen(Imu, 'imu/data')
        self.tilt = graph.listen(Vector3Stamped, 'tilt')
        self._diagnostics = graph.listen(DiagnosticArray, '/diagnostics')
        self._raw = graph.node.create_publisher(Imu, 'imu/data_raw', 100)
        self._info = graph.node.create_publisher(DiagnosticStatus, 'sensor_info', QoSProfile(
            depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
        self._sent = 0
        self._informed = False

    def inform(self, sensor: Sensor, **changes: str) -> None:
        """Publish sensor_info."""
        self._informed = True
        self._info.publish(DiagnosticStatus(values=[
            KeyValue(key=k, value=v) for k, v in {**sensor_info(sensor), **changes}.items()]))

    def connected(self, timeout_s: float = 20.0) -> None:
        """Wait until all topics are connected, and the compensation has its info."""
        self.graph.spin_until(
            lambda: self._raw.get_subscription_count()
            and self.graph.node.count_publishers('tilt')
            and self.graph.node.count_publishers('imu/data') and NODE in self.graph.diagnostics
            and (not self._informed or self.graph.value(NODE, 'unit') != 'not confirmed'),
            timeout_s, 'compensation connected')

    def send(self, values: list[float]) -> None:
        """Publish one sample of nominal acceleration, m/s²."""
        message = Imu()
        self._sent += 1
        message.header.stamp.sec = self._sent
        message.header.frame_id = 'arm_imu'
        message.orientation_covariance[0] = message.angular_velocity_covariance[0] = -1.0
        a = message.linear_acceleration
        a.x, a.y, a.z = values
        self._raw.publish(message)

    def answer(self, values: list[float]) -> Imu:
        """Publish one sample and return the corrected sample."""
        count, tilts = len(self.data), len(self.tilt)
        self.send(values)
        self.graph.spin_until(lambda: len(self.data) > count and len(self.tilt) > tilts, 10.0,
                              'corrected sample')
        return self.data[-1]

    def assign(self, **values: object) -> str:
        """Set parameters all at once; __ stands for a dot. Return the reason of a refusal."""
        request = SetParametersAtomically.Request(parameters=[
            Parameter(name.replace('__', '.'), value=value).to_parameter_msg()
            for name, value in values.items()])
        result = self.graph.call(SetParametersAtomically, f'{NODE}/set_parameters_atomically',
                                 request).result
        assert result.successful == (result.reason == '')
        return result.reason

    def get(self, *names: str) -> list:
        """Return the values of parameters."""
        request = GetParameters.Request(names=list(names))
        values = self.graph.call(GetParameters, f'{NODE}/get_parameters', request).values
        return [parameter_value_to_python(value) for value in values]

    def level(self, level: bytes, text: str) -> None:
        """Wait for diagnostics of a level with a text."""
        self.graph.spin_until(
            lambda: self.graph.reports(NODE, text)
            and self.graph.diagnostics[NODE].level == level, 10.0, f'{level!r} {text}')

    def warned(self, text: str, count: int) -> None:
        """Wait until warnings have counted a number of samples; a message covers one second."""
        self.graph.spin_until(lambda: count == sum(
            int(status.message.split()[0])
            for array in self._diagnostics for status in array.status
            if status.level == DiagnosticStatus.WARN and text in status.message), 10.0, text)


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
        [np.cos(roll / 2) * np.cos(pitch / 2), np.sin(roll / 2) * np.cos(pitch / 2),
         np.cos(roll / 2) * np.sin(pitch / 2), -np.sin(roll / 2) * np.sin(pitch / 2)], atol=1e-7)
    about = message.orientation_covariance.reshape(3, 3)
    assert about[2, 2] == 1e6
    assert (np.diag(about)[:2] > 1e-8).all()
    assert (np.diag(about)[:2] < 1e-5).all()
    tilt = robot.tilt[-1]
    assert tilt.header == message.header
    np.testing.assert_allclose([tilt.vector.x, tilt.vector.y, tilt.vector.z], [roll, pitch, 0.7],
                               atol=1e-7)
    for beta in np.linspace(0, 1, 20):
        robot.answer(output_of(sensor, pose(0.7, beta)))
    robot.level(DiagnosticStatus.OK, 'compensating')
    status = robot.graph.diagnostics[NODE]
    assert status.hardware_id == '17'
    assert {pair.key: pair.value for pair in status.values}.items() >= {
        'unit': 'confirmed', 'serial': '17', 'model': 'physical', 'received': '21',
        'published': '21', 'dropped': '0', 'provenance.source': 'by 17'}.items()
    process.popen.send_signal(signal.SIGINT)
    assert process.wait() == 0
    assert 'Traceback' not in process.output()
    assert stamp_ns(message) == 10 ** 9


def test_supply_and_temperature_are_corrected(robot: Robot, start: Start, tmp_path: Path) -> None:
    """The inverse uses `supply` and `temperature`, and diagnostics name missing values."""
    sensor = with_neutral(unit(), ['supply', 'temperature_bias'])
    sensor = put(sensor, [Coefficient('temperature_bias', 'per_k', 'x'), *(
        Coefficient('supply', f'{figure}_exponent', axis) for figure in ('zero_g', 'scale')
        for axis in sensor.axes)], [1e-3, *[1.0] * 2, *[1.135] * 2])
    started(start, tmp_path, sensor, '-p', 'use_sim_time:=true')
    robot.inform(sensor)
    robot.connected()
    node = robot.graph.node
    clock = node.create_publisher(Clock, '/clock', 10)
    supply = node.create_publisher(BatteryState, 'supply', 1)
    temperature = node.create_publisher(Temperature, 'temperature', 1)
    force, around = pose(0.7, 0.4), NOMINAL_ENVIRONMENT._replace(temperature_c=35.0, supply_v=4.8)
    volts = np.array([signal_chain.static_response(sensor)(force, around)])
    nominal_accel = [*to_nominal_mps2(volts, sensor)[0].tolist(), 0.0]
    robot.answer(nominal_accel)
    robot.level(DiagnosticStatus.WARN, 'supply is taken at 5: nothing on /supply')

    def corrected() -> bool:
        supply.publish(BatteryState(voltage=4.8))
        temperature.publish(Temperature(temperature=35.0))
        return bool(np.abs(np.array(accel(robot.answer(nominal_accel))) - force).max() < 1e-5)

    robot.graph.spin_until(corrected, 10.0, 'corrected for the surroundings')
    robot.level(DiagnosticStatus.OK, 'compensating')

    def old() -> bool:
        clock.publish(Clock(clock=Time(sec=3600)))
        temperature.publish(Temperature(temperature=35.0))
        robot.answer(nominal_accel)
        return robot.graph.reports(NODE, 'supply is taken at 4.8: nothing on /supply for 3600 s')
    # A value of an hour ago does not count.
    robot.graph.spin_until(old, 10.0, 'an hour later')
    assert robot.graph.diagnostics[NODE].level == DiagnosticStatus.WARN


def stored(folder: Path, sensor: Sensor, days_old: float) -> Path:
    """Put a calibration of a certain age into a store."""
    made = datetime.now(timezone.utc) - timedelta(days=days_old)
    path = calibration_store.put(folder, replace(sensor, provenance={
        'date': made.isoformat(timespec='seconds'), 'data_sha256': f'{days_old:064.3f}'}))
    assert path is not None
    return path


def test_the_newest_calibration_of_the_unit_is_taken(robot: Robot, start: Start, tmp_path: Path
                                                     ) -> None:
    """Serial number and date decide. Other files are ignored, and a newer file is announced."""
    folder = tmp_path / 'calibrations'
    old, newest = unit(seed=1), unit(seed=2)
    stored(folder, old, 30.0)
    path = stored(folder, newest, 10.0)
    stored(folder, unit('18', seed=3), 1.0)
    three = stored(folder, unit(axes='xyz', seed=4), 5.0)
    (folder / '17' / '17-29990101T000000Z-0.yaml').write_text('half of a fi')
    process = start(NODE, '--ros-args', '-p', f'store:={folder}', *RELIABLE)
    robot.connected()
    robot.level(DiagnosticStatus.WARN, 'no samples')
    assert robot.graph.value(NODE, 'validity') == 'not calibrated'
    robot.inform(newest)
    process.wait_for(f'compensating by {path}')
    process.wait_for(f'passed over: {three}: ')
    process.wait_for('17-29990101T000000Z-0.yaml:1:1: ')
    force = pose(0.7, -1.2)
    np.testing.assert_allclose(accel(robot.answer(output_of(newest, force))), force, atol=1e-7)
    robot.graph.spin_until(lambda: robot.graph.value(NODE, 'validity')
                           == 'valid, temperature not known', 10, 'validity')
    assert robot.graph.value(NODE, 'calibration_id') == path.stem
    assert float(robot.graph.value(NODE, 'age_days')) == pytest.approx(10.0, abs=0.01)
    (folder / '17' / '17-29990101T000000Z-0.yaml').unlink()
    fresh = stored(folder, unit(seed=5), 0.0)

    def announced() -> bool:
        robot.send(output_of(newest, force))
        return robot.graph.reports(NODE, f'a newer calibration is in the store: {fresh}')
    robot.graph.spin_until(announced, 10, 'the newer one')
    # The node loads it when the driver starts again, not during a run.
    np.testing.assert_allclose(accel(robot.answer(output_of(newest, force))), force, atol=1e-7)
    robot.inform(newest)
    process.wait_for(f'compensating by {fresh}')


def test_a_named_calibration_is_not_replaced(robot: Robot, start: Start, tmp_path: Path) -> None:
    """The store does not replace it. Without a name the default store counts."""
    sensor = unit(seed=1)
    stored(calibration_store.default_folder(), unit(seed=2), 0.0)
    process = started(start, tmp_path, sensor)
    robot.inform(sensor)
    robot.connected()
    force = pose(0.7, -1.2)
    np.testing.assert_allclose(accel(robot.answer(output_of(sensor, force))), force, atol=1e-7)
    robot.level(DiagnosticStatus.OK, 'compensating')
    assert process.output().count('compensating by') == 1
    nominal_file = tmp_path / 'nominal.yaml'
    parameter_file.save(nominal_file, nominal(serial='17'))
    process.stop()
    # Datasheet values without coefficients are not a calibration.
    other = start(NODE, '--ros-args', '--params-file', nominal_file, '-r', '__node:=other')
    other.wait_for(f'compensating by {calibration_store.default_folder()}')


def test_the_covariance_is_raised_outside_of_the_validity_range(
        robot: Robot, start: Start, tmp_path: Path) -> None:
    """Temperature and pose raise it as documented, and diagnostics report it."""
    sensor = unit(axes='xyz')
    sensor = replace(sensor, covariance_names=tuple(
        Coefficient(effect, parameter, axis) for effect, parameter in (
            ('bias', 'offset_v'), ('scale_factor', 'offset_v_per_g')) for axis in 'xyz'),
        covariance=np.diag([1e-8] * 3 + [1e-6] * 3))
    force = np.array([pose(a, b) for a in np.radians([0, 15, 30]) for b in (0.0, 2.0, 4.0)])
    nothing = np.zeros((9, 3))
    poses = Poses(nothing, nothing, nothing[:, 0], nothing[:, 0], nothing[:, :2],
                  nothing[:, 0] > 0, np.linspace(20, 25, 9))
    # The poses reach 30° at most. A small force determines the scale factor less.
    sensor = replace(sensor, envelope=envelope(sensor, force, poses, 0.02))
    started(start, tmp_path, sensor)
    robot.inform(sensor)
    robot.connected()
    temperature = robot.graph.node.create_publisher(Temperature, 'temperature', 1)
    inside = output_of(sensor, pose(0.4, 0.4))

    def variances(nominal_accel: list[float], at_c: float, validity: str) -> np.ndarray:
        """Return the variances of a sample at a temperature, once the validity is reported."""
        def there() -> bool:
            temperature.publish(Temperature(temperature=at_c))
            robot.answer(nominal_accel)
            value = robot.graph.value(NODE, 'validity')
            return value == validity or (validity != 'valid' and value.startswith(validity))
        robot.graph.spin_until(there, 15, f'{at_c} degC: {validity}')
        return np.array(robot.data[-1].linear_acceleration_covariance).reshape(3, 3).diagonal()

    robot.answer(inside)
    robot.graph.spin_until(lambda: robot.graph.value(NODE, 'validity')
                           == 'valid, temperature not known', 10, 'what is not known')
    before = variances(inside, 23.0, 'valid')
    np.testing.assert_array_equal(variances(inside, 26.5, 'valid'), before)
    warm = variances(inside, 40.0, 'outside: temperature 40.0 degC, calibrated at 20.0 to 25.0')
    robot.level(DiagnosticStatus.WARN, 'covariance raised: temperature 40.0 degC')
    # By the datasheet 0.1 mg/K and 3e-5/K of the force, over the 13 K beyond 25 + 2 degC.
    added = (13 * 1e-4 * G) ** 2 + (13 * 3e-5 * np.array(pose(0.4, 0.4))) ** 2
    np.testing.assert_allclose(warm - before, added, rtol=0.1)
    tilted = variances(output_of(sensor, [2 * G, 0.0, 0.0]), 23.0,
                       'outside: force near 19.5, 0.0, 0.0 m/s^2')
    assert tilted[0] > before[0] + 0.02 ** 2 * 0.5
    # No pose is near 85 deg either, although the force along x is in the range.
    variances(output_of(sensor, pose(1.48, 0.4)), 23.0, 'outside: force near')
    assert float(robot.graph.value(NODE, 'outside')) >= 3
    np.testing.assert_allclose(variances(inside, 23.0, 'valid'), before)


def test_without_a_file_the_nominal_sensor_applies(robot: Robot, start: Start) -> None:
    process = start(NODE, '--ros-args', *RELIABLE)
    robot.connected()
    process.wait_for('adxl203.yaml: nominal, which is not calibrated')
    np.testing.assert_allclose(accel(robot.answer([3.0, 4.0, 0.0])),
                               [3, 4, (G * G - 25) ** 0.5], atol=1e-7)
    robot.level(DiagnosticStatus.WARN, 'unit not confirmed')
    robot.inform(nominal(serial='any'))
    robot.answer([3.0, 4.0, 0.0])
    robot.level(DiagnosticStatus.WARN, 'not calibrated')
    robot.level(DiagnosticStatus.WARN, 'no samples on /imu/data_raw')


def test_an_unobservable_angle_keeps_its_value(robot: Robot, start: Start, tmp_path: Path) -> None:
    """With x upright, roll keeps its last value with a very large variance."""
    sensor = unit(axes='xyz')
    started(start, tmp_path, sensor)
    robot.connected()
    robot.answer(output_of(sensor, pose(0.7, -1.2)))
    roll = robot.tilt[-1].vector.x
    message = robot.answer(output_of(sensor, [G, 0.0, 0.0]))
    vector = robot.tilt[-1].vector
    assert vector.x == roll
    assert vector.y == pytest.approx(-np.pi / 2, abs=1e-3)
    about = message.orientation_covariance.reshape(3, 3)
    assert about[0, 0] == 1e6
    assert about[0, 1] == about[1, 0] == 0
    assert 0 < about[1, 1] < 1e-5


def test_invalid_samples_are_not_published(robot: Robot, start: Start, tmp_path: Path) -> None:
    sensor = unit()
    started(start, tmp_path, sensor)
    robot.inform(sensor)
    robot.connected()
    valid = output_of(sensor, pose(0.5, 0.5))
    before = accel(robot.answer(valid))
    for invalid in (float('nan'), float('inf'), 1e38, -1e300, 5e3):
        robot.send([invalid, valid[1], 0.0])
    np.testing.assert_array_equal(accel(robot.answer(valid)), before)
    assert len(robot.data) == len(robot.tilt) == 2
    robot.warned('samples dropped', 5)
    assert robot.graph.value(NODE, 'dropped') == '5'
    robot.answer([-2.5 * G, valid[1], 0.0])
    robot.warned('samples with the ADC at its rail', 1)


def test_samples_of_two_drivers_are_not_mixed(robot: Robot, start: Start) -> None:
    """The samples are withheld while both publish, and come again when one has ended."""
    graph = robot.graph
    process = start('compensation')
    start('driver')
    graph.spin_until(lambda: robot.data, 30.0, 'corrected samples')
    second = start('driver', '--ros-args', '-r', '__node:=second')
    robot.level(DiagnosticStatus.ERROR, 'nodes publish it, and their samples mix')
    graph.spin_until(lambda: graph.reports('second', 'nodes publish /imu/data_raw'), 10.0,
                     'the warning of a driver')
    count = len(robot.data)
    graph.spin(1.0)
    assert len(robot.data) == count
    second.stop()
    process.wait_for('publishing again')
    graph.spin_until(lambda: len(robot.data) > count, 10.0, 'corrected samples again')


def test_another_unit_is_refused(robot: Robot, start: Start, tmp_path: Path) -> None:
    """The policy of the compensation has tests of every other refusal."""
    sensor = unit()
    process = started(start, tmp_path, sensor)
    robot.inform(sensor, serial='18')
    robot.connected()
    robot.level(DiagnosticStatus.ERROR, 'is of the sensor 18, but the parameters are of 17')
    for _ in range(3):
        robot.send(output_of(sensor, pose(0.5, 0.5)))
    robot.graph.spin_until(lambda: robot.graph.value(NODE, 'received') == '3', 10.0, 'received')
    assert not robot.data
    assert not robot.tilt
    robot.inform(sensor)
    process.wait_for('publishing again')
    robot.answer(output_of(sensor, pose(0.5, 0.5)))
    robot.level(DiagnosticStatus.OK, 'compensating')
    assert process.output().count('publishing nothing') == 1


def test_coefficients_are_set_all_or_none(robot: Robot, start: Start, tmp_path: Path) -> None:
    sensor = replace(nominal(), serial='17', effects=('bias', 'scale_factor'), values={
        'bias': {'offset_v': np.zeros(2)}, 'scale_factor': {'offset_v_per_g': np.zeros(2)}})
    started(start, tmp_path, sensor)
    robot.inform(sensor)
    robot.connected()
    names = ('effects', 'bias.offset_v', 'scale_factor.offset_v_per_g', 'covariance')
    assert accel(robot.answer([1.0, 2.0, 0.0]))[0] == pytest.approx(1.0, abs=1e-7)
    assert robot.assign(bias__offset_v=[0.1, 0.0], scale_factor__offset_v_per_g=[0.25, 0.0]) == ''
    after = accel(robot.answer([1.0, 2.0, 0.0]))[0]
    assert after == pytest.approx((1.0 - 0.1 * G) / 1.25, abs=1e-7)
    held = robot.get(*names[:3])
    for values, reason in (
            ({'bias__offset_v': [0.2, 0.0], 'scale_factor__offset_v_per_g': [99.0, 0.0]},
             'scale_factor.offset_v_per_g: 99 V/g is outside -0.9 to 9'),
            ({'bias__offset_v': [0.2]}, 'bias.offset_v: 1 values for 2 axes'),
            ({'bias__offset_v': [float('nan'), 0.0]}, 'bias.offset_v: nan is not a finite'),
            ({'misalignment__alpha_rad': [0.1, 0.1]}, 'effects does not list misalignment'),
            ({'effects': ['bias', 'misalignment']}, 'missing'),
            ({'effects': ['bias', 'none']}, "unknown effect 'none'"),
            ({'covariance_names': ['bias.offset_v.x'], 'covariance': [-1.0]},
             'the variance of bias.offset_v.x is -1'),
            ({'sensor__serial': '18'}, 'sensor.serial: belongs to the parameter file'),
            ({'bias__offset_v': [0.2, 0.0], 'sensor__axes': 'x'}, 'sensor.axes: belongs to'),
            ({'format': 2}, 'format: belongs to the parameter file'),
            ({'calibration': '/none.yaml'}, '/none.yaml: cannot be read'),
            ({'calibration': '/none.yaml', 'bias__offset_v': [0.2, 0.0]}, 'cannot be set toget')):
        assert reason in robot.assign(**values)
        assert robot.get(*names[:3]) == held
        assert accel(robot.answer([1.0, 2.0, 0.0]))[0] == after
    # Effects that the file does not list have all their parameters.
    assert not robot.assign(
        effects=['bias', 'misalignment'], misalignment__alpha_rad=[0.0, 0.0],
        misalignment__beta_rad=[0.0, 0.02], covariance=[1e-4],
        covariance_names=['bias.offset_v.x'])
    message = robot.answer([1.0, 2.0, 0.0])
    assert accel(message)[0] == pytest.approx(1.0 - 0.1 * G, abs=1e-7)
    assert message.linear_acceleration_covariance[0] == pytest.approx(1e-4 * G * G, rel=0.01)


def test_calibration_loads_a_complete_file_or_nothing(robot: Robot, start: Start,
                                                      tmp_path: Path) -> None:
    first, second = unit(seed=1), replace(unit(seed=2), noise_density_g_per_rthz=np.full(2, 1e-3))
    second = replace(second, effects=('bias',), values={'bias': second.values['bias']},
                     provenance={'date': '2026-02-03'})
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
        calibration=str(tmp_path / 'foreign.yaml'))
    reason = robot.assign(calibration=str(broken))
    assert f'{broken}:' in reason
    assert 'sensor.rate_hz: 1000 is not a floating-point number' in reason
    np.testing.assert_allclose(accel(robot.answer(output_of(first, force))), force, atol=1e-7)
    assert robot.assign(calibration=str(other)) == ''
    np.testing.assert_allclose(accel(robot.answer(output_of(second, force))), force, atol=1e-7)
    flat = parameter_file.to_flat(second)
    values = robot.get('calibration', *flat)
    assert values == [str(other), *flat.values()]
    assert robot.get('misalignment.alpha_rad', 'provenance.source') == [[], '']
    robot.graph.spin_until(lambda: robot.graph.value(NODE, 'calibration') == str(other), 10.0,
                           'calibration in diagnostics')
    assert robot.graph.value(NODE, 'provenance.date') == '2026-02-03'
    assert robot.assign(bias__offset_v=[0.0, 0.0]) == ''
    robot.graph.spin_until(lambda: 'set since' in robot.graph.value(NODE, 'calibration'), 10.0,
                           'the change in diagnostics')


def test_parameters_are_described(robot: Robot, start: Start, tmp_path: Path) -> None:
    start(NODE, '--ros-args', '-p', f'calibration:={_saved(tmp_path, unit())}')
    robot.connected()
    names = ['sensor.serial', 'bias.offset_v', 'calibration', 'sensor.rate_hz', 'effects']
    descriptors = robot.graph.call(DescribeParameters, f'{NODE}/describe_parameters',
                                   DescribeParameters.Request(names=names)).descriptors
    assert all(d.description and not d.read_only for d in descriptors)
    assert descriptors[1].additional_constraints == '-2 to 2'
    assert descriptors[3].floating_point_range[0].to_value == 1e5
    assert robot.get('sensor.serial', 'sensor.axes') == ['17', 'xy']


def test_best_effort_publishers_are_received(robot: Robot, start: Start, tmp_path: Path) -> None:
    start(NODE, '--ros-args', '--params-file', _saved(tmp_path, unit()))
    robot._raw = robot.graph.node.create_publisher(Imu, 'imu/data_raw', QoSProfile(
        depth=10, reliability=ReliabilityPolicy.BEST_EFFORT))
    robot.connected()
    robot.answer(output_of(unit(), pose(0.5, 0.5)))


@pytest.mark.parametrize(('right', 'wrong', 'message'), [
    ('format: 1', 'format: 9', ':3:13: format: version 9, but this package reads version 1'),
    ('units: V, V/g, 1/g, rad', 'units: mV', ":4:12: units: 'mV', but coefficients are in"),
    ('[2.0e-06, 1.0e-06, 1.0e-06, 3.0e-06]', '[2.0e-06, 9.0e-06, 9.0e-06, 3.0e-06]',
     'covariance: not positive'),
    ('rate_hz: 1000.0', 'rate_hz: 1000', 'rate_hz'),
    ('effects: [', 'effects: [[', 'not YAML'),
])
def test_a_bad_file_ends_it_with_one_line(start: Start, tmp_path: Path, right: str, wrong: str,
                                          message: str) -> None:
    path = _saved(tmp_path, unit())
    text = path.read_text()
    assert right in text
    path.write_text(text.replace(right, wrong))
    for process in [start(NODE, '--ros-args', *arguments) for arguments in (
            ('--params-file', path), ('-p', f'calibration:={path}'))]:
        assert process.wait() == 1
        assert process.output().count('\n') == 1
        assert f'{path}:' in process.output()
        assert message in process.output()


def test_the_inverse_of_the_filter_keeps_the_stamps(robot: Robot, start: Start,
                                                    tmp_path: Path) -> None:
    """With undo_filter the output is the zero-phase inverse, eight samples later."""
    sensor = replace(unit().without_covariance(), rate_hz=1.0, rc_capacitance_f=3e-5)
    started(start, tmp_path, sensor, '-p', 'undo_filter:=true')
    robot.inform(sensor)
    robot.connected()
    values = {pair.key: pair.value for pair in robot.graph.diagnostics[NODE].values}
    assert values['delay_s'] == '8.0'
    alpha = 0.6 + 0.1 * np.sin(0.2 * np.arange(40))
    volts = np.column_stack(signal_chain.static_response(sensor)(specific_force(alpha, 0.3, G)))
    for row in to_nominal_mps2(volts, sensor):
        robot.send([*row.tolist(), 0.0])
    robot.graph.spin_until(lambda: len(robot.data) == 32, 10.0, '32 of 40 samples')
    assert [stamp_ns(m) for m in robot.data] == [k * 10 ** 9 for k in range(1, 33)]
    back = filter_inversion.undo(volts, np.arange(1.0, 41.0), np.full(2, sensor.rc_s), 1.0)
    expected = np.transpose(signal_chain.inverse(sensor)(list(back.T)))[:32]
    got = np.array([accel(m) for m in robot.data])
    np.testing.assert_allclose(got[8:, :2], expected[8:, :2], atol=1e-5)


def test_the_papers_inverse_is_an_option(robot: Robot, start: Start, tmp_path: Path) -> None:
    """inverse:=paper gives equations 14 to 21, and another value is refused at the start."""
    sensor = unit()
    started(start, tmp_path, sensor, '-p', 'inverse:=paper')
    robot.inform(sensor)
    robot.connected()
    values = output_of(sensor, pose(0.7, 0.4))
    volts = [v[0] for v in signal_chain.static_response(
        sensor)([np.array([f]) for f in pose(0.7, 0.4)])]
    expected = paper_inverse.inverse(sensor, maths=FLOATS)([float(v) for v in volts])
    assert accel(robot.answer(values)) == pytest.approx(expected, abs=1e-6)
