# SPDX-License-Identifier: Apache-2.0

"""
A sensor in the formats of other software: a table of formats, each with a function.

A format states which parts of the sensor it holds, with their places in the file; the head of each
file lists them beside what it cannot hold.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
import json
import re
from textwrap import wrap
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.files.parameter_file import float_text
from adxl_ros.model import noise, signal_chain
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Place
from adxl_ros.model.noise import ONE_SIDED
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from adxl_ros.process import package_version
import numpy as np

WHITE_NOISE = 'white noise'
"""Name of the part: noise of one sample before the ADC."""
FILTER = 'RC filter'
"""Name of the part: the low-pass of the output."""
STEPS = 'ADC steps'
"""Name of the part: rounding of the ADC."""

_NO_AXIS_VARIANCE = 1e6
"""Variance of an axis that the sensor does not have, (m/s²)², as the driver publishes it."""
_COLUMNS = 75
"""Columns of the head without the signs of a comment; chosen: 79 with them."""
_SMALLEST_MG = 5e-4
"""Size below which a part counts as 0, mg; chosen: half of the last digit."""
_WALK_S = 1e9
"""Correlation time of a walk without bounds, s; chosen: far longer than any simulation."""
_ABSENT = np.diag([-1.0, 0.0, 0.0])
"""Covariance of a quantity that the sensor does not measure (sensor_msgs/Imu)."""
_MODEL = 'adxl_ros.simulate.sensor_model'
"""Module of the whole chain, which files name."""


@dataclass(frozen=True)
class Export:
    """A sensor that is written for other software."""

    sensor: Sensor  # The unit
    source: str  # Name of its parameter file
    # Rms of what each part of the sensor changes, mg, by its name: effects but those of the stage,
    # and the constants above
    sizes_mg: Mapping[str, float]
    # Rms of all that the format does not hold, mg, without noise and steps of the ADC
    remaining_mg: float


class Format(NamedTuple):
    """A format of files."""

    meaning: str  # What the file is, for the help text
    holds: Mapping[str, str]  # Place in the file by name of the part that it holds
    text: Callable[[Export], str]  # Returns the content of a file


@dataclass(frozen=True)
class Axis:
    """Values of one axis in SI units."""

    name: str  # x, y or z
    zero_g_mps2: float  # Output at 0 g by the nominal conversion, m/s²
    noise_std_mps2: float  # Noise of one sample before the ADC, m/s²
    sample_variance: float  # Variance of one sample with the rounding of the ADC, (m/s²)²
    noise_density: float  # Density of the white noise over positive frequencies, m/s²/√Hz
    walk_density: float  # Density of the random walk of the zero-g, m/s²/√s; 0 without `bias_walk`
    # Inverse correlation time of a walk that has bounds, 1/s; 0 without them
    walk_return_per_s: float
    step_mps2: float  # Step of the ADC, m/s²; 0 for none


def axes(sensor: Sensor) -> list[Axis]:
    """Return the values of the measured axes at 25 °C and the nominal supply."""
    mps2_per_v = G0_MPS2 / sensor.nominal_scale_v_per_g
    at_zero_v = np.array([signal_chain.analog_response(sensor)([0.0, 0.0, 0.0])])
    zero_g = to_nominal_mps2(at_zero_v, sensor)[0]
    lost = sensor.values.get('quantisation', {})
    lost_bits = np.asarray(lost.get('lost_bits', 0.0)) + lost.get('axis_lost_bits', 0.0)
    step = sensor.lsb_v * 2.0 ** lost_bits * mps2_per_v
    std = noise.analog_std_v(sensor) * mps2_per_v
    density = (noise.electronics(sensor).noise_ratio * sensor.noise_density_g_per_rthz * G0_MPS2)
    walk, returns = (np.broadcast_to(sensor.values.get('bias_walk', {}).get(name, 0.0),
                                     len(sensor.axes))
                     for name in ('density_g_per_rts', 'return_per_s'))
    return [Axis(name, *(float(values[d]) for values in (
        zero_g, std, std ** 2 + step ** 2 / 12, density, walk * G0_MPS2, returns, step)))
        for d, name in enumerate(sensor.axes)]


def _arm_m(sensor: Sensor) -> list[float]:
    """Return the position of the sensor on its link, m: the lever arm, or zero without one."""
    values = sensor.values.get('lever_arm', {})
    return [float(values.get(f'{axis}_m', 0.0)) for axis in AXES]


def _head(export: Export, software: str, name: str, *further: str) -> list[str]:
    """Return the head of a file: what it holds of the sensor, and what it cannot hold."""
    sensor, holds = export.sensor, FORMATS[name].holds
    width = max(map(len, export.sizes_mg)) + 2
    lines = [f'Sensor {sensor.serial}, axes {" ".join(sensor.axes)}, {sensor.rate_hz:.5g} Hz.',
             f'Written by adxl_ros {package_version()} for {software}, from {export.source}.',
             '',
             f'{"part":{width}}{"size, mg rms":14}in this file']
    for part, size_mg in sorted(export.sizes_mg.items(), key=lambda part: -part[1]):
        lines.append(f'{part:{width}}{size_text(size_mg):14}{place_text(part, holds)}')
    missing = [axis for axis in AXES if axis not in sensor.axes]
    if missing:
        lines += ['', f'The sensor has no {" and no ".join(missing)}: do not use that output.']
    if stage := stage_effects(sensor):
        lines += ['', *wrap('Left out, as errors of the stage or of another reference: '
                            f'{", ".join(stage)}.', _COLUMNS)]
    return [*lines, '', *wrap(origin_text(sensor), _COLUMNS), '',
            'Sizes: change of the output in the manoeuvre rich (7 minutes of turns,',
            'shaking, warming and a step of the supply), by simulation.',
            'All that is not held, but for noise and steps: '
            f'{size_text(export.remaining_mg)} mg rms.', '', *further]


def _commented(lines: list[str]) -> list[str]:
    """Return lines as comments behind a hash."""
    return [f'# {line}'.rstrip() for line in lines]


def _xml_comment(lines: list[str]) -> list[str]:
    """Return lines as a comment of XML, which may not hold two dashes."""
    return ['<!--', *(f'  {line}'.rstrip().replace('--', '- -') for line in lines), '-->']


def origin_text(sensor: Sensor) -> str:
    """Return whose figures the white noise and the sample rate are."""
    noise_from, rate_from = map(sensor.provenance.get, ('noise_from', 'rate_from'))
    stated = sensor.datasheet_name or 'the parameter file'
    return (f'White noise: measured in {noise_from}. ' if noise_from else
            f'White noise: the figure of {stated}; nobody measured it. ') + (
            f'Rate: that of {rate_from}.' if rate_from else
            'Rate: as the parameter file states it.')


def _flat_noise_lines(sensor: Sensor) -> list[str]:
    """
    Return how much quieter white noise is than filtered noise of the same rms at low frequency.

    Filtered noise is an AR(1) sequence with a = exp(−dt/RC). At low frequency its density is
    √((1 + a)/(1 − a)) times that of white noise of the same variance.
    """
    rc_s = float(noise.electronics(sensor).rc_s.max())
    if not rc_s:
        return []
    ratio = np.tanh(0.5 / (sensor.rate_hz * rc_s)) ** -0.5
    return wrap('White noise is not filtered here: its spectrum is flat up to half the rate. Its '
                f'density is {ratio:.3g} times too small below the corner of the filter, '
                f'{0.5 / (np.pi * rc_s):.3g} Hz.', _COLUMNS)


def stage_effects(sensor: Sensor) -> list[str]:
    """Return the effects that are errors of a reference, and do not go with the sensor."""
    return [name for name in sensor.effects
            if effect_named(name).place in (Place.REFERENCE, Place.STAGE)]


def size_text(size_mg: float) -> str:
    """Return a size with three digits, mg."""
    return f'{size_mg:.3g}' if size_mg >= _SMALLEST_MG else '< 0.0005'


def place_text(name: str, holds: Mapping[str, str]) -> str:
    """Return where a file holds a part of the sensor."""
    return holds.get(name, 'not held')


def _broadcaster(export: Export) -> str:
    """ros2_controllers: parameters of `imu_sensor_broadcaster` with its static covariances."""
    variance = {axis.name: axis.sample_variance for axis in axes(export.sensor)}
    by_axis = np.diag([variance.get(name, _NO_AXIS_VARIANCE) for name in AXES])
    return '\n'.join([
        *_commented(_head(
            export, 'imu_sensor_broadcaster', 'broadcaster',
            'The covariance is that of one sample. Set sensor_name to that of the URDF.')),
        'imu_sensor_broadcaster:', '  ros__parameters:', '    sensor_name: imu',
        '    frame_id: imu_link',
        *(f'    static_covariance_{quantity}: '
          f'[{", ".join(float_text(value) for value in matrix.ravel().tolist())}]'
          for quantity, matrix in (('orientation', _ABSENT), ('angular_velocity', _ABSENT),
                                   ('linear_acceleration', by_axis))), ''])


def _isaaclab(export: Export) -> str:
    """Isaac Lab: a Python module with `ImuCfg` and the noise of its observation."""
    sensor = export.sensor
    by_name = {axis.name: axis for axis in axes(sensor)}
    mean, std = ([getattr(by_name[name], field) if name in by_name else 0.0 for name in AXES]
                 for field in ('zero_g_mps2', 'noise_std_mps2'))
    comment = _head(export, 'Isaac Lab', 'isaaclab', *_flat_noise_lines(sensor),
                    'The whole chain for all environments, in each step:',
                    f'  from {_MODEL} import SensorModel',
                    f'  sensor = SensorModel({export.source!r})',
                    '  readings = sensor(imu.data.lin_acc_b.cpu().numpy(), dt)')
    return '\n'.join([
        *_commented(comment), '',
        'from isaaclab.sensors import ImuCfg',
        'from isaaclab.utils.noise import GaussianNoiseCfg',
        'import torch', '',
        '# ImuCfg(prim_path=..., offset=OFFSET, update_period=UPDATE_PERIOD_S)',
        f'OFFSET = ImuCfg.OffsetCfg(pos={tuple(_arm_m(sensor))!r})',
        f'UPDATE_PERIOD_S = {1 / sensor.rate_hz!r}', '',
        '# ObsTerm(func=mdp.imu_lin_acc, noise=ACCELERATION_NOISE), m/s^2',
        'ACCELERATION_NOISE = GaussianNoiseCfg(',
        f'    mean=torch.tensor({mean!r}),',
        f'    std=torch.tensor({std!r}),',
        "    operation='add')", ''])


def _json(export: Export) -> str:
    """
    JSON: all values with units, and the sizes of all parts.

    Its model is the linear response at 0 g, 25 °C and the nominal supply, with filter, noise and
    steps. The parameters of all effects are in it, but not their functions.
    """
    sensor = export.sensor
    by_force = signal_chain.jacobian(signal_chain.analog_response(sensor), [0.0, 0.0, 0.0])
    gain = by_force * G0_MPS2 / sensor.nominal_scale_v_per_g[:, None]
    holds = FORMATS['json'].holds
    effects: dict[str, dict[str, Any]] = {}
    for effect in sensor.effects:
        units = {parameter.name: parameter.unit for parameter in effect_named(effect).parameters}
        effects[effect] = {name: {'value': np.asarray(value, float).tolist(), 'unit': units[name]}
                           for name, value in sensor.values[effect].items()}
    return json.dumps({
        'schema': 1,
        'source': export.source,
        'adxl_ros': package_version(),
        'serial': sensor.serial,
        'rate_hz': sensor.rate_hz,
        'axes': [asdict(axis) for axis in axes(sensor)],
        'units': {'zero_g_mps2': 'm/s^2', 'noise_std_mps2': 'm/s^2',
                  'sample_variance': '(m/s^2)^2', 'noise_density': 'm/s^2/sqrt(Hz), one-sided',
                  'walk_density': 'm/s^2/sqrt(s)', 'walk_return_per_s': '1/s',
                  'step_mps2': 'm/s^2'},
        'gain': gain.tolist(),
        'filter_s': noise.electronics(sensor).rc_s.tolist(),
        'position_m': _arm_m(sensor),
        'effects': effects,
        'parts': [{'name': name, 'size_mg': round(size, 6), 'place': place_text(name, holds)}
                  for name, size in export.sizes_mg.items()],
        'not_held_mg': round(export.remaining_mg, 6),
        'parameter_file': parameter_file.to_flat(sensor),
    }, indent=1) + '\n'


def kalibr_settings(white: float, walk: float, rate_hz: float) -> list[tuple[str, float, str]]:
    """Return the settings of Kalibr, which are densities over both signs of the frequency."""
    return [('accelerometer_noise_density', white, 'm/s^2/sqrt(Hz)'),
            ('accelerometer_random_walk', walk, 'm/s^3/sqrt(Hz)'), ('update_rate', rate_hz, 'Hz')]


def _kalibr(export: Export) -> str:
    """Kalibr: the accelerometer's part of `imu.yaml`, the largest value of all axes."""
    values = axes(export.sensor)
    white = max(axis.noise_density for axis in values) / ONE_SIDED
    if not white:
        raise UserError(f'{export.source}: sensor.noise_density_g_per_rthz is 0, which Kalibr '
                        'refuses; measure it: ros2 run adxl_ros noise RECORDING -o FILE.yaml')
    walk = max(axis.walk_density for axis in values)
    comment = _head(export, 'Kalibr', 'kalibr', 'Densities are the largest of the axes.')
    if not walk:
        walk = effect_named('bias_walk').diagnosis.healthy_density * G0_MPS2
        comment += ['The random walk is that of a healthy unit: the file states none.']
    comment += ['This sensor has no gyroscope. Kalibr needs these lines of yours, too:',
                'gyroscope_noise_density, gyroscope_random_walk']
    return '\n'.join([
        *_commented(comment), 'rostopic: /imu/data_raw',
        *(f'{name}: {float_text(value)}  # {unit}'
          for name, value, unit in kalibr_settings(white, walk, export.sensor.rate_hz)), ''])


def _mujoco(export: Export) -> str:
    """
    MuJoCo: a body with a site and an accelerometer, as MJCF.

    MuJoCo stores `noise` since 3.1.4 without adding it, and has one value for all axes: the
    largest.
    """
    sensor = export.sensor
    noise_mps2 = max(axis.noise_std_mps2 for axis in axes(sensor))
    # The comment names it, too, and may not hold two dashes.
    name = re.sub('-+', '-', sensor.serial)
    comment = _head(export, 'MuJoCo', 'mujoco',
                    'noise is the largest of the axes. Include this file, or copy site and '
                    'sensor.',
                    'The whole chain, in Python after each mj_step:',
                    f'  from {_MODEL} import SensorModel',
                    f'  sensor = SensorModel({export.source!r})',
                    f'  reading = sensor(data.sensor({name!r}).data, model.opt.timestep)')
    return '\n'.join([
        *_xml_comment(comment),
        '<mujoco>', '  <worldbody>', '    <body name="imu_link">',
        f'      <site name={quoteattr(name)} pos="{" ".join(map(repr, _arm_m(sensor)))}"/>',
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
    comment = _head(export, 'SDFormat', 'sdf',
                    'The zero-g is in mean, because gz-sensors draws the sign of bias_mean.',
                    *_flat_noise_lines(sensor))
    lines = ['<?xml version="1.0"?>', *_xml_comment(comment),
             '<sdf version="1.9">', '  <model name="imu">', '    <link name="imu_link">',
             f'      <sensor name={quoteattr(sensor.serial)} type="imu">',
             f'        <pose>{" ".join(map(repr, _arm_m(sensor)))} 0 0 0</pose>',
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


FORMATS = {
    'broadcaster': Format(
        'parameters of imu_sensor_broadcaster (ros2_controllers)',
        dict.fromkeys((WHITE_NOISE, 'noise_excess', STEPS, 'quantisation'), 'covariance'),
        _broadcaster),
    'isaaclab': Format(
        'Python module with configurations of Isaac Lab',
        {WHITE_NOISE: 'std', 'noise_excess': 'std', 'bias': 'mean', 'lever_arm': 'pos'},
        _isaaclab),
    'json': Format(
        'all values with units, for any program',
        {WHITE_NOISE: 'axes.noise_std_mps2', 'noise_excess': 'axes.noise_std_mps2',
         'bias': 'axes.zero_g_mps2', 'scale_factor': 'gain', 'misalignment': 'gain',
         'bias_walk': 'axes.walk_density', 'lever_arm': 'position_m', STEPS: 'axes.step_mps2',
         'quantisation': 'axes.step_mps2', FILTER: 'filter_s', 'bandwidth': 'filter_s'},
        _json),
    'kalibr': Format(
        'the part of the accelerometer in imu.yaml of Kalibr',
        {WHITE_NOISE: 'accelerometer_noise_density',
         'noise_excess': 'accelerometer_noise_density', 'bias_walk': 'accelerometer_random_walk'},
        _kalibr),
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
