# SPDX-License-Identifier: Apache-2.0
"""Faults like noise, faults outside the library, and the table of all faults of this world."""

from __future__ import annotations

from functools import partial
import math

from adxl_ros_validation.blind.world import sensor_faults
from adxl_ros_validation.blind.world.simulator import (
    Act,
    ADC_BITS,
    all_axes,
    by_axis,
    column,
    Draw,
    draw_weights,
    FaultKind,
    G0,
    low_pass,
    LSB_V,
    pink_noise,
    Place,
    Run,
    Shape,
    single_weights,
    travel_memory,
    Unit,
)
import numpy as np
import scipy

_HIGH_BITS = 5
"""Number of the bits whose weights are wrong, from the highest; chosen."""


def _noise_excess(run: Run, size: float, shape: Shape) -> None:
    """Add white, heavy-tailed noise before the filter; `size` is its rms within 50 Hz, V."""
    hiss = run.random('hiss').laplace(size=run.volts.shape) / math.sqrt(2)
    run.volts += size * column(shape) * math.sqrt(0.5 / run.dt / 78.5) * hiss


def _flicker(run: Run, size: float, shape: Shape) -> None:
    """Add 1/f noise: relaxations over four decades, V."""
    rng, slow = run.random('flicker'), np.arange(run.t[0], run.t[-1] + 0.05, 0.02)
    run.volts += size * column(shape) * np.stack([
        np.interp(run.t, slow, pink_noise(slow, rng)) for _ in run.volts])


def _bias_walk(run: Run, size: float, shape: Shape) -> None:
    """Add a random walk, V: a smoothed step every second."""
    rng, knots = run.random('walk'), np.arange(run.t[0] - 1, run.t[-1] + 2, 0.25)
    steps = rng.normal(size=(len(run.volts), len(knots))) * (np.arange(len(knots)) % 4 == 0)
    walks = scipy.ndimage.gaussian_filter1d(np.cumsum(steps, axis=1), 1.5, axis=1)
    run.volts += size * column(shape) * np.stack([
        np.interp(run.t, knots, walk - walk[0]) for walk in walks])


def _mains_hum(run: Run, size: float, shape: Shape) -> None:
    """Add mains hum, V: its frequency wanders, and it has two harmonics."""
    rng, slow = run.random('mains'), np.arange(run.t[0], run.t[-1] + 1, 0.5)
    wander = scipy.ndimage.gaussian_filter1d(rng.normal(size=len(slow)), 20)
    hertz = shape['hertz'] + 0.03 * wander / max(np.std(wander), 1e-9)
    phase = 2 * np.pi * np.cumsum(np.interp(run.t, slow, hertz)) * run.dt
    hum = np.sin(phase) + 0.3 * np.sin(3 * phase + 1.0) + 0.12 * np.sin(2 * phase)
    run.volts += size * column(shape) * (1 + 0.1 * np.sin(run.t / 17)) * hum


def _spikes(run: Run, size: float, shape: Shape) -> None:
    """Add spikes at random, V, each with a tail of a sample or two."""
    rng = run.random('spikes')
    hits = rng.random(run.volts.shape) < shape['rate'] * run.dt
    heights = rng.choice([-1.0, 1.0], hits.shape) * rng.lognormal(0, 0.4, hits.shape)
    run.volts += size * column(shape) * scipy.signal.lfilter([1.0], [1.0, -0.25], hits * heights)


def _stuck(run: Run, size: float, shape: Shape) -> None:
    """Repeat a sample of all axes, for `size` s on average."""
    rng = run.random('stuck')
    starts = np.flatnonzero(rng.random(len(run.t)) < shape['rate'] * run.dt)
    lengths = rng.exponential(1.0, len(run.t))[starts] * size / run.dt
    for start, length in zip(starts, lengths):
        run.volts[:, start:start + 1 + int(length)] = run.volts[:, start:start + 1]


def _quantisation(run: Run, size: float, shape: Shape) -> None:
    """Lose the low bits: steps of `size` V, which need not be a power of 2."""
    if size > LSB_V:
        step = size * np.maximum(np.abs(column(shape)), LSB_V / size)
        run.volts = np.floor(run.volts / step) * step + step / 2


def _adc_inl(run: Run, size: float, shape: Shape) -> None:
    """Weigh the high bits wrongly, V, as a charge converter with unmatched capacitors does."""
    code = np.clip(run.volts / LSB_V, 0, 2 ** ADC_BITS - 1)
    integer = code.astype(np.int64)
    for i, w in enumerate(shape['w']):
        run.volts += size * w * 0.7 ** i * ((integer >> (ADC_BITS - 1 - i) & 1) - 0.5)


def _draw_mains(rng: np.random.Generator, unit: Unit) -> Shape:
    return {**by_axis(rng, unit), 'hertz': float(rng.choice([50.0, 60.0]))}


def _draw_with_rate(lowest: float, highest: float, rng: np.random.Generator, unit: Unit) -> Shape:
    return {**by_axis(rng, unit), 'rate': float(rng.uniform(lowest, highest))}


def _noise(name: str, place: Place, act: Act, start: float, largest: float,
           draw: Draw = by_axis) -> FaultKind:
    """Return a kind with a weight for each axis that differs from run to run."""
    return FaultKind(name, place, act, draw, all_axes, start, largest, per_axis=True, random=True)


NOISE_KINDS = (
    _noise('noise_excess', Place.ELECTRONICS, _noise_excess, start=1e-3, largest=0.1),
    _noise('flicker', Place.ELECTRONICS, _flicker, start=3e-4, largest=0.05),
    _noise('bias_walk', Place.ELECTRONICS, _bias_walk, start=1e-4, largest=0.05),
    _noise('mains_hum', Place.WIRE, _mains_hum, 1e-3, 0.1, _draw_mains),
    _noise('spikes', Place.SAMPLES, _spikes, 0.05, 1.5, partial(_draw_with_rate, 0.05, 0.3)),
    _noise('stuck', Place.SAMPLES, _stuck, 0.05, 1.0, partial(_draw_with_rate, 0.03, 0.15)),
    _noise('quantisation', Place.SAMPLES, _quantisation, start=1e-3, largest=0.08),
    FaultKind('adc_inl', Place.SAMPLES, _adc_inl, partial(draw_weights, _HIGH_BITS),
              partial(single_weights, _HIGH_BITS), start=1e-3, largest=0.1),
)
"""The kinds of this file, in the order of the table."""


def _thermal_loop(run: Run, size: float, shape: Shape) -> None:
    """Shift zero-g by the direction of the last temperature change, g."""
    run.u += size * column(shape) * travel_memory(run.temperature, 2.0)


def _creep(run: Run, size: float, shape: Shape) -> None:
    """Yield slowly to a load and recover as slowly, as a soft glue does."""
    slow = low_pass(run.u, shape['lag'], run.dt)
    run.u += size * column(shape) * (slow - run.u)


def _jump(run: Run, size: float, shape: Shape) -> None:
    """Step once and stay, g, as a bond does that cracks."""
    run.u += size * column(shape) * (run.t > shape['at'] * run.t[-1])


def _loose_gain(run: Run, size: float, shape: Shape) -> None:
    """Lose a share of the scale factor for some seconds, as a loose contact does."""
    rng = run.random('loose')
    loose = np.zeros_like(run.t)
    for start in rng.uniform(0, 0.9, 5) * run.t[-1]:
        loose[(run.t > start) & (run.t < start + rng.uniform(3, 12))] = 1
    run.u *= 1 - size * np.abs(column(shape)) * low_pass(loose, 0.05, run.dt)


def _cogging(run: Run, size: float, shape: Shape) -> None:
    """Shake with the poles of the motor while it turns, g."""
    speed = np.hypot(np.gradient(run.beta, run.dt), np.gradient(run.alpha, run.dt))
    run.u += size * column(shape) * np.tanh(speed / 0.2) * np.sin(
        shape['poles'] * (run.beta + run.alpha))


def _rate_pull(run: Run, size: float, shape: Shape) -> None:
    """Shift by the sign of the rate of beta with a smooth limit, g, as a dragging cable does."""
    run.u += size * column(shape) * np.tanh(np.gradient(run.beta, run.dt) / 0.5)


def _floor_sway(run: Run, size: float, shape: Shape) -> None:
    """Sway with the floor under the bench in gusts, rad."""
    rng = run.random('sway')
    gust = np.interp(run.t, np.linspace(0, run.t[-1], 12), rng.uniform(0, 1.6, 12))
    sway = size * gust * np.sin(2 * np.pi * shape['hertz'] * run.t)
    run.alpha += sway * np.cos(run.beta)
    run.beta += sway


def _dead_zone(run: Run, size: float, shape: Shape) -> None:
    """Have a dead zone about zero, g, as a class B output has."""
    x = run.u / 0.12
    run.u -= size * column(shape) * x * np.exp(-x * x / 2)


def _product(run: Run, size: float, shape: Shape) -> None:
    """Add the product of the two other axes, g, as a frame does that shears."""
    x, y, z = run.force / G0
    run.u += size * column(shape) * np.stack([y * z, x * z, x * y])[run.unit.axis_indices]


def _bearing_bump(run: Run, size: float, shape: Shape) -> None:
    """Tilt within about 20° of one angle, rad, as a dented ball of a bearing does."""
    bump = size * np.exp(shape['sharp'] * (np.cos(run.beta - shape['at']) - 1))
    run.alpha += bump
    run.beta += bump


def _draw_with(bounds: dict[str, tuple[float, float]], rng: np.random.Generator, unit: Unit
               ) -> Shape:
    """Draw a weight for each axis, then a number within each of the bounds."""
    return {**by_axis(rng, unit),
            **{name: float(rng.uniform(*pair)) for name, pair in bounds.items()}}


def _unlisted(name: str, place: Place, act: Act, draw: Draw = by_axis, largest: float = 0.05
              ) -> FaultKind:
    return FaultKind(name, place, act, draw, all_axes, 1e-3, largest, in_library=False)


UNLISTED_KINDS = (
    _unlisted('thermal_loop', Place.ELEMENT, _thermal_loop),
    _unlisted('creep', Place.ELEMENT, _creep, partial(_draw_with, {'lag': (1.5, 8.0)})),
    _unlisted('jump', Place.ELEMENT, _jump, partial(_draw_with, {'at': (0.2, 0.8)})),
    _unlisted('loose_gain', Place.ELEMENT, _loose_gain),
    _unlisted('cogging', Place.ELEMENT, _cogging, partial(_draw_with, {'poles': (20.0, 60.0)})),
    _unlisted('rate_pull', Place.ELEMENT, _rate_pull),
    _unlisted('floor_sway', Place.STAGE, _floor_sway,
              partial(_draw_with, {'hertz': (0.15, 0.6)})),
    _unlisted('dead_zone', Place.ELEMENT, _dead_zone),
    _unlisted('product', Place.ELEMENT, _product),
    _unlisted('bearing_bump', Place.STAGE, _bearing_bump,
              partial(_draw_with, {'sharp': (6.0, 20.0), 'at': (-3.1, 3.1)}), largest=0.01),
)
"""The kinds of this file, in the order of the table."""


KINDS = {kind.name: kind for kind in (*sensor_faults.STAGE_KINDS, *sensor_faults.ELEMENT_KINDS,
                                      *NOISE_KINDS, *UNLISTED_KINDS)}
"""All kinds by name. Their order is part of a seed: do not change it."""
KNOWN = tuple(name for name, kind in KINDS.items() if kind.in_library)
"""Kinds of which the package's library has an effect of the same name."""
UNLISTED = tuple(name for name, kind in KINDS.items() if not kind.in_library)
"""Kinds of which the package's library has no effect."""
