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
Where a calibration holds, and by how much its covariance grows beyond.

Temperature. Beyond the temperatures at which the poses were taken, by ΔT more than `MARGIN_K`,
what the model does not follow drifts as the datasheet says: a measured axis of specific force f
gets

    (g·k_zero·ΔT)² + (f·k_scale·ΔT)²

with the typical slopes k of zero-g and scale factor, one standard deviation each. A model that
follows the temperature has slopes of its own, whose covariance grows by itself.

Pose. How far out a force lies, ρ, is the larger of two. The leverage h = trace(∂f/∂θ·Σ·∂f/∂θᵀ),
what the calibration's covariance makes of the force, by the largest of its poses (the regressor
variable hull: Montgomery, Peck, Vining, Introduction to Linear Regression Analysis, "hidden
extrapolation"). And, as a model says nothing of terms that it lacks, the square of the distance
from the middle of the poses' forces by half of their range and `MARGIN_MPS2`, in the component in
which it is largest. Beyond 1 the force is outside. Terms of the model grow with ρ in squares, and
so does the covariance; what the model lacks is of higher order and grows faster, at least as ρ².
With u the misfit that poses held out showed, each measured axis gets

    u²·(ρ² − 1), where ρ > 1

h_max is taken at the poses and at `STRETCH` times their force, as noise and tangents that
neighbours share must not count as outside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

MARGIN_K = 2.0
"""Temperatures so near to those of the poses are within: 0.2 mg by the datasheet, less than the
noise of a sample, and no sensor of temperature is at the same spot as the element."""
STRETCH = 1.1
MARGIN_MPS2 = 2.0
"""Room around the forces of the poses: planes from 30° on leave 1.3 m/s² up to level, and forces
that are near each other share what is said of them."""


@dataclass(frozen=True)
class Envelope:
    """
    What a calibration was taken in.

    Attributes
    ----------
    temperature_c
        Lowest and highest temperature of its poses, °C; None where it was not measured.
    zero_g_per_k, scale_per_k
        Slopes of what the model does not follow, g/K and 1/K: typical ones by the datasheet.
    leverage
        Largest of its poses, h_max, (m/s²)²; 0 is not known.
    misfit_mps2
        What poses held out showed beyond noise and stage, by axis, m/s².
    force_low_mps2, force_high_mps2
        Least and greatest specific force of its poses by component, m/s²; empty is not known.

    """

    temperature_c: tuple[float, float] | None = None
    zero_g_per_k: float = 0.0
    scale_per_k: float = 0.0
    leverage: float = 0.0
    misfit_mps2: float = 0.0
    force_low_mps2: tuple[float, ...] = ()
    force_high_mps2: tuple[float, ...] = ()

    def beyond_k(self, temperature_c: Any) -> Any:
        """Return by how much temperatures lie outside, margin excluded, K; 0 within."""
        if self.temperature_c is None:
            return np.zeros(np.shape(temperature_c))
        low, high = self.temperature_c
        return np.maximum(0.0, np.maximum(low - MARGIN_K - temperature_c,
                                          temperature_c - high - MARGIN_K))

    def reach(self, force: Sequence[Any], leverage: Any) -> Any:
        """
        Return how far out forces lie, ρ, at least 1; see the module.

        Parameters
        ----------
        force
            Specific force, m/s², three of (n,) or floats.
        leverage
            Of the forces, (m/s²)², (n,).

        """
        far = np.maximum(1.0, leverage / self.leverage if self.leverage else 1.0)
        for value, low, high in zip(force, self.force_low_mps2, self.force_high_mps2):
            off = np.abs(value - (low + high) / 2) / ((high - low) / 2 + MARGIN_MPS2)
            far = np.maximum(far, off ** 2)
        return far

    def added(self, axis_mps2: Any, temperature_c: Any, reach: Any, gravity_mps2: float) -> Any:
        """
        Return the variance that an axis gets, (m/s²)².

        Parameters
        ----------
        axis_mps2
            Specific force along the axis, m/s², (n,).
        temperature_c
            °C, (n,) or one.
        reach
            How far out the force lies, (n,).
        gravity_mps2
            One g.

        """
        off_k = self.beyond_k(temperature_c)
        return ((gravity_mps2 * self.zero_g_per_k * off_k) ** 2
                + (axis_mps2 * self.scale_per_k * off_k) ** 2
                + self.misfit_mps2 ** 2 * (reach ** 2 - 1))

    def outside(self, temperature_c: float, force: Sequence[float], leverage: float
                ) -> tuple[str, ...]:
        """Say what lies outside at one sample, in words; nothing within."""
        words = []
        if self.temperature_c is not None and self.beyond_k(temperature_c) > 0:
            low, high = self.temperature_c
            words.append(f'temperature {temperature_c:.1f} degC, calibrated at {low:.1f} to '
                         f'{high:.1f}')
        far = float(self.reach(force, leverage))
        if far > 1:
            words.append(f'force near {", ".join(f"{f:.1f}" for f in force)} m/s^2, '
                         f'{far ** 0.5:.2g} times as far out as the calibrated poses')
        return tuple(words)

    def lies_outside(self, temperature_c: Any, force: Sequence[Any], leverage: Any) -> np.ndarray:
        """Tell samples that lie outside, (n,)."""
        return (self.beyond_k(temperature_c) > 0) | (self.reach(force, leverage) > 1)
