# SPDX-License-Identifier: Apache-2.0

"""
Whitening filters for noise that can drift.

The noise is white noise behind the RC filter, the ADC's steps, and a zero-g that drifts. With a
random walk it is y = n + w + d. Here n is an AR(1) sequence with a = exp(−dt/RC), w is white, and
d is the walk. Then (1 − aL)(1 − L)·y is an MA(2). Its factor follows from its spectrum (Brockwell
and Davis 1991, section 3.2).

Alternating poles and zeros, one pair a decade, whiten 1/f noise below its corner, where its
density equals that of the white noise (Corsini and Saletti 1988, IEEE Trans. Instrum. Meas. 37).
The variance of the innovations is fitted. The filter then depends only on the ratio of drift and
noise, which is searched on a grid.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from adxl_ros.diagnose.reference import AngleErrorFilter, LostMotionFilter
from adxl_ros.model import noise
from adxl_ros.model.diagnosis_hints import DriftSpectrum
from adxl_ros.model.effects import effect_named, library
from adxl_ros.model.sensor import Sensor
import numpy as np
import scipy

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

    def __call__(self, series: Series) -> np.ndarray:
        """Filter k series after `before_filters`, (k, n)."""
        return scipy.signal.sosfilt(self.sections, series[self.corrects_angles])

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
