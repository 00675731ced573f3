# SPDX-License-Identifier: Apache-2.0

"""What a recording holds, and what is wrong with its stamps and samples, read in blocks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import chain

from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import (
    BadStamps,
    burst_samples,
    period_s,
    Recording,
    REFERENCES,
)
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from adxl_ros.signals.block_statistics import true_runs
from adxl_ros.signals.rest_detection import RecordedRests
import numpy as np

_SCATTER_QUANTILE = 0.9
"""Quantile of the deviations of steps that is their scatter. Chosen: one of ten may be a gap."""
_LARGE_SCATTER = 0.25
"""Scatter in periods from which the mean step is the period, not the median. Chosen."""
_LONG_STEPS = (1.25, 1.5)
"""Steps beyond the first number of periods, plus the second one times the scatter, are gaps.
Chosen: a sample that is missing among stamps rounded to a seventh of a period is found."""
_SHORTEST_GAP = 1.5
"""Shortest gap, periods. Chosen: halfway to two."""
_OUTLYING_STEP = 5.0
"""Steps beyond this number of medians are not part of the mean step."""
_SAME_POSE_G = 0.1
"""Distance of the means of two rests of one orientation, g. Chosen: 6° of tilt."""
_MOST_POSES = 200
"""Orientations that are counted at most. Chosen: more than a sweep has."""
_CLIPPED_SAMPLES = 3
"""Equal samples in a row at an extreme value that are clipped. Chosen: noise hardly repeats it."""
_CLIPPED_STEP_G = 0.05
"""Change before or after them, g. Chosen: a sensor at rest has none."""
_CLIPPED_WINDOW_S = 0.1
"""Longest time before or after them in which it changes, s. Chosen: within a motion of a hand."""
_CLIPPED_CODES = 20
"""Change, in steps of the resolution, that a smooth peak does not reach within the time that it
stays at its top. Chosen: a parabola reaches nine."""
_HELD_S = 1.0
"""Shortest time without any change that is reported, s. Chosen: noise changes samples sooner."""
_STUCK_S = 5.0
"""Shortest time without any change of one axis alone that is reported, s. Chosen: a coarse axis
may rest for some seconds between two codes."""
_HELD_SAMPLES = 20
"""Fewest samples of such a time. Chosen: a slow sensor repeats a few."""
_CHANGING = 0.5
"""Share of samples that usually change. Chosen: a coarse sensor at rest changes less."""
_PIECES = 20
"""Pieces of a bag whose median drift tells simulated time from a clock that was set. Chosen: a
step is in one of them."""
_LARGEST_CLOCK_DRIFT = 0.01
"""Largest drift of a clock. Chosen: a bad quartz has a hundredth of it."""


@dataclass(frozen=True)
class AxisRange:
    """The samples of one axis."""

    name: str  # Its column
    lowest_mps2: float  # Its lowest value, m/s²
    highest_mps2: float  # Its highest value, m/s²
    clipped: int  # Times at which it stays at an extreme value in motion
    is_stuck: bool  # Whether it never changes
    # Longest time in which it does not change although it usually does, s; 0 for none
    held_s: float


@dataclass(frozen=True)
class LogDelay:
    """Log time minus header stamp of the samples of a bag."""

    median_s: float  # Median, s
    spread_s: float  # Time from the 1st to the 99th percentile without drift, s
    drift_ppm: float  # Its drift by log time, 10⁻⁶
    # Whether it drifts by more than any clock does, and not in one step: header time is simulated,
    # and its pace varies
    is_simulated: bool


@dataclass(frozen=True)
class RecordingContents:
    """What a recording holds."""

    path: str  # The recording
    samples: int  # Number of samples
    span_s: float  # Time from the first to the last sample, s
    rate_hz: float  # Usual rate, Hz
    jitter_s: float  # Rms deviation of the steps of the stamps, without gaps, s
    burst: int  # Samples of a burst of stamps; 1 for none
    missing: int  # Missing samples
    gaps: int  # Number of gaps
    longest_gap_s: float  # Longest gap, s; 0 for none
    bad_stamps: BadStamps  # Samples whose stamp does not increase
    axes: tuple[AxisRange, ...]  # Ranges by axis
    # Longest time in which no axis changes although the samples usually do, s; 0 for none
    held_s: float
    rest_share: float  # Share of the time at rest
    longest_rest_s: float  # Longest rest, s
    rests: int  # Number of rests
    poses: int  # Number of different orientations among them
    # Median length of the specific force at rest, g; None without three axes or rests
    length_g: float | None
    # Lowest and highest value of each reference, by column
    reference_ranges: dict[str, tuple[float, float]]
    reference_means: dict[str, float]  # Mean of each reference, by column
    delay: LogDelay | None  # Log time minus header stamp; None where there is no bag
    remarks: tuple[str, ...]  # What was assumed or left out in reading
    cut: str  # Where a damaged file ends; empty if it is whole


def examine(blocks: Iterable[Recording], unit_of: Callable[[Recording], Sensor],
            delay: LogDelay | None) -> RecordingContents:
    """Find what a recording holds."""
    blocks = iter(blocks)
    first = next((block for block in blocks if len(block)), None)
    if first is None:
        raise UserError('the recording holds no samples')
    unit, stamps = unit_of(first), _Stamps(first)
    axes = [_Axis(name, stamps.period_s) for name in first.sensor_columns]
    held = _Held(_HELD_S / stamps.period_s)  # of all axes together
    last = first.accel_mps2(unit)[:1]
    rests = RecordedRests(unit, first)
    # Lowest and highest value, sum and count of each reference by block
    references: dict[str, list[tuple[float, float, float, int]]] = {}
    for block in chain([first], blocks):
        if not len(block):
            continue
        stamps.feed(block.time_s)
        accel_mps2 = np.concatenate([last, block.accel_mps2(unit)])
        last = accel_mps2[-1:]
        held.feed((np.diff(accel_mps2, axis=0) != 0).any(axis=1))
        for axis, values in zip(axes, accel_mps2.T):
            axis.feed(values)
        rests.feed(block)
        for name, values in block.columns.items():
            read = values[np.isfinite(values)]
            if name in REFERENCES and len(read):
                references.setdefault(name, []).append(
                    (float(read.min()), float(read.max()), float(read.sum()), len(read)))
    rests.take()
    # By reference: lowest and highest values, sums, counts
    parts = {name: list(zip(*rows)) for name, rows in references.items()}
    spans_s = [rest.span_s for rest, _ in rests.detected]
    means_mps2 = [to_nominal_mps2(mean_v, unit) for _, mean_v in rests.detected]
    lengths_g = np.linalg.norm(means_mps2, axis=-1) / G0_MPS2
    span_s = stamps.last_s - stamps.first_s
    return RecordingContents(
        path=block.path, samples=stamps.count, span_s=span_s,
        rate_hz=round(1 / stamps.period_s, 6), jitter_s=stamps.jitter_s, burst=stamps.burst,
        missing=stamps.missing, gaps=stamps.gaps, longest_gap_s=stamps.longest_gap_s,
        bad_stamps=block.bad_stamps, axes=tuple(axis.result() for axis in axes),
        held_s=held.samples * stamps.period_s,
        rest_share=min(sum(spans_s) / span_s, 1.0), longest_rest_s=max(spans_s, default=0.0),
        rests=len(spans_s), poses=_count_poses(means_mps2),
        length_g=float(np.median(lengths_g)) if spans_s and len(unit.axes) == len(AXES) else None,
        reference_ranges={name: (min(low), max(high)) for name, (low, high, *_) in parts.items()},
        reference_means={name: sum(total) / sum(count)
                         for name, (_, _, total, count) in parts.items()},
        delay=delay, remarks=block.remarks, cut=block.cut)


def log_delay(times_ns: Iterable[np.ndarray]) -> LogDelay | None:
    """Compare log times with header stamps, ns, (k, 2) by block; None without messages."""
    # A few messages of each block are enough, whatever the length of the recording.
    parts = [block[::max(len(block) // 128, 1)] for block in times_ns]
    if not parts:
        return None
    times = np.concatenate(parts)
    delay_s = (times[:, 1] - times[:, 0]) * 1e-9
    time_s = (times[:, 1] - times[0, 1]) * 1e-9
    line = np.polyfit(time_s, delay_s, 1) if np.ptp(time_s) > 0 else np.zeros(2)
    low_s, high_s = np.quantile(delay_s - np.polyval(line, time_s), [0.01, 0.99])
    places = np.linspace(0, len(time_s) - 1, _PIECES + 1).astype(int)
    drifts = np.diff(delay_s[places]) / np.maximum(np.diff(time_s[places]), 1e-9)
    return LogDelay(float(np.median(delay_s)), float(high_s - low_s), 1e6 * float(line[0]),
                    bool(abs(np.median(drifts)) > _LARGEST_CLOCK_DRIFT))


class _Stamps:
    """Statistics of the steps of the stamps; the period is that of the first block."""

    def __init__(self, first: Recording) -> None:
        if len(first) < 2:
            raise UserError(f'{first.path}: {len(first)} sample with a usable stamp; at least 2 '
                            'are needed; --rate HZ stamps by index')
        time_s = first.time_s
        self.burst = burst_samples(time_s)
        self.period_s = period_s(time_s)
        self.first_s = float(time_s[0])
        self.last_s = self.first_s - self.period_s
        self.count = self.missing = self.gaps = 0
        self.longest_gap_s = 0.0
        self._squares, self._usual = 0.0, 0
        steps_s = np.diff(time_s)
        scatter = float(np.quantile(np.abs(steps_s / self.period_s - 1), _SCATTER_QUANTILE))
        # The shortest gap, periods
        self._gap_periods = max(_LONG_STEPS[0] + _LONG_STEPS[1] * scatter, _SHORTEST_GAP)
        if self.burst > 1:
            self._gap_periods = _SHORTEST_GAP * self.burst
        elif scatter > _LARGE_SCATTER:
            self.period_s = float(np.mean(steps_s[steps_s < _OUTLYING_STEP * self.period_s]))

    def feed(self, time_s: np.ndarray) -> None:
        """Add further stamps."""
        before_s = self.last_s if self.count else time_s[0] - self.period_s
        steps = np.diff(time_s, prepend=before_s) / self.period_s
        self.count += len(time_s)
        self.last_s = float(time_s[-1])
        is_gap = steps > self._gap_periods
        self.missing += int((np.rint(steps[is_gap]) - self.burst).sum())
        self.gaps += int(is_gap.sum())
        self.longest_gap_s = max(self.longest_gap_s,
                                 float(steps[is_gap].max(initial=0.0)) * self.period_s)
        usual = steps[~is_gap]
        self._squares += float(((usual - 1) ** 2).sum())
        self._usual += len(usual)

    @property
    def jitter_s(self) -> float:
        """Rms deviation of the steps that are no gaps, s."""
        return self.period_s * float(np.sqrt(self._squares / max(self._usual, 1)))


class _Held:
    """The longest time without change of samples that usually change."""

    def __init__(self, shortest: float) -> None:
        self._shortest = max(shortest, _HELD_SAMPLES)
        self.changes = self._count = self._samples = self._longest = 0

    def feed(self, is_new: np.ndarray) -> None:
        """Add whether each further sample differs from the one before, (n,)."""
        self.changes += int(is_new.sum())
        self._count += len(is_new)
        # Samples from one change to the next, the first and last of which continue elsewhere
        runs = np.diff(np.flatnonzero(is_new), prepend=-1 - self._samples, append=len(is_new)) - 1
        self._samples = int(runs[-1])
        self._longest = max(self._longest, int(runs.max()))

    @property
    def samples(self) -> int:
        """Return the number of samples without change; 0 where it is usual or short."""
        is_held = (self._longest >= self._shortest
                   and self.changes > _CHANGING * (self._count - self._longest))
        return self._longest if is_held else 0


class _Axis:
    """Extreme values of an axis, and times without change."""

    def __init__(self, name: str, period_s: float) -> None:
        self._name, self._period_s = name, period_s
        # Largest value of minus the samples and of the samples, and how often they stay there
        self._largest, self._clipped = [-np.inf, -np.inf], [0, 0]
        self._held = _Held(_STUCK_S / period_s)

    def feed(self, values: np.ndarray) -> None:
        """Add further samples, m/s², behind the last one before, (1 + n,)."""
        steps = np.abs(np.diff(values))
        self._held.feed(steps != 0)
        smallest = float(steps[steps > 0].min(initial=np.inf))
        drop = max(_CLIPPED_STEP_G * G0_MPS2, _CLIPPED_CODES * smallest)
        for side, signed in enumerate((-values, values)):
            largest = float(signed.max())
            if largest > self._largest[side]:
                self._largest[side], self._clipped[side] = largest, 0
            if largest == self._largest[side]:
                self._clipped[side] += sum(
                    self._moves(signed, largest - drop, first, stop)
                    for first, stop in true_runs(signed == largest)
                    if stop - first >= _CLIPPED_SAMPLES)

    def _moves(self, values: np.ndarray, low: float, first: int, stop: int) -> bool:
        """Return whether the axis is below a value soon before or after some samples."""
        window = max(min(stop - first, round(_CLIPPED_WINDOW_S / self._period_s)), 1)
        beside = np.append(values[max(first - window, 0):first], values[stop:stop + window])
        return bool((beside < low).any())

    def result(self) -> AxisRange:
        """Return the range of the axis."""
        return AxisRange(self._name, -self._largest[0], self._largest[1],
                         sum(self._clipped), not self._held.changes,
                         self._held.samples * self._period_s)


def _count_poses(means_mps2: Sequence[np.ndarray]) -> int:
    """Return the number of different orientations among the means of rests, m/s², (m,) each."""
    poses: list[np.ndarray] = []
    for mean in means_mps2:
        is_new = all(np.linalg.norm(mean - pose) > _SAME_POSE_G * G0_MPS2 for pose in poses)
        if is_new and len(poses) < _MOST_POSES:
            poses.append(mean)
    return len(poses)
