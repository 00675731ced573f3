# SPDX-License-Identifier: Apache-2.0

"""The signal chain over time: samples of a sensor during a manoeuvre, block by block."""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from itertools import chain
from math import ceil
from typing import Any, NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import Recording, REFERENCES
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import (
    Components,
    Environment,
    Joint,
    Need,
    NOMINAL_ENVIRONMENT,
    Place,
    Signals,
)
from adxl_ros.model.error_sizes import rms
from adxl_ros.model.filters import first_order_recursion, low_pass
from adxl_ros.model.kinematics import specific_force_in_motion
from adxl_ros.model.sensor import neutral, Sensor
from adxl_ros.model.signal_chain import Chain
from adxl_ros.report.quantities import mg
from adxl_ros.simulate.motion import (
    encoder_reading,
    ForcePath,
    Held,
    lagrange_weights,
    Motion,
    Path,
    POINTS,
)
from adxl_ros.wording import option
import numpy as np

Columns = dict[str, np.ndarray]  # Columns of a recording by canonical name, (n,) each
_BLOCK_ROWS = 32768  # Samples of a block; chosen: its arrays stay smaller than the internal grid
_BLOCK_STEPS = 65536  # Steps of the internal grid in memory at once; chosen: some 10 MB of signals
_WHOLE_STEPS = 300_000
"""Most steps whose signals are kept. Chosen: 20 min at 250 Hz, 200 MB."""
_ALIGNED_STEPS = 1e-4  # Distance of an aligned sample, steps; chosen: above rounding
_ROUNDING = 1e-9  # Rounding error of a ratio of two rates
_ANALOG = tuple(place for place in Place if place not in (Place.ADC, Place.CODE))
"""Places of the chain up to the filter, with the clock."""
_NOISE_MEMORY = 50  # RC over which missing noise is drawn; chosen: e⁻⁵⁰ is left
_SEED = 0  # Seed of noise-like effects in a comparison
_QUIET = 1e-9  # Factor of white noise in a comparison; chosen: invisible, but not 0
_FINE_BITS = 32  # Resolution of the ADC in a comparison, bit; chosen: its steps are invisible
_RATE_HZ = 250.0  # Largest rate there, Hz; chosen: twice the bandwidth of the motion
_SHORT_RC_S = 1e-9  # RC of a filter that does nothing, s; chosen: not 0


class _Grid:
    """The newest volts behind the filter, on the uniform grid on which the chain runs."""

    def __init__(self, axes: int) -> None:
        self._rows = np.zeros((0, axes))
        self.end = 0  # Step behind the last row: so many the chain has run over

    @property
    def begin(self) -> int:
        """Return the step of the first row."""
        return self.end - len(self._rows)

    def extend(self, volts: np.ndarray, most_rows: int) -> None:
        """Append the next steps, (n, m), and forget all but the newest rows."""
        rows = np.concatenate([self._rows, volts]) if len(self._rows) else volts
        self._rows = rows[-most_rows:]
        self.end += len(volts)

    def forget(self) -> None:
        """Forget all but what samples between the last step and the next one need."""
        self._rows = self._rows[-(2 * POINTS) :]

    def at(self, steps: np.ndarray) -> np.ndarray:
        """Return the volts at steps, (n,) int: (n, m)."""
        return np.take(self._rows.T, steps - self.begin, axis=1).T

    def between(self, steps: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Interpolate from steps and their weights, (n, points): (n, m)."""
        index = np.clip(steps - self.begin, 0, None)
        return np.column_stack([np.einsum('ij,ij->i', weights, v[index]) for v in self._rows.T])


class _Neighbours(NamedTuple):
    """The steps that samples lie between, and their weights, (n, points) each."""

    steps: np.ndarray
    weights: np.ndarray


class _Stage(NamedTuple):
    """A part of the chain up to the sensing element."""

    name: str
    # Place whose effects act in it: its result depends on them, and on those of earlier stages
    place: Place
    run: Callable[[Signals], None]  # Changes the signals, of which it has copies


class Response:
    """
    Volts of a sensor during a manoeuvre.

    Stage, element and filter run on a uniform grid at a multiple of the sample rate. Samples
    between its steps (jitter, gaps of a recording) are interpolated from the filtered signal by
    polynomials. Noise and ADC belong to the samples. Effects of the clock move the grid: samples
    are taken at their instants, and noise is never resampled.
    """

    def __init__(
        self,
        sensor: Sensor,
        motion: Motion,
        seed: int,
        begin_s: float = 0.0,
        memo: ChainMemo | None = None,
        block_steps: int = _BLOCK_STEPS,
    ) -> None:
        """
        Put the sensor, settled, at the beginning of a manoeuvre.

        With a memo, which keeps results, all samples come at once.
        """
        check_needs(sensor, motion)
        self.sensor = sensor
        self._motion = motion
        self._begin_s = begin_s
        self._seed = seed
        self._is_whole = memo is not None
        self._memo = memo or ChainMemo(0)
        self._block_steps = block_steps
        self._chain = Chain(sensor, seed=seed)
        self._step_s = step_s(sensor, motion)
        # Rate of the instants by stamps; rounding evens out the steps of float64 times.
        instants_s = self._instants(np.array([0.0, 1.0]))
        self._dt_s = self._step_s * round(float(instants_s[1] - instants_s[0]), 12)
        self._force_path: Callable[[np.ndarray], Components] | None = None
        self._filters: list[dict[str, Any]] = [{} for _ in sensor.axes]
        self._grid = _Grid(len(sensor.axes))
        self._white = np.random.default_rng([seed, 0])
        self._noise = np.zeros(0)
        self._last_s = begin_s

    def __call__(self, stamps_s: np.ndarray) -> np.ndarray:
        """Advance to the next samples, (n,), which are later; return volts, (n, m)."""
        if not len(stamps_s):
            return np.zeros((0, len(self.sensor.axes)))
        steps = (stamps_s - self._begin_s) / self._step_s
        if ceil(steps[-1]) - self._grid.end > self._block_steps and len(stamps_s) > 1:
            # Memory holds the steps of a block: samples of a longer time come in two halves.
            half = len(stamps_s) // 2
            return np.concatenate([self(stamps_s[:half]), self(stamps_s[half:])])
        stamps = stamps_s.tobytes()
        analog_v, signals = self._once(
            'analog', _ANALOG, partial(self._sampled, steps), *self._electronics, stamps
        )
        signals = replace(signals, dt_s=1 / self.sensor.rate_hz)
        if self._chain.effects[Place.ADC] or self._chain.effects[Place.CODE]:
            instants_s = self._instants(stamps_s)
            signals.environment = self._once(
                'surroundings', (Place.CLOCK,), partial(self._environment, instants_s), stamps
            )
        signals.input_v = list((analog_v + self._draw_noise(stamps_s, signals)).T)
        return self._chain.convert(signals)

    def key(self, stamps_s: np.ndarray) -> tuple[Hashable, ...]:
        """Return what the volts of all samples of a recording depend on."""
        noise_density = self.sensor.noise_density_g_per_rthz.tolist()
        return self._key(Place, *self._electronics, *noise_density, stamps_s.tobytes())

    def _once(
        self,
        part: str,
        places: Collection[Place],
        compute: Callable[[], Any],
        *further: Hashable,
    ) -> Any:
        """Return a result, and compute it only where the memo does not have it; see `_key`."""
        return self._memo(part, self._key(places, *further), compute)

    def _key(self, places: Iterable[Place], *further: Hashable) -> tuple[Hashable, ...]:
        """
        Return what a result depends on.

        These are the motion, what the chain takes from the sensor up to the element, the effects
        of some places, and what is named further.
        """
        sensor = self.sensor
        effects = chain.from_iterable(self._chain.effects[place] for place in places)
        return (
            self._motion,
            self._begin_s,
            self._step_s,
            sensor.local_gravity_mps2,
            sensor.adc_vref_v,
            *sensor.nominal_scale_v_per_g.tolist(),
            *(effect.key for effect in effects),
            *further,
        )

    @property
    def _electronics(self) -> tuple[Hashable, ...]:
        """Return what the chain behind the element takes from the sensor, and its seed."""
        sensor = self.sensor
        return (
            self._seed,
            sensor.rate_hz,
            sensor.rc_s,
            sensor.lsb_v,
            *sensor.nominal_zero_g_v.tolist(),
        )

    def _instants(self, stamps_s: np.ndarray) -> np.ndarray:
        """Return the instants of samples by their stamps, s, (n,)."""
        signals = Signals(NOMINAL_ENVIRONMENT, time_s=stamps_s)
        self._chain(Place.CLOCK, signals)
        return signals.time_s

    def _environment(self, instants_s: np.ndarray) -> Environment:
        return NOMINAL_ENVIRONMENT._replace(
            time_s=instants_s,
            **{name: path(instants_s) for name, path in self._motion.environment.items()},
        )

    def _sampled(self, steps: np.ndarray) -> tuple[np.ndarray, Signals]:
        """Return filtered volts, (n, m), at samples in steps of the grid, and its signals."""
        nearest = np.rint(steps)
        aligned = bool(np.abs(steps - nearest).max() < _ALIGNED_STEPS)
        until = int(nearest[-1]) + 1 + (0 if aligned else POINTS // 2)
        every = round(1 / (self.sensor.rate_hz * self._step_s))
        number = nearest / every
        if self._is_whole and aligned and np.array_equal(number, np.rint(number)):
            signals = self._advance(until, every)
            return self._grid.at(number.astype(np.intp)), signals
        signals = self._advance(until)
        while self._grid.end < until:  # a gap, without samples
            signals = self._advance(until)
        if aligned:
            volts = self._grid.at(nearest.astype(np.intp))
        else:
            near = self._once('weights', (), partial(_neighbours, steps), steps.tobytes())
            volts = self._grid.between(near.steps, near.weights)
        self._grid.forget()
        return volts, signals

    def _advance(self, until: int, every: int = 1) -> Signals:
        """
        Run the chain up to the filter over the next steps of the grid, a block at most.

        every: the grid keeps each k-th step alone.
        """
        count = max(min(until - self._grid.end, self._block_steps), 0)
        signals = self._output_of_element(count)
        unfiltered = self._chain.volts(signals, Place.ELECTRONICS)
        volts = [
            low_pass(np.broadcast_to(v, count), tau_s, self._dt_s, memory, every=every)
            for v, tau_s, memory in zip(unfiltered, signals.rc_s, self._filters)
        ]
        self._grid.extend(np.array(volts).T, 2 * self._block_steps)
        return signals

    @property
    def _stages(self) -> tuple[_Stage, ...]:
        """Return the parts of the chain up to the sensing element, in order."""
        return (
            _Stage('clock', Place.CLOCK, self._follow_clock),
            _Stage('motion', Place.REFERENCE, self._follow_motion),
            _Stage('stage', Place.STAGE, self._turn_stage),
            _Stage('force', Place.FORCE, partial(self._chain, Place.FORCE)),
            _Stage('mounting', Place.MOUNTING, partial(self._chain, Place.MOUNTING)),
            _Stage('element', Place.ELEMENT, partial(self._chain, Place.ELEMENT)),
        )

    def _output_of_element(self, count: int) -> Signals:
        """Run the chain up to the sensing element over the next steps of the grid."""
        first = self._grid.end
        stamps_s = self._begin_s + (first + np.arange(count)) * self._step_s
        signals = self._chain.signals(NOMINAL_ENVIRONMENT, time_s=stamps_s, dt_s=self._dt_s)
        places: tuple[Place, ...] = ()
        for stage in self._stages:
            places = *places, stage.place
            signals = self._once(
                stage.name,
                places,
                partial(_after, stage, signals),
                *(self._seed, self._rotates, first, count),
            )
        return replace(signals)

    @property
    def _rotates(self) -> bool:
        """Whether the rotation of a robot is computed: an effect of the force follows it."""
        return isinstance(self._motion.force, ForcePath) and bool(self._chain.effects[Place.FORCE])

    def _follow_clock(self, signals: Signals) -> None:
        self._chain(Place.CLOCK, signals)
        signals.environment = self._environment(signals.time_s)

    def _follow_motion(self, signals: Signals) -> None:
        """Set the force of a robot, or the joints of a stage, before the effects of either."""
        motion = self._motion
        instants_s = signals.time_s
        if not motion.force:
            signals.alpha = _joint(motion.alpha, instants_s)
            signals.beta = _joint(motion.beta, instants_s)
            signals.shift = _joint(motion.shift, instants_s)
            return
        if self._force_path is None:
            self._force_path = self._once(
                'reference', (Place.REFERENCE,), partial(self._acting_force, motion.force)
            )
        signals.force = list(self._force_path(instants_s))
        if self._rotates and isinstance(motion.force, ForcePath):
            signals.rotation = motion.force.rotation(instants_s)

    def _turn_stage(self, signals: Signals) -> None:
        if self._motion.force:
            return
        self._chain(Place.STAGE, signals)
        signals.force = specific_force_in_motion(
            signals.alpha, signals.beta, signals.shift, signals.gravity_mps2, signals.up
        )

    def _acting_force(
        self, force: Callable[[np.ndarray], Components]
    ) -> Callable[[np.ndarray], Components]:
        """
        Return the specific force that acts on the sensor, from that of the reference.

        Only a recorded force has the errors of a reference; others are exact.
        """
        if not isinstance(force, ForcePath) or not self._chain.effects[Place.REFERENCE]:
            return force
        signals = Signals(
            NOMINAL_ENVIRONMENT,
            time_s=force.time_s,
            force=force(force.time_s),
            dt_s=float(np.median(np.diff(force.time_s))),
        )
        signals.modes = {name: list(mode.T) for name, mode in force.modes.items()}
        self._chain(Place.REFERENCE, signals)
        return ForcePath(signals.time_s, np.column_stack(signals.force))

    def _draw_noise(self, stamps_s: np.ndarray, signals: Signals) -> np.ndarray:
        """
        Draw the noise behind the filter, V, (n, m): an exactly sampled AR(1) sequence.

        Noise of missing samples is drawn, too, as far back as the filter remembers.
        """
        density = self.sensor.noise_density_g_per_rthz
        if not density.any():
            return np.zeros((len(density), len(stamps_s))).T
        rc_s = np.array(signals.rc_s)
        rate_hz = self.sensor.rate_hz
        std_v = noise.analog_std_v(self.sensor)
        decay = np.array([np.exp(-1 / (rate_hz * rc)) if rc else 0.0 for rc in rc_s])
        passed = np.rint(np.diff(stamps_s, prepend=self._last_s) * rate_hz).astype(np.intp)
        passed = np.clip(passed, 1, 1 + ceil(_NOISE_MEMORY * rc_s.max() * rate_hz))
        self._last_s = float(stamps_s[-1])
        drawn = self._white.standard_normal((int(passed.sum()), len(std_v)))
        if not len(self._noise):
            # The first sample is stationary.
            drawn[0] /= np.sqrt(1 - decay**2)
            self._noise = np.zeros(len(std_v))
        for d, a in enumerate(decay):
            if a:
                drawn[:, d] = first_order_recursion(
                    np.sqrt(1 - a * a), a, drawn[:, d], self._noise[d]
                )
        self._noise = drawn[-1].copy()
        return drawn[np.cumsum(passed) - 1] * std_v


def _after(stage: _Stage, before: Signals) -> Signals:
    """Return the signals behind a stage; those before it stay, for the memo."""
    signals = replace(before, up=list(before.up), force=list(before.force))
    stage.run(signals)
    return signals


def _joint(path: Path, instants_s: np.ndarray) -> Joint:
    return Joint(*(path(instants_s, order) for order in range(3)))


def _neighbours(steps: np.ndarray) -> _Neighbours:
    """Return the steps that samples lie between."""
    first = np.floor(steps).astype(np.intp) - (POINTS // 2 - 1)
    return _Neighbours(first[:, None] + np.arange(POINTS), lagrange_weights(steps - first))


class ChainMemo:
    """Results of parts of the chain by what they depend on, the newest of each part."""

    def __init__(self, most: int = 3, more_volts: int = 0) -> None:
        """
        Keep so many of each part, and some more outputs in volts.

        Chosen: baseline, hypothesis, one more; 100 MB for 10 min.
        """
        self._most = most
        self._more_volts = more_volts
        self._kept: dict[str, dict[Hashable, Any]] = {}

    def __call__(self, part: str, key: Hashable, compute: Callable[[], Any]) -> Any:
        """Return a result that was computed before, or compute it."""
        kept = self._kept.setdefault(part, {})
        # The entry moves to the end, so that the one that was not used for longest is dropped.
        result = kept[key] = kept.pop(key) if key in kept else compute()
        if len(kept) > self._most + (part == 'volts') * self._more_volts:
            del kept[next(iter(kept))]
        return result


def check_needs(sensor: Sensor, motion: Motion) -> None:
    """Refuse an effect that has nothing to act on."""
    has_stage = motion.force is None
    is_robot = getattr(motion.force, 'is_robot', False)
    missing = {
        Need.STAGE: (has_stage, 'this manoeuvre has none, only specific force'),
        Need.ROTATION: (has_stage or is_robot, 'it is not known beside a specific force'),
        Need.ROBOT: (is_robot, f'the motion is not that of a robot; give {option("urdf")}'),
        Need.ADC: (
            sensor.adc_bits or noise.electronics(sensor).lsb_v.any(),
            'the sensor has none: sensor.adc_bits is 0',
        ),
        Need.NOISE: (
            np.any(sensor.noise_density_g_per_rthz),
            'the sensor has none: sensor.noise_density_g_per_rthz is 0',
        ),
    }
    for name in sensor.effects:
        for need in effect_named(name).needs:
            is_there, reason = missing.get(need, (True, ''))
            if not is_there:
                raise UserError(
                    f'{name} acts on the {need.value}, but {reason}; leave the effect out'
                )


def step_s(sensor: Sensor, motion: Motion) -> float:
    """Return the step of the grid, s: a part of the sample period."""
    steps_per_sample = ceil(motion.internal_rate_hz / sensor.rate_hz - _ROUNDING)
    return 1 / (sensor.rate_hz * steps_per_sample)


def whole_response(
    sensor: Sensor, motion: Motion, seed: int, stamps_s: np.ndarray, memo: ChainMemo
) -> np.ndarray:
    """Simulate all samples of a recording: volts, (n, m); a memo keeps them for other sensors."""
    begin_s = float(stamps_s[0])
    span_s = float(stamps_s[-1]) - begin_s
    steps = ceil(span_s / step_s(sensor, motion)) + POINTS
    respond = (
        Response(sensor, motion, seed, begin_s, memo, steps)
        if steps <= _WHOLE_STEPS
        else Response(sensor, motion, seed, begin_s)
    )
    return memo('volts', respond.key(stamps_s), partial(respond, stamps_s)).copy('K')


def simulate(
    sensor: Sensor, motion: Motion, seed: int, begin_s: float = 0.0, like: Recording | None = None
) -> Columns:
    """
    Simulate a whole recording: columns by canonical name, (n,) each.

    They are `time_s`, volts by axis, encoders, and temperature and supply if they change; see
    `simulate_blocks`.
    """
    parts = list(simulate_blocks(sensor, motion, seed, begin_s, like))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def simulate_blocks(
    sensor: Sensor, motion: Motion, seed: int, begin_s: float = 0.0, like: Recording | None = None
) -> Iterator[Columns]:
    """Simulate a recording block by block; another one that it is like has its stamps."""
    count = max(int(round(motion.duration_s * sensor.rate_hz, 6)), 1)
    stamps_s = begin_s + np.arange(count) / sensor.rate_hz if like is None else like.time_s
    respond = Response(sensor, motion, seed, float(stamps_s[0]))
    for begin in range(0, len(stamps_s), _BLOCK_ROWS):
        part = slice(begin, begin + _BLOCK_ROWS)
        time_s = stamps_s[part]
        columns = {
            'time_s': time_s,
            **{f'{axis}_v': volts for axis, volts in zip(sensor.axes, respond(time_s).T)},
        }
        yield columns | (
            _references(sensor, motion, time_s)
            if like is None
            else {name: like.columns[name][part] for name in REFERENCES if name in like.columns}
        )


def _references(sensor: Sensor, motion: Motion, time_s: np.ndarray) -> Columns:
    """Return the readings of the encoders, temperature and supply at stamps, s."""
    columns = {}
    if motion.force is None:
        resolution_rad = sensor.stage_resolution_rad
        columns['alpha_rad'] = encoder_reading(motion.alpha(time_s), resolution_rad)
        columns['beta_rad'] = encoder_reading(motion.beta(time_s), resolution_rad)
        if not isinstance(motion.shift, Held):
            columns['shift_m'] = motion.shift(time_s)
    return columns | {name: path(time_s) for name, path in motion.environment.items()}


def change_mg(
    sensor: Sensor,
    motion: Motion,
    memo: ChainMemo,
    effects: Collection[str],
    is_filtered: bool = True,
) -> float:
    """Return the rms of what some effects change, and the filter, too, if it is left out."""
    sensor = sensor.computed_at(min(sensor.rate_hz, _RATE_HZ))
    motion = replace(motion, internal_rate_hz=sensor.rate_hz)
    stamps_s = np.arange(int(motion.duration_s * sensor.rate_hz)) / sensor.rate_hz
    needs = [set(effect_named(name).needs) for name in effects]
    if not needs or not all({Need.ADC, Need.NOISE} & each for each in needs):
        sensor = replace(
            sensor,
            adc_bits=_FINE_BITS if sensor.adc_bits else 0,
            noise_density_g_per_rthz=_QUIET * sensor.noise_density_g_per_rthz,
        )
    other = replace(
        sensor,
        values={
            **sensor.values,
            **{name: neutral(effect_named(name), sensor.axes) for name in effects},
        },
    )
    if other.rc_s and not is_filtered:
        other = replace(
            other, rc_resistance_ohm=_SHORT_RC_S / other.rc_capacitance_f, filter_rate_hz=0.0
        )
    changed_v = whole_response(sensor, motion, _SEED, stamps_s, memo) - whole_response(
        other, motion, _SEED, stamps_s, memo
    )
    change_mps2 = changed_v / sensor.nominal_scale_v_per_g * G0_MPS2
    return mg(rms(change_mps2))
