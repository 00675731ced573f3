# SPDX-License-Identifier: Apache-2.0

"""Directions in which a sensor is held by hand: their information and their names."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

from adxl_ros.calibrate.fits.gravity_model import (
    magnitude_jacobian,
    NAMES,
    sensing_axes,
    undetermined,
)
from adxl_ros.model.constants import AXES
import numpy as np

CANDIDATES = np.array([signs for signs in product((0, 1, -1), repeat=3) if any(signs)])
"""Faces, edges and corners of a cube, one of which points up, (26, 3)."""
UP = CANDIDATES / np.linalg.norm(CANDIDATES, axis=1, keepdims=True)
"""The candidates as unit vectors, (26, 3)."""
_COVERED_COS = np.cos(np.radians(22.0))
"""Cosine of the angle up to which a rest covers a direction: half of the 45° to the next one."""
_NEARLY_BEST = 0.5
"""Share of the greatest gain from which a direction is as good as the best; the nearest of them
is chosen."""


class InformationGain(NamedTuple):
    """What a further rest in each candidate would add."""

    # Variance of the predicted magnitude, g², by the number of axes that are not horizontal,
    # (26,). With one or two axes along gravity a pose is easier to hold.
    gain: np.ndarray
    rows: np.ndarray  # Derivatives of the magnitude by the parameters, (26, 9)


def information_gain(information: np.ndarray, parameters: np.ndarray, gravity_g: float
                     ) -> InformationGain:
    """
    Return what a rest in each candidate would add.

    Parameters
    ----------
    information
        Information of the rests so far, (9, 9).
    parameters : ndarray
        The nine parameters of `gravity_model`, (9,).
    gravity_g
        Local gravity, g.

    Returns
    -------
    InformationGain
        Gain and derivatives of each candidate.

    """
    outputs = parameters[:3] + (1 + parameters[3:6]) * (
        gravity_g * UP @ sensing_axes(parameters).T)
    rows = magnitude_jacobian(outputs, parameters)
    variance = np.einsum('ki,ij,kj->k', rows, np.linalg.inv(information), rows)
    return InformationGain(variance / np.count_nonzero(CANDIDATES, axis=1), rows)


def rests_to_add(count: int, information: np.ndarray, parameters: np.ndarray, gravity_g: float,
                 variance_g2: float) -> list[str]:
    """
    Name the rests with the greatest gain, one by one, until all coefficients are determined.

    Parameters
    ----------
    count
        Smallest count of rests.
    information
        Information of the rests so far, (9, 9).
    parameters : ndarray
        The nine parameters of `gravity_model`, (9,).
    gravity_g
        Local gravity, g.
    variance_g2
        Variance of the magnitude of a rest, g².

    Returns
    -------
    list
        Names such as 'x up and y down'.

    """
    rests: list[str] = []
    available = np.ones(len(UP), bool)
    while (len(rests) < count or undetermined(information)) and len(rests) <= len(NAMES):
        gain, rows = information_gain(information, parameters, gravity_g)
        best = int(np.argmax(np.where(available, gain, -np.inf)))
        information = information + np.outer(rows[best], rows[best]) / variance_g2
        available[best] = False
        rests.append(' and '.join(f'{axis} {"up" if sign > 0 else "down"}' for axis, sign
                                  in zip(AXES, CANDIDATES[best]) if sign))
    return rests


def covered(up: np.ndarray) -> np.ndarray:
    """Mark the candidates that rests in the directions `up`, (k, 3), cover, (26,) bool."""
    return np.any(up @ UP.T > _COVERED_COS, axis=0) if len(up) else np.zeros(len(UP), bool)


def next_up(gain: np.ndarray, available: np.ndarray, now: np.ndarray | None) -> int | None:
    """
    Choose the candidate to turn to: the nearest of those with nearly the greatest gain.

    Parameters
    ----------
    gain
        Gain of each candidate, (26,).
    available
        Candidates that may be chosen, (26,) bool.
    now
        Direction that points up at present, (3,), if known.

    Returns
    -------
    int or None
        Index of the candidate; None where none is available.

    """
    if not available.any():
        return None
    worth = np.where(available, gain, 0.0)
    best = np.flatnonzero(worth >= _NEARLY_BEST * worth.max())
    return int(best[np.argmax(worth[best])] if now is None else best[np.argmax(UP[best] @ now)])


def name_up(candidate: int) -> str:
    """Name what points up: '+x', or '+x and −y equally' for an edge."""
    axes = [('+' if sign > 0 else '−') + axis for axis, sign in zip(AXES, CANDIDATES[candidate])
            if sign]
    return axes[0] if len(axes) == 1 else f'{" and ".join(axes)} equally'


def points_up(name: str) -> str:
    """Return a sentence for a name: '+x points up', '+x and −y point up equally'."""
    if ' and ' not in name:
        return f'{name} points up'
    return f'{name.removesuffix(" equally")} point up equally'


def name_nearest(up: np.ndarray) -> str:
    """Name the candidate nearest a direction, (3,)."""
    return name_up(int(np.argmax(UP @ up)))
