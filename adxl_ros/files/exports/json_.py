# SPDX-License-Identifier: Apache-2.0

"""JSON: all values with units, the linear response, and the sizes of all parts."""

from __future__ import annotations

from dataclasses import asdict
import json
from typing import Any

from adxl_ros.files import parameter_file
from adxl_ros.files.exports.base import (
    arm_m,
    axes,
    Export,
    FILTER,
    place_text,
    STEPS,
    WHITE_NOISE,
)
from adxl_ros.files.package_version import package_version
from adxl_ros.model import analog_stages, noise, signal_chain
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import effect_named
import numpy as np

HOLDS = {WHITE_NOISE: 'axes.noise_std_mps2', 'noise_excess': 'axes.noise_std_mps2',
         'bias': 'axes.zero_g_mps2', 'scale_factor': 'gain', 'misalignment': 'gain',
         'bias_walk': 'axes.walk_density', 'lever_arm': 'position_m', STEPS: 'axes.step_mps2',
         'quantisation': 'axes.step_mps2', FILTER: 'filter_s', 'bandwidth': 'filter_s'}


def text(export: Export) -> str:
    """
    Return the content of a file.

    Its model is the linear response at 0 g, 25 °C and the nominal supply, with filter, noise and
    steps. The parameters of all effects are in it, but not their functions.
    """
    sensor = export.sensor
    by_force = signal_chain.jacobian(analog_stages.analog_response(sensor), [0.0, 0.0, 0.0])
    gain = by_force * G0_MPS2 / sensor.nominal_scale_v_per_g[:, None]
    content: dict[str, Any] = {
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
        'position_m': arm_m(sensor),
        'effects': {name: _parameters(name, sensor.values[name]) for name in sensor.effects},
        'parts': [{'name': name, 'size_mg': round(size, 6), 'place': place_text(name, HOLDS)}
                  for name, size in export.sizes_mg.items()],
        'not_held_mg': round(export.remaining_mg, 6),
        'parameter_file': parameter_file.to_flat(sensor),
    }
    return json.dumps(content, indent=1) + '\n'


def _parameters(effect: str, values: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return the parameters of an effect with their units."""
    units = {parameter.name: parameter.unit for parameter in effect_named(effect).parameters}
    return {name: {'value': np.asarray(value, float).tolist(), 'unit': units[name]}
            for name, value in values.items()}
