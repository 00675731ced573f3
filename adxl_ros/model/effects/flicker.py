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

"""Flicker noise: 1/f noise as a sum of Ornstein-Uhlenbeck processes."""

from functools import lru_cache

from adxl_ros.model.diagnosis_hints import DiagnosisHints, DriftSpectrum, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import ActsOn, Effect, Parameter, Parameters, Place, Signals
from adxl_ros.model.filters import first_order_recursion
import numpy as np

_LOWEST_HZ = 1e-5
"""Lowest corner, Hz; chosen: the density is 1/f from ten times this."""

_HIGHEST_RATIO = 10 ** -0.5
"""Highest corner divided by the sample rate; chosen: aliasing replaces the missing corners."""

_PER_DECADE = 2
"""Corners per decade; chosen: the sum is 1/f within 2 % up to a fifth of the sample rate."""


def apply(signals: Signals, p: Parameters) -> None:
    """
    Add noise of the one-sided density k²/f, g²/Hz, from 10⁻⁴ Hz up to a fifth of the rate.

    Ornstein-Uhlenbeck processes of equal variance, whose corners are evenly spaced on a
    logarithmic axis, sum up to 1/f (van der Ziel 1950). Each is sampled exactly.
    """
    assert signals.rng is not None
    corners = corners_hz(1 / signals.dt_s)
    shape = np.shape(signals.environment.time_s)
    drawn = signals.rng.standard_normal((*shape, len(p['density_g_per_rthz']), len(corners)))
    # The densities of the processes, σ²·2/(π·f_c)/(1 + (f/f_c)²), sum up to σ²/(f·Δln f).
    sigma = np.sqrt(np.log(10) / _PER_DECADE)
    decay = np.exp(-2 * np.pi * corners * signals.dt_s)
    for d, density in enumerate(p['density_g_per_rthz']):
        if not density or not shape[0]:
            continue
        previous = signals.memory.get(d)
        noise = np.zeros(shape)
        last = np.empty((len(corners), *shape[1:]))
        for i, a in enumerate(decay):
            step = np.sqrt(1 - a * a)
            steps = drawn[..., d, i].copy()
            if previous is None:
                steps[0] /= step  # stationary from the first sample on
            x = first_order_recursion(step, a, steps, 0.0 if previous is None else previous[i])
            noise += x
            last[i] = x[-1]
        signals.memory[d] = last
        signals.volts[d] = (signals.volts[d]
                            + density * sigma * noise * signals.nominal_scale_v_per_g[d])


@lru_cache(maxsize=8)
def corners_hz(rate_hz: float) -> np.ndarray:
    """Return the corners of the processes for a sample rate, Hz, the highest first."""
    highest = _HIGHEST_RATIO * rate_hz
    count = int(np.log10(highest / _LOWEST_HZ) * _PER_DECADE) + 1
    return highest * 10 ** (-np.arange(count) / _PER_DECADE)


EFFECT = Effect(
    name='flicker',
    place=Place.ADC,
    parameters=(
        Parameter('density_g_per_rthz', 'g/sqrt(Hz)', 0.0, 0.1, 1e-4,
                  'physics: corner near 1 Hz at 110 ug/sqrt(Hz)',
                  'density at 1 Hz; it falls with the root of the frequency'),
    ),
    apply=apply,
    acts_on=ActsOn.NOISE,
    cause='The electronics have 1/f noise; average shorter and take the zero more often.',
    # A healthy unit has 0.2 mg rms over five decades of frequency at most (tuned by hand on
    # simulated recordings).
    diagnosis=DiagnosisHints(drift=DriftSpectrum.FLICKER, healthy_density=6e-5,
                             revealed_by=Manoeuvre.HEAT,
                             proof=(ProofVariable.FREQUENCY,)),
)
