# SPDX-License-Identifier: Apache-2.0
"""
Held-out figures of sets of effects: mean squares, explained power, and the rest that repeats.

Blocks of time are held out in turn, and the blocks next to them are not fitted. A set of effects
is fitted to the other blocks and predicts the ones left out. Zero-g, scale factor, filter and
latency are free beside it, within what a healthy, calibrated unit may differ by.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
import warnings

from adxl_ros.diagnose import evidence
from adxl_ros.diagnose.evidence import BLOCKS, LinearFit
from adxl_ros.diagnose.hypothesis_fit import Hypothesis, LinearisedHypothesis
from adxl_ros.diagnose.linear_model import LinearModel
from adxl_ros.diagnose.noise_model import expected_drift_g
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.diagnosis_hints import FormDimension
from adxl_ros.model.sensor import Sensor
import numpy as np
import scipy

FOLDS = 4
"""Parts of a recording, each of which is held out once. Chosen: run time."""
_RUN_BLOCKS = 2
"""Neighbouring blocks that are held out together. Chosen: slow effects change within two."""
_DRAWS = 200
"""Draws of blocks. Chosen: the 5 % quantile has 10 draws below it."""
_ROUNDS = 12
"""Rounds of the fit of the levels of flexible functions. Chosen: they no longer change then."""
_FIRST_LEVEL_G = 1e-3
"""First level of a flexible function, g rms. Any other ends at the same levels."""
POSE = (FormDimension.FORCE, FormDimension.CROSS_FORCE, FormDimension.ALPHA, FormDimension.BETA)
"""Dimensions that only change with the pose."""
_POSES = 2000
"""Samples that show whether an effect follows the pose. Chosen: run time."""
_FIRST_MEAN_S = 0.1
"""Shortest mean in which a drift is looked for, s. Chosen: noise of sensors is white there."""
_FEWEST_MEANS, _FEWEST_STEPS = 16, 12
"""Fewest means of a recording, and of increments, that show a form."""
_ALL, _STEADY = 'all', 'all but time'
"""Choices of functions."""
_SMALLEST_LEVEL = 1e-4
"""Level, in first levels, below which a flexible function is left out: 0.1 µg."""


def folds() -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield held-out and fitted blocks, (blocks,) bool each."""
    number = np.arange(BLOCKS)
    for fold in range(FOLDS):
        held_out = (number // _RUN_BLOCKS) % FOLDS == fold
        yield held_out, np.convolve(held_out, np.ones(3), 'same') == 0


def block_weights(seed: int) -> np.ndarray:
    """Return how often each block is drawn, (1 + draws, blocks); the first row takes each once."""
    drawn = np.random.default_rng(seed).integers(0, BLOCKS, (_DRAWS, BLOCKS))
    counts = np.apply_along_axis(np.bincount, 1, drawn, minlength=BLOCKS)
    return np.concatenate([np.ones((1, BLOCKS)), counts])


@dataclass(frozen=True)
class HeldOut:
    """What a set of effects leaves of blocks that it was not fitted to."""

    # Squares of recording minus simulation, mean over axes, sum over samples, by block, (m/s²)²,
    # (blocks,)
    squares: np.ndarray
    log_likelihood: np.ndarray  # Log likelihood by block, (blocks,)


@dataclass(frozen=True)
class Rest:
    """What flexible functions predict of held-out blocks beyond a set of effects."""

    # Decrease of the squares by all functions together, by block, (m/s²)², (blocks,)
    squares: np.ndarray
    # The same by all functions but those of time, and their increase of the log likelihood
    steady_squares: np.ndarray
    steady_log_likelihood: np.ndarray
    # Decrease of the squares by the functions of one dimension alone, by block
    by_dimension: dict[str, np.ndarray]
    # Probability that a drift has increments with such jumps or lines; 1 beside a healthy unit
    drift_p: float = 1.0


@dataclass(frozen=True)
class HeldOutFits:
    """The fits of a linearised set of effects to all blocks but those held out."""

    linearised: LinearisedHypothesis  # The set of effects, linearised at its fit to all blocks
    # Effects by which the zero-g may drift more than that of a healthy unit
    drifts: tuple[str, ...] = ()

    @cached_property
    def full(self) -> LinearFit:
        """Fit to all blocks."""
        return self.linearised.fit(drifts=self.drifts)

    @cached_property
    def departures(self) -> np.ndarray:
        """Departures from the prior mean after the fit to all blocks, (k,)."""
        return self.linearised.departures(self.full, self.full)

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
            for number, (columns, channel) in enumerate(zip(linearised.columns,
                                                            linearised.channels)):
                v = np.concatenate([[1.0], -departures[columns.places]])
                squares[held_out] += np.einsum('i,bij,j->b', v, columns.plain[held_out], v)
                f, variance = fit.filter_indices[number], fit.innovation_variance_v2[number]
                white = np.einsum('i,bij,j->b', v, channel.block_grams[f][held_out], v)
                log_likelihood[held_out] += channel.log_scales[f][held_out] - 0.5 * (
                    white / variance + channel.counts[held_out] * np.log(variance))
        return HeldOut(squares, log_likelihood)


def reproducible_rest(fits: HeldOutFits, model: LinearModel) -> Rest:
    """
    Predict held-out blocks by flexible functions of everything that a residual may follow.

    Each axis has functions by dimension; their levels are those of the largest evidence (MacKay
    1992), so that functions that follow noise vanish. The effects keep their values, so that the
    functions take up only what the effects leave.
    """
    squares, steady, steady_squares = np.zeros((3, BLOCKS))
    by_dimension: dict[str, np.ndarray] = {}
    linearised = fits.linearised
    for number, (columns, filters) in enumerate(zip(linearised.columns, linearised.filters)):
        recording, axis = model.place_of_channel(number)
        comparison = model.comparisons[recording]
        basis = model.flexible_bases[recording][axis]
        if not basis:
            continue
        scale = float(comparison.scale_v_per_mps2[axis]) * len(comparison.sensor.axes) ** 0.5
        unit_v = _FIRST_LEVEL_G * float(comparison.sensor.scale_v_per_g[axis])
        dimension = np.repeat(np.arange(len(basis)), [b.shape[1] for b in basis.values()])
        k = columns.values.shape[1]
        design = np.concatenate([columns.values, unit_v * np.concatenate(
            list(basis.values()), axis=1)], axis=1)
        whitener = filters[fits.full.filter_indices[number]]
        white = evidence.whiten_channel(
            design[:, 0], design[:, 1:], np.arange(design.shape[1] - 1), comparison.used,
            [whitener]).block_grams[0]
        plain = evidence.plain_grams(design / scale, comparison.used)
        variance = float(fits.full.innovation_variance_v2[number])
        whole = _Products(white.sum(axis=0)[None], k, fits.departures[columns.places])
        choices = {name.value: dimension == i for i, name in enumerate(basis)}
        choices |= {_ALL: dimension >= 0, _STEADY: ~choices[FormDimension.TIME.value]}
        by_fold = [(held_out, _Products(white[fitted].sum(axis=0)[None], k, d[columns.places]),
                    _Products(plain[held_out], k, d[columns.places]),
                    _Products(white[held_out], k, d[columns.places]))
                   for held_out, fitted, _, d in fits.by_fold]
        for name, chosen in choices.items():
            level = _levels(whole, dimension, chosen, variance)
            for held_out, fitted, flat, whitened in by_fold:
                values = fitted.fit(level, variance)
                if name == _STEADY:
                    steady[held_out] += 0.5 * whitened.gain(values) / variance
                    steady_squares[held_out] += flat.gain(values)
                elif name == _ALL:
                    squares[held_out] += flat.gain(values)
                else:
                    by_dimension.setdefault(name, np.zeros(BLOCKS))[held_out] += flat.gain(values)
    return Rest(squares, steady_squares, steady, by_dimension, _drift_p(fits, model))


def _drift_p(fits: HeldOutFits, model: LinearModel) -> float:
    """Return the smallest p of the increments beside a drift, for the number of axes."""
    if not fits.drifts:
        return 1.0
    p = []
    for number, columns in enumerate(fits.linearised.columns):
        comparison = model.comparisons[model.place_of_channel(number)[0]]
        left = columns.values @ np.concatenate([[1.0], -fits.departures[columns.places]])
        p.append(increments_p(left, comparison.used, comparison.sensor.rate_hz))
    return min(1.0, len(p) * min(p))


def increments_p(values: np.ndarray, used: np.ndarray, rate_hz: float) -> float:
    """
    Return how probable the increments of a residual are if they are those of a random drift.

    The means are those over the time from which the drift exceeds the noise: twice that of the
    smallest Allan deviation. A drift has Gaussian increments (test of Anscombe and Glynn 1983)
    without a line (test of Fisher 1929); jumps between levels and slow oscillations have not.
    """
    longest = int(used.sum()) // _FEWEST_MEANS
    lengths = np.unique(np.geomspace(max(1.0, _FIRST_MEAN_S * rate_hz), max(longest, 1), 12
                                     ).astype(int))
    if len(lengths) < 2:
        return 1.0
    kept = np.where(used, values, np.nan)

    def increments(length: int) -> np.ndarray:
        parts = kept[:len(kept) // length * length].reshape(-1, length)
        known = np.isfinite(parts).mean(axis=1) > 0.5
        means = np.full(len(parts), np.nan)
        means[known] = np.nanmean(parts[known], axis=1)
        steps = np.diff(means)
        return steps[np.isfinite(steps)]

    quietest = min(lengths, key=lambda n: np.mean(increments(n) ** 2))
    steps = increments(min(2 * int(quietest), longest))
    if len(steps) < _FEWEST_STEPS or not np.ptp(steps):
        return 1.0
    power = np.abs(np.fft.rfft(steps - steps.mean())[1:(len(steps) + 1) // 2]) ** 2
    line = min(1.0, len(power) * (1 - power.max() / power.sum()) ** (len(power) - 1))
    with warnings.catch_warnings():
        # Older versions warn below 20 increments, where the test is rougher.
        warnings.simplefilter('ignore')
        shape = float(scipy.stats.kurtosistest(steps).pvalue)
    return min(1.0, 2 * min(line, shape))


class _Products:
    """Products of the residual after the effects with flexible functions, by block."""

    def __init__(self, grams: np.ndarray, k: int, departures: np.ndarray) -> None:
        self._functions = grams[:, k:, k:]
        self._residual = grams[:, k:, :k] @ np.concatenate([[1.0], -departures])

    def gain(self, values: np.ndarray) -> np.ndarray:
        """Return by how much the functions lower the squares, by block."""
        active = np.flatnonzero(values)
        v = values[active]
        return 2 * self._residual[:, active] @ v - np.einsum(
            'i,bij,j->b', v, self._functions[:, active[:, None], active], v)

    def normal(self, active: np.ndarray, level: np.ndarray, variance: float
               ) -> tuple[np.ndarray, np.ndarray]:
        """Return precision and information of the coefficients that are active."""
        gram = self._functions.sum(axis=0)[np.ix_(active, active)]
        return (gram / variance + np.diag(1 / level[active]),
                self._residual.sum(axis=0)[active] / variance)

    def fit(self, level: np.ndarray, variance: float) -> np.ndarray:
        """Return the coefficients of the functions, (functions,)."""
        values, active = np.zeros(len(level)), np.flatnonzero(level)
        if len(active):
            values[active] = np.linalg.solve(*self.normal(active, level, variance))
        return values


def _levels(products: _Products, dimension: np.ndarray, chosen: np.ndarray, variance: float
            ) -> np.ndarray:
    """Return the variance of each function's coefficient of the largest evidence, (functions,)."""
    level = np.where(chosen, 1.0, 0.0)
    count = dimension.max() + 1
    for _ in range(_ROUNDS):
        active = np.flatnonzero(level > _SMALLEST_LEVEL ** 2)
        if not len(active):
            break
        precision, information = products.normal(active, level, variance)
        covariance = np.linalg.inv(precision)
        mean, ids = covariance @ information, dimension[active]
        total = np.bincount(ids, mean ** 2 + np.diag(covariance), count)
        level[active] = (total / np.maximum(np.bincount(ids, minlength=count), 1))[ids]
        level[level <= _SMALLEST_LEVEL ** 2] = 0.0
    return level


def pose_shares(hypothesis: Hypothesis, model: LinearModel) -> dict[str, float]:
    """
    Return for each effect the share of what it does that a function of the pose also does.

    Beyond the share that the pose of another time does: a slow signal is like many functions.
    """
    done, by_pose = dict.fromkeys(hypothesis.effects, 0.0), dict.fromkeys(hypothesis.effects, 0.0)
    linearised = hypothesis.linearised
    for number, columns in enumerate(linearised.columns):
        recording, axis = model.place_of_channel(number)
        comparison, basis = model.comparisons[recording], model.flexible_bases[recording][axis]
        rows = np.flatnonzero(comparison.used)[::max(1, int(comparison.used.sum()) // _POSES)]
        pose = np.concatenate([np.ones((len(rows), 1)), *(
            basis[d][rows] for d in POSE if d in basis)], axis=1)
        basis_of_pose = np.linalg.qr(pose)[0]
        for effect in hypothesis.effects:
            own = [i for i, k in enumerate(columns.places)
                   if k < len(hypothesis.names) and hypothesis.names[k].effect == effect]
            does = columns.values[rows][:, 1:][:, own] @ hypothesis.values[columns.places[own]]
            shares = [np.sum((basis_of_pose.T @ np.roll(does, k * len(does) // 4)) ** 2)
                      for k in range(4)]
            square, other = float(does @ does), float(np.mean(shares[1:]))
            done[effect] += square - other
            by_pose[effect] += float(shares[0]) - other
    return {e: float(np.clip(by_pose[e] / done[e], 0.0, 1.0)) if done[e] > 0 else 1.0
            for e in hypothesis.effects}


def drift_mps2(fits: HeldOutFits, model: LinearModel) -> float:
    """Return the expected rms of the drift that the fitted noise has, m/s²."""
    squares = []
    for number, (filters, f) in enumerate(zip(fits.linearised.filters,
                                              fits.full.filter_indices)):
        comparison = model.comparisons[model.place_of_channel(number)[0]]
        w = filters[f]
        squares.append(0.0 if w.healthy else expected_drift_g(
            w.spectrum, w.density, comparison.span_s, comparison.sensor.rate_hz) ** 2)
    return float(G0_MPS2 * np.sqrt(np.mean(squares)))


def drift_densities(fits: HeldOutFits, sensor: Sensor) -> np.ndarray:
    """Return the densities of the drift on the axes of the first recording, (m,)."""
    whiteners = [filters[f] for filters, f in zip(fits.linearised.filters,
                                                  fits.full.filter_indices)]
    return np.array([0.0 if w.healthy else w.density for w in whiteners[:len(sensor.axes)]])


def used_counts(model: LinearModel) -> np.ndarray:
    """Return the samples that are used by block, (blocks,)."""
    return np.sum([np.add.reduceat(c.used, evidence.block_edges(len(c))[:-1])
                   for c in model.comparisons], axis=0).astype(float)
