# SPDX-License-Identifier: Apache-2.0

"""
The gyroscope beside an accelerometer: its bias over temperature, and its noise.

Scale factor, misalignment and the effect of acceleration are not described: no rest shows them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

NO_TURN = (0.0, 0.0, 0.0)
"""A value by axis that is not known, in the frame of the accelerometer."""


def _by_axis(doc: str, unit: str, has_sign: bool = False) -> Any:
    """Declare a value: three numbers, or none where it is not known."""
    return field(default=(), metadata={'doc': doc, 'unit': unit, 'has_sign': has_sign})


@dataclass(frozen=True)
class Gyroscope:
    """
    Values of a gyroscope: three numbers each, or none where they are not known.

    The fields are the keys `gyro.*` of the parameter file; their metadata describe them.
    """

    bias_radps: tuple[float, ...] = _by_axis('rate that it reads at rest', 'rad/s', has_sign=True)
    bias_std_radps: tuple[float, ...] = _by_axis('standard deviation of the bias', 'rad/s')
    bias_per_k_radps: tuple[float, ...] = _by_axis(
        'change of the bias by temperature', 'rad/s/K', has_sign=True
    )
    bias_per_k_std_radps: tuple[float, ...] = _by_axis(
        'standard deviation of this change', 'rad/s/K'
    )
    temperature_c: tuple[float, ...] = _by_axis(
        'lowest temperature of the rests, that for which the bias holds, and the highest',
        'degC',
        has_sign=True,
    )
    noise_density_radps_per_rthz: tuple[float, ...] = _by_axis(
        'white noise density over positive frequencies', 'rad/s/sqrt(Hz)'
    )
    flicker_radps_per_rthz: tuple[float, ...] = _by_axis(
        'density of the 1/f noise at 1 Hz', 'rad/s/sqrt(Hz)'
    )
    walk_radps_per_rts: tuple[float, ...] = _by_axis(
        'rms of the wandering bias divided by the root of time', 'rad/s/sqrt(s)'
    )

    @property
    def is_calibrated(self) -> bool:
        """Whether the bias is known."""
        return bool(self.bias_radps)

    @property
    def follows_temperature(self) -> bool:
        """Whether the bias is known by temperature."""
        return bool(self.bias_per_k_radps and self.temperature_c)

    def bias_at(self, temperature_c: Any = None) -> np.ndarray:
        """Return the bias at temperatures, °C, (n,) or one; rad/s, (n, 3) or (3,)."""
        bias = np.array(self.bias_radps or NO_TURN)
        return bias + self._departure_k(temperature_c) * np.array(self.bias_per_k_radps or NO_TURN)

    def bias_std_at(self, temperature_c: Any = None) -> np.ndarray:
        """Return the standard deviation of the bias at temperatures, rad/s, as `bias_at`."""
        # The bias holds for the mean temperature of the rests, so that its error and that of the
        # slope are independent.
        slope_std = self._departure_k(temperature_c) * np.array(
            self.bias_per_k_std_radps or NO_TURN
        )
        return np.hypot(np.array(self.bias_std_radps or NO_TURN), slope_std)

    def _departure_k(self, temperature_c: Any) -> Any:
        """Return temperatures less that of the bias, K, (n, 1) or (); 0 where it is not known."""
        if temperature_c is None or not self.follows_temperature:
            return 0.0
        departure_k = np.asarray(temperature_c, float) - self.temperature_c[1]
        return np.nan_to_num(departure_k)[..., None]
