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

from adxl_ros.blind.world.fault import Shape
from adxl_ros.blind.world.unit import Unit
import numpy as np

_SINGLE_SHARE = 0.4
"""Share of the faults that have one weight only; chosen."""
_LOG_SPREAD = 0.4
"""Standard deviation of the logarithm of a weight; chosen."""


def weights(count: int, rng: np.random.Generator) -> np.ndarray:
    """
    Draw weights with rms 1 over those that are not 0: one of them, or all.

    Parameters
    ----------
    count
        Number of weights.
    rng
        The random generator.

    Returns
    -------
    numpy.ndarray
        The weights, (count,).

    """
    w = rng.choice([-1.0, 1.0], count) * np.exp(rng.normal(0, _LOG_SPREAD, count))
    if rng.random() < _SINGLE_SHARE:
        w *= np.arange(count) == rng.integers(count)
    return w / np.sqrt(np.mean(w[w != 0] ** 2))


def draw_weights(count: int, rng: np.random.Generator, unit: Unit) -> Shape:
    """
    Draw a number of weights that do not depend on the axes of the unit.

    Parameters
    ----------
    count
        Number of weights.
    rng
        The random generator.
    unit
        Any unit.

    Returns
    -------
    dict
        The shape.

    """
    return {'w': weights(count, rng)}


def single_weights(count: int, unit: Unit) -> list[Shape]:
    """
    Return a shape for each weight alone.

    Parameters
    ----------
    count
        Number of weights.
    unit
        Any unit.

    Returns
    -------
    list of dict
        The shapes.

    """
    return [{'w': row} for row in np.eye(count)]


def equal_weights(count: int, unit: Unit) -> list[Shape]:
    """
    Return the shape whose weights are all 1.

    Parameters
    ----------
    count
        Number of weights.
    unit
        Any unit.

    Returns
    -------
    list of dict
        The one shape.

    """
    return [{'w': np.ones(count)}]


def by_axis(rng: np.random.Generator, unit: Unit) -> Shape:
    """
    Draw a weight for each axis of the unit.

    Parameters
    ----------
    rng
        The random generator.
    unit
        The unit.

    Returns
    -------
    dict
        The shape.

    """
    return {'w': weights(len(unit.axes), rng)}


def all_axes(unit: Unit) -> list[Shape]:
    """Return the shape with all axes at once."""
    return [{'w': np.ones(len(unit.axes))}]


def column(shape: Shape) -> np.ndarray:
    """Return the weights as a column, (m, 1)."""
    return np.asarray(shape['w'])[:, None]
