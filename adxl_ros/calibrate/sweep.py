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

"""
The guided sweep, free of ROS: samples and encoder angles in, accepted poses out.

A pose goes through: the stage arrives (or the operator captures), the sensor comes to rest, a
full dwell at rest is averaged. Motion during the dwell begins it anew.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from adxl_ros.calibrate.plan import Target
from adxl_ros.calibrate.recorded import known_noise
from adxl_ros.calibrate.rests import Rest, rest_means, RestFinder
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.sensor import Sensor
import numpy as np

STAGE_MODES = ('commanded', 'encoder', 'manual')
_KEPT_ANGLES = 100000


@dataclass(frozen=True)
class Settings:
    """How poses are taken; times are sensor time."""

    dwell_s: float
    tolerance_rad: float
    timeout_s: float
    stage_mode: str


@dataclass(frozen=True)
class State:
    """
    What the sweep waits for.

    Attributes
    ----------
    phase
        'operator', 'stage', 'rest', 'dwell' or 'done'.
    text
        The same for people, with figures.
    late
        Whether it has waited longer than the time-out.

    """

    phase: str
    text: str
    late: bool


class Sweep:
    """
    Walks the targets that are left.

    Parameters
    ----------
    sensor
        The nominal sensor of the stream; its noise decides what is at rest.
    targets
        The whole plan.
    done
        How many of its poses are there already.

    """

    def __init__(self, sensor: Sensor, targets: Sequence[Target], done: int, settings: Settings):
        self.settings = settings
        self.index = done
        self._sensor = sensor
        self._targets = targets
        self._angles: deque[tuple[int, float, float]] = deque(maxlen=_KEPT_ANGLES)
        self._since_ns: int | None = None
        self._newest_ns: int | None = None
        self._begin()

    @property
    def target(self) -> Target | None:
        """Return the pose to go to; None at the end."""
        return self._targets[self.index] if self.index < len(self._targets) else None

    def move(self, index: int) -> None:
        """Go on with the pose of that number (from 0)."""
        self.index = index
        self._since_ns = self._newest_ns
        self._begin()

    def capture(self) -> None:
        """Take the pose in which the operator has put the sensor."""
        self._restart()
        self._arrived_ns = self._newest_ns or 0
        self._captured = True

    def stage(self, stamp_ns: int, alpha_rad: float, beta_rad: float) -> None:
        """Take an encoder reading."""
        self._angles.append((stamp_ns, alpha_rad, beta_rad))
        target = self.target
        if self.settings.stage_mode != 'commanded' or target is None:
            return
        off_rad = max(abs(alpha_rad - target.alpha_rad), abs(beta_rad - target.beta_rad))
        arrived = off_rad <= self.settings.tolerance_rad
        if arrived and not self._captured:
            self._restart()
        self._captured = arrived

    def feed(self, stamps_ns: np.ndarray, volts: np.ndarray) -> None:
        """Take samples: stamps, ns, (n,), and volts, (n, m)."""
        if not len(stamps_ns):
            return
        self._newest_ns = int(stamps_ns[-1])
        if self._since_ns is None:
            self._since_ns = int(stamps_ns[0])
        if not self._captured:
            return
        # What was sampled before the stage arrived is no part of the pose.
        new = stamps_ns >= self._arrived_ns
        stamps_ns, volts = stamps_ns[new], volts[new]
        self._stamps.append(stamps_ns)
        self._volts.append(volts)
        # From the arrival: float64 seconds since 1970 resolve only 0.2 µs.
        self._finder.feed((stamps_ns - self._arrived_ns) * 1e-9, volts)

    def accept(self) -> dict[str, Any] | None:
        """Return the pose for the journal when a full dwell at rest is there, else None."""
        target = self.target
        if target is None or not self._captured or not self._stamps:
            return None
        wanted = round(self.settings.dwell_s * self._sensor.rate_hz)
        rest = next((r for r in self._finder.rests() if r.stop - r.start >= wanted), None)
        if rest is None:
            return None
        stamps, volts = np.concatenate(self._stamps), np.concatenate(self._volts)
        start, stop = rest.start, rest.start + wanted
        times = (stamps - self._arrived_ns) * 1e-9
        mean, std = rest_means(times, volts, [Rest(start, stop, times[start], times[stop - 1])],
                               self._sensor.rate_hz, known_noise(self._sensor))
        first_ns, last_ns = int(stamps[start]), int(stamps[stop - 1])
        alpha, beta = self._angle_between(first_ns, last_ns, target)
        return {'pose': self.index, 'alpha_rad': alpha, 'beta_rad': beta, 'check': target.check,
                'start_ns': first_ns, 'stop_ns': last_ns, 'samples': wanted,
                'mean_v': mean[0].tolist(), 'std_v': std[0].tolist()}

    def results(self, accepted: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
        """Return the poses to fit: all that were accepted."""
        return list(accepted)

    def state(self) -> State:
        """Say what is waited for, and by how much it is off."""
        target = self.target
        if target is None:
            return State('done', 'all poses are taken', False)
        waited_s = ((self._newest_ns or 0) - (self._since_ns or 0)) * 1e-9
        late = waited_s > self.settings.timeout_s
        since = f' for {waited_s:.0f} s' if late else ''
        where = f'alpha {np.degrees(target.alpha_rad):.1f}, ' \
                f'beta {np.degrees(target.beta_rad):.1f} deg'
        if not self._captured:
            if self.settings.stage_mode != 'commanded':
                return State('operator', f'turn the stage to {where}, then capture', False)
            return State('stage', f'the stage has not arrived at {where}{since}: '
                                  f'{self._off_text(target)}', late)
        still = self._finder.stillness()
        if still is None:
            return State('rest', f'at {where}: waiting for samples{since}', late)
        unit = G0_MPS2 / float(self._sensor.nominal_scale_v_per_g[still.axis])
        text = still.describe('m/s²', unit, self._sensor.axes)
        if still.still:
            return State('dwell', f'at {where}: averaging', late)
        return State('rest', f'at {where}: {text}{since}', late)

    def _begin(self) -> None:
        self._captured = False
        self._restart()

    def _restart(self) -> None:
        self._arrived_ns = self._angles[-1][0] if self._angles else 0
        self._finder = RestFinder(self._sensor.rate_hz, len(self._sensor.axes),
                                  known_noise(self._sensor), learn=False)
        self._stamps: list[np.ndarray] = []
        self._volts: list[np.ndarray] = []

    def _off_text(self, target: Target) -> str:
        if not self._angles:
            return 'nothing on stage/joint_states'
        _, alpha, beta = self._angles[-1]
        return ', '.join(
            f'{name} is {np.degrees(abs(now - wanted)):.2f} deg off'
            for name, now, wanted in (('alpha', alpha, target.alpha_rad),
                                      ('beta', beta, target.beta_rad))
            if abs(now - wanted) > self.settings.tolerance_rad) or 'arrived'

    def _angle_between(self, first_ns: int, last_ns: int, target: Target) -> tuple[float, float]:
        if self.settings.stage_mode == 'manual':
            return target.alpha_rad, target.beta_rad
        inside = [(a, b) for stamp, a, b in self._angles if first_ns <= stamp <= last_ns]
        alpha, beta = np.mean(inside or [self._angles[-1][1:]], axis=0)
        return float(alpha), float(beta)
