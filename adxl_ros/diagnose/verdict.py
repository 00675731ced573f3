# SPDX-License-Identifier: Apache-2.0
"""
The verdict: everything it says follows from held-out figures that the report shows.

Blocks of time are held out in turn, and the blocks next to them are not fitted. A set of effects
is fitted to the other blocks and predicts the ones left out. Zero-g, scale factor, filter and
latency are free beside it, within what a healthy, calibrated unit may differ by.

Explained power P is by how much a set of effects lowers the held-out mean square. The
reproducible rest U is by how much flexible functions lower what then is left. Material is what a
user would act on. The same rule, applied to blocks drawn with replacement, says how sure it is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import NamedTuple
import warnings

from adxl_ros.diagnose import evidence as linear
from adxl_ros.diagnose.evidence import BLOCKS, LinearFit, LinearisedHypothesis, Whitener
from adxl_ros.diagnose.flexible_functions import Basis
from adxl_ros.diagnose.linear_model import LinearModel
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import FormDimension, ProofVariable
from adxl_ros.report.quantities import Interval
import numpy as np
import scipy

UNKNOWN = 'unknown'  # Name of what no effect of the library explains
HEALTHY = ''  # The drift of a healthy unit's noise
MATERIAL_MG = 0.1  # Amplitude that a user would act on, mg, unless `--material` states another one
MATERIAL_SHARE_OF_NOISE = 0.1
"""Share of the noise that a user would act on: it adds half a per cent to the rms."""
_SHARE_OF_SET, _SHARE_OF_FORM = 0.03, 0.1
"""Share of the explained power that each effect of a set must hold, and the same beside an effect
whose form is not exact over the same variables."""
_FORM_AT_REST, _REST_ERRORS = _SHARE_OF_FORM**2, 2.0
"""Share of the explained power by which a set may make rests worse, and the same in standard
errors: a tenth of its amplitude may be an error of its form."""
_NATS = 3.0  # Held-out log likelihood that a further effect must gain
_SMALLEST_P = 0.001
"""Probability of the increments of a drift below which they are of something else. Chosen: one
error in 1000."""
_LOWEST, _HIGHEST = 0.05, 0.95  # Quantiles of the 90 % intervals
_REPEATED, _RIGHT = (0.0, 0.5, 0.8, 0.95, 1.0), (0.2, 0.4, 0.6, 0.75, 0.9)
"""Shares of the draws that repeat a verdict, and how often such verdicts were right. Rounded from
40 working cases (seed 901): of those that all draws repeat, 21 of 25."""
_POSE = {'force', 'cross_force', 'alpha_rad', 'beta_rad'}
"""Dimensions that only change with the pose."""
_SHOWN_BY_POSE = {
    ProofVariable.OWN_FORCE,
    ProofVariable.CROSS_FORCE,
    ProofVariable.FORCE_Z,
    ProofVariable.ALPHA,
    ProofVariable.BETA,
}
"""Variables over which an effect that only changes with the pose shows."""
_DRAWS = 200  # Draws of blocks. Chosen: the 5 % quantile has 10 draws below it
FOLDS, _RUN_BLOCKS = 4, 2
"""Parts of a recording, each of which is held out once, and neighbouring blocks that are held out
together. Chosen: run time, and slow effects change within two."""
_FIRST_MEAN_S, _FEWEST_MEANS, _FEWEST_STEPS = 0.1, 16, 12
"""Shortest mean in which a drift is looked for, s, and fewest means, and increments, that show a
form. Chosen: noise of sensors is white below it."""
_ROUNDS, _FIRST_LEVEL_G, _SMALLEST_LEVEL = 12, 1e-3, 1e-4
"""Rounds of the fit of the levels of flexible functions, first level, g rms, and level, in first
ones, below which a function is left out. Chosen: any other start ends at the same levels."""


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
            key=lambda h: (-h.probability, h.effects),
        )
    )


class HeldOut(NamedTuple):
    """What a set of effects leaves of blocks that it was not fitted to."""

    # Squares of recording minus simulation, mean over axes, sum over samples, by block, (m/s²)²,
    # (blocks,)
    squares: np.ndarray
    log_likelihood: np.ndarray  # Log likelihood by block, (blocks,)


@dataclass(frozen=True)
class Rest:
    """What flexible functions predict of held-out blocks beyond a set of effects."""

    squares: np.ndarray  # Decrease of the squares by all functions, by block, (m/s²)², (blocks,)
    # The same by all functions but those of time, and their increase of the log likelihood
    steady_squares: np.ndarray
    steady_log_likelihood: np.ndarray
    by_dimension: dict[str, np.ndarray]  # Decrease by the functions of one dimension alone
    # Probability that a drift has increments with such jumps or lines; 1 beside a healthy unit
    drift_p: float = 1.0


def block_weights(seed: int) -> np.ndarray:
    """Return how often each block is drawn, (1 + draws, blocks); the first row takes each once."""
    drawn = np.random.default_rng(seed).integers(0, BLOCKS, (_DRAWS, BLOCKS))
    counts = np.apply_along_axis(np.bincount, 1, drawn, minlength=BLOCKS)
    return np.concatenate([np.ones((1, BLOCKS)), counts])


def folds() -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield held-out and fitted blocks, (blocks,) bool each."""
    number = np.arange(BLOCKS)
    for fold in range(FOLDS):
        held_out = (number // _RUN_BLOCKS) % FOLDS == fold
        yield held_out, np.convolve(held_out, np.ones(3), 'same') == 0


@dataclass(frozen=True)
class HeldOutFits:
    """The fits of a linearised set of effects to all blocks but those held out."""

    linearised: LinearisedHypothesis  # The set of effects, linearised at its fit to all blocks
    model: LinearModel
    # Effects by which the zero-g may drift more than that of a healthy unit
    drifts: tuple[str, ...] = ()

    @cached_property
    def full(self) -> LinearFit:
        """Fit to all blocks."""
        return self.linearised.fit(drifts=self.drifts)

    @cached_property
    def by_fold(self) -> list[tuple[np.ndarray, np.ndarray, LinearFit, np.ndarray]]:
        """Held-out blocks, fitted blocks, fit, and departures from the prior mean by fold."""
        out = []
        for held_out, fitted in folds():
            fit = self.linearised.fit(fitted, self.drifts)
            out.append((held_out, fitted, fit, self.linearised.departures(fit, self.full)))
        return out

    @cached_property
    def figures(self) -> HeldOut:
        """Squares and log likelihood of the held-out blocks."""
        squares, log_likelihood = np.zeros(BLOCKS), np.zeros(BLOCKS)
        linearised = self.linearised
        for held_out, _, fit, departures in self.by_fold:
            for columns, channel, f, variance in zip(
                linearised.columns,
                linearised.channels,
                fit.filter_indices,
                fit.innovation_variance_v2,
            ):
                v = np.concatenate([[1.0], -departures[columns.places]])
                squares[held_out] += np.einsum('i,bij,j->b', v, columns.plain[held_out], v)
                white = np.einsum('i,bij,j->b', v, channel.block_grams[f][held_out], v)
                log_likelihood[held_out] += channel.log_scales[f][held_out] - 0.5 * (
                    white / variance + channel.counts[held_out] * np.log(variance)
                )
        return HeldOut(squares, log_likelihood)

    @property
    def _whiteners(self) -> list[Whitener]:
        """Whitening filter of each channel."""
        return [
            filters[f] for filters, f in zip(self.linearised.filters, self.full.filter_indices)
        ]

    def drift_densities(self) -> np.ndarray:
        """Return the densities of the drift by channel; 0 for that of a healthy unit."""
        return np.array([0.0 if w.healthy else w.density for w in self._whiteners])

    @cached_property
    def drift_mps2(self) -> float:
        """Return the expected rms of the drift that the fitted noise has, m/s²."""
        sizes_g = [
            linear.expected_drift_g(w.effect, density, comparison)
            for w, density, (comparison, _) in zip(
                self._whiteners, self.drift_densities(), self.model.places
            )
        ]
        return float(G0_MPS2 * np.sqrt(np.mean(np.square(sizes_g))))


def reproducible_rest(fits: HeldOutFits, bases: Sequence[Basis]) -> Rest:
    """
    Predict held-out blocks by flexible functions of everything that a residual may follow.

    Each axis has functions by dimension; their levels are those of the largest evidence (MacKay
    1992), so that functions that follow noise vanish. The effects keep their values, so that the
    functions take up only what the effects leave. `bases` are the functions of each channel.
    """
    linearised, model = fits.linearised, fits.model
    by_choice = {name: np.zeros(BLOCKS) for name in ('all', 'steady', 'nats')}
    whole = linearised.departures(fits.full, fits.full)
    for number, (columns, filters, basis, (comparison, axis)) in enumerate(
        zip(linearised.columns, linearised.filters, bases, model.places)
    ):
        if not basis:
            continue
        unit_v = _FIRST_LEVEL_G * float(comparison.sensor.scale_v_per_g[axis])
        design = np.concatenate([columns.values, *(unit_v * b for b in basis.values())], axis=1)
        white = linear.whiten_channel(
            design[:, 0],
            design[:, 1:],
            np.arange(design.shape[1] - 1),
            comparison.used,
            [filters[fits.full.filter_indices[number]]],
        ).block_grams[0]
        scale = float(comparison.scale_v_per_mps2[axis]) * len(comparison.sensor.axes) ** 0.5
        plain = linear.plain_grams(design / scale, comparison.used)
        variance = float(fits.full.innovation_variance_v2[number])
        names = np.repeat([d.value for d in basis], [b.shape[1] for b in basis.values()])
        choices = {d.value: names == d.value for d in basis}
        choices |= {'all': names != '', 'steady': names != FormDimension.TIME.value}
        for name, chosen in choices.items():
            level = _levels(_products(white, whole[columns.places]), names, chosen, variance)
            active = np.flatnonzero(level)
            for held_out, fitted, _, departures in fits.by_fold if len(active) else ():
                gram, residual = _products(white[fitted], departures[columns.places], active)
                values = np.linalg.solve(
                    gram / variance + np.diag(1 / level[active]), residual / variance
                )
                flat, gained = (
                    np.array(
                        [
                            _gain(
                                _products(block[None], departures[columns.places], active), values
                            )
                            for block in grams[held_out]
                        ]
                    )
                    for grams in (plain, white)
                )
                by_choice.setdefault(name, np.zeros(BLOCKS))[held_out] += flat
                if name == 'steady':
                    by_choice['nats'][held_out] += 0.5 * gained / variance
    together, steady, nats = (by_choice.pop(name) for name in ('all', 'steady', 'nats'))
    p = [
        increments_p(
            c.values @ np.concatenate([[1.0], -whole[c.places]]),
            comparison.used,
            comparison.sensor.rate_hz,
        )
        for c, (comparison, _) in zip(linearised.columns if fits.drifts else (), model.places)
    ]
    return Rest(together, steady, nats, by_choice, min([1.0, *(len(p) * v for v in p)]))


def increments_p(values: np.ndarray, used: np.ndarray, rate_hz: float) -> float:
    """
    Return how probable the increments of a residual are if they are those of a random drift.

    The means are those over the time from which the drift exceeds the noise: twice that of the
    smallest Allan deviation. A drift has Gaussian increments (test of Anscombe and Glynn 1983)
    without a line (test of Fisher 1929); jumps between levels and slow oscillations have not.
    """
    longest = int(used.sum()) // _FEWEST_MEANS
    lengths = np.unique(
        np.geomspace(max(1.0, _FIRST_MEAN_S * rate_hz), max(longest, 1), 12).astype(int)
    )

    def increments(length: int) -> np.ndarray:
        whole = len(values) // length * length
        count, total = (
            v[:whole].reshape(-1, length).sum(axis=1) for v in (used, np.where(used, values, 0.0))
        )
        means = np.where(count > length / 2, total / np.maximum(count, 1), np.nan)
        return np.diff(means)[np.isfinite(np.diff(means))]

    quietest = min(lengths.tolist(), key=lambda n: np.mean(increments(n) ** 2))
    steps = increments(min(2 * quietest, longest)) if len(lengths) > 1 else np.zeros(0)
    if len(steps) < _FEWEST_STEPS or not np.ptp(steps):
        return 1.0
    power = np.abs(np.fft.rfft(steps - steps.mean())[1 : (len(steps) + 1) // 2]) ** 2
    line = len(power) * (1 - power.max() / power.sum()) ** (len(power) - 1)
    with warnings.catch_warnings():
        # Older versions warn below 20 increments, where the test is rougher.
        warnings.simplefilter('ignore')
        return float(min(1.0, 2 * min(line, scipy.stats.kurtosistest(steps).pvalue)))


def _products(
    grams: np.ndarray, departures: np.ndarray, chosen: np.ndarray | slice = slice(None)
) -> tuple[np.ndarray, np.ndarray]:
    """Return products of functions with each other and with what effects leave, over blocks."""
    k, total = 1 + len(departures), grams.sum(axis=0)
    functions, residual = total[k:, k:], total[k:, :k] @ np.concatenate([[1.0], -departures])
    return functions[chosen][:, chosen], residual[chosen]


def _gain(products: tuple[np.ndarray, np.ndarray], values: np.ndarray) -> float:
    """Return by how much functions lower the squares."""
    return float(2 * products[1] @ values - values @ products[0] @ values)


def _levels(
    products: tuple[np.ndarray, np.ndarray], names: np.ndarray, chosen: np.ndarray, variance: float
) -> np.ndarray:
    """Return the variance of each function's coefficient of the largest evidence, (functions,)."""
    level, (gram, residual) = np.where(chosen, 1.0, 0.0), products
    for _ in range(_ROUNDS):
        active = np.flatnonzero(level)
        if not len(active):
            break
        covariance = np.linalg.inv(
            gram[np.ix_(active, active)] / variance + np.diag(1 / level[active])
        )
        squares = (covariance @ residual[active] / variance) ** 2 + np.diag(covariance)
        for name in np.unique(names[active]):
            of_name = names[active] == name
            level[active[of_name]] = squares[of_name].mean()
        level[level <= _SMALLEST_LEVEL**2] = 0.0
    return level


@dataclass(frozen=True)
class Verdict:
    """The result of a diagnosis; powers are mean squares over samples and axes, (m/s²)²."""

    status: str  # 'no_gap', 'explained', 'partly', 'inseparable', 'unknown' or 'insufficient'
    effects: tuple[str, ...]  # Effects that are named for certain
    groups: tuple[tuple[str, ...], ...]  # Sets of inseparable effects, one of which acts
    probability: float  # How often such a verdict is right
    # Sets of effects by falling probability, which sums to 1
    hypotheses: tuple[WeightedHypothesis, ...]
    best: frozenset[str]  # The set whose closing the report states
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
        return max(self.rest.value, self.left.value, 0.0)

    @property
    def explained_share(self) -> float:
        """Share of the power above the noise that the best set explains; 1 without any."""
        total = max(self.explained.value, 0.0) + self.remaining
        return 1.0 - self.remaining / total if total > 0 else 1.0


_NOTHING: frozenset[str] = frozenset()


class SimulatedAgain(NamedTuple):
    """What a set leaves when it is simulated; sums over samples, mean over axes, (m/s²)²."""

    # Squares with the sizes that are printed, without its nuisance parameters, by block, (blocks,)
    printed: np.ndarray
    # Increase of the squares of the rests beside a simulation without effects, by rest, (rests,)
    more_at_rest: np.ndarray
    resting: float  # Number of samples at rest
    at_bound: bool  # Whether a size is at the end of what its parameter can have


@dataclass(frozen=True)
class Evidence:
    """What the rule weighs; its methods return one value for each draw of the blocks."""

    # Sets of effects, the empty one among them, by the drift that the noise may have
    candidates: Mapping[frozenset[str], Mapping[str, HeldOutFits]]
    counts: np.ndarray  # Samples by block, (blocks,)
    # How often each block is drawn, (draws, blocks); once each in the first row
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

    def left(self, effects: frozenset[str]) -> np.ndarray:
        """Return the power above the noise floor that a set leaves."""
        return self.mean(self.candidates[effects][HEALTHY].figures.squares) - self.floor_mps2**2

    def material_power(self, pose_share: float) -> float:
        """Return the power that a user would act on and that is not of the reference, (m/s²)²."""
        share = 1.0 if self.errs_in_motion else pose_share
        return self.material_mps2**2 + share * self.reference_mps2**2

    def mean(self, by_block: np.ndarray) -> np.ndarray:
        """Return the mean over samples of sums by block."""
        return self.weights @ by_block / np.maximum(self.weights @ self.counts, 1.0)

    def is_refuted(self, effects: frozenset[str]) -> bool:
        """
        Determine whether a set cannot be, however much it explains.

        The rests of the same recording contradict it, or a size is at its bound.
        """
        if not effects or effects not in self.again:
            return False
        again = self.again[effects]
        more, count = again.more_at_rest, max(again.resting, 1.0)
        error = float(np.sqrt(np.sum(more**2))) / count
        explained = max(float(self.gain(effects, _NOTHING)[0]), 0.0)
        smallest = max(self.material_power(1.0), _FORM_AT_REST * explained)
        return again.at_bound or float(more.sum()) / count > smallest + _REST_ERRORS * error

    def leaves_more(self, effects: frozenset[str], other: frozenset[str]) -> bool:
        """Determine whether a set, as it is printed, leaves materially more than another."""
        if not {effects, other} <= {*self.again}:
            return False
        more = self.mean(self.again[effects].printed - self.again[other].printed)
        return float(more[0]) > self.material_power(1.0) and _low(more) > 0

    def drift_power(self, effects: frozenset[str], drifts: Sequence[str]) -> float:
        """Return the power of the first drift beside a set, (m/s²)²; 0 without one."""
        fits = self.candidates[effects]
        if not drifts or drifts[0] not in fits:
            return 0.0
        return fits[drifts[0]].drift_mps2 ** 2

    def gain(self, more: frozenset[str], less: frozenset[str]) -> np.ndarray:
        """Return by how much one set explains more power than another."""
        a, b = (self.candidates[e][HEALTHY].figures for e in (more, less))
        return self.mean(b.squares - a.squares)

    def nats(self, more: frozenset[str], less: frozenset[str], drift: str = HEALTHY) -> np.ndarray:
        """Return by how much a set, with its noise, makes the held-out samples more probable."""
        a, b = self.candidates[more][drift].figures, self.candidates[less][HEALTHY].figures
        return self.weights @ (a.log_likelihood - b.log_likelihood)

    def interval(self, draws: np.ndarray) -> Interval:
        """Return the value of all blocks with the interval of the draws."""
        low, high = np.quantile(draws[1:], [_LOWEST, _HIGHEST], method='nearest')
        return Interval(float(draws[0]), float(min(low, draws[0])), float(max(high, draws[0])))


def _low(draws: np.ndarray) -> float:
    """Return the lower end of the interval; of one draw, itself."""
    return float(np.quantile(draws, _LOWEST)) if len(draws) > 1 else float(draws[0])


def _predicts(nats: np.ndarray) -> bool:
    """Determine whether held-out samples are more probable, beyond the interval."""
    return bool(nats[0] > _NATS and _low(nats) > 0)


def is_needed(evidence: Evidence, effects: frozenset[str], effect: str) -> bool:
    """Determine whether a set loses a material part of what it explains without an effect."""
    if effect in evidence.sizeless.get(effects, ()):
        return False
    rest = effects - {effect}
    lost, nats = evidence.gain(effects, rest), evidence.nats(effects, rest)
    if nats[0] <= _NATS or max(_low(nats), _low(lost)) <= 0:
        return False
    hints = effect_named(effect).diagnosis
    # An error of form of another effect may look like an effect over the same variables.
    shares_form = any({*hints.form} & {*effect_named(e).diagnosis.form} for e in rest)
    share = _SHARE_OF_FORM if shares_form else _SHARE_OF_SET
    explained = float(evidence.gain(effects, _NOTHING)[0])
    by_pose = bool(hints.proof) and {*hints.proof} <= _SHOWN_BY_POSE
    return float(lost[0]) > max(evidence.material_power(float(by_pose)), share * explained)


def minimal_sets(evidence: Evidence) -> list[frozenset[str]]:
    """
    Return the sets all of whose effects are needed, the most probable first.

    Those that the rests refute are dropped; so is an alternative to the first one, or the first
    one itself, that as it is printed leaves materially more than the other.
    """
    kept = [
        effects
        for effects in evidence.candidates
        if all(
            effects - {e} in evidence.candidates and is_needed(evidence, effects, e)
            for e in effects
        )
        and not evidence.is_refuted(effects)
    ]
    kept.sort(key=lambda effects: -evidence.nats(effects, _NOTHING)[0])
    first = kept[0]
    alternatives = [
        first,
        *(
            other
            for other in kept[1:]
            if len(other) == len(first) and not _predicts(evidence.nats(first, other))
        ),
    ]
    dropped = [a for a in alternatives if any(evidence.leaves_more(a, b) for b in alternatives)]
    return [effects for effects in kept if effects not in dropped]


def drifts_beside(evidence: Evidence, effects: frozenset[str], rest: Rest) -> list[str]:
    """
    Return the drifts, the best first, that the noise beside a set needs; none for most.

    What flexible functions predict as well is an error of form, and no drift; nor is the motion
    that a smooth reference lacks.
    """
    candidate = evidence.candidates[effects]
    nats = {d: evidence.nats(effects, effects, d) for d in candidate if d != HEALTHY}
    drifts = sorted(nats, key=lambda d: -nats[d][0])
    if not drifts or evidence.fades:
        return []
    best = nats[drifts[0]]
    explained = float(evidence.gain(effects, _NOTHING)[0])
    exact = all(effect_named(e).exact for e in effects)
    smallest = max(
        evidence.material_mps2**2, (_SHARE_OF_SET if exact else _SHARE_OF_FORM) * explained
    )
    if (
        candidate[drifts[0]].drift_mps2 ** 2 <= smallest
        or not _predicts(best)
        or not _predicts(best - evidence.weights @ rest.steady_log_likelihood)
    ):
        return []
    return [d for d in drifts if d == drifts[0] or not _predicts(best - nats[d])]


class _Answer(NamedTuple):
    """Status, certain effects, and groups of inseparable ones."""

    status: str
    effects: frozenset[str]
    groups: frozenset[frozenset[str]]


def _answer(
    evidence: Evidence,
    rest: Rest,
    rest_material: float,
    drifts: Sequence[str],
    detected: frozenset[str],
) -> _Answer:
    """Apply the rule to the figures of all blocks, or of one draw of them."""
    minimal = minimal_sets(evidence)
    best = minimal[0]
    explained, above = (float(v[0]) for v in (evidence.gain(best, _NOTHING), evidence.left(best)))
    repeats, steady = map(evidence.mean, (rest.squares, rest.steady_squares))
    left = float(repeats[0]) if _low(repeats) > rest_material else 0.0
    drift = evidence.drift_power(best, drifts)
    follows = _low(steady) > rest_material and float(steady[0]) > _SHARE_OF_FORM * drift
    if drifts and (follows or rest.drift_p < _SMALLEST_P):
        # A drift follows time alone, and at random; its fit takes up what does not, too.
        drifts, drift, left = (), 0.0, max(float(repeats[0]), above)
    if left > explained + drift:
        return _Answer('unknown', _NOTHING, frozenset())
    named = () if evidence.wanders else drifts
    if not best and not detected and not named:
        # What neither repeats nor is noise at rest is no gap only while the noise is larger.
        is_much = above > max(evidence.floor_mps2**2, evidence.material_power(1.0))
        return _Answer('unknown' if is_much else 'no_gap', _NOTHING, frozenset())
    # The order of two sets could be that of their errors of form, where these are as large as
    # the rest that the best set leaves; or that of errors of the reference in motion.
    smallest = max(left, evidence.errs_in_motion * evidence.reference_mps2**2)
    rivals = [
        other
        for other in minimal[1:]
        if len(other) == len(best)
        and not (
            _predicts(evidence.nats(best, other))
            and float(evidence.gain(best, other)[0]) > smallest
        )
        and not evidence.leaves_more(other, best)
    ]
    groups = {
        group
        for e in best
        if len(
            group := frozenset({e}).union(*(other - best for other in rivals if e not in other))
        )
        > 1
    }
    certain = best.difference(*groups) | detected | {*named[:1]}
    if len(named) > 1:
        groups, certain = groups | {frozenset(named)}, certain - {*named}
    if best and above > drift + evidence.material_power(1.0):
        left = max(left, above)
    partly = left > _SHARE_OF_FORM * (explained + left)
    if groups and partly and not certain:
        # Nothing is named for certain, and none of the rivals explains what repeats.
        return _Answer('unknown', _NOTHING, frozenset())
    status = 'inseparable' if groups else 'partly' if partly else 'explained'
    return _Answer(status, certain, frozenset(groups))


def decide(
    evidence: Evidence,
    rest_of: Callable[[frozenset[str], str], Rest],
    detected: Sequence[str],
    simulate_again: Callable[[frozenset[str]], SimulatedAgain] | None = None,
) -> Verdict:
    """
    Apply the rule to the figures, and to draws of their blocks.

    simulate_again: simulates a set that could be the answer.
    """
    if simulate_again is not None:
        evidence = replace(
            evidence,
            again={
                effects: simulate_again(effects) for effects in minimal_sets(evidence) if effects
            },
        )
    best = minimal_sets(evidence)[0]
    rest = rest_of(best, HEALTHY)
    drifts = drifts_beside(evidence, best, rest)
    if drifts:
        rest = rest_of(best, drifts[0])
    power = {d: float(evidence.mean(b)[0]) for d, b in rest.by_dimension.items()}
    repeats = evidence.interval(evidence.mean(rest.squares))
    # What follows the pose may be of the reference.
    pose = max((power[d] for d in _POSE & {*power}), default=0.0)
    rest_material = evidence.material_power(
        float(np.clip(pose / repeats.value, 0.0, 1.0)) if repeats.value > 0 else 0.0
    )
    answer, *drawn = (
        _answer(
            replace(evidence, weights=weights), rest, rest_material, drifts, frozenset(detected)
        )
        for weights in (evidence.weights, *evidence.weights[1:, None])
    )
    highest = max(evidence.interval(evidence.gain(e, _NOTHING)).high for e in evidence.candidates)
    probability, hypotheses = _probabilities(answer, drawn)
    strongest = sorted(power, key=lambda d: -power[d])
    return Verdict(
        answer.status,
        tuple(sorted(answer.effects)),
        tuple(sorted(tuple(sorted(g)) for g in answer.groups)),
        probability,
        hypotheses,
        best,
        evidence.material_mps2,
        evidence.reference_mps2,
        evidence.interval(evidence.gain(best, _NOTHING)),
        repeats,
        evidence.interval(evidence.left(best)),
        float(np.sqrt(max(highest, repeats.high, evidence.material_power(1.0)))),
        {e: evidence.interval(evidence.gain(best, best - {e})) for e in sorted(best)},
        tuple(d for d in strongest if power[d] > 0 and power[d] >= power[strongest[0]] / 2),
    )


def _sets(answer: _Answer) -> list[frozenset[str]]:
    """Return the sets of effects that an answer stands for."""
    if answer.status == 'unknown':
        return [frozenset({UNKNOWN})]
    return [answer.effects | set(choice) for choice in product(*answer.groups)]


def _probabilities(
    answer: _Answer, drawn: Sequence[_Answer]
) -> tuple[float, tuple[WeightedHypothesis, ...]]:
    """Return the probability of the answer, and of all sets, none above the answer's."""
    named, votes = set(_sets(answer)), dict[frozenset[str], float]()
    for sets in map(_sets, drawn):
        for effects in sets:
            votes[effects] = votes.get(effects, 0.0) + 1 / len(sets)
    agreed = sum(count for effects, count in votes.items() if effects in named)
    probability = float(np.interp(agreed / len(drawn), _REPEATED, _RIGHT))
    weights = {
        e: min(count / (len(drawn) - agreed) * (1 - probability), probability)
        for e, count in votes.items()
        if e not in named
    }
    weights |= {effects: probability / len(named) for effects in named}
    missing = 1.0 - sum(weights.values())
    remaining = frozenset(() if answer.status == 'unknown' else {UNKNOWN})
    if missing > 1e-12:
        weights[remaining] = weights.get(remaining, 0.0) + missing
    return probability, normalised({tuple(sorted(e)): w for e, w in weights.items()})
