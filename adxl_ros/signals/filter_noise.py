# SPDX-License-Identifier: Apache-2.0

"""The filter of a sensor by its noise at rest: the likelihood of the periodogram (Whittle)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from adxl_ros.model.effects import effect_named
from adxl_ros.model.sensor import names_of, put, Sensor, with_neutral
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
import scipy

_SEGMENT_S = 1.0  # Length of a segment of the periodogram, s. Chosen: several fit into a rest
_MIN_SEGMENT_SAMPLES = 16  # Fewest samples of a segment. Chosen: fewer show no filter
_LOWEST_BINS = 2  # Highest bin that is left out: mean, drift and flicker dominate in bins 0 to 2
_INDEPENDENT_SEGMENTS = 0.95  # Independent periodograms a segment: Hann, half overlap
_CORRELATED_ORDINATES = 35 / 18  # Ordinates a degree of freedom behind a Hann window
_ADC_NOISE_PRIOR_STD = 0.7  # Prior std of ln(ADC variance / (LSB²/12)). Chosen: factor 2
_MIN_VARIANCE_V2 = 1e-18  # Lower bound of the start value of the noise variance, V²
_MIN_LSB_V = 1e-9  # Lower bound of the ADC's step, V, for samples without rounding
_LOG_STEP = 1e-4  # Step of the central differences, in the logarithm of a parameter
_MAX_LOG = 80.0  # Largest |ln| of a parameter, so that exp stays finite
_MIN_EXPECTED_V2 = 1e-300  # Lower bound of an ordinate, V², for its logarithm
_MAX_CONDITION = 1e12  # Largest condition number of the information matrix that can be inverted
_MAX_RATIO_STD = 0.1  # Largest relative std of a credible RC. Chosen: below the ±25 % of R
_MAX_SCATTER = 2.0  # Largest relative scatter. Chosen: flicker and hum exceed it


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


def estimate_filter(
    rests: Iterable[np.ndarray], rate_hz: float, rc_s: float, lsb_v: float
) -> FilterNoise | None:
    """Estimate the RC of one axis by the likelihood of the periodogram of its rests (Whittle)."""
    # scipy.signal takes 0.3 s to import, which a calibration needs only at its end.
    from scipy.signal.windows import hann

    size = max(_MIN_SEGMENT_SAMPLES, round(_SEGMENT_S * rate_hz))
    window = hann(size, sym=False)
    window /= np.sqrt(np.sum(window**2))
    power, count = _mean_periodogram(rests, window)
    has_noise = count > 1 and np.any(power)
    if not has_noise or not rc_s:
        return None
    weight = _INDEPENDENT_SEGMENTS * count
    lags = np.correlate(window, window, 'full')[size - 1 :]
    start = np.log(
        [
            max(float(np.mean(power)) / size, lsb_v**2, _MIN_VARIANCE_V2),
            rc_s * rate_hz,
            max(lsb_v, _MIN_LSB_V) ** 2 / 12,
        ]
    )

    def cost(x: np.ndarray) -> float:
        """Return the negative log posterior for the parameters of `_expected`."""
        expected = _expected(x, lags)
        prior = ((x[2] - start[2]) / _ADC_NOISE_PRIOR_STD) ** 2
        return float(np.sum(power / expected + np.log(expected)) + prior / (2 * weight))

    best = scipy.optimize.minimize(
        cost, start, method='Nelder-Mead', options={'xatol': 1e-5, 'fatol': 1e-6, 'maxiter': 2000}
    ).x
    information = _information(best, lags, weight)
    # White noise does not show a filter.
    if np.linalg.cond(information) > _MAX_CONDITION:
        return None
    scatter = float(np.mean((power / _expected(best, lags) - 1) ** 2) * weight)
    ratio_std = float(np.sqrt(np.linalg.inv(information)[1, 1] * max(scatter, 1.0)))
    return FilterNoise(float(np.exp(best[1]) / rate_hz), ratio_std, scatter)


def _information(x: np.ndarray, lags: np.ndarray, weight: float) -> np.ndarray:
    """Return the information on the parameters of `_expected`, (3, 3), the prior included."""
    ratios = [
        np.log(_expected(x + step, lags) / _expected(x - step, lags))
        for step in _LOG_STEP * np.eye(3)
    ]
    slopes = np.array(ratios) / (2 * _LOG_STEP)
    information = slopes @ slopes.T * weight / _CORRELATED_ORDINATES
    information += np.diag([0.0, 0.0, _ADC_NOISE_PRIOR_STD**-2])
    return information


def _mean_periodogram(rests: Iterable[np.ndarray], window: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the mean periodogram of all segments above the lowest bins, V², and their number."""
    size = len(window)
    parts = np.concatenate(
        [
            np.empty((0, size)),
            *(
                sliding_window_view(volts, size)[:: size // 2]
                for volts in rests
                if len(volts) >= size
            ),
        ]
    )
    spectra = np.fft.rfft(window * (parts - parts.mean(axis=1, keepdims=True)))
    power = (np.abs(spectra) ** 2).sum(axis=0) / max(len(parts), 1)
    return power[_LOWEST_BINS + 1 :], len(parts)


def _expected(x: np.ndarray, lags: np.ndarray) -> np.ndarray:
    """Return the expected periodogram, V², for the logarithms of σ², RC/dt and the ADC's σ²."""
    variance_v2, rc_samples, adc_variance_v2 = np.exp(np.clip(x, -_MAX_LOG, _MAX_LOG))
    covariance = variance_v2 * np.exp(-np.arange(len(lags)) / rc_samples)
    covariance[0] += adc_variance_v2
    terms = covariance * lags
    expected = 2 * np.fft.rfft(terms).real - terms[0]
    return np.maximum(expected[_LOWEST_BINS + 1 :], _MIN_EXPECTED_V2)


def with_filter(
    fitted: Sensor, estimates: Sequence[Sequence[FilterNoise | None]]
) -> tuple[Sensor, list[str]]:
    """Add the effect `bandwidth` with its variance to a fitted sensor."""
    if not fitted.rc_s or not estimates:
        return fitted, []
    ratios = []
    variances = []
    for axis, axis_estimates in zip(fitted.axes, zip(*estimates)):
        credible = [
            estimate for estimate in axis_estimates if estimate is not None and estimate.credible
        ]
        if not credible:
            return fitted, [
                f'{axis}: the noise at rest does not fit white noise behind the '
                'stated filter; the fit keeps the stated resistor'
            ]
        weights = np.array([estimate.ratio_std**-2 for estimate in credible])
        rc_s = np.average([estimate.rc_s for estimate in credible], weights=weights)
        ratios.append(rc_s / fitted.rc_s - 1)
        variances.append((rc_s / fitted.rc_s) ** 2 / weights.sum())
    names = names_of(effect_named('bandwidth'), fitted.axes)
    filtered = put(with_neutral(fitted, ['bandwidth']), names, ratios)
    return replace(
        filtered,
        covariance=scipy.linalg.block_diag(fitted.covariance, np.diag(variances)),
        covariance_names=(*fitted.covariance_names, *names),
    ), []
