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
Poses chosen by D-optimality: those that shrink the joint interval of all coefficients the most.

V. V. Fedorov, Theory of Optimal Experiments, 1972.
"""

from __future__ import annotations

from adxl_ros.calibrate import pose_response
from adxl_ros.calibrate.poses import Poses
from adxl_ros.calibrate.stage_error import StageError
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import Sensor
import numpy as np


def choose_poses(rows: np.ndarray, information: np.ndarray, count: int) -> list[int]:
    """
    Choose poses one after the other, each that of the greatest gain in log |information|.

    Parameters
    ----------
    rows
        Whitened derivatives of each candidate by the coefficients, (n, m, p).
    information
        What is known before the first of them, (p, p), of full rank.
    count
        How many to choose; a candidate may be chosen again.

    Returns
    -------
    list
        Numbers of the candidates, in the order of the choice.

    """
    chosen = []
    identity = np.eye(rows.shape[1])
    for _ in range(count):
        covariance = np.linalg.inv(information)
        gain = np.linalg.slogdet(identity + rows @ covariance @ np.swapaxes(rows, 1, 2))[1]
        chosen.append(int(np.argmax(gain)))
        information = information + rows[chosen[-1]].T @ rows[chosen[-1]]
    return chosen


def candidate_poses(std_v: np.ndarray, step_rad: float) -> Poses:
    """
    Lay candidates over the sphere, each a new setting of both joints.

    Parameters
    ----------
    std_v
        Noise of the mean of a pose, V, (m,).
    step_rad
        Step of alpha from 0 to π and of beta from 0 to 2π.

    """
    alpha, beta = (angles.ravel() for angles in np.meshgrid(
        np.arange(round(np.pi / step_rad) + 1) * step_rad,
        np.arange(round(2 * np.pi / step_rad)) * step_rad))
    count = len(alpha)
    return Poses(np.zeros((count, len(std_v))), np.tile(std_v, (count, 1)), alpha, beta,
                 np.zeros((count, 2)), np.zeros(count, bool), alpha_setting=np.arange(count),
                 beta_setting=np.arange(count))


def whitened_jacobian(unit: Sensor, poses: Poses, names: tuple[Coefficient, ...],
            stage: StageError) -> np.ndarray:
    """
    Return the derivatives of single poses by coefficients, whitened, (k, m, p).

    Parameters
    ----------
    unit
        Where they are taken.
    poses
        Each of settings of its own.
    names
        Coefficients, (p,).
    stage
        Levels of the stage's error.

    """
    design = pose_response.coefficient_jacobian(unit, poses, names)
    covariance = pose_response.volts_covariance(unit, poses, stage)
    return covariance.by_blocks(design).reshape(design.shape)
