# SPDX-License-Identifier: Apache-2.0

"""
A sensor in the formats of estimators and simulators.

The head of each file lists the parts of the sensor: where it holds them, or that it cannot.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import cache, partial
import json
from pathlib import Path
import re
from typing import NamedTuple, TYPE_CHECKING

from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.files.parameter_file import float_text
from adxl_ros.model import noise, signal_chain
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.covariance import NOT_MEASURED, UNMEASURED_VARIANCE
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Place
from adxl_ros.model.noise import ONE_SIDED
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from adxl_ros.process import command, package_version
from adxl_ros.report import templates
import numpy as np
import yaml

if TYPE_CHECKING:
    from jinja2 import Environment

WHITE_NOISE = 'white noise'  # Name of a part: noise of a sample before the ADC
FILTER = 'RC filter'  # Name of a part: low-pass of the output
STEPS = 'ADC steps'  # Name of a part: rounding
_TEMPLATES = Path(__file__).with_name('export_templates')  # What the files are made of
_NOT_HELD = 'not held'  # In place of the place of a part that a file lacks
_HIDDEN_S = 3600.0  # Rest that does not show an unstated walk, s. Chosen: an hour
_SMALLEST_MG = 5e-4  # Size below which a part counts as 0, mg; chosen: half of the last digit


@dataclass(frozen=True)
class Export:
    """A sensor that is written for other software."""

    sensor: Sensor  # The sensor
    source: str  # Name of its parameter file
    holds: Mapping[str, str]  # Place in the file by name of the part that it holds
    # Rms of what each part of the sensor changes, mg, by its name: effects but those of the stage,
    # and the constants above
    sizes_mg: Mapping[str, float]
    # Rms of all that the format does not hold, mg, without noise and steps of the ADC
    remaining_mg: float


class Format(NamedTuple):
    """A format of files; its text is the template of its name, or JSON."""

    meaning: str  # What the file is, for the help text
    holds: Mapping[str, str]  # Place in the file by name of the part that it holds


@dataclass(frozen=True)
class Axis:
    """Values of one axis in SI units."""

    name: str  # x, y or z
    zero_g_mps2: float  # Output at 0 g by the nominal conversion, m/s²
    noise_std_mps2: float  # Noise of one sample before the ADC, m/s²
    sample_variance: float  # Variance of one sample with the rounding of the ADC, (m/s²)²
    # Density of the samples at low, positive frequencies with the rounding of the ADC, m/s²/√Hz.
    # Noise above half of the rate of the file aliases into it.
    noise_density: float
    walk_density: float  # Density of the random walk of the zero-g, m/s²/√s; 0 without `bias_walk`
    # Inverse correlation time of a walk that has bounds, 1/s; 0 without them
    walk_return_per_s: float
    step_mps2: float  # Step of the ADC, m/s²; 0 for none


def axes(sensor: Sensor) -> list[Axis]:
    """Return the values of the measured axes at 25 °C and the nominal supply."""
    mps2_per_v = G0_MPS2 / sensor.nominal_scale_v_per_g
    at_zero_v = np.array([signal_chain.analog_response(sensor)([0.0, 0.0, 0.0])])
    zero_g = to_nominal_mps2(at_zero_v, sensor)[0]
    step = noise.electronics(sensor).lsb_v * mps2_per_v
    std = noise.analog_std_v(sensor) * mps2_per_v
    density = np.sqrt(noise.density_v2_per_hz(sensor, np.zeros(1)))[0] * mps2_per_v
    of_walk = sensor.values.get('bias_walk', {})
    count = len(sensor.axes)
    walk = np.broadcast_to(of_walk.get('density_g_per_rts', 0.0), count) * G0_MPS2
    returns = np.broadcast_to(of_walk.get('return_per_s', 0.0), count)
    by_field = {
        'zero_g_mps2': zero_g,
        'noise_std_mps2': std,
        'sample_variance': std**2 + step**2 / 12,
        'noise_density': density,
        'walk_density': walk,
        'walk_return_per_s': returns,
        'step_mps2': step,
    }
    rows = np.column_stack(list(by_field.values())).tolist()
    return [Axis(name, **dict(zip(by_field, row))) for name, row in zip(sensor.axes, rows)]


def by_axis(sensor: Sensor, field: str) -> tuple[float, ...]:
    """Return a field of `Axis` for x, y and z; 0 for an axis that the sensor does not have."""
    of_axis = {axis.name: getattr(axis, field) for axis in axes(sensor)}
    return tuple(of_axis.get(name, 0.0) for name in AXES)


def gain(sensor: Sensor) -> np.ndarray:
    """Return the linear response at 0 g, 25 °C and the nominal supply, (m, 3)."""
    by_force = signal_chain.jacobian(signal_chain.analog_response(sensor), [0.0, 0.0, 0.0])
    return by_force * G0_MPS2 / sensor.nominal_scale_v_per_g[:, None]


def arm_m(sensor: Sensor) -> tuple[float, ...]:
    """Return the position of the sensor on its link, m: the lever arm, or zero without one."""
    values = sensor.values.get('lever_arm', {})
    return tuple(float(values.get(f'{axis}_m', 0.0)) for axis in AXES)


def delay_s(sensor: Sensor) -> float:
    """Return how late the samples are, s; negative if they are early."""
    return float(sensor.values.get('time_offset', {}).get('offset_s', 0.0))


def places(form: Format, sensor: Sensor) -> dict[str, str]:
    """Return the places of what a format holds of a sensor; none holds samples before time."""
    return {
        part: place
        for part, place in form.holds.items()
        if part != 'time_offset' or delay_s(sensor) >= 0
    }


def _head(layouts: Environment, export: Export, software: str, prefix: str = '# ') -> str:
    """Return the head of a file as a comment whose lines begin with a prefix."""
    sensor = export.sensor
    width = max(map(len, export.sizes_mg)) + 2
    layouts.filters |= {'size': size_text, 'column': lambda part: part.ljust(width)}
    head = layouts.get_template('head.jinja').render(
        export=export,
        software=software,
        version=package_version(),
        missing=[axis for axis in AXES if axis not in sensor.axes],
        of_stage=stage_effects(sensor),
    )
    comment = '\n'.join(f'{prefix}{line}'.rstrip() for line in head.splitlines())
    return comment if prefix.startswith('#') else _without_double_dashes(comment)


def _without_double_dashes(comment: str) -> str:
    """Return a comment with single dashes: one of XML may not hold two."""
    return re.sub('--+', '-', comment)


def stage_effects(sensor: Sensor) -> list[str]:
    """Return the effects that are errors of a reference, and do not go with the sensor."""
    return [
        name
        for name in sensor.effects
        if effect_named(name).place in (Place.REFERENCE, Place.STAGE)
    ]


def size_text(size_mg: float) -> str:
    """Return a size with three digits, mg."""
    return f'{size_mg:.3g}' if size_mg >= _SMALLEST_MG else '< 0.0005'


def _json(export: Export) -> str:
    """Return all values: the linear response with units, and the parameter file."""
    sensor = export.sensor
    return (
        json.dumps(
            {
                'schema': 1,
                'source': export.source,
                'adxl_ros': package_version(),
                'serial': sensor.serial,
                'rate_hz': sensor.rate_hz,
                'axes': [asdict(axis) for axis in axes(sensor)],
                'units': {
                    'zero_g_mps2': 'm/s^2',
                    'noise_std_mps2': 'm/s^2',
                    'sample_variance': '(m/s^2)^2',
                    'noise_density': 'm/s^2/sqrt(Hz), one-sided',
                    'walk_density': 'm/s^2/sqrt(s)',
                    'walk_return_per_s': '1/s',
                    'step_mps2': 'm/s^2',
                },
                'gain': gain(sensor).tolist(),
                'filter_s': noise.electronics(sensor).rc_s.tolist(),
                'position_m': arm_m(sensor),
                'parts': [
                    {
                        'name': name,
                        'size_mg': round(size, 6),
                        'place': export.holds.get(name, _NOT_HELD),
                    }
                    for name, size in export.sizes_mg.items()
                ],
                'not_held_mg': round(export.remaining_mg, 6),
                'parameter_file': parameter_file.to_flat(sensor),
            },
            indent=1,
        )
        + '\n'
    )


class GyroFigures(NamedTuple):
    """The noise of a gyroscope for software that has one value for all axes."""

    white: float  # Density over both signs of the frequency, rad/s/√Hz
    walk: float  # Random walk, rad/s/√s
    variances: list[float]  # Variance of a sample by axis, (rad/s)²
    bias: list[float]  # Bias by axis, rad/s; 0 where it is not known
    remark: str  # Where the figures are from, one line for people


def gyro_figures(sensor: Sensor) -> GyroFigures | None:
    """Return the noise of the gyroscope; None where the file states none."""
    gyro = sensor.gyro
    if not gyro.noise_density_radps_per_rthz:
        return None
    white = np.array(gyro.noise_density_radps_per_rthz) / ONE_SIDED
    remark = 'Gyroscope: noise as it was measured.'
    walk = max(gyro.walk_radps_per_rts, default=0)
    if not walk:
        # Its Allan deviation K·√(τ/3) is that of white noise, N/√τ, after this time.
        walk = float(np.sqrt(3) * white.max() / _HIDDEN_S)
        remark = 'Gyroscope: its random walk is one that an hour at rest does not show.'
    return GyroFigures(
        white=float(white.max()),
        walk=walk,
        variances=(white**2 * sensor.rate_hz).tolist(),
        bias=gyro.bias_at().tolist(),
        remark=remark,
    )


def _white_density(export: Export, software: str) -> float:
    """Return the density of the white noise of the noisiest axis over both signs."""
    if not export.sensor.noise_density_g_per_rthz.any():
        raise UserError(
            f'{export.source}: sensor.noise_density_g_per_rthz is 0, and {software} '
            'needs noise; measure it: ' + command('noise', 'RECORDING -o FILE.yaml')
        )
    return max(by_axis(export.sensor, 'noise_density')) / ONE_SIDED


def _largest_mps2(sensor: Sensor) -> float:
    """Return the reading at which the first axis may clip, m/s²: by range, rails or saturation."""
    zero_g_v = sensor.nominal_zero_g_v
    scale = sensor.nominal_scale_v_per_g
    limits_g = [sensor.range_g, *np.ravel(sensor.values.get('saturation', {}).get('limit_g', ()))]
    if sensor.adc_bits:
        limits_g += [*(zero_g_v / scale), *((sensor.adc_vref_v - sensor.lsb_v - zero_g_v) / scale)]
    return float(min(limits_g)) * G0_MPS2


def _yaml(value: float | Sequence[float]) -> str:
    """Return a number, or a list of numbers, as YAML."""
    if isinstance(value, float):
        return float_text(value)
    return f'[{", ".join(map(float_text, value))}]'


def text(name: str, export: Export) -> str:
    """Return the content of a file in a format: the values of a sensor in its template."""
    if name == 'json':
        return _json(export)
    sensor = export.sensor
    values = {field.name: by_axis(sensor, field.name) for field in fields(Axis)[1:]}
    variances = [
        variance if axis in sensor.axes else UNMEASURED_VARIANCE
        for axis, variance in zip(AXES, values['sample_variance'])
    ]
    coupling = np.eye(3)
    coupling[sensor.axis_indices] = gain(sensor)
    walk = max(values['walk_density'])
    remarks = ['Values are those of the noisiest axis.']
    if not walk:
        walk = effect_named('bias_walk').diagnosis.healthy_density * G0_MPS2
        remarks.append('The random walk is that of a healthy unit: the file states none.')
    gyro = gyro_figures(sensor)
    layouts = templates.environment(
        f'--to {name}', ('adxl_ros', 'files/export_templates'), escapes=False
    )
    layouts.filters |= {'yaml': _yaml, 'single_dashes': _without_double_dashes}
    return layouts.get_template(f'{name}.jinja').render(
        head=partial(_head, layouts, export),
        white=partial(_white_density, export),
        walk=walk,
        walk_remarks=remarks,
        gyro=gyro,
        gyro_covariance=np.diag(gyro.variances).ravel().tolist() if gyro else [],
        sensor=sensor,
        source=export.source,
        axes=axes(sensor),
        by_axis=values,
        arm_m=arm_m(sensor),
        delay_s=delay_s(sensor),
        gain=coupling.tolist(),
        absent=NOT_MEASURED.tolist(),
        walk_a_sample=tuple(density / sensor.rate_hz**0.5 for density in values['walk_density']),
        largest_mps2=_largest_mps2(sensor),
        covariance=np.diag(variances).ravel().tolist(),
    )


@cache
def formats() -> dict[str, Format]:
    """Return the formats by their names, in the order of the alphabet."""
    stated = yaml.safe_load((_TEMPLATES / 'formats.yaml').read_text(encoding='utf-8'))
    found = {}
    for name, about in sorted(stated.items()):
        if not name.startswith('.'):
            holds: dict[str, str] = {}
            for place, parts in about['holds'].items():
                holds |= dict.fromkeys(parts, place)
            found[name] = Format(about['meaning'], holds)
    return found
