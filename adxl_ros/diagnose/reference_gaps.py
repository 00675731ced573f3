# SPDX-License-Identifier: Apache-2.0
"""
Gaps between the readings of a reference: which are bridged, and which samples are left out.

A pose that is stated before and after a gap, while the sensor rests, holds in between. Where a
reference may have moved in a gap, it is not known, and neither is it shortly before and after.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

from adxl_ros.diagnose.comparison import BaselineComparison, leave_out
from adxl_ros.files.recording_columns import JOINTS, Recording
from adxl_ros.files.reference_track import LONGEST_MOVE_NS, USUAL_GAPS
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.stage_angles import SMALLEST_MOTION_G
from adxl_ros.simulate.smoothed_path import visible_step
import numpy as np

_LONGEST_BRIDGE_S = LONGEST_MOVE_NS / 1e9
"""Longest time without a reading of a joint that is bridged, s: that of a move."""
_SLOWEST_S = 1.0
"""Longest time without a reading of a slow encoder that is bridged, s: a move at most."""
_BEFORE_S = 0.1  # Time left out before a gap, s. Chosen: the spline is uncertain there
_AFTER_S = 0.3  # Time left out after a gap, s. Chosen: an RC filter of 15 Hz has settled
_SAME_POSE = 1e-4  # Change of a joint over a gap without a move, rad or m. Chosen: 0.1 mg
_SAME_STEPS = 2.0
"""Change of a joint over such a gap, steps of its encoder. Chosen: two readings that scatter by
one step."""
_LAG_S = 0.02
"""Lag of differences that show the noise, s. Chosen: an RC filter has forgotten it."""
_STILL_STD_RATIO = 3.0
"""Standard deviation of the output, divided by that noise, up to which it rests. Chosen: motion
below 2 Hz exceeds it."""


def without_gaps(comparison: BaselineComparison) -> BaselineComparison:
    """Leave out samples in gaps of another simulator."""
    time_s, force = comparison.time_s, comparison.stated_force
    if force is None:
        return comparison
    limit_s = max(_LONGEST_BRIDGE_S, USUAL_GAPS * float(np.median(np.diff(force.time_s))))
    unknown = np.zeros(len(time_s), bool)
    for begin, end in _in_gaps(time_s, force.time_s, limit_s):
        if end > begin:
            begin_s, end_s = time_s[begin] - _BEFORE_S, time_s[end - 1] + _AFTER_S
            unknown |= (time_s >= begin_s) & (time_s <= end_s)
    return leave_out(
        comparison, unknown, f'no reading of {force.name} for more than {limit_s:.3g} s'
    )


def stated_poses(
    recording: Recording, sensor: Sensor
) -> tuple[Recording, list[tuple[np.ndarray, str]]]:
    """
    Fill the gaps of the stage's joints, and return the samples at which one is not known, and why.

    A pose that is stated before and after a gap, while the output rests, holds in between. Other
    gaps are left out; exact readings go on in a line, so that their spline stays even.
    """
    output_g = recording.volts(sensor) / sensor.scale_v_per_g
    columns = dict(recording.columns)
    left_out = []
    for joint, name in JOINTS.items():
        readings = columns.get(name, np.zeros(0))
        if np.isfinite(readings).sum() < 2:
            continue
        step = 0.0 if joint == 'shift' else sensor.stage_resolution_rad
        bridges = _Bridges.over(recording, output_g, readings, step)
        columns[name] = bridges.values
        reason = f'no reading of {name} for more than {bridges.limit_s:.3g} s'
        left_out.append((bridges.unknown, reason))
    return replace(recording, columns=columns), left_out


class _Bridges(NamedTuple):
    """The values of one joint over the gaps between its readings."""

    values: np.ndarray  # Readings, and values in the gaps that are bridged, (n,)
    unknown: np.ndarray  # Samples at which the joint is not known, (n,) bool
    limit_s: float  # Longest gap without an effect, s

    @classmethod
    def over(
        cls, recording: Recording, output_g: np.ndarray, readings: np.ndarray, step: float
    ) -> _Bridges:
        """Bridge the gaps of readings, (n,), of an encoder with this step; NaN is none."""
        time_s = recording.time_s
        read = np.isfinite(readings)
        read_s = time_s[read]
        line = np.interp(time_s, read_s, readings[read])
        is_exact = not step or visible_step(readings[read], step) < step
        usual_s = USUAL_GAPS * float(np.median(np.diff(read_s)))
        limit_s = max(_LONGEST_BRIDGE_S, min(usual_s, _SLOWEST_S))
        lag = max(1, round(_LAG_S * recording.rate_hz))
        values = readings.copy()
        unknown = np.zeros(len(time_s), bool)
        for begin, end in _in_gaps(time_s, read_s, _LONGEST_BRIDGE_S):
            is_inner = 0 < begin < end < len(time_s)
            gap_s = time_s[min(end, len(time_s) - 1)] - time_s[max(begin - 1, 0)]
            is_long = gap_s > limit_s
            holds = (
                is_inner
                and _is_still(output_g[begin:end], lag)
                and abs(line[end] - line[begin - 1]) <= _SAME_STEPS * step + _SAME_POSE
            )
            if is_inner and (holds or (is_exact and is_long)):
                # An encoder goes on with its last reading, and not in a line.
                values[begin:end] = line[begin:end] if is_exact else line[begin - 1]
            if is_long and not holds:
                unknown |= (time_s > time_s[begin] - _BEFORE_S) & (
                    time_s < time_s[end - 1] + _AFTER_S
                )
        return cls(values, unknown, limit_s)


def _in_gaps(
    time_s: np.ndarray, read_s: np.ndarray, longest_s: float
) -> Iterable[tuple[int, int]]:
    """
    Yield the samples, begin and end, in gaps between readings that are not bridged.

    Before the first reading and after the last, the ends of the recording count.
    """
    ends_s = np.concatenate([[min(time_s[0], read_s[0])], read_s, [max(time_s[-1], read_s[-1])]])
    for i in np.flatnonzero(np.diff(ends_s) > longest_s):
        yield (
            int(np.searchsorted(time_s, ends_s[i], 'right' if i else 'left')),
            int(
                np.searchsorted(time_s, ends_s[i + 1], 'right' if i > len(read_s) - 1 else 'left')
            ),
        )


def _is_still(output_g: np.ndarray, lag: int) -> bool:
    """Determine whether an output, g, (n, m), neither moves far nor slowly; with NaN as gaps."""
    output_g = output_g[np.isfinite(output_g).all(axis=1)]
    if len(output_g) <= 2 * lag:
        return True
    noise_g = np.sqrt(np.mean((output_g[lag:] - output_g[:-lag]) ** 2, axis=0) / 2)
    return bool(
        np.all(
            output_g.std(axis=0)
            < np.minimum(SMALLEST_MOTION_G, _STILL_STD_RATIO * noise_g) + _SAME_POSE
        )
    )
