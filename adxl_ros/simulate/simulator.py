# SPDX-License-Identifier: Apache-2.0

"""Simulated recordings: samples of a sensor during a manoeuvre, and the stage's encoders."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import ACCEL, JOINTS, Recording, REFERENCES
from adxl_ros.model.coefficients import neutral
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Need
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate.motion import Held, INTERNAL_RATE_HZ, Motion, Path
from adxl_ros.simulate.response import ChainMemo, Response
from adxl_ros.simulate.smoothed_paths import BAND_LIMITED_DEGREE, ForcePath, SmoothedPath
from adxl_ros.simulate.trajectories import TRAJECTORIES
import numpy as np

Columns = dict[str, np.ndarray]
"""Columns of a recording by canonical name, (n,) each."""

_BLOCK_ROWS = 32768
"""Samples of a block; chosen: its arrays stay smaller than the internal grid."""


def simulate(sensor: Sensor, motion: Motion, seed: int) -> Columns:
    """
    Simulate a whole recording.

    returns: columns by canonical name, (n,) each: `time_s`, volts by axis, readings of the
    encoders, and temperature and supply if the manoeuvre has them.
    """
    parts = list(simulate_blocks(sensor, motion, seed))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def simulate_blocks(sensor: Sensor, motion: Motion, seed: int, begin_s: float = 0.0
                    ) -> Iterator[Columns]:
    """Simulate a recording block by block."""
    respond = Response(sensor, motion, seed, begin_s)
    count = max(int(round(motion.duration_s * sensor.rate_hz, 6)), 1)
    for begin in range(0, count, _BLOCK_ROWS):
        time_s = begin_s + np.arange(begin, min(begin + _BLOCK_ROWS, count)) / sensor.rate_hz
        volts = respond(time_s)
        yield {'time_s': time_s,
               **{f'{axis}_v': volts[:, d] for d, axis in enumerate(sensor.axes)},
               **reference_columns(sensor, motion, time_s)}


def simulate_at_stamps(sensor: Sensor, motion: Motion, recording: Recording, seed: int
                       ) -> Iterator[Columns]:
    """
    Simulate samples at the stamps of a recording, block by block.

    yields: columns of the next samples by canonical name, (n,) each: `time_s`, volts by axis, and
    the references of the recording.
    """
    respond = Response(sensor, motion, seed, float(recording.time_s[0]))
    references = [name for name in REFERENCES if name in recording.columns]
    for begin in range(0, len(recording), _BLOCK_ROWS):
        part = slice(begin, begin + _BLOCK_ROWS)
        volts = respond(recording.time_s[part])
        yield {'time_s': recording.time_s[part],
               **{f'{axis}_v': volts[:, d] for d, axis in enumerate(sensor.axes)},
               **{name: recording.columns[name][part] for name in references}}


def reference_columns(sensor: Sensor, motion: Motion, time_s: np.ndarray) -> Columns:
    """
    Return the columns of a recording that are not those of the sensor.

    time_s: stamps, s, (n,); returns: readings of the encoders, temperature and supply by canonical
    name, (n,) each.
    """
    columns = {}
    if motion.force is None:
        resolution_rad = sensor.stage_resolution_rad
        columns['alpha_rad'] = encoder_reading(motion.alpha(time_s), resolution_rad)
        columns['beta_rad'] = encoder_reading(motion.beta(time_s), resolution_rad)
        if not isinstance(motion.shift, Held):
            columns['shift_m'] = motion.shift(time_s)
    if motion.temperature_c:
        columns['temperature_c'] = motion.temperature_c(time_s)
    if motion.supply_v:
        columns['supply_v'] = motion.supply_v(time_s)
    return columns


def encoder_reading(angle_rad: np.ndarray, resolution_rad: float) -> np.ndarray:
    """
    Round angles to the steps of an encoder.

    angle_rad: angles, rad, (n,); returns: readings, rad, (n,).
    """
    if not resolution_rad:
        return angle_rad
    return np.rint(angle_rad / resolution_rad) * resolution_rad


_MAX_SPEED_RAD_S = 100.0
"""Largest angular velocity of a stage, rad/s; chosen: a faster change is a jump of the reading."""

_MIN_FORCE_SAMPLES = 4
"""Fewest samples of specific force; a cubic spline needs them."""


def motion_from_force(ideal: Recording, resampled: bool) -> tuple[Motion, float]:
    """
    Make a motion from the specific force of another simulator, in the case frame.

    returns: the motion, and the time at which it begins, s.
    """
    time_s = ideal.time_s
    force_mps2 = np.column_stack([ideal.columns[name] for name in ACCEL])
    if len(time_s) < _MIN_FORCE_SAMPLES:
        raise UserError(f'{ideal.path}: {len(time_s)} samples of specific force; at least '
                        f'{_MIN_FORCE_SAMPLES} are needed')
    begin_s = float(time_s[0])
    duration_s = float(time_s[-1] - begin_s)
    rate_hz = round(1 / float(np.median(np.diff(time_s))), 6)
    return Motion(
        duration_s + 1 / rate_hz, force=ForcePath(time_s, force_mps2),
        internal_rate_hz=rate_hz if resampled else max(rate_hz, INTERNAL_RATE_HZ)), begin_s


def motion_from_references(read: Recording, sensor: Sensor) -> Motion:
    """Make a motion from the stage angles, temperature and supply of a recording."""
    for name in ('alpha_rad', 'beta_rad'):
        if name not in read.columns or np.isnan(read.columns[name]).all():
            raise UserError(f'{read.path}: no stage angle {name} to follow; for specific force '
                            f'say simulate imu --force {read.path}')
    resolution = {'alpha': sensor.stage_resolution_rad, 'beta': sensor.stage_resolution_rad,
                  'shift': 0.0}
    paths: dict[str, Any] = dict(environment_paths(read))
    for joint, name in JOINTS.items():
        values = read.columns.get(name)
        if values is None or np.isnan(values).all():
            paths[joint] = Held()
            continue
        if joint != 'shift':
            _check_speed(read, name, resolution[joint])
        paths[joint] = SmoothedPath(read.time_s, values, resolution[joint],
                                    BAND_LIMITED_DEGREE)
    return Motion(float(read.time_s[-1] - read.time_s[0]), **paths)


def environment_paths(read: Recording) -> dict[str, Path]:
    """Return the recorded temperature, °C, and supply, V, as paths by column."""
    return {name: SmoothedPath(read.time_s, read.columns[name], 0.0)
            for name in ('temperature_c', 'supply_v')
            if name in read.columns and np.isfinite(read.columns[name]).any()}


def _check_speed(read: Recording, name: str, resolution_rad: float) -> None:
    """Refuse an angle that changes faster than a stage turns."""
    sampled = np.flatnonzero(np.isfinite(read.columns[name]))
    change_rad = np.abs(np.diff(read.columns[name][sampled]))
    interval_s = np.diff(read.time_s[sampled])
    jumps = np.flatnonzero(change_rad - 2 * resolution_rad > _MAX_SPEED_RAD_S * interval_s)
    if len(jumps):
        i = jumps[0]
        raise UserError(f'{read.path}: {name} jumps by {change_rad[i]:.3g} rad within '
                        f'{interval_s[i]:.3g} s at {read.time_s[sampled[i]]:.6g} s, which no '
                        'stage does; unwrap the angle, or cut the recording there')


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
