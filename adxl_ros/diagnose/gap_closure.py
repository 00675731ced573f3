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

"""
How large the gap is, what each effect contributes, and how far a hypothesis closes the gap.

The gap is the rms of recording minus simulation over all used samples and axes. Nothing is removed
from it. What zero-g and drift take up is stated beside it.

Blocks are held out in turn, and the blocks next to them are not fitted. The gap after a hypothesis
is that of the held-out blocks. The decision compares hypotheses by the residual about a zero-g
that may drift, which is called the levelled residual.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from adxl_ros.diagnose import evidence, noise_floor
from adxl_ros.diagnose.baseline_comparison import BaselineComparison, Reference
from adxl_ros.diagnose.evidence import BLOCKS
from adxl_ros.diagnose.hypothesis_fit import Hypothesis, linearise
from adxl_ros.diagnose.linear_model import LinearModel
from adxl_ros.diagnose.noise_floor import FEWEST_SAMPLES, NoiseFloor, SquareSum
from adxl_ros.diagnose.noise_whitening import drifts_among, expected_drift_g, USUAL_DENSITY
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.diagnosis_hints import StraightLine
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import ActsOn
from adxl_ros.model.sensor import Sensor
import numpy as np
import scipy

_FOLDS = 4
"""Number of parts of a recording, each of which is held out once. Chosen: run time."""
_RUN_BLOCKS = 2
"""Number of neighbouring blocks that are held out together. Chosen: most slow effects change
within two blocks."""
_HARM_RATIO = 1.005
"""Held-out mean square with the hypothesis, divided by that of the baseline, above which the
hypothesis does harm. Chosen: above the change by refitting."""
_BOOTSTRAP_DRAWS = 400
"""Number of draws of the interval. Chosen: the 5 % quantile has 20 draws below it."""
_RATE_TOLERANCE = 1e-3
"""Largest relative difference of the sample rates of two repeats. Chosen: 20 ms in 20 s."""
_DRIFT_QUANTILE = 2.0
"""90 % quantile of the mean square of a random walk about its mean, divided by its expected value.
Derived from the random walk."""


@dataclass(frozen=True)
class GapClosure:
    """
    The gap before, after and at the noise floor, and the closed share.

    Attributes
    ----------
    before_mps2
        Rms of the recording minus the simulation of the baseline, m/s².
    after_mps2
        The same with the effects of the hypothesis, on held-out blocks, m/s².
    zero_g_mps2
        Rms over axes of the constant zero-g in the gap, m/s². The effects of the hypothesis are
        not in it, unless one of them is the zero-g.
    drift_mps2
        Rms of the slow changes of the zero-g about this constant, m/s². It is not larger than the
        drift of the noise model of the hypothesis.
    floor_mps2
        Noise floor, m/s².
    closed
        (before² − after²)/(before² − floor²); NaN where there is no gap to close.
    closed_ci
        90 % interval of the closed share.
    harm
        Whether the hypothesis makes the levelled held-out residual larger.
    explained_mps2
        Rms of the levelled residual that the fit to all blocks explains, m/s².
    fitted_rms_mps2
        Rms of the levelled residual about the fit to all blocks, none held out, m/s².
    log_likelihood_gain
        Held-out log likelihood with the effects minus that without.
    blocks
        Squares before and after, and samples, by block, (3, blocks).
    floor_ci
        90 % interval of the noise floor, m/s²; None where the floor is not measured.

    """

    before_mps2: float
    after_mps2: float
    zero_g_mps2: float
    drift_mps2: float
    floor_mps2: float
    closed: float
    closed_ci: tuple[float, float]
    harm: bool
    explained_mps2: float
    fitted_rms_mps2: float
    log_likelihood_gain: float
    blocks: np.ndarray = field(repr=False)
    floor_ci: tuple[float, float] | None = None

    def after_draws_mps2(self, seed: int) -> np.ndarray:
        """Return the gap after from blocks drawn with replacement, rms, m/s², (n,)."""
        return np.sqrt(_drawn_squares(self.blocks, seed)[1])

    def at_floor(self, floor_mps2: float, floor_ci: tuple[float, float] | None, seed: int
                 ) -> GapClosure:
        """
        Return the closure with another noise floor.

        Parameters
        ----------
        floor_mps2
            Noise floor, m/s².
        floor_ci
            Its 90 % interval, m/s²; None for none.
        seed
            Seed of the bootstrap.

        Returns
        -------
        GapClosure
            The same gap with another closed share.

        """
        closed, interval = _closed_share(self.blocks, floor_mps2, seed)
        return replace(self, floor_mps2=floor_mps2, floor_ci=floor_ci, closed=closed,
                       closed_ci=interval)


@dataclass(frozen=True)
class HeldOutResidual:
    """
    The residual of a hypothesis on blocks that it was not fitted to.

    Attributes
    ----------
    squares
        Sum over samples of the mean square over axes, of the levelled residual, by block,
        (m/s²)², (blocks,).
    plain_squares
        The same of the residual as it is. Without effects it is that of the baseline itself.
    log_likelihood
        Log likelihood of all blocks.

    """

    squares: np.ndarray
    plain_squares: np.ndarray
    log_likelihood: float


def estimate_noise_floor(comparisons: Sequence[BaselineComparison]) -> NoiseFloor:
    """
    Estimate the noise floor from rests, else from repeats, else from the parameter file.

    The noise at rest is that about the mean of each second. The mean square of the encoder's steps
    is added.
    """
    baseline = comparisons[0].sensor
    sums = [part for c in comparisons for part in noise_floor.squares_at_rest(
        c.volts, c.at_rest & c.used, c.sensor)]
    source = 'still'
    if sum(part.count for part in sums) < FEWEST_SAMPLES:
        sums, source = _repeat_squares(comparisons), 'repeats'
    count = sum(part.count for part in sums)
    if count < FEWEST_SAMPLES:
        sums, noise_v, source = [], noise.sample_std_v(baseline), 'assumed'
    else:
        noise_v = np.sqrt(np.sum([part.squares_v2 for part in sums], axis=0) / count)
    encoder = float(np.mean([_encoder_mean_square(c) for c in comparisons]))
    scale_v_per_mps2 = comparisons[0].scale_v_per_mps2
    parts = np.array([(np.mean(part.squares_v2 / scale_v_per_mps2 ** 2) + part.count * encoder,
                       part.count) for part in sums]).reshape(-1, 2).T
    noise_mps2 = noise_v / scale_v_per_mps2
    return NoiseFloor(noise_v, float(np.sqrt(np.mean(noise_mps2 ** 2) + encoder)), source, parts)


def _repeat_squares(comparisons: Sequence[BaselineComparison]) -> list[SquareSum]:
    """Return the squares of the differences between repeats of a trajectory on the stage."""
    staged = [c for c in comparisons if c.reference is Reference.STAGE]
    directions = [noise_floor.directions(c.motion.alpha(c.time_s), c.motion.beta(c.time_s))
                  for c in staged]
    out: list[SquareSum] = []
    for i, first in enumerate(staged):
        for j, second in enumerate(staged[i:], i):
            rate_hz = first.sensor.rate_hz
            if abs(rate_hz / second.sensor.rate_hz - 1) > _RATE_TOLERANCE:
                continue
            repeat = noise_floor.find_repeat(directions[i], directions[j], rate_hz,
                                             first.sensor.stage_resolution_rad, i == j)
            if repeat is not None:
                used = first.used[repeat[0]] & second.used[repeat[1]]
                out += noise_floor.squares_of_difference(
                    first.residual_v(first.sensor)[repeat[0]][used],
                    second.residual_v(second.sensor)[repeat[1]][used], rate_hz)
    return out


def _encoder_mean_square(comparison: BaselineComparison) -> float:
    """Return the mean square that the steps of the encoder make in a recording, (m/s²)²."""
    if comparison.reference is not Reference.STAGE or not comparison.sensor.stage_resolution_rad:
        return 0.0
    motion, time_s, used = comparison.motion, comparison.time_s, comparison.used
    return noise_floor.encoder_mean_square(motion.alpha(time_s)[used], motion.beta(time_s)[used],
                                           comparison.sensor)


def unexplained_mps2(linear_model: LinearModel, hypothesis: Hypothesis, closure: GapClosure,
                     noise_mps2: float, lost_mps2: float = 0.0) -> float:
    """
    Return the rms that neither the hypothesis nor noise nor a healthy drift explains.

    Parameters
    ----------
    linear_model
        The recordings.
    hypothesis
        The best hypothesis, whose noise may drift.
    closure
        Its gap closure.
    noise_mps2
        Rms of the simulated noise, with lines, spikes and steps that were detected, m/s².
    lost_mps2
        Rms of the motion that a smooth reference lacks, m/s².

    Returns
    -------
    float
        Rms, m/s².

    """
    floor = max(closure.floor_mps2, noise_mps2) ** 2 \
        + _DRIFT_QUANTILE * float(np.mean(_drift_squares(linear_model, hypothesis)))
    return float(np.sqrt(max(closure.fitted_rms_mps2 ** 2 - lost_mps2 ** 2 - floor, 0.0)))


def lost_motion_mps2(comparison: BaselineComparison, sensor: Sensor) -> float:
    """
    Return the rms of motion that the reference lacks, over all samples and axes, m/s².

    It is the residual above the frequency from which the reference lacks a part, without the
    noise.

    Parameters
    ----------
    comparison
        A recording, at its full rate.
    sensor
        The sensor with the effects of a hypothesis.

    Returns
    -------
    float
        Rms, m/s²; 0 where the reference does not fade.

    """
    if not comparison.reference_fades:
        return 0.0
    residual = evidence.bridged(comparison.residual_v(sensor), comparison.used) \
        / comparison.scale_v_per_mps2
    frequency_hz, density = scipy.signal.periodogram(residual, comparison.sensor.rate_hz, axis=0)
    fast = frequency_hz > comparison.lacking_hz
    resting = comparison.at_rest & comparison.used
    noise_square = _fast_square(residual[resting], comparison) if resting.any() else 0.0
    square = float(density[fast].sum() * frequency_hz[1]) / residual.shape[1]
    return float(np.sqrt(max(square - noise_square, 0.0)))


def _fast_square(resting: np.ndarray, comparison: BaselineComparison) -> float:
    """Return the mean square of samples at rest, (n, m), above that frequency."""
    frequency_hz, density = scipy.signal.periodogram(resting, comparison.sensor.rate_hz, axis=0)
    fast = frequency_hz > comparison.lacking_hz
    return float(density[fast].sum() * frequency_hz[1]) / resting.shape[1]


def held_out_residual(linear_model: LinearModel, comparisons: Sequence[BaselineComparison],
                      effects: Sequence[str], sensor: Sensor) -> HeldOutResidual:
    """
    Fit on three quarters of the blocks and simulate the others at the full rate, in turn.

    Parameters
    ----------
    linear_model
        The recordings at the rate of the search.
    comparisons
        The same recordings at their full rate.
    effects
        Effects whose parameters are fitted.
    sensor
        The sensor with these effects as fitted to all blocks.

    Returns
    -------
    HeldOutResidual
        Squares by block, and the log likelihood.

    """
    number = np.arange(BLOCKS)
    linearised = linearise(linear_model, effects, sensor)
    full_fit = linearised.fit()
    squares, plain_squares, log_likelihood = np.zeros(BLOCKS), np.zeros(BLOCKS), 0.0
    for fold in range(_FOLDS):
        held_out = (number // _RUN_BLOCKS) % _FOLDS == fold
        fitted = np.convolve(held_out, np.ones(3), 'same') == 0
        fit = linearised.fit(fitted)
        log_likelihood += float(evidence.held_out_log_likelihood(
            linearised.channels, fit, np.flatnonzero(held_out)).sum())
        refitted = linearised.refitted_sensor(fit, full_fit)
        for comparison in comparisons:
            residual = _residual_mps2(comparison, refitted)
            levelled = _levelled(comparison, residual, fitted, linear_model, effects)
            squares[held_out] += _squares_by_block(comparison, levelled)[held_out]
            if drifts_among(effects) and not _has_zero_g(effects):
                # The zero-g of this recording does not predict the next one.
                residual = residual + _zero_g_departure_mps2(comparison, refitted)
            plain_squares[held_out] += _squares_by_block(comparison, residual)[held_out]
    if not effects:
        plain_squares = np.sum([_squares_by_block(c, _residual_mps2(c, c.sensor))
                                for c in comparisons], axis=0)
    return HeldOutResidual(squares, plain_squares, log_likelihood)


def gap_closure(linear_model: LinearModel, comparisons: Sequence[BaselineComparison],
                hypothesis: Hypothesis, baseline_residual: HeldOutResidual, floor_mps2: float,
                seed: int) -> GapClosure:
    """
    Compare a hypothesis with the baseline on held-out blocks.

    Parameters
    ----------
    linear_model
        The recordings at the rate of the search.
    comparisons
        The same recordings at their full rate.
    hypothesis
        A fitted hypothesis, whose parameters are fitted again.
    baseline_residual
        Held-out residual without effects.
    floor_mps2
        Noise floor, m/s².
    seed
        Seed of the bootstrap.

    Returns
    -------
    GapClosure
        The gap and its closed share.

    """
    residual = baseline_residual if not hypothesis.effects else held_out_residual(
        linear_model, comparisons, hypothesis.effects, hypothesis.sensor)
    # Effects on the noise leave the mean and the gap as they are.
    if all(effect_named(effect).acts_on is not ActsOn.MEAN for effect in hypothesis.effects):
        residual = replace(baseline_residual, log_likelihood=residual.log_likelihood)
    before, after = baseline_residual.plain_squares, residual.plain_squares
    counts = np.zeros(BLOCKS)
    for c in comparisons:
        counts += np.add.reduceat(c.used, evidence.block_edges(len(c))[:-1])
    count = max(float(counts.sum()), 1.0)
    level = [_levels(c, linear_model, hypothesis, i) for i, c in enumerate(comparisons)]
    fitted_square = sum(part.levelled_squares for part in level) / count
    blocks = np.array([before, after, counts])
    closed, interval = _closed_share(blocks, floor_mps2, seed)
    return GapClosure(
        before_mps2=float(np.sqrt(before.sum() / count)),
        after_mps2=float(np.sqrt(after.sum() / count)),
        zero_g_mps2=float(np.sqrt(sum(part.zero_g_squares for part in level) / count)),
        drift_mps2=float(np.sqrt(sum(part.drift_squares for part in level) / count)),
        floor_mps2=floor_mps2,
        closed=closed,
        closed_ci=interval,
        harm=bool(residual.squares.sum() > baseline_residual.squares.sum() * _HARM_RATIO),
        explained_mps2=float(np.sqrt(max(
            baseline_residual.squares.sum() / count - fitted_square, 0.0))),
        fitted_rms_mps2=float(np.sqrt(fitted_square)),
        log_likelihood_gain=residual.log_likelihood - baseline_residual.log_likelihood,
        blocks=blocks)


def _closed_share(blocks: np.ndarray, floor_mps2: float, seed: int
                  ) -> tuple[float, tuple[float, float]]:
    """
    Return the closed share and its 90 % interval by a bootstrap of blocks.

    `blocks` are squares before and after, and samples. The share is NaN without a gap.
    """
    before, after, count = blocks.sum(axis=1)
    floor = floor_mps2 ** 2
    # The rms after can be below the floor by chance.
    lowest = min(floor, after / max(count, 1.0))
    before_drawn, after_drawn = _drawn_squares(blocks, seed)
    with np.errstate(all='ignore'):
        closed = (before - after) / (before - count * lowest)
        shares = (before_drawn - after_drawn) / (before_drawn - lowest)
    low, high = np.quantile(np.clip(np.nan_to_num(shares), -1, 1), [0.05, 0.95])
    return (float(min(closed, 1.0)) if before > count * floor else float('nan'),
            (float(low), float(high)))


def _drawn_squares(blocks: np.ndarray, seed: int) -> np.ndarray:
    """Return mean squares before and after from blocks drawn with replacement, (2, n)."""
    drawn = np.random.default_rng(seed).integers(0, BLOCKS, (_BOOTSTRAP_DRAWS, BLOCKS))
    return np.array([row[drawn].sum(axis=1) / blocks[2][drawn].sum(axis=1)
                     for row in blocks[:2]])


def _residual_mps2(comparison: BaselineComparison, sensor: Sensor) -> np.ndarray:
    """Return the recording minus the mean output of a sensor, m/s², (n, m)."""
    return comparison.residual_v(sensor) / comparison.scale_v_per_mps2


def _levelled(comparison: BaselineComparison, residual: np.ndarray, fitted: np.ndarray,
              linear_model: LinearModel, effects: Sequence[str]) -> np.ndarray:
    """
    Return a residual minus its mean over the fitted blocks, because the zero-g may drift.

    The mean shrinks towards zero by the tolerance of the zero-g, unless the zero-g is an effect of
    the hypothesis.
    """
    edges = evidence.block_edges(len(comparison))
    level_samples = comparison.used & np.repeat(fitted, np.diff(edges))
    if not level_samples.any():
        return residual
    drift_square = (USUAL_DENSITY * G0_MPS2) ** 2 * comparison.span_s / 6
    tolerance_v = np.array([np.inf if _has_zero_g(effects)
                            else linear_model.zero_g_tolerance_v(axis)
                            for axis in comparison.sensor.axes])
    return residual - residual[level_samples].mean(axis=0) \
        / (1 + drift_square / (tolerance_v / comparison.scale_v_per_mps2) ** 2)


def _has_zero_g(effects: Sequence[str]) -> bool:
    """Determine whether one of the effects is the zero-g."""
    return any(effect_named(e).diagnosis.straight_line is StraightLine.ZERO_G for e in effects)


def _squares_by_block(comparison: BaselineComparison, residual: np.ndarray) -> np.ndarray:
    """Return the sum over used samples of the mean square over axes, by block, (blocks,)."""
    squares = np.where(comparison.used, (residual ** 2).mean(axis=1), 0.0)
    return np.add.reduceat(squares, evidence.block_edges(len(comparison))[:-1])


def _zero_g_departure_mps2(comparison: BaselineComparison, sensor: Sensor) -> np.ndarray:
    """Return the zero-g of a sensor minus that of the baseline, m/s², (m,)."""
    change_v = sensor.zero_g_v - comparison.sensor.zero_g_v
    return change_v / comparison.scale_v_per_mps2


class _Levels(NamedTuple):
    """
    What the zero-g takes up of one recording, as sums over used samples, (m/s²)².

    `zero_g_squares` is that of a constant zero-g, `drift_squares` that of slow changes about it,
    and `levelled_squares` that of the levelled residual.
    """

    zero_g_squares: float
    drift_squares: float
    levelled_squares: float


def _levels(comparison: BaselineComparison, linear_model: LinearModel, hypothesis: Hypothesis,
            number: int) -> _Levels:
    """Split the zero-g of a recording into a constant and slow changes; `number` is its number."""
    residual = _residual_mps2(comparison, hypothesis.sensor)
    levelled = _levelled(comparison, residual, np.ones(BLOCKS, bool), linear_model,
                         hypothesis.effects)
    count = int(comparison.used.sum())
    mean = residual[comparison.used].mean(axis=0)
    zero_g = mean + _zero_g_departure_mps2(comparison, hypothesis.sensor)
    if comparison.reference is Reference.NONE:
        # The pose is unknown, and the mean of the residual is not compared.
        zero_g = np.zeros_like(zero_g)
    axes = len(comparison.sensor.axes)
    drift = [min(_slow_square(comparison, residual[:, d] - mean[d], d),
                 _DRIFT_QUANTILE * square) for d, square in enumerate(
                     _drift_squares(linear_model, hypothesis)[number * axes:][:axes])]
    return _Levels(count * float(np.mean(zero_g ** 2)), count * float(np.mean(drift)),
                   float(_squares_by_block(comparison, levelled).sum()))


def _slow_square(comparison: BaselineComparison, residual: np.ndarray, axis: int) -> float:
    """Return the mean square of the means of blocks, above that of white noise, (m/s²)²."""
    number = np.repeat(np.arange(BLOCKS), np.diff(evidence.block_edges(len(comparison))))
    number, values = number[comparison.used], residual[comparison.used]
    counts = np.maximum(np.bincount(number, minlength=BLOCKS), 1)
    means = np.bincount(number, values, minlength=BLOCKS) / counts
    noise_square = float(np.mean((values - means[number]) ** 2))
    rc_s = float(noise.electronics(comparison.sensor).rc_s[axis])
    independent = noise.effective_samples(counts, comparison.dt_s, rc_s)
    return max(float(np.average(means ** 2 - noise_square / independent, weights=counts)), 0.0)


def _drift_squares(linear_model: LinearModel, hypothesis: Hypothesis) -> list[float]:
    """Return the mean square of the drift that the noise of each channel has, (m/s²)²."""
    channels = [c for c in linear_model.comparisons for _ in c.sensor.axes]
    squares = []
    for c, whitener in zip(channels, hypothesis.whiteners):
        drift_g = expected_drift_g(whitener.spectrum, whitener.density, c.span_s,
                                   c.sensor.rate_hz)
        squares.append((G0_MPS2 * drift_g) ** 2)
    return squares
