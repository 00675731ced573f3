# SPDX-License-Identifier: Apache-2.0

"""
Time constant of the output filter, from the spectrum of the noise at rest.

White noise behind a first-order filter is an AR(1) sequence with a = exp(−dt/RC). The ADC adds
white rounding noise. The variance of the noise, RC and the variance of the rounding noise are
fitted to the mean periodogram of all rests by the debiased Whittle likelihood (Sykulski et al.
2019, doi 10.1093/biomet/asy071). It compares each ordinate with its exact expectation for the
window and the sampling.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from adxl_ros.model.coefficients import names_of, put, with_neutral
from adxl_ros.model.effects import effect_named
from adxl_ros.model.sensor import Sensor
import numpy as np
import scipy

_SEGMENT_S = 1.0
"""Length of a segment of the periodogram, s. Chosen: several fit into a rest."""
_MIN_SEGMENT_SAMPLES = 16
"""Smallest number of samples in a segment. Chosen: fewer ordinates do not show a filter."""
_LOWEST_BINS = 2
"""Highest bin that is left out: mean, drift and flicker dominate in bins 0 to 2."""
_INDEPENDENT_SEGMENTS = 0.95
"""Independent periodograms per segment, for a Hann window that overlaps by half."""
_CORRELATED_ORDINATES = 35 / 18
"""Ordinates per degree of freedom: neighbours are correlated behind a Hann window."""
_ADC_NOISE_PRIOR_STD = 0.7
"""Prior standard deviation of the logarithm of the ADC's noise variance about LSB²/12. Chosen:
a factor of two."""
_LINE_STD = 6.0
"""Excess from which an ordinate is a line (hum), standard deviations of the ordinates."""
_FIT_ROUNDS = 2
"""Number of fits: the second one leaves out the lines that the first one shows."""
_MIN_VARIANCE_V2 = 1e-18
"""Lower bound of the start value of the noise variance, V²."""
_MIN_LSB_V = 1e-9
"""Lower bound of the ADC's step, V, for samples without rounding."""
_LOG_STEP = 1e-4
"""Step of the central differences, in the logarithm of a parameter."""
_MAX_LOG = 80.0
"""Largest magnitude of a parameter's logarithm, so that its exponential stays finite."""
_MIN_EXPECTED_V2 = 1e-300
"""Lower bound of an expected ordinate, V², so that its logarithm is finite."""
_MAX_CONDITION = 1e12
"""Largest condition number of the information matrix that can be inverted."""
_MAX_RATIO_STD = 0.1
"""Largest relative standard deviation of a credible estimate. Chosen: well below the ±25 % of the
datasheet."""
_MAX_SCATTER = 2.0
"""Largest scatter of the ordinates, relative to that of filtered white noise. Chosen: flicker and
hum exceed it."""


@dataclass(frozen=True)
class FilterNoise:
    """Estimate of the filter of one axis."""

    rc_s: float  # Time constant, s
    ratio_std: float  # Relative standard deviation of the time constant
    # Mean square of the ordinates' deviations, relative to that of filtered white noise
    scatter: float

    @property
    def credible(self) -> bool:
        """Return whether the noise fits filtered white noise and determines the filter."""
        return self.scatter < _MAX_SCATTER and self.ratio_std < _MAX_RATIO_STD


def estimate_filter(rests: Iterable[np.ndarray], rate_hz: float, rc_s: float, lsb_v: float
                    ) -> FilterNoise | None:
    """
    Estimate the time constant of one axis.

    rests: volts of each rest without gaps, (n,) each.
    """
    # scipy.signal takes 0.3 s to import, which a calibration needs only at its end.
    from scipy.signal.windows import hann
    size = max(_MIN_SEGMENT_SAMPLES, round(_SEGMENT_S * rate_hz))
    window = hann(size, sym=False)
    window /= np.sqrt(np.sum(window ** 2))
    power, count = _mean_periodogram(rests, window)
    if count < 2 or not rc_s or not np.any(power):
        return None
    weight = _INDEPENDENT_SEGMENTS * count
    lags = np.correlate(window, window, 'full')[size - 1:]
    used = np.arange(len(power)) > _LOWEST_BINS
    start = np.log([max(float(np.mean(power[used])) / size, lsb_v ** 2, _MIN_VARIANCE_V2),
                    rc_s * rate_hz, max(lsb_v, _MIN_LSB_V) ** 2 / 12])
    log_adc_variance = float(start[2])

    def cost(x: np.ndarray) -> float:
        """Return the negative log posterior for the parameters of `_expected`."""
        expected = np.maximum(_expected(x, lags)[used], _MIN_EXPECTED_V2)
        prior = ((x[2] - log_adc_variance) / _ADC_NOISE_PRIOR_STD) ** 2
        return float(np.sum(power[used] / expected + np.log(expected)) + prior / (2 * weight))

    for _ in range(_FIT_ROUNDS):
        fit = scipy.optimize.minimize(cost, start, method='Nelder-Mead',
                                      options={'xatol': 1e-5, 'fatol': 1e-6, 'maxiter': 2000})
        deviation = power / _expected(fit.x, lags) - 1
        used &= deviation < _LINE_STD / np.sqrt(weight)
        if used.sum() < _MIN_SEGMENT_SAMPLES // 2:
            return None
        start = fit.x
    scatter = float(np.mean(deviation[used] ** 2) * weight)
    information = _information(fit.x, used, lags) * weight / _CORRELATED_ORDINATES
    information += np.diag([0.0, 0.0, _ADC_NOISE_PRIOR_STD ** -2])
    # White noise does not show a filter.
    if np.linalg.cond(information) > _MAX_CONDITION:
        return None
    ratio_std = float(np.sqrt(np.linalg.inv(information)[1, 1] * max(scatter, 1.0)))
    return FilterNoise(float(np.exp(fit.x[1]) / rate_hz), ratio_std, scatter)


def _mean_periodogram(rests: Iterable[np.ndarray], window: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the mean periodogram of all segments, V², and their number."""
    size = len(window)
    total, count = np.zeros(size // 2 + 1), 0
    for volts in rests:
        for begin in range(0, len(volts) - size + 1, size // 2):
            part = volts[begin:begin + size]
            total += np.abs(np.fft.rfft(window * (part - part.mean()))) ** 2
            count += 1
    return total / max(count, 1), count


def _expected(x: np.ndarray, lags: np.ndarray) -> np.ndarray:
    """Return the expected periodogram, V², for the logarithms of σ², RC/dt and the ADC's σ²."""
    variance_v2, rc_samples, adc_variance_v2 = np.exp(np.clip(x, -_MAX_LOG, _MAX_LOG))
    covariance = variance_v2 * np.exp(-np.arange(len(lags)) / rc_samples)
    covariance[0] += adc_variance_v2
    terms = covariance * lags
    return 2 * np.fft.rfft(terms).real - terms[0]


def _information(x: np.ndarray, used: np.ndarray, lags: np.ndarray) -> np.ndarray:
    """Return the expected information of one periodogram, (3, 3): Σ ∂log S·∂log Sᵀ."""
    slopes = np.array([(np.log(_expected(x + _LOG_STEP * unit, lags)[used])
                        - np.log(_expected(x - _LOG_STEP * unit, lags)[used])) / (2 * _LOG_STEP)
                       for unit in np.eye(3)])
    return slopes @ slopes.T


def with_filter(fitted: Sensor, estimates: Sequence[Sequence[FilterNoise | None]]
                ) -> tuple[Sensor, list[str]]:
    """Add the effect `bandwidth` with its variance to a fitted unit."""
    if not fitted.rc_s or not estimates:
        return fitted, []
    ratios, variances = [], []
    for axis, axis_estimates in zip(fitted.axes, zip(*estimates)):
        credible = [estimate for estimate in axis_estimates
                    if estimate is not None and estimate.credible]
        if not credible:
            return fitted, [f'{axis}: the noise at rest does not fit white noise behind the '
                            'stated filter; the fit keeps the stated resistor']
        weights = np.array([estimate.ratio_std ** -2 for estimate in credible])
        rc_s = np.average([estimate.rc_s for estimate in credible], weights=weights)
        ratios.append(rc_s / fitted.rc_s - 1)
        variances.append((rc_s / fitted.rc_s) ** 2 / weights.sum())
    names = names_of(effect_named('bandwidth'), fitted.axes)
    unit = put(with_neutral(fitted, ['bandwidth']), names, ratios)
    return replace(unit, covariance=scipy.linalg.block_diag(fitted.covariance, np.diag(variances)),
                   covariance_names=(*fitted.covariance_names, *names)), []
