# SPDX-License-Identifier: Apache-2.0
"""A recording beside the simulation of its baseline, on the recording's own reference motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from typing import Any

from adxl_ros.files.recording_columns import JOINTS, Recording
from adxl_ros.model import noise, signal_chain
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import ActsOn
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.rest_detection import find_rests
from adxl_ros.simulate.motion import INTERNAL_RATE_HZ, Motion, Path
from adxl_ros.simulate.response import ChainMemo, Response
from adxl_ros.simulate.smoothed_paths import ForcePath
from adxl_ros.simulate.trajectories import environment_paths, motion_from_references
import numpy as np
import scipy

SMALLEST_MOTION_G = 0.05
"""Standard deviation of the simulated force, g, from which an axis is compared. Chosen: ten times
the noise of an ADXL203."""
SEARCH_RATE_HZ, SEARCH_SAMPLES = 125.0, 25_000
"""Rate of the samples in the search, Hz, and their largest number in a recording. Chosen: motion
up to 60 Hz, and run time. Samples are left out, never averaged, so that aliases remain."""
_LOWEST_INTERNAL_RATE_HZ, _MOST_STEPS = 250.0, 1_000_000
"""Lowest internal rate of the simulator where something moves, Hz, and its largest number of steps
beyond the samples. Chosen: twice the rate of the search, and an hour of it."""
_SMALLEST_MOVES = {'alpha': 2e-3, 'beta': 2e-3, 'shift': 1e-6}
"""Ranges of the joints, rad and m, from which they move. Chosen: above the step of an encoder."""
_REST_RATE = 1e-3
"""A joint rests below this rate, rad/s, and the shift below this acceleration, m/s². Chosen: the
specific force then changes by less than the noise within a second."""
SETTLING_S = 0.3
"""A sample rests if no joint moves within this time before it, s. Chosen: an RC filter of 15 Hz
has settled."""
_LONGEST_S = 1e3
"""Time since the last move where there was none, s. Chosen: beyond any creep."""


class Reference(Enum):
    """What determines the motion of a recording; without any the sensor never moves."""

    STAGE = 'stage'
    SIMULATOR = 'sim'
    NONE = 'rest'


@dataclass(frozen=True)
class BaselineComparison:
    """Samples of one recording, n of m axes, and what the simulator needs to follow it."""

    name: str  # Path of the recording, for people
    time_s: np.ndarray  # Stamps, s, (n,)
    volts: np.ndarray  # Output of the sensor, V, (n, m)
    motion: Motion  # Motion of the reference
    # The baseline: datasheet values and effects of the parameter file, at this sample rate
    sensor: Sensor
    reference: Reference  # What determines the motion
    at_rest: np.ndarray  # Samples at which nothing moves, (n,) bool
    # Samples that are used, (n,) bool; the others are missing, repeated or outliers, or their
    # reference is not known
    used: np.ndarray
    notes: tuple[str, ...] = ()  # What was corrected or left out, one line each, for people
    # Frequency above which the reference lacks half of the motion's power, Hz; None for none
    fading_hz: float | None = None
    # Signals that simulations of this recording share
    memo: ChainMemo = field(default_factory=ChainMemo, compare=False, repr=False)

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.time_s)

    @property
    def dt_s(self) -> float:
        """Median time between samples, s."""
        return float(np.median(np.diff(self.time_s)))

    @property
    def span_s(self) -> float:
        """Time from the first sample to the last, s."""
        return float(self.time_s[-1] - self.time_s[0])

    @property
    def scale_v_per_mps2(self) -> np.ndarray:
        """Scale factor of the baseline by axis, V/(m/s²), (m,)."""
        return self.sensor.scale_v_per_g / G0_MPS2

    @property
    def joints(self) -> tuple[Path, Path] | None:
        """Paths of alpha and beta; None without a stage."""
        return (self.motion.alpha, self.motion.beta) if self.reference is Reference.STAGE else None

    @property
    def surroundings(self) -> dict[str, np.ndarray]:
        """Temperature, °C, and supply, V, at the samples, (n,) each, where they are known."""
        paths = {name: getattr(self.motion, name) for name in ('temperature_c', 'supply_v')}
        return {name: path(self.time_s) for name, path in paths.items() if path is not None}

    def reference_force_g(self) -> np.ndarray | None:
        """Return the specific force of the reference, g, (3, n); None without a reference."""
        if self.reference is Reference.SIMULATOR and self.motion.force is not None:
            return np.array(self.motion.force(self.time_s)) / G0_MPS2
        if self.joints is None:
            return None
        alpha_rad, beta_rad = (joint(self.time_s) for joint in self.joints)
        return np.array(specific_force(alpha_rad, beta_rad, 1.0))

    def simulated_v(self, sensor: Sensor) -> np.ndarray:
        """Return the mean output of a sensor in this recording, V, (n, m)."""
        respond = Response(noiseless(sensor), self.motion, 0, float(self.time_s[0]))
        return respond.whole(self.time_s, self.memo)

    def residual_v(self, sensor: Sensor) -> np.ndarray:
        """
        Return the recording minus the mean output of a sensor, V, (n, m).

        Without a reference the pose is unknown, and the mean of the residual is subtracted.
        """
        residual_v = self.volts - self.simulated_v(replace(sensor, rate_hz=self.sensor.rate_hz))
        if self.reference is Reference.NONE:
            return residual_v - np.nanmean(residual_v, axis=0)
        return residual_v

    def simulated_noise_v(self, sensor: Sensor, seed: int) -> np.ndarray:
        """Draw a sensor's output about its own mean, V, (n, m)."""
        at_rate = replace(sensor, rate_hz=self.sensor.rate_hz)
        noisy = Response(at_rate, self.motion, seed, float(self.time_s[0]))(self.time_s)
        return noisy - self.simulated_v(at_rate)

    @cached_property
    def robot_error_mps2(self) -> float:
        """Rms over used samples and axes that the encoders of a robot leave open, m/s²."""
        force = self.motion.force
        if not isinstance(force, ForcePath):
            return 0.0
        return float(np.sqrt(np.mean([
            np.square(force.errors(self.time_s, AXES.index(axis)).std[self.used])
            for axis in self.sensor.axes])))

    def lost_motion_mps2(self) -> float:
        """Return the rms of the fast motion that a smooth reference lacks, m/s²."""
        if self.fading_hz is None:
            return 0.0
        residual_v = np.where(self.used[:, None], self.residual_v(self.sensor), 0.0)
        frequency_hz, power = scipy.signal.periodogram(residual_v, self.sensor.rate_hz, axis=0)
        lost = (power - noise.density_v2_per_hz(self.sensor, frequency_hz))[
            frequency_hz > self.fading_hz / 2] / self.scale_v_per_mps2 ** 2
        return float(np.sqrt(max(lost.mean(axis=1).sum() * frequency_hz[1], 0.0)))


def noiseless(sensor: Sensor) -> Sensor:
    """Return the sensor without noise and without the steps of its ADC."""
    mean = tuple(e for e in sensor.effects if effect_named(e).acts_on is ActsOn.MEAN)
    # Without an ADC there are no rails, and pseudo-volts may be negative.
    bits = 48 if sensor.adc_bits else 0
    return replace(sensor, noise_density_g_per_rthz=np.zeros(len(sensor.axes)), adc_bits=bits,
                   effects=mean, values={e: sensor.values[e] for e in mean})


def with_values(sensor: Sensor, effect: str, values: Mapping[str, Any]) -> Sensor:
    """Return a sensor with changed parameters of an effect; one number stands for all axes."""
    before = sensor.values[effect]
    changed = {name: np.full_like(before[name], value, float) for name, value in values.items()}
    return replace(sensor, values={**sensor.values, effect: {**before, **changed}})


def compare(recording: Recording, sensor: Sensor, sim: Motion | None = None
            ) -> BaselineComparison:
    """Put a recording beside the simulator, at the full rate of the recording."""
    sensor = replace(sensor, rate_hz=recording.rate_hz)
    volts, time_s = recording.volts(sensor), recording.time_s
    motion, reference = _motion(recording, sensor, volts, sim)
    if reference is not Reference.NONE:
        motion = replace(motion, internal_rate_hz=min(
            max(_LOWEST_INTERNAL_RATE_HZ, sensor.rate_hz), INTERNAL_RATE_HZ, _most_hz(time_s)))
    at_rest = _at_rest(motion, time_s, reference, volts)
    used = np.ones(len(recording), bool)
    if reference is Reference.SIMULATOR:
        # Where another simulator moves from its first sample on, the filter has not settled.
        used = at_rest | (time_s > time_s[0] + SETTLING_S)
    return BaselineComparison(recording.path, time_s, volts, motion, sensor, reference, at_rest,
                              used)


def _most_hz(time_s: np.ndarray) -> float:
    """Return the internal rate at which a recording has the largest number of steps, Hz."""
    return _MOST_STEPS / max(float(time_s[-1] - time_s[0]), 1.0)


def at_search_rate(comparison: BaselineComparison) -> BaselineComparison:
    """Return every k-th sample of a recording, for the search."""
    rate_wanted_hz = min(SEARCH_RATE_HZ, SEARCH_SAMPLES / max(comparison.span_s, 1.0))
    every = max(1, round(comparison.sensor.rate_hz / rate_wanted_hz))
    part, motion = slice(None, None, every), comparison.motion
    if comparison.reference is not Reference.NONE:
        motion = replace(motion, internal_rate_hz=min(_LOWEST_INTERNAL_RATE_HZ,
                                                      _most_hz(comparison.time_s)))
    return replace(
        comparison, time_s=comparison.time_s[part], volts=comparison.volts[part],
        motion=motion, sensor=replace(comparison.sensor,
                                      rate_hz=comparison.sensor.rate_hz / every),
        at_rest=comparison.at_rest[part], used=comparison.used[part], memo=ChainMemo())


def _motion(recording: Recording, sensor: Sensor, volts: np.ndarray, sim: Motion | None
            ) -> tuple[Motion, Reference]:
    """Return the motion of a recording and what determines it."""
    paths: dict[str, Any] = {'temperature_c': None, 'supply_v': None,
                             **environment_paths(recording)}
    if sim is not None:
        return replace(sim, **paths), Reference.SIMULATOR
    ranges = {}
    for joint, name in JOINTS.items():
        values = recording.columns.get(name, np.array([np.nan]))
        if np.isfinite(values).any():
            ranges[joint] = np.nanmax(values) - np.nanmin(values)
    if {'alpha', 'beta'} <= set(ranges) and any(
            ranges[joint] > _SMALLEST_MOVES[joint] for joint in ranges):
        return motion_from_references(recording, sensor), Reference.STAGE
    # The median output stands for the unknown pose, and the simulator runs at the samples' rate.
    force = signal_chain.inverse(sensor)([float(v) for v in np.nanmedian(volts, axis=0)])
    return Motion(float(recording.time_s[-1] - recording.time_s[0]), internal_rate_hz=1e-3,
                  force=lambda time_s: [np.full(len(time_s), f) for f in force],
                  **paths), Reference.NONE


def _at_rest(motion: Motion, time_s: np.ndarray, reference: Reference, volts: np.ndarray
             ) -> np.ndarray:
    """Return which samples rest, (n,) bool."""
    if reference is Reference.NONE:
        return np.ones(len(time_s), bool)
    if reference is Reference.SIMULATOR:
        # The force of another simulator may be noisy, so that the sensor itself shows its rests.
        finite, at_rest = np.isfinite(volts).all(axis=1), np.zeros(len(time_s), bool)
        for rest in find_rests(time_s[finite], volts[finite],
                               1 / float(np.median(np.diff(time_s)))):
            at_rest |= (time_s >= rest.time_start_s) & (time_s <= rest.time_stop_s)
        return at_rest
    rates = [motion.alpha(time_s, 1), motion.beta(time_s, 1), motion.shift(time_s, 2)]
    return time_since_move_s(time_s, rates) > SETTLING_S


def direction_of_last_move(rate: np.ndarray, smallest: float = _REST_RATE) -> np.ndarray:
    """Return the direction of the last move, −1 or 1, 0 before the first, (n,)."""
    moving = np.abs(rate) > smallest
    last = np.maximum.accumulate(np.where(moving, np.arange(len(rate)), -1))
    return np.where(last >= 0, np.sign(rate[np.maximum(last, 0)]), 0.0)


def time_since_move_s(time_s: np.ndarray, rates: Sequence[np.ndarray]) -> np.ndarray:
    """Return the time since any joint moved."""
    moving = np.any(np.abs(np.array(rates)) > _REST_RATE, axis=0)
    last_s = np.maximum.accumulate(np.where(moving, time_s, -np.inf))
    return np.minimum(time_s - last_s, _LONGEST_S)


def code_step_v(volts: np.ndarray) -> np.ndarray:
    """Return the smallest change of an output on each axis, V; 0 where it never changes."""
    changes_v = np.abs(np.diff(volts, axis=0))
    smallest = np.min(changes_v, axis=0, initial=np.inf, where=changes_v > 0)
    return np.where(np.isfinite(smallest), smallest, 0.0)


def gravity_slopes(alpha_rad: np.ndarray, beta_rad: np.ndarray) -> np.ndarray:
    """Return the derivatives of gravity's direction in the sensor by both angles, (2, 3, n)."""
    sin_alpha, cos_alpha = np.sin(alpha_rad), np.cos(alpha_rad)
    sin_beta, cos_beta = np.sin(beta_rad), np.cos(beta_rad)
    return np.array([[cos_alpha * cos_beta, -cos_alpha * sin_beta, -sin_alpha],
                     [-sin_alpha * sin_beta, -sin_alpha * cos_beta, 0 * sin_alpha]])
