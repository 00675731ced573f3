# SPDX-License-Identifier: Apache-2.0

"""The guided calibration as a state machine, free of ROS; `poll` advances it."""

from __future__ import annotations

from collections.abc import Callable
from enum import auto, Enum
from typing import NamedTuple, Protocol

from adxl_ros.calibrate.fits.gravity_fit import NINE
from adxl_ros.calibrate.guided.guide import Guide, NewestSamples, NextPose, STALE_NS
from adxl_ros.calibrate.guided.rest_guides import ENOUGH_RESTS
from adxl_ros.calibrate.guided.screen_contents import GuideStatus, Phase
from adxl_ros.calibrate.guided.session import GravityError, Session, SessionSettings
from adxl_ros.calibrate.guided.stage_guide import MountingError
from adxl_ros.errors import UserError
from adxl_ros.files.stream_info import nominal_of, StreamInfo
from adxl_ros.files.sweep_journal import differences
from adxl_ros.model.sensor import Sensor
from adxl_ros.report.level import Level
from adxl_ros.signals import recorded_sensor
import numpy as np

IDLE_TEXT = 'idle; call ~/start'  # Status of a controller that has not been started


class ControllerState(Enum):
    """State of the guided calibration."""

    IDLE = auto()
    WAITING_FOR_SENSOR = auto()
    ASKING = auto()  # The operator, what to do with an interrupted calibration
    RUNNING = auto()


class StartMode(Enum):
    """What a start does with an interrupted calibration."""

    ASK = 'ask'
    """Ask an operator at a screen; without one, continue."""
    CONTINUE = 'continue'
    """Go on with its poses."""
    ANEW = 'anew'
    """Put its poses aside."""


class RequestAnswer(NamedTuple):
    """The answer to a request."""

    success: bool  # Whether the request was carried out
    message: str  # One line for people


_NOT_RUNNING = RequestAnswer(False, 'no calibration is running')


class LogLine(NamedTuple):
    """A line of the log."""

    level: Level
    text: str


class Report(NamedTuple):
    """The state of a calibration, for diagnostics."""

    status: GuideStatus
    serial: str  # Serial number of the sensor, '' while it is unknown
    values: dict[str, str | float]  # By key


class Outputs(Protocol):
    """Where a controller's lines, answers and announcements go."""

    def log(self, level: Level, text: str) -> None:
        """Log a line."""

    def answer_captures(self, answer: RequestAnswer) -> None:
        """Answer all callers that wait for the end of a capture."""

    def announce(self, pose: NextPose) -> None:
        """Announce the pose to go to, and command a stage that turns itself."""

    def withdraw_pose(self, reason: str) -> None:
        """Take the announced pose back."""

    def show_fit(self, text: str) -> None:
        """Show that the fit begins, which takes a while."""


class SampleSource(Protocol):
    """Where samples come from."""

    fault: str  # Why the newest samples are of no use, or ''

    def take(self, nominal: Sensor) -> tuple[np.ndarray, np.ndarray]:
        """Return the samples since the last call: stamps, ns, (n,), and volts, (n, m)."""

    def restart_silence(self) -> None:
        """Measure the time without samples from now on."""

    def silence(self) -> str:
        """Return one line on the time without samples; '' while samples come."""

    def waiting(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the waiting samples: stamps, ns, (n,), and specific force, m/s², (n, 3)."""

    def keep_newest(self, count: int = ...) -> None:
        """Forget all waiting samples but the newest."""


class StreamSensor:
    """The sensor of the stream, and its newest samples while no calibration runs."""

    def __init__(
        self, settings: SessionSettings, sensor: Sensor, anonymous: Sensor, samples: SampleSource
    ) -> None:
        self._settings = settings
        self._sensor = sensor
        self._anonymous = anonymous
        self._samples = samples
        self.nominal: Sensor | None = None  # The nominal sensor; None while it is unknown
        self.newest: NewestSamples | None = None  # Its newest samples
        self.fault = ''  # Why the stated sensor is not the one of the parameters, or ''
        self.outlook = ''  # What is ahead of a calibration, for people

    def adopt(self, nominal: Sensor) -> None:
        """Take a sensor as that of the stream."""
        self.nominal = nominal
        self.newest = NewestSamples(nominal)
        self.fault = ''
        self.outlook = self._settings.outlook(nominal)

    def stated(self, info: StreamInfo) -> Sensor | None:
        """Return the sensor that the stream states, if it states one; refuse another one."""
        try:
            nominal = nominal_of(self._sensor, info)
        except UserError as error:
            self.nominal = None
            self.newest = None
            self.fault = f'{error}'
            raise
        if nominal.unstated:
            self._anonymous = nominal
            return None
        return nominal

    def watch(self, shows: bool, waits: bool) -> LogLine | None:
        """Look at the samples of no calibration, if shown or waited for; return a line to log."""
        if self.nominal is None and (waits or shows):
            # A driver that has just begun states its sensor on another topic.
            self._samples.keep_newest()
            return None if self.fault else self._measure()
        if self.nominal is not None and self.newest is not None and shows:
            self.newest.feed(*self._samples.take(self.nominal))
        else:
            self._samples.keep_newest(0)
        return None

    def _measure(self) -> LogLine | None:
        """Measure the sensor of a stream that states nothing of itself."""
        stamps_ns, accel_mps2 = self._samples.waiting()
        if (
            len(stamps_ns) < recorded_sensor.FEWEST_SAMPLES
            or np.ptp(stamps_ns) < recorded_sensor.SHORTEST_S * 1e9
        ):
            return None
        try:
            nominal, lines = recorded_sensor.sensor_of_stream(
                self._anonymous, stamps_ns, accel_mps2
            )
        except UserError as error:
            self._samples.keep_newest(0)
            return LogLine(Level.WARN, f'imu/data_raw: {error}')
        self.adopt(nominal)
        return LogLine(Level.OK, f'no sensor_info: measured from the stream: {"; ".join(lines)}')


class Controller:
    """Runs guided calibrations, one after the other."""

    def __init__(
        self,
        settings: SessionSettings,
        sensor: Sensor,
        resume: str,
        samples: SampleSource,
        outputs: Outputs,
        anonymous: Sensor | None = None,
    ) -> None:
        self.settings = settings
        self.state = ControllerState.IDLE  # The present state
        self.stream = StreamSensor(settings, sensor, anonymous or sensor, samples)
        self.session: Session | None = None  # Only in the state RUNNING
        self.question = ''  # The question to the operator in the state ASKING, else ''
        self.fit_fault = ''  # Why the fit or its files failed after all poses were taken, or ''
        self.outcome: tuple[str, ...] = ()  # Lines on the calibration that ended last
        self.may_ask = False  # Whether somebody is at a screen who can be asked
        self.shows_idle_stream = False  # Whether a screen shows samples without a calibration
        self._usual_start = StartMode(resume)
        self._start = self._usual_start  # That of the newest request
        self._sensor = sensor
        self._samples = samples
        self._outputs = outputs
        self._newest_line = ''  # For people: it is not logged twice, and an idle status shows it
        self._warned = ''  # The newest obstacle
        self._accepted = 0
        self._has_doubt = False

    def start(self, mode: StartMode | None = None) -> RequestAnswer:
        """Begin or resume a calibration as soon as the sensor is known; None is as usual."""
        if self.session is not None:
            return RequestAnswer(False, 'a calibration is running; finish or abort it first')
        if self.state is ControllerState.ASKING and mode is None:
            return RequestAnswer(False, self.question)
        self.state = ControllerState.WAITING_FOR_SENSOR
        self.question = ''
        self._start = mode or self._usual_start
        return self._try_to_start()

    def capture(self) -> RequestAnswer:
        """Take the pose that the operator has reached; the end of the dwell answers later."""
        if self.session is None:
            return _NOT_RUNNING
        guide = self.session.guide
        if guide.moves_itself:
            return RequestAnswer(
                False,
                'nothing to capture: the stage moves itself, and poses are taken '
                'when it has arrived',
            )
        if fault := self.session.fault or self.fit_fault:
            return RequestAnswer(False, fault)
        self._take_samples(self.session)
        obstacle = guide.capture()
        if obstacle:
            self._say(Level.WARN, obstacle)
        return RequestAnswer(not obstacle, obstacle or 'averaging')

    def redo(self) -> RequestAnswer:
        """Take the previous pose again."""
        return self._change_pose(lambda guide: guide.redo, 'no pose to take again')

    def skip(self) -> RequestAnswer:
        """Leave out the open pose."""
        return self._change_pose(lambda guide: guide.skip, 'no pose to leave out')

    def _change_pose(
        self, request_of: Callable[[Guide], Callable[..., str]], nothing: str
    ) -> RequestAnswer:
        """Let the guide carry out a request; `nothing` says that there is no such pose."""
        if self.session is None:
            return _NOT_RUNNING
        try:
            text = request_of(self.session.guide)(self.session.journal.append)
        except UserError as error:
            return RequestAnswer(False, f'{error}')
        if not text:
            return RequestAnswer(False, nothing)
        self.fit_fault = ''
        self._outputs.answer_captures(RequestAnswer(False, text))
        self._say(Level.OK, text)
        return RequestAnswer(True, text)

    def finish(self) -> RequestAnswer:
        """Fit the poses so far and write the files."""
        session = self.session
        if session is None:
            return _NOT_RUNNING
        self._take_samples(session)
        self._outputs.show_fit(self._say(Level.OK, f'fitting {session.accepted_count} poses'))
        self.fit_fault = ''
        try:
            result = session.finish()
            self._outputs.log(Level.OK, result.keep(self.settings.store))
            try:
                session.write_report(result)
            except (UserError, OSError) as error:
                self._say(Level.ERROR, f'no report: {error}')
            session.end()
        except (UserError, OSError) as error:
            # The poses stay: further poses, or room on the disk, can still lead to a fit.
            text = f'cannot finish: {error}'
            if session.guide.next_pose() is None:
                self.fit_fault = text = f'{text}; finish again, redo or abort'
            return RequestAnswer(False, self._say(Level.ERROR, text))
        for line in result.comments():
            self._outputs.log(Level.OK, line)
        self.outcome = (result.summary[0].strip(), *result.summary[1:], *result.warnings)
        self._outputs.log(Level.OK, self.outcome[0])
        open_poses = session.guide.open_poses
        advice = f'; {open_poses} poses are open: start again to go on' if open_poses else ''
        return RequestAnswer(True, self._stop(Level.OK, f'wrote {self.settings.output}{advice}'))

    def abort(self) -> RequestAnswer:
        """End without a fit; the poses stay in the journal."""
        if self.state is ControllerState.IDLE:
            return _NOT_RUNNING
        kept = f'; its poses stay in {self.session.journal.path}' if self.session else ''
        return RequestAnswer(True, self._stop(Level.OK, f'aborted{kept}'))

    def read_sensor_info(self, info: StreamInfo) -> None:
        """Take what the stream states about its sensor; a running session needs the same one."""
        session = self.session
        try:
            nominal = self.stream.stated(info)
        except UserError as error:
            if session is not None:
                self._stop(Level.ERROR, f'{error}; the poses are kept')
            self._say(Level.ERROR, f'{error}')
            return
        if nominal is None:
            return
        if session is not None:
            changes = differences(self.settings.head(session.nominal), self.settings.head(nominal))
            if changes and session.nominal.measured and not session.accepted_count:
                self._stop(Level.OK, 'sensor_info has come: the calibration begins again with it')
                self.stream.adopt(nominal)
                self.start(StartMode.ANEW)
                return
            if changes:
                self._stop(
                    Level.ERROR,
                    f'sensor_info: {changes}: changed during the '
                    'calibration; put it back and start again, the poses are kept',
                )
            else:
                # The driver has started again, and may have been touched.
                if session.stage is not None:
                    session.stage.verify()
                self._outputs.answer_captures(
                    RequestAnswer(False, 'the driver started again; capture again')
                )
        self.stream.adopt(nominal)

    def read_quantity(self, quantity: str, stamp_ns: int, value: float) -> None:
        """Take a temperature or a supply; a stamp of another clock gives way to the newest one."""
        if self.session is not None:
            newest_ns = self.session.guide.newest_ns or stamp_ns
            is_near = abs(stamp_ns - newest_ns) <= STALE_NS
            self.session.guide.readings[quantity].add(stamp_ns if is_near else newest_ns, value)

    def poll(self) -> None:
        """Take the samples and poses since the last call; announce the next pose or fit."""
        if self.state is ControllerState.WAITING_FOR_SENSOR:
            self._try_to_start()
        session = self.session
        if session is None:
            if line := self.stream.watch(
                self.shows_idle_stream, self.state is not ControllerState.IDLE
            ):
                self._say(*line)
            return
        self._take_samples(session)
        try:
            for text in session.take_poses():
                self._say(Level.OK, text)
                self._outputs.answer_captures(RequestAnswer(True, text))
        except (MountingError, GravityError) as error:
            self._stop(Level.ERROR, f'{error}')
            return
        except UserError as error:
            self._say(Level.ERROR, f'{error}')
            self._outputs.answer_captures(RequestAnswer(False, f'{error}'))
        if session.doubt and not self._has_doubt:
            self._say(Level.WARN, f'imu/data_raw: {session.doubt}')
        self._has_doubt = bool(session.doubt)
        if refusal := session.guide.new_refusal():
            self._say(Level.WARN, refusal)
            self._outputs.answer_captures(RequestAnswer(False, refusal))
        pose = session.guide.next_pose()
        if pose is not None:
            self._outputs.announce(pose)
        elif not self.fit_fault:
            self.finish()

    def status(self) -> GuideStatus:
        """Return what the calibration waits for."""
        stream = self.stream
        if self.state is ControllerState.ASKING:
            return GuideStatus(Phase.QUESTION, self.question, late=True)
        if self.state is ControllerState.WAITING_FOR_SENSOR:
            if stream.fault:
                return GuideStatus(Phase.REFUSED, stream.fault, late=True)
            silence = self._samples.silence()
            obstacle = (
                f'{silence}; is the driver running?'
                if silence
                else 'without it, 2 s of samples show the sensor'
            )
            return GuideStatus(Phase.INFO, f'waiting for sensor_info; {obstacle}', late=True)
        if self.session is None:
            hints = IDLE_TEXT, stream.outlook, self._samples.silence()
            return GuideStatus(Phase.IDLE, self._newest_line or '; '.join(filter(None, hints)))
        if silence := self._samples.silence():
            return GuideStatus(Phase.SILENT, silence, late=True)
        if fault := self.session.fault or self.fit_fault:
            return GuideStatus(Phase.REFUSED, fault, late=True)
        return self.session.guide.status()

    def report(self) -> Report:
        """Return the state."""
        status = self.status()
        nominal = self.stream.nominal
        session = self.session
        values: dict[str, str | float] = {
            'accepted': str(self._accepted),
            'output': str(self.settings.output),
            'verdict': self.outcome[0] if self.outcome else '',
        }
        if session is not None:
            guide = session.guide
            values |= {
                'phase': status.phase.value,
                'pose': str(guide.pose_number),
                'next': guide.destination(),
                'accepted': str(session.accepted_count),
            }
            tilt_rad = guide.tilt_error_rad()
            if np.isfinite(tilt_rad):
                values['tilt_error_deg'] = float(np.degrees(tilt_rad))
        return Report(status, nominal.serial if nominal else '', values)

    def log_obstacle(self) -> None:
        """Log an obstacle that lasts, once for each pose."""
        status = self.status()
        if not status.late:
            return
        # The times in its text change.
        obstacle = f'{status.phase.value} {self.session.accepted_count if self.session else ""}'
        if obstacle != self._warned and status.text != self._newest_line:
            self._outputs.log(Level.WARN, status.text)
        self._warned = obstacle

    def _try_to_start(self) -> RequestAnswer:
        """Begin a session if the sensor is known and the operator has nothing to answer."""
        nominal = self.stream.nominal
        if nominal is None:
            return RequestAnswer(True, 'starts when sensor_info comes, or samples show the sensor')
        try:
            if self.may_ask and self._start is StartMode.ASK:
                self.question = self.settings.question(nominal)
            if self.question:
                self.state = ControllerState.ASKING
                return RequestAnswer(False, self.question)
            self.session = session = Session(
                nominal, self.settings, self._start is StartMode.ANEW, self._sensor
            )
        except UserError as error:
            return RequestAnswer(False, self._stop(Level.ERROR, f'{error}'))
        self.state = ControllerState.RUNNING
        self.outcome = ()
        self._samples.restart_silence()
        task = (
            self.stream.outlook
            or f'rest in {NINE.min_rests} or more directions (at best in '
            f'{ENOUGH_RESTS}), then call ~/finish'
        )
        check = (
            ' (the last one first, to see that the mounting is as it was)'
            if session.guide.to_verify
            else ''
        )
        resumed = (
            f', resumed after {session.resumed} poses{check}; resume:=anew puts them aside'
            if session.resumed
            else ''
        )
        line = self._say(Level.OK, f'calibrating {nominal.serial}: {task}{resumed}')
        return RequestAnswer(True, line)

    def _take_samples(self, session: Session) -> None:
        """Give the session the samples that have come, and log what is wrong with them."""
        stamps_ns, volts = self._samples.take(self.stream.nominal or session.nominal)
        if fault := session.feed(stamps_ns, volts, self._samples.fault):
            self._say(Level.ERROR, fault)

    def _stop(self, level: Level, text: str) -> str:
        """End the session, or the wait for one, with a line for people; return the line."""
        if self.session is not None:
            self._accepted = self.session.accepted_count
            self.session.journal.close()
        self.state = ControllerState.IDLE
        self.session = None
        self.question = self.fit_fault = ''
        self._outputs.answer_captures(RequestAnswer(False, text))
        self._outputs.withdraw_pose(text)
        return self._say(level, text)

    def _say(self, level: Level, text: str) -> str:
        """Log a line unless it was the last one; return it."""
        if text != self._newest_line:
            self._outputs.log(level, text)
        self._newest_line = text
        return text
