# SPDX-License-Identifier: Apache-2.0
"""
The held-out figures of a set of effects, from which the verdict follows.

Blocks of time are held out in turn, and the blocks next to them are not fitted. A set of effects
is fitted to the other blocks and predicts the ones left out. Zero-g, scale factor, filter and
latency are free beside it, within what a healthy, calibrated unit may differ by. Flexible
functions then show what repeats and is not explained.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
import warnings

from adxl_ros.diagnose import evidence
from adxl_ros.diagnose.evidence import BLOCKS, LinearFit, LinearisedHypothesis
from adxl_ros.diagnose.linear_model import LinearModel
from adxl_ros.diagnose.noise_model import expected_drift_g
from adxl_ros.diagnose.residual_map import Basis
from adxl_ros.diagnose.verdict import HeldOut, Rest
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.diagnosis_hints import FormDimension
import numpy as np
import scipy

FOLDS, _RUN_BLOCKS = 4, 2
"""Parts of a recording, each of which is held out once, and neighbouring blocks that are held out
together. Chosen: run time, and slow effects change within two."""
_FIRST_MEAN_S, _FEWEST_MEANS, _FEWEST_STEPS = 0.1, 16, 12
"""Shortest mean in which a drift is looked for, s, and fewest means, and increments, that show a
form. Chosen: noise of sensors is white below it."""
_ROUNDS, _FIRST_LEVEL_G, _SMALLEST_LEVEL = 12, 1e-3, 1e-4
"""Rounds of the fit of the levels of flexible functions, first level, g rms, and level, in first
ones, below which a function is left out. Chosen: any other start ends at the same levels."""


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
                    linearised.columns, linearised.channels, fit.filter_indices,
                    fit.innovation_variance_v2):
                v = np.concatenate([[1.0], -departures[columns.places]])
                squares[held_out] += np.einsum('i,bij,j->b', v, columns.plain[held_out], v)
                white = np.einsum('i,bij,j->b', v, channel.block_grams[f][held_out], v)
                log_likelihood[held_out] += channel.log_scales[f][held_out] - 0.5 * (
                    white / variance + channel.counts[held_out] * np.log(variance))
        return HeldOut(squares, log_likelihood, self.drift_mps2)

    def drift_densities(self) -> np.ndarray:
        """Return the densities of the drift by channel; 0 for that of a healthy unit."""
        chosen = [filters[f] for filters, f in zip(self.linearised.filters,
                                                   self.full.filter_indices)]
        return np.array([0.0 if w.healthy else w.density for w in chosen])

    @property
    def drift_mps2(self) -> float:
        """Return the expected rms of the drift that the fitted noise has, m/s²."""
        sizes = []
        for number, density in enumerate(self.drift_densities()):
            comparison = self.model.comparisons[self.model.place_of_channel(number)[0]]
            spectrum = self.linearised.filters[number][self.full.filter_indices[number]].spectrum
            sizes.append(expected_drift_g(spectrum, density, comparison.span_s,
                                          comparison.sensor.rate_hz))
        return float(G0_MPS2 * np.sqrt(np.mean(np.square(sizes))))


def reproducible_rest(fits: HeldOutFits, bases: Sequence[Sequence[Basis]]) -> Rest:
    """
    Predict held-out blocks by flexible functions of everything that a residual may follow.

    Each axis has functions by dimension; their levels are those of the largest evidence (MacKay
    1992), so that functions that follow noise vanish. The effects keep their values, so that the
    functions take up only what the effects leave. `bases` are the functions of each axis of each
    recording.
    """
    linearised, model, every = fits.linearised, fits.model, [d.value for d in FormDimension]
    by_choice = {name: np.zeros(BLOCKS) for name in ('all', 'steady', 'nats')}
    whole = linearised.departures(fits.full, fits.full)
    for number, (columns, filters) in enumerate(zip(linearised.columns, linearised.filters)):
        recording, axis = model.place_of_channel(number)
        comparison = model.comparisons[recording]
        basis = bases[recording][axis]
        if not basis:
            continue
        unit_v = _FIRST_LEVEL_G * float(comparison.sensor.scale_v_per_g[axis])
        design = np.concatenate([columns.values, *(unit_v * b for b in basis.values())], axis=1)
        white = evidence.whiten_channel(
            design[:, 0], design[:, 1:], np.arange(design.shape[1] - 1), comparison.used,
            [filters[fits.full.filter_indices[number]]]).block_grams[0]
        scale = float(comparison.scale_v_per_mps2[axis]) * len(comparison.sensor.axes) ** 0.5
        plain = evidence.plain_grams(design / scale, comparison.used)
        variance = float(fits.full.innovation_variance_v2[number])
        names = np.repeat([d.value for d in basis], [b.shape[1] for b in basis.values()])
        choices = {name: names == name for name in every if name in names}
        choices |= {'all': names != '', 'steady': names != FormDimension.TIME.value}
        for name, chosen in choices.items():
            level = _levels(_products(white, whole[columns.places]), names, chosen, variance)
            active = np.flatnonzero(level)
            for held_out, fitted, _, departures in fits.by_fold if len(active) else ():
                gram, residual = _products(white[fitted], departures[columns.places], active)
                values = np.linalg.solve(gram / variance + np.diag(1 / level[active]),
                                         residual / variance)
                flat, gained = (np.array(
                    [_gain(_products(block[None], departures[columns.places], active), values)
                     for block in grams[held_out]]) for grams in (plain, white))
                by_choice.setdefault(name, np.zeros(BLOCKS))[held_out] += flat
                if name == 'steady':
                    by_choice['nats'][held_out] += 0.5 * gained / variance
    together, steady, nats = (by_choice.pop(name) for name in ('all', 'steady', 'nats'))
    p = [increments_p(c.values @ np.concatenate([[1.0], -whole[c.places]]), comparison.used,
                      comparison.sensor.rate_hz)
         for number, c in enumerate(linearised.columns if fits.drifts else ())
         for comparison in (model.comparisons[model.place_of_channel(number)[0]],)]
    return Rest(together, steady, nats, by_choice, min([1.0, *(len(p) * v for v in p)]))


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

    def increments(length: int) -> np.ndarray:
        whole = len(values) // length * length
        count, total = (v[:whole].reshape(-1, length).sum(axis=1)
                        for v in (used, np.where(used, values, 0.0)))
        means = np.where(count > length / 2, total / np.maximum(count, 1), np.nan)
        return np.diff(means)[np.isfinite(np.diff(means))]

    quietest = min(lengths.tolist(), key=lambda n: np.mean(increments(n) ** 2))
    steps = increments(min(2 * quietest, longest)) if len(lengths) > 1 else np.zeros(0)
    if len(steps) < _FEWEST_STEPS or not np.ptp(steps):
        return 1.0
    power = np.abs(np.fft.rfft(steps - steps.mean())[1:(len(steps) + 1) // 2]) ** 2
    line = len(power) * (1 - power.max() / power.sum()) ** (len(power) - 1)
    with warnings.catch_warnings():
        # Older versions warn below 20 increments, where the test is rougher.
        warnings.simplefilter('ignore')
        return float(min(1.0, 2 * min(line, scipy.stats.kurtosistest(steps).pvalue)))


def _products(grams: np.ndarray, departures: np.ndarray, chosen: np.ndarray | slice = slice(None)
              ) -> tuple[np.ndarray, np.ndarray]:
    """Return products of functions with each other and with what effects leave, over blocks."""
    k, total = 1 + len(departures), grams.sum(axis=0)
    functions, residual = total[k:, k:], total[k:, :k] @ np.concatenate([[1.0], -departures])
    return functions[chosen][:, chosen], residual[chosen]


def _gain(products: tuple[np.ndarray, np.ndarray], values: np.ndarray) -> float:
    """Return by how much functions lower the squares."""
    return float(2 * products[1] @ values - values @ products[0] @ values)


def _levels(products: tuple[np.ndarray, np.ndarray], names: np.ndarray, chosen: np.ndarray,
            variance: float) -> np.ndarray:
    """Return the variance of each function's coefficient of the largest evidence, (functions,)."""
    level, (gram, residual) = np.where(chosen, 1.0, 0.0), products
    for _ in range(_ROUNDS):
        active = np.flatnonzero(level)
        if not len(active):
            break
        covariance = np.linalg.inv(gram[np.ix_(active, active)] / variance
                                   + np.diag(1 / level[active]))
        squares = (covariance @ residual[active] / variance) ** 2 + np.diag(covariance)
        for name in np.unique(names[active]):
            of_name = names[active] == name
            level[active[of_name]] = squares[of_name].mean()
        level[level <= _SMALLEST_LEVEL ** 2] = 0.0
    return level
