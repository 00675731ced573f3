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
"""Faults of noise, ADC and link, which change the samples of a whole recording."""

from __future__ import annotations

from math import pi

from adxl_ros.model.effects import adc_inl
from adxl_ros.model.effects.base import Parameters, Place, Signals
from adxl_ros.model.filters import low_pass
from adxl_ros.working.fault import by_axis, by_axis_with, Kind, scaled, Shape
import numpy as np

_BITS = tuple(p.name for p in adc_inl.EFFECT.parameters if p.name.endswith('_bit_v'))
"""Parameters of the library's wrong bits, the heaviest first."""
_FILTER_S = 0.004
"""Time constant behind which excess noise arises, s; chosen: some 40 Hz."""


def _rng(signals: Signals) -> np.random.Generator:
    """Return the generator of the fault."""
    assert signals.rng is not None
    return signals.rng


def _add_g(signals: Signals, d: int, added_g: np.ndarray) -> None:
    """Add g, (n,), to the volts of an axis."""
    signals.volts[d] = signals.volts[d] + added_g * signals.nominal_scale_v_per_g[d]


def _noise_excess(signals: Signals, size: float, shape: Shape) -> None:
    """Add noise of heavy tails, g rms, behind the filter; on some units it is Gaussian."""
    for d, w in enumerate(shape['w']):
        count = len(signals.volts[d])
        drawn = _rng(signals).standard_t(shape['tails'], count)
        passed = low_pass(drawn, _FILTER_S, signals.dt_s, {})
        _add_g(signals, d, size * w * passed / max(float(passed.std()), 1e-9))


def _flicker(signals: Signals, size: float, shape: Shape) -> None:
    """Add noise whose density falls with another power of the frequency, g rms."""
    for d, w in enumerate(shape['w']):
        count = len(signals.volts[d])
        spectrum = np.fft.rfft(_rng(signals).standard_normal(2 * count))
        ratio = np.arange(len(spectrum), dtype=float)
        ratio[0] = np.inf
        drawn = np.fft.irfft(spectrum * ratio ** (-shape['power'] / 2))[:count]
        drawn -= drawn[0]
        _add_g(signals, d, size * w * drawn / max(float(drawn.std()), 1e-12))


def _bias_walk(signals: Signals, size: float, shape: Shape) -> None:
    """Add a walk whose power changes from part to part of the recording, g rms."""
    count = len(signals.environment.time_s)
    pieces = np.exp(shape['uneven'] * _rng(signals).standard_normal(8))
    power = np.interp(np.linspace(0, 7, count), np.arange(8), pieces)
    for d, w in enumerate(shape['w']):
        walk = np.cumsum(power * _rng(signals).standard_normal(count))
        _add_g(signals, d, size * w * (walk - walk[0]) / max(float(walk.std()), 1e-12))


def _mains_hum(signals: Signals, size: float, shape: Shape) -> None:
    """Add hum, V, off its nominal frequency, with the harmonics of a rectifier."""
    phase = 2 * pi * shape['hertz'] * signals.environment.time_s + shape['phase']
    wave = np.sin(phase) + shape['second'] * np.sin(2 * phase) + 0.15 * np.sin(5 * phase)
    for d, w in enumerate(shape['w']):
        signals.volts[d] = signals.volts[d] + size * w * wave


def _spikes(signals: Signals, size: float, shape: Shape) -> None:
    """Add spikes of one sign on most units, V, of exponential height."""
    for d, w in enumerate(shape['w']):
        count = len(signals.volts[d])
        hit = _rng(signals).random(count) < shape['rate_hz'] * signals.dt_s
        height = 0.4 + 0.6 * _rng(signals).exponential(size=count)
        sign = np.where(_rng(signals).random(count) < shape['up'], 1.0, -1.0)
        signals.volts[d] = signals.volts[d] + size * w * hit * height * sign


def _stuck(signals: Signals, size: float, shape: Shape) -> None:
    """Hold all axes for `size` s, more or less by a half."""
    count = len(signals.environment.time_s)
    starts = np.flatnonzero(_rng(signals).random(count) < shape['rate_hz'] * signals.dt_s)
    for start in starts:
        held = max(int(size * _rng(signals).uniform(0.5, 1.5) / signals.dt_s), 1)
        for d in range(len(signals.volts)):
            signals.volts[d][start:start + held + 1] = signals.volts[d][start]


def _quantisation(signals: Signals, size: float, shape: Shape) -> None:
    """Lose the low `size` bits by rounding, or by cutting off; single axes may lose none."""
    step = signals.lsb_v * 2.0 ** round(size)
    rounded = np.floor if shape['cut'] > 0.5 else np.rint
    for d, w in enumerate(shape['w']):
        if w:
            signals.volts[d] = rounded(signals.volts[d] / step) * step


def _adc_inl(signals: Signals, size: float, shape: Shape) -> None:
    """Bend the converter, V: some wrong bits, two sines, or a bow."""
    for d, volts in enumerate(signals.input_v):
        share = volts / signals.vref_v
        if shape['law'] < 0.5:
            error = sum(weight * (np.floor(share * 2 ** bit) % 2 - 0.5)
                        for bit, weight in enumerate(shape['bits'], 1))
        elif shape['law'] < 0.85:
            error = np.sin(2 * pi * shape['cycles'] * share + shape['phase']) \
                + 0.4 * np.sin(2 * pi * 2.6 * shape['cycles'] * share)
        else:
            x = 4 * (share - 0.5)
            error = x - x ** 3 + 0.5 * x ** 5
        signals.volts[d] = signals.volts[d] + size * error


def _draw_curve(rng: np.random.Generator, axes: int) -> Shape:
    """Draw a curve of the converter: two or three wrong bits, cycles and phase."""
    bits = np.zeros(6)
    chosen = rng.choice(6, int(rng.integers(1, 4)), replace=False)
    bits[chosen] = rng.choice([-1.0, 1.0], len(chosen)) * rng.uniform(0.4, 1.2, len(chosen))
    return {'law': float(rng.random()), 'bits': bits.tolist(),
            'cycles': float(np.exp(rng.uniform(np.log(2), np.log(30)))),
            'phase': float(rng.uniform(0, 2 * pi))}


def _curve(size: float, shape: Shape) -> Parameters:
    """Return the parameters of the library's curve: bits or a sine."""
    bits = shape['bits'] if shape['law'] < 0.5 else [0.0] * len(_BITS)
    size_v = 0.0 if shape['law'] < 0.5 else size
    return {'amplitude_v': size_v, 'cosine_v': 0.0, 'cycles': shape['cycles'],
            **{name: size * weight for name, weight in zip(_BITS, bits)}}


def _draw_hum(rng: np.random.Generator, axes: int) -> Shape:
    """Draw a line: 50 or 60 Hz with the tolerance of the mains."""
    return {**by_axis(rng, axes), 'hertz': float(rng.choice([50.0, 60.0]) + rng.normal(0, 0.02)),
            'phase': float(rng.uniform(0, 2 * pi)), 'second': float(rng.uniform(0, 0.3))}


KINDS = (
    Kind('noise_excess', Place.ADC, _noise_excess, 2e-3, 0.05, by_axis_with(tails=(3.5, 30.0))),
    Kind('flicker', Place.ADC, _flicker, 2e-3, 0.05, by_axis_with(power=(0.85, 1.25)),
         scaled('density_g_per_rthz')),
    Kind('bias_walk', Place.ADC, _bias_walk, 2e-3, 0.05, by_axis_with(uneven=(0.0, 0.7))),
    Kind('mains_hum', Place.ADC, _mains_hum, 3e-3, 0.1, _draw_hum,
         lambda size, shape: {'amplitude_v': [size * w for w in shape['w']],
                              'frequency_hz': shape['hertz'], 'phase_rad': shape['phase']}),
    Kind('spikes', Place.ADC, _spikes, 0.1, 2.0,
         by_axis_with(rate_hz=(0.05, 0.5), up=(0.3, 1.0)),
         lambda size, shape: {'rate_hz': shape['rate_hz'],
                              'amplitude_v': [abs(size * w) for w in shape['w']]}),
    Kind('adc_inl', Place.ADC, _adc_inl, 3e-3, 0.05, _draw_curve, _curve, True),
    Kind('quantisation', Place.CODE, _quantisation, 7.0, 11.0, by_axis_with(cut=(0.0, 1.0))),
    Kind('stuck', Place.CODE, _stuck, 0.1, 2.0,
         lambda rng, axes: {'rate_hz': float(rng.uniform(0.03, 0.2))},
         lambda size, shape: {'rate_hz': shape['rate_hz'], 'duration_s': size}),
)
"""The kinds of this file."""
