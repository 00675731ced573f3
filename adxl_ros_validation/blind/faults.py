# SPDX-License-Identifier: Apache-2.0
"""The faults of this world: of stage and clock, of the element, like noise, and unlisted ones."""

from __future__ import annotations

import math

from adxl_ros_validation.blind import simulator as sim
from adxl_ros_validation.blind.motion import low_pass
from adxl_ros_validation.blind.simulator import G0, Kind, Place, Run, Shape
import numpy as np
import scipy

_OFF_DIAGONAL = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))
"""Row and column of each weight of a misalignment in the matrix of directions."""
_ZERO_C = 273.15
"""0 °C in K."""


def stage_offset(run: Run, size: float, shape: Shape) -> None:
    """Shift the zeros of both joints, rad."""
    run.alpha += size * shape['w'][0]
    run.beta += size * shape['w'][1]


def _stage_eccentricity(run: Run, size: float, shape: Shape) -> None:
    """Add a Fourier series of the angle, rad: three harmonics to beta and one to alpha."""
    c = np.asarray(shape['w'])
    beta, alpha = run.beta.copy(), run.alpha.copy()
    for h, part in ((1, 1.0), (2, 0.06), (3, 0.02)):
        run.beta += size * part * (c[0] * np.sin(h * beta) + c[1] * np.cos(h * beta))
    run.alpha += size * (c[2] * np.sin(alpha) + c[3] * np.cos(alpha))


def _backlash(run: Run, size: float, shape: Shape) -> None:
    """Follow with a gap that closes exponentially (Dahl), as of worn teeth with grease, rad."""
    for joint, w in ((run.alpha, shape['w'][0]), (run.beta, shape['w'][1])):
        if size * w:
            joint -= 0.5 * size * abs(w) * sim.travel_memory(joint, abs(size * w))


def _base_tilt(run: Run, size: float, shape: Shape) -> None:
    up = run.up + size * np.array([shape['w'][0], shape['w'][1], 0.0])
    run.up = up / np.linalg.norm(up)


def _gravity(run: Run, size: float, shape: Shape) -> None:
    """Change local gravity by a share, as at another site."""
    run.gravity = G0 * (1 + size * shape['w'][0])


def lever_arm(run: Run, size: float, shape: Shape) -> None:
    """Shift the sensor off the axes of the stage, m."""
    run.arm = size * np.asarray(shape['w'], float)


def _time_offset(run: Run, size: float, shape: Shape) -> None:
    run.late += size * shape['w'][0]


def _clock_skew(run: Run, size: float, shape: Shape) -> None:
    """Change the rate of the clock by a share; the oven of the clock makes it wander."""
    run.skew += size * shape['w'][0]


def _mount_resonance(run: Run, size: float, shape: Shape) -> None:
    """Add one mode of the bracket; `size` is its share of the motion."""
    w0, zeta, fs = 2 * np.pi * shape['hertz'], shape['zeta'], 1 / run.dt
    b, a = scipy.signal.bilinear([-1.0, -2 * zeta * w0 * 0.2, 0.0],
                                 [1.0, 2 * zeta * w0, w0 * w0], fs)
    moved = run.force - run.force[:, :1]
    run.force += size * scipy.signal.lfilter(b, a, moved)


def _sign(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.choice([-1.0, 1.0], count)


_STAGE = (
    Kind('stage_offset', stage_offset, 1e-3, 0.03, place=Place.STAGE, fixed=2, per_axis=False),
    Kind('stage_eccentricity', _stage_eccentricity, 1e-3, 0.03, place=Place.STAGE, fixed=4,
         per_axis=False),
    Kind('backlash', _backlash, 1e-3, 0.03, place=Place.STAGE, fixed=2, weigh=sim.positive,
         per_axis=False, sizes=(0.3, 1.0, 4.0)),
    Kind('base_tilt', _base_tilt, 1e-3, 0.03, place=Place.STAGE, fixed=2, per_axis=False),
    Kind('gravity', _gravity, 1e-3, 5e-3, place=Place.STAGE, fixed=1, weigh=_sign, per_axis=False),
    Kind('lever_arm', lever_arm, 0.01, 0.3, place=Place.STAGE, fixed=3, per_axis=False),
    Kind('time_offset', _time_offset, 1e-3, 0.1, place=Place.STAGE, fixed=1, weigh=_sign,
         per_axis=False),
    Kind('clock_skew', _clock_skew, 1e-5, 1e-3, place=Place.STAGE, fixed=1, weigh=_sign,
         per_axis=False),
    Kind('mount_resonance', _mount_resonance, 0.1, 1.0, place=Place.MOUNT, each=0, per_axis=False,
         bounds={'hertz': (14, 38), 'zeta': (0.03, 0.12)},
         spread_at={'hertz': (14.0, 20.0, 28.0, 38.0), 'zeta': (0.06,)}),
)


def _misalignment(run: Run, size: float, shape: Shape) -> None:
    """Turn each axis on its own, rad; its direction keeps the length 1."""
    for (row, col), w in zip(_OFF_DIAGONAL, shape['w']):
        run.directions[row, col] += size * w
    run.directions /= np.linalg.norm(run.directions, axis=1, keepdims=True)
    run.u = (run.directions @ run.force)[run.unit.axis_indices] / G0


def _saturation(run: Run, size: float, shape: Shape) -> None:
    """Clip softly; `size` is by how many g the limit is below 1.7 g."""
    limit = 1.7 - size * np.abs(sim.column(shape))
    run.u /= (1 + np.abs(run.u / limit) ** 40) ** (1 / 40)


def _clipped_axes(rng: np.random.Generator, count: int) -> np.ndarray:
    single = np.arange(count) == rng.integers(count)
    return single.astype(float) if rng.random() < 0.4 else np.ones(count)


def _hysteresis(run: Run, size: float, shape: Shape) -> None:
    """Add a hysteresis loop of Bouc and Wen, g: exponent 2, unequal branches."""
    every = max(int(0.004 / run.dt), 1)
    for row, w in zip(run.u, shape['w']):
        if w:
            z, loop = 0.0, []
            for step in np.diff(row[::every], prepend=row[0]).tolist():
                branch = 1.0 if step * z > 0 else -0.3
                z = min(max(z + step / 0.12 * (1 - branch * z * z), -1.0), 1.0)
                loop.append(z)
            row += size * w * np.interp(run.t, run.t[::every], loop)


def _vibration_rectification(run: Run, shape: Shape) -> np.ndarray:
    """Shift zero-g by the power of the vibration, with a limit, 1/g."""
    fast = scipy.signal.sosfilt(scipy.signal.butter(2, 2.0, 'high', fs=1 / run.dt, output='sos'),
                                run.u - run.u[:, :1])
    power = low_pass(fast ** 2, 0.4, run.dt)
    return power / (1 + 4 * power)


def _supply(run: Run, size: float, shape: Shape) -> None:
    """Scale zero-g and scale factor by the supply to the power 1.13 (560 mV/g at 3 V)."""
    run.volts *= 1 + size * sim.column(shape) * ((run.supply / 5.0) ** 1.13 - 1)


def _bandwidth(run: Run, size: float, shape: Shape) -> None:
    """Move the corner of the filter; a slower filter has a second pole."""
    factor = math.exp(-size * shape['w'][0])
    run.corner_hz *= factor
    if factor < 1:
        run.second_hz = 8 * run.corner_hz / (1 - factor)


_ELEMENT = (
    Kind('bias', sim.added_at_output(sim.constant), 1e-3, 0.1, place=Place.ELECTRONICS),
    Kind('scale_factor', sim.scaled(sim.constant)),
    Kind('misalignment', _misalignment, each=2, per_axis=False),
    # The first arch of a cosine.
    Kind('cross_axis', sim.added(lambda run, shape: 1 - np.cos(1.2 * (run.force / G0)[[1, 0]])),
         fixed=2),
    Kind('cross_axis_z', sim.added(lambda run, shape: np.expm1(run.force[2] / G0)), fixed=2),
    Kind('scale_factor_z', sim.scaled(lambda run, shape: np.expm1(0.8 * run.force[2] / G0)),
         fixed=2),
    # Exact at 0 and at full scale.
    Kind('nonlinearity', sim.added(
        lambda run, shape: np.sinh(1.4 * run.u) / math.sinh(1.4) - run.u), 1e-3, 0.1),
    # A hyperbola through zero.
    Kind('quadratic', sim.added(lambda run, shape: np.sqrt(1 + 0.8 * run.u ** 2) - 1), 1e-3, 0.1),
    Kind('saturation', _saturation, 0.6, 1.1, weigh=_clipped_axes, sizes=(0.8, 1.0, 1.3)),
    Kind('hysteresis', _hysteresis, 1e-3, 0.03),
    Kind('temperature_bias', sim.added(
        lambda run, shape: np.expm1((run.temperature - 25.0) / 25.0))),
    # The law of Arrhenius from 25 °C.
    Kind('temperature_scale', sim.scaled(lambda run, shape: np.expm1(2500.0 * (
        1 / (_ZERO_C + 25.0) - 1 / (_ZERO_C + run.temperature)))), 1e-3, 0.1),
    # A stretched exponential after power-on.
    Kind('warm_up', sim.added(
        lambda run, shape: np.exp(-(np.clip(run.t + 3.0, 0, None) / shape['lag']) ** 0.75)),
        1e-3, 0.1, bounds={'lag': (15, 50)}, spread_at={'lag': (15.0, 27.0, 50.0)}),
    Kind('vibration_rectification', sim.added(_vibration_rectification), 1e-2, 3.0),
    Kind('supply', _supply, 0.1, 1.5, place=Place.ELECTRONICS),
    # Two of three are slower.
    Kind('bandwidth', _bandwidth, 0.1, 1.0, place=Place.ELECTRONICS, fixed=1,
         weigh=lambda rng, count: rng.choice([1.0, 1.0, -1.0], count), per_axis=False,
         sizes=(-1.0, 1.0, 4.0)),
)


def _heavy_tails(run: Run, shape: Shape) -> np.ndarray:
    """Add white, heavy-tailed noise before the filter; size 1 V is 1 V rms within 50 Hz."""
    hiss = run.random('hiss').laplace(size=run.volts.shape) / math.sqrt(2)
    return math.sqrt(0.5 / run.dt / 78.5) * hiss


def _flicker(run: Run, shape: Shape) -> np.ndarray:
    """Add 1/f noise: relaxations over four decades, V."""
    rng, slow = run.random('flicker'), np.arange(run.t[0], run.t[-1] + 0.05, 0.02)
    return np.stack([np.interp(run.t, slow, sim.pink_noise(slow, rng)) for _ in run.volts])


def _bias_walk(run: Run, shape: Shape) -> np.ndarray:
    """Add a random walk, V: a smoothed step every second."""
    rng, knots = run.random('walk'), np.arange(run.t[0] - 1, run.t[-1] + 2, 0.25)
    steps = rng.normal(size=(len(run.volts), len(knots))) * (np.arange(len(knots)) % 4 == 0)
    walks = scipy.ndimage.gaussian_filter1d(np.cumsum(steps, axis=1), 1.5, axis=1)
    return np.stack([np.interp(run.t, knots, walk - walk[0]) for walk in walks])


def _mains_hum(run: Run, shape: Shape) -> np.ndarray:
    """Add mains hum, V: its frequency wanders, and it has two harmonics."""
    rng, slow = run.random('mains'), np.arange(run.t[0], run.t[-1] + 1, 0.5)
    wander = scipy.ndimage.gaussian_filter1d(rng.normal(size=len(slow)), 20)
    hertz = shape['hertz'] + 0.03 * wander / max(np.std(wander), 1e-9)
    phase = 2 * np.pi * np.cumsum(np.interp(run.t, slow, hertz)) * run.dt
    hum = np.sin(phase) + 0.3 * np.sin(3 * phase + 1.0) + 0.12 * np.sin(2 * phase)
    return (1 + 0.1 * np.sin(run.t / 17)) * hum


def _spikes(run: Run, shape: Shape) -> np.ndarray:
    """Add spikes at random, V, each with a tail of a sample or two."""
    rng = run.random('spikes')
    hits = rng.random(run.volts.shape) < shape['rate'] * run.dt
    heights = rng.choice([-1.0, 1.0], hits.shape) * rng.lognormal(0, 0.4, hits.shape)
    return scipy.signal.lfilter([1.0], [1.0, -0.25], hits * heights)


def _stuck(run: Run, size: float, shape: Shape) -> None:
    """Repeat a sample of all axes, for `size` s on average."""
    rng = run.random('stuck')
    starts = np.flatnonzero(rng.random(len(run.t)) < shape['rate'] * run.dt)
    lengths = rng.exponential(1.0, len(run.t))[starts] * size / run.dt
    for start, length in zip(starts, lengths):
        run.volts[:, start:start + 1 + int(length)] = run.volts[:, start:start + 1]


def _quantisation(run: Run, size: float, shape: Shape) -> None:
    """Lose the low bits: steps of `size` V, which need not be a power of 2."""
    if size > sim.LSB_V:
        step = size * np.maximum(np.abs(sim.column(shape)), sim.LSB_V / size)
        run.volts = np.floor(run.volts / step) * step + step / 2


def _adc_inl(run: Run, size: float, shape: Shape) -> None:
    """Weigh the high bits wrongly, V, as a charge converter with unmatched capacitors does."""
    integer = np.clip(run.volts / sim.LSB_V, 0, 2 ** sim.ADC_BITS - 1).astype(np.int64)
    for i, w in enumerate(shape['w']):
        run.volts += size * w * 0.7 ** i * ((integer >> (sim.ADC_BITS - 1 - i) & 1) - 0.5)


_NOISE = (
    Kind('noise_excess', sim.added_v(_heavy_tails), 1e-3, 0.1, place=Place.ELECTRONICS,
         random=True),
    Kind('flicker', sim.added_v(_flicker), 3e-4, place=Place.ELECTRONICS, random=True),
    Kind('bias_walk', sim.added_v(_bias_walk), 1e-4, place=Place.ELECTRONICS, random=True),
    Kind('mains_hum', sim.added_v(_mains_hum), 1e-3, 0.1, place=Place.WIRE, random=True,
         bounds={'hertz': [50.0, 60.0]}),
    Kind('spikes', sim.added_v(_spikes), 0.05, 1.5, place=Place.SAMPLES, random=True,
         bounds={'rate': (0.05, 0.3)}),
    Kind('stuck', _stuck, 0.05, 1.0, place=Place.SAMPLES, random=True,
         bounds={'rate': (0.03, 0.15)}),
    Kind('quantisation', _quantisation, 1e-3, 0.08, place=Place.SAMPLES, random=True),
    Kind('adc_inl', _adc_inl, 1e-3, 0.1, place=Place.SAMPLES, fixed=5, per_axis=False),
)


def _loose_gain(run: Run, size: float, shape: Shape) -> None:
    """Lose a share of the scale factor for some seconds, as a loose contact does."""
    rng = run.random('loose')
    loose = np.zeros_like(run.t)
    for start in rng.uniform(0, 0.9, 5) * run.t[-1]:
        loose[(run.t > start) & (run.t < start + rng.uniform(3, 12))] = 1
    run.u *= 1 - size * np.abs(sim.column(shape)) * low_pass(loose, 0.05, run.dt)


def _cogging(run: Run, shape: Shape) -> np.ndarray:
    """Shake with the poles of the motor while it turns, g."""
    speed = np.hypot(np.gradient(run.beta, run.dt), np.gradient(run.alpha, run.dt))
    return np.tanh(speed / 0.2) * np.sin(shape['poles'] * (run.beta + run.alpha))


def _floor_sway(run: Run, size: float, shape: Shape) -> None:
    """Sway with the floor under the bench in gusts, rad."""
    rng = run.random('sway')
    gust = np.interp(run.t, np.linspace(0, run.t[-1], 12), rng.uniform(0, 1.6, 12))
    sway = size * gust * np.sin(2 * np.pi * shape['hertz'] * run.t)
    run.alpha += sway * np.cos(run.beta)
    run.beta += sway


def _product(run: Run, shape: Shape) -> np.ndarray:
    """Add the product of the two other axes, g, as a frame does that shears."""
    x, y, z = run.force / G0
    return np.stack([y * z, x * z, x * y])[run.unit.axis_indices]


def _bearing_bump(run: Run, size: float, shape: Shape) -> None:
    """Tilt within about 20° of one angle, rad, as a dented ball of a bearing does."""
    bump = size * np.exp(shape['sharp'] * (np.cos(run.beta - shape['at']) - 1))
    run.alpha += bump
    run.beta += bump


_UNLISTED = (
    # Shift zero-g by the direction of the last temperature change.
    Kind('thermal_loop', sim.added(lambda run, shape: sim.travel_memory(run.temperature, 2.0))),
    # Yield slowly to a load and recover as slowly, as a soft glue does.
    Kind('creep', sim.added(lambda run, shape: low_pass(run.u, shape['lag'], run.dt) - run.u),
         bounds={'lag': (1.5, 8.0)}),
    # Step once and stay, as a bond does that cracks.
    Kind('jump', sim.added(lambda run, shape: run.t > shape['at'] * run.t[-1]),
         bounds={'at': (0.2, 0.8)}),
    Kind('loose_gain', _loose_gain),
    Kind('cogging', sim.added(_cogging), bounds={'poles': (20.0, 60.0)}),
    # Shift by the sign of the rate of beta with a smooth limit, as a dragging cable does.
    Kind('rate_pull', sim.added(lambda run, shape: np.tanh(np.gradient(run.beta, run.dt) / 0.5))),
    Kind('floor_sway', _floor_sway, place=Place.STAGE, bounds={'hertz': (0.15, 0.6)}),
    # A dead zone about zero, as a class B output has.
    Kind('dead_zone', sim.added(
        lambda run, shape: -run.u / 0.12 * np.exp(-(run.u / 0.12) ** 2 / 2))),
    Kind('product', sim.added(_product)),
    Kind('bearing_bump', _bearing_bump, 1e-3, 0.01, place=Place.STAGE,
         bounds={'sharp': (6.0, 20.0), 'at': (-3.1, 3.1)}),
)
UNLISTED = tuple(kind.name for kind in _UNLISTED)
"""Kinds of which the package's library has no effect."""
KINDS = {kind.name: kind for kind in (*_STAGE, *_ELEMENT, *_NOISE, *_UNLISTED)}
"""All kinds by name. Their order is part of a seed: do not change it."""
KNOWN = tuple(name for name in KINDS if name not in UNLISTED)
"""Kinds of which the package's library has an effect of the same name."""
NOISE_LIKE = frozenset(name for name, kind in KINDS.items() if kind.random)
"""Kinds that differ from run to run."""
