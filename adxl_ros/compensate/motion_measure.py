# SPDX-License-Identifier: Apache-2.0

"""
How much a sensor accelerates, by its specific force alone.

The tilt is that of gravity. An acceleration a across it turns the force by a/g, so that the square
of the acceleration is the variance by which motion raises that of a horizontal force.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import exp

from adxl_ros.model.effects.base import Components, FLOATS, Maths, Value

_LENGTH_STDS = 3.0  # Error of a length that is usual, in standard deviations of an axis

_MOTION_S = 0.2
"""Time constant of the variance that separates motion from noise, s; chosen: the RC filter leaves
some 20 independent samples in twice of it, and a strong vibration is forgotten after 2 s."""

_MANOEUVRE_S = 2.0
"""Time constant of the variance that shows manoeuvres, s; chosen: brakes last as long."""

_REST_S = 1.0
"""Time without motion after which a sensor rests, s; chosen: the variance takes as long to forget
what was before, so that a brake without vibration counts for 2 to 3 s."""

_PAUSE_S = 1.0
"""Time without a sample after which the variance begins again, s; chosen: some time constants."""

_NOISE_FACTOR = 2
"""Multiple of the noise variance that does not count as motion; chosen: the variance of some 20
samples hardly exceeds it by chance."""

_RANGE_STDS = 2.0
"""Smallest range of values in their standard deviations (Popoviciu's inequality): a force whose
variance is s² has changed by at least 2·s."""


def length_excess(length_mps2: Value, error2: Value, gravity_mps2: float, maths: Maths) -> Value:
    """
    Return how much the length of a force departs from gravity beyond its error, m/s².

    A force whose length is not gravity's is in motion, in another sensor, or has lost gravity, and
    at least this much of it is no gravity. error2: the largest variance of an axis, (m/s²)².
    """
    departure = length_mps2 - gravity_mps2
    beyond = maths.maximum(departure, -departure) - _LENGTH_STDS * maths.sqrt(error2)
    return maths.maximum(beyond, 0.0)


class MotionMeasure:
    """
    Measures the motion of a live stream, sample by sample, as a variance, (m/s²)².

    The force in the plane of x and y shows a vibration by its variance within 0.2 s, and a
    manoeuvre by how much its mean has changed in the last seconds of motion; each as far as it
    exceeds twice the variance of the noise. A constant acceleration across gravity is shown by the
    length of the force alone, √(g² + a²), which exceeds its errors from √(6·g·σ) on: 0.6 m/s² for
    an axis with a standard deviation σ of 0.7 mg.
    """

    def __init__(self, noise_variance: Sequence[float], gravity_mps2: float) -> None:
        """Prepare; `noise_variance`, (m/s²)², is that of x and y, or of x alone."""
        self._limits = [_NOISE_FACTOR * variance for variance in noise_variance]
        self._gravity_mps2 = gravity_mps2
        # Times of the last sample, and of the last one with more variance than noise has
        self._time_s = self._moved_s = float('-inf')
        # Weighted mean and variance of the force within 0.2 s, and of this mean within seconds
        self._mean, self._variance = [0.0, 0.0], [0.0, 0.0]
        self._long_mean, self._long_variance = [0.0, 0.0], [0.0, 0.0]
        self._length2 = 0.0  # Weighted mean of the square of the length within 0.2 s, (m/s²)²

    def changes(self, force: Components, time_s: float) -> float:
        """Take the force of a sample; return the variance that its changes show."""
        elapsed_s = time_s - self._time_s
        self._time_s = time_s
        goes_on = 0 <= elapsed_s < _PAUSE_S
        kept = exp(-elapsed_s / _MOTION_S) if goes_on else 0.0
        long_kept = exp(-elapsed_s / _MANOEUVRE_S) if goes_on else 0.0
        vibration = manoeuvre = 0.0
        for d, limit in enumerate(self._limits):
            deviation = force[d] - self._mean[d]
            self._mean[d] += (1 - kept) * deviation
            self._variance[d] = kept * (self._variance[d] + (1 - kept) * deviation * deviation)
            vibration = max(vibration, self._variance[d] - limit)
            change = self._mean[d] - self._long_mean[d]
            self._long_mean[d] += (1 - long_kept) * change
            self._long_variance[d] = long_kept * (
                self._long_variance[d] + (1 - long_kept) * change * change
            )
            manoeuvre = max(manoeuvre, _RANGE_STDS**2 * self._long_variance[d] - limit)
        x, y, z = force
        self._length2 += (1 - kept) * (x * x + y * y + z * z - self._length2)
        if vibration > 0:
            self._moved_s = time_s
        if not self._is_moving:
            self._long_variance = [0.0, 0.0]
            return 0.0
        return vibration + manoeuvre

    @property
    def _is_moving(self) -> bool:
        return 0 <= self._time_s - self._moved_s < _REST_S

    def of_length(self, force: Components, error2: float) -> float:
        """Return the variance that the length of the force of the last sample shows."""
        x, y, z = force
        gravity = self._gravity_mps2
        excess = length_excess((x * x + y * y + z * z) ** 0.5, error2, gravity, FLOATS)
        across2 = 0.0
        # The length of a sensor that rests may be wrong by its drift.
        if self._is_moving and length_excess(self._length2**0.5, error2, gravity, FLOATS) > 0:
            across2 = self._length2 - gravity * gravity
        return max(float(excess) ** 2, across2)
