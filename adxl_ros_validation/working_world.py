# SPDX-License-Identifier: Apache-2.0
"""
The world of the working cases: units, motion, noise and faults that are wrong in their own ways.

The chain is that of the blind check's simulator. Everything that a diagnosis could be tuned to is
different: the forms of the faults, those outside the library, the profiles of motion, the rates,
the axes and the noise. So the blind check stays blind to what is developed with these cases.
working_faults.yaml says how each fault acts, and its numbers.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
import math

from adxl_ros_validation.blind import faults, ideal_observer, simulator as sim
from adxl_ros_validation.blind.motion import low_pass, Manoeuvre
from adxl_ros_validation.blind.simulator import Fault, G0, Kind, Place, Run, Scene, Shape, Unit
import numpy as np
import scipy

_PLANE = np.array([[1.0], [1.0], [0.0]])
"""Weights of the axes of the plane."""


def draw_unit(rng: np.random.Generator) -> Unit:
    """Draw a unit whose noise is 5 to 20 % above or below the stated one."""
    axes = str(rng.choice(['x', 'xy', 'xyz'], p=(0.1, 0.35, 0.55)))
    n, rate = len(axes), float(rng.choice([50, 100, 200, 250, 400, 500, 1000]))
    zero, scale = 2.5 + 0.05 * rng.uniform(-1, 1, n), 1 + 0.03 * rng.uniform(-1, 1, n)
    stated = rng.uniform(60e-6, 250e-6) * rng.uniform(0.9, 1.1, n)
    off = 1 + rng.choice([-1, 1]) * rng.uniform(0.05, 0.2)
    resolution = math.radians(rng.choice([0.001, 0.005, 0.02]))
    return Unit(
        axes,
        zero,
        scale,
        zero + sim.ZERO_G_STD_G * scale * rng.normal(size=n),
        scale * (1 + sim.SCALE_STD * rng.normal(size=n)),
        off * stated,
        stated,
        rate / rng.uniform(2.0, 6.0),
        10 ** rng.uniform(-6.3, -5.3, n),
        10 ** rng.uniform(-5.5, -4.8, n),
        resolution,
        np.zeros(6),
        rate,
    )


def trapezoidal(u: np.ndarray) -> np.ndarray:
    """Return the share of a move whose velocity is a trapezium."""
    ramp, edge = 0.2, np.minimum(u, 1 - u)
    part = np.where(edge < ramp, edge**2 / (2 * ramp), edge - ramp / 2) / (1 - ramp)
    return np.where(u < 0.5, part, 1 - part)


def cycloidal(u: np.ndarray) -> np.ndarray:
    """Return the share of a move whose velocity is a raised cosine."""
    return u - np.sin(2 * np.pi * u) / (2 * np.pi)


def _fade(u: np.ndarray) -> np.ndarray:
    return 0.5 - 0.5 * np.cos(np.pi * np.clip(np.minimum(u, 1 - u) / 0.15, 0, 1))


def draw_motion(rng: np.random.Generator, unit: Unit, needs: set[str]) -> Manoeuvre:
    """
    Draw a manoeuvre that has what some faults need: 'heat', 'supply', 'shake' or 'fast'.

    It takes 60 to 200 s, and has 120 000 samples at most.
    """
    script = Manoeuvre(share=trapezoidal if rng.random() < 0.5 else cycloidal, fade=_fade)
    length = min(rng.uniform(60, 200), 120_000 / unit.rate_hz)
    script.beta[0] = rng.uniform(-3, 3)
    script.rest(2.0)
    blocks = ['planes', 'poses', 'fast', 'shake']
    if not needs and rng.random() < 0.2:
        blocks = [str(rng.choice(['planes', 'poses']))]
    while script.seconds < length:
        for block in rng.permutation(blocks):
            _block(script, str(block), rng, unit)
    script.rest(2.0)
    warm = 'heat' in needs or rng.random() < 0.5
    heat = (rng.uniform(20, 28), rng.uniform(6, 20) * warm, rng.uniform(8, 30))
    sag = (
        rng.uniform(0.02, 0.08) * ('supply' in needs or rng.random() < 0.4),
        rng.uniform(17, 50),
    )
    script.kind = blocks[0] if len(blocks) == 1 else 'mixed'
    script.climate = partial(_climate, script.seconds, heat, sag)
    return script


def _block(script: Manoeuvre, block: str, rng: np.random.Generator, unit: Unit) -> None:
    """Add some moves of one sort, 15 to 40 s."""
    if block == 'planes':
        script.go(seconds=2.0, alpha=math.radians(rng.uniform(20, 160)))
        step, speed = rng.uniform(0.5, 1.2), rng.uniform(0.4, 1.5)
        for sign in [1] * 5 + [-1] * 5:
            script.go(seconds=step / speed, beta=script.beta[-1] + sign * step)
            script.rest(rng.uniform(0.5, 1.5))
    elif block == 'poses':
        for _ in range(6):
            script.go(
                seconds=rng.uniform(1.5, 4),
                alpha=math.acos(rng.uniform(-0.98, 0.98)),
                beta=script.beta[-1] + rng.uniform(-2, 2),
            )
            script.rest(rng.uniform(0.8, 2.5))
    elif block == 'fast':
        for i in range(8):
            turn = rng.uniform(0.8, 1.6)
            script.go(seconds=turn / rng.uniform(2, 4), beta=script.beta[-1] + turn * (-1) ** i)
            script.rest(rng.uniform(0.2, 0.5))
        script.go(seconds=1.0, alpha=math.radians(rng.uniform(40, 140)))
    else:
        low, high = 2.0, min(20.0, unit.rate_hz / 12)
        for _ in range(2):
            peak_mps2, first_hz = rng.uniform(1, 4), rng.uniform(low, high)
            last_hz = rng.uniform(low, high)
            script.swing(
                'shift',
                peak_mps2 / (2 * np.pi * first_hz) ** 2,
                first_hz,
                rng.uniform(5, 9),
                last_hz,
            )
            script.rest(0.5)


def _climate(
    seconds: float, heat: tuple[float, float, float], sag: tuple[float, float], t: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return temperature, °C, and supply, V: a heater goes on and off, a load switches."""
    start_c, rise_c, lag_s = heat
    on, off = (np.clip(t - part * seconds, 0, None) for part in (0.15, 0.6))
    warm = start_c + rise_c * (np.exp(-off / lag_s) - np.exp(-on / lag_s))
    return warm, 5.0 + sag[0] * np.tanh(4 * np.sin(2 * np.pi * t / sag[1]))


def recalibrated(unit: Unit, acting: list[Fault]) -> Unit:
    """Calibrate zero-g and scale factor of a unit that has faults at rest by a straight line."""
    script = Manoeuvre('rests', share=trapezoidal)
    ends = []
    for alpha in (90, 45, 135):
        for beta in range(0, 360, 30):
            script.go(math.radians(alpha), math.radians(beta), 0.4)
            script.rest(0.6)
            ends.append(script.seconds)
    still = replace(unit, rate_hz=50.0)
    scene = Scene(still, script, 0)
    with_faults, without = (scene.volts(kept, noise=False, fine_hz=200.0) for kept in (acting, []))
    t = scene.stamps()
    rest = np.any([(t > end - 0.2) & (t < end) for end in ends], axis=0)
    u = (without - unit.zero_v[:, None]) / unit.scale_v_per_g[:, None]
    zero, scale = np.transpose(
        [
            ideal_observer.line(along[rest], change[rest])
            for along, change in zip(u, with_faults - without)
        ]
    )
    return replace(
        unit,
        stated_zero_v=unit.stated_zero_v + zero,
        stated_scale_v_per_g=unit.stated_scale_v_per_g + scale,
    )


bias = scale_factor = time_offset = sim.constant
stage_offset, lever_arm = faults.stage_offset, faults.lever_arm
standard_normal, uniform = np.random.Generator.standard_normal, np.random.Generator.random
"""What draws weights."""


def gravity(run: Run, size: float, shape: Shape) -> None:
    """Add to local gravity, m/s²."""
    run.gravity = G0 + size * shape['w'][0]


def base_tilt(run: Run, size: float, shape: Shape) -> None:
    """Tilt the base by two angles, rad."""
    x, y = np.sin(size * np.asarray(shape['w']))
    run.up = np.array([x, y, math.sqrt(1 - x * x - y * y)])


def stage_eccentricity(run: Run, size: float, shape: Shape) -> None:
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


def backlash(run: Run, size: float, shape: Shape) -> None:
    """Follow by three dead bands of different widths, rad, as flanks that yield."""
    for joint, w in ((run.alpha, shape['w'][0]), (run.beta, shape['w'][1])):
        if w:
            joint[:] = np.mean(
                [_play(run, joint, part * abs(size * w) / 2) for part in (0.5, 0.9, 1.3)], axis=0
            )


def late(law: sim.Law) -> sim.Act:
    """Read the output late by a law, s."""

    def act(run: Run, size: float, shape: Shape) -> None:
        late_s = size * shape['w'][0] * law(run, shape)
        run.volts = np.stack([np.interp(run.t - late_s, run.t, row) for row in run.volts])

    return act


def misalignment(run: Run, size: float, shape: Shape) -> None:
    """Turn each axis about three directions, rad."""
    turn = size * np.asarray(shape['w']).reshape(-1, 3)
    for d, angles in zip(run.unit.axis_indices, turn):
        run.directions[d] = scipy.spatial.transform.Rotation.from_rotvec(angles).apply(
            run.directions[d]
        )
    run.u = (run.directions @ run.force)[run.unit.axis_indices] / G0


def mount_resonance(run: Run, size: float, shape: Shape) -> None:
    """Transmit a share of the force by two modes."""
    force = run.force.copy()
    for ratio, part in ((1.0, 1.0), (2.2, 0.2)):
        w0 = 2 * np.pi * shape['hertz'] * ratio
        b, a = scipy.signal.bilinear(
            [w0 * w0], [1, 2 * shape['damping'] * w0, w0 * w0], 1 / run.dt
        )
        moved = scipy.signal.lfilter(b, a, force - force[:, :1]) + force[:, :1]
        run.force += size * part * (moved - force)


def _other(run: Run) -> np.ndarray:
    """Return the other axis of the plane of each measured axis, g, (m, n)."""
    return run.force[[(1, 0, 0)[d] for d in run.unit.axis_indices]] / G0


def cross_axis(run: Run, shape: Shape) -> np.ndarray:
    """Follow the other axis by an even law with an odd part."""
    c = _other(run)
    return c * c * (1 - 0.3 * c * c) + shape['odd'] * c


def cross_axis_z(run: Run, shape: Shape) -> np.ndarray:
    """Follow z by an even law with an odd part."""
    c = run.force[2] / G0
    return _PLANE[: len(run.u)] * (np.log(np.cosh(1.5 * c)) + shape['odd'] * c)


def hysteresis(run: Run, size: float, shape: Shape) -> None:
    """Lag by stops of uneven thresholds and weights, more at positive force, g."""
    for row, w in zip(run.u, shape['w']):
        if w:
            lag = sum(
                part * (row - _play(run, row, reach * shape['reach'])) / (reach * shape['reach'])
                for reach, part in ((0.15, 0.5), (0.45, 0.2), (1.4, 0.3))
            )
            row -= size * w * lag * (1 + shape['skew'] * row)


def vibration_rectification(run: Run, shape: Shape) -> np.ndarray:
    """Follow a power of the vibration."""
    moving = np.abs(run.u - low_pass(run.u, 0.25, run.dt)) ** shape['power']
    return low_pass(moving, 0.8, run.dt)


def saturation(run: Run, size: float, shape: Shape) -> None:
    """Approach a rail exponentially beyond a knee; the two rails differ by some percent."""
    knee = shape['knee']
    for row, w in zip(run.u, shape['w']):
        for sign, ratio in ((1.0, 1.0), (-1.0, shape['lower'])) if w else ():
            over = np.maximum(sign * row - ((1.5 - size) * ratio - knee), 0.0)
            row -= sign * (over + knee * np.expm1(-over / knee))


def _warm(run: Run, shape: Shape, cubic: float) -> np.ndarray:
    """Return a law of a die that follows the thermometer late, of 10 K."""
    warm = low_pass(run.temperature - 25, shape['late_s'], run.dt)
    return warm * (1 + shape['bend'] * warm * (1 + cubic * warm)) / 10


def warm_up(run: Run, shape: Shape) -> np.ndarray:
    """Settle by two time constants, or by a hyperbola."""
    t = np.clip(run.t, 0, None) / shape['tau_s']
    return 0.65 * np.exp(-t) + 0.35 * np.exp(-t / 4) if shape['law'] < 0.5 else 1 / (1 + t)


def supply(run: Run, size: float, shape: Shape) -> None:
    """Follow the supply with a square, behind a capacitor."""
    change = low_pass(run.supply / 5 - 1, shape['late_s'], run.dt)
    run.volts *= 1 + size * sim.column(shape) * change * (1 + shape['bend'] * change)


def bandwidth(run: Run, size: float, shape: Shape) -> None:
    """Lower the corner and add a second pole."""
    run.corner_hz *= math.exp(-size)
    run.second_hz = run.corner_hz / shape['second']


def _unit_rms(rows: np.ndarray) -> np.ndarray:
    return rows / np.maximum(rows.std(axis=-1, keepdims=True), 1e-12)


def noise_excess(run: Run, shape: Shape) -> np.ndarray:
    """Add noise of heavy tails behind the filter."""
    drawn = run.random('tails').standard_t(shape['tails'], run.volts.shape)
    return _unit_rms(low_pass(drawn, 0.004, run.dt))


def _colour(run: Run, shape: Shape) -> np.ndarray:
    """Add slow Gaussian noise: no unit is quite white."""
    drawn = run.random('colour').normal(size=run.volts.shape)
    return _unit_rms(low_pass(drawn, shape['lag_s'], run.dt))


def flicker(run: Run, shape: Shape) -> np.ndarray:
    """Add noise whose density falls with another power of the frequency."""
    drawn = np.fft.rfft(run.random('flicker').normal(size=run.volts.shape))
    ratio = np.maximum(np.arange(drawn.shape[1]), 1.0) ** (-shape['power'] / 2)
    ratio[0] = 0
    return _unit_rms(np.fft.irfft(drawn * ratio, run.volts.shape[1]))


def bias_walk(run: Run, shape: Shape) -> np.ndarray:
    """Add a walk whose power changes from part to part."""
    rng, n = run.random('walk'), len(run.t)
    power = np.interp(
        np.linspace(0, 7, n), np.arange(8), np.exp(shape['uneven'] * rng.normal(size=8))
    )
    return _unit_rms(np.cumsum(power * rng.normal(size=run.volts.shape), axis=1))


def mains_hum(run: Run, shape: Shape) -> np.ndarray:
    """Add hum off its nominal frequency, with the harmonics of a rectifier."""
    phase = 2 * np.pi * (shape['mains'] + shape['off']) * run.t + shape['phase']
    return np.sin(phase) + shape['second'] * np.sin(2 * phase) + 0.15 * np.sin(5 * phase)


def spikes(run: Run, size: float, shape: Shape) -> None:
    """Add spikes of exponential height, most of one sign, V."""
    rng, like = run.random('spikes'), run.volts.shape
    hit = rng.random(like) < shape['rate_hz'] * run.dt
    sign = np.where(rng.random(like) < shape['up'], 1.0, -1.0)
    run.volts += (
        size * np.abs(sim.column(shape)) * hit * sign * (0.4 + 0.6 * rng.exponential(size=like))
    )


def stuck(run: Run, size: float, shape: Shape) -> None:
    """Hold all axes for `size` s, more or less by a half."""
    rng = run.random('stuck')
    for start in np.flatnonzero(rng.random(len(run.t)) < shape['rate_hz'] * run.dt):
        held = max(int(size * rng.uniform(0.5, 1.5) / run.dt), 1)
        run.volts[:, start : start + held + 1] = run.volts[:, start : start + 1]


def quantisation(run: Run, size: float, shape: Shape) -> None:
    """Lose low bits by rounding or by cutting off; single axes may lose none."""
    step = sim.LSB_V * 2.0 ** round(math.log2(1 + size / sim.LSB_V))
    rounded = np.floor if shape['cut'] > 0.5 else np.rint
    for d, w in enumerate(shape['w']):
        if w:
            run.volts[d] = rounded(run.volts[d] / step) * step


def adc_inl(run: Run, size: float, shape: Shape) -> None:
    """Bend the converter, V: some wrong bits, two sines, or a bow."""
    share, (law, phase, cycles, *bits) = run.volts / (sim.LSB_V * 2**sim.ADC_BITS), shape['w']
    if law < 0.5:
        run.volts += size * sum(
            (bit > 0.5) * (np.floor(share * 2 ** (i + 1)) % 2 - 0.5) for i, bit in enumerate(bits)
        )
    elif law < 0.85:
        angle = 2 * np.pi * 2 * 15**cycles * share
        run.volts += size * (np.sin(angle + 6 * phase) + 0.4 * np.sin(2.6 * angle))
    else:
        x = 4 * (share - 0.5)
        run.volts += size * (x - x**3 + 0.5 * x**5)


def aftermath(run: Run, shape: Shape) -> np.ndarray:
    """Shift zero-g while and after a joint turns: charge of a mass, or current of a motor."""
    rate = np.hypot(np.gradient(run.alpha, run.dt), np.gradient(run.beta, run.dt))
    return low_pass(1 - np.exp(-((rate / 0.3) ** 2)), shape['late_s'], run.dt)


motor_current = aftermath


def two_levels(run: Run, shape: Shape) -> np.ndarray:
    """Switch zero-g between two levels at uneven times, as popcorn noise does."""
    phase = 2 * np.pi * run.t / shape['period_s'] + shape['phase']
    return np.where(np.sin(phase) + 0.7 * np.sin(2.718 * phase) > 0.4, 1.0, 0.0)


_LAWS: dict[str, sim.Law] = {
    # Come later and later, and grow by some percent over the minutes.
    'clock_skew': lambda run, shape: run.t * (1 + shape['growth'] * run.t / 600),
    # Scale with the other axis.
    'scale_factor_cross': lambda run, shape: np.tanh(1.2 * _other(run)),
    # Scale with z.
    'scale_factor_z': lambda run, shape: (
        _PLANE[: len(run.u)] * (np.tanh(1.2 * run.force[2] / G0 + 0.4) - np.tanh(0.4))
    ),
    # Yield less and less.
    'nonlinearity': lambda run, shape: np.arctan(shape['bend'] * run.u) / shape['bend'] - run.u,
    # Follow a power of the force that is not quite 2.
    'quadratic': lambda run, shape: np.abs(run.u) ** shape['power'],
    # Follow the die with a cubic part.
    'temperature_bias': lambda run, shape: _warm(run, shape, 0.02),
    # Scale with the die.
    'temperature_scale': lambda run, shape: _warm(run, shape, 0.0),
    # Beat with the clock, as a radio carrier does.
    'beat': lambda run, shape: np.sin(2 * np.pi * run.t / shape['period_s'] + shape['phase']),
    # Ripple with the force, as a servo loop with a limit cycle does.
    'ripple': lambda run, shape: np.sin(2 * np.pi * run.u / shape['period_g'] + shape['phase']),
    # Follow the direction in the room, beyond its first harmonics.
    'magnet': lambda run, shape: (
        np.sin(3 * run.beta + shape['phase']) * (1 + 0.5 * np.cos(2 * run.alpha))
    ),
    # Lose scale factor steadily, as by leakage into a reference.
    'fading_gain': lambda run, shape: run.t / 100,
}
"""Laws of one line."""
_LISTED, _UNLISTED = sim.load_kinds('working_faults.yaml', globals() | _LAWS)
LISTED, UNLISTED, KINDS = tuple(_LISTED), tuple(_UNLISTED), _LISTED | _UNLISTED
"""Faults of which the package's library has an effect, the others, and all by name."""
COLOUR = Kind(
    'colour',
    sim.added_at_output(_colour),
    1e-4,
    1e-2,
    place=Place.ELECTRONICS,
    random=True,
    bounds={'lag_s': (0.02, 0.3)},
)
"""What every recording has: noise that is not quite white."""
