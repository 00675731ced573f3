# SPDX-License-Identifier: Apache-2.0

"""A sensor in the formats of simulators, as `exports` has those of estimators."""

from __future__ import annotations

import re
from xml.sax.saxutils import quoteattr

from adxl_ros.files.exports import (
    arm_m,
    axes,
    by_axis,
    commented,
    delay_s,
    Export,
    flat_noise_lines,
    Format,
    gain,
    head,
    STEPS,
    WHITE_NOISE,
)
from adxl_ros.model.constants import AXES
import numpy as np

_WALK_S = 1e9
"""Correlation time of a walk without bounds, s; chosen: far longer than any simulation."""
_MODEL = 'adxl_ros.simulate.sensor_model'
"""Module of the whole chain, which files name."""


def _xml_comment(lines: list[str]) -> list[str]:
    """Return lines as a comment of XML, which may not hold two dashes."""
    return ['<!--', *(f'  {line}'.rstrip().replace('--', '- -') for line in lines), '-->']


def _gaussian(export: Export, form: str) -> list[str]:
    """Return the configuration of white noise with zero-g; `form` is that of its numbers."""
    return ['ACCELERATION_NOISE = GaussianNoiseCfg(  # m/s^2', "    operation='add',",
            *(f'    {name}={form.format(by_axis(export.sensor, field))},'
              for name, field in (('mean', 'zero_g_mps2'), ('std', 'noise_std_mps2'))), ')']


def _whole_chain(export: Export) -> list[str]:
    """Return the whole chain as a class of Python; both simulators ask for their own base."""
    return ['', '',
            '# The whole chain needs adxl_ros in this Python; else delete all below.',
            f'from {_MODEL} import SensorNoise  # noqa: E402', '', '',
            'class WholeChain(SensorNoise, NoiseModel):',
            '    """All parts of the sensor; the attributes are its configuration."""', '',
            f'    params = {export.source!r}  # path from where the program starts',
            f'    dt = {1 / export.sensor.rate_hz!r}  # s; set it to a step of the environment',
            "    units = None  # 'datasheet', 'calibration', population.yaml: one a robot",
            '    seed = 0', '',
            '    def __init__(self, noise_model_cfg, num_envs, device):',
            '        super().__init__(self, num_envs, device)', '', '']


_APPLIED = ('The table is that of ACCELERATION_NOISE; WHOLE_CHAIN has all parts. Use one',
            'as noise of a term of observations with func=acceleration. The group of',
            'the term needs enable_corruption=True.')
"""How noise is used in Isaac Lab and mjlab."""


def _isaaclab(export: Export) -> str:
    """
    Isaac Lab: a Python module with `ImuCfg` and the noise of its observation.

    Data is a `ProxyArray` since 3.0, and a tensor before. Both versions have +g at rest.
    """
    sensor = export.sensor
    return '\n'.join([
        *commented(head(
            export, 'Isaac Lab 2.x and 3.0', *flat_noise_lines(sensor), *_APPLIED,
            'If the case is turned: rot of OffsetCfg is x, y, z, w in 3.0, and before',
            'it w, x, y, z. The Pva of 3.0 leaves gravity out: it is no accelerometer.')), '',
        'from isaaclab.sensors import ImuCfg',
        'from isaaclab.utils.noise.noise_cfg import GaussianNoiseCfg, NoiseModelCfg',
        'from isaaclab.utils.noise.noise_model import NoiseModel',
        'import torch', '',
        '# imu = ImuCfg(prim_path=..., offset=OFFSET, update_period=UPDATE_PERIOD_S)',
        f'OFFSET = ImuCfg.OffsetCfg(pos={arm_m(sensor)!r})  # m',
        f'UPDATE_PERIOD_S = {1 / sensor.rate_hz!r}',
        *_gaussian(export, 'torch.tensor({})'), '', '',
        "def acceleration(env, name='imu'):",
        '    """Return what an ideal accelerometer reads, m/s^2, (num_envs, 3)."""',
        '    data = env.scene[name].data.lin_acc_b',
        "    return getattr(data, 'torch', data)",
        *_whole_chain(export),
        'WHOLE_CHAIN = NoiseModelCfg(',
        '    class_type=WholeChain, noise_cfg=ACCELERATION_NOISE)', ''])


def _mjlab(export: Export) -> str:
    """Mjlab: a Python module with an accelerometer and the noise of its observation."""
    sensor = export.sensor
    return '\n'.join([
        *commented(head(export, 'mjlab 1.x', *flat_noise_lines(sensor), *_APPLIED,
                        'The robot needs the site: spec.body(...).add_site(name=NAME, pos=POS).')),
        '',
        'from mjlab.sensor import BuiltinSensorCfg, ObjRef',
        'from mjlab.utils.noise import GaussianNoiseCfg, NoiseModel, NoiseModelCfg', '',
        f'NAME = {sensor.serial!r}',
        f'POS = {arm_m(sensor)!r}  # m',
        'ACCELEROMETER = BuiltinSensorCfg(',
        "    name=NAME, sensor_type='accelerometer',",
        "    obj=ObjRef(type='site', name=NAME, entity='robot'))",
        *_gaussian(export, '{}'), '', '',
        'def acceleration(env):',
        '    """Return what an ideal accelerometer reads, m/s^2, (num_envs, 3)."""',
        "    return env.scene[f'robot/{NAME}'].data",
        *_whole_chain(export),
        'class WholeChainCfg(NoiseModelCfg, class_type=WholeChain):',
        '    """Its configuration."""', '', '',
        'WHOLE_CHAIN = WholeChainCfg(noise_cfg=ACCELERATION_NOISE)', ''])


def _genesis(export: Export) -> str:
    """
    Genesis: options of `gs.sensors.IMU`, which runs once a step of the scene.

    The options refuse a matrix with entries outside 0 to 1; the sensor itself takes any.
    """
    sensor = export.sensor
    dt_s = 1 / sensor.rate_hz
    coupling = np.eye(3)
    coupling[[AXES.index(axis) for axis in sensor.axes]] = gain(sensor)
    options = {
        'pos_offset': arm_m(sensor),
        'acc_bias': by_axis(sensor, 'zero_g_mps2'),
        'acc_noise': by_axis(sensor, 'noise_std_mps2'),
        'acc_random_walk': tuple(np.multiply(by_axis(sensor, 'walk_density'), dt_s ** 0.5)
                                 .tolist()),
        'acc_resolution': by_axis(sensor, 'step_mps2'),
        'delay': max(delay_s(sensor), 0.0),
        'jitter': 0.0,
    }
    return '\n'.join([
        *commented(head(
            export, 'Genesis 0.4 to 1.4', *flat_noise_lines(sensor),
            'Values are those of a step of DT_S; give the scene that dt. Genesis rounds',
            'the delay to steps, and its random walk has no bounds.',
            '  imu = scene.add_sensor(gs.sensors.IMU(',
            '      entity_idx=robot.idx, **ACCELEROMETER))',
            '  scene.build()',
            '  imu.set_acc_cross_axis_coupling(CROSS_AXIS_COUPLING)',
            'The whole chain, in Python after each scene.step():',
            f'  from {_MODEL} import SensorModel',
            f'  sensor = SensorModel({export.source!r})',
            '  readings = sensor(imu.read_ground_truth().lin_acc, DT_S)')), '',
        f'DT_S = {dt_s!r}',
        'ACCELEROMETER = {', *(f'    {name!r}: {value!r},' for name, value in options.items()),
        '}', 'CROSS_AXIS_COUPLING = (',
        *(f'    {tuple(row)!r},' for row in coupling.tolist()), ')', ''])


def _mujoco(export: Export) -> str:
    """
    MuJoCo: a body with a site and an accelerometer, as MJCF.

    MuJoCo stores `noise` since 3.1.4 without adding it, and has one value for all axes: the
    largest.
    """
    sensor = export.sensor
    noise_mps2 = max(by_axis(sensor, 'noise_std_mps2'))
    # The comment names it, too, and may not hold two dashes.
    name = re.sub('-+', '-', sensor.serial)
    comment = head(export, 'MuJoCo',
                   'noise is the largest of the axes. Include this file, or copy site and sensor.',
                   'The whole chain, in Python after each mj_step:',
                   f'  from {_MODEL} import SensorModel',
                   f'  sensor = SensorModel({export.source!r})',
                   f'  reading = sensor(data.sensor({name!r}).data, model.opt.timestep)')
    return '\n'.join([
        *_xml_comment(comment),
        '<mujoco>', '  <worldbody>', '    <body name="imu_link">',
        f'      <site name={quoteattr(name)} pos="{" ".join(map(repr, arm_m(sensor)))}"/>',
        '    </body>', '  </worldbody>', '  <sensor>',
        f'    <accelerometer name={quoteattr(name)} site={quoteattr(name)} '
        f'noise="{noise_mps2!r}"/>',
        '  </sensor>', '</mujoco>', ''])


def _sdf(export: Export) -> str:
    """
    SDFormat: an `<imu>` of gz-sensors (Gazebo), in a link of a model.

    The zero-g is the mean of the noise. gz-sensors changes the sign of `<bias_mean>` at random
    (GaussianNoiseModel.cc), but not that of `<mean>`.
    """
    sensor = export.sensor
    comment = head(export, 'SDFormat',
                   'The zero-g is in mean, because gz-sensors draws the sign of bias_mean.',
                   *flat_noise_lines(sensor))
    lines = ['<?xml version="1.0"?>', *_xml_comment(comment),
             '<sdf version="1.9">', '  <model name="imu">', '    <link name="imu_link">',
             f'      <sensor name={quoteattr(sensor.serial)} type="imu">',
             f'        <pose>{" ".join(map(repr, arm_m(sensor)))} 0 0 0</pose>',
             '        <always_on>true</always_on>',
             f'        <update_rate>{sensor.rate_hz!r}</update_rate>',
             '        <imu>', '          <linear_acceleration>']
    for axis in axes(sensor):
        values = {'mean': axis.zero_g_mps2, 'stddev': axis.noise_std_mps2, 'bias_mean': 0.0,
                  'bias_stddev': 0.0}
        if axis.walk_density:
            values |= {'dynamic_bias_stddev': axis.walk_density,
                       'dynamic_bias_correlation_time':
                           1 / (axis.walk_return_per_s or 1 / _WALK_S)}
        if axis.step_mps2:
            values['precision'] = axis.step_mps2
        kind = 'gaussian_quantized' if axis.step_mps2 else 'gaussian'
        lines += [f'            <{axis.name}>', f'              <noise type="{kind}">',
                  *(f'                <{name}>{value!r}</{name}>'
                    for name, value in values.items()),
                  '              </noise>', f'            </{axis.name}>']
    return '\n'.join([*lines, '          </linear_acceleration>', '        </imu>',
                      '      </sensor>', '    </link>', '  </model>', '</sdf>', ''])


_STD = {WHITE_NOISE: 'std', 'noise_excess': 'std', 'bias': 'mean'}
"""Places of the parts in Gaussian noise."""

SIMULATORS = {
    'genesis': Format(
        'Python module with options of an IMU of Genesis 0.4 to 1.4',
        {WHITE_NOISE: 'acc_noise', 'noise_excess': 'acc_noise', 'bias': 'acc_bias',
         'bias_walk': 'acc_random_walk', 'scale_factor': 'CROSS_AXIS_COUPLING',
         'misalignment': 'CROSS_AXIS_COUPLING', 'lever_arm': 'pos_offset',
         STEPS: 'acc_resolution', 'quantisation': 'acc_resolution', 'time_offset': 'delay'},
        _genesis),
    'isaaclab': Format(
        'Python module with configurations of Isaac Lab, 2.x and 3.0',
        {**_STD, 'lever_arm': 'pos'},
        _isaaclab),
    'mjlab': Format(
        'Python module with configurations of mjlab 1.x',
        {**_STD, 'lever_arm': 'POS'},
        _mjlab),
    'mujoco': Format(
        'site and accelerometer of MuJoCo (MJCF)',
        {'lever_arm': 'pos of the site', WHITE_NOISE: 'noise (MuJoCo does not add it)',
         'noise_excess': 'noise (MuJoCo does not add it)'},
        _mujoco),
    'sdf': Format(
        'imu of gz-sensors, Gazebo (SDFormat)',
        {WHITE_NOISE: '<stddev>', 'noise_excess': '<stddev>', 'bias': '<mean>',
         'bias_walk': '<dynamic_bias_stddev>', 'lever_arm': '<pose>', STEPS: '<precision>',
         'quantisation': '<precision>'},
        _sdf),
}
"""Formats by name."""
