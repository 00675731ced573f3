# SPDX-License-Identifier: Apache-2.0
"""
Log evidence of linear models on whitened columns.

Columns are sensitivities of the simulated output, and a hypothesis is a set of columns. The
coefficients have normal priors. The evidence integrates the coefficients out (Bishop 2006,
section 3.5), so that an effect that the recording hardly shows gains nothing and costs nothing.
The noise is one of several whitening filters; filter and level are fitted to each hypothesis.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Coefficient, DriftSpectrum, Role
from adxl_ros.model.sensor import parameter_of, Sensor
import numpy as np
import scipy

BLOCKS = 48
"""Number of blocks of a recording, of which some are held out. Chosen: a multiple of the folds,
and blocks of a few seconds in a short recording."""
_ITERATIONS = 3
"""Iterations over coefficients and noise. Chosen: the filters no longer change then."""
_SMALLEST_SQUARES_V2 = 1e-300
"""Smallest sum of squares, V², whose logarithm is taken: above zero."""
_CACHED_VALUES = 100_000
"""Number of values that are filtered at once. Chosen: 0.8 MB stay in the cache of a processor."""
_RIDGE = 1e-12
"""Ridge on the scaled precision. Chosen: columns that differ by a millionth are separable."""
UNDETERMINED_SHARE, _UNDETERMINED_RATIO = 0.5, 3.0
"""A coefficient is not determined if its posterior standard deviation exceeds this share of the
prior's, nor by some blocks if it exceeds that of all blocks by this factor. Chosen."""
_SERIES = 16
"""Series that are filtered together. Chosen: little memory beside all series."""


@dataclass(frozen=True)
class AngleErrorFilter:
    """A filter that gives noise with errors of angles the spectrum of noise without them."""

    rms_v: float  # Rms of the errors, V
    pole: float  # Pole a of the noise
    transition: np.ndarray  # Factor of the estimate of u from sample to sample, (n,)
    gain: np.ndarray  # Gain of the estimate of u, 1/V, (n,)
    weight: np.ndarray  # Change of the predicted sample by the estimate of u, V, (n,)
    scale: np.ndarray  # Standard deviation of the noise divided by that of the innovation, (n,)

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Filter k series, (k, n)."""
        lower = np.ones((2, len(self.gain)))
        lower[1, :-1] = -self.transition[1:]
        filtered = np.empty_like(values)
        for first in range(0, len(values), _SERIES):
            part = values[first:first + _SERIES]
            changes = part.copy()
            changes[:, 1:] -= self.pole * part[:, :-1]
            changes[:, 0] = 0.0
            estimates = scipy.linalg.lapack.dtbtrs(lower, (changes * self.gain).T, uplo='L',
                                                   diag='U')[0].T
            changes[:, 1:] -= self.weight[1:] * estimates[:, :-1]
            changes *= self.scale
            changes[:, 0] = part[:, 0]
            filtered[first:first + _SERIES] = scipy.signal.lfilter(
                [1.0], [1.0, -self.pole], changes)
        return filtered


@dataclass(frozen=True)
class Whitener:
    """A filter that makes noise white."""

    sections: np.ndarray  # Second-order sections, (s, 6)
    log_prior: float  # Log prior probability of such noise, up to a constant
    effect: str  # Name of the drift effect that the filter is for
    density: float  # Density of the drift, in the unit of the effect's parameter
    # Filter for the errors of angles and rounding; None where there are none, or where the drift
    # exceeds them: they would take up a part of it
    errors: AngleErrorFilter | None = None

    @property
    def spectrum(self) -> DriftSpectrum:
        """Spectrum of the drift."""
        spectrum = effect_named(self.effect).diagnosis.drift
        assert spectrum is not None
        return spectrum

    @property
    def healthy(self) -> bool:
        """Whether a unit without the effect may drift as much."""
        return self.density <= effect_named(self.effect).diagnosis.healthy_density

    def continued(self, values: np.ndarray, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Filter the next part of k series, (k, n); return it and the state, (s, k, 2)."""
        if len(self.sections) > 1:
            return scipy.signal.sosfilt(self.sections, values, zi=state)
        # The same recursion without a copy.
        filtered, after = scipy.signal.lfilter(self.sections[0, :3], self.sections[0, 3:], values,
                                               zi=state[0])
        return filtered, after[None]


def drifts_among(effects: Iterable[str]) -> tuple[str, ...]:
    """Return those of the given effects that let the zero-g drift."""
    return tuple(e for e in effects if effect_named(e).diagnosis.drift)


@dataclass(frozen=True)
class WhitenedChannel:
    """One axis of one recording: products of whitened columns, by filter and block."""

    column_ids: np.ndarray  # Numbers of the k columns that the axis follows, (k,)
    # Products of the residual (first) and the columns, V², (filters, blocks, k + 1, k + 1); no
    # block where they are not kept
    block_grams: np.ndarray
    total_grams: np.ndarray  # Their sums over all blocks, V², (filters, k + 1, k + 1)
    counts: np.ndarray  # Samples by block, (blocks,)
    # What the filter for errors of the reference adds to the log likelihood, (filters, blocks)
    log_scales: np.ndarray
    log_priors: np.ndarray  # Log prior probability of each filter, (filters,)
    # Effect that the noise of each filter needs, '' for a healthy unit, (filters,)
    drift_effects: np.ndarray


def whiten_channel(residual_v: np.ndarray, columns: np.ndarray, column_ids: np.ndarray,
                   used: np.ndarray, filters: Sequence[Whitener], by_block: bool = True
                   ) -> WhitenedChannel:
    """
    Whiten one axis of one recording.

    residual_v: residual, V, (n,); columns: columns, V per unit of their coefficients, (n, k);
    column_ids: numbers of the columns, (k,); used: samples that are used, (n,) bool; the others
    are bridged by straight lines.
    """
    data = np.empty((1 + columns.shape[1], len(used)))
    data[0], data[1:] = residual_v, columns.T
    if not used.all():
        data = bridged(data.T, used).T
    before = {id(f.errors): data if f.errors is None else f.errors(data)
              for f in {id(f.errors): f for f in filters}.values()}
    edges, unused = block_edges(len(used)), np.flatnonzero(~used)
    grams = np.zeros((len(filters), BLOCKS if by_block else 1, len(data), len(data)))
    states = [np.zeros((len(f.sections), len(data), 2)) for f in filters]
    together = max(1, _CACHED_VALUES * BLOCKS // data.size)
    for first in range(0, BLOCKS, together):
        blocks = range(first, min(first + together, BLOCKS))
        part = slice(edges[first], edges[blocks[-1] + 1])
        values = {kind: np.ascontiguousarray(series[:, part]) for kind, series in before.items()}
        dropped = unused[slice(*np.searchsorted(unused, [part.start, part.stop]))] - part.start
        for i, whitener in enumerate(filters):
            white, states[i] = whitener.continued(values[id(whitener.errors)], states[i])
            # The first sample is a step from zero.
            white[:, dropped if first else np.append(dropped, 0)] = 0.0
            if not by_block:
                grams[i, 0] += white @ white.T
                continue
            for b in blocks:
                inside = white[:, edges[b] - part.start:edges[b + 1] - part.start]
                np.matmul(inside, inside.T, out=grams[i, b])
    total = grams.sum(axis=1)
    grams = grams if by_block else np.zeros((len(filters), 0, len(data), len(data)))
    # The log determinant of the filter for errors, sample by sample.
    log_scales = np.array([np.zeros(BLOCKS) if f.errors is None else np.add.reduceat(
        np.where(used, np.log(f.errors.scale), 0.0), edges[:-1]) for f in filters])
    return WhitenedChannel(column_ids, grams, total, used_by_block(used), log_scales,
                           np.array([f.log_prior for f in filters]),
                           np.array(['' if f.healthy else f.effect for f in filters]))


def used_by_block(used: np.ndarray) -> np.ndarray:
    """Return the number of samples that are used, (n,) bool, by block."""
    return np.add.reduceat(used, block_edges(len(used))[:-1]).astype(float)


def plain_grams(columns: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return the products of k columns, (n, k), over used samples, by block, (blocks, k, k)."""
    kept = np.where(used[:, None], columns, 0.0)
    return np.array([kept[a:b].T @ kept[a:b] for a, b in pairwise(block_edges(len(used)))])


def block_edges(count: int) -> np.ndarray:
    """Return where the blocks of so many samples begin and end, (blocks + 1,)."""
    return np.linspace(0, count, BLOCKS + 1).astype(int)


def bridged(data: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Replace rows, (n, k), that are not used by straight lines between those that are."""
    if used.all() or not used.any() or not data.shape[1]:
        return data
    kept, missing = np.flatnonzero(used), np.flatnonzero(~used)
    after = np.searchsorted(kept, missing)
    before, right = kept[np.maximum(after - 1, 0)], kept[np.minimum(after, len(kept) - 1)]
    share = np.clip((missing - before) / np.maximum(right - before, 1), 0.0, 1.0)[:, None]
    out = data.copy(order='K')
    out[missing] = data[before] + share * (data[right] - data[before])
    return out


@dataclass(frozen=True)
class LinearFit:
    """A linear model after the fit of k coefficients."""

    column_ids: np.ndarray  # Numbers of the columns, (k,)
    values: np.ndarray  # Posterior mean of the coefficients, (k,)
    covariance: np.ndarray  # Posterior covariance, (k, k)
    log_evidence: float  # Log evidence of the samples
    filter_indices: tuple[int, ...]  # Number of the whitening filter of each channel
    innovation_variance_v2: np.ndarray  # Variance of the whitened residual of each channel, V²

    def given(self, places: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return the posterior mean, (k,), where j coefficients at places have given values."""
        mean = self.values.copy()
        others = np.setdiff1d(np.arange(len(mean)), places)
        mean[others] += self.covariance[np.ix_(others, places)] @ np.linalg.lstsq(
            self.covariance[np.ix_(places, places)], values - mean[places])[0]
        mean[places] = values
        return mean

    def loss(self, values: np.ndarray) -> float:
        """
        Return how far the log posterior at values of the first coefficients is below its top.

        The other coefficients are at their conditional maximum.
        """
        count = len(values)
        std = np.sqrt(np.diag(self.covariance)[:count])
        deviation = (values - self.values[:count]) / std
        correlation = self.covariance[:count, :count] / std / std[:, None]
        return 0.5 * float(deviation @ np.linalg.solve(
            correlation + _RIDGE * np.eye(count), deviation))


def fit_columns(channels: Sequence[WhitenedChannel], column_ids: Iterable[int],
                prior_std: np.ndarray, blocks: np.ndarray | None = None,
                start: LinearFit | None = None, drifts: Sequence[str] = ()) -> LinearFit:
    """
    Fit the coefficients of some columns, and the noise.

    blocks: blocks that are used, (blocks,) bool; None for all. The noise has the drift of given
    effects, or that of a healthy unit.
    """
    ids = np.array(sorted(column_ids), int)
    chosen = np.ones(BLOCKS, bool) if blocks is None else blocks
    # By channel: places of its columns among all, products, count of samples, log scales, and
    # log priors of the filters
    selected, filters = [], []
    for channel in channels:
        columns = np.flatnonzero(np.isin(channel.column_ids, ids))
        rows = np.concatenate([[0], 1 + columns])
        grams = channel.total_grams if blocks is None \
            else channel.block_grams[:, blocks].sum(axis=1)
        allowed = np.isin(channel.drift_effects, ('', *drifts))
        log_priors = np.where(allowed | ~allowed.any(), channel.log_priors, -np.inf)
        selected.append((np.searchsorted(ids, channel.column_ids[columns]),
                         grams[:, rows[:, None], rows],
                         max(float(channel.counts[chosen].sum()), 1.0),
                         channel.log_scales[:, chosen].sum(axis=1), log_priors))
        filters.append(int(np.argmax(log_priors)))
    if start is not None:
        filters = list(start.filter_indices)
    variance_v2 = np.array([grams[f, 0, 0] / count
                            for (_, grams, count, *_), f in zip(selected, filters)])
    prior_precision = prior_std[ids] ** -2.0
    for _ in range(_ITERATIONS):
        precision, information = np.diag(prior_precision), np.zeros(len(ids))
        for (places, grams, *_), f, variance in zip(selected, filters, variance_v2):
            precision[np.ix_(places, places)] += grams[f, 1:, 1:] / variance
            information[places] += grams[f, 1:, 0] / variance
        # The columns are scaled, so that different sizes or nearly equal columns cause no
        # rounding errors.
        size = 1 / np.sqrt(np.diag(precision))
        factor = np.linalg.cholesky(precision * size[:, None] * size + _RIDGE * np.eye(len(ids)))
        values = size * scipy.linalg.cho_solve((factor, True), size * information)
        for i, (places, grams, count, log_scales, log_priors) in enumerate(selected):
            v = np.concatenate([[1.0], -values[places]])
            squares_v2 = np.maximum(np.einsum('i,wij,j->w', v, grams, v), _SMALLEST_SQUARES_V2)
            filters[i] = int(np.argmax(-count / 2 * np.log(squares_v2) + log_scales + log_priors))
            variance_v2[i] = squares_v2[filters[i]] / count
    covariance = scipy.linalg.cho_solve((factor, True), np.eye(len(ids))) * size[:, None] * size
    log_evidence = -0.5 * float(np.sum(prior_precision * values ** 2)) \
        - float(np.log(np.diag(factor) / size).sum()) + 0.5 * float(np.log(prior_precision).sum())
    for (*_, count, log_scales, log_priors), variance, f in zip(selected, variance_v2, filters):
        log_evidence += float(-count / 2 * (np.log(variance) + 1) + log_scales[f] + log_priors[f])
    return LinearFit(ids, values, covariance, log_evidence, tuple(filters), variance_v2)


class ChannelColumns(NamedTuple):
    """The linear model of a hypothesis in one channel."""

    places: np.ndarray  # Places of the k coefficients among all, (k,)
    values: np.ndarray  # Residual at the prior mean, V, and sensitivities, V per unit, (n, k + 1)
    # Products of the same divided by the scale factor and the root of the number of axes, by
    # block, (m/s²)², (blocks, k + 1, k + 1)
    plain: np.ndarray


@dataclass(frozen=True)
class LinearisedHypothesis:
    """
    A hypothesis linearised at values of its k coefficients.

    The first j coefficients are those of the effects. The others are nuisance parameters, which
    stay near the baseline and are linearised there.
    """

    effects: tuple[str, ...]  # Names of the effects
    sensor: Sensor  # The sensor at the values
    names: tuple[Coefficient, ...]  # Coefficients, those of the effects first, (k,)
    prior_mean: np.ndarray  # Prior mean of the coefficients, (k,)
    prior_std: np.ndarray  # Prior standard deviation of the coefficients, (k,)
    reach: np.ndarray  # Largest departure of the nuisance parameters of a healthy unit, (k − j,)
    values: np.ndarray  # Values of the coefficients of the effects, (j,)
    # Whitened columns, and whitened residuals at the prior mean by the linear model
    channels: list[WhitenedChannel]
    columns: list[ChannelColumns]  # The same before whitening
    filters: Sequence[Sequence[Whitener]]  # Whitening filters of each channel

    def fit(self, blocks: np.ndarray | None = None, drifts: Sequence[str] = ()) -> LinearFit:
        """Fit all coefficients to some blocks, (blocks,) bool, or to all."""
        return fit_columns(self.channels, range(len(self.names)), self.prior_std, blocks,
                           drifts=(*drifts, *drifts_among(self.sensor.effects)))

    def departures(self, fit: LinearFit, full_fit: LinearFit | None = None) -> np.ndarray:
        """
        Return the departures from the prior mean after a fit, (k,).

        A limit or a shape keeps its value if the samples do not determine it, because its prior
        mean is no better guess. Beside it, each nuisance parameter does so if only the blocks that
        are not fitted determine it: a drift may leave the zero-g open. A shape changes by a factor
        of two at most. In a fit to some blocks, zero-g, scale factor, filter and latency stay
        within the tolerance of a healthy unit.
        """
        j = len(self.values)
        parameters = [parameter_of(name) for name in self.names[:j]]
        std = np.sqrt(np.diag(fit.covariance)[:j])
        undetermined = std > UNDETERMINED_SHARE * self.prior_std[:j]
        if full_fit is not None:
            undetermined |= std > _UNDETERMINED_RATIO * np.sqrt(np.diag(full_fit.covariance)[:j])
        kept = np.array([not p.is_size or bool(effect_named(name.effect).limits)
                         for p, name in zip(parameters, self.names)], bool)
        is_shape = np.array([p.role is Role.SHAPE for p in parameters], bool)
        fitted = self.prior_mean[:j] + fit.values[:j]
        values = np.where(undetermined & kept, self.values, fitted)
        values = np.where(is_shape, np.clip(values, *np.sort([self.values / 2, self.values * 2],
                                                             axis=0)), values)
        given = np.concatenate([values != fitted, np.zeros(len(self.reach), bool)])
        target = np.concatenate([values - self.prior_mean[:j], np.zeros(len(self.reach))])
        departures = fit.given(np.flatnonzero(given), target[given])
        if full_fit is None:
            return departures
        is_open = np.diag(fit.covariance)[j:] > _UNDETERMINED_RATIO ** 2 * np.diag(
            full_fit.covariance)[j:]
        nuisance = np.clip(np.where(is_open, full_fit.values[j:], departures[j:]),
                           -self.reach, self.reach)
        given[j:], target[j:] = nuisance != departures[j:], nuisance
        return fit.given(np.flatnonzero(given), target[given])
