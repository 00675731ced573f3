# SPDX-License-Identifier: Apache-2.0

"""Faces, edges and corners of a cube: the directions in which a sensor is turned by hand."""

from __future__ import annotations

from itertools import product

from adxl_ros.model.constants import AXES
from adxl_ros.model.kinematics import unit_vectors
import numpy as np

CANDIDATES = np.array([signs for signs in product((0, 1, -1), repeat=3) if any(signs)])
"""Faces, edges and corners of a cube, one of which points up, (26, 3)."""
UP = unit_vectors(CANDIDATES)
"""The candidates as unit vectors, (26, 3)."""
_COVERED_COS = np.cos(np.radians(22.0))
"""Cosine of the angle up to which a rest covers a direction: half of the 45° to the next one."""
AXES_UP = np.count_nonzero(CANDIDATES, axis=1)
"""Number of axes that are not horizontal, (26,): 1 for a face, 2 for an edge, 3 for a corner."""


_NEARNESS = 0.4
"""Largest gain of a direction by being near; chosen: below 1/2, so that every face comes before
every edge, and these before every corner, however near one is."""


def covered(up: np.ndarray) -> np.ndarray:
    """Mark the candidates that rests in the directions `up`, (k, 3), cover, (26,) bool."""
    return np.any(up @ UP.T > _COVERED_COS, axis=0) if len(up) else np.zeros(len(UP), bool)


def next_up(available: np.ndarray, now: np.ndarray | None) -> int | None:
    """Choose the nearest available face, edge or corner by what points up now, (3,)."""
    nearness = UP @ (np.zeros(3) if now is None else now)
    cost = np.where(available, AXES_UP - _NEARNESS * nearness, np.inf)
    return int(cost.argmin()) if available.any() else None


def points_up(candidate: int) -> str:
    """Return a sentence: '+x points up', '+x and −y point up equally'."""
    axes = [
        ('+' if sign > 0 else '−') + axis
        for axis, sign in zip(AXES, CANDIDATES[candidate])
        if sign
    ]
    return f'{axes[0]} points up' if len(axes) == 1 else f'{" and ".join(axes)} point up equally'
