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

"""The floor: what noise and the stage's stated resolution leave, whatever is modelled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from adxl_ros.gap.series import Series
from adxl_ros.model import noise
import numpy as np

_SHORTEST_S = 1.0
_FEWEST = 200


@dataclass(frozen=True)
class Floor:
    """
    Rms of what is no gap, over samples and measured axes, m/s², and where it is known from.

    Attributes
    ----------
    noise_v
        Of the samples about their mean, by axis, V, (m,).
    rms_mps2
        With the stage's resolution.
    source
        'still' stretches, or 'assumed' from the parameter file.

    """

    noise_v: np.ndarray
    rms_mps2: float
    source: str


def runs(chosen: np.ndarray) -> list[tuple[int, int]]:
    """Return begin and end of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], chosen.astype(np.int8), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist()))


def floor(series: Sequence[Series], used: Sequence[np.ndarray]) -> Floor:
    """
    Find the floor: noise about the mean of still stretches; else what the parameters promise.

    Where the sensor never moves, slow changes are what is asked about: a stretch is a second.
    """
    squares, count = 0.0, 0
    for one, mask in zip(series, used):
        length = max(round(_SHORTEST_S * one.sensor.rate_hz), 4)
        for begin, end in runs(one.still & mask):
            for a in range(begin, end - length + 1, length):
                part = one.volts[a:a + length]
                squares = squares + ((part - part.mean(axis=0)) ** 2).sum(axis=0) \
                    * length / (length - _independent(one, length))
                count += length
    first = series[0]
    if count >= _FEWEST:
        sigma, source = np.sqrt(squares / count), 'still'
    else:
        sigma, source = noise.sigma_v(first.sensor), 'assumed'
    by_stage = np.mean([_by_stage(one, mask) for one, mask in zip(series, used)])
    mps2 = sigma / first.scale_v_per_mps2
    return Floor(sigma, float(np.sqrt(np.mean(mps2 ** 2) + by_stage)), source)


def _independent(series: Series, length: int) -> float:
    """Return how many samples the mean of a stretch takes out of its variance."""
    return length / float(noise.effective_samples(length, 1 / series.sensor.rate_hz,
                                                  series.sensor.rc_s))


def _by_stage(series: Series, used: np.ndarray) -> float:
    """Mean square that the encoder's step makes, over samples and axes, (m/s²)²."""
    step = series.sensor.stage_resolution_rad
    if series.reference != 'stage' or not step:
        return 0.0
    alpha, beta = (getattr(series.motion, j)(series.time_s)[used] for j in ('alpha', 'beta'))
    g, measured = series.sensor.local_gravity_mps2, len(series.sensor.axes)
    by_alpha = np.array([np.cos(alpha) * np.cos(beta), -np.cos(alpha) * np.sin(beta),
                         -np.sin(alpha)])[:measured]
    by_beta = np.array([-np.sin(alpha) * np.sin(beta), -np.sin(alpha) * np.cos(beta),
                        0 * alpha])[:measured]
    return float(g ** 2 * step ** 2 / 12 * np.mean(by_alpha ** 2 + by_beta ** 2))
