# SPDX-License-Identifier: Apache-2.0

"""Sizes of the parts of a sensor: what each changes in the output, by simulation."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace

from adxl_ros.model.coefficients import neutral
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Need
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate.chain_memo import ChainMemo
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.response import Response
from adxl_ros.simulate.trajectories import TRAJECTORIES
import numpy as np

_SEED = 0
"""Seed of the manoeuvre and of noise-like effects."""

_QUIET = 1e-9
"""Factor of the white noise in a comparison; chosen: invisible, but not 0, which effects on the
noise refuse."""

_FINE_BITS = 32
"""Resolution of the ADC in a comparison, bit; chosen: its steps are invisible."""

_RATE_HZ = 250.0
"""Largest sample rate of the comparison, Hz; chosen: above twice the bandwidth of the motion."""

_SHORT_RC_S = 1e-9
"""Time constant of a filter that does nothing, s; chosen: not 0, which `bandwidth` refuses."""


class PartSizes:
    """Simulates a sensor in the manoeuvre `rich` with and without parts of it."""

    def __init__(self, sensor: Sensor) -> None:
        """Prepare the comparison."""
        rich = TRAJECTORIES['rich'](np.random.default_rng(_SEED))
        self._sensor = replace(sensor, rate_hz=min(sensor.rate_hz, _RATE_HZ))
        self._motion: Motion = replace(rich, internal_rate_hz=self._sensor.rate_hz)
        count = int(self._motion.duration_s * self._sensor.rate_hz)
        self._stamps_s = np.arange(count) / self._sensor.rate_hz
        self._memo = ChainMemo()

    def effects_mg(self, effects: Collection[str], show: Callable[[float], None]
                   ) -> dict[str, float]:
        """Return the size of each effect."""
        sizes = {}
        for number, name in enumerate(effects):
            show(number / len(effects))
            needs = effect_named(name).needs
            sensor = self._sensor if {Need.ADC, Need.NOISE} & set(needs) else self._quiet()
            sizes[name] = self._change_mg(sensor, _without(sensor, [name]))
        return sizes

    def filter_mg(self) -> float:
        """Return the rms of what the RC filter changes, mg."""
        return self._change_mg(self._quiet(), _unfiltered(self._quiet()))

    def remaining_mg(self, held: Collection[str], is_filtered: bool) -> float:
        """Return the size of all that some effects leave out."""
        sensor = self._quiet()
        other = _without(sensor, [name for name in sensor.effects if name not in held])
        return self._change_mg(sensor, other if is_filtered else _unfiltered(other))

    def _quiet(self) -> Sensor:
        """Return the sensor with invisible white noise and steps."""
        sensor = self._sensor
        return replace(sensor, adc_bits=_FINE_BITS if sensor.adc_bits else 0,
                       noise_density_g_per_rthz=_QUIET * sensor.noise_density_g_per_rthz)

    def _change_mg(self, sensor: Sensor, other: Sensor) -> float:
        """Return the rms of the difference of two sensors, mg."""
        volts = [Response(unit, self._motion, _SEED).whole(self._stamps_s, self._memo)
                 for unit in (sensor, other)]
        change_g = (volts[0] - volts[1]) / sensor.nominal_scale_v_per_g
        return float(1e3 * np.sqrt(np.mean(change_g ** 2)))


def _without(sensor: Sensor, effects: Collection[str]) -> Sensor:
    """Return the sensor with some effects at their neutral values."""
    return replace(sensor, values={**sensor.values, **{
        name: neutral(effect_named(name), sensor.axes) for name in effects}})


def _unfiltered(sensor: Sensor) -> Sensor:
    """Return the sensor without its filter."""
    if not sensor.rc_s:
        return sensor
    return replace(sensor, rc_resistance_ohm=_SHORT_RC_S / sensor.rc_capacitance_f)
