# SPDX-License-Identifier: Apache-2.0

"""A manoeuvre: motion of joints and surroundings over time; and a stage that moves by commands."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import exp
from types import MappingProxyType
from typing import Protocol

from adxl_ros.errors import UserError
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Components, Need
from adxl_ros.model.sensor import Sensor
import numpy as np
import scipy

INTERNAL_RATE_HZ = 1000.0
"""Lowest rate at which the chain runs, Hz; chosen: slow samples then get the motion between
them, up to the bandwidth of the sensor."""


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


class Knots:
    """
    A path through knots, by polynomials of degree 5 with continuous second derivatives.

    Between two knots at rest it is the motion of minimum jerk, 10·u³ − 15·u⁴ + 6·u⁵.
    """

    def __init__(self, time_s: Sequence[float] | np.ndarray,
                 position: Sequence[float] | np.ndarray,
                 velocity: Sequence[float] | np.ndarray | None = None) -> None:
        """Interpolate ascending knots, (k,); second derivatives there are 0."""
        rates = np.zeros(len(time_s)) if velocity is None else np.asarray(velocity, float)
        derivatives = np.column_stack([position, rates, np.zeros(len(time_s))])
        pieces = scipy.interpolate.PPoly.from_bernstein_basis(
            scipy.interpolate.BPoly.from_derivatives(time_s, derivatives))
        self._orders = [pieces, pieces.derivative(), pieces.derivative(2)]
        self._begin_s, self._end_s = float(time_s[0]), float(time_s[-1])

    def __call__(self, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        """Return a derivative; see `Path`."""
        values = self._orders[order](np.clip(time_s, self._begin_s, self._end_s))
        if order and len(time_s) and (time_s[0] < self._begin_s or time_s[-1] > self._end_s):
            values[(time_s < self._begin_s) | (time_s > self._end_s)] = 0.0
        return values


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


POINTS = 6  # Points of the polynomial between the steps of a grid; chosen: as exact as the filters


def lagrange_weights(position: np.ndarray) -> np.ndarray:
    """Return the weights of `POINTS` steps for interpolation at positions, (n, points)."""
    nodes = np.arange(POINTS)
    return np.column_stack([
        np.prod([(position - k) / (j - k) for k in nodes if k != j], axis=0) for j in nodes])


def check_needs(sensor: Sensor, motion: Motion) -> None:
    """Refuse an effect that has nothing to act on."""
    has_stage, is_robot = motion.force is None, getattr(motion.force, 'is_robot', False)
    missing = {
        Need.STAGE: (has_stage, 'this manoeuvre has none, only specific force'),
        Need.ROTATION: (has_stage or is_robot, 'it is not known beside a specific force'),
        Need.ROBOT: (is_robot, 'the motion is not that of a robot; give --urdf'),
        Need.ADC: (sensor.adc_bits > 0, 'the sensor has none: sensor.adc_bits is 0'),
        Need.NOISE: (np.any(sensor.noise_density_g_per_rthz),
                     'the sensor has none: sensor.noise_density_g_per_rthz is 0')}
    for name in sensor.effects:
        for need in effect_named(name).needs:
            is_there, reason = missing.get(need, (True, ''))
            if not is_there:
                raise UserError(f'{name} acts on the {need.value}, but {reason}; leave the effect '
                                'out')


JOINTS = ('alpha', 'beta', 'shift')  # Names of the joints, in the order of all arrays
_REACH = {'alpha': 100.0, 'beta': 100.0, 'shift': 10.0}  # Largest positions. Chosen: 16 turns
_SETTLED = 6.638  # Root of (1 + x)·exp(−x) = 0.01: a critically damped step is within 1 %
_MIN_MOVE = 1e-9  # Distance at rest without encoder step, rad or m


class SimulatedStage:
    """
    True motion and encoders of the stage.

    All arrays are (3,): alpha, rad; beta, rad; shift, m. A reference moves to the goal at the slew
    rate, and the joint follows it as a critically damped system of second order. A time step is
    exact for a reference that is linear within it. A joint comes to rest within the encoder step
    of the command; its place in that step is random for each command.
    """

    def __init__(self, pose: np.ndarray, slew: np.ndarray, settling_s: float,
                 resolution: np.ndarray, seed: int) -> None:
        """Rest at a pose; `slew` is the largest velocity, and a resolution of 0 is exact."""
        self._slew, self._speed = slew, np.array(slew, float)
        self._omega, self._resolution = _SETTLED / settling_s, resolution
        self._rng = np.random.default_rng(seed)
        self._commanded = np.array(pose, float)
        self._goal = self._reachable(self._commanded)
        self._reference = self._goal.copy()
        self.position = self._goal.copy()  # True position, (3,)
        self.velocity = np.zeros(3)  # True velocity, (3,)

    def command(self, positions: Mapping[str, float],
                speeds: Mapping[str, float] = MappingProxyType({})) -> None:
        """Command joints to positions; a joint whose command does not change goes on."""
        target = self._commanded.copy()
        for name, position in positions.items():
            if name not in JOINTS:
                raise UserError(f'no joint {name!r}; the joints are {", ".join(JOINTS)}')
            if not abs(position) <= _REACH[name]:
                raise UserError(f'{name} = {position:g} is out of reach; the stage goes to '
                                f'+-{_REACH[name]:g}')
            target[JOINTS.index(name)] = position
        is_new = target != self._commanded
        if is_new.any():
            self._goal = np.where(is_new, self._reachable(target), self._goal)
            self._commanded = target
        for name in positions:
            joint = JOINTS.index(name)
            self._speed[joint] = min(self._slew[joint], abs(speeds.get(name, 0.0)) or np.inf)

    def step(self, dt_s: float) -> None:
        """Advance by a time step, s."""
        max_move = self._speed * dt_s
        reference = self._reference + np.clip(self._goal - self._reference, -max_move, max_move)
        rate = (reference - self._reference) / dt_s
        # x'' = w² (r - x) - 2 w x' behind a ramp r: x = r - 2 r'/w + (c + d t) exp(-w t).
        w, decay = self._omega, exp(-self._omega * dt_s)
        lag = self.position - (self._reference - 2 * rate / w)
        slope = self.velocity - rate + w * lag
        self.position = reference - 2 * rate / w + (lag + slope * dt_s) * decay
        self.velocity = rate + (slope - w * (lag + slope * dt_s)) * decay
        self._reference = reference

    def encoder(self) -> np.ndarray:
        """Return the readings of the encoders, rad, rad, m, (3,)."""
        # + 0.0 turns -0.0 into 0.0.
        return encoder_reading(self.position, self._resolution) + 0.0

    def moving(self) -> bool:
        """Return whether a joint is more than an encoder step from its goal."""
        distance = np.abs(self.position - self._goal)
        return bool((distance > np.maximum(self._resolution, _MIN_MOVE)).any())

    def _reachable(self, target: np.ndarray) -> np.ndarray:
        """Return where the joints come to rest for a target, (3,)."""
        return encoder_reading(target, self._resolution) \
            + self._resolution * self._rng.uniform(-0.5, 0.5, 3)
