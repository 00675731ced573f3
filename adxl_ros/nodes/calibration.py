# SPDX-License-Identifier: Apache-2.0

"""Guide a calibration: command or announce poses, average at rest, fit, write the file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
import os
from pathlib import Path
from typing import Any

from adxl_ros.calibrate.guided import controller, pose_plan
from adxl_ros.calibrate.guided.controller import ControllerState, RequestAnswer, StartMode
from adxl_ros.calibrate.guided.guide import NextPose
from adxl_ros.calibrate.guided.screen_contents import CaptureSettings, StageMode
from adxl_ros.calibrate.guided.session import SessionSettings
from adxl_ros.calibrate.guided.thermal_guide import ThermalSettings
from adxl_ros.compensate.live_stream import UNKNOWN_ANGLE_RAD2
from adxl_ros.files import calibration_store, cdr
from adxl_ros.files.recording_columns import JOINTS
from adxl_ros.model.sensor import Sensor, to_volts
from adxl_ros.nodes import parameter_checks, parameters, params_files, sensor_parameters, topics
from adxl_ros.nodes.calibration_screen import DisplayPublisher
from adxl_ros.nodes.parameters import parameter, sample_unit
from adxl_ros.nodes.run_node import run
from adxl_ros.nodes.topics import create_publisher, Level, Status, status_message, STEADY
from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import Imu, JointState
from std_srvs.srv import Trigger

_REPEAT_NS = 500_000_000
"""Time between two commands of the same pose, ns: a stage that starts late, or that has lost the
first command, loses at most this of a pose of seconds."""
_COMMAND_QUEUE = 10
"""Commands that are kept for a recorder that stalls: a bag then has every command."""
_POLL_S = 0.02
"""Time between two steps of the controller, s. It ends a dwell late by at most this: by 1 % of 2
s, and by 0.4 s where sensor time is twenty times real time."""
_FAREWELL_NS = 2_500_000_000
"""Time from the end of a calibration to that of the node, ns: two reports of the diagnostics, one
a second, come within it, so that a screen or recorder has the result."""
_QUEUE = 100
"""Messages that wait while the node fits: 100 s of temperature and supply at 1 Hz; a fit takes
some seconds."""
_STAGE_TOPICS = ('stage/command', 'stage/joint_states')
_STAGE_QUEUE = 1000
"""Messages of the stage that wait meanwhile; more, because its angles come faster."""
_CHECK_POSES = {'full': 16, 'quick': 8}
"""Check poses by kind of the pose plan. Their rms is then known within 18 and 25 %. They are about
a tenth, or a fifth, of the poses; more of them would weaken the fit."""
_EXAMPLES = {
    'a stage that is turned by hand': '--ros-args -p stage.mode:=manual -p output:=unit.yaml',
    'a three-axis sensor without a stage': '--ros-args -p mode:=gravity -p output:=unit.yaml',
}
"""Examples of arguments, by their purpose."""
_SAMPLES = 'imu/data_raw'  # Topic of the samples, relative to the namespace of the node
_YAW_VARIANCE = 8
"""Place of the variance of yaw in an orientation's covariance of 9 numbers, from 0."""
_INFO_NS = 1_000_000_000
"""Time that samples wait for `sensor_info`, ns. A latched message comes within it, also where
sensor time is ten times real time; until then nothing is measured, so that more delays the first
pose."""
_SAMPLES_QUEUE = 20000  # Samples that are kept: 20 s at 1 kHz, longer than a fit takes


@dataclass(frozen=True)
class CalibrationSettings:
    """The guided calibration."""

    mode: str = parameter(
        'stage', 'what the reference is', choices=('stage', 'gravity', 'thermal')
    )
    autostart: bool = parameter(False, 'start without a call of ~/start')
    resume: str = parameter(
        'ask',
        'go on with an interrupted calibration; without a screen, ask is continue',
        choices=('ask', 'continue', 'anew'),
    )
    exit_when_done: bool = parameter(
        False, 'end the node after a calibration: status 0 where it wrote its file, else 1'
    )
    screen: bool = parameter(True, 'show a screen, where the node runs in a terminal')
    output: str = parameter('calibration.yaml', 'parameter file to write')
    journal: str = parameter('', 'file of accepted poses; empty: beside the output')
    report: str = parameter('', 'directory for the report; empty: none')
    store: str = parameter(
        str(calibration_store.default_folder()),
        'folder of calibrations that gets a copy; empty: none',
    )
    dwell_s: float = parameter(5.0, 'time at rest a pose', 's', 0.5, 3600.0, name='sweep.dwell_s')
    # A stage of 5 arcmin arrives within this default.
    tolerance_rad: float = parameter(
        float(np.radians(0.2)), 'arrived within this', 'rad', 1e-6, 0.2, name='stage.tolerance_rad'
    )
    timeout_s: float = parameter(
        60.0, 'time after which a pose is late', 's', 1.0, 86400.0, name='stage.timeout_s'
    )
    stage_mode: str = parameter(
        'commanded',
        'commanded turns itself, the others by hand',
        name='stage.mode',
        choices=('commanded', 'encoder', 'manual'),
    )
    samples_unit: str = sample_unit()
    near_deg: float = parameter(
        2.0,
        'a stage turned by hand is captured within this of the pose',
        'deg',
        0.01,
        30.0,
        name='stage.near_deg',
    )
    temperature_span_c: float = parameter(
        3.0,
        'largest temperature change since the first pose',
        'degC',
        0.1,
        1000.0,
        name='sweep.temperature_span_c',
    )
    plan: str = parameter(
        'auto',
        'full (planes, 25 minutes), quick (about 38 poses), or auto: '
        'quick where a stage is turned by hand without planes',
        name='sweep.plan',
        choices=('auto', 'full', 'quick'),
    )
    planes_deg: Any = parameter(
        (),
        'planes alpha of the plan full; empty: 30 to 150, or 0 to 180 for a sensor with a z axis',
        'deg',
        name='sweep.planes_deg',
    )
    step_deg: float = parameter(
        30.0, 'step of beta of the plan full', 'deg', 0.5, 90.0, name='sweep.step_deg'
    )
    check_poses: int = parameter(
        -1,
        'poses kept out of the fit for the verdict; -1: 16, or 8 in the plan quick',
        '',
        -1,
        1000,
        name='sweep.check_poses',
    )
    tilt_error_deg: float = parameter(
        0.1,
        'rms tilt error that the plan quick is to reach',
        'deg',
        1e-3,
        10.0,
        name='sweep.tilt_error_deg',
    )
    range_c: Any = parameter(
        (),
        'lowest and highest temperature that mode thermal is to cover; empty: 0 to 50',
        'degC',
        name='thermal.range_c',
    )
    block_s: float = parameter(
        10.0,
        'length of a block of samples in mode thermal',
        's',
        0.5,
        600.0,
        name='thermal.block_s',
    )


class Announcer:
    """
    Announces the next pose.

    `~/next_pose` has the pose for people and programs, latched. `stage/command` has the command
    for a stage that turns itself. It is repeated, so that a stage that starts later or loses a
    message gets it, too.
    """

    def __init__(self, node: Node, has_stage: bool) -> None:
        self._node = node
        self._command = (
            create_publisher(node, JointState, 'stage/command', _COMMAND_QUEUE)
            if has_stage
            else None
        )
        self._next = create_publisher(node, DiagnosticStatus, '~/next_pose', 1, latched=True)
        self._announced = ''
        self._commanded_ns = 0

    def announce(self, pose: NextPose) -> None:
        """Announce a pose if it is new, and command the stage if it turns itself."""
        if pose.text != self._announced:
            self._node.get_logger().info(pose.text)
            self._publish(pose.text, pose.values)
            self._announced = pose.text
            self._commanded_ns = 0
        now_ns = STEADY.now().nanoseconds
        if (
            self._command
            and pose.command_rad is not None
            and now_ns - self._commanded_ns >= _REPEAT_NS
        ):
            self._commanded_ns = now_ns
            command = JointState(name=['alpha', 'beta'], position=list(pose.command_rad))
            # The clock of a simulation may lag behind samples that have come.
            command.header.stamp = topics.stamp(
                max(self._node.get_clock().now().nanoseconds, pose.newest_ns)
            )
            self._command.publish(command)

    def withdraw(self, reason: str) -> None:
        """Take back the pose that was announced, if one was: the topic is latched."""
        if self._announced:
            self._publish(f'no pose: {reason}', {})
        self._announced = ''

    def _publish(self, text: str, values: Mapping[str, str | float]) -> None:
        self._next.publish(status_message('next_pose', Status(Level.OK, text, '', values)))


class WaitingSamples:
    """Takes the serialized messages that wait, and decodes many at once."""

    def __init__(self, node: Node, unit: str) -> None:
        self._node = node
        self._raw: list[bytes] = []
        self._begun_ns = 0  # Steady time of the first sample, ns; 0 before it
        self.fault = ''  # Why the newest samples cannot be used, or ''
        self._inbox = topics.Inbox(node, Imu, _SAMPLES, _SAMPLES_QUEUE, unit)
        self.silence = self._inbox.silence  # Why or for how long no sample has come
        self.restart_silence = self._inbox.restart_silence  # Of the time without samples
        self.mixture = self._inbox.fault  # That several nodes publish the samples, or ''

    def keep_newest(self, count: int = _SAMPLES_QUEUE) -> None:
        """Forget all samples but the newest, as many as the queue holds."""
        self._receive()
        del self._raw[: max(len(self._raw) - count, 0)]

    def waiting(self) -> tuple[np.ndarray, np.ndarray]:
        """
        Return the samples that wait: stamps, ns, (n,), and m/s², (n, 3), finite; keep them.

        There are none as long as `sensor_info` may still come.
        """
        self._receive()
        may_come = STEADY.now().nanoseconds - self._begun_ns < _INFO_NS
        return topics.finite_samples([] if may_come else self._raw)

    def take(self, sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
        """Return the samples since the last call: stamps, ns, (n,), and volts, (n, m), finite."""
        self._receive()
        batch = self._raw
        self._raw = []
        stamps, fields = topics.decoded(
            batch, cdr.imu, linear_acceleration=3, orientation_covariance=9
        )
        accel = fields['linear_acceleration']
        covariance = fields['orientation_covariance']
        # -1 in the first place means that a message has no orientation.
        yaw_rad2 = np.where(covariance[:, 0] >= 0, covariance[:, _YAW_VARIANCE], 0.0)
        accel = accel[:, : len(sensor.axes)]
        finite = np.isfinite(accel)
        if batch:
            self.fault = self._fault(bool((yaw_rad2 != UNKNOWN_ANGLE_RAD2).all()), finite, sensor)
        complete = finite.all(axis=1)
        return stamps[complete], to_volts(accel[complete], sensor)

    def _receive(self) -> None:
        """Take the messages that have come since the last call."""
        self._raw += self._inbox.take()
        if self._raw:
            self._begun_ns = self._begun_ns or STEADY.now().nanoseconds

    def _fault(self, is_raw: bool, finite: np.ndarray, sensor: Sensor) -> str:
        """Return why samples with these finite values, (n, m), cannot be used, or ''."""
        if not is_raw:
            return (
                f'{self._node.resolve_topic_name(_SAMPLES)}: this stream is already '
                'compensated (it carries an orientation, as imu/data does); remap it to '
                'imu/data_raw of the driver'
            )
        if finite.all(axis=1).any():
            return ''
        dead = ' and '.join(
            axis for axis, lives in zip(sensor.axes, np.asarray(finite.any(axis=0))) if not lives
        )
        return (
            f'{dead or "one axis or another"} is not a number in all samples; check its '
            'wiring and the driver'
        )


class Calibration(Node):
    """
    The node of the guided calibration.

    It connects topics and services to a `Controller`, which does the work.
    """

    def __init__(self) -> None:
        super().__init__('calibration')
        parameter_checks.check_given(self)
        flat = sensor_parameters.declare_sensor(self)
        carried: dict[str, Any] = {
            name: parameters.given_below(self, f'{name}.') for name in ('link', 'mounting')
        }
        sensor = replace(sensor_parameters.make_sensor(flat, may_measure=True), **carried)
        anonymous = replace(sensor_parameters.anonymous_sensor(self, flat), **carried)
        self._own = own = parameters.declare_all(self, CalibrationSettings)
        settings = _session_settings(own)
        self._captures: list[object] = []  # Requests that wait for the end of a capture
        announcer = Announcer(self, own.mode == 'stage')
        # What the controller asks of a node
        self.announce = announcer.announce
        self.withdraw_pose = announcer.withdraw
        self._samples = WaitingSamples(self, own.samples_unit)
        self._controller = controller.Controller(
            settings=settings,
            sensor=sensor,
            resume=own.resume,
            samples=self._samples,
            outputs=self,
            anonymous=anonymous,
        )
        if own.autostart:
            self._controller.start()
        self._connect()
        self._has_run = False
        self._busy_ns = 0
        self._names_joints = False  # Whether a line has named joints that no stage has
        self._display = DisplayPublisher(self, self._controller, own.screen)
        self.show_fit = self._display.show_fit
        if not own.autostart and not self._controller.may_ask:
            # Nobody sees a screen, so that the log says what the node waits for.
            self.log(
                Level.OK,
                f'waits for a call of {self.resolve_service_name("~/start")}, or '
                f'start it with autostart:=true; it takes samples of '
                f'{self.resolve_topic_name(_SAMPLES)}',
            )

    def log(self, level: Level, text: str) -> None:
        """Log a line."""
        topics.log(self, level, text)

    def answer_captures(self, answer: RequestAnswer) -> None:
        """Answer all calls of ~/capture that wait."""
        self._capture_service.answer(self._captures, *answer)
        self._captures.clear()

    def close(self) -> None:
        """Close the journal and the screen."""
        if self._controller.session is not None:
            self._controller.session.journal.close()
        self._display.close()

    def _connect(self) -> None:
        """Make diagnostics, subscriptions, services and the timer."""
        topics.DiagnosticsReporter(self, 'calibration', self._status)
        topics.subscribe_info(self, 'sensor_info', self._controller.read_sensor_info)
        self._stage = {
            topic: topics.Inbox(self, JointState, topic, _STAGE_QUEUE)
            for topic in (_STAGE_TOPICS if self._own.mode == 'stage' else ())
        }
        self._surroundings = topics.SurroundingTopics(self, _QUEUE)
        start = self._controller.start
        requests: dict[str, Callable[[], RequestAnswer]] = {
            'start': start,
            'resume': partial(start, StartMode.CONTINUE),
            'start_over': partial(start, StartMode.ANEW),
            'redo': self._controller.redo,
            'skip': self._controller.skip,
            'finish': self._controller.finish,
            'abort': self._controller.abort,
        }
        for name, request in requests.items():
            self.create_service(Trigger, f'~/{name}', self._service(request))
        # The answer comes when the pose is on disk.
        self._capture_service = topics.LateService(self, '~/capture')
        self.create_timer(_POLL_S, self._poll, clock=STEADY)

    def _poll(self) -> None:
        self._read_stage()
        for topic, stamps_ns, values in self._surroundings.take():
            for stamp_ns, value in zip(stamps_ns.tolist(), values[:, 0].tolist()):
                self._controller.read_quantity(topic, stamp_ns, value)
        for request in self._capture_service.take():
            answer = self._controller.capture()
            if answer.success:
                self._captures.append(request)
            else:
                self._capture_service.answer([request], *answer)
        # A poll may begin a calibration and end it at once.
        self._has_run |= self._controller.state is not ControllerState.IDLE
        self._controller.poll()
        now_ns = STEADY.now().nanoseconds
        if self._controller.state is not ControllerState.IDLE or not self._has_run:
            self._busy_ns = now_ns
        elif self._own.exit_when_done and now_ns - self._busy_ns > _FAREWELL_NS:
            # The last report has been received.
            raise SystemExit(0 if self._controller.outcome else 1)

    def _status(self) -> Status:
        self._controller.log_obstacle()
        report = self._controller.report()
        level = Level.WARN if report.status.late else Level.OK
        if self._samples.mixture():
            level = Level.ERROR
        return Status(level, report.status.text, report.serial, report.values)

    def _read_stage(self) -> None:
        """Give the commands and the angles of the stage that have come to the guide."""
        session = self._controller.session
        stage = session.stage if session is not None else None
        for topic, inbox in self._stage.items():
            for reading in topics.joint_readings(inbox.take()):
                if stage is not None and topic == 'stage/command':
                    stage.read_command(*reading.angles)
                elif stage is not None and np.isfinite(reading.angles).all():
                    stage.read_encoder(reading.stamp_ns, *reading.angles)
                elif not reading.position.keys() & JOINTS.keys() and not self._names_joints:
                    self._names_joints = True
                    self.log(
                        Level.WARN,
                        f'{self.resolve_topic_name(topic)} has the joints '
                        f'{", ".join(reading.position)}, but calibration needs alpha and '
                        'beta; the node stage gives them, by bridge.alpha.joint and '
                        'bridge.beta.joint',
                    )

    def _service(self, request: Callable[[], RequestAnswer]) -> Callable[..., Trigger.Response]:
        """Make the callback of a service that calls a request of the controller."""

        def respond(*_: object) -> Trigger.Response:
            self._read_stage()
            answer = request()
            self._display.update()
            return Trigger.Response(success=answer.success, message=answer.message)

        return respond


def _session_settings(own: CalibrationSettings) -> SessionSettings:
    """Return what a calibration is to do."""
    output = Path(own.output)
    journal = Path(own.journal or f'{output}.journal')
    if own.mode == 'thermal' and own.report:
        raise params_files.parameter_error('report', 'mode thermal writes no page; leave it empty')
    for name, path in (('output', output), ('journal', journal)):
        if path.is_dir():
            raise params_files.parameter_error(name, f'{path} is a directory; name a file')
    planes_rad = tuple(
        np.radians(
            parameters.numbers('sweep.planes_deg', own.planes_deg or [], '[30.0, 60.0, 90.0]')
        ).tolist()
    )
    step_rad = float(np.radians(own.step_deg))
    capture = CaptureSettings(
        dwell_s=own.dwell_s,
        tolerance_rad=own.tolerance_rad,
        timeout_s=own.timeout_s,
        stage_mode=StageMode(own.stage_mode),
        near_rad=float(np.radians(own.near_deg)),
        temperature_span_c=own.temperature_span_c,
    )
    kind = own.plan
    if kind == 'auto':
        by_hand = capture.stage_mode is not StageMode.COMMANDED
        is_default = not planes_rad and step_rad == pose_plan.STEP_RAD
        kind = 'quick' if by_hand and is_default else 'full'
    # A bad plan is refused before there is a sensor.
    pose_plan.guided(planes_rad or pose_plan.default_planes_rad('xy'), step_rad, 0)
    return SessionSettings(
        mode=own.mode,
        plan_kind=kind,
        planes_rad=planes_rad,
        step_rad=step_rad,
        tilt_error_rad=float(np.radians(own.tilt_error_deg)),
        check_poses=_CHECK_POSES[kind] if own.check_poses < 0 else own.check_poses,
        capture=capture,
        output=output,
        journal=journal,
        report=own.report,
        store=own.store,
        thermal=ThermalSettings(
            parameters.low_and_high('thermal.range_c', own.range_c, ThermalSettings.range_c),
            own.block_s,
        ),
    )


def main() -> int:
    """Run the node."""
    # Through shared memory, Fast DDS does not reach a process again that was killed and started
    # again (eProsima/Fast-DDS issues 2811, 5053 and 5469): a sweep could not be resumed.
    os.environ.setdefault('FASTDDS_BUILTIN_TRANSPORTS', 'UDPv4')
    return run(Calibration, __doc__, _EXAMPLES)
