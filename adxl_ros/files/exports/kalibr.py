# SPDX-License-Identifier: Apache-2.0

"""Kalibr: the accelerometer's part of `imu.yaml`."""

from __future__ import annotations

from adxl_ros.errors import UserError
from adxl_ros.files.exports.base import axes, Export, head, WHITE_NOISE
from adxl_ros.files.parameter_file import float_text
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import effect_named
from adxl_ros.model.noise import ONE_SIDED

HOLDS = {WHITE_NOISE: 'accelerometer_noise_density',
         'noise_excess': 'accelerometer_noise_density', 'bias_walk': 'accelerometer_random_walk'}


def settings(white: float, walk: float, rate_hz: float) -> list[tuple[str, float, str]]:
    """Return the settings of Kalibr, which are densities over both signs of the frequency."""
    return [('accelerometer_noise_density', white, 'm/s^2/sqrt(Hz)'),
            ('accelerometer_random_walk', walk, 'm/s^3/sqrt(Hz)'), ('update_rate', rate_hz, 'Hz')]


def text(export: Export) -> str:
    """
    Return the content of a file.

    Kalibr has one value for all axes: the largest.
    """
    values = axes(export.sensor)
    white = max(axis.noise_density for axis in values) / ONE_SIDED
    if not white:
        raise UserError(f'{export.source}: sensor.noise_density_g_per_rthz is 0, which Kalibr '
                        'refuses; measure it: ros2 run adxl_ros noise RECORDING -o FILE.yaml')
    walk = max(axis.walk_density for axis in values)
    comment = [*head(export, 'Kalibr', HOLDS), '', 'Densities are the largest of the axes.']
    if not walk:
        walk = effect_named('bias_walk').diagnosis.healthy_density * G0_MPS2
        comment += ['The random walk is that of a healthy unit: the file states none.']
    comment += ['This sensor has no gyroscope. Kalibr needs these lines of yours, too:',
                'gyroscope_noise_density, gyroscope_random_walk']
    return '\n'.join([
        *(f'# {line}'.rstrip() for line in comment), 'rostopic: /imu/data_raw',
        *(f'{name}: {float_text(value)}  # {unit}'
          for name, value, unit in settings(white, walk, export.sensor.rate_hz)), ''])
