# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""A unit of this world: its true values, and those that its user's parameter file states."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

G0 = 9.80665
"""Standard gravity, m/s², exact."""
ADC_BITS = 16
"""Resolution of the ADC, bits; chosen: that of the paper."""
ADC_VREF = 5.0
"""Range of the ADC, V; chosen: that of the paper."""
LSB_V = ADC_VREF / 2 ** ADC_BITS
"""Step of the ADC, V."""
ZERO_G_STD_G = 150e-6
"""Standard deviation of zero-g since its calibration some days ago, g; chosen."""
SCALE_STD = 150e-6
"""Standard deviation of the scale factor since then, a share; chosen."""
STAGE_STD = 0.15
"""Standard deviation of each error of the stage, in its stated resolution; chosen."""


@dataclass(frozen=True)
class Unit:
    """
    A sensor on its stage; m axes. `stated_` values are those that the user knows.

    Attributes
    ----------
    axes
        Measured axes, 'xy' or 'xyz'.
    zero_v, scale_v_per_g
        Zero-g, V, and scale factor, V/g, on the day of the recording, (m,).
    stated_zero_v, stated_scale_v_per_g
        The same by the calibration, (m,).
    noise_g_per_rthz, stated_noise_g_per_rthz
        Noise density, g/√Hz, (m,).
    corner_hz
        Corner of the output filter, Hz.
    walk_g_per_rts, flicker_g
        Random walk, g/√s, and size of the 1/f noise, g, (m,).
    resolution_rad
        Stated resolution of the stage, rad.
    stage_rad
        Errors of alpha, then of beta, rad, (6,): offset, and parts of sine and cosine.
    rate_hz
        Sample rate, Hz.

    """

    axes: str
    zero_v: np.ndarray
    scale_v_per_g: np.ndarray
    stated_zero_v: np.ndarray
    stated_scale_v_per_g: np.ndarray
    noise_g_per_rthz: np.ndarray
    stated_noise_g_per_rthz: np.ndarray
    corner_hz: float
    walk_g_per_rts: np.ndarray
    flicker_g: np.ndarray
    resolution_rad: float
    stage_rad: np.ndarray
    rate_hz: float

    @property
    def axis_indices(self) -> list[int]:
        """Return the indices of the measured axes among x, y and z."""
        return ['xyz'.index(axis) for axis in self.axes]

    @property
    def volts_to_mps2(self) -> np.ndarray:
        """Return the factor from V to m/s² by the stated scale factor, (m, 1)."""
        return (G0 / self.stated_scale_v_per_g)[:, None]


def draw(rng: np.random.Generator) -> Unit:
    """Draw a unit like an ADXL203 with a 50 Hz filter, calibrated some days before."""
    axes = 'xyz' if rng.random() < 0.7 else 'xy'
    n = len(axes)
    zero = 2.5 + 0.1 * np.clip(rng.normal(0, 0.4, n), -1, 1)
    scale = 1.0 + 0.04 * np.clip(rng.normal(0, 0.5, n), -1, 1)
    noise = 110e-6 * np.exp(rng.normal(0, 0.12, n))
    corner = 50.0 * np.exp(rng.normal(0, 0.08))
    resolution = float(np.deg2rad(rng.choice([0.002, 0.005, 0.01])))
    return Unit(
        axes, zero, scale,
        zero + ZERO_G_STD_G * scale * rng.normal(size=n),
        scale * (1 + SCALE_STD * rng.normal(size=n)),
        noise, noise * np.exp(rng.normal(0, 0.015, n)),
        corner,
        10 ** rng.uniform(-6.0, -5.1, n), 10 ** rng.uniform(-5.3, -4.7, n),
        resolution, STAGE_STD * resolution * np.clip(rng.normal(size=6), -2, 2),
        float(rng.choice([100.0, 125.0, 200.0, 250.0])))


def parameter_file(unit: Unit, serial: str) -> str:
    """
    Return the parameter file that the user has; every number takes the same space.

    Parameters
    ----------
    unit
        The unit.
    serial
        Its serial number.

    Returns
    -------
    str
        YAML text.

    """
    n = len(unit.axes)

    def row(values: np.ndarray) -> str:
        return '[' + ', '.join(f'{value:+.9e}' for value in values) + ']'

    names = [f'bias.offset_v.{axis}' for axis in unit.axes] + [
        f'scale_factor.offset_v_per_g.{axis}' for axis in unit.axes]
    spread = np.concatenate([ZERO_G_STD_G * unit.stated_scale_v_per_g,
                             SCALE_STD * unit.stated_scale_v_per_g])
    resistance = 32e3
    return f"""\
/**:
  ros__parameters:
    format: 1
    units: 'V, V/g, 1/g, rad'
    model: linear
    sensor:
      serial: {serial}
      axes: {unit.axes}
      nominal_zero_g_v: {row(np.full(n, 2.5))}
      nominal_scale_v_per_g: {row(np.full(n, 1.0))}
      noise_density_g_per_rthz: {row(unit.stated_noise_g_per_rthz)}
      rc_resistance_ohm: {resistance:.9e}
      rc_capacitance_f: {1 / (2 * np.pi * resistance * unit.corner_hz):.9e}
      adc_bits: {ADC_BITS}
      adc_vref_v: {ADC_VREF}
      rate_hz: {unit.rate_hz:05.1f}
      range_g: 1.7
      local_gravity_mps2: {G0}
      z_sign: 1
    stage:
      resolution_rad: {unit.resolution_rad:.9e}
    effects: [bias, scale_factor]
    bias:
      offset_v: {row(unit.stated_zero_v - 2.5)}
    scale_factor:
      offset_v_per_g: {row(unit.stated_scale_v_per_g - 1.0)}
    covariance_names: [{', '.join(names)}]
    covariance: {row(np.diag(spread ** 2).ravel())}
    provenance:
      source: sweep
"""
