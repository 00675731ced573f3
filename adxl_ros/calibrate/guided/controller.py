# SPDX-License-Identifier: Apache-2.0

"""
The guided calibration as a state machine, free of ROS.

Services, keys and messages call its methods, and `poll` advances it. Samples come from a
`SampleSource`. Lines, answers and poses go to `Outputs`.
"""

from __future__ import annotations

from enum import auto, Enum
from pathlib import Path
from typing import NamedTuple, Protocol

from adxl_ros.calibrate.calibration import CalibrationResult
from adxl_ros.calibrate.fits.gravity_fit import MIN_RESTS
from adxl_ros.calibrate.guided.guide import NewestSamples, NextPose, Readings, STALE_NS
from adxl_ros.calibrate.guided.hand_guide import ENOUGH_RESTS
from adxl_ros.calibrate.guided.screen_contents import Phase, Status
from adxl_ros.calibrate.guided.session import Session, SessionSettings
from adxl_ros.calibrate.guided.stage_guide import MountingError
from adxl_ros.calibrate.report import report_html
from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import unit_of
from adxl_ros.files.stream_info import StreamInfo
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals import recorded_sensor
import numpy as np

IDLE_TEXT = 'idle; call ~/start'
"""Status of a controller that has not been started."""
_POLLS_PER_MEASUREMENT = 50
"""Calls of `poll` from one attempt to measure an unknown sensor to the next: one a second."""
_NOT_RUNNING = 'no calibration is running'
"""The answer to requests that need a session."""


class ControllerState(Enum):
    """State of the guided calibration."""

    IDLE = auto()
    """No calibration runs or waits."""
    WAITING_FOR_SENSOR = auto()
    """A calibration begins once the sensor is known."""
    ASKING = auto()
    """The operator is asked what to do with an interrupted calibration."""
    RUNNING = auto()
    """A session takes poses."""
    FIT_FAILED = auto()
    """All poses of the session are taken, but the fit or its files failed."""


class Resume(Enum):
    """What to do with an interrupted calibration."""

    ASK = 'ask'
    """Ask the operator if somebody is at a screen; else resume it."""
    CONTINUE = 'continue'
    """Resume it."""
    ANEW = 'anew'
    """Put its journal aside and begin a new calibration."""


class Severity(Enum):
    """Severity of a log line."""

    INFO = auto()
    WARNING = auto()
    ERROR = auto()


class Answer(NamedTuple):
    """The answer to a request."""

    success: bool  # Whether the request was carried out
    message: str  # One line for people


class Report(NamedTuple):
    """What the diagnostics report."""

    status: Status  # What the calibration waits for
    serial: str  # Serial number of the sensor; '' while it is unknown
    values: dict[str, str | float]  # Further values by key


class Outputs(Protocol):
    """Where a controller's lines, answers and announcements go."""

    def log(self, severity: Severity, text: str) -> None:
        """Log a line."""

    def answer_captures(self, answer: Answer) -> None:
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

    def take(self, unit: Sensor) -> tuple[np.ndarray, np.ndarray]:
        """Return the samples since the last call: stamps, ns, (n,), and volts, (n, m)."""

    def restart_silence(self) -> None:
        """Measure the time without samples from now on."""

    def silence(self) -> str:
        """Return one line on the time without samples; '' while samples come."""

    def waiting(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the waiting samples: stamps, ns, (n,), and specific force, m/s², (n, 3)."""

    def clear(self) -> None:
        """Forget the waiting samples."""

    def keep_newest(self) -> None:
        """Forget the oldest of the waiting samples."""


class Controller:
    """
    Runs guided calibrations, one after the other.

    may_ask: whether somebody is at a screen who can be asked; shows_idle_stream: whether a screen
    shows the samples while no calibration runs.
    """

    def __init__(self, settings: SessionSettings, sensor: Sensor, resume: Resume,
                 samples: SampleSource, outputs: Outputs, anonymous: Sensor | None = None
                 ) -> None:
        self.settings = settings
        self.state = ControllerState.IDLE  # The present state
        # The nominal sensor of the stream; None while it is unknown
        self.unit: Sensor | None = None
        # The running calibration; None in the states IDLE, WAITING_FOR_SENSOR and ASKING
        self.session: Session | None = None
        self.question = ''  # The question to the operator in the state ASKING, else ''
        self.outcome: tuple[str, ...] = ()  # Lines on the calibration that ended last
        self.may_ask = self.shows_idle_stream = False
        self._sensor, self._resume = sensor, resume
        self._samples, self._outputs = samples, outputs
        self._anonymous, self._polls = anonymous or sensor, 0
        self._starts_over = resume is Resume.ANEW
        self._question_is_answered = False
        self._idle_samples: NewestSamples | None = None
        self._outlook = self._last_line = self._last_warning = ''
        self._sensor_fault = self._sample_fault = self._fit_fault = ''
        self._misdated: set[str] = set()
        self._accepted = 0

    @property
    def newest(self) -> NewestSamples | None:
        """Return the newest samples; None before the sensor is known."""
        return self.session.newest if self.session is not None else self._idle_samples

    def wait_for_sensor(self) -> None:
        """Begin a calibration as soon as the sensor is known."""
        self.state = ControllerState.WAITING_FOR_SENSOR

    def start(self, start_over: bool | None = None) -> Answer:
        """Begin a calibration, or resume an interrupted one."""
        if self.session is not None:
            return Answer(False, 'a calibration is running; finish or abort it first')
        if self.state is ControllerState.ASKING and start_over is None:
            return Answer(False, self.question)
        self.state, self.question = ControllerState.WAITING_FOR_SENSOR, ''
        self._question_is_answered = start_over is not None
        self._starts_over = self._resume is Resume.ANEW if start_over is None else start_over
        self._try_to_start()
        if self.state is ControllerState.ASKING:
            return Answer(False, self.question)
        if self.state is ControllerState.WAITING_FOR_SENSOR:
            return Answer(True, 'starts when sensor_info comes, or samples show the sensor')
        return Answer(self.session is not None, self._last_line)

    def capture(self) -> Answer:
        """Take the pose that the operator has reached; the end of the dwell answers later."""
        if self.session is None:
            return Answer(False, _NOT_RUNNING)
        if self.session.guide.moves_itself:
            return Answer(False, 'nothing to capture: the stage moves itself, and poses are taken '
                                 'when it has arrived')
        if self._sample_fault or self._fit_fault:
            return Answer(False, self._sample_fault or self._fit_fault)
        self._take_samples(self.session)
        obstacle = self.session.guide.capture()
        if obstacle:
            self._log_unless_repeated(Severity.WARNING, obstacle)
            return Answer(False, obstacle)
        return Answer(True, 'averaging')

    def redo(self) -> Answer:
        """Take the previous pose again."""
        if self.session is None:
            return Answer(False, _NOT_RUNNING)
        try:
            return self._answer_pose_change(self.session.redo(), 'no pose to take again')
        except UserError as error:
            return Answer(False, f'{error}')

    def skip(self) -> Answer:
        """Leave out the open pose."""
        if self.session is None:
            return Answer(False, _NOT_RUNNING)
        try:
            return self._answer_pose_change(self.session.skip(), 'no pose to leave out')
        except UserError as error:
            return Answer(False, f'{error}')

    def finish(self) -> Answer:
        """Fit the poses so far and write the files."""
        if self.session is None:
            return Answer(False, _NOT_RUNNING)
        self._take_samples(self.session)
        return Answer(self._fit(self.session), self._last_line)

    def abort(self) -> Answer:
        """End without a fit; the poses stay in the journal."""
        if self.state is ControllerState.IDLE:
            return Answer(False, _NOT_RUNNING)
        kept = f'; its poses stay in {self.session.journal.path}' if self.session else ''
        self._stop(Severity.INFO, f'aborted{kept}')
        return Answer(True, self._last_line)

    def say(self, text: str) -> None:
        """Log a line unless it was the last one."""
        self._log_unless_repeated(Severity.INFO, text)

    def read_sensor_info(self, info: StreamInfo) -> None:
        """Take what the stream states about its sensor."""
        try:
            unit = unit_of(self._sensor, info)
        except UserError as error:
            self._refuse_sensor(f'{error}')
            return
        if unit.unstated:
            self._anonymous = unit
            return
        if self.session is not None:
            self._compare_sensor(self.session, unit)
        self._take_unit(unit)

    def _take_unit(self, unit: Sensor) -> None:
        """Take a sensor as that of the stream."""
        self._sensor_fault = ''
        self.unit, self._idle_samples = unit, NewestSamples(unit)
        self._outlook = self.settings.outlook(unit)

    def read_stage(self, stamp_ns: int, alpha_rad: float, beta_rad: float) -> None:
        """Take the angles of the stage."""
        if self.session is not None:
            self.session.guide.read_encoder(stamp_ns, alpha_rad, beta_rad)

    def read_command(self, alpha_rad: float, beta_rad: float) -> None:
        """Take a command that somebody gave the stage."""
        if self.session is not None:
            self.session.guide.read_command(alpha_rad, beta_rad)

    def read_temperature(self, stamp_ns: int, temperature_c: float) -> None:
        """Take a temperature."""
        if self.session is not None:
            readings = self.session.guide.surroundings.temperature_c
            self._add_reading(self.session, readings, 'temperature', stamp_ns, temperature_c)

    def read_supply(self, stamp_ns: int, supply_v: float) -> None:
        """Take a supply voltage."""
        if self.session is not None:
            readings = self.session.guide.surroundings.supply_v
            self._add_reading(self.session, readings, 'supply', stamp_ns, supply_v)

    def poll(self) -> None:
        """Take the samples and poses since the last call; announce the next pose or fit."""
        if self.state is ControllerState.WAITING_FOR_SENSOR:
            self._try_to_start()
        if self.session is None:
            self._watch()
            return
        self._take_samples(self.session)
        if self._take_poses(self.session):
            self._announce_or_fit(self.session)

    def status(self) -> Status:
        """Return what the calibration waits for."""
        if self.state is ControllerState.ASKING:
            return Status(Phase.QUESTION, self.question, True)
        if self.state is ControllerState.WAITING_FOR_SENSOR:
            if self._sensor_fault:
                return Status(Phase.REFUSED, self._sensor_fault, True)
            silence = self._samples.silence()
            obstacle = f'{silence}; is the driver running?' if silence else \
                'without it, 2 s of samples show the sensor'
            return Status(Phase.INFO, f'waiting for sensor_info; {obstacle}', True)
        if self.session is None:
            idle = f'{IDLE_TEXT}; {self._outlook}' if self._outlook else IDLE_TEXT
            return Status(Phase.IDLE, self._last_line or idle, False)
        silence = self._samples.silence()
        if silence:
            return Status(Phase.SILENT, silence, True)
        fault = self._sample_fault or self._fit_fault
        if fault:
            return Status(Phase.REFUSED, fault, True)
        return self.session.guide.status()

    def report(self) -> Report:
        """Return what the diagnostics report; log an obstacle once for each pose and phase."""
        status = self.status()
        if status.late:
            self._warn_once(status)
        values: dict[str, str | float] = {
            'accepted': str(self._accepted), 'output': str(self.settings.output),
            'verdict': self.outcome[0] if self.outcome else ''}
        if self.session is not None:
            guide = self.session.guide
            values |= {'phase': status.phase.value, 'pose': str(guide.pose_number),
                       'next': guide.destination(), 'accepted': str(self.session.accepted_count),
                       **guide.values()}
            tilt_rad = guide.tilt_error_rad()
            if np.isfinite(tilt_rad):
                values['tilt_error_deg'] = float(np.degrees(tilt_rad))
        return Report(status, self.unit.serial if self.unit else '', values)

    def close(self) -> None:
        """Close the journal."""
        if self.session is not None:
            self.session.close()

    def _try_to_start(self) -> None:
        """Begin a session if the sensor is known and the operator has nothing to answer."""
        if self.unit is None:
            return
        try:
            if self.may_ask and self._resume is Resume.ASK and not self._question_is_answered:
                self.question = self.settings.question(self.unit)
            if self.question:
                self.state = ControllerState.ASKING
            else:
                self._begin_session(self.unit)
        except UserError as error:
            self._stop(Severity.ERROR, f'{error}')

    def _begin_session(self, unit: Sensor) -> None:
        self.session = session = Session(unit, self.settings, self._starts_over, self._sensor)
        self.state, self.outcome = ControllerState.RUNNING, ()
        self._samples.restart_silence()
        task = self._outlook or f'rest in {MIN_RESTS} or more directions (at best in ' \
            f'{ENOUGH_RESTS}), then call ~/finish'
        if not session.resumed:
            self.say(f'calibrating {unit.serial}: {task}')
            return
        check = ' (the last one first, to see that the mounting is as it was)' \
            if session.guide.poses_to_verify else ''
        self.say(f'calibrating {unit.serial}: {task}, resumed after {session.resumed} poses'
                 f'{check}; resume:=anew puts them aside')

    def _refuse_sensor(self, fault: str) -> None:
        """End the session of a stream whose sensor is not the one of the parameters."""
        self._sensor_fault = fault
        self.unit = self._idle_samples = None
        if self.session is not None:
            self._stop(Severity.ERROR, f'{fault}; the poses are kept')
        self._log_unless_repeated(Severity.ERROR, fault)

    def _compare_sensor(self, session: Session, unit: Sensor) -> None:
        """End a session whose sensor changed; check the mounting if its driver restarted."""
        old, new = self.settings.head(session.unit), self.settings.head(unit)
        changes = ', '.join(f'{key} was {old[key]}, is {new[key]}' for key in old
                            if old[key] != new[key])
        if changes:
            self._stop(Severity.ERROR, f'sensor_info: {changes}: changed during the calibration; '
                       'put it back and start again, the poses are kept')
            return
        session.guide.verify()
        self._outputs.answer_captures(Answer(False, 'the driver started again; capture again'))

    def _add_reading(self, session: Session, readings: Readings, quantity: str, stamp_ns: int,
                     value: float) -> None:
        """Add a reading; a reading on another clock gets the stamp of the newest sample."""
        newest_ns = session.guide.newest_ns or 0
        ahead_ns = stamp_ns - newest_ns
        if stamp_ns and newest_ns and abs(ahead_ns) > STALE_NS:
            if quantity not in self._misdated:
                self._misdated.add(quantity)
                side = 'ahead of' if ahead_ns > 0 else 'behind'
                self._outputs.log(
                    Severity.WARNING, f'{quantity} is stamped {abs(ahead_ns) * 1e-9:.0f} s {side} '
                    'imu/data_raw: its time of arrival counts; put both on one clock')
            stamp_ns = 0
        readings.add(stamp_ns or newest_ns, value)

    def _watch(self) -> None:
        """Keep the newest samples while no calibration runs."""
        if self.unit is None and (self.state is not ControllerState.IDLE
                                  or self.shows_idle_stream):
            # A driver that has just begun states its sensor on another topic.
            self._samples.keep_newest()
            self._polls += 1
            if self._polls % _POLLS_PER_MEASUREMENT == 0 and not self._sensor_fault:
                self._measure_unit()
        elif self.unit is not None and self._idle_samples is not None and self.shows_idle_stream:
            self._idle_samples.feed(*self._samples.take(self.unit))
        else:
            self._samples.clear()

    def _measure_unit(self) -> None:
        """Measure the sensor of a stream that states nothing of itself."""
        stamps_ns, accel_mps2 = self._samples.waiting()
        if not len(stamps_ns) or np.ptp(stamps_ns) < recorded_sensor.SHORTEST_S * 1e9:
            return
        try:
            unit, lines = recorded_sensor.unit_of_stream(self._anonymous, stamps_ns, accel_mps2)
        except UserError as error:
            self._log_unless_repeated(Severity.WARNING, f'imu/data_raw: {error}')
            return
        self._outputs.log(Severity.INFO, 'no sensor_info: measured from the stream: '
                          + '; '.join(lines))
        self._take_unit(unit)

    def _take_samples(self, session: Session) -> None:
        stamps_ns, volts = self._samples.take(self.unit or session.unit)
        if not len(stamps_ns) and not self._samples.fault:
            return
        fault = self._samples.fault or session.feed(stamps_ns, volts)
        if fault and not self._sample_fault:
            self._log_unless_repeated(Severity.ERROR, fault)
        self._sample_fault = fault

    def _take_poses(self, session: Session) -> bool:
        """Take the poses that are complete; return whether the session goes on."""
        try:
            for text in session.take_poses():
                self.say(text)
                self._outputs.answer_captures(Answer(True, text))
        except MountingError as error:
            self._stop(Severity.ERROR, f'{error}')
            return False
        except UserError as error:
            self._log_unless_repeated(Severity.ERROR, f'{error}')
            self._outputs.answer_captures(Answer(False, f'{error}'))
        refusal = session.guide.new_refusal()
        if refusal:
            self._log_unless_repeated(Severity.WARNING, refusal)
            self._outputs.answer_captures(Answer(False, refusal))
        return True

    def _announce_or_fit(self, session: Session) -> None:
        """Announce the next pose; fit if no pose is open."""
        pose = session.guide.next_pose()
        if pose is not None:
            self._outputs.announce(pose)
        elif self.state is not ControllerState.FIT_FAILED:
            self._fit(session)

    def _answer_pose_change(self, text: str, obstacle: str) -> Answer:
        """Answer a request for another pose by its line, or by the obstacle if it has none."""
        if not text:
            return Answer(False, obstacle)
        self._fit_fault, self.state = '', ControllerState.RUNNING
        self._outputs.answer_captures(Answer(False, text))
        self.say(text)
        return Answer(True, text)

    def _fit(self, session: Session) -> bool:
        """Fit and write all files; return whether that succeeded."""
        self.say(f'fitting {session.accepted_count} poses')
        self._outputs.show_fit(self._last_line)
        self._fit_fault, self.state = '', ControllerState.RUNNING
        try:
            result = session.finish()
            self._outputs.log(Severity.INFO, result.keep(self.settings.store))
            self._write_report(result)
            session.end()
        except (UserError, OSError) as error:
            # The poses stay: further poses, or room on the disk, can still lead to a fit.
            text = f'cannot finish: {error}'
            if session.guide.is_over:
                text = f'{text}; finish again, redo or abort'
                self._fit_fault, self.state = text, ControllerState.FIT_FAILED
            self._log_unless_repeated(Severity.ERROR, text)
            return False
        for line in result.comments():
            self._outputs.log(Severity.INFO, line)
        self.outcome = tuple(result.summary_lines)
        self._outputs.log(Severity.INFO, self.outcome[0])
        open_poses = session.guide.open_poses
        advice = f'; {open_poses} poses are open: start again to go on' if open_poses else ''
        self._stop(Severity.INFO, f'wrote {self.settings.output}{advice}')
        return True

    def _write_report(self, result: CalibrationResult) -> None:
        """Write the report; without it the calibration is still valid."""
        if not self.settings.report:
            return
        try:
            Path(self.settings.report).mkdir(parents=True, exist_ok=True)
            report_html.write(self.settings.report, result, self.settings.store)
        except (UserError, OSError) as error:
            self._log_unless_repeated(Severity.ERROR, f'no report: {error}')

    def _stop(self, severity: Severity, text: str) -> None:
        """End the session, or the wait for one, with a line for people."""
        if self.session is not None:
            self._accepted = self.session.accepted_count
            self.session.close()
        self.state, self.session, self.question = ControllerState.IDLE, None, ''
        self._sample_fault = self._fit_fault = ''
        self._outputs.answer_captures(Answer(False, text))
        self._outputs.withdraw_pose(text)
        self._log_unless_repeated(severity, text)

    def _log_unless_repeated(self, severity: Severity, text: str) -> None:
        """Log a line unless it was the last one."""
        if text != self._last_line:
            self._outputs.log(severity, text)
        self._last_line = text

    def _warn_once(self, status: Status) -> None:
        """Log a warning once for each phase and pose, although its times change."""
        poses = self.session.accepted_count if self.session is not None else ''
        key = f'{status.phase.value} {poses}'
        if key != self._last_warning and status.text != self._last_line:
            self._outputs.log(Severity.WARNING, status.text)
        self._last_warning = key
