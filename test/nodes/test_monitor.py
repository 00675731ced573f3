# SPDX-License-Identifier: Apache-2.0

"""The monitor over DDS: gap, changes, diagnosis, and what is reported of faulty streams."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import json
from pathlib import Path
import re
import time

from adxl_ros.files import parameter_file
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.response import Response
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from graph import Graph, RELIABLE
import numpy as np
from processes import PATIENCE, Started
import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger
from units import nominal, with_effects

RATE_HZ = 100.0
STEP_NS = 10_000_000
UNIT = nominal('xyz', serial='M7', rate_hz=RATE_HZ)
SHIFTED = with_effects(UNIT, ['bias:offset_v.x=0.02'])
"""The unit after a change of 20 mg."""


def force(time_s: np.ndarray) -> list[np.ndarray]:
    """Return a specific force with much motion, m/s²."""
    return [6 * np.sin(0.7 * time_s), 5 * np.cos(0.45 * time_s), 7 + 3 * np.sin(0.3 * time_s)]


class Streams:
    """Publishes a sensor and the simulator beside it, at 100 Hz, twenty times real time."""

    def __init__(self, graph: Graph, stated: Sensor = UNIT) -> None:
        self._graph = graph
        self._real = graph.node.create_publisher(Imu, 'imu/data_raw', 1000)
        self._ideal = graph.node.create_publisher(Imu, 'imu/ideal', 1000)
        info = graph.node.create_publisher(
            DiagnosticStatus,
            'sensor_info',
            QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL),
        )
        info.publish(
            DiagnosticStatus(
                values=[
                    KeyValue(key=key, value=value) for key, value in sensor_info(stated).items()
                ]
            )
        )
        self._responses = [
            Response(sensor, Motion(np.inf, force=force), 1) for sensor in (UNIT, SHIFTED)
        ]
        self.is_shifted = False
        self.origin_ns = 1_700_000_000 * 10**9
        self.step = 0
        self.published = 0
        self.has_reference = True

    def turn(self) -> None:
        time_s = (self.step + np.arange(10)) / RATE_HZ
        volts = [respond(time_s) for respond in self._responses]
        samples = to_nominal_mps2(volts[self.is_shifted], UNIT)
        ideal = np.column_stack(force(time_s))
        for i in range(10):
            stamp_ns = self.origin_ns + (self.step + i) * STEP_NS
            if self.has_reference:
                self._publish(self._ideal, stamp_ns, ideal[i])
            self._publish(self._real, stamp_ns, samples[i])
        self.step += 10
        self.published += 10
        self._graph.spin(0.005)

    def run_until(self, condition: Callable[[], object], purpose: str) -> None:
        end_s = time.monotonic() + PATIENCE * 60
        while not condition():
            self.turn()
            if time.monotonic() > end_s:
                pytest.fail(f'{purpose}: not after {PATIENCE} min; {self._graph.diagnostics}')

    @staticmethod
    def _publish(publisher, stamp_ns: int, accel: np.ndarray) -> None:
        message = Imu()
        message.header.stamp = Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        for axis, value in zip('xyz', accel.tolist()):
            setattr(message.linear_acceleration, axis, value)
        publisher.publish(message)


@pytest.fixture
def monitor(start: Callable[..., Started], tmp_path: Path) -> Callable[..., Started]:
    """Give a function that starts a monitor with a simulator as its reference."""
    parameter_file.save(tmp_path / 'unit.yaml', UNIT)

    def begin(*arguments: str) -> Started:
        return start(
            'monitor',
            '--ros-args',
            '--params-file',
            'unit.yaml',
            '-p',
            'reference:=imu',
            '-p',
            'output:=kept',
            '-p',
            'window_s:=10.0',
            *arguments,
        )

    return begin


@pytest.fixture
def graph(ros_env) -> Iterator[Graph]:
    with Graph() as listening:
        yield listening


def values(status: DiagnosticStatus) -> dict[str, str]:
    return {pair.key: pair.value for pair in status.values}


def figures_mg(messages: list[DiagnosticArray]) -> list[float]:
    return [
        float(pair.value)
        for message in messages
        for status in message.status
        for pair in status.values
        if pair.key.endswith('_mg')
    ]


def test_gap_floor_and_a_change(monitor, graph, tmp_path) -> None:
    gaps = graph.listen(DiagnosticArray, 'gap')
    streams = Streams(graph)
    node = monitor('-p', 'diagnose.automatic:=false')
    streams.run_until(lambda: gaps and len(gaps[-1].status) == 4, 'the gap of three axes')
    streams.run_until(lambda: graph.reports('monitor', 'gap x'), 'diagnostics')
    streams.run_until(lambda: graph.number('monitor', 'blocks') > 80, '80 s')
    steady = gaps[-1]
    assert steady.status[0].level == DiagnosticStatus.OK, steady
    for axis in steady.status[1:]:
        floats = {key: float(text) for key, text in values(axis).items() if key != 'floor_source'}
        assert floats['gap_low_mg'] <= floats['gap_mg'] <= floats['gap_high_mg']
        assert floats['floor_low_mg'] <= floats['floor_mg'] <= floats['floor_high_mg']
        assert floats['gap_mg'] == pytest.approx(floats['floor_mg'], rel=0.2)
    # A change within a block of a second shows first with a part of its size.
    streams.run_until(lambda: streams.step % RATE_HZ == 0, 'the begin of a block')
    changed_s = streams.origin_ns * 1e-9 + streams.step / RATE_HZ
    streams.is_shifted = True
    streams.run_until(lambda: graph.reports('monitor', 'changed since'), 'the change')
    status = graph.diagnostics['monitor']
    assert status.level == DiagnosticStatus.WARN
    assert abs(graph.number('monitor', 'changed_since_s') - changed_s) <= 2
    assert graph.number('monitor', 'detected_s') - changed_s < 10
    assert re.search(r'changed since \S+: x by \+(19|20|21)', status.message)
    assert 'noise' not in status.message, 'a step is no noise'
    assert np.isfinite(figures_mg(gaps)).all()
    record = [
        json.loads(line) for line in (tmp_path / 'kept' / 'changes.jsonl').read_text().splitlines()
    ]
    assert (record[0]['axis'], record[0]['quantity'], record[0]['serial']) == ('x', 'mean', 'M7')
    assert record[0]['size'] == pytest.approx(20, rel=0.2)
    assert node.stop() == 0
    assert 'Traceback' not in node.output()


def test_a_change_is_diagnosed_and_a_report_is_on_disk(monitor, graph, tmp_path) -> None:
    streams = Streams(graph)
    node = monitor('-p', 'diagnose.wait_s:=60.0')
    streams.is_shifted = True
    streams.run_until(lambda: graph.reports('monitor', 'gap x'), 'the gap')
    streams.run_until(
        lambda: graph.has_stated('monitor', 'diagnosis_runs', 'True'), 'an automatic diagnosis'
    )
    # A request is answered by the diagnosis that runs.
    answer = graph.call(Trigger, 'monitor/diagnose', Trigger.Request(), 200)
    assert answer.success, answer.message
    page = Path(tmp_path, answer.message.split('report: ')[1])
    assert page.name == 'report.html'
    assert page.exists() and page.with_name('report.json').exists()
    graph.spin_until(lambda: graph.value('monitor', 'likely_effect'), 20, 'the likely effect')
    assert 'bias' in graph.value('monitor', 'likely_effect')
    assert Path(tmp_path, graph.value('monitor', 'report')) == page
    assert node.stop() == 0


def test_a_killed_monitor_loses_no_change(monitor, graph, kill, tmp_path) -> None:
    streams = Streams(graph)
    record = tmp_path / 'kept' / 'changes.jsonl'
    for count in (1, 2):
        # A name of its own: what the killed monitor said last may arrive after its end.
        name = f'monitor{count}'
        node = monitor('-r', f'__node:={name}', '-p', 'diagnose.automatic:=false')
        streams.run_until(
            lambda name=name: graph.reports(name, 'gap x') and graph.number(name, 'blocks') > 60,
            '60 s',
        )
        streams.is_shifted = not streams.is_shifted
        streams.run_until(
            lambda count=count: (
                record.exists() and record.read_text().count('"axis": "x"') >= count
            ),
            'the record',
        )
        kill(node.popen.pid)
        node.popen.wait()
    lines = [json.loads(line) for line in record.read_text().splitlines()]
    assert len(lines) >= 2


def test_no_sample_at_1_khz_is_lost(start, graph) -> None:
    # A machine that is held up for seconds would drop messages between nodes.
    start('monitor', '--ros-args', '-p', 'diagnose.automatic:=false', *RELIABLE)
    graph.spin_until(lambda: 'monitor' in graph.diagnostics, 20, 'the monitor')
    start('stage')
    start(
        'driver',
        '--ros-args',
        '-p',
        'link.type:=sim',
        '-p',
        'qos_overrides./imu/data_raw.publisher.depth:=20000',
    )
    graph.spin_until(lambda: graph.reports('monitor', 'gap x'), 40, 'the gap')
    graph.spin_until(lambda: graph.number('monitor', 'samples') > 8000, 40, '8000 samples')
    assert (graph.value('monitor', 'missing'), graph.value('monitor', 'dropped')) == ('0', '0')
    assert (
        0.5 < graph.number('monitor', 'x_gap_mg') / graph.number('monitor', 'x_floor_mg') < 1.1
    ), 'the floor includes steps of the encoder'
