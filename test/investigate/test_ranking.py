# SPDX-License-Identifier: Apache-2.0

"""The manoeuvre that is chosen separates what remains."""

from dataclasses import replace
from functools import cache

from adxl_ros.diagnose.next_experiment import ManoeuvreWorth
from adxl_ros.diagnose.verdict import WeightedHypothesis
from adxl_ros.investigate.investigation import (
    decide,
    Question,
    rank,
    RoundOutcome,
    run_round,
)
from adxl_ros.investigate.manoeuvres import CATALOGUE, plan, plan_all, Pose, StageLimits
import numpy as np
import pytest
from units import nominal

LIMITS = StageLimits((0.0, np.pi), (0.0, 2 * np.pi), 0.5)
SENSOR = nominal(rate_hz=62.5)
FIRST = Question(Pose(0.0, 0.0), 0.0, 10.0, False)


BEYOND = ('saturation',)
"""An effect that acts beyond the force that a stage gives: it predicts what no gap predicts."""


def between(*hypotheses):
    return tuple(WeightedHypothesis(h, 1 / len(hypotheses)) for h in hypotheses)


def planned(*names):
    return [plan(name, LIMITS, Pose(1.5, 0.0)) for name in names]


def told_nothing(information=0.0):
    return ManoeuvreWorth('rests_upright', 1.0, information)


@cache
def first_round():
    """Return answer and diagnosis of a round of ten minutes without samples."""
    return run_round(FIRST, [], SENSOR, LIMITS)


@pytest.mark.long
def test_fast_turns_show_an_arm_better_than_rests_and_slow_turns():
    names = ('rests_on_axes', 'fast_turn_of_beta', 'slow_turn_of_beta')
    _, worth = rank(between(BEYOND, ('lever_arm',)), None, SENSOR, planned(*names))
    information = {w.name: w.information for w in worth}
    assert information['fast_turn_of_beta'] > information['rests_on_axes']
    assert information['fast_turn_of_beta'] > information['slow_turn_of_beta']


@pytest.mark.long
@pytest.mark.xdist_group('first_round')
def test_a_manoeuvre_that_does_not_fit_in_the_time_is_not_chosen():
    pose = Pose(0.0, 0.0)
    minutes = {m.name: m.minutes for m in plan_all(LIMITS, pose)}
    shortest = min(minutes, key=minutes.get)
    fits, _ = run_round(Question(pose, 0.0, minutes[shortest] + 1e-6, False), [], SENSOR, LIMITS)
    none_fits, _ = run_round(
        Question(pose, 0.0, minutes[shortest] - 1e-6, False), [], SENSOR, LIMITS
    )
    assert fits.manoeuvre == shortest
    assert (none_fits.manoeuvre, none_fits.outcome) == ('', RoundOutcome.TIME_OVER)


def test_a_round_without_time_left_ends():
    decision = decide(between((), ('hysteresis',)), (told_nothing(1.0),), FIRST, False)
    assert decision.outcome is RoundOutcome.TIME_OVER


@pytest.mark.parametrize(
    'probability, outcome', [(0.96, RoundOutcome.CERTAIN), (0.85, RoundOutcome.GO_ON)]
)
def test_90_percent_of_a_hypothesis_is_a_verdict(probability, outcome):
    hypotheses = (
        WeightedHypothesis(('hysteresis',), probability),
        WeightedHypothesis((), 1 - probability),
    )
    decision = decide(hypotheses, (told_nothing(1.0),), FIRST, True)
    assert decision.outcome is outcome
    if outcome is RoundOutcome.CERTAIN:
        assert decision.sentence == 'The recording shows hysteresis: 96 %.'


def test_a_verdict_that_stays_after_every_kind_of_manoeuvre_ends_it():
    """The manoeuvres still promise much, as where the probability of no gap has a ceiling."""
    hypotheses = (WeightedHypothesis((), 0.8), WeightedHypothesis(('gravity',), 0.2))
    worth = tuple(ManoeuvreWorth(m.name, m.minutes, 1.0) for m in plan_all(LIMITS, Pose(1.5, 0.0)))
    question, recorded = FIRST, []
    while (answer := decide(hypotheses, worth, question, True, 'no_gap')).manoeuvre:
        recorded.append(answer.manoeuvre)
        question = replace(FIRST, recorded=tuple(recorded), verdict=answer.verdict)
    kinds = {m.kind for m in CATALOGUE.values()}
    assert {CATALOGUE[name].kind for name in recorded} == kinds
    assert len(recorded) == len(kinds)
    assert answer.outcome is RoundOutcome.NO_VISIBLE_GAP
    changed = decide(hypotheses, worth, replace(question, verdict='unknown'), True, 'no_gap')
    assert changed.outcome is RoundOutcome.GO_ON


@pytest.mark.long
@pytest.mark.xdist_group('first_round')
def test_the_first_round_needs_no_samples():
    answer, diagnosis = first_round()
    assert diagnosis is None
    assert answer.outcome is RoundOutcome.GO_ON
    assert sum(h.probability for h in answer.hypotheses) == pytest.approx(1)
