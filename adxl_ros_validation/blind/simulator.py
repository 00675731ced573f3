# SPDX-License-Identifier: Apache-2.0
"""The simulator of this world: units, faults, and the chain from joints to codes of the ADC."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, KW_ONLY
from enum import Enum
from functools import cached_property, partial
from itertools import product
import math
from pathlib import Path
from typing import Any
import zlib

from adxl_ros_validation.blind.motion import Manoeuvre
import numpy as np
import scipy
import yaml

G0 = 9.80665
"""Standard gravity, m/s², exact."""
ADC_BITS = 16
"""Resolution of the ADC, bits; chosen: that of the paper."""
ADC_VREF = 5.0
"""Range of the ADC, V; chosen: that of the paper."""
LSB_V = ADC_VREF / 2**ADC_BITS
"""Step of the ADC, V."""
ZERO_G_STD_G = 150e-6
"""Standard deviation of zero-g since its calibration some days ago, g; chosen."""
SCALE_STD = 150e-6
"""Standard deviation of the scale factor since then, a share; chosen."""
STAGE_STD = 0.15
"""Standard deviation of each error of the stage, in its stated resolution; chosen."""


@dataclass(frozen=True)
class Unit:
    """A sensor on its stage; m axes. `stated_` values are those that the user knows."""

    axes: str  # measured axes, 'xy' or 'xyz'
    zero_v: np.ndarray  # zero-g, V, and scale factor, V/g, on the day of the recording, (m,)
    scale_v_per_g: np.ndarray
    stated_zero_v: np.ndarray  # the same by the calibration, (m,)
    stated_scale_v_per_g: np.ndarray
    noise_g_per_rthz: np.ndarray  # noise density, g/√Hz, (m,)
    stated_noise_g_per_rthz: np.ndarray
    corner_hz: float  # corner of the output filter, Hz
    walk_g_per_rts: np.ndarray  # random walk, g/√s, and size of the 1/f noise, g, (m,)
    flicker_g: np.ndarray
    resolution_rad: float  # stated resolution of the stage, rad
    # errors of alpha, then of beta, rad, (6,): offset, and parts of sine and cosine
    stage_rad: np.ndarray
    rate_hz: float  # sample rate, Hz

    @property
    def axis_indices(self) -> list[int]:
        """Return the indices of the measured axes among x, y and z."""
        return ['xyz'.index(axis) for axis in self.axes]

    @property
    def volts_to_mps2(self) -> np.ndarray:
        """Return the factor from V to m/s² by the stated scale factor, (m, 1)."""
        return (G0 / self.stated_scale_v_per_g)[:, None]


def draw_unit(rng: np.random.Generator) -> Unit:
    """Draw a unit like an ADXL203 with a 50 Hz filter, calibrated some days before."""
    axes = 'xyz' if rng.random() < 0.7 else 'xy'
    n = len(axes)
    zero = 2.5 + 0.1 * np.clip(rng.normal(0, 0.4, n), -1, 1)
    scale = 1.0 + 0.04 * np.clip(rng.normal(0, 0.5, n), -1, 1)
    noise = 110e-6 * np.exp(rng.normal(0, 0.12, n))
    corner = 50.0 * np.exp(rng.normal(0, 0.08))
    resolution = float(np.deg2rad(rng.choice([0.002, 0.005, 0.01])))
    return Unit(
        axes,
        zero,
        scale,
        zero + ZERO_G_STD_G * scale * rng.normal(size=n),
        scale * (1 + SCALE_STD * rng.normal(size=n)),
        noise,
        noise * np.exp(rng.normal(0, 0.015, n)),
        corner,
        10 ** rng.uniform(-6.0, -5.1, n),
        10 ** rng.uniform(-5.3, -4.7, n),
        resolution,
        STAGE_STD * resolution * np.clip(rng.normal(size=6), -2, 2),
        float(rng.choice([100.0, 125.0, 200.0, 250.0])),
    )


def parameter_file(
    unit: Unit,
    serial: str,
    *,
    nominal_zero_v: float = 2.5,
    is_certain: bool = False,
    **sensor: float,
) -> str:
    """Return the parameter file that the user has, with other values of the sensor, if any."""
    file = yaml.safe_load(Path(__file__).with_name('unit.yaml').read_text(encoding='utf-8'))
    keys, ones = file['/**']['ros__parameters'], np.ones(len(unit.axes))
    keys['sensor'].update(
        {
            'serial': serial,
            'axes': unit.axes,
            'nominal_zero_g_v': (nominal_zero_v * ones).tolist(),
            'nominal_scale_v_per_g': ones.tolist(),
            'noise_density_g_per_rthz': unit.stated_noise_g_per_rthz.tolist(),
            'rc_capacitance_f': float(
                1 / (2 * np.pi * keys['sensor']['rc_resistance_ohm'] * unit.corner_hz)
            ),
            'adc_bits': ADC_BITS,
            'adc_vref_v': ADC_VREF,
            'rate_hz': unit.rate_hz,
            **sensor,
        }
    )
    keys.update(
        {
            'stage': {'resolution_rad': unit.resolution_rad},
            'bias': {'offset_v': (unit.stated_zero_v - nominal_zero_v).tolist()},
            'scale_factor': {'offset_v_per_g': (unit.stated_scale_v_per_g - 1.0).tolist()},
        }
    )
    names = ('bias.offset_v', 'scale_factor.offset_v_per_g')
    variance = np.outer(np.square((ZERO_G_STD_G, SCALE_STD)), unit.stated_scale_v_per_g**2)
    keys['covariance_names'] = [f'{name}.{axis}' for name in names for axis in unit.axes]
    keys['covariance'] = np.diag(variance.ravel()).ravel().tolist()
    if is_certain:
        del keys['covariance_names'], keys['covariance']
    return yaml.safe_dump(file, sort_keys=False)


Place = Enum('Place', ['STAGE', 'MOUNT', 'ELEMENT', 'ELECTRONICS', 'WIRE', 'SAMPLES'])
"""Where in the chain a fault acts."""


@dataclass
class Run:
    """A recording while it is simulated; n instants, m axes."""

    unit: Unit  # the sensor on its stage
    t: np.ndarray  # instants, s, (n,): the fine grid, or the stamps at the place SAMPLES
    seed: int  # seed of all random numbers
    alpha: np.ndarray  # joint angles, rad, (n,)
    beta: np.ndarray
    shift: np.ndarray  # position of the shaker, m, (n,)
    temperature: np.ndarray  # °C and V, (n,)
    supply: np.ndarray
    # direction that is up, in the base, (3,)
    up: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    gravity: float = G0  # local gravity, m/s²
    # position of the sensor off the axes of the stage, m, (3,)
    arm: np.ndarray = field(default_factory=lambda: np.zeros(3))
    late: float = 0.0  # delay of the samples, s, and its growth, s/s
    skew: float = 0.0
    corner_hz: float = 0.0  # corners of the output filter's two poles, Hz
    second_hz: float = math.inf
    # specific force in the sensor's frame, m/s², (3, n)
    force: np.ndarray = field(default_factory=lambda: np.zeros((3, 0)))
    # directions of x, y and z in the sensor's frame, one per row, (3, 3)
    directions: np.ndarray = field(default_factory=lambda: np.eye(3))
    # input of the measured axes, g, (m, n)
    u: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    # output of the measured axes, V, (m, n)
    volts: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def dt(self) -> float:
        """Return the step of the grid, s."""
        return float(self.t[1] - self.t[0])

    def late_s(self, t: np.ndarray) -> np.ndarray:
        """Return how late the samples are, s; the oven of the clock makes it wander."""
        return self.late + self.skew * (t + 8 * np.sin(t / 25))

    def random(self, stream: str) -> np.random.Generator:
        """Return the random generator of a stream; other faults do not change it."""
        return np.random.default_rng([self.seed, zlib.crc32(stream.encode())])


def pink_noise(t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw 1/f noise as a sum of relaxations at half-decade steps, each of variance 1."""
    noise = np.zeros_like(t)
    dt = t[1] - t[0]
    for lag in dt * 10 ** np.arange(0.5, math.log10(2 * (t[-1] - t[0]) / dt), 0.5):
        keep = math.exp(-dt / lag)
        noise += scipy.signal.lfilter(
            [math.sqrt(1 - keep * keep)],
            [1, -keep],
            rng.normal(size=len(t)),
            zi=[keep * rng.normal()],
        )[0]
    return noise


def travel_memory(x: np.ndarray, travel: float) -> np.ndarray:
    """Return the direction of the last travel, forgotten exponentially with the distance."""
    direction = np.sign(np.diff(x, prepend=x[0]))
    moving = np.flatnonzero(direction)
    memory = np.zeros_like(x)
    turns = moving[np.flatnonzero(np.diff(direction[moving], prepend=0))]
    level = 0.0
    for start, stop in zip(turns, [*turns[1:], len(x)]):
        s = direction[start]
        distance = np.abs(x[start:stop] - x[start - 1])
        memory[start:stop] = s + (level - s) * np.exp(-distance / travel)
        level = memory[stop - 1]
    return memory


Shape = dict[str, Any]
"""The numbers of a fault that stay when its size changes: weights `w`, and others by name."""
Act = Callable[[Run, float, Shape], None]
"""Lets a fault of a size and a shape act on a run."""
Law = Callable[[Run, Shape], Any]
"""What a fault of size and weight 1 does to an axis, (n,), or to all, (m, n)."""


def column(shape: Shape) -> np.ndarray:
    """Return the weights as a column, (m, 1)."""
    return np.asarray(shape['w'])[:, None]


def constant(run: Run, shape: Shape) -> float:
    """Shift, or scale, by the size itself: the simplest law."""
    return 1.0


def _acting(how: str, law: Law) -> Act:
    """Let a law act on each axis by its weight."""

    def act(run: Run, size: float, shape: Shape) -> None:
        change = size * column(shape) * law(run, shape)
        if how == 'scaled':
            run.u[: len(change)] *= 1 + change
        elif how == 'added':
            run.u[: len(change)] += change
        else:
            run.volts += change * (run.unit.scale_v_per_g[:, None] if how == 'output' else 1.0)

    return act


added, scaled, added_at_output, added_v = (
    partial(_acting, how) for how in ('added', 'scaled', 'output', 'volts')
)
"""Make a fault of a law: added to the input, g, its scale factor, or to the output, g or V."""


def weights(rng: np.random.Generator, count: int) -> np.ndarray:
    """Draw weights with rms 1 over those that are not 0: in four of ten cases one, else all."""
    w = rng.choice([-1.0, 1.0], count) * np.exp(rng.normal(0, 0.4, count))
    if rng.random() < 0.4:
        w *= np.arange(count) == rng.integers(count)
    return w / np.sqrt(np.mean(w[w != 0] ** 2))


def positive(rng: np.random.Generator, count: int) -> np.ndarray:
    """Draw weights as `weights`, all of them positive."""
    return np.abs(weights(rng, count))


@dataclass(frozen=True)
class Kind:
    """One kind of fault."""

    name: str
    act: Act
    start: float = 1e-3  # a size at which the search for a strength begins
    largest: float = 0.05  # its largest size
    place: Place = Place.ELEMENT  # where in the chain it acts
    _: KW_ONLY
    fixed: int = 0  # number of its weights; where it is 0, `each` for each measured axis
    each: int = 1
    weigh: Callable[[np.random.Generator, int], np.ndarray] = weights  # draws the weights
    # its other numbers, drawn within bounds or from a list
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    choices: Mapping[str, Sequence[float]] = field(default_factory=dict)
    per_axis: bool = True  # whether the responses of single axes are independent
    random: bool = False  # whether it differs from run to run
    # multiples of `start`, and other numbers, at which its responses span all
    sizes: Sequence[float] = (1.0,)
    spread_at: Mapping[str, Sequence[float]] = field(default_factory=dict)
    # what the package calls its weights; see the table
    same: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    needs: str = ''  # what a recording must have for it to act or to show
    at_rest: bool = False  # whether a calibration at rest takes a part of it up

    def _count(self, unit: Unit) -> int:
        return self.fixed or self.each * len(unit.axes)

    def draw(self, rng: np.random.Generator, unit: Unit) -> Shape:
        """Draw the shape of a fault of a unit."""
        count = self._count(unit)
        shape: Shape = {'w': self.weigh(rng, count)} if count else {}
        shape |= {name: float(rng.uniform(*limits)) for name, limits in self.bounds.items()}
        shape |= {name: float(rng.choice(values)) for name, values in self.choices.items()}
        return shape

    def spread(self, unit: Unit) -> list[Shape]:
        """Return shapes whose responses span all its responses."""
        count = self._count(unit)
        rows = np.ones((1, count)) if self.per_axis else np.eye(count)
        shapes: list[Shape] = [{'w': row} for row in rows if count] or [{}]
        return [
            {**shape, **dict(zip(self.spread_at, numbers))}
            for shape in shapes
            for numbers in product(*self.spread_at.values())
        ]


def load_kinds(table: str, functions: Mapping[str, Any]) -> tuple[dict[str, Kind], ...]:
    """Return the listed and the unlisted faults of a table, whose functions have their names."""
    named = {**globals(), **functions}

    def kind(
        name: str, law: str = '', place: str = 'element', weigh: str = 'weights', **numbers: Any
    ) -> Kind:
        act = named[law](named[name]) if law else named[name]
        return Kind(name, act, place=Place[place.upper()], weigh=named[weigh], **numbers)

    parts = yaml.safe_load((Path(__file__).parents[1] / table).read_text(encoding='utf-8'))
    return tuple(
        {name: kind(name, **row) for name, row in parts[part].items()}
        for part in ('listed', 'unlisted')
    )


@dataclass(frozen=True)
class Fault:
    """One fault: its kind, its size in the unit of the kind, and its shape."""

    kind: Kind
    size: float
    shape: Shape


FINE_HZ = 2000.0
"""Lowest rate of the simulation, Hz; chosen. Each sample has a whole number of its steps."""
_COARSE_HZ = 400.0
"""Lowest rate of the simulation of responses, Hz; chosen: eight times the filter's corner."""
DIGITS = {'shift_m': 10, 'temperature_c': 3, 'supply_v': 5}
"""Digits of a column of a recording after the point; 7 without one."""


@dataclass(frozen=True)
class Scene:
    """A unit in a manoeuvre, with the seed of all random numbers; m axes, n samples."""

    unit: Unit
    manoeuvre: Manoeuvre
    seed: int

    def stamps(self) -> np.ndarray:
        """Return the stamps of the recording, s, (n,)."""
        return np.arange(int(self.manoeuvre.seconds * self.unit.rate_hz)) / self.unit.rate_hz

    def volts(
        self, faults: Sequence[Fault], *, noise: bool = True, fine_hz: float = FINE_HZ
    ) -> np.ndarray:
        """Simulate the recording's volts, (m, n)."""
        unit, sampled = self.unit, self.stamps()
        step = 1 / (unit.rate_hz * math.ceil(fine_hz / unit.rate_hz))
        # Late and early samples must lie within the grid.
        t = np.arange(-0.5, sampled[-1] + 1.0, step)
        joints = self.manoeuvre.joints(t)
        run = Run(
            unit,
            t,
            self.seed,
            joints['alpha'],
            joints['beta'],
            joints['shift'],
            *self.manoeuvre.climate(t),
            corner_hz=unit.corner_hz,
        )

        def act(place: Place) -> None:
            for fault in faults:
                if fault.kind.place is place:
                    fault.kind.act(run, fault.size, fault.shape)

        if noise:
            _stage_errors(run)
        act(Place.STAGE)
        run.force = _force(run)
        act(Place.MOUNT)
        run.u = (run.directions @ run.force)[unit.axis_indices] / G0
        act(Place.ELEMENT)
        run.volts = unit.zero_v[:, None] + unit.scale_v_per_g[:, None] * run.u
        act(Place.ELECTRONICS)
        if noise:
            run.volts += unit.scale_v_per_g[:, None] * _sensor_noise(run)
        run.volts = _one_pole(_one_pole(run.volts, run.corner_hz, step), run.second_hz, step)
        act(Place.WIRE)
        run.volts = scipy.interpolate.CubicSpline(t, run.volts, axis=1)(
            np.clip(sampled - run.late_s(sampled), t[0], t[-1])
        )
        run.t = sampled
        act(Place.SAMPLES)
        if noise:
            run.volts = np.clip(np.floor(run.volts / LSB_V), 0, 2**ADC_BITS - 1) * LSB_V
        return run.volts

    def response(self, faults: Sequence[Fault], coarse: bool = False) -> np.ndarray:
        """Return the change of the output by faults, m/s², (m, n)."""
        noise, fine_hz = any(f.kind.random for f in faults), _COARSE_HZ if coarse else FINE_HZ
        without = self._coarse_v if coarse and not noise else None
        if without is None:
            without = self.volts([], noise=noise, fine_hz=fine_hz)
        changed = self.volts(faults, noise=noise, fine_hz=fine_hz) - without
        return changed * self.unit.volts_to_mps2

    @cached_property
    def _coarse_v(self) -> np.ndarray:
        """Return the volts without faults and noise, V, (m, n)."""
        return self.volts([], noise=False, fine_hz=_COARSE_HZ)

    def force(self) -> np.ndarray:
        """Return the specific force along each axis without faults, m/s², (m, n)."""
        volts = self.volts([], noise=False)
        return (volts - self.unit.zero_v[:, None]) * self.unit.volts_to_mps2

    def gap(self, faults: Sequence[Fault]) -> np.ndarray:
        """Return the recording minus the stated nominal response, m/s², (m, n)."""
        volts = self.volts(faults) - self.unit.stated_zero_v[:, None]
        return volts * self.unit.volts_to_mps2 - self.force()

    def references(self) -> dict[str, np.ndarray]:
        """Return the other columns of the recording, by encoder, thermometer and voltmeter."""
        t, rng = self.stamps(), np.random.default_rng([self.seed, 77])
        joints, (temperature, supply) = self.manoeuvre.joints(t), self.manoeuvre.climate(t)
        step = self.unit.resolution_rad
        return {
            'alpha_rad': np.round(joints['alpha'] / step) * step,
            'beta_rad': np.round(joints['beta'] / step) * step,
            'shift_m': joints['shift'],
            'temperature_c': temperature + 0.006 * rng.normal(size=len(t)),
            'supply_v': supply + 1e-4 * rng.normal(size=len(t)),
        }

    def recording(self, faults: Sequence[Fault], digits: Mapping[str, int] = DIGITS) -> str:
        """Return the recording as CSV."""
        volts = {f'{axis}_v': row for axis, row in zip(self.unit.axes, self.volts(faults))}
        return csv_text({'time_s': self.stamps(), **volts, **self.references()}, digits)


def csv_text(columns: dict[str, np.ndarray], digits: Mapping[str, int]) -> str:
    """Return columns as CSV, each with as many digits in each recording; NaN is empty."""
    formats = ','.join(f'%.{digits.get(name, 7)}f' for name in columns)
    rows = np.stack(list(columns.values()), axis=1)
    return '\n'.join(
        [','.join(columns), *(formats % tuple(row) for row in rows.tolist()), '']
    ).replace('nan', '')


def _stage_errors(run: Run) -> None:
    """Add errors of the stage within its resolution, and of the encoder between its lines."""
    step, rng = run.unit.resolution_rad, run.random('encoder')
    for joint, (offset, sine, cosine) in zip(
        (run.alpha, run.beta), run.unit.stage_rad.reshape(2, 3)
    ):
        joint += (
            offset
            + sine * np.sin(joint)
            + cosine * np.cos(joint)
            + 0.15 * step * np.sin(2 * np.pi * joint / (37 * step) + rng.uniform(0, 2 * np.pi))
        )


def _rotate(run: Run, vector: np.ndarray) -> np.ndarray:
    """Rotate a vector of the base, (3,) or (3, n), into the sensor's frame, (3, n)."""
    ca, sa, cb, sb = np.cos(run.alpha), np.sin(run.alpha), np.cos(run.beta), np.sin(run.beta)
    x, y, z = vector
    x, z = ca * x + sa * z, -sa * x + ca * z
    return np.stack([cb * x + sb * y, -sb * x + cb * y, z])


def _force(run: Run) -> np.ndarray:
    force = run.gravity * _rotate(run, run.up)
    force[0] += _second_derivative(run.shift, run.dt)
    if run.arm.any():
        # The path of the sensor in the base is differentiated twice: no rotating frame is used.
        ca, sa, cb, sb = np.cos(run.alpha), np.sin(run.alpha), np.cos(run.beta), np.sin(run.beta)
        x, y = cb * run.arm[0] - sb * run.arm[1], sb * run.arm[0] + cb * run.arm[1]
        path = np.stack([ca * x - sa * run.arm[2], y, sa * x + ca * run.arm[2]])
        force += _rotate(run, _second_derivative(path, run.dt))
    return force


def _second_derivative(values: np.ndarray, dt: float) -> np.ndarray:
    """Differentiate twice to fourth order: second order lacks 0.3 % of a shaker's 20 Hz."""
    return scipy.ndimage.correlate1d(
        values, np.array([-1, 16, -30, 16, -1]) / (12 * dt * dt), axis=-1, mode='nearest'
    )


def _one_pole(values: np.ndarray, corner_hz: float, dt: float) -> np.ndarray:
    """Filter by one pole, exactly for inputs that are linear between steps."""
    if math.isinf(corner_hz):
        return values
    x = 2 * np.pi * corner_hz * dt
    keep = math.exp(-x)
    now, before = 1 - (1 - keep) / x, (1 - keep) / x - keep
    first = values[..., :1]
    return first + scipy.signal.lfilter([now, before], [1, -keep], values - first)


def _sensor_noise(run: Run) -> np.ndarray:
    unit, rng = run.unit, run.random('noise')
    white = (
        rng.normal(size=run.u.shape) * (unit.noise_g_per_rthz * math.sqrt(0.5 / run.dt))[:, None]
    )
    slow = np.arange(run.t[0], run.t[-1] + 0.2, 0.1)
    rng = run.random('drift')
    for row, walk, size in zip(white, unit.walk_g_per_rts, unit.flicker_g):
        drift = walk * math.sqrt(0.1) * np.cumsum(rng.normal(size=len(slow)))
        row += np.interp(run.t, slow, drift + size * pink_noise(slow, rng))
    return white
