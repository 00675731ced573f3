# SPDX-License-Identifier: Apache-2.0

"""
White noise, bias instability and random walk of a signal at rest, with intervals.

The points of an Allan deviation are correlated, so a line through them has no simple interval.
The fit therefore takes the cosine transform of the means of short cells. There a random walk and
white noise have independent coefficients of known variance, and 1/f noise nearly so. The fit
maximises the likelihood of the coefficients. The intervals are those of the profile likelihood.
Frequencies from which on a filter, a fan or mains show are left out. A walk that ends in bounds is
a Gauss-Markov process (IEEE Std 952, annex B).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy

INTERVAL_DROP = 2.705543454095404
"""Drop of twice the log likelihood at the ends of a 90 % interval: χ², 1 degree of freedom."""
_SINGLE_COEFFICIENTS = 64
"""Lowest coefficients that are fitted one by one: from there on a group of `_GROUP_WIDTH` has two
or more."""
_GROUP_WIDTH = 1.03  # Ratio of frequencies of further groups. Chosen: a term changes by 6 %
_ROUNDS = 60  # Largest number of rounds of a fit. Chosen: usual are ten
_HALVINGS = 20  # Largest number of halvings of a step that does not raise the likelihood
_CONVERGED_GAIN = 1e-9  # Change of twice the log likelihood at which a fit ends
_SMALLEST_SQUARE = 1e-4
"""Square, by a dominant one, from which a limit is searched. Chosen: never seen."""
_LINE_PROBABILITY = 1e-3  # Chance from which a line shows. Chosen: 1 % of logs
_OCTAVE_PROBABILITY = 0.05
"""Chance from which a filter shows in an octave. Chosen: an octave less costs little, but one that
is kept because the others are low by chance makes N too small."""
_BOUND_PROBABILITY = 1e-2  # Chance from which a walk has bounds. Chosen: 1 of 100 healthy logs
_BOUND_STEP = 2**0.5  # Ratio of tried correlation times. Chosen: the likelihood changes little
_SHORTEST_BOUND = 10.0  # Shortest T, by the highest frequency. Chosen: below, it is a filter
_SHORTEST_BOUND_S = 1.0  # Shortest T, s: filters have 0.3 s at most (ADXL203 Rev. E, table 4)
_MARGIN_OCTAVES = 1  # Octaves left out below a filter or line. Chosen: a line leaks less far
_FILTER_LOSSES = (0.0, *(4.0**n for n in range(-2, 2)))
"""Power that tried filters take at the end of the fit, by what they leave. Chosen: less than the
first does not show in a thousand coefficients, more than the last ends the fit earlier."""
_FEWEST_COEFFICIENTS = 32
"""Fewest coefficients of a fit. Chosen: white noise is then known within 20 %."""
LEAST_WHITE = 0.5
"""Share of white noise from which a slope is not that of a filter: most of the power."""
_SEEN_STDS = 2.0
"""Standard deviations of a square that is seen. Chosen: as 90 % intervals exclude 0."""

FLOOR = float(np.sqrt(2 * np.log(2) / np.pi))  # Allan deviation of B / B (IEEE Std 952, C.15)


class NoiseTerm(NamedTuple):
    """A value with its interval."""

    value: float  # The most likely value
    low: float  # Lower end of the 90 % interval; 0 where the term is not seen
    high: float  # Upper end; an upper limit where the term is not seen

    @property
    def is_seen(self) -> bool:
        """Whether the interval excludes 0."""
        return self.low > 0

    def scaled(self, factor: float) -> NoiseTerm:
        """Return the estimate in another unit."""
        return NoiseTerm(self.value * factor, self.low * factor, self.high * factor)


@dataclass(frozen=True)
class NoiseFit:
    """The noise of one axis; u is the unit of the signal."""

    # White noise N, u/√Hz: the density over positive and negative frequencies is N²
    white: NoiseTerm
    instability: NoiseTerm  # Bias instability B, u: the density is B²/(2π·f)
    # Random walk K, u/√s: the density is K²/(2π·f)², or K²/((2π·f)² + 1/T²) with bounds
    walk: NoiseTerm
    # Correlation time T of a bounded walk (first-order Gauss-Markov), s, whose standard deviation
    # is K·√(T/2); inf where no bounds show
    bound_s: float
    highest: int  # Number of cosine coefficients of the fit, from the lowest
    highest_hz: float  # Frequency of the last one, Hz

    def allan_deviation(self, tau_s: np.ndarray) -> np.ndarray:
        """Return the Allan deviation of the fitted terms at times, s, (k,), in u."""
        return np.sqrt(np.sum(np.square(self.lines(tau_s)), axis=0))

    def needed_s(self, term: int) -> float:
        """
        Return how long a recording must be to show half of the upper limit of N, B or K, s.

        The Fisher information of the cosine coefficients tells when its interval excludes 0. It
        is inf beyond a thousand times the recording: the other terms hide it.
        """
        terms = self.white, self.instability, self.walk
        squares = np.square([estimate.value for estimate in terms])
        squares[term] = (terms[term].high / 2) ** 2
        present = np.flatnonzero(squares)
        for time_s in self.highest / (2 * self.highest_hz) * 2.0 ** np.arange(0, 10.25, 0.25):
            k = np.unique(np.geomspace(1, 2 * time_s * self.highest_hz, 400).astype(int))
            omega = np.pi * k / time_s
            parts = np.column_stack([np.ones(len(k)), 1 / omega, omega**-2.0]) * squares
            design = (parts / parts.sum(axis=1, keepdims=True))[:, present]
            information = design.T @ (design * np.gradient(k)[:, None] / 2)
            variance = np.linalg.inv(information)[present == term, present == term]
            if variance < _SEEN_STDS**-2:
                return float(time_s)
        return np.inf

    def lines(self, tau_s: np.ndarray) -> np.ndarray:
        """Return the Allan deviations of N, B and K at times, s, (k,), in u, (3, k)."""
        # IEEE Std 952, equation C.19; for short times its terms cancel.
        time_s = min(self.bound_s, 1e4 * tau_s.max())
        x = tau_s / time_s
        terms = np.abs(1 - (3 - 4 * np.exp(-x) + np.exp(-2 * x)) / (2 * x))
        walk = np.where(x > 1e-3, time_s * np.sqrt(terms / tau_s), np.sqrt(tau_s / 3))
        return np.stack(
            [
                self.white.value / np.sqrt(tau_s),
                np.full(len(tau_s), FLOOR * self.instability.value),
                self.walk.value * walk,
            ]
        )


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

    def bounded(self, time_s: float, span_s: float) -> _Groups:
        """Return the groups with a walk of this correlation time, in recordings of `span_s`."""
        cycle = np.pi * time_s / span_s * (self.first + (self.count - 1) / 2)
        return replace(
            self,
            shapes=self.shapes
            * np.column_stack([np.ones((len(cycle), 2)), 1 / (1 + cycle**-2.0)]),
        )

    def filtered(self, strength: float, step_rad: float) -> _Groups:
        """Return the groups behind an AR(1) filter, which divides by 1 + strength·sin²."""
        angle_rad = step_rad * (self.first + (self.count - 1) / 2)
        gain = 1 / (1 + strength * np.sin(angle_rad) ** 2)
        return replace(self, shapes=self.shapes * gain[:, None])


class _Fit(NamedTuple):
    """The likeliest terms."""

    squares: np.ndarray  # N², B² and K², (3,)
    log_likelihood: float  # Up to a constant


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


def fit_noise(
    means: np.ndarray, step_s: float, variances: np.ndarray | None = None, rounding: float = 0.0
) -> NoiseFit:
    """
    Fit the terms to means of neighbouring cells, (n,), by their `coefficient_variances`.

    rounding: the part of N, u/√Hz, that is known to come from behind the filter.
    """
    if variances is None:
        variances = coefficient_variances(len(means), step_s)
    groups = _grouped(np.square(coefficients(means)), variances)
    span_s = len(means) * step_s
    highest = _highest(groups, len(means), span_s, rounding)
    walks, bound_s = _walks(groups.below(highest), span_s, highest)
    step_rad = np.pi / (2 * len(means))
    models = _filters(walks, step_rad * highest, step_rad)
    best = _best(models)
    return NoiseFit(
        white=_interval(models, best, 0),
        instability=_interval(models, best, 1),
        walk=_interval(models, best, 2),
        bound_s=bound_s,
        highest=highest,
        highest_hz=highest / (2 * span_s),
    )


def _walks(groups: _Groups, span_s: float, highest: int) -> tuple[list[_Groups], float]:
    """Return the groups with each bound of the walk that is likely, and the likeliest bound, s."""
    shortest = min(highest / _SHORTEST_BOUND, span_s / _SHORTEST_BOUND_S)
    count = int(np.log(shortest) / np.log(_BOUND_STEP))
    times_s = span_s * _BOUND_STEP ** np.arange(-count, 5.0)
    models = [groups.bounded(time_s, span_s) for time_s in times_s]
    likelihoods = _likelihoods(models)
    gain = 2 * (likelihoods.max() - _fit(groups).log_likelihood)
    if gain < scipy.stats.chi2.isf(_BOUND_PROBABILITY, 1):
        return [groups], np.inf
    return _likely(models, likelihoods), float(times_s[likelihoods.argmax()])


def _likelihoods(models: list[_Groups]) -> np.ndarray:
    """Return the log likelihood of the best fit of each model, (k,)."""
    return np.array([_fit(model).log_likelihood for model in models])


def _likely(models: list[_Groups], likelihoods: np.ndarray) -> list[_Groups]:
    """Return the models that a 90 % interval holds."""
    drop = 2 * (likelihoods.max() - likelihoods)
    return [models[i] for i in np.flatnonzero(drop < INTERVAL_DROP)]


def _filters(models: list[_Groups], end_rad: float, step_rad: float) -> list[_Groups]:
    """Return the models behind each filter that is likely; angles are half a turn a sample."""
    filtered = []
    for loss in _FILTER_LOSSES:
        strength = loss / np.sin(end_rad) ** 2
        filtered += [model.filtered(strength, step_rad) for model in models]
    return _likely(filtered, _likelihoods(filtered))


def _best(models: list[_Groups], fixed: int | None = None, value: float = 0.0) -> _Fit:
    """Return the most likely fit of several models; see `_fit`."""
    fits = [_fit(model, fixed, value) for model in models]
    return max(fits, key=lambda fit: fit.log_likelihood)


def _grouped(power: np.ndarray, variances: np.ndarray) -> _Groups:
    """Group squares of coefficients, (n,), with their variances for terms of 1, (n, 3)."""
    edges = [*range(min(_SINGLE_COEFFICIENTS, len(power)))]
    position = float(_SINGLE_COEFFICIENTS)
    while position < len(power):
        edges.append(int(position))
        position = max(position * _GROUP_WIDTH, position + 1)
    first = np.array(edges)
    count = np.diff(np.append(first, len(power)))
    return _Groups(
        np.add.reduceat(power, first) / count,
        count,
        np.add.reduceat(variances, first) / count[:, None],
        first + 1,
    )


def _log_likelihood(groups: _Groups, theta: np.ndarray) -> float:
    """Return the log likelihood of N², B² and K², (3,), up to a constant."""
    variance = groups.shapes @ theta
    if not (variance > 0).all():
        return -np.inf
    return -0.5 * float(groups.count @ (np.log(variance) + groups.power / variance))


def _fit(groups: _Groups, fixed: int | None = None, value: float = 0.0) -> _Fit:
    """Return the likeliest terms of 0 or more by Fisher scoring; one may have a fixed square."""
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
            trial = theta + step * 0.5**halving
            gained = _log_likelihood(groups, trial) - likelihood
            if gained > 0:
                break
        else:
            break
        theta = trial
        likelihood = likelihood + gained
        if 2 * gained < _CONVERGED_GAIN:
            break
    return _Fit(theta, likelihood)


def _interval(models: list[_Groups], fit: _Fit, term: int) -> NoiseTerm:
    """Return a term with the ends of its interval by the profile likelihood."""

    def drop(square: float) -> float:
        """Return twice the drop of the likelihood where the term has another square."""
        return 2 * (fit.log_likelihood - _best(models, term, square).log_likelihood)

    def excess(logarithm: float) -> float:
        """Return the drop minus its limit, by the logarithm of the square."""
        return drop(np.exp(logarithm)) - INTERVAL_DROP

    shapes = models[0].shapes
    scale = float(np.min(shapes @ fit.squares / shapes[:, term]))
    best = float(fit.squares[term])
    begin = np.log(best if best > 0 else scale * _SMALLEST_SQUARE)

    def end(step: float) -> float:
        """Return the end of the interval that lies in the direction of a step."""
        beyond = begin + step
        while excess(beyond) < 0:
            beyond += step
        return float(np.exp(scipy.optimize.brentq(excess, beyond - step, beyond, xtol=1e-6)))

    low = end(-1.0) if best > 0 and drop(0.0) > INTERVAL_DROP else 0.0
    high = end(1.0)
    return NoiseTerm(float(np.sqrt(best)), float(np.sqrt(low)), float(np.sqrt(high)))


def _highest(groups: _Groups, count: int, span_s: float, rounding: float) -> int:
    """
    Return at which coefficient the fit stops: where a filter or a line shows.

    Behind a filter, white noise has the spectrum of a walk with bounds, and no fit tells the two
    apart. The fit therefore ends in an octave in which white noise prevails.
    """
    stop = count
    while stop > 2 * _FEWEST_COEFFICIENTS:
        lower = groups.below(max(stop // 2, _FEWEST_COEFFICIENTS))
        _, bound_s = _walks(lower, span_s, stop // 2)
        used = groups.below(stop).bounded(bound_s, span_s)
        lower = lower.bounded(bound_s, span_s)
        theta = _fit(lower).squares
        chances = scipy.stats.chi2.sf(used.count * used.power / (used.shapes @ theta), used.count)
        octave = used.where(used.first >= stop // 2)
        has_line = chances.min() * len(chances) <= _LINE_PROBABILITY
        is_white = _white_share(octave, theta, rounding) > LEAST_WHITE
        has_filter = not is_white or not _is_expected(octave, lower, theta)
        if not has_line and not has_filter:
            break
        stop //= 2
    return max(stop >> _MARGIN_OCTAVES, min(count, _FEWEST_COEFFICIENTS))


def _white_share(groups: _Groups, theta: np.ndarray, rounding: float) -> float:
    """Return the share of white noise, without the rounding, in the power of a fit, 0 to 1."""
    if not len(groups.count):
        return 0.0
    white = max(float(theta[0]) - rounding**2, 0.0)
    share = groups.shapes[:, 0] * white / (groups.shapes @ theta)
    return float(np.average(share, weights=groups.count))


def _is_expected(octave: _Groups, lower: _Groups, theta: np.ndarray) -> bool:
    """Whether an octave has the power that a fit of the lower groups predicts."""
    if not len(octave.count):
        return False
    parts = _shares(octave, theta)
    design = _shares(lower, theta)
    share = octave.count / octave.count.sum()
    predicted = share @ parts @ np.linalg.pinv(design * np.sqrt(lower.count / 2)[:, None])
    excess = float(share @ (octave.power / (octave.shapes @ theta))) - 1
    variance = 2 / octave.count.sum() + float(predicted @ predicted)
    return bool(scipy.stats.chi2.sf(excess**2 / variance, 1) > _OCTAVE_PROBABILITY)


def _shares(groups: _Groups, theta: np.ndarray) -> np.ndarray:
    """Return the share of each term that a fit has in the power, (g, terms)."""
    return (groups.shapes * theta)[:, theta > 0] / (groups.shapes @ theta)[:, None]
