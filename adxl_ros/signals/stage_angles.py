# SPDX-License-Identifier: Apache-2.0
"""
Whether the angles of a stage explain the output of a sensor, as recorded or with other factors.

At rest f = g·[sin α·cos β, −sin α·sin β, cos α].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

from adxl_ros.files.recording_columns import JOINTS
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import Sensor
import numpy as np

SMALLEST_MOTION_G = 0.05
"""Standard deviation of the specific force, g, from which an axis is compared. Chosen: ten times
the noise of an ADXL203."""
_SAMPLES = 4000
"""Largest number of samples that are compared with angles. Chosen: a few for each second."""
_WRONG = 0.2
"""Share of the output's variance that angles do not explain, from which they may be wrong. Chosen:
it is 0.03 where the sensor is mounted 10° off."""
_RIGHT = 0.1
"""The same share up to which changed angles are right. Chosen: half of that of wrong ones."""
_SIGNS = ((1, 1), (1, -1), (-1, 1), (-1, -1))
"""Signs of both angles that are tried. The fewest changes come first."""
_AS_RECORDED = (1.0, 1.0)
"""Factors of both angles that change nothing."""
_RAD_PER_DEG = np.pi / 180


@dataclass(frozen=True)
class StageReadings:
    """Angles of a stage and outputs of a sensor."""

    angles_rad: np.ndarray  # As recorded, (n, 2)
    measured_g: np.ndarray  # (n, m)

    @classmethod
    def of(cls, angles_rad: np.ndarray, volts: np.ndarray, sensor: Sensor) -> StageReadings:
        """Return some of the readings of angles, (k, 2), and outputs, V, (k, m)."""
        measured_g = (volts - sensor.zero_g_v) / sensor.scale_v_per_g
        rows = np.flatnonzero(np.isfinite(np.hstack([angles_rad, measured_g])).all(axis=1))
        rows = rows[:: max(1, len(rows) // _SAMPLES)]
        return cls(angles_rad[rows], measured_g[rows])

    @property
    def variance_g2(self) -> float:
        """Variance of the output, summed over axes, g²."""
        return float(np.var(self.measured_g, axis=0).sum())

    def force_g(self, factors: Sequence[float]) -> np.ndarray:
        """Return the force at angles times factors, g, (n, m)."""
        alpha_rad, beta_rad = (self.angles_rad * factors).T
        force_g = np.column_stack(specific_force(alpha_rad, beta_rad, 1.0))
        return force_g[:, : self.measured_g.shape[1]]

    def unexplained(self, factors: Sequence[float]) -> float:
        """Return the share of the variance that angles times factors do not explain."""
        left_g2 = np.var(self.measured_g - self.force_g(factors), axis=0).sum()
        return float(left_g2) / self.variance_g2

    def correlation_text(self, factors: Sequence[float]) -> str:
        """Return how well angles times factors explain the output, for people."""
        return f'correlation {np.sqrt(1 - self.unexplained(factors)):.2f}'

    def mirrored_axes(self, factors: Sequence[float]) -> np.ndarray:
        """Return the numbers of the axes whose force changes with the signs of the angles."""
        change_g = self.force_g(factors) - self.force_g(_AS_RECORDED)
        return np.flatnonzero(np.std(change_g, axis=0) > SMALLEST_MOTION_G)

    def right_factors(self) -> tuple[float, float] | None:
        """
        Return the factors of alpha and beta, signs and units, that clearly explain the output.

        None where the recorded angles may be right, nothing explains it, or nothing moves.
        """
        if len(self.angles_rad) < 2 or self.variance_g2 < SMALLEST_MOTION_G**2:
            return None
        recorded = self.unexplained(_AS_RECORDED)
        if recorded < _WRONG:
            return None
        # Angles beyond a turn may be in degrees.
        may_be_degrees = np.abs(self.angles_rad).max(axis=0) > 2 * np.pi
        units = [(1.0, _RAD_PER_DEG) if may_be else (1.0,) for may_be in may_be_degrees]
        tried = []
        for of_alpha, of_beta in product(*units):
            tried += [(alpha * of_alpha, beta * of_beta) for alpha, beta in _SIGNS]
        best = min(tried, key=self.unexplained)
        is_right = self.unexplained(best) <= min(_RIGHT, recorded / 2)
        return best if is_right else None

    def degrees_fault(self) -> str:
        """Return which angles are in degrees and what to do, one line; '' for none."""
        factors = self.right_factors() or _AS_RECORDED
        reached = np.abs(self.angles_rad).max(axis=0, initial=0.0)
        in_degrees = {
            name: f'{largest:.4g}'
            for name, factor, largest in zip(JOINTS.values(), factors, reached)
            if abs(factor) != 1
        }
        if not in_degrees:
            return ''
        joined = ' and '.join(in_degrees)
        return (
            f'{joined}: up to {" and ".join(in_degrees.values())}: degrees in '
            f'a column of radians (as degrees it fits the output, '
            f'{self.correlation_text(factors)}); multiply {joined} by π/180'
        )
