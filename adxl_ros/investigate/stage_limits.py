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

"""The limits of the stage that an investigation keeps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple


class Pose(NamedTuple):
    """
    Angles of the stage.

    Attributes
    ----------
    alpha_rad, beta_rad
        Angles, rad.

    """

    alpha_rad: float
    beta_rad: float


@dataclass(frozen=True)
class StageLimits:
    """
    Limits of angle and rate.

    Attributes
    ----------
    alpha_rad, beta_rad
        Lowest and highest angle of each joint, rad.
    rate_rad_s
        Largest rate of each joint, rad/s.

    """

    alpha_rad: tuple[float, float]
    beta_rad: tuple[float, float]
    rate_rad_s: float

    def nearest(self, alpha_rad: float, beta_rad: float) -> Pose:
        """
        Return the pose within the limits that is nearest to a pose.

        Parameters
        ----------
        alpha_rad, beta_rad
            Angles, rad.

        Returns
        -------
        Pose
            The pose within the limits.

        """
        return Pose(_within(alpha_rad, self.alpha_rad), _within(beta_rad, self.beta_rad))

    def excess_rad(self, pose: Pose) -> float:
        """Return how far the worse angle of a pose is beyond the limits, rad; 0 within them."""
        nearest = self.nearest(*pose)
        return max(abs(pose.alpha_rad - nearest.alpha_rad), abs(pose.beta_rad - nearest.beta_rad))


def _within(value: float, limits: tuple[float, float]) -> float:
    """Return the value within limits that is nearest to a value."""
    return min(max(value, limits[0]), limits[1])
