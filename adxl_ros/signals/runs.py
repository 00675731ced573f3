# SPDX-License-Identifier: Apache-2.0

"""Runs of consecutive values that satisfy a condition."""

from __future__ import annotations

from itertools import pairwise

import numpy as np


def true_runs(mask: np.ndarray, group: np.ndarray | None = None) -> list[tuple[int, int]]:
    """
    List the runs of True in a mask.

    mask: booleans, (k,); group: numbers, not negative, (k,). A run ends where the number changes.
    None for one group.
    """
    number = np.where(mask, 0 if group is None else group, -1)
    edges = np.flatnonzero(np.diff(number, prepend=-2, append=-2))
    return [(int(first), int(stop)) for first, stop in pairwise(edges) if mask[first]]
