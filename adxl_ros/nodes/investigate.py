# SPDX-License-Identifier: Apache-2.0

"""Investigate the sim-to-real gap: record, diagnose, command the next manoeuvre, until certain."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
import shlex
import signal
import sys
from textwrap import wrap
from typing import Any

from adxl_ros.files.bag_writer import LiveBag
from adxl_ros.investigate.background import BackgroundDiagnoser, OutputFolder
from adxl_ros.investigate.diagnosis_round import Answer, hypothesis_text, Outcome
from adxl_ros.investigate.investigation import Investigation, State, Status as Situation
from adxl_ros.investigate.manoeuvres import description, Pose, StageLimits
from adxl_ros.links.support.base import Watchdog
from adxl_ros.nodes.node_help import NodeHelp
from adxl_ros.nodes.parameters import declare_all, low_and_high
from adxl_ros.nodes.run_node import run
from adxl_ros.nodes.sensor_parameters import declare_sensor, make_sensor
from adxl_ros.nodes.settings import check_given_parameters, InvestigateSettings
from adxl_ros.nodes.steps import drawable
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
from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.executors import Executor
from rclpy.node import Node
from sensor_msgs.msg import BatteryState, Imu, JointState, Temperature
from std_msgs.msg import Header
from std_srvs.srv import Trigger

_COLUMNS = 79
"""Columns of a line."""
_TIME_COLUMNS = 11
"""Columns of the time at the beginning of a line."""
_SMALLEST_SHOWN = 0.01
"""Probability below which a hypothesis is not named. Chosen: the smallest number that is shown."""


class InvestigationScreen:
    """Prints lines; in a terminal that can draw, the last line shows what happens now."""

    def __init__(self, folder: Path, limits: StageLimits, minutes: float) -> None:
        """Print what is about to happen."""
        self._live: Any = None
        self._text = ''
        if drawable():
            from rich.console import Console
            from rich.live import Live
            self._live = Live('', console=Console(file=sys.stdout, highlight=False,
                                                  markup=False, emoji=False), transient=True)
            self._live.start()
        for line in opening_lines(folder, limits, minutes):
            self._print(line)

    def show_answer(self, minutes: float, answer: Answer) -> None:
        """Print the probabilities after a diagnosis, and what follows."""
        for line in answer_lines(minutes, answer):
            self._print(line)

    def show_status(self, status: Situation) -> None:
        """Show what happens now, where the terminal can draw."""
        if self._live is None:
            return
        text = status_line(status)
        if text != self._text:
            from rich.text import Text
            self._live.update(Text(text))
            self._text = text

    def close(self) -> None:
        """Stop drawing."""
        if self._live is not None:
            self._live.stop()
            self._live = None

    def _print(self, line: str) -> None:
        if self._live is None:
            print(line, flush=True)
        else:
            self._live.console.print(line, soft_wrap=True)


def opening_lines(folder: Path, limits: StageLimits, minutes: float) -> list[str]:
    """Return what is about to happen."""
    ranges = ', '.join(f'{joint} {low:.0f} to {high:.0f}°' for joint, (low, high) in (
        ('alpha', np.degrees(limits.alpha_rad)), ('beta', np.degrees(limits.beta_rad))))
    return [f'Investigation into {folder}, {minutes:g} minutes at most',
            f'Stage within {ranges}, {np.degrees(limits.rate_rad_s):.3g}°/s', '']


def answer_lines(minutes: float, answer: Answer) -> list[str]:
    """Return the lines of one diagnosis."""
    line, rest = f'{minutes:5.1f} min ', 1.0
    for hypothesis in answer.hypotheses:
        if hypothesis.probability < _SMALLEST_SHOWN:
            break
        part = f' {hypothesis_text(hypothesis.effects)} {_percent(hypothesis.probability)} '
        other = f' others {_percent(rest - hypothesis.probability)}'
        if len(line) + len(part) + len(other) > _COLUMNS:
            break
        line, rest = line + part, rest - hypothesis.probability
    if rest >= _SMALLEST_SHOWN / 2:
        line += f' others {_percent(rest)}'
    lines = [line.rstrip()]
    if answer.outcome is Outcome.GO_ON:
        lines += _indented(f'next: {description(answer.manoeuvre)}')
    return lines


def status_line(status: Situation) -> str:
    """Return one line about what happens now."""
    remaining = f', {status.remaining_s:.0f} s left' if status.state is State.MOVING else ''
    text = f'{status.minutes:5.1f} min  {status.text}'
    room = _COLUMNS - len(remaining)
    return (text if len(text) <= room else f'{text[:room - 1]}…') + remaining


def closing_lines(investigation: Investigation, folder: OutputFolder) -> list[str]:
    """Return the result, where the files are, and what to do next."""
    bag, baseline, gap, parameters = (shlex.quote(str(path)) for path in (
        folder.bag, folder.baseline, folder.path / 'gap', folder.parameters))
    diagnose = ['ros2 run adxl_ros diagnose', bag, f'--params {baseline}', f'-o {gap}']
    files = [('Report', folder.report), ('Parameters', folder.parameters), ('Bag', folder.bag)]
    named = [f' {name:11} {path}' for name, path in files if path.exists()]
    if investigation.state is State.STOPPED:
        return ['', *wrap(f'Stopped without a verdict: {investigation.reason}', _COLUMNS), '',
                *named, *(_command(diagnose) if investigation.has_moved else [])]
    answer = investigation.answers[-1][1]
    lines = ['', *wrap(answer.sentence, _COLUMNS)]
    if answer.hidden:
        lines += wrap(f'It cannot show {_listed(answer.hidden)}.', _COLUMNS)
    simulate = ['ros2 run adxl_ros simulate rich', f'--params {parameters}', '-o sim.csv']
    return [*lines, '', *named, *_command(simulate)]


def _command(words: Sequence[str]) -> list[str]:
    """Return a command for the terminal; it goes on in the next line where it is long."""
    lines = [f' {"Next":11}']
    for word in words:
        if len(lines[-1]) + len(word) + len(' \\') >= _COLUMNS:
            lines[-1] += ' \\'
            lines.append(' ' * 15)
        lines[-1] += f' {word}'
    return lines


def _percent(probability: float) -> str:
    """Return a probability in percent; 99 % stands for all below 1."""
    percent = 100 * probability
    return f'{min(percent, 99) if probability < 0.9995 else percent:.0f} %'


def _listed(names: Sequence[str]) -> str:
    return ', '.join(names[:-1]) + ' or ' * (len(names) > 1) + names[-1]


def _indented(text: str) -> list[str]:
    return [' ' * _TIME_COLUMNS + line for line in wrap(text, _COLUMNS - _TIME_COLUMNS)]


_SAMPLES = 'imu/data_raw'
"""Topic of the samples."""
_SAMPLES_QUEUE = 20000
"""Samples that are kept while the thread is busy: 20 s at 1 kHz."""
_SLOW_QUEUE = 1000
"""Messages of a slow topic that wait meanwhile; chosen: 10 s of a stage."""
_KINDS = {'stage/joint_states': (JointState, 'sensor_msgs/msg/JointState'),
          'stage/command': (JointState, 'sensor_msgs/msg/JointState'),
          'temperature': (Temperature, 'sensor_msgs/msg/Temperature'),
          'supply': (BatteryState, 'sensor_msgs/msg/BatteryState'),
          'sensor_info': (DiagnosticStatus, 'diagnostic_msgs/msg/DiagnosticStatus')}
"""Class and name of the type of each topic beside the samples."""


class BagRecorder:
    """Writes the topics of the package into a bag. A thread of its own takes the samples."""

    def __init__(self, node: Node, watchdog: Watchdog) -> None:
        """Subscribe; nothing is kept before `start`."""
        self._node = node
        self.has_samples = False  # Whether a sample has come
        self._bag: LiveBag | None = None
        self._thread: RepeatingThread | None = None
        self._system = Clock(clock_type=ClockType.SYSTEM_TIME)
        self._watchdog = watchdog
        # Its message comes once, perhaps before the bag is open.
        self._early: list[tuple[str, str, bytes]] = []
        for topic, (kind, name) in _KINDS.items():
            create_subscription(node, kind, topic, partial(self._write, topic, name), _SLOW_QUEUE,
                                latched=topic == 'sensor_info', raw=True)
        self._samples = Inbox(node, Imu, _SAMPLES, _SAMPLES_QUEUE)

    @property
    def is_writing(self) -> bool:
        """Return whether there is a bag."""
        return self._bag is not None

    def listen(self) -> None:
        """Take samples, so that `has_samples` shows them."""
        self._thread = RepeatingThread(
            self._node, lambda: self._samples.receive(self._write_sample), _SAMPLES)

    def start(self, path: Path) -> None:
        """Begin to write."""
        self._bag = LiveBag(path)
        for topic, kind, data in self._early:
            self._write(topic, kind, data)

    def fault(self) -> str:
        """Return that several nodes publish samples, so that none is written, or ''."""
        return self._samples.fault()

    def flush(self) -> None:
        """Write the messages so far to the file."""
        if self._bag is not None:
            self._bag.flush()

    def close(self) -> None:
        """End the thread, and write the end of the bag."""
        if self._thread is not None:
            self._thread.close()
            self._thread = None
        if self._bag is not None:
            self._bag.close()

    def _write_sample(self, data: bytes) -> None:
        self.has_samples = True
        self._watchdog.feed()
        self._write(_SAMPLES, 'sensor_msgs/msg/Imu', data)

    def _write(self, topic: str, kind: str, data: bytes) -> None:
        if self._bag is None:
            if topic == 'sensor_info':
                self._early = [(topic, kind, data)]
            return
        self._bag.write(self._node.resolve_topic_name(topic), kind, data,
                        self._system.now().nanoseconds)


_POLL_S = 0.02
"""Time between two commands, s; chosen: a tenth of the largest step."""
_SILENT_S = 3.0
"""Time without samples or poses after which the stage is stopped, s; chosen."""
_LONGEST_TURN_S = 0.2
"""Longest time between two commands that counts as silence, s; chosen: ten turns."""
_FAREWELL_S = 0.5
"""Time for which the last command is repeated at the end, s; chosen: the stage has it then."""
_COMMAND_QUEUE = 10
"""Commands that are kept for a slow subscriber; chosen."""
_STAGE_QUEUE = 1000
"""Poses of the stage that wait while the node is busy; chosen: 10 s."""
_EXAMPLES = {
    'a simulated stage, driver and stage running': '',
    'a unit by its parameter file, within limits':
        '--ros-args --params-file unit.yaml -p limits.rate_deg_s:=10.0 '
        "-p 'limits.beta_deg:=[-90.0,90.0]'",
}
"""Examples of arguments, by their purpose."""


class Investigate(Node):
    """
    The node of the investigation.

    It connects topics to an `Investigation`, records them, and shows what happens.
    """

    def __init__(self) -> None:
        super().__init__('investigate')
        check_given_parameters(self)
        self._sensor = make_sensor(declare_sensor(self))
        self._settings = own = declare_all(self, InvestigateSettings)
        alpha_deg = low_and_high('limits.alpha_deg', own.alpha_deg, (0.0, 180.0))
        beta_deg = low_and_high('limits.beta_deg', own.beta_deg, (0.0, 360.0))
        self._limits = StageLimits(_radians(alpha_deg), _radians(beta_deg),
                                   float(np.radians(own.rate_deg_s)))
        self._commands = create_publisher(self, JointState, 'stage/command', _COMMAND_QUEUE)
        self.create_service(Trigger, '~/abort', self._on_abort)
        create_subscription(self, JointState, 'stage/joint_states', self._on_stage, _STAGE_QUEUE)
        self._pose: Pose | None = None
        self._watchdogs = {topic: Watchdog(_LONGEST_TURN_S)
                           for topic in ('imu/data_raw', 'stage/joint_states')}
        self._diagnostics = DiagnosticsReporter(self, {'investigate': self._status})
        self._recorder = BagRecorder(self, self._watchdogs['imu/data_raw'])
        self._investigation: Investigation | None = None
        self._screen: InvestigationScreen | None = None
        self._ended_ns: int | None = None
        self._request = ''

    def request_stop(self, reason: str) -> None:
        """Stop the investigation at the next turn; a signal may come at any time."""
        self._request = reason

    def begin(self) -> None:
        """Wait for sensor and stage; the files are made when both are there."""
        settings = self._settings
        self._folder = OutputFolder.free(Path(settings.output))
        self._screen = InvestigationScreen(self._folder.path, self._limits, settings.minutes)
        self._investigation = Investigation(
            self._limits, settings.minutes,
            BackgroundDiagnoser(self._folder, self._limits, settings.seed),
            self._screen.show_answer, self._recorder.flush)
        self._recorder.listen()
        self.create_timer(_POLL_S, self._poll, clock=STEADY)

    def stop(self, reason: str) -> None:
        """Stop the investigation; the stage holds its pose."""
        if self._investigation is not None:
            self._investigation.stop(reason)

    def close(self) -> None:
        """Write the end of the bag, and end the screen and the diagnosis."""
        self.stop('the node has ended')
        self._recorder.close()
        if self._screen is not None:
            self._screen.close()

    def _poll(self) -> None:
        investigation, screen = self._investigation, self._screen
        assert investigation is not None and screen is not None
        if self._request:
            self.stop(self._request)
        if not investigation.has_ended:
            self._check_streams(investigation)
        now_s = self.get_clock().now().nanoseconds * 1e-9
        command = investigation.step(now_s, self._pose) if now_s else None
        if command is not None:
            self._commands.publish(JointState(
                header=Header(stamp=self.get_clock().now().to_msg()), name=['alpha', 'beta'],
                position=list(command), velocity=list(investigation.speed or ())))
        screen.show_status(investigation.status())
        if investigation.has_ended:
            self._end(investigation)

    def _end(self, investigation: Investigation) -> None:
        """End the node when the stage has its last command."""
        now_ns = STEADY.now().nanoseconds
        if self._ended_ns is None:
            self._ended_ns = now_ns
        elif now_ns - self._ended_ns > _FAREWELL_S * 1e9:
            assert self._screen is not None
            self._recorder.close()
            self._screen.close()
            print('\n'.join(closing_lines(investigation, self._folder)), flush=True)
            raise SystemExit(0 if investigation.has_verdict else 1)

    def _check_streams(self, investigation: Investigation) -> None:
        """Stop where sensor or stage is silent; wait for both at the beginning."""
        if investigation.state is State.RECORDING:
            if not self._recorder.has_samples:
                self._pose = None
            elif self._pose is not None and not self._recorder.is_writing:
                self._folder.make(self._sensor)
                self._recorder.start(self._folder.bag)
            return
        if self._recorder.fault():
            investigation.stop(f'{self._recorder.fault()}; the stage holds its pose')
        for topic, watchdog in self._watchdogs.items():
            silent_s = watchdog.check()
            if silent_s > _SILENT_S:
                investigation.stop(f'nothing on {self.resolve_topic_name(topic)} for '
                                   f'{silent_s:.0f} s; the stage holds its pose')

    def _on_stage(self, message: JointState) -> None:
        angles_rad = dict(zip(message.name, message.position))
        pose = Pose(angles_rad.get('alpha', np.nan), angles_rad.get('beta', np.nan))
        if np.isfinite(pose).all():
            self._pose = pose
            self._watchdogs['stage/joint_states'].feed()

    def _on_abort(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.stop('~/abort was called')
        response.success, response.message = True, 'stopped; the stage holds its pose'
        return response

    def _status(self) -> Status:
        if self._investigation is None:
            return Status(Level.OK, 'not begun', self._sensor.serial, {})
        status = self._investigation.status()
        level = Level.WARN if status.state in (State.STOPPED, State.RECORDING) else Level.OK
        answers = self._investigation.answers
        values = {'state': status.state.value, 'minutes': status.minutes}
        if answers:
            best = answers[-1][1].hypotheses[0]
            values |= {'hypothesis': ' '.join(best.effects) or 'no gap',
                       'probability': best.probability}
        return Status(level, status.text, self._sensor.serial, values)


def _radians(range_deg: tuple[float, float]) -> tuple[float, float]:
    low_rad, high_rad = np.radians(range_deg).tolist()
    return low_rad, high_rad


def _work(node: Investigate, executor: Executor) -> None:
    """Run the node; a signal stops the stage before the node ends."""
    # A handler of rclpy would end the graph before the stage has its last command.
    for number, name in ((signal.SIGINT, 'Ctrl-C'), (signal.SIGTERM, 'SIGTERM')):
        signal.signal(number, partial(_stop_by_signal, node, name))
    node.begin()
    executor.spin()


def _stop_by_signal(node: Investigate, name: str, *_: object) -> None:
    node.request_stop(name)


def main() -> int:
    """Run the node."""
    return run(Investigate, NodeHelp(__doc__, _EXAMPLES, (InvestigateSettings,)), _work)
