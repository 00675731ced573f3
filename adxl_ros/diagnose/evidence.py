# SPDX-License-Identifier: Apache-2.0
"""
The evidence of linear models of whitened samples.

A hypothesis is a set of columns, which are whitened sensitivities of the simulated output. The
coefficients have normal priors. The evidence integrates the coefficients out (Bishop 2006,
section 3.5), so that an effect that the recording hardly shows gains nothing and costs nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise, repeat
from typing import NamedTuple

from adxl_ros.diagnose.noise_filters import drifts_among, in_pairs, Whitener, without_pole
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Coefficient, Role
from adxl_ros.model.error_sizes import stds
from adxl_ros.model.sensor import parameter_of, Sensor
from adxl_ros.signals.block_statistics import bridged
import numpy as np
import scipy

BLOCKS = 48
"""Number of blocks of a recording, of which some are held out. Chosen: a multiple of the folds,
and blocks of a few seconds in a short recording."""
_ITERATIONS = 3
"""Iterations over coefficients and noise. Chosen: the filters no longer change then."""
_SMALLEST_SQUARES_V2 = 1e-300  # Smallest sum of squares, V², whose logarithm is taken: above zero
_SMALLEST_VARIANCE_V2 = 1e-14
"""Smallest variance of the noise, V²; a log may have none. Chosen: 0.1 µV, below any ADC."""
_RIDGE = 1e-12
"""Ridge on the scaled precision. Chosen: columns that differ by a millionth are separable."""
UNDETERMINED_SHARE = 0.5
"""A coefficient is not determined if its posterior standard deviation exceeds this share of the
prior's. Chosen: three quarters of the precision are then of the samples."""
_UNDETERMINED_RATIO = 3.0
"""Nor is it by some blocks if it exceeds that of all blocks by this factor. Chosen: with a quarter
of the samples less it usually exceeds it by 15 %."""


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


def whiten_channel(
    design: np.ndarray,
    column_ids: np.ndarray,
    used: np.ndarray,
    filters: Sequence[Whitener],
    by_block: bool = True,
    also: Iterable[np.ndarray | None] = repeat(None),
) -> WhitenedChannel:
    """
    Whiten one axis of one recording.

    design: residual, V, and columns, V per unit of their coefficients, (n, c + 1); column_ids:
    numbers of the columns, (k,); used: samples that are used, (n,) bool; the others are bridged by
    straight lines; also: further columns of each filter that are white already, (k − c, n).
    """
    grams = []
    total_grams = []
    log_scales = []
    for whitener, rows, known in zip(filters, white_rows(design, used, filters), also):
        white = rows if known is None else np.concatenate([rows, known])
        grams.append(block_grams(white) if by_block else np.zeros((0, 0, 0)))
        total_grams.append(grams[-1].sum(axis=0) if by_block else white @ white.T)
        # The log determinant of the filter for errors, sample by sample.
        log_scale = np.log(whitener.errors.scale) if whitener.errors else 0.0
        log_scales.append(sum_by_block(used * log_scale))
    return WhitenedChannel(
        column_ids=column_ids,
        block_grams=np.array(grams),
        total_grams=np.array(total_grams),
        counts=sum_by_block(used),
        log_scales=np.array(log_scales),
        log_priors=np.array([f.log_prior for f in filters]),
        drift_effects=np.array(['' if f.healthy else f.effect for f in filters]),
    )


def white_rows(
    design: np.ndarray, used: np.ndarray, filters: Sequence[Whitener]
) -> Iterator[np.ndarray]:
    """
    Yield k columns, (n, k), whitened by each filter, (k, n); 0 where they are not used.

    Those of the next filter take the memory of the last one.
    """
    rows = bridged(design, used).T
    # Filters share that for errors of angles, which is applied once.
    shared = {id(f.errors): f.errors or partial(without_pole, pole=f.pole) for f in filters}
    before = {number: [*map(run, in_pairs(rows))] for number, run in shared.items()}
    # The first sample is a step from zero.
    left_out = [0, *np.flatnonzero(~used)]
    white = np.empty((len(rows) + 1, len(used)))
    for whitener in filters:
        for i, pair in enumerate(before[id(whitener.errors)]):
            filtered = scipy.signal.sosfilt(whitener.sections, pair)
            white[2 * i], white[2 * i + 1] = filtered.real, filtered.imag
        white[:, left_out] = 0.0
        yield white[: len(rows)]


def sum_by_block(values: np.ndarray) -> np.ndarray:
    """Return the sums of values, (n,), or how many of them are True, by block, (blocks,)."""
    return np.add.reduceat(values, block_edges(len(values))[:-1]).astype(float)


def block_grams(rows: np.ndarray) -> np.ndarray:
    """Return the products of k rows, (k, n), by block, (blocks, k, k)."""
    edges = pairwise(block_edges(rows.shape[1]).tolist())
    return np.array([rows[:, a:b] @ rows[:, a:b].T for a, b in edges])


def block_edges(count: int) -> np.ndarray:
    """Return where the blocks of so many samples begin and end, (blocks + 1,)."""
    return np.linspace(0, count, BLOCKS + 1).astype(int)


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
        mean[others] += (
            self.covariance[np.ix_(others, places)]
            @ np.linalg.lstsq(self.covariance[np.ix_(places, places)], values - mean[places])[0]
        )
        mean[places] = values
        return mean

    def loss(self, places: np.ndarray, values: np.ndarray) -> float:
        """
        Return how far the log posterior at values of coefficients at places is below its top.

        The other coefficients are at their conditional maximum.
        """
        std = stds(self.covariance)[places]
        deviation = (values - self.values[places]) / std
        correlation = self.covariance[np.ix_(places, places)] / std / std[:, None]
        ridge = _RIDGE * np.eye(len(places))
        return 0.5 * float(deviation @ np.linalg.solve(correlation + ridge, deviation))


def fit_columns(
    channels: Sequence[WhitenedChannel],
    column_ids: Iterable[int],
    prior_std: np.ndarray,
    blocks: np.ndarray | None = None,
    start: LinearFit | None = None,
    drifts: Sequence[str] = (),
) -> LinearFit:
    """
    Fit the coefficients of k columns, and the noise of each channel.

    Coefficients and noise are fitted in turn: the coefficients by generalised least squares with
    their normal priors, then the filter and the variance of each channel by the likelihood of the
    residual. The evidence integrates the coefficients out (Bishop 2006, equation 3.86).

    column_ids: numbers of the columns, (k,); prior_std: prior standard deviation of the
    coefficient of every column; blocks: blocks that are used, (blocks,) bool, None for all;
    start: a fit whose filters are the first ones; drifts: effects whose drift the noise may have.
    """
    ids = np.array(sorted(column_ids), int)
    selected = [_SelectedChannel.of(channel, ids, blocks, drifts) for channel in channels]
    filters = [int(np.argmax(channel.log_priors)) for channel in selected]
    if start is not None:
        filters = list(start.filter_indices)
    variance_v2 = np.maximum(
        [channel.grams[f, 0, 0] / channel.count for channel, f in zip(selected, filters)],
        _SMALLEST_VARIANCE_V2,
    )
    prior_precision = prior_std[ids] ** -2.0
    for _ in range(_ITERATIONS):
        posterior = _Posterior.of(selected, filters, variance_v2, prior_precision)
        for i, channel in enumerate(selected):
            squares_v2 = channel.squares_v2(posterior.mean)
            log_likelihood = -channel.count / 2 * np.log(squares_v2) + channel.log_scales
            filters[i] = int(np.argmax(log_likelihood + channel.log_priors))
            variance_v2[i] = max(squares_v2[filters[i]] / channel.count, _SMALLEST_VARIANCE_V2)
    log_evidence = posterior.log_occam_factor(prior_precision)
    for channel, chosen_filter, variance in zip(selected, filters, variance_v2):
        log_evidence += channel.log_likelihood(chosen_filter, variance)
    return LinearFit(
        ids, posterior.mean, posterior.covariance(), log_evidence, tuple(filters), variance_v2
    )


@dataclass(frozen=True)
class _SelectedChannel:
    """The products of the chosen columns of one channel, summed over the chosen blocks."""

    places: np.ndarray  # Places of its columns among the k chosen ones
    # Products of the whitened residual (first) and columns by filter, V², (filters, c + 1, c + 1)
    grams: np.ndarray
    count: float  # Number of samples
    log_scales: np.ndarray  # What the filter for errors adds to the log likelihood, (filters,)
    log_priors: np.ndarray  # Log prior probability of each filter; −inf where not allowed

    @classmethod
    def of(
        cls,
        channel: WhitenedChannel,
        ids: np.ndarray,
        blocks: np.ndarray | None,
        drifts: Sequence[str],
    ) -> _SelectedChannel:
        """Choose the columns, blocks and filters of a channel."""
        columns = np.flatnonzero(np.isin(channel.column_ids, ids))
        rows = np.concatenate([[0], 1 + columns])
        chosen = np.ones(BLOCKS, bool)
        grams = channel.total_grams
        if blocks is not None:
            chosen = blocks
            grams = channel.block_grams[:, blocks].sum(axis=1)
        allowed = np.array([e in ('', *drifts) for e in channel.drift_effects], bool)
        return cls(
            places=np.searchsorted(ids, channel.column_ids[columns]),
            grams=grams[:, rows[:, None], rows],
            count=max(float(channel.counts[chosen].sum()), 1.0),
            log_scales=channel.log_scales[:, chosen].sum(axis=1),
            log_priors=np.where(allowed | ~allowed.any(), channel.log_priors, -np.inf),
        )

    def squares_v2(self, values: np.ndarray) -> np.ndarray:
        """Return the sum of squares of the whitened residual by filter, V², (filters,)."""
        combination = np.concatenate([[1.0], -values[self.places]])
        squares_v2 = np.einsum('i,wij,j->w', combination, self.grams, combination)
        return np.maximum(squares_v2, _SMALLEST_SQUARES_V2)

    def log_likelihood(self, chosen_filter: int, variance_v2: float) -> float:
        """Return the log likelihood at the best variance of a filter, up to a constant."""
        return float(
            -self.count / 2 * (np.log(variance_v2) + 1)
            + self.log_scales[chosen_filter]
            + self.log_priors[chosen_filter]
        )


@dataclass(frozen=True)
class _Posterior:
    """The normal posterior of k coefficients. Columns are scaled against rounding errors."""

    mean: np.ndarray  # (k,)
    size: np.ndarray  # Scale of each coefficient, by which its precision is 1, (k,)
    factor: np.ndarray  # Cholesky factor of the scaled precision, (k, k)

    @classmethod
    def of(
        cls,
        channels: Sequence[_SelectedChannel],
        filters: Sequence[int],
        variance_v2: np.ndarray,
        prior_precision: np.ndarray,
    ) -> _Posterior:
        """Combine prior and channels, each whitened by its present filter."""
        precision = np.diag(prior_precision)
        information = np.zeros(len(prior_precision))
        for channel, f, variance in zip(channels, filters, variance_v2):
            places = channel.places
            precision[np.ix_(places, places)] += channel.grams[f, 1:, 1:] / variance
            information[places] += channel.grams[f, 1:, 0] / variance
        size = 1 / np.sqrt(np.diag(precision))
        scaled = precision * size[:, None] * size + _RIDGE * np.eye(len(size))
        factor = np.linalg.cholesky(scaled)
        mean = size * scipy.linalg.cho_solve((factor, True), size * information)
        return cls(mean, size, factor)

    def covariance(self) -> np.ndarray:
        """Return the covariance of the coefficients, (k, k)."""
        inverse = scipy.linalg.cho_solve((self.factor, True), np.eye(len(self.size)))
        return inverse * self.size[:, None] * self.size

    def log_occam_factor(self, prior_precision: np.ndarray) -> float:
        """Return the log prior at the mean, plus the log ratio of posterior and prior volume."""
        log_prior = -0.5 * float(np.sum(prior_precision * self.mean**2))
        log_posterior_volume = -float(np.log(np.diag(self.factor) / self.size).sum())
        log_prior_volume = -0.5 * float(np.log(prior_precision).sum())
        return log_prior + log_posterior_volume - log_prior_volume


def left_beside(products: np.ndarray, free: list[int], prior_std: np.ndarray) -> np.ndarray:
    """
    Return the squares of each of k columns that free ones with normal priors leave, (k,).

    products: products of the columns, in units of the noise, (k, k); prior_std: prior standard
    deviations of the coefficients, (k,).
    """
    precision = products[np.ix_(free, free)] + np.diag(prior_std[free] ** -2.0)
    size = np.sqrt(np.diag(precision))
    scaled = precision / size / size[:, None] + _RIDGE * np.eye(len(size))
    shared = products[free] / size[:, None]
    return np.diag(products) - np.einsum('ij,ij->j', shared, np.linalg.solve(scaled, shared))


class ChannelColumns(NamedTuple):
    """The linear model of a hypothesis in one channel."""

    places: np.ndarray  # Places of the k coefficients among all, (k,)
    # Residual at the prior mean, V, and sensitivities to the effects, V per unit, (n, c + 1)
    own: np.ndarray
    nuisances: dict[Coefficient, np.ndarray]  # The same to nuisance parameters, (n,) each

    @property
    def values(self) -> np.ndarray:
        """Residual and all sensitivities, (n, k + 1)."""
        return np.vstack([self.own.T, *self.nuisances.values()]).T

    def combination(self, departures: np.ndarray) -> np.ndarray:
        """Return the factors of the columns, (k + 1,), that leave the residual at departures."""
        return np.concatenate([[1.0], -departures[self.places]])


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
        return fit_columns(
            self.channels,
            range(len(self.prior_std)),
            self.prior_std,
            blocks,
            drifts=(*drifts, *drifts_among(self.sensor.effects)),
        )

    def departures(
        self, fit: LinearFit, full_fit: LinearFit | None = None, lasting: bool = False
    ) -> np.ndarray:
        """
        Return the departures from the prior mean after a fit, (k,).

        A limit or a shape keeps its value if the samples do not determine it, because its prior
        mean is no better guess. Beside it, each nuisance parameter does so if only the blocks that
        are not fitted determine it: a drift may leave the zero-g open. A shape changes by a factor
        of two at most. In a fit to some blocks, zero-g, scale factor, filter and latency stay
        within the tolerance of a healthy unit. Where the blocks are `lasting` parts, sizes that
        only the others determine keep their values, too.
        """
        j = len(self.values)
        values = self._effect_values(fit, full_fit, lasting)
        kept = np.flatnonzero(values != self._fitted_values(fit))
        targets = (values - self.prior_mean[:j])[kept]
        departures = fit.given(kept, targets)
        if full_fit is None:
            return departures
        full_variance = np.diag(full_fit.covariance)[j:]
        is_open = np.diag(fit.covariance)[j:] > _UNDETERMINED_RATIO**2 * full_variance
        nuisances = np.where(is_open, full_fit.values[j:], departures[j:])
        nuisances = np.clip(nuisances, -self.reach, self.reach)
        moved = np.flatnonzero(nuisances != departures[j:])
        return fit.given(
            np.concatenate([kept, j + moved]), np.concatenate([targets, nuisances[moved]])
        )

    def _fitted_values(self, fit: LinearFit) -> np.ndarray:
        """Return the values of the effects by a fit, (j,)."""
        j = len(self.values)
        return self.prior_mean[:j] + fit.values[:j]

    def _effect_values(
        self, fit: LinearFit, full_fit: LinearFit | None, lasting: bool
    ) -> np.ndarray:
        """Return the values of the effects, (j,), of which some are kept or bounded."""
        j = len(self.values)
        names = self.names[:j]
        std = stds(fit.covariance)[:j]
        undetermined = std > UNDETERMINED_SHARE * self.prior_std[:j]
        if full_fit is not None:
            undetermined |= std > _UNDETERMINED_RATIO * stds(full_fit.covariance)[:j]
        is_shape = np.array([parameter_of(name).role is Role.SHAPE for name in names], bool)
        is_limit = np.array([bool(effect_named(name.effect).limits) for name in names], bool)
        is_size = np.array([parameter_of(name).is_size for name in names], bool)
        keeps = undetermined & (is_limit | ~is_size | lasting)
        values = np.where(keeps, self.values, self._fitted_values(fit))
        low, high = np.sort([self.values / 2, self.values * 2], axis=0)
        return np.where(is_shape, np.clip(values, low, high), values)
