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
Whether what passes for a zero-g that wanders is one.

The evidence takes whatever comes and goes slowly for a drift. A drift is the same all the time,
and a random walk has its share in every octave; a warm draught or a floor that sways crowds a few
of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, pairwise

from adxl_ros.diagnose.baseline_comparison import Series
from adxl_ros.diagnose.evidence import block_edges, bridged
from adxl_ros.diagnose.hypothesis_fit import Hypothesis
from adxl_ros.diagnose.linear_model import Study
from adxl_ros.diagnose.noise_whitening import WALKS_G_PER_RTS, Whitener
import numpy as np
from scipy.optimize import minimize_scalar
from scipy.signal import sosfreqz

_FEW = 4.0
"""Octaves with more than so many times the walk's power, or so many times less, are not of it."""
_TAPERED = 0.6
"""Of neighbouring frequencies under a Hann window so many are independent (Harris 1978)."""
_COLOUR_S = 0.1
"""Strong noise of another colour than the filter's stays correlated so long."""


def unevenness(of: Study, found: Hypothesis) -> float:
    """
    Return how unlike each other the stretches are: 1 where the noise is the same in all of them.

    The rms, over stretches, of what each one's squares depart from the mean by, in standard
    deviations of such a sum (of correlated samples Bartlett 1946); of the axis where it is
    largest.
    """
    most = 0.0
    for one, mask, column, walk in _channels(of, found):
        white = walk(column[None])[0] * mask
        white[0] = 0.0
        if not white.any():
            continue
        spectrum = np.abs(np.fft.rfft(white, 2 * len(white))) ** 2
        alike = np.fft.irfft(spectrum)[:1 + int(_COLOUR_S * one.sensor.rate_hz)]
        times = 1 + 2 * float(np.sum((alike[1:] / alike[0]) ** 2))
        edges = block_edges(len(white))[:-1]
        counts = np.add.reduceat(mask, edges).astype(float)
        squares = np.add.reduceat(white ** 2, edges)[counts > 0]
        counts = counts[counts > 0]
        depart = (squares / counts * mask.sum() / squares.sum() - 1) * np.sqrt(counts / 2 / times)
        most = max(most, float(np.sqrt(np.mean(depart ** 2))))
    return most


def crowding(of: Study, found: Hypothesis) -> float:
    """
    Return by how many nats octaves of a random walk are fuller or emptier than it has them.

    Whittle's likelihood of the whitened residual, summed over the axes that walk more than a
    healthy unit's: a periodogram of the walk's own mean against one of the mean that is seen,
    over the run of octaves that tells most. 0 where nothing walks.
    """
    return sum(_nats(*_beside_walk(column, mask, walk, of.filters[number],
                                   float(found.fit.variance[number])))
               for number, (_, mask, column, walk) in enumerate(_channels(of, found))
               if walk.drift == 'bias_walk' and not walk.healthy)


def _channels(of: Study, found: Hypothesis
              ) -> Iterator[tuple[Series, np.ndarray, np.ndarray, Whitener]]:
    """Give by axis of each recording it, samples that count, what is left, V, and its filter."""
    number = 0
    for one, mask in zip(of.series, of.used):
        for column in bridged(one.residual(found.sensor), mask).T:
            yield one, mask, column, of.filters[number][found.fit.walks[number]]
            number += 1


def _beside_walk(residual: np.ndarray, used: np.ndarray, walk: Whitener,
                 tried: list[Whitener], variance_v2: float) -> tuple[np.ndarray, np.ndarray]:
    """Give by octave, as far as it walks, how many frequencies, and power by what is expected."""
    white = walk(residual[None])[0] * used
    white[0] = 0.0
    taper = np.sqrt(8 / 3) * np.hanning(len(white))
    power = np.abs(np.fft.rfft(white * taper)) ** 2 / (used.sum() * variance_v2)
    angle = 2 * np.pi * np.arange(len(power)) / len(white)
    still = next(f for f in tried if f.density == WALKS_G_PER_RTS[0])
    gain, at_rest = (np.abs(sosfreqz(f.sections, angle)[1]) ** 2 for f in (walk, still))
    # What does not walk has this share of the whitened power.
    share = np.zeros(len(power))
    share[1:] = np.minimum(gain[1:] / at_rest[1:] * (at_rest[-1] / gain[-1]), 1.0)
    top = int(np.argmax(share > 0.5))
    band = slice(1, 4 * top)

    def lacks(log_more: float) -> float:
        mean = share[band] + np.exp(log_more) * (1 - share[band])
        return float(np.sum(np.log(mean) + power[band] / mean))
    # The grid of filters is wide: how much of the walk there is, is fitted.
    more = np.exp(minimize_scalar(lacks, bounds=(-3.0, 3.0), method='bounded').x)
    power = power / (share + more * (1 - share))
    edges = np.unique(np.minimum(2 ** np.arange(int(np.log2(max(top, 1))) + 2), top))
    return np.diff(edges), np.array([power[i:j].mean() for i, j in pairwise(edges)])


def _nats(counts: np.ndarray, means: np.ndarray) -> float:
    most = 0.0
    for begin, end in combinations(range(len(counts) + 1), 2):
        count = counts[begin:end].sum()
        mean = max(float(np.average(means[begin:end], weights=counts[begin:end])), 1e-9)
        if not 1 / _FEW < mean < _FEW:
            most = max(most, _TAPERED * count * (mean - 1 - np.log(mean)))
    return most
