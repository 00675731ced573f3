# SPDX-License-Identifier: Apache-2.0

"""
The investigation as a state machine, free of ROS.

    RECORDING → DIAGNOSING → MOVING → DIAGNOSING → … → FINISHED
    every state → STOPPED

RECORDING waits for the sensor and the stage. In MOVING the stage follows a manoeuvre. In
DIAGNOSING it rests while the samples so far are diagnosed in the background. Samples are recorded
in all states. FINISHED has a verdict or has used its time; STOPPED was ended from outside.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from adxl_ros.errors import UserError
from adxl_ros.investigate import diagnosis_round
from adxl_ros.investigate.diagnosis_round import Answer, Outcome
from adxl_ros.investigate.manoeuvres import CATALOGUE, CommandStream, plan, Pose, StageLimits
import numpy as np

_FIRST_REST_S = 1.0
"""Time for which samples and stage are there before the first question, s. Chosen: both topics
have been discovered."""
_SETTLING_S = 1.0
"""Time at rest between a manoeuvre and its diagnosis, s. Chosen: a stage has settled."""
_LONGEST_WAIT_S = 15.0
"""Time that a stage may need to follow a command, s. Chosen: the slowest stages creep."""
_OUTSIDE_RAD = 0.02
"""Distance beyond a limit at which a stage counts as outside, rad. Chosen: above the error of an
encoder's zero."""


class State(Enum):
    """The states; the module describes them."""

    RECORDING = 'recording'
    DIAGNOSING = 'diagnosing'
    MOVING = 'moving'
    FINISHED = 'finished'
    STOPPED = 'stopped'


@dataclass(frozen=True)
class Status:
    """What an investigation does."""

    state: State  # Its state
    text: str  # What happens, for people
    minutes: float  # Time since its beginning, min
    remaining_s: float  # Time to the end of a manoeuvre, s; 0 in other states


class Investigation:
    """The state machine."""

    def __init__(self, limits: StageLimits, longest_minutes: float,
                 diagnoser: diagnosis_round.BackgroundDiagnoser,
                 show: Callable[[float, Answer], None] = lambda minutes, answer: None,
                 flush: Callable[[], None] = lambda: None) -> None:
        """Wait for sensor and stage."""
        self.state = State.RECORDING  # The state
        # Answers so far, each with the minutes at which its question was asked
        self.answers: list[tuple[float, Answer]] = []
        self.reason = ''  # Why it was stopped; '' otherwise
        self._limits, self._longest_s = limits, 60 * longest_minutes
        self._diagnoser, self._show, self._flush = diagnoser, show, flush
        self._begin_s: float | None = None
        self.moved_s = 0.0  # Time of the manoeuvres so far, s
        self._now_s = self._since_s = 0.0
        self._asked_minutes = 0.0
        self._pose: Pose | None = None
        self._command: Pose | None = None
        self._stream: CommandStream | None = None
        self._manoeuvre = ''

    @property
    def has_ended(self) -> bool:
        """Return whether it is over."""
        return self.state in (State.FINISHED, State.STOPPED)

    @property
    def has_verdict(self) -> bool:
        """Return whether it has come to a verdict."""
        return self.state is State.FINISHED and bool(self.answers) \
            and self.answers[-1][1].outcome not in (Outcome.GO_ON, Outcome.TIME_OVER)

    @property
    def speed(self) -> Pose | None:
        """Return the speed on the way to the newest command, rad/s; None at its end."""
        return None if self._stream is None or self._stream.is_done else self._stream.speed

    def status(self) -> Status:
        """Return what it does."""
        texts = {State.RECORDING: 'waiting for samples and stage',
                 State.DIAGNOSING: 'diagnosing the samples so far; the stage rests',
                 State.MOVING: CATALOGUE[self._manoeuvre].text if self._manoeuvre else '',
                 State.FINISHED: 'finished', State.STOPPED: f'stopped: {self.reason}'}
        remaining_s = self._stream.remaining_s if self._stream else 0.0
        return Status(self.state, texts[self.state], self._minutes(), remaining_s)

    def step(self, now_s: float, pose: Pose | None) -> Pose | None:
        """Go on."""
        elapsed_s, self._now_s, self._pose = now_s - self._now_s, now_s, pose
        if pose is None or self.has_ended:
            self._since_s = now_s
            return self._command
        if self.state is State.RECORDING:
            self._record(now_s, pose)
        elif self.state is State.DIAGNOSING:
            self._take_answer()
        else:
            self._move(elapsed_s, pose)
        return self._command

    def stop(self, reason: str) -> Pose | None:
        """Stop, and hold the present pose."""
        if not self.has_ended:
            self.state, self.reason = State.STOPPED, reason
            self._diagnoser.cancel()
            self._hold()
        return self._command

    def _minutes(self) -> float:
        return 0.0 if self._begin_s is None else (self._now_s - self._begin_s) / 60

    def _hold(self) -> None:
        """Command the present pose, if the stage has been commanded before."""
        self._stream = None
        if self._command is not None and self._pose is not None:
            self._command = self._limits.nearest(*self._pose)

    def _record(self, now_s: float, pose: Pose) -> None:
        """Wait until the stage has been there for a while; refuse a stage outside its limits."""
        if now_s - self._since_s < _FIRST_REST_S:
            return
        if self._limits.excess_rad(pose) > _OUTSIDE_RAD:
            self.stop(f'the stage is at {_text(pose)}, outside of its limits; move it, or set '
                      'limits.alpha_deg and limits.beta_deg')
            return
        self._begin_s = now_s
        self._ask(pose)

    def _ask(self, pose: Pose) -> None:
        """Ask for a diagnosis of the samples so far."""
        assert self._begin_s is not None
        self.state, self._stream = State.DIAGNOSING, None
        self._asked_minutes = self._minutes()
        self._flush()
        self._diagnoser.ask(diagnosis_round.Question(
            self._command or self._limits.nearest(*pose), self._asked_minutes,
            max(self._longest_s - self.moved_s, 0.0) / 60, bool(self.answers),
            tuple(answer.manoeuvre for _, answer in self.answers),
            self.answers[-1][1].verdict if self.answers else ''))

    def _take_answer(self) -> None:
        """Take the answer if there is one, and follow it."""
        try:
            answer = self._diagnoser.answer()
        except UserError as error:
            self.stop(str(error))
            return
        if answer is None:
            return
        if answer.fault:
            self.stop(answer.fault)
            return
        self.answers.append((self._asked_minutes, answer))
        self._show(self._asked_minutes, answer)
        if answer.outcome is not Outcome.GO_ON:
            self.state = State.FINISHED
            return
        assert self._pose is not None
        begin = self._command or self._limits.nearest(*self._pose)
        self._manoeuvre = answer.manoeuvre
        self._stream = CommandStream(
            self._limits, plan(answer.manoeuvre, self._limits, begin), begin)
        self.state = State.MOVING

    def _move(self, elapsed_s: float, pose: Pose) -> None:
        """Command the next step; diagnose when the stage has settled at the end."""
        stream = self._stream
        assert stream is not None
        self.moved_s += elapsed_s
        if self.moved_s > self._longest_s:
            self._hold()
            self._ask(pose)
            return
        if not stream.is_done:
            self._since_s = self._now_s
            self._command = stream.advance(elapsed_s, pose)
            if stream.waited_s > _LONGEST_WAIT_S:
                self.stop(f'the stage has not followed its command for {_LONGEST_WAIT_S:.0f} s: '
                          f'it is at {_text(pose)}, commanded {_text(self._command)}; check the '
                          'stage, or lower limits.rate_deg_s')
        elif self._now_s - self._since_s > _SETTLING_S:
            self._ask(pose)


def _text(pose: Pose) -> str:
    """Return a pose for people."""
    alpha_deg, beta_deg = np.degrees(pose)
    return f'alpha {alpha_deg:.1f}°, beta {beta_deg:.1f}°'
