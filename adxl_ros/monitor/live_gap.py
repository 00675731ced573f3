# SPDX-License-Identifier: Apache-2.0

"""The gap of a running sensor: samples and reference go in, gap, floor and changes come out."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

from adxl_ros.files.recording_columns import ACCEL, JOINTS, Recording
from adxl_ros.files.reference_track import LONGEST_MOVE_NS, Track
from adxl_ros.files.stamps import stamped_rate_hz
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import effect_named
from adxl_ros.model.sensor import Sensor
from adxl_ros.monitor import reference_stream
from adxl_ros.monitor.changes import ChangeTest, DiagnosisInput, GapChange, LONGEST_BLOCKS
from adxl_ros.monitor.reference_stream import ComparedBlock, ReferenceKind
from adxl_ros.report.quantities import Interval
import numpy as np
import scipy

BLOCK_NS = 1_000_000_000  # Length of a block, ns: one second, as the reports
_LATE_NS = 5_000_000_000
"""Time that a block waits for its reference, ns. Chosen: longer than a busy network delays."""
_BREAK_NS = 10_000_000_000
"""Longest time without a block over which blocks are compared, ns. Chosen: the drift within it is
small beside the noise of a second."""
_JUMP_NS = 1_000_000_000
"""Step of the stamps backwards from which the clock has jumped, ns; chosen: no network reorders
samples so far."""
_FEWEST_SAMPLES = 4  # Fewest samples of a block; chosen: a variance needs some
_RATE_TOLERANCE = 0.02
"""Largest relative difference of the measured rate from the stated one. Chosen: above the errors
of clocks, below those of a wrong file."""
_BATCHES = 10
"""Batches of blocks whose scatter gives an interval. Chosen: they are long enough to be
independent, and Student's t is then near the normal."""
_FEWEST_BLOCKS = 5  # Fewest blocks of a report; chosen: an interval needs some
_CONFIDENCE = 0.9  # Probability of the intervals, as in all reports of the package
_MG = 1e-3 * G0_MPS2  # One mg, m/s²
_HEALTHY_S = 100.0  # Time over which the drift of a healthy unit is stated, s: its bounds
_MOST_CHANGES = 100  # Changes in memory; chosen: the record on disk has all
_OPEN = 1.1
"""Rms of the gap, divided by the floor, from which it is open. Chosen: the intervals alone would
call every twentieth closed gap open."""
_COUNTS = ('samples', 'missing', 'dropped', 'jumps', 'blocks', 'skipped')
"""Samples that came, that are missing between others by their stamps, and that came twice, late or
are no numbers; jumps of the stamps; seconds that were compared, and that were not for want of
samples or reference."""
_EXPLAINED_LEAST = 1.1
"""Rms of the difference to the datasheet, divided by the floor, from which there is something to
explain. Chosen: an added effect of half the noise."""


@dataclass(frozen=True)
class AxisGap:
    """The gap of one axis over the window; rms, mg."""

    axis: str  # x, y or z
    gap: Interval  # Samples minus prediction
    floor: Interval  # Noise about the mean of each second at rest, and the steps of the encoder
    floor_source: str  # `rest` where it was measured, `parameters` where nothing has rested yet
    offset_mg: float  # Mean of samples minus prediction
    # Share of the squares of the gap to the datasheet, above the floor, that the parameters
    # remove, 0 to 1; None where that gap is no larger than the floor
    explained: float | None

    @property
    def is_open(self) -> bool:
        """Return whether the gap exceeds the floor by more than chance."""
        return self.gap.low > _OPEN * self.floor.high


@dataclass(frozen=True)
class GapSettings:
    """Settings of the comparison."""

    window_s: float = 60.0  # Time over which the gap is taken, s
    false_alarms_per_day: float = 1 / 30  # Largest rate of changes that are none
    history_s: float = 600.0  # Time that is kept for a diagnosis, s
    wait_s: float = 120.0  # Time after a change of an axis in which further ones belong to it, s


class LiveGap:
    """
    Compares a stream with the prediction of its parameters, second by second.

    sensor: the sensor at the rate of the stream.
    """

    def __init__(self, sensor: Sensor, kind: ReferenceKind, settings: GapSettings) -> None:
        self.sensor = sensor
        self._settings = settings
        span_ns = round(settings.history_s * 1e9)
        # The reference, which takes its messages itself
        self.reference = reference_stream.ReferenceStream(kind, sensor, span_ns)
        self._samples = reference_stream.StreamBuffer(len(sensor.axes), span_ns)
        self.counts = dict.fromkeys(_COUNTS, 0)  # Counts since the start
        self.obstacle = 'no samples yet'  # Why the newest second was not compared; empty if it was
        self.changes: list[GapChange] = []  # Changes so far, the newest last
        self._blocks: deque[ComparedBlock] = deque(
            maxlen=max(round(settings.window_s * 1e9 / BLOCK_NS), _FEWEST_BLOCKS)
        )
        self._ends_ns: deque[int] = deque(maxlen=LONGEST_BLOCKS + 1)
        # Random walk of a healthy sensor, or of its file if larger: that of a file goes on.
        healthy_g = effect_named('bias_walk').diagnosis.healthy_density
        walk_g = float(
            np.max(
                sensor.values.get('bias_walk', {}).get('density_g_per_rts', ()), initial=healthy_g
            )
        )
        drift_g = healthy_g * _HEALTHY_S**0.5 if walk_g == healthy_g else np.inf
        count = len(sensor.axes)
        any_noise = (np.inf,) * count
        self._test = ChangeTest(
            2 * count,
            settings.false_alarms_per_day,
            BLOCK_NS * 1e-9,
            (G0_MPS2 * walk_g,) * count + any_noise,
            (G0_MPS2 * drift_g,) * count + any_noise,
        )
        self._changed_ns: dict[str, int] = {}
        self._prediction = reference_stream.Prediction(sensor, self.reference)
        self.left_out = self._prediction.left_out  # Effects that the reference cannot drive
        self._next_ns: int | None = None
        self._compared_ns: int | None = None

    @property
    def newest_ns(self) -> int:
        """Return the stamp of the newest sample, ns; 0 before the first."""
        return self._samples.newest_ns or 0

    def add_samples(self, stamp_ns: np.ndarray, accel_mps2: np.ndarray) -> None:
        """Add stamps, ns, (n,), and specific force by nominal conversion, m/s², (n, m or more)."""
        accel_mps2 = accel_mps2[:, : len(self.sensor.axes)]
        finite = np.isfinite(accel_mps2).all(axis=1)
        self.counts['samples'] += len(stamp_ns)
        self.counts['dropped'] += int((~finite).sum())
        stamp_ns = stamp_ns[finite]
        accel_mps2 = accel_mps2[finite]
        steps_ns = _steps_ns(self._samples.newest_ns, stamp_ns)
        jumps = np.flatnonzero((steps_ns < -_JUMP_NS) | (steps_ns > _BREAK_NS))
        for i, part in enumerate(np.split(np.arange(len(stamp_ns)), jumps)):
            if i:
                self._restart()
            newest_ns = self._samples.newest_ns
            kept_ns = self._samples.add(stamp_ns[part], accel_mps2[part])
            self.counts['dropped'] += len(part) - len(kept_ns)
            periods = np.rint(_steps_ns(newest_ns, kept_ns) * 1e-9 * self.sensor.rate_hz)
            self.counts['missing'] += int((periods - 1).clip(0).sum())

    def advance(self) -> list[GapChange]:
        """Compare all seconds whose reference is known; return the changes in them."""
        changes: list[GapChange] = []
        while self._next_ns is not None or self._begin():
            assert self._next_ns is not None, 'a comparison that has begun has a next second'
            end_ns = self._next_ns + BLOCK_NS
            if self.newest_ns < end_ns or self._waits(end_ns, self.newest_ns):
                break
            block = self._compared(self._next_ns, end_ns)
            self._next_ns = end_ns
            if block is not None:
                changes += self._take(block)
        return changes

    def report(self) -> tuple[AxisGap, ...]:
        """Return the gap of each axis over the window; nothing before the first seconds."""
        blocks = list(self._blocks)
        return tuple(
            self._axis_gap(d, axis, blocks)
            for d, axis in enumerate(self.sensor.axes)
            if len(blocks) >= _FEWEST_BLOCKS
        )

    def diagnosis_input(self, begin_ns: int = 0) -> DiagnosisInput:
        """Return what there is since a stamp, ns, of at most the history, for a diagnosis."""
        newest_ns = self.newest_ns
        begin_ns = max(begin_ns, newest_ns - round(self._settings.history_s * 1e9))
        stamps_ns, accel_mps2 = self._samples.between(begin_ns, newest_ns + 1)
        origin_ns = int(stamps_ns[0]) if len(stamps_ns) else 0
        columns = dict(zip(ACCEL, accel_mps2.T))
        around = (begin_ns - BLOCK_NS, newest_ns + BLOCK_NS)
        force = None
        at_ns, readings = self.reference.readings.between(*around)
        tracks = {
            name: (at_ns, values, LONGEST_MOVE_NS)
            for name, values in zip(JOINTS.values(), readings.T)
        }
        if self.reference.kind is not ReferenceKind.STAGE:
            tracks = {}
            force = ((at_ns - origin_ns) * 1e-9, readings)
        for name, buffer in self.reference.surroundings.items():
            at_ns, readings = buffer.between(*around)
            if len(at_ns) > 1:
                tracks[name] = at_ns, readings[:, 0], np.inf
        for name, track in tracks.items():
            # Unknown where no reading is near.
            columns[name] = Track('the reference', *track).interpolate(stamps_ns)
        return DiagnosisInput(
            Recording(
                'the running stream',
                (stamps_ns - origin_ns) * 1e-9,
                columns,
                sensor_info(self.sensor),
            ),
            self.sensor,
            force,
        )

    def span_s(self, begin_ns: int = 0) -> float:
        """Return the time of the samples since a stamp, ns, that are kept, s."""
        stamps_ns, _ = self._samples.between(begin_ns, self.newest_ns + 1)
        return float(stamps_ns[-1] - stamps_ns[0]) * 1e-9 if len(stamps_ns) else 0.0

    def _restart(self) -> None:
        """Begin again after a jump of the stamps; what was learnt of the noise is kept."""
        self.counts['jumps'] += 1
        self._samples.clear()
        self._next_ns = None
        self._prediction.restart()
        self._test.restart()
        self._blocks.clear()
        self._changed_ns.clear()

    def _begin(self) -> bool:
        """Begin with the first whole second, at the measured rate; return whether it has come."""
        newest_ns = self.newest_ns
        stamps_ns, _ = self._samples.between(newest_ns - 2 * BLOCK_NS, newest_ns + 1)
        if len(stamps_ns) < _FEWEST_SAMPLES or newest_ns - stamps_ns[0] < BLOCK_NS:
            return False
        measured_hz = stamped_rate_hz((stamps_ns - stamps_ns[0]) * 1e-9)
        if abs(measured_hz / self.sensor.rate_hz - 1) > _RATE_TOLERANCE:
            self.sensor = replace(self.sensor, rate_hz=measured_hz)
            self._prediction = reference_stream.Prediction(self.sensor, self.reference)
        self._next_ns = -(-int(stamps_ns[0]) // BLOCK_NS) * BLOCK_NS
        return True

    def _waits(self, end_ns: int, newest_ns: int) -> bool:
        """Return whether a block waits for its reference; set the obstacle where it does long."""
        reference_ns = self.reference.readings.newest_ns
        if reference_ns is not None and reference_ns >= end_ns + reference_stream.AFTER_NS:
            return False
        waits = newest_ns - end_ns < _LATE_NS
        if not waits or reference_ns is None:
            away_s = ((reference_ns or 0) - newest_ns) * 1e-9
            self.obstacle = (
                'no reference has come'
                if reference_ns is None
                else f'the reference is {-away_s:.1f} s behind the samples: it is '
                f'late, or has stopped'
            )
        return waits

    def _compared(self, begin_ns: int, end_ns: int) -> ComparedBlock | None:
        """Compare one second; None where samples or reference are missing."""
        stamps_ns, accel_mps2 = self._samples.between(begin_ns, end_ns)
        if self._compared_ns is not None and begin_ns - self._compared_ns > _BREAK_NS:
            self._prediction.restart()
            self._test.restart()
        motion = self._prediction.prepare(begin_ns, end_ns)
        if motion is None or len(stamps_ns) < _FEWEST_SAMPLES:
            self.counts['skipped'] += 1
            if motion is None and not self.obstacle.startswith(('no ref', 'the ref')):
                self.obstacle = 'the reference does not cover the samples; is its clock another?'
            elif motion is not None:
                self.obstacle = 'no samples'
            return None
        self._compared_ns = end_ns
        self.obstacle = ''
        return self._prediction.block(stamps_ns, accel_mps2, motion, end_ns)

    def _take(self, block: ComparedBlock) -> list[GapChange]:
        """Add a block to the window, and test it."""
        self.counts['blocks'] += 1
        self._blocks.append(block)
        self._ends_ns.append(block.end_ns)
        changes = []
        alarms = self._test.add(np.concatenate([block.mean_mps2, block.log_noise]), block.moves)
        # More noise scatters the mean, too, so that it comes first.
        for change in sorted(alarms, key=lambda change: -change.channel):
            quantity, number = divmod(change.channel, len(self.sensor.axes))
            axis = self.sensor.axes[number]
            if block.end_ns < self._changed_ns.get(axis, 0):
                continue
            self._changed_ns[axis] = block.end_ns + round(self._settings.wait_s * 1e9)
            begun = max(len(self._ends_ns) - 1 - change.blocks, 0)
            changes.append(
                GapChange(
                    axis,
                    'noise' if quantity else 'mean',
                    self._ends_ns[begun],
                    block.end_ns,
                    float(np.exp(change.size)) if quantity else change.size / _MG,
                )
            )
        self.changes = (self.changes + changes)[-_MOST_CHANGES:]
        return changes

    def _axis_gap(self, d: int, axis: str, blocks: list[ComparedBlock]) -> AxisGap:
        """Return the gap of one axis."""

        def of_blocks(name: str) -> np.ndarray:
            return np.array([getattr(block, name)[d] for block in blocks])

        gap = _rms_interval(of_blocks('square'))
        encoder = of_blocks('reference_square').mean()
        still = [not block.moves for block in blocks]
        if sum(still) >= _FEWEST_BLOCKS:
            floor = _rms_interval(of_blocks('noise_square')[still] + encoder)
            source = 'rest'
        else:
            noise_g = noise.sample_std_v(self.sensor)[d] / self.sensor.nominal_scale_v_per_g[d]
            std_mg = float(np.sqrt((noise_g * G0_MPS2) ** 2 + encoder)) / _MG
            floor = Interval(std_mg, std_mg, std_mg)
            source = 'parameters'
        datasheet = _rms_interval(of_blocks('datasheet_square')).value
        explained = None
        if datasheet > _EXPLAINED_LEAST * floor.value:
            explained = float(
                np.clip((datasheet**2 - gap.value**2) / (datasheet**2 - floor.value**2), 0.0, 1.0)
            )
        return AxisGap(
            axis=axis,
            gap=gap,
            floor=floor,
            floor_source=source,
            offset_mg=float(of_blocks('mean_mps2').mean()) / _MG,
            explained=explained,
        )


def _steps_ns(newest_ns: int | None, stamp_ns: np.ndarray) -> np.ndarray:
    """Return the steps of stamps from the newest one before on; 0 to the very first."""
    return np.diff(stamp_ns, prepend=stamp_ns[:1] if newest_ns is None else newest_ns)


def _rms_interval(squares: np.ndarray) -> Interval:
    """Return the rms, mg, of the mean squares of blocks, (m/s²)², (n,), with its interval."""
    batches = [part.mean() for part in np.array_split(squares, min(_BATCHES, len(squares)))]
    mean = float(squares.mean())
    half = float(
        scipy.special.stdtrit(len(batches) - 1, 0.5 + _CONFIDENCE / 2)
        * np.std(batches, ddof=1)
        / np.sqrt(len(batches))
    )
    value, low, high = np.sqrt(np.maximum([mean, mean - half, mean + half], 0.0)) / _MG
    return Interval(float(value), float(low), float(high))
