# SPDX-License-Identifier: Apache-2.0
"""
What is known of the reference: its time, empty cells, too coarse sampling, and fading.

The force of another simulator may have another clock. A large shift is a fault of the files. A
small one may be the latency of the sensor, which is an effect of the library: it is left alone.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from os.path import basename
from typing import Any

from adxl_ros.diagnose.comparison import (
    BaselineComparison,
    compare,
    Reference,
    SMALLEST_MOTION_G,
)
from adxl_ros.files.recording_columns import JOINTS, Recording
from adxl_ros.files.reference_alignment import LONGEST_MOVE_NS, USUAL_GAPS
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2, MAD_TO_STD, Z_90
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.block_statistics import true_runs
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.smoothed_paths import BAND_LIMITED_DEGREE, ForcePath
import numpy as np
import scipy

SHORTEST_S = 30.0
"""Shortest time, s, that the recordings of a moving sensor last together. Chosen: a few turns of
the stage."""
LARGEST_LATENCY_S = 0.1
"""Largest shift, s, that may be a latency of the sensor. Chosen: twenty times the typical delay of
`time_offset`; a buffer of ten samples at 100 Hz has it."""
_SEARCH_STEP_S, _LONGEST_SEARCH = 0.02, 1 << 20
"""Step of the first search of a shift, s, and its largest number of steps. Chosen: well below the
largest latency, and six hours."""
CORRELATED = 0.9
"""Correlation from which two motions are the same one. Chosen: noise of half the motion."""
_SAME_CORRELATION = 0.01
"""Correlations that differ by less are equal, and the one of the longest overlap counts. Chosen: a
motion that repeats fits at several shifts."""
_LARGEST_ERROR_RATIO = 0.5
"""A shift shows if it reduces 1 − correlation below this share. Chosen: noise that is not shifted
keeps it."""
_BLOCKS, _FINE_SAMPLES = 10, 20_000
"""Blocks and samples of the fine search. Chosen: their scatter shows the error to 24 %."""
_LONGEST_BRIDGE_S, _SLOWEST_S = LONGEST_MOVE_NS / 1e9, 1.0
"""Longest time without a reading that is bridged, s: of a joint as between messages of a bag, and
of a slow encoder, whose readings are a move apart at most."""
_BEFORE_S, _AFTER_S = 0.1, 0.3
"""Times that are left out beside a gap, s. Chosen: the spline is uncertain before it, and an RC
filter of 15 Hz has settled after it."""
_FEWEST_CHANGES, _LARGEST_STEP_RAD, _COARSER = 100, 0.02, 1.05
"""Fewest changes of a reading that show the step of its encoder, its largest step, rad, and the
ratio to the stated one from which it counts. Chosen: two turns by hand; 1°; 1/12° may be 0.083°.
"""
_WHOLE, _WHOLE_SHARE = 0.2, 0.9
"""Deviation from whole steps, and share of the changes within it, by encoders. Chosen: 40 % of the
changes of exact readings are within it."""
_SAME_POSE, _SAME_STEPS = 1e-4, 2.0
"""Change of a joint over a gap without a move, rad or m, and in steps of its encoder. Chosen:
0.1 mg, and two readings that scatter by one step."""
_LAG_S, _SLOW = 0.02, 3.0
"""Lag of differences, s, and standard deviation of the output, divided by theirs, up to which it
rests. Chosen: an RC filter has forgotten its noise, and motion below 2 Hz exceeds it."""
_WINDOW_S, _SHORTEST_WINDOW = 1.0, 64
"""Length of a window whose spectrum is taken, s and readings. Chosen: shorter than a move, and
some periods of a shaker."""
_LARGEST_ERROR = 0.3
"""Error of the force by the spline, divided by the noise, up to which a window is used. Chosen: it
adds 4 % to the noise."""
_SAME_MOTION = 2.0
"""Ratio of recorded and simulated motion from which one is an alias. Chosen: an alias below 0.2 of
the rate has a ratio of 4."""
_NAMED_PARTS = 4
"""Parts that a note names. Chosen: it stays one or two lines."""
_FEWEST_WINDOWS, _BAND_HZ = 20, 2.0
"""Fewest windows, and width of the bands, Hz, by which fading is judged. Chosen: noise then has a
coherence of 0.05, and a line of the mains is one value."""
_MOTION, _FADED = 10.0, 0.5
"""Power over noise from which motion shows, and power of the reference, even without the filter of
the sensor, divided by the recorded one, below which it has faded. Chosen."""


@dataclass(eq=False)
class DataFault(Exception):
    """A fault of the recording, with the recordings that were compared before."""

    name: str  # Name in the report: `verdict.data_fault`
    message: str  # What is wrong and what to do, one line
    status: str = 'bad_data'  # Status of the verdict: 'bad_data' or 'insufficient'
    comparisons: tuple[BaselineComparison, ...] = ()


@dataclass(frozen=True)
class LeftOut:
    """Samples that are not used, and why."""

    rows: np.ndarray  # The samples, (n,) bool
    reason: str  # Reason, for people

    def text(self, time_s: np.ndarray) -> str:
        """Return the reason with the times, s, of the samples; `time_s` are those of all."""
        runs = true_runs(self.rows)
        total_s = float(np.median(np.diff(time_s))) * self.rows.sum()
        parts = ', '.join(f'{time_s[a]:.5g} to {time_s[b - 1]:.5g} s'
                          for a, b in runs[:_NAMED_PARTS])
        return f'left out: {total_s:.3g} s ({parts}{", ..." * (len(runs) > _NAMED_PARTS)}): ' \
            f'{self.reason}'


@dataclass(frozen=True)
class _Shift:
    """How much later the motion of a simulator is stamped than that of a recording."""

    late_s: float  # The shift, s; negative where the simulator is early
    std_s: float  # Its standard deviation, s
    correlation: float  # Correlation of the two motions without the shift

    @property
    def text(self) -> str:
        """Return the shift with its 90 % error and correlation, for people."""
        return (f'{abs(self.late_s):.4f} s {"late" if self.late_s > 0 else "early"} '
                f'(± {Z_90 * self.std_s:.4f} s, correlation {self.correlation:.3f})')


def align_force(recording: Recording, sensor: Sensor, sim: Motion, may_shift: bool
                ) -> tuple[Recording, Motion, list[str]]:
    """
    Find the part of a recording that another simulator covers, and check their time.

    Return that part, the simulator, shifted where it was asked for, and notes; raise DataFault.
    """
    force, notes = sim.force, []
    assert isinstance(force, ForcePath)
    shift = _find_shift(recording, replace(sensor, rate_hz=recording.rate_hz), force)
    if shift is not None and may_shift:
        force = force.shifted(-shift.late_s)
        notes = [f'--align: {force.name} was {shift.text}, and is shifted by '
                 f'{-shift.late_s:+.6g} s; a latency of the sensor is a part of that and cannot '
                 'show']
    elif may_shift:
        notes = [f'--align: no shift beyond {LARGEST_LATENCY_S:g} s was found; less may be an '
                 'effect of the sensor (time_offset), and nothing is shifted']
    begin_s, end_s = force.time_s[0], force.time_s[-1]
    covered = (recording.time_s >= begin_s) & (recording.time_s <= end_s)
    if not covered.any():
        advice = f'its motion fits, but is {shift.text}; use --align' if shift is not None else \
            'no shift makes its motion fit; give that of this recording'
        raise DataFault('no_overlap', f'{force.name} does not overlap the recording in '
                        f'time: {basename(recording.path)} is from {recording.time_s[0]:.6g} '
                        f'to {recording.time_s[-1]:.6g} s, {force.name} from {begin_s:.6g} to '
                        f'{end_s:.6g} s; {advice}')
    if shift is not None and not may_shift:
        raise DataFault('time_misaligned', f'{force.name} is {shift.text}; use --align, or '
                        f'shift its stamps by {-shift.late_s:+.6g} s')
    if not covered.all():
        outside_s = (1 - covered.mean()) * float(np.ptp(recording.time_s))
        notes.append(f'left out: {outside_s:.3g} s of the recording that {force.name} does not '
                     f'cover (it is from {begin_s:.6g} to {end_s:.6g} s)')
    return _between(recording, begin_s, end_s), replace(sim, force=force), notes


def _between(recording: Recording, begin_s: float, end_s: float) -> Recording:
    """Return the samples of a recording between two times."""
    return recording.rows(int(np.searchsorted(recording.time_s, begin_s)),
                          int(np.searchsorted(recording.time_s, end_s, 'right')))


def _find_shift(recording: Recording, sensor: Sensor, force: ForcePath) -> _Shift | None:
    """
    Return the shift of a simulator from the cross-correlation of both motions over all overlaps.

    None where it may be a latency, or does not show.
    """
    measured_g = recording.volts(sensor) / sensor.nominal_scale_v_per_g
    finite = np.isfinite(measured_g).all(axis=1)
    if finite.sum() < 2:
        return None
    time_s, sim_s = recording.time_s[finite], force.time_s
    step_s = max(_SEARCH_STEP_S, (np.ptp(time_s) + np.ptp(sim_s)) / _LONGEST_SEARCH)
    first_s, second_s = (np.arange(t[0], t[-1], step_s) for t in (time_s, sim_s))
    first = np.column_stack([np.interp(first_s, time_s, g) for g in measured_g[finite].T])
    second = np.column_stack(force(second_s))[:, :first.shape[1]] / G0_MPS2
    shortest_s = min(SHORTEST_S, np.ptp(time_s) / 2, np.ptp(sim_s) / 2)
    lags, overlap, correlation = correlations(first, second, max(round(shortest_s / step_s), 2))
    lags_s = second_s[0] - first_s[0] + lags * step_s
    equal = np.flatnonzero(correlation > correlation.max() - _SAME_CORRELATION)
    longest_s = lags_s[equal[np.argmax(overlap[equal])]]
    best = int(np.argmax(np.where(np.abs(lags_s - longest_s) < 1.0, correlation, -1.0)))
    unshifted = int(np.argmin(np.abs(lags_s)))
    if correlation[best] < CORRELATED or (
            abs(lags_s[unshifted]) < step_s and 1 - correlation[best]
            > _LARGEST_ERROR_RATIO * (1 - correlation[unshifted])):
        return None
    fine = _fine_shift(recording, sensor, force, float(lags_s[best]), float(correlation[best]))
    return fine if abs(fine.late_s) > LARGEST_LATENCY_S else None


def correlations(first: np.ndarray, second: np.ndarray, smallest: int
                 ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Correlate two motions, g, (n, m) and (n', m), at all lags, each over the samples that overlap.

    Sample i of the first meets sample i + lag of the second. Return lags, counts of samples that
    overlap, and correlations, −1 where fewer than `smallest` overlap or one does not move.
    """
    def products(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return scipy.signal.correlate(b, a, method='fft')

    one, two = np.ones(len(first)), np.ones(len(second))
    overlap = np.maximum(np.rint(products(one, two)), 1)
    covariance, squares = np.zeros(len(overlap)), np.zeros((2, len(overlap)))
    for a, b in zip((first - first.mean(axis=0)).T, (second - second.mean(axis=0)).T):
        sum_a, sum_b = products(a, two), products(one, b)
        covariance += np.abs(products(a, b) - sum_a * sum_b / overlap)
        squares[0] += products(a * a, two) - sum_a ** 2 / overlap
        squares[1] += products(one, b * b) - sum_b ** 2 / overlap
    smallest_square = SMALLEST_MOTION_G ** 2 * overlap
    compared = (overlap >= smallest) & (squares > smallest_square).all(axis=0)
    correlation = covariance / np.sqrt(np.maximum(squares, smallest_square).prod(axis=0))
    return (scipy.signal.correlation_lags(len(second), len(first)), overlap,
            np.where(compared, correlation, -1.0))


def _fine_shift(recording: Recording, sensor: Sensor, force: ForcePath, late_s: float,
                correlation: float) -> _Shift:
    """Fit shift, zero-g and scale factor to blocks of the recording, from a rough shift."""
    begin_s, end_s = force.time_s[0] - late_s, force.time_s[-1] - late_s
    comparison = compare(_between(recording, begin_s, end_s), sensor,
                         Motion(float(end_s - begin_s), force=force.shifted(-late_s)))
    time_s, volts = comparison.time_s, comparison.volts
    simulated_v = comparison.simulated_v(comparison.sensor)
    # The ends may need values from outside.
    inside = np.isfinite(volts).all(axis=1) & (time_s > time_s[0] + LARGEST_LATENCY_S) \
        & (time_s < time_s[-1] - LARGEST_LATENCY_S)
    rows = np.flatnonzero(inside)[::max(1, len(recording) // _FINE_SAMPLES)]

    def left_v2(more_s: float, part: np.ndarray) -> float:
        """Return what zero-g and scale factor leave of a part after a further shift."""
        left = 0.0
        for measured, simulated in zip(volts[part].T, simulated_v.T):
            line = np.column_stack([np.ones(len(part)), np.interp(
                time_s[part] + more_s, time_s, simulated)])
            left += float(np.sum((measured - line @ np.linalg.lstsq(line, measured)[0]) ** 2))
        return left

    more_s, *of_blocks = (float(scipy.optimize.minimize_scalar(
        left_v2, bounds=(-LARGEST_LATENCY_S, LARGEST_LATENCY_S), args=(part,), method='bounded',
        options={'xatol': 1e-6}).x) for part in (rows, *np.array_split(rows, _BLOCKS)))
    # A block at rest shows no shift, so that the median scatter counts.
    std_s = MAD_TO_STD * float(np.median(np.abs(np.subtract(of_blocks, more_s)))) / _BLOCKS ** 0.5
    return _Shift(late_s + more_s, std_s, correlation)


def _in_gaps(time_s: np.ndarray, read_s: np.ndarray, longest_s: float
             ) -> Iterable[tuple[int, int]]:
    """
    Yield the samples, begin and end, in gaps between readings that are not bridged.

    Before the first reading and after the last, the ends of the recording count.
    """
    ends_s = np.concatenate([[min(time_s[0], read_s[0])], read_s, [max(time_s[-1], read_s[-1])]])
    for i in np.flatnonzero(np.diff(ends_s) > longest_s):
        yield (int(np.searchsorted(time_s, ends_s[i], 'right' if i else 'left')),
               int(np.searchsorted(time_s, ends_s[i + 1], 'right' if i > len(read_s) - 1
                                   else 'left')))


def without_reading(comparison: BaselineComparison) -> list[LeftOut]:
    """Find samples in gaps of another simulator."""
    time_s, force = comparison.time_s, comparison.motion.force
    if not isinstance(force, ForcePath):
        return []
    limit_s = max(_LONGEST_BRIDGE_S, USUAL_GAPS * float(np.median(np.diff(force.time_s))))
    unknown = np.zeros(len(time_s), bool)
    for begin, end in _in_gaps(time_s, force.time_s, limit_s):
        if end > begin:
            unknown |= (time_s >= time_s[begin] - _BEFORE_S) \
                & (time_s <= time_s[end - 1] + _AFTER_S)
    return [LeftOut(unknown, f'no reading of {force.name} for more than {limit_s:.3g} s')] \
        if unknown.any() else []


def stated_poses(recording: Recording, sensor: Sensor) -> tuple[Recording, list[LeftOut]]:
    """
    Fill the gaps of the stage's joints, and return what is not known there.

    A pose that is stated before and after a gap, while the output rests, holds in between. Other
    gaps are left out.
    """
    time_s, output_g = recording.time_s, recording.volts(sensor) / sensor.scale_v_per_g
    columns, left_out = dict(recording.columns), []
    lag = max(1, round(_LAG_S * recording.rate_hz))
    for joint, name in JOINTS.items():
        values = columns.get(name, np.zeros(0))
        read = np.flatnonzero(np.isfinite(values))
        if len(read) < 2:
            continue
        step = 0.0 if joint == 'shift' else sensor.stage_resolution_rad
        filled = np.interp(time_s, time_s[read], values[read])
        limit_s = max(_LONGEST_BRIDGE_S, min(USUAL_GAPS * float(np.median(np.diff(
            time_s[read]))), _SLOWEST_S))
        unknown, columns[name] = np.zeros(len(time_s), bool), values.copy()
        for begin, end in _in_gaps(time_s, time_s[read], _LONGEST_BRIDGE_S):
            inner = 0 < begin < end < len(time_s)
            gap_s = time_s[min(end, len(time_s) - 1)] - time_s[max(begin - 1, 0)]
            holds = inner and _rests(output_g[begin:end], lag) and abs(
                filled[end] - filled[begin - 1]) <= _SAME_STEPS * step + _SAME_POSE
            if inner and (holds or gap_s > limit_s):
                columns[name][begin:end] = filled[begin:end]
            if not holds and gap_s > limit_s:
                unknown |= (time_s > time_s[begin] - _BEFORE_S) \
                    & (time_s < time_s[end - 1] + _AFTER_S)
        if unknown.any():
            left_out.append(LeftOut(unknown, f'no reading of {name} for more than '
                                    f'{limit_s:.3g} s'))
    return replace(recording, columns=columns), left_out


def _rests(output_g: np.ndarray, lag: int) -> bool:
    """Determine whether an output, g, (n, m), neither moves far nor slowly; with NaN as gaps."""
    output_g = output_g[np.isfinite(output_g).all(axis=1)]
    if len(output_g) <= 2 * lag:
        return True
    noise_g = np.sqrt(np.mean((output_g[lag:] - output_g[:-lag]) ** 2, axis=0) / 2)
    return bool(np.all(output_g.std(axis=0) < np.minimum(SMALLEST_MOTION_G, _SLOW * noise_g)
                       + _SAME_POSE))


def seen_step_rad(recording: Recording, stated_rad: float) -> float:
    """Return the step that the encoders show, where it exceeds the stated one, rad."""
    largest_rad = stated_rad
    for name in ('alpha_rad', 'beta_rad'):
        changes = np.abs(np.diff(recording.columns.get(name, np.zeros(0))))
        changes = changes[changes > 1e-9]
        if len(changes) < _FEWEST_CHANGES:
            continue
        step_rad = float(np.median(changes[changes < 1.5 * changes.min()]))
        few = changes[changes < 4.5 * step_rad]
        # Readings with decimals differ by one step more or less exactly.
        step_rad = float(few.sum() / np.rint(few / step_rad).sum())
        whole = np.abs(few / step_rad - np.rint(few / step_rad)) < _WHOLE
        if whole.sum() >= _FEWEST_CHANGES and whole.mean() > _WHOLE_SHARE \
                and _COARSER * largest_rad < step_rad < _LARGEST_STEP_RAD:
            largest_rad = step_rad
    return largest_rad


_JERK_S, _LARGEST_JERK = 0.1, 4.0
"""Time around a jerk of a robot that is left out, s, and error of the force, divided by the noise,
from which it is one. Chosen: that of the splines' knots; the error of what stays is below the
noise, rms, and the filter for errors weighs it."""


def _too_abrupt(comparison: BaselineComparison, force: Any, noise_g: float
                ) -> list[LeftOut]:
    """Find samples at which a robot jerks, so that its encoders do not show its acceleration."""
    error_g = np.abs(force.smoothing_mps2[:, :len(comparison.sensor.axes)]).max(axis=1) / G0_MPS2
    time_s = comparison.time_s
    rows = np.interp(time_s, force.time_s, error_g) > _LARGEST_JERK * noise_g
    rows |= (time_s < force.time_s[0] + _JERK_S) | (time_s > force.time_s[-1] - _JERK_S)
    margin = round(_JERK_S * comparison.sensor.rate_hz)
    rows = np.convolve(rows, np.ones(2 * margin + 1), 'same') > 0.5
    return [LeftOut(rows, f'the robot jerks, which its encoders do not show (error up to '
                    f'{1e3 * error_g.max():.2g} mg); move more smoothly, or record the joints at '
                    'a higher rate')] if rows.any() else []


def too_coarse(comparison: BaselineComparison, columns: dict[str, np.ndarray]) -> list[LeftOut]:
    """Find samples at which the reference moves faster than its readings show."""
    sensor, time_s, force = comparison.sensor, comparison.time_s, comparison.motion.force
    noise_g = float(np.min(noise.analog_std_v(sensor) / sensor.scale_v_per_g))
    limit_g = _LARGEST_ERROR * max(noise_g, float(np.min(sensor.lsb_v / sensor.scale_v_per_g)))
    # Name, times and readings of each reference, degrees of its splines, and their derivative
    references: list[tuple] = []
    if isinstance(force, ForcePath) and force.is_robot:
        return _too_abrupt(comparison, force, noise_g)
    if isinstance(force, ForcePath):
        references = [(force.name, force.time_s, np.array(force(force.time_s)) / G0_MPS2,
                       (3, 5), 0)]
    for joint, name in JOINTS.items() if comparison.joints else ():
        values = columns.get(name, np.zeros(0))
        read = np.isfinite(values)
        if read.sum() > BAND_LIMITED_DEGREE and np.ptp(values[read]):
            references.append(
                (name, time_s[read], values[None, read] / G0_MPS2,
                 (BAND_LIMITED_DEGREE - 2, BAND_LIMITED_DEGREE), 2) if joint == 'shift' else
                (name, time_s[read], values[None, read], (3, 5), 0))
    left_out = []
    margin = np.ones(2 * round(_WINDOW_S / 2 * sensor.rate_hz) + 1)
    for name, read_s, readings, degrees, order in references:
        # Between the readings, where both splines agree, they show the motion.
        middle_s = (read_s[1:] + read_s[:-1]) / 2
        first, second = (scipy.interpolate.make_interp_spline(
            read_s, readings[:len(sensor.axes)].T, k)(middle_s, order) for k in degrees)
        error_g = np.interp(time_s, middle_s, np.abs(first - second).max(axis=1))
        step_g = sensor.stage_resolution_rad if name in ('alpha_rad', 'beta_rad') else 0.0
        coarse = comparison.used & (error_g > np.hypot(limit_g, step_g))
        if coarse.any():
            coarse = np.convolve(_with_aliases(comparison, coarse, noise_g), margin, 'same') > 0.5
            rate_hz = 1 / float(np.median(np.diff(read_s)))
            left_out.append(LeftOut(
                coarse, f'{name} moves too fast for its {rate_hz:.4g} readings a second (error '
                f'up to {1e3 * error_g[coarse].max():.2g} mg); read it at a higher rate'))
    return left_out


def _with_aliases(comparison: BaselineComparison, coarse: np.ndarray, noise_g: float
                  ) -> np.ndarray:
    """Extend samples to the seconds beside them that move otherwise than simulated, (n,) bool."""
    sensor, signals_v = comparison.sensor, (comparison.volts,
                                            comparison.simulated_v(comparison.sensor))
    length = max(round(_WINDOW_S * sensor.rate_hz), _SHORTEST_WINDOW)
    part = np.minimum(np.arange(len(coarse)) // length, max(len(coarse) // length - 1, 0))
    recorded, simulated = (np.sqrt([
        noise_g ** 2 + np.bincount(part, c ** 2) / np.bincount(part) for c in np.nan_to_num(
            np.diff(v / sensor.scale_v_per_g, axis=0, prepend=0.0)).T]) for v in signals_v)
    differs = np.any(np.abs(np.log(recorded / simulated)) > np.log(_SAME_MOTION), axis=0)
    touched = np.bincount(part, coarse) > 0
    extended = coarse.copy()
    for begin, end in true_runs(differs | touched):
        if touched[begin:end].any():
            extended |= (part >= begin) & (part < end) & differs[part]
    return extended


def fading_frequency_hz(comparison: BaselineComparison) -> float | None:
    """Find the frequency above which the reference has less motion than the sensor."""
    if comparison.reference is not Reference.SIMULATOR:
        return None
    sensor = comparison.sensor
    size = max(round(_WINDOW_S * sensor.rate_hz), _SHORTEST_WINDOW)
    recorded_g, simulated_g = (np.nan_to_num(v / sensor.scale_v_per_g) for v in (
        comparison.volts, comparison.simulated_v(sensor)))
    if len(recorded_g) < _FEWEST_WINDOWS * size // 2:
        return None

    frequency_hz = np.arange(size // 2 + 1) * sensor.rate_hz / size
    band = max(round(_BAND_HZ * size / sensor.rate_hz), 1)
    count = (size // 2) // band * band
    stated = (noise.density_v2_per_hz(sensor, frequency_hz[1:]) / sensor.scale_v_per_g ** 2).sum(1)
    # Without its RC filter the sensor has this gain over its simulation.
    rc_s = float(np.max(noise.electronics(sensor).rc_s))
    unfiltered = 1 + (2 * np.pi * frequency_hz[1:] * rc_s) ** 2
    recorded, simulated = (scipy.signal.welch(
        v, sensor.rate_hz, nperseg=size, detrend='linear', axis=0)[1][1:].sum(axis=1)
        for v in (recorded_g, simulated_g))
    recorded, simulated, stated = (v[:count].reshape(-1, band).mean(axis=1) for v in (
        recorded, simulated * unfiltered, stated))
    moves = recorded > _MOTION * stated
    followed = np.flatnonzero(moves & (simulated >= _FADED * recorded))
    first = followed[-1] + 1 if len(followed) else 0
    return float(frequency_hz[1 + first * band]) if moves[first:].any() else None
