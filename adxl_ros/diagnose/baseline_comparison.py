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

from adxl_ros.files.recording_columns import Recording
from adxl_ros.model import signal_chain
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import ActsOn
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.rest_detection import find_rests
from adxl_ros.simulate.from_recording import followed, surroundings
from adxl_ros.simulate.motion import Motion, Path
from adxl_ros.simulate.response import Response
import numpy as np

SEARCH_RATE_HZ, SEARCH_SAMPLES = 125.0, 80_000
"""The search looks at samples about this often, more seldom where a recording is long; samples
are left out, never averaged, so that what is fast still shows in them. What is found is confirmed
at the full rate."""
_INTERNAL_RATE_HZ = 250.0
_REMEMBERED = 3_000_000
"""So many values of a path are held in memory."""
_NEVER_MOVES_RAD, _NEVER_SHIFTS_M = 2e-3, 1e-6
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

    def residual(self, sensor: Sensor) -> np.ndarray:
        """
        Return the recording less the mean of a sensor's output, V, (n, m).

        At rest, where the pose is not known, less its own mean, too.
        """
        off = self.volts - self.simulated(replace(sensor, rate_hz=self.sensor.rate_hz))
        return off - np.nanmean(off, axis=0) if self.reference == 'rest' else off

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
            while sum(map(len, self._known.values())) > _REMEMBERED and len(self._known) > 1:
                del self._known[next(iter(self._known))]
        # The newest is last: what was not asked for the longest goes first.
        self._known[key] = self._known.pop(key)
        return self._known[key]


def _remembering(motion: Motion, reference: str) -> Motion:
    """Return the motion with paths that are evaluated once."""
    if reference == 'stage':
        motion = replace(motion, alpha=Remembered(motion.alpha), beta=Remembered(motion.beta),
                         shift=Remembered(motion.shift))
    temperature_c, supply_v = (path and Remembered(path)
                               for path in (motion.temperature_c, motion.supply_v))
    return replace(motion, temperature_c=temperature_c, supply_v=supply_v)


def noiseless(sensor: Sensor) -> Sensor:
    """Return the sensor without noise and without the steps of its ADC."""
    mean = tuple(e for e in sensor.effects if effect_named(e).acts_on is ActsOn.MEAN)
    return replace(sensor, noise_density_g_per_rthz=np.zeros(len(sensor.axes)), adc_bits=48,
                   effects=mean, values={e: sensor.values[e] for e in mean})


def series_of(read: Recording, sensor: Sensor, sim: Motion | None = None) -> Series:
    """
    Put a recording beside the simulator, at its full rate.

    Parameters
    ----------
    read
        The recording, of `sensor`.
    sensor
        The baseline, at the rate of the samples.
    sim
        The motion by another simulator, in place of the stage.

    Raises
    ------
    UserError
        See `from_recording.followed`.

    """
    volts = read.volts(sensor)
    motion, reference = _motion(read, sensor, volts, sim)
    if reference != 'rest':
        motion = replace(motion, internal_rate_hz=min(max(_INTERNAL_RATE_HZ, sensor.rate_hz),
                                                      1000.0))
    motion = _remembering(motion, reference)
    return Series(read.path, read.time_s, volts, motion, sensor, reference, dict(read.columns),
                  _still(motion, read.time_s, reference, volts))


def thinned(full: Series) -> Series:
    """Return every k-th sample of a recording, for the search."""
    span_s = float(full.time_s[-1] - full.time_s[0])
    wanted_hz = min(SEARCH_RATE_HZ, SEARCH_SAMPLES / max(span_s, 1.0))
    every = max(1, round(full.sensor.rate_hz / wanted_hz))
    part, motion = slice(None, None, every), full.motion
    if full.reference != 'rest':
        motion = replace(motion, internal_rate_hz=_INTERNAL_RATE_HZ)
    return Series(full.name, full.time_s[part], full.volts[part],
                  _remembering(motion, full.reference),
                  replace(full.sensor, rate_hz=full.sensor.rate_hz / every), full.reference,
                  {name: values[part] for name, values in full.columns.items()},
                  full.still[part])


def _motion(read: Recording, sensor: Sensor, volts: np.ndarray, sim: Motion | None
            ) -> tuple[Motion, str]:
    around = surroundings(read)
    temperature_c, supply_v = around.get('temperature_c'), around.get('supply_v')
    if sim is not None:
        return replace(sim, temperature_c=temperature_c, supply_v=supply_v), 'sim'
    angles = [read.columns.get(name, np.array([np.nan])) for name in ('alpha_rad', 'beta_rad')]
    shift_m = read.columns.get('shift_m', np.zeros(1))
    moves = any(np.nanmax(q) - np.nanmin(q) > least for q, least in (
        (angles[0], _NEVER_MOVES_RAD), (angles[1], _NEVER_MOVES_RAD), (shift_m, _NEVER_SHIFTS_M))
        if np.isfinite(q).any())
    if moves and all(np.isfinite(q).any() for q in angles):
        return followed(read, sensor), 'stage'
    middle = np.nanmedian(volts, axis=0)
    force = signal_chain.inverse(sensor)([float(v) for v in middle])
    return Motion(float(read.time_s[-1] - read.time_s[0]), internal_rate_hz=1e-3,
                  temperature_c=temperature_c, supply_v=supply_v,
                  force=lambda at_s: [np.full(len(at_s), f) for f in force]), 'rest'


def _still(motion: Motion, time_s: np.ndarray, reference: str, volts: np.ndarray) -> np.ndarray:
    if reference == 'rest':
        return np.ones(len(time_s), bool)
    if reference == 'sim':
        # Another simulator's force may be measured, and noisy: the sensor tells.
        known = np.isfinite(volts).all(axis=1)
        rests = find_rests(time_s[known], volts[known], 1 / float(np.median(np.diff(time_s))))
        still = np.zeros(len(time_s), bool)
        for rest in rests:
            still |= (time_s >= rest.time_start_s) & (time_s <= rest.time_stop_s)
        return still
    moving = np.zeros(len(time_s), bool)
    for joint in (motion.alpha, motion.beta):
        moving |= np.abs(joint(time_s, 1)) > _STILL_RAD_S
    moving |= np.abs(motion.shift(time_s, 2)) > _STILL_RAD_S
    last = np.maximum.accumulate(np.where(moving, time_s, -np.inf))
    return time_s - last > _AROUND_STILL_S
