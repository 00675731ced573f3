# SPDX-License-Identifier: Apache-2.0
"""
The verdict: everything it says follows from held-out figures that the report shows.

`held_out` says what a set of effects leaves of blocks that it was not fitted to, `remainder` what
flexible functions predict of that, and `weighing` which sets of effects are candidates. Here one
rule says from these figures what is named. Material is what a user would act on. The same rule,
applied to blocks drawn with replacement, says how sure it is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import NamedTuple

from adxl_ros.diagnose.evidence import BLOCKS
from adxl_ros.diagnose.remainder import Remainder
from adxl_ros.diagnose.weighing import (
    beside_form,
    drifts_beside,
    Evidence,
    form_of,
    HEALTHY,
    is_drifting,
    minimal_sets,
    most_probable_set,
    NOTHING,
    SHARE_OF_FORM,
    SimulatedAgain,
)
from adxl_ros.report.quantities import Interval
import numpy as np

UNKNOWN = 'unknown'  # Name of what no effect of the library explains
MATERIAL_MG = 0.1  # Amplitude that a user would act on, mg, unless `--material` states another one
MATERIAL_SHARE_OF_NOISE = 0.1
"""Share of the noise that a user would act on: it adds half a per cent to the rms."""
_SMALLEST_P = 0.001
"""Probability of the increments of a drift below which they are of something else. Chosen: one
error in 1000."""
_REPEATED = (0.5, 0.8, 0.95, 1.0)
"""Shares of the draws that repeat a verdict, at which `_RIGHT` is known."""
_RIGHT = {
    'explained': (0.46, 0.46, 0.65, 0.92),
    'inseparable': (0.40, 0.53, 0.53, 0.53),
    'no_gap': (0.81, 0.81, 0.93, 0.93),
    'partly': (0.17, 0.32, 0.70, 0.82),
    'unknown': (0.59, 0.59, 0.59, 0.85),
}
"""How often verdicts that so many draws repeat were right, by status. Measured on 320 cases, 200
of them in real recordings: docs/measurements/verdict_probabilities.txt."""
_POSE = {'force', 'cross_force', 'alpha_rad', 'beta_rad'}
"""Dimensions that only change with the pose."""
_DRAWS = 200  # Draws of blocks. Chosen: the 5 % quantile has 10 draws below it


class WeightedHypothesis(NamedTuple):
    """A set of effects, 'unknown' perhaps among them, and its probability."""

    effects: tuple[str, ...]
    probability: float


def normalised(weights: Mapping[tuple[str, ...], float]) -> tuple[WeightedHypothesis, ...]:
    """Return sets by falling probability, which sums to 1."""
    total = sum(weights.values())
    return tuple(
        sorted(
            (WeightedHypothesis(effects, weight / total) for effects, weight in weights.items()),
            key=lambda h: (-h.probability, len(h.effects), h.effects),
        )
    )


@dataclass(frozen=True)
class Verdict:
    """The result of a diagnosis; powers are mean squares over samples and axes, (m/s²)²."""

    status: str  # 'no_gap', 'explained', 'partly', 'inseparable', 'unknown' or 'insufficient'
    effects: tuple[str, ...]  # Effects that are named for certain
    groups: tuple[tuple[str, ...], ...]  # Sets of inseparable effects, one of which acts
    probability: float  # How often such a verdict is right
    repeated: float  # Share of draws of the blocks that name the same
    # Sets of effects by falling probability, which sums to 1
    hypotheses: tuple[WeightedHypothesis, ...]
    best: frozenset[str]  # The set whose closing the report states
    material_mps2: float  # Material amplitude, m/s²
    # Rms error of the reference, m/s², that what follows the pose must exceed, too
    reference_mps2: float
    explained: Interval  # Explained power of the best set
    remainder: Interval  # Reproducible remainder beside it
    left: Interval  # Power that it leaves above the noise floor, repeating or not
    # Part of it that shows only while joints move, m/s²: vibration of the motor or the mount
    vibration_mps2: float
    # Amplitude above which a gap of any kind would have shown, m/s²
    upper_limit_mps2: float
    # Part of it that is in no gap, m/s²: zero-g, scale factor, filter and latency differ from the
    # parameter file by no more than those of a healthy unit may
    tolerated_mps2: float
    # Explained power that is lost without each effect of the best set
    lost_without: Mapping[str, Interval] = field(default_factory=dict)
    # Dimensions that the reproducible remainder follows, the strongest first
    remainder_follows: tuple[str, ...] = ()

    @property
    def named(self) -> tuple[str, ...]:
        """Effects that are named, for certain or in groups."""
        return tuple(dict.fromkeys((*self.effects, *sum(self.groups, ()))))

    @property
    def closes(self) -> bool:
        """Whether it names effects."""
        return self.status in ('explained', 'partly', 'inseparable')

    @property
    def remaining(self) -> float:
        """Power beside the best set: what repeats, or all above the noise where that is more."""
        above = self.left.value if self.left.low > 0 else 0.0
        return max(self.remainder.value, above)

    @property
    def explained_share(self) -> float:
        """Share of the power above the noise that the best set explains; 1 without any."""
        total = max(self.explained.value, 0.0) + self.remaining
        return 1.0 - self.remaining / total if total > 0 else 1.0


def block_weights(seed: int) -> np.ndarray:
    """Return how often each block is drawn, (1 + draws, blocks); the first row takes each once."""
    drawn = np.random.default_rng(seed).integers(0, BLOCKS, (_DRAWS, BLOCKS))
    counts = np.apply_along_axis(np.bincount, 1, drawn, minlength=BLOCKS)
    return np.concatenate([np.ones((1, BLOCKS)), counts])


class NoiseCause(NamedTuple):
    """An effect that shows in the noise, not in the mean."""

    effect: str
    # Mean square that it adds, (m/s²)²; infinite for repeated samples, which hide what was
    power_mps2: float
    is_left_out: bool  # Whether its samples are not among the compared ones


class _Answer(NamedTuple):
    """Status, certain effects, and groups of inseparable ones."""

    status: str
    effects: frozenset[str] = NOTHING
    groups: frozenset[frozenset[str]] = frozenset()


class _Powers(NamedTuple):
    """What the best set explains and leaves, (m/s²)²."""

    explained: float  # Explained power
    above: float  # What is left above the noise floor, repeating or not; 0 if that is not material
    repeats: float  # What repeats beside the set and the drifts; 0 where it is not material
    drift: float  # Power of the first drift
    drifts: Sequence[str]  # The drifts of the noise, the best first

    @property
    def remaining(self) -> float:
        """Return what is left beside effects: what repeats, or all that no drift explains."""
        return self.repeats if self.drifts else max(self.repeats, self.above)


def _powers(
    evidence: Evidence,
    best: frozenset[str],
    found: _BestSet,
    remainder_material: float,
    of_noise: float,
) -> _Powers:
    """Weigh what the best set and the noise leave, and drop the drifts where it is none."""
    explained = max(evidence.explained(best), 0.0)
    left = evidence.value(evidence.left(best))
    above = left - of_noise if evidence.is_above_floor(best, of_noise) else 0.0
    repeats = evidence.figure(evidence.mean(found.remainder.squares))
    material = repeats.value if found.repeats and repeats.low > remainder_material else 0.0
    if not found.drifts:
        return _Powers(explained, above, material, 0.0, ())
    if not found.is_random:
        # The fit of a drift takes up what is none, too.
        return _Powers(explained, above, max(repeats.value, above), 0.0, ())
    drift = evidence.candidates[best][found.drifts[0]].drift_mps2 ** 2
    return _Powers(explained, above, material, drift, found.drifts)


def _rivals(
    evidence: Evidence, best: frozenset[str], others: Sequence[frozenset[str]], powers: _Powers
) -> list[frozenset[str]]:
    """
    Return the other sets that could be the answer in place of the best one.

    The order of two sets could be that of their errors of form, where these are as large as what
    repeats beside the best set; or that of errors of the reference in motion. Beside a drift
    powers scatter, and the likelihood decides.
    """
    of_reference = evidence.reference_mps2**2 if evidence.errs_in_motion else 0.0
    smallest = max(powers.repeats, of_reference)
    rivals = []
    for other in others:
        is_less_probable = evidence.figure(evidence.nats(best, other)).predicts
        explains_less = evidence.figure(evidence.gain(best, other)).value > smallest
        is_beaten = is_less_probable and (explains_less or bool(powers.drifts))
        is_alike = len(other) == len(best) and not is_beaten
        if is_alike and not evidence.leaves_more(other, best):
            rivals.append(other)
    return rivals


def _groups(best: frozenset[str], rivals: Sequence[frozenset[str]]) -> frozenset[frozenset[str]]:
    """Return each effect of the best set with those that rivals have in its place."""
    groups = set()
    for effect in best:
        instead = [other - best for other in rivals if effect not in other]
        if any(instead):
            groups.add(frozenset({effect}).union(*instead))
    return frozenset(groups)


def _answer(
    evidence: Evidence,
    found: _BestSet,
    remainder_material: float,
    in_noise: Sequence[NoiseCause],
) -> _Answer:
    """Apply the rule to the figures of all blocks, or of one draw of them."""
    best, *others = minimal_sets(evidence)
    detected = frozenset(cause.effect for cause in in_noise)
    # Only samples that are compared say what is left.
    of_noise = sum(cause.power_mps2 for cause in in_noise if not cause.is_left_out)
    powers = _powers(evidence, best, found, remainder_material, of_noise)
    # A reference that lacks motion leaves more than a floor at rest.
    only_repeats = evidence.fades or not best
    of_sensor = max(powers.repeats, powers.remaining - evidence.vibration(best))
    unexplained = powers.repeats if only_repeats else of_sensor
    if unexplained > powers.explained + powers.drift + of_noise:
        return _Answer('unknown')
    named = frozenset(() if evidence.wanders else powers.drifts)
    if not best | detected | named:
        # What neither repeats nor is noise at rest is no gap only while the noise is larger.
        of_gap = evidence.value(evidence.left(best)) - of_noise
        is_much = of_gap > max(evidence.floor.values[0], evidence.material_power(1.0))
        return _Answer('unknown' if is_much else 'no_gap')
    groups = _groups(best, _rivals(evidence, best, others, powers))
    certain = best.difference(*groups) | detected
    if len(named) > 1:
        groups |= {named}
        certain -= named
    else:
        certain |= named
    remaining = powers.remaining if best else powers.repeats
    is_partly = remaining > SHARE_OF_FORM * (powers.explained + remaining)
    if groups and not detected and unexplained > SHARE_OF_FORM * (powers.explained + unexplained):
        # None of the rivals explains what is left: the set only imitates it. What the noise
        # shows would be lost with it.
        return _Answer('unknown')
    if groups:
        return _Answer('inseparable', certain, groups)
    return _Answer('partly' if is_partly else 'explained', certain)


class _BestSet(NamedTuple):
    """The most probable set, and what it and the noise leave."""

    evidence: Evidence  # The figures, in the noise beside the set
    effects: frozenset[str]
    remainder: Remainder
    drifts: Sequence[str] = ()  # The drifts of the noise, the best first
    # Whether the noise is a drift by one residual: draws would repeat the test of a largest value
    is_random: bool = True
    repeats: bool = True  # Whether what repeats is no part of a drift


def _best_set(
    evidence: Evidence,
    remainder_of: Callable[[frozenset[str], str], Remainder],
    simulate_again: Callable[[frozenset[str]], SimulatedAgain] | None,
) -> _BestSet:
    """Find the most probable set, and compare sets in noise that drifts where it is needed."""

    def simulated(weighed: Evidence) -> Evidence:
        if simulate_again is None:
            return weighed
        sets = filter(None, minimal_sets(weighed))
        return replace(weighed, again={effects: simulate_again(effects) for effects in sets})

    def nats(drifting: Evidence) -> float:
        best = most_probable_set(drifting)
        return drifting.value(drifting.drift_nats(best, drifting.noise, healthy))

    evidence = simulated(evidence)
    healthy = most_probable_set(evidence)
    # In noise that drifts, sets explain less than they seem to beside white noise. The motion
    # that a smooth reference lacks is no drift.
    every = () if evidence.fades else evidence.candidates[healthy]
    in_drifts = [replace(evidence, noise=drift) for drift in every if drift != HEALTHY]
    likeliest = max(in_drifts, key=nats, default=None)
    if likeliest is None or not is_drifting(likeliest, most_probable_set(likeliest), healthy):
        return _BestSet(evidence, healthy, remainder_of(healthy, HEALTHY))
    evidence = simulated(likeliest)
    best = most_probable_set(evidence)
    remainder = remainder_of(best, evidence.noise)
    follows_more = evidence.follows(remainder, beside_form(best))
    return _BestSet(
        evidence,
        best,
        remainder,
        drifts_beside(evidence, best),
        is_random=remainder.drift_p >= _SMALLEST_P and not follows_more,
        repeats=evidence.follows(remainder, form_of(best)),
    )


def decide(
    evidence: Evidence,
    remainder_of: Callable[[frozenset[str], str], Remainder],
    in_noise: Sequence[NoiseCause],
    simulate_again: Callable[[frozenset[str]], SimulatedAgain] | None = None,
) -> Verdict:
    """
    Apply the rule to the figures, and to draws of their blocks.

    in_noise: the effects that show in the noise.
    simulate_again: simulates a set that could be the answer.
    """
    found = _best_set(evidence, remainder_of, simulate_again)
    evidence, best, remainder = found.evidence, found.effects, found.remainder
    power = {d: evidence.value(evidence.mean(b)) for d, b in remainder.by_dimension.items()}
    repeats = evidence.mean(remainder.squares).interval
    # What follows the pose may be of the reference.
    pose = max((power[d] for d in _POSE & {*power}), default=0.0)
    pose_share = float(np.clip(pose / repeats.value, 0.0, 1.0)) if repeats.value > 0 else 0.0
    remainder_material = evidence.material_power(pose_share)

    def answer_of(weighed: Evidence) -> _Answer:
        return _answer(weighed, found, remainder_material, in_noise)

    drawn = [answer_of(evidence.draw(number)) for number in range(1, len(evidence.weights))]
    votes = _votes(drawn)
    # What fewer draws support than that nothing is named is not stated (Breiman 1996).
    possible = (answer_of(evidence), _Answer('unknown'), _Answer('no_gap'))
    answer = max(possible, key=lambda a: _support(a, votes))
    probability, hypotheses = _probabilities(answer, votes)
    highest = max(evidence.gain(e, NOTHING).interval.high for e in evidence.candidates)
    strongest = sorted(power, key=lambda d: -power[d])
    tolerated = evidence.value(evidence.mean(evidence.candidates[NOTHING][HEALTHY].tolerated))
    unseen = max(highest, repeats.high, evidence.material_power(1.0))
    return Verdict(
        status=answer.status,
        effects=tuple(sorted(answer.effects)),
        groups=tuple(sorted(tuple(sorted(g)) for g in answer.groups)),
        probability=probability,
        repeated=_support(answer, votes),
        hypotheses=hypotheses,
        best=best,
        material_mps2=evidence.material_mps2,
        reference_mps2=evidence.reference_mps2,
        explained=evidence.gain(best, NOTHING).interval,
        remainder=repeats,
        left=evidence.left(best).interval,
        vibration_mps2=evidence.vibration(best) ** 0.5,
        upper_limit_mps2=(unseen + tolerated) ** 0.5,
        tolerated_mps2=tolerated**0.5,
        lost_without={e: evidence.lost(best, best - {e}).interval for e in sorted(best)},
        remainder_follows=tuple(
            d for d in strongest if power[d] > 0 and power[d] >= power[strongest[0]] / 2
        ),
    )


def _sets(answer: _Answer) -> list[frozenset[str]]:
    """Return the sets of effects that an answer stands for."""
    if answer.status == 'unknown':
        return [frozenset({UNKNOWN})]
    return [answer.effects | set(choice) for choice in product(*answer.groups)]


def _votes(drawn: Sequence[_Answer]) -> dict[frozenset[str], float]:
    """Return the share of draws that name a set, by set."""
    votes = dict[frozenset[str], float]()
    for sets in map(_sets, drawn):
        for effects in sets:
            votes[effects] = votes.get(effects, 0.0) + 1 / len(sets) / len(drawn)
    return votes


def _support(answer: _Answer, votes: Mapping[frozenset[str], float]) -> float:
    """Return the share of draws that name what an answer stands for."""
    return sum(votes.get(effects, 0.0) for effects in {*_sets(answer)})


def probability_of(status: str, repeated: float) -> float:
    """Return how often verdicts of a status that so many draws repeat were right."""
    return float(np.interp(repeated, _REPEATED, _RIGHT[status]))


def _probabilities(
    answer: _Answer, votes: Mapping[frozenset[str], float]
) -> tuple[float, tuple[WeightedHypothesis, ...]]:
    """Return the probability of the answer, and of all sets; no other named one is above it."""
    named, agreed = set(_sets(answer)), _support(answer, votes)
    probability = probability_of(answer.status, agreed)
    highest = probability / len(named)
    weights = {
        e: min(share / (1 - agreed) * (1 - probability), highest)
        for e, share in votes.items()
        if e not in named
    }
    weights |= dict.fromkeys(named, highest)
    missing = 1.0 - sum(weights.values())
    unnamed = frozenset(() if answer.status == 'unknown' else {UNKNOWN})
    if missing > 1e-12:
        weights[unnamed] = weights.get(unnamed, 0.0) + missing
    return probability, normalised({tuple(sorted(e)): w for e, w in weights.items()})
