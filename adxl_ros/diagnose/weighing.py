# SPDX-License-Identifier: Apache-2.0
"""
The rules that weigh sets of effects by their held-out figures.

Explained power P is by how much a set of effects lowers the held-out mean square. A set is a
candidate where each of its effects is needed: without it materially less is explained, and the
samples are less probable, also where the form of the other effects may err. The same rules weigh
all blocks and each draw of them.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, wraps
from typing import cast, NamedTuple, TYPE_CHECKING, TypeVar

from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import FormDimension, ProofVariable
from adxl_ros.report.quantities import Interval
import numpy as np

if TYPE_CHECKING:
    from adxl_ros.diagnose.held_out import HeldOut, HeldOutFits
    from adxl_ros.diagnose.remainder import Remainder

_T = TypeVar('_T', bound='Callable[..., ByDraw]')
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
_LASTING_SHARE = 0.5
"""Share of its log likelihood that a set gains in quarters that are held out whole, if it is not
sure to gain at all. Chosen: a set names most of a gap."""
_NATS = 3.0  # Held-out log likelihood that a further effect must gain: a ratio of 20
_DRIFT_LIMIT = 5.0
"""Expected mean square of a random walk about its mean, divided by the one in a recording, that
one walk in 20 exceeds. Derived from the random walk."""
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


@dataclass(frozen=True, eq=False)
class ByDraw:
    """A figure of all blocks, and of each draw of them."""

    values: np.ndarray  # Of all blocks, then of each draw, (1 + draws,)

    @cached_property
    def low(self) -> float:
        """Lower end of its interval."""
        return float(np.quantile(self.values, _LOWEST))

    @property
    def interval(self) -> Interval:
        """Return the value of all blocks with the interval of the draws."""
        value = float(self.values[0])
        low, high = np.quantile(self.values[1:], [_LOWEST, _HIGHEST], method='nearest')
        return Interval(value, min(float(low), value), max(float(high), value))


class SimulatedAgain(NamedTuple):
    """What a set leaves when it is simulated; sums over samples, mean over axes, (m/s²)²."""

    # Squares with the sizes that are printed, without its nuisance parameters, by block, (blocks,)
    printed: np.ndarray
    # Increase of the squares of the rests beside a simulation without effects, by rest, (rests,)
    more_at_rest: np.ndarray
    resting: float  # Number of samples at rest
    at_bound: bool  # Whether a size is at the end of what its parameter can have
    # Squares of vibration that shows only in motion, so that it is not of the sensor, (blocks,)
    vibration: np.ndarray


class Figure(NamedTuple):
    """A figure that the rule weighs: a difference of power, (m/s²)², or log likelihood."""

    value: float
    low: float  # Lower end of its interval over draws; within one draw the value itself

    @property
    def predicts(self) -> bool:
        """Whether samples are so much more probable, beyond the interval."""
        return self.value > _NATS and self.low > 0


def _once(method: _T) -> _T:
    """Keep a figure, which all draws ask for."""

    @wraps(method)
    def kept(evidence: Evidence, *args: object) -> ByDraw:
        key = (method.__name__, evidence.noise, *args)
        if key not in evidence._known:
            evidence._known[key] = method(evidence, *args)
        return evidence._known[key]

    return cast(_T, kept)


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
    # Noise floor by draw of its own pieces, (m/s²)²; infinite where nobody knows how sure it is
    floor: ByDraw
    # Effects of each set none of whose sizes differs from 0
    sizeless: Mapping[frozenset[str], frozenset[str]] = field(default_factory=dict)
    # The sets that could be the answer, simulated again, not linearised
    again: Mapping[frozenset[str], SimulatedAgain] = field(default_factory=dict)
    number: int = 0  # Number of the draw; 0 for all blocks
    noise: str = HEALTHY  # The drift in whose noise sets are compared
    _known: dict[tuple, ByDraw] = field(default_factory=dict)  # Figures that were asked for

    def draw(self, number: int) -> Evidence:
        """Return one draw of the blocks."""
        return replace(self, number=number)

    def value(self, draws: ByDraw) -> float:
        """Return the value of a figure."""
        return float(draws.values[self.number])

    def figure(self, draws: ByDraw) -> Figure:
        """Return what the rule weighs of a figure."""
        value = self.value(draws)
        return Figure(value, value if self.number else draws.low)

    def left(self, effects: frozenset[str]) -> ByDraw:
        """Return the power above the noise floor that a set leaves."""
        return ByDraw(self.squares(effects).values - self.floor.values)

    def is_above_floor(self, effects: frozenset[str], of_noise: float) -> bool:
        """Determine whether a set leaves materially more than the noise floor can be."""
        left = self.figure(self.squares(effects)).low - self.floor.interval.high
        return left - of_noise > self.material_power(1.0)

    def material_power(self, pose_share: float) -> float:
        """Return the power that a user would act on and that is not of the reference, (m/s²)²."""
        share = 1.0 if self.errs_in_motion else pose_share
        return self.material_mps2**2 + share * self.reference_mps2**2

    def total(self, by_block: np.ndarray) -> ByDraw:
        """Return a sum over blocks."""
        return ByDraw(self.weights @ by_block)

    def mean(self, by_block: np.ndarray) -> ByDraw:
        """Return the mean over samples of sums by block."""
        return ByDraw(self.weights @ by_block / np.maximum(self.weights @ self.counts, 1.0))

    def is_refuted(self, effects: frozenset[str]) -> bool:
        """
        Determine whether a set cannot be, however much it explains.

        The rests of the same recording contradict it, a size is at its bound, or what it gains
        does not last: in whole quarters it gains less than half, and perhaps nothing.
        """
        if not effects:
            return False
        lasting = self.figure(self._nats_by_quarter(effects))
        gained = self.value(self.nats(effects, NOTHING))
        if lasting.low <= 0 and lasting.value < _LASTING_SHARE * gained:
            return True
        if effects not in self.again:
            return False
        again = self.again[effects]
        more = again.more_at_rest
        count = max(again.resting, 1.0)
        error = float(np.sqrt(np.sum(more**2))) / count
        explained = max(self.explained(effects), 0.0)
        smallest = max(self.material_power(1.0), _FORM_AT_REST * explained)
        if self.noise != HEALTHY:
            smallest += self.candidates[effects][self.noise].drift_mps2 ** 2
        return again.at_bound or float(more.sum()) / count > smallest + _REST_ERRORS * error

    def leaves_more(self, effects: frozenset[str], other: frozenset[str]) -> bool:
        """Determine whether a set, as it is printed, leaves materially more than another."""
        if not {effects, other} <= {*self.again}:
            return False
        more = self.figure(self._more_as_printed(effects, other))
        return more.value > self.material_power(1.0) and more.low > 0

    @_once
    def _more_as_printed(self, effects: frozenset[str], other: frozenset[str]) -> ByDraw:
        """Return the power that a set, as it is printed, leaves more than another."""
        return self.mean(self.again[effects].printed - self.again[other].printed)

    def vibration(self, effects: frozenset[str]) -> float:
        """Return the power of the vibration of the stage that a set leaves, (m/s²)²."""
        if effects not in self.again:
            return 0.0
        left = max(self.value(self.left(effects)), 0.0)
        return float(np.clip(self.value(self._vibration(effects)), 0.0, left))

    @_once
    def _vibration(self, effects: frozenset[str]) -> ByDraw:
        """Return its power by draw, which may be more than what is left, or negative by chance."""
        return self.mean(self.again[effects].vibration)

    def follows(self, remainder: Remainder, dimensions: Collection[str]) -> bool:
        """
        Determine whether functions of any of some dimensions make held-out samples more probable.

        Each function of each axis is one more that might by chance.
        """
        tried = [row for d in dimensions for row in remainder.nats.get(d, ())]
        figures = [self.figure(self.total(row)) for row in tried]
        smallest = _NATS + np.log(max(len(tried), 1))
        return any(figure.value > smallest and figure.low > 0 for figure in figures)

    @_once
    def squares(self, effects: frozenset[str]) -> ByDraw:
        """Return the power that a set leaves, in healthy noise."""
        return self.mean(self.candidates[effects][HEALTHY].figures.squares)

    @_once
    def gain(self, more: frozenset[str], less: frozenset[str]) -> ByDraw:
        """Return by how much one set explains more power than another."""
        return self.mean(self._figures(less).squares - self._figures(more).squares)

    def explained(self, effects: frozenset[str]) -> float:
        """Return the power that a set explains."""
        return self.value(self.gain(effects, NOTHING))

    @_once
    def lost(self, effects: frozenset[str], part: frozenset[str]) -> ByDraw:
        """
        Return what a part of a set explains less.

        Beside a drift the squares scatter as it does, and the figure is by how much predictions
        differ.
        """
        if self.noise == HEALTHY:
            return self.gain(effects, part)
        return self.mean(self._fits(effects).squares_between(self._fits(part)))

    @_once
    def nats(self, more: frozenset[str], less: frozenset[str]) -> ByDraw:
        """Return by how much a set makes held-out samples more probable."""
        gained = self._figures(more).log_likelihood - self._figures(less).log_likelihood
        return self.total(gained)

    @_once
    def _nats_by_quarter(self, effects: frozenset[str]) -> ByDraw:
        """Return by how much a set makes quarters more probable that were held out as a whole."""
        return self.total(self._fits(effects).by_quarter - self._fits(NOTHING).by_quarter)

    @_once
    def drift_nats(self, effects: frozenset[str], drift: str, healthy: frozenset[str]) -> ByDraw:
        """Return by how much a set and a drift are likelier than a set with errors of form."""
        drifting = self.candidates[effects][drift].figures
        steady = self.candidates[healthy][HEALTHY].beside_form_errors(healthy)
        return self.total(drifting.log_likelihood - steady.log_likelihood)

    def is_beyond_form(self, effects: frozenset[str], others: frozenset[str]) -> bool:
        """Determine whether a set explains materially more than others with errors of form."""
        # No error of form holds a tenth of the power, and most effects of a set hold more.
        if self.value(self.lost(effects, others)) > SHARE_OF_FORM * self.explained(effects):
            return True
        # A weak effect that all blocks do not show is not looked for in draws of them.
        if self.number and others not in self._fits(effects).beside_errors:
            return False
        gained = self.figure(self._nats_beside_form(effects, others))
        lost = self.value(self._lost_beside_form(effects, others))
        return gained.predicts and lost > self.material_mps2**2

    @_once
    def _nats_beside_form(self, effects: frozenset[str], others: frozenset[str]) -> ByDraw:
        """Return by how much a set is likelier than others with errors of form."""
        more, less = (self._fits(e).beside_form_errors(others) for e in (effects, others))
        return self.total(more.log_likelihood - less.log_likelihood)

    @_once
    def _lost_beside_form(self, effects: frozenset[str], others: frozenset[str]) -> ByDraw:
        """Return what others with errors of form explain less."""
        more, less = (self._fits(e).beside_form_errors(others) for e in (effects, others))
        return self.mean(less.squares - more.squares)

    def _fits(self, effects: frozenset[str]) -> HeldOutFits:
        """Return the fits of a set in the present noise."""
        return self.candidates[effects][self.noise]

    def _figures(self, effects: frozenset[str]) -> HeldOut:
        """Return the figures of a set in the present noise."""
        return self._fits(effects).figures


def _is_shown_by_pose(effect: str) -> bool:
    """Return whether an effect only changes with the pose."""
    proof = {*effect_named(effect).diagnosis.proof}
    return bool(proof) and proof <= _SHOWN_BY_POSE


def _loses(evidence: Evidence, effects: frozenset[str], part: frozenset[str]) -> bool:
    """Determine whether a part of a set explains materially less."""
    lost = evidence.figure(evidence.lost(effects, part))
    nats = evidence.figure(evidence.nats(effects, part))
    by_pose = all(map(_is_shown_by_pose, effects - part))
    # Beside a drift, what is lost is a square, which is never below 0.
    is_certain = nats.low > 0 or (evidence.noise == HEALTHY and lost.low > 0)
    is_material = lost.value > evidence.material_power(float(by_pose))
    return nats.value > _NATS and is_certain and is_material


def _is_minimal(evidence: Evidence, effects: frozenset[str]) -> bool:
    """
    Determine whether all effects of a set are needed, beyond errors of form of the others.

    No smaller part of a set may be better than a larger one: it would be the one to beat.
    """
    without_one = [effects - {e} for e in effects]
    if evidence.sizeless.get(effects) or not {*without_one} <= {*evidence.candidates}:
        return False
    parts = [part for part in evidence.candidates if part < effects]
    return all(_loses(evidence, effects, part) for part in parts) and all(
        evidence.is_beyond_form(effects, part) for part in without_one
    )


def minimal_sets(evidence: Evidence) -> list[frozenset[str]]:
    """
    Return the sets all of whose effects are needed, the most probable first.

    Refuted ones are dropped; so is an alternative to the first one, or the first one itself, that
    as it is printed leaves materially more than the other.
    """
    kept = [
        effects
        for effects in evidence.candidates
        if _is_minimal(evidence, effects) and not evidence.is_refuted(effects)
    ]
    kept.sort(key=lambda effects: -evidence.value(evidence.nats(effects, NOTHING)))
    first = kept[0]
    alternatives = [first]
    for other in kept[1:]:
        is_less_probable = evidence.figure(evidence.nats(first, other)).predicts
        if len(other) == len(first) and not is_less_probable:
            alternatives.append(other)
    dropped = [a for a in alternatives if any(evidence.leaves_more(a, b) for b in alternatives)]
    return [effects for effects in kept if effects not in dropped]


def most_probable_set(evidence: Evidence) -> frozenset[str]:
    """Return the first of the minimal sets."""
    return minimal_sets(evidence)[0]


def drifts_beside(evidence: Evidence, effects: frozenset[str]) -> list[str]:
    """
    Return the drifts, the best first, that make samples beside a set more probable.

    None is expected to leave far more than the set leaves.
    """
    largest = _DRIFT_LIMIT * evidence.value(evidence.squares(effects))
    fits = evidence.candidates[effects]
    tried = [d for d in fits if d != HEALTHY and fits[d].drift_mps2 ** 2 <= largest]
    nats = {d: evidence.drift_nats(effects, d, effects) for d in tried}
    drifts = sorted(nats, key=lambda d: -evidence.value(nats[d]))
    if not drifts or not evidence.figure(nats[drifts[0]]).predicts:
        return []
    best = nats[drifts[0]].values
    less = {d: evidence.figure(ByDraw(best - nats[d].values)) for d in drifts}
    return [d for d in drifts if not less[d].predicts]


def is_drifting(evidence: Evidence, effects: frozenset[str], healthy: frozenset[str]) -> bool:
    """
    Determine whether a set in noise that drifts is better than another one in healthy noise.

    The drift must be material beside what the set explains in the same noise.
    """
    smallest = max(evidence.material_mps2**2, _SHARE_OF_SET * evidence.explained(effects))
    is_material = evidence.candidates[effects][evidence.noise].drift_mps2 ** 2 > smallest
    nats = evidence.drift_nats(effects, evidence.noise, healthy)
    return is_material and evidence.figure(nats).predicts


def form_of(effects: Collection[str]) -> set[str]:
    """Return the dimensions along which effects may have an error of form."""
    return {d.value for e in effects for d in effect_named(e).diagnosis.form}


def beside_form(effects: Collection[str]) -> set[str]:
    """Return the dimensions that neither a drift nor an error of form of effects follows."""
    return {d.value for d in FormDimension} - {FormDimension.TIME.value} - form_of(effects)
