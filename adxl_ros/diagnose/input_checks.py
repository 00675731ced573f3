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

"""A recording and its reference before the comparison: what is corrected, and what is left out."""

from __future__ import annotations

from dataclasses import replace

from adxl_ros.diagnose.baseline_comparison import BaselineComparison, compare
from adxl_ros.diagnose.data_checks import DataFault, find_clock_fault
from adxl_ros.diagnose.encoder_checks import find_encoder_fault
from adxl_ros.diagnose.reference_bandwidth import fading_frequency_hz
from adxl_ros.diagnose.reference_coverage import too_coarse, without_reading
from adxl_ros.diagnose.sim_alignment import align_force
from adxl_ros.diagnose.stamps import even_stamps
from adxl_ros.files.recording_columns import Recording
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate.motion import Motion
import numpy as np

_SAME_ROUGHNESS = 1.05
"""Ratio of the steps of two residuals up to which they are equal. Chosen: above its scatter by
noise in a thousand samples."""
_LONGEST_STEP_S = 0.5
"""Longest time between samples, s, that follow a moving stage. Chosen: the motion between two
samples is unknown, and stamps in milliseconds are far beyond."""
_SMALLEST_MOVE_RAD = 0.01
"""Range of an angle, rad, above which the stage moves. Chosen: beyond the jitter of an encoder."""


def compare_checked(recording: Recording, sensor: Sensor, sim: Motion | None, may_shift: bool
                    ) -> BaselineComparison | DataFault:
    """
    Put a recording beside the simulator, without the parts that have no reference.

    Parameters
    ----------
    recording
        A recording of `sensor`.
    sensor
        The baseline.
    sim
        Specific force by another simulator, in place of the stage.
    may_shift
        Whether `sim` is shifted in time where its motion is late or early.

    Returns
    -------
    BaselineComparison or DataFault
        The comparison with its notes, or why there is none.

    Raises
    ------
    UserError
        The stage angles jump as no stage does.

    """
    notes: list[str] = []
    even = even_stamps(recording.time_s)
    if even is not None and even.certain:
        recording = replace(recording, time_s=even.time_s)
        notes += [even.note] if even.note else []
    fault = find_clock_fault(recording.time_s)
    if fault is not None:
        return fault
    fault = _too_slow(recording)
    if fault is not None:
        return fault
    if sim is not None:
        aligned = align_force(recording, sensor, sim, may_shift)
        if isinstance(aligned, DataFault):
            return aligned
        recording, sim = aligned.recording, aligned.sim
        notes += aligned.notes
    else:
        fault = find_encoder_fault(recording, sensor)
        if fault is not None:
            return fault
    comparison = compare(recording, sensor, sim)
    if even is not None and not even.certain and len(even.time_s) == len(recording):
        evenly = replace(recording, time_s=even.time_s)
        even_comparison = compare(evenly, sensor, sim)
        if _roughness(even_comparison) < _SAME_ROUGHNESS * _roughness(comparison):
            recording, comparison = evenly, even_comparison
            notes += [even.note] if even.note else []
    left_out = [*without_reading(recording, comparison), *too_coarse(recording, comparison)]
    used = comparison.used.copy()
    for part in left_out:
        used &= ~part.rows
        notes.append(part.text(recording.time_s))
    comparison = replace(comparison, used=used)
    fading_hz = fading_frequency_hz(comparison)
    if fading_hz is not None:
        notes.append(f'--sim is smoother than the sensor: above {fading_hz:.3g} Hz it lacks '
                     'motion that the recording has; effects that show in fast motion are not '
                     'named')
    return replace(comparison, notes=tuple(notes), fading_hz=fading_hz)


def _roughness(comparison: BaselineComparison) -> float:
    """Return the mean square of the residual's steps, V²: wrong instants add to it in motion."""
    return float(np.nanmean(np.diff(comparison.residual_v(comparison.sensor), axis=0) ** 2))


def _too_slow(recording: Recording) -> DataFault | None:
    """Find stamps that are too far apart to follow the stage, as milliseconds in place of s."""
    step_s = float(np.median(np.diff(recording.time_s)))
    angles = [recording.columns[name] for name in ('alpha_rad', 'beta_rad')
              if name in recording.columns]
    moves = any(np.nanmax(angle) - np.nanmin(angle) > _SMALLEST_MOVE_RAD for angle in angles
                if np.isfinite(angle).any())
    if not moves or step_s <= _LONGEST_STEP_S:
        return None
    return DataFault('unit', 'bad_data', f'time_s: {step_s:.3g} s between samples while the stage '
                     f'moves, at most {_LONGEST_STEP_S:g} s are followed; divide stamps in '
                     'milliseconds by 1000')
