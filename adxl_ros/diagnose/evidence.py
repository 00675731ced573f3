# SPDX-License-Identifier: Apache-2.0
"""
The noise of a healthy unit and of its reference, and the evidence of linear models beside it.

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
filter predicts g·u; its innovations, scaled, have the spectrum of (1 − aL)·n. Where g is 0, they
are (1 − aL)·y. Rounding that the noise does not hide is such an error, too: it stays until the
output has moved.

A hypothesis is a set of columns, which are whitened sensitivities of the simulated output. The
coefficients have normal priors. The evidence integrates the coefficients out (Bishop 2006,
section 3.5), so that an effect that the recording hardly shows gains nothing and costs nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, repeat
from math import sqrt
from typing import NamedTuple

from adxl_ros.diagnose.comparison import BaselineComparison, bridged, gravity_slopes
from adxl_ros.model import noise
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.effects import effect_named, library
from adxl_ros.model.effects.base import Coefficient, DriftSpectrum, Role
from adxl_ros.model.sensor import parameter_of, Sensor
from adxl_ros.signals.block_statistics import true_runs
from adxl_ros.simulate.smoothed_path import SmoothedPath
import numpy as np
import scipy

_REST_S = 1.0
"""Length of a rest whose mean is subtracted, s. Chosen: slower changes are part of the gap."""
_PARTS_OF_REST = 4
"""Parts of a rest, for the interval of the noise. Chosen: longer than its samples correlate."""
_FEWEST_PARTS = 20
"""Parts from which an interval is drawn. Chosen: they show their spread to 16 %."""
_MOST_PARTS = 100  # Largest number of parts that are drawn. Chosen: run time
FEWEST_SAMPLES = 200  # Fewest samples of an estimate. Chosen: 5 % of the standard deviation
_REPEAT_SHORTEST_S = 20.0  # Shortest repeat of a trajectory, s. Chosen: a few moves
_REPEAT_DELAY_S = 10.0
"""Smallest delay of a repeat in the same recording, s. Chosen: beyond the correlation of a move
with itself."""
_REPEAT_STEPS = 5.0
"""Largest rms angle between two repeats, in steps of the encoder. Chosen."""
_SMALLEST_RESOLUTION_RAD = 1e-5  # Smallest such step, rad. Chosen: 0.01 mg
_REPEAT_MOTION = 0.05
"""Smallest standard deviation of the direction of gravity in a repeat, rad. Chosen: 50 mg, from
which an axis is compared, too."""
RANDOM_WALKS_G_PER_RTS = (1e-7, 1e-5, 3e-5, 7e-5, 1.5e-4, 4e-4, 1e-3, 3e-3)
"""Grid of densities of a random walk, g/√s, a factor of two to three apart."""
FLICKERS_G_PER_RTHZ = (6e-5, 1.5e-4, 5e-4, 1.5e-3, 4e-3)
"""Grid of densities of 1/f noise at 1 Hz, g/√Hz, a factor of three apart."""
_USUAL_DENSITY = 1e-5  # Usual density of both drifts, in their units. Chosen: 0.1 mg within 100 s
_DENSITY_DECADES = 1.0
"""Prior standard deviation of its logarithm, decades. Chosen: units differ by a factor of ten."""
_LOWEST_NOISE_V = 1e-7
"""Smallest standard deviation of the noise, V, because whitening needs noise. Chosen: below that
of any ADC."""
_TOP_OF_RATE = 0.25
"""Highest corner frequency of 1/f noise, divided by the sample rate. Chosen: half of Nyquist."""
BLOCKS = 48
"""Number of blocks of a recording, of which some are held out. Chosen: a multiple of the folds,
and blocks of a few seconds in a short recording."""
_ITERATIONS = 3
"""Iterations over coefficients and noise. Chosen: the filters no longer change then."""
_SMALLEST_SQUARES_V2 = 1e-300  # Smallest sum of squares, V², whose logarithm is taken: above zero
_RIDGE = 1e-12
"""Ridge on the scaled precision. Chosen: columns that differ by a millionth are separable."""
_ROUNDING_FORGETS = 6.0
"""How fast rounding forgets its error, per step of the output. Derived: the autocovariance of a
sawtooth of variance 1 is 1 − 6·x + 6·x² after x steps."""
UNDETERMINED_SHARE = 0.5
"""A coefficient is not determined if its posterior standard deviation exceeds this share of the
prior's. Chosen: three quarters of the precision are then of the samples."""
_UNDETERMINED_RATIO = 3.0
"""Nor is it by some blocks if it exceeds that of all blocks by this factor. Chosen: with a quarter
of the samples less it usually exceeds it by 15 %."""


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


class PartSquares(NamedTuple):
    """The squares of a part of a recording."""

    squares_v2: np.ndarray  # Sum by axis, V², (m,)
    samples: int


def estimate_floor(comparisons: Sequence[BaselineComparison]) -> NoiseFloor:
    """
    Estimate the noise floor from rests, else from repeats, else from the parameter file.

    The noise at rest is that about the mean of each second. The mean square of the encoder's steps
    is added: step²/12 times the squared slope of gravity, or what they leave open of a robot. So
    is the rounding that no rest shows.
    """
    sums: list[PartSquares] = []
    for c in comparisons:
        sums += squares_at_rest(c.volts, c.at_rest & c.used, c.sensor)
    source, scale_v_per_mps2 = 'still', comparisons[0].scale_v_per_mps2
    if sum(part.samples for part in sums) < FEWEST_SAMPLES:
        sums, source = _repeat_squares(comparisons), 'repeats'
    count = sum(part.samples for part in sums)
    if count < FEWEST_SAMPLES:
        sums, noise_v, source = [], noise.sample_std_v(comparisons[0].sensor), 'assumed'
    else:
        noise_v = np.sqrt(np.sum([squares_v2 for squares_v2, _ in sums], axis=0) / count)
    unknown = np.mean([encoder_error_mps2(c) ** 2 for c in comparisons])
    if source == 'still':
        unknown += np.mean(held_rounding_v2(comparisons[0].sensor) / scale_v_per_mps2**2)
    rows = [
        (np.mean(squares_v2 / scale_v_per_mps2**2) + count * unknown, count)
        for squares_v2, count in sums
    ]
    rms_mps2 = np.sqrt(np.mean((noise_v / scale_v_per_mps2) ** 2) + unknown)
    return NoiseFloor(noise_v, float(rms_mps2), source, np.reshape(rows, (-1, 2)).T)


def encoder_error_mps2(comparison: BaselineComparison) -> float:
    """Return the rms over samples and axes that the steps of encoders leave open."""
    if comparison.joints is None:
        return comparison.robot_error_mps2
    sensor, used = comparison.sensor, comparison.used
    slopes = gravity_slopes(*comparison.joint_values())[:, : len(sensor.axes), used]
    squares = (slopes**2).sum(axis=0).mean()
    return float(sensor.local_gravity_mps2 * sensor.stage_std_rad * np.sqrt(squares))


def squares_at_rest(volts: np.ndarray, at_rest: np.ndarray, sensor: Sensor) -> list[PartSquares]:
    """Sum the squares of an output, V, (n, m), about the mean of each second at rest."""
    length = max(round(_REST_S * sensor.rate_hz), 4)
    # The mean of correlated samples takes more out of their variance than one sample.
    independent = length / float(noise.effective_samples(length, 1 / sensor.rate_hz, sensor.rc_s))
    squares: list[PartSquares] = []
    for begin, end in true_runs(at_rest):
        for first in range(begin, end - length + 1, length):
            part = volts[first : first + length]
            squares_v2 = (part - part.mean(axis=0)) ** 2 * length / (length - independent)
            squares += [
                PartSquares(piece.sum(axis=0), len(piece))
                for piece in np.array_split(squares_v2, _PARTS_OF_REST)
            ]
    return squares


def _repeat_squares(comparisons: Sequence[BaselineComparison]) -> list[PartSquares]:
    """Return half the squares of the differences between repeats of a trajectory on the stage."""
    staged = [
        (c, force)
        for c in comparisons
        if c.joints and (force := c.reference_force_g()) is not None
    ]
    squares: list[PartSquares] = []
    for i, (first, force) in enumerate(staged):
        for second, other in staged[i:]:
            rate_hz = first.sensor.rate_hz
            if abs(rate_hz / second.sensor.rate_hz - 1) > 1e-3:
                continue
            found = find_repeat(
                force, other, rate_hz, first.sensor.stage_resolution_rad, first is second
            )
            if found is None:
                continue
            lag, count = found
            used = first.used[:count] & second.used[lag : lag + count]
            difference_v = (
                second.residual_v(second.sensor)[lag : lag + count]
                - first.residual_v(first.sensor)[:count]
            )[used]
            squares_v2 = (difference_v - difference_v.mean(axis=0)) ** 2 / 2
            length = max(round(_REST_S * rate_hz), 1)
            squares += [
                PartSquares(part.sum(axis=0), len(part))
                for part in np.split(squares_v2, range(length, len(squares_v2), length))
            ]
    return squares


class Repeat(NamedTuple):
    """A part of a trajectory that is repeated later."""

    lag: int  # How much later, samples
    samples: int  # Length of the part


def find_repeat(
    first: np.ndarray,
    second: np.ndarray,
    rate_hz: float,
    resolution_rad: float,
    same_recording: bool,
) -> Repeat | None:
    """
    Find the lag, and its overlap, by which the directions of gravity in two recordings agree best.

    first, second: direction of gravity in the sensor's frame, unit vectors, (3, n) and (3, n').
    """
    products = sum(scipy.signal.correlate(b, a, method='fft') for a, b in zip(first, second))
    lags = scipy.signal.correlation_lags(second.shape[1], first.shape[1])
    overlap = np.minimum(first.shape[1], second.shape[1] - lags)
    tried = (lags >= _REPEAT_DELAY_S * rate_hz * same_recording) & (
        overlap >= _REPEAT_SHORTEST_S * rate_hz
    )
    if not tried.any():
        return None
    # |a − b|² of unit vectors is 2 − 2·a·b.
    mean_square = np.where(tried, 2 - 2 * products / np.maximum(overlap, 1), np.inf)
    best = int(np.argmin(mean_square))
    lag, count = int(lags[best]), int(overlap[best])
    largest_rad = _REPEAT_STEPS * max(resolution_rad, _SMALLEST_RESOLUTION_RAD)
    moved = first[:, :count].std(axis=1).max()
    is_same = mean_square[best] <= largest_rad**2
    return Repeat(lag, count) if is_same and moved >= _REPEAT_MOTION else None


@dataclass(frozen=True)
class AngleErrorFilter:
    """A filter (1 − aL) for noise with errors of angles, as if it were without them."""

    rms_v: float  # Rms of the errors, V
    pole: float  # Pole a of the noise
    transition: np.ndarray  # Factor of the estimate of u from sample to sample, (n,)
    gain: np.ndarray  # Gain of the estimate of u, 1/V, (n,)
    weight: np.ndarray  # Change of the predicted sample by the estimate of u, V, (n,)
    scale: np.ndarray  # Standard deviation of the noise divided by that of the innovation, (n,)

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Filter k series, (k, n)."""
        lower = np.ones((2, len(self.gain)), order='F')
        lower[1, :-1] = -self.transition[1:]
        out = np.empty(values.shape)
        # One by one they stay in the cache.
        for series, filtered in zip(values, out):
            changes = without_pole(series, self.pole)
            changes[0] = 0.0
            estimates = scipy.linalg.lapack.dtbtrs(
                lower, changes * self.gain, uplo='L', diag='U', overwrite_b=True
            )[0]
            changes[1:] -= estimates[:-1] * self.weight[1:]
            np.multiply(changes, self.scale, out=filtered)
            filtered[0] = series[0]
        return out


def without_pole(values: np.ndarray, pole: float) -> np.ndarray:
    """Filter series, (..., n), by 1 − aL; the first values stay."""
    out = values.copy()
    out[..., 1:] -= pole * values[..., :-1]
    return out


@dataclass(frozen=True)
class Whitener:
    """A filter that makes noise white."""

    sections: np.ndarray  # Second-order sections behind the filter 1 − aL, (s, 6)
    effect: str  # Name of the drift effect that the filter is for
    density: float  # Density of the drift, in the unit of the effect's parameter
    # The same that the noise has whose innovations have a standard deviation of 1 V
    density_per_v: float = 0.0
    pole: float = 0.0  # Pole a of the noise
    # Filter 1 − aL for the errors of angles and rounding; None where there are none, or where the
    # drift exceeds them: they would take up a part of it
    errors: AngleErrorFilter | None = None

    @property
    def log_prior(self) -> float:
        """Log prior probability of such noise, up to a constant."""
        return -0.5 * float(np.log10(self.density / _USUAL_DENSITY) / _DENSITY_DECADES) ** 2

    @property
    def healthy(self) -> bool:
        """Whether a unit without the effect may drift as much."""
        return self.density <= effect_named(self.effect).diagnosis.healthy_density


def _angle_error_filter(
    comparison: BaselineComparison, axis: int, usual: _UsualNoise
) -> AngleErrorFilter | None:
    """
    Return the filter for one axis by the Riccati recursion of the Kalman filter.

    None where the errors of angles are 0.
    """
    variance_v2, remembered_v2 = np.zeros(len(comparison)), np.zeros(len(comparison))
    for part_v2, memory in _angle_errors(comparison, axis):
        variance_v2 += part_v2
        remembered_v2 += part_v2 * memory
    if not variance_v2.any():
        return None
    pole = usual.pole
    noise_v2 = usual.std_v**2 * (1 - pole**2) + usual.step_v2 * (1 + pole**2)
    memories = np.divide(
        remembered_v2, variance_v2, where=variance_v2 > 0, out=np.ones(len(comparison))
    )
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


def _angle_errors(
    comparison: BaselineComparison, axis: int
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield variance, V², and memory from sample to sample, (n,) each, of angles and rounding."""
    sensor, time_s, joints = comparison.sensor, comparison.time_s, comparison.joints or ()
    slopes = gravity_slopes(*comparison.joint_values())[:, axis] if joints else ()
    for joint, slope in zip(joints, slopes):
        if isinstance(joint, SmoothedPath) and (errors := joint.errors(time_s)) is not None:
            # An error that grows, after a move, is a new one.
            memory = np.exp(-errors.forgetting_per_s * comparison.dt_s)
            memory[1:] *= np.minimum(errors.std[:-1] / errors.std[1:], 1.0)
            v_per_rad = slope * sensor.scale_v_per_g[axis] * sensor.local_gravity_mps2 / G0_MPS2
            yield (v_per_rad * errors.std) ** 2, memory
    robot = comparison.robot_force
    if robot is not None:
        errors = robot.errors(time_s, AXES.index(sensor.axes[axis]))
        v_per_mps2 = sensor.scale_v_per_g[axis] / G0_MPS2
        yield (v_per_mps2 * errors.std) ** 2, np.exp(-errors.forgetting_per_s * comparison.dt_s)
    held_v2 = held_rounding_v2(sensor)[axis]
    if held_v2:
        output_v = comparison.simulated_v(sensor)[:, axis]
        moved = np.abs(np.diff(output_v, prepend=output_v[0]))
        moved /= noise.electronics(sensor).lsb_v[axis]
        yield np.full(len(time_s), held_v2), np.exp(-_ROUNDING_FORGETS * moved)


def held_rounding_v2(sensor: Sensor) -> np.ndarray:
    """Return the mean square of the rounding that stays while the output stays, V², (m,)."""
    return noise.held_rounding(sensor) * noise.electronics(sensor).lsb_v ** 2 / 12


def whiteners(comparison: BaselineComparison, axis: int) -> list[Whitener]:
    """Return the filters that are tried for the noise of an axis of a recording."""
    sensor = comparison.sensor
    scale = float(sensor.scale_v_per_g[axis])
    rc_s, _, lsb_v = (float(values[axis]) for values in noise.electronics(sensor))
    usual = _UsualNoise(
        dt_s=comparison.dt_s,
        pole=float(np.exp(-comparison.dt_s / rc_s)) if rc_s else 0.0,
        std_v=max(float(noise.analog_std_v(sensor)[axis]), _LOWEST_NOISE_V),
        step_v2=lsb_v**2 / 12 - float(held_rounding_v2(sensor)[axis]),
    )
    by_spectrum = {effect_named(e).diagnosis.drift: e for e in drifts_among(library())}
    filters = []
    for density in RANDOM_WALKS_G_PER_RTS:
        sections, innovation_v = usual.without_walk(density * scale)
        effect = by_spectrum[DriftSpectrum.RANDOM_WALK]
        filters.append(Whitener(sections, effect, density, density / innovation_v, usual.pole))
    for density in FLICKERS_G_PER_RTHZ:
        sections, innovation_v = usual.without_flicker(density * scale, comparison.span_s)
        shown = min(density, usual.largest_flicker_v / scale)
        effect = by_spectrum[DriftSpectrum.FLICKER]
        filters.append(Whitener(sections, effect, density, shown / innovation_v, usual.pole))
        if usual.corner_hz(density * scale) > usual.highest_corner_hz:
            break
    errors = _angle_error_filter(comparison, axis, usual)
    largest = np.inf if errors is None else errors.rms_v / scale
    return [replace(f, errors=errors) if f.healthy or f.density < largest else f for f in filters]


@dataclass(frozen=True)
class _UsualNoise:
    """The noise of one axis without drift: white noise behind an RC filter, and ADC steps."""

    dt_s: float  # Time between samples, s
    pole: float  # Pole of the RC filter
    std_v: float  # Standard deviation of the analog noise, V
    step_v2: float  # Mean square of the steps, V²

    @property
    def highest_corner_hz(self) -> float:
        """Return the highest corner of 1/f noise that a filter has, Hz."""
        return _TOP_OF_RATE / self.dt_s

    @property
    def _density_v2_per_hz(self) -> float:
        """Return the density at low frequencies, V²/Hz."""
        analog_v2 = self.std_v**2 * (1 + self.pole) / (1 - self.pole)
        return 2 * self.dt_s * (analog_v2 + self.step_v2)

    @property
    def largest_flicker_v(self) -> float:
        """Return the density of the 1/f noise that has the highest corner, V/√Hz at 1 Hz."""
        return sqrt(self.highest_corner_hz * self._density_v2_per_hz)

    def corner_hz(self, density_v: float) -> float:
        """Return the frequency at which 1/f noise, V/√Hz at 1 Hz, is as dense as this one, Hz."""
        return density_v**2 / self._density_v2_per_hz

    def without_walk(self, density_v: float) -> tuple[np.ndarray, float]:
        """Return what whitens noise with a random walk, V/√s, behind 1 − aL; and its std, V."""
        pole, difference = np.array([1, -self.pole]), np.array([1, -1.0])
        both = np.convolve(pole, difference)
        spectrum = (
            self.std_v**2 * (1 - self.pole**2) * _power(difference, 2)
            + self.step_v2 * _power(both, 2)
            + density_v**2 * self.dt_s * _power(pole, 2)
        )
        factor = _spectral_factor(spectrum, 2)
        sections = np.array([[*difference, 0.0, *factor]])
        return sections, sqrt(spectrum[2] / np.sum(factor**2))

    def without_flicker(self, density_v: float, span_s: float) -> tuple[np.ndarray, float]:
        """Return what whitens noise with 1/f noise, V/√Hz at 1 Hz, behind 1 − aL; and its std."""
        # Noise and steps without drift are an ARMA(1, 1) sequence; this is the zero of its MA.
        spectrum = self.std_v**2 * (1 - self.pole**2) * _power(np.ones(1), 1)
        spectrum += self.step_v2 * _power(np.array([1, -self.pole]), 1)
        factor = _spectral_factor(spectrum, 1)
        zero, innovation_v = -factor[1], sqrt(spectrum[1] / np.sum(factor**2))
        # Zeros and poles, one pair a decade from the corner down: the gain of the filter rises
        # with the root of the frequency.
        top_hz = min(self.corner_hz(density_v), self.highest_corner_hz)
        decades = np.arange(int(np.ceil(max(np.log10(top_hz * span_s), 0.0))))
        corners = 2 * np.pi * self.dt_s * top_hz * 10.0**-decades
        poles, zeros = [0.0, *np.exp(-corners * 10**-0.5)], [zero, *np.exp(-corners)]
        return scipy.signal.zpk2sos(poles, zeros, 1.0), innovation_v


def expected_drift_g(effect: str, density: float, comparison: BaselineComparison) -> float:
    """Return the expected rms of a drift about its mean over a recording."""
    if effect_named(effect).diagnosis.drift is DriftSpectrum.RANDOM_WALK:
        return float(density * np.sqrt(comparison.span_s / 6))
    return float(density * np.sqrt(np.log(comparison.sensor.rate_hz / 2 * comparison.span_s)))


def _power(polynomial: np.ndarray, order: int) -> np.ndarray:
    """Return the coefficients of |p(L)|², of the powers of L from −order to order."""
    return np.pad(np.convolve(polynomial, polynomial[::-1]), order - (len(polynomial) - 1))


def _spectral_factor(spectrum: np.ndarray, order: int) -> np.ndarray:
    """Return the monic polynomial with all roots inside the unit circle and this spectrum."""
    trimmed = np.trim_zeros(np.where(np.abs(spectrum) > 1e-14 * spectrum.max(), spectrum, 0.0))
    roots = np.roots(trimmed)
    inside = roots[np.argsort(np.abs(roots))[: len(roots) // 2]]
    factor = np.atleast_1d(np.real(np.poly(inside)))
    return np.pad(factor, (0, order + 1 - len(factor)))


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
    grams, total_grams, log_scales = [], [], []
    for whitener, rows, known in zip(filters, white_rows(design, used, filters), also):
        white = rows if known is None else np.concatenate([rows, known])
        grams.append(block_grams(white) if by_block else np.zeros((0, 0, 0)))
        total_grams.append(grams[-1].sum(axis=0) if by_block else white @ white.T)
        # The log determinant of the filter for errors, sample by sample.
        scale = np.ones(len(used)) if whitener.errors is None else whitener.errors.scale
        log_scales.append(sum_by_block(np.where(used, np.log(scale), 0.0)))
    return WhitenedChannel(
        column_ids,
        np.array(grams),
        np.array(total_grams),
        sum_by_block(used),
        np.array(log_scales),
        np.array([f.log_prior for f in filters]),
        np.array(['' if f.healthy else f.effect for f in filters]),
    )


def white_rows(
    design: np.ndarray, used: np.ndarray, filters: Sequence[Whitener]
) -> Iterator[np.ndarray]:
    """Yield k columns, (n, k), whitened by each filter, (k, n); 0 where they are not used."""
    data = np.ascontiguousarray(bridged(design, used).T, float)
    # Filters share that for errors of angles, which is applied once.
    shared = {id(f.errors): f.errors for f in filters}
    pole = filters[0].pole
    before = {k: without_pole(data, pole) if e is None else e(data) for k, e in shared.items()}
    # The first sample is a step from zero.
    counted = used.copy()
    counted[0] = False
    for whitener in filters:
        white = scipy.signal.sosfilt(whitener.sections, before[id(whitener.errors)])
        white *= counted
        yield white


def sum_by_block(values: np.ndarray) -> np.ndarray:
    """Return the sums of values, (n,), or how many of them are True, by block, (blocks,)."""
    return np.add.reduceat(values, block_edges(len(values))[:-1]).astype(float)


def plain_grams(columns: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return the products of k columns, (n, k), over used samples, by block, (blocks, k, k)."""
    edges = pairwise(block_edges(len(used)).tolist())
    parts = (columns[a:b].T * used[a:b] for a, b in edges)
    return np.array([part @ part.T for part in parts])


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

    def loss(self, values: np.ndarray) -> float:
        """
        Return how far the log posterior at values of the first coefficients is below its top.

        The other coefficients are at their conditional maximum.
        """
        count = len(values)
        std = np.sqrt(np.diag(self.covariance)[:count])
        deviation = (values - self.values[:count]) / std
        correlation = self.covariance[:count, :count] / std / std[:, None]
        return 0.5 * float(
            deviation @ np.linalg.solve(correlation + _RIDGE * np.eye(count), deviation)
        )


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
    variance_v2 = np.array(
        [channel.grams[f, 0, 0] / channel.count for channel, f in zip(selected, filters)]
    )
    prior_precision = prior_std[ids] ** -2.0
    for _ in range(_ITERATIONS):
        posterior = _Posterior.of(selected, filters, variance_v2, prior_precision)
        for i, channel in enumerate(selected):
            squares_v2 = channel.squares_v2(posterior.mean)
            log_likelihood = -channel.count / 2 * np.log(squares_v2) + channel.log_scales
            filters[i] = int(np.argmax(log_likelihood + channel.log_priors))
            variance_v2[i] = squares_v2[filters[i]] / channel.count
    log_evidence = posterior.log_occam_factor(prior_precision)
    for channel, variance, f in zip(selected, variance_v2, filters):
        log_evidence += channel.log_likelihood(f, variance)
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
        if blocks is None:
            grams, chosen = channel.total_grams, np.ones(BLOCKS, bool)
        else:
            grams, chosen = channel.block_grams[:, blocks].sum(axis=1), blocks
        allowed = np.isin(channel.drift_effects, ('', *drifts))
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
        precision, information = np.diag(prior_precision), np.zeros(len(prior_precision))
        for channel, f, variance in zip(channels, filters, variance_v2):
            places = channel.places
            precision[np.ix_(places, places)] += channel.grams[f, 1:, 1:] / variance
            information[places] += channel.grams[f, 1:, 0] / variance
        size = 1 / np.sqrt(np.diag(precision))
        scaled = precision * size[:, None] * size + _RIDGE * np.eye(len(size))
        factor = np.linalg.cholesky(scaled)
        return cls(size * scipy.linalg.cho_solve((factor, True), size * information), size, factor)

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
            range(len(self.names)),
            self.prior_std,
            blocks,
            drifts=(*drifts, *drifts_among(self.sensor.effects)),
        )

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
        kept = np.array(
            [
                not p.is_size or bool(effect_named(name.effect).limits)
                for p, name in zip(parameters, self.names)
            ],
            bool,
        )
        is_shape = np.array([p.role is Role.SHAPE for p in parameters], bool)
        fitted = self.prior_mean[:j] + fit.values[:j]
        values = np.where(undetermined & kept, self.values, fitted)
        values = np.where(
            is_shape, np.clip(values, *np.sort([self.values / 2, self.values * 2], axis=0)), values
        )
        given = np.concatenate([values != fitted, np.zeros(len(self.reach), bool)])
        target = np.concatenate([values - self.prior_mean[:j], np.zeros(len(self.reach))])
        departures = fit.given(np.flatnonzero(given), target[given])
        if full_fit is None:
            return departures
        is_open = (
            np.diag(fit.covariance)[j:] > _UNDETERMINED_RATIO**2 * np.diag(full_fit.covariance)[j:]
        )
        nuisance = np.clip(
            np.where(is_open, full_fit.values[j:], departures[j:]), -self.reach, self.reach
        )
        given[j:], target[j:] = nuisance != departures[j:], nuisance
        return fit.given(np.flatnonzero(given), target[given])
