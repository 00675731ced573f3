# SPDX-License-Identifier: Apache-2.0

"""A simulated sensor, on a stage that moves or at rest in a pose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from math import inf
from typing import NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import JOINTS
from adxl_ros.links.support.base import (
    FOREVER_NS,
    Level,
    Link,
    LinkStatus,
    option,
    PacedSettings,
    Samples,
    Watchdog,
)
from adxl_ros.links.support.self_test import EmulatedLine
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.response import Response
import numpy as np
from scipy.interpolate import CubicHermiteSpline

_AHEAD_NS = 50_000_000
"""Length of a block of samples, ns. Chosen: a block costs less than its samples one by one."""
_MAX_BLOCK = 4096  # Most samples of a block. Chosen: it bounds the memory at high sample rates
_LOST_S = 1.0
"""Silence after which a stage counts as lost, s of steady time. Chosen: a stage sends 100 poses a
second."""
_LONGEST_TURN_S = 0.1
"""Longest time between two reads that counts as silence, s. Chosen: ten poses of a stage."""
_FOREIGN_NS = 2_000_000_000
"""Largest distance between the stamps of stage and samples, ns. A larger one is another clock."""
_GAP_NS = 50_000_000
"""Longest gap in the stage's motion that is interpolated, ns. Over a longer one the pose is held.
Chosen: five of the stage's steps."""
_BEAT_NS = 10_000_000
"""The first sample lies on a multiple of this, ns, as the stage's stamps do. So every reference
has a sample of its own."""


@dataclass(frozen=True)
class Settings(PacedSettings):
    """Settings of the link."""

    seed: int = option(0, 'seed of the noise', '', 0, 2**31 - 1)
    # alpha_rad, beta_rad: Pose without a stage, rad
    alpha_rad: float = option(0.0, 'pose without a stage', 'rad', -100.0, 100.0)
    beta_rad: float = option(0.0, 'pose without a stage', 'rad', -100.0, 100.0)


class _JointKnot(NamedTuple):
    """Motion of the joints at one stamp."""

    stamp_ns: int  # ROS time, ns
    position: tuple[float, ...]  # alpha, rad; beta, rad; shift, m
    velocity: tuple[float, ...]  # Their rates, rad/s and m/s


def open_link(sensor: Sensor, settings: Settings) -> SimulatedSensor:
    """Open the link with the sensor at rest."""
    return SimulatedSensor(sensor, settings)


class SimulatedSensor(Link):
    """
    The signal chain forward in time, driven by the true motion of the stage.

    The stage publishes its motion some time ahead. Samples are made up to the newest stamp of that
    motion, so sensor time waits for the stage and each sample has the exact motion. The link waits
    for a silent stage for one second; then it holds the last pose.
    """

    live = False
    joint_state_topic = 'stage/true_joint_states'

    sensor: Sensor

    def __init__(self, sensor: Sensor, settings: Settings) -> None:
        self.sensor = sensor
        self._seed = settings.seed
        self._knots = [_resting((settings.alpha_rad, settings.beta_rad, 0.0))]
        self._respond = self._settled_response()
        self._line = EmulatedLine(sensor)
        self._watchdog: Watchdog | None = None
        self._status = LinkStatus(Level.OK, 'at rest, no stage')
        self._origin_ns = self._made = self._until_ns = self._next_ns = 0
        self._stamps = np.zeros(0, np.int64)
        self._volts = np.zeros((0, len(sensor.axes)))

    def sense_stage(
        self, stamp_ns: int, position: Mapping[str, float], velocity: Mapping[str, float]
    ) -> None:
        """Take the true motion of the stage at a stamp, which may lie ahead."""
        if not np.isfinite([*position.values(), *velocity.values()]).all():
            self._status = LinkStatus(
                Level.WARN, f'{self.joint_state_topic}: not finite: {position}'
            )
            return
        if abs(stamp_ns - self._until_ns) > _FOREIGN_NS:
            self._status = LinkStatus(
                Level.WARN,
                'the stage lives by another clock, '
                f'{(stamp_ns - self._until_ns) * 1e-9:+.1f} s from the sensor; set use_sim_time '
                'for both or for none',
            )
            return
        # A stage that has started again publishes these stamps a second time, from its new pose.
        while len(self._knots) > 1 and self._knots[-1].stamp_ns >= stamp_ns:
            self._knots.pop()
        previous = self._knots[-1].position
        self._knots.append(
            _JointKnot(
                stamp_ns,
                tuple(position.get(joint, previous[i]) for i, joint in enumerate(JOINTS)),
                tuple(velocity.get(joint, 0.0) for joint in JOINTS),
            )
        )
        self._watchdog = self._watchdog or Watchdog(_LONGEST_TURN_S)
        self._watchdog.feed()
        self._status = LinkStatus(Level.OK, 'on the stage')

    def begin(self, now_ns: int) -> int:
        """Make the next sample due now; return the number of samples that are skipped."""
        gap_s = (now_ns - self._until_ns) * 1e-9
        skipped = round(gap_s * self.sensor.rate_hz) if self._until_ns and gap_s > 0 else 0
        self._origin_ns = -(-now_ns // _BEAT_NS) * _BEAT_NS
        self._made = 0
        self._until_ns = now_ns
        self._next_ns = self._origin_ns
        self._stamps = self._stamps[:0]
        self._volts = self._volts[:0]
        self._knots = [_resting(self._knots[-1].position)]
        self._respond = self._settled_response()
        return skipped

    def read(self, now_ns: int) -> Samples:
        """Return the samples up to now, or up to the newest stamp of the stage's motion."""
        until_ns = max(self._until_ns, min(now_ns, self._motion_until_ns()))
        while until_ns >= self._next_ns:
            self._make(until_ns)
        due = int(self._stamps.searchsorted(until_ns, 'right'))
        stamps, volts = self._stamps[:due], self._volts[:due]
        is_in_test = self._line.add(stamps * 1e-9, volts)
        samples = Samples(stamps, volts, until_ns, in_self_test=is_in_test)
        self._stamps = self._stamps[due:]
        self._volts = self._volts[due:]
        self._until_ns = until_ns
        return samples

    def hold_self_test(self, hold_s: float) -> None:
        """Change the samples by the usual step of the datasheet."""
        if not self._line.has_step:
            raise UserError(
                f'the parameters of {self.sensor.serial} state no self-test; write '
                'sensor.self_test_g, by axis'
            )
        self._line.hold(self._until_ns * 1e-9, hold_s)

    def status(self) -> LinkStatus:
        """Return whether a stage moves the sensor."""
        return self._status

    def _stamp(self, index: float | np.ndarray) -> np.ndarray:
        return self._origin_ns + np.rint(index * (1e9 / self.sensor.rate_hz)).astype(np.int64)

    def _motion_until_ns(self) -> int:
        """Return the time up to which the motion is known; it is unbounded without a stage."""
        if self._watchdog is None:
            return FOREVER_NS
        if self._watchdog.check() < _LOST_S:
            return self._knots[-1].stamp_ns
        self._watchdog = None
        self._status = LinkStatus(
            Level.WARN,
            f'stage lost: nothing on {self.joint_state_topic} for {_LOST_S:g} '
            's, its last pose is held',
        )
        return FOREVER_NS

    def _make(self, until_ns: int) -> None:
        """Make a block of samples, beyond a time as far as the motion is known."""
        ahead_ns = min(until_ns + _AHEAD_NS, self._motion_until_ns())
        stamps = self._stamp(self._made + np.arange(_MAX_BLOCK, dtype=float))
        stamps = stamps[: np.searchsorted(stamps, ahead_ns, 'right')]
        self._made += len(stamps)
        self._next_ns = int(self._stamp(self._made))
        volts = self._respond((stamps - self._origin_ns) * 1e-9)
        self._stamps = np.concatenate([self._stamps, stamps])
        self._volts = np.concatenate([self._volts, volts])
        while len(self._knots) > 1 and self._knots[1].stamp_ns <= stamps[-1]:
            del self._knots[0]

    def _settled_response(self) -> Response:
        """Return the response of a sensor at rest in the stage's pose, with new noise."""
        self._seed += 1
        motion = Motion(
            inf,
            alpha=partial(self._joint, 0),
            beta=partial(self._joint, 1),
            shift=partial(self._joint, 2),
        )
        return Response(self.sensor, motion, self._seed - 1)

    def _joint(self, joint: int, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        """Interpolate one joint by cubic Hermite splines, exactly at the stage's stamps."""
        stamps = self._origin_ns + np.rint(time_s * 1e9).astype(np.int64)
        knots = np.array([knot.stamp_ns for knot in self._knots], np.int64)
        position = np.array([knot.position[joint] for knot in self._knots])
        velocity = np.array([knot.velocity[joint] for knot in self._knots])
        before = (np.searchsorted(knots, stamps) - 1).clip(0)
        step_ns = np.diff(knots, append=knots[-1])[before]
        held = position[before] if order == 0 else np.zeros(len(stamps))
        if len(knots) == 1:
            return held
        spline = CubicHermiteSpline((knots - self._origin_ns) * 1e-9, position, velocity)
        return np.where((step_ns > 0) & (step_ns <= _GAP_NS), spline(time_s, order), held)


def _resting(position: tuple[float, ...]) -> _JointKnot:
    return _JointKnot(0, position, (0.0,) * len(JOINTS))
