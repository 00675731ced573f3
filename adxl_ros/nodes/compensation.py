# SPDX-License-Identifier: Apache-2.0

"""
Republish a stream corrected by its parameter file: acceleration, orientation, tilt.

The topic tilt has three angles in a Vector3Stamped, so tf2 must not transform it: use imu/data.
"""

from __future__ import annotations

from collections import Counter
from math import isfinite
from typing import Any

from adxl_ros.compensate import filter_inversion
from adxl_ros.compensate.compensation_policy import CompensationPolicy, Interval, State, Topics
from adxl_ros.compensate.live_stream import COUNTS, LiveStream
from adxl_ros.errors import UserError
from adxl_ros.files import calibration_store, imu_message
from adxl_ros.files.stream_info import StreamInfo
from adxl_ros.model.sensor import Sensor
from adxl_ros.nodes.support.diagnostics import DiagnosticsReporter, Level, Status
from adxl_ros.nodes.support.exchangeable_sensor import ExchangeableSensor
from adxl_ros.nodes.support.given_parameters import check_given_parameters
from adxl_ros.nodes.support.imu_subscription import finite_samples
from adxl_ros.nodes.support.mounting_parameters import MountingParameters
from adxl_ros.nodes.support.node_help import NodeHelp
from adxl_ros.nodes.support.parameters import declare
from adxl_ros.nodes.support.receive_thread import ReceiveTurn, RepeatingThread
from adxl_ros.nodes.support.run_node import run
from adxl_ros.nodes.support.sample_ages import SampleAges
from adxl_ros.nodes.support.sensor_parameters import is_from_file
from adxl_ros.nodes.support.topics import create_publisher, create_subscription
from adxl_ros.signals.measured_values import unit_of_stream
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Vector3Stamped
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import BatteryState, Imu, Temperature

_DEPTH = 100
"""Samples that are kept while the node is busy: 0.1 s at 1 kHz."""
_LOOK_S = 0.5
"""Time between two looks at who publishes and, where it is unknown, at the sensor, s; chosen."""
_LEVELS = {State.REFUSED: Level.ERROR, State.COMPENSATING: Level.OK}
"""Levels of the states; all others are warnings."""
_EXAMPLES = {
    'the newest calibration of the unit in the store': '',
    'a calibration by its file': '--ros-args -p calibration:=unit.yaml',
    'a sensor that moves, without the lag of its filter':
        '--ros-args -p calibration:=unit.yaml -p undo_filter:=true',
}
"""Examples of arguments, by their purpose."""


class Compensation(Node):
    """
    The node of the compensation.

    It connects topics and parameters to the package `compensate`, which corrects the samples and
    decides which calibration applies.
    """

    def __init__(self) -> None:
        super().__init__('compensation')
        check_given_parameters(self)
        paper = declare(
            self, 'inverse', 'exact', "inverse of the model: exact, or the paper's approximation",
            choices=('exact', 'paper')) == 'paper'
        self._undo_filter = declare(
            self, 'undo_filter', False, 'take the RC filter out, amplitude and phase; a sample '
            f'is published {filter_inversion.HALF} samples late, with its own stamp')
        keeps_orientation = declare(
            self, 'orientation', 'keep', 'keep: a sample that states an orientation keeps it; '
            'tilt: imu/data has that of the tilt', choices=('keep', 'tilt')) == 'keep'
        store = declare(
            self, 'store', str(calibration_store.default_folder()),
            'folder of calibrations, of which the newest of the unit is taken where none is '
            'named; empty: none')
        self._heard_ns: dict[str, int] = {}
        self._named: tuple[Sensor, str]
        self._obstacle = ''
        self._reported: Counter[str] = Counter()
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._reported_ns = self._steady.now().nanoseconds
        self._diagnostics = DiagnosticsReporter(self, {'compensation': self._status})
        self._ages = SampleAges()
        self._data = create_publisher(self, Imu, 'imu/data', _DEPTH)
        tilt = create_publisher(self, Vector3Stamped, 'tilt', _DEPTH)
        output_rate_hz = declare(
            self, 'output_rate_hz', 0.0, 'rate of imu/data and tilt: one sample of so many is '
            'published as it is, so that vibration above half of this rate folds into it; 0: '
            'every sample', 'Hz', 0.0, 1e5)
        publishes_free = declare(
            self, 'free_acceleration', False, 'publish imu/linear_acceleration_free: the '
            'acceleration without gravity of samples that state an orientation')
        free = create_publisher(self, Vector3Stamped, 'imu/linear_acceleration_free', _DEPTH) \
            if publishes_free else None
        self._stream = LiveStream(paper, self._undo_filter, self._publish, tilt.publish,
                                  keeps_orientation, free.publish if free else None,
                                  output_rate_hz)
        self._policy = CompensationPolicy(paper, store, Topics(
            data_raw=self.resolve_topic_name('imu/data_raw'),
            sensor_info=self.resolve_topic_name('sensor_info'),
            temperature=self.resolve_topic_name('temperature'),
            supply=self.resolve_topic_name('supply')))
        self._samples = ReceiveTurn(self, Imu, 'imu/data_raw', self._stream, _DEPTH)
        self._sensor = ExchangeableSensor(self, self._policy.check, self._use)
        MountingParameters(self, self._stream)
        self.create_timer(_LOOK_S, self._look, clock=self._steady)
        create_subscription(self, DiagnosticStatus, 'sensor_info', self._on_info, 1, latched=True)
        create_subscription(self, Temperature, 'temperature', self._on_temperature, 1)
        create_subscription(self, BatteryState, 'supply', self._on_supply, 1)
        self._thread = RepeatingThread(self, self._samples, 'imu/data_raw')

    def close(self) -> None:
        """End the thread that receives."""
        self._thread.close()

    def _publish(self, raw: bytes) -> None:
        """Publish a corrected sample, and take note of its age."""
        self._data.publish(raw)
        stamp_s, _ = imu_message.read(raw)
        self._ages.add((self.get_clock().now().nanoseconds * 1e-9 - stamp_s,))

    def _use(self, sensor: Sensor, source: str) -> None:
        """Correct samples by a sensor from the next one on; `source` says where it is from."""
        self._named = sensor, source
        self._stream.release()
        is_named = sensor.effects or self._calibration() or is_from_file(self)
        self._stream.may_be_foreign = not (is_named or self._policy.info)
        if sensor.unstated:
            self._stream.hold()
        self._correct_by(sensor, source)

    def _correct_by(self, sensor: Sensor, source: str) -> None:
        text = self._policy.use(sensor, source)
        self._stream.use(sensor, self._policy.rate_hz)
        if self._stream.unknown is None:
            self.get_logger().info(text)
        self._assess()

    def _look(self) -> None:
        """Refuse samples of several nodes; measure the sensor of a stream that states none."""
        self._policy.mixture = self._samples.fault()
        self._assess()
        samples = self._stream.unknown
        if samples is None:
            return
        named, _ = self._named
        try:
            unit, lines = unit_of_stream(
                named if named.unstated else self._sensor.anonymous(), *finite_samples([*samples]))
        except UserError as error:
            self._obstacle = f'{error}'
            return
        self.get_logger().info(f'measured from the stream: {"; ".join(lines)}')
        self._stream.release()
        self._correct_by(unit, 'what the stream shows')

    def _on_info(self, message: DiagnosticStatus) -> None:
        self._policy.info = StreamInfo({pair.key: pair.value for pair in message.values},
                                       self.resolve_topic_name('sensor_info'))
        if self._stream.may_be_foreign or self._policy.sensor is not self._named[0]:
            self._use(*self._named)
        self._take_from_store()
        self._stream.restart_filter(self._policy.rate_hz)
        self._assess()

    def _take_from_store(self) -> None:
        """Use the newest calibration of the stream's unit, unless one was named."""
        path, warnings = self._policy.choose(self._calibration())
        if path:
            before, self._policy.stored_path = self._policy.stored_path, path
            result = self.set_parameters([Parameter('calibration', value=path)])[0]
            if not result.successful:
                self._policy.stored_path = before
                warnings += self._policy.new_warnings([f'not taken: {result.reason}'])
        for text in warnings:
            self.get_logger().warning(text)

    def _calibration(self) -> str:
        """Return the path of the parameter `calibration`, '' without one."""
        return self.get_parameter('calibration').value

    def _assess(self) -> None:
        """Publish only if the coefficients are those of the stream's unit; log a change."""
        changed = self._policy.assess()
        refusal = self._policy.refusal
        self._stream.refused = bool(refusal)
        if not changed:
            return
        if refusal:
            self.get_logger().error(f'publishing nothing: {refusal}')
        else:
            self.get_logger().info('publishing again')
        self._diagnostics.notice('compensation', Level.ERROR if refusal else Level.OK)

    def _on_temperature(self, message: Temperature) -> None:
        self._set_surroundings('temperature_c', message.temperature)

    def _on_supply(self, message: BatteryState) -> None:
        self._set_surroundings('supply_v', message.voltage)

    def _set_surroundings(self, name: str, value: float) -> None:
        """Use a temperature, °C, or supply, V, from the next sample on; ignore NaN."""
        if isfinite(value):
            self._stream.surround(name, value)
            self._heard_ns[name] = self.get_clock().now().nanoseconds

    def _status(self) -> Status:
        interval = self._interval()
        newer = self._policy.newer()
        state, text = self._policy.status(interval, newer, self._calibration())
        counts, duration_s = interval.counts, interval.duration_s
        delay_s = filter_inversion.HALF / self._policy.rate_hz if self._undo_filter else 0.0
        values: dict[str, Any] = {
            'rate_in_hz': round(counts['received'] / duration_s, 1),
            'rate_out_hz': round(counts['published'] / duration_s, 1),
            **{name: self._reported[name] for name in COUNTS},
            'delay_s': delay_s, **self._ages.report(), **self._policy.values(interval, newer)}
        return Status(_LEVELS.get(state, Level.WARN), text, self._policy.sensor.serial, values)

    def _interval(self) -> Interval:
        """Return what the stream has shown since the last report, and begin a new interval."""
        steady_ns, ros_ns = self._steady.now().nanoseconds, self.get_clock().now().nanoseconds
        counts = Counter({name: self._stream.counts[name] for name in COUNTS})
        interval = Interval(
            duration_s=(steady_ns - self._reported_ns) * 1e-9,
            counts={name: counts[name] - self._reported[name] for name in COUNTS},
            outside=self._stream.outside,
            surroundings=self._stream.surroundings.copy(),
            ages_s={name: (ros_ns - ns) * 1e-9 for name, ns in self._heard_ns.items()},
            obstacle=self._obstacle if self._stream.unknown is not None else '')
        self._reported, self._reported_ns = counts, steady_ns
        return interval


def main() -> int:
    """Run the node."""
    return run(Compensation, NodeHelp(__doc__, _EXAMPLES))
