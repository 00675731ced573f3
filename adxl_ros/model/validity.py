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
Validity range of a calibration, and how its covariance grows outside.

Temperature. A model that ignores temperature drifts outside of the temperatures of its poses, as
the datasheet states. By ΔT more than `MARGIN_K` outside, an axis with specific force f gets the
variance

    (g·k_zero·ΔT)² + (f·k_scale·ΔT)²

with the typical slopes k of zero-g and scale factor, one standard deviation each. A model that
follows temperature has slopes of its own, whose covariance grows by itself.

Pose. The extrapolation ρ of a force is the larger of two ratios:

- The leverage h = trace(∂f/∂θ·Σ·∂f/∂θᵀ) by the largest leverage of the poses, h_max. This is the
  regressor variable hull (Montgomery, Peck, Vining, Introduction to Linear Regression Analysis,
  "hidden extrapolation").
- The square of the distance from the middle of the poses' forces, divided by half of their range
  plus `MARGIN_MPS2`, in the component where it is largest. It covers terms that the model lacks.

A force is outside where ρ > 1. The squares of the model's terms grow as ρ, and the covariance
does, too. What the model lacks is of higher order: its square grows at least as ρ². With the
misfit u of held-out poses, an axis gets the variance

    u²·(ρ² − 1), where ρ > 1

h_max is taken at the forces of the poses and at `STRETCH` times them. Otherwise noise, and forces
that share a tangent with their neighbours, would count as outside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

MARGIN_K = 2.0
"""Distance from the temperatures of the poses that counts as inside, K; chosen: by the datasheet
it is 0.2 mg, below the noise of a sample. No thermometer is at the element."""

STRETCH = 1.1
"""Factor of the poses' forces at which h_max is taken, too; chosen: see the text above."""

MARGIN_MPS2 = 2.0
"""Distance from the forces of the poses that counts as inside, m/s²; chosen: planes from 30° on
leave 1.3 m/s² to level, and nearby forces share one result."""


@dataclass(frozen=True)
class Envelope:
    """
    Validity range of a calibration.

    Attributes
    ----------
    temperature_c
        Lowest and highest temperature of the poses, °C; None if it was not measured.
    zero_g_per_k
        Typical slope of the zero-g, g/K, by the datasheet; 0 if the model follows temperature.
    scale_per_k
        Typical slope of the scale factor, 1/K, by the datasheet; 0 if the model follows it.
    leverage
        Largest leverage of the poses, h_max, (m/s²)²; 0 if unknown.
    misfit_mps2
        Misfit of held-out poses beyond noise and stage error, by axis, m/s².
    force_low_mps2, force_high_mps2
        Lowest and highest specific force of the poses by component, m/s²; empty if unknown.

    """

    temperature_c: tuple[float, float] | None = None
    zero_g_per_k: float = 0.0
    scale_per_k: float = 0.0
    leverage: float = 0.0
    misfit_mps2: float = 0.0
    force_low_mps2: tuple[float, ...] = ()
    force_high_mps2: tuple[float, ...] = ()

    def beyond_k(self, temperature_c: Any) -> Any:
        """Return the distance of temperatures, °C, outside of range and margin, K; 0 inside."""
        if self.temperature_c is None:
            return np.zeros(np.shape(temperature_c))
        low, high = self.temperature_c
        return np.maximum(0.0, np.maximum(low - MARGIN_K - temperature_c,
                                          temperature_c - high - MARGIN_K))

    def extrapolation(self, force: Sequence[Any], leverage: Any) -> Any:
        """
        Return the extrapolation ρ of forces, at least 1.

        Parameters
        ----------
        force
            Specific force, m/s², three components, (n,) or floats.
        leverage
            Leverage of the forces, (m/s²)², (n,).

        Returns
        -------
        ndarray
            ρ, (n,); 1 inside.

        """
        rho = np.maximum(1.0, leverage / self.leverage if self.leverage else 1.0)
        for value, low, high in zip(force, self.force_low_mps2, self.force_high_mps2):
            distance = np.abs(value - (low + high) / 2) / ((high - low) / 2 + MARGIN_MPS2)
            rho = np.maximum(rho, distance ** 2)
        return rho

    def added_variance(self, axis_mps2: Any, temperature_c: Any, extrapolation: Any,
                       gravity_mps2: float) -> Any:
        """
        Return the variance that an axis gets outside of the validity range.

        Parameters
        ----------
        axis_mps2
            Specific force along the axis, m/s², (n,).
        temperature_c
            Temperature, °C, (n,) or one value.
        extrapolation
            Extrapolation ρ of the forces, (n,).
        gravity_mps2
            One g, m/s².

        Returns
        -------
        ndarray
            Variance, (m/s²)², (n,).

        """
        beyond_k = self.beyond_k(temperature_c)
        return ((gravity_mps2 * self.zero_g_per_k * beyond_k) ** 2
                + (axis_mps2 * self.scale_per_k * beyond_k) ** 2
                + self.misfit_mps2 ** 2 * (extrapolation ** 2 - 1))

    def is_outside(self, temperature_c: Any, force: Sequence[Any], leverage: Any) -> np.ndarray:
        """
        Return which samples lie outside of the validity range.

        Parameters
        ----------
        temperature_c
            Temperature, °C, (n,) or one value.
        force
            Specific force, m/s², three components, (n,) or floats.
        leverage
            Leverage of the forces, (m/s²)², (n,).

        Returns
        -------
        ndarray
            Whether each sample is outside, (n,).

        """
        return (self.beyond_k(temperature_c) > 0) | (self.extrapolation(force, leverage) > 1)

    def describe_outside(self, temperature_c: float, force: Sequence[float], leverage: float
                         ) -> tuple[str, ...]:
        """
        Describe in words how one sample lies outside of the validity range.

        Parameters
        ----------
        temperature_c
            Temperature, °C.
        force
            Specific force, m/s², three components.
        leverage
            Leverage of the force, (m/s²)².

        Returns
        -------
        tuple
            A text for temperature and one for the force; empty inside.

        """
        texts = []
        if self.temperature_c is not None and self.beyond_k(temperature_c) > 0:
            low, high = self.temperature_c
            texts.append(f'temperature {temperature_c:.1f} degC, calibrated at {low:.1f} to '
                         f'{high:.1f}')
        rho = float(self.extrapolation(force, leverage))
        if rho > 1:
            texts.append(f'force near {", ".join(f"{f:.1f}" for f in force)} m/s^2, '
                         f'{rho ** 0.5:.2g} times as far out as the calibrated poses')
        return tuple(texts)
