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

from adxl_ros.errors import UserError
import numpy as np

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
    if not len(planes_rad) or not np.all(np.isfinite(planes_rad)):
        raise UserError('sweep.planes_rad: names no plane; give at least one angle alpha')
    if not 2 * np.pi / 720 <= step_rad <= np.pi / 2 + 1e-9:
        raise UserError(f'sweep.step_rad: {step_rad:g} rad is not between 0.0087 and 1.5708')
    forth = np.arange(round(2 * np.pi / step_rad) + 1) * step_rad
    turn = np.concatenate([forth, forth[::-1]])
    grid = [Target(float(alpha), float(beta)) for alpha in planes_rad for beta in turn]
    return grid + _spread(check_poses)


def _spread(count: int) -> list[Target]:
    index = np.arange(count)
    alpha = np.arccos(0.97 - 1.94 * (index + 0.5) / max(count, 1))
    beta = (index * _GOLDEN_RAD) % (2 * np.pi)
    return [Target(float(a), float(b), True) for a, b in zip(alpha, beta)]
