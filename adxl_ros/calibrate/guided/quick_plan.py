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

"""
The quick plan: the fewest poses that reach a stated tilt error.

Poses are chosen by D-optimality from a grid of 15°, which can be set by hand on a scale, for the
unit's axes and for its stage. They are visited on a short way, and the tilt error to expect is
that of this very order, where joints keep their error until they move.
"""

from __future__ import annotations

from collections.abc import Sequence

from adxl_ros.calibrate.fits import d_optimal
from adxl_ros.calibrate.guided import running_estimate
from adxl_ros.calibrate.guided.pose_plan import nearest, Target, with_checks
from adxl_ros.calibrate.poses import Poses
from adxl_ros.model.sensor import Sensor
import numpy as np

_SPARE = 40
"""Readings beyond the coefficients: by these the stage's error and disturbed poses are judged."""
_MOST = 90
"""Poses after which a plan is no longer quick."""


def quick(sensor: Sensor, dwell_s: float, tilt_error_rad: float, check_poses: int
          ) -> list[Target]:
    """
    Choose the fewest poses that reach a tilt error, or the most that are quick.

    Parameters
    ----------
    sensor
        Nominal figures of the unit; its stage resolution is the stated error of the stage.
    dwell_s
        Time that a pose is averaged, s.
    tilt_error_rad
        Rms error of alpha and beta to reach, rad.
    check_poses
        Poses off the grid after the others.

    Returns
    -------
    list
        Poses in the order of the visit.

    """
    start = nothing_known(sensor, dwell_s)
    fewest = -(-(len(start.names) + _SPARE) // len(sensor.axes))
    grid = d_optimal.candidate_poses(start.pose_std_v)
    rows = d_optimal.whitened_jacobian(start.unit, grid, start.names, start.stage)
    chosen = [Target(float(grid.alpha_rad[i]), float(grid.beta_rad[i])) for i in
              d_optimal.choose_poses(rows, np.diag(1 / start.prior ** 2), max(_MOST, fewest))]
    for count in range(fewest, len(chosen) + 1):
        targets = _short_way(chosen[:count])
        if start.after(targets).tilt_error_rad() <= tilt_error_rad:
            break
    return with_checks(targets, check_poses)


def nothing_known(sensor: Sensor, dwell_s: float) -> running_estimate.Known:
    """Return what the datasheet alone tells of a unit, with poses of a dwell in s to come."""
    empty = Poses.without_volts(np.zeros(0), np.zeros(0), np.zeros(len(sensor.axes)))
    return running_estimate.from_poses(
        sensor, empty, dwell_s, sensor.stage_resolution_rad / np.sqrt(12))


def expected_tilt_error_rad(sensor: Sensor, dwell_s: float, targets: Sequence[Target]) -> float:
    """
    Return the rms error of alpha and beta to expect after a plan, rad.

    Parameters
    ----------
    sensor
        Nominal figures of the unit.
    dwell_s
        Time that a pose is averaged, s.
    targets
        The plan; check poses do not count.

    """
    fitted = [target for target in targets if not target.check]
    return nothing_known(sensor, dwell_s).after(fitted).tilt_error_rad()


def _short_way(targets: list[Target]) -> list[Target]:
    first = min(targets, key=lambda t: (t.alpha_rad, t.beta_rad))
    rest = list(targets)
    rest.remove(first)
    return [first, *nearest(first, rest)]
