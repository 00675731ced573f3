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

"""Which poses a sweep visits, and in what order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from adxl_ros.errors import UserError
import numpy as np

ORDER = 2
"""To be raised with every change of `guided`: an interrupted sweep cannot go on in another."""
_GOLDEN_RAD = np.pi * (3 - np.sqrt(5))


@dataclass(frozen=True)
class Target:
    """One pose to visit, rad; a `check` pose judges the fit and stays out of it."""

    alpha_rad: float
    beta_rad: float
    check: bool = False


def sweep(planes_rad: Sequence[float], step_rad: float, check_poses: int) -> list[Target]:
    """
    Plan the paper's two experiments: in each plane alpha, beta through a turn forth and back.

    Parameters
    ----------
    planes_rad
        Angles alpha, in the order of the visit.
    step_rad
        Step of beta from 0 to 2π and back; the paper's is 30°.
    check_poses
        Poses off the grid after the sweep, spread evenly over the sphere by a golden spiral.

    Raises
    ------
    UserError
        No planes, or a step that makes less than four or more than 720 poses a turn.

    """
    forth = _turn(planes_rad, step_rad)
    grid = [Target(float(alpha), float(beta)) for alpha in planes_rad
            for beta in (*forth, *forth[::-1])]
    return grid + spread(check_poses)


def guided(planes_rad: Sequence[float], step_rad: float, check_poses: int) -> list[Target]:
    """
    Order the poses of `sweep` for a real stage: little travel, each plane from both sides.

    The planes are gone through upwards and then downwards, and beta turns forth in one plane and
    back in the next, so that each pose of the grid is reached in both directions of both joints,
    and half of the sweep has all planes already. Check poses follow, in whole degrees, which can
    be set by hand on a scale, each the nearest to the one before.

    Parameters
    ----------
    planes_rad, step_rad, check_poses
        As `sweep` takes them; planes in any order.

    Raises
    ------
    UserError
        See `sweep`.

    """
    forth = _turn(planes_rad, step_rad)
    planes = sorted({float(alpha) for alpha in planes_rad})
    there = [(alpha, forth[::-1] if i % 2 else forth) for i, alpha in enumerate(planes)]
    back = [(alpha, turn[::-1]) for alpha, turn in there[::-1]]
    grid = [Target(alpha, float(beta)) for alpha, turn in there + back for beta in turn]
    checks = [Target(_whole(t.alpha_rad), _whole(t.beta_rad), True) for t in spread(check_poses)]
    return grid + _nearest(grid[-1], checks)


def travel_rad(targets: Sequence[Target]) -> float:
    """Return the way of the slower joint over all moves, rad: the joints turn at one time."""
    return sum(_apart(a, b) for a, b in pairwise(targets))


def _turn(planes_rad: Sequence[float], step_rad: float) -> np.ndarray:
    """Return the angles beta of a turn, or say what is wrong with the plan."""
    if not len(planes_rad) or not np.all(np.isfinite(planes_rad)):
        raise UserError('sweep.planes_rad: names no plane; give at least one angle alpha')
    if not 2 * np.pi / 720 <= step_rad <= np.pi / 2 + 1e-9:
        raise UserError(f'sweep.step_rad: {step_rad:g} rad is not between 0.0087 and 1.5708')
    return np.arange(round(2 * np.pi / step_rad) + 1) * step_rad


def _whole(angle_rad: float) -> float:
    return float(np.radians(np.round(np.degrees(angle_rad))))


def _apart(a: Target, b: Target) -> float:
    return max(abs(a.alpha_rad - b.alpha_rad), abs(a.beta_rad - b.beta_rad))


def _nearest(start: Target, targets: list[Target]) -> list[Target]:
    """Order targets by the nearest neighbour of the one before."""
    left, way = list(targets), [start]
    while left:
        way.append(min(left, key=lambda target: _apart(way[-1], target)))
        left.remove(way[-1])
    return way[1:]


def spread(count: int) -> list[Target]:
    """Spread check poses evenly over the sphere by a golden spiral."""
    index = np.arange(count)
    alpha = np.arccos(0.97 - 1.94 * (index + 0.5) / max(count, 1))
    beta = (index * _GOLDEN_RAD) % (2 * np.pi)
    return [Target(float(a), float(b), True) for a, b in zip(alpha, beta)]
