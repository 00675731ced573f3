# SPDX-License-Identifier: Apache-2.0

"""By how much the readings of a sound sensor may be off, by datasheet or calibration."""

from __future__ import annotations

from dataclasses import dataclass

from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.error_sizes import stds
from adxl_ros.model.sensor import get, Sensor
import numpy as np

_TYPICAL_TO_LARGEST = 2.0
"""Largest departure of a part, by the typical one of its datasheet, where no maximum is stated: a
typical value is that of one standard deviation, and nearly all parts are within two."""
_UNSTATED_ZERO_G = 0.1  # Zero-g error where no datasheet states one, g. Chosen: above most sensors
_UNSTATED_SCALE = 0.1  # Scale error where none is stated. Chosen: above most sensors
_UNSTATED_ACROSS = 0.02  # Cross-axis sensitivity where none is stated: the usual one
_CALIBRATED_STDS = 3.0  # Largest error of a fitted coefficient, in its standard deviations
_SHIFT_IN_USE_G = 0.02  # Shift of the zero-g of a healthy unit since its calibration, g
_CHANGE_IN_USE = 0.01  # Change of its scale factor: a typical drift over 30 K
_TEMPERATURES_K = 25.0  # Distance from room temperature that a recording may have, K


@dataclass(frozen=True)
class Tolerance:
    """By how much the readings of a sound sensor may be off, by axis."""

    zero_g_mps2: np.ndarray  # Zero-g error, m/s², (m,)
    scale: np.ndarray  # Relative error of the scale factor, (m,)
    across: float  # Share of the force across an axis that it reads

    def widest(self, axes: int) -> Tolerance:
        """Return the tolerance of its worst axis for a number of axes."""
        return Tolerance(
            np.full(axes, self.zero_g_mps2.max()), np.full(axes, self.scale.max()), self.across
        )


def nominal_tolerance(sensor: Sensor) -> Tolerance:
    """Return the tolerance of a sensor that is read by its nominal values."""
    zero_g = _departure(sensor, 'bias', 'offset_v') / sensor.nominal_scale_v_per_g
    scale = _departure(sensor, 'scale_factor', 'offset_v_per_g') / sensor.nominal_scale_v_per_g
    across = _departure(sensor, 'cross_axis', 'linear')
    return Tolerance(
        G0_MPS2 * np.where(zero_g > 0, zero_g, _UNSTATED_ZERO_G),
        np.where(scale > 0, scale, _UNSTATED_SCALE),
        across or _UNSTATED_ACROSS,
    )


def _departure(sensor: Sensor, effect: str, parameter: str) -> float:
    """Return the largest departure by the datasheet, in the unit of the parameter; 0 for none."""
    typical, largest = sensor.datasheet.get(Coefficient(effect, parameter), (0.0, 0.0))
    return largest or _TYPICAL_TO_LARGEST * typical


def calibrated_tolerance(sensor: Sensor) -> Tolerance:
    """Return the tolerance of a calibrated sensor, whose effects are undone."""
    std = dict(zip(sensor.covariance_names, stds(sensor.covariance)))

    def fitted(effect: str, parameter: str) -> np.ndarray:
        return _CALIBRATED_STDS * np.array(
            [std.get(Coefficient(effect, parameter, axis), 0.0) for axis in sensor.axes]
        )

    zero_g = fitted('bias', 'offset_v') / sensor.nominal_scale_v_per_g + _SHIFT_IN_USE_G
    if 'temperature_bias' in sensor.effects:
        # It is undone for room temperature.
        slopes = [Coefficient('temperature_bias', 'per_k', axis) for axis in sensor.axes]
        zero_g = zero_g + _TEMPERATURES_K * np.abs(get(sensor, slopes))
    scale = fitted('scale_factor', 'offset_v_per_g') / sensor.nominal_scale_v_per_g
    across = np.concatenate([fitted('misalignment', name) for name in ('alpha_rad', 'beta_rad')])
    return Tolerance(
        G0_MPS2 * zero_g, scale + _CHANGE_IN_USE, max(float(across.max()), _CHANGE_IN_USE)
    )


IDEAL = Tolerance(np.zeros(3), np.zeros(3), _CHANGE_IN_USE)
"""The tolerance of another simulator, whose readings are ideal up to its value of gravity."""
