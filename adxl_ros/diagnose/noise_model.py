# SPDX-License-Identifier: Apache-2.0
"""
The noise of a healthy unit and of its reference: the floor, and filters that make noise white.

The floor is from noise at rest, differences of repeats, and the steps of the encoder.

The noise is white noise behind the RC filter, the ADC's steps, and a zero-g that drifts. With a
random walk it is y = n + w + d. Here n is an AR(1) sequence with a = exp(−dt/RC), w is white, and
d is the walk. Then (1 − aL)(1 − L)·y is an MA(2). Its factor follows from its spectrum (Brockwell
and Davis 1991, section 3.2).

Alternating poles and zeros, one pair a decade, whiten 1/f noise below its corner, where its
density equals that of the white noise (Corsini and Saletti 1988, IEEE Trans. Instrum. Meas. 37).
The variance of the innovations is fitted. The filter then depends only on the ratio of drift and
noise, which is searched on a grid.

Errors of followed angles are constant at rest and new after each move (errors in variables; Fuller
1987). The model is y = n + g·u. Here n is noise behind the RC filter, AR(1) with pole a, u has
variance 1, u_t = φ_t·u_(t−1) + √(1 − φ_t²)·ξ_t, and g is its standard deviation in V. A Kalman
filter predicts g·u; its innovations, scaled and filtered by 1/(1 − aL), have the spectrum of n.
Where g is 0, samples stay as they are.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import sqrt

from adxl_ros.diagnose.comparison import BaselineComparison, CachedPath, gravity_slopes
from adxl_ros.diagnose.evidence import AngleErrorFilter, Whitener
from adxl_ros.model import noise
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.effects import effect_named, library
from adxl_ros.model.effects.base import DriftSpectrum
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.block_statistics import true_runs
from adxl_ros.simulate.smoothed_paths import ForcePath
import numpy as np
import scipy

_REST_S, _PARTS_OF_REST = 1.0, 4
"""Length of a rest whose mean is subtracted, s, and its parts for the interval of the noise.
Chosen: slower changes are part of the gap, and a part is longer than its samples correlate."""
_FEWEST_PARTS, _MOST_PARTS = 20, 100
"""Parts from which an interval is drawn. Chosen: 20 parts show their spread to 16 %."""
FEWEST_SAMPLES = 200
"""Fewest samples of an estimate. Chosen: 5 % of the standard deviation."""
_REPEAT_SHORTEST_S, _REPEAT_DELAY_S = 20.0, 10.0
"""Shortest repeat of a trajectory, s, and smallest delay of one in the same recording. Chosen: a
few moves, beyond the correlation of a move with itself."""
_REPEAT_STEPS, _SMALLEST_RESOLUTION_RAD, _REPEAT_MOTION = 5.0, 1e-5, 0.05
"""Largest rms angle between two repeats, in steps of the encoder; the smallest such step, rad; and
smallest standard deviation of the direction of gravity in a repeat, rad. Chosen."""
RANDOM_WALKS_G_PER_RTS = (1e-7, 1e-5, 3e-5, 7e-5, 1.5e-4, 4e-4, 1e-3, 3e-3)
"""Grid of densities of a random walk, g/√s, a factor of two to three apart."""
FLICKERS_G_PER_RTHZ = (6e-5, 1.5e-4, 5e-4, 1.5e-3, 4e-3)
"""Grid of densities of 1/f noise at 1 Hz, g/√Hz, a factor of three apart."""
_USUAL_DENSITY, _DENSITY_DECADES = 1e-5, 1.0
"""Usual density of both drifts, and prior standard deviation of its logarithm, decades. Chosen:
0.1 mg within 100 s, and a factor of ten."""
_LOWEST_NOISE_V = 1e-7
"""Smallest standard deviation of the noise, V, because whitening needs noise. Chosen: below that
of any ADC."""
_TOP_OF_RATE = 0.25
"""Highest corner frequency of 1/f noise, divided by the sample rate. Chosen: half of Nyquist."""


@dataclass(frozen=True)
class NoiseFloor:
    """Rms of what no model can predict, over samples and measured axes."""

    noise_v: np.ndarray  # Standard deviation of the samples about their mean, V, (m,)
    rms_mps2: float  # Noise and the steps of the stage's encoder, m/s²
    # 'still' for rests, 'repeats' of a trajectory, or 'assumed' from the parameter file
    source: str
    # Sum of the squares of noise and steps, mean over axes, (m/s²)², and number of samples, by
    # part of the recordings, (2, k). Without columns where the floor is assumed.
    parts: np.ndarray

    def draws_mps2(self, seed: int, draws: int) -> np.ndarray | None:
        """Return the floor from parts drawn with replacement, m/s²; None for too few parts."""
        count = self.parts.shape[1]
        if count < _FEWEST_PARTS:
            return None
        edges = np.linspace(0, count, min(count, _MOST_PARTS) + 1).astype(int)[:-1]
        squares, samples = np.add.reduceat(self.parts, edges, axis=1)
        drawn = np.random.default_rng(seed).integers(0, len(edges), (draws, len(edges)))
        return np.sqrt(squares[drawn].sum(axis=1) / samples[drawn].sum(axis=1))


Squares = list[tuple[np.ndarray, int]]
"""Sums of squares by axis, V², (m,), and their numbers of samples, by part of a recording."""


def estimate(comparisons: Sequence[BaselineComparison]) -> NoiseFloor:
    """
    Estimate the noise floor from rests, else from repeats, else from the parameter file.

    The noise at rest is that about the mean of each second. The mean square of the encoder's steps
    is added: step²/12 times the squared slope of gravity, or what they leave open of a robot.
    """
    sums: Squares = [part for c in comparisons for part in squares_at_rest(
        c.volts, c.at_rest & c.used, c.sensor)]
    source, scale_v_per_mps2 = 'still', comparisons[0].scale_v_per_mps2
    if sum(count for _, count in sums) < FEWEST_SAMPLES:
        sums, source = _repeat_squares(comparisons), 'repeats'
    count = sum(count for _, count in sums)
    if count < FEWEST_SAMPLES:
        sums, noise_v, source = [], noise.sample_std_v(comparisons[0].sensor), 'assumed'
    else:
        noise_v = np.sqrt(np.sum([squares_v2 for squares_v2, _ in sums], axis=0) / count)
    encoder = float(np.mean([c.robot_error_mps2 ** 2 for c in comparisons]))
    for c in comparisons:
        if c.joints:
            slopes = gravity_slopes(*(joint(c.time_s)[c.used] for joint in c.joints))
            squares = np.mean((slopes[:, :len(c.sensor.axes)] ** 2).sum(axis=0))
            encoder += float((c.sensor.local_gravity_mps2 * c.sensor.stage_std_rad) ** 2
                             * squares / len(comparisons))
    parts = np.array([(np.mean(squares_v2 / scale_v_per_mps2 ** 2) + count * encoder, count)
                      for squares_v2, count in sums]).reshape(-1, 2).T
    return NoiseFloor(noise_v, float(np.sqrt(np.mean((noise_v / scale_v_per_mps2) ** 2)
                                             + encoder)), source, parts)


def squares_at_rest(volts: np.ndarray, at_rest: np.ndarray, sensor: Sensor) -> Squares:
    """Sum the squares of an output, V, (n, m), about the mean of each second at rest."""
    length = max(round(_REST_S * sensor.rate_hz), 4)
    # The mean of correlated samples takes more out of their variance than one sample.
    independent = length / float(noise.effective_samples(length, 1 / sensor.rate_hz,
                                                         sensor.rc_s))
    squares: Squares = []
    for begin, end in true_runs(at_rest):
        for first in range(begin, end - length + 1, length):
            part = volts[first:first + length]
            squares_v2 = (part - part.mean(axis=0)) ** 2 * length / (length - independent)
            squares += [(piece.sum(axis=0), len(piece))
                        for piece in np.array_split(squares_v2, _PARTS_OF_REST)]
    return squares


def _repeat_squares(comparisons: Sequence[BaselineComparison]) -> Squares:
    """Return half the squares of the differences between repeats of a trajectory on the stage."""
    staged = [(c, force) for c in comparisons
              if c.joints and (force := c.reference_force_g()) is not None]
    squares: Squares = []
    for i, (first, force) in enumerate(staged):
        for second, other in staged[i:]:
            rate_hz = first.sensor.rate_hz
            if abs(rate_hz / second.sensor.rate_hz - 1) > 1e-3:
                continue
            found = find_repeat(force, other, rate_hz, first.sensor.stage_resolution_rad,
                                first is second)
            if found is None:
                continue
            lag, count = found
            used = first.used[:count] & second.used[lag:lag + count]
            difference_v = (second.residual_v(second.sensor)[lag:lag + count]
                            - first.residual_v(first.sensor)[:count])[used]
            squares_v2 = (difference_v - difference_v.mean(axis=0)) ** 2 / 2
            length = max(round(_REST_S * rate_hz), 1)
            squares += [(part.sum(axis=0), len(part)) for part in np.split(
                squares_v2, range(length, len(squares_v2), length))]
    return squares


def find_repeat(first: np.ndarray, second: np.ndarray, rate_hz: float, resolution_rad: float,
                same_recording: bool) -> tuple[int, int] | None:
    """
    Find the lag, and its overlap, by which the directions of gravity in two recordings agree best.

    first, second: direction of gravity in the sensor's frame, unit vectors, (3, n) and (3, n').
    """
    products = sum(scipy.signal.correlate(b, a, method='fft') for a, b in zip(first, second))
    lags = scipy.signal.correlation_lags(second.shape[1], first.shape[1])
    overlap = np.minimum(first.shape[1], second.shape[1] - lags)
    tried = (lags >= _REPEAT_DELAY_S * rate_hz * same_recording) \
        & (overlap >= _REPEAT_SHORTEST_S * rate_hz)
    if not tried.any():
        return None
    # |a − b|² of unit vectors is 2 − 2·a·b.
    mean_square = np.where(tried, 2 - 2 * products / np.maximum(overlap, 1), np.inf)
    best = int(np.argmin(mean_square))
    lag, count = int(lags[best]), int(overlap[best])
    largest_rad = _REPEAT_STEPS * max(resolution_rad, _SMALLEST_RESOLUTION_RAD)
    moved = first[:, :count].std(axis=1).max()
    return (lag, count) if mean_square[best] <= largest_rad ** 2 and moved >= _REPEAT_MOTION \
        else None


def angle_error_filter(comparison: BaselineComparison, axis: int) -> AngleErrorFilter | None:
    """
    Return the filter for one axis of a recording, by the Riccati recursion of the Kalman filter.

    None where the errors of angles are 0.
    """
    variance_v2, remembered_v2 = np.zeros(len(comparison)), np.zeros(len(comparison))
    for part_v2, memory in _angle_errors(comparison, axis):
        variance_v2 += part_v2
        remembered_v2 += part_v2 * memory
    if not variance_v2.any():
        return None
    pole, analog_v = _analog(comparison, axis)
    noise_v2 = analog_v ** 2 * (1 - pole ** 2) \
        + comparison.sensor.lsb_v ** 2 / 12 * (1 + pole ** 2)
    memories = np.divide(remembered_v2, variance_v2, where=variance_v2 > 0,
                         out=np.ones(len(comparison)))
    std_v = np.sqrt(variance_v2)
    rows, variance, previous_v = [], 1.0, float(std_v[0])
    for g, phi in zip(std_v.tolist(), memories.tolist()):
        renewal2 = 1 - phi * phi
        weight = g * phi - pole * previous_v
        total_v2 = weight * weight * variance + g * g * renewal2 + noise_v2
        gain = (phi * weight * variance + g * renewal2) / total_v2
        rows.append((phi - gain * weight, gain, weight, sqrt(noise_v2 / total_v2)))
        variance = phi * phi * variance + renewal2 - gain * gain * total_v2
        previous_v = g
    return AngleErrorFilter(float(np.sqrt(np.mean(variance_v2))), pole, *np.array(rows).T)


def _analog(comparison: BaselineComparison, axis: int) -> tuple[float, float]:
    """Return pole of the RC filter and standard deviation of the analog noise, V."""
    rc_s = float(noise.electronics(comparison.sensor).rc_s[axis])
    return (float(np.exp(-comparison.dt_s / rc_s)) if rc_s else 0.0,
            max(float(noise.analog_std_v(comparison.sensor)[axis]), _LOWEST_NOISE_V))


def _angle_errors(comparison: BaselineComparison, axis: int
                  ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield variance, V², and memory from sample to sample, (n,) each, of errors of angles."""
    sensor, time_s, joints = comparison.sensor, comparison.time_s, comparison.joints or ()
    slopes = gravity_slopes(*(joint(time_s) for joint in joints))[:, axis] if joints else ()
    for joint, slope in zip(joints, slopes):
        errors = joint.errors(time_s) if isinstance(joint, CachedPath) else None
        if errors is not None:
            # An error that grows, after a move, is a new one.
            memory = np.exp(-errors.forgetting_per_s * comparison.dt_s)
            memory[1:] *= np.minimum(errors.std[:-1] / errors.std[1:], 1.0)
            v_per_rad = slope * sensor.scale_v_per_g[axis] * sensor.local_gravity_mps2 / G0_MPS2
            yield (v_per_rad * errors.std) ** 2, memory
    force = comparison.motion.force
    if isinstance(force, ForcePath) and force.is_robot:
        errors = force.errors(time_s, AXES.index(sensor.axes[axis]))
        v_per_mps2 = sensor.scale_v_per_g[axis] / G0_MPS2
        yield (v_per_mps2 * errors.std) ** 2, np.exp(-errors.forgetting_per_s * comparison.dt_s)


def drift_effects() -> tuple[str, ...]:
    """Return the names of the effects that let the zero-g drift."""
    return tuple(e.name for e in library().values() if e.diagnosis.drift)


def whiteners(comparisons: Sequence[BaselineComparison]) -> list[list[Whitener]]:
    """Return the filters that are tried for the noise of each axis of each recording."""
    return [_whiteners(c, axis) for c in comparisons for axis in range(len(c.sensor.axes))]


def _whiteners(comparison: BaselineComparison, axis: int) -> list[Whitener]:
    sensor, dt_s, span_s = comparison.sensor, comparison.dt_s, comparison.span_s
    errors, scale = angle_error_filter(comparison, axis), float(sensor.scale_v_per_g[axis])
    a, std_v = _analog(comparison, axis)
    step_v2 = sensor.lsb_v ** 2 / 12
    by_spectrum = {effect_named(e).diagnosis.drift: e for e in drift_effects()}
    # Sections, effect and density of each filter.
    filters: list[tuple[np.ndarray, str, float]] = []
    pole, difference = np.array([1, -a]), np.array([1, -1.0])
    for density in RANDOM_WALKS_G_PER_RTS:
        spectrum = (std_v ** 2 * (1 - a * a) * _power(difference, 2)
                    + step_v2 * _power(np.convolve(pole, difference), 2)
                    + (density * scale) ** 2 * dt_s * _power(pole, 2))
        filters.append((scipy.signal.tf2sos(np.convolve(pole, difference),
                                            _spectral_factor(spectrum, 2)),
                        by_spectrum[DriftSpectrum.RANDOM_WALK], density))
    # Noise and ADC steps without drift are an ARMA(1, 1) sequence; this is the zero of its MA.
    zero = -_spectral_factor(std_v ** 2 * (1 - a * a) * _power(np.ones(1), 1)
                             + step_v2 * _power(pole, 1), 1)[1]
    white_v2_per_hz = 2 * dt_s * (std_v ** 2 * (1 + a) / (1 - a) + step_v2)
    for density in FLICKERS_G_PER_RTHZ:
        corner_hz = (density * scale) ** 2 / white_v2_per_hz
        top_hz = min(corner_hz, _TOP_OF_RATE / dt_s)
        # Zeros and poles, one pair a decade from the corner down: the gain of the filter rises
        # with the root of the frequency.
        decades = np.arange(int(np.ceil(max(np.log10(top_hz * span_s), 0.0))))
        corners = 2 * np.pi * dt_s * top_hz * 10.0 ** -decades
        filters.append((scipy.signal.zpk2sos(
            [a, *np.exp(-corners * 10 ** -0.5)], [zero, *np.exp(-corners)], 1.0),
            by_spectrum[DriftSpectrum.FLICKER], density))
        if corner_hz > top_hz:
            break
    largest = np.inf if errors is None else errors.rms_v / scale
    made = [Whitener(sections, -0.5 * (np.log10(density / _USUAL_DENSITY) / _DENSITY_DECADES) ** 2,
                     effect, density) for sections, effect, density in filters]
    return [replace(f, errors=errors) if f.healthy or f.density < largest else f for f in made]


def expected_drift_g(spectrum: DriftSpectrum, density: float, span_s: float, rate_hz: float
                     ) -> float:
    """Return the expected rms of a drift about its mean over a recording."""
    if spectrum is DriftSpectrum.RANDOM_WALK:
        return float(density * np.sqrt(span_s / 6))
    return float(density * np.sqrt(np.log(rate_hz / 2 * span_s)))


def _power(polynomial: np.ndarray, order: int) -> np.ndarray:
    """Return the coefficients of |p(L)|², of the powers of L from −order to order."""
    square = np.convolve(polynomial, polynomial[::-1])
    return np.pad(square, order - (len(polynomial) - 1))


def _spectral_factor(spectrum: np.ndarray, order: int) -> np.ndarray:
    """Return the monic polynomial with all roots inside the unit circle and this spectrum."""
    trimmed = np.trim_zeros(np.where(np.abs(spectrum) > 1e-14 * spectrum.max(), spectrum, 0.0))
    roots = np.roots(trimmed)
    inside = roots[np.argsort(np.abs(roots))[:len(roots) // 2]]
    factor = np.atleast_1d(np.real(np.poly(inside)))
    return np.pad(factor, (0, order + 1 - len(factor)))
