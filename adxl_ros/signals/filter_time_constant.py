# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
The output filter's time constant from the colour of the noise at rest.

White noise behind a first-order filter is an AR(1) sequence, a = exp(−dt/RC), beside the white
steps of the ADC. Three figures are fitted to the mean periodogram of all rests by Whittle's
likelihood, each ordinate compared with its exact expectation behind window and sampling (the
debiased Whittle likelihood; Sykulski et al. 2019, doi 10.1093/biomet/asy071).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from adxl_ros.model.coefficients import names_of, put, with_neutral
from adxl_ros.model.effects import effect_named
from adxl_ros.model.sensor import Sensor
import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import minimize

_SEGMENT_S = 1.0
_FEWEST = 16
"""Samples in a segment, at least."""
_LOWEST_BINS = 2
"""Left out: the mean, drift and flicker live there."""
_OVERLAPPED = 0.95
"""Independent periodograms in a segment of a Hann window overlapped by half, by its number."""
_ALIKE = 35 / 18
"""Ordinates of a Hann window go along with their neighbours: so many are as good as one."""
_WHITE_STD = 0.7
"""Standard deviation of the logarithm of the ADC's white noise about LSB²/12."""
_LINE = 6.0
"""An ordinate this far above the others, in standard deviations, is a line (hum) and no noise."""
_SINGULAR = 1e12
_MOST_STD = 0.1
"""An estimate worse than this says nothing beside the ±25 % of the datasheet."""
_MOST_SCATTER = 2.0
"""Scatter of the ordinates by what chance gives, beyond which the noise is no filtered white."""


@dataclass(frozen=True)
class FilterNoise:
    """
    The filter as the noise shows it.

    Attributes
    ----------
    rc_s
        Time constant, s.
    ratio_std
        Relative standard deviation of it.
    scatter
        Mean square of the periodogram's deviations by what chance gives: 1 for filtered noise.

    """

    rc_s: float
    ratio_std: float
    scatter: float

    @property
    def credible(self) -> bool:
        """Tell whether the noise looks like white noise behind a filter, and says enough."""
        return self.scatter < _MOST_SCATTER and self.ratio_std < _MOST_STD


def estimate_filter(rests: Iterable[np.ndarray], rate_hz: float, rc_s: float, lsb_v: float
             ) -> FilterNoise | None:
    """
    Estimate the time constant of one axis; None without noise or a rest that is long enough.

    Parameters
    ----------
    rests
        Volts of each rest without gaps, (n,) each.
    rate_hz
        Sample rate.
    rc_s
        Stated time constant, s, to begin with.
    lsb_v
        Step of the ADC, V.

    """
    # scipy.signal takes 0.3 s to import, which a calibration needs only at its end.
    from scipy.signal.windows import hann
    size = max(_FEWEST, round(_SEGMENT_S * rate_hz))
    window = hann(size, sym=False)
    window /= np.sqrt(np.sum(window ** 2))
    total, count = np.zeros(size // 2 + 1), 0
    for volts in rests:
        for begin in range(0, len(volts) - size + 1, size // 2):
            part = volts[begin:begin + size]
            total += np.abs(np.fft.rfft(window * (part - part.mean()))) ** 2
            count += 1
    if count < 2 or not rc_s or not np.any(power := total / max(count, 1)):
        return None
    weight = _OVERLAPPED * count
    lags = np.correlate(window, window, 'full')[size - 1:]
    used = np.arange(len(power)) > _LOWEST_BINS
    start = np.log([max(float(np.mean(power[used])) / size, lsb_v ** 2, 1e-18),
                    rc_s * rate_hz, max(lsb_v, 1e-9) ** 2 / 12])
    white = float(start[2])

    def cost(x: np.ndarray) -> float:
        expected = np.maximum(_expected(x, lags)[used], 1e-300)
        return float(np.sum(power[used] / expected + np.log(expected))
                     + ((x[2] - white) / _WHITE_STD) ** 2 / (2 * weight))

    for _ in range(2):
        found = minimize(cost, start, method='Nelder-Mead',
                         options={'xatol': 1e-5, 'fatol': 1e-6, 'maxiter': 2000})
        off = power / _expected(found.x, lags) - 1
        used &= off < _LINE / np.sqrt(weight)
        if used.sum() < _FEWEST // 2:
            return None
        start = found.x
    scatter = float(np.mean(off[used] ** 2) * weight)
    information = _curvature(found.x, used, lags) * weight / _ALIKE
    information += np.diag([0.0, 0.0, _WHITE_STD ** -2])
    if np.linalg.cond(information) > _SINGULAR:
        return None     # noise that no filter has shaped: it says nothing of one
    ratio_std = float(np.sqrt(np.linalg.inv(information)[1, 1] * max(scatter, 1.0)))
    return FilterNoise(float(np.exp(found.x[1]) / rate_hz), ratio_std, scatter)


def _expected(x: np.ndarray, lags: np.ndarray) -> np.ndarray:
    """Return the expected periodogram for log of σ², RC in samples and the white part's σ²."""
    sigma2, rc, white = np.exp(np.clip(x, -80, 80))
    covariance = sigma2 * np.exp(-np.arange(len(lags)) / rc)
    covariance[0] += white
    terms = covariance * lags
    return 2 * np.fft.rfft(terms).real - terms[0]


def _curvature(x: np.ndarray, used: np.ndarray, lags: np.ndarray) -> np.ndarray:
    """Return the expected information of one periodogram, (3, 3): Σ ∂log S·∂log Sᵀ."""
    step = 1e-4
    slopes = np.array([(np.log(_expected(x + step * e, lags)[used])
                        - np.log(_expected(x - step * e, lags)[used])) / (2 * step)
                       for e in np.eye(3)])
    return slopes @ slopes.T


def with_filter(fitted: Sensor, found: Sequence[Sequence[FilterNoise | None]]
                ) -> tuple[Sensor, list[str]]:
    """
    Add the filter as the noise shows it to a fit: `bandwidth`, with its variance.

    Parameters
    ----------
    fitted
        The unit.
    found
        By recording and axis.

    Returns
    -------
    tuple
        The unit, as it was where the noise of an axis does not tell; and why, for people.

    """
    if not fitted.rc_s or not found:
        return fitted, []
    ratios, variances = [], []
    for axis, of_axis in zip(fitted.axes, zip(*found)):
        good = [one for one in of_axis if one is not None and one.credible]
        if not good:
            return fitted, [f'{axis}: the noise at rest does not look like white noise behind '
                            'the stated filter, whose resistor is taken as stated']
        weights = np.array([one.ratio_std ** -2 for one in good])
        rc_s = np.sum(weights * np.array([one.rc_s for one in good])) / weights.sum()
        ratios.append(rc_s / fitted.rc_s - 1)
        variances.append((rc_s / fitted.rc_s) ** 2 / weights.sum())
    names = names_of(effect_named('bandwidth'), fitted.axes)
    known = put(with_neutral(fitted, ['bandwidth']), names, ratios)
    return replace(known, covariance=block_diag(fitted.covariance, np.diag(variances)),
                   covariance_names=(*fitted.covariance_names, *names)), []
