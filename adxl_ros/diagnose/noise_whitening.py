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
Noise that can drift, whitened: white noise behind the filter, the ADC's steps, a wandering zero-g.

y = n + w + d with n an AR(1) sequence of a = exp(−dt/RC), w white and d a random walk is
(1 − aL)(1 − L)·y = an MA(2), whose factor is found from its spectrum (Brockwell and Davis 1991,
section 3.2). Below the corner where 1/f noise meets the white, poles and zeros in turn whiten it,
one pair a decade (Corsini and Saletti 1988, IEEE Trans. Instrum. Meas. 37). The innovations are
white; their variance is fitted, so that the level of the noise need not be known, only how fast
the zero-g wanders by it, which is searched on a grid. Whitened residuals are therefore neither
fooled by correlation nor by drift.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from adxl_ros.diagnose.baseline_comparison import Series
from adxl_ros.model import noise
import numpy as np
from scipy.signal import sosfilt, sosfreqz, tf2sos, zpk2sos

DRIFTS = ('bias_walk', 'flicker')
"""The effects that let the zero-g wander."""
WALKS_G_PER_RTS = (1e-7, 3e-6, 1e-5, 3e-5, 3.8e-5, 5e-5, 8e-5, 2e-4, 6e-4, 2e-3)
"""Densest where healthy ends: between two steps a walk would look like something unknown."""
FLICKERS_G_PER_RTHZ = (3e-5, 6e-5, 8e-5, 1.2e-4, 2.5e-4, 5e-4, 1e-3, 2e-3, 4e-3)
HEALTHY = {'bias_walk': 3e-5, 'flicker': 6e-5}
"""What a unit without these effects may show: 0.3 mg within 100 s, 0.2 mg over five decades."""
USUAL, _DECADES = 1e-5, 1.0
"""What is usual of both, and how far it may be from that, as a standard deviation."""
_LOWEST_NOISE_V = 1e-7


def drifts_among(effects: Iterable[str]) -> tuple[str, ...]:
    """Return those by which the zero-g may wander."""
    return tuple(e for e in effects if e in DRIFTS)


@dataclass(frozen=True)
class Whitener:
    """
    A filter that makes noise white, and how likely such noise is.

    Attributes
    ----------
    sections
        Of second order, (s, 6).
    log_prior
        Of such noise.
    drift, density
        Effect that it is for, and how much of that, in its own unit.

    """

    sections: np.ndarray
    log_prior: float
    drift: str
    density: float

    @property
    def healthy(self) -> bool:
        """Whether a unit without the effect may wander so."""
        return self.density <= HEALTHY[self.drift]

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Filter series, (k, n)."""
        return sosfilt(self.sections, values)


def whiteners(series: Series, d: int) -> list[Whitener]:
    """Return the filters for the noise that is tried, for axis d of a recording."""
    sensor = series.sensor
    rc_s, _ = noise.electronics(sensor)
    dt_s = float(np.median(np.diff(series.time_s)))
    a = float(np.exp(-dt_s / rc_s[d])) if rc_s[d] else 0.0
    level = max(float(noise.analog_sigma_v(sensor)[d]), _LOWEST_NOISE_V)
    steps = sensor.lsb_v / np.sqrt(12)
    scale = float(sensor.scale_v_per_g[d])
    pole, apart = np.array([1, -a]), np.array([1, -1.0])
    out = []
    for walk in WALKS_G_PER_RTS:
        spectrum = (level ** 2 * (1 - a * a) * _square(apart, 2)
                    + steps ** 2 * _square(np.convolve(pole, apart), 2)
                    + (walk * scale) ** 2 * dt_s * _square(pole, 2))
        out.append(_whitener(tf2sos(np.convolve(pole, apart), _factor(spectrum, 2)),
                             'bias_walk', walk))
    still = _factor(level ** 2 * (1 - a * a) * _square(np.ones(1), 1)
                    + steps ** 2 * _square(pole, 1), 1)
    white_v2_per_hz = 2 * dt_s * (level ** 2 * (1 + a) / (1 - a) + steps ** 2)
    span_s = float(series.time_s[-1] - series.time_s[0])
    for density in FLICKERS_G_PER_RTHZ:
        corner_hz = (density * scale) ** 2 / white_v2_per_hz
        top_hz = min(corner_hz, 0.25 / dt_s)
        decades = int(np.ceil(max(np.log10(top_hz * span_s), 0.0)))
        zeros, poles = _in_turn(top_hz, decades, dt_s)
        out.append(_whitener(zpk2sos([a, *zeros], [-still[1], *poles], 1.0), 'flicker', density))
        if corner_hz > top_hz:
            break
    # 1/f noise that the filter did not pass is all there is where it exceeds the rest at the
    # filter's corner.
    if a:
        zeros, poles = _in_turn(0.4 / dt_s, int(np.ceil(np.log10(span_s / dt_s))), dt_s)
        least = np.sqrt(white_v2_per_hz / (2 * np.pi * rc_s[d])) / scale
        out.append(_whitener(zpk2sos(zeros, poles, 1.0), 'flicker',
                             max(float(least), 2 * HEALTHY['flicker'])))
    return out


def _in_turn(top_hz: float, decades: int, dt_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return zeros and poles, one pair a decade, that rise as the root of frequency to the top."""
    bends_hz = top_hz * 10.0 ** -np.arange(decades)
    return (np.exp(-2 * np.pi * dt_s * bends_hz * 10 ** -0.5),
            np.exp(-2 * np.pi * dt_s * bends_hz))


def _whitener(sections: np.ndarray, drift: str, density: float) -> Whitener:
    return Whitener(sections, -0.5 * (np.log10(density / USUAL) / _DECADES) ** 2, drift, density)


def flicker_g_per_rthz(whiten: Whitener, variance_v2: float, series: Series, d: int) -> float:
    """Return the density at 1 Hz, root of one-sided, of noise that a filter makes white."""
    dt_s = float(np.median(np.diff(series.time_s)))
    _, gain = sosfreqz(whiten.sections, [2 * np.pi * dt_s])
    at_1_hz_v = np.sqrt(2 * dt_s * variance_v2) / np.abs(gain[0])
    return float(at_1_hz_v / series.sensor.scale_v_per_g[d])


def near(filters: Sequence[Whitener], best: int) -> list[Whitener]:
    """Return the best filter and its neighbours, enough where the noise is already known."""
    return [f for i, f in enumerate(filters)
            if abs(i - best) <= 1 and f.drift == filters[best].drift]


def _square(polynomial: np.ndarray, order: int) -> np.ndarray:
    """Return |p(L)|² by powers of L from −order to order."""
    whole = np.convolve(polynomial, polynomial[::-1])
    spare = order - (len(polynomial) - 1)
    return np.pad(whole, spare)


def _factor(spectrum: np.ndarray, order: int) -> np.ndarray:
    """Return the monic polynomial with all roots inside the circle whose square is this."""
    trimmed = np.trim_zeros(np.where(np.abs(spectrum) > 1e-14 * spectrum.max(), spectrum, 0.0))
    roots = np.roots(trimmed)
    inside = roots[np.argsort(np.abs(roots))[:len(roots) // 2]]
    found = np.atleast_1d(np.real(np.poly(inside)))
    return np.pad(found, (0, order + 1 - len(found)))
