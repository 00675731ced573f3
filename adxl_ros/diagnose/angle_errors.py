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
Errors of the followed angles and of coarse rounding, as a part of the noise.

The simulator follows angles that an encoder has rounded. Their error turns into volts by the slope
of gravity over each angle. At rest it is constant and new after each move; in motion it changes
quickly and is smaller, see `SmoothedPath.errors`. It belongs to the noise of every hypothesis
(errors in variables; Fuller 1987). The rounding to codes that are coarser than the noise is
constant at rest, too, and changes with the output.

The model is y = n + g·u. Here n is noise behind the RC filter, an AR(1) sequence with pole a. The
error u has variance 1 and u_t = φ_t·u_(t−1) + √(1 − φ_t²)·ξ_t, and g is its standard deviation in
V. Both g and φ follow from the motion. A Kalman filter predicts g·u, and its innovations, scaled
and filtered by 1/(1 − aL), have the spectrum of n. What follows, the whitening filters, then needs
no change. Where g is 0, samples stay as they are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import sqrt

from adxl_ros.diagnose.baseline_comparison import BaselineComparison, CachedPath, Reference
from adxl_ros.diagnose.noise_floor import gravity_slopes
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2
import numpy as np
import scipy

_LOWEST_NOISE_V = 1e-7
"""Smallest standard deviation of the noise, V, because the filter divides by it. Chosen: below
that of any ADC."""
_SMALLEST_HELD_SHARE = 0.01
"""Share of the rounding that is held, below which all of it is white. Chosen: the noise is then
a third of a step, as in any unit whose ADC suits it."""
_SERIES = 16
"""Series that are filtered together. Chosen: little memory beside all series."""


@dataclass(frozen=True)
class AngleErrorFilter:
    """
    A filter that gives noise with errors of angles the spectrum of noise without them.

    Attributes
    ----------
    rms_v
        Rms of the errors, V.
    pole
        Pole a of the noise.
    transition
        Factor of the estimate of u from sample to sample, (n,).
    gain
        Gain of the estimate of u, 1/V, (n,).
    weight
        Change of the predicted sample by the estimate of u, V, (n,).
    scale
        Standard deviation of the noise divided by that of the innovation, (n,).

    """

    rms_v: float
    pole: float
    transition: np.ndarray
    gain: np.ndarray
    weight: np.ndarray
    scale: np.ndarray

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Filter k series, (k, n)."""
        lower = np.ones((2, len(self.gain)))
        lower[1, :-1] = -self.transition[1:]
        filtered = np.empty_like(values)
        for first in range(0, len(values), _SERIES):
            part = values[first:first + _SERIES]
            changes = part.copy()
            changes[:, 1:] -= self.pole * part[:, :-1]
            changes[:, 0] = 0.0
            estimates = scipy.linalg.lapack.dtbtrs(lower, (changes * self.gain).T, uplo='L',
                                                   diag='U')[0].T
            changes[:, 1:] -= self.weight[1:] * estimates[:, :-1]
            changes *= self.scale
            changes[:, 0] = part[:, 0]
            filtered[first:first + _SERIES] = scipy.signal.lfilter(
                [1.0], [1.0, -self.pole], changes)
        return filtered


def angle_error_filter(comparison: BaselineComparison, axis: int) -> AngleErrorFilter | None:
    """
    Return the filter for one axis of a recording.

    Parameters
    ----------
    comparison
        The recording, at the rate of its samples.
    axis
        Index of the measured axis.

    Returns
    -------
    AngleErrorFilter or None
        The filter; None where the reference has no error that is known.

    """
    sensor = comparison.sensor
    rounding = noise.rounding(sensor, axis)
    variance_v2, remembered_v2 = np.zeros(len(comparison)), np.zeros(len(comparison))
    for part_v2, memory in (*_angle_errors(comparison, axis),
                            *_rounding_errors(comparison, axis, rounding.held_v2)):
        variance_v2 += part_v2
        remembered_v2 += part_v2 * memory
    if not variance_v2.any():
        return None
    rc_s = float(noise.electronics(sensor).rc_s[axis])
    pole = float(np.exp(-comparison.dt_s / rc_s)) if rc_s else 0.0
    std_v = max(float(noise.analog_std_v(sensor)[axis]), _LOWEST_NOISE_V)
    noise_v2 = std_v ** 2 * (1 - pole ** 2) + rounding.white_v2 * (1 + pole ** 2)
    return _filter(np.sqrt(variance_v2),
                   np.divide(remembered_v2, variance_v2, where=variance_v2 > 0,
                             out=np.ones(len(comparison))), pole, noise_v2)


def _angle_errors(comparison: BaselineComparison, axis: int
                  ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield variance, V², (n,), and memory from sample to sample, (n,), of each joint's error."""
    if comparison.reference is not Reference.STAGE:
        return
    time_s, motion, sensor = comparison.time_s, comparison.motion, comparison.sensor
    slopes = gravity_slopes(motion.alpha(time_s), motion.beta(time_s))[:, axis]
    v_per_rad = slopes * sensor.scale_v_per_g[axis] * sensor.local_gravity_mps2 / G0_MPS2
    for joint, slope in zip((motion.alpha, motion.beta), v_per_rad):
        errors = joint.errors(time_s) if isinstance(joint, CachedPath) else None
        if errors is not None:
            # An error that grows, after a move, is a new one.
            grown = np.minimum(errors.std[:-1] / errors.std[1:], 1.0)
            memory = np.exp(-errors.forgetting_per_s * comparison.dt_s)
            memory[1:] *= grown
            yield (slope * errors.std) ** 2, memory


def _rounding_errors(comparison: BaselineComparison, axis: int, held_v2: float
                     ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """
    Yield variance, V², (n,), and memory from sample to sample, (n,), of the held rounding error.

    Rounding errors of two outputs that differ by a small share x of a step have the correlation
    1 − 6·x.
    """
    if held_v2 < _SMALLEST_HELD_SHARE * comparison.sensor.lsb_v ** 2 / 12 or not held_v2:
        return
    simulated_v = comparison.simulated_v(comparison.sensor)[:, axis]
    steps = np.abs(np.diff(simulated_v, prepend=simulated_v[:1])) / comparison.sensor.lsb_v
    yield np.full(len(comparison), held_v2), np.exp(-6 * steps)


def _filter(std_v: np.ndarray, memory: np.ndarray, pole: float, noise_v2: float
            ) -> AngleErrorFilter:
    """
    Run the Riccati recursion of the Kalman filter.

    `std_v` is g, V, (n,), `memory` is φ, (n,), and `noise_v2` the variance of (1 − aL)·n, V².
    """
    rows, variance, previous_v = [], 1.0, float(std_v[0])
    for g, phi in zip(std_v.tolist(), memory.tolist()):
        renewal2 = 1 - phi * phi
        weight = g * phi - pole * previous_v
        total_v2 = weight * weight * variance + g * g * renewal2 + noise_v2
        gain = (phi * weight * variance + g * renewal2) / total_v2
        rows.append((phi - gain * weight, gain, weight, sqrt(noise_v2 / total_v2)))
        variance = phi * phi * variance + renewal2 - gain * gain * total_v2
        previous_v = g
    rms_v = float(np.sqrt(np.mean(std_v ** 2)))
    return AngleErrorFilter(rms_v, pole, *np.array(rows).T)
