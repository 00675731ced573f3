# SPDX-License-Identifier: Apache-2.0
"""What the stamps of a recording say: late ones are corrected, and impossible ones refused."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from adxl_ros.diagnose.comparison import BaselineComparison, compare
from adxl_ros.diagnose.data_faults import DataFault
from adxl_ros.diagnose.motion_shifts import LARGEST_LATENCY_S
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stamps import without_stalls
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate.motion import Motion
import numpy as np

_SAME_ROUGHNESS = 1.05
"""Ratio of the steps of two residuals up to which they are equal. Chosen: above its scatter by
noise in a thousand samples."""
_LONGEST_STEP_S = 0.5
"""Longest time between samples, s, that follow a moving stage. Chosen: the motion between two
samples is unknown, and stamps in milliseconds are far beyond."""
_EVEN_STAMPS = 0.01
"""Deviation from a line, in samples, up to which stamps are even. Chosen: nothing shows in the
slowest motion."""
_LARGEST_SCATTER = 0.45
"""Deviation, in samples, by which a stamp still shows the number of its sample: below one half."""
_USUAL_STEP = 1.5  # Largest step of one sample, in medians of all steps: halfway to two samples
_SMALLEST_MOVE_RAD = 0.01
"""Range of an angle, rad, above which the stage moves. Chosen: beyond the jitter of an encoder."""
_JUMP_STEPS = 20.0
"""A step of the stamps of this many usual steps is a jump. Chosen: a link that loses a
buffer of ten samples stays below by a factor of two."""
_LARGEST_JUMP_SHARE = 0.2
"""Share of the recording that jumps may have. Chosen: gaps of a lossy link are no fault of the
clock."""


class Stamped(NamedTuple):
    """A recording whose stamps are those of its samples."""

    recording: Recording
    notes: list[str]  # What was changed, for people


def without_late_stamps(recording: Recording) -> Stamped:
    """Return a recording as if its host had never stalled."""
    mended_s = without_stalls(recording.time_s, 1 / recording.rate_hz, LARGEST_LATENCY_S)
    late_s = recording.time_s - mended_s
    if not late_s.any():
        return Stamped(recording, [])
    note = (
        f'{np.count_nonzero(late_s)} samples are stamped up to {late_s.max():.3g} s late, the '
        f'first at {mended_s[np.flatnonzero(late_s)[0]]:.6g} s, as by a host that stalls and '
        'reads at once what waited: they are taken at an even rate'
    )
    return Stamped(replace(recording, time_s=mended_s), [note])


def check_clock(recording: Recording) -> None:
    """Refuse stamps that run backwards, jump, or are too far apart to follow the stage."""
    time_s = recording.time_s
    steps_s = np.diff(time_s)
    step_s = float(np.median(steps_s))
    backward = np.flatnonzero(steps_s <= 0)
    if len(backward):
        raise DataFault(
            'clock_jump',
            f'the stamps run backwards at {time_s[backward[0]]:.6g} s; '
            'record again with a steady clock',
        )
    wide = np.flatnonzero(steps_s > _JUMP_STEPS * step_s)
    if float(steps_s[wide].sum()) > _LARGEST_JUMP_SHARE * float(steps_s.sum()):
        raise DataFault(
            'clock_jump',
            f'the stamps jump by {steps_s[wide].max():.3g} s at '
            f'{time_s[wide[0]]:.6g} s; cut the recording there, and diagnose the '
            'parts together',
        )
    # Milliseconds in place of seconds are too far apart.
    if step_s > _LONGEST_STEP_S and _stage_moves(recording):
        raise DataFault(
            'unit',
            f'time_s: {step_s:.3g} s between samples while the stage moves, '
            f'at most {_LONGEST_STEP_S:g} s are followed; divide stamps in '
            'milliseconds by 1000',
        )


def _stage_moves(recording: Recording) -> bool:
    """Determine whether an angle of a stage changes by more than its encoder jitters."""
    angles_rad = recording.stage_angles
    if angles_rad is None:
        return False
    range_rad = np.nanmax(angles_rad, axis=0) - np.nanmin(angles_rad, axis=0)
    return bool(np.any(range_rad >= _SMALLEST_MOVE_RAD))


def has_every_sample(stamps_s: np.ndarray) -> bool:
    """Determine whether no sample is missing, so that the number of one tells its time."""
    steps_s = np.diff(stamps_s)
    return bool(steps_s.max() < _USUAL_STEP * np.median(steps_s))


def even_stamps(stamps_s: np.ndarray) -> np.ndarray | None:
    """
    Return the even instants behind stamps that are rounded or scatter; missing samples count.

    None where the stamps are even, or where no line explains them.
    """
    steps_s = np.diff(stamps_s)
    if len(steps_s) < 2 or steps_s.min() <= 0:
        return None
    step_s = float(np.mean(steps_s[steps_s < _USUAL_STEP * np.median(steps_s)]))
    number = np.cumsum([0.0, *np.maximum(np.rint(steps_s / step_s), 1.0)])
    line = np.polynomial.Polynomial.fit(number, stamps_s - stamps_s[0], 1)
    time_s = stamps_s[0] + line(number)
    largest = np.abs(stamps_s - time_s).max() / line.deriv()(0.0)
    return time_s if _EVEN_STAMPS < largest < _LARGEST_SCATTER else None


def compare_by_best_stamps(
    recording: Recording, sensor: Sensor, sim: Motion | None, even_s: np.ndarray | None
) -> BaselineComparison:
    """
    Compare by even instants, s, where they explain a recording as well as its stamps do.

    Samples may also have been taken unevenly, so that the simulation decides. A recording of which
    a part is left out keeps its stamps.
    """
    stamped = compare(recording, sensor, sim)
    if even_s is None or len(even_s) != len(recording):
        return stamped
    evenly = compare(replace(recording, time_s=even_s), sensor, sim)
    if _roughness_v2(evenly) >= _SAME_ROUGHNESS * _roughness_v2(stamped):
        return stamped
    note = (
        f'stamps are uneven, and an even rate of {evenly.sensor.rate_hz:.6g} '
        'Hz explains them: it is used'
    )
    return replace(evenly, notes=(note,))


def _roughness_v2(comparison: BaselineComparison) -> float:
    """Return the mean square of the residual's steps, V²: wrong instants add to it in motion."""
    return float(np.nanmean(np.diff(comparison.residual_v(comparison.sensor), axis=0) ** 2))
