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

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import NamedTuple
import warnings

from adxl_ros.diagnose import evidence as linear
from adxl_ros.diagnose.comparison import bridged
from adxl_ros.diagnose.evidence import (
    BLOCKS,
    ChannelColumns,
    LinearFit,
    LinearisedHypothesis,
    Whitener,
)
from adxl_ros.diagnose.flexible_functions import Basis
from adxl_ros.diagnose.linear_model import LinearModel
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import FormDimension, ProofVariable
from adxl_ros.report.quantities import Interval
from adxl_ros.signals.block_statistics import rms, true_runs
import numpy as np
import scipy

UNKNOWN = 'unknown'  # Name of what no effect of the library explains
HEALTHY = ''  # The drift of a healthy unit's noise
MATERIAL_MG = 0.1  # Amplitude that a user would act on, mg, unless `--material` states another one
MATERIAL_SHARE_OF_NOISE = 0.1
"""Share of the noise that a user would act on: it adds half a per cent to the rms."""
_SHARE_OF_SET = 0.03
"""Share of the explained power that each effect of a set must hold. Chosen: a sixth of the
amplitude."""
_SHARE_OF_FORM = 0.1
"""The same beside an effect whose form is not exact over the same variables. Chosen: a third of
the amplitude, because what such a form leaves may look like an effect."""
_FORM_AT_REST = _SHARE_OF_FORM**2
"""Share of the explained power by which a set may make rests worse: a tenth of its amplitude may
be an error of its form."""
_REST_ERRORS = 2.0
"""The same in standard errors: one set in 40 exceeds it by chance."""
_NATS = 3.0  # Held-out log likelihood that a further effect must gain: a ratio of 20
_SMALLEST_P = 0.001
"""Probability of the increments of a drift below which they are of something else. Chosen: one
error in 1000."""
_LOWEST = 0.05  # Quantile at the lower end of a 90 % interval
_HIGHEST = 0.95  # Quantile at its upper end
_REPEATED = (0.0, 0.5, 0.8, 0.95, 1.0)
"""Shares of the draws that repeat a verdict, at which `_RIGHT` is known."""
_RIGHT = (0.2, 0.4, 0.6, 0.75, 0.9)
"""How often verdicts that so many draws repeat were right. Rounded from 40 working cases (seed
901): of those that all draws repeat, 21 of 25."""
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
FOLDS = 4  # Parts of a recording, each of which is held out once. Chosen: run time
_RUN_BLOCKS = 2
"""Neighbouring blocks that are held out together. Chosen: slow effects change within two."""
_FIRST_MEAN_S = 0.1
"""Shortest mean in which a drift is looked for, s. Chosen: noise of sensors is white below it."""
_FEWEST_MEANS = 16  # Fewest means of the longest length. Chosen: their increments show a form
_FEWEST_STEPS = 12  # Fewest increments that show a form. Chosen: a kurtosis scatters by 1.4
_FEWEST_GAPS = 8  # Fewest gaps over which steps show. Chosen: 8 of 17 have 24 310 orders
_LOCAL_ORDINATES = 101  # Ordinates of the level around a line. Chosen: much wider than a line
_ROUNDS = 12
"""Rounds of the fit of the levels of flexible functions. Chosen: the levels hardly change then."""
_FIRST_LEVEL_G = 1e-3  # First level, g rms. Chosen: any other start ends at the same levels
_SMALLEST_LEVEL = 1e-4
"""Level, in first ones, below which a function is left out. Chosen: 0.1 µg is below any noise."""


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
    steady_squares: np.ndarray  # The same by all functions but those of time
    steady_log_likelihood: np.ndarray  # Increase of the log likelihood by these, (blocks,)
    by_dimension: dict[str, np.ndarray]  # Decrease by the functions of one dimension alone
    # Probability that a drift has increments with such jumps or lines; 1 beside a healthy unit
    drift_p: float = 1.0


def block_weights(seed: int) -> np.ndarray:
    """Return how often each block is drawn, (1 + draws, blocks); the first row takes each once."""
    drawn = np.random.default_rng(seed).integers(0, BLOCKS, (_DRAWS, BLOCKS))
    counts = np.apply_along_axis(np.bincount, 1, drawn, minlength=BLOCKS)
    return np.concatenate([np.ones((1, BLOCKS)), counts])


class Fold(NamedTuple):
    """A fit to some blocks, and the blocks that it predicts."""

    held_out: np.ndarray  # Blocks that are predicted, (blocks,) bool
    fitted: np.ndarray  # Blocks that are fitted: none of them is next to a held-out one
    fit: LinearFit
    departures: np.ndarray  # Departures of the k coefficients from the prior mean, (k,)


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
    def full_departures(self) -> np.ndarray:
        """Departures from the prior mean in the fit to all blocks, (k,)."""
        return self.linearised.departures(self.full, self.full)

    @cached_property
    def folds(self) -> list[Fold]:
        """Return the fits to all blocks but one part of them, which is held out."""
        out = []
        for part in range(FOLDS):
            held_out = (np.arange(BLOCKS) // _RUN_BLOCKS) % FOLDS == part
            fitted = np.convolve(held_out, np.ones(3), 'same') == 0
            fit = self.linearised.fit(fitted, self.drifts)
            out.append(Fold(held_out, fitted, fit, self.linearised.departures(fit, self.full)))
        return out

    @cached_property
    def figures(self) -> HeldOut:
        """Squares and log likelihood of the held-out blocks."""
        squares, log_likelihood = np.zeros(BLOCKS), np.zeros(BLOCKS)
        linearised = self.linearised
        # Products of the columns, mean over axes, by block, (m/s²)²
        plain = [
            linear.plain_grams(columns.values, place.comparison.used) / place.v_per_mean_mps2**2
            for columns, place in zip(linearised.columns, self.model.places)
        ]
        for held_out, _, fit, departures in self.folds:
            for columns, plain_mps2, channel, f, variance in zip(
                linearised.columns,
                plain,
                linearised.channels,
                fit.filter_indices,
                fit.innovation_variance_v2,
            ):
                v = columns.combination(departures)
                squares[held_out] += np.einsum('i,bij,j->b', v, plain_mps2[held_out], v)
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
        per_v = [0.0 if w.healthy else w.density_per_v for w in self._whiteners]
        return np.array(per_v) * np.sqrt(self.full.innovation_variance_v2)

    @cached_property
    def drift_mps2(self) -> float:
        """Return the expected rms of the drift that the fitted noise has, m/s²."""
        sizes_g = [
            linear.expected_drift_g(w.effect, density, comparison)
            for w, density, (comparison, _) in zip(
                self._whiteners, self.drift_densities(), self.model.places
            )
        ]
        return G0_MPS2 * rms(sizes_g)


class _Decrease(NamedTuple):
    """What functions predict of each block, (blocks,) each."""

    squares: np.ndarray  # Decrease of the squares, (m/s²)²
    log_likelihood: np.ndarray  # Increase of the log likelihood


class _FoldProducts(NamedTuple):
    """The products of a fold."""

    fitted_v2: np.ndarray  # Whitened, over the fitted blocks, V²
    white_v2: np.ndarray  # Whitened, by held-out block, V²
    plain_mps2: np.ndarray  # Mean over axes, by held-out block, (m/s²)²


@dataclass(frozen=True)
class _FlexibleFunctions:
    """The k flexible functions of one channel, beside the columns of a set of effects."""

    dimensions: np.ndarray  # What each function follows, (k,)
    columns: ChannelColumns  # The columns of the set
    # Products of the columns, then the functions, in both directions
    white_v2: np.ndarray  # Whitened, V²
    by_fold: list[_FoldProducts]
    variance_v2: float  # Variance of the whitened noise, V²

    @classmethod
    def of(cls, fits: HeldOutFits, number: int, basis: Basis) -> _FlexibleFunctions:
        """Multiply the columns and functions of the channel of some number."""
        columns, channel = fits.linearised.columns[number], fits.model.places[number]
        sensor, used = channel.comparison.sensor, channel.comparison.used
        unit_v = _FIRST_LEVEL_G * float(sensor.scale_v_per_g[channel.axis])
        rows = np.concatenate([columns.values.T, *(b.T for b in basis.values())])
        rows[1 + len(columns.places) :] *= unit_v
        plain_mps2 = linear.plain_grams(rows.T, used) / channel.v_per_mean_mps2**2
        whitener = fits.linearised.filters[number][fits.full.filter_indices[number]]
        # One by one and in place they take little memory.
        for row in rows:
            row[:] = next(linear.white_rows(row[:, None], used, [whitener]))[0]
        white_v2 = linear.block_grams(rows)
        return cls(
            dimensions=np.repeat(
                [d.value for d in basis], [functions.shape[1] for functions in basis.values()]
            ),
            columns=columns,
            white_v2=white_v2.sum(axis=0),
            by_fold=[
                _FoldProducts(
                    white_v2[fold.fitted].sum(axis=0),
                    white_v2[fold.held_out],
                    plain_mps2[fold.held_out],
                )
                for fold in fits.folds
            ],
            variance_v2=float(fits.full.innovation_variance_v2[number]),
        )

    def products(
        self, grams: np.ndarray, departures: np.ndarray, chosen: np.ndarray
    ) -> FunctionProducts:
        """Return the products of chosen functions, where effects have some departures."""
        effects = 1 + len(self.columns.places)
        functions = grams[..., effects:, effects:]
        residual = grams[..., effects:, :effects] @ self.columns.combination(departures)
        return FunctionProducts(functions[..., chosen, :][..., chosen], residual[..., chosen])

    def predict(self, fits: HeldOutFits, chosen: np.ndarray) -> _Decrease:
        """Fit functions, (k,) bool, to the other blocks, and predict those held out."""
        number = np.flatnonzero(chosen)
        level = largest_evidence_levels(
            self.products(self.white_v2, fits.full_departures, number),
            self.dimensions[number],
            self.variance_v2,
        )
        active, level = number[level > 0], level[level > 0]
        squares, log_likelihood = np.zeros(BLOCKS), np.zeros(BLOCKS)
        if not len(active):
            return _Decrease(squares, log_likelihood)
        for (held_out, _, _, departures), fold in zip(fits.folds, self.by_fold):
            known = self.products(fold.fitted_v2, departures, active)
            values = np.linalg.solve(
                known.functions / self.variance_v2 + np.diag(1 / level),
                known.residual / self.variance_v2,
            )
            plain = self.products(fold.plain_mps2, departures, active)
            white = self.products(fold.white_v2, departures, active)
            squares[held_out] = plain.decrease(values)
            log_likelihood[held_out] = 0.5 * white.decrease(values) / self.variance_v2
        return _Decrease(squares, log_likelihood)


def reproducible_rest(fits: HeldOutFits, bases: Iterable[Basis]) -> Rest:
    """
    Predict held-out blocks by flexible functions of everything that a residual may follow.

    Each axis has functions by dimension; their levels are those of the largest evidence (MacKay
    1992), so that functions that follow noise vanish. The effects keep their values, so that the
    functions take up only what the effects leave. `bases` are the functions of each channel.
    """
    squares, steady_squares, steady_log_likelihood = np.zeros((3, BLOCKS))
    by_dimension: dict[str, np.ndarray] = {}
    for number, basis in enumerate(bases):
        if not basis:
            continue
        functions = _FlexibleFunctions.of(fits, number, basis)
        squares += functions.predict(fits, functions.dimensions != '').squares
        steady = functions.predict(fits, functions.dimensions != FormDimension.TIME.value)
        steady_squares += steady.squares
        steady_log_likelihood += steady.log_likelihood
        for dimension in (d.value for d in basis):
            alone = functions.predict(fits, functions.dimensions == dimension).squares
            by_dimension[dimension] = by_dimension.get(dimension, 0.0) + alone
    return Rest(squares, steady_squares, steady_log_likelihood, by_dimension, _drift_p(fits))


def _drift_p(fits: HeldOutFits) -> float:
    """Return how probable the residuals of all channels are if they drift; 1 without a drift."""
    if not fits.drifts:
        return 1.0
    smallest = 1.0
    for columns, (comparison, _) in zip(fits.linearised.columns, fits.model.places):
        residual_v = columns.values @ columns.combination(fits.full_departures)
        used, rate_hz = comparison.used, comparison.sensor.rate_hz
        p = increments_p(residual_v, used, rate_hz, comparison.at_rest)
        p = min(p, between_rests_p(residual_v, used, rate_hz))
        smallest = min(smallest, len(fits.model.places) * p)
    return smallest


def increments_p(
    values: np.ndarray, used: np.ndarray, rate_hz: float, at_rest: np.ndarray
) -> float:
    """
    Return how probable the increments of a residual are if they are those of a random drift.

    The means are those over the time from which the drift exceeds the noise: twice that of the
    smallest Allan deviation. A drift has Gaussian increments (test of Anscombe and Glynn 1983), as
    large at rest as in motion (test of Mann and Whitney 1947), and no line. Jumps between levels,
    what a motor does, and slow oscillations have not.
    """
    longest = int(used.sum()) // _FEWEST_MEANS
    lengths = np.unique(
        np.geomspace(max(1.0, _FIRST_MEAN_S * rate_hz), max(longest, 1), 12).astype(int)
    )
    if not longest or len(lengths) < 2:
        return 1.0

    def increments(length: int) -> _Increments:
        whole = len(values) // length * length
        count, total, resting = (
            v[:whole].reshape(-1, length).sum(axis=1)
            for v in (used, np.where(used, values, 0.0), used & at_rest)
        )
        means = np.where(count > length / 2, total / np.maximum(count, 1), np.nan)
        steps, still = np.diff(means), resting > count / 2
        known = np.isfinite(steps)
        return _Increments(
            steps[known], (still[1:] & still[:-1])[known], ~(still[1:] | still[:-1])[known]
        )

    by_length = [increments(length) for length in lengths.tolist()]
    quietest = min(range(len(lengths)), key=lambda i: np.mean(by_length[i].values ** 2))
    steps = increments(min(2 * lengths[quietest], longest)).values
    if len(steps) < _FEWEST_STEPS or not np.ptp(steps):
        return 1.0
    with warnings.catch_warnings():
        # Older versions warn below 20 increments, where the test is rougher.
        warnings.simplefilter('ignore')
        gaussian = scipy.stats.kurtosistest(steps).pvalue
    # The longest means that are often at rest show the drift best.
    often = [each for each in by_length if each.fewest >= _FEWEST_STEPS]
    alike = often[-1].alike_p if often else 1.0
    line = _line_p(values, used, lengths[0])
    return float(min(1.0, 3 * min(line, gaussian, alike)))


def between_rests_p(values: np.ndarray, used: np.ndarray, rate_hz: float) -> float:
    """
    Return how probable the steps of a residual over gaps are, by its changes between them.

    A drift goes on within rests. Errors of the stated poses, as of a stand, change in moves alone.
    The variance of a random walk grows by the time from mean to mean, a third of each mean's own.
    """
    runs = [(a, b) for a, b in true_runs(used) if b - a >= rate_hz]
    if len(runs) <= _FEWEST_GAPS:
        return 1.0
    start, stop = np.array(runs).T
    middle, half_s = (start + stop) // 2, (stop - start) / 2 / rate_hz
    gap_s = (start[1:] - stop[:-1]) / rate_hz
    first = np.array([np.mean(values[a:b]) for a, b in zip(start, middle)])
    last = np.array([np.mean(values[a:b]) for a, b in zip(middle, stop)])
    within = (last - first) / np.sqrt(2 / 3 * half_s)
    between = (first[1:] - last[:-1]) / np.sqrt(gap_s + (half_s[1:] + half_s[:-1]) / 3)
    test = scipy.stats.mannwhitneyu(np.abs(between), np.abs(within), alternative='greater')
    return float(test.pvalue)


def _line_p(values: np.ndarray, used: np.ndarray, length: int) -> float:
    """Return how probable the strongest line of a residual without lines is, in slow means."""
    changes = np.diff(bridged(values[:, None], used)[:, 0])
    power = scipy.signal.periodogram(changes, window='hann')[1][1:-1]
    # A spectrum that is smooth over frequency has exponential ordinates about its local level.
    level = scipy.ndimage.median_filter(power, _LOCAL_ORDINATES, mode='reflect') / np.log(2)
    ratios = (power / np.maximum(level, np.finfo(float).tiny))[: max(len(power) // length, 1)]
    return float(min(1.0, len(ratios) * np.exp(-ratios.max())))


class _Increments(NamedTuple):
    """Increments between neighbouring means of a residual."""

    values: np.ndarray  # (k,)
    resting: np.ndarray  # Those between means at rest, (k,) bool
    moving: np.ndarray  # Those between means in motion, (k,) bool

    @property
    def fewest(self) -> int:
        """Return the smaller number of those at rest and those in motion."""
        return int(min(self.resting.sum(), self.moving.sum()))

    @property
    def alike_p(self) -> float:
        """Return how probable they are if they are as large at rest as in motion."""
        sizes = np.abs(self.values)
        return float(scipy.stats.mannwhitneyu(sizes[self.resting], sizes[self.moving]).pvalue)


class FunctionProducts(NamedTuple):
    """Products of k functions, of one part of a recording or by part."""

    functions: np.ndarray  # With each other, (..., k, k)
    residual: np.ndarray  # With what the effects leave, (..., k)

    def decrease(self, values: np.ndarray) -> np.ndarray:
        """Return by how much the functions lower the squares with k coefficients."""
        return 2 * self.residual @ values - (self.functions @ values) @ values


def largest_evidence_levels(
    products: FunctionProducts, dimensions: np.ndarray, variance: float
) -> np.ndarray:
    """
    Return the prior variances of the coefficients of k functions of the largest evidence, (k,).

    All functions of a dimension have one. It is 0 where the functions follow noise. `variance` is
    that of the noise.
    """
    level = np.ones(len(dimensions))
    for _ in range(_ROUNDS):
        active = np.flatnonzero(level)
        if not len(active):
            break
        precision = products.functions[np.ix_(active, active)] / variance
        covariance = np.linalg.inv(precision + np.diag(1 / level[active]))
        mean = covariance @ products.residual[active] / variance
        squares = mean**2 + np.diag(covariance)
        for dimension in np.unique(dimensions[active]):
            alike = dimensions[active] == dimension
            level[active[alike]] = squares[alike].mean()
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
        more, count = again.more_at_rest, max(again.resting, 1.0)
        error = float(np.sqrt(np.sum(more**2))) / count
        explained = max(float(self.gain(effects, _NOTHING)[0]), 0.0)
        smallest = max(self.material_power(1.0), _FORM_AT_REST * explained)
        return again.at_bound or float(more.sum()) / count > smallest + _REST_ERRORS * error

    def leaves_more(self, effects: frozenset[str], other: frozenset[str]) -> bool:
        """Determine whether a set, as it is printed, leaves materially more than another."""
        if not {effects, other} <= {*self.again}:
            return False
        printed, others = self.again[effects].printed, self.again[other].printed
        more = self.figure(self.mean(printed - others))
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
        a, b = self._figures(more), self._figures(less)
        return self.weights @ (a.log_likelihood - b.log_likelihood)

    def drift_nats(self, effects: frozenset[str], drift: str) -> np.ndarray:
        """Return by how much a drift makes held-out samples more probable beside a set."""
        a, b = (self.candidates[effects][d].figures for d in (drift, HEALTHY))
        return self.weights @ (a.log_likelihood - b.log_likelihood)

    def _figures(self, effects: frozenset[str]) -> HeldOut:
        """Return the figures of a set in the present noise, or in healthy noise without it."""
        fits = self.candidates[effects]
        return fits[self.noise if self.noise in fits else HEALTHY].figures

    def interval(self, draws: np.ndarray) -> Interval:
        """Return the value of all blocks with the interval of the draws."""
        low, high = np.quantile(draws[1:], [_LOWEST, _HIGHEST], method='nearest')
        return Interval(float(draws[0]), float(min(low, draws[0])), float(max(high, draws[0])))


def is_needed(evidence: Evidence, effects: frozenset[str], effect: str) -> bool:
    """Determine whether a set loses a material part of what it explains without an effect."""
    if effect in evidence.sizeless.get(effects, ()):
        return False
    rest = effects - {effect}
    lost = evidence.figure(evidence.gain(effects, rest))
    nats = evidence.figure(evidence.nats(effects, rest))
    is_certain = nats.value > _NATS and max(nats.low, lost.low) > 0
    if not is_certain:
        return False
    hints = effect_named(effect).diagnosis
    # An error of form of another effect may look like an effect over the same variables.
    shares_form = any({*hints.form} & {*effect_named(e).diagnosis.form} for e in rest)
    share = _SHARE_OF_FORM if shares_form else _SHARE_OF_SET
    explained = float(evidence.gain(effects, _NOTHING)[0])
    by_pose = bool(hints.proof) and {*hints.proof} <= _SHOWN_BY_POSE
    return lost.value > max(evidence.material_power(float(by_pose)), share * explained)


def _is_minimal(evidence: Evidence, effects: frozenset[str]) -> bool:
    """Determine whether all effects of a set are needed."""
    return all(
        effects - {e} in evidence.candidates and is_needed(evidence, effects, e) for e in effects
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
    kept.sort(key=lambda effects: -evidence.nats(effects, _NOTHING)[0])
    first = kept[0]
    alternatives = [first]
    for other in kept[1:]:
        is_less_probable = evidence.figure(evidence.nats(first, other)).predicts
        if len(other) == len(first) and not is_less_probable:
            alternatives.append(other)
    dropped = [a for a in alternatives if any(evidence.leaves_more(a, b) for b in alternatives)]
    return [effects for effects in kept if effects not in dropped]


def drifts_beside(evidence: Evidence, effects: frozenset[str], rest: Rest) -> list[str]:
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
    explained = float(evidence.gain(effects, _NOTHING)[0])
    exact = all(effect_named(e).exact for e in effects)
    share = _SHARE_OF_SET if exact else _SHARE_OF_FORM
    smallest = max(evidence.material_mps2**2, share * explained)
    of_functions = evidence.weights @ rest.steady_log_likelihood
    is_material = candidate[drifts[0]].drift_mps2 ** 2 > smallest
    is_likely = evidence.figure(best).predicts
    beats_functions = evidence.figure(best - of_functions).predicts
    if not (is_material and is_likely and beats_functions):
        return []
    others = [d for d in drifts[1:] if not evidence.figure(best - nats[d]).predicts]
    return [drifts[0], *others]


class NoiseCause(NamedTuple):
    """An effect that shows in the noise, not in the mean."""

    effect: str
    # Mean square that it adds, (m/s²)²; infinite for repeated samples, which hide what was
    power_mps2: float
    is_left_out: bool  # Whether its samples are not among the compared ones


class _Answer(NamedTuple):
    """Status, certain effects, and groups of inseparable ones."""

    status: str
    effects: frozenset[str] = _NOTHING
    groups: frozenset[frozenset[str]] = frozenset()


class _Powers(NamedTuple):
    """What the best set explains and leaves, (m/s²)²."""

    explained: float  # Explained power
    above: float  # What is left above the noise floor, repeating or not
    repeats: float  # What repeats beside the set and the drifts; 0 where it is not material
    drift: float  # Power of the first drift
    drifts: Sequence[str]  # The drifts of the noise, the best first

    def remaining(self, material: float) -> float:
        """Return what is left beside effects: what repeats, or all that no drift explains."""
        is_more = self.above > self.drift + material
        return max(self.repeats, self.above) if is_more else self.repeats


def _powers(
    evidence: Evidence,
    best: frozenset[str],
    rest: Rest,
    rest_material: float,
    drifts: Sequence[str],
    of_noise: float,
) -> _Powers:
    """Weigh what the best set and the noise leave, and drop the drifts where it is none."""
    explained = float(evidence.gain(best, _NOTHING)[0])
    above = float(evidence.left(best)[0]) - of_noise
    repeats = evidence.figure(evidence.mean(rest.squares))
    steady = evidence.figure(evidence.mean(rest.steady_squares))
    drift = evidence.drift_power(best, drifts)
    follows_more = steady.low > rest_material and steady.value > _SHARE_OF_FORM * drift
    is_random = rest.drift_p >= _SMALLEST_P
    if drifts and (follows_more or not is_random):
        # A drift follows time alone, and at random; its fit takes up what does not, too.
        return _Powers(explained, above, max(repeats.value, above), 0.0, ())
    material = repeats.value if repeats.low > rest_material else 0.0
    return _Powers(explained, above, material, drift, drifts)


def _rivals(
    evidence: Evidence, minimal: Sequence[frozenset[str]], repeats: float
) -> list[frozenset[str]]:
    """
    Return the other sets that could be the answer in place of the first.

    The order of two sets could be that of their errors of form, where these are as large as what
    repeats beside the best set; or that of errors of the reference in motion.
    """
    best = minimal[0]
    smallest = max(repeats, evidence.errs_in_motion * evidence.reference_mps2**2)
    rivals = []
    for other in minimal[1:]:
        is_less_probable = evidence.figure(evidence.nats(best, other)).predicts
        explains_less = evidence.figure(evidence.gain(best, other)).value > smallest
        is_beaten = is_less_probable and explains_less
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
    rest: Rest,
    rest_material: float,
    drifts: Sequence[str],
    in_noise: Sequence[NoiseCause],
) -> _Answer:
    """Apply the rule to the figures of all blocks, or of one draw of them."""
    minimal = minimal_sets(evidence)
    best, material = minimal[0], evidence.material_power(1.0)
    detected = frozenset(cause.effect for cause in in_noise)
    # Only samples that are compared say what is left.
    of_noise = sum(cause.power_mps2 for cause in in_noise if not cause.is_left_out)
    powers = _powers(evidence, best, rest, rest_material, drifts, of_noise)
    # A reference that lacks motion leaves more than a floor at rest.
    only_repeats = evidence.fades or not best
    unexplained = powers.repeats if only_repeats else powers.remaining(material)
    if unexplained > powers.explained + powers.drift + of_noise:
        return _Answer('unknown')
    named = frozenset(() if evidence.wanders else powers.drifts)
    if not best | detected | named:
        # What neither repeats nor is noise at rest is no gap only while the noise is larger.
        is_much = powers.above > max(evidence.floor_mps2**2, material)
        return _Answer('unknown' if is_much else 'no_gap')
    groups = _groups(best, _rivals(evidence, minimal, powers.repeats))
    certain = best.difference(*groups) | detected
    if len(named) > 1:
        groups, certain = groups | {named}, certain - named
    else:
        certain |= named
    remaining = powers.remaining(material) if best else powers.repeats
    is_partly = remaining > _SHARE_OF_FORM * (powers.explained + remaining)
    if groups and is_partly and not certain:
        # Nothing is named for certain, and none of the rivals explains what repeats.
        return _Answer('unknown')
    if groups:
        return _Answer('inseparable', certain, groups)
    return _Answer('partly' if is_partly else 'explained', certain)


class _BestSet(NamedTuple):
    """The most probable set, and what it and the noise leave."""

    evidence: Evidence  # The figures, in the noise beside the set
    effects: frozenset[str]
    rest: Rest
    drifts: Sequence[str]  # The drifts of the noise, the best first


def _best_set(
    evidence: Evidence,
    rest_of: Callable[[frozenset[str], str], Rest],
    simulate_again: Callable[[frozenset[str]], SimulatedAgain] | None,
) -> _BestSet:
    """Find the most probable set, and compare sets in noise that drifts where it is needed."""

    def simulated(weighed: Evidence) -> Evidence:
        if simulate_again is None:
            return weighed
        sets = filter(None, minimal_sets(weighed))
        return replace(weighed, again={effects: simulate_again(effects) for effects in sets})

    evidence = simulated(evidence)
    best = minimal_sets(evidence)[0]
    rest = rest_of(best, HEALTHY)
    drifts = drifts_beside(evidence, best, rest)
    if drifts:
        # In noise that drifts, sets explain less than they seem to beside white noise.
        evidence = simulated(replace(evidence, noise=drifts[0]))
        best = minimal_sets(evidence)[0]
        drifts = [d for d in drifts if d in evidence.candidates[best]]
        rest = rest_of(best, drifts[0] if drifts else HEALTHY)
    return _BestSet(evidence, best, rest, drifts)


def decide(
    evidence: Evidence,
    rest_of: Callable[[frozenset[str], str], Rest],
    in_noise: Sequence[NoiseCause],
    simulate_again: Callable[[frozenset[str]], SimulatedAgain] | None = None,
) -> Verdict:
    """
    Apply the rule to the figures, and to draws of their blocks.

    in_noise: the effects that show in the noise.
    simulate_again: simulates a set that could be the answer.
    """
    evidence, best, rest, drifts = _best_set(evidence, rest_of, simulate_again)
    power = {d: float(evidence.mean(b)[0]) for d, b in rest.by_dimension.items()}
    repeats = evidence.interval(evidence.mean(rest.squares))
    # What follows the pose may be of the reference.
    pose = max((power[d] for d in _POSE & {*power}), default=0.0)
    pose_share = float(np.clip(pose / repeats.value, 0.0, 1.0)) if repeats.value > 0 else 0.0
    rest_material = evidence.material_power(pose_share)

    def answer_of(weighed: Evidence) -> _Answer:
        return _answer(weighed, rest, rest_material, drifts, in_noise)

    drawn = [answer_of(evidence.draw(number)) for number in range(1, len(evidence.weights))]
    votes = _votes(drawn)
    # What fewer draws support than that nothing is named is not stated (Breiman 1996).
    possible = (answer_of(evidence), _Answer('unknown'), _Answer('no_gap'))
    answer = max(possible, key=lambda a: _support(a, votes))
    probability, hypotheses = _probabilities(answer, votes)
    highest = max(evidence.interval(evidence.gain(e, _NOTHING)).high for e in evidence.candidates)
    strongest = sorted(power, key=lambda d: -power[d])
    return Verdict(
        status=answer.status,
        effects=tuple(sorted(answer.effects)),
        groups=tuple(sorted(tuple(sorted(g)) for g in answer.groups)),
        probability=probability,
        hypotheses=hypotheses,
        best=best,
        material_mps2=evidence.material_mps2,
        reference_mps2=evidence.reference_mps2,
        explained=evidence.interval(evidence.gain(best, _NOTHING)),
        rest=repeats,
        left=evidence.interval(evidence.left(best)),
        upper_limit_mps2=max(highest, repeats.high, evidence.material_power(1.0)) ** 0.5,
        lost_without={e: evidence.interval(evidence.gain(best, best - {e})) for e in sorted(best)},
        rest_follows=tuple(
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


def _probabilities(
    answer: _Answer, votes: Mapping[frozenset[str], float]
) -> tuple[float, tuple[WeightedHypothesis, ...]]:
    """Return the probability of the answer, and of all sets, none above the answer's."""
    named, agreed = set(_sets(answer)), _support(answer, votes)
    probability = float(np.interp(agreed, _REPEATED, _RIGHT))
    weights = {
        e: min(share / (1 - agreed) * (1 - probability), probability)
        for e, share in votes.items()
        if e not in named
    }
    weights |= {effects: probability / len(named) for effects in named}
    missing = 1.0 - sum(weights.values())
    remaining = frozenset(() if answer.status == 'unknown' else {UNKNOWN})
    if missing > 1e-12:
        weights[remaining] = weights.get(remaining, 0.0) + missing
    return probability, normalised({tuple(sorted(e)): w for e, w in weights.items()})
