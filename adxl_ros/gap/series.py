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

"""A recording beside the simulator's baseline on its own reference motion."""

from __future__ import annotations

from dataclasses import dataclass, replace

from adxl_ros.files.columns import Recording
from adxl_ros.files.followed import followed
from adxl_ros.model import chain
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import effect_named
from adxl_ros.model.follow import Smoothed
from adxl_ros.model.motion import Motion, Path
from adxl_ros.model.response import Response
from adxl_ros.model.sensor import Sensor
import numpy as np

SEARCH_RATE_HZ = 125.0
"""The search looks at samples about this often; what is found is confirmed at the full rate."""
_INTERNAL_RATE_HZ = 250.0
_STILL_RAD_S = 1e-3
_AROUND_STILL_S = 0.3
"""A sample is still if no joint moves within this before it: the filter has settled."""


@dataclass(frozen=True)
class Series:
    """
    Samples of one recording, (n,) of them, and what the simulator needs to follow it.

    Attributes
    ----------
    name
        Of the recording, for people.
    time_s, volts
        Stamps, s, (n,), and output, V, (n, m).
    motion
        Of the reference.
    sensor
        The baseline: stated figures and the effects of the parameter file, at this rate.
    reference
        'stage', 'sim' (another simulator's specific force) or 'rest' (it never moves).
    columns
        References by name, (n,) each.
    still
        Samples at which nothing moves, (n,).

    """

    name: str
    time_s: np.ndarray
    volts: np.ndarray
    motion: Motion
    sensor: Sensor
    reference: str
    columns: dict[str, np.ndarray]
    still: np.ndarray

    def __len__(self) -> int:
        """Count the samples."""
        return len(self.time_s)

    def simulated(self, sensor: Sensor) -> np.ndarray:
        """Return what the mean of a sensor's output would be in this recording, V, (n, m)."""
        return Response(noiseless(sensor), self.motion, 0, float(self.time_s[0]))(self.time_s)

    @property
    def scale_v_per_mps2(self) -> np.ndarray:
        """Volts a m/s², by axis, (m,)."""
        return self.sensor.scale_v_per_g / G0_MPS2


class Remembered:
    """A path that is asked for the same instants again and again."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._known: dict[tuple, np.ndarray] = {}

    def __call__(self, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        """See `Path`."""
        if not len(time_s):
            return self._path(time_s, order)
        key = (order, len(time_s), float(time_s[0]), float(time_s[-1]),
               float(time_s[len(time_s) // 2]))
        if key not in self._known:
            self._known[key] = self._path(time_s, order)
        return self._known[key]


def _remembered(path: Path | None) -> Path | None:
    return None if path is None else Remembered(path)


def noiseless(sensor: Sensor) -> Sensor:
    """Return the sensor without noise and without the steps of its ADC."""
    mean = tuple(e for e in sensor.effects if effect_named(e).acts_on == 'mean')
    return replace(sensor, noise_density_g_per_rthz=np.zeros(len(sensor.axes)), adc_bits=48,
                   effects=mean, values={e: sensor.values[e] for e in mean})


def series_of(read: Recording, sensor: Sensor, rate_hz: float, sim: Motion | None = None,
              search_rate_hz: float = SEARCH_RATE_HZ) -> Series:
    """
    Take a recording as the search wants it.

    Parameters
    ----------
    read
        The recording, of `sensor`.
    sensor
        The baseline.
    rate_hz
        Of the samples.
    sim
        The motion by another simulator, in place of the stage.
    search_rate_hz
        Every so many samples are taken that about this rate is left.

    Raises
    ------
    UserError
        See `followed`.

    """
    every = max(1, round(rate_hz / search_rate_hz))
    part = slice(None, None, every)
    columns = {name: values[part] for name, values in read.columns.items()}
    volts = read.volts(sensor)
    motion, reference = _motion(read, sensor, volts, sim)
    if reference != 'rest':
        motion = replace(motion, internal_rate_hz=min(max(_INTERNAL_RATE_HZ, rate_hz / every),
                                                      1000.0))
    if reference != 'sim':
        motion = replace(motion, alpha=Remembered(motion.alpha), beta=Remembered(motion.beta),
                         shift=Remembered(motion.shift))
    motion = replace(motion, temperature_c=_remembered(motion.temperature_c),
                     supply_v=_remembered(motion.supply_v))
    at = replace(sensor, rate_hz=rate_hz / every)
    time_s = read.time_s[part]
    return Series(read.path, time_s, volts[part], motion, at, reference, columns,
                  _still(motion, time_s, reference))


def _motion(read: Recording, sensor: Sensor, volts: np.ndarray, sim: Motion | None
            ) -> tuple[Motion, str]:
    if sim is not None:
        return sim, 'sim'
    if all(np.isfinite(read.columns.get(name, np.array([np.nan]))).any()
           for name in ('alpha_rad', 'beta_rad')):
        motion = followed(read, sensor)
        return motion, 'stage'
    middle = np.nanmedian(volts, axis=0)
    force = chain.inverse(sensor)([float(v) for v in middle])
    around = followed_surroundings(read)
    return Motion(float(read.time_s[-1] - read.time_s[0]), internal_rate_hz=1e-3,
                  temperature_c=around.get('temperature_c'), supply_v=around.get('supply_v'),
                  force=lambda at_s: [np.full(len(at_s), f) for f in force]), 'rest'


def followed_surroundings(read: Recording) -> dict[str, Path]:
    """Return temperature and supply of a recording as paths."""
    return {name: Smoothed(read.time_s, read.columns[name], 0.0)
            for name in ('temperature_c', 'supply_v')
            if name in read.columns and np.isfinite(read.columns[name]).any()}


def _still(motion: Motion, time_s: np.ndarray, reference: str) -> np.ndarray:
    if reference == 'rest':
        return np.ones(len(time_s), bool)
    if reference == 'sim':
        return np.zeros(len(time_s), bool)
    moving = np.zeros(len(time_s), bool)
    for joint in (motion.alpha, motion.beta):
        moving |= np.abs(joint(time_s, 1)) > _STILL_RAD_S
    moving |= np.abs(motion.shift(time_s, 2)) > _STILL_RAD_S
    last = np.maximum.accumulate(np.where(moving, time_s, -np.inf))
    return time_s - last > _AROUND_STILL_S
