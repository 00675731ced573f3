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

"""Signals that the chain and several faults use: filters, 1/f noise and memory of travel."""

from __future__ import annotations

import math

import numpy as np
import scipy


def pink_noise(t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """
    Draw 1/f noise as a sum of relaxations at half-decade steps, each of variance 1.

    Parameters
    ----------
    t
        Equidistant instants, s, (n,).
    rng
        The random generator.

    Returns
    -------
    numpy.ndarray
        The noise, (n,).

    """
    noise = np.zeros_like(t)
    dt = t[1] - t[0]
    for lag in dt * 10 ** np.arange(0.5, math.log10(2 * (t[-1] - t[0]) / dt), 0.5):
        keep = math.exp(-dt / lag)
        noise += scipy.signal.lfilter([math.sqrt(1 - keep * keep)], [1, -keep],
                                      rng.normal(size=len(t)), zi=[keep * rng.normal()])[0]
    return noise


def low_pass(values: np.ndarray, lag: float, dt: float) -> np.ndarray:
    """
    Filter by one slow pole that is at rest before the first value.

    Parameters
    ----------
    values
        The signal, (..., n).
    lag
        Time constant, s.
    dt
        Step, s.

    Returns
    -------
    numpy.ndarray
        The filtered signal, (..., n).

    """
    keep = np.exp(-dt / lag)
    first = values[..., :1]
    return first + scipy.signal.lfilter([1 - keep], [1, -keep], values - first)


def travel_memory(x: np.ndarray, travel: float) -> np.ndarray:
    """
    Return the direction of the last travel, forgotten exponentially with the distance.

    Parameters
    ----------
    x
        A position, (n,).
    travel
        Distance that forgets all but 1/e, in the unit of `x`.

    Returns
    -------
    numpy.ndarray
        From −1 to 1, (n,).

    """
    direction = np.sign(np.diff(x, prepend=x[0]))
    moving = np.flatnonzero(direction)
    memory = np.zeros_like(x)
    if not len(moving):
        return memory
    turns = moving[np.flatnonzero(np.diff(direction[moving], prepend=0))]
    level = 0.0
    for start, stop in zip(turns, [*turns[1:], len(x)]):
        s = direction[start]
        distance = np.abs(x[start:stop] - x[start - 1])
        memory[start:stop] = s + (level - s) * np.exp(-distance / travel)
        level = memory[stop - 1]
    return memory
