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
A reference that is smoother than the sensor, as motion capture is, or a filtered simulation.

Where it fades, the recording still follows it, but with a gain that grows with frequency. No
sensor does this beyond the gain that a missing RC filter would have.
"""

from __future__ import annotations

from adxl_ros.diagnose.baseline_comparison import BaselineComparison, Reference
from adxl_ros.model.noise import electronics
import numpy as np
import scipy

_WINDOW_S = 1.0
"""Length of the windows of the spectra, s. Chosen: it separates frequencies of 1 Hz."""
_SHORTEST_WINDOW = 64
"""Fewest samples of a window. Chosen: 33 frequencies."""
_USED = 0.9
"""Share of the samples of a window that are compared. Chosen: jumps of the force take a few."""
_FEWEST_WINDOWS = 20
"""Fewest windows. Chosen: noise then has a coherence of 0.05."""
_QUIET = 0.1
"""Share of the windows, those of the smallest power, that show the noise. Chosen: a recording
begins with a rest of some seconds."""
_BAND = 2
"""Frequencies that are averaged. Chosen: 2 Hz, so that a line of the mains is one value."""
_MOTION = 10.0
"""Power, divided by that of the noise, from which motion shows. Chosen: far above its scatter."""
_COHERENCE = 0.5
"""Coherence from which the recording follows the reference. Chosen: half of the power."""
_GAIN = 1.5
"""Gain of the recording over the reference, beyond that of a missing RC filter, that no sensor
has. Chosen: a third of the motion is then missing."""
_FADED = 0.5
"""Power of the reference, divided by the recorded one, below which it has faded."""


def fading_frequency_hz(comparison: BaselineComparison) -> float | None:
    """
    Find the frequency above which the reference has less motion than the sensor.

    Parameters
    ----------
    comparison
        A recording beside the simulator that follows another simulator.

    Returns
    -------
    float or None
        The frequency, Hz; None where the reference does not fade, or the motion ends below.

    """
    if comparison.reference is not Reference.SIMULATOR:
        return None
    sensor = comparison.sensor
    size = max(round(_WINDOW_S * sensor.rate_hz), _SHORTEST_WINDOW) // 2 * 2
    recorded_g, simulated_g = (v / sensor.scale_v_per_g for v in (
        comparison.volts, comparison.simulated_v(sensor)))
    is_finite = np.isfinite(recorded_g + simulated_g).all(axis=1)
    starts = [i for i in range(0, len(is_finite) - size + 1, size // 2)
              if is_finite[i:i + size].all() and comparison.used[i:i + size].mean() > _USED]
    if len(starts) < _FEWEST_WINDOWS:
        return None
    rows = np.array(starts)[:, None] + np.arange(size)
    recorded, simulated = (
        np.fft.rfft(scipy.signal.detrend(accel_g[rows], axis=1) * np.hanning(size)[None, :, None],
                    axis=1)
        for accel_g in (recorded_g, simulated_g))
    power = np.sum(np.abs(recorded) ** 2, axis=2)
    quiet = np.argsort(power.sum(axis=1))[:max(round(_QUIET * len(starts)), 2)]
    noise = _bands(power[quiet].mean(axis=0))
    recorded_power = _bands(power.mean(axis=0))
    simulated_power = _bands(np.mean(np.sum(np.abs(simulated) ** 2, axis=2), axis=0))
    shared = np.abs(_bands(np.mean(np.sum(np.conj(simulated) * recorded, axis=2), axis=0)))
    frequency_hz = _bands(np.fft.rfftfreq(size, 1 / sensor.rate_hz))
    # Without its RC filter the sensor has this gain over its simulation.
    unfiltered = np.sqrt(1 + (2 * np.pi * frequency_hz * float(np.max(electronics(sensor)[0])))
                         ** 2)
    moves = recorded_power > _MOTION * noise
    follows = shared ** 2 > _COHERENCE * simulated_power * recorded_power
    exceeds = moves & follows & (shared > _GAIN * unfiltered * simulated_power)
    faded = simulated_power < _FADED * recorded_power
    if not exceeds.any() or not faded[moves & (frequency_hz >= frequency_hz[exceeds][0])].all():
        return None
    followed = np.flatnonzero(moves & ~faded)
    first = followed[-1] + 1 if len(followed) else 0
    return float(frequency_hz[first])


def _bands(values: np.ndarray) -> np.ndarray:
    """Return means of neighbouring frequencies without the lowest one."""
    count = (len(values) - 1) // _BAND
    return values[1:1 + count * _BAND].reshape(count, _BAND).mean(axis=1)
