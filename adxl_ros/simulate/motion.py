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

"""A manoeuvre: what the joints of the stage and the surroundings do over time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from adxl_ros.model.effects.base import Components
import numpy as np
from scipy.interpolate import BPoly, PPoly

INTERNAL_RATE_HZ = 1000.0
"""The chain runs at least this fast, so that what lies between slow samples is felt, too."""


class Path(Protocol):
    """A quantity over time that can be differentiated."""

    def __call__(self, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        """Return the derivative of an order (0, 1 or 2) at times, (n,); at rest outside."""


@dataclass(frozen=True)
class Held:
    """Stays as it is."""

    value: float = 0.0

    def __call__(self, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        """See `Path`."""
        return np.full(len(time_s), 0.0 if order else self.value)


class Knots:
    """
    Runs through knots by polynomials of degree 5, continuous to the second derivative.

    Between two knots at rest that is the motion of least jerk, 10·u³ − 15·u⁴ + 6·u⁵.
    """

    def __init__(self, time_s: Sequence[float] | np.ndarray,
                 position: Sequence[float] | np.ndarray,
                 velocity: Sequence[float] | np.ndarray | None = None) -> None:
        """
        Take positions and, unless it is at rest there, velocities at ascending times.

        Parameters
        ----------
        time_s, position, velocity
            (k,) each; s, rad or m, and its rate.

        """
        rates = np.zeros(len(time_s)) if velocity is None else np.asarray(velocity, float)
        derivatives = np.column_stack([position, rates, np.zeros(len(time_s))])
        pieces = PPoly.from_bernstein_basis(BPoly.from_derivatives(time_s, derivatives))
        self._orders = [pieces, pieces.derivative(), pieces.derivative(2)]
        self._begin, self._end = float(time_s[0]), float(time_s[-1])

    def __call__(self, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        """See `Path`."""
        values = self._orders[order](np.clip(time_s, self._begin, self._end))
        if order and len(time_s) and (time_s[0] < self._begin or time_s[-1] > self._end):
            values[(time_s < self._begin) | (time_s > self._end)] = 0.0
        return values


@dataclass(frozen=True)
class Motion:
    """
    A manoeuvre from time 0 on.

    Attributes
    ----------
    duration_s
        How long it lasts.
    alpha, beta, shift
        Joints: rad, rad, m.
    temperature_c, supply_v
        Surroundings where they change or are measured; else the nominal ones.
    force
        Specific force in the case frame, m/s², three components by time, where no stage moves
        the sensor; the joints then mean nothing.
    internal_rate_hz
        Rate that follows what it does; see `INTERNAL_RATE_HZ`.

    """

    duration_s: float
    alpha: Path = Held()
    beta: Path = Held()
    shift: Path = Held()
    temperature_c: Path | None = None
    supply_v: Path | None = None
    force: Callable[[np.ndarray], Components] | None = None
    internal_rate_hz: float = INTERNAL_RATE_HZ
