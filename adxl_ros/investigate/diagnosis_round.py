# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""One round of an investigation: samples so far in, probabilities and the next manoeuvre out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from adxl_ros.diagnose.decision import WeightedHypothesis
from adxl_ros.diagnose.diagnosis import Diagnosis
from adxl_ros.files.recording_columns import Recording
from adxl_ros.investigate.assessment import assess, prior
from adxl_ros.investigate.manoeuvres import plan_all
from adxl_ros.investigate.ranking import rank
from adxl_ros.investigate.stage_limits import Pose, StageLimits
from adxl_ros.investigate.stop_rule import decide, decide_early, Outcome
from adxl_ros.model.sensor import Sensor


@dataclass(frozen=True)
class Question:
    """
    What a round begins with.

    Attributes
    ----------
    pose
        Pose of the stage.
    minutes
        Time since the first sample, min.
    remaining_minutes
        Time that remains for manoeuvres, min.
    has_samples
        Whether there are samples to diagnose.

    """

    pose: Pose
    minutes: float
    remaining_minutes: float
    has_samples: bool


@dataclass(frozen=True)
class Answer:
    """
    What a round ends with.

    Attributes
    ----------
    hypotheses
        Hypotheses by falling probability.
    outcome
        Why the investigation goes on or ends.
    sentence
        The result in one sentence; '' where it goes on.
    manoeuvre
        Name of the next manoeuvre; '' at the end.
    information_per_minute
        What it is expected to tell, nat/min.
    fault
        Fault of the recording that makes a verdict impossible; '' without one.
    hidden
        Effects that this stage cannot show.

    """

    hypotheses: tuple[WeightedHypothesis, ...]
    outcome: Outcome
    sentence: str = ''
    manoeuvre: str = ''
    information_per_minute: float = 0.0
    fault: str = ''
    hidden: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Return the answer as values of JSON."""
        return {'hypotheses': [[list(h.effects), h.probability] for h in self.hypotheses],
                'outcome': self.outcome.value, 'sentence': self.sentence,
                'manoeuvre': self.manoeuvre,
                'information_per_minute': self.information_per_minute, 'fault': self.fault,
                'hidden': list(self.hidden)}

    @staticmethod
    def from_json(values: dict[str, Any]) -> Answer:
        """Return the answer of values of JSON."""
        return Answer(**{**values, 'outcome': Outcome(values['outcome']),
                         'hidden': tuple(values['hidden']),
                         'hypotheses': tuple(WeightedHypothesis(tuple(effects), probability)
                                             for effects, probability in values['hypotheses'])})


def run_round(question: Question, recordings: Sequence[Recording], sensor: Sensor,
              limits: StageLimits, seed: int = 0) -> tuple[Answer, Diagnosis | None]:
    """
    Diagnose the samples so far, and choose the next manoeuvre.

    Parameters
    ----------
    question
        Pose and times.
    recordings
        All samples; none before the first manoeuvre.
    sensor
        The baseline.
    limits
        Limits of the stage.
    seed
        Seed of the diagnosis.

    Returns
    -------
    tuple
        The answer, and the diagnosis; None without samples.

    Raises
    ------
    UserError
        A recording is of another unit, or its reference cannot be followed.

    """
    assessment = assess(recordings, sensor, seed) if recordings else prior()
    diagnosis = assessment.diagnosis
    if assessment.fault:
        return Answer(assessment.hypotheses, Outcome.INSEPARABLE,
                      fault=assessment.fault), diagnosis
    decision = decide_early(assessment)
    if decision is not None:
        return Answer(assessment.hypotheses, decision.outcome, decision.sentence), diagnosis
    manoeuvres = plan_all(limits, question.pose, 60 * question.minutes)
    in_time = [m for m in manoeuvres if m.minutes <= question.remaining_minutes]
    ranking = rank(assessment, sensor, in_time or manoeuvres)
    decision = decide(ranking, bool(in_time))
    hypotheses = ranking.assessment.hypotheses
    if decision.following is None:
        return Answer(hypotheses, decision.outcome, decision.sentence,
                      hidden=ranking.hidden), diagnosis
    return Answer(hypotheses, decision.outcome, '', decision.following.manoeuvre.name,
                  decision.following.per_minute, hidden=ranking.hidden), diagnosis
