# SPDX-License-Identifier: Apache-2.0
"""
Whether the angles of a stage have the sign and the unit that the output of the sensor shows.

A wrong sign of β looks like an inverted y, and one of α like inverted x and y. The explanation
with fewer changes is named.
"""

from __future__ import annotations

from collections.abc import Sequence

from adxl_ros.diagnose.data_faults import DataFault
from adxl_ros.files.recording_columns import JOINTS, Recording
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.stage_angles import StageReadings
import numpy as np

_AGED_ZERO_G = 0.01
"""Zero-g, g, from which its sign tells an inverted axis from a wrong angle. Chosen: that of a
healthy unit ages by less."""
_FEWEST_CHANGES = 100
"""Fewest changes of a reading that show the step of its encoder. Chosen: two turns by hand."""
_LARGEST_STEP_RAD = 0.02  # Largest step of an encoder, rad. Chosen: 1°
_COARSER_STEP_RATIO = 1.05
"""Ratio to the stated step from which one counts. Chosen: 1/12° may be stated as 0.083°."""
_WHOLE_STEPS_TOLERANCE = 0.2
"""Deviation of a change from whole steps, in steps, up to which it is one. Chosen: above the
rounding of written angles, and exact readings stay distinct."""
_FEWEST_WHOLE_SHARE = 0.9
"""Share of such changes by encoders. Chosen: 40 % of the changes of exact readings are such."""


def check_encoder(recording: Recording, sensor: Sensor) -> None:
    """Refuse an angle with the wrong sign, or in degrees."""
    angles_rad = recording.stage_angles
    if angles_rad is None:
        return
    readings = StageReadings.of(angles_rad, recording.volts(sensor), sensor)
    if text := readings.degrees_fault():
        raise DataFault('unit', text)
    factors = readings.right_factors()
    if factors is None:
        return
    inverted = [name for name, factor in zip(JOINTS.values(), factors) if factor < 0]
    mirrored = readings.mirrored_axes(factors)
    if len(inverted) > len(mirrored):
        return
    # As many axes as angles may be inverted instead, and their zero-g is then mirrored.
    if len(inverted) == len(mirrored) and _zero_g_is_mirrored(readings, factors, sensor):
        return
    joined = ' and '.join(inverted)
    axes = ' and '.join(sensor.axes[d] for d in mirrored)
    raise DataFault(
        'encoder_sign',
        f'{joined}: opposite sign of the encoder ({readings.correlation_text(factors)} with the '
        f'sign changed); change the sign of {joined}, unless the axis {axes} is inverted',
    )


def _zero_g_is_mirrored(readings: StageReadings, factors: Sequence[float], sensor: Sensor) -> bool:
    """Determine whether an axis is inverted, not an angle: its zero-g is mirrored, too."""
    axis = readings.mirrored_axes(factors)[0]
    aged_v = sensor.zero_g_v - sensor.nominal_zero_g_v
    zero_g = float((aged_v / sensor.scale_v_per_g)[axis])
    offset_g = float(np.mean(readings.measured_g - readings.force_g(factors), axis=0)[axis])
    return abs(zero_g) > _AGED_ZERO_G and abs(offset_g + 2 * zero_g) < abs(offset_g)


def seen_step_rad(recording: Recording, sensor: Sensor) -> float:
    """Return the step that the encoders show, where it exceeds the stated one, rad."""
    largest_rad = sensor.stage_resolution_rad
    for name in ('alpha_rad', 'beta_rad'):
        changes = np.abs(np.diff(recording.columns.get(name, np.zeros(0))))
        changes = changes[changes > 1e-9]
        if len(changes) < _FEWEST_CHANGES:
            continue
        step_rad = float(np.median(changes[changes < 1.5 * changes.min()]))
        few = changes[changes < 4.5 * step_rad]
        # Readings with decimals differ by one step more or less exactly.
        step_rad = float(few.sum() / np.rint(few / step_rad).sum())
        whole = np.abs(few / step_rad - np.rint(few / step_rad)) < _WHOLE_STEPS_TOLERANCE
        has_steps = whole.sum() >= _FEWEST_CHANGES and whole.mean() > _FEWEST_WHOLE_SHARE
        if has_steps and _COARSER_STEP_RATIO * largest_rad < step_rad < _LARGEST_STEP_RAD:
            largest_rad = step_rad
    return largest_rad
