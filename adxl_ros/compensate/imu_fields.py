# SPDX-License-Identifier: Apache-2.0

"""Estimates of a recording as fields of messages, in which no number is NaN or infinite."""

from __future__ import annotations

from adxl_ros.compensate.live_stream import UNKNOWN_ANGLE_RAD2
from adxl_ros.compensate.recordings import Estimates
from adxl_ros.model.covariance import UNMEASURED_VARIANCE
from adxl_ros.model.scalar_or_array import ARRAYS
from adxl_ros.model.tilt import quaternion, roll_pitch_covariance
import numpy as np


class ImuFields:
    """
    Makes the fields of `imu/data` and `tilt`, block by block.

    An angle that a sample does not show keeps its last value, 0 before the first, with a very
    large variance. So has a force that the sample does not determine.
    """

    def __init__(self) -> None:
        """Begin with angles of 0."""
        self._last_rad = np.zeros(3)

    def __call__(self, estimates: Estimates) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """
        Return the fields of sensor_msgs/Imu and the tilt of the samples that have a solution.

        returns: fields by name, (n, k) each. The yaw of the orientation is 0 and unknown. Roll,
        pitch and inclination, rad, (n, 3).
        """
        unsolved = estimates.unsolved
        solved = ~unsolved if unsolved.any() else slice(None)  # a slice copies nothing
        force = estimates.force_mps2[:, solved]
        force = np.where(np.isnan(force), 0.0, force)
        covariance = _known(estimates.covariance[:, :, solved])
        tilt = estimates.tilt
        shown_rad = np.stack([tilt.roll, tilt.pitch, tilt.inclination])[:, solved]
        std_rad = np.stack([tilt.roll_std, tilt.pitch_std])[:, solved]
        angles_rad = self._held(shown_rad)
        variance = np.where(np.isfinite(std_rad), std_rad ** 2, UNKNOWN_ANGLE_RAD2)
        return {'linear_acceleration': force.T,
                'linear_acceleration_covariance': covariance.reshape(9, -1).T,
                'orientation': np.stack(quaternion(angles_rad[0], angles_rad[1], ARRAYS)).T,
                'orientation_covariance': _orientation_covariance(force, covariance, *variance).T
                }, angles_rad.T

    def _held(self, angles_rad: np.ndarray) -> np.ndarray:
        """Return angles, rad, (3, n), with the last known value in place of NaN."""
        if angles_rad.size and not np.isnan(angles_rad).any():
            self._last_rad = angles_rad[:, -1]
            return angles_rad
        angles_rad = np.concatenate([self._last_rad[:, None], angles_rad], axis=1)
        rows = np.where(np.isnan(angles_rad), 0, np.arange(angles_rad.shape[1]))
        held = np.take_along_axis(angles_rad, np.maximum.accumulate(rows, axis=1), axis=1)
        self._last_rad = held[:, -1]
        return held[:, 1:]


def _known(covariance: np.ndarray) -> np.ndarray:
    """Return covariances, (m/s²)², (3, 3, n), with a very large one in place of infinite ones."""
    unknown = np.diag(np.full(3, UNMEASURED_VARIANCE))[:, :, None]
    return np.where(np.isfinite(covariance).all(axis=(0, 1)), covariance, unknown)


def _orientation_covariance(force: np.ndarray, covariance: np.ndarray, roll_rad2: np.ndarray,
                            pitch_rad2: np.ndarray) -> np.ndarray:
    """
    Return the elements of the covariance of roll, pitch and yaw, row after row.

    force: specific force, m/s², (3, n); covariance: its covariance, (m/s²)², (3, 3, n); roll_rad2,
    pitch_rad2: variances, rad², (n,); returns: the covariance, rad², (9, n).
    """
    components = tuple(covariance[i, j] for i in range(3) for j in range(i, 3))
    both = roll_pitch_covariance(list(force), components, ARRAYS)
    is_known = np.maximum(roll_rad2, pitch_rad2) < UNKNOWN_ANGLE_RAD2
    elements = np.zeros((9, len(roll_rad2)))
    elements[0], elements[4], elements[8] = roll_rad2, pitch_rad2, UNKNOWN_ANGLE_RAD2
    elements[1] = elements[3] = np.where(is_known, both, 0.0)
    return elements
