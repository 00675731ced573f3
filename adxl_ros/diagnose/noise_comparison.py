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
How alike recorded and simulated noise are: power by band, Allan deviation, likelihood.

The rms of a gap is blind to what is noise-like; here the residual about the mean is compared with
noise that the simulator itself makes, without and with what was found.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

from adxl_ros.diagnose.baseline_comparison import Series
from adxl_ros.diagnose.evidence import bridged
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate.response import Response
import numpy as np
from scipy.signal import periodogram, welch

_BANDS = 5
_TIMES_S = (0.1, 1.0, 10.0)
_SEGMENT_S = 16.0


@dataclass(frozen=True)
class Likeness:
    """
    Recorded noise by simulated noise, axes together.

    Attributes
    ----------
    bands_hz
        Edges of bands of frequency, (k + 1,).
    power
        Ratio of power by band, (k,); 1 is alike.
    times_s, allan
        Averaging times, (j,), and the ratio of Allan deviations, (j,).
    log_likelihood
        Of the recorded spectrum under the simulated one (Whittle 1953), nats.
    sigma_mps2
        Of the simulated noise, rms over samples and axes.

    """

    bands_hz: tuple[float, ...]
    power: tuple[float, ...]
    times_s: tuple[float, ...]
    allan: tuple[float, ...]
    log_likelihood: float
    sigma_mps2: float


def likeness(full: Series, residual_v: np.ndarray, used: np.ndarray, sensor: Sensor, seed: int
             ) -> Likeness:
    """
    Compare what is left of a recording with the noise of a sensor.

    Parameters
    ----------
    full
        The recording at its full rate.
    residual_v
        Less the mean of the output, V, (n, m).
    used
        Samples that count, (n,); the others are bridged.
    sensor
        Whose noise.
    seed
        Of the simulated noise.

    """
    noise_v = simulated_noise(full, sensor, seed)
    rate_hz = full.sensor.rate_hz
    seen, made = ((v - v.mean(axis=0)) / full.scale_v_per_mps2
                  for v in (bridged(residual_v, used), noise_v))
    frequency, power = periodogram(seen, rate_hz, axis=0)
    _, other = periodogram(made, rate_hz, axis=0)
    edges = np.geomspace(max(frequency[1], 0.05), rate_hz / 2, _BANDS + 1)
    edges[0] = 0.0
    ratios = [float(power[inside].sum() / other[inside].sum())
              for inside in ((frequency > low) & (frequency <= high)
                             for low, high in pairwise(edges))]
    length = min(round(_SEGMENT_S * rate_hz), len(made))
    at, level = welch(made, rate_hz, nperseg=max(length, 8), axis=0)
    expected = np.column_stack([np.interp(frequency[1:], at[1:], v[1:]) for v in level.T])
    expected = np.maximum(expected, 1e-6 * expected.max())
    times_s = [t for t in _TIMES_S if t * rate_hz >= 2 and t * 10 < len(seen) / rate_hz]
    allans = [[allan_deviation(v, round(t * rate_hz)) for v in (seen, made)] for t in times_s]
    return Likeness(tuple(edges.tolist()), tuple(ratios), tuple(times_s),
                    tuple(float(np.sqrt(np.mean((a / b) ** 2))) for a, b in allans),
                    -float(np.sum(power[1:] / expected + np.log(expected))),
                    float(np.sqrt(np.mean(made ** 2))))


def simulated_noise(full: Series, sensor: Sensor, seed: int) -> np.ndarray:
    """Return a sensor's output about its own mean, V, (n, m), drawn."""
    at_rate = replace(sensor, rate_hz=full.sensor.rate_hz)
    loud = Response(at_rate, full.motion, seed, float(full.time_s[0]))(full.time_s)
    return loud - full.simulated(at_rate)


def allan_deviation(values: np.ndarray, count: int) -> np.ndarray:
    """
    Return the overlapping Allan deviation of means of `count` samples (IEEE 1554), (m,).

    Parameters
    ----------
    values
        (n, m).
    count
        Samples in a mean, less than n/2.

    """
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    twice = total[2 * count:] - 2 * total[count:-count] + total[:-2 * count]
    return np.sqrt(np.mean(twice ** 2, axis=0) / 2) / count
