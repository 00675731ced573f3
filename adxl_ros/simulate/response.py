# SPDX-License-Identifier: Apache-2.0

"""The signal chain over time: volts of a sensor during a manoeuvre, block by block."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from dataclasses import replace
from functools import partial
from math import ceil
from typing import Any, TypeVar
import zlib

from adxl_ros.errors import UserError
from adxl_ros.model import analog_stages, noise, signal_chain
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import (
    Components,
    Environment,
    Joint,
    Need,
    NOMINAL_ENVIRONMENT,
    Parameters,
    Place,
    Role,
    Signals,
)
from adxl_ros.model.filters import first_order_recursion, low_pass
from adxl_ros.model.kinematics import specific_force_in_motion, UPRIGHT
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.smoothed_paths import ForcePath
import numpy as np

_BLOCK_STEPS = 65536
"""Steps of the internal grid in memory at once; chosen: some 10 MB of signals."""

_WHOLE_STEPS = 300_000
"""Largest number of steps that are simulated at once and kept; chosen: 20 minutes at 250 Hz, some
200 MB."""

POINTS = 6
"""Points of the polynomial between the steps of the grid; chosen: as exact as the filters."""

_ALIGNED_STEPS = 1e-4
"""Largest distance of a sample on a step from it, in steps; chosen: far above rounding."""

_ROUNDING = 1e-9
"""Rounding error of a ratio of two rates."""

_NOISE_MEMORY = 50
"""Time constants of the filter over which the noise of missing samples is drawn; chosen: the state
of the filter has then decayed to e⁻⁵⁰."""


class Response:
    """
    Volts of a sensor during a manoeuvre.

    Stage, element and filter run on a uniform grid at a multiple of the sample rate. Samples
    between its steps (jitter, gaps of a recording) are interpolated from the filtered signal by
    polynomials. Noise and ADC belong to the samples. Effects of the clock move the grid: samples
    are taken at their instants, and noise is never resampled.
    """

    def __init__(self, sensor: Sensor, motion: Motion, seed: int, begin_s: float = 0.0) -> None:
        """Put the sensor, settled, at the beginning of a manoeuvre."""
        check_needs(sensor, motion)
        self.sensor, self._motion, self._begin_s = sensor, motion, begin_s
        self._seed = seed
        self._force_path: Callable[[np.ndarray], Components] | None = None
        self._run = EffectRunner(sensor, sensor.effects, seed)
        self._effects = self._run.effects
        self._memo: ChainMemo | None = None
        self._block_steps = _BLOCK_STEPS
        steps_per_sample = ceil(motion.internal_rate_hz / sensor.rate_hz - _ROUNDING)
        self._step_s = 1 / (sensor.rate_hz * steps_per_sample)
        # Rate of the instants by stamps; rounding evens out the steps of float64 times.
        instants_s = self._instants(np.array([0.0, 1.0]))
        self._dt_s = self._step_s * round(float(instants_s[1] - instants_s[0]), 12)
        self._filters: list[dict[str, Any]] = [{} for _ in sensor.axes]
        self._done_steps = 0
        self._tail = np.zeros((0, len(sensor.axes)))
        self._white = np.random.default_rng([seed, 0])
        self._noise = np.zeros(0)
        self._last_s = begin_s

    def __call__(self, stamps_s: np.ndarray) -> np.ndarray:
        """
        Advance to the next samples.

        stamps_s: stamps of the samples, s, (n,), ascending and later than those of the last call;
        returns: volts of the ADC, V, (n, m).
        """
        if not len(stamps_s):
            return np.zeros((0, len(self.sensor.axes)))
        steps = (stamps_s - self._begin_s) / self._step_s
        exceeds_block = ceil(steps[-1]) - self._done_steps > self._block_steps
        if exceeds_block and len(stamps_s) > 1:
            half = len(stamps_s) // 2
            return np.concatenate([self(stamps_s[:half]), self(stamps_s[half:])])
        instants_s = self._instants(stamps_s)
        analog_v, signals = self._sampled(steps)
        signals.dt_s = 1 / self.sensor.rate_hz
        if self._effects[Place.ADC] or self._effects[Place.CODE]:
            signals.environment = self._environment(instants_s)
        signals.input_v = list((analog_v + self._draw_noise(stamps_s, signals)).T)
        return self._run.convert(signals)

    def whole(self, stamps_s: np.ndarray, memo: ChainMemo) -> np.ndarray:
        """
        Simulate a whole recording.

        stamps_s: stamps of all samples, s, (n,), ascending; returns: volts of the ADC, V, (n, m).
        Nothing can follow.
        """
        steps = ceil((float(stamps_s[-1]) - self._begin_s) / self._step_s) + POINTS
        if steps > _WHOLE_STEPS:
            return self(stamps_s)
        self._memo, self._block_steps = memo, steps
        sensor = self.sensor
        key = (*self._chain_key(), self._seed, sensor.rate_hz, sensor.rc_s, sensor.lsb_v,
               *sensor.nominal_zero_g_v.tolist(), *sensor.noise_density_g_per_rthz.tolist(),
               stamps_s.tobytes(), *(state.key for states in self._effects.values()
                                     for state in states))
        return self._kept('volts', key, lambda: self(stamps_s)).copy()

    def _instants(self, stamps_s: np.ndarray) -> np.ndarray:
        """Return the instants of samples by their stamps, s, (n,)."""
        signals = Signals(NOMINAL_ENVIRONMENT, time_s=stamps_s)
        self._run(Place.CLOCK, signals)
        return signals.time_s

    def _environment(self, instants_s: np.ndarray) -> Environment:
        environment = NOMINAL_ENVIRONMENT._replace(time_s=instants_s)
        if self._motion.temperature_c:
            environment = environment._replace(
                temperature_c=self._motion.temperature_c(instants_s))
        if self._motion.supply_v:
            environment = environment._replace(supply_v=self._motion.supply_v(instants_s))
        return environment

    def _sampled(self, steps: np.ndarray) -> tuple[np.ndarray, Signals]:
        """Return filtered volts, (n, m), at samples in steps of the grid, and its signals."""
        nearest = np.rint(steps)
        aligned = bool(np.abs(steps - nearest).max() < _ALIGNED_STEPS)
        ahead = 0 if aligned else POINTS // 2
        first = self._done_steps - len(self._tail)
        until = int(nearest[-1]) + 1 + ahead
        kept, signals = [self._tail], None
        while self._done_steps < until or signals is None:
            volts, signals = self._advance(min(until - self._done_steps, self._block_steps))
            kept.append(volts)
            if sum(map(len, kept)) > 2 * self._block_steps:  # a gap, without samples
                first += sum(map(len, kept[:-1]))
                kept = kept[-1:]
        grid = np.concatenate(kept) if len(kept[0]) else kept[-1]
        self._tail = grid[-(2 * POINTS):]
        if aligned:
            index = nearest.astype(np.intp) - first
            every = (int(index[-1]) - int(index[0])) // max(len(index) - 1, 1)
            if every and np.array_equal(np.arange(index[0], index[-1] + 1, every), index):
                return grid[index[0]:index[-1] + 1:every], signals
            return grid[index], signals
        key = (first, steps.tobytes())
        index, weights = self._kept('weights', key, lambda: _interpolation(steps, first))
        return np.column_stack([np.einsum('ij,ij->i', weights, v[index]) for v in grid.T]), signals

    def _advance(self, count: int) -> tuple[np.ndarray, Signals]:
        """Run the chain up to the filter over the next steps of the grid: volts, (n, m)."""
        signals = self._output_of_element(max(count, 0))
        self._done_steps += max(count, 0)
        volts = np.empty((max(count, 0), len(self.sensor.axes)))
        for d, v in enumerate(self._run.amplify(signals)):
            volts[:, d] = low_pass(np.broadcast_to(v, len(volts)), signals.rc_s[d],
                                   self._dt_s, self._filters[d])
        return volts, signals

    def _output_of_element(self, count: int) -> Signals:
        """Run the chain up to the sensing element over the next steps of the grid."""
        key = (*self._chain_key(), self._done_steps, count)
        stamps_s = self._begin_s + (self._done_steps + np.arange(count)) * self._step_s
        signals = Signals(
            NOMINAL_ENVIRONMENT, time_s=stamps_s, dt_s=self._dt_s, up=list(UPRIGHT),
            gravity_mps2=self.sensor.local_gravity_mps2, vref_v=self.sensor.adc_vref_v,
            nominal_scale_v_per_g=self.sensor.nominal_scale_v_per_g.tolist())
        for place, run in _UP_TO_ELEMENT.items():
            key = (*key, *(state.key for state in self._effects[place]))
            # The memo shares its signals; those that follow are a copy.
            signals = _copied(self._kept(place.name, key, partial(run, self, signals)))
        return signals

    def _chain_key(self) -> tuple:
        """Return what the chain depends on beside its effects, up to the element."""
        sensor = self.sensor
        return (self._motion, self._begin_s, self._step_s, sensor.local_gravity_mps2,
                sensor.adc_vref_v, *sensor.nominal_scale_v_per_g.tolist(),
                *(state.key for state in self._effects[Place.REFERENCE]))

    def _put_in_time(self, signals: Signals) -> Signals:
        """Set the instants of the samples and the surroundings."""
        self._run(Place.CLOCK, signals)
        signals.environment = self._environment(signals.time_s)
        return signals

    def _move(self, signals: Signals) -> Signals:
        """Set the specific force by the stage, or by the motion where it states the force."""
        motion, instants_s = self._motion, signals.time_s
        if motion.force:
            if self._force_path is None:
                keys = [state.key for state in self._effects[Place.REFERENCE]]
                self._force_path = self._kept('reference', (motion, *keys),
                                              partial(self._acting_force, motion.force))
            signals.force = list(self._force_path(instants_s))
            return signals
        signals.alpha, signals.beta, signals.shift = (
            Joint(*(joint(instants_s, order) for order in range(3)))
            for joint in (motion.alpha, motion.beta, motion.shift))
        self._run(Place.STAGE, signals)
        signals.force = specific_force_in_motion(
            signals.alpha, signals.beta, signals.shift, signals.gravity_mps2, signals.up)
        return signals

    def _acting_force(self, force: Callable[[np.ndarray], Components]
                      ) -> Callable[[np.ndarray], Components]:
        """
        Return the specific force that acts on the sensor, from that of the reference.

        Only a recorded force has the errors of a reference; others are exact.
        """
        if not isinstance(force, ForcePath) or not self._effects[Place.REFERENCE]:
            return force
        signals = Signals(NOMINAL_ENVIRONMENT, time_s=force.time_s, force=force(force.time_s),
                          dt_s=float(np.median(np.diff(force.time_s))))
        self._run(Place.REFERENCE, signals)
        return ForcePath(signals.time_s, np.column_stack(signals.force))

    def _mount(self, signals: Signals) -> Signals:
        """Turn the specific force into the force along the axes of the case, g."""
        self._run(Place.FORCE, signals)
        signals.sensed = [f / G0_MPS2 for f in signals.force]
        return signals

    def _sense(self, signals: Signals) -> Signals:
        """Turn the force along the axes of the case into that along the sensing axes."""
        self._run(Place.MOUNTING, signals)
        signals.output = list(signals.sensed)
        return signals

    def _put_out(self, signals: Signals) -> Signals:
        """Add the effects of the sensing element."""
        self._run(Place.ELEMENT, signals)
        return signals

    def _kept(self, part: str, key: Hashable, compute: Callable[[], Any]) -> Any:
        """Return a result from the memo, or compute it."""
        return compute() if self._memo is None else self._memo(part, key, compute)

    def _draw_noise(self, stamps_s: np.ndarray, signals: Signals) -> np.ndarray:
        """
        Draw the noise behind the filter, V, (n, m): an exactly sampled AR(1) sequence.

        Noise of missing samples is drawn, too, as far back as the filter remembers.
        """
        rc_s, rate_hz = np.array(signals.rc_s), self.sensor.rate_hz
        std_v = noise.analog_std_v(self.sensor)
        if not std_v.any():
            return np.zeros((len(stamps_s), len(std_v)))
        decay = np.array([np.exp(-1 / (rate_hz * rc)) if rc else 0.0 for rc in rc_s])
        passed = np.rint(np.diff(stamps_s, prepend=self._last_s) * rate_hz).astype(np.intp)
        passed = np.clip(passed, 1, 1 + ceil(_NOISE_MEMORY * rc_s.max() * rate_hz))
        self._last_s = float(stamps_s[-1])
        drawn = self._white.standard_normal((int(passed.sum()), len(std_v)))
        if not len(self._noise):
            # The first sample is stationary.
            drawn[0] /= np.sqrt(1 - decay ** 2)
            self._noise = np.zeros(len(std_v))
        for d, a in enumerate(decay):
            if a:
                drawn[:, d] = first_order_recursion(np.sqrt(1 - a * a), a, drawn[:, d],
                                                    self._noise[d])
        self._noise = drawn[-1].copy()
        return drawn[np.cumsum(passed) - 1] * std_v


_UP_TO_ELEMENT = {Place.CLOCK: Response._put_in_time, Place.STAGE: Response._move,
                  Place.FORCE: Response._mount, Place.MOUNTING: Response._sense,
                  Place.ELEMENT: Response._put_out}
"""What the chain does at each place before the electronics, in its order."""


class EffectState:
    """An effect of the sensor: its parameters, its memory and its random generator."""

    def __init__(self, name: str, values: Parameters, seed: int) -> None:
        """Prepare the effect before its first sample."""
        effect = effect_named(name)
        sizes = [p for p in effect.parameters if p.role is not Role.SHAPE]
        # At the neutral values of its sizes and limits an effect does nothing.
        self.is_neutral = bool(sizes) and all(
            np.all(np.equal(values.get(p.name, p.neutral), p.neutral)) for p in sizes)
        self.place, self.apply = effect.place, effect.apply
        self.key = (name, *sorted(values.items()))
        self.parameters = values
        self.memory: dict[str, Any] = {}
        self.rng = np.random.default_rng([seed, zlib.crc32(name.encode())])


class EffectRunner:
    """Runs the effects of a sensor over samples, in blocks or one by one."""

    def __init__(self, sensor: Sensor, names: Iterable[str], seed: int) -> None:
        """Prepare some effects of the sensor before the first sample."""
        self._sensor = sensor
        states = [EffectState(name, analog_stages.parameters(sensor, name), seed)
                  for name in names]
        self.effects = {place: [state for state in states
                                if state.place is place and not state.is_neutral]
                        for place in Place}

    def __call__(self, place: Place, signals: Signals) -> None:
        """Apply the effects of a place."""
        for effect in self.effects[place]:
            signals.memory, signals.rng = effect.memory, effect.rng
            effect.apply(signals, effect.parameters)

    def amplify(self, signals: Signals) -> Components:
        """Run the electronics up to the filter; return volts by axis."""
        sensor, count = self._sensor, len(self._sensor.axes)
        signals.zero_g_v = sensor.nominal_zero_g_v.tolist()
        signals.scale_v_per_g = sensor.nominal_scale_v_per_g.tolist()
        signals.rc_s, signals.noise_ratio = [sensor.rc_s] * count, [1.0] * count
        signals.lsb_v, signals.lsb_ratio = sensor.lsb_v, [1.0] * count
        self(Place.ELECTRONICS, signals)
        return analog_stages.output_volts(signals)

    def convert(self, signals: Signals) -> np.ndarray:
        """Run the ADC on `input_v`; return volts, (..., m)."""
        signals.volts = list(signals.input_v)
        self(Place.ADC, signals)
        coded = signal_chain.quantise(np.stack(signals.volts, axis=-1), self._sensor,
                                      signals.lsb_v * np.array(signals.lsb_ratio))
        if not self.effects[Place.CODE]:
            return coded
        signals.volts = [coded[..., d] for d in range(coded.shape[-1])]
        self(Place.CODE, signals)
        return np.stack(signals.volts, axis=-1)


def _copied(signals: Signals) -> Signals:
    """Return signals that effects can change without changing these."""
    return replace(signals, up=list(signals.up), force=list(signals.force),
                   sensed=list(signals.sensed), output=list(signals.output))


def _interpolation(steps: np.ndarray, first: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the steps from `first` on that samples lie between, (n, points), and weights."""
    start = np.floor(steps).astype(np.intp) - (POINTS // 2 - 1)
    index = np.clip(start[:, None] + np.arange(POINTS) - first, 0, None)
    return index, lagrange_weights(steps - start)


def lagrange_weights(position: np.ndarray) -> np.ndarray:
    """Return the weights of `POINTS` steps for interpolation at positions, (n, points)."""
    nodes = np.arange(POINTS)
    return np.column_stack([
        np.prod([(position - k) / (j - k) for k in nodes if k != j], axis=0) for j in nodes])


def check_needs(sensor: Sensor, motion: Motion) -> None:
    """Refuse an effect that has nothing to act on."""
    missing = {}
    if motion.force is not None:
        missing[Need.STAGE] = 'this manoeuvre has none, only specific force'
    if not sensor.adc_bits > 0:
        missing[Need.ADC] = 'the sensor has none: sensor.adc_bits is 0'
    if not np.any(sensor.noise_density_g_per_rthz):
        missing[Need.NOISE] = 'the sensor has none: sensor.noise_density_g_per_rthz is 0'
    for name in sensor.effects:
        for need in effect_named(name).needs:
            if need in missing:
                raise UserError(f'{name} acts on the {need.value}, but {missing[need]}; leave the '
                                'effect out')


_KEPT = 3
"""Number of results of each part that are kept. Chosen: the baseline, the present hypothesis and
one more; a recording of ten minutes then needs below 100 MB."""

_Result = TypeVar('_Result')


class ChainMemo:
    """Results of parts of the chain by what they depend on, the newest of each part."""

    def __init__(self) -> None:
        self._kept: dict[str, dict[Hashable, object]] = {}

    def __call__(self, part: str, key: Hashable, compute: Callable[[], _Result]) -> _Result:
        """Return a result that was computed before, or compute it."""
        kept = self._kept.setdefault(part, {})
        # The entry moves to the end, so that the one that was not used for longest is dropped.
        kept[key] = kept.pop(key) if key in kept else compute()
        while len(kept) > _KEPT:
            del kept[next(iter(kept))]
        return kept[key]  # type: ignore[return-value]
