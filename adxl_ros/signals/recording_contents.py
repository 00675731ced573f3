# SPDX-License-Identifier: Apache-2.0

"""What a recording holds, read in blocks: its stamps, axes, rests, references and gyroscope."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain

from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import GYRO, Recording, REFERENCES
from adxl_ros.files.stamp_check import BadStamps
from adxl_ros.files.stamps import burst_samples, lacks_samples, mean_period_s
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from adxl_ros.signals.allan_deviation import longest_of
from adxl_ros.signals.axis_ranges import axis_faults, AxisLook, AxisRange
from adxl_ros.signals.gravity_at_rest import GravityAtRest
from adxl_ros.signals.gyroscope_turns import GyroFindings, GyroLook
from adxl_ros.signals.recorded_gravity import RecordingLook
from adxl_ros.signals.rest_search import Rest
from adxl_ros.signals.stage_angles import StageReadings
from adxl_ros.wording import option
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
    angle_fault: str  # Which stage angles are in degrees; '' for none
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
    angle_fault = ''
    for block in chain([first], blocks):
        if not len(block):
            continue
        stamps.feed(block.time_s)
        look.feed(block)
        if gyro is not None:
            gyro.feed(block)
        references.feed(block)
        if block.stage_angles is not None and not angle_fault:
            volts = block.volts(look.nominal)
            readings = StageReadings.of(block.stage_angles, volts, look.nominal)
            angle_fault = readings.degrees_fault()
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
        angle_fault=angle_fault,
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
        self.period_s = mean_period_s(first.time_s)
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
        if not np.isfinite([axis.lowest for axis in ranges]).all():
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
