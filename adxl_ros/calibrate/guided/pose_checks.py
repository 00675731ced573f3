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
Why a pose is not taken: one line with the figure that is wrong, and what to do.

Each function returns that line, or '' where nothing is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence

from adxl_ros.calibrate.guided.pose_plan import Target
from adxl_ros.calibrate.guided.running_estimate import in_g, Known
from adxl_ros.model.sensor import Sensor
import numpy as np

_UNLIKELY = 3.5
"""A reading this many standard deviations from what it should be is that of another pose."""
_MODEL_G = 5e-3
"""What stage and model may miss beyond what is known of them, g."""
_SAME_G = 0.2
"""Readings within this are taken for the same when the kind of a mistake is told."""
_TRUSTED = 4
"""Poses after which the axes are known to be the right ones."""
_CLOCKS_S = 2.0
_RATE = 0.05


def angles(target: Target, alpha_rad: float, beta_rad: float, tolerance_rad: float) -> str:
    """Compare where the stage is with where it was asked to be."""
    return ', '.join(
        f'{name} is {degrees(now - wanted)} from the asked {np.degrees(wanted):.4g}°'
        for name, now, wanted in (('alpha', alpha_rad, target.alpha_rad),
                                  ('beta', beta_rad, target.beta_rad))
        if abs(now - wanted) > tolerance_rad)


def moved(name: str, angles_rad: np.ndarray, tolerance_rad: float) -> str:
    """Refuse a joint that turned while the pose was averaged, by its readings (n,)."""
    by = float(np.ptp(angles_rad)) if len(angles_rad) else 0.0
    return f'{name} moved {degrees(by)} while the pose was averaged; hold the stage still' \
        if by > tolerance_rad else ''


def saturated(sensor: Sensor, volts: np.ndarray) -> str:
    """Refuse volts, (n, m), at a rail of the ADC or beyond the sensor's range."""
    rows, columns = np.nonzero(sensor.saturated(volts))
    if not len(rows):
        return ''
    axis = int(columns[0])
    worst = volts[rows[0], axis]
    reads = (worst - sensor.nominal_zero_g_v[axis]) / sensor.nominal_scale_v_per_g[axis]
    return (f'saturated: {sensor.axes[axis]} reads {signed(reads)} g ({worst:.3f} V), beyond '
            f'its range of ±{sensor.range_g:g} g or at a rail of the ADC; check supply and wiring')


def temperature(first_c: float, now_c: float, span_c: float) -> str:
    """Refuse a pose at another temperature than the first one; NaN is not measured."""
    if not abs(now_c - first_c) > span_c:
        return ''
    return (f'temperature moved {abs(now_c - first_c):.1f} °C since the first pose '
            f'({first_c:.1f} to {now_c:.1f} °C), must stay within {span_c:g} °C: wait until it '
            'is back, or finish with the poses so far')


def rate(measured_hz: float, stated_hz: float) -> str:
    """Compare the rate of the stamps with the one that sensor_info states."""
    if not abs(measured_hz / stated_hz - 1) > _RATE:
        return ''
    return (f'samples are {measured_hz:.4g} a second by their stamps, but sensor_info states '
            f'rate_hz {stated_hz:.4g}; put the rate of the driver right')


def clocks(stage_ahead_s: float) -> str:
    """Refuse a stage whose stamps are not of the samples' time."""
    if not abs(stage_ahead_s) > _CLOCKS_S:
        return ''
    side = 'ahead of' if stage_ahead_s > 0 else 'behind'
    return (f'stage/joint_states is stamped {_span(abs(stage_ahead_s))} {side} imu/data_raw: '
            'stage and sensor must share one clock (use_sim_time for both or for none, or '
            'synchronise their computers)')


def reading(known: Known, target: Target, volts: np.ndarray, tolerance_rad: float) -> str:
    """
    Compare what a pose reads with what the poses so far, or the datasheet, let expect.

    Parameters
    ----------
    known
        From the poses so far.
    target
        The angles at which the pose was taken.
    volts
        Their mean, (m,).
    tolerance_rad
        How far the stage may be off its angles.

    """
    sensor = known.unit
    expected_v, std_v = known.reading(target.alpha_rad, target.beta_rad)
    slack_v = sensor.nominal_scale_v_per_g * np.hypot(_MODEL_G, tolerance_rad)
    far = np.abs(volts - expected_v) / np.hypot(std_v, slack_v)
    if far.max() <= _UNLIKELY:
        return ''
    axis = int(far.argmax())
    reads, expected = in_g(sensor, volts), in_g(sensor, expected_v)
    said = (f'{sensor.axes[axis]} reads {signed(reads[axis])} g where '
            f'{signed(expected[axis])} g was expected')
    # The wiring that has read some poses right does not change; the operator may be mistaken.
    if known.poses < _TRUSTED and _crossed(reads, expected):
        return f'{said}: axis inverted or swapped; check wiring, mounting and pose'
    before = ', or take the pose before again' if 0 < known.poses < _TRUSTED else ''
    there = known.seen_at(target.alpha_rad, target.beta_rad, volts, slack_v)
    off = angles(target, *there, tolerance_rad) if there else ''
    if off:
        return f'{said}: by the sensor, {off}; check the pose and the mounting{before}'
    return f'{said}; check the pose, the mounting and the wiring{before}'


def degrees(angle_rad: float) -> str:
    """Write the size of an angle."""
    size = abs(float(np.degrees(angle_rad)))
    return f'{size:.2f}°' if size < 1 else f'{size:.1f}°'


def signed(value: float) -> str:
    """Write a figure with its sign."""
    return f'{value:+.2f}'.replace('-', '−')


def _crossed(reads: np.ndarray, expected: np.ndarray) -> bool:
    """Tell whether axes with other signs, or in another order, read what was expected."""
    def same(a: Sequence[float] | np.ndarray) -> bool:
        return bool(np.abs(np.asarray(a) - expected).max() < _SAME_G)

    signs = np.array(np.meshgrid(*[[1, -1]] * len(reads))).reshape(len(reads), -1).T
    orders = [np.roll(np.arange(len(reads)), i)[::step] for i in range(len(reads))
              for step in (1, -1)]
    return not same(reads) and any(same(sign * reads[order]) for order in orders
                                   for sign in signs)


def _span(seconds: float) -> str:
    return f'{seconds:.1f} s' if seconds < 600 else f'{seconds / 3600:.3g} h'
