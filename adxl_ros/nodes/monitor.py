# SPDX-License-Identifier: Apache-2.0

"""Compare a running sensor with its prediction: gap, noise floor, changes, likely cause."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, UTC
from pathlib import Path
import time

from adxl_ros.errors import UserError
from adxl_ros.files import cdr
from adxl_ros.files.recording_columns import check_unit, unit_of
from adxl_ros.files.stream_info import NO_UNIT, StreamInfo
from adxl_ros.monitor import records
from adxl_ros.monitor.live_gap import AxisGap, GapChange, GapSettings, LiveGap
from adxl_ros.monitor.records import DiagnosisResult, DiagnosisRun, iso_time
from adxl_ros.monitor.reference_stream import ReferenceKind, ReferenceStream
from adxl_ros.nodes import topics
from adxl_ros.nodes.parameters import declare_all, declare_sensor, make_sensor
from adxl_ros.nodes.rclpy_internals import NotForExecutors, take_request
from adxl_ros.nodes.run_node import NodeHelp, run
from adxl_ros.nodes.samples_in import decoded, imu_samples, joint_readings
from adxl_ros.nodes.settings import check_given_parameters, MonitorSettings
from adxl_ros.nodes.topics import Inbox, Level, Status
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import BatteryState, Imu, JointState, Temperature
from std_srvs.srv import Trigger

_TOGETHER_NS = 120_000_000_000
"""Time within which changes are one event, ns; chosen: slow axes are found later."""


@dataclass(frozen=True)
class GapState:
    """What the monitor knows at one moment."""

    serial: str  # Serial number of the sensor
    stamp_ns: int  # Stamp of the newest sample, ns; 0 before the first
    obstacle: str  # Why nothing is compared; empty where it is
    axes: Sequence[AxisGap]  # The gap by axis; empty before the first seconds
    changes: Sequence[GapChange]  # Changes so far
    likely: DiagnosisResult | None  # The newest diagnosis; None before it
    window_s: float  # Time over which the gap is taken, s

    @property
    def event(self) -> list[GapChange]:
        """Return the changes of the newest event, the earliest first."""
        newest_ns = max((change.since_ns for change in self.changes), default=0)
        return sorted((change for change in self.changes
                       if newest_ns - change.since_ns < _TOGETHER_NS),
                      key=lambda change: change.since_ns)

    @property
    def level(self) -> Level:
        """Return OK where the gap is no larger than the floor, and nothing has changed."""
        fine = not self.obstacle and self.axes and not self.changes
        return Level.OK if fine and not any(gap.is_open for gap in self.axes) else Level.WARN

    def text(self) -> str:
        """Return the state in one line."""
        if self.obstacle:
            return self.obstacle
        if not self.axes:
            return 'comparing; the first result takes some seconds'
        gaps = ', '.join(f'{gap.axis} {gap.gap.value:.3g}' for gap in self.axes)
        floors = ', '.join(f'{gap.axis} {gap.floor.value:.3g}' for gap in self.axes)
        parts = [f'gap {gaps} mg, floor {floors} mg']
        if event := self.event:
            latest = {(change.axis, change.quantity): change.text() for change in event}
            parts.append(f'changed since {iso_time(event[0].since_ns)}: '
                         f'{", ".join(latest.values())}')
        if self.likely is not None:
            parts.append('likely ' * bool(self.likely.effects) + self.likely.text)
        return '; '.join(parts)

    def values(self) -> dict[str, object]:
        """Return the values of the summary by key."""
        values: dict[str, object] = {'window_s': self.window_s, 'changes': len(self.changes)}
        if event := self.event:
            values |= {'changed_since': iso_time(event[0].since_ns),
                       'changed_since_s': event[0].since_ns * 1e-9,
                       'detected_s': event[0].detected_ns * 1e-9}
        if self.likely is not None:
            values |= {'likely_effect': ', '.join(self.likely.effects),
                       'probability': self.likely.probability, 'report': self.likely.report}
        return values

    def message(self) -> DiagnosticArray:
        """Return the message of the topic `gap`: the summary, then one status for each axis."""
        summary = Status(self.level, self.text(), self.serial, self.values())
        axes = {f'gap: {gap.axis}': Status(
            Level.WARN if gap.is_open else Level.OK, _axis_text(gap), self.serial,
            axis_values(gap)) for gap in (() if self.obstacle else self.axes)}
        array = DiagnosticArray(status=[topics.status_message(name, status) for name, status in
                                        ({'gap': summary} | axes).items()])
        array.header.stamp = topics.stamp(self.stamp_ns)
        return array


def axis_values(gap: AxisGap) -> dict[str, object]:
    """Return the values of an axis by key; `explained` is absent where nothing is to explain."""
    values: dict[str, object] = {
        'gap_mg': gap.gap.value, 'gap_low_mg': gap.gap.low, 'gap_high_mg': gap.gap.high,
        'floor_mg': gap.floor.value, 'floor_low_mg': gap.floor.low,
        'floor_high_mg': gap.floor.high, 'offset_mg': gap.offset_mg,
        'floor_source': gap.floor_source}
    return values if gap.explained is None else values | {'explained': gap.explained}


def _axis_text(gap: AxisGap) -> str:
    """Return the gap of an axis in words."""
    share = '' if gap.explained is None else \
        f'; the parameters explain {100 * gap.explained:.0f} %'
    return (f'gap {gap.gap.value:.3g} mg ({gap.gap.low:.3g} to {gap.gap.high:.3g}), floor '
            f'{gap.floor.value:.3g} mg{share}')


_INPUT_QUEUE = 10000
"""Messages that are kept while the node is busy: 10 s at 1 kHz."""


class MonitorStreams:
    """Takes samples, reference and surroundings."""

    def __init__(self, node: Node, kind: ReferenceKind, reference_topic: str) -> None:
        self._kind = kind
        reference = JointState if kind is ReferenceKind.STAGE else Imu
        self._samples, self._reference, self._temperature, self._supply = (
            Inbox(node, message, topic, _INPUT_QUEUE) for message, topic in (
                (Imu, 'imu/data_raw'), (reference, reference_topic),
                (Temperature, 'temperature'), (BatteryState, 'supply')))

    def take_samples(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the samples that wait: stamps, ns, (n,), and acceleration, m/s², (n, 3)."""
        return imu_samples(self._samples.take())

    def fault(self) -> str:
        """Return that several nodes publish samples or reference, so that none count, or ''."""
        return self._samples.fault() or self._reference.fault()

    def take_others(self, reference: ReferenceStream) -> int:
        """Add reference and surroundings that wait; return how many messages of it came."""
        stamps_ns, fields = decoded(self._temperature.take(), cdr.temperature, temperature=1)
        reference.add_surroundings('temperature_c', stamps_ns, fields['temperature'])
        stamps_ns, fields = decoded(self._supply.take(), cdr.battery_state, voltage=1)
        reference.add_surroundings('supply_v', stamps_ns, fields['voltage'])
        messages = self._reference.take()
        if self._kind is ReferenceKind.IMU:
            reference.add_readings(*imu_samples(messages))
        else:
            readings = [reading for reading in joint_readings(messages) if reading.position]
            reference.add_joints([reading.stamp_ns for reading in readings],
                                 [reading.position for reading in readings])
        return len(messages)


_TURN_S = 0.05
"""Time between two looks at the topics, s; chosen: a turn costs as much as ten messages."""
_PERIOD_S = 1.0
"""Time between two messages on `gap`, s."""
_QUEUE = 10
"""Messages that are kept for a slow subscriber; chosen: 10 s."""
_INFO_S = 3.0
"""Time that samples wait for `sensor_info`, s; chosen: a latched message comes within 1 s."""
_SILENT_S = 3.0
"""Time without messages after which a topic is silent, s; chosen."""
_SHORTEST_S = 20.0
"""Shortest time of samples that is diagnosed, s; chosen: `diagnose` needs some rests or moves."""
_PAUSE_S = 600.0
"""Shortest time between two automatic diagnoses, s; chosen: each may cost minutes of a core."""
_EXAMPLES = {
    'a sensor on a stage': '--ros-args --params-file unit.yaml',
    'a sensor beside its simulation': '--ros-args --params-file unit.yaml -p reference:=imu '
    '-p reference_topic:=/sim/imu',
    'one false alarm a year at most': '--ros-args -p false_alarms_per_day:=0.0027',
}
"""Examples of arguments, by their purpose."""


class Monitor(Node):
    """
    The node of the live gap.

    It connects topics and parameters to the package `monitor`, which compares and tests.
    """

    def __init__(self) -> None:
        super().__init__('monitor')
        check_given_parameters(self)
        self._file_sensor = make_sensor(declare_sensor(self))
        self._own = own = declare_all(self, MonitorSettings)
        self._kind = ReferenceKind(own.reference)
        self._reference_topic = own.reference_topic or (
            'stage/joint_states' if self._kind is ReferenceKind.STAGE else 'imu/ideal')
        self._settings = GapSettings(own.window_s, own.false_alarms_per_day, own.history_s,
                                     own.wait_s)
        self._output = Path(own.output).expanduser()
        self._live: LiveGap | None = None
        self._info: StreamInfo | None = None
        self._refusal = ''
        self._run: DiagnosisRun | None = None
        self._result: DiagnosisResult | None = None
        self._headers: list[object] = []
        self._changed_ns: int | None = None
        self._diagnosed_s = -_PAUSE_S
        self._begun_s = self._sampled_s = self._referenced_s = self._heard_s = 0.0
        self._streams = MonitorStreams(self, self._kind, self._reference_topic)
        self._publisher = topics.create_publisher(self, DiagnosticArray, 'gap', _QUEUE)
        self._service = self.create_service(Trigger, '~/diagnose', lambda _, answer: answer,
                                            callback_group=NotForExecutors())
        self._diagnostics = topics.DiagnosticsReporter(self, {'gap': self._status})
        topics.create_subscription(self, DiagnosticStatus, 'sensor_info', self._on_info, 1,
                                   latched=True)
        self.create_timer(_TURN_S, self._turn, clock=topics.STEADY)
        self.create_timer(_PERIOD_S, self._publish, clock=topics.STEADY)

    def close(self) -> None:
        """End a diagnosis that runs."""
        if self._run is not None:
            self._run.close()

    def _on_info(self, message: DiagnosticStatus) -> None:
        """Compare by what the stream states of its sensor; begin again if that has changed."""
        info = topics.stream_info(message, self.resolve_topic_name('sensor_info'))
        if self._info is None or self._info.texts != info.texts:
            self._info = info
            self._compare_by(info)

    def _compare_by(self, info: StreamInfo) -> None:
        """Begin a comparison with the parameters, as far as they fit the stream."""
        sensor = self._file_sensor
        try:
            if sensor.effects or sensor.serial != NO_UNIT:
                check_unit(info, info.axes or sensor.axes, sensor)
                sensor = replace(sensor, rate_hz=info.rate_hz or sensor.rate_hz)
            else:
                sensor = unit_of(sensor, info)
            self._live, self._refusal = LiveGap(sensor, self._kind, self._settings), ''
        except UserError as error:
            self._live, self._refusal = None, str(error)
            self.get_logger().error(self._refusal)
            return
        self._changed_ns = self._result = None
        effects = ', '.join(sensor.effects) or 'no effects'
        self.get_logger().info(
            f'comparing {self.resolve_topic_name("imu/data_raw")} of {sensor.serial} ({effects}) '
            f'with {self.resolve_topic_name(self._reference_topic)}')
        if self._live.left_out:
            self.get_logger().warning(f'not predicted, for want of stage angles: '
                                      f'{", ".join(self._live.left_out)}')

    def _turn(self) -> None:
        """Take what has come, compare, and serve."""
        now_s = time.monotonic()
        stamps_ns, accel_mps2 = self._streams.take_samples()
        if len(stamps_ns):
            self._begun_s = self._begun_s or now_s
            self._sampled_s = now_s
        if self._live is None and not self._refusal and self._begun_s \
                and now_s - self._begun_s > _INFO_S:
            self._compare_by(StreamInfo({}, self.resolve_topic_name('sensor_info')))
        if self._live is not None:
            self._live.add_samples(stamps_ns, accel_mps2)
            if self._streams.take_others(self._live.reference):
                self._referenced_s = now_s
            self._advance(self._live)
        self._serve()

    def _advance(self, live: LiveGap) -> None:
        """Compare, and put changes on disk before they are published."""
        changes = live.advance()
        for change in changes:
            self.get_logger().warning(
                f'changed since {records.iso_time(change.since_ns)}: {change.text()}')
            try:
                self._output.mkdir(parents=True, exist_ok=True)
                records.append(self._output, change, live.sensor.serial)
            except (UserError, OSError) as error:
                self.get_logger().error(f'{self._output}: the change is not on disk: {error}')
        if changes:
            # The waiting time of a diagnosis does not start again with a further change.
            self._changed_ns = self._changed_ns or min(change.since_ns for change in changes)
            self._diagnostics.notice('gap', Level.WARN)

    def _diagnose_if_due(self, live: LiveGap) -> None:
        """Diagnose a change, or the first open gap, once there are enough samples."""
        if not self._own.automatic or self._run is not None \
                or time.monotonic() - self._diagnosed_s < _PAUSE_S \
                or live.span_s(self._changed_ns or 0) < self._settings.wait_s:
            return
        if self._changed_ns or (self._result is None and any(g.is_open for g in live.report())):
            begin_ns, self._changed_ns = self._changed_ns or 0, None
            self._diagnosed_s = time.monotonic()
            self._begin_diagnosis(live, begin_ns)

    def _begin_diagnosis(self, live: LiveGap, begin_ns: int) -> None:
        """Begin a diagnosis of the samples since a stamp, ns."""
        name = datetime.now(UTC).strftime('diagnosis_%Y%m%dT%H%M%S_%fZ')
        self._run = DiagnosisRun(self._output / name, live.diagnosis_input(begin_ns),
                                 'adxl_ros.tools.diagnose', self._own.budget_s)

    def _serve(self) -> None:
        """Take requests of ~/diagnose, and answer them when the diagnosis ends."""
        while (request := take_request(self._service, Trigger)) is not None:
            self._headers.append(request[1])
            live = self._live
            if self._run is None and live is not None and live.span_s() >= _SHORTEST_S:
                self._begin_diagnosis(live, 0)
            elif self._run is None:
                self._answer(DiagnosisResult(False, f'less than {_SHORTEST_S:g} s of samples; '
                                             'ask again later'))
        if self._run is None or self._run.result is None:
            return
        result, self._run = self._run.result, None
        if result.is_done:
            self._result = result
        self.get_logger().info(f'diagnosis: {result.text}; {result.report}'.rstrip('; '))
        self._answer(result)

    def _answer(self, result: DiagnosisResult) -> None:
        """Answer all requests that wait."""
        text = f'{result.text}; report: {result.report}' if result.report else result.text
        for header in self._headers:
            self._service.send_response(Trigger.Response(success=result.is_done, message=text),
                                        header)
        self._headers.clear()

    def _obstacle(self) -> str:
        """Return why nothing is compared; empty where samples are."""
        now_s = time.monotonic()
        if self._refusal or self._streams.fault():
            return self._refusal or self._streams.fault()
        if now_s - self._sampled_s > _SILENT_S:
            return self._silence('imu/data_raw')
        if self._live is None:
            return 'waiting for sensor_info'
        if now_s - self._referenced_s > _SILENT_S:
            return f'{self._silence(self._reference_topic)}: no reference'
        return self._live.obstacle

    def _silence(self, topic: str) -> str:
        """Return that a topic is silent, and whether it has a publisher."""
        name = self.resolve_topic_name(topic)
        return f'nothing on {name}' + ('' if self.count_publishers(name) else
                                       ', and nobody publishes it')

    def _state(self) -> GapState:
        """Return what is known now."""
        live = self._live
        sensor = live.sensor if live else self._file_sensor
        return GapState(sensor.serial, live.newest_ns if live else 0, self._obstacle(),
                        live.report() if live else (), live.changes if live else (),
                        self._result, self._settings.window_s)

    def _publish(self) -> None:
        self._publisher.publish(self._state().message())
        if self._live is not None:
            self._diagnose_if_due(self._live)

    def _status(self) -> Status:
        """Return the state for /diagnostics, with counts."""
        state = self._state()
        values = state.values()
        for gap in () if state.obstacle else state.axes:
            values |= {f'{gap.axis}_{key}': value for key, value in axis_values(gap).items()}
        if self._live is not None:
            values |= vars(self._live.counts)
        values |= {'false_alarms_per_day': self._settings.false_alarms_per_day,
                   'diagnosis_runs': self._run is not None}
        level = Level.ERROR if self._refusal or self._streams.fault() else state.level
        return Status(level, state.text(), state.serial, values)


def main() -> int:
    """Run the node."""
    return run(Monitor, NodeHelp(__doc__, _EXAMPLES, (MonitorSettings,)))
