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

"""Shapes that many faults share: weights of axes and of directions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from adxl_ros.blind.world.chain import Run
from adxl_ros.blind.world.unit import Unit
import numpy as np
from scipy.signal import lfilter

Shape = dict[str, Any]
Draw = Callable[[np.random.Generator, Unit], Shape]
Act = Callable[[Run, float, Shape], None]


def weights(count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw weights with rms 1 over those that are not 0: one of them, or all."""
    w = rng.choice([-1.0, 1.0], count) * np.exp(rng.normal(0, 0.4, count))
    if rng.random() < 0.4:
        w *= np.arange(count) == rng.integers(count)
    return w / np.sqrt(np.mean(w[w != 0] ** 2))


def by_axis(rng: np.random.Generator, unit: Unit) -> Shape:
    """Draw a weight for each axis of the unit."""
    return {'w': weights(len(unit.axes), rng)}


def ones(unit: Unit) -> list[Shape]:
    """Span by all axes at once, each axis's part by itself."""
    return [{'w': np.ones(len(unit.axes))}]


def vector(count: int) -> dict[str, Callable[..., Any]]:
    """Give `draw` and `spread` of a fault with so many weights that axes share."""
    return {'draw': lambda rng, unit: {'w': weights(count, rng)},
            'spread': lambda unit: [{'w': row} for row in np.eye(count)]}


def column(shape: Shape) -> np.ndarray:
    """Give the weights as a column, (axes, 1)."""
    return np.asarray(shape['w'])[:, None]


def memory(x: np.ndarray, travel: float) -> np.ndarray:
    """Give the direction of the last travel, -1 to 1, forgotten exponentially over `travel`."""
    way = np.sign(np.diff(x, prepend=x[0]))
    moving = np.flatnonzero(way)
    out = np.zeros_like(x)
    if not len(moving):
        return out
    turns = moving[np.flatnonzero(np.diff(way[moving], prepend=0))]
    level = 0.0
    for start, stop in zip(turns, [*turns[1:], len(x)]):
        s = way[start]
        out[start:stop] = s + (level - s) * np.exp(-np.abs(x[start:stop] - x[start - 1]) / travel)
        level = out[stop - 1]
    return out


def low_pass(values: np.ndarray, lag: float, dt: float) -> np.ndarray:
    """Filter by one slow pole, at rest before the first value."""
    keep = np.exp(-dt / lag)
    first = values[..., :1]
    return first + lfilter([1 - keep], [1, -keep], values - first)
