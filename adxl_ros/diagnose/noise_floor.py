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

from adxl_ros.diagnose.baseline_comparison import Series
from adxl_ros.model import noise
from adxl_ros.model.kinematics import specific_force
import numpy as np

_SHORTEST_S = 1.0
_FEWEST = 200
_OVERLAP_S, _APART_S, _STEPS, _MOVED = 20.0, 10.0, 5.0, 0.05


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
        'still' stretches, 'repeats' of a trajectory, or 'assumed' from the parameter file.

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
    Find the floor: noise about the mean of still stretches; else what differs between repeats.

    With neither it is what the parameters promise.

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
    repeated = None if count >= _FEWEST else repeats_v(series, used)
    if count >= _FEWEST:
        sigma, source = np.sqrt(squares / count), 'still'
    elif repeated is not None:
        sigma, source = repeated, 'repeats'
    else:
        sigma, source = noise.sigma_v(first.sensor), 'assumed'
    by_stage = np.mean([_by_stage(one, mask) for one, mask in zip(series, used)])
    mps2 = sigma / first.scale_v_per_mps2
    return Floor(sigma, float(np.sqrt(np.mean(mps2 ** 2) + by_stage)), source)


def repeats_v(series: Sequence[Series], used: Sequence[np.ndarray]) -> np.ndarray | None:
    """
    Return what differs between repeats of a trajectory, by √2, V, (m,); None without repeats.

    A repeat is a stretch of moving samples, in one recording or in two, over which the stage
    points where it pointed before, to a few steps of its encoder.
    """
    squares, count = 0.0, 0
    for i, one in enumerate(series):
        for j, other in enumerate(series[i:], i):
            if one.reference == 'stage' and other.reference == 'stage':
                found = _repeat(one, other, i == j)
                if found is not None:
                    here, there = found
                    both = used[i][here] & used[j][there]
                    apart = (other.residual(other.sensor)[there]
                             - one.residual(one.sensor)[here])[both]
                    squares = squares + ((apart - apart.mean(axis=0)) ** 2).sum(axis=0) / 2
                    count += len(apart)
    return np.sqrt(squares / count) if count >= _FEWEST else None


def _repeat(one: Series, other: Series, same: bool) -> tuple[slice, slice] | None:
    """Find the shift by which two recordings of directions agree best over 20 s at least."""
    rate = one.sensor.rate_hz
    if abs(rate / other.sensor.rate_hz - 1) > 1e-3:
        return None
    a, b = (np.array(specific_force(s.motion.alpha(s.time_s), s.motion.beta(s.time_s), 1.0))
            for s in (one, other))
    least, apart = round(_OVERLAP_S * rate), round(_APART_S * rate) if same else 0
    size = 2 ** int(np.ceil(np.log2(a.shape[1] + b.shape[1])))
    alike = np.fft.irfft((np.conj(np.fft.rfft(a, size)) * np.fft.rfft(b, size)).sum(axis=0), size)
    lags = np.arange(apart, max(b.shape[1] - least, apart))
    overlap = np.minimum(a.shape[1], b.shape[1] - lags)
    lags, overlap = lags[overlap >= least], overlap[overlap >= least]
    if not len(lags):
        return None
    off = 2 - 2 * alike[lags] / overlap
    best = int(np.argmin(off))
    lag, count = int(lags[best]), int(overlap[best])
    resolution = max(one.sensor.stage_resolution_rad, 1e-5)
    moved = a[:, :count].std(axis=1).max()
    if off[best] > (_STEPS * resolution) ** 2 or moved < _MOVED:
        return None
    return slice(0, count), slice(lag, lag + count)


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
