# SPDX-License-Identifier: Apache-2.0
"""
What is corrected or left out before a comparison, and faults that make a diagnosis meaningless.

They are stamps, axes, units, clocks, the range, the reference, and missing samples. At rest
f = g·[sin α·cos β, −sin α·sin β, cos α]: a wrong sign of β looks like an inverted y, and one of α
like inverted x and y. The explanation with fewer changes is named.

The force of another simulator may have another clock. A large shift is a fault of the files. A
small one may be the latency of the sensor, which is an effect of the library: it is left alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from os.path import basename
from typing import Any, NamedTuple

from adxl_ros.diagnose import comparison as baseline, noise_effects, reference_checks
from adxl_ros.diagnose.comparison import BaselineComparison, compare, SMALLEST_MOTION_G
from adxl_ros.files.recording_columns import JOINTS, Recording, stamped_rate_hz
from adxl_ros.files.stamps import without_stalls
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2, TINY
from adxl_ros.model.effects.base import Detector
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from adxl_ros.process import option
from adxl_ros.report.quantities import listed
from adxl_ros.signals import gravity_at_rest, tolerances
from adxl_ros.signals.block_statistics import true_runs
from adxl_ros.signals.gravity_at_rest import GravityFaultKind, RestReadings
from adxl_ros.signals.polarity import find_polarity_fault
from adxl_ros.signals.recorded_gravity import RecordingLook
from adxl_ros.signals.rest_detection import find_rests
from adxl_ros.signals.rest_means import rest_means
from adxl_ros.signals.rest_search import RestRule
from adxl_ros.simulate.motion import ForcePath, Motion
import numpy as np
import scipy

SHORTEST_S = 30.0
"""Shortest time, s, that the recordings of a moving sensor last together. Chosen: a few turns of
the stage."""
LARGEST_LATENCY_S = 0.1
"""Largest shift, s, that may be a latency of the sensor. Chosen: twenty times the typical delay of
`time_offset`; a buffer of ten samples at 100 Hz has it."""
_LARGEST_DRIFT_S = 2 * LARGEST_LATENCY_S
"""Change of a shift, s, up to which one shift leaves no more than a latency at either end. The
effect of a clock skew describes what is left."""
_DRIFT_ACCURACY_S = 1e-4  # Accuracy of its ends, s. Chosen: far below a sample
_SEARCH_STEP_S = 0.02
"""Step of the first search of a shift, s. Chosen: well below the largest latency."""
_LONGEST_SEARCH = 1 << 20  # Largest number of its steps. Chosen: six hours
_PART_S = 15.0
"""Shortest part of a recording whose shift is looked for, s. Chosen: half of the shortest
recording, so that each has two."""
_OVERLAP_OF_PART = 0.5
"""Share of a part that must overlap. Chosen: the ends of both recordings differ, and a clock may
step by half of a part."""
_MOST_PARTS = 8  # Most parts. Chosen: a step then shows in all but an eighth at either end
_CORRELATED = 0.9
"""Correlation from which two motions are the same one. Chosen: noise of half the motion."""
_SAME_CORRELATION = 0.01
"""Correlations that differ by less are equal, and the one of the longest overlap counts. Chosen: a
motion that repeats fits at several shifts."""
_LARGEST_STEP_S = 4.0
"""Largest step of a clock that is looked for anywhere, s; of a larger one, the parts tell the
shifts. Chosen: a quarter of a part."""
_COARSE_S = 0.05  # Step of the search for a step, s. Chosen: below a period of most motion
_SMALLEST_STEP_S = 5e-3  # Smallest step of a clock, s. Chosen: less is jitter
_LARGEST_ERROR_RATIO = 0.5
"""A shift shows if it reduces 1 − correlation below this share. Chosen: noise that is not shifted
keeps it."""
_FINE_SAMPLES = 20_000  # Largest number of samples of the fine search. Chosen: run time
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
_SAMPLES = 4000
"""Largest number of samples that are compared with angles. Chosen: a few for each second."""
_WRONG = 0.2
"""Share of the output's variance that angles do not explain, from which they may be wrong. Chosen:
it is 0.03 where the sensor is mounted 10° off."""
_RIGHT = 0.1
"""The same share up to which changed angles are right. Chosen: half of that of wrong ones."""
_SIGNS = ((1, 1), (1, -1), (-1, 1), (-1, -1))
"""Signs of both angles that are tried. The fewest changes come first."""
_AGED_ZERO_G = 0.01
"""Zero-g, g, from which its sign tells an inverted axis from a wrong angle. Chosen: that of a
healthy unit ages by less."""
_FEWEST_SAMPLES = 50  # Fewest samples of any recording. Chosen: one for each of 48 blocks
_LARGEST_UNEXPLAINED_MOTION_G = 0.3
"""Range of the output, g, that drift and noise cannot explain without a reference. Chosen: 17° of
tilt."""
_RANGE_QUANTILES = (0.02, 0.98)  # Quantiles at the ends of that range. Chosen: without outliers
_SWAPPED = 0.7
"""Correlation with its own reference below which an axis may be swapped. Chosen: that of noise as
large as the signal."""
_UNCORRELATED = 0.5
"""Correlation below which nothing follows the reference. Chosen: that of noise 1.7 times as large
as the signal."""
_LARGEST_MISSING_SHARE = 0.3
"""Share of samples that may be missing, or at the end of the range. Chosen: the rest still
shows the effects."""
_SEARCHED_DELAY_S = 1.0  # Largest delay that the effect of a time offset models, s
_LARGEST_DELAY_S = 30.0
"""Largest delay that is looked for, s. Chosen: a recording started by hand."""
_CORRELATION_GAIN = 0.05
"""Correlation that a delay must gain. Chosen: above the error of a correlation by noise."""
_JUMP_STEPS = 20.0
"""A step of the stamps of this many usual steps is a jump. Chosen: a link that loses a
buffer of ten samples stays below by a factor of two."""
_LARGEST_JUMP_SHARE = 0.2
"""Share of the recording that jumps may have. Chosen: gaps of a lossy link are no fault of the
clock."""
_SMALLEST_GAP_G = 1e-6
"""Gap below which a simulator holds the recording itself, g. Chosen: files round by less, and the
noise of any sensor is far above."""
_SMALLEST_STEP_V = 1e-9  # Step of an ADC that stands for none, V. Chosen: rounding errors
_DEAD_SHARE = 1e-4  # Share of its simulated range that a wired axis covers. Chosen: any wrong unit
_LONGEST_HOLD_S = 1.0
"""Longest time that an output may keep one value in motion, s. Chosen: a link that
holds its last value recovers sooner, and a broken wire does not."""
_LARGEST_LEVEL_G = 1e3  # Largest median output, g. Chosen: above that of any sensor on a stage
_UNIT_TOLERANCE = 0.1
"""Relative deviation of a gain from the ratio of two units. Chosen: above any scale error."""
_UNIT_RATIOS = {
    G0_MPS2: 'm/s² instead of g',
    1 / G0_MPS2: 'g instead of m/s²',
    1e3: 'mm/s² instead of m/s², or mV instead of V',
    1e-3: 'm/s² instead of mm/s², or V instead of mV',
    1e3 / G0_MPS2: 'mg instead of m/s²',
    G0_MPS2 / 1e3: 'm/s² instead of mg',
    1e3 * G0_MPS2: 'mm/s² instead of g',
    1e-3 / G0_MPS2: 'g instead of mm/s²',
}
"""Gain of an output in the wrong unit, and which unit it has instead of which."""
DATA_FAULTS = {
    'axis_inverted': 'an axis has the opposite sign',
    'axis_swapped': 'two axes are swapped',
    'clock_drift': 'two clocks drift apart by more than one shift corrects',
    'clock_jump': 'a clock steps or runs backwards',
    'constant': 'an axis does not change',
    'encoder_sign': 'an angle has the opposite sign',
    'gravity': 'gravity is missing at rest, as in linear acceleration',
    'missing': 'many samples are no numbers',
    'no_overlap': 'the reference has no time in common with the recording',
    'reference': 'the reference is wrong, of another motion, or missing',
    'saturated': 'many samples are at the end of the range',
    'time_misaligned': 'one shift in time is needed that is no latency',
    'too_short': 'too little can be compared; the status is insufficient',
    'unit': 'readings, angles or stamps are in another unit',
}
"""Faults of the data by name, with their meaning."""


@dataclass(eq=False)
class DataFault(Exception):
    """A fault of the recording, with the recordings whose notes say more."""

    name: str  # Name in the report, `verdict.data_fault`: one of `DATA_FAULTS`
    message: str  # What is wrong and what to do, one line
    status: str = 'bad_data'  # Status of the verdict: 'bad_data' or 'insufficient'
    comparisons: tuple[BaselineComparison, ...] = ()

    def __post_init__(self) -> None:
        assert self.name in DATA_FAULTS, 'a fault has a meaning for reports'

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy and pickle it, which exceptions with names do not by themselves."""
        return DataFault, (self.name, self.message, self.status, self.comparisons)


def check_gravity(recording: Recording, sensor: Sensor, sim: Motion | None) -> list[str]:
    """
    Refuse a recording, or the force of another simulator, whose rests do not read gravity.

    A wrong zero-g or scale factor is an effect that the diagnosis finds, and no fault. Return what
    else is wrong with the samples of the recording.
    """
    doubts: list[str] = []
    if len(recording) > 1:
        look = RecordingLook(sensor, recording)
        look.feed(recording)
        doubts = [f'{basename(recording.path)}: {fault}' for fault in look.faults()]
        fault = look.gravity().fault
        if fault is not None and fault.is_clear:
            raise DataFault(fault.data_fault, f'{basename(recording.path)}: {fault.text}')
    if sim is not None and isinstance(sim.force, ForcePath):
        time_s = sim.force.time_s
        force_mps2 = np.column_stack(sim.force(time_s))
        rate_hz = stamped_rate_hz(time_s)
        rests = find_rests(time_s, force_mps2, rate_hz, RestRule(gravity=G0_MPS2))
        shape = len(rests), force_mps2.shape[1]
        mean, std = (
            np.reshape(values, shape) for values in rest_means(time_s, force_mps2, rests, rate_hz)
        )
        readings, gravity_mps2 = RestReadings(mean, std), sensor.local_gravity_mps2
        fault = gravity_at_rest.look(readings, tolerances.IDEAL, gravity_mps2).fault
        if fault is not None and fault.is_clear:
            raise DataFault(
                fault.data_fault,
                f'{sim.force.name}: {fault.stated_by(option(sim_unit=fault.symbol))}',
            )
        # A simulator may have the errors of a sensor, but none beyond its tolerance.
        tolerance = tolerances.nominal_tolerance(sensor).widest(force_mps2.shape[1])
        fault = gravity_at_rest.look(readings, tolerance, gravity_mps2).fault
        if fault is not None and fault.kind is GravityFaultKind.SCALE:
            raise DataFault(
                'reference', f'{sim.force.name}: {fault.reason}; check the gravity of its world'
            )
    return doubts


def _align_force(
    recording: Recording, sensor: Sensor, sim: Motion, may_shift: bool
) -> tuple[Recording, Motion, list[str]]:
    """
    Find the part of a recording that another simulator covers, and check their time.

    Return that part, the simulator, shifted where it was asked for, and notes; raise DataFault.
    """
    force, notes = sim.force, []
    assert isinstance(force, ForcePath)
    align, late_s = option(align=True), 0.0
    motions = _motions(recording, sensor, force)
    if motions is not None:
        late_s = _find_shift(motions, recording, sensor, force)
        parts = motions.fitting_parts()
        _check_step(motions, recording, force, late_s, parts)
        drift = _find_drift(motions, parts)
        if drift is not None:
            raise _drift_fault(drift, recording, force)
    shift = f'{abs(late_s):.4f} s {"late" if late_s > 0 else "early"}' if late_s else ''
    if late_s and may_shift:
        force = force.shifted(-late_s)
        notes = [
            f'{align}: {force.name} was {shift}, and is shifted by '
            f'{-late_s:+.6g} s; a latency of the sensor is a part of that and cannot show'
        ]
    elif may_shift:
        notes = [
            f'{align}: no shift beyond {LARGEST_LATENCY_S:g} s was found; less may '
            'be an effect of the sensor (time_offset), and nothing is shifted'
        ]
    covered, begin_s, end_s = _covered(recording, force)
    span = f'it is from {begin_s:.6g} to {end_s:.6g} s'
    if not len(covered):
        advice = (
            f'its motion fits, but is {shift}; use {align}'
            if shift
            else 'no shift makes its motion fit; give that of this recording'
        )
        raise DataFault(
            'no_overlap',
            f'{force.name} does not overlap the recording in time: '
            f'{span}, {basename(recording.path)} from {recording.time_s[0]:.6g} to '
            f'{recording.time_s[-1]:.6g} s; {advice}',
        )
    if late_s and not may_shift:
        raise DataFault(
            'time_misaligned',
            f'{force.name} is {shift}; use {align}, or shift its stamps by {-late_s:+.6g} s',
        )
    if len(covered) < len(recording):
        outside_s = (1 - len(covered) / len(recording)) * float(np.ptp(recording.time_s))
        notes.append(
            f'left out: {outside_s:.3g} s of the recording that {force.name} does not '
            f'cover ({span})'
        )
    return covered, replace(sim, force=force), notes


def _covered(recording: Recording, force: ForcePath) -> tuple[Recording, float, float]:
    """Return the part of a recording that a force covers, and begin and end of the force, s."""
    begin_s, end_s = force.time_s[0], force.time_s[-1]
    return (
        recording.rows(
            int(np.searchsorted(recording.time_s, begin_s)),
            int(np.searchsorted(recording.time_s, end_s, 'right')),
        ),
        begin_s,
        end_s,
    )


class _Motions(NamedTuple):
    """The motion of a recording, and that of a simulator, at even instants."""

    measured_s: np.ndarray  # Instants of the recording, s, (n,)
    measured_g: np.ndarray  # Its readings, g, (n, m)
    stated_s: np.ndarray  # Instants of the simulator, s, (n',)
    stated_g: np.ndarray  # Its force, g, (n', m)
    step_s: float  # Time between two instants, s

    def shifts(self, rows: np.ndarray, smallest: int) -> _Shifts:
        """Correlate a part of the recording, rows, with the simulator at all shifts."""
        time_s = self.measured_s[rows]
        found = reference_checks.correlations(self.measured_g[rows], self.stated_g, smallest)
        lags_s = self.stated_s[0] - time_s[0] + found.lags * self.step_s
        return _Shifts(time_s, lags_s, found.overlap, found.correlation)

    def fitting_parts(self) -> list[_Shifts]:
        """Return the parts of the recording that fit the simulator at one shift each."""
        time_s = self.measured_s
        count = max(min(int(np.ptp(time_s) / _PART_S), _MOST_PARTS), 1)
        parts = [
            self.shifts(rows, round(_OVERLAP_OF_PART * len(rows)))
            for rows in np.array_split(np.arange(len(time_s)), count)
        ]
        return [part for part in parts if part.fits]

    def stated_at(self, late_s: np.ndarray | float) -> np.ndarray:
        """Return the simulator beside the recording, g, (n, m), at shifts, s, (n,) or ()."""
        instants_s = self.measured_s + late_s
        return np.column_stack(
            [np.interp(instants_s, self.stated_s, axis_g) for axis_g in self.stated_g.T]
        )

    def overlap(self, late_s: np.ndarray | float) -> np.ndarray:
        """Return which instants the simulator has at shifts, s, (n,) or (), (n,) bool."""
        instants_s = self.measured_s + late_s
        return (instants_s >= self.stated_s[0]) & (instants_s <= self.stated_s[-1])

    def left_g2(self, late_s: np.ndarray | float) -> float:
        """Return the mean square, g², that shifts, s, (n,) or (), leave where both overlap."""
        overlap = self.overlap(late_s)
        if overlap.mean() < _OVERLAP_OF_PART:
            return np.inf
        left = _unexplained(self.measured_g[overlap], self.stated_at(late_s)[overlap])
        return left / int(overlap.sum())

    def part(self, rows: np.ndarray) -> _Motions:
        """Return the part of the recording that has these rows."""
        return self._replace(measured_s=self.measured_s[rows], measured_g=self.measured_g[rows])

    def best_shift_s(self, near_s: np.ndarray) -> float:
        """Return the shift that leaves least, near some, s, (k,)."""
        best_s = min(near_s.tolist(), key=self.left_g2)
        ends_s = best_s - _COARSE_S, best_s + _COARSE_S
        found = scipy.optimize.minimize_scalar(self.left_g2, bounds=ends_s, method='bounded')
        return float(found.x)


def _motions(recording: Recording, sensor: Sensor, force: ForcePath) -> _Motions | None:
    """Return both motions, coarse enough for a search over all shifts; None without samples."""
    measured_g = (recording.volts(sensor) - sensor.zero_g_v) / sensor.scale_v_per_g
    finite = np.isfinite(measured_g).all(axis=1)
    if finite.sum() < 2:
        return None
    time_s, sim_s = recording.time_s[finite], force.time_s
    step_s = max(_SEARCH_STEP_S, (np.ptp(time_s) + np.ptp(sim_s)) / _LONGEST_SEARCH)
    measured_s, stated_s = (np.arange(t[0], t[-1], step_s) for t in (time_s, sim_s))
    return _Motions(
        measured_s,
        np.column_stack([np.interp(measured_s, time_s, g) for g in measured_g[finite].T]),
        stated_s,
        np.column_stack(force(stated_s))[:, : measured_g.shape[1]] / G0_MPS2,
        step_s,
    )


class _Shifts(NamedTuple):
    """How well a part of a recording fits a simulator, by shift, (lags,) each."""

    time_s: np.ndarray  # Instants of the part, s, (k,)
    lags_s: np.ndarray  # How much later the simulator is stamped, s
    overlap: np.ndarray  # Number of instants that overlap
    correlation: np.ndarray  # −1 where too few overlap

    @property
    def late_s(self) -> float:
        """Return the best shift, s."""
        return float(self.lags_s[np.argmax(self.correlation)])

    @property
    def fits(self) -> bool:
        """Return whether the part fits at its best shift."""
        return bool(self.correlation.max() > _CORRELATED)


class _Drift(NamedTuple):
    """Shifts of a simulator that change evenly from begin to end of a recording."""

    begin_s: float  # How much later the simulator is stamped at the begin, s
    end_s: float  # The same at the end, s

    @property
    def change_s(self) -> float:
        """Return how much the shift changes, s."""
        return self.end_s - self.begin_s

    def late_s(self, motions: _Motions) -> np.ndarray:
        """Return the shift at each instant of a recording, s, (n,)."""
        return np.linspace(self.begin_s, self.end_s, len(motions.measured_s))

    def explains(self, part: _Shifts, motions: _Motions) -> bool:
        """Return whether the shift of a part is that of an instant in it, to half a step."""
        ends_s = np.interp(
            part.time_s[[0, -1]], motions.measured_s[[0, -1]], [self.begin_s, self.end_s]
        )
        resolution_s = motions.step_s / 2
        return bool(ends_s.min() - resolution_s <= part.late_s <= ends_s.max() + resolution_s)


def _fit_drift(motions: _Motions, ends_s: np.ndarray) -> tuple[_Drift, float]:
    """Fit the shifts at begin and end, from rough ones, s, (2,); return the g² that they leave."""
    fitted = scipy.optimize.minimize(
        lambda ends: motions.left_g2(_Drift(*ends).late_s(motions)),
        ends_s,
        method='Nelder-Mead',
        options={
            'initial_simplex': ends_s + motions.step_s * np.array([[0, 0], [1, 0], [0, 1]]),
            'xatol': _DRIFT_ACCURACY_S,
            'fatol': 0.0,
        },
    )
    return _Drift(*map(float, fitted.x)), float(fitted.fun)


def _find_drift(motions: _Motions, parts: Sequence[_Shifts]) -> _Drift | None:
    """
    Return the drift that explains the shifts of all parts.

    None where one shift is near enough for all, or explains as much, or a step explains more.
    """
    if len(parts) < 2:
        return None
    time_s, span_s = motions.measured_s, np.ptp(motions.measured_s)
    first, last = parts[0].late_s, parts[-1].late_s
    line = np.polynomial.Polynomial.fit(
        [part.time_s.mean() for part in parts], [part.late_s for part in parts], 1
    )
    ends_s = line(time_s[[0, -1]])
    # No part shows its shift better than that of one of its instants.
    uncertain_s = motions.step_s + abs(np.ptp(ends_s)) * np.ptp(parts[0].time_s) / span_s
    if abs(np.ptp(ends_s)) + uncertain_s < _LARGEST_DRIFT_S:
        return None
    drift, left_g2 = _fit_drift(motions, ends_s)
    if abs(drift.change_s) < _LARGEST_DRIFT_S:
        return None
    one_shift = scipy.optimize.minimize_scalar(
        motions.left_g2, bounds=sorted(drift), method='bounded'
    )
    step_at_s = _time_of_step(motions, first, last)
    left_by_step_g2 = motions.left_g2(np.where(time_s < step_at_s, first, last))
    is_better = left_g2 < min(_LARGEST_ERROR_RATIO * one_shift.fun, left_by_step_g2)
    return drift if is_better and all(drift.explains(part, motions) for part in parts) else None


def _drift_fault(drift: _Drift, recording: Recording, force: ForcePath) -> DataFault:
    """Return the fault of two clocks of different rates, with the rate that mends it."""
    time_s = recording.time_s
    ratio = drift.change_s / np.ptp(time_s)
    steps_s = np.diff(time_s)
    # The number of a sample tells its time only where none is missing.
    counts_time = steps_s.max() < _USUAL_STEP * np.median(steps_s)
    own_correction = (
        f'use {option(rate=f"{recording.rate_hz / (1 + ratio):.6g}")}'
        if counts_time
        else f'multiply its stamps by {1 + ratio:.6g} ({option("rate")} would miss the gaps)'
    )
    return DataFault(
        'clock_drift',
        f'the clocks of {force.name} and of the recording drift apart by '
        f'{100 * abs(ratio):.3g} s in 100 s, so that no shift fits from begin to end; if that of '
        f'the recording is wrong, {own_correction}, else divide the stamps of {force.name} by '
        f'{1 + ratio:.6g}; a shift that is left then needs {option(align=True)}',
    )


def _step_fault(force: ForcePath, motions: _Motions, before_s: float, after_s: float) -> DataFault:
    """Return the fault of a clock that steps from one shift to another, with size and time."""
    return DataFault(
        'clock_jump',
        f'the clock of {force.name} or that of the recording steps by '
        f'{abs(after_s - before_s):.2g} s at about '
        f'{_time_of_step(motions, before_s, after_s):.4g} s; cut the recording there, '
        f'and diagnose each part with {option(align=True)}',
    )


def _check_step(
    motions: _Motions,
    recording: Recording,
    force: ForcePath,
    about_s: float,
    parts: Sequence[_Shifts],
) -> None:
    """
    Refuse motions whose shift steps, wherever it does.

    A step shows if two shifts leave far less than one, and than shifts that drift. It needs no
    whole parts on both sides: a recording may move for some seconds only before its step.
    The shifts that are tried lie within seconds of `about_s`, which fits best, and within a
    latency of 0 and of those at which single parts fit.
    """
    centers_s = {about_s, 0.0, *(part.late_s for part in parts)}
    # Instants that have a reference, without gaps
    inside = np.any([motions.overlap(late_s) for late_s in centers_s], axis=0)
    before = np.searchsorted(recording.time_s, motions.measured_s, 'right') - 1
    inside &= np.diff(recording.time_s, append=np.inf)[before] < _COARSE_S + 2 / recording.rate_hz
    compared = np.flatnonzero(inside)
    motions = motions.part(compared[:: 1 + len(compared) // _FINE_SAMPLES])
    rows = np.arange(len(motions.measured_s))
    if not len(rows):
        return
    latencies_s = np.arange(-LARGEST_LATENCY_S, LARGEST_LATENCY_S, motions.step_s)
    near_s = np.concatenate(
        [
            about_s + np.arange(-_LARGEST_STEP_S, _LARGEST_STEP_S, _COARSE_S),
            *(late_s + latencies_s for late_s in centers_s),
        ]
    )
    one_s = motions.best_shift_s(near_s)
    zero_g = (motions.measured_g - motions.stated_at(one_s))[motions.overlap(one_s)].mean(axis=0)
    motions = motions._replace(measured_g=motions.measured_g - zero_g)
    first = _first_row_behind(motions, one_s, near_s)
    if min(first, len(rows) - first) * motions.step_s < LARGEST_LATENCY_S:
        return
    before_s, after_s = (
        motions.part(side).best_shift_s(near_s) for side in np.split(rows, [first])
    )
    _, drift_g2 = _fit_drift(motions, np.full(2, one_s))
    left_g2 = motions.left_g2(np.where(rows < first, before_s, after_s))
    explains = left_g2 < _LARGEST_ERROR_RATIO * min(motions.left_g2(one_s), drift_g2)
    if explains and abs(after_s - before_s) > _SMALLEST_STEP_S:
        raise _step_fault(force, motions, before_s, after_s)


def _first_row_behind(motions: _Motions, one_s: float, near_s: np.ndarray) -> int:
    """Return the row on one side of which another shift gains most, of some, s, (k,)."""
    own_g, one_g = motions.measured_g, motions.stated_at(one_s)
    most_g2, first = 0.0, 0
    for other_s in near_s:
        other_g = motions.stated_at(other_s)
        gains_g2 = ((own_g - one_g) ** 2 - (own_g - other_g) ** 2).sum(axis=1)
        gain_g2 = np.cumsum(gains_g2 * motions.overlap(one_s) * motions.overlap(other_s))
        for row, gained_g2 in (
            (gain_g2.argmax(), gain_g2.max()),
            (gain_g2.argmin(), gain_g2[-1] - gain_g2.min()),
        ):
            if gained_g2 > most_g2:
                most_g2, first = gained_g2, int(row) + 1
    return first


def _time_of_step(motions: _Motions, before_s: float, after_s: float) -> float:
    """Return from when on the second of two shifts explains the recording better, s."""
    before_g2, after_g2 = (
        ((motions.measured_g - motions.stated_at(np.array(late_s))) ** 2).sum(axis=1)
        for late_s in (before_s, after_s)
    )
    last = int(np.argmin(np.cumsum(before_g2 - after_g2)))
    # In the middle of a gap
    return float(motions.measured_s[last : last + 2].mean())


def _unexplained(measured: np.ndarray, stated: np.ndarray) -> float:
    """Return the squares, summed, that zero-g and scale factor of each axis leave, (n, m) each."""
    left = 0.0
    for own, other in zip(measured.T, stated.T):
        line = np.column_stack([np.ones(len(other)), other])
        left += float(np.sum((own - line @ np.linalg.lstsq(line, own)[0]) ** 2))
    return left


def _find_shift(
    motions: _Motions, recording: Recording, sensor: Sensor, force: ForcePath
) -> float:
    """
    Return how much later a simulator is stamped, s, by the cross-correlation of both motions.

    0 where it may be a latency, or does not show.
    """
    shortest_s = min(SHORTEST_S, np.ptp(recording.time_s) / 2, np.ptp(force.time_s) / 2)
    every = np.arange(len(motions.measured_s))
    shifts = motions.shifts(every, max(round(shortest_s / motions.step_s), 2))
    lags_s, correlation = shifts.lags_s, shifts.correlation
    equal = np.flatnonzero(correlation > correlation.max() - _SAME_CORRELATION)
    longest_s = lags_s[equal[np.argmax(shifts.overlap[equal])]]
    best = int(np.argmax(np.where(np.abs(lags_s - longest_s) < 1.0, correlation, -1.0)))
    unshifted = int(np.argmin(np.abs(lags_s)))
    overlaps_unshifted = abs(lags_s[unshifted]) < motions.step_s
    gains_little = 1 - correlation[best] > _LARGEST_ERROR_RATIO * (1 - correlation[unshifted])
    if correlation[best] < _CORRELATED or (overlaps_unshifted and gains_little):
        return 0.0
    late_s = _fine_shift(recording, sensor, force, float(lags_s[best]))
    return late_s if abs(late_s) > LARGEST_LATENCY_S else 0.0


def _fine_shift(recording: Recording, sensor: Sensor, force: ForcePath, late_s: float) -> float:
    """Fit shift, s, zero-g and scale factor to the recording, from a rough shift."""
    shifted = force.shifted(-late_s)
    covered, begin_s, end_s = _covered(recording, shifted)
    comparison = compare(covered, sensor, Motion(float(end_s - begin_s), force=shifted))
    time_s, volts = comparison.time_s, comparison.volts
    simulated_v = comparison.simulated_v(comparison.sensor)
    # The ends may need values from outside.
    inside = (
        np.isfinite(volts).all(axis=1)
        & (time_s > time_s[0] + LARGEST_LATENCY_S)
        & (time_s < time_s[-1] - LARGEST_LATENCY_S)
    )
    rows = np.flatnonzero(inside)[:: max(1, len(recording) // _FINE_SAMPLES)]

    def left_v2(more_s: float) -> float:
        """Return what zero-g and scale factor leave after a further shift."""
        later_s = time_s[rows] + more_s
        shifted_v = [np.interp(later_s, time_s, axis_v) for axis_v in simulated_v.T]
        return _unexplained(volts[rows], np.column_stack(shifted_v))

    return late_s + float(
        scipy.optimize.minimize_scalar(
            left_v2,
            bounds=(-LARGEST_LATENCY_S, LARGEST_LATENCY_S),
            method='bounded',
            options={'xatol': 1e-6},
        ).x
    )


def _without_stalls(recording: Recording) -> tuple[Recording, list[str]]:
    """Return a recording as if its host had never stalled, and what was changed."""
    mended_s = without_stalls(recording.time_s, 1 / recording.rate_hz, LARGEST_LATENCY_S)
    late_s = recording.time_s - mended_s
    if not late_s.any():
        return recording, []
    note = (
        f'{np.count_nonzero(late_s)} samples are stamped up to {late_s.max():.3g} s late, the '
        f'first at {mended_s[np.flatnonzero(late_s)[0]]:.6g} s, as by a host that stalls and '
        'reads at once what waited: they are taken at an even rate'
    )
    return replace(recording, time_s=mended_s), [note]


def compare_checked(
    recording: Recording, sensor: Sensor, sim: Motion | None, may_shift: bool
) -> BaselineComparison:
    """
    Put a recording beside the simulator, without the parts that have no reference.

    Raise DataFault where that is meaningless.
    """
    sensor = replace(sensor, rate_hz=recording.rate_hz)
    recording, notes = _without_stalls(recording)
    _check_clock(recording)
    even_s = even_stamps(recording.time_s)
    left_out: list[tuple[np.ndarray, str]] = []
    if sim is not None:
        recording, sim, of_shift = _align_force(recording, sensor, sim, may_shift)
        notes += of_shift
    else:
        _check_encoder(recording, sensor)
        step_rad = baseline.seen_step_rad(recording, sensor)
        if step_rad > sensor.stage_resolution_rad:
            stated_deg = np.degrees(sensor.stage_resolution_rad)
            notes.append(
                f'the stage reads in steps of {np.degrees(step_rad):.3g}°, not of '
                f'{stated_deg:.3g}° as stated: this is used'
            )
            sensor = replace(sensor, stage_resolution_rad=step_rad)
        recording, left_out = baseline.stated_poses(recording, sensor)
    comparison = compare(recording, sensor, sim)
    if even_s is not None and len(even_s) == len(recording):
        # Samples may also have been taken unevenly, so that the simulation decides.
        evenly = compare(replace(recording, time_s=even_s), sensor, sim)
        if _roughness(evenly) < _SAME_ROUGHNESS * _roughness(comparison):
            comparison = evenly
            notes.append(
                f'stamps are uneven, and an even rate of {evenly.sensor.rate_hz:.6g} '
                'Hz explains them: it is used'
            )
    comparison = replace(comparison, notes=tuple(notes))
    try:
        _check_output(comparison)
        _check_simulator(comparison)
    except DataFault as fault:
        raise replace(fault, comparisons=(comparison,)) from None
    for rows, reason in left_out if comparison.joints else ():
        comparison = baseline.leave_out(comparison, rows, reason)
    comparison = baseline.without_gaps(_without_disturbed(comparison))
    # What moves too fast is looked for where the reference is stated.
    comparison = baseline.without_fast_motion(comparison, recording.columns)
    fading_hz = baseline.fading_frequency_hz(comparison)
    if fading_hz is not None:
        smoother = (
            f'the reference is smoother than the sensor: above {fading_hz:.3g} Hz it '
            'lacks motion that the recording has; effects that show in fast motion are '
            'not named'
        )
        comparison = replace(comparison, notes=(smoother, *comparison.notes))
    return replace(comparison, fading_hz=fading_hz)


def _without_disturbed(comparison: BaselineComparison) -> BaselineComparison:
    """Leave out what the sensor did not measure: no numbers, repeated, lone or stuck samples."""
    faults, sensor = noise_effects.sample_faults(comparison), comparison.sensor
    stuck = _stuck(comparison)
    disturbed = faults.repeated | faults.isolated | stuck.any(axis=1)
    comparison = replace(comparison, disturbed=disturbed)
    for rows, reason, detector in (
        (~np.isfinite(comparison.volts).all(axis=1), 'they are no numbers', None),
        (faults.repeated, 'they repeat the one before', Detector.REPEATED_SAMPLES),
        (
            faults.isolated,
            'they stand alone, away from the samples around them',
            Detector.ISOLATED_SAMPLES,
        ),
    ):
        effect = noise_effects.effect_of(detector) if detector else None
        comparison = baseline.leave_out(comparison, rows, reason, effect)
    readings_mps2 = to_nominal_mps2(comparison.volts, sensor)
    for axis, still, held, values_mps2 in zip(
        sensor.axes, stuck.T, faults.held.T, readings_mps2.T
    ):
        comparison = baseline.leave_out(
            comparison, still, f'{axis} does not change there, though the motion does', ''
        )
        ends = [f'{end:.4g}' for end in np.unique(values_mps2[held])]
        comparison = baseline.leave_out(
            comparison,
            held,
            f'{axis} is held at {listed(ends, "and")} m/s², the end of its range',
            noise_effects.effect_of(Detector.HELD_AT_END),
        )
    beyond = comparison.out_of_range
    for d in np.flatnonzero(beyond.any(axis=0)):
        output_v = comparison.volts[beyond[:, d], d] - sensor.zero_g_v[d]
        largest_g = np.abs(output_v).max() / sensor.scale_v_per_g[d]
        note = (
            f'{sensor.axes[d]}: {len(output_v)} samples, up to {largest_g:.3g} g, are at a rail '
            f'or beyond the range of {sensor.range_g:g} g that the parameter file states; set the '
            'range of the sensor'
        )
        comparison = replace(comparison, notes=(*comparison.notes, note))
    return comparison


def _stuck(comparison: BaselineComparison) -> np.ndarray:
    """Return where an axis keeps one value in motion that it should follow, (n, m) bool."""
    volts, simulated_v = comparison.volts, comparison.simulated_v(comparison.sensor)
    longest = max(round(_LONGEST_HOLD_S * comparison.sensor.rate_hz), 2)
    stuck = np.zeros(volts.shape, bool)
    for d, (values, expected) in enumerate(zip(volts.T, simulated_v.T)):
        # An output that clips, or coarse codes in an extreme pose, hold the largest value.
        held = np.diff(values, prepend=np.nan) == 0
        held &= (values < np.nanmax(values)) & (values > np.nanmin(values))
        for begin, end in true_runs(held & comparison.used):
            if (
                end - begin > longest
                and np.ptp(expected[begin:end]) > noise_effects.SMALLEST_RANGE_V
            ):
                stuck[begin:end, d] = True
    return stuck


def _roughness(comparison: BaselineComparison) -> float:
    """Return the mean square of the residual's steps, V²: wrong instants add to it in motion."""
    return float(np.nanmean(np.diff(comparison.residual_v(comparison.sensor), axis=0) ** 2))


def _check_clock(recording: Recording) -> None:
    """
    Refuse stamps that run backwards, jump, or are too far apart to follow the stage.

    Milliseconds in place of seconds are too far apart.
    """
    time_s, angles_rad = recording.time_s, recording.stage_angles
    steps_s = np.diff(time_s)
    step_s, backward = float(np.median(steps_s)), np.flatnonzero(steps_s <= 0)
    if len(backward):
        raise DataFault(
            'clock_jump',
            f'the stamps run backwards at {time_s[backward[0]]:.6g} s; '
            'record again with a steady clock',
        )
    wide = np.flatnonzero(steps_s > _JUMP_STEPS * step_s)
    if len(wide) and float(steps_s[wide].sum()) > _LARGEST_JUMP_SHARE * float(steps_s.sum()):
        raise DataFault(
            'clock_jump',
            f'the stamps jump by {steps_s[wide].max():.3g} s at '
            f'{time_s[wide[0]]:.6g} s; cut the recording there, and diagnose the '
            'parts together',
        )
    if angles_rad is None or step_s <= _LONGEST_STEP_S:
        return
    range_rad = np.nanmax(angles_rad, axis=0) - np.nanmin(angles_rad, axis=0)
    if np.any(range_rad >= _SMALLEST_MOVE_RAD):
        raise DataFault(
            'unit',
            f'time_s: {step_s:.3g} s between samples while the stage moves, '
            f'at most {_LONGEST_STEP_S:g} s are followed; divide stamps in '
            'milliseconds by 1000',
        )


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


@dataclass(frozen=True)
class _StageReadings:
    """Angles of a stage and outputs of a sensor, which is moved."""

    angles_rad: np.ndarray  # (n, 2)
    measured_g: np.ndarray  # (n, m)

    @classmethod
    def of(cls, recording: Recording, sensor: Sensor) -> _StageReadings | None:
        """Return some readings of a recording; None where the sensor does not move."""
        angles_rad = recording.stage_angles
        if angles_rad is None:
            return None
        measured_g = (recording.volts(sensor) - sensor.zero_g_v) / sensor.scale_v_per_g
        rows = np.flatnonzero(np.isfinite(np.hstack([angles_rad, measured_g])).all(axis=1))
        rows = rows[:: max(1, len(rows) // _SAMPLES)]
        readings = cls(angles_rad[rows], measured_g[rows])
        moves = len(rows) > 1 and readings.variance_g2 >= SMALLEST_MOTION_G**2
        return readings if moves else None

    @property
    def variance_g2(self) -> float:
        """Variance of the output, summed over axes, g²."""
        return float(np.var(self.measured_g, axis=0).sum())

    def force_g(self, factors: Sequence[float]) -> np.ndarray:
        """Return the force at angles times factors, g, (n, m)."""
        alpha_rad, beta_rad = (self.angles_rad * factors).T
        force_g = np.column_stack(specific_force(alpha_rad, beta_rad, 1.0))
        return force_g[:, : self.measured_g.shape[1]]

    def unexplained(self, factors: Sequence[float]) -> float:
        """Return the share of the variance that angles times factors do not explain."""
        left_g2 = np.var(self.measured_g - self.force_g(factors), axis=0).sum()
        return float(left_g2) / self.variance_g2

    def best_factors(self) -> tuple[float, float]:
        """Return the signs, and factors from degrees, that explain most."""
        reached_rad = np.abs(self.angles_rad).max(axis=0)
        # Angles beyond a turn may be in degrees.
        units = [(1.0, np.pi / 180) if rad > 2 * np.pi else (1.0,) for rad in reached_rad]
        tried = [
            (alpha_sign * alpha_unit, beta_sign * beta_unit)
            for (alpha_unit, beta_unit), (alpha_sign, beta_sign) in product(
                product(*units), _SIGNS
            )
        ]
        return min(tried, key=self.unexplained)


def _check_encoder(recording: Recording, sensor: Sensor) -> None:
    """Refuse an angle with the wrong sign, or in degrees."""
    readings = _StageReadings.of(recording, sensor)
    if readings is None:
        return
    factors = readings.best_factors()
    recorded, changed = readings.unexplained((1.0, 1.0)), readings.unexplained(factors)
    if recorded < _WRONG or changed > min(_RIGHT, recorded / 2):
        return
    correlation = f'correlation {np.sqrt(1 - changed):.2f}'
    names = list(JOINTS.values())
    in_degrees = [i for i, factor in enumerate(factors) if abs(factor) != 1]
    if in_degrees:
        reached = np.abs(readings.angles_rad).max(axis=0)
        joined = ' and '.join(names[i] for i in in_degrees)
        raise DataFault(
            'unit',
            f'{joined}: up to {" and ".join(f"{reached[i]:.4g}" for i in in_degrees)}: degrees in '
            f'a column of radians (as degrees it fits the output, {correlation}); multiply '
            f'{joined} by π/180',
        )
    inverted = [name for name, factor in zip(names, factors) if factor < 0]
    mirrored = _mirrored_axes(readings, factors)
    # As many axes as angles may be inverted instead, and their zero-g is then mirrored.
    missing = len(inverted) - len(mirrored)
    if missing > 0 or (not missing and _zero_g_is_mirrored(readings, factors, sensor)):
        return
    joined = ' and '.join(inverted)
    axes = ' and '.join(sensor.axes[d] for d in mirrored)
    raise DataFault(
        'encoder_sign',
        f'{joined}: opposite sign of the encoder ({correlation} with the sign changed); change '
        f'the sign of {joined}, unless the axis {axes} is inverted',
    )


def _mirrored_axes(readings: _StageReadings, factors: Sequence[float]) -> np.ndarray:
    """Return the numbers of the axes whose force changes with the signs of the angles."""
    change_g = readings.force_g(factors) - readings.force_g((1.0, 1.0))
    return np.flatnonzero(np.std(change_g, axis=0) > SMALLEST_MOTION_G)


def _zero_g_is_mirrored(
    readings: _StageReadings, factors: Sequence[float], sensor: Sensor
) -> bool:
    """Determine whether an axis is inverted, not an angle: its zero-g is mirrored, too."""
    axis = _mirrored_axes(readings, factors)[0]
    aged_v = sensor.zero_g_v - sensor.nominal_zero_g_v
    zero_g = float((aged_v / sensor.scale_v_per_g)[axis])
    offset_g = float(np.mean(readings.measured_g - readings.force_g(factors), axis=0)[axis])
    return abs(zero_g) > _AGED_ZERO_G and abs(offset_g + 2 * zero_g) < abs(offset_g)


class CheckedRecording(NamedTuple):
    """A recording that can be diagnosed."""

    comparison: BaselineComparison  # The recording beside the baseline at its full rate
    search_comparison: BaselineComparison  # The same at the rate of the search
    # Noise-like effects that the samples themselves show
    detections: tuple[noise_effects.Detection, ...]
    # Isolated samples; the residual of the best hypothesis must show them, too
    possible_spikes: list[noise_effects.Detection]
    stated: Sensor  # The baseline with the steps of the ADC by the parameter file


def check_recording(comparison: BaselineComparison) -> CheckedRecording:
    """
    Check a recording beside its reference; raise DataFault.

    Where codes of the ADC are coarser than stated, the baseline gets their steps, axis by axis.
    """
    faults, stated = noise_effects.sample_faults(comparison), comparison.sensor
    comparison = replace(comparison, sensor=faults.sensor)
    search_comparison = baseline.at_search_rate(comparison)
    if comparison.pose_known:
        _check_axes(search_comparison)
    else:
        _check_rest(comparison, np.isfinite(comparison.volts).all(axis=1))
    return CheckedRecording(
        comparison,
        search_comparison,
        tuple(faults.detections),
        faults.possible_spikes,
        stated,
    )


def check_length(comparisons: Sequence[BaselineComparison]) -> None:
    """Refuse recordings that are too short together; one at rest may have any length."""
    used_s = sum(c.span_s * float(c.used.mean()) for c in comparisons)
    if used_s < SHORTEST_S and any(c.pose_known for c in comparisons):
        raise DataFault(
            'too_short',
            f'{used_s:.3g} of {sum(c.span_s for c in comparisons):.3g} s '
            'can be compared, which is too short for a verdict; record at '
            'least one minute, or see the note on what is left out',
            'insufficient',
            tuple(comparisons),
        )


def _check_output(comparison: BaselineComparison) -> None:
    """Refuse an output that no sensor has, before any sample is left out."""
    if len(comparison) < _FEWEST_SAMPLES:
        raise DataFault(
            'too_short',
            f'{len(comparison)} samples are too few; a recording needs {_FEWEST_SAMPLES}',
            'insufficient',
        )
    finite, sensor = np.isfinite(comparison.volts).all(axis=1), comparison.sensor
    if finite.mean() < 1 - _LARGEST_MISSING_SHARE:
        raise DataFault(
            'missing',
            f'{100 * (1 - finite.mean()):.0f} % of the samples are not numbers; record again',
        )
    _check_range(comparison, finite)
    # No sensor can output more.
    level_g = (
        np.abs(np.median(comparison.volts[finite], axis=0) - sensor.zero_g_v)
        / sensor.scale_v_per_g
    )
    worst = int(np.argmax(level_g))
    if level_g[worst] >= _LARGEST_LEVEL_G:
        raise DataFault(
            'unit',
            f'{sensor.axes[worst]} is at {level_g[worst]:.3g} g; correct the '
            f'unit of its column, or {option("sensor")}',
        )


def _check_simulator(comparison: BaselineComparison) -> None:
    """Refuse another simulator whose errors no effect of the sensor describes."""
    residual_g = comparison.residual_v(comparison.sensor) / comparison.sensor.scale_v_per_g
    if comparison.simulated_force and np.nanmax(np.abs(residual_g)) < _SMALLEST_GAP_G:
        raise DataFault(
            'reference',
            f'{comparison.simulated_force.name} agrees with the recording to '
            f'{1e6 * _SMALLEST_GAP_G:g} µg in all samples, as no sensor does: it holds the '
            'recording itself',
        )
    factor = reference_checks.wrong_dynamic_factor(comparison)
    if factor is not None:
        raise DataFault('reference', factor)


def _check_range(comparison: BaselineComparison, finite: np.ndarray) -> None:
    """Refuse an axis at the end of its range, or one that does not change as a sensor does."""
    sensor = comparison.sensor
    volts, simulated_v = (v[finite] for v in (comparison.volts, comparison.simulated_v(sensor)))
    lsb_v, range_v = max(sensor.lsb_v, _SMALLEST_STEP_V), np.ptp(volts, axis=0)
    # Coarse codes repeat in an extreme pose, so that the simulation must differ, too.
    step_v = np.maximum(baseline.code_step_v(volts), lsb_v)
    for rail_v in (volts.max(axis=0), volts.min(axis=0)):
        railed = (np.abs(volts - rail_v) < lsb_v / 2) & (np.abs(simulated_v - rail_v) > step_v)
        share = np.where(range_v > noise_effects.SMALLEST_RANGE_V, railed.mean(axis=0), 0.0)
        worst = int(np.argmax(share))
        if share[worst] > _LARGEST_MISSING_SHARE:
            end_mps2 = to_nominal_mps2(rail_v, sensor)[worst]
            raise DataFault(
                'saturated',
                f'{sensor.axes[worst]} is held at {end_mps2:.4g} m/s², the end of its range, for '
                f'{railed[:, worst].sum()} samples ({100 * share[worst]:.0f} %); check supply, '
                'range and wiring',
            )
    expected_v = np.ptp(simulated_v, axis=0)
    # At rest, codes may all be the same where their step exceeds the noise.
    noisy = noise.analog_std_v(sensor) > sensor.lsb_v
    dead = np.where(
        expected_v > noise_effects.SMALLEST_RANGE_V,
        range_v < _DEAD_SHARE * expected_v,
        (range_v < _SMALLEST_STEP_V) & ((range_v > 0) | noisy),
    )
    if dead.any():
        raise DataFault(
            'constant',
            f'{sensor.axes[int(np.argmax(dead))]} does not change with '
            'motion or noise; check its wiring',
        )
    stuck = _stuck(comparison).mean(axis=0)
    if stuck.max() > _LARGEST_MISSING_SHARE:
        raise DataFault(
            'constant',
            f'{sensor.axes[int(np.argmax(stuck))]} does not change for '
            f'{100 * stuck.max():.0f} % of the recording, though the motion does; '
            'check its wiring',
        )


def _check_rest(comparison: BaselineComparison, finite: np.ndarray) -> None:
    """Refuse a sensor that moves although no reference describes the motion."""
    force_g = comparison.volts[finite] / comparison.sensor.scale_v_per_g
    step_g = np.std(np.diff(force_g, axis=0), axis=0)
    range_g = np.subtract(*np.quantile(force_g, _RANGE_QUANTILES[::-1], axis=0))
    worst = int(np.argmax(range_g))
    if range_g[worst] >= _LARGEST_UNEXPLAINED_MOTION_G and step_g[worst] <= range_g[worst]:
        raise DataFault(
            'reference',
            f'{comparison.sensor.axes[worst]} moves by '
            f'{range_g[worst]:.2f} g, but no stage angles that change; give '
            f'alpha_rad and beta_rad, or {option("sim")} with the specific force of the same '
            'manoeuvre',
        )


def _check_delay(simulated_g: np.ndarray, measured_g: np.ndarray, rate_hz: float) -> None:
    """Refuse a sensor that is later or earlier than its reference than a latency explains."""
    found = reference_checks.correlations(simulated_g, measured_g, 2 * len(simulated_g) // 3)
    is_searched = np.abs(found.lags) <= _LARGEST_DELAY_S * rate_hz
    by_lag = np.where(is_searched, found.correlation, -1.0)
    best = int(np.argmax(by_lag))
    delay_s = found.lags[best] / rate_hz
    undelayed = by_lag[found.lags == 0][0]
    is_clear = by_lag[best] > max(_CORRELATED, undelayed + _CORRELATION_GAIN)
    if is_clear and abs(delay_s) > _SEARCHED_DELAY_S:
        raise DataFault(
            'time_misaligned',
            f'the sensor is {abs(delay_s):.2f} s '
            f'{"later" if delay_s > 0 else "earlier"} than the reference, but the '
            f'search covers {_SEARCHED_DELAY_S:g} s; shift its stamps',
        )


def _check_axes(comparison: BaselineComparison) -> None:
    """Compare order, sign, unit and time of the axes with the simulated output."""
    sensor, finite = comparison.sensor, np.isfinite(comparison.volts).all(axis=1)
    simulated_g, measured_g = (
        (v - v[finite].mean(axis=0)) / sensor.scale_v_per_g
        for v in (comparison.simulated_v(sensor), comparison.volts)
    )
    _check_units(comparison, measured_g, finite)
    moving = np.flatnonzero(simulated_g.std(axis=0) > SMALLEST_MOTION_G)
    if not len(moving):
        return
    _check_delay(simulated_g, np.nan_to_num(measured_g), sensor.rate_hz)
    simulated_g, measured_g = simulated_g[finite][:, moving], measured_g[finite][:, moving]
    count, axes = len(moving), [sensor.axes[d] for d in moving]
    with np.errstate(all='ignore'):
        correlation = np.nan_to_num(np.corrcoef(measured_g.T, simulated_g.T)[:count, count:])
    polarity = find_polarity_fault(correlation, list(range(count)), _SWAPPED)
    if polarity is not None:
        raise DataFault(
            'axis_inverted' if polarity.axis == polarity.follows else 'axis_swapped',
            polarity.describe(axes[polarity.axis], axes[polarity.follows]),
        )
    largest = float(np.max(np.abs(correlation)))
    if largest < _UNCORRELATED:
        raise DataFault(
            'reference',
            f'the output does not follow the reference (correlation {largest:.2f}); '
            'check that both belong to one recording, with clocks that differ by less than '
            f'{_LARGEST_DELAY_S:g} s',
        )


def _check_units(
    comparison: BaselineComparison, measured_g: np.ndarray, finite: np.ndarray
) -> None:
    """Compare the size of motion on each axis, g, (n, m), with the ratios of two units."""
    sensor = comparison.sensor
    # In another unit the simulated output may be beyond the rails of the ADC.
    simulated_v = comparison.simulated_v(replace(sensor, adc_bits=0))
    gains: dict[str, float] = {}
    for axis, simulated, measured in zip(
        sensor.axes, (simulated_v / sensor.scale_v_per_g)[finite].T, measured_g[finite].T
    ):
        stds_g = float(simulated.std()), float(measured.std())
        covariance_g2 = float(np.mean((simulated - simulated.mean()) * measured))
        # Only another simulator can be in such a unit that it seems not to move.
        moves_g = max(stds_g) if comparison.simulated_force else stds_g[0]
        if moves_g > SMALLEST_MOTION_G and covariance_g2 > _CORRELATED * stds_g[0] * stds_g[1]:
            gains[axis] = covariance_g2 / max(stds_g[0] ** 2, TINY)
    for ratio, units in _UNIT_RATIOS.items():
        wrong = [axis for axis in gains if abs(np.log(gains[axis] / ratio)) < _UNIT_TOLERANCE]
        if not wrong:
            continue
        are_all = len(wrong) == len(gains)
        which = 'the output' if are_all else f'the output of {listed(wrong, "and")}'
        by_option = ''
        if are_all and comparison.simulated_force:
            by_option = f', by {option("unit")} or {option("sim_unit")}'
        raise DataFault(
            'unit',
            f'{which} is {np.median([gains[axis] for axis in wrong]):.4g} times the simulated '
            f'output, as values in {units} are; correct the unit of the columns{by_option}',
        )
