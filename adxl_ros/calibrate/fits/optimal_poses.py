# SPDX-License-Identifier: Apache-2.0

"""The poses that determine a sensor best (D-optimality; Fedorov 1972)."""

from __future__ import annotations

from dataclasses import replace

from adxl_ros.calibrate.fits.pose_covariance import StageError, volts_covariance
from adxl_ros.calibrate.pose_model import coefficient_jacobian
from adxl_ros.calibrate.poses import Poses
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import Sensor
import numpy as np

GRID_RAD = np.radians(15.0)
"""Step of the grid of candidates in alpha and beta, rad. Chosen: such angles can be set by hand on
a scale."""


def choose_poses(rows: np.ndarray, information: np.ndarray, count: int) -> list[int]:
    """
    Choose poses one by one, each with the greatest gain in log |information|.

    rows: whitened Jacobian of each of n candidates, (n, m, p); information: that before the first
    choice, (p, p), of full rank; returns: indices of the candidates, which may repeat.
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
    """Return a grid over the sphere with a noise, (m,); each pose sets both joints anew."""
    alpha, beta = np.meshgrid(
        np.arange(round(np.pi / GRID_RAD) + 1) * GRID_RAD,
        np.arange(round(2 * np.pi / GRID_RAD)) * GRID_RAD,
    )
    settings = np.arange(alpha.size)
    return replace(
        Poses.without_volts(alpha.ravel(), beta.ravel(), std_v),
        alpha_setting=settings,
        beta_setting=settings,
    )


def whitened_jacobian(
    sensor: Sensor, poses: Poses, names: tuple[Coefficient, ...], stage: StageError
) -> np.ndarray:
    """Return the Jacobian, (k, m, p), whitened by noise and stage error, without settings."""
    design = coefficient_jacobian(sensor, poses, names)
    return volts_covariance(sensor, poses, stage).whiten_by_pose(design).reshape(design.shape)
