# SPDX-License-Identifier: Apache-2.0

"""Investigate the sim-to-real gap: record, diagnose, command the next manoeuvre, until certain."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
import shlex
import signal
from textwrap import wrap
import time
from typing import Any

from adxl_ros.files.atomic_write import free_name
from adxl_ros.files.bag_writer import LiveBag
from adxl_ros.investigate.investigation import (
    Answer,
    BackgroundDiagnoser,
    hypothesis_text,
    Investigation,
    OutputFolder,
    RoundOutcome,
    State,
)
from adxl_ros.investigate.manoeuvres import CATALOGUE, Pose, StageLimits
from adxl_ros.nodes import parameter_checks, parameters, sensor_parameters, topics
from adxl_ros.nodes.jobs import LiveLine
from adxl_ros.nodes.parameters import low_and_high, parameter, SEEDS
from adxl_ros.nodes.run_node import run
from adxl_ros.nodes.topics import Level, Status
from adxl_ros.process import command
from adxl_ros.report.quantities import percent
from adxl_ros.report.screen import COLUMNS, end_lines
from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import BatteryState, Imu, JointState, Temperature
from std_msgs.msg import Header
from std_srvs.srv import Trigger

_INDENT = 11 * ' '  # Spaces in place of the time at the beginning of a line
_MOST_NAMED = 3
"""Largest number of hypotheses in a line: more of them fill the line of a terminal."""
_SAMPLES = 'imu/data_raw'
_STAGE = 'stage/joint_states'
_KINDS = {
    _SAMPLES: Imu,
    _STAGE: JointState,
    'stage/command': JointState,
    'temperature': Temperature,
    'supply': BatteryState,
    'sensor_info': DiagnosticStatus,
}
"""Type of each recorded topic."""
_QUEUE = 20000  # Messages of a topic that are kept while the node is busy: 20 s at 1 kHz
_POLL_S = 0.02
"""Time between two commands, s: a tenth of `LONGEST_STEP_S`, by which a command is ahead of the
stage. A command that is late by one turn of the loop is still in time."""
_FAREWELL_S = 0.5
"""Time for which the last command is repeated at the end, s: 25 times, so that a subscriber that
loses messages has it. Until then the stage goes on to an older one."""
_COMMAND_QUEUE = 10
"""Commands that are kept for a slow subscriber: 0.2 s of them; an older one moves nothing any
more."""
_EXAMPLES = {
    'a unit by its parameter file, within limits': (
        '--ros-args --params-file unit.yaml -p limits.rate_deg_s:=10.0 '
        "-p 'limits.beta_deg:=[-90.0,90.0]'"
    )
}
"""Examples of arguments, by their purpose."""


@dataclass(frozen=True)
class InvestigateSettings:
    """The investigation."""

    output: str = parameter(
        'investigation',
        'folder of bag, report and parameters; a number is added where it has a diagnosis',
    )
    alpha_deg: Any = parameter(
        (), 'range of alpha; empty: 0 to 180', 'deg', name='limits.alpha_deg'
    )
    beta_deg: Any = parameter((), 'range of beta; empty: 0 to 360', 'deg', name='limits.beta_deg')
    # The default is that of the bridge, 0.3 rad/s.
    rate_deg_s: float = parameter(
        17.0, 'largest rate of each joint', 'deg/s', 0.1, 180.0, name='limits.rate_deg_s'
    )
    minutes: float = parameter(
        15.0, 'largest time of all manoeuvres together', 'min', 0.5, 240.0, name='limits.minutes'
    )
    seed: int = parameter(0, 'seed of the diagnosis', '', *SEEDS)


def answer_lines(minutes: float, answer: Answer) -> list[str]:
    """Return the probabilities after a diagnosis, and what follows."""
    named = '  '.join(
        f'{hypothesis_text(h.effects)} {percent(h.probability)}'
        for h in answer.hypotheses[:_MOST_NAMED]
    )
    lines = wrap(f'{minutes:5.1f} min  {named}', COLUMNS, subsequent_indent=_INDENT)
    if answer.outcome is RoundOutcome.GO_ON:
        lines += wrap(
            f'next: {CATALOGUE[answer.manoeuvre].text}',
            COLUMNS,
            initial_indent=_INDENT,
            subsequent_indent=_INDENT,
        )
    return lines


def closing_lines(ended: Investigation, folder: OutputFolder) -> list[str]:
    """Return the result, where the files are, and what to do next."""
    files = [str(path) for path in (folder.report, folder.parameters, folder.bag) if path.exists()]
    if ended.state is State.STOPPED:
        return ['', *end_lines([f'Stopped without a verdict: {ended.reason}'], files)]
    words = 'rich', '--params', str(folder.parameters), '-o', str(free_name('sim.csv'))
    return [
        '',
        *end_lines(
            [ended.answers[-1].answer.sentence], files, command('simulate', shlex.join(words))
        ),
    ]


class Investigate(Node):
    """
    The node of the investigation.

    It connects topics to an `Investigation`, records them, and shows what happens.
    """

    def __init__(self) -> None:
        super().__init__('investigate')
        parameter_checks.check_given(self)
        self._sensor = sensor_parameters.make_sensor(sensor_parameters.declare_sensor(self))
        own = parameters.declare_all(self, InvestigateSettings)
        alpha_deg = low_and_high('limits.alpha_deg', own.alpha_deg, (0.0, 180.0))
        beta_deg = low_and_high('limits.beta_deg', own.beta_deg, (0.0, 360.0))
        alpha_rad, beta_rad = np.radians([alpha_deg, beta_deg]).tolist()
        limits = StageLimits(alpha_rad, beta_rad, float(np.radians(own.rate_deg_s)))
        self._commands = topics.create_publisher(self, JointState, 'stage/command', _COMMAND_QUEUE)
        self.create_service(Trigger, '~/abort', self._on_abort)
        self._inboxes = {
            topic: topics.Inbox(self, kind, topic, _QUEUE, latched=topic == 'sensor_info')
            for topic, kind in _KINDS.items()
        }
        self._bag: LiveBag | None = None  # None before sensor and stage are there
        self._has_samples = False
        self._pose: Pose | None = None
        self._diagnostics = topics.DiagnosticsReporter(self, 'investigate', self._status)
        self._folder = OutputFolder.free(Path(own.output))
        self._screen = LiveLine()
        self._investigation = Investigation(
            limits,
            own.minutes,
            BackgroundDiagnoser(self._folder, limits, own.seed),
            lambda minutes, answer: self._screen.add(*answer_lines(minutes, answer)),
            self._flush,
        )
        self._busy_s = time.monotonic()
        self._request = ''
        # A handler of rclpy would end the graph before the stage has its last command.
        for number, name in ((signal.SIGINT, 'Ctrl-C'), (signal.SIGTERM, 'SIGTERM')):
            signal.signal(number, partial(self.request_stop, name))
        ranges = ', '.join(
            f'{joint} {low:.0f} to {high:.0f}°'
            for joint, (low, high) in (('alpha', alpha_deg), ('beta', beta_deg))
        )
        self._screen.add(
            f'Investigation into {self._folder.path}, manoeuvres of '
            f'{own.minutes:g} minutes at most',
            f'Stage within {ranges}, {own.rate_deg_s:.3g}°/s',
            '',
        )
        self.create_timer(_POLL_S, self._poll, clock=topics.STEADY)

    def request_stop(self, name: str, *_: object) -> None:
        """Stop the investigation at the next turn; a signal may come at any time."""
        self._request = name

    def close(self) -> None:
        """Write the end of the bag, and end the screen and the diagnosis."""
        self._investigation.stop('the node has ended')
        if self._bag is not None:
            self._bag.close()
        self._screen.close()

    def _flush(self) -> None:
        """Write the messages so far to the file, for the diagnosis."""
        if self._bag is not None:
            self._bag.flush()

    def _take(self) -> None:
        """Take and record the messages that have come; `sensor_info` waits for the bag."""
        for topic, kind in _KINDS.items():
            if self._bag is None and topic == 'sensor_info':
                continue
            messages = self._inboxes[topic].take()
            if self._bag is not None:
                recorded = (
                    self.resolve_topic_name(topic),
                    f'{kind.__module__.partition(".")[0]}/msg/{kind.__name__}',
                )
                for message in messages:
                    self._bag.write(*recorded, message, time.time_ns())
            if topic == _STAGE:
                for reading in topics.joint_readings(messages):
                    if np.isfinite(reading.angles).all():
                        self._pose = Pose(*reading.angles)
            self._has_samples |= topic == _SAMPLES and bool(messages)

    def _poll(self) -> None:
        run = self._investigation
        if self._request:
            run.stop(self._request)
        self._take()
        if not run.has_ended:
            self._check_streams(run)
        now = self.get_clock().now()
        command = run.step(now.nanoseconds * 1e-9, self._pose) if now.nanoseconds else None
        if command is not None:
            self._commands.publish(
                JointState(
                    header=Header(stamp=now.to_msg()),
                    name=['alpha', 'beta'],
                    position=list(command),
                    velocity=list(run.speed or ()),
                )
            )
        left = f', {run.remaining_s:.0f} s left' if run.state is State.MOVING else ''
        self._screen.show(f'{run.minutes:5.1f} min{left}  {run.text}'[:COLUMNS])
        now_s = time.monotonic()
        if not run.has_ended:
            self._busy_s = now_s
        elif now_s - self._busy_s > _FAREWELL_S:
            # The stage has its last command.
            self.close()
            self._screen.add(*closing_lines(run, self._folder))
            raise SystemExit(0 if run.has_verdict else 1)

    def _check_streams(self, run: Investigation) -> None:
        """Stop where sensor or stage is silent; wait for both at the beginning."""
        if run.state is not State.RECORDING:
            for topic in (_SAMPLES, _STAGE):
                if silence := self._inboxes[topic].silence():
                    run.stop(f'{silence}; the stage holds its pose')
        elif not self._has_samples:
            self._pose = None
        elif self._pose is not None and self._bag is None:
            self._folder.make(self._sensor)
            self._bag = LiveBag(self._folder.bag)

    def _on_abort(self, *_: object) -> Trigger.Response:
        self._request = '~/abort was called'
        return Trigger.Response(success=True, message='stopped; the stage holds its pose')

    def _status(self) -> Status:
        run = self._investigation
        level = Level.WARN if run.state in (State.STOPPED, State.RECORDING) else Level.OK
        values = {'state': run.state.value, 'minutes': run.minutes}
        if run.answers:
            best = run.answers[-1].answer.hypotheses[0]
            values |= {
                'hypothesis': ' '.join(best.effects) or 'no gap',
                'probability': best.probability,
            }
        return Status(level, run.text, self._sensor.serial, values)


def main() -> int:
    """Run the node."""
    return run(Investigate, __doc__, _EXAMPLES)
