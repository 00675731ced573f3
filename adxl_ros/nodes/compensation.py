# SPDX-License-Identifier: Apache-2.0

"""
Republish a stream corrected by its parameter file: acceleration, orientation, tilt.

The topic tilt has three angles in a Vector3Stamped, so tf2 must not transform it: use imu/data.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from math import isfinite
from typing import Any

from adxl_ros.compensate import inversions
from adxl_ros.compensate.compensation_policy import CompensationPolicy, Interval, State, Topics
from adxl_ros.compensate.live_stream import COUNTS, LiveStream
from adxl_ros.errors import UserError
from adxl_ros.files import imu_message
from adxl_ros.files.stream_info import StreamInfo
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.kinematics import Mounting
from adxl_ros.model.sensor import Sensor
from adxl_ros.nodes.node_help import NodeHelp
from adxl_ros.nodes.parameters import declare_all, parameter_error
from adxl_ros.nodes.run_node import run
from adxl_ros.nodes.sample_output import SampleAges
from adxl_ros.nodes.samples_in import finite_samples
from adxl_ros.nodes.sensor_parameters import ExchangeableSensor, is_from_file
from adxl_ros.nodes.settings import check_given_parameters, CompensationSettings
from adxl_ros.nodes.topics import (
    create_publisher,
    create_subscription,
    DiagnosticsReporter,
    Inbox,
    Level,
    RepeatingThread,
    Status,
    STEADY,
)
from adxl_ros.signals.recorded_sensor import unit_of_stream
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Vector3Stamped
import numpy as np
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future
from sensor_msgs.msg import BatteryState, Imu, Temperature
from std_srvs.srv import Trigger

_RPY = 'mounting.rpy_rad'
"""Parameter of the rotation."""
_LEVEL_S = 1.0
"""Time over which a rest is averaged, s; chosen: the noise of a sample then is negligible."""
_FEWEST_SAMPLES = 10
"""Smallest number of samples of that rest; chosen: they show whether the sensor moves."""
_MAX_NOISE = 3.0
"""Largest scatter of a rest, in standard deviations of a sample's noise; chosen."""
_MAX_GRAVITY_ERROR = 0.1
"""Largest relative departure of a rest from gravity; chosen: beyond an uncalibrated sensor."""


class MountingParameters:
    """The parameters `mounting.*` and the service `~/level` of a node."""

    def __init__(self, node: Node, stream: LiveStream, settings: CompensationSettings) -> None:
        self._node, self._stream = node, stream
        self._frame_id = settings.mounting_frame_id
        self._mounting = _mounting(settings.rpy_rad)
        self._waiting: Future | None = None
        stream.mount(self._mounting, self._frame_id)
        node.add_on_set_parameters_callback(_check)
        node.add_post_set_parameters_callback(self._apply)
        # The answer comes after a second of samples, which the node takes meanwhile.
        node.create_service(Trigger, '~/level', self._on_level,
                            callback_group=ReentrantCallbackGroup())

    def _apply(self, parameters: Sequence[Parameter]) -> None:
        for parameter in parameters:
            if parameter.name == _RPY:
                self._mounting = _mounting(parameter.value)
                self._stream.mount(self._mounting, self._frame_id)

    async def _on_level(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._waiting is not None:
            response.message = 'a rest is being averaged; wait for its answer'
            return response
        self._waiting = Future()
        self._stream.collect()
        timer = self._node.create_timer(_LEVEL_S, self._waiting_ends,
                                        clock=STEADY)
        await self._waiting
        self._node.destroy_timer(timer)
        forces_mps2, self._waiting = self._stream.collected(), None
        self._stream.stop_collecting()
        try:
            levelled = level(self._mounting, forces_mps2, self._stream.sensor)
        except UserError as error:
            response.message = f'{error}'
            return response
        rpy_rad = [round(angle, 6) for angle in levelled.rpy_rad]
        self._node.set_parameters([Parameter(_RPY, value=rpy_rad)])
        degrees = ', '.join(f'{np.degrees(angle):.2f}' for angle in rpy_rad)
        response.success = True
        yaml = f'[{", ".join(f"{angle:.6f}" for angle in rpy_rad)}]'
        response.message = (
            f'level: roll, pitch, yaw of the case are {degrees} deg, until this node ends; to '
            f"keep them, start it with -p '{_RPY}:={yaml}', or write '/**: {{ros__parameters: "
            f"{{{_RPY}: {yaml}}}}}' into a file and start it with --params-file")
        self._node.get_logger().info(response.message)
        return response

    def _waiting_ends(self) -> None:
        if self._waiting is not None and not self._waiting.done():
            self._waiting.set_result(True)


def level(mounting: Mounting, forces_mps2: np.ndarray, sensor: Sensor) -> Mounting:
    """
    Return the mounting that makes the force of a rest vertical.

    forces_mps2: corrected samples in the frame of the case, m/s², (n, 3).
    """
    if len(forces_mps2) < _FEWEST_SAMPLES:
        raise UserError(f'{len(forces_mps2)} samples in {_LEVEL_S:g} s; at least '
                        f'{_FEWEST_SAMPLES} are needed')
    mean_mps2 = forces_mps2.mean(axis=0)
    scatter_mps2 = forces_mps2.std(axis=0)[:len(sensor.axes)]
    noise_mps2 = noise.sample_std_v(sensor) / sensor.scale_v_per_g * G0_MPS2
    worst = int(np.argmax(scatter_mps2 / noise_mps2))
    if scatter_mps2[worst] > _MAX_NOISE * noise_mps2[worst]:
        raise UserError(f'the sensor moves: {sensor.axes[worst]} scatters by '
                        f'{scatter_mps2[worst]:.2g} m/s², and its noise is '
                        f'{noise_mps2[worst]:.2g} m/s²; let the robot rest on level ground')
    magnitude_mps2 = float(np.linalg.norm(mean_mps2))
    if abs(magnitude_mps2 / sensor.local_gravity_mps2 - 1) > _MAX_GRAVITY_ERROR:
        raise UserError(f'the sensor reads {magnitude_mps2:.2f} m/s², and gravity is '
                        f'{sensor.local_gravity_mps2:.2f} m/s²; calibrate it first')
    return mounting.levelled(mean_mps2.tolist())


def _mounting(rpy_rad: Sequence[float]) -> Mounting:
    if _fault(rpy_rad):
        raise parameter_error(_RPY, _fault(rpy_rad))
    roll, pitch, yaw = rpy_rad
    return Mounting((float(roll), float(pitch), float(yaw)))


def _fault(rpy_rad: Sequence[float]) -> str:
    """Return why a rotation is not three angles in rad; empty where it is."""
    if len(rpy_rad) != 3 or not np.isfinite(rpy_rad).all():
        return f'{list(rpy_rad)} is not roll, pitch and yaw in rad'
    if np.abs(rpy_rad).max() > 2 * np.pi:
        in_rad = ', '.join(f'{angle:.6g}' for angle in np.radians(rpy_rad))
        return f'{list(rpy_rad)} is more than a turn in rad; if it is in degrees, write [{in_rad}]'
    return ''


def _check(parameters: Sequence[Parameter]) -> SetParametersResult:
    """Refuse a rotation that is not three angles in rad."""
    for parameter in parameters:
        fault = _fault(parameter.value) if parameter.name == _RPY else ''
        if fault:
            return SetParametersResult(successful=False, reason=f'{_RPY}: {fault}')
    return SetParametersResult(successful=True)


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
        self._settings = settings = declare_all(self, CompensationSettings)
        paper = settings.inverse == 'paper'
        self._heard_ns: dict[str, int] = {}
        self._named: tuple[Sensor, str]
        self._obstacle = ''
        self._reported: Counter[str] = Counter()
        self._reported_ns = STEADY.now().nanoseconds
        self._diagnostics = DiagnosticsReporter(self, {'compensation': self._status})
        self._ages = SampleAges()
        self._data = create_publisher(self, Imu, 'imu/data', _DEPTH)
        tilt = create_publisher(self, Vector3Stamped, 'tilt', _DEPTH)
        free = create_publisher(self, Vector3Stamped, 'imu/linear_acceleration_free', _DEPTH) \
            if settings.free_acceleration else None
        self._stream = LiveStream(
            paper, settings.undo_filter, self._publish, tilt.publish,
            settings.orientation == 'keep', free.publish if free else None,
            settings.output_rate_hz)
        self._policy = CompensationPolicy(paper, settings.store, Topics(
            data_raw=self.resolve_topic_name('imu/data_raw'),
            sensor_info=self.resolve_topic_name('sensor_info'),
            temperature=self.resolve_topic_name('temperature'),
            supply=self.resolve_topic_name('supply')))
        self._samples = Inbox(self, Imu, 'imu/data_raw', _DEPTH)
        self._sensor = ExchangeableSensor(
            self, settings.calibration, self._policy.check, self._use)
        MountingParameters(self, self._stream, settings)
        self.create_timer(_LOOK_S, self._look, clock=STEADY)
        create_subscription(self, DiagnosticStatus, 'sensor_info', self._on_info, 1, latched=True)
        create_subscription(self, Temperature, 'temperature', self._on_temperature, 1)
        create_subscription(self, BatteryState, 'supply', self._on_supply, 1)
        self._thread = RepeatingThread(self, lambda: self._samples.receive(self._stream),
                                       'imu/data_raw')

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
        late = inversions.HALF if self._settings.undo_filter else 0
        values: dict[str, Any] = {
            'rate_in_hz': round(counts['received'] / duration_s, 1),
            'rate_out_hz': round(counts['published'] / duration_s, 1),
            **{name: self._reported[name] for name in COUNTS},
            'delay_s': late / self._policy.rate_hz, **self._ages.report(),
            **self._policy.values(interval, newer)}
        return Status(_LEVELS.get(state, Level.WARN), text, self._policy.sensor.serial, values)

    def _interval(self) -> Interval:
        """Return what the stream has shown since the last report, and begin a new interval."""
        steady_ns, ros_ns = STEADY.now().nanoseconds, self.get_clock().now().nanoseconds
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
    return run(Compensation, NodeHelp(__doc__, _EXAMPLES, (CompensationSettings,)))
