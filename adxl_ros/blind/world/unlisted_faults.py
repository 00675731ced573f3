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

"""Faults that the library of effects does not have."""

from __future__ import annotations

from functools import partial

from adxl_ros.blind.world.fault import Act, Draw, FaultKind, Shape
from adxl_ros.blind.world.fault_shapes import all_axes, by_axis, column
from adxl_ros.blind.world.run import Place, Run
from adxl_ros.blind.world.signals import low_pass, travel_memory
from adxl_ros.blind.world.unit import G0, Unit
import numpy as np


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


KINDS = (
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
