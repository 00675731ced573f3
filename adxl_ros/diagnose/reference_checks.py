# SPDX-License-Identifier: Apache-2.0
"""
Errors of a reference that come before any effect of the sensor: its time, gravity and dynamics.

With a the acceleration of the case and g gravity, the specific force in the turned frame R is
f = R·(a + g), and a simulator with k times the dynamic part states s = R·(k·a + g). Then
(k·f − s)/(k − 1) = R·g has the length of gravity at all times, whatever the rotation was. Only
the right k does so, where the recording has dynamics at all.
"""

from __future__ import annotations

from adxl_ros.diagnose.comparison import BaselineComparison
from adxl_ros.diagnose.data_faults import DataFault
from adxl_ros.diagnose.motion_shifts import correlate, CORRELATED
from adxl_ros.files.recording_columns import stamped_rate_hz
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.error_sizes import rms
from adxl_ros.model.sensor import Sensor
from adxl_ros.process import option
from adxl_ros.report.quantities import mg_text
from adxl_ros.signals import gravity_at_rest, tolerances
from adxl_ros.signals.block_statistics import bridged
from adxl_ros.signals.gravity_at_rest import GravityFaultKind, RestReadings
from adxl_ros.signals.rest_detection import find_rests
from adxl_ros.signals.rest_means import rest_means
from adxl_ros.signals.rest_search import RestRule
from adxl_ros.simulate.motion import ForcePath
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
_SMALLEST_GAP_G = 1e-6
"""Gap below which a simulator holds the recording itself, g. Chosen: files round by less, and the
noise of any sensor is far above."""
_LARGEST_UNEXPLAINED_MOTION_G = 0.3
"""Range of the output, g, that drift and noise cannot explain without a reference. Chosen: 17° of
tilt."""
_RANGE_QUANTILES = (0.02, 0.98)  # Quantiles at the ends of that range. Chosen: without outliers
_SEARCHED_DELAY_S = 1.0  # Largest delay that the effect of a time offset models, s
LARGEST_DELAY_S = 30.0
"""Largest delay that is looked for, s. Chosen: a recording started by hand."""
_CORRELATION_GAIN = 0.05
"""Correlation that a delay must gain. Chosen: above the error of a correlation by noise."""


def check_stated_gravity(force: ForcePath, sensor: Sensor) -> None:
    """
    Refuse the force of another simulator whose rests do not read the gravity of a sensor's place.

    A simulator may have the errors of a sensor, but none beyond its tolerance.
    """
    time_s = force.time_s
    force_mps2 = np.column_stack(force(time_s))
    rate_hz = stamped_rate_hz(time_s)
    rests = find_rests(time_s, force_mps2, rate_hz, RestRule(gravity=G0_MPS2))
    axes = force_mps2.shape[1]
    shape = len(rests), axes
    mean, std = rest_means(time_s, force_mps2, rests, rate_hz)
    readings = RestReadings(np.reshape(mean, shape), np.reshape(std, shape))
    gravity_mps2 = sensor.local_gravity_mps2
    fault = gravity_at_rest.look(readings, tolerances.IDEAL, gravity_mps2).fault
    if fault is not None and fault.is_clear:
        text = fault.stated_by(option(sim_unit=fault.symbol))
        raise DataFault(fault.data_fault, f'{force.name}: {text}')
    tolerance = tolerances.nominal_tolerance(sensor).widest(axes)
    fault = gravity_at_rest.look(readings, tolerance, gravity_mps2).fault
    if fault is not None and fault.kind is GravityFaultKind.SCALE:
        raise DataFault(
            'reference', f'{force.name}: {fault.reason}; check the gravity of its world'
        )


def check_simulator(comparison: BaselineComparison) -> None:
    """Refuse another simulator whose errors no effect of the sensor describes."""
    force = comparison.simulated_force
    if force is None:
        return
    residual_g = comparison.residual_v(comparison.sensor) / comparison.sensor.scale_v_per_g
    if np.nanmax(np.abs(residual_g)) < _SMALLEST_GAP_G:
        raise DataFault(
            'reference',
            f'{force.name} agrees with the recording to {1e6 * _SMALLEST_GAP_G:g} µg in all '
            'samples, as no sensor does: it holds the recording itself',
        )
    text = wrong_dynamic_factor(comparison)
    if text is not None:
        raise DataFault('reference', text)


def check_rest(comparison: BaselineComparison) -> None:
    """Refuse a sensor that moves although no reference describes the motion."""
    finite = np.isfinite(comparison.volts).all(axis=1)
    force_g = comparison.volts[finite] / comparison.sensor.scale_v_per_g
    step_g = np.std(np.diff(force_g, axis=0), axis=0)
    range_g = np.ptp(np.quantile(force_g, _RANGE_QUANTILES, axis=0), axis=0)
    worst = int(np.argmax(range_g))
    if range_g[worst] >= _LARGEST_UNEXPLAINED_MOTION_G and step_g[worst] <= range_g[worst]:
        raise DataFault(
            'reference',
            f'{comparison.sensor.axes[worst]} moves by '
            f'{range_g[worst]:.2f} g, but no stage angles that change; give '
            f'alpha_rad and beta_rad, or {option("sim")} with the specific force of the same '
            'manoeuvre',
        )


def check_delay(simulated_g: np.ndarray, measured_g: np.ndarray, rate_hz: float) -> None:
    """Refuse a sensor that is later or earlier than its reference than a latency explains."""
    found = correlate(simulated_g, measured_g, 1 / rate_hz, 2 * len(simulated_g) // 3)
    is_searched = np.abs(found.lags_s) <= LARGEST_DELAY_S
    by_lag = np.where(is_searched, found.correlation, -1.0)
    best = int(np.argmax(by_lag))
    delay_s = found.lags_s[best]
    undelayed = by_lag[found.lags_s == 0][0]
    is_clear = by_lag[best] > max(CORRELATED, undelayed + _CORRELATION_GAIN)
    if is_clear and abs(delay_s) > _SEARCHED_DELAY_S:
        raise DataFault(
            'time_misaligned',
            f'the sensor is {abs(delay_s):.2f} s '
            f'{"later" if delay_s > 0 else "earlier"} than the reference, but the '
            f'search covers {_SEARCHED_DELAY_S:g} s; shift its stamps',
        )


def wrong_dynamic_factor(comparison: BaselineComparison) -> str | None:
    """Return what is wrong with the factor of a simulator's dynamic part; None if it is right."""
    sensor = comparison.sensor
    force = comparison.simulated_force
    if force is None or len(sensor.axes) < len(AXES):
        return None
    measured_g = _smoothed_g(comparison, comparison.volts)
    stated_g = _smoothed_g(comparison, comparison.simulated_v(sensor))
    gravity_g = sensor.local_gravity_mps2 / G0_MPS2

    def left_g(log_factor: float) -> float:
        """Return the rms error of the length of gravity by (k·f − s)/(k − 1)."""
        turned_g = np.linalg.norm(np.exp(log_factor) * measured_g - stated_g, axis=1)
        difference = abs(np.expm1(log_factor))
        return rms(turned_g - difference * gravity_g) / difference

    gap_g = rms(measured_g - stated_g)
    dynamics_g = min(rms(np.linalg.norm(g, axis=1) - gravity_g) for g in (measured_g, stated_g))
    if min(gap_g, dynamics_g) < _SMALLEST_DYNAMICS_G:
        return None
    lowest, highest = np.log(_FACTORS)
    grid = np.linspace(lowest, highest, 120)
    start = float(min(grid, key=left_g))
    step = float(grid[1] - grid[0])
    found = scipy.optimize.minimize_scalar(
        left_g, bounds=(start - step, start + step), method='bounded'
    )
    factor = float(np.exp(found.x))
    difference = abs(factor - 1)
    is_right = difference < _RIGHT_FACTOR
    if is_right or found.fun > _SAME_LENGTH * min(dynamics_g, gap_g / difference):
        return None
    return (
        f'the dynamic part of {force.name} is {factor:.2g} times that of the recording, while '
        f'its gravity agrees: with that factor, both hold a gravity of {gravity_g:.4g} g to '
        f'{mg_text(found.fun * G0_MPS2)} rms; check how the simulator differentiates its '
        'velocity, and its time step'
    )


def _smoothed_g(comparison: BaselineComparison, volts: np.ndarray) -> np.ndarray:
    """Return means of an output of the sensor, g, (k, m), of samples that are used."""
    sensor = comparison.sensor
    length = max(round(_SMOOTHED_S * sensor.rate_hz), 1)
    force_g = (bridged(volts, comparison.measured) - sensor.zero_g_v) / sensor.scale_v_per_g
    return force_g[: len(force_g) // length * length].reshape(-1, length, len(sensor.axes)).mean(1)
