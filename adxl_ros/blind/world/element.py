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

"""Faults of the sensing element and of its electronics."""

from __future__ import annotations

import math
from typing import Any

from adxl_ros.blind.world.chain import Run
from adxl_ros.blind.world.fault_shapes import Act, by_axis, column, low_pass, ones, Shape, weights
from adxl_ros.blind.world.unit import G0, Unit
import numpy as np
from scipy.signal import butter, sosfilt

_ZERO_C = 273.15
_OFF_DIAGONAL = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))


def bias(run: Run, size: float, shape: Shape) -> None:
    """Shift the zero since it was calibrated."""
    run.volts += size * column(shape) * run.unit.scale_v_per_g[:, None]


def scale_factor(run: Run, size: float, shape: Shape) -> None:
    """Change the gain since it was calibrated."""
    run.u *= 1 + size * column(shape)


def misalignment(run: Run, size: float, shape: Shape) -> None:
    """Turn each sensing axis by itself; its direction stays of length 1."""
    for (row, col), w in zip(_OFF_DIAGONAL, shape['w']):
        run.directions[row, col] += size * w
    run.directions /= np.linalg.norm(run.directions, axis=1, keepdims=True)
    run.u = (run.directions @ run.force)[run.unit.which] / G0


def cross_axis(run: Run, size: float, shape: Shape) -> None:
    """Feel the other axis of the plane, evenly (a cosine's first arch)."""
    force = run.force / G0
    run.u[:2] += size * column(shape) * (1 - np.cos(1.2 * force[[1, 0]]))


def cross_axis_z(run: Run, size: float, shape: Shape) -> None:
    """Feel the force across the plane, exponentially."""
    run.u[:2] += size * column(shape) * np.expm1(run.force[2] / G0)


def scale_factor_z(run: Run, size: float, shape: Shape) -> None:
    """Change the gain with the force across the plane, exponentially."""
    run.u[:2] *= 1 + size * column(shape) * np.expm1(0.8 * run.force[2] / G0)


def nonlinearity(run: Run, size: float, shape: Shape) -> None:
    """Stiffen: a hyperbolic sine that is right at 0 and at full scale."""
    run.u += size * column(shape) * (np.sinh(1.4 * run.u) / math.sinh(1.4) - run.u)


def quadratic(run: Run, size: float, shape: Shape) -> None:
    """Bend the line: a hyperbola through the zero."""
    run.u += size * column(shape) * (np.sqrt(1 + 0.8 * run.u ** 2) - 1)


def saturation(run: Run, size: float, shape: Shape) -> None:
    """Clip softly, the sooner the larger the size (g off the range of 1.7 g)."""
    limit = 1.7 - size * np.abs(column(shape))
    run.u /= (1 + np.abs(run.u / limit) ** 40) ** (1 / 40)


def hysteresis(run: Run, size: float, shape: Shape) -> None:
    """Remember the way: Bouc and Wen's loop, exponent 2, with unequal branches."""
    every = max(int(0.004 / run.dt), 1)
    for row, w in zip(run.u, shape['w']):
        if w:
            z, loop = 0.0, []
            for step in np.diff(row[::every], prepend=row[0]).tolist():
                branch = 1.0 if step * z > 0 else -0.3
                z = min(max(z + step / 0.12 * (1 - branch * z * z), -1.0), 1.0)
                loop.append(z)
            row += size * w * np.interp(run.t, run.t[::every], loop)


def temperature_bias(run: Run, size: float, shape: Shape) -> None:
    """Shift the zero exponentially with temperature, from 25 degC."""
    run.u += size * column(shape) * np.expm1((run.temperature - 25.0) / 25.0)


def temperature_scale(run: Run, size: float, shape: Shape) -> None:
    """Change the gain as Arrhenius has it, from 25 degC."""
    inverse = 1 / (_ZERO_C + 25.0) - 1 / (_ZERO_C + run.temperature)
    run.u *= 1 + size * column(shape) * np.expm1(2500.0 * inverse)


def warm_up(run: Run, size: float, shape: Shape) -> None:
    """Settle after power-on by a stretched exponential."""
    since = np.clip(run.t + 3.0, 0, None)
    run.u += size * column(shape) * np.exp(-(since / shape['lag']) ** 0.75)


def vibration_rectification(run: Run, size: float, shape: Shape) -> None:
    """Shift the zero by the power of the vibration, which levels off."""
    fast = sosfilt(butter(2, 2.0, 'high', fs=1 / run.dt, output='sos'),
                   run.u - run.u[:, :1])
    power = low_pass(fast ** 2, 0.4, run.dt)
    run.u += size * column(shape) * power / (1 + 4 * power)


def supply(run: Run, size: float, shape: Shape) -> None:
    """Follow the supply by the power 1.13 (560 mV/g at 3 V), zero and gain alike."""
    run.volts *= 1 + size * column(shape) * ((run.supply / 5.0) ** 1.13 - 1)


def bandwidth(run: Run, size: float, shape: Shape) -> None:
    """Move the filter's corner; a slower one brings a second pole along."""
    factor = math.exp(-size * shape['w'][0])
    run.corner_hz *= factor
    if factor < 1:
        run.second_hz = 8 * run.corner_hz / (1 - factor)


def _settling(rng: np.random.Generator, unit: Unit) -> Shape:
    return {**by_axis(rng, unit), 'lag': float(rng.uniform(15, 50))}


def _settlings(unit: Unit) -> list[Shape]:
    return [{**ones(unit)[0], 'lag': lag} for lag in (15.0, 27.0, 50.0)]


def _limited(rng: np.random.Generator, unit: Unit) -> Shape:
    count = len(unit.axes)
    one = np.arange(count) == rng.integers(count)
    return {'w': one.astype(float) if rng.random() < 0.4 else np.ones(count)}


def _turned(rng: np.random.Generator, unit: Unit) -> Shape:
    return {'w': weights(2 * len(unit.axes), rng)}


def _turns(unit: Unit) -> list[Shape]:
    return [{'w': row} for row in np.eye(2 * len(unit.axes))]


def _each(act: Act, place: str, start: float, most: float) -> dict[str, Any]:
    return {'place': place, 'act': act, 'draw': by_axis, 'spread': ones, 'each': True,
            'start': start, 'most': most}


# Of the two axes in the plane, whether or not there is a third.
_PLANE = {'draw': lambda rng, unit: {'w': weights(2, rng)},
          'spread': lambda unit: [{'w': np.ones(2)}]}

KINDS = {
    'bias': _each(bias, 'electronics', 1e-3, 0.1),
    'scale_factor': _each(scale_factor, 'element', 1e-3, 0.05),
    'misalignment': {'place': 'element', 'act': misalignment, 'draw': _turned, 'spread': _turns,
                     'start': 1e-3, 'most': 0.05},
    'cross_axis': {**_each(cross_axis, 'element', 1e-3, 0.05), **_PLANE},
    'cross_axis_z': {**_each(cross_axis_z, 'element', 1e-3, 0.05), **_PLANE},
    'scale_factor_z': {**_each(scale_factor_z, 'element', 1e-3, 0.05), **_PLANE},
    'nonlinearity': _each(nonlinearity, 'element', 1e-3, 0.1),
    'quadratic': _each(quadratic, 'element', 1e-3, 0.1),
    'saturation': {**_each(saturation, 'element', 0.6, 1.1), 'draw': _limited,
                   'sizes': (0.8, 1.0, 1.3)},
    'hysteresis': _each(hysteresis, 'element', 1e-3, 0.03),
    'temperature_bias': _each(temperature_bias, 'element', 1e-3, 0.05),
    'temperature_scale': _each(temperature_scale, 'element', 1e-3, 0.1),
    'warm_up': {**_each(warm_up, 'element', 1e-3, 0.1), 'draw': _settling,
                'spread': _settlings},
    'vibration_rectification': _each(vibration_rectification, 'element', 1e-2, 3.0),
    'supply': _each(supply, 'electronics', 0.1, 1.5),
    'bandwidth': {'place': 'electronics', 'act': bandwidth, 'draw': lambda rng, unit: {
        'w': rng.choice([1.0, 1.0, -1.0], 1)}, 'spread': lambda unit: [{'w': np.ones(1)}],
        'start': 0.1, 'most': 1.0, 'sizes': (-1.0, 1.0, 4.0)},
}
