# SPDX-License-Identifier: Apache-2.0

"""
The investigation of a stage: its diagnoses, and the state machine that asks for them.

A round diagnoses the samples so far in a process of its own, and names the manoeuvre that is
expected to tell most per minute. `Investigation` goes from round to round, free of ROS:

    RECORDING → DIAGNOSING → MOVING → DIAGNOSING → … → FINISHED
    every state → STOPPED

RECORDING waits for the sensor and the stage. In MOVING the stage follows a manoeuvre. In
DIAGNOSING it rests while the samples so far are diagnosed in the background. Samples are recorded
in all states. FINISHED has a verdict or has used its time; STOPPED was ended from outside.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from enum import Enum
from itertools import accumulate, chain, count
import os
from pathlib import Path
import shutil
from typing import TYPE_CHECKING

from adxl_ros.diagnose import next_experiment
from adxl_ros.diagnose.linear_model import LinearModel
from adxl_ros.diagnose.verdict import normalised, UNKNOWN, WeightedHypothesis
from adxl_ros.errors import one_line, UserError
from adxl_ros.files import parameter_file, recording as recording_files
from adxl_ros.files.atomic_write import write_text
from adxl_ros.files.recording_columns import Recording
from adxl_ros.investigate.manoeuvres import (
    CATALOGUE,
    CommandStream,
    plan,
    plan_all,
    PlannedManoeuvre,
    Pose,
    StageLimits,
)
from adxl_ros.model.effects import library
from adxl_ros.model.sensor import Sensor
from adxl_ros.report import quantities
from adxl_ros.workers import in_background
import numpy as np

if TYPE_CHECKING:
    from adxl_ros.api.gap import Gap

CERTAIN = 0.9
"""Probability of a hypothesis at which an investigation ends. Chosen: one error in ten."""
_NOTHING = 0.6
"""Prior probability of no gap; a single effect is as probable. Chosen: most units are healthy."""
_SMALLEST_PER_MINUTE = 0.01
"""Expected information per minute, nat/min, below which no manoeuvre separates anything. Chosen:
ten minutes then change even odds by a tenth."""
_LARGEST_NAMED = 4
"""Largest number of hypotheses in a sentence. Chosen: a reader keeps four in mind."""


class RoundOutcome(Enum):
    """
    Why an investigation goes on or ends.

    GO_ON: another manoeuvre follows. CERTAIN: a hypothesis has 90 %. NO_VISIBLE_GAP, INSEPARABLE:
    no manoeuvre of this stage changes that there is no gap, or separates what remains. TIME_OVER:
    the time does not suffice for a manoeuvre.
    """

    GO_ON = 'go_on'
    CERTAIN = 'certain'
    NO_VISIBLE_GAP = 'no_visible_gap'
    INSEPARABLE = 'inseparable'
    TIME_OVER = 'time_over'


Hypotheses = tuple[WeightedHypothesis, ...]
"""Hypotheses by falling probability, which sums to 1; no effect means no gap."""


@dataclass(frozen=True)
class Question:
    """What a round begins with."""

    pose: Pose  # Pose of the stage
    minutes: float  # Time since the first sample, min
    remaining_minutes: float  # Time that remains for manoeuvres, min
    has_samples: bool  # Whether there are samples to diagnose
    recorded: tuple[str, ...] = ()  # Names of the manoeuvres that have been recorded
    verdict: str = ''  # Verdict of the round before; '' for none


@dataclass(frozen=True)
class Answer:
    """What a round ends with."""

    hypotheses: Hypotheses
    outcome: RoundOutcome  # Why the investigation goes on or ends
    sentence: str = ''  # The result in one sentence; '' where it goes on
    manoeuvre: str = ''  # Name of the next manoeuvre; '' at the end
    fault: str = ''  # Fault of the recording that makes a verdict impossible; '' without one
    verdict: str = ''  # Status and effects of the diagnosis; '' without a verdict


def run_round(
    question: Question,
    recordings: Sequence[Recording],
    sensor: Sensor,
    limits: StageLimits,
    seed: int = 0,
) -> tuple[Answer, Gap | None]:
    """Diagnose the samples so far, and choose the next manoeuvre."""
    from adxl_ros.api.gap import diagnose  # the node itself needs none

    gap = diagnose(recordings, sensor, seed=seed) if recordings else None
    report = gap.diagnosis.report if gap else None
    # The prior probabilities, where the samples are too few.
    hypotheses = (
        report.verdict.hypotheses
        if report
        else normalised({(): _NOTHING, (UNKNOWN,): 1 - _NOTHING})
    )
    fault = gap.diagnosis.fault if gap else None
    if fault is not None and fault.status != 'insufficient':
        return Answer(hypotheses, RoundOutcome.INSEPARABLE, fault=fault.message), gap
    verdict = ' '.join([report.verdict.status, *report.verdict.effects]) if report else ''
    best = hypotheses[0]
    if best.effects and best.probability >= CERTAIN:
        # Effects that were not seen so far only take probability from no gap, so that the
        # manoeuvres need not be simulated.
        return decide(hypotheses, (), question, True, verdict), gap
    manoeuvres = plan_all(limits, question.pose, 60 * question.minutes)
    in_time = [m for m in manoeuvres if m.minutes <= question.remaining_minutes]
    ranked = rank(
        hypotheses, report.linear_model if report else None, sensor, in_time or manoeuvres
    )
    return decide(*ranked, question, bool(in_time), verdict), gap


def rank(
    hypotheses: Hypotheses,
    model: LinearModel | None,
    sensor: Sensor,
    manoeuvres: Sequence[PlannedManoeuvre],
) -> tuple[Hypotheses, tuple[next_experiment.ManoeuvreWorth, ...]]:
    """
    Rank manoeuvres by their expected information per minute, the best first.

    model: that of the samples so far, None without any. The hypotheses then have the effects that
    only the manoeuvres can show, too.
    """
    seen = {v.effect for v in model.variants} if model else set()
    leading = next_experiment.leading(hypotheses)
    considered = set(chain.from_iterable(h.effects for h in leading))
    needed = sorted(considered | (set(library()) - seen))
    responses = [
        next_experiment.predict(m.name, m.motion, m.begin_s, sensor, needed) for m in manoeuvres
    ]
    variants = chain.from_iterable(response.linear_model.variants for response in responses)
    excited = {v.effect for v in variants}
    # Effects that the samples could not show keep their prior odds over no gap.
    weights = {h.effects: h.probability for h in hypotheses}
    unseen = weights.get((), 0.0) * (1 / max(len(excited | seen), 1))
    for effect in sorted(excited - seen):
        weights.setdefault((effect,), unseen)
    hypotheses = normalised(weights)
    return hypotheses, next_experiment.rank_responses(responses, hypotheses, model)


def decide(
    hypotheses: Hypotheses,
    worth: Sequence[next_experiment.ManoeuvreWorth],
    question: Question,
    has_time: bool,
    verdict: str = '',
) -> Answer:
    """
    Choose the next manoeuvre, or end.

    A verdict that was the same in the round before is not expected to change by more of the same:
    only manoeuvres of a kind that is not recorded yet follow it.
    """
    best = hypotheses[0]
    kinds = (
        {CATALOGUE[name].kind for name in question.recorded}
        if verdict and verdict == question.verdict
        else set()
    )
    following = [
        w
        for w in worth
        if w.per_minute > _SMALLEST_PER_MINUTE and CATALOGUE[w.name].kind not in kinds
    ]
    totals = accumulate(hypothesis.probability for hypothesis in hypotheses)
    # The fewest that together have 90 %
    named = hypotheses[: next((i for i, total in enumerate(totals, 1) if total >= CERTAIN), None)]
    if best.effects and best.probability >= CERTAIN:
        outcome = RoundOutcome.CERTAIN
    elif not following and not best.effects:
        # The samples prefer no gap to each of these effects, so that they do not show it.
        outcome = RoundOutcome.NO_VISIBLE_GAP
        named = tuple(h for h in hypotheses if len(h.effects) < 2 and UNKNOWN not in h.effects)
    elif not following:
        outcome = RoundOutcome.INSEPARABLE
    elif not has_time:
        outcome = RoundOutcome.TIME_OVER
    else:
        return Answer(hypotheses, RoundOutcome.GO_ON, manoeuvre=following[0].name, verdict=verdict)
    names = first_or_others([hypothesis_text(h.effects) for h in named])
    sentence = {
        RoundOutcome.CERTAIN: f'The recording shows {names}: ',
        RoundOutcome.NO_VISIBLE_GAP: 'There is no gap that this stage can show: ',
        RoundOutcome.INSEPARABLE: f'This stage cannot separate {names}: together ',
        RoundOutcome.TIME_OVER: f'The time is over; the recording shows {names}: together ',
    }
    return Answer(
        hypotheses,
        outcome,
        f'{sentence[outcome]}{100 * sum(h.probability for h in named):.0f} %.',
        verdict=verdict,
    )


def hypothesis_text(effects: Sequence[str]) -> str:
    """Return a hypothesis for people."""
    if not effects:
        return 'no gap'
    # What is unknown stands at the end.
    named = [effect for effect in effects if effect != UNKNOWN]
    if UNKNOWN in effects:
        named.append('something unknown')
    return ' with '.join(named)


def first_or_others(names: Sequence[str]) -> str:
    """Return the first names in a sentence, and how many others there are."""
    shown = list(names[:_LARGEST_NAMED])
    others = len(names) - _LARGEST_NAMED
    if others > 0:
        shown.append(f'{others} others')
    return quantities.listed(shown, 'or')


_NICENESS = 10  # Niceness of the process. Chosen: the node that records comes first
_WITHOUT_DIAGNOSIS = {'bag', 'baseline.yaml'}
"""Files of an investigation that was stopped before its first diagnosis of samples."""


class OutputFolder:
    """The folder of an investigation."""

    def __init__(self, path: Path) -> None:
        self.path = path  # The folder
        self.bag = path / 'bag'  # The recording, a rosbag2 directory
        self.baseline = path / 'baseline.yaml'  # What the recording is compared with
        self.parameters = path / 'params.yaml'  # The parameters with the effects that were found
        self.report = path / 'report.html'  # The page of the diagnosis

    @staticmethod
    def free(path: Path) -> OutputFolder:
        """Return the first of `path`, `path_2`, ... that has nothing, or no diagnosis yet."""
        candidates = chain([path], (path.with_name(f'{path.name}_{n}') for n in count(2)))
        return next(
            OutputFolder(p)
            for p in candidates
            if not p.exists()
            or (p.is_dir() and {child.name for child in p.iterdir()} <= _WITHOUT_DIAGNOSIS)
        )

    def make(self, sensor: Sensor) -> None:
        """Make the folder, and write the baseline; an investigation without diagnosis goes."""
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            if self.bag.exists():
                shutil.rmtree(self.bag)
        except OSError as error:
            raise UserError(
                f'{self.path}: cannot make the folder: {error.strerror}; set output to another one'
            ) from None
        parameter_file.save(self.baseline, sensor)


class BackgroundDiagnoser:
    """Diagnoses the bag of a folder in a process of its own."""

    def __init__(self, folder: OutputFolder, limits: StageLimits, seed: int) -> None:
        self._folder = folder
        self._limits = limits
        self._seed = seed
        self._answer: Future | None = None
        self.cancel: Callable[[], object] = lambda: None  # Ends the process

    def ask(self, question: Question) -> None:
        """Start the process."""
        self._answer, self.cancel = in_background(
            _diagnose, self._folder, question, self._limits, self._seed
        )

    def answer(self) -> Answer | None:
        """Return the answer, or None while the process runs."""
        if self._answer is None or not self._answer.done():
            return None
        ended = self._answer
        self._answer = None
        try:
            return ended.result()
        except Exception as error:
            raise UserError(f'the diagnosis failed: {one_line(error)}') from error


def _diagnose(folder: OutputFolder, question: Question, limits: StageLimits, seed: int) -> Answer:
    """Answer one question, and write the files of its diagnosis."""
    os.nice(_NICENESS)
    sensor = parameter_file.load(folder.baseline)
    recordings = [recording_files.read(folder.bag)] if question.has_samples else []
    answer, gap = run_round(question, recordings, sensor, limits, seed)
    if gap is not None:
        # The page is that of the end.
        gap = replace(gap, compared=gap.compared.with_params(str(folder.baseline)))
        texts = gap.documents(folder.path, has_page=answer.outcome is not RoundOutcome.GO_ON)
        for name, text in texts.items():
            write_text(folder.path / name, text)
    return answer


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


class Investigation:
    """The state machine."""

    def __init__(
        self,
        limits: StageLimits,
        longest_minutes: float,
        diagnoser: BackgroundDiagnoser,
        show: Callable[[float, Answer], None] = lambda minutes, answer: None,
        flush: Callable[[], None] = lambda: None,
    ) -> None:
        """Wait for sensor and stage."""
        self.state = State.RECORDING  # The state
        # Answers so far, each with the minutes at which its question was asked
        self.answers: list[tuple[float, Answer]] = []
        self.reason = ''  # Why it was stopped; '' otherwise
        self._limits = limits
        self._longest_s = 60 * longest_minutes
        self._diagnoser = diagnoser
        self._show = show
        self._flush = flush
        self._begin_s: float | None = None
        self.moved_s = 0.0  # Time of the manoeuvres so far, s
        self._now_s = self._since_s = self._asked_minutes = 0.0
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
        return (
            self.state is State.FINISHED
            and bool(self.answers)
            and self.answers[-1][1].outcome not in (RoundOutcome.GO_ON, RoundOutcome.TIME_OVER)
        )

    @property
    def speed(self) -> Pose | None:
        """Return the speed on the way to the newest command, rad/s; None at its end."""
        return None if self._stream is None or self._stream.is_done else self._stream.speed

    @property
    def text(self) -> str:
        """Return what it does, for people."""
        return {
            State.RECORDING: 'waiting for samples and stage',
            State.DIAGNOSING: 'diagnosing the samples so far; the stage rests',
            State.MOVING: CATALOGUE[self._manoeuvre].text if self._manoeuvre else '',
            State.FINISHED: 'finished',
            State.STOPPED: f'stopped: {self.reason}',
        }[self.state]

    @property
    def minutes(self) -> float:
        """Return the time since its beginning, min."""
        return 0.0 if self._begin_s is None else (self._now_s - self._begin_s) / 60

    @property
    def remaining_s(self) -> float:
        """Return the time to the end of a manoeuvre, s; 0 in other states."""
        return self._stream.remaining_s if self._stream else 0.0

    def step(self, now_s: float, pose: Pose | None) -> Pose | None:
        """Go on."""
        elapsed_s = now_s - self._now_s
        self._now_s = now_s
        self._pose = pose
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
            self.state = State.STOPPED
            self.reason = reason
            self._diagnoser.cancel()
            self._hold()
        return self._command

    def _hold(self) -> None:
        """Command the present pose, if the stage has been commanded before."""
        self._stream = None
        if self._command is not None and self._pose is not None:
            self._command = self._limits.nearest(*self._pose)

    def _record(self, now_s: float, pose: Pose) -> None:
        """Wait until the stage has been there for a while; refuse a stage outside its limits."""
        if now_s - self._since_s < _FIRST_REST_S:
            return
        if np.abs(np.subtract(pose, self._limits.nearest(*pose))).max() > _OUTSIDE_RAD:
            self.stop(
                f'the stage is at {_text(pose)}, outside of its limits; move it, or set '
                'limits.alpha_deg and limits.beta_deg'
            )
            return
        self._begin_s = now_s
        self._ask(pose)

    def _ask(self, pose: Pose) -> None:
        """Ask for a diagnosis of the samples so far."""
        assert self._begin_s is not None
        self.state = State.DIAGNOSING
        self._stream = None
        self._asked_minutes = self.minutes
        self._flush()
        self._diagnoser.ask(
            Question(
                pose=self._command or self._limits.nearest(*pose),
                minutes=self._asked_minutes,
                remaining_minutes=max(self._longest_s - self.moved_s, 0.0) / 60,
                has_samples=bool(self.answers),
                recorded=tuple(answer.manoeuvre for _, answer in self.answers),
                verdict=self.answers[-1][1].verdict if self.answers else '',
            )
        )

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
        if answer.outcome is not RoundOutcome.GO_ON:
            self.state = State.FINISHED
            return
        assert self._pose is not None
        begin = self._command or self._limits.nearest(*self._pose)
        self._manoeuvre = answer.manoeuvre
        self._stream = CommandStream(
            self._limits, plan(answer.manoeuvre, self._limits, begin), begin
        )
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
                self.stop(
                    f'the stage has not followed its command for {_LONGEST_WAIT_S:.0f} s: '
                    f'it is at {_text(pose)}, commanded {_text(self._command)}; check the '
                    'stage, or lower limits.rate_deg_s'
                )
        elif self._now_s - self._since_s > _SETTLING_S:
            self._ask(pose)


def _text(pose: Pose) -> str:
    """Return a pose for people."""
    alpha_deg, beta_deg = np.degrees(pose)
    return f'alpha {alpha_deg:.1f}°, beta {beta_deg:.1f}°'
