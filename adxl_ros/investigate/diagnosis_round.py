# SPDX-License-Identifier: Apache-2.0

"""One round of an investigation: samples so far in, probabilities and the next manoeuvre out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

from adxl_ros.diagnose.diagnosis import diagnose, Diagnosis
from adxl_ros.diagnose.linear_model import candidates
from adxl_ros.diagnose.next_experiment import (
    Experiment,
    leading,
    ManoeuvreWorth,
    predict,
    rank_responses,
    unknown_dimensions,
)
from adxl_ros.diagnose.noise_effects import UNKNOWN
from adxl_ros.diagnose.verdict import normalised, WeightedHypothesis
from adxl_ros.files.recording_columns import Recording
from adxl_ros.investigate.manoeuvres import KIND_OF, plan_all, PlannedManoeuvre, Pose, StageLimits
from adxl_ros.model.effects import library
from adxl_ros.model.sensor import Sensor

CERTAIN = 0.9
"""Probability of a hypothesis at which an investigation ends. Chosen: one error in ten."""
_NOTHING = 0.6
"""Prior probability of no gap; a single effect is as probable. Chosen: most units are healthy."""
_SMALLEST_PER_MINUTE = 0.01
"""Expected information per minute, nat/min, below which no manoeuvre separates anything. Chosen:
ten minutes then change even odds by a tenth."""
_LARGEST_NAMED = 4
"""Largest number of hypotheses in a sentence. Chosen: a reader keeps four in mind."""


class Outcome(Enum):
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

    hypotheses: tuple[WeightedHypothesis, ...]  # Hypotheses by falling probability
    outcome: Outcome  # Why the investigation goes on or ends
    sentence: str = ''  # The result in one sentence; '' where it goes on
    manoeuvre: str = ''  # Name of the next manoeuvre; '' at the end
    information_per_minute: float = 0.0  # What it is expected to tell, nat/min
    fault: str = ''  # Fault of the recording that makes a verdict impossible; '' without one
    hidden: tuple[str, ...] = ()  # Effects that this stage cannot show
    verdict: str = ''  # Status and effects of the diagnosis; '' without a verdict

    def as_json(self) -> dict[str, Any]:
        """Return the answer as values of JSON."""
        return {**vars(self), 'outcome': self.outcome.value,
                'hypotheses': [[list(h.effects), h.probability] for h in self.hypotheses]}


@dataclass(frozen=True)
class Assessment:
    """Probabilities of the hypotheses, and the diagnosis that gives them."""

    # Hypotheses by falling probability, which sums to 1; no effect means no gap
    hypotheses: tuple[WeightedHypothesis, ...]
    diagnosis: Diagnosis | None = None  # The diagnosis; None before there are samples enough

    @property
    def fault(self) -> str:
        """Return the fault of the recording that makes a verdict impossible; '' without one."""
        fault = self.diagnosis.fault if self.diagnosis else None
        return '' if fault is None or fault.status == 'insufficient' else fault.message

    @property
    def verdict(self) -> str:
        """Return status and effects of the diagnosis; '' without a verdict."""
        report = self.diagnosis.report if self.diagnosis else None
        verdict = report.verdict if report else None
        return ' '.join([verdict.status, *verdict.effects]) if verdict else ''


@dataclass(frozen=True)
class Ranking:
    """The manoeuvres by what they are expected to tell per minute."""

    assessment: Assessment  # The assessment, with the effects that only the manoeuvres can show
    worth: tuple[ManoeuvreWorth, ...]  # Manoeuvres, the best first
    # Effects that neither the samples nor a manoeuvre of this stage can show
    hidden: tuple[str, ...]


def run_round(question: Question, recordings: Sequence[Recording], sensor: Sensor,
              limits: StageLimits, seed: int = 0) -> tuple[Answer, Diagnosis | None]:
    """Diagnose the samples so far, and choose the next manoeuvre."""
    assessment = _assess(recordings, sensor, seed)
    hypotheses = assessment.hypotheses
    if assessment.fault:
        return Answer(hypotheses, Outcome.INSEPARABLE, fault=assessment.fault), \
            assessment.diagnosis
    if hypotheses[0].effects and hypotheses[0].probability >= CERTAIN:
        # Effects that were not seen so far only take probability from no gap, so that the
        # manoeuvres need not be simulated.
        return decide(Ranking(assessment, (), ()), question, True), assessment.diagnosis
    manoeuvres = plan_all(limits, question.pose, 60 * question.minutes)
    in_time = [m for m in manoeuvres if m.minutes <= question.remaining_minutes]
    ranking = rank(assessment, sensor, in_time or manoeuvres)
    return decide(ranking, question, bool(in_time)), assessment.diagnosis


def _assess(recordings: Sequence[Recording], sensor: Sensor, seed: int = 0) -> Assessment:
    """Diagnose the samples; the probabilities are the prior ones where they are too few."""
    diagnosis = diagnose(recordings, sensor, seed=seed) if recordings else None
    if diagnosis is not None and diagnosis.report is not None:
        return Assessment(diagnosis.report.verdict.hypotheses, diagnosis)
    return Assessment(normalised({(): _NOTHING, (UNKNOWN,): 1 - _NOTHING}), diagnosis)


def rank(assessment: Assessment, sensor: Sensor, manoeuvres: Sequence[PlannedManoeuvre]
         ) -> Ranking:
    """Rank manoeuvres by their expected information per minute, given the samples so far."""
    diagnosis = assessment.diagnosis
    report = diagnosis.report if diagnosis else None
    model = report.linear_model if report else None
    seen = {v.effect for v in model.variants} if model else set()
    considered = {e for h in leading(assessment.hypotheses) for e in h.effects}
    needed = sorted(considered | (set(library()) - seen))
    dimensions = unknown_dimensions(report.verdict if report else None)
    responses = [predict(Experiment(m.name, m.begin_s, m.motion), sensor, needed, dimensions)
                 for m in manoeuvres]
    excited = {effect for response in responses for effect in response.effects}
    complete = _with_unseen(assessment, excited - seen, len(excited | seen))
    worth = rank_responses(responses, complete.hypotheses, model, dimensions)
    on_the_mean = {e.name for e in candidates()}
    return Ranking(complete, worth, tuple(sorted(on_the_mean - excited - seen)))


def _with_unseen(assessment: Assessment, effects: set[str], library_size: int) -> Assessment:
    """Add effects that the samples could not show; they keep their prior odds over no gap."""
    weights = {h.effects: h.probability for h in assessment.hypotheses}
    odds = 1 / max(library_size, 1)
    for effect in sorted(effects):
        weights.setdefault((effect,), weights.get((), 0.0) * odds)
    return Assessment(normalised(weights), assessment.diagnosis)


def decide(ranking: Ranking, question: Question, has_time: bool) -> Answer:
    """
    Choose the next manoeuvre, or end.

    A verdict that was the same in the round before is not expected to change by more of the same:
    only manoeuvres of a kind that is not recorded yet follow it.
    """
    hypotheses, verdict = ranking.assessment.hypotheses, ranking.assessment.verdict
    best = hypotheses[0]
    following = [w for w in ranking.worth if w.per_minute > _SMALLEST_PER_MINUTE]
    if verdict and verdict == question.verdict:
        kinds = {KIND_OF[name] for name in question.recorded}
        following = [w for w in following if KIND_OF[w.manoeuvre.name] not in kinds]
    named = _with_90_percent(hypotheses)
    if best.effects and best.probability >= CERTAIN:
        outcome = Outcome.CERTAIN
    elif not following and not best.effects:
        # The samples prefer no gap to each of these effects, so that they do not show it.
        outcome = Outcome.NO_VISIBLE_GAP
        named = [h for h in hypotheses if len(h.effects) < 2 and UNKNOWN not in h.effects]
    elif not following:
        outcome = Outcome.INSEPARABLE
    elif not has_time:
        outcome = Outcome.TIME_OVER
    else:
        return Answer(hypotheses, Outcome.GO_ON, '', following[0].manoeuvre.name,
                      following[0].per_minute, hidden=ranking.hidden, verdict=verdict)
    return Answer(hypotheses, outcome, _sentence(outcome, named), hidden=ranking.hidden,
                  verdict=verdict)


def _with_90_percent(hypotheses: Sequence[WeightedHypothesis]) -> list[WeightedHypothesis]:
    """Return the fewest hypotheses that together have 90 %."""
    total, kept = 0.0, []
    for hypothesis in hypotheses:
        kept.append(hypothesis)
        total += hypothesis.probability
        if total >= CERTAIN:
            break
    return kept


def _sentence(outcome: Outcome, named: Sequence[WeightedHypothesis]) -> str:
    """Return the result in one sentence with one number."""
    percent = f'{100 * sum(h.probability for h in named):.0f} %'
    names = listed([hypothesis_text(h.effects) for h in named])
    return {
        Outcome.CERTAIN: f'The recording shows {names}: {percent}.',
        Outcome.NO_VISIBLE_GAP: f'There is no gap that this stage can show: {percent}.',
        Outcome.INSEPARABLE: f'This stage cannot separate {names}: together {percent}.',
        Outcome.TIME_OVER: f'The time is over; the recording shows {names}: together {percent}.',
    }[outcome]


def hypothesis_text(effects: Sequence[str]) -> str:
    """Return a hypothesis for people."""
    if not effects:
        return 'no gap'
    named = [e for e in effects if e != UNKNOWN]
    return ' with '.join(named + ['something unknown'] * (UNKNOWN in effects))


def listed(names: Sequence[str]) -> str:
    """Return the first names in a sentence, and how many others there are."""
    others = len(names) - _LARGEST_NAMED
    if others > 1:
        return f'{", ".join(names[:_LARGEST_NAMED])} or {others} other hypotheses'
    return ', '.join(names[:-1]) + ' or ' * (len(names) > 1) + names[-1]
