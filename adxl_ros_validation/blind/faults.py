# SPDX-License-Identifier: Apache-2.0
"""
The faults of this world: of stage and clock, of the element, like noise, and unlisted ones.

faults.yaml says how each acts, and its numbers.
"""

from __future__ import annotations

import math

from adxl_ros_validation.blind import simulator as sim
from adxl_ros_validation.blind.motion import low_pass
from adxl_ros_validation.blind.simulator import G0, Run, Shape
import numpy as np
import scipy

_ZERO_C = 273.15
"""0 °C in K."""


bias = scale_factor = sim.constant


def stage_offset(run: Run, size: float, shape: Shape) -> None:
    """Shift the zeros of both joints, rad."""
    run.alpha += size * shape['w'][0]
    run.beta += size * shape['w'][1]


def stage_eccentricity(run: Run, size: float, shape: Shape) -> None:
    """Add a Fourier series of the angle, rad: three harmonics to beta and one to alpha."""
    c = np.asarray(shape['w'])
    beta, alpha = run.beta.copy(), run.alpha.copy()
    for h, part in ((1, 1.0), (2, 0.06), (3, 0.02)):
        run.beta += size * part * (c[0] * np.sin(h * beta) + c[1] * np.cos(h * beta))
    run.alpha += size * (c[2] * np.sin(alpha) + c[3] * np.cos(alpha))


def backlash(run: Run, size: float, shape: Shape) -> None:
    """Follow with a gap that closes exponentially (Dahl), as of worn teeth with grease, rad."""
    for joint, w in ((run.alpha, shape['w'][0]), (run.beta, shape['w'][1])):
        if size * w:
            joint -= 0.5 * size * abs(w) * sim.travel_memory(joint, abs(size * w))


def base_tilt(run: Run, size: float, shape: Shape) -> None:
    """Tilt the direction that is up, rad."""
    up = run.up + size * np.array([shape['w'][0], shape['w'][1], 0.0])
    run.up = up / np.linalg.norm(up)


def gravity(run: Run, size: float, shape: Shape) -> None:
    """Change local gravity by a share, as at another site."""
    run.gravity = G0 * (1 + size * shape['w'][0])


def lever_arm(run: Run, size: float, shape: Shape) -> None:
    """Shift the sensor off the axes of the stage, m."""
    run.arm = size * np.asarray(shape['w'], float)


def time_offset(run: Run, size: float, shape: Shape) -> None:
    """Read the samples late, s."""
    run.late += size * shape['w'][0]


def clock_skew(run: Run, size: float, shape: Shape) -> None:
    """Change the rate of the clock by a share; the oven of the clock makes it wander."""
    run.skew += size * shape['w'][0]


def mount_resonance(run: Run, size: float, shape: Shape) -> None:
    """Add one mode of the bracket; `size` is its share of the motion."""
    w0, zeta, fs = 2 * np.pi * shape['hertz'], shape['zeta'], 1 / run.dt
    b, a = scipy.signal.bilinear(
        [-1.0, -2 * zeta * w0 * 0.2, 0.0], [1.0, 2 * zeta * w0, w0 * w0], fs
    )
    moved = run.force - run.force[:, :1]
    run.force += size * scipy.signal.lfilter(b, a, moved)


def sign(rng: np.random.Generator, count: int) -> np.ndarray:
    """Draw weights of 1 or −1."""
    return rng.choice([-1.0, 1.0], count)


def misalignment(run: Run, size: float, shape: Shape) -> None:
    """Turn each axis on its own, rad; its direction keeps the length 1."""
    for (row, col), w in zip(np.argwhere(~np.eye(3, dtype=bool)), shape['w']):
        run.directions[row, col] += size * w
    run.directions /= np.linalg.norm(run.directions, axis=1, keepdims=True)
    run.u = (run.directions @ run.force)[run.unit.axis_indices] / G0


def saturation(run: Run, size: float, shape: Shape) -> None:
    """Clip softly; `size` is by how many g the limit is below 1.7 g."""
    limit = 1.7 - size * np.abs(sim.column(shape))
    run.u /= (1 + np.abs(run.u / limit) ** 40) ** (1 / 40)


def clipped_axes(rng: np.random.Generator, count: int) -> np.ndarray:
    """Draw the axes that are clipped: one of them, or all."""
    single = np.arange(count) == rng.integers(count)
    return single.astype(float) if rng.random() < 0.4 else np.ones(count)


def hysteresis(run: Run, size: float, shape: Shape) -> None:
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


def vibration_rectification(run: Run, shape: Shape) -> np.ndarray:
    """Shift zero-g by the power of the vibration, with a limit, 1/g."""
    fast = scipy.signal.sosfilt(
        scipy.signal.butter(2, 2.0, 'high', fs=1 / run.dt, output='sos'), run.u - run.u[:, :1]
    )
    power = low_pass(fast**2, 0.4, run.dt)
    return power / (1 + 4 * power)


def supply(run: Run, size: float, shape: Shape) -> None:
    """Scale zero-g and scale factor by the supply to the power 1.13 (560 mV/g at 3 V)."""
    run.volts *= 1 + size * sim.column(shape) * ((run.supply / 5.0) ** 1.13 - 1)


def bandwidth(run: Run, size: float, shape: Shape) -> None:
    """Move the corner of the filter; a slower filter has a second pole."""
    factor = math.exp(-size * shape['w'][0])
    run.corner_hz *= factor
    if factor < 1:
        run.second_hz = 8 * run.corner_hz / (1 - factor)


def mostly_slower(rng: np.random.Generator, count: int) -> np.ndarray:
    """Draw weights of which two of three are positive."""
    return rng.choice([1.0, 1.0, -1.0], count)


def noise_excess(run: Run, shape: Shape) -> np.ndarray:
    """Add white, heavy-tailed noise before the filter; size 1 V is 1 V rms within 50 Hz."""
    hiss = run.random('hiss').laplace(size=run.volts.shape) / math.sqrt(2)
    return math.sqrt(0.5 / run.dt / 78.5) * hiss


def flicker(run: Run, shape: Shape) -> np.ndarray:
    """Add 1/f noise: relaxations over four decades, V."""
    rng, slow = run.random('flicker'), np.arange(run.t[0], run.t[-1] + 0.05, 0.02)
    return np.stack([np.interp(run.t, slow, sim.pink_noise(slow, rng)) for _ in run.volts])


def bias_walk(run: Run, shape: Shape) -> np.ndarray:
    """Add a random walk, V: a smoothed step every second."""
    rng, knots = run.random('walk'), np.arange(run.t[0] - 1, run.t[-1] + 2, 0.25)
    steps = rng.normal(size=(len(run.volts), len(knots))) * (np.arange(len(knots)) % 4 == 0)
    walks = scipy.ndimage.gaussian_filter1d(np.cumsum(steps, axis=1), 1.5, axis=1)
    return np.stack([np.interp(run.t, knots, walk - walk[0]) for walk in walks])


def mains_hum(run: Run, shape: Shape) -> np.ndarray:
    """Add mains hum, V: its frequency wanders, and it has two harmonics."""
    rng, slow = run.random('mains'), np.arange(run.t[0], run.t[-1] + 1, 0.5)
    wander = scipy.ndimage.gaussian_filter1d(rng.normal(size=len(slow)), 20)
    hertz = shape['hertz'] + 0.03 * wander / max(np.std(wander), 1e-9)
    phase = 2 * np.pi * np.cumsum(np.interp(run.t, slow, hertz)) * run.dt
    hum = np.sin(phase) + 0.3 * np.sin(3 * phase + 1.0) + 0.12 * np.sin(2 * phase)
    return (1 + 0.1 * np.sin(run.t / 17)) * hum


def spikes(run: Run, shape: Shape) -> np.ndarray:
    """Add spikes at random, V, each with a tail of a sample or two."""
    rng = run.random('spikes')
    hits = rng.random(run.volts.shape) < shape['rate'] * run.dt
    heights = rng.choice([-1.0, 1.0], hits.shape) * rng.lognormal(0, 0.4, hits.shape)
    return scipy.signal.lfilter([1.0], [1.0, -0.25], hits * heights)


def stuck(run: Run, size: float, shape: Shape) -> None:
    """Repeat a sample of all axes, for `size` s on average."""
    rng = run.random('stuck')
    starts = np.flatnonzero(rng.random(len(run.t)) < shape['rate'] * run.dt)
    lengths = rng.exponential(1.0, len(run.t))[starts] * size / run.dt
    for start, length in zip(starts, lengths):
        run.volts[:, start : start + 1 + int(length)] = run.volts[:, start : start + 1]


def quantisation(run: Run, size: float, shape: Shape) -> None:
    """Lose the low bits: steps of `size` V, which need not be a power of 2."""
    if size > sim.LSB_V:
        step = size * np.maximum(np.abs(sim.column(shape)), sim.LSB_V / size)
        run.volts = np.floor(run.volts / step) * step + step / 2


def adc_inl(run: Run, size: float, shape: Shape) -> None:
    """Weigh the high bits wrongly, V, as a charge converter with unmatched capacitors does."""
    integer = np.clip(run.volts / sim.LSB_V, 0, 2**sim.ADC_BITS - 1).astype(np.int64)
    for i, w in enumerate(shape['w']):
        run.volts += size * w * 0.7**i * ((integer >> (sim.ADC_BITS - 1 - i) & 1) - 0.5)


def loose_gain(run: Run, size: float, shape: Shape) -> None:
    """Lose a share of the scale factor for some seconds, as a loose contact does."""
    rng = run.random('loose')
    loose = np.zeros_like(run.t)
    for start in rng.uniform(0, 0.9, 5) * run.t[-1]:
        loose[(run.t > start) & (run.t < start + rng.uniform(3, 12))] = 1
    run.u *= 1 - size * np.abs(sim.column(shape)) * low_pass(loose, 0.05, run.dt)


def cogging(run: Run, shape: Shape) -> np.ndarray:
    """Shake with the poles of the motor while it turns, g."""
    speed = np.hypot(np.gradient(run.beta, run.dt), np.gradient(run.alpha, run.dt))
    return np.tanh(speed / 0.2) * np.sin(shape['poles'] * (run.beta + run.alpha))


def floor_sway(run: Run, size: float, shape: Shape) -> None:
    """Sway with the floor under the bench in gusts, rad."""
    rng = run.random('sway')
    gust = np.interp(run.t, np.linspace(0, run.t[-1], 12), rng.uniform(0, 1.6, 12))
    sway = size * gust * np.sin(2 * np.pi * shape['hertz'] * run.t)
    run.alpha += sway * np.cos(run.beta)
    run.beta += sway


def product(run: Run, shape: Shape) -> np.ndarray:
    """Add the product of the two other axes, g, as a frame does that shears."""
    x, y, z = run.force / G0
    return np.stack([y * z, x * z, x * y])[run.unit.axis_indices]


def bearing_bump(run: Run, size: float, shape: Shape) -> None:
    """Tilt within about 20° of one angle, rad, as a dented ball of a bearing does."""
    bump = size * np.exp(shape['sharp'] * (np.cos(run.beta - shape['at']) - 1))
    run.alpha += bump
    run.beta += bump


_LAWS: dict[str, sim.Law] = {
    # Follow the other axis by the first arch of a cosine.
    'cross_axis': lambda run, shape: 1 - np.cos(1.2 * (run.force / G0)[[1, 0]]),
    # Follow z by an exponential.
    'cross_axis_z': lambda run, shape: np.expm1(run.force[2] / G0),
    # Scale with z by an exponential.
    'scale_factor_z': lambda run, shape: np.expm1(0.8 * run.force[2] / G0),
    # Bend by a hyperbolic sine that is exact at 0 and at full scale.
    'nonlinearity': lambda run, shape: np.sinh(1.4 * run.u) / math.sinh(1.4) - run.u,
    # Bend by a hyperbola through zero.
    'quadratic': lambda run, shape: np.sqrt(1 + 0.8 * run.u**2) - 1,
    # Follow the temperature by an exponential.
    'temperature_bias': lambda run, shape: np.expm1((run.temperature - 25.0) / 25.0),
    # Follow the law of Arrhenius from 25 °C.
    'temperature_scale': lambda run, shape: np.expm1(
        2500.0 * (1 / (_ZERO_C + 25.0) - 1 / (_ZERO_C + run.temperature))
    ),
    # Settle by a stretched exponential after power-on.
    'warm_up': lambda run, shape: np.exp(
        -((np.clip(run.t + 3.0, 0, None) / shape['lag']) ** 0.75)
    ),
    # Shift zero-g by the direction of the last temperature change.
    'thermal_loop': lambda run, shape: sim.travel_memory(run.temperature, 2.0),
    # Yield slowly to a load and recover as slowly, as a soft glue does.
    'creep': lambda run, shape: low_pass(run.u, shape['lag'], run.dt) - run.u,
    # Step once and stay, as a bond does that cracks.
    'jump': lambda run, shape: run.t > shape['at'] * run.t[-1],
    # Shift by the sign of the rate of beta with a smooth limit, as a dragging cable does.
    'rate_pull': lambda run, shape: np.tanh(np.gradient(run.beta, run.dt) / 0.5),
    # Lose what is near zero, as a class B output does.
    'dead_zone': lambda run, shape: -run.u / 0.12 * np.exp(-((run.u / 0.12) ** 2) / 2),
}
"""Laws of one line."""
_LISTED, _UNLISTED = sim.load_kinds('blind/faults.yaml', globals() | _LAWS)
KINDS = _LISTED | _UNLISTED
"""All kinds by name."""
KNOWN, UNLISTED = tuple(_LISTED), tuple(_UNLISTED)
"""Kinds of which the package's library has an effect of the same name, and the others."""
NOISE_LIKE = frozenset(name for name, kind in KINDS.items() if kind.random)
"""Kinds that differ from run to run."""
