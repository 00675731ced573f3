# SPDX-License-Identifier: Apache-2.0

"""
Checks of a pose: one line with the value that is wrong, and what to do.

Each check returns that line, or '' where nothing is wrong.
"""

from __future__ import annotations

from itertools import permutations, product

from adxl_ros.calibrate.guided.pose_plan import Target
from adxl_ros.calibrate.guided.running_estimate import in_g, RunningEstimate
from adxl_ros.model.sensor import Sensor
import numpy as np

_OUTLIER_STDS = 3.5
"""Residual from which a pose is refused, standard deviations; chosen: one of 2000 by chance."""
_MODEL_STD_G = 5e-3
"""Standard deviation of further model errors, g; chosen: it accepts twice the datasheet limits."""
_SAME_READING_G = 0.2
"""Largest difference of readings that count as equal when a mistake is named, g; chosen."""
_WIRING_POSES = 4
"""Poses after which the wiring of the axes counts as right; chosen: all axes have moved."""
_CLOCK_OFFSET_S = 2.0
"""Largest offset of the clocks of stage and sensor, s; chosen: above any delay of messages."""
_RATE_ERROR = 0.05
"""Largest relative error of the sample rate; chosen: above the error of any oscillator."""
_LONGEST_IN_S = 600
"""Longest time that is stated in seconds; a longer time is stated in hours."""


def angle_fault(target: Target, alpha_rad: float, beta_rad: float, tolerance_rad: float) -> str:
    """Refuse a stage that is not at the pose."""
    return ', '.join(
        f'{name} is {degrees_text(now - wanted)} from the target {np.degrees(wanted):.4g}°'
        for name, now, wanted in (('alpha', alpha_rad, target.alpha_rad),
                                  ('beta', beta_rad, target.beta_rad))
        if abs(now - wanted) > tolerance_rad)


def motion_fault(name: str, angles_rad: np.ndarray, tolerance_rad: float) -> str:
    """
    Refuse a joint that turned while the pose was averaged.

    angles_rad: its readings during the dwell, rad, (n,).
    """
    range_rad = float(np.ptp(angles_rad)) if len(angles_rad) else 0.0
    if range_rad <= tolerance_rad:
        return ''
    return (f'{name} moved {degrees_text(range_rad)} while the pose was averaged; hold the stage '
            'still')


def saturation_fault(sensor: Sensor, volts: np.ndarray) -> str:
    """
    Refuse volts at a rail of the ADC or beyond the range of the sensor.

    volts: samples of the pose, V, (n, m).
    """
    rows, columns = np.nonzero(sensor.saturated(volts))
    if not len(rows):
        return ''
    axis = int(columns[0])
    reading_v = volts[rows[0], axis]
    reading_g = (reading_v - sensor.nominal_zero_g_v[axis]) / sensor.nominal_scale_v_per_g[axis]
    return (f'saturated: {sensor.axes[axis]} reads {signed_text(reading_g)} g '
            f'({reading_v:.3f} V), beyond its range of ±{sensor.range_g:g} g or at a rail of the '
            'ADC; check supply and wiring')


def temperature_fault(first_c: float, now_c: float, span_c: float) -> str:
    """Refuse a pose whose temperature differs from that of the first pose."""
    if not abs(now_c - first_c) > span_c:
        return ''
    return (f'temperature moved {abs(now_c - first_c):.1f} °C since the first pose '
            f'({first_c:.1f} to {now_c:.1f} °C), must stay within {span_c:g} °C; wait until it '
            'is back, or finish with the poses so far')


def rate_fault(measured_hz: float, unit: Sensor) -> str:
    """Refuse samples whose rate is not that of the unit."""
    if not abs(measured_hz / unit.rate_hz - 1) > _RATE_ERROR:
        return ''
    expected = f'were {unit.rate_hz:.4g} at the start; keep the rate of the sensor' \
        if 'rate_hz' in unit.measured else \
        f'sensor_info states rate_hz {unit.rate_hz:.4g}; correct the rate of the driver'
    return f'samples are {measured_hz:.4g} a second by their stamps, but {expected}'


def clock_fault(stage_ahead_s: float) -> str:
    """Refuse a stage whose clock differs from that of the samples, by the offset, s."""
    if not abs(stage_ahead_s) > _CLOCK_OFFSET_S:
        return ''
    side = 'ahead of' if stage_ahead_s > 0 else 'behind'
    return (f'stage/joint_states is stamped {_duration_text(abs(stage_ahead_s))} {side} '
            'imu/data_raw: stage and sensor must share one clock (use_sim_time for both or for '
            'none, or synchronise their computers)')


def reading_fault(estimate: RunningEstimate, target: Target, volts: np.ndarray,
                  tolerance_rad: float) -> str:
    """
    Refuse a pose whose mean is an outlier to the prediction from the poses so far.

    volts: mean of the pose, V, (m,).
    """
    sensor = estimate.unit
    expected_v, std_v = estimate.predicted(target.alpha_rad, target.beta_rad)
    slack_v = sensor.nominal_scale_v_per_g * np.hypot(_MODEL_STD_G, tolerance_rad)
    residual_stds = np.abs(volts - expected_v) / np.hypot(std_v, slack_v)
    if residual_stds.max() <= _OUTLIER_STDS:
        return ''
    axis = int(residual_stds.argmax())
    measured_g, expected_g = in_g(sensor, volts), in_g(sensor, expected_v)
    finding = (f'{sensor.axes[axis]} reads {signed_text(measured_g[axis])} g where '
               f'{signed_text(expected_g[axis])} g was expected')
    # After some good poses the wiring is right, but the operator may still be wrong.
    is_wiring_unproven = estimate.poses < _WIRING_POSES
    if is_wiring_unproven and _is_crossed(measured_g, expected_g):
        return f'{finding}: axis inverted or swapped; check wiring, mounting and pose'
    advice = ', or take the pose before again' if estimate.poses and is_wiring_unproven else ''
    angles_rad = estimate.angles_of(target.alpha_rad, target.beta_rad, volts, slack_v)
    distance = angle_fault(target, *angles_rad, tolerance_rad) if angles_rad else ''
    if distance:
        return f'{finding}: by the sensor, {distance}; check the pose and the mounting{advice}'
    return f'{finding}; check the pose, the mounting and the wiring{advice}'


def degrees_text(angle_rad: float) -> str:
    """Return the size of an angle as text, in degrees."""
    size = abs(float(np.degrees(angle_rad)))
    return f'{size:.2f}°' if size < 1 else f'{size:.1f}°'


def signed_text(value: float) -> str:
    """Return a value as text, with its sign."""
    return f'{value:+.2f}'.replace('-', '−')


def _is_crossed(measured_g: np.ndarray, expected_g: np.ndarray) -> bool:
    """Return whether axes with other signs, or in another order, read the expected values."""
    def is_expected(values_g: np.ndarray) -> bool:
        return bool(np.abs(values_g - expected_g).max() < _SAME_READING_G)

    if is_expected(measured_g):
        return False
    signs = product((1, -1), repeat=len(measured_g))
    orders = permutations(measured_g)
    return any(is_expected(np.array(sign) * order) for sign, order in product(signs, orders))


def _duration_text(seconds: float) -> str:
    return f'{seconds:.1f} s' if seconds < _LONGEST_IN_S else f'{seconds / 3600:.3g} h'
