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

y = n + w + d with n an AR(1) sequence of a = exp(−dt/RC), w white and d a random walk that forgets
by b = exp(−dt/τ) a sample, is (1 − aL)(1 − bL)·y = an MA(2), whose factor is found from its
spectrum (Brockwell and Davis 1991, section 3.2). Its innovations are white; their variance is
fitted, so that the level of the noise need not be known, only how fast the zero-g wanders by it,
and how soon it comes back, which is searched on a grid. Whitened residuals are therefore neither
fooled by correlation nor by drift.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from adxl_ros.gap.series import Series
from adxl_ros.model import noise
import numpy as np
from scipy.signal import lfilter

WALKS_G_PER_RTS = (1e-7, 3e-6, 1e-5, 3e-5, 1e-4, 3e-4, 1e-3, 3e-3)
RETURNING = ((1e-4, 10.0), (2e-4, 10.0), (5e-5, 100.0), (3e-4, 100.0), (1e-3, 100.0),
             (3e-3, 100.0))
"""Wandering of the zero-g that is tried: for good, and coming back within a time, s. 1/f noise is
between them."""
HEALTHY_G_PER_RTS, _HEALTHY_G = 1e-4, 5e-4
"""1 mg within 100 s; what wanders more has the effect `bias_walk`."""
USUAL_G_PER_RTS, _DECADES = 2e-5, 1.0
"""What is usual (`bias_walk`), and how far it may be from that, as a standard deviation."""
_LOWEST_NOISE_V = 1e-7


@dataclass(frozen=True)
class Whitener:
    """
    A filter num(L)/den(L) that makes the noise white, and how likely such noise is.

    Attributes
    ----------
    walk_g_per_rts
        Wandering that it is for.
    healthy
        Whether a unit without the effect `bias_walk` may wander so.

    """

    num: np.ndarray
    den: np.ndarray
    log_prior: float
    walk_g_per_rts: float
    healthy: bool

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Filter series, (k, n)."""
        return lfilter(self.num, self.den, values)


def whiteners(series: Series, d: int) -> list[Whitener]:
    """Return the filters for the walks that are tried, for axis d of a recording."""
    sensor = series.sensor
    rc_s, _ = noise.electronics(sensor)
    dt_s = float(np.median(np.diff(series.time_s)))
    a = float(np.exp(-dt_s / rc_s[d])) if rc_s[d] else 0.0
    level = max(float(noise.analog_sigma_v(sensor)[d]), _LOWEST_NOISE_V)
    steps = sensor.lsb_v / np.sqrt(12)
    scale = float(sensor.scale_v_per_g[d])
    out = []
    for walk, back_s in (*((walk, np.inf) for walk in WALKS_G_PER_RTS), *RETURNING):
        pole, apart = np.array([1, -a]), np.array([1, -np.exp(-dt_s / back_s)])
        spectrum = (level ** 2 * (1 - a * a) * _square(apart, 2)
                    + steps ** 2 * _square(np.convolve(pole, apart), 2)
                    + (walk * scale) ** 2 * dt_s * _square(pole, 2))
        out.append(Whitener(np.convolve(pole, apart), _factor(spectrum),
                            -0.5 * (np.log10(walk / USUAL_G_PER_RTS) / _DECADES) ** 2,
                            walk, walk <= HEALTHY_G_PER_RTS
                            or walk * np.sqrt(back_s / 2) <= _HEALTHY_G))
    return out


def near(filters: Sequence[Whitener], best: int) -> list[Whitener]:
    """Return the best filter and its neighbours, enough where the noise is already known."""
    return [f for i, f in enumerate(filters) if abs(i - best) <= 1]


def _square(polynomial: np.ndarray, order: int) -> np.ndarray:
    """Return |p(L)|² by powers of L from −order to order."""
    whole = np.convolve(polynomial, polynomial[::-1])
    spare = order - (len(polynomial) - 1)
    return np.pad(whole, spare)


def _factor(spectrum: np.ndarray) -> np.ndarray:
    """Return the monic polynomial with all roots inside the circle whose square is this."""
    trimmed = np.trim_zeros(np.where(np.abs(spectrum) > 1e-14 * spectrum.max(), spectrum, 0.0))
    roots = np.roots(trimmed)
    inside = roots[np.argsort(np.abs(roots))[:len(roots) // 2]]
    return np.real(np.poly(inside))
