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

"""Faults that look like noise: of the sensor, of the wire, of the samples."""

from __future__ import annotations

import math
from typing import Any

from adxl_ros.blind.world.chain import LSB, pink, Run
from adxl_ros.blind.world.fault_shapes import Act, by_axis, column, Draw, ones, Shape, vector
from adxl_ros.blind.world.unit import ADC_BITS, Unit
import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

_HEAVY_BITS = 5


def noise_excess(run: Run, size: float, shape: Shape) -> None:
    """Hiss more: white and heavy-tailed ahead of the filter, `size` g rms within 50 Hz."""
    hiss = run.random('hiss').laplace(size=run.volts.shape) / math.sqrt(2)
    run.volts += size * column(shape) * math.sqrt(0.5 / run.dt / 78.5) * hiss


def flicker(run: Run, size: float, shape: Shape) -> None:
    """Flicker: relaxations over four decades."""
    rng, slow = run.random('flicker'), np.arange(run.t[0], run.t[-1] + 0.05, 0.02)
    run.volts += size * column(shape) * np.stack([
        np.interp(run.t, slow, pink(slow, rng)) for _ in run.volts])


def bias_walk(run: Run, size: float, shape: Shape) -> None:
    """Wander: a step every second, rounded off."""
    rng, knots = run.random('walk'), np.arange(run.t[0] - 1, run.t[-1] + 2, 0.25)
    steps = rng.normal(size=(len(run.volts), len(knots))) * (np.arange(len(knots)) % 4 == 0)
    walks = gaussian_filter1d(np.cumsum(steps, axis=1), 1.5, axis=1)
    run.volts += size * column(shape) * np.stack([
        np.interp(run.t, knots, walk - walk[0]) for walk in walks])


def mains_hum(run: Run, size: float, shape: Shape) -> None:
    """Hum: a mains whose frequency wanders, with two harmonics that come and go."""
    rng, slow = run.random('mains'), np.arange(run.t[0], run.t[-1] + 1, 0.5)
    wander = gaussian_filter1d(rng.normal(size=len(slow)), 20)
    hertz = shape['hertz'] + 0.03 * wander / max(np.std(wander), 1e-9)
    phase = 2 * np.pi * np.cumsum(np.interp(run.t, slow, hertz)) * run.dt
    hum = np.sin(phase) + 0.3 * np.sin(3 * phase + 1.0) + 0.12 * np.sin(2 * phase)
    run.volts += size * column(shape) * (1 + 0.1 * np.sin(run.t / 17)) * hum


def spikes(run: Run, size: float, shape: Shape) -> None:
    """Spike at random, with a tail of a sample or two."""
    rng = run.random('spikes')
    hits = rng.random(run.volts.shape) < shape['rate'] * run.dt
    heights = rng.choice([-1.0, 1.0], hits.shape) * rng.lognormal(0, 0.4, hits.shape)
    run.volts += size * column(shape) * lfilter([1.0], [1.0, -0.25], hits * heights)


def stuck(run: Run, size: float, shape: Shape) -> None:
    """Repeat a sample of all axes, for `size` s on the average."""
    rng = run.random('stuck')
    starts = np.flatnonzero(rng.random(len(run.t)) < shape['rate'] * run.dt)
    lengths = rng.exponential(1.0, len(run.t))[starts] * size / run.dt
    for start, length in zip(starts, lengths):
        run.volts[:, start:start + 1 + int(length)] = run.volts[:, start:start + 1]


def quantisation(run: Run, size: float, shape: Shape) -> None:
    """Lose the low bits: steps of `size` V, that need not be a power of 2."""
    if size > LSB:
        step = size * np.maximum(np.abs(column(shape)), LSB / size)
        run.volts = np.floor(run.volts / step) * step + step / 2


def adc_inl(run: Run, size: float, shape: Shape) -> None:
    """Weigh the heavy bits wrongly, as a charge converter with unmatched capacitors does."""
    code = np.clip(run.volts / LSB, 0, 2 ** ADC_BITS - 1)
    whole = code.astype(np.int64)
    for i, w in enumerate(shape['w']):
        run.volts += size * w * 0.7 ** i * ((whole >> (ADC_BITS - 1 - i) & 1) - 0.5)


def _mains(rng: np.random.Generator, unit: Unit) -> Shape:
    return {**by_axis(rng, unit), 'hertz': float(rng.choice([50.0, 60.0]))}


def _at_rate(least: float, most: float) -> Draw:
    return lambda rng, unit: {**by_axis(rng, unit), 'rate': float(rng.uniform(least, most))}


def _disorder(act: Act, place: str, start: float, most: float,
              draw: Draw = by_axis) -> dict[str, Any]:
    return {'place': place, 'act': act, 'draw': draw, 'spread': ones, 'each': True,
            'start': start, 'most': most, 'random': True}


KINDS = {
    'noise_excess': _disorder(noise_excess, 'electronics', 1e-3, 0.1),
    'flicker': _disorder(flicker, 'electronics', 3e-4, 0.05),
    'bias_walk': _disorder(bias_walk, 'electronics', 1e-4, 0.05),
    'mains_hum': _disorder(mains_hum, 'wire', 1e-3, 0.1, _mains),
    'spikes': _disorder(spikes, 'samples', 0.05, 1.5, _at_rate(0.05, 0.3)),
    'stuck': _disorder(stuck, 'samples', 0.05, 1.0, _at_rate(0.03, 0.15)),
    'quantisation': _disorder(quantisation, 'samples', 1e-3, 0.08),
    'adc_inl': {'place': 'samples', 'act': adc_inl, **vector(_HEAVY_BITS), 'start': 1e-3,
                'most': 0.1},
}
