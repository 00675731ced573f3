# SPDX-License-Identifier: Apache-2.0

"""How many poses of each group are taken: by plane, by direction of travel, by orientation."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from adxl_ros.calibrate.fits import orientations
from adxl_ros.calibrate.guided.pose_plan import Target
from adxl_ros.calibrate.guided.screen_contents import Coverage
import numpy as np

_SIDES = {1: 'faces up', 2: 'edges up', 3: 'corners up'}
"""Groups of orientations, by the number of axes that point up."""
_CHECKS = 'check poses'
"""Group of the check poses."""
_FORTH = 'beta forth'
"""Group of the poses that a rising beta reaches."""
_BACK = 'beta back'
"""Group of the poses that a falling beta reaches."""


def by_plane(targets: Sequence[Target], accepted: Collection[int]) -> tuple[Coverage, ...]:
    """Count the poses of a plan by plane and by direction of travel, and the check poses."""
    groups: dict[str, list[int]] = {}
    previous = None
    for number, target in enumerate(targets):
        for name in _groups(target, previous):
            groups.setdefault(name, []).append(number)
        previous = target
    order = sorted(groups, key=lambda name: (name == _CHECKS, name in (_FORTH, _BACK)))
    return tuple(Coverage(name, sum(number in accepted for number in groups[name]),
                          len(groups[name])) for name in order)


def by_orientation(covered: np.ndarray) -> tuple[Coverage, ...]:
    """Count the covered orientations, (26,) bool, by faces, edges and corners."""
    sides = np.count_nonzero(orientations.CANDIDATES, axis=1)
    return tuple(Coverage(name, int(covered[sides == count].sum()), int((sides == count).sum()))
                 for count, name in _SIDES.items())


def faces(covered: np.ndarray) -> str:
    """Name the faces among the covered orientations, (26,) bool."""
    sides = np.count_nonzero(orientations.CANDIDATES, axis=1)
    return ' '.join(orientations.name_up(int(number))
                    for number in np.flatnonzero(covered & (sides == 1)))


def _groups(target: Target, previous: Target | None) -> list[str]:
    """Return the groups of a target: its plane and its direction of travel, or the checks."""
    if target.check:
        return [_CHECKS]
    plane = f'{np.degrees(target.alpha_rad):.0f}°'
    if previous is None or target.beta_rad == previous.beta_rad:
        return [plane]
    return [plane, _FORTH if target.beta_rad > previous.beta_rad else _BACK]
