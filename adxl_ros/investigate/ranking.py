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

"""What each manoeuvre is expected to tell, given the samples so far."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from adxl_ros.diagnose.diagnosis import SETTINGS
from adxl_ros.diagnose.expectation import (
    leading,
    ManoeuvreWorth,
    predict,
    rank_responses,
    unknown_dimensions,
)
from adxl_ros.diagnose.information import entropy
from adxl_ros.diagnose.sensitivities import candidates
from adxl_ros.investigate.assessment import Assessment, with_unseen
from adxl_ros.investigate.manoeuvres import PlannedManoeuvre
from adxl_ros.model.effects import library
from adxl_ros.model.sensor import Sensor


@dataclass(frozen=True)
class Ranking:
    """
    The manoeuvres by what they are expected to tell per minute.

    Attributes
    ----------
    assessment
        The assessment, with the effects that only the manoeuvres can show.
    worth
        Manoeuvres, the best first.
    hidden
        Effects that neither the samples nor a manoeuvre of this stage can show.

    """

    assessment: Assessment
    worth: tuple[ManoeuvreWorth, ...]
    hidden: tuple[str, ...]

    @property
    def entropy(self) -> float:
        """Return the entropy of the hypotheses, nat."""
        return entropy([h.probability for h in self.assessment.hypotheses])


def rank(assessment: Assessment, sensor: Sensor, manoeuvres: Sequence[PlannedManoeuvre]
         ) -> Ranking:
    """
    Rank manoeuvres by their expected information per minute.

    Parameters
    ----------
    assessment
        What the samples so far say.
    sensor
        The baseline.
    manoeuvres
        The manoeuvres.

    Returns
    -------
    Ranking
        The manoeuvres, the best first.

    """
    diagnosis = assessment.diagnosis
    model = diagnosis.linear_model if diagnosis else None
    seen = {v.effect for v in model.variants} if model else set()
    considered = {e for h in leading(assessment.hypotheses) for e in h.effects}
    needed = sorted(considered | (set(library()) - seen))
    dimensions = unknown_dimensions(diagnosis.verdict if diagnosis else None)
    responses = [predict(m, sensor, needed, dimensions) for m in manoeuvres]
    excited = {effect for response in responses for effect in response.effects}
    complete = with_unseen(assessment, sorted(excited - seen), len(excited | seen))
    worth = rank_responses(responses, complete.hypotheses, model, dimensions,
                           SETTINGS.evidence_factor)
    return Ranking(complete, worth, tuple(sorted(_mean_effects() - excited - seen)))


def _mean_effects() -> set[str]:
    """Return the effects that act on the mean of the output."""
    return {e.name for e in candidates()}
