# SPDX-License-Identifier: Apache-2.0

"""The findings of `check`: faults of a recording, remarks, and what other tools can do with it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from adxl_ros.errors import one_line, UserError
from adxl_ros.files import recording
from adxl_ros.files.bag_reader import log_times
from adxl_ros.files.column_mapping import likely_unit, ReadingOptions
from adxl_ros.files.recording_columns import Recording, uncalibrated
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.sensor import Sensor
from adxl_ros.report.quantities import counted, duration
from adxl_ros.signals.allan_deviation import shortest_rest_s
from adxl_ros.signals.recorded_sensor import load_sensor
from adxl_ros.signals.recording_contents import examine, log_delay, RecordingContents
import numpy as np

_LARGEST_MISSING = 0.01
"""Share of missing samples of a sound recording. Chosen: a lossy link loses less."""
_LONGEST_GAP_S = 1.0
"""Longest gap of a sound recording, s. Chosen: a pose or a turn may be in a longer one."""
_LARGEST_JITTER = 0.3
"""Jitter of the stamps of a sound recording, periods. Chosen: they still show the samples."""
_FEWEST_CLIPPED = 3
"""Times at the end of the range from which a recording is not sound. Chosen: once may be a knock.
"""
_LENGTHS_G = (0.8, 1.25)
"""Bounds of the length of gravity, g. Chosen: zero-g and scale errors stay within them."""
_LARGEST_DELAY_S = 0.1
"""Delay of the log time that is mentioned, s. Chosen: a usual recorder is faster."""
_LARGEST_SPREAD_S = 1.0
"""Spread of this delay in a sound recording, s. Chosen: a step of the clock is larger."""
_LARGEST_DRIFT_PPM = 200.0
"""Drift of this delay that is mentioned, 10⁻⁶. Chosen: twice that of a usual quartz."""
_MOVED_RAD = 0.01
"""Range of a stage angle from which the stage moves, rad. Chosen: beyond jitter of encoders."""
_FOLLOWED = {'temperature_c': ('temperature', 1.0), 'supply_v': ('supply', 0.1)}
"""Name of a reference and its smallest range, °C and V, that shows effects at rest. Chosen: a
typical drift of the zero-g is then 0.1 mg."""
FEWEST_GRAVITY_POSES = 10
"""Orientations that a fit against gravity needs: one more than zero-g, scale factors and
misalignments have values."""
SHORTEST_MOTION_S = 30.0
"""Shortest recording on a moving stage that `diagnose` compares, s."""
_FEWEST_STAGE_POSES = 4
"""Orientations on a stage that a linear fit needs. Chosen: both ends of two axes."""


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
    # By effect what `diagnose` could show: effect, smallest and typical size, what is missing
    shows: tuple[tuple[str, str, str, str], ...] = ()
    paste: str = ''  # End of the last fault that is for a command line; empty for none

    @property
    def is_sound(self) -> bool:
        """Whether there is no fault."""
        return not self.faults


def assess(contents: RecordingContents) -> Findings:
    """Return the findings of a recording that can be read."""
    faults = [*_stamp_faults(contents), *_sample_faults(contents)]
    return Findings(contents.path, contents, tuple(faults), tuple(_remarks(contents)),
                    (_fit(contents), _diagnose(contents), _noise(contents)))


def _missing(contents: RecordingContents) -> str:
    expected = contents.samples + contents.missing
    return (f'{contents.missing} samples are missing ({100 * contents.missing / expected:.2g} %) '
            f'in {counted(contents.gaps, "gap")}, the longest of {contents.longest_gap_s:.3g} s')


def _has_wide_gaps(contents: RecordingContents) -> bool:
    share = contents.missing / (contents.samples + contents.missing)
    return share > _LARGEST_MISSING or contents.longest_gap_s > _LONGEST_GAP_S


def _stamp_faults(contents: RecordingContents) -> list[str]:
    faults = []
    duplicates, backward = contents.bad_stamps
    if duplicates:
        faults.append(f'samples with the stamp of the one before: {duplicates}; --drop-bad-stamps '
                      'leaves them out')
    if backward:
        faults.append(f'samples whose stamp steps back: {backward}; --drop-bad-stamps leaves them '
                      'out')
    if _has_wide_gaps(contents):
        faults.append(f'{_missing(contents)}; record again, or use the parts')
    period_s = 1 / contents.rate_hz
    if contents.jitter_s > _LARGEST_JITTER * period_s and contents.burst == 1:
        faults.append(f'stamps scatter by {1e3 * contents.jitter_s:.3g} ms rms, expected '
                      f'{1e3 * _LARGEST_JITTER * period_s:.3g} ms at most; --rate HZ stamps by '
                      'index')
    delay = contents.delay
    if delay is not None and delay.spread_s > _LARGEST_SPREAD_S \
            and not delay.is_simulated:
        faults.append(f'log time minus header time varies by {delay.spread_s:.3g} s, expected '
                      f'{_LARGEST_SPREAD_S:g} s at most; a clock was set, or messages came late')
    if contents.cut:
        faults.append(contents.cut)
    return faults


def _sample_faults(contents: RecordingContents) -> list[str]:
    faults = [f'{axis.name} never changes; the axis is stuck, or not connected'
              for axis in contents.axes if axis.is_stuck]
    faults += [f'{axis.name} does not change for {axis.held_s:.3g} s while other axes do; the '
               'axis is stuck then' for axis in contents.axes
               if axis.held_s > contents.held_s and not axis.is_stuck]
    faults += [f'{axis.name} stays at its extreme value {axis.clipped} times in motion; its range '
               f'ends at {axis.lowest_mps2 / G0_MPS2:.3g} or {axis.highest_mps2 / G0_MPS2:.3g} g'
               for axis in contents.axes if axis.clipped >= _FEWEST_CLIPPED]
    if contents.held_s:
        faults.append(f'no axis changes for {contents.held_s:.3g} s; the driver repeats a sample')
    length_g = contents.length_g
    if length_g is not None and not _LENGTHS_G[0] < length_g < _LENGTHS_G[1]:
        unit = likely_unit(length_g * G0_MPS2)
        hint = f'the readings seem to be in {unit}: state it by --columns' if unit else \
            'check unit and scale factor'
        faults.append(f'at rest the specific force is {length_g * G0_MPS2:.3g} m/s², expected '
                      f'{G0_MPS2:.3g}; {hint}')
    return faults


def _remarks(contents: RecordingContents) -> list[str]:
    remarks = list(contents.remarks)
    if contents.missing and not _has_wide_gaps(contents):
        remarks.append(_missing(contents))
    if contents.burst > 1:
        remarks.append(f'stamps come in bursts of {contents.burst} samples; --rate '
                       f'{contents.rate_hz:.4g} stamps by index')
    delay = contents.delay
    if delay is not None and abs(delay.median_s) > _LARGEST_DELAY_S:
        order = 'after' if delay.median_s > 0 else 'before'
        remarks.append(f'log time is {duration(abs(delay.median_s))} {order} header time; the '
                       'clocks of sensor and recorder differ')
    if delay is not None and abs(delay.drift_ppm) > _LARGEST_DRIFT_PPM:
        ratio = 1 - 1e-6 * delay.drift_ppm
        remarks.append(f'header time runs {ratio:.6g} times as fast as log time; the headers have '
                       'simulated time, or a clock of their own')
    return remarks


def _range_rad(contents: RecordingContents) -> float | None:
    """Return the larger range of both stage angles, rad; None without them."""
    ranges = [contents.reference_ranges.get(name) for name in ('alpha_rad', 'beta_rad')]
    if any(limits is None for limits in ranges):
        return None
    return max(limits[1] - limits[0] for limits in ranges if limits is not None)


def _fit(contents: RecordingContents) -> Ability:
    held = f'{counted(contents.poses, "orientation")} in {counted(contents.rests, "rest")}'
    if _range_rad(contents) is not None:
        is_able = contents.poses >= _FEWEST_STAGE_POSES
        return Ability('fit', is_able, f'against stage angles, {held}' if is_able else
                       f'has {held}, needs {_FEWEST_STAGE_POSES} orientations at least')
    if len(contents.axes) < len(AXES):
        return Ability('fit', False, 'has no stage angles, and gravity alone needs x, y and z')
    is_able = contents.poses >= FEWEST_GRAVITY_POSES
    return Ability('fit', is_able, f'against gravity, {held}' if is_able else
                   f'has {held} and no stage angles, needs {FEWEST_GRAVITY_POSES} orientations')


def _diagnose(contents: RecordingContents) -> Ability:
    range_rad = _range_rad(contents)
    if contents.poses <= 1 and not (range_rad and range_rad > _MOVED_RAD):
        follows = [text for name, (text, smallest) in _FOLLOWED.items()
                   if np.ptp(contents.reference_ranges.get(name, (0.0, 0.0))) > smallest]
        if follows:
            return Ability('diagnose', True, f'at rest, for effects of {" and ".join(follows)}')
    if range_rad is None:
        return Ability('diagnose', False, 'has no stage angles; give --sim with the specific '
                       'force of the same motion')
    if range_rad < _MOVED_RAD:
        return Ability('diagnose', False, 'has stage angles that do not change; move the stage')
    if contents.span_s < SHORTEST_MOTION_S:
        return Ability('diagnose', False, f'lasts {contents.span_s:.3g} s, needs '
                       f'{SHORTEST_MOTION_S:g} s')
    return Ability('diagnose', True, f'stage angles over {np.degrees(range_rad):.0f}°')


def _noise(contents: RecordingContents) -> Ability:
    longest_s, shortest_s = contents.longest_rest_s, shortest_rest_s(contents.rate_hz)
    return Ability('noise', longest_s >= shortest_s,
                   f'longest rest {duration(longest_s)}' if longest_s >= shortest_s else
                   f'rests for {longest_s:.4g} s, needs {shortest_s:.3g} s')


BLOCK_ROWS = 65536
"""Samples that are read at a time (chosen: some MB)."""


def check_recording(path: str, params: str | None, reading: ReadingOptions,
                    show: Callable[[float], None] = lambda done: None) -> Findings:
    """Return the findings of a recording; one that cannot be read is not sound."""
    try:
        delay = None
        if reading.rate_hz is None and recording.is_bag(path):
            delay = log_delay(log_times(path, reading.topic))

        def unit_of(block: Recording) -> Sensor:
            sensor = load_sensor(params, block)
            return uncalibrated(sensor, block.stream_info, block.axes, sensor.rate_hz)

        blocks = recording.blocks(path, BLOCK_ROWS, reading)
        contents = examine(_shown(blocks, show), unit_of, delay)
    except UserError as error:
        reason = one_line(error).removeprefix(f'{path}: ')
        return Findings(path, None, (reason,), paste=error.paste)
    return replace(assess(contents), path=path)


def _shown(blocks: Iterator[Recording], show: Callable[[float], None]) -> Iterator[Recording]:
    for block in blocks:
        yield block
        show(block.done)
