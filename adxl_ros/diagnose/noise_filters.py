# SPDX-License-Identifier: Apache-2.0
"""
Filters that make the noise of an axis white, whatever drift it has.

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
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import zip_longest
from math import sqrt
from typing import NamedTuple, TYPE_CHECKING

from adxl_ros.model import noise
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.effects import effect_named, library
from adxl_ros.model.effects.base import DriftSpectrum
from adxl_ros.model.kinematics import gravity_slopes
from adxl_ros.simulate.smoothed_path import SmoothedPath
import numpy as np
import scipy

if TYPE_CHECKING:
    from adxl_ros.diagnose.comparison import BaselineComparison

RANDOM_WALKS_G_PER_RTS = (1e-7, 1e-5, 3e-5, 7e-5, 1.5e-4, 4e-4, 1e-3, 3e-3, 1e-2, 3e-2)
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
_ROUNDING_FORGETS = 6.0
"""How fast rounding forgets its error, per step of the output. Derived: the autocovariance of a
sawtooth of variance 1 is 1 − 6·x + 6·x² after x steps."""


def without_pole(values: np.ndarray, pole: float) -> np.ndarray:
    """Filter a series, (n,), by 1 − aL; the first value stays."""
    out = values.copy()
    out[1:] -= pole * values[:-1]
    return out


def in_pairs(series: np.ndarray) -> Iterator[np.ndarray]:
    """
    Yield k real series, (k, n), two at a time as the parts of complex numbers, (n,).

    A recursion waits for its last output, so that a complex one takes no longer than a real one.
    """
    for real, imaginary in zip_longest(series[::2], series[1::2], fillvalue=0.0):
        yield np.add(real, 1j * imaginary)


@dataclass(frozen=True)
class AngleErrorFilter:
    """A filter (1 − aL) for noise with errors of angles, as if it were without them."""

    rms_v: float  # Rms of the errors, V
    pole: float  # Pole a of the noise
    transition: np.ndarray  # Factor of the estimate of u from sample to sample, (n,)
    gain: np.ndarray  # Gain of the estimate of u, 1/V, (n,)
    weight: np.ndarray  # Change of the predicted sample by the estimate of u, V, (n,)
    scale: np.ndarray  # Standard deviation of the noise divided by that of the innovation, (n,)

    @cached_property
    def _recursion(self) -> np.ndarray:
        """Bands of the matrix that turns estimates of u into what drives them, (2, n)."""
        lower = np.ones((2, len(self.gain)), complex, order='F')
        lower[1, :-1] = -self.transition[1:]
        return lower

    def __call__(self, pair: np.ndarray) -> np.ndarray:
        """Filter a pair of series, (n,) complex."""
        changes = without_pole(pair, self.pole)
        changes[0] = 0.0
        estimates = scipy.linalg.lapack.ztbtrs(
            self._recursion, changes * self.gain, uplo='L', diag='U', overwrite_b=True
        )[0]
        changes[1:] -= estimates[:-1] * self.weight[1:]
        changes *= self.scale
        changes[0] = pair[0]
        return changes


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


def drifts_among(effects: Iterable[str]) -> tuple[str, ...]:
    """Return those of the given effects that let the zero-g drift."""
    return tuple(e for e in effects if effect_named(e).diagnosis.drift)


def expected_drift_g(effect: str, density: float, comparison: BaselineComparison) -> float:
    """Return the expected rms of a drift about its mean over a recording."""
    if effect_named(effect).diagnosis.drift is DriftSpectrum.RANDOM_WALK:
        return float(density * np.sqrt(comparison.span_s / 6))
    return float(density * np.sqrt(np.log(comparison.sensor.rate_hz / 2 * comparison.span_s)))


def whiteners(comparison: BaselineComparison, axis: int) -> list[Whitener]:
    """Return the filters that are tried for the noise of an axis of a recording."""
    usual = _UsualNoise.of(comparison, axis)
    by_spectrum = {effect_named(e).diagnosis.drift: e for e in drifts_among(library())}
    walk = by_spectrum[DriftSpectrum.RANDOM_WALK]
    flicker = by_spectrum[DriftSpectrum.FLICKER]
    filters = [usual.against_walk(walk, density) for density in RANDOM_WALKS_G_PER_RTS]
    for density in FLICKERS_G_PER_RTHZ:
        filters.append(usual.against_flicker(flicker, density, comparison.span_s))
        if usual.corner_hz(density) > usual.highest_corner_hz:
            break
    errors = _angle_error_filter(comparison, axis, usual)
    if errors is None:
        return filters
    largest = errors.rms_v / usual.v_per_g
    return [replace(f, errors=errors) if f.healthy or f.density < largest else f for f in filters]


@dataclass(frozen=True)
class _UsualNoise:
    """The noise of one axis without drift: white noise behind an RC filter, and ADC steps."""

    v_per_g: float  # Scale factor of the axis, V/g
    dt_s: float  # Time between samples, s
    pole: float  # Pole of the RC filter
    std_v: float  # Standard deviation of the analog noise, V
    step_v2: float  # Mean square of the steps, V²

    @classmethod
    def of(cls, comparison: BaselineComparison, axis: int) -> _UsualNoise:
        """Return that of an axis of a recording, without the rounding that stays."""
        sensor = comparison.sensor
        electronics = noise.electronics(sensor)
        rc_s = float(electronics.rc_s[axis])
        step_v2 = electronics.lsb_v**2 / 12 - noise.held_rounding_v2(sensor)
        return cls(
            v_per_g=float(sensor.scale_v_per_g[axis]),
            dt_s=comparison.dt_s,
            pole=float(np.exp(-comparison.dt_s / rc_s)) if rc_s else 0.0,
            std_v=max(float(noise.analog_std_v(sensor)[axis]), _LOWEST_NOISE_V),
            step_v2=float(step_v2[axis]),
        )

    @property
    def highest_corner_hz(self) -> float:
        """Return the highest corner of 1/f noise that a filter has, Hz."""
        return _TOP_OF_RATE / self.dt_s

    @property
    def _density_v2_per_hz(self) -> float:
        """Return the density at low frequencies, V²/Hz."""
        analog_v2 = self.std_v**2 * (1 + self.pole) / (1 - self.pole)
        return 2 * self.dt_s * (analog_v2 + self.step_v2)

    def corner_hz(self, density: float) -> float:
        """Return the frequency at which 1/f noise, g/√Hz at 1 Hz, is as dense as this one, Hz."""
        return (density * self.v_per_g) ** 2 / self._density_v2_per_hz

    def against_walk(self, effect: str, density: float) -> Whitener:
        """Return the filter for noise with a random walk, g/√s."""
        pole = np.array([1, -self.pole])
        difference = np.array([1, -1.0])
        spectrum = (
            self.std_v**2 * (1 - self.pole**2) * _power(difference, 2)
            + self.step_v2 * _power(np.convolve(pole, difference), 2)
            + (density * self.v_per_g) ** 2 * self.dt_s * _power(pole, 2)
        )
        factor = _spectral_factor(spectrum, 2)
        sections = np.array([[*difference, 0.0, *factor]])
        innovation_v = sqrt(spectrum[2] / np.sum(factor**2))
        return Whitener(sections, effect, density, density / innovation_v, self.pole)

    def against_flicker(self, effect: str, density: float, span_s: float) -> Whitener:
        """Return the filter for noise with 1/f noise, g/√Hz at 1 Hz."""
        # Noise and steps without drift are an ARMA(1, 1) sequence; this is the zero of its MA.
        spectrum = self.std_v**2 * (1 - self.pole**2) * _power(np.ones(1), 1)
        spectrum += self.step_v2 * _power(np.array([1, -self.pole]), 1)
        factor = _spectral_factor(spectrum, 1)
        zero = -factor[1]
        innovation_v = sqrt(spectrum[1] / np.sum(factor**2))
        # Zeros and poles, one pair a decade from the corner down: the gain of the filter rises
        # with the root of the frequency.
        top_hz = min(self.corner_hz(density), self.highest_corner_hz)
        decades = np.arange(int(np.ceil(max(np.log10(top_hz * span_s), 0.0))))
        corners = 2 * np.pi * self.dt_s * top_hz * 10.0**-decades
        poles = [0.0, *np.exp(-corners * 10**-0.5)]
        sections = scipy.signal.zpk2sos(poles, [zero, *np.exp(-corners)], 1.0)
        # The filter is that of the noise with the highest corner, where it would be higher.
        largest_v = sqrt(self.highest_corner_hz * self._density_v2_per_hz)
        filtered = min(density, largest_v / self.v_per_g)
        return Whitener(sections, effect, density, filtered / innovation_v, self.pole)


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


class _HeldErrors(NamedTuple):
    """Errors of an axis that stay while nothing moves, (n,) each."""

    variance_v2: np.ndarray  # Variance, V²
    memory: np.ndarray  # Correlation with the sample before


def _held_errors(comparison: BaselineComparison, axis: int) -> Iterator[_HeldErrors]:
    """Yield the errors of angles, of a robot, and of rounding."""
    sensor = comparison.sensor
    time_s = comparison.time_s
    joints = comparison.joints or ()
    slopes = gravity_slopes(*comparison.joint_values())[:, axis] if joints else ()
    for joint, slope in zip(joints, slopes):
        errors = joint.errors(time_s) if isinstance(joint, SmoothedPath) else None
        if errors is not None:
            # An error that grows, after a move, is a new one.
            memory = np.exp(-errors.forgetting_per_s * comparison.dt_s)
            memory[1:] *= np.minimum(errors.std[:-1] / errors.std[1:], 1.0)
            v_per_rad = slope * sensor.scale_v_per_g[axis] * sensor.local_gravity_mps2 / G0_MPS2
            yield _HeldErrors((v_per_rad * errors.std) ** 2, memory)
    robot = comparison.robot_force
    if robot is not None:
        errors = robot.errors(time_s, AXES.index(sensor.axes[axis]))
        std_v = comparison.scale_v_per_mps2[axis] * errors.std
        yield _HeldErrors(std_v**2, np.exp(-errors.forgetting_per_s * comparison.dt_s))
    held_v2 = noise.held_rounding_v2(sensor)[axis]
    if held_v2:
        output_v = comparison.simulated_v(sensor)[:, axis]
        moved_v = np.abs(np.diff(output_v, prepend=output_v[0]))
        steps = moved_v / noise.electronics(sensor).lsb_v[axis]
        yield _HeldErrors(np.full(len(time_s), held_v2), np.exp(-_ROUNDING_FORGETS * steps))


def _angle_error_filter(
    comparison: BaselineComparison, axis: int, usual: _UsualNoise
) -> AngleErrorFilter | None:
    """
    Return the filter for one axis by the Riccati recursion of the Kalman filter.

    None where the errors of angles are 0.
    """
    variance_v2, remembered_v2 = np.zeros((2, len(comparison)))
    for errors in _held_errors(comparison, axis):
        variance_v2 += errors.variance_v2
        remembered_v2 += errors.variance_v2 * errors.memory
    if not variance_v2.any():
        return None
    pole = usual.pole
    noise_v2 = usual.std_v**2 * (1 - pole**2) + usual.step_v2 * (1 + pole**2)
    memories = np.divide(
        remembered_v2, variance_v2, where=variance_v2 > 0, out=np.ones(len(comparison))
    )
    std_v = np.sqrt(variance_v2)
    rows = []
    variance = 1.0
    previous_v = float(std_v[0])
    for g, phi in zip(std_v.tolist(), memories.tolist()):
        renewal2 = 1 - phi * phi
        weight = g * phi - pole * previous_v
        total_v2 = weight * weight * variance + g * g * renewal2 + noise_v2
        gain = (phi * weight * variance + g * renewal2) / total_v2
        rows.append((phi - gain * weight, gain, weight, sqrt(noise_v2 / total_v2)))
        variance = phi * phi * variance + renewal2 - gain * gain * total_v2
        previous_v = g
    transition, gains, weights, scale = map(np.array, zip(*rows))
    return AngleErrorFilter(
        float(np.sqrt(np.mean(variance_v2))), pole, transition, gains, weights, scale
    )
