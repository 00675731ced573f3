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
The evidence for hypotheses: Bayesian model comparison on whitened tangents.

Columns are tangents of the simulated output by coefficients; a hypothesis is a set of them.
Coefficients have normal priors of their typical size, zero-g and scale what the calibration and
their stability leave. The evidence integrates the coefficients out (Bishop 2006, section 3.5), so
that an effect that the recording hardly shows gains nothing and costs nothing. The noise is that
of `noise_whitening`, fitted anew to each hypothesis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from adxl_ros.diagnose.noise_whitening import Whitener
import numpy as np
from scipy.linalg import cho_solve

BLOCKS = 48
"""Stretches that a recording is cut into, to hold some out."""
_ROUNDS = 3
SIZES = 10.0 ** np.arange(0, -2.5, -0.5)
"""Of typical sizes, alike beforehand: an effect may be as strong as usual or hardly show."""
_TINY = 1e-300
_ALIKE = 1e-12


@dataclass(frozen=True)
class Channel:
    """
    One axis of one recording.

    Attributes
    ----------
    ids
        Numbers of the columns that it follows, (k,).
    grams
        Products of the whitened residual (first) and columns, by walk and block, (w, b, k+1, k+1).
    whole
        Their sums over all blocks, (w, k+1, k+1).
    counts
        Samples by block, (b,).
    log_priors, needs
        Of the filters, and the effect that the noise of each takes, '' for none, (w,).

    """

    ids: np.ndarray
    grams: np.ndarray
    whole: np.ndarray
    counts: np.ndarray
    log_priors: np.ndarray
    needs: np.ndarray


def channel(residual: np.ndarray, columns: np.ndarray, ids: np.ndarray, used: np.ndarray,
            filters: Sequence[Whitener]) -> Channel:
    """
    Whiten one axis of one recording.

    Parameters
    ----------
    residual, columns
        (n,) and (n, k), V.
    ids
        Numbers of the columns, (k,).
    used
        Samples that count, (n,); the others are bridged by straight lines, all alike.
    filters
        From `noise_whitening.whiteners`.

    """
    data = np.ascontiguousarray(bridged(np.column_stack([residual, columns]), used).T)
    edges = block_edges(len(used))
    grams = np.empty((len(filters), BLOCKS, len(data), len(data)))
    for i, whiten in enumerate(filters):
        white = whiten(data)
        white[:, ~used] = 0.0
        # The first sample is a step from nothing.
        white[:, 0] = 0.0
        for b, (begin, end) in enumerate(pairwise(edges)):
            grams[i, b] = white[:, begin:end] @ white[:, begin:end].T
    counts = np.add.reduceat(used, edges[:-1]).astype(float)
    return Channel(ids, grams, grams.sum(axis=1), counts,
                   np.array([f.log_prior for f in filters]),
                   np.array(['' if f.healthy else f.drift for f in filters]))


def block_edges(count: int) -> np.ndarray:
    """Return where the stretches of so many samples begin and end, (b + 1,)."""
    return np.linspace(0, count, BLOCKS + 1).astype(int)


def bridged(data: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Replace rows that do not count by straight lines between those that do."""
    if used.all() or not used.any():
        return data
    rows = np.arange(len(data))
    return np.column_stack([np.interp(rows, rows[used], column[used]) for column in data.T])


@dataclass(frozen=True)
class Fit:
    """
    A hypothesis after the fit.

    Attributes
    ----------
    ids, values, covariance
        Coefficients, (k,), (k,), (k, k).
    held
        Those that are as large as they may be, (k,); their covariance is none.
    log_evidence
        Of the samples, nats.
    walks, variance
        By channel: number of the walk, and variance of the innovations, V².

    """

    ids: np.ndarray
    values: np.ndarray
    covariance: np.ndarray
    held: np.ndarray
    log_evidence: float
    walks: tuple[int, ...]
    variance: np.ndarray


def fit(channels: Sequence[Channel], ids: Sequence[int], prior: np.ndarray, most: np.ndarray,
        blocks: np.ndarray | None = None, start: Fit | None = None,
        wanders: Sequence[str] = ()) -> Fit:
    """
    Fit a hypothesis.

    Parameters
    ----------
    channels
        Axes of recordings.
    ids
        Columns of the hypothesis, nuisances among them.
    prior, most
        Standard deviation of each column's coefficient, and how large it may be, by number,
        (all,) each.
    blocks
        Which blocks count, (b,); all of them unless given.
    start
        A fit with walks and variances near those of this one.
    wanders
        Effects by which the zero-g may wander more than that of a healthy unit.

    """
    own = np.array(sorted(ids), int)
    chosen = np.ones(BLOCKS, bool) if blocks is None else blocks
    grams, counts = [], []
    for c in channels:
        at = np.flatnonzero(np.isin(c.ids, own))
        rows = np.concatenate([[0], 1 + at])
        together = c.whole if blocks is None else c.grams[:, chosen].sum(axis=1)
        grams.append((np.searchsorted(own, c.ids[at]), together[:, rows[:, None], rows]))
        counts.append(max(float(c.counts[chosen].sum()), 1.0))
    allowed = [np.isin(c.needs, ('', *wanders)) for c in channels]
    priors = [np.where(may | ~may.any(), c.log_priors, -np.inf)
              for c, may in zip(channels, allowed)]
    walks = list(start.walks) if start else [int(np.argmax(p)) for p in priors]
    variance = np.array([g[w, 0, 0] / n for (_, g), w, n in zip(grams, walks, counts)])
    known, bound = prior[own] ** -2.0, most[own]
    for _ in range(_ROUNDS):
        precision, pull = np.diag(known), np.zeros(len(own))
        for (at, g), w, s2 in zip(grams, walks, variance):
            precision[np.ix_(at, at)] += g[w, 1:, 1:] / s2
            pull[at] += g[w, 1:, 0] / s2
        values, held, covariance, half_log_det = _bounded(precision, pull, bound)
        left = [_left(g, values[at]) for at, g in grams]
        walks = [int(np.argmax(-n / 2 * np.log(np.maximum(r, _TINY)) + p))
                 for r, n, p in zip(left, counts, priors)]
        variance = np.array([max(r[w], _TINY) / n for r, w, n in zip(left, walks, counts)])
    log_evidence = -0.5 * float(np.sum(known * values ** 2)) \
        - half_log_det + 0.5 * float(np.log(known[~held]).sum())
    for n, s2, w, c in zip(counts, variance, walks, channels):
        log_evidence += float(-n / 2 * (np.log(s2) + 1) + c.log_priors[w])
    return Fit(own, values, covariance, held, log_evidence, tuple(walks), variance)


def of_any_size(mean: np.ndarray, covariance: np.ndarray, prior: np.ndarray) -> float:
    """Return what the log-evidence gains where an effect may be of any of `SIZES`, nats."""
    gains = by_size(mean, covariance, prior)
    return float(np.logaddexp.reduce(gains) - np.log(len(gains)))


def by_size(mean: np.ndarray, covariance: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """
    Return what the log-evidence gains where the prior is narrower, by `SIZES`, nats.

    The posterior's mean of the ratio of the narrower and the given prior, in closed form.

    Parameters
    ----------
    mean, covariance
        Of coefficients, (k,), (k, k), with the given prior.
    prior
        Its standard deviations, (k,).

    """
    # In units of the prior, so that volts and radians are alike.
    inverse = np.linalg.inv(covariance / prior[:, None] / prior)
    pull = inverse @ (mean / prior)
    here, whole = float(pull @ (mean / prior)), np.linalg.slogdet(inverse)[1]
    gains = []
    for size in SIZES:
        there = inverse + (size ** -2 - 1) * np.eye(len(prior))
        gains.append(-len(prior) * np.log(size) + 0.5 * (
            whole - np.linalg.slogdet(there)[1]
            + float(pull @ np.linalg.solve(there, pull)) - here))
    return np.array(gains)


def _bounded(precision: np.ndarray, pull: np.ndarray, bound: np.ndarray
             ) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """
    Solve for values within bounds.

    Gives the values, which are held, the others' covariance, and half the logarithm of the
    determinant of their precision. Columns of all sizes that are nearly alike are no obstacle:
    they are scaled, and told apart to a millionth.
    """
    size = 1 / np.sqrt(np.diag(precision))
    scaled = precision * size[:, None] * size + _ALIKE * np.eye(len(size))
    values, held = np.zeros(len(bound)), np.zeros(len(bound), bool)
    while True:
        free = ~held
        factor = np.linalg.cholesky(scaled[np.ix_(free, free)])
        rest = pull - precision @ np.where(held, values, 0.0)
        values[free] = size[free] * cho_solve((factor, True), (size * rest)[free])
        beyond = np.abs(values) > bound * (1 + 1e-9)
        if not beyond.any():
            break
        values[beyond] = np.sign(values[beyond]) * bound[beyond]
        held |= beyond
    covariance = np.zeros_like(precision)
    covariance[np.ix_(free, free)] = (cho_solve((factor, True), np.eye(int(free.sum())))
                                      * size[free][:, None] * size[free])
    return values, held, covariance, float(np.log(np.diag(factor) / size[free]).sum())


def _left(grams: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the squares that coefficients leave, by walk."""
    v = np.concatenate([[1.0], -values])
    return np.einsum('i,wij,j->w', v, grams, v)


def robust_std(channels: Sequence[Channel], found: Fit, prior: np.ndarray) -> np.ndarray:
    """
    Return standard deviations that hold where the model is not quite right, too, (k,).

    The larger of the model's and of what the scores of blocks say (sandwich; White 1982,
    Econometrica 50, blocks for what is correlated).
    """
    own = len(found.ids)
    scores = np.zeros((BLOCKS, own))
    for c, w, s2 in zip(channels, found.walks, found.variance):
        at = np.flatnonzero(np.isin(c.ids, found.ids))
        to = np.searchsorted(found.ids, c.ids[at])
        rows = c.grams[w][:, 1 + at]
        scores[:, to] += (rows[:, :, 0] - rows[:, :, 1 + at] @ found.values[to]) / s2
    scores = scores - scores.mean(axis=0)
    sandwich = found.covariance @ (scores.T @ scores) @ found.covariance * BLOCKS / (BLOCKS - 1)
    return np.sqrt(np.maximum(np.diag(found.covariance),
                              np.minimum(np.diag(sandwich), prior[found.ids] ** 2)))


def given(found: Fit, held: np.ndarray, values: np.ndarray) -> np.ndarray:
    """
    Return the posterior mean of all coefficients where some have given values.

    Parameters
    ----------
    found
        The fit, (k,).
    held, values
        Places of those that are given in it, and their values, (j,) each.

    """
    out = found.values.copy()
    others = np.setdiff1d(np.arange(len(out)), held)
    out[others] += found.covariance[np.ix_(others, held)] @ np.linalg.lstsq(
        found.covariance[np.ix_(held, held)], values - out[held])[0]
    out[held] = values
    return out


def predicted(channels: Sequence[Channel], found: Fit, blocks: np.ndarray) -> np.ndarray:
    """Return the log-likelihood of blocks that were not fitted, nats, by block, (b,)."""
    out = np.zeros(len(blocks))
    for c, w, s2 in zip(channels, found.walks, found.variance):
        left = _by_block(c, found, w)[blocks]
        out += -0.5 * (left / s2 + c.counts[blocks] * np.log(s2))
    return out


def _by_block(c: Channel, found: Fit, walk: int) -> np.ndarray:
    """Return the squares that a fit leaves, by block, (b,)."""
    at = np.flatnonzero(np.isin(c.ids, found.ids))
    v = np.zeros(len(c.ids) + 1)
    v[0] = 1.0
    v[1 + at] = -found.values[np.searchsorted(found.ids, c.ids[at])]
    return np.einsum('i,bij,j->b', v, c.grams[walk], v)


def lost(channels: Sequence[Channel], found: Fit, values: np.ndarray, prior: np.ndarray
         ) -> float:
    """
    Return what the log-posterior at other values of coefficients lacks of its maximum, nats.

    The other coefficients are at their best beside them.

    Parameters
    ----------
    channels, prior
        As for `fit`, of all blocks.
    found
        The fit.
    values
        Of the first coefficients, (j,).

    """
    count = len(values)
    off = values - found.values[:count]
    precision = np.diag(prior[found.ids] ** -2.0)
    for c, w, s2 in zip(channels, found.walks, found.variance):
        at = np.searchsorted(found.ids, c.ids)
        precision[np.ix_(at, at)] += c.whole[w, 1:, 1:] / s2
    free = np.flatnonzero(~found.held)
    free = free[free >= count]
    own, across, rest = precision[:count, :count], precision[:count, free], \
        precision[np.ix_(free, free)]
    return 0.5 * float(off @ (own - across @ np.linalg.solve(rest, across.T)) @ off)
