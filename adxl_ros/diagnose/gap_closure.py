# SPDX-License-Identifier: Apache-2.0
"""The gap before and after the effects of a verdict, above the noise floor, with its intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from adxl_ros.diagnose.noise_floor import NoiseFloor
from adxl_ros.diagnose.noise_remainders import floor_without, NoiseRemainder
from adxl_ros.diagnose.verdict import Verdict
from adxl_ros.diagnose.weighing import Evidence
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.error_sizes import rms
from adxl_ros.model.sensor import Sensor
from adxl_ros.report.quantities import Interval
import numpy as np


class GapClosure(NamedTuple):
    """The gap before and after the effects of the verdict, held out, and the noise floor."""

    before: Interval  # Rms of recording minus simulation over samples and axes, m/s²
    after: Interval  # The same with the effects, m/s²
    floor: Interval  # Noise floor, m/s²; its interval is NaN where it is not measured
    closed: Interval  # (before² − after²)/(before² − floor²); NaN without a gap


def gap_closure(
    verdict: Verdict,
    evidence: Evidence,
    floor: NoiseFloor,
    remainders: Sequence[NoiseRemainder],
    sensor: Sensor,
    removed_power: float,
) -> GapClosure:
    """
    Return the gap before and after the best set, above the floor without noise-like effects.

    removed_power: mean square, (m/s²)², of samples that the sensor did not measure.
    """
    best = verdict.best if verdict.closes else frozenset[str]()

    def left(effects: frozenset[str]) -> np.ndarray:
        """Return the power that a set leaves, (m/s²)², by draw."""
        # A difference of squares may fall below 0 by rounding.
        return np.maximum(evidence.squares(effects).values, 0.0) + removed_power

    before = left(frozenset())
    after = left(best)
    stated_mps2 = rms(noise.sample_std_v(sensor) / (sensor.scale_v_per_g / G0_MPS2))
    is_sure = np.isfinite(evidence.floor.values)
    floors_mps2 = np.sqrt(np.where(is_sure, evidence.floor.values, floor.rms_mps2**2))
    # No set leaves less than the noise.
    floors_mps2 = np.minimum(floors_mps2, np.sqrt(after))
    lowest_mps2 = np.array([floor_without(f, remainders, stated_mps2) for f in floors_mps2])
    above_floor = before - lowest_mps2**2
    with np.errstate(all='ignore'):
        closed = (before - after) / np.where(before > lowest_mps2**2, above_floor, np.nan)
    lowest_mps2[1:][~is_sure[1:]] = np.nan
    return GapClosure(
        before=_interval(np.sqrt(before)),
        after=_interval(np.sqrt(after)),
        floor=_interval(lowest_mps2),
        closed=_interval(np.clip(closed, -1.0, 1.0)),
    )


def _interval(draws: np.ndarray) -> Interval:
    """Return the first value with the 90 % interval of the others."""
    finite = draws[1:][np.isfinite(draws[1:])]
    low, high = np.quantile(finite, [0.05, 0.95]) if len(finite) else (np.nan, np.nan)
    return Interval(float(draws[0]), float(low), float(high))
