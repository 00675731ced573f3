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

"""The motion before each sample: direction of the last move, and time since it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

_MOVING_RAD_S = 1e-3
"""Rate above which a joint moves, rad/s. Chosen: that of the comparison's rests."""
_LONGEST_S = 1e3
"""Time since the last move where there was none, s. Chosen: beyond any creep."""


def direction_of_last_move(rate_rad_s: np.ndarray) -> np.ndarray:
    """Return the direction of the last move of a joint, −1 or 1, 0 before the first, (n,)."""
    moving = np.abs(rate_rad_s) > _MOVING_RAD_S
    last = np.maximum.accumulate(np.where(moving, np.arange(len(rate_rad_s)), -1))
    return np.where(last >= 0, np.sign(rate_rad_s[np.maximum(last, 0)]), 0.0)


def time_since_move_s(time_s: np.ndarray, rates_rad_s: Sequence[np.ndarray]) -> np.ndarray:
    """
    Return the time since any joint moved.

    Parameters
    ----------
    time_s
        Stamps, s, (n,).
    rates_rad_s
        Rates of the joints, rad/s, (n,) each.

    Returns
    -------
    numpy.ndarray
        Time, s, (n,), 1000 s at most.

    """
    moving = np.any(np.abs(np.array(rates_rad_s)) > _MOVING_RAD_S, axis=0)
    last_s = np.maximum.accumulate(np.where(moving, time_s, -np.inf))
    return np.minimum(time_s - last_s, _LONGEST_S)
