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

"""Directions in which a sensor is held by hand: what they tell, and their names."""

from __future__ import annotations

from itertools import product

from adxl_ros.calibrate.fits.gravity_model import (
    magnitude_jacobian,
    NAMES,
    sensing_axes,
    undetermined,
)
from adxl_ros.model.constants import AXES
import numpy as np

CANDIDATES = np.array([c for c in product((0, 1, -1), repeat=3) if any(c)])
"""Faces, edges and corners of a cube, one of which points up, (26, 3)."""
UP = CANDIDATES / np.linalg.norm(CANDIDATES, axis=1, keepdims=True)
_COVERED = np.cos(np.radians(22.0))
"""A rest nearer than this to a direction covers it: half of the 45° to the next."""
_NEARLY = 0.5
"""Directions that tell as much as this of the best one's: the nearest of them is asked for."""


def information_gain(information: np.ndarray, found: np.ndarray, gravity: float
         ) -> tuple[np.ndarray, np.ndarray]:
    """
    Return what a rest in each candidate tells, (26,), and its derivatives, (26, 9).

    Parameters
    ----------
    information
        What is known, (9, 9).
    found
        Where it is taken, (9,).
    gravity
        Local gravity, g.

    """
    outputs = found[:3] + (1 + found[3:6]) * (gravity * UP @ sensing_axes(found).T)
    rows = magnitude_jacobian(outputs, found)
    told = np.einsum('ki,ij,kj->k', rows, np.linalg.inv(information), rows)
    # With one or two axes along gravity a pose is easier to hold.
    return told / np.count_nonzero(CANDIDATES, axis=1), rows


def poses_to_add(fewest: int, information: np.ndarray, found: np.ndarray, gravity: float,
                 variance: float) -> list[str]:
    """Name the poses that tell most, one after the other, until all coefficients are told."""
    poses: list[str] = []
    left = np.ones(len(UP), bool)
    while (len(poses) < fewest or undetermined(information)) and len(poses) <= len(NAMES):
        told, rows = information_gain(information, found, gravity)
        best = int(np.argmax(np.where(left, told, -np.inf)))
        information = information + np.outer(rows[best], rows[best]) / variance
        left[best] = False
        poses.append(' and '.join(f'{axis} {"up" if sign > 0 else "down"}' for axis, sign
                                  in zip(AXES, CANDIDATES[best]) if sign))
    return poses


def covered(up: np.ndarray) -> np.ndarray:
    """Tell which candidates rests in the directions `up`, (k, 3), cover, (26,)."""
    return np.any(up @ UP.T > _COVERED, axis=0) if len(up) else np.zeros(len(UP), bool)


def next_up(told: np.ndarray, open_: np.ndarray, now: np.ndarray | None) -> int | None:
    """
    Choose the candidate to turn to: it tells nearly the most, and is the nearest of those.

    Parameters
    ----------
    told
        What each candidate tells, (26,).
    open_
        Which may be chosen, (26,).
    now
        What points up at present, (3,), if that is known.

    """
    if not open_.any():
        return None
    worth = np.where(open_, told, 0.0)
    good = np.flatnonzero(worth >= _NEARLY * worth.max())
    return int(good[np.argmax(worth[good])] if now is None else good[np.argmax(UP[good] @ now)])


def name_up(candidate: int) -> str:
    """Name what points up: '+x', or '+x and −y equally' for an edge."""
    axes = [('+' if sign > 0 else '−') + axis for axis, sign in zip(AXES, CANDIDATES[candidate])
            if sign]
    return axes[0] if len(axes) == 1 else f'{" and ".join(axes)} equally'


def points_up(name: str) -> str:
    """Make a sentence of a name: '+x points up', '+x and −y point up equally'."""
    if ' and ' not in name:
        return f'{name} points up'
    return f'{name.removesuffix(" equally")} point up equally'


def name_nearest(up: np.ndarray) -> str:
    """Name the candidate nearest a direction, (3,)."""
    return name_up(int(np.argmax(UP @ up)))
