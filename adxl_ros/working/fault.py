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
"""What a fault of a working case is: its function, its shape, and how the simulator runs it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from adxl_ros.model.effects import library
from adxl_ros.model.effects.base import Effect, Parameters, Place, Signals
import numpy as np

Shape = dict[str, Any]
"""Everything of a fault but its size, as JSON has it. `w` has the weights of the axes or of other
parts; `form` is 'library' where the fault has the form of the library."""

Act = Callable[[Signals, float, Shape], None]
"""Changes the signals by a fault of a size and a shape."""

Draw = Callable[[np.random.Generator, int], Shape]
"""Draws a shape for a number of axes."""

_SINGLE_SHARE = 0.3
"""Share of the faults that act on one axis, or by one weight, only; chosen."""
_EQUAL_SHARE = 0.3
"""Share of the faults whose weights are equal; chosen."""
_LOG_SPREAD = 0.35
"""Standard deviation of the logarithm of any other weight; chosen."""
LIBRARY_SHARE = 0.3
"""Share of the faults with the very form of the library; chosen."""


@dataclass(frozen=True)
class Kind:
    """
    A kind of faults.

    Attributes
    ----------
    name
        Effect of the library that is the right answer; a name of its own outside the library.
    place
        Place in the chain. Faults from ADC on change whole recordings.
    act
        Its function with a form that is not the library's; None where the form is exact.
    start, largest
        Size at which the search for a strength begins, and the largest size.
    draw
        Draws the shape.
    parameters : callable or None
        Turns size and shape into parameters of the library's form; None where only `act` exists.
    at_rest
        Whether a calibration at rest contains the fault, if the unit had it then.
    needs
        What the manoeuvre must have for it to show: 'heat', 'supply', 'shake' or 'fast'.
    listed
        Whether the library has the effect.

    """

    name: str
    place: Place
    act: Act | None
    start: float
    largest: float
    draw: Draw
    parameters: Callable[[float, Shape], Parameters] | None = None
    at_rest: bool = False
    needs: str = ''
    listed: bool = True


@dataclass(frozen=True)
class Fault:
    """
    A fault of a case.

    Attributes
    ----------
    kind
        Its kind.
    size
        Its size, in the unit of the kind.
    shape
        Its shape.

    """

    kind: Kind
    size: float
    shape: Shape

    def act(self, signals: Signals) -> None:
        """Change the signals of its place."""
        if self.kind.act is not None and self.shape.get('form') != 'library':
            self.kind.act(signals, self.size, self.shape)
            return
        assert self.kind.parameters is not None
        library()[self.kind.name].apply(signals, self.kind.parameters(self.size, self.shape))


@contextmanager
def in_library(faults: Sequence[Fault]) -> Iterator[tuple[str, ...]]:
    """
    Add faults to the library of this process for a while, so that the simulator runs them.

    Parameters
    ----------
    faults
        The faults.

    Yields
    ------
    tuple of str
        The names under which the library has them.

    """
    def effect(name: str, fault: Fault) -> Effect:
        return Effect(name, fault.kind.place, (), lambda signals, _: fault.act(signals), '')

    added = {f'fault_{i}': effect(f'fault_{i}', fault) for i, fault in enumerate(faults)}
    library().update(added)
    try:
        yield tuple(added)
    finally:
        for name in added:
            del library()[name]


def weights(rng: np.random.Generator, count: int) -> list[float]:
    """
    Draw weights: only the first or another one, all equal, or each of its own.

    Parameters
    ----------
    rng
        The random generator.
    count
        Number of weights.

    Returns
    -------
    list of float
        The weights.

    """
    kind = rng.random()
    if kind < _SINGLE_SHARE:
        w = (np.arange(count) == rng.integers(count)) * rng.choice([-1.0, 1.0])
    elif kind < _SINGLE_SHARE + _EQUAL_SHARE:
        w = np.full(count, rng.choice([-1.0, 1.0]))
    else:
        w = rng.choice([-1.0, 1.0], count) * np.exp(rng.normal(0, _LOG_SPREAD, count))
    return [float(value) for value in w]


def by_axis(rng: np.random.Generator, axes: int) -> Shape:
    """
    Draw a weight for each axis.

    Parameters
    ----------
    rng
        The random generator.
    axes
        Number of axes.

    Returns
    -------
    dict
        The shape.

    """
    return {'w': weights(rng, axes)}


def by_axis_with(**bounds: tuple[float, float]) -> Draw:
    """Return what draws a weight for each axis, and a number within each of the bounds."""
    def draw(rng: np.random.Generator, axes: int) -> Shape:
        return {**by_axis(rng, axes),
                **{name: float(rng.uniform(*pair)) for name, pair in bounds.items()}}
    return draw


def parts(count: int) -> Draw:
    """Return what draws a number of weights, whatever the axes."""
    return lambda rng, axes: {'w': weights(rng, count)}


def scaled(name: str) -> Callable[[float, Shape], Parameters]:
    """Return what makes the only parameter of an effect of the weights of the axes."""
    return lambda size, shape: {name: [size * w for w in shape['w']]}


def named(*names: str) -> Callable[[float, Shape], Parameters]:
    """Return what makes parameters without axes of the weights."""
    return lambda size, shape: {name: size * w for name, w in zip(names, shape['w'])}
