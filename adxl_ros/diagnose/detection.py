# SPDX-License-Identifier: Apache-2.0
"""An effect that shows in samples or in noise, with the parameters that its detector estimates."""

from __future__ import annotations

from dataclasses import dataclass

from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import effect_named, library
from adxl_ros.model.effects.base import Detector
from adxl_ros.model.sensor import Sensor, with_neutral, with_values
import numpy as np


@dataclass(frozen=True)
class Detection:
    """One noise-like effect that shows."""

    effect: str  # Name of the effect
    values: dict[str, np.ndarray]  # Parameters of the effect by name, (m,) or () each
    # Mean square over samples and axes that the effect adds, (m/s²)²; infinite for repeated
    # samples, because nobody knows what they hide
    power_mps2: float

    @property
    def is_left_out(self) -> bool:
        """Whether its samples are left out of the comparison."""
        detector = effect_named(self.effect).diagnosis.detector
        return detector in (
            Detector.REPEATED_SAMPLES,
            Detector.ISOLATED_SAMPLES,
            Detector.HELD_AT_END,
        )

    def added_to(self, sensor: Sensor) -> Sensor:
        """Return a sensor with the effect as it was found."""
        return with_values(with_neutral(sensor, [self.effect]), self.effect, self.values)


def effect_of(detector: Detector) -> str:
    """Return the name of the effect that a detector finds."""
    return next(e.name for e in library().values() if e.diagnosis.detector is detector)


def detection_of(
    detector: Detector, power_v2: np.ndarray | float, sensor: Sensor, **values: np.ndarray | float
) -> Detection:
    """Return the detection of a detector's effect, with its mean square, V², (m,) or ()."""
    arrays = {key: np.asarray(value) for key, value in values.items()}
    return Detection(
        effect_of(detector),
        arrays,
        float(np.mean(power_v2 * (G0_MPS2 / sensor.scale_v_per_g) ** 2)),
    )
