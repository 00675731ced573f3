# SPDX-License-Identifier: Apache-2.0
"""
The rules that weigh sets of effects by their held-out figures.

Explained power P is by how much a set of effects lowers the held-out mean square. A set is a
candidate where each of its effects is needed: without it materially less is explained, and the
samples are less probable, also where the form of the other effects may err. The same rules weigh
all blocks and each draw of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TYPE_CHECKING

from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import ProofVariable
from adxl_ros.report.quantities import Interval
import numpy as np

if TYPE_CHECKING:
    from adxl_ros.diagnose.held_out import HeldOut, HeldOutFits
    from adxl_ros.diagnose.remainder import Remainder

HEALTHY = ''  # The drift of a healthy unit's noise
_SHARE_OF_SET = 0.03
"""Share of the explained power that a drift beside exact effects must hold. Chosen: a sixth of the
amplitude."""
SHARE_OF_FORM = 0.1
"""Share of the explained power that no error of form holds. Chosen: a third of the amplitude,
three standard deviations of such an error."""
_FORM_AT_REST = SHARE_OF_FORM**2
"""Share of the explained power by which a set may make rests worse: a tenth of its amplitude may
be an error of its form."""
_REST_ERRORS = 2.0
"""The same in standard errors: one set in 40 exceeds it by chance."""
_NATS = 3.0  # Held-out log likelihood that a further effect must gain: a ratio of 20
_LOWEST = 0.05  # Quantile at the lower end of a 90 % interval
_HIGHEST = 0.95  # Quantile at its upper end
_SHOWN_BY_POSE = {
    ProofVariable.OWN_FORCE,
    ProofVariable.CROSS_FORCE,
    ProofVariable.FORCE_Z,
    ProofVariable.ALPHA,
    ProofVariable.BETA,
}
"""Variables over which an effect that only changes with the pose shows."""
NOTHING: frozenset[str] = frozenset()
"""The set without effects: the baseline."""


class SimulatedAgain(NamedTuple):
    """What a set leaves when it is simulated; sums over samples, mean over axes, (m/s²)²."""

    # Squares with the sizes that are printed, without its nuisance parameters, by block, (blocks,)
    printed: np.ndarray
    # Increase of the squares of the rests beside a simulation without effects, by rest, (rests,)
    more_at_rest: np.ndarray
    resting: float  # Number of samples at rest
    at_bound: bool  # Whether a size is at the end of what its parameter can have


class Figure(NamedTuple):
    """A figure that the rule weighs: a difference of power, (m/s²)², or log likelihood."""

    value: float
    low: float  # Lower end of its interval over draws; within one draw the value itself

    @property
    def predicts(self) -> bool:
        """Whether samples are so much more probable, beyond the interval."""
        return self.value > _NATS and self.low > 0


@dataclass(frozen=True)
class Evidence:
    """What the rule weighs: all blocks, with draws of them for the intervals, or one draw."""

    # Sets of effects, the empty one among them, by the drift that the noise may have
    candidates: Mapping[frozenset[str], Mapping[str, HeldOutFits]]
    counts: np.ndarray  # Samples by block, (blocks,)
    # How often each block is drawn, (draws, blocks); the first row is what the rule is applied to
    weights: np.ndarray
    material_mps2: float  # Material amplitude, m/s²
    # Rms error of the reference, m/s²: its steps return with each pose, as an effect would
    reference_mps2: float
    errs_in_motion: bool  # Whether it errs in motion, too, as a robot does
    fades: bool  # Whether the reference lacks motion
    wanders: bool  # Whether the reference may drift slowly, so that no drift is of the sensor
    floor_mps2: float  # Noise floor, m/s²; infinite where it is assumed
    # Effects of each set none of whose sizes differs from 0
    sizeless: Mapping[frozenset[str], frozenset[str]] = field(default_factory=dict)
    # The sets that could be the answer, simulated again, not linearised
    again: Mapping[frozenset[str], SimulatedAgain] = field(default_factory=dict)
    is_draw: bool = False  # Whether it is one draw, whose figures have no interval
    noise: str = HEALTHY  # The drift in whose noise sets are compared

    def draw(self, number: int) -> Evidence:
        """Return one draw of the blocks."""
        return replace(self, weights=self.weights[number : number + 1], is_draw=True)

    def figure(self, draws: np.ndarray) -> Figure:
        """Return what the rule weighs of a figure with one value for each draw."""
        value = float(draws[0])
        return Figure(value, value if self.is_draw else float(np.quantile(draws, _LOWEST)))

    def left(self, effects: frozenset[str]) -> np.ndarray:
        """Return the power above the noise floor that a set leaves, by draw."""
        return self.mean(self.candidates[effects][HEALTHY].figures.squares) - self.floor_mps2**2

    def material_power(self, pose_share: float) -> float:
        """Return the power that a user would act on and that is not of the reference, (m/s²)²."""
        share = 1.0 if self.errs_in_motion else pose_share
        return self.material_mps2**2 + share * self.reference_mps2**2

    def mean(self, by_block: np.ndarray) -> np.ndarray:
        """Return the mean over samples of sums by block, by draw."""
        return self.weights @ by_block / np.maximum(self.weights @ self.counts, 1.0)

    def is_refuted(self, effects: frozenset[str]) -> bool:
        """
        Determine whether a set cannot be, however much it explains.

        The rests of the same recording contradict it, or a size is at its bound.
        """
        if not effects or effects not in self.again:
            return False
        again = self.again[effects]
        more = again.more_at_rest
        count = max(again.resting, 1.0)
        error = float(np.sqrt(np.sum(more**2))) / count
        explained = max(float(self.gain(effects, NOTHING)[0]), 0.0)
        smallest = max(self.material_power(1.0), _FORM_AT_REST * explained)
        return again.at_bound or float(more.sum()) / count > smallest + _REST_ERRORS * error

    def leaves_more(self, effects: frozenset[str], other: frozenset[str]) -> bool:
        """Determine whether a set, as it is printed, leaves materially more than another."""
        if not {effects, other} <= {*self.again}:
            return False
        more = self.figure(self.mean(self.again[effects].printed - self.again[other].printed))
        return more.value > self.material_power(1.0) and more.low > 0

    def drift_power(self, effects: frozenset[str], drifts: Sequence[str]) -> float:
        """Return the power of the first drift beside a set, (m/s²)²; 0 without one."""
        fits = self.candidates[effects]
        if not drifts or drifts[0] not in fits:
            return 0.0
        return fits[drifts[0]].drift_mps2 ** 2

    def gain(self, more: frozenset[str], less: frozenset[str]) -> np.ndarray:
        """Return by how much one set explains more power than another, by draw."""
        return self.mean(self._figures(less).squares - self._figures(more).squares)

    def nats(self, more: frozenset[str], less: frozenset[str]) -> np.ndarray:
        """Return by how much a set makes held-out samples more probable, by draw."""
        gained = self._figures(more).log_likelihood - self._figures(less).log_likelihood
        return self.weights @ gained

    def drift_nats(self, effects: frozenset[str], drift: str) -> np.ndarray:
        """Return by how much a drift makes held-out samples more probable beside a set."""
        fits = self.candidates[effects]
        drifting = fits[drift].figures
        healthy = fits[HEALTHY].figures
        return self.weights @ (drifting.log_likelihood - healthy.log_likelihood)

    def is_beyond_form(self, effects: frozenset[str], others: frozenset[str]) -> bool:
        """Determine whether a set explains materially more than others with errors of form."""
        # No error of form holds a tenth of the power, and most effects of a set hold more.
        explained = float(self.gain(effects, NOTHING)[0])
        if float(self.gain(effects, others)[0]) > SHARE_OF_FORM * explained:
            return True
        # A weak effect that all blocks do not show is not looked for in draws of them.
        if self.is_draw and others not in self._fits(effects).beside_errors:
            return False
        more, less = (self._fits(e).beside_form_errors(others) for e in (effects, others))
        gained = self.figure(self.weights @ (more.log_likelihood - less.log_likelihood))
        lost = float(self.mean(less.squares - more.squares)[0])
        return gained.predicts and lost > self.material_mps2**2

    def _fits(self, effects: frozenset[str]) -> HeldOutFits:
        """Return the fits of a set in the present noise, or in healthy noise without it."""
        fits = self.candidates[effects]
        return fits[self.noise if self.noise in fits else HEALTHY]

    def _figures(self, effects: frozenset[str]) -> HeldOut:
        """Return the figures of a set in the present noise, or in healthy noise without it."""
        return self._fits(effects).figures

    def interval(self, draws: np.ndarray) -> Interval:
        """Return the value of all blocks with the interval of the draws."""
        low, high = np.quantile(draws[1:], [_LOWEST, _HIGHEST], method='nearest')
        return Interval(float(draws[0]), float(min(low, draws[0])), float(max(high, draws[0])))


def _is_needed(evidence: Evidence, effects: frozenset[str], effect: str) -> bool:
    """Determine whether a set loses a material part of what it explains without an effect."""
    others = effects - {effect}
    if effect in evidence.sizeless.get(effects, ()) or others not in evidence.candidates:
        return False
    lost = evidence.figure(evidence.gain(effects, others))
    nats = evidence.figure(evidence.nats(effects, others))
    proof = {*effect_named(effect).diagnosis.proof}
    by_pose = bool(proof) and proof <= _SHOWN_BY_POSE
    is_certain = nats.value > _NATS and max(nats.low, lost.low) > 0
    return is_certain and lost.value > evidence.material_power(float(by_pose))


def _is_minimal(evidence: Evidence, effects: frozenset[str]) -> bool:
    """Determine whether all effects of a set are needed, beyond errors of form of the others."""
    return all(_is_needed(evidence, effects, e) for e in effects) and all(
        evidence.is_beyond_form(effects, effects - {e}) for e in effects
    )


def minimal_sets(evidence: Evidence) -> list[frozenset[str]]:
    """
    Return the sets all of whose effects are needed, the most probable first.

    Those that the rests refute are dropped; so is an alternative to the first one, or the first
    one itself, that as it is printed leaves materially more than the other.
    """
    kept = [
        effects
        for effects in evidence.candidates
        if _is_minimal(evidence, effects) and not evidence.is_refuted(effects)
    ]
    kept.sort(key=lambda effects: -evidence.nats(effects, NOTHING)[0])
    first = kept[0]
    alternatives = [first]
    for other in kept[1:]:
        is_less_probable = evidence.figure(evidence.nats(first, other)).predicts
        if len(other) == len(first) and not is_less_probable:
            alternatives.append(other)
    dropped = [a for a in alternatives if any(evidence.leaves_more(a, b) for b in alternatives)]
    return [effects for effects in kept if effects not in dropped]


def drifts_beside(evidence: Evidence, effects: frozenset[str], remainder: Remainder) -> list[str]:
    """
    Return the drifts, the best first, that the noise beside a set needs; none for most.

    What flexible functions predict as well is an error of form, and no drift; nor is the motion
    that a smooth reference lacks.
    """
    candidate = evidence.candidates[effects]
    nats = {d: evidence.drift_nats(effects, d) for d in candidate if d != HEALTHY}
    drifts = sorted(nats, key=lambda d: -nats[d][0])
    if not drifts or evidence.fades:
        return []
    best = nats[drifts[0]]
    explained = float(evidence.gain(effects, NOTHING)[0])
    exact = all(effect_named(e).exact for e in effects)
    share = _SHARE_OF_SET if exact else SHARE_OF_FORM
    smallest = max(evidence.material_mps2**2, share * explained)
    of_functions = evidence.weights @ remainder.steady_log_likelihood
    is_material = candidate[drifts[0]].drift_mps2 ** 2 > smallest
    is_likely = evidence.figure(best).predicts
    beats_functions = evidence.figure(best - of_functions).predicts
    if not (is_material and is_likely and beats_functions):
        return []
    others = [d for d in drifts[1:] if not evidence.figure(best - nats[d]).predicts]
    return [drifts[0], *others]
