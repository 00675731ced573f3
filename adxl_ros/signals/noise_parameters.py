# SPDX-License-Identifier: Apache-2.0

"""
White noise, bias instability and random walk of a signal at rest, with intervals.

The points of an Allan deviation are correlated, so a line through them has no simple interval.
The fit therefore takes the cosine transform of the means of short cells. There a random walk and
white noise have independent coefficients of known variance, and 1/f noise nearly so. The fit
maximises the likelihood of the coefficients. The intervals are those of the profile likelihood.
Lines of a fan or of mains are left out first, and a walk that ends in bounds is a Gauss-Markov
process (IEEE Std 952, annex B).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy

_DROP = 2.705543454095404
"""Twice the drop of the log likelihood at the ends of a 90 % interval: the quantile of χ² with
one degree of freedom."""
_SINGLE = 64
"""Coefficients of the lowest frequencies that are fitted one by one. Chosen: the terms change
little between the further ones."""
_WIDTH = 1.03
"""Ratio of the frequencies of a group of further coefficients. Chosen: a term changes by 6 %."""
_ROUNDS = 60
"""Largest number of rounds of a fit. Chosen: usual are ten."""
_HALVINGS = 20
"""Largest number of halvings of a step that does not raise the likelihood."""
_CONVERGED = 1e-9
"""Change of twice the log likelihood at which a fit ends."""
_SMALLEST = 1e-4
"""Square of a term, by the square at which it would dominate, from which an upper limit is
searched. Chosen: it changes the likelihood of no recording."""
_OCTAVE_PROBABILITY = 1e-3
"""Probability by chance, below which an octave shows a filter, or a group exceeds its
neighbours. Chosen: with ten octaves one healthy recording in a hundred."""
_BOUND_PROBABILITY = 1e-2
"""Probability by chance, below which a walk has bounds. Chosen: one healthy recording in a
hundred; where bounds are missed, the interval of K is too low."""
_FEWEST_NEIGHBOURS = 8
"""Fewest groups within an octave on both sides that show the level beside a line. Chosen."""
_BOUND_STEP = 2 ** 0.5
"""Ratio of correlation times that are tried. Chosen: the likelihood changes little between."""
_SHORTEST_BOUND = 10.0
"""Shortest correlation time, by that of the highest frequency. Chosen: a shorter one is taken for
a filter of white noise."""
_MARGIN_OCTAVES = 2
"""Octaves below a filter's effect that are left out. Chosen: the effect falls by 16 in power."""
_FEWEST = 32
"""Fewest coefficients of a fit. Chosen: white noise is then known within 20 %."""
_SEEN = 2.0
"""Standard deviations of its square by which a term must differ from 0 to be seen. Chosen: it
gives the rate at which 90 % intervals exclude 0."""

FLOOR = float(np.sqrt(2 * np.log(2) / np.pi))
"""Allan deviation of bias instability divided by B: 0.664 (IEEE Std 952, equation C.15)."""


class Estimate(NamedTuple):
    """A value with its interval."""

    value: float  # The most likely value
    low: float  # Lower end of the 90 % interval; 0 where the term is not seen
    high: float  # Upper end; an upper limit where the term is not seen

    @property
    def is_seen(self) -> bool:
        """Whether the interval excludes 0."""
        return self.low > 0

    def scaled(self, factor: float) -> Estimate:
        """Return the estimate in another unit."""
        return Estimate(self.value * factor, self.low * factor, self.high * factor)


@dataclass(frozen=True)
class NoiseFit:
    """The noise of one axis; u is the unit of the signal."""

    # White noise N, u/√Hz: the density over positive and negative frequencies is N²
    white: Estimate
    instability: Estimate  # Bias instability B, u: the density is B²/(2π·f)
    # Random walk K, u/√s: the density is K²/(2π·f)², or K²/((2π·f)² + 1/T²) with bounds
    walk: Estimate
    # Correlation time T of a bounded walk (first-order Gauss-Markov), s, whose standard deviation
    # is K·√(T/2); None where no bounds show
    correlation: Estimate | None
    highest: int  # Number of cosine coefficients of the fit, from the lowest
    highest_hz: float  # Frequency of the last one, Hz
    kept: np.ndarray  # Groups of coefficients without lines, bool
    lines_hz: np.ndarray  # Frequencies of sure lines among the others, Hz, (j,)
    log_likelihood: float  # Largest log likelihood, up to a constant

    @property
    def squares(self) -> np.ndarray:
        """N², B² and K², (3,)."""
        return np.square([self.white.value, self.instability.value, self.walk.value])

    def allan_deviation(self, tau_s: np.ndarray) -> np.ndarray:
        """Return the Allan deviation of the fitted terms at times, s, (k,), in u."""
        return np.sqrt(np.sum(np.square(self.lines(tau_s)), axis=0))

    def needed_s(self, term: int) -> float:
        """
        Return how long a recording must be to show half of the upper limit of N, B or K, s.

        The Fisher information of the cosine coefficients tells when its interval excludes 0. It
        is inf beyond a thousand times the recording: the other terms hide it.
        """
        squares = self.squares
        squares[term] = ((self.white, self.instability, self.walk)[term].high / 2) ** 2
        present = np.flatnonzero(squares)
        for time_s in self.highest / (2 * self.highest_hz) * 2.0 ** np.arange(0, 10.25, 0.25):
            k = np.unique(np.geomspace(1, 2 * time_s * self.highest_hz, 400).astype(int))
            omega = np.pi * k / time_s
            parts = np.column_stack([np.ones(len(k)), 1 / omega, omega ** -2.0]) * squares
            design = (parts / parts.sum(axis=1, keepdims=True))[:, present]
            information = design.T @ (design * np.gradient(k)[:, None] / 2)
            variance = np.linalg.inv(information)[present == term, present == term]
            if variance < _SEEN ** -2:
                return float(time_s)
        return np.inf

    def lines(self, tau_s: np.ndarray) -> np.ndarray:
        """Return the Allan deviations of N, B and K at times, s, (k,), in u, (3, k)."""
        walk = np.sqrt(tau_s / 3)
        if self.correlation is not None:
            # IEEE Std 952, equation C.19; for short times its terms cancel.
            time_s = self.correlation.value
            x = tau_s / time_s
            terms = 1 - (3 - 4 * np.exp(-x) + np.exp(-2 * x)) / (2 * x)
            walk = np.where(x > 1e-3, time_s * np.sqrt(np.abs(terms) / tau_s), walk)
        return np.stack([self.white.value / np.sqrt(tau_s),
                         np.full(len(tau_s), FLOOR * self.instability.value),
                         self.walk.value * walk])


@dataclass(frozen=True)
class _Groups:
    """Groups of neighbouring coefficients."""

    power: np.ndarray  # Mean square of the coefficients, (g,)
    count: np.ndarray  # Number of coefficients, (g,)
    shapes: np.ndarray  # Their mean variance for N², B² and K² of 1, (g, 3)
    first: np.ndarray  # Number of the first coefficient, from 1, (g,)

    def where(self, kept: np.ndarray) -> _Groups:
        """Return the groups that are marked, (g,) bool."""
        return _Groups(self.power[kept], self.count[kept], self.shapes[kept], self.first[kept])

    def below(self, stop: int) -> _Groups:
        """Return the groups that end before coefficient number `stop`."""
        return self.where(self.first + self.count <= stop)

    def without_lines(self) -> np.ndarray:
        """
        Return which groups, and neighbours, do not exceed those of an octave on both sides, bool.

        The fitted terms make the spectrum flat first; the median of the octaves is its level. A
        strong line has a broad foot, which shows after its peak is left out.
        """
        kept = np.ones(len(self.first), bool)
        spans = np.searchsorted(self.first, np.outer(self.first, (0.5, 2.0)), 'right')
        for _ in range(_ROUNDS):
            ratio = self.power / (self.shapes @ _fit(self.where(kept))[0])
            of_median = np.where(kept, ratio / (1 - 2 / (9 * self.count)) ** 3, np.nan)
            level = np.full(len(ratio), np.inf)
            for i in np.flatnonzero(kept):
                begin, end = spans[i]
                if np.count_nonzero(kept[begin:end]) >= _FEWEST_NEIGHBOURS:
                    level[i] = np.nanmedian(of_median[begin:end])
            line = kept & (scipy.stats.chi2.sf(self.count * ratio / level, self.count)
                           < _OCTAVE_PROBABILITY)
            if not line.any():
                break
            kept &= ~(line | np.append(line[1:], False) | np.append(False, line[:-1]))
        return kept

    def bounded(self, correlation_s: float, span_s: float) -> _Groups:
        """Return the groups with a bounded walk, in recordings of `span_s`."""
        cycle = np.pi * correlation_s / span_s * (self.first + (self.count - 1) / 2)
        return replace(self, shapes=self.shapes * np.column_stack(
            [np.ones((len(cycle), 2)), 1 / (1 + cycle ** -2.0)]))


def coefficients(means: np.ndarray) -> np.ndarray:
    """Return the cosine coefficients 1 to n − 1 of means, (n,); coefficient k is at k/(2·T)."""
    return scipy.fft.dct(means - means.mean(), norm='ortho')[1:]


def coefficient_variances(count: int, step_s: float) -> np.ndarray:
    """
    Return the variances of the cosine coefficients of cell means, for N, B and K of 1.

    Those of white noise are equal. The means of a random walk have the inverse of the path's
    Laplacian as covariance, whose eigenvectors are the cosines; the average within a cell adds
    the factor (2 + cos ω)/3. For 1/f noise the diagonal of its covariance is computed. That
    covariance is −B²/π·ln|t| up to a constant, averaged over two cells.

    Returned by coefficient and term for `count` cells, (n − 1, 3), in s⁻¹, 1 and s.
    """
    k = np.arange(1, count)
    omega = np.pi * k / count
    lag = np.arange(count + 1.0)
    integral = np.zeros(count + 1)
    integral[1:] = lag[1:] ** 2 * np.log(lag[1:])
    covariance = np.empty(count)
    covariance[0] = -integral[1]
    covariance[1:] = -0.5 * (integral[2:] - 2 * integral[1:-1] + integral[:-2])
    covariance -= covariance[-1]
    even = scipy.fft.dct(np.append((count - lag[:-1]) * covariance, 0.0), type=1)[1:-1]
    odd = scipy.fft.dst(covariance[1:], type=1) / np.sin(omega)
    flicker = (even - odd) / count / np.pi
    walk = step_s * (2 + np.cos(omega)) / (12 * np.sin(omega / 2) ** 2)
    return np.column_stack([np.full(count - 1, 1 / step_s), flicker, walk])


def fit_noise(means: np.ndarray, step_s: float, variances: np.ndarray | None = None,
              like: NoiseFit | None = None) -> NoiseFit:
    """
    Fit white noise, bias instability and random walk to the means of neighbouring cells, u, (n,).

    variances: those of `coefficient_variances`, which axes of one recording share; like: fit whose
    coefficients to use; None leaves out those at which a filter or vibration shows.
    """
    if variances is None:
        variances = coefficient_variances(len(means), step_s)
    everything = _grouped(np.square(coefficients(means)), variances)
    kept = everything.without_lines() if like is None else like.kept
    groups = everything.where(kept)
    span_s = len(means) * step_s
    highest = _highest(groups, len(means), span_s) if like is None else like.highest
    used = groups.below(highest)
    models, correlation = _walks(used, span_s, highest)
    theta, likelihood = _best(models)
    white, instability, walk = (_interval(models, theta, likelihood, term) for term in range(3))
    excess = everything.count * everything.power / (everything.shapes @ theta)
    is_line = ~kept & (scipy.stats.chi2.sf(excess, everything.count)
                       < _OCTAVE_PROBABILITY / len(kept))
    lines_hz = (everything.first + everything.count / 2)[is_line] / (2 * span_s)
    return NoiseFit(white, instability, walk, correlation, highest, highest / (2 * span_s), kept,
                    lines_hz, likelihood)


def _walks(groups: _Groups, span_s: float, highest: int
           ) -> tuple[list[_Groups], Estimate | None]:
    """
    Return the groups with the walks that the interval of its correlation time holds.

    A walk without bounds is one of its own, which bounds must contradict.
    """
    count = int(np.log(highest / _SHORTEST_BOUND) / np.log(_BOUND_STEP))
    times_s = span_s * _BOUND_STEP ** np.arange(-count, 5.0)
    models = [groups.bounded(time_s, span_s) for time_s in times_s]
    likelihoods = np.array([_fit(model)[1] for model in models])
    free = _fit(groups)[1]
    if 2 * (likelihoods.max() - free) < scipy.stats.chi2.isf(_BOUND_PROBABILITY, 1):
        return [groups], None
    inside = np.flatnonzero(2 * (likelihoods.max() - likelihoods) < _DROP)
    low, high = max(inside[0] - 1, 0), min(inside[-1] + 1, len(times_s) - 1)
    return models[low:high + 1], Estimate(float(times_s[likelihoods.argmax()]),
                                          float(times_s[low]), float(times_s[high]))


def _best(models: list[_Groups], fixed: int | None = None, value: float = 0.0
          ) -> tuple[np.ndarray, float]:
    """Return the most likely fit of several models; see `_fit`."""
    return max((_fit(model, fixed, value) for model in models), key=lambda fit: fit[1])


def _grouped(power: np.ndarray, variances: np.ndarray) -> _Groups:
    edges = [*range(min(_SINGLE, len(power)))]
    position = float(_SINGLE)
    while position < len(power):
        edges.append(int(position))
        position = max(position * _WIDTH, position + 1)
    first = np.array(edges)
    count = np.diff(np.append(first, len(power)))
    return _Groups(np.add.reduceat(power, first) / count, count,
                   np.add.reduceat(variances, first) / count[:, None], first + 1)


def _log_likelihood(groups: _Groups, theta: np.ndarray) -> float:
    """Return the log likelihood of N², B² and K², (3,), up to a constant."""
    variance = groups.shapes @ theta
    if not (variance > 0).all():
        return -np.inf
    return -0.5 * float(groups.count @ (np.log(variance) + groups.power / variance))


def _fit(groups: _Groups, fixed: int | None = None, value: float = 0.0
         ) -> tuple[np.ndarray, float]:
    """Return the likeliest N², B² and K² of 0 or more, (3,), by Fisher scoring; and how likely."""
    free = [term for term in range(3) if term != fixed]
    theta = np.zeros(3)
    if fixed is not None:
        theta[fixed] = value
    offset = groups.shapes @ theta
    white = max(float(np.median(groups.power - offset)), float(groups.power.min()))
    theta[free[0]] = white / float(np.median(groups.shapes[:, free[0]]))
    likelihood = _log_likelihood(groups, theta)
    for _ in range(_ROUNDS):
        weight = np.sqrt(groups.count) / (groups.shapes @ theta)
        design = groups.shapes[:, free] * weight[:, None]
        norm = np.linalg.norm(design, axis=0)
        solution, _ = scipy.optimize.nnls(design / norm, (groups.power - offset) * weight)
        step = np.zeros(3)
        step[free] = solution / norm - theta[free]
        for halving in range(_HALVINGS):
            trial = theta + step * 0.5 ** halving
            gained = _log_likelihood(groups, trial) - likelihood
            if gained > 0:
                break
        else:
            break
        theta, likelihood = trial, likelihood + gained
        if 2 * gained < _CONVERGED:
            break
    return theta, likelihood


def _interval(models: list[_Groups], theta: np.ndarray, likelihood: float, term: int) -> Estimate:
    """Return a term with the ends of its interval by the profile likelihood over models."""
    def excess(logarithm: float) -> float:
        """Return twice the drop of the profile likelihood, minus its limit."""
        return 2 * (likelihood - _best(models, term, np.exp(logarithm))[1]) - _DROP

    scale = float(np.min(models[0].shapes @ theta / models[0].shapes[:, term]))
    best = float(theta[term])
    low = 0.0
    begin = np.log(best if best > 0 else scale * _SMALLEST)
    if best > 0 and 2 * (likelihood - _best(models, term, 0.0)[1]) > _DROP:
        bottom = begin - 1.0
        while excess(bottom) < 0:
            bottom -= 1.0
        low = float(np.exp(scipy.optimize.brentq(excess, bottom, begin, xtol=1e-6)))
    top = begin + 1.0
    while excess(top) < 0:
        top += 1.0
    high = float(np.exp(scipy.optimize.brentq(excess, top - 1.0, top, xtol=1e-6)))
    return Estimate(*(float(np.sqrt(square)) for square in (best, low, high)))


def _highest(groups: _Groups, count: int, span_s: float) -> int:
    """Return the number of the coefficient at which the fit stops: where a filter shows."""
    stop = count
    while stop > 2 * _FEWEST:
        lower = groups.below(max(stop // 2, _FEWEST))
        octave = groups.where((groups.first >= stop // 2) & (groups.first + groups.count <= stop))
        _, correlation = _walks(lower, span_s, stop // 2)
        if correlation is not None:
            lower, octave = (part.bounded(correlation.value, span_s) for part in (lower, octave))
        if _is_expected(octave, lower, _fit(lower)[0]):
            break
        stop //= 2
    return max(stop >> _MARGIN_OCTAVES, min(count, _FEWEST))


def _is_expected(octave: _Groups, lower: _Groups, theta: np.ndarray) -> bool:
    """Whether an octave has the power that a fit of the lower groups predicts."""
    if not len(octave.count):
        return False
    parts, design = ((g.shapes * theta)[:, theta > 0] / (g.shapes @ theta)[:, None]
                     for g in (octave, lower))
    share = octave.count / octave.count.sum()
    predicted = share @ parts @ np.linalg.pinv(design * np.sqrt(lower.count / 2)[:, None])
    excess = float(share @ (octave.power / (octave.shapes @ theta))) - 1
    variance = 2 / octave.count.sum() + float(predicted @ predicted)
    return bool(scipy.stats.chi2.sf(excess ** 2 / variance, 1) > _OCTAVE_PROBABILITY)


_DRIFT_GAIN = 12.0
"""Gain in twice the log likelihood from which a drift is named. Chosen: one chance in 2000."""
_FIT_ROUNDS = 3
"""Rounds that fit the size of a drift and the noise in turn. Chosen: sizes then stay."""


@dataclass(frozen=True)
class Drift:
    """A drift of one axis; u is its unit."""

    follows: str  # What it follows: temperature or time
    size: float  # Its size: u/K or u/s
    without: NoiseFit  # The noise without the drift


def find_drift(means: np.ndarray, step_s: float, variances: np.ndarray, fit: NoiseFit,
               temperature_c: np.ndarray | None) -> Drift | None:
    """
    Find the drift that explains most of the slow motion of a signal; None where noise does.

    means: means of cells, u, (n,); variances: those of `coefficient_variances`; fit: the noise of
    the same cells; temperature_c: temperature of the cells, (n,), None where it is not measured.
    """
    shapes = {'time': np.arange(len(means)) * step_s}
    if temperature_c is not None and np.ptp(temperature_c) > 0:
        shapes['temperature'] = temperature_c
    drifts = []
    for name, shape in shapes.items():
        measured, expected = (coefficients(values)[:fit.highest] for values in (means, shape))
        size, without = 0.0, fit
        for _ in range(_FIT_ROUNDS):
            weight = expected / (variances[:fit.highest] @ without.squares)
            size = float(weight @ measured / (weight @ expected))
            without = fit_noise(means - size * shape, step_s, variances, without)
        drifts.append(Drift(name, size, without))
    best = max(drifts, key=lambda drift: drift.without.log_likelihood)
    gain = 2 * (best.without.log_likelihood - fit.log_likelihood)
    return best if gain > _DRIFT_GAIN else None
