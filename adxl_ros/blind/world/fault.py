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

"""What a fault is: its kind, its size and its shape. The modules of faults build on this file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from adxl_ros.blind.world.run import Place, Run
from adxl_ros.blind.world.unit import Unit
import numpy as np

Shape = dict[str, Any]
"""The numbers of a fault that stay when its size changes: weights `w`, and others by name."""
Draw = Callable[[np.random.Generator, Unit], Shape]
"""Draws the shape of a fault of a unit."""
Act = Callable[[Run, float, Shape], None]
"""Lets a fault of a size and a shape act on a run."""


@dataclass(frozen=True)
class FaultKind:
    """
    One kind of fault.

    Attributes
    ----------
    name
        Its name.
    place
        Where in the chain it acts.
    act
        How it acts.
    draw
        How its shape is drawn.
    spread
        Shapes whose responses span all its responses.
    start
        A size at which the search for a strength begins.
    largest
        Its largest size.
    per_axis
        Whether the responses of single axes are independent.
    random
        Whether it differs from run to run.
    in_library
        Whether the library of effects of the package has its name.
    sizes
        Multiples of `start` at which its responses span all.

    """

    name: str
    place: Place
    act: Act
    draw: Draw
    spread: Callable[[Unit], list[Shape]]
    start: float
    largest: float
    per_axis: bool = False
    random: bool = False
    in_library: bool = True
    sizes: tuple[float, ...] = (1.0,)


@dataclass(frozen=True)
class Fault:
    """
    One fault.

    Attributes
    ----------
    kind, size, shape
        Its kind, its size in the unit of the kind, and its shape.

    """

    kind: FaultKind
    size: float
    shape: Shape
