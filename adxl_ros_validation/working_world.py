# SPDX-License-Identifier: Apache-2.0
"""
The world of the working cases: units, motion, noise and faults that are wrong in their own ways.

The chain is that of the blind check's simulator. Everything that a diagnosis could be tuned to is
different: the forms of the faults, those outside the library, the profiles of motion, the rates,
the axes and the noise. So the blind check stays blind to what is developed with these cases.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
import math

from adxl_ros_validation.blind.world.simulator import (
    Act,
    ADC_BITS,
    column,
    Fault,
    FaultKind,
    G0,
    low_pass,
    LSB_V,
    Place,
    render,
    Run,
    SCALE_STD,
    Shape,
    stamps,
    Unit,
    weights,
    ZERO_G_STD_G,
)
import numpy as np
import scipy

RATES_HZ = (50.0, 100.0, 200.0, 250.0, 400.0, 500.0, 1000.0)
SECONDS = (60.0, 200.0)
"""Shortest and longest recording, s."""
_MOST_SAMPLES = 120_000
_NOISE_OFF = (0.05, 0.2)
"""Smallest and largest share by which the noise is not the stated one."""
_OTHER = [1, 0, 0]
"""The other axis of the plane, of x, y and z."""


def draw_unit(rng: np.random.Generator) -> Unit:
    """Draw a unit whose noise is 5 to 20 % above or below the stated one."""
    axes = str(rng.choice(['x', 'xy', 'xyz'], p=(0.1, 0.35, 0.55)))
    n, rate = len(axes), float(rng.choice(RATES_HZ))
    zero, scale = 2.5 + 0.05 * rng.uniform(-1, 1, n), 1 + 0.03 * rng.uniform(-1, 1, n)
    stated = rng.uniform(60e-6, 250e-6) * rng.uniform(0.9, 1.1, n)
    off = 1 + rng.choice([-1, 1]) * rng.uniform(*_NOISE_OFF)
    resolution = math.radians(rng.choice([0.001, 0.005, 0.02]))
    return Unit(axes, zero, scale, zero + ZERO_G_STD_G * scale * rng.normal(size=n),
                scale * (1 + SCALE_STD * rng.normal(size=n)), off * stated, stated,
                rate / rng.uniform(2.0, 6.0), 10 ** rng.uniform(-6.3, -5.3, n),
                10 ** rng.uniform(-5.5, -4.8, n), resolution, np.zeros(6), rate)


@dataclass
class Moves:
    """Moves of both joints by one profile of velocity, and bursts of the shaker."""

    trapezoidal: bool
    alpha: float = math.pi / 2
    beta: float = 0.0
    seconds: float = 0.0
    kind: str = ''
    steps: list[tuple[str, float, float, float, float]] = field(default_factory=list)
    bursts: list[tuple[float, float, float, float, float]] = field(default_factory=list)
    heat: tuple[float, float, float] = (25.0, 0.0, 20.0)  # start and rise, °C; time constant, s
    sag: tuple[float, float] = (0.0, 1.0)  # size, V, and period, s, of the supply's steps

    def go(self, seconds: float, **to: float) -> None:
        """Move joints to where they should be, rad, at once."""
        for joint, value in to.items():
            self.steps.append((joint, self.seconds, seconds, getattr(self, joint), value))
            setattr(self, joint, value)
        self.seconds += seconds

    def shake(self, size: float, hertz: float, to_hertz: float, seconds: float) -> None:
        """Sweep the shaker from one frequency to another at a peak acceleration, m/s²."""
        self.bursts.append((self.seconds, seconds, size, hertz, to_hertz))
        self.seconds += seconds

    def joints(self, t: np.ndarray) -> dict[str, np.ndarray]:
        """Return alpha and beta (rad) and shift (m) at instants t (s)."""
        out = {'alpha': np.full_like(t, self._first('alpha')),
               'beta': np.full_like(t, self._first('beta')), 'shift': np.zeros_like(t)}
        for joint, start, seconds, begin, end in self.steps:
            a, b = np.searchsorted(t, [start, start + seconds])
            out[joint][a:b] += (end - begin) * self._share((t[a:b] - start) / seconds)
            out[joint][b:] += end - begin
        for start, seconds, size, low, high in self.bursts:
            a, b = np.searchsorted(t, [start, start + seconds])
            u = (t[a:b] - start) / seconds
            hertz = low + (high - low) * u
            phase = 2 * np.pi * seconds * (low * u + (high - low) * u * u / 2)
            fade = 0.5 - 0.5 * np.cos(np.pi * np.clip(np.minimum(u, 1 - u) / 0.15, 0, 1))
            out['shift'][a:b] += size * fade * np.sin(phase) / (2 * np.pi * hertz) ** 2
        return out

    def climate(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return temperature (°C) and supply (V) at instants t (s)."""
        start, rise, lag = self.heat
        on = np.clip(t - 0.15 * self.seconds, 0, None)
        off = np.clip(t - 0.6 * self.seconds, 0, None)
        warm = start + rise * (np.exp(-off / lag) - np.exp(-on / lag))
        return warm, 5.0 + self.sag[0] * np.tanh(4 * np.sin(2 * np.pi * t / self.sag[1]))

    def _first(self, joint: str) -> float:
        """Return where a joint is before its first move, rad."""
        return next((step[3] for step in self.steps if step[0] == joint), getattr(self, joint))

    def _share(self, u: np.ndarray) -> np.ndarray:
        """Return the share of a move that is done at a share of its time."""
        if not self.trapezoidal:
            return u - np.sin(2 * np.pi * u) / (2 * np.pi)
        ramp, edge = 0.2, np.minimum(u, 1 - u)
        part = np.where(edge < ramp, edge ** 2 / (2 * ramp), edge - ramp / 2) / (1 - ramp)
        return np.where(u < 0.5, part, 1 - part)


def draw_motion(rng: np.random.Generator, unit: Unit, needs: set[str]) -> Moves:
    """Draw a manoeuvre that has what some faults need: 'heat', 'supply', 'shake' or 'fast'."""
    moves = Moves(bool(rng.random() < 0.5))
    length = min(rng.uniform(*SECONDS), _MOST_SAMPLES / unit.rate_hz)
    moves.beta = rng.uniform(-3, 3)
    moves.go(2.0)
    blocks = ['planes', 'poses', 'fast', 'shake']
    if not needs and rng.random() < 0.2:
        blocks = [str(rng.choice(['planes', 'poses']))]
    moves.kind = '+'.join(blocks) if len(blocks) == 1 else 'mixed'
    while moves.seconds < length:
        for block in rng.permutation(blocks):
            _block(moves, str(block), rng, unit)
    moves.go(2.0)
    warm = 'heat' in needs or rng.random() < 0.5
    moves.heat = (rng.uniform(20, 28), rng.uniform(6, 20) * warm, rng.uniform(8, 30))
    moves.sag = (rng.uniform(0.02, 0.08) * ('supply' in needs or rng.random() < 0.4),
                 rng.uniform(17, 50))
    return moves


def _block(moves: Moves, block: str, rng: np.random.Generator, unit: Unit) -> None:
    """Add some moves of one sort, 15 to 40 s."""
    if block == 'planes':
        moves.go(2.0, alpha=math.radians(rng.uniform(20, 160)))
        step, speed = rng.uniform(0.5, 1.2), rng.uniform(0.4, 1.5)
        for sign in [1] * 5 + [-1] * 5:
            moves.go(step / speed, beta=moves.beta + sign * step)
            moves.go(rng.uniform(0.5, 1.5))
    elif block == 'poses':
        for _ in range(6):
            moves.go(rng.uniform(1.5, 4), alpha=math.acos(rng.uniform(-0.98, 0.98)),
                     beta=moves.beta + rng.uniform(-2, 2))
            moves.go(rng.uniform(0.8, 2.5))
    elif block == 'fast':
        for i in range(8):
            turn = rng.uniform(0.8, 1.6)
            moves.go(turn / rng.uniform(2, 4), beta=moves.beta + turn * (-1) ** i)
            moves.go(rng.uniform(0.2, 0.5))
        moves.go(1.0, alpha=math.radians(rng.uniform(40, 140)))
    else:
        low, high = 2.0, min(20.0, unit.rate_hz / 12)
        for _ in range(2):
            moves.shake(rng.uniform(1, 4), rng.uniform(low, high), rng.uniform(low, high),
                        rng.uniform(5, 9))
            moves.go(0.5)


def recalibrated(unit: Unit, faults: list[Fault]) -> Unit:
    """Calibrate zero-g and scale factor of a unit that has faults at rest by a straight line."""
    moves = Moves(True)
    ends = []
    for alpha in (90, 45, 135):
        for beta in range(0, 360, 30):
            moves.go(0.4, alpha=math.radians(alpha), beta=math.radians(beta))
            moves.go(0.6)
            ends.append(moves.seconds)
    still = replace(unit, rate_hz=50.0)
    with_faults, without = (render(still, moves, acting, 0, noise=False, fine_hz=200.0)
                            for acting in (faults, []))
    t = stamps(still, moves)
    rest = np.any([(t > end - 0.2) & (t < end) for end in ends], axis=0)
    zero, scale = unit.stated_zero_v.copy(), unit.stated_scale_v_per_g.copy()
    for d in range(len(unit.axes)):
        u = (without[d, rest] - unit.zero_v[d]) / unit.scale_v_per_g[d]
        line = np.column_stack([np.ones_like(u), u])
        change = np.linalg.lstsq(line, (with_faults - without)[d, rest], rcond=None)[0]
        zero[d] += change[0]
        scale[d] += change[1]
    return replace(unit, stated_zero_v=zero, stated_scale_v_per_g=scale)


def _stage_offset(run: Run, size: float, shape: Shape) -> None:
    run.alpha += size * shape['w'][0]
    run.beta += size * shape['w'][1]


def _stage_eccentricity(run: Run, size: float, shape: Shape) -> None:
    """Add harmonics 1, 2 and 4 of the angle to both joints, rad."""
    for joint, (s, c) in ((run.alpha, shape['w'][:2]), (run.beta, shape['w'][2:])):
        q = joint.copy()
        for k, part in ((1, 1.0), (2, shape['second']), (4, 0.04)):
            joint += part * size * (s * np.sin(k * q) + c * np.cos(k * q))


def _play(run: Run, x: np.ndarray, reach: float) -> np.ndarray:
    """Follow with a dead band of half width `reach`, on a grid of 4 ms."""
    every, y, out = max(int(0.004 / run.dt), 1), float(x[0]), []
    for value in x[::every].tolist():
        y = min(max(y, value - reach), value + reach)
        out.append(y)
    return np.interp(run.t, run.t[::every], out)


def _backlash(run: Run, size: float, shape: Shape) -> None:
    """Follow by three dead bands of different widths, rad, as flanks that yield."""
    for joint, w in ((run.alpha, shape['w'][0]), (run.beta, shape['w'][1])):
        if w:
            joint[:] = np.mean([_play(run, joint, part * abs(size * w) / 2)
                                for part in (0.5, 0.9, 1.3)], axis=0)


def _base_tilt(run: Run, size: float, shape: Shape) -> None:
    x, y = np.sin(size * np.asarray(shape['w']))
    run.up = np.array([x, y, math.sqrt(1 - x * x - y * y)])


def _gravity(run: Run, size: float, shape: Shape) -> None:
    run.gravity = G0 + size * shape['w'][0]


def _lever_arm(run: Run, size: float, shape: Shape) -> None:
    run.arm = size * np.asarray(shape['w'])


def _late(run: Run, late_s: np.ndarray | float) -> None:
    """Read the output some seconds late."""
    run.volts = np.stack([np.interp(run.t - late_s, run.t, row) for row in run.volts])


def _time_offset(run: Run, size: float, shape: Shape) -> None:
    _late(run, size * shape['w'][0])


def _clock_skew(run: Run, size: float, shape: Shape) -> None:
    """Drift by `size` s/s, growing by some percent over the minutes."""
    _late(run, size * shape['w'][0] * run.t * (1 + shape['growth'] * run.t / 600))


def _mount_resonance(run: Run, size: float, shape: Shape) -> None:
    """Transmit a share of the force by two modes."""
    force = run.force.copy()
    for ratio, part in ((1.0, 1.0), (2.2, 0.2)):
        w0 = 2 * np.pi * shape['hertz'] * ratio
        b, a = scipy.signal.bilinear([w0 * w0], [1, 2 * shape['damping'] * w0, w0 * w0],
                                     1 / run.dt)
        moved = scipy.signal.lfilter(b, a, force - force[:, :1]) + force[:, :1]
        run.force += size * part * (moved - force)


def _misalignment(run: Run, size: float, shape: Shape) -> None:
    turn = size * np.asarray(shape['w']).reshape(-1, 3)
    for d, angles in zip(run.unit.axis_indices, turn):
        run.directions[d] = scipy.spatial.transform.Rotation.from_rotvec(angles).apply(
            run.directions[d])
    run.u = (run.directions @ run.force)[run.unit.axis_indices] / G0


def _other(run: Run) -> np.ndarray:
    """Return the other axis of the plane of each measured axis, g, (m, n)."""
    return run.force[[_OTHER[d] for d in run.unit.axis_indices]] / G0


def _cross_axis(run: Run, size: float, shape: Shape) -> None:
    c = _other(run)
    run.u += size * column(shape) * (c * c * (1 - 0.3 * c * c) + shape['odd'] * c)


def _cross_axis_z(run: Run, size: float, shape: Shape) -> None:
    c = run.force[2] / G0
    run.u[:2] += size * column(shape)[:2] * (np.log(np.cosh(1.5 * c)) + shape['odd'] * c)


def _scale_factor_cross(run: Run, size: float, shape: Shape) -> None:
    run.u *= 1 + size * column(shape) * np.tanh(1.2 * _other(run))


def _scale_factor_z(run: Run, size: float, shape: Shape) -> None:
    c = run.force[2] / G0
    run.u[:2] *= 1 + size * column(shape)[:2] * (np.tanh(1.2 * c + 0.4) - np.tanh(0.4))


def _nonlinearity(run: Run, size: float, shape: Shape) -> None:
    """Soften by the arc tangent, g."""
    run.u += size * column(shape) * (np.arctan(shape['bend'] * run.u) / shape['bend'] - run.u)


def _quadratic(run: Run, size: float, shape: Shape) -> None:
    run.u += size * column(shape) * np.abs(run.u) ** shape['power']


def _hysteresis(run: Run, size: float, shape: Shape) -> None:
    """Lag by stops of uneven thresholds and weights, more at positive force, g."""
    for row, w in zip(run.u, shape['w']):
        if w:
            lag = sum(part * (row - _play(run, row, reach * shape['reach'])) / (
                reach * shape['reach']) for reach, part in ((0.15, 0.5), (0.45, 0.2), (1.4, 0.3)))
            row -= size * w * lag * (1 + shape['skew'] * row)


def _saturation(run: Run, size: float, shape: Shape) -> None:
    """Approach a rail exponentially beyond a knee; the two rails differ by some percent."""
    knee = shape['knee']
    for row, w in zip(run.u, shape['w']):
        for sign, ratio in ((1.0, 1.0), (-1.0, shape['lower'])) if w else ():
            over = np.maximum(sign * row - ((1.5 - size) * ratio - knee), 0.0)
            row -= sign * (over + knee * np.expm1(-over / knee))


def _temperature_bias(run: Run, size: float, shape: Shape) -> None:
    """Shift zero-g by a cubic law of a die that follows the thermometer late, g."""
    warm = low_pass(run.temperature - 25, shape['late_s'], run.dt)
    run.u += size * column(shape) * warm * (1 + shape['bend'] * warm * (1 + 0.02 * warm)) / 10


def _temperature_scale(run: Run, size: float, shape: Shape) -> None:
    warm = low_pass(run.temperature - 25, shape['late_s'], run.dt)
    run.u *= 1 + size * column(shape) * warm * (1 + shape['bend'] * warm) / 10


def _warm_up(run: Run, size: float, shape: Shape) -> None:
    """Settle by two time constants, or by a hyperbola, g."""
    t = np.clip(run.t, 0, None) / shape['tau_s']
    run.u += size * column(shape) * (0.65 * np.exp(-t) + 0.35 * np.exp(-t / 4)
                                     if shape['law'] < 0.5 else 1 / (1 + t))


def _vibration_rectification(run: Run, size: float, shape: Shape) -> None:
    moving = np.abs(run.u - low_pass(run.u, 0.25, run.dt)) ** shape['power']
    run.u += size * column(shape) * low_pass(moving, 0.8, run.dt)


def _bias(run: Run, size: float, shape: Shape) -> None:
    run.volts += size * column(shape) * run.unit.scale_v_per_g[:, None]


def _scale_factor(run: Run, size: float, shape: Shape) -> None:
    run.u *= 1 + size * column(shape)


def _supply(run: Run, size: float, shape: Shape) -> None:
    """Follow the supply with a square, behind a capacitor."""
    change = low_pass(run.supply / 5 - 1, shape['late_s'], run.dt)
    run.volts *= 1 + size * column(shape) * change * (1 + shape['bend'] * change)


def _bandwidth(run: Run, size: float, shape: Shape) -> None:
    run.corner_hz *= math.exp(-size)
    run.second_hz = run.corner_hz / shape['second']


def _add(run: Run, size: float, shape: Shape, law: np.ndarray) -> None:
    """Add a law, (n,) or (m, n), to the output of each axis by its weight, g."""
    run.volts += size * column(shape) * law * run.unit.scale_v_per_g[:, None]


def _unit_rms(rows: np.ndarray) -> np.ndarray:
    return rows / np.maximum(rows.std(axis=-1, keepdims=True), 1e-12)


def _noise_excess(run: Run, size: float, shape: Shape) -> None:
    """Add noise of heavy tails behind the filter, g rms."""
    drawn = run.random('tails').standard_t(shape['tails'], run.volts.shape)
    _add(run, size, shape, _unit_rms(low_pass(drawn, 0.004, run.dt)))


def _colour(run: Run, size: float, shape: Shape) -> None:
    """Add slow Gaussian noise, g rms: no unit is quite white."""
    drawn = run.random('colour').normal(size=run.volts.shape)
    _add(run, size, shape, _unit_rms(low_pass(drawn, shape['lag_s'], run.dt)))


def _flicker(run: Run, size: float, shape: Shape) -> None:
    """Add noise whose density falls with another power of the frequency, g rms."""
    drawn = np.fft.rfft(run.random('flicker').normal(size=run.volts.shape))
    ratio = np.maximum(np.arange(drawn.shape[1]), 1.0) ** (-shape['power'] / 2)
    ratio[0] = 0
    _add(run, size, shape, _unit_rms(np.fft.irfft(drawn * ratio, run.volts.shape[1])))


def _bias_walk(run: Run, size: float, shape: Shape) -> None:
    """Add a walk whose power changes from part to part, g rms."""
    rng, n = run.random('walk'), len(run.t)
    power = np.interp(np.linspace(0, 7, n), np.arange(8), np.exp(shape['uneven'] * rng.normal(
        size=8)))
    _add(run, size, shape, _unit_rms(np.cumsum(power * rng.normal(size=run.volts.shape), axis=1)))


def _mains_hum(run: Run, size: float, shape: Shape) -> None:
    """Add hum, V, off its nominal frequency, with the harmonics of a rectifier."""
    phase = 2 * np.pi * (shape['mains'] + shape['off']) * run.t + shape['phase']
    _add(run, size, shape, np.sin(phase) + shape['second'] * np.sin(2 * phase)
         + 0.15 * np.sin(5 * phase))


def _spikes(run: Run, size: float, shape: Shape) -> None:
    """Add spikes of exponential height, most of one sign, V."""
    rng, like = run.random('spikes'), run.volts.shape
    hit = rng.random(like) < shape['rate_hz'] * run.dt
    sign = np.where(rng.random(like) < shape['up'], 1.0, -1.0)
    run.volts += size * np.abs(column(shape)) * hit * sign * (0.4 + 0.6 * rng.exponential(
        size=like))


def _stuck(run: Run, size: float, shape: Shape) -> None:
    """Hold all axes for `size` s, more or less by a half."""
    rng = run.random('stuck')
    for start in np.flatnonzero(rng.random(len(run.t)) < shape['rate_hz'] * run.dt):
        held = max(int(size * rng.uniform(0.5, 1.5) / run.dt), 1)
        run.volts[:, start:start + held + 1] = run.volts[:, start:start + 1]


def _quantisation(run: Run, size: float, shape: Shape) -> None:
    """Lose low bits by rounding or by cutting off; single axes may lose none."""
    step = LSB_V * 2.0 ** round(math.log2(1 + size / LSB_V))
    rounded = np.floor if shape['cut'] > 0.5 else np.rint
    for d, w in enumerate(shape['w']):
        if w:
            run.volts[d] = rounded(run.volts[d] / step) * step


def _adc_inl(run: Run, size: float, shape: Shape) -> None:
    """Bend the converter, V: some wrong bits, two sines, or a bow."""
    share, (law, phase, cycles, *bits) = run.volts / (LSB_V * 2 ** ADC_BITS), shape['curve']
    if law < 0.5:
        run.volts += size * sum((bit > 0.5) * (np.floor(share * 2 ** (i + 1)) % 2 - 0.5)
                                for i, bit in enumerate(bits))
    elif law < 0.85:
        angle = 2 * np.pi * 2 * 15 ** cycles * share
        run.volts += size * (np.sin(angle + 6 * phase) + 0.4 * np.sin(2.6 * angle))
    else:
        x = 4 * (share - 0.5)
        run.volts += size * (x - x ** 3 + 0.5 * x ** 5)


def _beat(run: Run, size: float, shape: Shape) -> None:
    """Add a slow sine in time, g, as of a radio carrier that beats with the clock."""
    _add(run, size, shape, np.sin(2 * np.pi * run.t / shape['period_s'] + shape['phase']))


def _ripple(run: Run, size: float, shape: Shape) -> None:
    """Add a ripple over the axis's own force, g, as of a servo loop with a limit cycle."""
    run.u += size * column(shape) * np.sin(2 * np.pi * run.u / shape['period_g'] + shape['phase'])


def _turning(run: Run) -> np.ndarray:
    """Return how fast the joints turn, 0 to 1, (n,)."""
    rate = np.hypot(np.gradient(run.alpha, run.dt), np.gradient(run.beta, run.dt))
    return 1 - np.exp(-(rate / 0.3) ** 2)


def _motion_lag(run: Run, size: float, shape: Shape) -> None:
    """Shift zero-g while and after a joint turns, g: current of a motor, charge of a mass."""
    _add(run, size, shape, low_pass(_turning(run), shape['late_s'], run.dt))


def _magnet(run: Run, size: float, shape: Shape) -> None:
    """Shift zero-g by the direction in the room, g, beyond its first harmonics."""
    _add(run, size, shape, np.sin(3 * run.beta + shape['phase']) * (
        1 + 0.5 * np.cos(2 * run.alpha)))


def _two_levels(run: Run, size: float, shape: Shape) -> None:
    """Switch zero-g between two levels at uneven times, g, as popcorn noise does."""
    phase = 2 * np.pi * run.t / shape['period_s'] + shape['phase']
    _add(run, size, shape, np.where(np.sin(phase) + 0.7 * np.sin(2.718 * phase) > 0.4, 1.0, 0.0))


def _fading_gain(run: Run, size: float, shape: Shape) -> None:
    """Change the scale factor with time, as leakage into a reference does."""
    run.u *= 1 + size * column(shape) * run.t / 100


def _draw(count: int | None, positive: bool, bounds: dict[str, tuple[float, float]],
          rng: np.random.Generator, unit: Unit) -> Shape:
    """Draw weights, of the axes where no count is given, and a number within each bound."""
    w = weights(count or len(unit.axes), rng)
    return {'w': np.abs(w) if positive else w,
            **{name: float(rng.uniform(*pair)) for name, pair in bounds.items()}}


@dataclass(frozen=True)
class Kind(FaultKind):
    """A kind of fault of this world."""

    needs: str = ''  # what the manoeuvre must have for it to show
    at_rest: bool = False  # whether a calibration at rest takes a part of it up


def _kind(name: str, place: Place, act: Act, start: float, largest: float, *,
          count: int | None = None, positive: bool = False, needs: str = '',
          at_rest: bool = False, random: bool = False, listed: bool = True,
          **bounds: tuple[float, float]) -> Kind:
    return Kind(name, place, act, partial(_draw, count, positive, bounds), lambda unit: [],
                start, largest, random=random, in_library=listed, needs=needs, at_rest=at_rest)


def _draw_turns(rng: np.random.Generator, unit: Unit) -> Shape:
    return {'w': rng.normal(size=3 * len(unit.axes))}


def _draw_curve(rng: np.random.Generator, unit: Unit) -> Shape:
    return {'curve': rng.random(9)}


def _draw_mains(rng: np.random.Generator, unit: Unit) -> Shape:
    return {**_draw(None, False, {'off': (-0.03, 0.03), 'phase': _PHASE, 'second': (0.0, 0.3)},
                    rng, unit), 'mains': float(rng.choice([50.0, 60.0]))}


_PHASE = (0.0, 2 * math.pi)
_STAGE, _MOUNT, _ELEMENT = Place.STAGE, Place.MOUNT, Place.ELEMENT
_VOLTS, _WIRE, _SAMPLES = Place.ELECTRONICS, Place.WIRE, Place.SAMPLES
KINDS = {kind.name: kind for kind in (
    _kind('bias', _VOLTS, _bias, 2e-3, 0.1),
    _kind('scale_factor', _ELEMENT, _scale_factor, 3e-3, 0.1),
    _kind('gravity', _STAGE, _gravity, 0.02, 0.09, count=1, at_rest=True),
    _kind('base_tilt', _STAGE, _base_tilt, 2e-3, 0.05, count=2, at_rest=True),
    _kind('stage_offset', _STAGE, _stage_offset, 2e-3, 0.05, count=2, at_rest=True),
    _kind('stage_eccentricity', _STAGE, _stage_eccentricity, 2e-3, 0.05, count=4, at_rest=True,
          second=(-0.15, 0.15)),
    _kind('backlash', _STAGE, _backlash, 4e-3, 0.05, count=2, positive=True),
    _kind('lever_arm', _STAGE, _lever_arm, 0.02, 0.5, count=3, needs='fast'),
    _kind('time_offset', _WIRE, _time_offset, 5e-3, 0.2, count=1, needs='fast'),
    _kind('clock_skew', _WIRE, _clock_skew, 5e-5, 2e-3, count=1, needs='fast',
          growth=(-0.1, 0.1)),
    replace(_kind('misalignment', _ELEMENT, _misalignment, 3e-3, 0.05, at_rest=True),
            draw=_draw_turns),
    _kind('mount_resonance', _MOUNT, _mount_resonance, 0.3, 1.0, needs='shake',
          hertz=(12.0, 45.0), damping=(0.03, 0.12)),
    _kind('cross_axis', _ELEMENT, _cross_axis, 3e-3, 0.1, at_rest=True, odd=(-0.5, 0.5)),
    _kind('cross_axis_z', _ELEMENT, _cross_axis_z, 3e-3, 0.1, at_rest=True, odd=(-0.5, 0.5)),
    _kind('scale_factor_cross', _ELEMENT, _scale_factor_cross, 5e-3, 0.1, at_rest=True),
    _kind('scale_factor_z', _ELEMENT, _scale_factor_z, 5e-3, 0.1, at_rest=True),
    _kind('nonlinearity', _ELEMENT, _nonlinearity, 0.02, 0.5, at_rest=True, bend=(0.6, 1.2)),
    _kind('quadratic', _ELEMENT, _quadratic, 5e-3, 0.1, at_rest=True, power=(1.5, 2.5)),
    _kind('hysteresis', _ELEMENT, _hysteresis, 4e-3, 0.05, reach=(0.08, 0.5), skew=(-0.3, 0.3)),
    _kind('vibration_rectification', _ELEMENT, _vibration_rectification, 0.3, 30.0,
          needs='shake', power=(1.7, 2.4)),
    _kind('saturation', _ELEMENT, _saturation, 0.6, 1.2, positive=True, at_rest=True,
          knee=(0.005, 0.05), lower=(0.96, 1.04)),
    _kind('temperature_bias', _ELEMENT, _temperature_bias, 3e-3, 0.1, needs='heat',
          bend=(-0.03, 0.03), late_s=(0.5, 6.0)),
    _kind('temperature_scale', _ELEMENT, _temperature_scale, 5e-3, 0.2, needs='heat',
          bend=(-0.03, 0.03), late_s=(0.5, 6.0)),
    _kind('warm_up', _ELEMENT, _warm_up, 5e-3, 0.1, tau_s=(20.0, 150.0), law=(0.0, 1.0)),
    _kind('supply', _VOLTS, _supply, 0.3, 3.0, needs='supply', late_s=(0.05, 0.5),
          bend=(-3.0, 3.0)),
    _kind('bandwidth', _VOLTS, _bandwidth, 0.3, 1.5, needs='shake', second=(0.02, 0.1)),
    _kind('noise_excess', _WIRE, _noise_excess, 2e-3, 0.05, random=True, tails=(3.5, 30.0)),
    _kind('flicker', _WIRE, _flicker, 2e-3, 0.05, random=True, power=(0.85, 1.25)),
    _kind('bias_walk', _WIRE, _bias_walk, 2e-3, 0.05, random=True, uneven=(0.0, 0.7)),
    replace(_kind('mains_hum', _WIRE, _mains_hum, 3e-3, 0.1, random=True), draw=_draw_mains),
    _kind('spikes', _SAMPLES, _spikes, 0.1, 2.0, random=True, rate_hz=(0.05, 0.5),
          up=(0.3, 1.0)),
    _kind('stuck', _SAMPLES, _stuck, 0.1, 2.0, random=True, rate_hz=(0.03, 0.2)),
    _kind('quantisation', _SAMPLES, _quantisation, 5e-3, 0.1, random=True, cut=(0.0, 1.0)),
    replace(_kind('adc_inl', _SAMPLES, _adc_inl, 3e-3, 0.05, at_rest=True), draw=_draw_curve),
    _kind('beat', _VOLTS, _beat, 3e-3, 0.1, listed=False, period_s=(6.0, 40.0), phase=_PHASE),
    _kind('ripple', _ELEMENT, _ripple, 3e-3, 0.1, listed=False, period_g=(0.2, 0.5),
          phase=_PHASE),
    _kind('aftermath', _VOLTS, _motion_lag, 3e-3, 0.1, listed=False, needs='fast',
          late_s=(4.0, 15.0)),
    _kind('motor_current', _VOLTS, _motion_lag, 3e-3, 0.1, listed=False, needs='fast',
          late_s=(0.03, 0.1)),
    _kind('magnet', _VOLTS, _magnet, 3e-3, 0.1, listed=False, phase=_PHASE),
    _kind('two_levels', _VOLTS, _two_levels, 3e-3, 0.1, listed=False, period_s=(15.0, 60.0),
          phase=_PHASE),
    _kind('fading_gain', _ELEMENT, _fading_gain, 3e-3, 0.1, listed=False),
)}
"""All kinds by name; the order is part of a seed."""
COLOUR = _kind('colour', _VOLTS, _colour, 1e-4, 1e-2, random=True, lag_s=(0.02, 0.3))
"""What every recording has: noise that is not quite white."""
LISTED = tuple(name for name, kind in KINDS.items() if kind.in_library)
UNLISTED = tuple(name for name, kind in KINDS.items() if not kind.in_library)
