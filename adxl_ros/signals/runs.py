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

"""Runs of consecutive values that satisfy a condition."""

from __future__ import annotations

from itertools import pairwise

import numpy as np


def true_runs(mask: np.ndarray, group: np.ndarray | None = None) -> list[tuple[int, int]]:
    """
    List the runs of True in a mask.

    Parameters
    ----------
    mask
        Booleans, (k,).
    group
        Numbers, not negative, (k,). A run ends where the number changes. None for one group.

    Returns
    -------
    list
        First index and index after the last of each run.

    """
    number = np.where(mask, 0 if group is None else group, -1)
    edges = np.flatnonzero(np.diff(number, prepend=-2, append=-2))
    return [(int(first), int(stop)) for first, stop in pairwise(edges) if mask[first]]
