# SPDX-License-Identifier: Apache-2.0

"""Compare a running sensor with its prediction: gap, noise floor, changes, likely cause."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
import time

from adxl_ros.errors import UserError
from adxl_ros.files import calibration_store
from adxl_ros.files.stream_info import check_same_sensor, NO_SERIAL, nominal_of, StreamInfo
from adxl_ros.links.support.base import COLUMNS
from adxl_ros.monitor import changes
from adxl_ros.monitor.changes import DiagnosisResult, DiagnosisRun, iso_time
from adxl_ros.monitor.live_gap import AxisGap, GapSettings, LiveGap
from adxl_ros.monitor.reference_stream import ReferenceKind, ReferenceStream, RobotForce
from adxl_ros.nodes import parameter_checks, parameters, sensor_parameters, topics
from adxl_ros.nodes.parameters import parameter, sample_unit
from adxl_ros.nodes.run_node import run
from adxl_ros.nodes.topics import Inbox, Level, Status
from adxl_ros.report.quantities import percent
from adxl_ros.simulate.robot import Robot
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from sensor_msgs.msg import Imu, JointState

_INPUT_QUEUE = 10000  # Messages that are kept while the node is busy: 10 s at 1 kHz
_TOPICS = {
    ReferenceKind.STAGE: 'stage/joint_states',
    ReferenceKind.IMU: 'imu/ideal',
    ReferenceKind.ROBOT: 'joint_states',
}
"""Usual topic of each reference."""
_TURN_S = 0.05
"""Time between two looks at the topics, s. A look costs as much as ten messages, so that at 1 kHz
it adds a fifth to their work; half of the time would add two fifths, and twice only delays by 0.1
s."""
_PERIOD_S = 1.0  # Time between two messages on `gap`, s
_QUEUE = 10
"""Messages that are kept for a slow subscriber: those of the 10 s after which blocks are
reported."""
_INFO_S = 3.0
"""Time that samples wait for `sensor_info`, s. A latched message comes within 1 s of discovery on
a busy host; with half of that a driver's own values would be replaced by those of any IMU."""
_SHORTEST_S = 20.0
"""Shortest time of samples that is diagnosed, s. Four rests of 5 s, or as many moves, fit into it;
half of them hardly tell one effect from another."""
_PAUSE_S = 600.0
"""Shortest time between two automatic diagnoses, s: twice `changes._BUDGET_S`, so that the
diagnoses take at most half of a core."""
_EXAMPLES = {
    'a sensor on a stage': '--ros-args --params-file unit.yaml',
    'a sensor on a robot': '--ros-args --params-file unit.yaml -p reference:=robot '
    '-p urdf:=robot.urdf',
}
"""Examples of arguments, by their purpose."""


@dataclass(frozen=True)
class MonitorSettings:
    """The monitor."""

    reference: str = parameter(
        'stage',
        'what the sensor is compared with: the joints of a stage, '
        'the ideal Imu of a simulator, or the joints of a robot',
        choices=('stage', 'imu', 'robot'),
    )
    reference_topic: str = parameter(
        '', 'topic of the reference; empty: stage/joint_states, imu/ideal, or joint_states'
    )
    urdf: str = parameter('', 'file of the robot; its base rests')
    frame: str = parameter('imu_link', 'frame of the robot that carries the sensor')
    samples_unit: str = sample_unit()
    window_s: float = parameter(60.0, 'time over which gap and floor are taken', 's', 5.0, 3600.0)
    false_alarms_per_day: float = parameter(
        0.0333, 'largest rate of reported changes that are none', '1/day', 1e-5, 10.0
    )
    history_s: float = parameter(600.0, 'time that is kept for a diagnosis', 's', 60.0, 3600.0)
    wait_s: float = parameter(
        120.0,
        'time of samples that an automatic diagnosis needs',
        's',
        20.0,
        3600.0,
        name='diagnose.wait_s',
    )
    output: str = parameter(
        str(calibration_store.default_folder().with_name('monitor')),
        'folder of the record of changes and of the diagnoses',
    )
    automatic: bool = parameter(
        True, 'diagnose a change, or an open gap', name='diagnose.automatic'
    )


def gap_status(live: LiveGap, likely: DiagnosisResult | None, window_s: float) -> Status:
    """Return text, level and values of the gap, its newest change, and the newest diagnosis."""
    gaps = live.report()
    changed = live.changes[-1:]
    text = 'comparing; the first result takes some seconds'
    values: dict[str, object] = {'window_s': window_s, 'changes': len(live.changes)}
    if gaps:
        text = ', '.join(
            f'{name} {", ".join(parts)} mg'
            for name, parts in {
                'gap': [f'{gap.axis} {gap.gap.value:.3g}' for gap in gaps],
                'floor': [f'{gap.axis} {gap.floor.value:.3g}' for gap in gaps],
            }.items()
        )
    for change in changed:
        since = iso_time(change.since_ns)
        text += f'; changed since {since}: {change.text()}'
        values |= {
            'changed_since': since,
            'changed_since_s': change.since_ns * 1e-9,
            'detected_s': change.detected_ns * 1e-9,
        }
    if likely is not None:
        named = f'likely {" or ".join(likely.effects)} ({percent(likely.probability)})'
        text += f'; {named if likely.effects else likely.text}'
        values |= {
            'likely_effect': ', '.join(likely.effects),
            'probability': likely.probability,
            'report': likely.report,
        }
    is_fine = gaps and not changed and not any(gap.is_open for gap in gaps)
    return Status(Level.OK if is_fine else Level.WARN, text, live.sensor.serial, values)


def axis_status(gap: AxisGap, serial: str) -> Status:
    """Return the gap of an axis; `explained` is absent where nothing is to explain."""
    values: dict[str, object] = {'offset_mg': gap.offset_mg, 'floor_source': gap.floor_source}
    for name, interval in (('gap', gap.gap), ('floor', gap.floor)):
        values |= {
            f'{name}_mg': interval.value,
            f'{name}_low_mg': interval.low,
            f'{name}_high_mg': interval.high,
        }
    if gap.explained is not None:
        values['explained'] = gap.explained
    return Status(
        Level.WARN if gap.is_open else Level.OK,
        f'gap {gap.gap.value:.3g} mg, floor {gap.floor.value:.3g} mg',
        serial,
        values,
    )


class Monitor(Node):
    """
    The node of the live gap.

    It connects topics and parameters to the package `monitor`, which compares and tests.
    """

    def __init__(self) -> None:
        super().__init__('monitor')
        parameter_checks.check_given(self)
        self._file_sensor = sensor_parameters.make_sensor(sensor_parameters.declare_sensor(self))
        self._own = own = parameters.declare_all(self, MonitorSettings)
        self._kind = ReferenceKind(own.reference)
        self._reference_topic = own.reference_topic or _TOPICS[self._kind]
        self._robot = (
            RobotForce(Robot(own.urdf, own.frame), self._file_sensor.local_gravity_mps2)
            if self._kind is ReferenceKind.ROBOT
            else None
        )
        self._settings = GapSettings(
            own.window_s, own.false_alarms_per_day, own.history_s, own.wait_s
        )
        self._output = Path(own.output).expanduser()
        self._live = LiveGap(self._file_sensor, self._kind, self._settings)
        self._info: StreamInfo | None = None  # None until samples are compared
        self._refusal = ''
        self._run: DiagnosisRun | None = None
        self._result: DiagnosisResult | None = None
        self._requests: list[object] = []
        self._changed_ns = 0  # Begin of a change that is not diagnosed yet, ns; 0 without one
        self._diagnosed_s = -_PAUSE_S
        self._begun_s = 0.0
        self._samples = Inbox(self, Imu, 'imu/data_raw', _INPUT_QUEUE, own.samples_unit)
        self._reference = Inbox(
            self,
            Imu if self._kind is ReferenceKind.IMU else JointState,
            self._reference_topic,
            _INPUT_QUEUE,
        )
        self._surroundings = topics.SurroundingTopics(self, _INPUT_QUEUE)
        self._publisher = topics.create_publisher(self, DiagnosticArray, 'gap', _QUEUE)
        self._service = topics.LateService(self, '~/diagnose')
        topics.DiagnosticsReporter(self, 'gap', self._status)
        self._info_topic = self.resolve_topic_name('sensor_info')
        topics.subscribe_info(self, self._info_topic, self._compare_by)
        self.create_timer(_TURN_S, self._turn, clock=topics.STEADY)
        self.create_timer(_PERIOD_S, self._publish, clock=topics.STEADY)

    def close(self) -> None:
        """End a diagnosis that runs."""
        if self._run is not None:
            self._run.close()

    def _compare_by(self, info: StreamInfo) -> None:
        """Begin a comparison with the parameters, as far as they fit what a stream states."""
        if self._info is not None and self._info.texts == info.texts:
            return
        self._info = info
        self._refusal = ''
        sensor = self._file_sensor
        try:
            if sensor.effects or sensor.serial != NO_SERIAL:
                check_same_sensor(info, info.axes or sensor.axes, sensor)
                sensor = replace(sensor, rate_hz=info.rate_hz or sensor.rate_hz)
            else:
                sensor = nominal_of(sensor, info)
        except UserError as error:
            self._refusal = str(error)
            self.get_logger().error(self._refusal)
            return
        self._live = LiveGap(sensor, self._kind, self._settings)
        self._changed_ns = 0
        self._result = None
        self.get_logger().info(
            f'comparing {self.resolve_topic_name("imu/data_raw")} of {sensor.serial} with '
            f'{self.resolve_topic_name(self._reference_topic)}'
        )
        if self._live.left_out:
            self.get_logger().warning(
                f'not predicted, for want of stage angles: {", ".join(self._live.left_out)}'
            )

    def _turn(self) -> None:
        """Take what has come, compare, and serve."""
        now_s = time.monotonic()
        stamps_ns, accel_mps2 = topics.imu_samples(self._samples.take())
        if len(stamps_ns):
            self._begun_s = self._begun_s or now_s
        if self._info is None and self._begun_s and now_s - self._begun_s > _INFO_S:
            self._compare_by(StreamInfo({}, self._info_topic))
        if self._info is not None and not self._refusal:
            self._live.add_samples(stamps_ns, accel_mps2)
            self._take_others(self._live.reference)
            self._advance()
        self._serve()

    def _take_others(self, reference: ReferenceStream) -> None:
        """Add reference and surroundings that wait."""
        for topic, stamps_ns, values in self._surroundings.take():
            reference.add_surroundings(COLUMNS[topic], stamps_ns, values)
        messages = self._reference.take()
        if self._kind is ReferenceKind.IMU:
            reference.add_readings(*topics.imu_samples(messages))
        else:
            readings = [reading for reading in topics.joint_readings(messages) if reading.position]
            (self._robot.add if self._robot else reference.add_joints)(
                [reading.stamp_ns for reading in readings],
                [reading.position for reading in readings],
            )
        if self._robot:
            self._robot.send(reference)

    def _advance(self) -> None:
        """Compare, and put changes on disk before they are published."""
        found = self._live.advance()
        for change in found:
            self.get_logger().warning(
                f'changed since {iso_time(change.since_ns)}: {change.text()}'
            )
            try:
                changes.append(self._output, change, self._live.sensor.serial)
            except UserError as error:
                self.get_logger().error(f'the change is not on disk: {error}')
        if found:
            # The waiting time of a diagnosis does not start again with a further change.
            self._changed_ns = self._changed_ns or min(change.since_ns for change in found)

    def _diagnose_if_due(self) -> None:
        """Diagnose a change, or the first open gap, once there are enough samples."""
        may_begin = self._own.automatic and self._run is None
        has_paused = time.monotonic() - self._diagnosed_s >= _PAUSE_S
        if not (may_begin and has_paused):
            return
        has_samples = self._live.span_s(self._changed_ns) >= self._settings.wait_s
        is_first_gap = self._result is None and any(gap.is_open for gap in self._live.report())
        if has_samples and (self._changed_ns or is_first_gap):
            self._begin_diagnosis(self._changed_ns)
            self._changed_ns = 0
            self._diagnosed_s = time.monotonic()

    def _begin_diagnosis(self, begin_ns: int) -> None:
        """Begin a diagnosis of the samples since a stamp, ns."""
        name = datetime.now(timezone.utc).strftime('diagnosis_%Y%m%dT%H%M%S_%fZ')
        self._run = DiagnosisRun(self._output / name, self._live.diagnosis_input(begin_ns))

    def _serve(self) -> None:
        """Take requests of ~/diagnose, and answer them when the diagnosis ends."""
        self._requests += self._service.take()
        if self._requests and self._run is None:
            if self._live.span_s() >= _SHORTEST_S:
                self._begin_diagnosis(0)
            else:
                self._answer(False, f'less than {_SHORTEST_S:g} s of samples; ask again later')
        if self._run is not None and (result := self._run.result) is not None:
            self._run = None
            self._result = result if result.is_done else self._result
            self.get_logger().info(f'diagnosis: {result.text}; {result.report}'.rstrip('; '))
            report = f'; report: {result.report}' if result.report else ''
            self._answer(result.is_done, result.text + report)

    def _answer(self, success: bool, text: str) -> None:
        """Answer all requests that wait."""
        self._service.answer(self._requests, success, text)
        self._requests.clear()

    def _obstacle(self) -> str:
        """Return why nothing is compared; empty where samples are."""
        silence = self._refusal or self._samples.silence()
        if silence or self._info is None:
            return silence or 'waiting for sensor_info'
        silence = self._reference.silence()
        return f'{silence}: no reference' if silence else self._live.obstacle

    def _state(self) -> tuple[Status, dict[str, Status]]:
        """Return what is known now: a summary, and the gap by axis unless nothing is compared."""
        summary = gap_status(self._live, self._result, self._settings.window_s)
        if obstacle := self._obstacle():
            return replace(summary, level=Level.WARN, summary=obstacle), {}
        return summary, {
            gap.axis: axis_status(gap, self._live.sensor.serial) for gap in self._live.report()
        }

    def _publish(self) -> None:
        summary, axes = self._state()
        parts = {'gap': summary} | {f'gap: {axis}': status for axis, status in axes.items()}
        array = DiagnosticArray(status=[topics.status_message(*part) for part in parts.items()])
        array.header.stamp = topics.stamp(self._live.newest_ns)
        self._publisher.publish(array)
        if self._info is not None:
            self._diagnose_if_due()

    def _status(self) -> Status:
        """Return the state for /diagnostics, with counts."""
        summary, axes = self._state()
        values = {**summary.values}
        for axis, status in axes.items():
            values |= {f'{axis}_{key}': value for key, value in status.values.items()}
        values |= {
            **self._live.counts,
            'diagnosis_runs': self._run is not None,
            'false_alarms_per_day': self._settings.false_alarms_per_day,
        }
        faults = self._refusal, self._samples.fault(), self._reference.fault()
        level = Level.ERROR if any(faults) else summary.level
        return replace(summary, level=level, values=values)


def main() -> int:
    """Run the node."""
    return run(Monitor, __doc__, _EXAMPLES)
