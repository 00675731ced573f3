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

ORDER = 3
"""To be raised with every change of `guided`: an interrupted sweep cannot go on in another."""
KINDS = ('full', 'quick')
"""Plans of a stage: the paper's planes, or the fewest poses that reach a tilt error."""
STEP_RAD = float(np.radians(30.0))
"""Step of beta of the paper."""
MOVE_S = 5.0
"""Time from a pose to the next, beside the dwell, until there is some experience, s."""
_FLAT = 0.2
"""Planes with |sin α| below this hardly show beta; the paper leaves them out of (15), too."""
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


def default_planes_rad(axes: str) -> tuple[float, ...]:
    """
    Return the planes alpha of a sweep, rad: 30° to 150° by 30°, with z 0° to 180°.

    Without level planes a z axis is calibrated to 0.87 g only.
    """
    ends = (0.0, 180.0) if 'z' in axes else (30.0, 150.0)
    return tuple(float(angle) for angle in np.radians(np.arange(ends[0], ends[1] + 1, 30.0)))


def guided(planes_rad: Sequence[float], step_rad: float, check_poses: int) -> list[Target]:
    """
    Order the poses of `sweep` for a real stage, whose joints keep their error until they move.

    Beta turns forth and then back, and at each of its angles alpha goes through all planes, up
    and down in turn. A joint takes a new error with each move, so that a plane has as many as it
    has poses: with one setting a plane, the error of that setting would count in full. All planes
    are there after half of the sweep, and each pose is reached in both directions of both joints.
    Where |sin alpha| < 0.2 beta hardly shows, and quarter turns of beta are enough. Check poses
    follow, in whole degrees, which can be set by hand on a scale, each the nearest to the one
    before.

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
    planes = np.array(sorted({float(alpha) for alpha in planes_rad}))
    inclined = np.abs(np.sin(planes)) >= _FLAT
    grid = []
    for i, beta in enumerate((*forth, *forth[::-1])):
        quarter = abs(np.sin(2 * beta)) < 1e-6
        visited = planes if quarter or not inclined.any() else planes[inclined]
        grid += [Target(float(alpha), float(beta)) for alpha in visited[::-1 if i % 2 else 1]]
    return with_checks(grid, check_poses)


def with_checks(targets: list[Target], check_poses: int) -> list[Target]:
    """Add check poses in whole degrees, each the nearest to the one before."""
    checks = [Target(_whole(t.alpha_rad), _whole(t.beta_rad), True) for t in spread(check_poses)]
    return targets + nearest(targets[-1], checks)


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


def nearest(start: Target, targets: list[Target]) -> list[Target]:
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
