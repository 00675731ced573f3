# SPDX-License-Identifier: Apache-2.0

"""The states of an investigation, with answers that the test gives."""

from adxl_ros.diagnose.verdict import WeightedHypothesis
from adxl_ros.errors import UserError
from adxl_ros.investigate.investigation import Answer, Investigation, RoundOutcome, State
from adxl_ros.investigate.manoeuvres import Pose, StageLimits
import numpy as np
import pytest

LIMITS = StageLimits((0.0, np.pi), (0.0, 2 * np.pi), 0.5)
GO_ON = Answer((WeightedHypothesis((), 0.6),), RoundOutcome.GO_ON, manoeuvre='rests_upright')
CERTAIN = Answer(
    (WeightedHypothesis(('lever_arm',), 0.97),), RoundOutcome.CERTAIN, 'It is lever_arm.'
)
TIME_OVER = Answer((WeightedHypothesis((), 0.6),), RoundOutcome.TIME_OVER, 'The time is over.')


STEP_S = 0.02  # Time between two looks of the node
LOOKS = 50  # Looks at a diagnosis until it answers: one second


class Answers:
    """A diagnosis that answers what it is given, after a while."""

    def __init__(self, *answers):
        self.answers = list(answers)
        self.questions = []
        self.wait = 0  # Looks that are left
        self.is_cancelled = False

    def ask(self, question):
        self.questions.append(question)
        self.wait = LOOKS

    def answer(self):
        self.wait -= 1
        if self.wait > 0:
            return None
        answer = self.answers.pop(0)
        if isinstance(answer, UserError):
            raise answer
        return answer

    def cancel(self):
        self.is_cancelled = True


class Stage:
    """A stage that follows its command within a time step, unless it is stuck."""

    def __init__(self, investigation):
        self.investigation = investigation
        self.pose = Pose(0.0, 0.0)
        self.now_s = 1000.0
        self.commands = []
        self.is_stuck = False

    def run(self, until, longest_s=2000.0):
        end_s = self.now_s + longest_s
        while not until():
            assert self.now_s < end_s, self.investigation.text
            self.now_s += STEP_S
            command = self.investigation.step(self.now_s, self.pose)
            if command is not None:
                self.commands.append(command)
                self.pose = self.pose if self.is_stuck else command


def started(*answers, minutes=10.0):
    diagnoser = Answers(*answers)
    investigation = Investigation(LIMITS, minutes, diagnoser)
    return investigation, Stage(investigation), diagnoser


def test_it_diagnoses_and_moves_in_turn_until_a_hypothesis_is_certain():
    investigation, stage, diagnoser = started(GO_ON, GO_ON, CERTAIN)
    states = []

    def has_ended():
        if not states or states[-1] is not investigation.state:
            states.append(investigation.state)
        return investigation.has_ended

    stage.run(has_ended)
    assert states == [
        State.RECORDING,
        State.DIAGNOSING,
        State.MOVING,
        State.DIAGNOSING,
        State.MOVING,
        State.DIAGNOSING,
        State.FINISHED,
    ]
    assert investigation.has_verdict
    assert [q.has_samples for q in diagnoser.questions] == [False, True, True]
    assert diagnoser.questions[1].minutes > diagnoser.questions[0].minutes
    assert diagnoser.questions[1].remaining_minutes < 10
    assert all(LIMITS.nearest(*c) == c for c in stage.commands)


def test_a_stop_holds_the_pose_of_the_stage():
    investigation, stage, diagnoser = started(GO_ON, CERTAIN)
    stage.run(lambda: investigation.state is State.MOVING and stage.now_s > 1010)
    stage.is_stuck = True
    stage.pose = Pose(0.3, 0.4)
    stage.run(lambda: stage.now_s > 1012)
    assert investigation.stop('Ctrl-C') == (0.3, 0.4)
    assert investigation.step(stage.now_s + 1, Pose(0.31, 0.41)) == (0.3, 0.4)
    assert diagnoser.is_cancelled
    assert not investigation.has_verdict
    assert 'Ctrl-C' in investigation.text


def test_a_stage_that_does_not_follow_is_left_alone():
    investigation, stage, _ = started(GO_ON, CERTAIN)
    stage.is_stuck = True
    stage.run(lambda: investigation.has_ended, 60)
    assert investigation.state is State.STOPPED
    assert 'has not followed' in investigation.reason
    assert stage.commands[-1] == stage.pose


def test_the_time_is_a_limit():
    investigation, stage, diagnoser = started(GO_ON, GO_ON, TIME_OVER, minutes=1.0)
    stage.run(lambda: investigation.has_ended)
    assert investigation.state is State.FINISHED
    assert not investigation.has_verdict
    assert diagnoser.questions[-1].remaining_minutes == 0
    moves = np.any(np.diff(stage.commands, axis=0) != 0, axis=1)
    assert moves.sum() * STEP_S < 60, 'it moves for less than the minute'


@pytest.mark.parametrize(
    'answer, reason',
    [
        (UserError('the bag is gone'), 'the bag is gone'),
        (
            Answer((), RoundOutcome.INSEPARABLE, fault='axis x is inverted'),
            'axis x is inverted',
        ),
    ],
)
def test_a_failed_diagnosis_stops_it(answer, reason):
    investigation, stage, _ = started(GO_ON, answer)
    stage.run(lambda: investigation.has_ended)
    assert investigation.state is State.STOPPED
    assert investigation.reason == reason
