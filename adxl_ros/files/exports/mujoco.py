# SPDX-License-Identifier: Apache-2.0

"""MuJoCo: a body with a site and an accelerometer, as MJCF."""

from __future__ import annotations

import re
from xml.sax.saxutils import quoteattr

from adxl_ros.files.exports.base import arm_m, axes, Export, head, WHITE_NOISE

MODEL = 'adxl_ros.simulate.sensor_model'
"""Module of the whole chain, which the file names."""
HOLDS = {'lever_arm': 'pos of the site', WHITE_NOISE: 'noise (MuJoCo does not add it)',
         'noise_excess': 'noise (MuJoCo does not add it)'}


def text(export: Export) -> str:
    """
    Return the content of a file.

    MuJoCo stores `noise` since 3.1.4 without adding it, and has one value for all axes: the
    largest.
    """
    sensor = export.sensor
    noise_mps2 = max(axis.noise_std_mps2 for axis in axes(sensor))
    # The comment names it, too, and may not hold two dashes.
    name = re.sub('-+', '-', sensor.serial)
    comment = [*head(export, 'MuJoCo', HOLDS), '',
               'noise is the largest of the axes. Include this file, or copy site and sensor.',
               'The whole chain, in Python after each mj_step:',
               f'  from {MODEL} import SensorModel',
               f'  sensor = SensorModel({export.source!r})',
               f'  reading = sensor(data.sensor({name!r}).data, model.opt.timestep)']
    return '\n'.join([
        '<!--', *(f'  {line}'.rstrip().replace('--', '- -') for line in comment), '-->',
        '<mujoco>', '  <worldbody>', '    <body name="imu_link">',
        f'      <site name={quoteattr(name)} pos="{" ".join(map(repr, arm_m(sensor)))}"/>',
        '    </body>', '  </worldbody>', '  <sensor>',
        f'    <accelerometer name={quoteattr(name)} site={quoteattr(name)} '
        f'noise="{noise_mps2!r}"/>',
        '  </sensor>', '</mujoco>', ''])
