# SPDX-License-Identifier: Apache-2.0

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
    """Validity range of a calibration."""

    # Lowest and highest temperature of the poses, °C; None if it was not measured
    temperature_c: tuple[float, float] | None = None
    # Typical slope of the zero-g, g/K, by the datasheet; 0 if the model follows temperature
    zero_g_per_k: float = 0.0
    # Typical slope of the scale factor, 1/K, by the datasheet; 0 if the model follows it
    scale_per_k: float = 0.0
    leverage: float = 0.0  # Largest leverage of the poses, h_max, (m/s²)²; 0 if unknown
    # Misfit of held-out poses beyond noise and stage error, by axis, m/s²
    misfit_mps2: float = 0.0
    # force_low_mps2, force_high_mps2: Lowest and highest specific force of the poses by component,
    # m/s²; empty if unknown
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

        force: specific force, m/s², three components, (n,) or floats; leverage: leverage of the
        forces, (m/s²)², (n,); returns: ρ, (n,); 1 inside.
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

        axis_mps2: specific force along the axis, m/s², (n,); temperature_c: temperature, °C, (n,)
        or one value; extrapolation: extrapolation ρ of the forces, (n,); returns: variance,
        (m/s²)², (n,).
        """
        beyond_k = self.beyond_k(temperature_c)
        return ((gravity_mps2 * self.zero_g_per_k * beyond_k) ** 2
                + (axis_mps2 * self.scale_per_k * beyond_k) ** 2
                + self.misfit_mps2 ** 2 * (extrapolation ** 2 - 1))

    def is_outside(self, temperature_c: Any, force: Sequence[Any], leverage: Any) -> np.ndarray:
        """
        Return which samples lie outside of the validity range.

        temperature_c: temperature, °C, (n,) or one value; force: specific force, m/s², three
        components, (n,) or floats; leverage: leverage of the forces, (m/s²)², (n,); returns:
        whether each sample is outside, (n,).
        """
        return (self.beyond_k(temperature_c) > 0) | (self.extrapolation(force, leverage) > 1)

    def describe_outside(self, temperature_c: float, force: Sequence[float], leverage: float
                         ) -> tuple[str, ...]:
        """
        Describe in words how one sample lies outside of the validity range.

        force: specific force, m/s², three components; leverage: leverage of the force, (m/s²)².
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
