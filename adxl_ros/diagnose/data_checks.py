# SPDX-License-Identifier: Apache-2.0
"""
From a recording to one that can be diagnosed: what is corrected, left out, and refused, in order.

Stamps come first, then the reference, the range of each axis, and what the sensor did not measure.
What the axes say beside the simulation is last. A fault that makes a diagnosis meaningless ends
it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from os.path import basename
from typing import NamedTuple

from adxl_ros.diagnose.axis_checks import check_axes, check_output, stuck
from adxl_ros.diagnose.comparison import at_search_rate, BaselineComparison, leave_out
from adxl_ros.diagnose.data_faults import DataFault
from adxl_ros.diagnose.detection import effect_of
from adxl_ros.diagnose.encoder_checks import check_encoder, seen_step_rad
from adxl_ros.diagnose.fast_motion import fading_frequency_hz, without_fast_motion
from adxl_ros.diagnose.motion_shifts import SHORTEST_S
from adxl_ros.diagnose.reference_checks import check_rest, check_simulator, check_stated_gravity
from adxl_ros.diagnose.reference_gaps import stated_poses, without_gaps
from adxl_ros.diagnose.sample_faults import sample_faults, SampleFaults
from adxl_ros.diagnose.simulator_time import covered_by
from adxl_ros.diagnose.stamp_checks import (
    check_clock,
    compare_by_best_stamps,
    even_stamps,
    without_late_stamps,
)
from adxl_ros.files.recording_columns import Recording
from adxl_ros.model.effects.base import Detector
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from adxl_ros.report.quantities import listed
from adxl_ros.signals.recorded_gravity import RecordingLook
from adxl_ros.simulate.motion import ForcePath, Motion
import numpy as np
import scipy


def check_gravity(recording: Recording, sensor: Sensor, sim: Motion | None) -> list[str]:
    """
    Refuse a recording, or the force of another simulator, whose rests do not read gravity.

    A wrong zero-g or scale factor is an effect that the diagnosis finds, and no fault. Return what
    else is wrong with the samples of the recording.
    """
    doubts: list[str] = []
    if len(recording) > 1:
        look = RecordingLook(sensor, recording)
        look.feed(recording)
        name = basename(recording.path)
        doubts = [f'{name}: {fault}' for fault in look.faults()]
        fault = look.gravity().fault
        if fault is not None and fault.is_clear:
            raise DataFault(fault.data_fault, f'{name}: {fault.text}')
    if sim is not None and isinstance(sim.force, ForcePath):
        check_stated_gravity(sim.force, sensor)
    return doubts


def compare_checked(
    recording: Recording, sensor: Sensor, sim: Motion | None, may_shift: bool
) -> BaselineComparison:
    """
    Put a recording beside the simulator, without the parts that have no reference.

    Raise DataFault where that is meaningless.
    """
    sensor = replace(sensor, rate_hz=recording.rate_hz)
    recording, notes = without_late_stamps(recording)
    check_clock(recording)
    even_s = even_stamps(recording.time_s)
    unknown_poses: list[tuple[np.ndarray, str]] = []
    if sim is not None:
        recording, sim, of_shift = covered_by(recording, sensor, sim, may_shift)
        notes += of_shift
    else:
        check_encoder(recording, sensor)
        step_rad = seen_step_rad(recording, sensor)
        if step_rad > sensor.stage_resolution_rad:
            stated_deg = np.degrees(sensor.stage_resolution_rad)
            notes.append(
                f'the stage reads in steps of {np.degrees(step_rad):.3g}°, not of '
                f'{stated_deg:.3g}° as stated: this is used'
            )
            sensor = replace(sensor, stage_resolution_rad=step_rad)
        recording, unknown_poses = stated_poses(recording, sensor)
    comparison = compare_by_best_stamps(recording, sensor, sim, even_s)
    comparison = replace(comparison, notes=(*notes, *comparison.notes))
    try:
        check_output(comparison)
        check_simulator(comparison)
    except DataFault as fault:
        raise replace(fault, comparisons=(comparison,)) from None
    for rows, reason in unknown_poses if comparison.joints else ():
        comparison = leave_out(comparison, rows, reason)
    comparison = without_gaps(_without_disturbed(comparison))
    # What moves too fast is looked for where the reference is stated.
    comparison = without_fast_motion(comparison, recording.columns)
    return _with_fading(comparison)


def _with_fading(comparison: BaselineComparison) -> BaselineComparison:
    """Find the frequency above which a reference is smoother than the sensor, and say so first."""
    fading_hz = fading_frequency_hz(comparison)
    if fading_hz is None:
        return comparison
    note = (
        f'the reference is smoother than the sensor: above {fading_hz:.3g} Hz it '
        'lacks motion that the recording has; effects that show in fast motion are '
        'not named'
    )
    return replace(comparison, notes=(note, *comparison.notes), fading_hz=fading_hz)


def _without_disturbed(comparison: BaselineComparison) -> BaselineComparison:
    """Leave out what the sensor did not measure: no numbers, repeated, lone or stuck samples."""
    faults = sample_faults(comparison)
    sensor = comparison.sensor
    is_stuck = stuck(comparison)
    readings_mps2 = to_nominal_mps2(comparison.volts, sensor)
    beside = scipy.ndimage.binary_dilation(faults.isolated)
    disturbed = faults.repeated | beside | is_stuck.any(axis=1)
    comparison = replace(comparison, disturbed=disturbed)
    no_number = ~np.isfinite(comparison.volts).all(axis=1)
    comparison = leave_out(comparison, no_number, 'they are no numbers')
    comparison = leave_out(
        comparison,
        faults.repeated,
        'they repeat the one before',
        effect_of(Detector.REPEATED_SAMPLES),
    )
    comparison = leave_out(
        comparison,
        faults.isolated,
        'they stand alone, away from the samples around them',
        effect_of(Detector.ISOLATED_SAMPLES),
    )
    comparison = leave_out(
        comparison, beside, 'they are next to samples that stand alone, and may share a filter'
    )
    for d, axis in enumerate(sensor.axes):
        comparison = leave_out(
            comparison,
            is_stuck[:, d],
            f'{axis} does not change there, though the motion does',
            '',
        )
        held = faults.held[:, d]
        ends = [f'{end:.4g}' for end in np.unique(readings_mps2[held, d])]
        comparison = leave_out(
            comparison,
            held,
            f'{axis} is held at {listed(ends, "and")} m/s², the end of its range',
            effect_of(Detector.HELD_AT_END),
        )
    return replace(comparison, notes=(*comparison.notes, *_notes_on_range(comparison)))


def _notes_on_range(comparison: BaselineComparison) -> list[str]:
    """Say of each axis which samples are at a rail, or beyond the range that the file states."""
    sensor = comparison.sensor
    notes = []
    for d, beyond in enumerate(comparison.out_of_range.T):
        if not beyond.any():
            continue
        output_v = comparison.volts[beyond, d] - sensor.zero_g_v[d]
        largest_g = np.abs(output_v).max() / sensor.scale_v_per_g[d]
        notes.append(
            f'{sensor.axes[d]}: {len(output_v)} samples, up to {largest_g:.3g} g, are at a rail '
            f'or beyond the range of {sensor.range_g:g} g that the parameter file states; set the '
            'range of the sensor'
        )
    return notes


class CheckedRecording(NamedTuple):
    """A recording that can be diagnosed."""

    comparison: BaselineComparison  # The recording beside the baseline at its full rate
    search_comparison: BaselineComparison  # The same at the rate of the search
    faults: SampleFaults  # What the samples themselves show
    stated: Sensor  # The baseline with the steps of the ADC by the parameter file


def check_recording(comparison: BaselineComparison) -> CheckedRecording:
    """
    Check a recording beside its reference; raise DataFault.

    Where codes of the ADC are coarser than stated, the baseline gets their steps, axis by axis.
    """
    faults = sample_faults(comparison)
    stated = comparison.sensor
    comparison = replace(comparison, sensor=faults.sensor)
    search_comparison = at_search_rate(comparison)
    if comparison.pose_known:
        check_axes(search_comparison)
    else:
        check_rest(comparison)
    return CheckedRecording(comparison, search_comparison, faults, stated)


def check_length(comparisons: Sequence[BaselineComparison]) -> None:
    """Refuse recordings that are too short together; one at rest may have any length."""
    used_s = sum(c.span_s * float(c.used.mean()) for c in comparisons)
    if used_s < SHORTEST_S and any(c.pose_known for c in comparisons):
        raise DataFault(
            'too_short',
            f'{used_s:.3g} of {sum(c.span_s for c in comparisons):.3g} s '
            'can be compared, which is too short for a verdict; record at '
            'least one minute, or see the note on what is left out',
            'insufficient',
            tuple(comparisons),
        )
