# SPDX-License-Identifier: Apache-2.0

"""
Log evidence of hypotheses: Bayesian comparison of linear models on whitened columns.

Columns are sensitivities of the simulated output, and a hypothesis is a set of columns. The
coefficients have normal priors. The evidence integrates the coefficients out (Bishop 2006,
section 3.5), so that an effect that the recording hardly shows gains nothing and costs nothing.
The noise is that of `noise_model`; its filter and level are fitted to each hypothesis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from adxl_ros.diagnose.noise_model import before_filters, Whitener
import numpy as np
import scipy

BLOCKS = 48
"""Number of blocks of a recording, of which some are held out. Chosen: a multiple of the folds,
and blocks of a few seconds in a short recording."""
AMPLITUDES = 10.0 ** np.arange(0, -2.5, -0.5)
"""Amplitudes of an effect, divided by that of its given prior. They are equally probable: a
log-uniform prior over two decades, in five steps."""
_ITERATIONS = 3
"""Iterations over coefficients and noise. Chosen: the filters no longer change then."""
_SMALLEST_SQUARES_V2 = 1e-300
"""Smallest sum of squares, V², whose logarithm is taken: above zero."""
_CACHED_VALUES = 100_000
"""Number of values that are filtered at once. Chosen: 0.8 MB stay in the cache of a processor."""
_RIDGE = 1e-12
"""Ridge on the scaled precision. Chosen: columns that differ by a millionth are separable."""


@dataclass(frozen=True)
class WhitenedChannel:
    """One axis of one recording: products of whitened columns, by filter and block."""

    column_ids: np.ndarray  # Numbers of the k columns that the axis follows, (k,)
    # Products of the residual (first) and the columns, V², (filters, blocks, k + 1, k + 1); no
    # block where they are not kept
    block_grams: np.ndarray
    total_grams: np.ndarray  # Their sums over all blocks, V², (filters, k + 1, k + 1)
    counts: np.ndarray  # Samples by block, (blocks,)
    # What the filter for errors of angles adds to the log likelihood, (filters, blocks)
    log_scales: np.ndarray
    log_priors: np.ndarray  # Log prior probability of each filter, (filters,)
    # Effect that the noise of each filter needs, '' for a healthy unit, (filters,)
    drift_effects: np.ndarray


class FlexibleColumns(NamedTuple):
    """Functions that are integrated out of a channel."""

    # Functions times the prior standard deviations of their coefficients, V, (n, m)
    values: np.ndarray
    variance_v2: float  # Variance of the whitened noise, V²


def whiten_channel(residual_v: np.ndarray, columns: np.ndarray, column_ids: np.ndarray,
                   used: np.ndarray, filters: Sequence[Whitener],
                   flexible: FlexibleColumns | None = None, by_block: bool = True
                   ) -> WhitenedChannel:
    """
    Whiten one axis of one recording.

    residual_v: residual, V, (n,); columns: columns, V per unit of their coefficients, (n, k);
    column_ids: numbers of the columns, (k,); used: samples that are used, (n,) bool; the others
    are bridged by straight lines.
    """
    parts = [residual_v[:, None], columns, *([] if flexible is None else [flexible.values])]
    data = np.empty((sum(values.shape[1] for values in parts), len(used)))
    np.concatenate([values.T for values in parts], out=data)
    if not used.all():
        data = bridged(data.T, used).T
    before = before_filters(filters, data)
    edges, unused = block_edges(len(used)), np.flatnonzero(~used)
    grams = np.zeros((len(filters), BLOCKS if by_block else 1, len(data), len(data)))
    states = [np.zeros((len(f.sections), len(data), 2)) for f in filters]
    together = max(1, _CACHED_VALUES * BLOCKS // data.size)
    for first in range(0, BLOCKS, together):
        blocks = [(b, *edges[b:b + 2] - edges[first])
                  for b in range(first, min(first + together, BLOCKS))]
        part = slice(edges[first], edges[first] + blocks[-1][2])
        values = {kind: np.ascontiguousarray(series[:, part]) for kind, series in before.items()}
        dropped = unused[slice(*np.searchsorted(unused, [part.start, part.stop]))] - part.start
        for i, whitener in enumerate(filters):
            white, states[i] = whitener.continued(values[whitener.corrects_angles], states[i])
            white[:, dropped] = 0.0
            if not first:
                # The first sample is a step from zero.
                white[:, 0] = 0.0
            if not by_block:
                grams[i, 0] += white @ white.T
                continue
            for b, begin, end in blocks:
                np.matmul(white[:, begin:end], white[:, begin:end].T, out=grams[i, b])
    counts = np.add.reduceat(used, edges[:-1]).astype(float)
    total, count = grams.sum(axis=1), 1 + columns.shape[1]
    if flexible is not None:
        cross = total[:, :count, count:]
        precision = total[:, count:, count:] + flexible.variance_v2 * np.eye(len(data) - count)
        total = total[:, :count, :count] - cross @ np.linalg.solve(precision,
                                                                   cross.transpose(0, 2, 1))
    grams = grams[:, :, :count, :count] if by_block else np.zeros((len(filters), 0, count, count))
    log_scales = np.array([np.add.reduceat(f.log_scale(used), edges[:-1]) for f in filters])
    return WhitenedChannel(column_ids, grams, total, counts, log_scales,
                           np.array([f.log_prior for f in filters]),
                           np.array(['' if f.healthy else f.effect for f in filters]))


def plain_grams(columns: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return the products of k columns, (n, k), over used samples, by block, (blocks, k, k)."""
    kept = np.where(used[:, None], columns, 0.0)
    edges = block_edges(len(used))
    return np.array([kept[a:b].T @ kept[a:b] for a, b in pairwise(edges)])


def block_edges(count: int) -> np.ndarray:
    """Return where the blocks of so many samples begin and end, (blocks + 1,)."""
    return np.linspace(0, count, BLOCKS + 1).astype(int)


def bridged(data: np.ndarray, used: np.ndarray) -> np.ndarray:
    """
    Replace rows that are not used by straight lines between those that are.

    data: series, (n, k); used: rows that are used, (n,) bool; returns: series without gaps, (n,
    k).
    """
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


def fit_columns(channels: Sequence[WhitenedChannel], column_ids: Sequence[int],
                prior_std: np.ndarray, blocks: np.ndarray | None = None,
                start: LinearFit | None = None, drifts: Sequence[str] = ()) -> LinearFit:
    """
    Fit the coefficients of some columns, and the noise.

    blocks: blocks that are used, (blocks,) bool; None for all.
    """
    ids = np.array(sorted(column_ids), int)
    selected = [_selected(channel, ids, blocks) for channel in channels]
    log_priors = [_filter_log_priors(channel, drifts) for channel in channels]
    filters = list(start.filter_indices) if start else [int(np.argmax(p)) for p in log_priors]
    variance_v2 = np.array([s.grams[f, 0, 0] / s.count for s, f in zip(selected, filters)])
    prior_precision = prior_std[ids] ** -2.0
    for _ in range(_ITERATIONS):
        precision, information = np.diag(prior_precision), np.zeros(len(ids))
        for s, f, variance in zip(selected, filters, variance_v2):
            precision[np.ix_(s.places, s.places)] += s.grams[f, 1:, 1:] / variance
            information[s.places] += s.grams[f, 1:, 0] / variance
        values, covariance, half_log_det = _solution(precision, information)
        for i, s in enumerate(selected):
            v = np.concatenate([[1.0], -values[s.places]])
            squares_v2 = np.maximum(np.einsum('i,wij,j->w', v, s.grams, v), _SMALLEST_SQUARES_V2)
            filters[i] = int(np.argmax(-s.count / 2 * np.log(squares_v2) + s.log_scales
                                       + log_priors[i]))
            variance_v2[i] = squares_v2[filters[i]] / s.count
    log_evidence = -0.5 * float(np.sum(prior_precision * values ** 2)) \
        - half_log_det + 0.5 * float(np.log(prior_precision).sum())
    for s, variance, f, channel in zip(selected, variance_v2, filters, channels):
        log_evidence += float(-s.count / 2 * (np.log(variance) + 1) + s.log_scales[f]
                              + channel.log_priors[f])
    return LinearFit(ids, values, covariance, log_evidence, tuple(filters), variance_v2)


@dataclass(frozen=True)
class _SelectedColumns:
    """
    Some columns of a channel, in some blocks.

    They have places among all that are fitted, products, count of samples, and log scales.
    """

    places: np.ndarray
    grams: np.ndarray
    count: float
    log_scales: np.ndarray


def _selected(channel: WhitenedChannel, ids: np.ndarray, blocks: np.ndarray | None
              ) -> _SelectedColumns:
    """Select columns and blocks of a channel."""
    columns = np.flatnonzero(np.isin(channel.column_ids, ids))
    rows = np.concatenate([[0], 1 + columns])
    grams = channel.total_grams if blocks is None \
        else channel.block_grams[:, blocks].sum(axis=1)
    chosen = np.ones(BLOCKS, bool) if blocks is None else blocks
    return _SelectedColumns(np.searchsorted(ids, channel.column_ids[columns]),
                            grams[:, rows[:, None], rows],
                            max(float(channel.counts[chosen].sum()), 1.0),
                            channel.log_scales[:, chosen].sum(axis=1))


def _filter_log_priors(channel: WhitenedChannel, drifts: Sequence[str]) -> np.ndarray:
    """
    Return log priors of the filters, (filters,).

    The prior of a filter for a drift that is not given is −inf, unless no filter remains.
    """
    allowed = np.isin(channel.drift_effects, ('', *drifts))
    return np.where(allowed | ~allowed.any(), channel.log_priors, -np.inf)


def amplitude_log_bayes_factor(mean: np.ndarray, covariance: np.ndarray, prior_std: np.ndarray
                               ) -> float:
    """
    Return what the log evidence gains by the log-uniform prior over `AMPLITUDES`.

    For each amplitude it is the logarithm of the posterior mean of the ratio of both priors, in
    closed form.

    mean: posterior mean of the effect's k coefficients with the given prior, (k,); covariance:
    posterior covariance, (k, k); prior_std: standard deviations of the given prior, (k,).
    """
    # Divided by their prior deviations, coefficients in V and in rad have similar sizes.
    precision = np.linalg.inv(covariance / prior_std[:, None] / prior_std)
    information = precision @ (mean / prior_std)
    quadratic = float(information @ (mean / prior_std))
    log_det = np.linalg.slogdet(precision)[1]
    gains = []
    for amplitude in AMPLITUDES:
        narrower = precision + (amplitude ** -2 - 1) * np.eye(len(prior_std))
        gains.append(-len(prior_std) * np.log(amplitude) + 0.5 * (
            log_det - np.linalg.slogdet(narrower)[1]
            + float(information @ np.linalg.solve(narrower, information)) - quadratic))
    return float(np.logaddexp.reduce(gains) - np.log(len(gains)))


def _solution(precision: np.ndarray, information: np.ndarray
              ) -> tuple[np.ndarray, np.ndarray, float]:
    """
    Solve precision · values = information.

    Return the values, their covariance, and half the logarithm of the determinant of the
    precision. The columns are scaled, so that columns of different sizes or nearly equal columns
    cause no rounding errors.
    """
    size = 1 / np.sqrt(np.diag(precision))
    scaled = precision * size[:, None] * size + _RIDGE * np.eye(len(size))
    factor = np.linalg.cholesky(scaled)
    values = size * scipy.linalg.cho_solve((factor, True), size * information)
    covariance = scipy.linalg.cho_solve((factor, True), np.eye(len(size))) * size[:, None] * size
    return values, covariance, float(np.log(np.diag(factor) / size).sum())


def robust_std(channels: Sequence[WhitenedChannel], fit: LinearFit, prior_std: np.ndarray
               ) -> np.ndarray:
    """
    Return standard deviations that also hold where the model is not exact.

    Each is the larger of the model's deviation and of the sandwich estimate (White 1982,
    Econometrica 50). The sandwich sums gradients of the log likelihood over blocks, because
    samples may be correlated.

    returns: standard deviations of the coefficients, (k,).
    """
    gradients = np.zeros((BLOCKS, len(fit.column_ids)))
    for c, f, v in zip(channels, fit.filter_indices, fit.innovation_variance_v2):
        columns = np.flatnonzero(np.isin(c.column_ids, fit.column_ids))
        places = np.searchsorted(fit.column_ids, c.column_ids[columns])
        rows = c.block_grams[f][:, 1 + columns]
        gradients[:, places] += (rows[:, :, 0] - rows[:, :, 1 + columns] @ fit.values[places]) / v
    gradients = gradients - gradients.mean(axis=0)
    sandwich = fit.covariance @ (gradients.T @ gradients) @ fit.covariance * BLOCKS / (BLOCKS - 1)
    return np.sqrt(np.maximum(np.diag(fit.covariance),
                              np.minimum(np.diag(sandwich), prior_std[fit.column_ids] ** 2)))


def conditional_mean(fit: LinearFit, places: np.ndarray, values: np.ndarray) -> np.ndarray:
    """
    Return the posterior mean of all coefficients where some have given values.

    places: places of the j coefficients with given values, (j,); values: their values, (j,);
    returns: mean of the coefficients, (k,).
    """
    mean = fit.values.copy()
    others = np.setdiff1d(np.arange(len(mean)), places)
    mean[others] += fit.covariance[np.ix_(others, places)] @ np.linalg.lstsq(
        fit.covariance[np.ix_(places, places)], values - mean[places])[0]
    mean[places] = values
    return mean


def log_posterior_loss(channels: Sequence[WhitenedChannel], fit: LinearFit, values: np.ndarray,
                       prior_std: np.ndarray) -> float:
    """
    Return how far the log posterior at some values is below its maximum.

    The other coefficients are at their conditional maximum.

    values: values of the first j coefficients, (j,).
    """
    count = len(values)
    deviation = values - fit.values[:count]
    precision = np.diag(prior_std[fit.column_ids] ** -2.0)
    for c, f, v in zip(channels, fit.filter_indices, fit.innovation_variance_v2):
        places = np.searchsorted(fit.column_ids, c.column_ids)
        precision[np.ix_(places, places)] += c.total_grams[f, 1:, 1:] / v
    free = np.arange(count, len(fit.values))
    # Schur complement of the free coefficients.
    cross = precision[:count, free]
    marginal = precision[:count, :count] - cross @ np.linalg.solve(
        precision[np.ix_(free, free)], cross.T)
    return 0.5 * float(deviation @ marginal @ deviation)
