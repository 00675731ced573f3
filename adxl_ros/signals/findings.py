# SPDX-License-Identifier: Apache-2.0

"""
The findings of `check`.

These are faults of stamps and samples, remarks, and what other tools can do with the recording.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
import os
from typing import NamedTuple

from adxl_ros.errors import one_line, UserError
from adxl_ros.files import recording
from adxl_ros.files.atomic_write import AnyPath
from adxl_ros.files.bag_reader import log_times
from adxl_ros.files.column_mapping import ReadingOptions
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.tables import BLOCK_ROWS
from adxl_ros.model.constants import AXES
from adxl_ros.model.sensor import Sensor
from adxl_ros.report.quantities import counted, duration
from adxl_ros.signals import findings_text as text
from adxl_ros.signals.allan_deviation import shortest_rest_s
from adxl_ros.signals.recorded_sensor import load_sensor
from adxl_ros.signals.recording_contents import examine, log_delay_s, RecordingContents
from adxl_ros.wording import usage
import numpy as np

_LARGEST_MISSING = 0.01  # Share of missing samples of a sound log. Chosen: a lossy link loses less
_LONGEST_GAP_S = 1.0  # Longest gap of a sound log, s. Chosen: a longer one may hide a turn
_LARGEST_JITTER = 0.3  # Jitter of a sound log, periods. Chosen: samples still show
_LARGEST_DELAY_S = 0.1  # Mentioned delay of the log time, s. Chosen: recorders are faster
_MOVED_RAD = 0.01  # Range from which a stage moves, rad. Chosen: beyond jitter of encoders
_SHOWING_C = 1.0
"""Smallest range of temperature that shows effects at rest, °C. Chosen: a typical drift of the
zero-g is then 0.1 mg."""
_SHOWING_V = 0.1  # The same of the supply, V
FEWEST_GRAVITY_POSES = 7  # Orientations of a fit of six parameters against gravity: one more
SHORTEST_MOTION_S = 30.0  # Shortest recording on a moving stage that `diagnose` compares, s
_IN_DEGREES = 'has stage angles in degrees'  # Why no tool can use them
_FEWEST_STAGE_POSES = 4  # Orientations of a linear fit. Chosen: both ends of two axes


class Shown(NamedTuple):
    """What a recording shows of an effect, sizes with their units, for people."""

    effect: str  # Name of the effect
    smallest: str  # Smallest size that would show, or that none would
    typical: str  # Typical size
    missing: str  # What is missing to show it; '' for nothing


@dataclass(frozen=True)
class Ability:
    """What a tool can do with a recording."""

    tool: str  # Name of the tool
    is_able: bool  # Whether it can do its task
    reason: str  # What it uses, or what is missing, for people


@dataclass(frozen=True)
class Findings:
    """The check of a recording."""

    path: str  # The recording
    contents: RecordingContents | None  # What it holds; None where it cannot be read
    faults: tuple[str, ...]  # Why it is not sound, one line each
    remarks: tuple[str, ...] = ()  # What else is noteworthy, one line each
    abilities: tuple[Ability, ...] = ()  # What the tools can do with it
    shows: tuple[Shown, ...] = ()  # By effect what `diagnose` could show
    paste: str = ''  # End of the last fault that is for a command line; empty for none

    @property
    def is_sound(self) -> bool:
        """Whether there is no fault."""
        return not self.faults


def assess(contents: RecordingContents) -> Findings:
    """Return the findings of a recording that can be read."""
    faults = [*_stamp_faults(contents), *contents.neighbour_faults]
    if contents.gravity.fault:
        faults.append(contents.gravity.fault.text)
    if contents.angle_fault:
        faults.append(contents.angle_fault)
    if contents.gyro:
        faults += contents.gyro.faults
    return Findings(
        contents.path,
        contents,
        tuple(faults),
        tuple(_remarks(contents)),
        (_fit(contents), _diagnose(contents), _noise(contents)),
    )


def _has_wide_gaps(contents: RecordingContents) -> bool:
    """Return whether more samples are missing than a sound log lacks."""
    share = contents.missing / (contents.samples + contents.missing)
    return share > _LARGEST_MISSING or contents.longest_gap_s > _LONGEST_GAP_S


def _stamp_faults(contents: RecordingContents) -> list[str]:
    """Return what is wrong with the stamps, one line each."""
    faults = text.bad_stamps(contents)
    if _has_wide_gaps(contents):
        faults.append(
            f'{text.missing(contents)}, or the clock stepped there; record again, or use the parts'
        )
    largest_s = _LARGEST_JITTER / contents.rate_hz
    if contents.jitter_s > largest_s and contents.burst == 1:
        faults.append(text.jitter(contents, largest_s))
    if contents.cut:
        faults.append(contents.cut)
    return faults


def _remarks(contents: RecordingContents) -> list[str]:
    """Return what else is noteworthy, one line each."""
    remarks = list(contents.remarks)
    if contents.missing and not _has_wide_gaps(contents):
        remarks.append(text.missing(contents))
    if contents.burst > 1:
        remarks.append(text.bursts(contents))
    delay_s = contents.log_delay_s or 0.0
    if abs(delay_s) > _LARGEST_DELAY_S:
        remarks.append(text.log_delay(delay_s))
    return remarks


def _span(contents: RecordingContents, name: str) -> float:
    """Return the range of a reference, in its unit; 0 where there is none."""
    low, high = contents.reference_ranges.get(name, (0.0, 0.0))
    return high - low


def _stage_range_rad(contents: RecordingContents) -> float | None:
    """Return the larger range of both stage angles, rad; None without them."""
    if not {'alpha_rad', 'beta_rad'} <= contents.reference_ranges.keys():
        return None
    return max(_span(contents, 'alpha_rad'), _span(contents, 'beta_rad'))


def _fit(contents: RecordingContents) -> Ability:
    """Return whether enough orientations rest for a calibration."""
    if contents.angle_fault:
        return Ability('fit', False, _IN_DEGREES)
    held = f'{counted(contents.poses, "orientation")} in {counted(contents.rests, "rest")}'
    if _stage_range_rad(contents) is not None:
        if contents.poses >= _FEWEST_STAGE_POSES:
            return Ability('fit', True, f'against stage angles, {held}')
        return Ability(
            'fit', False, f'has {held}, needs {_FEWEST_STAGE_POSES} orientations at least'
        )
    if len(contents.axes) < len(AXES):
        return Ability('fit', False, 'has no stage angles, and gravity alone needs x, y and z')
    if contents.poses >= FEWEST_GRAVITY_POSES:
        return Ability('fit', True, f'against gravity, {held}')
    return Ability(
        'fit',
        False,
        f'has {held} and no stage angles, needs {FEWEST_GRAVITY_POSES} orientations',
    )


def _diagnose(contents: RecordingContents) -> Ability:
    """Return whether the motion of a stage, or a change of its surroundings, shows effects."""
    if contents.angle_fault:
        return Ability('diagnose', False, _IN_DEGREES)
    range_rad = _stage_range_rad(contents)
    has_moved = range_rad is not None and range_rad > _MOVED_RAD
    if contents.poses <= 1 and not has_moved:
        follows = []
        if _span(contents, 'temperature_c') > _SHOWING_C:
            follows.append('temperature')
        if _span(contents, 'supply_v') > _SHOWING_V:
            follows.append('supply')
        if follows:
            return Ability('diagnose', True, f'at rest, for effects of {" and ".join(follows)}')
    if range_rad is None:
        return Ability(
            'diagnose',
            False,
            f'has no stage angles; give {usage("diagnose", sim=None)} with the specific force '
            'of the same motion',
        )
    if range_rad < _MOVED_RAD:
        return Ability('diagnose', False, 'has stage angles that do not change; move the stage')
    if contents.span_s < SHORTEST_MOTION_S:
        return Ability(
            'diagnose', False, f'lasts {contents.span_s:.3g} s, needs {SHORTEST_MOTION_S:g} s'
        )
    return Ability('diagnose', True, f'stage angles over {np.degrees(range_rad):.0f}°')


def _noise(contents: RecordingContents) -> Ability:
    """Return whether the longest rest shows noise."""
    longest_s = contents.longest_rest_s
    shortest_s = shortest_rest_s(contents.rate_hz)
    if longest_s >= shortest_s:
        return Ability('noise', True, f'longest rest {duration(longest_s)}')
    return Ability('noise', False, f'rests for {longest_s:.4g} s, needs {shortest_s:.3g} s')


def check_recording(
    given: AnyPath | Recording,
    params: Sensor | str | None,
    reading: ReadingOptions,
    show: Callable[[float], None] = lambda done: None,
) -> Findings:
    """Return the findings of a recording, or of its path; what cannot be read is not sound."""
    if isinstance(given, Recording):
        contents = examine([given], lambda block: load_sensor(params, block), None)
        return replace(assess(contents), path=given.path)
    path = os.fspath(given)
    try:
        delay_s = None
        if reading.rate_hz is None and recording.is_bag(path):
            delay_s = log_delay_s(log_times(path, reading.topic))
        blocks = recording.blocks(path, BLOCK_ROWS, reading)
        contents = examine(_shown(blocks, show), lambda block: load_sensor(params, block), delay_s)
    except UserError as error:
        reason = one_line(error).removeprefix(f'{path}: ')
        return Findings(path, None, (reason,), paste=error.paste)
    return replace(assess(contents), path=path)


def _shown(blocks: Iterator[Recording], show: Callable[[float], None]) -> Iterator[Recording]:
    """Yield blocks, and show how much of the file is read."""
    for block in blocks:
        yield block
        show(block.done)
