# SPDX-License-Identifier: Apache-2.0

"""
The limits of the stage, the manoeuvres that an investigation can command, and their commands.

A manoeuvre begins in the pose of the stage and keeps the limits of the stage: each pose is moved
to the nearest one within them, and no joint turns faster than the limit.

A stage is commanded in short steps. Each command is a position some time ahead on the manoeuvre,
with the speed at which it is reached in this time. A stage that keeps to it moves evenly although
commands come late. Where they end for any reason, the stage comes to rest at the last one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import pathlib
from typing import NamedTuple

from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.trajectories import RUN_UP_S, Script
import numpy as np
import yaml

_REST_S = 4.0
"""Time at rest in a pose, s. Chosen: the mean of its samples is then a tenth of their noise."""
_SWING_RAD = np.radians(15.0)
"""Amplitude of swings and of reversals, rad. Chosen: far beyond every backlash."""
_SWINGS = 4  # Number of swings forth and back. Chosen: their reversals are averaged
LONGEST_STEP_S = 0.2
"""Longest time of a manoeuvre between two commands, s. Chosen: the stage then comes to rest within
a fifth of a second at the limit of rate where the commands end. A command is ahead of the stage by
this time, so that none is late."""
LARGEST_LAG_RAD = 0.15
"""Distance of the stage from where it should be, rad, at which the command waits. Chosen: a
controller lags by some tenths of a second."""


class Pose(NamedTuple):
    """Angles of the stage, rad."""

    alpha_rad: float
    beta_rad: float


@dataclass(frozen=True)
class StageLimits:
    """Lowest and highest angle, and largest rate, of each joint."""

    alpha_rad: tuple[float, float]
    beta_rad: tuple[float, float]
    rate_rad_s: float

    def of(self, joint: str) -> tuple[float, float]:
        """Return the lowest and highest angle of a joint, rad."""
        return self.alpha_rad if joint == 'alpha' else self.beta_rad

    def nearest(self, alpha_rad: float, beta_rad: float) -> Pose:
        """Return the pose within the limits that is nearest to a pose."""
        return Pose(
            float(np.clip(alpha_rad, *self.alpha_rad)), float(np.clip(beta_rad, *self.beta_rad))
        )


class StagePath:
    """A path of the stage within its limits, move by move."""

    def __init__(self, limits: StageLimits, pose: Pose, begin_s: float) -> None:
        """Begin at rest in a pose."""
        self.limits = limits  # The limits
        self._begin_s = begin_s
        self._script = Script(*limits.nearest(*pose), now_s=begin_s, slew_rad_s=limits.rate_rad_s)
        self._script.rest(0.5)

    def rest(self, alpha_deg: float, beta_deg: float, seconds: float = _REST_S) -> None:
        """Move to a pose and rest there for some seconds."""
        pose = self.limits.nearest(np.radians(alpha_deg), np.radians(beta_deg))
        if pose != self.end():
            self._script.go(*pose)
        self._script.rest(seconds)

    def turn(self, joint: str, to_rad: float, share: float = 1.0) -> None:
        """Turn one joint at a constant rate, and rest for a second."""
        to_rad = float(np.clip(to_rad, *self.limits.of(joint)))
        rate_rad_s = share * self.limits.rate_rad_s
        distance_rad = abs(to_rad - getattr(self._script, f'{joint}_rad'))
        if distance_rad > rate_rad_s * RUN_UP_S:
            self._script.run(joint, to_rad, rate_rad_s)
        elif distance_rad > 0:
            self._script.go(*self.end()._replace(**{f'{joint}_rad': to_rad}))
        self._script.rest(1.0)

    def swing(self, joint: str, share: float = 1.0) -> None:
        """Turn one joint about its angle, forth and back."""
        middle_rad = getattr(self._script, f'{joint}_rad')
        low_rad, high_rad = self.limits.of(joint)
        # A joint at its limit swings to the inner side.
        middle_rad = min(
            max(middle_rad, min(low_rad + _SWING_RAD, high_rad)),
            max(high_rad - _SWING_RAD, low_rad),
        )
        for _ in range(_SWINGS):
            for side in (1.0, -1.0):
                self.turn(joint, middle_rad + side * _SWING_RAD, share)
        self.turn(joint, middle_rad, share)

    def full_turn(self, joint: str, other_deg: float, share: float = 1.0) -> None:
        """Turn one joint over its range, a turn at most, forth and back."""
        low_rad, high_rad = self.limits.of(joint)
        low_deg = float(np.degrees(low_rad))
        self.rest(*((low_deg, other_deg) if joint == 'alpha' else (other_deg, low_deg)), 1.0)
        self.turn(joint, min(high_rad, low_rad + 2 * np.pi), share)
        self.turn(joint, low_rad, share)

    def motion(self) -> Motion:
        """Return the path as a motion that begins at its own time."""
        alpha, beta = self._script.joints()
        return Motion(self._script.now_s - self._begin_s, alpha, beta)

    def end(self) -> Pose:
        """Return the pose at the end."""
        return Pose(self._script.alpha_rad, self._script.beta_rad)


class CatalogueManoeuvre(NamedTuple):
    """A manoeuvre of the catalogue."""

    kind: str  # What it varies
    text: str  # What it does, for people
    moves: Sequence[Sequence]  # Name of a method of `StagePath` and its arguments, for each move


CATALOGUE = {
    name: CatalogueManoeuvre(**stated)
    for name, stated in yaml.safe_load(
        pathlib.Path(__file__).with_suffix('.yaml').read_text(encoding='utf-8')
    ).items()
}
"""Manoeuvres by name."""


@dataclass(frozen=True)
class PlannedManoeuvre:
    """A manoeuvre from the pose of the stage on."""

    name: str  # Its name in the catalogue
    begin_s: float  # Time at which it begins, s
    motion: Motion  # The motion; its joints count the time from the same origin
    end: Pose  # Pose at its end

    @property
    def minutes(self) -> float:
        """Return the duration, min."""
        return self.motion.duration_s / 60


def plan(name: str, limits: StageLimits, pose: Pose, begin_s: float = 0.0) -> PlannedManoeuvre:
    """Plan a manoeuvre."""
    path = StagePath(limits, pose, begin_s)
    for move, *arguments in CATALOGUE[name].moves:
        getattr(path, move)(*arguments)
    return PlannedManoeuvre(name, begin_s, path.motion(), path.end())


def plan_all(limits: StageLimits, pose: Pose, begin_s: float = 0.0) -> list[PlannedManoeuvre]:
    """Plan all manoeuvres of the catalogue."""
    return [plan(name, limits, pose, begin_s) for name in CATALOGUE]


class CommandStream:
    """The commands of one manoeuvre; `command` is the newest one."""

    def __init__(self, limits: StageLimits, manoeuvre: PlannedManoeuvre, pose: Pose) -> None:
        """Begin with the stage in a pose."""
        self.command = self._expected = limits.nearest(*pose)
        self.speed = Pose(0.0, 0.0)  # Speed of each joint on the way to it, rad/s
        self.waited_s = 0.0  # Time for which the command has waited for the stage, s
        self._limits = limits
        self._manoeuvre = manoeuvre
        self._elapsed_s = 0.0

    @property
    def is_done(self) -> bool:
        """Return whether the last command is that of the manoeuvre's end."""
        return self._elapsed_s >= self._manoeuvre.motion.duration_s

    @property
    def remaining_s(self) -> float:
        """Return the time to the end of the manoeuvre, s."""
        return max(self._manoeuvre.motion.duration_s - self._elapsed_s, 0.0)

    def advance(self, elapsed_s: float, pose: Pose) -> Pose:
        """Return the next command; a call later than `LONGEST_STEP_S` makes a manoeuvre longer."""
        # Where a stage is that has moved on with its last command.
        self._expected = _moved(
            self._expected, self.command, *(speed * max(elapsed_s, 0.0) for speed in self.speed)
        )
        elapsed_s = min(max(elapsed_s, 0.0), LONGEST_STEP_S)
        lag_rad = max(
            max(min(e, c) - p, p - max(e, c))
            for e, c, p in zip(self._expected, self.command, pose)
        )
        if lag_rad > LARGEST_LAG_RAD:
            self.waited_s += elapsed_s
            return self.command
        self.waited_s = 0.0
        self._elapsed_s += elapsed_s
        motion = self._manoeuvre.motion
        ahead_s = np.array(
            [self._manoeuvre.begin_s + min(self._elapsed_s + LONGEST_STEP_S, motion.duration_s)]
        )
        goal = self._limits.nearest(
            float(motion.alpha(ahead_s)[0]), float(motion.beta(ahead_s)[0])
        )
        rate_rad_s = self._limits.rate_rad_s
        largest_rad = rate_rad_s * elapsed_s
        self.command = _moved(self.command, goal, largest_rad, largest_rad)
        # A stage that came to rest for want of commands starts as softly as a manoeuvre.
        faster = rate_rad_s * elapsed_s / RUN_UP_S
        self.speed = Pose(
            *(
                min(abs(c - e) / LONGEST_STEP_S, speed + faster, rate_rad_s)
                for c, e, speed in zip(self.command, self._expected, self.speed)
            )
        )
        return self.command


def _moved(pose: Pose, goal: Pose, alpha_rad: float, beta_rad: float) -> Pose:
    """Return a pose after a move towards a goal, by a distance of each joint at most."""
    return Pose(
        *(
            p + min(max(g - p, -largest), largest)
            for p, g, largest in zip(pose, goal, (alpha_rad, beta_rad))
        )
    )
