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

"""Faults of the stage, of its place on Earth and of the clock."""

from __future__ import annotations

from adxl_ros.blind.world.chain import Run
from adxl_ros.blind.world.fault_shapes import memory, Shape, vector, weights
from adxl_ros.blind.world.unit import G0, Unit
import numpy as np
from scipy.signal import bilinear, lfilter


def stage_offset(run: Run, size: float, shape: Shape) -> None:
    """Both joints' zeros are off."""
    run.alpha += size * shape['w'][0]
    run.beta += size * shape['w'][1]


def stage_eccentricity(run: Run, size: float, shape: Shape) -> None:
    """Add a Fourier series of the angle, three harmonics on beta and one on alpha."""
    c = np.asarray(shape['w'])
    beta, alpha = run.beta.copy(), run.alpha.copy()
    for h, less in ((1, 1.0), (2, 0.06), (3, 0.02)):
        run.beta += size * less * (c[0] * np.sin(h * beta) + c[1] * np.cos(h * beta))
    run.alpha += size * (c[2] * np.sin(alpha) + c[3] * np.cos(alpha))


def backlash(run: Run, size: float, shape: Shape) -> None:
    """Follow by a gap that closes exponentially (Dahl), as worn teeth under grease do."""
    if size:
        for joint, w in ((run.alpha, shape['w'][0]), (run.beta, shape['w'][1])):
            if w:
                joint -= 0.5 * size * abs(w) * memory(joint, abs(size * w))


def base_tilt(run: Run, size: float, shape: Shape) -> None:
    """Stand on a bench that is not level."""
    up = run.up + size * np.array([shape['w'][0], shape['w'][1], 0.0])
    run.up = up / np.linalg.norm(up)


def gravity(run: Run, size: float, shape: Shape) -> None:
    """Be somewhere else on Earth."""
    run.gravity = G0 * (1 + size * shape['w'][0])


def lever_arm(run: Run, size: float, shape: Shape) -> None:
    """Sit off the axes."""
    run.arm = size * np.asarray(shape['w'], float)


def time_offset(run: Run, size: float, shape: Shape) -> None:
    """Come late, or early."""
    run.late += size * shape['w'][0]


def clock_skew(run: Run, size: float, shape: Shape) -> None:
    """Run at another rate, which wanders a little with the oven."""
    run.skew += size * shape['w'][0]


def mount_resonance(run: Run, size: float, shape: Shape) -> None:
    """Add one mode of the bracket, which takes part in the motion by `size`."""
    w0, zeta, fs = 2 * np.pi * shape['hertz'], shape['zeta'], 1 / run.dt
    b, a = bilinear([-1.0, -2 * zeta * w0 * 0.2, 0.0], [1.0, 2 * zeta * w0, w0 * w0], fs)
    moved = run.force - run.force[:, :1]
    run.force += size * lfilter(b, a, moved)


def _resonance(rng: np.random.Generator, unit: Unit) -> Shape:
    return {'hertz': float(rng.uniform(14, 38)), 'zeta': float(rng.uniform(0.03, 0.12))}


def _resonances(unit: Unit) -> list[Shape]:
    return [{'hertz': hertz, 'zeta': 0.06} for hertz in (14.0, 20.0, 28.0, 38.0)]


def _sign(rng: np.random.Generator, unit: Unit) -> Shape:
    return {'w': rng.choice([-1.0, 1.0], 1)}


def _one(unit: Unit) -> list[Shape]:
    return [{'w': np.ones(1)}]


def _positive(rng: np.random.Generator, unit: Unit) -> Shape:
    return {'w': np.abs(weights(2, rng))}


KINDS = {
    'stage_offset': {'place': 'stage', 'act': stage_offset, **vector(2),
                     'start': 1e-3, 'most': 0.03},
    'stage_eccentricity': {'place': 'stage', 'act': stage_eccentricity, **vector(4),
                           'start': 1e-3, 'most': 0.03},
    'backlash': {'place': 'stage', 'act': backlash, 'draw': _positive,
                 'spread': lambda unit: [{'w': row} for row in np.eye(2)],
                 'start': 1e-3, 'most': 0.03, 'sizes': (0.3, 1.0, 4.0)},
    'base_tilt': {'place': 'stage', 'act': base_tilt, **vector(2), 'start': 1e-3, 'most': 0.03},
    'gravity': {'place': 'stage', 'act': gravity, 'draw': _sign, 'spread': _one,
                'start': 1e-3, 'most': 5e-3},
    'lever_arm': {'place': 'stage', 'act': lever_arm, **vector(3), 'start': 0.01, 'most': 0.3},
    'time_offset': {'place': 'stage', 'act': time_offset, 'draw': _sign, 'spread': _one,
                    'start': 1e-3, 'most': 0.1},
    'clock_skew': {'place': 'stage', 'act': clock_skew, 'draw': _sign, 'spread': _one,
                   'start': 1e-5, 'most': 1e-3},
    'mount_resonance': {'place': 'mount', 'act': mount_resonance, 'draw': _resonance,
                        'spread': _resonances, 'start': 0.1, 'most': 1.0},
}
