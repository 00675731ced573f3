# SPDX-License-Identifier: Apache-2.0

"""
Republish a stream corrected by its parameter file: acceleration, orientation, tilt.

The topic tilt has three angles in a Vector3Stamped, so tf2 must not transform it: use imu/data.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass
from math import isfinite
from typing import Any

from adxl_ros.compensate.compensation_policy import CompensationPolicy, StreamInterval
from adxl_ros.compensate.inversions import HALF
from adxl_ros.compensate.live_stream import COUNTS, LiveStream
from adxl_ros.errors import UserError
from adxl_ros.files import calibration_store, imu_message, parameter_file
from adxl_ros.files.stream_info import StreamInfo
from adxl_ros.links.support.base import COLUMNS
from adxl_ros.model.sensor import Sensor
from adxl_ros.nodes import parameter_checks, parameters, sensor_parameters, topics
from adxl_ros.nodes.mounting import (
    FEWEST_SAMPLES,
    mounting_by_angles,
    mounting_of,
    MountingParameters,
    NamedSensor,
)
from adxl_ros.nodes.parameters import parameter, sample_unit
from adxl_ros.nodes.run_node import run
from adxl_ros.nodes.sample_output import age_report, MOST_AGES
from adxl_ros.nodes.topics import Level, Status, STEADY
from adxl_ros.signals.recorded_gravity import LIVE_WINDOW_S, LiveLook
from adxl_ros.signals.recorded_sensor import sensor_of_stream
from geometry_msgs.msg import Vector3Stamped
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import Imu

_DEPTH = 100  # Samples that are kept while the node is busy: 0.1 s at 1 kHz
_LOOK_S = 0.5
"""Time between two looks at who publishes and, where it is unknown, at the sensor, s. A driver
that was exchanged is noticed within it, before its first rest; discovery itself takes 0.3 s."""
_EXAMPLES = {
    'the newest calibration of the unit in the store': '',
    'a calibration by its file': '--ros-args -p calibration:=unit.yaml',
}
"""Examples of arguments, by their purpose."""


@dataclass(frozen=True)
class CompensationSettings:
    """The compensation."""

    calibration: str = parameter(
        '', 'parameter file to use; setting it loads the whole file or nothing of it', live=True
    )
    inverse: str = parameter(
        'exact',
        "inverse of the model: exact, or the paper's approximation",
        choices=('exact', 'paper'),
    )
    undo_filter: bool = parameter(
        False,
        f'take the RC filter out; a sample is published {HALF} samples late, with its own stamp',
    )
    orientation: str = parameter(
        'keep',
        'of a sample that states one: keep it, or that of the tilt',
        choices=('keep', 'tilt'),
    )
    store: str = parameter(
        str(calibration_store.default_folder()),
        'folder of calibrations, '
        'whose newest of the unit is used where none is named; empty: none',
    )
    output_rate_hz: float = parameter(
        0.0,
        'single samples are published at this rate, so that faster vibration folds; 0: all',
        'Hz',
        0.0,
        1e5,
    )
    free_acceleration: bool = parameter(
        False, 'publish imu/linear_acceleration_free of samples that state an orientation'
    )
    samples_unit: str = sample_unit()
    rpy_rad: Any = parameter(
        [0.0, 0.0, 0.0],
        'roll, pitch and yaw of the case on the robot, as in a URDF joint',
        'rad',
        name='mounting.rpy_rad',
        live=True,
    )
    mounting_frame_id: str = parameter(
        'base_link',
        'frame of the robot, in the header where the case is turned',
        name='mounting.frame_id',
    )


class Compensation(Node):
    """
    The node of the compensation.

    It connects topics and parameters to the package `compensate`, which corrects the samples and
    decides which calibration applies.
    """

    def __init__(self) -> None:
        super().__init__('compensation')
        parameter_checks.check_given(self)
        self._settings = settings = parameters.declare_all(self, CompensationSettings)
        paper = settings.inverse == 'paper'
        mounting = mounting_by_angles(settings.rpy_rad)
        self._heard_ns: dict[str, int] = {}
        self._named: NamedSensor
        self._obstacle = self._told = ''  # Why the sensor is unknown; the newest line on it
        self._reported: Counter[str] = Counter()
        self._reported_ns = STEADY.now().nanoseconds
        topics.DiagnosticsReporter(self, 'compensation', self._status)
        self._ages_s: deque[float] = deque(maxlen=MOST_AGES)
        self._data = topics.create_publisher(self, Imu, 'imu/data', _DEPTH)
        tilt = topics.create_publisher(self, Vector3Stamped, 'tilt', _DEPTH)
        free = (
            topics.create_publisher(self, Vector3Stamped, 'imu/linear_acceleration_free', _DEPTH)
            if settings.free_acceleration
            else None
        )
        self._stream = LiveStream(
            paper=paper,
            undo_filter=settings.undo_filter,
            publish_imu=self._publish,
            publish_tilt=tilt.publish,
            keep_orientation=settings.orientation == 'keep',
            publish_free=free.publish if free else None,
            output_rate_hz=settings.output_rate_hz,
        )
        self._policy = CompensationPolicy(paper, settings.store, self.resolve_topic_name)
        self._look_at_gravity = LiveLook()
        self._samples = topics.Inbox(self, Imu, 'imu/data_raw', _DEPTH, settings.samples_unit)
        self._flat = sensor_parameters.given_sensor(self)
        own = NamedSensor(
            sensor_parameters.make_sensor(self._flat, may_measure=True),
            (
                'the parameters given'
                if sensor_parameters.is_from_file(self)
                else f'the nominal {parameter_file.nominal_path()}'
            ),
        )
        loaded = self._load(settings.calibration)
        self._use(loaded or own)
        self._mounting = MountingParameters(
            self, self._stream, mounting, settings.mounting_frame_id
        )
        if loaded:
            self._mounting.take(loaded)
        parameters.on_change(self, 'calibration', self._load, self._exchange)
        self.create_timer(_LOOK_S, self._look, clock=STEADY)
        topics.subscribe_info(self, self.resolve_topic_name('sensor_info'), self._on_info)
        self._surroundings = topics.SurroundingTopics(self, 1)
        self._thread = topics.RepeatingThread(self, self._receive, 'imu/data_raw')

    def close(self) -> None:
        """End the thread that receives."""
        self._thread.close()

    def _publish(self, raw: bytes) -> None:
        """Publish a corrected sample, and take note of its age."""
        self._data.publish(raw)
        stamp_s, _ = imu_message.read(raw)
        self._ages_s.append(self.get_clock().now().nanoseconds * 1e-9 - stamp_s)

    def _load(self, path: str) -> NamedSensor | None:
        """Load the file of `calibration`, if one is named; it is refused if it does not fit."""
        if not path:
            return None
        loaded = NamedSensor(parameter_file.load(path), path)
        self._policy.check(loaded.sensor)
        mounting_of(loaded)
        return loaded

    def _exchange(self, loaded: NamedSensor | None) -> None:
        if loaded is not None:
            self._told = ''
            self._use(loaded)
            self._mounting.take(loaded)

    def _use(self, named: NamedSensor) -> None:
        """Correct samples by a sensor from the next one on."""
        self._named = named
        sensor = named.sensor
        self._stream.release()
        is_named = sensor.effects or self._calibration() or sensor_parameters.is_from_file(self)
        self._stream.may_be_foreign = not (is_named or self._policy.info)
        if sensor.unstated:
            self._stream.hold()
        self._correct_by(*named)

    def _correct_by(self, sensor: Sensor, source: str) -> None:
        text = self._policy.use(sensor, source)
        self._stream.use(sensor, self._policy.rate_hz)
        self._newest: deque[bytes] = deque(
            maxlen=round(max(LIVE_WINDOW_S * self._policy.rate_hz, FEWEST_SAMPLES))
        )
        sensor_parameters.show_sensor(self, sensor)
        if self._stream.unknown is None and text != self._told:
            self.get_logger().info(text)
            self._told = text
        self._assess()

    def _look(self) -> None:
        """Refuse samples of several nodes; measure the sensor of a stream that states none."""
        self._policy.faults.mixture = self._samples.fault()
        self._check_gravity()
        self._assess()
        samples = self._stream.unknown
        if samples is None:
            return
        named = self._named.sensor
        try:
            sensor = (
                named if named.unstated else sensor_parameters.anonymous_sensor(self, self._flat)
            )
            measured, lines = sensor_of_stream(sensor, *topics.finite_samples([*samples]))
        except UserError as error:
            self._obstacle = f'{error}'
            return
        self.get_logger().info(f'measured from the stream: {"; ".join(lines)}')
        self._stream.release()
        self._correct_by(measured, 'what the stream shows')

    def _check_gravity(self) -> None:
        """Look whether the newest rests read gravity."""
        newest = [*self._newest]
        if self._stream.unknown is not None or not newest:
            return
        fault = self._look_at_gravity(
            self._policy.sensor, self._policy.rate_hz, *topics.finite_samples(newest)
        ).fault
        text = (
            ''
            if fault is None
            else f'{self.resolve_topic_name("imu/data_raw")}: {fault.live_text}'
        )
        is_clear = fault is not None and fault.is_clear
        faults = self._policy.faults
        faults.no_gravity = text if is_clear else ''
        faults.wrong_gravity = '' if is_clear else text

    def _on_info(self, info: StreamInfo) -> None:
        self._policy.info = info
        if self._stream.may_be_foreign or self._policy.sensor is not self._named.sensor:
            self._use(self._named)
        self._take_from_store()
        self._stream.use(self._policy.sensor, self._policy.rate_hz)
        self._assess()

    def _take_from_store(self) -> None:
        """Use the newest calibration of the stream's unit, unless one was named."""
        path, warnings = self._policy.choose(self._calibration())
        if path:
            before = self._policy.stored_path
            self._policy.stored_path = path
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
        topics.log(
            self,
            Level.ERROR if refusal else Level.OK,
            f'publishing nothing: {refusal}' if refusal else 'publishing again',
        )

    def _receive(self) -> None:
        """Correct the samples that come, by the newest finite temperature and supply."""
        self._samples.wait()
        for topic, _, values in self._surroundings.take():
            if isfinite(value := float(values[-1, 0])):
                self._stream.surround(COLUMNS[topic], value)
                self._heard_ns[COLUMNS[topic]] = self.get_clock().now().nanoseconds
        for sample in self._samples.take():
            self._newest.append(sample)
            self._stream(sample)

    def _status(self) -> Status:
        steady_ns = STEADY.now().nanoseconds
        ros_ns = self.get_clock().now().nanoseconds
        totals = {name: self._stream.counts[name] for name in COUNTS}
        duration_s = (steady_ns - self._reported_ns) * 1e-9
        counts = {name: total - self._reported[name] for name, total in totals.items()}
        self._reported = Counter(totals)
        self._reported_ns = steady_ns
        interval = StreamInterval(
            duration_s=duration_s,
            counts=counts,
            outside=self._stream.outside,
            surroundings=self._stream.surroundings.copy(),
            ages_s={name: (ros_ns - ns) * 1e-9 for name, ns in self._heard_ns.items()},
            obstacle=self._obstacle if self._stream.unknown is not None else '',
        )
        newer = self._policy.newer()
        state = self._policy.status(interval, newer, self._calibration())
        late = HALF if self._settings.undo_filter else 0
        values = {
            'rate_in_hz': round(counts['received'] / duration_s, 1),
            'rate_out_hz': round(counts['published'] / duration_s, 1),
            **totals,
            'delay_s': late / self._policy.rate_hz,
            **age_report(self._ages_s),
            **self._policy.values(interval, newer),
        }
        return Status(state.level, state.text, self._policy.sensor.serial, values)


def main() -> int:
    """Run the node."""
    return run(Compensation, __doc__, _EXAMPLES)
