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

"""Faults that the library of effects does not hold."""

from __future__ import annotations

from typing import Any

from adxl_ros.blind.world.chain import Run
from adxl_ros.blind.world.fault_shapes import (
    Act,
    by_axis,
    column,
    Draw,
    low_pass,
    memory,
    ones,
    Shape,
)
from adxl_ros.blind.world.unit import G0
import numpy as np


def thermal_loop(run: Run, size: float, shape: Shape) -> None:
    """Lag behind the temperature's way: one zero while it warms, another while it cools."""
    run.u += size * column(shape) * memory(run.temperature, 2.0)


def creep(run: Run, size: float, shape: Shape) -> None:
    """Yield under load for seconds and come back as slowly (a soft glue)."""
    slow = low_pass(run.u, shape['lag'], run.dt)
    run.u += size * column(shape) * (slow - run.u)


def jump(run: Run, size: float, shape: Shape) -> None:
    """Jump once, for good (a bond that cracks)."""
    run.u += size * column(shape) * (run.t > shape['at'] * run.t[-1])


def loose_gain(run: Run, size: float, shape: Shape) -> None:
    """Lose some gain in spells (a contact that works loose)."""
    rng = run.random('loose')
    off = np.zeros_like(run.t)
    for start in rng.uniform(0, 0.9, 5) * run.t[-1]:
        off[(run.t > start) & (run.t < start + rng.uniform(3, 12))] = 1
    run.u *= 1 - size * np.abs(column(shape)) * low_pass(off, 0.05, run.dt)


def cogging(run: Run, size: float, shape: Shape) -> None:
    """Shake by the motor's poles while it turns."""
    speed = np.hypot(np.gradient(run.beta, run.dt), np.gradient(run.alpha, run.dt))
    run.u += size * column(shape) * np.tanh(speed / 0.2) * np.sin(
        shape['poles'] * (run.beta + run.alpha))


def rate_pull(run: Run, size: float, shape: Shape) -> None:
    """Shift with the rate of beta, oddly, and level off (a cable that drags)."""
    run.u += size * column(shape) * np.tanh(np.gradient(run.beta, run.dt) / 0.5)


def floor_sway(run: Run, size: float, shape: Shape) -> None:
    """Sway with the floor under the bench, in gusts."""
    rng = run.random('sway')
    gust = np.interp(run.t, np.linspace(0, run.t[-1], 12), rng.uniform(0, 1.6, 12))
    sway = size * gust * np.sin(2 * np.pi * shape['hertz'] * run.t)
    run.alpha += sway * np.cos(run.beta)
    run.beta += sway


def dead_zone(run: Run, size: float, shape: Shape) -> None:
    """Be dull about zero (a class B output)."""
    x = run.u / 0.12
    run.u -= size * column(shape) * x * np.exp(-x * x / 2)


def product(run: Run, size: float, shape: Shape) -> None:
    """Feel the product of the two other axes (a frame that shears)."""
    x, y, z = run.force / G0
    run.u += size * column(shape) * np.stack([y * z, x * z, x * y])[run.unit.which]


def bearing_bump(run: Run, size: float, shape: Shape) -> None:
    """Tilt where a ball of the bearing is dented, within some 20 degrees of one angle."""
    bump = size * np.exp(shape['sharp'] * (np.cos(run.beta - shape['at']) - 1))
    run.alpha += bump
    run.beta += bump


def _with(**bounds: tuple[float, float]) -> Draw:
    return lambda rng, unit: {**by_axis(rng, unit), **{
        name: float(rng.uniform(*pair)) for name, pair in bounds.items()}}


def _foreign(act: Act, place: str, draw: Draw = by_axis) -> dict[str, Any]:
    return {'place': place, 'act': act, 'draw': draw, 'spread': ones, 'start': 1e-3,
            'most': 0.05}


KINDS = {
    'thermal_loop': _foreign(thermal_loop, 'element'),
    'creep': _foreign(creep, 'element', _with(lag=(1.5, 8.0))),
    'jump': _foreign(jump, 'element', _with(at=(0.2, 0.8))),
    'loose_gain': _foreign(loose_gain, 'element'),
    'cogging': _foreign(cogging, 'element', _with(poles=(20.0, 60.0))),
    'rate_pull': _foreign(rate_pull, 'element'),
    'floor_sway': _foreign(floor_sway, 'stage', _with(hertz=(0.15, 0.6))),
    'dead_zone': _foreign(dead_zone, 'element'),
    'product': _foreign(product, 'element'),
    'bearing_bump': _foreign(bearing_bump, 'stage',
                             _with(sharp=(6.0, 20.0), at=(-3.1, 3.1))) | {'most': 0.01},
}
