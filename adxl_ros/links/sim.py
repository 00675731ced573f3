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

"""A simulated sensor on a stage that moves, or at rest in a pose."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from math import inf
import time
from typing import Any

from adxl_ros.links.support.base import Option, Samples, State
from adxl_ros.links.support.simulated_stage import JOINTS
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.response import Response
import numpy as np

OPTIONS = (
    Option('speed', 1.0, 'sensor time by real time; other than 1 with /clock', '', 0.01, 1000.0),
    Option('seed', 0, 'of the noise', '', 0, 2 ** 31 - 1),
    Option('alpha_rad', 0.0, 'pose while no stage is heard', 'rad', -100.0, 100.0),
    Option('beta_rad', 0.0, 'pose while no stage is heard', 'rad', -100.0, 100.0),
)

_AHEAD_NS = 50_000_000
"""Samples are made in blocks of this length, which costs less than one by one."""
_BLOCK = 4096
_LOST_S = 1.0
"""A stage that says nothing for so long of steady time is lost."""
_FOREIGN_NS = 2_000_000_000
"""A stage whose stamps are farther from the samples' than this lives by another clock."""
_GAP_NS = 50_000_000
"""Over a longer gap in what the stage says the pose is held, not interpolated."""
_BEAT_NS = 10_000_000
"""The first sample is on a multiple of this, as the stage's stamps are: no reference lies between
samples."""
_FOR_EVER_NS = 2 ** 63 - 1


def open_link(sensor: Sensor, options: Mapping[str, Any]) -> SimulatedSensor:
    """Make the sensor in the pose that the options name."""
    return SimulatedSensor(sensor, [options['alpha_rad'], options['beta_rad'], 0.0],
                           options['seed'])


class SimulatedSensor:
    """
    The chain of effects run forward, behind the stage's true motion where one is heard.

    The stage says where it will be some time ahead; samples are made up to the newest of that,
    so that sensor time waits for the stage, and the sensor feels the motion exactly at its
    samples. A stage that falls silent is waited for for a second; then its last pose is held.
    """

    live = False
    references = ()
    waits = False
    start_ns = None

    def __init__(self, sensor: Sensor, pose: list[float], seed: int) -> None:
        """Rest in a pose: alpha, beta, rad, and shift, m."""
        self.sensor = sensor
        self._seed = seed
        # Motion of the joints: stamp, position, velocity of each, (k, 1 + 3 + 3).
        self._motion = [(0, *pose, 0.0, 0.0, 0.0)]
        self._respond = self._settled()
        self._heard_s = -inf
        self._state = State('ok', 'at rest, no stage')
        self._origin_ns = self._made = self._until_ns = 0
        self._stamps, self._volts = np.zeros(0, np.int64), np.zeros((0, len(sensor.axes)))

    def feel(self, stamp_ns: int, position: Mapping[str, float],
             velocity: Mapping[str, float]) -> None:
        """
        Take where the stage truly is, or will be, at a stamp.

        Parameters
        ----------
        stamp_ns
            ROS time, ns.
        position, velocity
            By joint, rad or m and their rates; a joint that is not named stays.

        """
        if not np.isfinite([*position.values(), *velocity.values()]).all():
            self._state = State('warn', f'stage/true_joint_states: not finite: {position}')
            return
        if abs(stamp_ns - self._until_ns) > _FOREIGN_NS:
            self._state = State('warn', 'the stage lives by another clock, '
                                f'{(stamp_ns - self._until_ns) * 1e-9:+.1f} s from the sensor; '
                                'set use_sim_time for both or for none')
            return
        # A stage that was started anew says it again, from where it is now.
        while len(self._motion) > 1 and self._motion[-1][0] >= stamp_ns:
            self._motion.pop()
        last = self._motion[-1]
        self._motion.append((stamp_ns, *(position.get(j, last[1 + i])
                                         for i, j in enumerate(JOINTS)),
                             *(velocity.get(j, 0.0) for j in JOINTS)))
        self._heard_s = time.monotonic()
        self._state = State('ok', 'on the stage')

    def begin(self, now_ns: int) -> int:
        """Let the next sample be due now; return the samples that are left out."""
        skipped = self._skipped(now_ns)
        self._origin_ns = -(-now_ns // _BEAT_NS) * _BEAT_NS
        self._made, self._until_ns = 0, now_ns
        self._stamps, self._volts = self._stamps[:0], self._volts[:0]
        self._motion = [(0, *self._motion[-1][1:4], 0.0, 0.0, 0.0)]
        self._respond = self._settled()
        return skipped

    def read(self, now_ns: int) -> Samples:
        """Return the samples up to now, or up to where the stage's motion is known."""
        until = max(self._until_ns, min(now_ns, self._known_ns()))
        while until >= self._stamp(self._made):
            self._make(until)
        due = int(np.searchsorted(self._stamps, until, 'right'))
        samples = Samples(self._stamps[:due], self._volts[:due], until)
        self._stamps, self._volts = self._stamps[due:], self._volts[due:]
        self._until_ns = until
        return samples

    def state(self) -> State:
        """Say whether there is a stage."""
        return self._state

    def close(self) -> None:
        """Nothing is open."""

    def _skipped(self, now_ns: int) -> int:
        gap_s = (now_ns - self._until_ns) * 1e-9
        return round(gap_s * self.sensor.rate_hz) if self._until_ns and gap_s > 0 else 0

    def _stamp(self, index: float | np.ndarray) -> np.ndarray:
        """Return the times of samples by their numbers, ns."""
        return self._origin_ns + np.rint(index * (1e9 / self.sensor.rate_hz)).astype(np.int64)

    def _known_ns(self) -> int:
        """Time up to which the motion is known: for ever while there is no stage."""
        if self._heard_s == -inf:
            return _FOR_EVER_NS
        if time.monotonic() - self._heard_s < _LOST_S:
            return self._motion[-1][0]
        self._heard_s = -inf
        self._state = State('warn', 'stage lost: nothing on stage/true_joint_states for '
                            f'{_LOST_S:g} s, its last pose is held')
        return _FOR_EVER_NS

    def _make(self, until: int) -> None:
        """Make samples up to a time, and ahead of it as far as the motion is known."""
        ahead = min(until + _AHEAD_NS, self._known_ns())
        stamps = self._stamp(self._made + np.arange(_BLOCK, dtype=float))
        stamps = stamps[:np.searchsorted(stamps, ahead, 'right')]
        self._made += len(stamps)
        volts = self._respond((stamps - self._origin_ns) * 1e-9)
        self._stamps = np.concatenate([self._stamps, stamps])
        self._volts = np.concatenate([self._volts, volts])
        while len(self._motion) > 1 and self._motion[1][0] <= stamps[-1]:
            del self._motion[0]

    def _settled(self) -> Response:
        """Let the sensor be at rest where the stage is; its noise is new each time."""
        joints = [partial(self._joint, j) for j in range(len(JOINTS))]
        self._seed += 1
        return Response(self.sensor, Motion(inf, *joints), self._seed - 1)

    def _joint(self, joint: int, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        """Interpolate a joint at times since the origin, s, (n,); see `motion.Path`."""
        stamps = self._origin_ns + np.rint(time_s * 1e9).astype(np.int64)
        knots = np.array([m[0] for m in self._motion], np.int64)
        at = np.array([(m[1 + joint], m[4 + joint]) for m in self._motion])
        left = (np.searchsorted(knots, stamps) - 1).clip(0)
        right = (left + 1).clip(max=len(knots) - 1)
        step_ns = knots[right] - knots[left]
        held = (step_ns <= 0) | (step_ns > _GAP_NS)
        h = np.where(held, 1, step_ns) * 1e-9
        u = np.where(held, 0.0, (stamps - knots[left]) * 1e-9 / h)
        (p0, v0), (p1, v1) = at[left].T, at[right].T
        v0, v1 = np.where(held, 0.0, v0 * h), v1 * h
        # Cubic Hermite: exact in position and velocity at the stage's stamps.
        square, cube = 3 * (p1 - p0) - 2 * v0 - v1, 2 * (p0 - p1) + v0 + v1
        if order == 0:
            return p0 + u * (v0 + u * (square + u * cube))
        moving = np.where(held, 0.0, v0 + u * (2 * square + 3 * u * cube) if order == 1
                          else (2 * square + 6 * u * cube) / h)
        return moving / h
