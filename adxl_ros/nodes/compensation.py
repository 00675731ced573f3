# SPDX-License-Identifier: Apache-2.0

"""
Republish a stream corrected by its parameter file: acceleration, orientation, tilt.

The topic tilt has three angles in a Vector3Stamped, so tf2 must not transform it: use imu/data.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass
from datetime import datetime, timezone
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

from adxl_ros.compensate.compensation_policy import CompensationPolicy, StreamInterval
from adxl_ros.compensate.inversions import HALF
from adxl_ros.compensate.live_stream import COUNTS, LiveStream
from adxl_ros.errors import UserError
from adxl_ros.files import calibration_store, imu_message, parameter_file
from adxl_ros.files.recording_columns import StreamInfo
from adxl_ros.links.support.base import COLUMNS
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.kinematics import Mounting
from adxl_ros.model.sensor import Sensor
from adxl_ros.nodes import parameter_checks, parameters, params_files, sensor_parameters, topics
from adxl_ros.nodes.parameters import parameter, sample_unit
from adxl_ros.nodes.run_node import run
from adxl_ros.nodes.sample_output import age_report, MOST_AGES
from adxl_ros.nodes.topics import Level, Status, STEADY
from adxl_ros.signals.recorded_gravity import LIVE_WINDOW_S, LiveLook
from adxl_ros.signals.recorded_sensor import sensor_of_stream
from geometry_msgs.msg import Vector3Stamped
import numpy as np
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger

_MOUNTING = 'mounting.'  # Begin of the names of the parameters of the mounting
_RPY = f'{_MOUNTING}rpy_rad'  # Parameter of the rotation
_LEVEL_S = 1.0
"""Time over which a rest is averaged, s. At 100 Hz the mean has a tenth of the noise of a sample,
0.003° of tilt for an ADXL203."""
_FEWEST_SAMPLES = 10
"""Smallest number of samples of that rest: their scatter is then known within a quarter, which
tells motion from noise."""
_MAX_NOISE = 3.0
"""Largest scatter of a rest, in standard deviations of a sample's noise. The scatter of ten
samples at rest exceeds twice that in one of 25 000 rests, three times never."""
_MAX_GRAVITY_ERROR = 0.1
"""Largest relative departure of a rest from gravity: beyond the zero-g of an uncalibrated ADXL203,
0.1 g, another unit of measurement or motion explains it."""
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


class _NamedSensor(NamedTuple):
    """A sensor that corrects the samples."""

    sensor: Sensor
    source: str  # Where it is from, for people: the path of a calibration


class MountingParameters:
    """The parameters `mounting.*` and the service `~/level` of a node."""

    def __init__(self, node: Node, stream: LiveStream, mounting: Mounting, frame_id: str) -> None:
        self._node = node
        self._stream = stream
        self._frame_id = frame_id
        self._path = ''
        # What was given counts before the file of a calibration.
        self._is_given = _RPY in parameters.given_parameters(node)
        self._mount(mounting)
        parameters.on_change(node, _RPY, _mounting, self._mount)
        # The answer comes after a second of samples, which the node takes meanwhile.
        node.create_service(
            Trigger, '~/level', self._on_level, callback_group=ReentrantCallbackGroup()
        )

    def take(self, loaded: _NamedSensor) -> None:
        """Use the mounting that the file of a calibration has, unless one was given."""
        self._path = path = loaded.source
        mounting = _mounting_of(loaded)
        if mounting is None:
            return
        if not self._is_given:
            self._node.set_parameters([Parameter(_RPY, value=list(mounting.rpy_rad))])
        elif mounting != self._mounting:
            self._node.get_logger().warning(
                f'{_RPY} is given, and counts before that of {path}: {list(mounting.rpy_rad)}'
            )

    def _mount(self, mounting: Mounting) -> None:
        self._mounting = mounting
        self._stream.mount(mounting, self._frame_id)

    async def _on_level(self, *_: object) -> Trigger.Response:
        over: Future = Future()
        self._stream.collect()
        timer = self._node.create_timer(_LEVEL_S, lambda: over.set_result(True), clock=STEADY)
        await over
        self._node.destroy_timer(timer)
        try:
            levelled = level(self._mounting, self._stream.collected(), self._stream.sensor)
        except UserError as error:
            return Trigger.Response(message=f'{error}')
        before_rad = list(self._mounting.rpy_rad)
        rpy_rad = [round(angle, 6) for angle in levelled.rpy_rad]
        self._node.set_parameters([Parameter(_RPY, value=rpy_rad)])
        text = self._kept(rpy_rad, before_rad)
        self._node.get_logger().info(text)
        return Trigger.Response(success=True, message=text)

    def _kept(self, rpy_rad: list[float], before_rad: list[float]) -> str:
        """Write a new mounting where the next start finds it; return where that is."""
        path = (
            params_files.file_of(_RPY)
            if self._is_given
            else self._path or params_files.file_of('format')
        )
        begin = f'level: {_RPY} is {rpy_rad}'
        option = f"to keep it, start the node with -p '{_RPY}:={rpy_rad}'"
        if not path:
            return f'{begin} until this node ends; {option}'
        date = datetime.now(timezone.utc).isoformat(timespec='seconds')
        try:
            params_files.write_into(
                path,
                self._node.get_fully_qualified_name(),
                {
                    _RPY: f'[{", ".join(map(parameter_file.float_text, rpy_rad))}]',
                    'provenance.levelled': f"'{date}, {_RPY} before: {before_rad}'",
                },
            )
        except UserError as error:
            return f'{begin} until this node ends: {error}; {option}'
        return f'{begin}, written into {Path(path).resolve()}, which the next start reads'


def level(mounting: Mounting, forces_mps2: np.ndarray, sensor: Sensor) -> Mounting:
    """
    Return the mounting that makes the force of a rest vertical.

    forces_mps2: corrected samples in the frame of the case, m/s², (n, 3).
    """
    if len(forces_mps2) < _FEWEST_SAMPLES:
        raise UserError(
            f'{len(forces_mps2)} samples in {_LEVEL_S:g} s; at least {_FEWEST_SAMPLES} are needed'
        )
    mean_mps2 = forces_mps2.mean(axis=0)
    scatter_mps2 = forces_mps2.std(axis=0)[: len(sensor.axes)]
    noise_mps2 = noise.sample_std_v(sensor) / sensor.scale_v_per_g * G0_MPS2
    worst = int(np.argmax(scatter_mps2 / noise_mps2))
    if scatter_mps2[worst] > _MAX_NOISE * noise_mps2[worst]:
        raise UserError(
            f'the sensor moves: {sensor.axes[worst]} scatters by '
            f'{scatter_mps2[worst]:.2g} m/s², and its noise is '
            f'{noise_mps2[worst]:.2g} m/s²; let the robot rest on level ground'
        )
    magnitude_mps2 = float(np.linalg.norm(mean_mps2))
    if abs(magnitude_mps2 / sensor.local_gravity_mps2 - 1) > _MAX_GRAVITY_ERROR:
        raise UserError(
            f'the sensor reads {magnitude_mps2:.2f} m/s², and gravity is '
            f'{sensor.local_gravity_mps2:.2f} m/s²; calibrate it first'
        )
    return mounting.levelled(mean_mps2.tolist())


def _mounting(
    rpy_rad: Any, make_error: parameter_file.MakeError = params_files.parameter_error
) -> Mounting:
    """Return the mounting of three angles, rad; refuse what is none."""
    try:
        roll, pitch, yaw = map(float, rpy_rad)
        is_right = bool(np.abs([roll, pitch, yaw]).max() <= 2 * np.pi)
    except (TypeError, ValueError):
        is_right = False
    if not is_right:
        raise make_error(_RPY, f'{rpy_rad} is not roll, pitch and yaw in rad, each within a turn')
    return Mounting((roll, pitch, yaw))


def _mounting_of(loaded: _NamedSensor) -> Mounting | None:
    """Return the mounting that the file of a calibration has, None where it has none."""
    rpy_rad = loaded.sensor.mounting.get(_RPY.removeprefix(_MOUNTING))
    if rpy_rad is None:
        return None
    return _mounting(rpy_rad, lambda key, reason: UserError(f'{loaded.source}: {key}: {reason}'))


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
        mounting = _mounting(settings.rpy_rad)
        self._heard_ns: dict[str, int] = {}
        self._named: _NamedSensor
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
        own = _NamedSensor(
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

    def _load(self, path: str) -> _NamedSensor | None:
        """Load the file of `calibration`, if one is named; it is refused if it does not fit."""
        if not path:
            return None
        loaded = _NamedSensor(parameter_file.load(path), path)
        self._policy.check(loaded.sensor)
        _mounting_of(loaded)
        return loaded

    def _exchange(self, loaded: _NamedSensor | None) -> None:
        if loaded is not None:
            self._told = ''
            self._use(loaded)
            self._mounting.take(loaded)

    def _use(self, named: _NamedSensor) -> None:
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
            maxlen=round(max(LIVE_WINDOW_S * self._policy.rate_hz, _FEWEST_SAMPLES))
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
