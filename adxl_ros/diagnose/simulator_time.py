# SPDX-License-Identifier: Apache-2.0
"""
The part of a recording that another simulator covers, once their clocks agree.

A large shift between both is a fault of the files. A small one may be the latency of the sensor,
which is an effect of the library: it is left alone.
"""

from __future__ import annotations

from dataclasses import replace
from os.path import basename
from typing import NamedTuple

from adxl_ros.diagnose.comparison import compare
from adxl_ros.diagnose.data_faults import DataFault
from adxl_ros.diagnose.motion_shifts import (
    ClockStep,
    CORRELATED,
    Drift,
    find_drift,
    find_step,
    FINE_SAMPLES,
    LARGEST_ERROR_RATIO,
    LARGEST_LATENCY_S,
    left_by_lines,
    Motions,
    SHORTEST_S,
)
from adxl_ros.diagnose.stamp_checks import has_every_sample
from adxl_ros.files.recording_columns import Recording
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate.motion import ForcePath, Motion
from adxl_ros.wording import option
import numpy as np
import scipy

_SAME_CORRELATION = 0.01
"""Correlations that differ by less are equal, and the one of the longest overlap counts. Chosen: a
motion that repeats fits at several shifts."""


class Covered(NamedTuple):
    """The part of a recording that another simulator covers."""

    recording: Recording
    sim: Motion  # The simulator, shifted in time where it was asked for
    notes: list[str]  # What was shifted or left out, for people


def covered_by(recording: Recording, sensor: Sensor, sim: Motion, may_shift: bool) -> Covered:
    """Find the part that another simulator covers, and check their time; raise DataFault."""
    force = sim.force
    assert isinstance(force, ForcePath)
    late_s = _checked_shift_s(recording, sensor, force)
    if may_shift and late_s:
        force = force.shifted(-late_s)
    covered = _rows_within(recording, force)
    if not len(covered):
        raise _no_overlap(recording, force, late_s)
    if late_s and not may_shift:
        raise DataFault(
            'time_misaligned',
            f'{force.name} is {_late_text(late_s)}; use {option(align=True)}, or shift its stamps '
            f'by {-late_s:+.6g} s',
        )
    notes = []
    if may_shift:
        notes.append(_shift_note(force, late_s))
    if len(covered) < len(recording):
        outside_s = (1 - len(covered) / len(recording)) * float(np.ptp(recording.time_s))
        notes.append(
            f'left out: {outside_s:.3g} s of the recording that {force.name} does not '
            f'cover (it is from {_span_text(force.time_s)})'
        )
    return Covered(covered, replace(sim, force=force), notes)


def _rows_within(recording: Recording, force: ForcePath) -> Recording:
    """Return the samples from the first instant of a force to its last."""
    begin = int(np.searchsorted(recording.time_s, force.time_s[0]))
    end = int(np.searchsorted(recording.time_s, force.time_s[-1], 'right'))
    return recording.rows(begin, end)


def _span_text(time_s: np.ndarray) -> str:
    """Return the first and the last time, for people."""
    return f'{time_s[0]:.6g} to {time_s[-1]:.6g} s'


def _late_text(late_s: float) -> str:
    """Return by how much a simulator is late or early."""
    return f'{abs(late_s):.4f} s {"late" if late_s > 0 else "early"}'


def _shift_note(force: ForcePath, late_s: float) -> str:
    """Say what was shifted by the option that allows it; 0 where nothing was."""
    if not late_s:
        return (
            f'{option(align=True)}: no shift beyond {LARGEST_LATENCY_S:g} s was found; less may '
            'be an effect of the sensor (time_offset), and nothing is shifted'
        )
    return (
        f'{option(align=True)}: {force.name} was {_late_text(late_s)}, and is shifted by '
        f'{-late_s:+.6g} s; a latency of the sensor is a part of that and cannot show'
    )


def _no_overlap(recording: Recording, force: ForcePath, late_s: float) -> DataFault:
    """Return the fault of a simulator that has no time in common with the recording."""
    advice = 'no shift makes its motion fit; give that of this recording'
    if late_s:
        advice = f'its motion fits, but is {_late_text(late_s)}; use {option(align=True)}'
    return DataFault(
        'no_overlap',
        f'{force.name} does not overlap the recording in time: it is from '
        f'{_span_text(force.time_s)}, {basename(recording.path)} from '
        f'{_span_text(recording.time_s)}; {advice}',
    )


def _checked_shift_s(recording: Recording, sensor: Sensor, force: ForcePath) -> float:
    """
    Return how much later a simulator is stamped, s; raise DataFault for a step or a drift.

    0 where it may be a latency, or does not show.
    """
    motions = Motions.of(recording, sensor, force)
    if motions is None:
        return 0.0
    late_s = _find_shift_s(motions, recording, sensor, force)
    parts = motions.fitting_parts()
    step = find_step(motions, recording, late_s, parts)
    if step is not None:
        raise _step_fault(step, force)
    drift = find_drift(motions, parts)
    if drift is not None:
        raise _drift_fault(drift, recording, force)
    return late_s


def _find_shift_s(
    motions: Motions, recording: Recording, sensor: Sensor, force: ForcePath
) -> float:
    """Return the shift, s, by the cross-correlation of both motions; 0 for a latency."""
    shortest_s = min(SHORTEST_S, np.ptp(recording.time_s) / 2, np.ptp(force.time_s) / 2)
    every = np.arange(len(motions.measured_s))
    shifts = motions.shifts(every, max(round(shortest_s / motions.step_s), 2))
    lags_s = shifts.lags_s
    correlation = shifts.correlation
    equal = np.flatnonzero(correlation > correlation.max() - _SAME_CORRELATION)
    longest_s = lags_s[equal[np.argmax(shifts.overlap[equal])]]
    best = int(np.argmax(np.where(np.abs(lags_s - longest_s) < 1.0, correlation, -1.0)))
    unshifted = int(np.argmin(np.abs(lags_s)))
    overlaps_unshifted = abs(lags_s[unshifted]) < motions.step_s
    gains_little = 1 - correlation[best] > LARGEST_ERROR_RATIO * (1 - correlation[unshifted])
    if correlation[best] < CORRELATED or (overlaps_unshifted and gains_little):
        return 0.0
    late_s = _fine_shift_s(recording, sensor, force, float(lags_s[best]))
    return late_s if abs(late_s) > LARGEST_LATENCY_S else 0.0


def _fine_shift_s(recording: Recording, sensor: Sensor, force: ForcePath, late_s: float) -> float:
    """Fit shift, s, zero-g and scale factor to the recording, from a rough shift."""
    shifted = force.shifted(-late_s)
    covered = _rows_within(recording, shifted)
    comparison = compare(covered, sensor, Motion(float(np.ptp(shifted.time_s)), force=shifted))
    time_s = comparison.time_s
    volts = comparison.volts
    simulated_v = comparison.simulated_v(comparison.sensor)
    # The ends may need values from outside.
    begin_s = time_s[0] + LARGEST_LATENCY_S
    end_s = time_s[-1] - LARGEST_LATENCY_S
    inside = np.isfinite(volts).all(axis=1) & (time_s > begin_s) & (time_s < end_s)
    rows = np.flatnonzero(inside)[:: max(1, len(recording) // FINE_SAMPLES)]

    def left_v2(more_s: float) -> float:
        """Return what zero-g and scale factor leave after a further shift."""
        later_s = time_s[rows] + more_s
        shifted_v = [np.interp(later_s, time_s, axis_v) for axis_v in simulated_v.T]
        return left_by_lines(volts[rows], np.column_stack(shifted_v))

    found = scipy.optimize.minimize_scalar(
        left_v2,
        bounds=(-LARGEST_LATENCY_S, LARGEST_LATENCY_S),
        method='bounded',
        options={'xatol': 1e-6},
    )
    return late_s + float(found.x)


def _step_fault(step: ClockStep, force: ForcePath) -> DataFault:
    """Return the fault of a clock that steps, with size and time."""
    return DataFault(
        'clock_jump',
        f'the clock of {force.name} or that of the recording steps by '
        f'{abs(step.after_s - step.before_s):.2g} s at about {step.at_s:.4g} s; cut the recording '
        f'there, and diagnose each part with {option(align=True)}',
    )


def _drift_fault(drift: Drift, recording: Recording, force: ForcePath) -> DataFault:
    """Return the fault of two clocks of different rates, with the rate that mends it."""
    ratio = drift.change_s / np.ptp(recording.time_s)
    own_correction = f'use {option(rate=f"{recording.rate_hz / (1 + ratio):.6g}")}'
    if not has_every_sample(recording.time_s):
        own_correction = (
            f'multiply its stamps by {1 + ratio:.6g} ({option("rate")} would miss the gaps)'
        )
    return DataFault(
        'clock_drift',
        f'the clocks of {force.name} and of the recording drift apart by '
        f'{100 * abs(ratio):.3g} s in 100 s, so that no shift fits from begin to end; if that of '
        f'the recording is wrong, {own_correction}, else divide the stamps of {force.name} by '
        f'{1 + ratio:.6g}; a shift that is left then needs {option(align=True)}',
    )
