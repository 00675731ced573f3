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

"""Faults of the stage, of its site and of the clock."""

from __future__ import annotations

from functools import partial

from adxl_ros.blind.world.fault import Act, FaultKind, Shape
from adxl_ros.blind.world.fault_shapes import (
    draw_weights,
    equal_weights,
    single_weights,
    weights,
)
from adxl_ros.blind.world.run import Place, Run
from adxl_ros.blind.world.signals import travel_memory
from adxl_ros.blind.world.unit import G0, Unit
import numpy as np
import scipy


def _stage_offset(run: Run, size: float, shape: Shape) -> None:
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
    if size:
        for joint, w in ((run.alpha, shape['w'][0]), (run.beta, shape['w'][1])):
            if w:
                joint -= 0.5 * size * abs(w) * travel_memory(joint, abs(size * w))


def _base_tilt(run: Run, size: float, shape: Shape) -> None:
    """Tilt the base, rad."""
    up = run.up + size * np.array([shape['w'][0], shape['w'][1], 0.0])
    run.up = up / np.linalg.norm(up)


def _gravity(run: Run, size: float, shape: Shape) -> None:
    """Change local gravity by a share, as at another site."""
    run.gravity = G0 * (1 + size * shape['w'][0])


def _lever_arm(run: Run, size: float, shape: Shape) -> None:
    """Shift the sensor off the axes of the stage, m."""
    run.arm = size * np.asarray(shape['w'], float)


def _time_offset(run: Run, size: float, shape: Shape) -> None:
    """Delay all samples, s."""
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


def _draw_resonance(rng: np.random.Generator, unit: Unit) -> Shape:
    return {'hertz': float(rng.uniform(14, 38)), 'zeta': float(rng.uniform(0.03, 0.12))}


def _resonances(unit: Unit) -> list[Shape]:
    return [{'hertz': hertz, 'zeta': 0.06} for hertz in (14.0, 20.0, 28.0, 38.0)]


def _draw_sign(rng: np.random.Generator, unit: Unit) -> Shape:
    return {'w': rng.choice([-1.0, 1.0], 1)}


def _draw_positive(rng: np.random.Generator, unit: Unit) -> Shape:
    return {'w': np.abs(weights(2, rng))}


def _weighted(name: str, act: Act, count: int, start: float,
              largest: float) -> FaultKind:
    """Return a kind with a number of independent weights."""
    return FaultKind(name, Place.STAGE, act, partial(draw_weights, count),
                     partial(single_weights, count), start, largest)


def _signed(name: str, act: Act, start: float, largest: float
            ) -> FaultKind:
    """Return a kind whose only weight is a sign."""
    return FaultKind(name, Place.STAGE, act, _draw_sign, partial(equal_weights, 1), start,
                     largest)


KINDS = (
    _weighted('stage_offset', _stage_offset, 2, start=1e-3, largest=0.03),
    _weighted('stage_eccentricity', _stage_eccentricity, 4, start=1e-3, largest=0.03),
    FaultKind('backlash', Place.STAGE, _backlash, _draw_positive, partial(single_weights, 2),
              start=1e-3, largest=0.03, sizes=(0.3, 1.0, 4.0)),
    _weighted('base_tilt', _base_tilt, 2, start=1e-3, largest=0.03),
    _signed('gravity', _gravity, start=1e-3, largest=5e-3),
    _weighted('lever_arm', _lever_arm, 3, start=0.01, largest=0.3),
    _signed('time_offset', _time_offset, start=1e-3, largest=0.1),
    _signed('clock_skew', _clock_skew, start=1e-5, largest=1e-3),
    FaultKind('mount_resonance', Place.MOUNT, _mount_resonance, _draw_resonance, _resonances,
              start=0.1, largest=1.0),
)
"""The kinds of this file, in the order of the table."""
