# SPDX-License-Identifier: Apache-2.0
"""
Errors of another simulator that come before any effect of the sensor.

With a the acceleration of the case and g gravity, the specific force in the turned frame R is
f = R·(a + g), and a simulator with k times the dynamic part states s = R·(k·a + g). Then
(k·f − s)/(k − 1) = R·g has the length of gravity at all times, whatever the rotation was. Only
the right k does so, where the recording has dynamics at all.
"""

from __future__ import annotations

from typing import NamedTuple

from adxl_ros.diagnose.comparison import BaselineComparison, bridged, SMALLEST_MOTION_G
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.error_sizes import rms
from adxl_ros.report.quantities import mg_text
import numpy as np
import scipy

_SMOOTHED_S = 0.1
"""Length of the means in which the length of gravity is taken, s. Chosen: shorter than a move, and
the noise of a sensor is then below a mg."""
_FACTORS = (0.05, 20.0)  # Smallest and largest factor of the dynamic part that is looked for
_RIGHT_FACTOR = 0.1
"""Deviation from 1, relative, from which the factor of a dynamic part is wrong. Chosen: less may
be the filter of a reference, which is an effect."""
_SAME_LENGTH = 0.3
"""Error of the length of gravity with the factor, divided by that without any dynamic part and by
the gap, up to which the factor explains both. Chosen: filters and noise leave a part."""
_SMALLEST_DYNAMICS_G = 5e-3
"""Rms of the length of a force about that of gravity from which it has dynamics, g. Chosen: the
errors of a healthy, uncalibrated sensor's zero-g are larger, but those of its length are less."""


def _smoothed_g(comparison: BaselineComparison, volts: np.ndarray) -> np.ndarray:
    """Return means of an output of the sensor, g, (k, m), of samples that are used."""
    sensor = comparison.sensor
    length = max(round(_SMOOTHED_S * sensor.rate_hz), 1)
    force_g = (bridged(volts, comparison.measured) - sensor.zero_g_v) / sensor.scale_v_per_g
    return force_g[: len(force_g) // length * length].reshape(-1, length, len(sensor.axes)).mean(1)


def wrong_dynamic_factor(comparison: BaselineComparison) -> str | None:
    """Return what is wrong with the factor of a simulator's dynamic part; None if it is right."""
    sensor = comparison.sensor
    force = comparison.simulated_force
    if force is None or len(sensor.axes) < len(AXES):
        return None
    measured_g = _smoothed_g(comparison, comparison.volts)
    stated_g = _smoothed_g(comparison, comparison.simulated_v(sensor))
    gravity_g = sensor.local_gravity_mps2 / G0_MPS2

    def length_error_g(log_factor: float) -> float:
        """Return the rms error of the length of gravity, as a part of the difference."""
        factor = np.exp(log_factor)
        turned_g = np.linalg.norm(factor * measured_g - stated_g, axis=1)
        return rms(turned_g - abs(factor - 1) * gravity_g)

    gap_g = rms(measured_g - stated_g)
    dynamics_g = min(rms(np.linalg.norm(g, axis=1) - gravity_g) for g in (measured_g, stated_g))
    if min(gap_g, dynamics_g) < _SMALLEST_DYNAMICS_G:
        return None
    grid = np.linspace(np.log(_FACTORS[0]), np.log(_FACTORS[1]), 120)
    start = float(min(grid, key=lambda v: length_error_g(v) / abs(np.expm1(v))))
    step = float(grid[1] - grid[0])
    best = float(
        scipy.optimize.minimize_scalar(
            lambda v: length_error_g(v) / abs(np.expm1(v)),
            bounds=(start - step, start + step),
            method='bounded',
        ).x
    )
    factor = float(np.exp(best))
    left_g = length_error_g(best) / abs(factor - 1)
    is_right = abs(factor - 1) < _RIGHT_FACTOR
    largest_left = _SAME_LENGTH * min(dynamics_g * abs(factor - 1), gap_g)
    if is_right or length_error_g(best) > largest_left:
        return None
    return (
        f'the dynamic part of {force.name} is {factor:.2g} times that of the recording, while '
        f'its gravity agrees: with that factor, both hold a gravity of {gravity_g:.4g} g to '
        f'{mg_text(left_g * G0_MPS2)} rms; check how the simulator differentiates its '
        'velocity, and its time step'
    )


class Correlations(NamedTuple):
    """Correlations of two motions by lag, (lags,) each."""

    lags: np.ndarray  # Sample i of the first meets sample i + lag of the second
    overlap: np.ndarray  # Number of samples that overlap
    correlation: np.ndarray  # −1 where too few overlap, or one does not move


def correlations(first: np.ndarray, second: np.ndarray, smallest: int) -> Correlations:
    """
    Correlate two motions, g, (n, m) and (n', m), at all lags, each over the samples that overlap.

    At least `smallest` samples must overlap.
    """

    def products(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return scipy.signal.correlate(b, a, method='fft')

    one, two = np.ones(len(first)), np.ones(len(second))
    overlap = np.maximum(np.rint(products(one, two)), 1)
    covariance = np.zeros(len(overlap))
    squares = np.zeros((2, len(overlap)))
    for a, b in zip((first - first.mean(axis=0)).T, (second - second.mean(axis=0)).T):
        sum_a, sum_b = products(a, two), products(one, b)
        covariance += np.abs(products(a, b) - sum_a * sum_b / overlap)
        squares[0] += products(a * a, two) - sum_a**2 / overlap
        squares[1] += products(one, b * b) - sum_b**2 / overlap
    smallest_square = SMALLEST_MOTION_G**2 * overlap
    compared = (overlap >= smallest) & (squares > smallest_square).all(axis=0)
    correlation = covariance / np.sqrt(np.maximum(squares, smallest_square).prod(axis=0))
    return Correlations(
        scipy.signal.correlation_lags(len(second), len(first)),
        overlap,
        np.where(compared, correlation, -1.0),
    )
