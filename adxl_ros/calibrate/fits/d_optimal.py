# SPDX-License-Identifier: Apache-2.0

"""
Selection of poses by D-optimality: the smallest joint confidence region of all coefficients.

V. V. Fedorov, Theory of Optimal Experiments, 1972.
"""

from __future__ import annotations

from adxl_ros.calibrate import pose_response
from adxl_ros.calibrate.poses import Poses
from adxl_ros.calibrate.stage_error import StageError
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import Sensor
import numpy as np

GRID_RAD = np.radians(15.0)
"""Step of the grid of candidates in alpha and beta, rad. Chosen: such angles can be set by hand on
a scale."""


def choose_poses(rows: np.ndarray, information: np.ndarray, count: int) -> list[int]:
    """
    Choose poses one by one, each with the greatest gain in log |information|.

    Parameters
    ----------
    rows
        Whitened Jacobian of each of n candidates, (n, m, p).
    information
        Information before the first choice, (p, p), of full rank.
    count
        Number of poses to choose; a candidate may be chosen again.

    Returns
    -------
    list
        Indices of the candidates, in the order of the choice.

    """
    chosen = []
    identity = np.eye(rows.shape[1])
    for _ in range(count):
        covariance = np.linalg.inv(information)
        gain = np.linalg.slogdet(identity + rows @ covariance @ np.swapaxes(rows, 1, 2))[1]
        chosen.append(int(np.argmax(gain)))
        information = information + rows[chosen[-1]].T @ rows[chosen[-1]]
    return chosen


def candidate_poses(std_v: np.ndarray) -> Poses:
    """
    Return candidates on a grid of `GRID_RAD` over the sphere, each a new setting of both joints.

    Alpha covers 0 to π and beta covers 0 to 2π. `std_v` is the noise of the mean of a pose, V,
    (m,).
    """
    alpha, beta = np.meshgrid(np.arange(round(np.pi / GRID_RAD) + 1) * GRID_RAD,
                              np.arange(round(2 * np.pi / GRID_RAD)) * GRID_RAD)
    return Poses.without_volts(alpha.ravel(), beta.ravel(), std_v, np.arange(alpha.size))


def whitened_jacobian(unit: Sensor, poses: Poses, names: tuple[Coefficient, ...],
                      stage: StageError) -> np.ndarray:
    """
    Return the Jacobian of each pose by coefficients, whitened by noise and stage error.

    Parameters
    ----------
    unit
        Sensor at whose coefficients the volts are differentiated.
    poses
        k poses that share no setting.
    names
        Coefficients, (p,).
    stage
        Standard deviations of the stage's error.

    Returns
    -------
    ndarray
        Whitened Jacobian, (k, m, p).

    """
    design = pose_response.coefficient_jacobian(unit, poses, names)
    covariance = pose_response.volts_covariance(unit, poses, stage)
    return covariance.whiten_by_pose(design).reshape(design.shape)
