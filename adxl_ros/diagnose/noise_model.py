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

Errors of followed angles, and rounding to codes coarser than the noise, are constant at rest and
new after each move (errors in variables; Fuller 1987). The model is y = n + g·u. Here n is noise
behind the RC filter, AR(1) with pole a, u has variance 1, u_t = φ_t·u_(t−1) + √(1 − φ_t²)·ξ_t, and
g is its standard deviation in V. A Kalman filter predicts g·u; its innovations, scaled and
filtered by 1/(1 − aL), have the spectrum of n. Where g is 0, samples stay as they are.

Motion that a smooth reference lacks adds to the noise in motion. Its spectrum is that of the part
of the recording that no linear filter of the reference predicts (multiple coherence; Bendat and
Piersol 2010, section 7.3). A filter of the smallest phase gives such noise the spectrum of noise
alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import sqrt

from adxl_ros.diagnose.comparison import BaselineComparison, CachedPath, Reference
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.diagnosis_hints import DriftSpectrum
from adxl_ros.model.effects import effect_named, library
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.block_statistics import true_runs
import numpy as np
import scipy

_REST_S = 1.0
"""Length of a rest whose mean is subtracted, s. Chosen: slower changes are part of the gap."""
_PARTS_OF_REST = 4
"""Parts into which a rest is divided for the interval of the noise. Chosen: a part is longer than
the correlation of its samples."""
_MOST_PARTS = 100
"""Parts from which an interval is drawn at most. Chosen: 100 parts show their spread to 7 %."""
_FEWEST_PARTS = 20
"""Fewest parts of an interval. Chosen: 20 parts show their spread to 16 %."""
FEWEST_SAMPLES = 200
"""Fewest samples of an estimate. Chosen: 5 % of the standard deviation."""
_REPEAT_SHORTEST_S = 20.0
"""Shortest repeat of a trajectory, s. Chosen: a few moves."""
_REPEAT_DELAY_S = 10.0
"""Smallest delay of a repeat in the same recording, s. Chosen: beyond the correlation of a move
with itself."""
_REPEAT_STEPS = 5.0
"""Largest rms angle between the directions of two repeats, in steps of the encoder. Chosen:
several times the rounding of both."""
_RATE_TOLERANCE = 1e-3
"""Largest relative difference of the sample rates of two repeats. Chosen: 20 ms in 20 s."""
_SMALLEST_RESOLUTION_RAD = 1e-5
"""Smallest step of the encoder that is assumed for repeats, rad. Chosen: rounding errors of
stated angles."""
_REPEAT_MOTION = 0.05
"""Smallest standard deviation of the direction of gravity in a repeat, rad. Chosen: above the
changes of a rest."""


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
        """
        Return the floor from parts drawn with replacement.

        returns: rms, m/s², (n,); None where the floor is assumed, or from a few parts.
        """
        count = self.parts.shape[1]
        if count < _FEWEST_PARTS:
            return None
        edges = np.linspace(0, count, min(count, _MOST_PARTS) + 1).astype(int)[:-1]
        squares, samples = np.add.reduceat(self.parts, edges, axis=1)
        drawn = np.random.default_rng(seed).integers(0, len(edges), (draws, len(edges)))
        return np.sqrt(squares[drawn].sum(axis=1) / samples[drawn].sum(axis=1))


@dataclass(frozen=True)
class SquareSum:
    """A sum of squares and its number of samples."""

    squares_v2: np.ndarray  # Sum over samples by axis, V², (m,)
    count: int  # Number of samples


def estimate(comparisons: Sequence[BaselineComparison]) -> NoiseFloor:
    """
    Estimate the noise floor from rests, else from repeats, else from the parameter file.

    The noise at rest is that about the mean of each second. The mean square of the encoder's steps
    is added.
    """
    baseline = comparisons[0].sensor
    sums = [part for c in comparisons for part in squares_at_rest(
        c.volts, c.at_rest & c.used, c.sensor)]
    source = 'still'
    if sum(part.count for part in sums) < FEWEST_SAMPLES:
        sums, source = _repeat_squares(comparisons), 'repeats'
    count = sum(part.count for part in sums)
    if count < FEWEST_SAMPLES:
        sums, noise_v, source = [], noise.sample_std_v(baseline), 'assumed'
    else:
        noise_v = np.sqrt(np.sum([part.squares_v2 for part in sums], axis=0) / count)
    encoder = float(np.mean([_encoder_mean_square(c) for c in comparisons]))
    scale_v_per_mps2 = comparisons[0].scale_v_per_mps2
    parts = np.array([(np.mean(part.squares_v2 / scale_v_per_mps2 ** 2) + part.count * encoder,
                       part.count) for part in sums]).reshape(-1, 2).T
    noise_mps2 = noise_v / scale_v_per_mps2
    return NoiseFloor(noise_v, float(np.sqrt(np.mean(noise_mps2 ** 2) + encoder)), source, parts)


def _repeat_squares(comparisons: Sequence[BaselineComparison]) -> list[SquareSum]:
    """Return the squares of the differences between repeats of a trajectory on the stage."""
    staged = [c for c in comparisons if c.reference is Reference.STAGE]
    oriented = [np.array(specific_force(c.motion.alpha(c.time_s), c.motion.beta(c.time_s), 1.0))
                for c in staged]
    out: list[SquareSum] = []
    for i, first in enumerate(staged):
        for j, second in enumerate(staged[i:], i):
            rate_hz = first.sensor.rate_hz
            if abs(rate_hz / second.sensor.rate_hz - 1) > _RATE_TOLERANCE:
                continue
            repeat = find_repeat(oriented[i], oriented[j], rate_hz,
                                 first.sensor.stage_resolution_rad, i == j)
            if repeat is not None:
                used = first.used[repeat[0]] & second.used[repeat[1]]
                out += squares_of_difference(
                    first.residual_v(first.sensor)[repeat[0]][used],
                    second.residual_v(second.sensor)[repeat[1]][used], rate_hz)
    return out


def _encoder_mean_square(comparison: BaselineComparison) -> float:
    """
    Return the mean square that the steps of the encoder make, over samples and axes, (m/s²)².

    It is step²/12 times the squared slope of gravity.
    """
    motion, sensor = comparison.motion, comparison.sensor
    if comparison.reference is not Reference.STAGE or not sensor.stage_resolution_rad:
        return 0.0
    angles = (joint(comparison.time_s)[comparison.used] for joint in (motion.alpha, motion.beta))
    slopes = gravity_slopes(*angles)[:, :len(sensor.axes)]
    return float(sensor.local_gravity_mps2 ** 2 * sensor.stage_std_rad ** 2
                 * np.mean((slopes ** 2).sum(axis=0)))


def squares_at_rest(volts: np.ndarray, at_rest: np.ndarray, sensor: Sensor) -> list[SquareSum]:
    """
    Sum the squares about the mean of each second at rest.

    volts: output, V, (n, m); at_rest: samples that rest and are used, (n,) bool.
    """
    length = max(round(_REST_S * sensor.rate_hz), 4)
    # The mean of correlated samples takes more out of their variance than one sample.
    independent = length / float(noise.effective_samples(length, 1 / sensor.rate_hz,
                                                         sensor.rc_s))
    squares = []
    for begin, end in true_runs(at_rest):
        for first in range(begin, end - length + 1, length):
            part = volts[first:first + length]
            squares_v2 = (part - part.mean(axis=0)) ** 2 * length / (length - independent)
            squares += [SquareSum(piece.sum(axis=0), len(piece))
                        for piece in np.array_split(squares_v2, _PARTS_OF_REST)]
    return squares


def squares_of_difference(first_v: np.ndarray, second_v: np.ndarray, rate_hz: float
                          ) -> list[SquareSum]:
    """
    Sum half of the squares of the difference between two repeats.

    first_v, second_v: residuals of the same trajectory, V, (n, m).
    """
    difference_v = second_v - first_v
    squares_v2 = (difference_v - difference_v.mean(axis=0)) ** 2 / 2
    length = max(round(_REST_S * rate_hz), 1)
    return [SquareSum(part.sum(axis=0), len(part))
            for part in np.split(squares_v2, range(length, len(squares_v2), length))]


def find_repeat(first: np.ndarray, second: np.ndarray, rate_hz: float, resolution_rad: float,
                same_recording: bool) -> tuple[slice, slice] | None:
    """
    Find the shift by which the directions of gravity in two recordings agree best.

    first, second: direction of gravity in the sensor's frame, unit vectors, (3, n) and (3, n').
    """
    shortest = round(_REPEAT_SHORTEST_S * rate_hz)
    smallest_lag = round(_REPEAT_DELAY_S * rate_hz) if same_recording else 0
    size = 2 ** int(np.ceil(np.log2(first.shape[1] + second.shape[1])))
    products = np.fft.irfft((np.conj(np.fft.rfft(first, size))
                             * np.fft.rfft(second, size)).sum(axis=0), size)
    lags = np.arange(smallest_lag, max(second.shape[1] - shortest, smallest_lag))
    overlap = np.minimum(first.shape[1], second.shape[1] - lags)
    lags, overlap = lags[overlap >= shortest], overlap[overlap >= shortest]
    if not len(lags):
        return None
    # |a − b|² of unit vectors is 2 − 2·a·b.
    mean_square = 2 - 2 * products[lags] / overlap
    best = int(np.argmin(mean_square))
    lag, count = int(lags[best]), int(overlap[best])
    moved = first[:, :count].std(axis=1).max()
    if mean_square[best] > (_REPEAT_STEPS * max(resolution_rad, _SMALLEST_RESOLUTION_RAD)) ** 2 \
            or moved < _REPEAT_MOTION:
        return None
    return slice(0, count), slice(lag, lag + count)


def gravity_slopes(alpha_rad: np.ndarray, beta_rad: np.ndarray) -> np.ndarray:
    """
    Return the derivatives of the direction of gravity by the angles of the stage.

    alpha_rad, beta_rad: angles of the stage, rad, (n,); returns: by angle and component in the
    sensor's frame, 1/rad, (2, 3, n).
    """
    sin_alpha, cos_alpha = np.sin(alpha_rad), np.cos(alpha_rad)
    sin_beta, cos_beta = np.sin(beta_rad), np.cos(beta_rad)
    return np.array([[cos_alpha * cos_beta, -cos_alpha * sin_beta, -sin_alpha],
                     [-sin_alpha * sin_beta, -sin_alpha * cos_beta, 0 * sin_alpha]])


RANDOM_WALKS_G_PER_RTS = (1e-7, 1e-5, 3e-5, 7e-5, 1.5e-4, 4e-4, 1e-3, 3e-3)
"""Grid of densities of a random walk, g/√s, a factor of two to three apart."""
FLICKERS_G_PER_RTHZ = (6e-5, 1.5e-4, 5e-4, 1.5e-3, 4e-3)
"""Grid of densities of 1/f noise at 1 Hz, g/√Hz, a factor of three apart."""
USUAL_DENSITY = 1e-5
"""Usual density of both drifts, g/√s and g/√Hz. Chosen: 0.1 mg within 100 s."""
_DENSITY_DECADES = 1.0
"""Prior standard deviation of the logarithm of the density, decades. Chosen: a factor of ten."""
_LOWEST_NOISE_V = 1e-7
"""Smallest standard deviation of the noise, V, because whitening needs noise. Chosen: below that
of any ADC."""
_TOP_OF_RATE = 0.25
"""Highest corner frequency of 1/f noise, divided by the sample rate. Chosen: half of Nyquist."""
_UNFILTERED_TOP_OF_RATE = 0.4
"""Highest pole of 1/f noise that bypasses the RC filter, divided by the sample rate. Chosen: below
Nyquist."""


_SMALLEST_HELD_SHARE = 0.01
"""Share of the rounding that is held, below which all of it is white. Chosen: the noise is then
a third of a step, as in any unit whose ADC suits it."""
_SERIES = 16
"""Series that are filtered together. Chosen: little memory beside all series."""
_LOST_S = 2.0
"""Length of the windows of the spectra, s. Chosen: a filter of an optical tracker is shorter."""
_FEWEST_MOVING = 12
"""Fewest windows in motion. Chosen: three axes of a reference then predict a quarter by chance."""
_OVERLAP_SHARE = 0.6
"""Independent windows divided by the windows, which overlap by half. Chosen: that of a Hann
window."""
_RESTORING_ERROR = 0.1
"""Error of restored motion, divided by what the reference lacks of it. Chosen: the forms of
filters differ by some per cent, and the reference has noise."""
_RIDGE = 1e-9
"""Ridge on the spectra of the reference, divided by their mean. Chosen: above rounding errors."""


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


def angle_error_filter(comparison: BaselineComparison, axis: int) -> AngleErrorFilter | None:
    """Return the filter for one axis of a recording."""
    sensor = comparison.sensor
    rounding = noise.rounding(sensor, axis)
    variance_v2, remembered_v2 = np.zeros(len(comparison)), np.zeros(len(comparison))
    for part_v2, memory in (*_angle_errors(comparison, axis),
                            *_rounding_errors(comparison, axis, rounding.held_v2)):
        variance_v2 += part_v2
        remembered_v2 += part_v2 * memory
    if not variance_v2.any():
        return None
    rc_s = float(noise.electronics(sensor).rc_s[axis])
    pole = float(np.exp(-comparison.dt_s / rc_s)) if rc_s else 0.0
    std_v = max(float(noise.analog_std_v(sensor)[axis]), _LOWEST_NOISE_V)
    noise_v2 = std_v ** 2 * (1 - pole ** 2) + rounding.white_v2 * (1 + pole ** 2)
    return _filter(np.sqrt(variance_v2),
                   np.divide(remembered_v2, variance_v2, where=variance_v2 > 0,
                             out=np.ones(len(comparison))), pole, noise_v2)


def _angle_errors(comparison: BaselineComparison, axis: int
                  ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield variance, V², (n,), and memory from sample to sample, (n,), of each joint's error."""
    if comparison.reference is not Reference.STAGE:
        return
    time_s, motion, sensor = comparison.time_s, comparison.motion, comparison.sensor
    slopes = gravity_slopes(motion.alpha(time_s), motion.beta(time_s))[:, axis]
    v_per_rad = slopes * sensor.scale_v_per_g[axis] * sensor.local_gravity_mps2 / G0_MPS2
    for joint, slope in zip((motion.alpha, motion.beta), v_per_rad):
        errors = joint.errors(time_s) if isinstance(joint, CachedPath) else None
        if errors is not None:
            # An error that grows, after a move, is a new one.
            grown = np.minimum(errors.std[:-1] / errors.std[1:], 1.0)
            memory = np.exp(-errors.forgetting_per_s * comparison.dt_s)
            memory[1:] *= grown
            yield (slope * errors.std) ** 2, memory


def _rounding_errors(comparison: BaselineComparison, axis: int, held_v2: float
                     ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """
    Yield variance, V², (n,), and memory from sample to sample, (n,), of the held rounding error.

    Rounding errors of two outputs that differ by a small share x of a step have the correlation
    1 − 6·x.
    """
    if held_v2 < _SMALLEST_HELD_SHARE * comparison.sensor.lsb_v ** 2 / 12 or not held_v2:
        return
    simulated_v = comparison.simulated_v(comparison.sensor)[:, axis]
    steps = np.abs(np.diff(simulated_v, prepend=simulated_v[:1])) / comparison.sensor.lsb_v
    yield np.full(len(comparison), held_v2), np.exp(-6 * steps)


def _filter(std_v: np.ndarray, memory: np.ndarray, pole: float, noise_v2: float
            ) -> AngleErrorFilter:
    """
    Run the Riccati recursion of the Kalman filter.

    `std_v` is g, V, (n,), `memory` is φ, (n,), and `noise_v2` the variance of (1 − aL)·n, V².
    """
    rows, variance, previous_v = [], 1.0, float(std_v[0])
    for g, phi in zip(std_v.tolist(), memory.tolist()):
        renewal2 = 1 - phi * phi
        weight = g * phi - pole * previous_v
        total_v2 = weight * weight * variance + g * g * renewal2 + noise_v2
        gain = (phi * weight * variance + g * renewal2) / total_v2
        rows.append((phi - gain * weight, gain, weight, sqrt(noise_v2 / total_v2)))
        variance = phi * phi * variance + renewal2 - gain * gain * total_v2
        previous_v = g
    rms_v = float(np.sqrt(np.mean(std_v ** 2)))
    return AngleErrorFilter(rms_v, pole, *np.array(rows).T)


@dataclass(frozen=True)
class LostMotionFilter:
    """A filter that gives noise with lost motion the spectrum of noise without it."""

    moves: np.ndarray  # Samples in motion, (n,) bool; at rest nothing is lost
    taps: np.ndarray  # Impulse response of the filter, (k,)
    lost_rms_v: float  # Rms of the lost motion over all samples, V
    # Filter for errors of angles and rounding, which comes first; None without any
    before: AngleErrorFilter | None = None

    @property
    def rms_v(self) -> float:
        """Return the rms of the errors, V."""
        return float(np.hypot(self.lost_rms_v, self.before.rms_v if self.before else 0.0))

    @cached_property
    def scale(self) -> np.ndarray:
        """Return the standard deviation of the noise over that of the innovation, (n,)."""
        scale = np.where(self.moves, self.taps[0], 1.0)
        return scale if self.before is None else scale * self.before.scale

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Filter k series, (k, n)."""
        before = values if self.before is None else self.before(values)
        return np.where(self.moves, scipy.signal.lfilter(self.taps, [1.0], before), before)


def lost_motion_filter(comparison: BaselineComparison, axis: int, before: AngleErrorFilter | None
                       ) -> LostMotionFilter | None:
    """Return the filter for one axis of a recording."""
    if not comparison.reference_fades:
        return None
    moves = ~comparison.at_rest
    size = round(_LOST_S * comparison.sensor.rate_hz) // 2 * 2
    usable = comparison.used & moves
    starts = [i for i in range(0, len(usable) - size + 1, size // 2) if usable[i:i + size].all()]
    if len(starts) < _FEWEST_MOVING:
        return None
    rows = np.array(starts)[:, None] + np.arange(size)
    recorded = _spectra(comparison.volts[:, axis:axis + 1], rows)[:, :, 0]
    stated = _spectra(comparison.simulated_v(comparison.sensor), rows)
    lacking = np.mean(np.abs(recorded) ** 2 - np.abs(stated[:, :, axis]) ** 2, axis=1)
    density_v2 = 2 * comparison.dt_s * (_unpredicted(recorded, stated) + _RESTORING_ERROR ** 2
                                        * np.maximum(lacking, 0.0))
    noise_v2 = _noise_density_v2(comparison, axis, size)
    lost_v2 = np.maximum(density_v2 - noise_v2, 0.0)
    step_hz = 1 / (size * comparison.dt_s)
    lost_rms_v = float(np.sqrt(lost_v2.sum() * step_hz * (usable.sum() / comparison.used.sum())))
    return LostMotionFilter(moves, _minimum_phase(np.sqrt(noise_v2 / (noise_v2 + lost_v2))),
                            lost_rms_v, before)


def _spectra(volts: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the spectra of windows by frequency, (frequencies, windows, m), of unit power."""
    taper = np.hanning(rows.shape[1])
    windows = scipy.signal.detrend(volts[rows], axis=1) * taper[None, :, None]
    return np.moveaxis(np.fft.rfft(windows, axis=1), 1, 0) / np.sqrt(np.sum(taper ** 2))


def _unpredicted(recorded: np.ndarray, stated: np.ndarray) -> np.ndarray:
    """
    Return the power of a recording that no linear filter of the reference predicts.

    `recorded` is (frequencies, windows), `stated` (frequencies, windows, m). What the reference
    predicts by chance is made up for.
    """
    windows, inputs = stated.shape[1:]
    gram = np.einsum('fwi,fwj->fij', stated.conj(), stated)
    cross = np.einsum('fwi,fw->fi', stated.conj(), recorded)
    ridge = _RIDGE * np.trace(gram, axis1=1, axis2=2).real.mean() * np.eye(inputs)
    gain = np.linalg.solve(gram + ridge, cross[:, :, None])
    rest = recorded - np.einsum('fwi,fi->fw', stated, gain[:, :, 0])
    free = max(_OVERLAP_SHARE * windows - inputs, 1.0)
    return np.mean(np.abs(rest) ** 2, axis=1) * _OVERLAP_SHARE * windows / free


def _noise_density_v2(comparison: BaselineComparison, axis: int, size: int) -> np.ndarray:
    """Return the one-sided density of noise and rounding by frequency, V²/Hz."""
    sensor = comparison.sensor
    rc_s = float(noise.electronics(sensor).rc_s[axis])
    pole = float(np.exp(-comparison.dt_s / rc_s)) if rc_s else 0.0
    std_v = max(float(noise.analog_std_v(sensor)[axis]), _LOWEST_NOISE_V)
    angle = 2 * np.pi * np.arange(size // 2 + 1) / size
    coloured = std_v ** 2 * (1 - pole ** 2) / np.abs(1 - pole * np.exp(-1j * angle)) ** 2
    return 2 * comparison.dt_s * (coloured + noise.rounding(sensor, axis).white_v2)


def _minimum_phase(gain: np.ndarray) -> np.ndarray:
    """Return the impulse response of the smallest phase with a gain, by its cepstrum."""
    cepstrum = np.fft.irfft(np.log(gain))
    half = len(cepstrum) // 2
    cepstrum[1:half] *= 2
    cepstrum[half + 1:] = 0.0
    return np.fft.irfft(np.exp(np.fft.rfft(cepstrum)))[:half]


def drift_effects() -> tuple[str, ...]:
    """Return the names of the effects that let the zero-g drift."""
    return tuple(e.name for e in library().values() if e.diagnosis.drift)


def drifts_among(effects: Iterable[str]) -> tuple[str, ...]:
    """Return those of the given effects that let the zero-g drift."""
    return tuple(e for e in effects if effect_named(e).diagnosis.drift)


def _drift_effect(spectrum: DriftSpectrum) -> str:
    """Return the name of the effect that drifts with a spectrum."""
    return next(e.name for e in library().values() if e.diagnosis.drift is spectrum)


Series = dict[bool, np.ndarray]
"""The k series for whitening filters, (k, n), by `Whitener.corrects_angles`."""


@dataclass(frozen=True)
class Whitener:
    """A filter that makes noise white."""

    sections: np.ndarray  # Second-order sections, (s, 6)
    log_prior: float  # Log prior probability of such noise, up to a constant
    effect: str  # Name of the drift effect that the filter is for
    density: float  # Density of the drift, in the unit of the effect's parameter
    # Filter for the errors of the reference, which comes first; None where the reference is exact,
    # or where the drift within a second exceeds these errors: they would take up a part of it
    angle_errors: AngleErrorFilter | LostMotionFilter | None = None

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

    @property
    def corrects_angles(self) -> bool:
        """Whether the errors of the followed angles are a part of the noise."""
        return self.angle_errors is not None

    def log_scale(self, used: np.ndarray) -> np.ndarray:
        """
        Return what the filter for errors of angles adds to the log likelihood, (n,).

        It is the log determinant of this filter sample by sample; `used`, (n,) bool, are the
        samples that count.
        """
        if self.angle_errors is None:
            return np.zeros(len(used))
        return np.where(used, np.log(self.angle_errors.scale), 0.0)

    def continued(self, values: np.ndarray, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Filter the next part of k series after `before_filters`.

        values: the part, (k, n); state: state before it, (sections, k, 2); returns: filtered part,
        (k, n), and the state after it.
        """
        if len(self.sections) > 1:
            return scipy.signal.sosfilt(self.sections, values, zi=state)
        # The same recursion without a copy.
        numerator, denominator = self.sections[0, :3], self.sections[0, 3:]
        filtered, after = scipy.signal.lfilter(numerator, denominator, values, zi=state[0])
        return filtered, after[None]


def before_filters(filters: Sequence[Whitener], values: np.ndarray) -> Series:
    """
    Apply what whitening filters of a channel have in common.

    values: the k series, (k, n); returns: series, (k, n), for filters that correct errors of
    angles and for the others.
    """
    angle_errors = {f.corrects_angles: f.angle_errors for f in filters}
    return {corrects: values if errors is None else errors(values)
            for corrects, errors in angle_errors.items()}


def whiteners(sensor: Sensor, axis: int, dt_s: float, span_s: float,
              angle_errors: AngleErrorFilter | LostMotionFilter | None = None
              ) -> list[Whitener]:
    """Return the filters that are tried for the noise of one axis of a recording."""
    rc_s = float(noise.electronics(sensor).rc_s[axis])
    a = float(np.exp(-dt_s / rc_s)) if rc_s else 0.0
    std_v = max(float(noise.analog_std_v(sensor)[axis]), _LOWEST_NOISE_V)
    step_std_v = float(np.sqrt(noise.rounding(sensor, axis).white_v2))
    scale = float(sensor.scale_v_per_g[axis])
    walks = _walk_whiteners(a, std_v, step_std_v, scale, dt_s)
    # Noise and ADC steps without drift are an ARMA(1, 1) sequence; this is the zero of its MA.
    healthy_zero = -_spectral_factor(
        std_v ** 2 * (1 - a * a) * _power(np.ones(1), 1)
        + step_std_v ** 2 * _power(np.array([1, -a]), 1), 1)[1]
    white_v2_per_hz = 2 * dt_s * (std_v ** 2 * (1 + a) / (1 - a) + step_std_v ** 2)
    flickers = []
    flicker = _drift_effect(DriftSpectrum.FLICKER)
    for density in FLICKERS_G_PER_RTHZ:
        corner_hz = (density * scale) ** 2 / white_v2_per_hz
        top_hz = min(corner_hz, _TOP_OF_RATE / dt_s)
        decades = int(np.ceil(max(np.log10(top_hz * span_s), 0.0)))
        zeros, poles = _flicker_zeros_and_poles(top_hz, decades, dt_s)
        sections = scipy.signal.zpk2sos([a, *zeros], [healthy_zero, *poles], 1.0)
        flickers.append(_whitener(sections, flicker, density))
        if corner_hz > top_hz:
            break
    if a:
        # 1/f noise that bypasses the RC filter is the largest noise at all frequencies if it is
        # the largest at the filter's corner.
        zeros, poles = _flicker_zeros_and_poles(_UNFILTERED_TOP_OF_RATE / dt_s,
                                                int(np.ceil(np.log10(span_s / dt_s))), dt_s)
        lowest = np.sqrt(white_v2_per_hz / (2 * np.pi * rc_s)) / scale
        healthy = effect_named(flicker).diagnosis.healthy_density
        flickers.append(_whitener(scipy.signal.zpk2sos(zeros, poles, 1.0), flicker,
                                  max(float(lowest), 2 * healthy)))
    largest = np.inf if angle_errors is None else angle_errors.rms_v / scale
    return [replace(f, angle_errors=angle_errors) if f.healthy or f.density < largest else f
            for f in walks + flickers]


def _walk_whiteners(a: float, std_v: float, step_std_v: float, scale_v_per_g: float, dt_s: float
                    ) -> list[Whitener]:
    """Return the filters for random walks; a is the pole of the RC filter."""
    pole, difference = np.array([1, -a]), np.array([1, -1.0])
    walk = _drift_effect(DriftSpectrum.RANDOM_WALK)
    out = []
    for density in RANDOM_WALKS_G_PER_RTS:
        spectrum = (std_v ** 2 * (1 - a * a) * _power(difference, 2)
                    + step_std_v ** 2 * _power(np.convolve(pole, difference), 2)
                    + (density * scale_v_per_g) ** 2 * dt_s * _power(pole, 2))
        out.append(_whitener(scipy.signal.tf2sos(np.convolve(pole, difference),
                                                 _spectral_factor(spectrum, 2)), walk, density))
    return out


def _flicker_zeros_and_poles(top_hz: float, decades: int, dt_s: float
                             ) -> tuple[np.ndarray, np.ndarray]:
    """
    Return zeros and poles, one pair a decade from `top_hz` down, of a filter for 1/f noise.

    Its gain rises with the root of the frequency.
    """
    corners_hz = top_hz * 10.0 ** -np.arange(decades)
    return (np.exp(-2 * np.pi * dt_s * corners_hz * 10 ** -0.5),
            np.exp(-2 * np.pi * dt_s * corners_hz))


def _whitener(sections: np.ndarray, effect: str, density: float) -> Whitener:
    """Make a filter with its log-normal prior."""
    log_prior = -0.5 * (np.log10(density / USUAL_DENSITY) / _DENSITY_DECADES) ** 2
    return Whitener(sections, log_prior, effect, density)


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
