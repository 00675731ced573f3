# SPDX-License-Identifier: Apache-2.0

"""
Commands of a stage along a manoeuvre: positions in short steps.

Each command is a position some time ahead on the manoeuvre, with the speed at which it is reached
in this time. A stage that keeps to it moves evenly although commands come late. Where they end for
any reason, the stage comes to rest at the last one.
"""

from __future__ import annotations

from adxl_ros.investigate.manoeuvres import PlannedManoeuvre, Pose, StageLimits
from adxl_ros.simulate.trajectories import RUN_UP_S
import numpy as np

LONGEST_STEP_S = 0.2
"""Longest time of a manoeuvre between two commands, s. Chosen: the stage then comes to rest within
a fifth of a second at the limit of rate where the commands end."""
_AHEAD_S = LONGEST_STEP_S
"""Time by which a command is ahead of the stage, s. Chosen: no command is later."""
LARGEST_LAG_RAD = 0.15
"""Distance of the stage from where it should be, rad, at which the command waits. Chosen: a
controller lags by some tenths of a second."""


class CommandStream:
    """
    The commands of one manoeuvre.

    command: the newest command.
    """

    def __init__(self, limits: StageLimits, manoeuvre: PlannedManoeuvre, pose: Pose) -> None:
        """Begin with the stage in a pose."""
        self.command = self._expected = limits.nearest(*pose)
        self.speed = Pose(0.0, 0.0)  # Speed of each joint on the way to it, rad/s
        self.waited_s = 0.0  # Time for which the command has waited for the stage, s
        self._limits, self._manoeuvre = limits, manoeuvre
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
        """
        Return the next command.

        The manoeuvre takes longer where a call is later than `LONGEST_STEP_S`.
        """
        # Where a stage is that has moved on with its last command.
        self._expected = _moved(self._expected, self.command, *(
            speed * max(elapsed_s, 0.0) for speed in self.speed))
        elapsed_s = min(max(elapsed_s, 0.0), LONGEST_STEP_S)
        lag_rad = max(max(min(e, c) - p, p - max(e, c))
                      for e, c, p in zip(self._expected, self.command, pose))
        if lag_rad > LARGEST_LAG_RAD:
            self.waited_s += elapsed_s
            return self.command
        self.waited_s = 0.0
        self._elapsed_s += elapsed_s
        motion = self._manoeuvre.motion
        ahead_s = np.array([self._manoeuvre.begin_s
                            + min(self._elapsed_s + _AHEAD_S, motion.duration_s)])
        goal = self._limits.nearest(float(motion.alpha(ahead_s)[0]),
                                    float(motion.beta(ahead_s)[0]))
        rate_rad_s = self._limits.rate_rad_s
        largest_rad = rate_rad_s * elapsed_s
        self.command = _moved(self.command, goal, largest_rad, largest_rad)
        # A stage that came to rest for want of commands starts as softly as a manoeuvre.
        faster = rate_rad_s * elapsed_s / RUN_UP_S
        self.speed = Pose(*(min(abs(c - e) / _AHEAD_S, speed + faster, rate_rad_s) for c, e, speed
                            in zip(self.command, self._expected, self.speed)))
        return self.command


def _moved(pose: Pose, goal: Pose, alpha_rad: float, beta_rad: float) -> Pose:
    """Return a pose after a move towards a goal, by a distance of each joint at most."""
    return Pose(*(p + min(max(g - p, -largest), largest)
                  for p, g, largest in zip(pose, goal, (alpha_rad, beta_rad))))
