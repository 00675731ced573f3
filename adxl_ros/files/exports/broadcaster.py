# SPDX-License-Identifier: Apache-2.0

"""ros2_controllers: parameters of `imu_sensor_broadcaster` with its static covariances."""

from __future__ import annotations

from adxl_ros.files.exports.base import Export, head, STEPS, variances, WHITE_NOISE
from adxl_ros.files.parameter_file import float_text
import numpy as np

HOLDS = {WHITE_NOISE: 'covariance', 'noise_excess': 'covariance', STEPS: 'covariance',
         'quantisation': 'covariance'}

_ABSENT = np.diag([-1.0, 0.0, 0.0])
"""Covariance of a quantity that the sensor does not measure (sensor_msgs/Imu)."""


def text(export: Export) -> str:
    """Return the content of a file: the variance of one sample by axis, and no correlation."""
    comment = [*head(export, 'imu_sensor_broadcaster', HOLDS), '',
               'The covariance is that of one sample. Set sensor_name to that of the URDF.']
    return '\n'.join([
        *(f'# {line}'.rstrip() for line in comment), 'imu_sensor_broadcaster:',
        '  ros__parameters:', '    sensor_name: imu', '    frame_id: imu_link',
        f'    static_covariance_orientation: {_row(_ABSENT)}',
        f'    static_covariance_angular_velocity: {_row(_ABSENT)}',
        '    static_covariance_linear_acceleration: '
        f'{_row(np.diag(variances(export.sensor)))}', ''])


def _row(matrix: np.ndarray) -> str:
    """Return the nine numbers of a matrix as a list of doubles in YAML."""
    return f'[{", ".join(float_text(value) for value in matrix.ravel().tolist())}]'
