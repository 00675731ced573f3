# SPDX-License-Identifier: Apache-2.0
"""
Time shift between a recording and the specific force of another simulator.

A large shift is a fault of the files: the two began at different times, or have other clocks. A
small one may be the latency of the sensor, which is an effect of the library. It is left alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from adxl_ros.diagnose.comparison import compare, DataFault, SHORTEST_S, SMALLEST_MOTION_G
from adxl_ros.files.recording_columns import Recording
from adxl_ros.model.constants import G0_MPS2, Z_90
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.smoothed_paths import ForcePath
import numpy as np

LARGEST_LATENCY_S = 0.1
"""Largest shift, s, that may be a latency of the sensor. Chosen: twenty times the typical delay of
`time_offset`; a buffer of ten samples at 100 Hz has it."""
_SEARCH_STEP_S = 0.02
"""Step of the first search, s. Chosen: well below the largest latency."""
_LONGEST_SEARCH = 1 << 20
"""Largest number of steps of the first search. Chosen: six hours, and some 100 MB."""
_CERTAIN_CORRELATION = 0.9
"""Correlation from which two motions are the same one. Chosen: noise of half the motion."""
_SAME_CORRELATION = 0.01
"""Correlations that differ by less are equal, and the one of the longest overlap counts. Chosen: a
motion that repeats fits at several shifts."""
_LARGEST_ERROR_RATIO = 0.5
"""A shift shows if it reduces 1 − correlation below this share. Chosen: noise that is not shifted
keeps it."""
_ROUNDS = 6
"""Gauss-Newton steps of the fine search. Chosen: the shift then changes by less than 1 µs."""
_BLOCKS = 10
"""Blocks whose shifts show the error of their mean. Chosen: their scatter is known to 24 %."""
_FINE_SAMPLES = 20_000
"""Largest number of samples of the fine search. Chosen: far below the error of the sensor."""
_FINE_STD_S = 1e-3
"""Standard deviation of a shift, s, below which it is shown to 0.1 ms. Chosen: one digit more than
the error."""


@dataclass(frozen=True)
class Shift:
    """How much later the motion of a simulator is stamped than that of a recording."""

    late_s: float  # The shift, s; negative where the simulator is early
    std_s: float  # Its standard deviation, s
    correlation: float  # Correlation of the two motions without the shift

    @property
    def text(self) -> str:
        """Return the shift with its 90 % error and correlation, for people."""
        digits = 4 if self.std_s < _FINE_STD_S else 3
        return (f'{abs(self.late_s):.{digits}f} s {"late" if self.late_s > 0 else "early"} '
                f'(± {Z_90 * self.std_s:.{digits}f} s, correlation {self.correlation:.3f})')


@dataclass(frozen=True)
class AlignedForce:
    """A recording and the specific force of another simulator that belongs to it."""

    recording: Recording  # The samples that the simulator covers
    sim: Motion  # The simulator, shifted where it was asked for
    notes: tuple[str, ...]  # What was shifted or left out, one line each


def align_force(recording: Recording, sensor: Sensor, sim: Motion, may_shift: bool
                ) -> AlignedForce | DataFault:
    """Find the part of a recording that another simulator covers, and check their time."""
    assert isinstance(sim.force, ForcePath)
    shift, notes = _find_shift(recording, sensor, sim.force), []
    if shift is not None and may_shift:
        sim = replace(sim, force=sim.force.shifted(-shift.late_s))
        notes = [f'--align: --sim was {shift.text}, and is shifted by {-shift.late_s:+.6g} s; a '
                 'latency of the sensor is a part of that and cannot show']
    elif may_shift:
        notes = [f'--align: no shift beyond {LARGEST_LATENCY_S:g} s was found; less may be an '
                 'effect of the sensor (time_offset), and nothing is shifted']
    assert isinstance(sim.force, ForcePath)
    begin_s, end_s = sim.force.time_s[0], sim.force.time_s[-1]
    covered = (recording.time_s >= begin_s) & (recording.time_s <= end_s)
    if not covered.any():
        advice = f'its motion fits, but is {shift.text}; use --align' if shift is not None else \
            'no shift makes its motion fit; give the simulation of this recording'
        return DataFault('no_overlap', 'bad_data', '--sim does not overlap the recording in '
                         f'time: {Path(recording.path).name} is from {recording.time_s[0]:.6g} '
                         f'to {recording.time_s[-1]:.6g} s, --sim from {begin_s:.6g} to '
                         f'{end_s:.6g} s; {advice}')
    if shift is not None and not may_shift:
        return DataFault('time_misaligned', 'bad_data', f'--sim is {shift.text}; use --align, or '
                         f'shift its stamps by {-shift.late_s:+.6g} s')
    if not covered.all():
        outside_s = (1 - covered.mean()) * float(np.ptp(recording.time_s))
        notes.append(f'left out: {outside_s:.3g} s of the recording that --sim does not cover '
                     f'(it is from {begin_s:.6g} to {end_s:.6g} s)')
        recording = replace(recording, time_s=recording.time_s[covered],
                            columns={k: v[covered] for k, v in recording.columns.items()})
    return AlignedForce(recording, sim, tuple(notes))


def _find_shift(recording: Recording, sensor: Sensor, force: ForcePath) -> Shift | None:
    """Return the shift of a simulator, None where it may be a latency, or does not show."""
    sensor = replace(sensor, rate_hz=recording.rate_hz)
    volts = recording.volts(sensor)
    finite = np.isfinite(volts).all(axis=1)
    if finite.sum() < 2:
        return None
    late_s = _rough_shift(recording.time_s[finite],
                          volts[finite] / sensor.nominal_scale_v_per_g, force)
    if late_s is None:
        return None
    fine = _fine_shift(recording, sensor, force, late_s)
    return fine if fine is not None and abs(fine.late_s) > LARGEST_LATENCY_S else None


def _rough_shift(time_s: np.ndarray, measured_g: np.ndarray, force: ForcePath) -> float | None:
    """
    Return by how much a simulator is late, s, from the cross-correlation over all overlaps.

    None where no shift beyond a latency shows.
    """
    sim_s = force.time_s
    step_s = max(_SEARCH_STEP_S, (np.ptp(time_s) + np.ptp(sim_s)) / _LONGEST_SEARCH)
    first_s, second_s = (np.arange(t[0], t[-1], step_s) for t in (time_s, sim_s))
    first = np.column_stack([np.interp(first_s, time_s, g) for g in measured_g.T])
    second = np.column_stack(force(second_s))[:, :first.shape[1]] / G0_MPS2
    if min(first.std(axis=0).max(), second.std(axis=0).max()) < SMALLEST_MOTION_G:
        return None
    smallest = round(min(SHORTEST_S, np.ptp(time_s) / 2, np.ptp(sim_s) / 2) / step_s)
    lags, overlap, correlation = _correlations(first, second, max(smallest, 2))
    equal = np.flatnonzero(correlation > correlation.max() - _SAME_CORRELATION)
    # Of the lags of one peak the highest counts.
    best = equal[np.argmax(overlap[equal])]
    near = np.abs(lags - lags[best]) * step_s < 1.0
    best = int(np.argmax(np.where(near, correlation, -1.0)))
    late_s = float(second_s[0] - first_s[0] + lags[best] * step_s)
    if correlation[best] < _CERTAIN_CORRELATION:
        return None
    unshifted = int(np.argmin(np.abs(second_s[0] - first_s[0] + lags * step_s)))
    overlapping = abs(second_s[0] - first_s[0] + lags[unshifted] * step_s) < step_s
    if overlapping and 1 - correlation[best] > _LARGEST_ERROR_RATIO * (
            1 - correlation[unshifted]):
        return None
    return late_s


def _correlations(first: np.ndarray, second: np.ndarray, smallest: int
                  ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Correlate two series at all lags, each over the samples that overlap."""
    size = 1 << int(np.ceil(np.log2(len(first) + len(second))))

    def products(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return Σ a(i)·b(i + lag) for all lags."""
        spectrum = np.conj(np.fft.rfft(a, size)) * np.fft.rfft(b, size)
        circular = np.fft.irfft(spectrum, size)
        return np.concatenate([circular[size - len(first) + 1:], circular[:len(second)]])

    ones_first, ones_second = np.ones(len(first)), np.ones(len(second))
    # Sample i of the first meets sample i + lag of the second.
    lags = np.arange(-len(first) + 1, len(second))
    overlap = np.rint(products(ones_first, ones_second))
    covariance = np.zeros(len(lags))
    squares = [np.zeros(len(lags)), np.zeros(len(lags))]
    count = np.maximum(overlap, 1)
    for a, b in zip((first - first.mean(axis=0)).T, (second - second.mean(axis=0)).T):
        sum_a, sum_b = products(a, ones_second), products(ones_first, b)
        covariance += np.abs(products(a, b) - sum_a * sum_b / count)
        squares[0] += products(a * a, ones_second) - sum_a ** 2 / count
        squares[1] += products(ones_first, b * b) - sum_b ** 2 / count
    long_enough = overlap >= smallest
    smallest_square = SMALLEST_MOTION_G ** 2 * count
    moves = (squares[0] > smallest_square) & (squares[1] > smallest_square)
    correlation = np.where(long_enough & moves, covariance / np.sqrt(
        np.maximum(squares[0], smallest_square) * np.maximum(squares[1], smallest_square)), -1.0)
    return lags, overlap, correlation


def _fine_shift(recording: Recording, sensor: Sensor, force: ForcePath, late_s: float
                ) -> Shift | None:
    """Fit shift, zero-g and scale factor to blocks of the recording, from a rough shift."""
    every = max(1, len(recording) // _FINE_SAMPLES)
    begin_s, end_s = force.time_s[0] - late_s, force.time_s[-1] - late_s
    covered = np.flatnonzero((recording.time_s >= begin_s) & (recording.time_s <= end_s))
    part = slice(covered[0], covered[-1] + 1)
    recording = replace(recording, time_s=recording.time_s[part],
                        columns={k: v[part] for k, v in recording.columns.items()})
    sim = Motion(float(end_s - begin_s), force=force.shifted(-late_s))
    comparison = compare(recording, sensor, sim)
    time_s, volts = comparison.time_s, comparison.volts
    simulated_v = comparison.simulated_v(comparison.sensor)
    slope_v = np.gradient(simulated_v, time_s, axis=0)
    finite = np.isfinite(volts).all(axis=1)
    # The ends may need values from outside.
    inside = finite & (time_s > time_s[0] + LARGEST_LATENCY_S) \
        & (time_s < time_s[-1] - LARGEST_LATENCY_S)
    rows = np.flatnonzero(inside)[::every]
    more_s, squares, scatter = 0.0, np.ones(2), np.zeros(1)
    for _ in range(_ROUNDS):
        at_s = time_s[rows] + more_s
        shifted, slope = (np.column_stack([np.interp(at_s, time_s, v) for v in series.T])
                          for series in (simulated_v, slope_v))
        sums = np.array([_block_error(volts[rows[block]], shifted[block], slope[block])
                         for block in np.array_split(np.arange(len(rows)), _BLOCKS)])
        products, weights = sums[:, 0], sums[:, 1]
        if not weights.sum():
            return None
        step_s = float(products.sum() / weights.sum())
        more_s += float(np.clip(step_s, -LARGEST_LATENCY_S, LARGEST_LATENCY_S))
        scatter = (products - step_s * weights) / weights.sum()
        squares = sums[:, 2:].sum(axis=0)
    correlation = float(np.sqrt(max(1 - squares[0] / squares[1], 0.0)))
    return Shift(late_s + more_s, float(np.sqrt(np.sum(scatter ** 2))), correlation)


def _block_error(volts: np.ndarray, simulated_v: np.ndarray, slope_v: np.ndarray
                 ) -> np.ndarray:
    """Fit zero-g and scale factor to a block, and sum what determines its shift."""
    sums = np.zeros(4)
    for measured, simulated, slope in zip(volts.T, simulated_v.T, slope_v.T):
        line = np.column_stack([np.ones(len(simulated)), simulated])
        both = np.column_stack([measured, slope])
        residual, slope = (both - line @ np.linalg.lstsq(line, both)[0]).T
        sums += [residual @ slope, slope @ slope, residual @ residual,
                 np.sum((measured - measured.mean()) ** 2)]
    return sums
