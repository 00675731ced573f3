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

"""The chain over time: what a sensor says while a manoeuvre goes on, block by block."""

from __future__ import annotations

from collections.abc import Callable
from math import ceil
from typing import Any
import zlib

from adxl_ros.errors import UserError
from adxl_ros.model import noise, signal_chain
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import (
    Environment,
    Joint,
    Need,
    NOMINAL_ENVIRONMENT,
    Parameters,
    Place,
    Signals,
)
from adxl_ros.model.filters import low_pass
from adxl_ros.model.kinematics import specific_force_in_motion, UPRIGHT
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate.motion import Motion
import numpy as np
from scipy.signal import lfilter

_BLOCK = 65536
"""Steps of the internal grid that are held in memory at once."""
_POINTS = 6
"""Of the polynomial that interpolates samples that lie between the steps."""
_ON_STEP = 1e-4
"""Samples this near a step, in steps, are on it."""


class Response:
    """
    A sensor that feels a manoeuvre.

    Stage, element and filter run on a uniform grid of instants at a multiple of the sample rate;
    samples that lie between its steps (jitter, gaps of a recording) are interpolated from the
    filtered signal by polynomials. Noise and ADC belong to the samples. Effects of the clock move
    the grid: a sample is taken at its instant, and noise is never resampled.
    """

    def __init__(self, sensor: Sensor, motion: Motion, seed: int, begin_s: float = 0.0) -> None:
        """
        Put the sensor, settled, at the beginning of a manoeuvre.

        Parameters
        ----------
        sensor
            The unit, with its effects.
        motion
            What it feels.
        seed
            Of all randomness; each effect has its own generator.
        begin_s
            Stamp of the first sample.

        Raises
        ------
        UserError
            An effect has nothing to act on: the stage, the filter or the ADC is not there.

        """
        _check(sensor, motion)
        self.sensor, self._motion, self._seed, self._begin_s = sensor, motion, seed, begin_s
        self._effects = {place: [_Applied(name, signal_chain.parameters(sensor, name), seed)
                                 for name in sensor.effects
                                 if effect_named(name).place is place] for place in Place}
        self._step_s = 1 / (sensor.rate_hz * ceil(motion.internal_rate_hz / sensor.rate_hz
                                                  - 1e-9))
        # How fast instants go by stamps, rounded off what makes float64 times uneven.
        instants = self._instants(np.array([0.0, 1.0]))
        self._dt_s = self._step_s * round(float(instants[1] - instants[0]), 12)
        self._filters: list[dict[str, Any]] = [{} for _ in sensor.axes]
        self._done = 0
        self._tail = np.zeros((0, len(sensor.axes)))
        self._white = np.random.default_rng([seed, 0])
        self._noise = np.zeros(0)
        self._last_s = begin_s

    def __call__(self, stamps_s: np.ndarray) -> np.ndarray:
        """
        Go on to the next samples.

        Parameters
        ----------
        stamps_s
            Stamps of the samples, ascending and behind those of the last call, s, (n,).

        Returns
        -------
        ndarray
            Volts that the ADC gives, (n, m).

        """
        if not len(stamps_s):
            return np.zeros((0, len(self.sensor.axes)))
        steps = (stamps_s - self._begin_s) / self._step_s
        many = ceil(steps[-1]) - self._done > _BLOCK
        if many and len(stamps_s) > 1:
            half = len(stamps_s) // 2
            return np.concatenate([self(stamps_s[:half]), self(stamps_s[half:])])
        at_s = self._instants(stamps_s)
        analog, signals = self._sampled(steps)
        signals.dt_s = 1 / self.sensor.rate_hz
        signals.environment = self._environment(at_s)
        signals.input_v = list((analog + self._noisy(stamps_s, signals)).T)
        signals.volts = list(signals.input_v)
        self._apply(Place.ADC, signals)
        coded = signal_chain.quantise(np.column_stack(signals.volts), self.sensor, signals.lsb_v)
        signals.volts = list(coded.T)
        self._apply(Place.CODE, signals)
        return np.column_stack(signals.volts)

    def _instants(self, stamps_s: np.ndarray) -> np.ndarray:
        signals = Signals(NOMINAL_ENVIRONMENT, time_s=stamps_s)
        self._apply(Place.CLOCK, signals)
        return signals.time_s

    def _environment(self, at_s: np.ndarray) -> Environment:
        nominal = NOMINAL_ENVIRONMENT
        motion = self._motion
        return Environment(at_s,
                           motion.temperature_c(at_s) if motion.temperature_c
                           else nominal.temperature_c,
                           motion.supply_v(at_s) if motion.supply_v else nominal.supply_v)

    def _apply(self, place: Place, signals: Signals) -> None:
        for effect in self._effects[place]:
            signals.memory, signals.rng = effect.memory, effect.rng
            effect.apply(signals, effect.parameters)

    def _sampled(self, steps: np.ndarray) -> tuple[np.ndarray, Signals]:
        """Return the filtered volts at samples between steps of the grid, and its signals."""
        nearest = np.rint(steps)
        aligned = bool(np.abs(steps - nearest).max() < _ON_STEP)
        ahead = 0 if aligned else _POINTS // 2
        first = self._done - len(self._tail)
        until = int(nearest[-1]) + 1 + ahead
        kept, signals = [self._tail], None
        while self._done < until or signals is None:
            volts, signals = self._advance(min(until - self._done, _BLOCK))
            kept.append(volts)
            if sum(map(len, kept)) > 2 * _BLOCK:      # a gap: nobody asks for what is in it
                first += sum(map(len, kept[:-1]))
                kept = kept[-1:]
        grid = np.concatenate(kept)
        self._tail = grid[-(2 * _POINTS):]
        if aligned:
            return grid[nearest.astype(np.intp) - first], signals
        left = np.floor(steps).astype(np.intp) - (_POINTS // 2 - 1)
        index = np.clip(left[:, None] + np.arange(_POINTS) - first, 0, None)
        return np.einsum('ij,ijm->im', _lagrange(steps - left), grid[index]), signals

    def _advance(self, count: int) -> tuple[np.ndarray, Signals]:
        """Run the chain from the stage to the filter over the next steps of the grid."""
        stamps_s = self._begin_s + (self._done + np.arange(max(count, 0))) * self._step_s
        self._done += len(stamps_s)
        at_s = self._instants(stamps_s)
        signals = Signals(self._environment(at_s), dt_s=self._dt_s,
                          gravity_mps2=self.sensor.local_gravity_mps2, up=list(UPRIGHT),
                          nominal_scale_v_per_g=self.sensor.nominal_scale_v_per_g.tolist(),
                          vref_v=self.sensor.adc_vref_v)
        if self._motion.force:
            signals.force = list(self._motion.force(at_s))
        else:
            signals.alpha, signals.beta, signals.shift = (
                Joint(*(joint(at_s, order) for order in range(3)))
                for joint in (self._motion.alpha, self._motion.beta, self._motion.shift))
            self._apply(Place.STAGE, signals)
            signals.force = specific_force_in_motion(signals.alpha, signals.beta, signals.shift,
                                 signals.gravity_mps2, signals.up)
        self._apply(Place.FORCE, signals)
        signals.sensed = [f / G0_MPS2 for f in signals.force]
        self._apply(Place.MOUNTING, signals)
        signals.output = list(signals.sensed)
        self._apply(Place.ELEMENT, signals)
        m = len(self.sensor.axes)
        signals.zero_g_v = self.sensor.nominal_zero_g_v.tolist()
        signals.scale_v_per_g = self.sensor.nominal_scale_v_per_g.tolist()
        signals.rc_s, signals.noise_ratio = [self.sensor.rc_s] * m, [1.0] * m
        signals.lsb_v = self.sensor.lsb_v
        self._apply(Place.ELECTRONICS, signals)
        volts = np.empty((len(at_s), m))
        for d, v in enumerate(signal_chain.output_volts(signals)):
            volts[:, d] = low_pass(np.broadcast_to(v, len(at_s)), signals.rc_s[d], self._dt_s,
                                   self._filters[d])
        return volts, signals

    def _noisy(self, stamps_s: np.ndarray, signals: Signals) -> np.ndarray:
        """
        Draw the white noise behind the filter: the exactly sampled AR(1) sequence, (n, m).

        Samples that are missing are drawn, too, as far as the filter remembers.
        """
        rc_s, rate_hz = np.array(signals.rc_s), self.sensor.rate_hz
        sigma = noise.analog_std_v(self.sensor)
        if not sigma.any():
            return np.zeros((len(stamps_s), len(sigma)))
        decay = np.array([np.exp(-1 / (rate_hz * rc)) if rc else 0.0 for rc in rc_s])
        passed = np.rint(np.diff(stamps_s, prepend=self._last_s) * rate_hz).astype(np.intp)
        passed = np.clip(passed, 1, 1 + ceil(50 * rc_s.max() * rate_hz))
        self._last_s = float(stamps_s[-1])
        drawn = self._white.standard_normal((int(passed.sum()), len(sigma)))
        if not len(self._noise):
            # The first sample is stationary.
            drawn[0] /= np.sqrt(1 - decay ** 2)
            self._noise = np.zeros(len(sigma))
        for d, a in enumerate(decay):
            if a:
                drawn[:, d], _ = lfilter([np.sqrt(1 - a * a)], [1.0, -a], drawn[:, d],
                                         zi=[a * self._noise[d]])
        self._noise = drawn[-1].copy()
        return drawn[np.cumsum(passed) - 1] * sigma


class _Applied:
    """An effect of this sensor: its parameters, its memory and its randomness."""

    def __init__(self, name: str, parameters: Parameters, seed: int) -> None:
        self.apply: Callable[[Signals, Parameters], None] = effect_named(name).apply
        self.parameters = parameters
        self.memory: dict[str, Any] = {}
        self.rng = np.random.default_rng([seed, zlib.crc32(name.encode())])


def _lagrange(at: np.ndarray) -> np.ndarray:
    """Weights of the polynomial through `_POINTS` steps at places among them, (n, points)."""
    nodes = np.arange(_POINTS)
    return np.column_stack([
        np.prod([(at - k) / (j - k) for k in nodes if k != j], axis=0) for j in nodes])


def _check(sensor: Sensor, motion: Motion) -> None:
    """Refuse an effect that has nothing to act on."""
    missing = {}
    if motion.force is not None:
        missing[Need.STAGE] = 'this manoeuvre has none, only specific force'
    if not sensor.rc_s > 0:
        missing[Need.FILTER] = \
            'the sensor has none: sensor.rc_capacitance_f or rc_resistance_ohm is 0'
    if not sensor.adc_bits > 0:
        missing[Need.ADC] = 'the sensor has none: sensor.adc_bits is 0'
    if not np.any(sensor.noise_density_g_per_rthz):
        missing[Need.NOISE] = 'the sensor has none: sensor.noise_density_g_per_rthz is 0'
    for name in sensor.effects:
        for need in effect_named(name).needs:
            if need in missing:
                raise UserError(f'{name} acts on the {need.value}, but {missing[need]}; leave the '
                                'effect out')
