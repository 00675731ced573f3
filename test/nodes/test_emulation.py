# SPDX-License-Identifier: Apache-2.0

"""The driver as a realistic sensor in a simulator: ideal Imu and /clock in, imu/data_raw out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import time

from adxl_ros.files import parameter_file
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from graph import accel, Graph, stamp_ns
import numpy as np
from processes import PATIENCE, Started
import pytest
from rclpy.qos import qos_profile_sensor_data
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu
from units import nominal

STEP_NS = 5_000_000
REST = (0.5, -0.3, 9.78)


class Simulator:
    """Publishes an ideal Imu at 200 Hz of simulated time, best effort, and /clock."""

    def __init__(self, graph: Graph) -> None:
        self._graph = graph
        self._imu = graph.node.create_publisher(Imu, 'imu/ideal', qos_profile_sensor_data)
        self._clock = graph.node.create_publisher(Clock, '/clock', 10)
        self.now_ns = 0
        self.has_clock = True
        self.sent: list[int] = []

    def step(self, factor: float = 2.0) -> None:
        self.now_ns += STEP_NS
        stamp = Time(sec=self.now_ns // 10**9, nanosec=self.now_ns % 10**9)
        if self.has_clock:
            self._clock.publish(Clock(clock=stamp))
        message = Imu()
        message.header.stamp, message.header.frame_id = stamp, 'robot/imu'
        for axis, value in zip('xyz', REST):
            setattr(message.linear_acceleration, axis, value)
        message.angular_velocity.z = 0.25
        message.orientation.x, message.orientation.w = 0.6, 0.8
        message.angular_velocity_covariance[8] = 1e-4
        self._imu.publish(message)
        self.sent.append(self.now_ns)
        self._graph.spin(STEP_NS * 1e-9 / factor)

    def run_until(
        self, condition: Callable[[], object], purpose: str, factor: float = 2.0
    ) -> None:
        end_s = time.monotonic() + PATIENCE * 60
        while not condition():
            self.step(factor)
            if time.monotonic() > end_s:
                pytest.fail(f'{purpose}: not after {PATIENCE} min; {self._graph.diagnostics}')


def start_driver(start: Callable[..., Started], *arguments: str) -> Started:
    return start(
        'driver', '--ros-args', '-p', 'link.type:=topic', '-p', 'use_sim_time:=true', *arguments
    )


def test_a_withheld_effect_shows_in_the_stream_of_the_robot(start, tmp_path: Path) -> None:
    offset_g = np.array([0.03, -0.02, 0.01])
    sensor = nominal(
        'xyz',
        serial='SIM7',
        effects=('bias',),
        values={'bias': {'offset_v': offset_g * nominal('xyz').nominal_scale_v_per_g}},
    )
    parameter_file.save(tmp_path / 'unit.yaml', sensor)
    with Graph() as graph:
        simulator = Simulator(graph)
        samples = graph.listen(Imu, 'imu/data_raw')
        info = graph.listen(DiagnosticStatus, 'sensor_info', latched=True)
        driver = start_driver(start, '--params-file', 'unit.yaml', '-p', 'frame_id:=case')
        simulator.run_until(lambda: len(samples) > 400 and info, '400 samples')
        simulator.run_until(lambda: graph.reports('driver', 'emulates SIM7'), 'diagnostics')
        assert graph.diagnostics['driver'].level == DiagnosticStatus.OK
    values = {pair.key: pair.value for pair in info[-1].values}
    assert (values['serial'], float(values['rate_hz'])) == ('SIM7', 200.0)
    stamps = [stamp_ns(message) for message in samples]
    assert set(stamps) <= set(simulator.sent), 'stamps are those of the simulator'
    assert (np.diff(stamps) > 0).all()
    accels = np.array([accel(message) for message in samples])
    assert np.isfinite(accels).all()
    assert (accels[100:].mean(0) - REST) / 9.80665 == pytest.approx(offset_g, abs=2e-3)
    assert accels[100:].std(0).min() > 0, 'the noise of the sensor'
    newest = samples[-1]
    assert newest.header.frame_id == 'case'
    assert (newest.angular_velocity.z, newest.orientation.x, newest.orientation.w) == (
        0.25,
        0.6,
        0.8,
    )
    assert newest.angular_velocity_covariance[8] == 1e-4
    assert driver.stop() == 0
    assert 'Traceback' not in driver.output()
