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
"""Faults of stage, clock, mount, element and electronics, in forms other than the library's."""

from __future__ import annotations

from math import exp

from adxl_ros.model.constants import NOMINAL_TEMPERATURE_C
from adxl_ros.model.effects import cross_axis, cross_axis_z
from adxl_ros.model.effects.base import Joint, Place, Signals
from adxl_ros.model.filters import low_pass, resonator
from adxl_ros.model.play_operator import play
from adxl_ros.working.fault import (
    by_axis,
    by_axis_with,
    Kind,
    named,
    parts,
    scaled,
    Shape,
)
import numpy as np

_NOMINAL_V = 5.0
"""Supply of the nominal unit, V."""


def _stage_eccentricity(signals: Signals, size: float, shape: Shape) -> None:
    """Add three harmonics of the angle of falling size to both joints, rad."""
    for joint, (s, c) in zip(('alpha', 'beta'), (shape['w'][:2], shape['w'][2:])):
        q, v, a = getattr(signals, joint)
        error = slope = bend = 0.0
        for k, part in ((1, 1.0), (2, shape['second']), (4, 0.04)):
            error = error + part * size * (s * np.sin(k * q) + c * np.cos(k * q))
            slope = slope + part * size * k * (s * np.cos(k * q) - c * np.sin(k * q))
            bend = bend - part * size * k * k * (s * np.sin(k * q) + c * np.cos(k * q))
        setattr(signals, joint, Joint(q + error, v + slope * v, a + slope * a + bend * v * v))


def _backlash(signals: Signals, size: float, shape: Shape) -> None:
    """Follow by three dead bands of different widths, rad, as flanks that yield."""
    for joint, w in zip(('alpha', 'beta'), shape['w']):
        if w:
            read = getattr(signals, joint)
            bands = [play(read.position, part * abs(size * w) / 2,
                          signals.memory.setdefault((joint, part), {}))
                     for part in (0.5, 0.9, 1.3)]
            setattr(signals, joint, read._replace(position=sum(bands) / len(bands)))


def _clock_skew(signals: Signals, size: float, shape: Shape) -> None:
    """Drift by `size` s/s, slowly growing by some percent over the minutes."""
    t = signals.time_s
    signals.time_s = t - size * shape['w'][0] * t * (1 + shape['growth'] * t / 600.0)


def _mount_resonance(signals: Signals, size: float, shape: Shape) -> None:
    """Transmit a share `size` of the force by two modes."""
    hertz, damping = shape['hertz'], shape['damping']
    for d, w in enumerate(shape['w']):
        sensed = signals.sensed[d]
        if w:
            for k, (ratio, part) in enumerate(((1.0, 1.0), (2.2, 0.2))):
                moved = resonator(sensed, ratio * hertz, damping, signals.dt_s,
                                  signals.memory.setdefault((d, k), {}))
                signals.sensed[d] = signals.sensed[d] + size * abs(w) * part * (moved - sensed)


def _cross_axis(signals: Signals, size: float, shape: Shape) -> None:
    """Add even and odd powers of the other axis of the plane, g."""
    for d, w in enumerate(shape['w']):
        c = signals.sensed[cross_axis.OTHER[d]]
        signals.output[d] = signals.output[d] + size * w * (
            c * c * (1 - 0.3 * c * c) + shape['odd'] * c)


def _cross_axis_z(signals: Signals, size: float, shape: Shape) -> None:
    """Add the logarithm of a cosh of the axis out of the plane, and an odd part, g."""
    for d, w in enumerate(shape['w']):
        c = signals.sensed[cross_axis_z.OTHER[d]]
        signals.output[d] = signals.output[d] + size * w * (
            np.log(np.cosh(1.5 * c)) + shape['odd'] * c)


def _scale_factor_cross(signals: Signals, size: float, shape: Shape) -> None:
    """Change the scale factor by a sigmoid of the other axis of the plane."""
    for d, w in enumerate(shape['w']):
        signals.output[d] = signals.output[d] + size * w * signals.sensed[d] * np.tanh(
            1.2 * signals.sensed[cross_axis.OTHER[d]])


def _scale_factor_z(signals: Signals, size: float, shape: Shape) -> None:
    """Change the scale factor by a sigmoid of the axis out of the plane, off its middle."""
    for d, w in enumerate(shape['w']):
        z = signals.sensed[cross_axis_z.OTHER[d]]
        signals.output[d] = signals.output[d] + size * w * signals.sensed[d] * (
            np.tanh(1.2 * z + 0.4) - np.tanh(0.4))


def _nonlinearity(signals: Signals, size: float, shape: Shape) -> None:
    """Soften by the arc tangent, g."""
    for d, w in enumerate(shape['w']):
        x, bend = signals.sensed[d], shape['bend']
        signals.output[d] = signals.output[d] + size * w * (np.arctan(bend * x) / bend - x)


def _quadratic(signals: Signals, size: float, shape: Shape) -> None:
    """Add a power of the magnitude, between 1.5 and 2.5, g."""
    for d, w in enumerate(shape['w']):
        signals.output[d] = signals.output[d] + size * w * np.abs(
            signals.sensed[d]) ** shape['power']


def _hysteresis(signals: Signals, size: float, shape: Shape) -> None:
    """Lag by stops of uneven thresholds and weights, more at positive force, g."""
    for d, w in enumerate(shape['w']):
        x, lag = signals.sensed[d], 0.0
        if w:
            for threshold, part in ((0.15, 0.5), (0.45, 0.2), (1.4, 0.3)):
                reach = threshold * shape['reach']
                follower = play(x, reach, signals.memory.setdefault((d, threshold), {}))
                lag = lag + part * (x - follower) / reach
            signals.output[d] = signals.output[d] - size * w * lag * (1 + shape['skew'] * x)


def _saturation(signals: Signals, size: float, shape: Shape) -> None:
    """Approach a rail exponentially beyond a knee; the two rails differ by some percent."""
    knee = shape['knee']
    for d, w in enumerate(shape['w']):
        if not w:
            continue
        x = signals.output[d]
        for sign, ratio in ((1.0, 1.0), (-1.0, shape['lower'])):
            begin = (1.5 - size) * ratio - knee
            over = np.maximum(sign * x - begin, 0.0)
            x = x - sign * (over + knee * np.expm1(-over / knee))
        signals.output[d] = x


def _temperature_bias(signals: Signals, size: float, shape: Shape) -> None:
    """Shift the zero-g by a cubic law of a die that follows the thermometer late, g."""
    warmer = _die_k(signals, shape)
    law = warmer * (1 + shape['bend'] * warmer * (1 + 0.02 * warmer)) / 10.0
    for d, w in enumerate(shape['w']):
        signals.output[d] = signals.output[d] + size * w * law


def _temperature_scale(signals: Signals, size: float, shape: Shape) -> None:
    """Change the scale factor by a quadratic law of a late die."""
    warmer = _die_k(signals, shape)
    law = warmer * (1 + shape['bend'] * warmer) / 10.0
    for d, w in enumerate(shape['w']):
        signals.scale_v_per_g[d] = signals.scale_v_per_g[d] * (1 + size * w * law)


def _die_k(signals: Signals, shape: Shape) -> np.ndarray:
    """Return how much warmer than 25 °C the die is, K."""
    warmer = np.asarray(signals.environment.temperature_c, float) - NOMINAL_TEMPERATURE_C
    if not warmer.ndim:
        warmer = np.full(len(signals.environment.time_s), float(warmer))
    return low_pass(warmer, shape['late_s'], signals.dt_s,
                    signals.memory.setdefault('die', {}))


def _warm_up(signals: Signals, size: float, shape: Shape) -> None:
    """Settle by two time constants, or by a hyperbola, g."""
    t = signals.environment.time_s / shape['tau_s']
    law = 0.65 * np.exp(-t) + 0.35 * np.exp(-t / 4) if shape['kind'] < 0.5 else 1 / (1 + t)
    for d, w in enumerate(shape['w']):
        signals.output[d] = signals.output[d] + size * w * law


def _vibration_rectification(signals: Signals, size: float, shape: Shape) -> None:
    """Shift the zero-g by a mean power of the vibration, which is slower than 1 s, g."""
    for d, w in enumerate(shape['w']):
        x = signals.sensed[d]
        mean, power = (signals.memory.setdefault((d, i), {}) for i in range(2))
        vibration = np.abs(x - low_pass(x, 0.25, signals.dt_s, mean)) ** shape['power']
        signals.output[d] = signals.output[d] + size * w * low_pass(
            vibration, 0.8, signals.dt_s, power)


def _supply(signals: Signals, size: float, shape: Shape) -> None:
    """Follow the supply in proportion, with a square, behind a capacitor."""
    supply = np.asarray(signals.environment.supply_v, float)
    if not supply.ndim:
        return
    change = low_pass(supply / _NOMINAL_V - 1, shape['late_s'], signals.dt_s,
                      signals.memory.setdefault('supply', {}))
    law = change * (1 + shape['bend'] * change)
    for d, w in enumerate(shape['w']):
        signals.zero_g_v[d] = signals.zero_g_v[d] * (1 + size * w * law)
        signals.scale_v_per_g[d] = signals.scale_v_per_g[d] * (1 + size * w * law)


def _bandwidth(signals: Signals, size: float, shape: Shape) -> None:
    """Have another time constant, and a second pole far above it."""
    for d, w in enumerate(shape['w']):
        ratio = exp(size * w)
        second_s = shape['second'] * signals.rc_s[d]
        signals.rc_s[d] = signals.rc_s[d] * ratio
        if w:
            sensed = np.asarray(signals.output[d])
            signals.output[d] = low_pass(sensed, second_s * size, signals.dt_s,
                                         signals.memory.setdefault(d, {}))


def _draw_tilt(rng: np.random.Generator, axes: int) -> Shape:
    """Draw a tilt of the base; one about the axis of alpha alone is an offset of alpha."""
    return {'w': [float(rng.choice([-1.0, 1.0])), float(rng.uniform(-0.6, 0.6))]}


def _draw_turns(rng: np.random.Generator, axes: int) -> Shape:
    """Draw turns of the sensing axes; equal ones are an offset of the stage."""
    turns = rng.normal(size=(2, axes))
    if rng.random() < 0.3:
        turns *= np.arange(2 * axes).reshape(2, axes) == rng.integers(2 * axes)
    return {'w': turns[0].tolist(), 'v': turns[1].tolist()}


KINDS = (
    Kind('bias', Place.ELECTRONICS, None, 2e-3, 0.1, by_axis, scaled('offset_v')),
    Kind('scale_factor', Place.ELECTRONICS, None, 3e-3, 0.1, by_axis, scaled('offset_v_per_g')),
    Kind('gravity', Place.STAGE, None, 0.02, 0.09, parts(1), named('offset_mps2'), True),
    Kind('base_tilt', Place.STAGE, None, 2e-3, 0.05, _draw_tilt, named('x_rad', 'y_rad'), True),
    Kind('stage_offset', Place.STAGE, None, 2e-3, 0.05, parts(2),
         named('alpha_rad', 'beta_rad'), True),
    Kind('stage_eccentricity', Place.STAGE, _stage_eccentricity, 2e-3, 0.05,
         lambda rng, axes: {**parts(4)(rng, axes), 'second': float(rng.uniform(-0.15, 0.15))},
         named('alpha_sine_rad', 'alpha_cosine_rad', 'beta_sine_rad', 'beta_cosine_rad'), True),
    Kind('backlash', Place.STAGE, _backlash, 4e-3, 0.05,
         lambda rng, axes: {'w': [abs(w) for w in parts(2)(rng, axes)['w']]},
         named('alpha_rad', 'beta_rad')),
    Kind('lever_arm', Place.FORCE, None, 0.02, 0.5, parts(3), named('x_m', 'y_m', 'z_m'),
         needs='fast'),
    Kind('time_offset', Place.CLOCK, None, 5e-3, 0.2, parts(1), named('offset_s'), needs='fast'),
    Kind('clock_skew', Place.CLOCK, _clock_skew, 5e-5, 2e-3,
         lambda rng, axes: {**parts(1)(rng, axes), 'growth': float(rng.uniform(-0.1, 0.1))},
         named('ratio'), needs='fast'),
    Kind('misalignment', Place.MOUNTING, None, 3e-3, 0.05,
         _draw_turns,
         lambda size, shape: {'alpha_rad': [size * w for w in shape['w']],
                              'beta_rad': [size * v for v in shape['v']]}, True),
    Kind('mount_resonance', Place.MOUNTING, _mount_resonance, 0.3, 1.0,
         by_axis_with(hertz=(12.0, 45.0), damping=(0.03, 0.12)),
         lambda size, shape: {'gain': [size * abs(w) for w in shape['w']],
                              'frequency_hz': shape['hertz'], 'damping_ratio': shape['damping']},
         needs='shake'),
    Kind('cross_axis', Place.ELEMENT, _cross_axis, 3e-3, 0.1, by_axis_with(odd=(-0.5, 0.5)),
         lambda size, shape: {'quadratic_per_g': [size * w for w in shape['w']],
                              'linear': [shape['odd'] * size * w for w in shape['w']]}, True),
    Kind('cross_axis_z', Place.ELEMENT, _cross_axis_z, 3e-3, 0.1, by_axis_with(odd=(-0.5, 0.5)),
         lambda size, shape: {'quadratic_per_g': [size * w for w in shape['w']],
                              'linear': [shape['odd'] * size * w for w in shape['w']]}, True),
    Kind('scale_factor_cross', Place.ELEMENT, _scale_factor_cross, 5e-3, 0.1, by_axis,
         scaled('linear_per_g'), True),
    Kind('scale_factor_z', Place.ELEMENT, _scale_factor_z, 5e-3, 0.1, by_axis,
         lambda size, shape: {'linear_per_g': [size * w for w in shape['w']],
                              'quadratic_per_g2': [-0.3 * size * w for w in shape['w']]}, True),
    Kind('nonlinearity', Place.ELEMENT, _nonlinearity, 0.02, 0.5, by_axis_with(bend=(0.6, 1.2)),
         scaled('cubic_per_g2'), True),
    Kind('quadratic', Place.ELEMENT, _quadratic, 5e-3, 0.1, by_axis_with(power=(1.5, 2.5)),
         scaled('quadratic_per_g'), True),
    Kind('hysteresis', Place.ELEMENT, _hysteresis, 4e-3, 0.05,
         by_axis_with(reach=(0.08, 0.5), skew=(-0.3, 0.3)),
         lambda size, shape: {'half_width_g': [size * w for w in shape['w']],
                              'reach_g': shape['reach']}),
    Kind('vibration_rectification', Place.ELEMENT, _vibration_rectification, 0.3, 30.0,
         by_axis_with(power=(1.7, 2.4)),
         lambda size, shape: {'coefficient_per_g': [size * w for w in shape['w']],
                              'tau_s': 0.5}, needs='shake'),
    Kind('saturation', Place.ELECTRONICS, _saturation, 0.6, 1.2,
         by_axis_with(knee=(0.005, 0.05), lower=(0.96, 1.04)),
         lambda size, shape: {'limit_g': [1.5 - size if w else 1000.0 for w in shape['w']],
                              'knee_g': 0.0, 'offset_g': [0.0 for _ in shape['w']]}, True),
    Kind('temperature_bias', Place.ELECTRONICS, _temperature_bias, 3e-3, 0.1,
         by_axis_with(bend=(-0.03, 0.03), late_s=(0.5, 6.0)),
         lambda size, shape: {'per_k': [size * w / 10 for w in shape['w']],
                              'per_k2': [0.0 for _ in shape['w']]}, needs='heat'),
    Kind('temperature_scale', Place.ELECTRONICS, _temperature_scale, 5e-3, 0.2,
         by_axis_with(bend=(-0.03, 0.03), late_s=(0.5, 6.0)),
         lambda size, shape: {'per_k': [size * w / 10 for w in shape['w']],
                              'per_k2': [0.0 for _ in shape['w']]}, needs='heat'),
    Kind('warm_up', Place.ELECTRONICS, _warm_up, 5e-3, 0.1,
         by_axis_with(tau_s=(20.0, 150.0), kind=(0.0, 1.0)),
         lambda size, shape: {'amplitude_g': [size * w for w in shape['w']],
                              'tau_s': shape['tau_s']}),
    Kind('supply', Place.ELECTRONICS, _supply, 0.3, 3.0,
         by_axis_with(late_s=(0.05, 0.5), bend=(-3.0, 3.0)),
         lambda size, shape: {'zero_g_exponent': [size * w for w in shape['w']],
                              'scale_exponent': [size * w for w in shape['w']],
                              'nominal_v': _NOMINAL_V}, needs='supply'),
    Kind('bandwidth', Place.ELECTRONICS, _bandwidth, 0.3, 1.5, by_axis_with(second=(0.02, 0.1)),
         lambda size, shape: {'resistance_ratio': [exp(size * w) - 1 for w in shape['w']]},
         needs='fast'),
)
"""The kinds of this file."""
