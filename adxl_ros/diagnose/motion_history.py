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

"""What came before a sample: the direction of the last move, and the time since."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

_MOVES_RAD_S = 1e-3


def direction(rate_rad_s: np.ndarray) -> np.ndarray:
    """Return the direction of the last move of a joint, −1, 0 before the first, or 1, (n,)."""
    moving = np.abs(rate_rad_s) > _MOVES_RAD_S
    last = np.maximum.accumulate(np.where(moving, np.arange(len(rate_rad_s)), -1))
    return np.where(last >= 0, np.sign(rate_rad_s[np.maximum(last, 0)]), 0.0)


def since_move_s(time_s: np.ndarray, rates_rad_s: Sequence[np.ndarray]) -> np.ndarray:
    """Return the time since any joint moved, s, (n,), 1000 at most."""
    moving = np.any(np.abs(np.array(rates_rad_s)) > _MOVES_RAD_S, axis=0)
    last = np.maximum.accumulate(np.where(moving, time_s, -np.inf))
    return np.minimum(time_s - last, 1e3)
