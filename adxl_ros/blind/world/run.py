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

"""A recording while it is simulated: the quantities that faults change at their places."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
import math
import zlib

from adxl_ros.blind.world.unit import G0, Unit
import numpy as np


class Place(Enum):
    """Where in the chain a fault acts."""

    STAGE = 'stage'
    MOUNT = 'mount'
    ELEMENT = 'element'
    ELECTRONICS = 'electronics'
    WIRE = 'wire'
    SAMPLES = 'samples'


@dataclass
class Run:
    """
    A recording while it is simulated; n instants, m axes.

    Attributes
    ----------
    unit
        The sensor on its stage.
    t
        Instants, s, (n,): the fine grid, or the stamps at the place SAMPLES.
    seed
        Seed of all random numbers.
    alpha, beta
        Joint angles, rad, (n,).
    shift
        Position of the shaker, m, (n,).
    temperature, supply
        °C and V, (n,).
    up
        Direction that is up, in the base, (3,).
    gravity
        Local gravity, m/s².
    arm
        Position of the sensor off the axes of the stage, m, (3,).
    late, skew
        Delay of the samples, s, and its growth, s/s.
    corner_hz, second_hz
        Corners of the output filter's two poles, Hz.
    force
        Specific force in the sensor's frame, m/s², (3, n).
    directions
        Directions of x, y and z in the sensor's frame, one per row, (3, 3).
    u
        Input of the measured axes, g, (m, n).
    volts
        Output of the measured axes, V, (m, n).

    """

    unit: Unit
    t: np.ndarray
    seed: int
    alpha: np.ndarray
    beta: np.ndarray
    shift: np.ndarray
    temperature: np.ndarray
    supply: np.ndarray
    up: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    gravity: float = G0
    arm: np.ndarray = field(default_factory=lambda: np.zeros(3))
    late: float = 0.0
    skew: float = 0.0
    corner_hz: float = 0.0
    second_hz: float = math.inf
    force: np.ndarray = field(default_factory=lambda: np.zeros((3, 0)))
    directions: np.ndarray = field(default_factory=lambda: np.eye(3))
    u: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    volts: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def dt(self) -> float:
        """Return the step of the grid, s."""
        return float(self.t[1] - self.t[0])

    def random(self, stream: str) -> np.random.Generator:
        """Return the random generator of a stream; other faults do not change it."""
        return np.random.default_rng([self.seed, zlib.crc32(stream.encode())])
