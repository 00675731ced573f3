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

"""A two-axis rotary stage with a linear third joint: what its motors do with a command."""

from __future__ import annotations

from collections.abc import Mapping
from math import exp

from adxl_ros.errors import UserError
from adxl_ros.simulate.simulator import encoder
import numpy as np

JOINTS = ('alpha', 'beta', 'shift')
_FARTHEST = {'alpha': 100.0, 'beta': 100.0, 'shift': 10.0}
_SETTLED = 6.638
"""Where the step response (1 + x)·exp(−x) of a critically damped system has 1 % to go."""


class SimulatedStage:
    """
    True motion and encoder of the stage, joint by joint, (3,) each: rad, rad, m.

    A reference runs to the goal at the slew rate; the joint follows it as a critically damped
    system of second order. A step of time is exact for a reference that is linear within it.
    The encoder brings a joint to the commanded one of its steps; where in that step it comes to
    rest is drawn anew with each command.
    """

    def __init__(self, pose: np.ndarray, slew: np.ndarray, settling_s: float,
                 resolution: np.ndarray, seed: int) -> None:
        """
        Rest at a pose.

        Parameters
        ----------
        pose
            Where it rests, rad, rad, m, (3,).
        slew
            Fastest motion, rad/s, rad/s, m/s, (3,).
        settling_s
            Time that the step response takes to 1 %, s.
        resolution
            Steps of the encoders, (3,); 0 for none.
        seed
            Of where in the encoder's step a joint comes to rest.

        """
        self._slew = slew
        self._omega = _SETTLED / settling_s
        self._resolution = resolution
        self._rng = np.random.default_rng(seed)
        self._wanted = np.array(pose, float)
        self._goal = self._reachable(self._wanted)
        self._reference = self._goal.copy()
        self.position = self._goal.copy()
        self.velocity = np.zeros(3)

    def command(self, wanted: Mapping[str, float]) -> None:
        """
        Set where joints shall go; a joint that is told what it knows goes on.

        Raises
        ------
        UserError
            An unknown joint, or a position that is no number or out of reach; no joint moves.

        """
        target = self._wanted.copy()
        for name, position in wanted.items():
            if name not in JOINTS:
                raise UserError(f'no joint {name!r}; the joints are {", ".join(JOINTS)}')
            if not abs(position) <= _FARTHEST[name]:
                raise UserError(f'{name} = {position:g} is out of reach; the stage goes to '
                                f'+-{_FARTHEST[name]:g}')
            target[JOINTS.index(name)] = position
        self._goal = np.where(target == self._wanted, self._goal, self._reachable(target))
        self._wanted = target

    def step(self, dt_s: float) -> None:
        """Advance by a time step, s."""
        most = self._slew * dt_s
        reference = self._reference + np.clip(self._goal - self._reference, -most, most)
        rate = (reference - self._reference) / dt_s
        # x'' = w^2 (r - x) - 2 w x' behind a ramp: x = r - 2 r'/w + (c + d t) exp(-w t).
        w, decay = self._omega, exp(-self._omega * dt_s)
        lag = self.position - (self._reference - 2 * rate / w)
        slope = self.velocity - rate + w * lag
        self.position = reference - 2 * rate / w + (lag + slope * dt_s) * decay
        self.velocity = rate + (slope - w * (lag + slope * dt_s)) * decay
        self._reference = reference

    def encoder(self) -> np.ndarray:
        """Read the encoders, rad, rad, m, (3,)."""
        # + 0.0 turns -0.0 into 0.0.
        return np.array([encoder(p, r) for p, r in zip(self.position, self._resolution)]) + 0.0

    def moving(self) -> bool:
        """Tell whether a joint is more than an encoder's step from its goal."""
        off = np.abs(self.position - self._goal)
        return bool((off > np.maximum(self._resolution, 1e-9)).any())

    def _reachable(self, target: np.ndarray) -> np.ndarray:
        on_step = np.array([encoder(p, r) for p, r in zip(target, self._resolution)])
        return on_step + self._resolution * self._rng.uniform(-0.5, 0.5, 3)
