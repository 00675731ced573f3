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
Commands of a stage along a manoeuvre: positions in short steps.

The stage gets positions, never velocities. Where the commands end for any reason, the stage comes
to rest within one step of its last command.
"""

from __future__ import annotations

from adxl_ros.investigate.manoeuvres import PlannedManoeuvre
from adxl_ros.investigate.stage_limits import Pose, StageLimits
import numpy as np

LONGEST_STEP_S = 0.2
"""Longest time of a manoeuvre between two commands, s. Chosen: the stage then comes to rest within
a fifth of a second at the limit of rate where the commands end."""
_FIRST_STEP_S = 0.02
"""Time that a step may have after a shorter one, s. Chosen: that of the node."""
_GROWTH = 2.0
"""Largest ratio of the times of two steps. Chosen: a stage that was not commanded for a while then
starts again within some steps, and not by a jump."""
LARGEST_LAG_RAD = 0.15
"""Distance of the stage from its command, rad, at which the command waits. Chosen: a controller
lags by some tenths of a second."""


class CommandStream:
    """
    The commands of one manoeuvre.

    Attributes
    ----------
    command
        The newest command.
    waited_s
        Time for which the command has waited for the stage, s.

    """

    def __init__(self, limits: StageLimits, manoeuvre: PlannedManoeuvre, pose: Pose) -> None:
        """
        Begin with the stage in a pose.

        Parameters
        ----------
        limits
            Limits of the stage.
        manoeuvre
            The manoeuvre.
        pose
            Pose of the stage.

        """
        self.command = limits.nearest(*pose)
        self.waited_s = 0.0
        self._limits, self._manoeuvre = limits, manoeuvre
        self._elapsed_s = 0.0
        self._step_s = _FIRST_STEP_S

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

        A late call does not catch up: the manoeuvre then takes longer. The step after it is at
        most twice as long as the last one, so that the stage does not jump.

        Parameters
        ----------
        elapsed_s
            Time since the last call, s.
        pose
            Pose of the stage.

        Returns
        -------
        Pose
            The command, within the limits of angle. It differs from the last one by the limit of
            rate times the elapsed time at most.

        """
        elapsed_s = min(max(elapsed_s, 0.0), LONGEST_STEP_S)
        lag_rad = max(abs(c - p) for c, p in zip(self.command, pose))
        if lag_rad > LARGEST_LAG_RAD:
            self.waited_s += elapsed_s
            return self.command
        self.waited_s = 0.0
        elapsed_s = min(elapsed_s, _GROWTH * self._step_s)
        self._step_s = max(elapsed_s, _FIRST_STEP_S)
        self._elapsed_s += elapsed_s
        time_s = np.array([self._manoeuvre.begin_s + self._elapsed_s])
        motion = self._manoeuvre.motion
        largest_rad = self._limits.rate_rad_s * elapsed_s
        goal = self._limits.nearest(float(motion.alpha(time_s)[0]), float(motion.beta(time_s)[0]))
        self.command = Pose(*(c + min(max(g - c, -largest_rad), largest_rad)
                              for c, g in zip(self.command, goal)))
        return self.command
