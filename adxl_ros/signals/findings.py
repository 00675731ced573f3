# SPDX-License-Identifier: Apache-2.0

"""
What a recording holds, read in blocks, and the findings of `check`.

These are faults of stamps and samples, remarks, and what other tools can do with the recording.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
import os
from typing import NamedTuple

from adxl_ros.errors import one_line, UserError
from adxl_ros.files import recording
from adxl_ros.files.atomic_write import AnyPath
from adxl_ros.files.bag_reader import log_times
from adxl_ros.files.column_mapping import ReadingOptions
from adxl_ros.files.recording_columns import (
    BadStamps,
    GYRO,
    Recording,
    REFERENCES,
)
from adxl_ros.files.stamps import burst_samples, lacks_samples, period_s
from adxl_ros.files.tables import BLOCK_ROWS
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from adxl_ros.process import option, usage
from adxl_ros.report.quantities import counted, duration
from adxl_ros.signals.allan_deviation import longest_of, shortest_rest_s
from adxl_ros.signals.axis_ranges import axis_faults, AxisLook, AxisRange
from adxl_ros.signals.gravity_at_rest import GravityAtRest
from adxl_ros.signals.gyroscope_turns import GyroFindings, GyroLook
from adxl_ros.signals.recorded_gravity import RecordingLook
from adxl_ros.signals.recorded_sensor import load_sensor
from adxl_ros.signals.rest_search import Rest
import numpy as np

_SAME_POSE_G = 0.1  # Distance of the means of two rests of one orientation, g. Chosen: 6° of tilt
_MOST_POSES = 200  # Orientations that are counted at most. Chosen: more than a sweep has


@dataclass(frozen=True)
class RecordingContents:
    """What a recording holds."""

    path: str  # The recording
    samples: int  # Number of samples
    span_s: float  # Time from the first to the last sample, s
    rate_hz: float  # Samples over their time, gaps left out, Hz
    jitter_s: float  # Rms deviation of the steps of the stamps, without gaps, s
    burst: int  # Samples of a burst of stamps; 1 for none
    missing: int  # Missing samples
    gaps: int  # Number of gaps
    longest_gap_s: float  # Longest gap, s; 0 for none
    bad_stamps: BadStamps  # Samples whose stamp does not increase
    axes: tuple[AxisRange, ...]  # Ranges by axis
    rest_share: float  # Share of the time at rest
    longest_rest_s: float  # Longest rest, s
    rests: int  # Number of rests
    poses: int  # Number of different orientations among them
    gravity: GravityAtRest  # The length of gravity over the rests
    neighbour_faults: tuple[str, ...]  # What is wrong between neighbouring samples
    # Lowest and highest value of each reference, by column
    reference_ranges: dict[str, tuple[float, float]]
    reference_means: dict[str, float]  # Mean of each reference, by column
    # Usual log time minus header stamp, s; None where there is no bag
    log_delay_s: float | None
    remarks: tuple[str, ...]  # What was assumed or left out in reading
    cut: str  # Where a damaged file ends; empty if it is whole
    gyro: GyroFindings | None = None  # What it shows of its gyroscope; None without one


def examine(
    blocks: Iterable[Recording],
    sensor_of: Callable[[Recording], Sensor],
    log_delay_s: float | None,
) -> RecordingContents:
    """Find what a recording holds; `sensor_of` returns its sensor, calibrated or not."""
    blocks = iter(blocks)
    first = next((block for block in blocks if len(block)), None)
    if first is None:
        raise UserError('the recording holds no samples')
    sensor = sensor_of(first)
    stamps = _Stamps(first)
    look = RecordingLook(sensor, first)
    gyro = _Gyro(first, stamps.period_s) if first.gyro_radps is not None else None
    references = _References()
    for block in chain([first], blocks):
        if not len(block):
            continue
        stamps.feed(block.time_s)
        look.feed(block)
        if gyro is not None:
            gyro.feed(block)
        references.feed(block)
    gravity = look.gravity()
    rests = look.rests.detected
    spans_s = [found.rest.span_s for found in rests]
    longest, _ = longest_of([found.rest for found in rests], stamps.first_s, stamps.last_s)
    means_mps2 = [to_nominal_mps2(found.mean_v, look.nominal) for found in rests]
    span_s = stamps.last_s - stamps.first_s
    return RecordingContents(
        path=block.path,
        samples=stamps.count,
        span_s=span_s,
        rate_hz=stamps.rate_hz,
        jitter_s=stamps.jitter_s,
        burst=stamps.burst,
        missing=stamps.missing,
        gaps=stamps.gaps,
        longest_gap_s=stamps.longest_gap_s,
        bad_stamps=block.bad_stamps,
        axes=look.axes(),
        rest_share=min(sum(spans_s) / span_s, 1.0),
        longest_rest_s=longest.span_s,
        rests=len(spans_s),
        poses=_count_poses(means_mps2),
        gravity=gravity,
        neighbour_faults=tuple(look.faults()),
        reference_ranges=references.ranges,
        reference_means=references.means,
        log_delay_s=log_delay_s,
        remarks=block.remarks,
        cut=block.cut,
        gyro=gyro.result([found.rest for found in rests], means_mps2) if gyro else None,
    )


class _References:
    """Range and mean of each reference, by column."""

    def __init__(self) -> None:
        self.ranges: dict[str, tuple[float, float]] = {}  # Lowest and highest value
        self._sums: defaultdict[str, float] = defaultdict(float)
        self._counts: Counter[str] = Counter()

    def feed(self, block: Recording) -> None:
        """Add the samples of a block, where they are known."""
        for name, values in block.columns.items():
            known = values[np.isfinite(values)]
            if name not in REFERENCES or not len(known):
                continue
            low, high = self.ranges.get(name, (np.inf, -np.inf))
            self.ranges[name] = min(low, float(known.min())), max(high, float(known.max()))
            self._sums[name] += float(known.sum())
            self._counts[name] += len(known)

    @property
    def means(self) -> dict[str, float]:
        """Return the mean of each."""
        return {name: self._sums[name] / self._counts[name] for name in self.ranges}


def log_delay_s(times_ns: Iterable[np.ndarray]) -> float | None:
    """Return the median of log time minus header stamp, ns, (k, 2) by block; None without any."""
    # A few messages of each block are enough, whatever the length of the recording.
    parts = [block[:: max(len(block) // 128, 1)] for block in times_ns]
    return 1e-9 * float(np.median(np.diff(np.concatenate(parts)))) if parts else None


class _Stamps:
    """Statistics of the steps of the stamps; gaps are found by the period of the first block."""

    def __init__(self, first: Recording) -> None:
        if len(first) < 2:
            raise UserError(
                f'{first.path}: {len(first)} sample with a usable stamp; at least 2 '
                f'are needed; {option(rate="HZ")} stamps by index'
            )
        self.burst = burst_samples(first.time_s)
        self.period_s = period_s(first.time_s)
        self.first_s = float(first.time_s[0])
        self.last_s = self.first_s - self.period_s
        self.count = self.missing = self.gaps = 0
        self.longest_gap_s = 0.0
        # Sums over the steps that are no gaps
        self._squares = 0.0
        self._usual_s = 0.0
        self._usual = 0

    def feed(self, time_s: np.ndarray) -> None:
        """Add further stamps."""
        stamps_s = np.concatenate([[self.last_s], time_s]) if self.count else time_s
        steps_s = np.diff(stamps_s)
        is_gap = lacks_samples(stamps_s, self.period_s)
        self.count += len(time_s)
        self.last_s = float(time_s[-1])
        lacking = np.rint(steps_s[is_gap] / self.period_s) - self.burst
        self.missing += int(np.maximum(lacking, 1).sum())
        self.gaps += int(is_gap.sum())
        self.longest_gap_s = max(self.longest_gap_s, float(steps_s[is_gap].max(initial=0.0)))
        usual_s = steps_s[~is_gap]
        self._squares += float(((usual_s - self.period_s) ** 2).sum())
        self._usual_s += float(usual_s.sum())
        self._usual += len(usual_s)

    @property
    def rate_hz(self) -> float:
        """Return samples over their time, gaps left out, Hz."""
        return round(self._usual / self._usual_s if self._usual_s else 1 / self.period_s, 6)

    @property
    def jitter_s(self) -> float:
        """Rms deviation of the steps that are no gaps, s."""
        return float(np.sqrt(self._squares / max(self._usual, 1)))


class _Gyro:
    """What a recording shows of its gyroscope."""

    def __init__(self, first: Recording, period_s: float) -> None:
        self._look = GyroLook(first)
        self._axes = [AxisLook(name, period_s) for name in GYRO]

    def feed(self, block: Recording) -> None:
        """Add a block of the recording."""
        self._look.feed(block)
        for axis in self._axes:
            axis.feed(block.columns[axis.name])

    def result(self, rests: list[Rest], means_mps2: list[np.ndarray]) -> GyroFindings | None:
        """Return the findings; None where it was never sampled."""
        ranges = [axis.result() for axis in self._axes]
        if not np.isfinite([axis.lowest_mps2 for axis in ranges]).all():
            return None
        found = self._look.result(rests, means_mps2)
        stuck = axis_faults(ranges)
        # What is stuck follows no turn.
        return replace(found, faults=tuple(stuck or found.faults))


def _count_poses(means_mps2: Sequence[np.ndarray]) -> int:
    """Return the number of different orientations among the means of rests, m/s², (m,) each."""
    poses: list[np.ndarray] = []
    for mean in means_mps2:
        is_new = all(np.linalg.norm(mean - pose) > _SAME_POSE_G * G0_MPS2 for pose in poses)
        if is_new and len(poses) < _MOST_POSES:
            poses.append(mean)
    return len(poses)


_LARGEST_MISSING = 0.01  # Share of missing samples of a sound log. Chosen: a lossy link loses less
_LONGEST_GAP_S = 1.0  # Longest gap of a sound log, s. Chosen: a longer one may hide a turn
_LARGEST_JITTER = 0.3  # Jitter of a sound log, periods. Chosen: samples still show
_LARGEST_DELAY_S = 0.1  # Mentioned delay of the log time, s. Chosen: recorders are faster
_MOVED_RAD = 0.01  # Range from which a stage moves, rad. Chosen: beyond jitter of encoders
_FOLLOWED = {'temperature_c': ('temperature', 1.0), 'supply_v': ('supply', 0.1)}
"""Name of a reference and its smallest range, °C and V, that shows effects at rest. Chosen: a
typical drift of the zero-g is then 0.1 mg."""
FEWEST_GRAVITY_POSES = 7  # Orientations of a fit of six parameters against gravity: one more
SHORTEST_MOTION_S = 30.0  # Shortest recording on a moving stage that `diagnose` compares, s
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
    if contents.gyro:
        faults += contents.gyro.faults
    return Findings(
        contents.path,
        contents,
        tuple(faults),
        tuple(_remarks(contents)),
        (_fit(contents), _diagnose(contents), _noise(contents)),
    )


def _missing(contents: RecordingContents) -> str:
    expected = contents.samples + contents.missing
    verb = 'is' if contents.missing == 1 else 'are'
    return (
        f'{counted(contents.missing, "sample")} {verb} missing '
        f'({100 * contents.missing / expected:.2g} %) in {counted(contents.gaps, "gap")}, '
        f'the longest of {contents.longest_gap_s:.3g} s'
    )


def _has_wide_gaps(contents: RecordingContents) -> bool:
    share = contents.missing / (contents.samples + contents.missing)
    return share > _LARGEST_MISSING or contents.longest_gap_s > _LONGEST_GAP_S


def _stamp_faults(contents: RecordingContents) -> list[str]:
    which = 'with the stamp of the one before', 'whose stamp steps back'
    faults = [
        f'samples {text}: {count}; {option(drop_bad_stamps=True)} leaves them out'
        for text, count in zip(which, contents.bad_stamps)
        if count
    ]
    if _has_wide_gaps(contents):
        faults.append(
            f'{_missing(contents)}, or the clock stepped there; record again, or use the parts'
        )
    period_s = 1 / contents.rate_hz
    if contents.jitter_s > _LARGEST_JITTER * period_s and contents.burst == 1:
        faults.append(
            f'stamps scatter by {1e3 * contents.jitter_s:.3g} ms rms, expected '
            f'{1e3 * _LARGEST_JITTER * period_s:.3g} ms at most; {option(rate="HZ")} stamps '
            'by index'
        )
    if contents.cut:
        faults.append(contents.cut)
    return faults


def _remarks(contents: RecordingContents) -> list[str]:
    remarks = list(contents.remarks)
    if contents.missing and not _has_wide_gaps(contents):
        remarks.append(_missing(contents))
    if contents.burst > 1:
        remarks.append(
            f'stamps come in bursts of {contents.burst} samples; '
            f'{option(rate=f"{contents.rate_hz:.4g}")} stamps by index'
        )
    delay_s = contents.log_delay_s or 0.0
    if abs(delay_s) > _LARGEST_DELAY_S:
        order = 'after' if delay_s > 0 else 'before'
        remarks.append(
            f'log time is {duration(abs(delay_s))} {order} header time; the clocks of '
            'sensor and recorder differ, or the headers have simulated time'
        )
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
        return Ability(
            'fit',
            is_able,
            f'against stage angles, {held}'
            if is_able
            else f'has {held}, needs {_FEWEST_STAGE_POSES} orientations at least',
        )
    if len(contents.axes) < len(AXES):
        return Ability('fit', False, 'has no stage angles, and gravity alone needs x, y and z')
    is_able = contents.poses >= FEWEST_GRAVITY_POSES
    return Ability(
        'fit',
        is_able,
        f'against gravity, {held}'
        if is_able
        else f'has {held} and no stage angles, needs {FEWEST_GRAVITY_POSES} orientations',
    )


def _diagnose(contents: RecordingContents) -> Ability:
    range_rad = _range_rad(contents)
    if contents.poses <= 1 and not (range_rad and range_rad > _MOVED_RAD):
        follows = [
            text
            for name, (text, smallest) in _FOLLOWED.items()
            if np.ptp(contents.reference_ranges.get(name, (0.0, 0.0))) > smallest
        ]
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
    longest_s = contents.longest_rest_s
    shortest_s = shortest_rest_s(contents.rate_hz)
    return Ability(
        'noise',
        longest_s >= shortest_s,
        f'longest rest {duration(longest_s)}'
        if longest_s >= shortest_s
        else f'rests for {longest_s:.4g} s, needs {shortest_s:.3g} s',
    )


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
    for block in blocks:
        yield block
        show(block.done)
