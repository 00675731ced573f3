# SPDX-License-Identifier: Apache-2.0

"""A stage that follows commands, with its encoders."""

from __future__ import annotations

from collections.abc import Mapping
from math import exp
from types import MappingProxyType

from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import JOINTS
from adxl_ros.simulate.motion import encoder_reading
import numpy as np

_NAMES = tuple(JOINTS)  # Names of the joints, in the order of all arrays
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

    def __init__(
        self,
        pose: np.ndarray,
        slew: np.ndarray,
        settling_s: float,
        resolution: np.ndarray,
        seed: int,
    ) -> None:
        """Rest at a pose; `slew` is the largest velocity, and a resolution of 0 is exact."""
        self._slew = slew
        self._speed = np.array(slew, float)
        self._omega = _SETTLED / settling_s
        self._resolution = resolution
        self._rng = np.random.default_rng(seed)
        self._commanded = np.array(pose, float)
        self._goal = self._reachable(self._commanded)
        self._reference = self._goal.copy()
        self.position = self._goal.copy()  # True position, (3,)
        self.velocity = np.zeros(3)  # True velocity, (3,)

    def command(
        self, positions: Mapping[str, float], speeds: Mapping[str, float] = MappingProxyType({})
    ) -> None:
        """Command joints to positions; a joint whose command does not change goes on."""
        target = self._commanded.copy()
        for name, position in positions.items():
            if name not in _NAMES:
                raise UserError(f'no joint {name!r}; the joints are {", ".join(_NAMES)}')
            if not abs(position) <= _REACH[name]:
                raise UserError(
                    f'{name} = {position:g} is out of reach; the stage goes to +-{_REACH[name]:g}'
                )
            target[_NAMES.index(name)] = position
        is_new = target != self._commanded
        if is_new.any():
            self._goal = np.where(is_new, self._reachable(target), self._goal)
            self._commanded = target
        for name in positions:
            joint = _NAMES.index(name)
            self._speed[joint] = min(self._slew[joint], abs(speeds.get(name, 0.0)) or np.inf)

    def step(self, dt_s: float) -> None:
        """Advance by a time step, s."""
        max_move = self._speed * dt_s
        reference = self._reference + np.clip(self._goal - self._reference, -max_move, max_move)
        rate = (reference - self._reference) / dt_s
        # x'' = w² (r - x) - 2 w x' behind a ramp r: x = r - 2 r'/w + (lag + slope t) exp(-w t).
        w = self._omega
        decay = exp(-self._omega * dt_s)
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
        return encoder_reading(target, self._resolution) + self._resolution * self._rng.uniform(
            -0.5, 0.5, 3
        )
