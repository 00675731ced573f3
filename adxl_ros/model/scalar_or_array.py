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
Elementary functions for arrays and for single floats.

A formula that takes a `Maths` serves recordings (`ARRAYS`) and live samples (`FLOATS`) alike.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Maths:
    """
    Functions of components, which are arrays (n,) or floats; see `effects.base.Value`.

    Attributes
    ----------
    sqrt
        Square root.
    sin, cos
        Sine and cosine of an angle, rad.
    atan2
        Angle of the point (second value, first value), rad.
    maximum
        The larger of two values.
    where
        The second value where the first is true, otherwise the third.

    """

    sqrt: Callable[[Any], Any]
    sin: Callable[[Any], Any]
    cos: Callable[[Any], Any]
    atan2: Callable[[Any, Any], Any]
    maximum: Callable[[Any, Any], Any]
    where: Callable[[Any, Any, Any], Any]


def _choose(condition: bool, value: float, otherwise: float) -> float:
    return value if condition else otherwise


ARRAYS = Maths(np.sqrt, np.sin, np.cos, np.arctan2, np.maximum, np.where)
"""Functions for arrays, (n,)."""

FLOATS = Maths(math.sqrt, math.sin, math.cos, math.atan2, max, _choose)
"""Functions for single samples: ten times faster than those of numpy."""
