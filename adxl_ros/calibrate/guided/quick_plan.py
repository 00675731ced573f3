# SPDX-License-Identifier: Apache-2.0

"""
The quick plan: the fewest poses that reach a stated tilt error.

Poses are chosen by D-optimality for the axes of the unit and for its stage. They come from a grid
of 15°, which can be set by hand on a scale. A short path connects them. The expected tilt error
holds for this order, in which joints keep their error until they move.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil

from adxl_ros.calibrate.fits import d_optimal
from adxl_ros.calibrate.guided import running_estimate
from adxl_ros.calibrate.guided.pose_plan import nearest, Target, with_checks
from adxl_ros.model.sensor import Sensor
import numpy as np

_SPARE_READINGS = 40
"""Readings beyond the number of coefficients; chosen: they show stage error and outliers."""
_MOST_POSES = 90
"""Largest number of poses; chosen: by hand a longer plan is no longer quick."""


def quick(sensor: Sensor, dwell_s: float, tilt_error_rad: float, check_poses: int
          ) -> list[Target]:
    """Choose the fewest poses that reach a tilt error, and never more than 90."""
    start = datasheet_estimate(sensor, dwell_s)
    fewest = ceil((len(start.names) + _SPARE_READINGS) / len(sensor.axes))
    grid = d_optimal.candidate_poses(start.pose_std_v)
    rows = d_optimal.whitened_jacobian(start.unit, grid, start.names, start.stage)
    chosen = [Target(float(grid.alpha_rad[i]), float(grid.beta_rad[i])) for i in
              d_optimal.choose_poses(rows, np.diag(1 / start.prior ** 2),
                                     max(_MOST_POSES, fewest))]
    for count in range(fewest, len(chosen) + 1):
        targets = _short_path(chosen[:count])
        if start.with_poses(targets).tilt_error_rad() <= tilt_error_rad:
            break
    return with_checks(targets, check_poses)


def datasheet_estimate(sensor: Sensor, dwell_s: float) -> running_estimate.RunningEstimate:
    """Return the estimate of a unit before its first pose, by the datasheet alone."""
    return running_estimate.from_poses(
        sensor, running_estimate.no_poses(len(sensor.axes)), dwell_s,
        sensor.stage_std_rad)


def expected_tilt_error_rad(sensor: Sensor, dwell_s: float, targets: Sequence[Target]) -> float:
    """Predict the rms error of alpha and beta after a pose plan."""
    fitted = [target for target in targets if not target.check]
    return datasheet_estimate(sensor, dwell_s).with_poses(fitted).tilt_error_rad()


def _short_path(targets: list[Target]) -> list[Target]:
    """Order poses so that each one is the nearest to the pose before, from the lowest angles."""
    first = min(targets, key=lambda target: (target.alpha_rad, target.beta_rad))
    others = list(targets)
    others.remove(first)
    return [first, *nearest(first, others)]
