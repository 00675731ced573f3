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

"""The decision: from posterior probabilities to a verdict."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import NamedTuple

from adxl_ros.diagnose.decision_settings import DecisionSettings
from adxl_ros.diagnose.hypothesis_fit import Hypothesis
from adxl_ros.diagnose.linear_model import shows_in_lost_motion
from adxl_ros.diagnose.noise_detectors import Detection, UNKNOWN
from adxl_ros.diagnose.noise_whitening import drifts_among
from adxl_ros.diagnose.posterior import WeighedHypothesis
from adxl_ros.model.effects import effect_named
import numpy as np


class WeightedHypothesis(NamedTuple):
    """
    A hypothesis with its probability.

    Attributes
    ----------
    effects
        Names of the effects; 'unknown' may be among them.
    probability
        Probability of the hypothesis.

    """

    effects: tuple[str, ...]
    probability: float


def normalised(weights: Mapping[tuple[str, ...], float]) -> tuple[WeightedHypothesis, ...]:
    """Return hypotheses by falling probability, which sums to 1."""
    total = sum(weights.values())
    return tuple(sorted((WeightedHypothesis(effects, weight / total)
                         for effects, weight in weights.items()), key=lambda h: -h.probability))


@dataclass(frozen=True)
class Verdict:
    """
    The result of a diagnosis.

    Attributes
    ----------
    status
        'no_gap', 'explained', 'inseparable', 'unknown' or 'insufficient'.
    effects
        Effects that are certain.
    groups
        Sets of inseparable effects, one of which acts.
    probability
        Probability of the verdict.
    hypotheses
        Hypotheses by falling probability, which sums to 1.
    best
        The most probable hypothesis.
    unknown_where
        Dimensions in which something unknown shows, the strongest first.
    undescribed
        The part of the probabilities that stands for verdicts that are wrong for a reason that no
        hypothesis describes, and the hypothesis that has it.

    """

    status: str
    effects: tuple[str, ...]
    groups: tuple[tuple[str, ...], ...]
    probability: float
    hypotheses: tuple[WeightedHypothesis, ...]
    best: Hypothesis
    unknown_where: tuple[str, ...] = ()
    undescribed: WeightedHypothesis = WeightedHypothesis((), 0.0)

    @property
    def described(self) -> tuple[WeightedHypothesis, ...]:
        """
        Return the hypotheses without the undescribed part, by falling probability.

        No sample changes that part, so that it cannot lead a choice of samples.
        """
        weights = {h.effects: h.probability for h in self.hypotheses}
        effects, share = self.undescribed
        if effects in weights:
            weights[effects] = max(weights[effects] - share, 0.0)
        return normalised(weights)


@dataclass(frozen=True)
class Findings:
    """
    What the decision weighs.

    Attributes
    ----------
    weighed
        Sets of effects that hold on held-out blocks, with and without something unknown, by
        falling probability.
    hidden_odds
        Odds of each effect that is too small to show, over no effect.
    walk_log_bayes_factor
        Log Bayes factor of another power in some octaves than a random walk's.
    detections
        Noise-like effects that show.
    noise_mps2
        Rms of the noise, m/s².
    explained_mps2
        Rms that the best hypothesis explains, m/s².
    unexplained_mps2
        Rms that neither the best hypothesis nor noise explains, m/s².
    lost_motion_mps2
        Rms of motion that a smooth reference lacks, m/s².
    code_step_mps2
        Rms of the rounding to codes of the ADC, m/s². It is not unknown, although it is not white
        where the rounding follows the signal.

    """

    weighed: Sequence[WeighedHypothesis]
    hidden_odds: Mapping[str, float]
    walk_log_bayes_factor: float
    detections: Sequence[Detection]
    noise_mps2: float
    explained_mps2: float
    unexplained_mps2: float
    lost_motion_mps2: float
    code_step_mps2: float


def decide(findings: Findings, settings: DecisionSettings) -> Verdict:
    """
    Sum the probabilities of the sets that the verdict names.

    A verdict can be wrong for a reason that no hypothesis describes. The share of such verdicts
    among working cases is taken from the probability of the named sets.

    Parameters
    ----------
    findings
        Probabilities, and what shows in the noise.
    settings
        Limits of the decision.

    Returns
    -------
    Verdict
        The verdict.

    """
    total = sum(w.probability for w in findings.weighed)
    library_sets = [w for w in findings.weighed if w.unknown is None]
    unknown = sum(w.probability for w in findings.weighed if w.unknown is not None) / total
    where = _dimensions(findings.weighed)
    best = library_sets[0]
    unexplained = _unexplained(findings, best, settings)
    if unexplained:
        unknown, where = max(unknown, 1 - unknown), tuple(dict.fromkeys((*where, *unexplained)))
    detected = tuple(d.effect for d in findings.detections if d.effect != UNKNOWN)
    # Where something unknown is certain, the others have no probability in floating point.
    share = (1 - unknown) / max(sum(w.probability for w in library_sets), np.finfo(float).tiny)
    is_unknown = unknown > settings.certain
    count = len(best.effects) + len(detected)
    wrong = settings.wrong_unknown if is_unknown \
        else settings.wrong_by_count[min(count, len(settings.wrong_by_count) - 1)]
    named = (*best.effects, *detected)
    weights = {tuple(sorted((*w.effects, *detected))): float(w.probability * share * (1 - wrong))
               for w in library_sets}
    if () in weights:
        nothing = weights[()] / (1 + sum(findings.hidden_odds.values()))
        for effect, odds in findings.hidden_odds.items():
            weights[(effect,)] = weights.get((effect,), 0.0) + nothing * odds
        weights[()] = nothing
    weights[(UNKNOWN,)] = float(unknown * (1 - wrong))
    rivals = _rivals(library_sets, settings)
    other = tuple(sorted(named if is_unknown else (*named, UNKNOWN)))
    weights[other] = weights.get(other, 0.0) + wrong
    for others in (detected, (*detected, UNKNOWN)):
        _share_among_imitations(weights, best.effects, rivals, others)
    weighted = sorted((WeightedHypothesis(*item) for item in weights.items()),
                      key=lambda w: -w.probability)
    undescribed = WeightedHypothesis(other, wrong)
    if is_unknown:
        return Verdict('unknown', (), (), weights[(UNKNOWN,)], tuple(weighted), best.hypothesis,
                       where, undescribed)
    effects = tuple(sorted((*(e for e in best.effects if len(rivals[e]) == 1), *detected)))
    groups = tuple(sorted({tuple(sorted(rivals[e])) for e in best.effects
                           if len(rivals[e]) > 1}))
    covered = {frozenset(effects) | set(choice) for choice in _choices(groups)}
    probability = float(sum(w.probability for w in weighted if frozenset(w.effects) in covered))
    if not best.effects and not detected:
        return Verdict('no_gap', (), (), probability, tuple(weighted), best.hypothesis,
                       undescribed=undescribed)
    return Verdict('inseparable' if groups else 'explained', effects, groups, probability,
                   tuple(weighted), best.hypothesis, undescribed=undescribed)


def _dimensions(weighed: Sequence[WeighedHypothesis]) -> tuple[str, ...]:
    """Return the dimensions in which something unknown is probable, the strongest first."""
    probability: dict[str, float] = {}
    for w in weighed:
        if w.unknown is not None:
            probability[w.unknown.value] = probability.get(w.unknown.value, 0.0) + w.probability
    largest = max(probability.values(), default=0.0)
    return tuple(sorted((d for d, p in probability.items() if p > 0.1 * largest),
                        key=lambda d: -probability[d]))


def _unexplained(findings: Findings, best: WeighedHypothesis, settings: DecisionSettings
                 ) -> tuple[str, ...]:
    """Return the dimensions of what no hypothesis describes: octaves of a drift, or lines."""
    drifts = drifts_among(best.effects)
    if drifts and findings.walk_log_bayes_factor > settings.walk_log_bayes_factor:
        return ('time_s',)
    # With a drift, the residual is the drift itself, so that its rms shows nothing unknown.
    limit_mps2 = max(settings.unexplained_share_of_noise * findings.noise_mps2,
                     settings.unexplained_share_of_explained * findings.explained_mps2,
                     settings.smallest_share_of_lost_motion * findings.lost_motion_mps2,
                     findings.code_step_mps2)
    if (not drifts and findings.unexplained_mps2 > limit_mps2) \
            or any(d.effect == UNKNOWN for d in findings.detections):
        return ('frequency',)
    return ()


def _rivals(library_sets: Sequence[WeighedHypothesis], settings: DecisionSettings
            ) -> dict[str, set[str]]:
    """
    Return for each effect of the best set the effects that can stand in its place.

    The forms of geometry and of straight lines are exact, so that evidence between sets of such
    effects is not tempered.
    """
    best = library_sets[0]
    rivals = {effect: {effect, *_imitating(effect, best.effects)} for effect in best.effects}
    for w in library_sets[1:]:
        _add_imitated(rivals, best, w, settings)
        share = w.probability / best.probability
        if all(effect_named(e).exact for e in best.effects | w.effects):
            share = np.exp(min(w.log_evidence - best.log_evidence, 0.0))
        if share < settings.smallest_rival_share or len(w.effects) != len(best.effects):
            continue
        new = w.effects - best.effects
        for effect in best.effects - w.effects:
            rivals[effect] |= new
    return rivals


def _share_among_imitations(weights: dict[tuple[str, ...], float], best: frozenset[str],
                            rivals: Mapping[str, set[str]], others: Sequence[str]) -> None:
    """Give equal probability to sets that give the same samples, each beside other effects."""
    same = [[effect, *(r for r in rivals[effect] - {effect}
                       if effect in _imitating(r, ()) or r in _imitating(effect, ()))]
            for effect in sorted(best)]
    keys = [tuple(sorted((*choice, *others))) for choice in _choices(same)]
    if len(keys) > 1:
        total = sum(weights.get(key, 0.0) for key in keys)
        weights.update(dict.fromkeys(keys, total / len(keys)))


def _imitating(effect: str, present: Iterable[str]) -> set[str]:
    """Return the effect of the sensor that gives the same samples as one of the reference."""
    imitating = effect_named(effect).diagnosis.imitated_by
    return {imitating} - {'', *present}


def _add_imitated(rivals: dict[str, set[str]], best: WeighedHypothesis, other: WeighedHypothesis,
                  settings: DecisionSettings) -> None:
    """Add the effect of the reference that gives the same samples as one of the best set."""
    new, replaced = other.effects - best.effects, best.effects - other.effects
    if len(new) == len(replaced) == 1 \
            and effect_named(next(iter(new))).diagnosis.imitated_by in replaced \
            and best.log_evidence - other.log_evidence < settings.imitated_deficit:
        rivals[next(iter(replaced))] |= new


def _choices(groups: Sequence[Sequence[str]]) -> list[tuple[str, ...]]:
    """Return all ways to choose one effect of each group."""
    choices: list[tuple[str, ...]] = [()]
    for group in groups:
        choices = [(*choice, effect) for choice in choices for effect in group]
    return choices


def without_fast_effects(verdict: Verdict) -> Verdict:
    """Return unknown where an effect is named that a reference without fast motion imitates."""
    def is_imitated(effects: Iterable[str]) -> bool:
        """Determine whether an effect shows in fast motion, or is unknown."""
        return any(e == UNKNOWN or shows_in_lost_motion(effect_named(e)) for e in effects)

    if not is_imitated((*verdict.effects, *chain(*verdict.groups))):
        return verdict
    probability = sum(h.probability for h in verdict.hypotheses if is_imitated(h.effects))
    others = [h for h in verdict.hypotheses if not is_imitated(h.effects)]
    return replace(verdict, status='unknown', effects=(), groups=(), probability=probability,
                   hypotheses=(WeightedHypothesis((UNKNOWN,), probability), *others))
