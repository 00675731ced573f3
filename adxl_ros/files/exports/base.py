# SPDX-License-Identifier: Apache-2.0

"""What the formats share: values of a sensor in SI units, and the head of each file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from textwrap import wrap
from typing import Protocol

from adxl_ros.files.package_version import package_version
from adxl_ros.model import analog_stages, noise
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Place
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
import numpy as np

WHITE_NOISE = 'white noise'
"""Name of the part: noise of one sample before the ADC."""

FILTER = 'RC filter'
"""Name of the part: the low-pass of the output."""

STEPS = 'ADC steps'
"""Name of the part: rounding of the ADC."""

NO_AXIS_VARIANCE = 1e6
"""Variance of an axis that the sensor does not have, (m/s²)², as the driver publishes it."""

COLUMNS = 75
"""Columns of the head without the signs of a comment; chosen: 79 with them."""

_SMALLEST_MG = 5e-4
"""Size below which a part counts as 0, mg; chosen: half of the last digit."""


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


class ExportFormat(Protocol):
    """A format of files."""

    HOLDS: Mapping[str, str]  # Place in the file by name of the part that it holds

    def text(self, export: Export, /) -> str:
        """Return the content of a file."""


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
    at_zero_v = np.array([analog_stages.analog_response(sensor)([0.0, 0.0, 0.0])])
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


def arm_m(sensor: Sensor) -> list[float]:
    """Return the position of the sensor on its link, m: the lever arm, or zero without one."""
    values = sensor.values.get('lever_arm', {})
    return [float(values.get(f'{axis}_m', 0.0)) for axis in AXES]


def variances(sensor: Sensor) -> list[float]:
    """Return the variance of one sample of x, y and z, (m/s²)²; very large without the axis."""
    measured = {axis.name: axis.sample_variance for axis in axes(sensor)}
    return [measured.get(name, NO_AXIS_VARIANCE) for name in AXES]


def head(export: Export, format_name: str, holds: Mapping[str, str]) -> list[str]:
    """Return the head of a file: what it holds of the sensor, and what it cannot hold."""
    sensor = export.sensor
    width = max(map(len, export.sizes_mg)) + 2
    lines = [f'Sensor {sensor.serial}, axes {" ".join(sensor.axes)}, {sensor.rate_hz:.5g} Hz.',
             f'Written by adxl_ros {package_version()} for {format_name}, from {export.source}.',
             '',
             f'{"part":{width}}{"size, mg rms":14}in this file']
    for name, size_mg in sorted(export.sizes_mg.items(), key=lambda part: -part[1]):
        lines.append(f'{name:{width}}{size_text(size_mg):14}{place_text(name, holds)}')
    missing = [name for name in AXES if name not in sensor.axes]
    if missing:
        lines += ['', f'The sensor has no {" and no ".join(missing)}: do not use that output.']
    stage = stage_effects(sensor)
    if stage:
        lines += ['', *wrap('Left out, as errors of the stage or of another reference: '
                            f'{", ".join(stage)}.', COLUMNS)]
    lines += ['', *wrap(origin_text(sensor), COLUMNS)]
    return [*lines, '', 'Sizes: change of the output in the manoeuvre rich (7 minutes of turns,',
            'shaking, warming and a step of the supply), by simulation.',
            'All that is not held, but for noise and steps: '
            f'{size_text(export.remaining_mg)} mg rms.']


def origin_text(sensor: Sensor) -> str:
    """Return whose figures the white noise and the sample rate are."""
    noise_from, rate_from = map(sensor.provenance.get, ('noise_from', 'rate_from'))
    stated = sensor.datasheet_name or 'the parameter file'
    return (f'White noise: measured in {noise_from}. ' if noise_from else
            f'White noise: the figure of {stated}; nobody measured it. ') + (
            f'Rate: that of {rate_from}.' if rate_from else
            'Rate: as the parameter file states it.')


def flat_noise_lines(sensor: Sensor) -> list[str]:
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
                f'{0.5 / (np.pi * rc_s):.3g} Hz.', COLUMNS)


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
