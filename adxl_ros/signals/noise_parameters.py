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

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import nominal_of, Recording
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.gyroscope import Gyroscope
from adxl_ros.model.noise import (
    density_for_variance,
    electronics,
    ONE_SIDED,
    rc_of_white_share,
    white_share,
)
from adxl_ros.model.sensor import Sensor, without_effect
from adxl_ros.signals.allan_deviation import longest_rest, StillStretch
from adxl_ros.signals.gravity_at_rest import require_unit
from adxl_ros.signals.recorded_gravity import RecordingLook
from adxl_ros.signals.recorded_sensor import load_sensor, RESISTANCE_OHM
import numpy as np
import scipy

_INTERVAL_DROP = 2.705543454095404
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
_LEAST_WHITE = 0.5
"""Share of white noise from which a slope is not that of a filter: most of the power."""
_SEEN_STDS = 2.0
"""Standard deviations of a square that is seen. Chosen: as 90 % intervals exclude 0."""

_FLICKER_OF_INSTABILITY = 1 / float(np.sqrt(np.pi))
"""Density of `flicker` at 1 Hz divided by B: over positive frequencies it is B²/(π·f)."""
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
    models = _filters(walks, np.pi * highest / (2 * len(means)), np.pi / (2 * len(means)))
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
    likelihoods = np.array([_fit(model).log_likelihood for model in models])
    best = likelihoods.max()
    if 2 * (best - _fit(groups).log_likelihood) < scipy.stats.chi2.isf(_BOUND_PROBABILITY, 1):
        return [groups], np.inf
    likely = 2 * (best - likelihoods) < _INTERVAL_DROP
    return [models[i] for i in np.flatnonzero(likely)], float(times_s[likelihoods.argmax()])


def _filters(models: list[_Groups], end_rad: float, step_rad: float) -> list[_Groups]:
    """Return the models behind each filter that is likely; angles are half a turn a sample."""
    filtered = []
    for loss in _FILTER_LOSSES:
        strength = loss / np.sin(end_rad) ** 2
        filtered += [model.filtered(strength, step_rad) for model in models]
    likelihoods = np.array([_fit(model).log_likelihood for model in filtered])
    return [
        filtered[i] for i in np.flatnonzero(2 * (likelihoods.max() - likelihoods) < _INTERVAL_DROP)
    ]


def _best(models: list[_Groups], fixed: int | None = None, value: float = 0.0) -> _Fit:
    """Return the most likely fit of several models; see `_fit`."""
    fits = [_fit(model, fixed, value) for model in models]
    return max(fits, key=lambda fit: fit.log_likelihood)


def _grouped(power: np.ndarray, variances: np.ndarray) -> _Groups:
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
        return drop(np.exp(logarithm)) - _INTERVAL_DROP

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

    low = end(-1.0) if best > 0 and drop(0.0) > _INTERVAL_DROP else 0.0
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
        is_without_line = chances.min() * len(chances) > _LINE_PROBABILITY
        is_white = _white_share(octave, theta, rounding) > _LEAST_WHITE
        if is_white and is_without_line and _is_expected(octave, lower, theta):
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


_CERTAIN_STDS = 2.576  # Standard deviations that refute a filter: 1 of 100 healthy logs is beyond
_FORM_TOLERANCE = 0.2  # Logarithm within which noise has the form of an RC filter. Chosen: 20 %
_DITHERED_STEPS = 0.6
"""Noise from which rounding adds step²/12, steps. Chosen: exact within 0.4 % by the first harmonic
of the rounding error (Widrow and Kollár 2008, section 4.4)."""
_DENSITY = 'noise_density_g_per_rthz'  # Field of a sensor that holds its white noise


class FilterEvidence(NamedTuple):
    """What the noise of an axis shows of its filter."""

    # Logarithm of the variance of a sample by that of white noise with the same N
    log_share: float
    std: float  # Standard deviation of this logarithm
    change: float  # Half of the mean square of neighbouring differences, by the variance


@dataclass(frozen=True)
class AxisNoise:
    """The noise of one axis; u is m/s² for an accelerometer, rad/s for a gyroscope."""

    axis: str  # Its letter
    fit: NoiseFit  # White noise, bias instability and random walk, in u
    sample_std: float  # Standard deviation of a sample, u
    resolution: float  # Smallest change of a sample, u
    rounding: float  # N of the rounding to this resolution, u/√Hz, which `fit` does not contain
    # Variance of a sample without rounding, bias instability and random walk, u²
    white_variance: float
    # Half of the mean square of the differences of neighbouring samples without rounding, u²
    change_variance: float

    @property
    def estimates(self) -> tuple[NoiseTerm, ...]:
        """N in u/√Hz, B in u, and K in u/√s."""
        return self.fit.white, self.fit.instability, self.fit.walk

    @property
    def is_coarse(self) -> bool:
        """Whether rounding hides the noise."""
        return _is_coarse(self.sample_std, self.resolution)

    def filter_evidence(self, rest: StillStretch) -> FilterEvidence | None:
        """Return what the noise shows of a filter; None where slow noise or rounding hides it."""
        white = self.fit.white
        is_clear = self.white_variance > _LEAST_WHITE * (self.sample_std**2)
        if not white.is_seen or not is_clear:
            return None
        share = self.white_variance / (white.value**2 * rest.rate_hz)
        repeat = np.clip(1 - self.change_variance / self.white_variance, 0.0, 1.0)
        independent = rest.count * (1 - repeat**2) / (1 + repeat**2)
        # 90 % of a normal distribution are within 1.645 standard deviations.
        white_std = 2 * np.log(white.high / white.low) / (2 * np.sqrt(_INTERVAL_DROP))
        return FilterEvidence(
            np.log(share),
            float(np.hypot(white_std, np.sqrt(2 / independent))),
            self.change_variance / self.white_variance,
        )

    @property
    def sample_white(self) -> float:
        """N of the samples with their rounding, or its upper limit, u/√Hz."""
        white = self.fit.white
        return float(np.hypot(white.value if white.is_seen else white.high, self.rounding))


@dataclass(frozen=True)
class RecordingNoise:
    """The noise of a recording."""

    path: str  # The recording
    sensor: Sensor  # Its parameter file
    nominal: Sensor  # The nominal sensor that it comes from
    rest: StillStretch  # Its samples at rest
    axes: list[AxisNoise]  # The noise by axis
    # What is wrong with the length of gravity and between neighbouring samples, one line each
    doubts: tuple[str, ...] = ()
    gyro_rest: StillStretch | None = None  # The samples of the gyroscope in the same rest
    gyro: Sequence[AxisNoise] = ()  # Its noise by axis; none without a gyroscope


def recording_noise(
    read: Callable[[], Iterable[Recording]],
    params: Sensor | str | None,
    show: Callable[[float], None] = lambda done: None,
) -> RecordingNoise:
    """Fit the noise of all axes in the longest rest; `read` yields the blocks of a recording."""
    first = next(iter(read()), None)
    if first is None:
        raise UserError('the recording holds no samples')
    sensor = load_sensor(params, first)
    nominal = nominal_of(sensor, first.stream_info, first.axes)
    look = RecordingLook(sensor, first)
    still = longest_rest(read, nominal, first, look)
    rest = still.accelerometer
    gyro_rest = still.gyroscope
    doubts = require_unit(look.gravity(), first.path)
    share = 1.0 if gyro_rest is None else 0.5
    noises = _axis_noises(rest, nominal.axes, lambda done: show(share * done))
    gyro = (
        _axis_noises(gyro_rest, AXES, lambda done: show(share * (1 + done))) if gyro_rest else []
    )
    if still.gyro_doubt:
        doubts.append(still.gyro_doubt)
    doubts += look.faults()
    return RecordingNoise(
        path=first.path,
        sensor=sensor,
        nominal=nominal,
        rest=rest,
        axes=noises,
        doubts=tuple(doubts),
        gyro_rest=gyro_rest,
        gyro=gyro,
    )


def _axis_noises(rest: StillStretch, axes: str, show: Callable[[float], None]) -> list[AxisNoise]:
    """Fit the noise of each axis of one sensor at rest."""
    variances = coefficient_variances(len(rest.means), rest.step_s)
    noises = []
    for i, axis in enumerate(axes):
        std = float(rest.sample_std[i])
        resolution = float(rest.resolution[i])
        rounding = resolution / float(np.sqrt(12 * rest.rate_hz))
        fit = fit_noise(rest.means[:, i], rest.step_s, variances, rounding)
        rounding_variance = rounding**2 * rest.rate_hz
        tau_s = rest.allan.tau_s[: rest.window_octaves]
        _, instability, walk = fit.lines(tau_s)
        slow_lines = []
        if fit.instability.is_seen:
            slow_lines.append(instability)
        if fit.walk.is_seen:
            slow_lines.append(walk)
        slow = float(np.sum(np.square(slow_lines)) / 2 / (1 - 0.5 ** len(tau_s)))
        noises.append(
            AxisNoise(
                axis=axis,
                fit=without_rounding(fit, std, resolution, rounding),
                sample_std=std,
                resolution=resolution,
                rounding=rounding,
                white_variance=max(std**2 - slow - rounding_variance, 0.0),
                change_variance=max(
                    float(rest.allan.deviation[0, i]) ** 2 - rounding_variance, 0.0
                ),
            )
        )
        show((i + 1) / len(axes))
    return noises


def without_rounding(fit: NoiseFit, std: float, resolution: float, rounding: float) -> NoiseFit:
    """
    Return the noise before the rounding of the samples to a resolution.

    Above 0.6 steps of noise, rounding adds independent noise of the variance step²/12. Less noise
    is hidden: it may be anything up to that, and codes that do not change show less.
    """
    if not _is_coarse(std, resolution):
        before = [float(np.sqrt(max(value**2 - rounding**2, 0.0))) for value in fit.white]
        return replace(fit, white=NoiseTerm(*before))
    widest = max(_DITHERED_STEPS * resolution / std, 1.0)

    def widened(term: NoiseTerm) -> NoiseTerm:
        return NoiseTerm(term.value, 0.0, term.high * widest)

    return replace(
        fit,
        white=widened(fit.white),
        instability=widened(fit.instability),
        walk=widened(fit.walk),
    )


def _is_coarse(std: float, resolution: float) -> bool:
    """Whether samples with rounding have less noise than makes rounding independent of them."""
    return std**2 < resolution**2 * (_DITHERED_STEPS**2 + 1 / 12)


def with_noise(sensor: Sensor, noises: list[AxisNoise], rest: StillStretch) -> Sensor:
    """
    Give a sensor the measured noise, so that its simulation repeats it at the recorded rate.

    Bias instability is the effect `flicker`, whose density over positive frequencies is B²/(π·f),
    and random walk is `bias_walk`. A term that is not seen on an axis keeps the value of `sensor`
    up to its upper limit. White noise that neither shows stays unstated, so that nobody takes it
    for 0. It has the rounding where `sensor` has no ADC.

    White noise is the density before the filter that gives a sample the measured variance. The
    filter is the stated one unless the noise refutes it: see `_with_filter`. A rest shows neither
    range nor resolution: where they are not stated, the placeholders of `Sensor` stay, which limit
    and round nothing.
    """
    values = {name: value for name, value in sensor.values.items() if name != 'noise_excess'}
    to_g = np.array([ONE_SIDED, _FLICKER_OF_INSTABILITY, 1.0])[:, None] / G0_MPS2
    # By field of an estimate, term and axis.
    value, low, high = (np.array([noise.estimates for noise in noises]) * to_g).T
    for term, (effect, name) in enumerate(
        (('flicker', 'density_g_per_rthz'), ('bias_walk', 'density_g_per_rts')), 1
    ):
        before = sensor.values.get(effect, {}).get(name, 0.0)
        sizes = np.where(low[term] > 0, value[term], np.minimum(before, high[term]))
        values.pop(effect, None)
        if sizes.any():
            values[effect] = {name: sizes}
    if 'bias_walk' in values:
        values['bias_walk']['return_per_s'] = np.array([1 / noise.fit.bound_s for noise in noises])
    kept = [name for name in sensor.effects if name in values]
    sensor = replace(
        sensor, values=values, effects=(*kept, *(name for name in values if name not in kept))
    )
    filtered, is_repeated = _with_filter(sensor, noises, rest)
    is_seen = low[0] > 0
    changed: dict[str, Any] = {'unstated': (_DENSITY,)}
    if _DENSITY not in sensor.unstated or is_seen.all():
        changed = {_DENSITY: _density(filtered, noises, is_repeated), 'unstated': ()}
    return replace(filtered, **changed)


def with_gyro_noise(gyro: Gyroscope, noises: Sequence[AxisNoise]) -> Gyroscope:
    """
    Give a gyroscope the measured noise, by the conventions of `with_noise`.

    A term that is not seen on an axis is 0 there, but for white noise, which is its upper limit.
    """
    if not noises:
        return gyro

    def scaled(factor: float, values: Iterable[float]) -> tuple[float, ...]:
        densities = tuple(factor * value for value in values)
        return densities if any(densities) else ()

    fits = [noise.fit for noise in noises]
    whites = [fit.white.value if fit.white.is_seen else fit.white.high for fit in fits]
    return replace(
        gyro,
        noise_density_radps_per_rthz=scaled(ONE_SIDED, whites),
        flicker_radps_per_rthz=scaled(
            _FLICKER_OF_INSTABILITY, (_seen(fit.instability) for fit in fits)
        ),
        walk_radps_per_rts=scaled(1.0, (_seen(fit.walk) for fit in fits)),
    )


def _seen(estimate: NoiseTerm) -> float:
    return estimate.value if estimate.is_seen else 0.0


def _density(sensor: Sensor, noises: list[AxisNoise], is_repeated: bool) -> np.ndarray:
    """
    Return the white noise before the filter by axis, g/√Hz over positive frequencies, (m,).

    is_repeated: whether the variance of a sample is that of white noise behind the filter.
    """
    circuit = electronics(sensor)
    rate_hz = sensor.rate_hz
    share = white_share(circuit.rc_s, rate_hz)
    variances = []
    for noise, axis_share in zip(noises, share):
        white = noise.fit.white
        if not white.is_seen:
            variance = white.high**2 * rate_hz * axis_share
        elif is_repeated:
            variance = noise.white_variance
        else:
            variance = white.value**2 * rate_hz * axis_share
        if not sensor.adc_bits and white.is_seen:
            variance += noise.rounding**2 * rate_hz
        variances.append(variance / G0_MPS2**2)
    measured = np.sqrt(density_for_variance(np.array(variances), circuit.rc_s, rate_hz))
    measured /= circuit.noise_ratio
    before = sensor.noise_density_g_per_rthz
    stated = np.where(before > 0, before, np.inf)
    is_seen = [noise.fit.white.is_seen for noise in noises]
    return np.where(is_seen, measured, np.minimum(stated, measured))


def _with_filter(
    sensor: Sensor, noises: list[AxisNoise], rest: StillStretch
) -> tuple[Sensor, bool]:
    """
    Return the sensor with a filter that agrees with the noise, and whether one does.

    White noise behind an RC filter has a variance that follows from N and the filter. Less of it
    refutes the stated filter. So does more, but only if the differences of neighbouring samples
    have the form of a filter: vibration and mains add to the variance, too.
    """
    seen = list(filter(None, (noise.filter_evidence(rest) for noise in noises)))
    if not seen:
        return sensor, False
    weights = np.array([each.std**-2 for each in seen])
    log_share = float(np.average([each.log_share for each in seen], weights=weights))
    limit = _CERTAIN_STDS / float(np.sqrt(weights.sum()))
    is_stated = 'rc_capacitance_f' not in sensor.unstated
    stated_share = white_share(electronics(sensor).rc_s, sensor.rate_hz)
    excess = log_share - float(np.mean(np.log(stated_share)))
    if is_stated and abs(excess) < limit:
        return sensor, True
    share = 1.0 if log_share > -limit else float(np.exp(log_share))
    change = float(np.average([each.change for each in seen], weights=weights))
    has_form = abs(np.log(change * (1 + share) / (2 * share))) < limit + _FORM_TOLERANCE
    if is_stated and excess > 0 and not has_form:
        return sensor, False
    return replace(
        without_effect(sensor, 'bandwidth'),
        rc_resistance_ohm=RESISTANCE_OHM,
        rc_capacitance_f=rc_of_white_share(share, sensor.rate_hz) / RESISTANCE_OHM,
        filter_rate_hz=sensor.rate_hz,
    ), True
