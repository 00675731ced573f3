# SPDX-License-Identifier: Apache-2.0

"""A manoeuvre: motion of joints and surroundings over time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from types import MappingProxyType
from typing import Protocol

from adxl_ros.model.effects.base import Components
from adxl_ros.simulate.smoothed_path import PathErrors
from adxl_ros.wording import option
import numpy as np
import scipy

INTERNAL_RATE_HZ = 1000.0
"""Lowest rate at which the chain runs, Hz; chosen: slow samples then get the motion between
them, up to the bandwidth of the sensor."""
POINTS = 6  # Points of the polynomial between the steps of a grid; chosen: as exact as the filters


class Path(Protocol):
    """A quantity over time with its derivatives."""

    def __call__(self, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        """Return a derivative at times, s, (n,); outside of its own range it is at rest."""


@dataclass(frozen=True)
class Held:
    """A constant quantity."""

    value: float = 0.0  # The constant

    def __call__(self, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        """Return a derivative; see `Path`."""
        return np.full(len(time_s), 0.0 if order else self.value)


class Pieces:
    """A path of piecewise polynomials."""

    def __init__(self, pieces: scipy.interpolate.PPoly) -> None:
        """Take the polynomials."""
        self._orders = [pieces, pieces.derivative(), pieces.derivative(2)]
        self._begin_s = float(pieces.x[0])
        self._end_s = float(pieces.x[-1])

    def __call__(self, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        """Return a derivative; see `Path`."""
        within_s = np.clip(time_s, self._begin_s, self._end_s)
        values = self._orders[order](within_s)
        if order:
            values[within_s != time_s] = 0.0
        return values


class Knots(Pieces):
    """
    A path through knots, by polynomials of degree 5 with continuous second derivatives.

    Between two knots at rest it is the motion of minimum jerk, 10·u³ − 15·u⁴ + 6·u⁵.
    """

    def __init__(
        self,
        time_s: Sequence[float] | np.ndarray,
        position: Sequence[float] | np.ndarray,
        velocity: Sequence[float] | np.ndarray | None = None,
    ) -> None:
        """Interpolate ascending knots, (k,); second derivatives there are 0."""
        rates = np.zeros(len(time_s)) if velocity is None else np.asarray(velocity, float)
        derivatives = np.column_stack([position, rates, np.zeros(len(time_s))])
        super().__init__(
            scipy.interpolate.PPoly.from_bernstein_basis(
                scipy.interpolate.BPoly.from_derivatives(time_s, derivatives)
            )
        )


@dataclass(frozen=True)
class Motion:
    """A manoeuvre from time 0 on."""

    duration_s: float  # Duration, s
    # alpha, beta, shift: Joints, rad, rad and m
    alpha: Path = Held()
    beta: Path = Held()
    shift: Path = Held()
    # temperature_c, supply_v: Temperature, °C, and supply voltage, V, if they change or are
    # measured; None for the nominal ones
    temperature_c: Path | None = None
    supply_v: Path | None = None
    # Maps times, s, (n,), to specific force in the case frame, m/s², three components, where no
    # stage moves the sensor. The joints then have no meaning.
    force: Callable[[np.ndarray], Components] | None = None
    internal_rate_hz: float = INTERNAL_RATE_HZ  # Lowest rate at which the chain runs, Hz

    @property
    def environment(self) -> dict[str, Path]:
        """Return temperature, °C, and supply, V, by name, as far as they change."""
        paths = {'temperature_c': self.temperature_c, 'supply_v': self.supply_v}
        return {name: path for name, path in paths.items() if path}


def encoder_reading(position: np.ndarray, resolution: float | np.ndarray) -> np.ndarray:
    """Round positions to the steps of an encoder; those of a resolution of 0 are exact."""
    with np.errstate(divide='ignore', invalid='ignore'):
        return np.where(resolution, np.rint(position / resolution) * resolution, position)


def lagrange_weights(position: np.ndarray) -> np.ndarray:
    """Return the weights of `POINTS` steps for interpolation at positions, (n, points)."""
    nodes = np.arange(POINTS)
    return np.column_stack(
        [np.prod([(position - k) / (j - k) for k in nodes if k != j], axis=0) for j in nodes]
    )


class ForcePath:
    """Specific force of a recording or of another simulator, as cubic splines."""

    is_robot = False  # Whether what follows is known
    wanders = False  # Whether it may drift slowly, as the estimated pose of a base
    modes: Mapping[str, np.ndarray] = MappingProxyType({})
    """Force at `time_s` per unit of each error of a robot, (n, 3)."""

    @property
    def name(self) -> str:
        """Return what it is, for people."""
        return option('sim').removesuffix('=')

    def __init__(self, time_s: np.ndarray, columns: np.ndarray) -> None:
        """Interpolate columns, (n, k), the first three of them specific force of the case."""
        self.time_s = time_s  # Times of the samples, s, (n,)
        self._columns = columns
        self._spline = scipy.interpolate.CubicSpline(time_s, columns)

    def at(self, time_s: np.ndarray) -> Components:
        """Return all columns at times, s, (n,); constant outside."""
        return list(self._spline(np.clip(time_s, self.time_s[0], self.time_s[-1])).T)

    def __call__(self, time_s: np.ndarray) -> Components:
        """Return the three components of the force at times, s, (n,), m/s²; constant outside."""
        return self.at(time_s)[:3]

    def rotation(self, time_s: np.ndarray) -> tuple[Components, Components] | None:
        """Return angular rate, rad/s, and acceleration, rad/s², in the frame; None if unknown."""
        return None

    def errors(self, time_s: np.ndarray, component: int) -> PathErrors:
        """Return the errors of a component at times, s, (n,), m/s²: none are known."""
        return PathErrors(np.zeros(len(time_s)), np.zeros(len(time_s)))

    def shifted(self, later_s: float) -> ForcePath:
        """Return the same force at later times, s."""
        later = copy(self)
        ForcePath.__init__(later, self.time_s + later_s, self._columns)
        return later
