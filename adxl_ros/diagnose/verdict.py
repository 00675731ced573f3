# SPDX-License-Identifier: Apache-2.0
"""
The verdict: everything it says follows from held-out figures that the report shows.

Explained power P is by how much a set of effects lowers the held-out mean square. The
reproducible rest U is by how much flexible functions lower what then is left. Material is what a
user would act on. The same rule, applied to blocks drawn with replacement, says how sure it is.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import NamedTuple

from adxl_ros.diagnose.held_out import HeldOut, POSE, Rest
from adxl_ros.diagnose.hypothesis_fit import Hypothesis
from adxl_ros.diagnose.noise_effects import UNKNOWN
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Concern
from adxl_ros.report.quantities import Interval
import numpy as np

HEALTHY = ''
"""The drift of a healthy unit's noise."""
MATERIAL_MG = 0.1
"""Amplitude that a user would act on, mg, unless `--material` states another one."""
MATERIAL_SHARE_OF_NOISE = 0.1
"""Share of the noise that a user would act on: it adds half a per cent to the rms."""
_SHARE_OF_SET = 0.03
"""Share of the explained power that each effect of a set must hold."""
_SHARE_OF_FORM = 0.1
"""The same beside an effect whose form is not exact over the same variables."""
_SHARE_OF_LOST = 0.5
"""Error of a smooth reference in slower motion, as a share of the motion that it lacks. Chosen."""
_NATS = 3.0
"""Held-out log likelihood that a further effect must gain."""
_SMALLEST_P = 0.001
"""Probability of the increments of a drift below which they are of something else. Chosen: one
error in 1000."""
_DRIFT_REACH = 10.0
"""95 % quantile of the mean square of a random walk about its start, divided by the one expected
about its mean. Derived: 1.66·T and T/6."""
_LOWEST, _HIGHEST = 0.05, 0.95
"""Quantiles of the 90 % intervals."""


class WeightedHypothesis(NamedTuple):
    """A set of effects, 'unknown' perhaps among them, and its probability."""

    effects: tuple[str, ...]
    probability: float


def normalised(weights: Mapping[tuple[str, ...], float]) -> tuple[WeightedHypothesis, ...]:
    """Return sets by falling probability, which sums to 1."""
    total = sum(weights.values())
    return tuple(sorted((WeightedHypothesis(effects, weight / total)
                         for effects, weight in weights.items()), key=lambda h: -h.probability))


@dataclass(frozen=True)
class Candidate:
    """A fitted set of effects."""

    hypothesis: Hypothesis  # The fitted effects
    # Held-out figures by the drift that the noise may have; '' is that of a healthy unit
    figures: Mapping[str, HeldOut]
    drift_mps2: Mapping[str, float]  # Expected rms of the fitted drift, m/s², by the same
    # Share of what each effect does that a function of the pose also does
    pose_shares: Mapping[str, float]


@dataclass(frozen=True)
class Verdict:
    """The result of a diagnosis; powers are mean squares over samples and axes, (m/s²)²."""

    status: str  # 'no_gap', 'explained', 'partly', 'inseparable', 'unknown' or 'insufficient'
    effects: tuple[str, ...]  # Effects that are named for certain
    groups: tuple[tuple[str, ...], ...]  # Sets of inseparable effects, one of which acts
    probability: float  # How often such a verdict is right
    # Sets of effects by falling probability, which sums to 1
    hypotheses: tuple[WeightedHypothesis, ...]
    best: Hypothesis  # The set whose closing the report states
    material_mps2: float  # Material amplitude, m/s²
    # Rms error of the reference, m/s², that what follows the pose must exceed, too
    reference_mps2: float
    explained: Interval  # Explained power of the best set
    rest: Interval  # Reproducible rest beside it
    left: Interval  # Power that it leaves above the noise floor, repeating or not
    upper_limit_mps2: float  # Amplitude above which a gap of any kind would have shown
    # Explained power that is lost without each effect of the best set
    lost_without: Mapping[str, Interval] = field(default_factory=dict)
    # Dimensions that the reproducible rest follows, the strongest first
    rest_follows: tuple[str, ...] = ()

    @property
    def remaining(self) -> float:
        """Power beside the best set: what repeats, or all above the noise where that is more."""
        return max(self.rest.value, self.left.value, 0.0)

    @property
    def explained_share(self) -> float:
        """Share of the power above the noise that the best set explains; 1 without any."""
        total = max(self.explained.value, 0.0) + self.remaining
        return 1.0 - self.remaining / total if total > 0 else 1.0


_Modelled = tuple[frozenset[str], str]
"""A set of effects, and the drift of the noise beside it."""


@dataclass(frozen=True)
class Evidence:
    """What the rule weighs."""

    # Sets of effects by name; the empty one is among them
    candidates: Mapping[frozenset[str], Candidate]
    counts: np.ndarray  # Samples by block, (blocks,)
    # How often each block is drawn, (draws, blocks); once each in the first row
    weights: np.ndarray
    material_mps2: float  # Material amplitude, m/s²
    # Rms error of the reference, m/s²: its steps return with each pose, as an effect would
    reference_mps2: float
    lost_mps2: float  # Rms of the motion that a smooth reference lacks, m/s²
    floor_mps2: float  # Noise floor, m/s²; infinite where it is assumed

    def left(self, effects: frozenset[str], rows: slice) -> np.ndarray:
        """Return the power above the noise floor that a set leaves, by draw."""
        return self.mean(self.candidates[effects].figures[HEALTHY].squares,
                         rows) - self.floor_mps2 ** 2

    def material_power(self, pose_share: float) -> float:
        """Return the power that a user would act on and that is not of the reference, (m/s²)²."""
        return self.material_mps2 ** 2 + pose_share * self.reference_mps2 ** 2

    def rest_material(self, rest: Rest) -> float:
        """Return the same for a reproducible rest, which may be what a smooth reference lacks."""
        total = float(self.mean(rest.squares)[0])
        pose = max((float(self.mean(rest.by_dimension[d.value])[0]) for d in POSE
                    if d.value in rest.by_dimension), default=0.0)
        share = float(np.clip(pose / total, 0.0, 1.0)) if total > 0 else 0.0
        return self.material_power(share) + (_SHARE_OF_LOST * self.lost_mps2) ** 2

    def mean(self, by_block: np.ndarray, rows: slice = slice(None)) -> np.ndarray:
        """Return the mean over samples of sums by block, by draw."""
        weights = self.weights[rows]
        return weights @ by_block / np.maximum(weights @ self.counts, 1.0)

    def gain(self, more: frozenset[str], less: frozenset[str], rows: slice) -> np.ndarray:
        """Return by how much one set explains more power than another, by draw."""
        a, b = (self.candidates[e].figures[HEALTHY] for e in (more, less))
        return self.mean(b.squares - a.squares, rows)

    def nats(self, more: _Modelled, less: _Modelled, rows: slice) -> np.ndarray:
        """Return by how much a set, with its noise, makes the held-out samples more probable."""
        a, b = (self.candidates[e].figures[noise] for e, noise in (more, less))
        return self.weights[rows] @ (a.log_likelihood - b.log_likelihood)

    def predicts(self, more: _Modelled, less: _Modelled, rows: slice) -> bool:
        """Determine whether the held-out samples are more probable, beyond the interval."""
        nats = self.nats(more, less, rows)
        return bool(nats[0] > _NATS and _low(nats) > 0)

    def noise_of(self, effects: frozenset[str], rows: slice) -> str:
        """Return the drift that the noise beside a set has; '' where a healthy one is as good."""
        drifts = [d for d in self.candidates[effects].figures if d != HEALTHY]
        healthy = (effects, HEALTHY)
        best = max(drifts, default=HEALTHY, key=lambda d: self.nats(
            (effects, d), healthy, rows)[0])
        return best if drifts and self.predicts((effects, best), healthy, rows) else HEALTHY

    def interval(self, draws: np.ndarray) -> Interval:
        """Return the value of all blocks with the interval of the draws."""
        low, high = np.quantile(draws[1:], [_LOWEST, _HIGHEST], method='nearest')
        return Interval(float(draws[0]), float(min(low, draws[0])), float(max(high, draws[0])))


def _low(draws: np.ndarray) -> float:
    """Return the lower end of the interval; of one draw, itself."""
    return float(np.quantile(draws, _LOWEST)) if len(draws) > 1 else float(draws[0])


def shares_form(effect: str, others: frozenset[str]) -> bool:
    """Determine whether an error of form of another effect may look like an effect."""
    form = set(effect_named(effect).diagnosis.form)
    return any(form & set(effect_named(other).diagnosis.form) for other in others)


def is_needed(evidence: Evidence, effects: frozenset[str], effect: str, rows: slice,
              beside_drift: bool) -> bool:
    """Determine whether a set loses a material part of what it explains without an effect."""
    rest = effects - {effect}
    lost, nats = evidence.gain(effects, rest, rows), evidence.nats(
        (effects, HEALTHY), (rest, HEALTHY), rows)
    if nats[0] <= _NATS or max(_low(nats), _low(lost)) <= 0:
        return False
    explained = float(evidence.gain(effects, frozenset(), rows)[0])
    share = _SHARE_OF_FORM if shares_form(effect, rest) else _SHARE_OF_SET
    material = evidence.material_power(evidence.candidates[effects].pose_shares[effect])
    if effect_named(effect).concern is not Concern.REFERENCE:
        # Where a reference lacks motion, it is wrong in slower motion, too.
        material += (_SHARE_OF_LOST * evidence.lost_mps2) ** 2
    if float(lost[0]) <= max(material, share * explained):
        return False
    # A drift that is as large may take its place.
    largest = max(evidence.candidates[rest].drift_mps2.values()) ** 2
    return not beside_drift or _DRIFT_REACH * largest < float(lost[0]) or evidence.predicts(
        (effects, evidence.noise_of(effects, rows)), (rest, evidence.noise_of(rest, rows)), rows)


def drifts_beside(evidence: Evidence, effects: frozenset[str], rest: Rest, rows: slice
                  ) -> list[str]:
    """
    Return the drifts, the best first, that the noise beside a set needs; none for most.

    What flexible functions predict as well is an error of form, and no drift; nor is the motion
    that a smooth reference lacks.
    """
    if evidence.lost_mps2:
        return []
    noise, candidate = evidence.noise_of(effects, rows), evidence.candidates[effects]
    explained = float(evidence.gain(effects, frozenset(), rows)[0])
    inexact = any(not effect_named(e).exact for e in effects)
    share = _SHARE_OF_FORM if inexact else _SHARE_OF_SET
    if noise == HEALTHY or candidate.drift_mps2[noise] ** 2 <= max(
            evidence.material_mps2 ** 2, share * explained):
        return []
    beyond = evidence.nats((effects, noise), (effects, HEALTHY), rows) \
        - evidence.weights[rows] @ rest.steady_log_likelihood
    if beyond[0] <= _NATS or _low(beyond) <= 0:
        return []
    return [noise, *(d for d in candidate.figures if d not in (HEALTHY, noise)
                     and not evidence.predicts((effects, noise), (effects, d), rows))]


def minimal_sets(evidence: Evidence, rows: slice, beside_drift: bool = False
                 ) -> list[frozenset[str]]:
    """Return the sets all of whose effects are needed, the most probable first."""
    kept = [effects for effects in evidence.candidates
            if all(effects - {e} in evidence.candidates
                   and is_needed(evidence, effects, e, rows, beside_drift) for e in effects)]
    null: _Modelled = (frozenset(), HEALTHY)
    return sorted(kept, key=lambda effects: -evidence.nats(
        (effects, evidence.noise_of(effects, rows) if beside_drift else HEALTHY), null, rows)[0])


def rivals(evidence: Evidence, minimal: Sequence[frozenset[str]], rest: float, rows: slice
           ) -> list[frozenset[str]]:
    """
    Return the minimal sets of as many effects that explain as much as the first.

    The order of two sets could be that of their errors of form, where these are as large as the
    rest that the best set leaves.
    """
    best = minimal[0]
    return [other for other in minimal[1:]
            if len(other) == len(best)
            and not (evidence.predicts((best, HEALTHY), (other, HEALTHY), rows)
                     and float(evidence.gain(best, other, rows)[0]) > rest)]


class _Answer(NamedTuple):
    """Status, certain effects, and groups of inseparable ones."""

    status: str
    effects: frozenset[str]
    groups: frozenset[frozenset[str]]


def _answer(evidence: Evidence, minimal: Sequence[frozenset[str]], rest: Rest,
            drifts: Sequence[str], detected: frozenset[str], rows: slice) -> _Answer:
    """Apply the rule to the figures of all blocks, or of one draw of them."""
    best = minimal[0]
    explained = float(evidence.gain(best, frozenset(), rows)[0])
    all_left, steady_left = (evidence.mean(squares, rows)
                             for squares in (rest.squares, rest.steady_squares))
    left, rest_material = float(all_left[0]), evidence.rest_material(rest)
    material = _low(all_left) > rest_material
    drift = evidence.candidates[best].drift_mps2.get(drifts[0], 0.0) if drifts else 0.0
    above = float(evidence.left(best, rows)[0])
    follows = _low(steady_left) > rest_material \
        and float(steady_left[0]) > _SHARE_OF_FORM * drift ** 2
    if drifts and (follows or rest.drift_p < _SMALLEST_P):
        # A drift follows time alone, and at random; its fit takes up what does not, too.
        drifts, drift, material, left = (), 0.0, True, max(left, above)
    if material and left > explained + drift ** 2:
        return _Answer('unknown', frozenset(), frozenset())
    if not best and not detected and not drifts:
        # What neither repeats nor is noise at rest is no gap only while the noise is larger.
        is_much = above > max(evidence.floor_mps2 ** 2, evidence.material_power(1.0))
        return _Answer('unknown' if is_much else 'no_gap', frozenset(), frozenset())
    others = rivals(evidence, minimal, left if material else 0.0, rows)
    groups = frozenset(g for e in best if len(g := _group(e, best, others)) > 1)
    certain = frozenset(e for e in best if not any(e in g for g in groups)) | detected
    if len(drifts) > 1:
        groups |= {frozenset(drifts)}
    else:
        certain |= set(drifts)
    left = left if material else 0.0
    if best and above > drift ** 2 + evidence.material_power(1.0):
        left = max(left, above)
    partly = left > _SHARE_OF_FORM * (explained + left)
    if groups and partly and not certain:
        # Nothing is named for certain, and none of the rivals explains what repeats.
        return _Answer('unknown', frozenset(), frozenset())
    if groups:
        return _Answer('inseparable', certain, groups)
    return _Answer('partly' if partly else 'explained', certain, groups)


def _with_drift_instead(evidence: Evidence, best: frozenset[str],
                        rest_of: Callable[[frozenset[str], str], Rest]
                        ) -> tuple[frozenset[str], list[str]] | None:
    """
    Return a part of a set and the drifts beside it that predict better than the whole set.

    Effects that leave a material part may only follow a drift, which takes up anything.
    """
    everything = slice(None)
    smaller = [(e, d) for e, c in evidence.candidates.items() if e < best
               for d in c.figures if d != HEALTHY]
    for effects, drift in sorted(smaller, key=lambda s: -evidence.nats(
            s, (best, HEALTHY), everything)[0]):
        if not evidence.predicts((effects, drift), (best, HEALTHY), everything):
            return None
        drifts = drifts_beside(evidence, effects, rest_of(effects, HEALTHY), everything)
        if drifts:
            return effects, drifts
    return None


def _group(effect: str, best: frozenset[str], others: Sequence[frozenset[str]]) -> frozenset[str]:
    """Return the effects that can stand in the place of one of the best set."""
    group = {effect}
    for other in others:
        if effect not in other:
            group |= other - best
    return frozenset(group)


def decide(evidence: Evidence, rest_of: Callable[[frozenset[str], str], Rest],
           detected: Sequence[str], reliability: Callable[[float], float]) -> Verdict:
    """Apply the rule to the figures, and to draws of their blocks."""
    everything, noise_effects = slice(None), frozenset(detected)
    best = minimal_sets(evidence, everything)[0]
    rest = rest_of(best, HEALTHY)
    drifts = drifts_beside(evidence, best, rest, everything)
    if drifts:
        best = minimal_sets(evidence, everything, True)[0]
        rest = rest_of(best, HEALTHY)
        drifts = drifts_beside(evidence, best, rest, everything)
        rest = rest_of(best, drifts[0]) if drifts else rest

    def answered(rows: slice) -> _Answer:
        minimal = [best] if drifting else minimal_sets(evidence, rows, bool(drifts))
        return _answer(evidence, minimal, rest, drifts, noise_effects, rows)

    drifting = None
    answer = answered(everything)
    if answer.status in ('partly', 'unknown') and not drifts:
        drifting = _with_drift_instead(evidence, best, rest_of)
        if drifting:
            best, drifts = drifting
            rest = rest_of(best, drifts[0])
            answer = answered(everything)
    votes = Counter(answered(slice(i, i + 1)) for i in range(1, len(evidence.weights)))
    explained = evidence.interval(evidence.gain(best, frozenset(), everything))
    left = evidence.interval(evidence.mean(rest.squares))
    highest = max(evidence.interval(evidence.gain(e, frozenset(), everything)).high
                  for e in evidence.candidates)
    probability, hypotheses = _probabilities(answer, votes, reliability)
    return Verdict(
        answer.status, tuple(sorted(answer.effects)),
        tuple(sorted(tuple(sorted(g)) for g in answer.groups)), probability, hypotheses,
        evidence.candidates[best].hypothesis, evidence.material_mps2, evidence.reference_mps2,
        explained, left, evidence.interval(evidence.left(best, everything)),
        float(np.sqrt(max(highest, left.high, evidence.material_power(1.0)))),
        {e: evidence.interval(evidence.gain(best, best - {e}, everything)) for e in best},
        _follows(evidence, rest))


def _named(answer: _Answer) -> list[frozenset[str]]:
    """Return the sets of effects that an answer stands for."""
    if answer.status == 'unknown':
        return [frozenset({UNKNOWN})]
    return [answer.effects | set(choice) for choice in product(*answer.groups)]


def _probabilities(answer: _Answer, votes: Mapping[_Answer, int],
                   reliability: Callable[[float], float]
                   ) -> tuple[float, tuple[WeightedHypothesis, ...]]:
    """Return the probability of the answer, and of all sets, none above the answer's."""
    named = set(_named(answer))
    shares: dict[frozenset[str], float] = {}
    for other, count in votes.items():
        sets = _named(other)
        for effects in sets:
            shares[effects] = shares.get(effects, 0.0) + count / len(sets)
    total = sum(shares.values())
    agreed = sum(v for e, v in shares.items() if e in named)
    probability = reliability(agreed / total)
    weights = {e: v / (total - agreed) * (1 - probability)
               for e, v in shares.items() if e not in named}
    largest = max(weights.values(), default=0.0)
    if largest > probability:
        weights = {e: min(v, probability) for e, v in weights.items()}
    for effects in named:
        weights[effects] = probability / len(named)
    missing = 1.0 - sum(weights.values())
    if missing > 1e-12:
        remaining = frozenset(() if answer.status == 'unknown' else {UNKNOWN})
        weights[remaining] = weights.get(remaining, 0.0) + missing
    return probability, tuple(sorted((WeightedHypothesis(tuple(sorted(e)), float(w))
                                      for e, w in weights.items()),
                                     key=lambda h: -h.probability))


def _follows(evidence: Evidence, rest: Rest) -> tuple[str, ...]:
    """Return the dimensions that alone predict half as much as the best one, or more."""
    power = {d: float(evidence.mean(b)[0]) for d, b in rest.by_dimension.items()}
    largest = max(power.values(), default=0.0)
    return tuple(sorted((d for d, p in power.items() if p > 0 and p >= largest / 2),
                        key=lambda d: -power[d]))
