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

"""A sensor's stated figures, its fitted departures from them, and where they come from."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.validity import Envelope
import numpy as np

MODELS = ('nominal', 'linear', 'physical', 'full', 'gravity')


def _figure(key: str, doc: str, unit: str = '', lower: float | None = None,
            upper: float | None = None, choices: tuple[str, ...] = ()) -> Any:
    """Declare one stated figure: its key in a parameter file, its unit, bounds and meaning."""
    return field(metadata={'key': key, 'doc': doc, 'unit': unit, 'lower': lower,
                           'upper': upper, 'choices': choices})


@dataclass(frozen=True)
class Sensor:
    """
    One unit: the nominal chain by its stated figures, and the effects that depart from it.

    The metadata of each field is the only description of the figure: the parameter file, the
    nodes' parameters and the error messages all read it. Arrays marked (m,) have one entry an
    axis of `axes`.

    `datasheet` has the typical and the greatest departure by `effect.parameter` as the maker
    states them, in the parameter's unit, 0 where he does not; `datasheet_name` is what they are
    of.
    """

    serial: str = _figure('sensor.serial', 'serial number; nominal is no unit in particular')
    axes: str = _figure('sensor.axes', 'measured axes', choices=('x', 'xy', 'xyz'))
    nominal_zero_g_v: np.ndarray = _figure(
        'sensor.nominal_zero_g_v', 'zero-g output by the datasheet, by axis', 'V', -10.0, 10.0)
    nominal_scale_v_per_g: np.ndarray = _figure(
        'sensor.nominal_scale_v_per_g', 'scale factor by the datasheet, by axis', 'V/g',
        1e-3, 10.0)
    noise_density_g_per_rthz: np.ndarray = _figure(
        'sensor.noise_density_g_per_rthz', 'white noise density, by axis', 'g/sqrt(Hz)',
        0.0, 0.1)
    rc_resistance_ohm: float = _figure(
        'sensor.rc_resistance_ohm', 'output resistance that the filter capacitor sees', 'Ohm',
        0.0, 1e9)
    rc_capacitance_f: float = _figure(
        'sensor.rc_capacitance_f', 'filter capacitor; 0 is no filter', 'F', 0.0, 1.0)
    adc_bits: int = _figure('sensor.adc_bits', 'resolution of the ADC; 0 does not quantise',
                            'bit', 0, 32)
    adc_vref_v: float = _figure('sensor.adc_vref_v', 'full scale of the ADC', 'V', 0.1, 100.0)
    rate_hz: float = _figure('sensor.rate_hz', 'sample rate', 'Hz', 0.01, 100000.0)
    range_g: float = _figure('sensor.range_g', 'measuring range by the datasheet', 'g',
                             0.1, 1000.0)
    local_gravity_mps2: float = _figure(
        'sensor.local_gravity_mps2', 'gravity where the sensor is', 'm/s^2', 9.7, 9.9)
    z_sign: int = _figure(
        'sensor.z_sign', 'which way up, for the z of equation 5: 1 or -1', '', -1, 1)
    stage_resolution_rad: float = _figure(
        'stage.resolution_rad', "step of the stage's encoder, or of the scale read by hand",
        'rad', 0.0, 1.0)
    model: str = _figure('model', 'what was fitted', choices=MODELS)
    effects: tuple[str, ...] = ()
    values: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    covariance_names: tuple[Coefficient, ...] = ()
    provenance: dict[str, str] = field(default_factory=dict)
    envelope: Envelope = Envelope()
    datasheet_name: str = ''
    datasheet: dict[Coefficient, tuple[float, float]] = field(default_factory=dict)

    @property
    def zero_g_v(self) -> np.ndarray:
        """Zero-g output of this unit, V, (m,)."""
        return self.nominal_zero_g_v + self._value('bias', 'offset_v')

    @property
    def scale_v_per_g(self) -> np.ndarray:
        """Scale factor of this unit, V/g, (m,)."""
        return self.nominal_scale_v_per_g + self._value('scale_factor', 'offset_v_per_g')

    @property
    def rc_s(self) -> float:
        """Time constant of the output filter, s."""
        return self.rc_resistance_ohm * self.rc_capacitance_f

    @property
    def lsb_v(self) -> float:
        """Step of the ADC, V; 0 where it does not quantise."""
        return self.adc_vref_v / 2 ** self.adc_bits if self.adc_bits else 0.0

    def saturated(self, volts: np.ndarray) -> np.ndarray:
        """Tell where volts, (n, m), are at a rail of the ADC or beyond the range, (n, m)."""
        beyond = np.abs(volts - self.nominal_zero_g_v) > self.range_g * self.nominal_scale_v_per_g
        if self.adc_bits:
            beyond |= (volts <= 0) | (volts >= self.adc_vref_v - self.lsb_v)
        return beyond

    def without_covariance(self) -> Sensor:
        """Return the sensor with coefficients that count as exact."""
        return replace(self, covariance=np.zeros((0, 0)), covariance_names=())

    def without_temperature_range(self) -> Sensor:
        """Return the sensor for samples whose temperature is not known: none is outside."""
        return replace(self, envelope=replace(self.envelope, temperature_c=None))

    def _value(self, effect: str, parameter: str) -> np.ndarray:
        known = self.values.get(effect, {})
        return known.get(parameter, np.zeros(len(self.axes)))


def with_axes(sensor: Sensor, axes: str) -> Sensor:
    """
    Give a nominal sensor the axes of the stream at hand.

    Axes are left out from the end, or added with the figures that all axes share.

    Parameters
    ----------
    sensor
        Not calibrated, unless it has these axes.
    axes
        x, xy or xyz.

    Raises
    ------
    UserError
        The sensor is calibrated, or its axes differ in a figure, so that what an added axis
        would be is not known.

    """
    if axes == sensor.axes:
        return sensor
    if sensor.effects:
        raise UserError(f'the parameters of {sensor.serial} are calibrated for the axes '
                        f'{sensor.axes}, not {axes}; name the parameter file of this sensor')
    figures: dict[str, Any] = {name: getattr(sensor, name) for name in (
        'nominal_zero_g_v', 'nominal_scale_v_per_g', 'noise_density_g_per_rthz')}
    for name, of in list(figures.items()):
        if len(axes) > len(of) and np.ptp(of) > 0:
            raise UserError(f'sensor.{name}: {of.tolist()} for {sensor.axes} does not tell the '
                            f'figure of the other axes of {axes}; name a parameter file for '
                            f'{axes}')
        figures[name] = np.array([*of, *[of[0]] * 3])[:len(axes)]
    if len(axes) > len(sensor.axes):
        # A part with more axes is another part.
        figures |= {'datasheet_name': '', 'datasheet': {}}
    return replace(sensor, axes=axes, **figures)


def to_volts(accel_mps2: np.ndarray, sensor: Sensor) -> np.ndarray:
    """
    Undo the nominal conversion: m/s² (n, m) to V (n, m), affine and exact.

    Parameters
    ----------
    accel_mps2
        Nominally converted specific force, m/s², (n, m).
    sensor
        Whose nominal zero-g and scale factor apply.

    """
    return sensor.nominal_zero_g_v + accel_mps2 / G0_MPS2 * sensor.nominal_scale_v_per_g


def to_nominal_mps2(volts: np.ndarray, sensor: Sensor) -> np.ndarray:
    """
    Convert V (n, m) to m/s² (n, m) by the nominal zero-g and scale factor (equation 3).

    Parameters
    ----------
    volts
        ADC volts, (n, m).
    sensor
        Whose nominal zero-g and scale factor apply.

    """
    return (volts - sensor.nominal_zero_g_v) / sensor.nominal_scale_v_per_g * G0_MPS2
