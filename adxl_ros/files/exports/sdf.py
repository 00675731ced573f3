# SPDX-License-Identifier: Apache-2.0

"""SDFormat: an `<imu>` of gz-sensors (Gazebo), in a link of a model."""

from __future__ import annotations

from xml.sax.saxutils import quoteattr

from adxl_ros.files.exports.base import (
    arm_m,
    axes,
    Axis,
    Export,
    flat_noise_lines,
    head,
    STEPS,
    WHITE_NOISE,
)

HOLDS = {WHITE_NOISE: '<stddev>', 'noise_excess': '<stddev>', 'bias': '<mean>',
         'bias_walk': '<dynamic_bias_stddev>', 'lever_arm': '<pose>', STEPS: '<precision>',
         'quantisation': '<precision>'}

_WALK_S = 1e9
"""Correlation time of a walk without bounds, s; chosen: far longer than any simulation."""


def text(export: Export) -> str:
    """
    Return the content of a file.

    The zero-g is the mean of the noise. gz-sensors changes the sign of `<bias_mean>` at random
    (GaussianNoiseModel.cc), but not that of `<mean>`.
    """
    sensor = export.sensor
    comment = [*head(export, 'SDFormat', HOLDS), '',
               'The zero-g is in mean, because gz-sensors draws the sign of bias_mean.',
               *flat_noise_lines(sensor)]
    lines = ['<?xml version="1.0"?>', '<!--',
             *(f'  {line}'.rstrip().replace('--', '- -') for line in comment), '-->',
             '<sdf version="1.9">', '  <model name="imu">', '    <link name="imu_link">',
             f'      <sensor name={quoteattr(sensor.serial)} type="imu">',
             f'        <pose>{" ".join(map(repr, arm_m(sensor)))} 0 0 0</pose>',
             '        <always_on>true</always_on>',
             f'        <update_rate>{sensor.rate_hz!r}</update_rate>',
             '        <imu>', '          <linear_acceleration>']
    for axis in axes(sensor):
        lines += _axis_lines(axis)
    return '\n'.join([*lines, '          </linear_acceleration>', '        </imu>',
                      '      </sensor>', '    </link>', '  </model>', '</sdf>', ''])


def _axis_lines(axis: Axis) -> list[str]:
    """Return the noise of an axis."""
    values = {'mean': axis.zero_g_mps2, 'stddev': axis.noise_std_mps2, 'bias_mean': 0.0,
              'bias_stddev': 0.0}
    if axis.walk_density:
        values |= {'dynamic_bias_stddev': axis.walk_density,
                   'dynamic_bias_correlation_time': 1 / (axis.walk_return_per_s or 1 / _WALK_S)}
    if axis.step_mps2:
        values['precision'] = axis.step_mps2
    kind = 'gaussian_quantized' if axis.step_mps2 else 'gaussian'
    return [f'            <{axis.name}>', f'              <noise type="{kind}">',
            *(f'                <{name}>{value!r}</{name}>' for name, value in values.items()),
            '              </noise>', f'            </{axis.name}>']
