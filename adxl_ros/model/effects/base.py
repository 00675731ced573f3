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

"""What an effect is, and the signals that run through the chain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

Value = Any
"""One component of a signal: an array over samples, or a float for one sample.

Effects compute component by component with plain arithmetic, so that one description serves
recordings (arrays) and a live sample (floats, without the cost of small arrays)."""

Components = list[Value]
Parameters = dict[str, tuple[float, ...]]


class Place(IntEnum):
    """Where in the chain an effect acts; the chain runs in this order."""

    MOUNTING = 3
    ELEMENT = 4
    ELECTRONICS = 5


@dataclass
class Signals:
    """
    What runs through the static part of the chain, component by component.

    Attributes
    ----------
    sensed
        Specific force along the sensing axes, g, always three: axes that are not measured keep
        the component along the case's axis.
    output
        What the element makes of it, g; starts as `sensed`. Effects read `sensed` and add to
        `output`, so that their order does not matter.
    zero_g_v, scale_v_per_g
        Figures of the conversion to volts, by measured axis.

    """

    sensed: Components
    output: Components = field(default_factory=list)
    zero_g_v: Components = field(default_factory=list)
    scale_v_per_g: Components = field(default_factory=list)


@dataclass(frozen=True)
class Parameter:
    """
    One parameter of an effect, an entry an axis; neutral is 0: a departure from the nominal.

    Attributes
    ----------
    axes
        The axes that it means something for; the entries of others must be 0.
    scale
        A typical magnitude, with its source (datasheet, paper or physics).

    """

    name: str
    unit: str
    lower: float
    upper: float
    scale: float
    source: str
    doc: str
    axes: str = 'xyz'


@dataclass(frozen=True)
class Effect:
    """
    One effect of a real sensor: what the simulator, the inverse and the fits know of it.

    Attributes
    ----------
    apply
        Changes the signals in place, given the parameters as tuples of floats by axis.
    cause
        One sentence for a report: what causes it and what to do about it.

    """

    name: str
    place: Place
    parameters: tuple[Parameter, ...]
    apply: Callable[[Signals, Parameters], None]
    cause: str
