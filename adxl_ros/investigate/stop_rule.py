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

"""When an investigation ends, and what it then says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from adxl_ros.diagnose.decision import WeightedHypothesis
from adxl_ros.diagnose.noise_detectors import UNKNOWN
from adxl_ros.investigate.assessment import Assessment
from adxl_ros.investigate.ranking import ManoeuvreWorth, Ranking

CERTAIN = 0.95
"""Probability of a hypothesis at which an investigation ends. Chosen: one error in 20."""
_SMALLEST_PER_MINUTE = 0.01
"""Expected information per minute, nat/min, below which no manoeuvre separates anything. Chosen:
ten minutes then change even odds by a tenth."""
_LARGEST_NAMED = 4
"""Largest number of hypotheses in a sentence. Chosen: a reader keeps four in mind."""


class Outcome(Enum):
    """
    Why an investigation goes on or ends.

    GO_ON: another manoeuvre follows. CERTAIN: a hypothesis has 95 %. INSEPARABLE: no manoeuvre of
    this stage separates what remains. TIME_OVER: the time does not suffice for a manoeuvre.
    """

    GO_ON = 'go_on'
    CERTAIN = 'certain'
    NO_VISIBLE_GAP = 'no_visible_gap'
    INSEPARABLE = 'inseparable'
    TIME_OVER = 'time_over'


@dataclass(frozen=True)
class Decision:
    """
    What follows from the samples so far.

    Attributes
    ----------
    outcome
        Why the investigation goes on or ends.
    hypotheses
        The most probable hypothesis. Of INSEPARABLE and TIME_OVER those that together have 95 %,
        of NO_VISIBLE_GAP no gap and all effects that are too small to show.
    following
        The next manoeuvre; None at the end.

    """

    outcome: Outcome
    hypotheses: tuple[WeightedHypothesis, ...]
    following: ManoeuvreWorth | None = None

    @property
    def probability(self) -> float:
        """Return the probability of the named hypotheses together."""
        return sum(h.probability for h in self.hypotheses)

    @property
    def sentence(self) -> str:
        """Return the result in one sentence with one number."""
        percent = f'{100 * self.probability:.0f} %'
        names = _listed([hypothesis_text(h.effects) for h in self.hypotheses])
        if self.outcome is Outcome.CERTAIN:
            return f'The recording shows {names}: {percent}.'
        if self.outcome is Outcome.NO_VISIBLE_GAP:
            return f'There is no gap that this stage can show: {percent}.'
        if self.outcome is Outcome.INSEPARABLE:
            return f'This stage cannot separate {names}: together {percent}.'
        return f'The time is over; the recording shows {names}: together {percent}.'


def decide_early(assessment: Assessment) -> Decision | None:
    """
    End where a hypothesis with effects has 95 %.

    Effects that were not seen so far only take probability from no gap, so that the manoeuvres
    need not be simulated.
    """
    best = assessment.hypotheses[0]
    if best.effects and best.probability >= CERTAIN:
        return Decision(Outcome.CERTAIN, (best,))
    return None


def decide(ranking: Ranking, has_time: bool) -> Decision:
    """
    Choose the next manoeuvre, or end.

    Parameters
    ----------
    ranking
        Probabilities of the hypotheses, and the manoeuvres.
    has_time
        Whether there is time for each of the manoeuvres.

    Returns
    -------
    Decision
        The decision.

    """
    hypotheses = ranking.assessment.hypotheses
    best = hypotheses[0]
    if best.probability >= CERTAIN:
        return Decision(Outcome.CERTAIN, (best,))
    remaining = _with_95_percent(hypotheses)
    if not ranking.worth[0].per_minute > _SMALLEST_PER_MINUTE:
        # The samples prefer no gap to each of these effects, so that they do not show it.
        invisible = tuple(h for h in hypotheses if len(h.effects) < 2 and UNKNOWN not in h.effects)
        if not best.effects and sum(h.probability for h in invisible) >= CERTAIN:
            return Decision(Outcome.NO_VISIBLE_GAP, invisible)
        return Decision(Outcome.INSEPARABLE, remaining)
    if not has_time:
        return Decision(Outcome.TIME_OVER, remaining)
    return Decision(Outcome.GO_ON, (best,), ranking.worth[0])


def _with_95_percent(hypotheses: Sequence[WeightedHypothesis]) -> tuple[WeightedHypothesis, ...]:
    """Return the fewest hypotheses that together have 95 %."""
    total, kept = 0.0, []
    for hypothesis in hypotheses:
        kept.append(hypothesis)
        total += hypothesis.probability
        if total >= CERTAIN:
            break
    return tuple(kept)


def hypothesis_text(effects: Sequence[str]) -> str:
    """Return a hypothesis for people."""
    if not effects:
        return 'no gap'
    named = [e for e in effects if e != UNKNOWN]
    parts = named + ['something unknown'] * (UNKNOWN in effects)
    return ' with '.join(parts)


def _listed(names: Sequence[str]) -> str:
    """Return the first names in a sentence, and how many others there are."""
    others = len(names) - _LARGEST_NAMED
    if others > 1:
        return f'{", ".join(names[:_LARGEST_NAMED])} or {others} other hypotheses'
    return ', '.join(names[:-1]) + ' or ' * (len(names) > 1) + names[-1]
