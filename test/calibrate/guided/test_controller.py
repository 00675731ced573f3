# SPDX-License-Identifier: Apache-2.0

"""The guided calibration as a state machine, without a graph: requests, states and answers."""

from dataclasses import replace

from adxl_ros.calibrate.guided.controller import Controller, ControllerState, StartMode
from adxl_ros.calibrate.guided.screen_contents import CaptureSettings, Phase, StageMode
from adxl_ros.calibrate.guided.session import SessionSettings
from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file, sweep_journal
from adxl_ros.files.stream_info import sensor_info, StreamInfo
from adxl_ros.model.kinematics import specific_force
from adxl_ros.report.level import Level
import numpy as np
import pytest
from units import drawn, Fed, nominal

UNIT = nominal(serial='C1', rate_hz=200.0)
TRUTH = drawn(np.random.default_rng(3), UNIT)


class Rig:
    """A controller with a sensor on a stage: a source of samples and the end of all outputs."""

    def __init__(self, folder, mode=StageMode.COMMANDED, resume='ask', **changes):
        self.fault = self.silence_text = ''
        self.unstated = np.zeros(0, np.int64), np.zeros((0, 3))  # Too few to measure the sensor
        self.log_lines, self.answers, self.withdrawn = [], [], []
        self.pose, self.angles_rad = None, (0.0, 0.0)
        self.now_ns = 1_700_000_000_000_000_000
        self.fed, self._waiting = Fed(TRUTH, 1), []
        settings = SessionSettings(
            'stage',
            'full',
            (np.pi / 4, np.pi / 2),
            np.pi / 2,
            1e-3,
            2,
            CaptureSettings(0.5, np.radians(0.2), 20.0, mode),
            folder / 'unit.yaml',
            folder / 'journal',
            '',
            '',
        )
        self.controller = Controller(replace(settings, **changes), UNIT, resume, self, self)

    def log(self, level, text):
        self.log_lines.append((level, text))

    def answer_captures(self, answer):
        self.answers.append(answer)

    def announce(self, pose):
        self.pose = pose

    def withdraw_pose(self, reason):
        self.pose = None
        self.withdrawn.append(reason)

    def show_fit(self, text):
        assert text.startswith('fitting ')

    def take(self, unit):
        batch, self._waiting = self._waiting, []
        if not batch:
            return np.zeros(0, np.int64), np.zeros((0, len(unit.axes)))
        return tuple(np.concatenate(part) for part in zip(*batch))

    def restart_silence(self):
        self.silence_text = ''

    def silence(self):
        return self.silence_text

    def waiting(self):
        """Return the samples that show a sensor which nothing states."""
        return self.unstated

    def keep_newest(self, count=None):
        """Keep all waiting samples, as there are few, or none."""
        if count == 0:
            self._waiting.clear()

    def say_info(self, **changes):
        info = {**sensor_info(UNIT), **changes}
        self.controller.read_sensor_info(StreamInfo(info, 'sensor_info'))

    def read_encoder(self):
        if self.controller.session is not None:
            self.controller.session.stage.read_encoder(self.now_ns, *self.angles_rad)

    def close(self):
        if self.controller.session is not None:
            self.controller.session.journal.close()

    def turn(self, seconds=0.05, encoder=True):
        """Advance the time; a commanded stage reaches its pose at once."""
        for _ in range(round(seconds / 0.05)):
            if self.pose is not None and self.pose.command_rad is not None:
                self.angles_rad = self.pose.command_rad
            if encoder:
                self.read_encoder()
            alpha_rad, beta_rad = (np.full(10, angle) for angle in self.angles_rad)
            stamps_ns = self.now_ns + np.arange(10) * 5_000_000
            self._waiting.append(
                (stamps_ns, self.fed(specific_force(alpha_rad, beta_rad, 9.80665)))
            )
            self.now_ns += 50_000_000
            self.controller.poll()

    def turn_until(self, condition, seconds=60.0):
        for _ in range(round(seconds / 0.05)):
            if condition():
                return
            self.turn()
        pytest.fail(f'{condition} has not come: {self.controller.status()}')

    def lines(self, level=None):
        return [text for kind, text in self.log_lines if level in (None, kind)]


@pytest.fixture
def rig(tmp_path):
    """Give a function that makes controllers on one journal; each one ends the one before."""
    made = []

    def make(*args, **changes):
        if made:
            made[-1].close()
        made.append(Rig(tmp_path, *args, **changes))
        return made[-1]

    yield make
    made[-1].close()


def test_a_sweep_goes_from_the_wait_for_its_sensor_to_its_file(rig, tmp_path):
    bench = rig()
    controller = bench.controller
    assert controller.start() == (
        True,
        'starts when sensor_info comes, or samples show the sensor',
    )
    assert controller.state is ControllerState.WAITING_FOR_SENSOR
    assert controller.status().text == (
        'waiting for sensor_info; without it, 2 s of samples show the sensor'
    )
    bench.silence_text = 'nothing on imu/data_raw'
    assert controller.status().text.endswith('nothing on imu/data_raw; is the driver running?')
    bench.turn()
    assert controller.state is ControllerState.WAITING_FOR_SENSOR
    bench.say_info()
    bench.turn()
    assert controller.state is ControllerState.RUNNING
    assert bench.lines()[-1].startswith('calibrating C1: plan full: 22 poses')
    assert controller.start() == (False, 'a calibration is running; finish or abort it first')
    assert not controller.capture().success
    bench.turn_until(lambda: controller.session.accepted_count == 2)
    assert bench.pose.text == 'pose 3 of 22: alpha 90.0°, beta 90.0°'
    assert bench.pose.values['check'] == 'false' and bench.answers[-1].success
    report = controller.report()
    assert report.serial == 'C1' and report.values['accepted'] == '2'
    assert report.values['phase'] == report.status.phase.value
    assert 0 < report.values['tilt_error_deg'] < 90
    bench.turn_until(lambda: controller.state is ControllerState.IDLE, 120)
    assert controller.session is None and bench.pose is None
    assert bench.withdrawn == [f'wrote {tmp_path / "unit.yaml"}']
    assert controller.outcome and controller.report().values['verdict']
    assert parameter_file.load(tmp_path / 'unit.yaml').serial == 'C1'


def test_an_operator_at_a_screen_has_a_choice_and_others_resume(rig, tmp_path):
    bench = rig()
    bench.say_info()
    assert bench.controller.start().success
    bench.turn_until(lambda: bench.controller.session.accepted_count == 3)
    aborted = bench.controller.abort()
    assert aborted == (True, f'aborted; its poses stay in {tmp_path / "journal"}')

    asking = rig()
    asking.say_info()
    asking.controller.may_ask = True
    answer = asking.controller.start()
    assert not answer.success and 'holds 3 poses of an interrupted' in answer.message
    assert asking.controller.state is ControllerState.ASKING
    assert asking.controller.start() == answer
    assert asking.controller.status() == (
        type(asking.controller.status())(Phase.QUESTION, answer.message, True)
    )
    assert asking.controller.start(StartMode.CONTINUE).success
    assert asking.controller.session.accepted_count == 3
    assert 'resumed after 3 poses (the last one first' in asking.lines()[-1]
    assert asking.controller.abort().success

    continuing = rig()
    continuing.say_info()
    assert continuing.controller.start().success
    assert continuing.controller.session.resumed == 3

    anew = rig(resume='anew')
    anew.say_info()
    assert anew.controller.start().success
    assert anew.controller.session.resumed == 0
    (kept,) = tmp_path.glob('journal.2*')
    assert len(sweep_journal.accepted_poses(sweep_journal.read(kept).entries)) == 3


def test_a_fit_that_fails_at_the_end_waits_for_a_decision(rig, tmp_path, monkeypatch):
    bench = rig(planes_rad=(np.pi / 2,), check_poses=0)
    bench.say_info()
    bench.controller.start()
    session = bench.controller.session

    def full_disk():
        raise UserError('unit.yaml: the disk is full')

    monkeypatch.setattr(session, 'finish', full_disk)
    bench.turn_until(lambda: bench.controller.fit_fault, 120)
    status = bench.controller.status()
    assert status.phase is Phase.REFUSED and status.late
    assert status.text == 'cannot finish: unit.yaml: the disk is full; finish again, redo or abort'
    bench.turn(0.5)
    assert bench.lines(Level.ERROR) == [status.text], 'one attempt has one report'
    assert bench.controller.redo() == (True, 'pose 10 will be taken again')
    assert not bench.controller.fit_fault
    bench.turn_until(lambda: bench.controller.fit_fault)
    monkeypatch.undo()
    answer = bench.controller.finish()
    assert answer == (True, f'wrote {tmp_path / "unit.yaml"}')
    assert bench.controller.state is ControllerState.IDLE


def test_a_capture_has_its_answer_when_its_pose_is_on_disk_or_refused(rig):
    bench = rig(StageMode.ENCODER)
    bench.say_info()
    bench.controller.start()
    bench.turn(0.5)
    assert bench.controller.status().phase is Phase.OPERATOR
    answer = bench.controller.capture()
    assert not answer.success and answer.message.startswith('alpha is 45.0° from the target 45°')
    assert bench.lines(Level.WARN)[-1] == answer.message
    bench.angles_rad = (np.pi / 4, 0.0)
    bench.turn(0.5)
    assert bench.controller.capture() == (True, 'averaging')
    bench.turn_until(lambda: bench.answers)
    assert bench.answers == [(True, 'pose 1 is on disk')]
    bench.controller.capture()
    assert bench.controller.skip() == (True, 'pose 2 is left out')
    assert bench.answers[-1] == (False, 'pose 2 is left out')
    bench.fault = 'this stream is already compensated'
    bench.turn()
    assert bench.controller.capture() == (False, bench.fault)
    assert bench.controller.status().text == bench.fault
    bench.silence_text = 'nothing on imu/data_raw for 4 s'
    assert bench.controller.status().phase is Phase.SILENT


def test_a_sensor_info_that_comes_late_begins_the_calibration_again(rig):
    """The samples of 3 s were taken for those of a sensor that states nothing."""
    bench = rig()
    stamps_ns = bench.now_ns + 5_000_000 * np.arange(600)
    noise_mps2 = np.random.default_rng(1).normal(0, [0.01, 0.01, 0], (600, 3))
    bench.unstated = stamps_ns, noise_mps2 + [9.8, 0, 0]
    bench.controller.start()
    bench.turn_until(lambda: bench.controller.session is not None)
    assert bench.controller.session.nominal.measured
    bench.say_info()
    assert not bench.controller.session.nominal.measured and not bench.lines(Level.ERROR)
    bench.turn_until(lambda: bench.controller.session.accepted_count == 1)


def test_another_sensor_ends_the_session_and_a_restarted_driver_checks_the_mounting(rig):
    """The info of the stream decides."""
    bench = rig()
    bench.say_info()
    bench.controller.start()
    bench.turn_until(lambda: bench.controller.session.accepted_count == 2)
    bench.say_info()
    assert len(bench.controller.session.guide.to_verify) == 1
    assert bench.answers[-1] == (False, 'the driver started again; capture again')
    bench.turn_until(lambda: not bench.controller.session.guide.to_verify)
    assert 'the sensor is mounted as it was' in bench.lines()
    bench.say_info(rate_hz='100.0')
    assert bench.controller.state is ControllerState.IDLE
    assert 'rate_hz was 200.0, is 100.0: changed during the calibration' in bench.lines()[-1]
    bench.say_info(serial='C2')
    assert bench.controller.stream.nominal is None and bench.lines(Level.ERROR)[-1].startswith(
        'sensor_info: is of the sensor C2'
    )
    bench.controller.start()
    assert bench.controller.status().phase is Phase.REFUSED
