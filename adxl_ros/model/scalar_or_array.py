# SPDX-License-Identifier: Apache-2.0

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
    """Functions of components, which are arrays (n,) or floats; see `effects.base.Value`."""

    sqrt: Callable[[Any], Any]  # Square root
    # sin, cos: Sine and cosine of an angle, rad
    sin: Callable[[Any], Any]
    cos: Callable[[Any], Any]
    atan2: Callable[[Any, Any], Any]  # Angle of the point (second value, first value), rad
    maximum: Callable[[Any, Any], Any]  # The larger of two values
    # The second value where the first is true, otherwise the third
    where: Callable[[Any, Any, Any], Any]


def _choose(condition: bool, value: float, otherwise: float) -> float:
    return value if condition else otherwise


ARRAYS = Maths(np.sqrt, np.sin, np.cos, np.arctan2, np.maximum, np.where)
"""Functions for arrays, (n,)."""

FLOATS = Maths(math.sqrt, math.sin, math.cos, math.atan2, max, _choose)
"""Functions for single samples: ten times faster than those of numpy."""
