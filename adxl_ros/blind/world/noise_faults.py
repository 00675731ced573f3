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

"""Faults that look like noise: of the sensor, of the wire and of the samples."""

from __future__ import annotations

from functools import partial
import math

from adxl_ros.blind.world.fault import Act, Draw, FaultKind, Shape
from adxl_ros.blind.world.fault_shapes import (
    all_axes,
    by_axis,
    column,
    draw_weights,
    single_weights,
)
from adxl_ros.blind.world.run import Place, Run
from adxl_ros.blind.world.signals import pink_noise
from adxl_ros.blind.world.unit import ADC_BITS, LSB_V, Unit
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


KINDS = (
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
