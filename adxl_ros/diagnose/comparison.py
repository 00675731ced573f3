# SPDX-License-Identifier: Apache-2.0
"""
A recording beside the simulation of its baseline, on the recording's own reference motion.

The force of another simulator may have another clock. A large shift is a fault of the files. A
small one may be the latency of the sensor, which is an effect of the library: it is left alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from os.path import basename

from adxl_ros.files.recording_columns import Recording
from adxl_ros.model import signal_chain
from adxl_ros.model.constants import G0_MPS2, Z_90
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import ActsOn
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.rest_detection import find_rests
from adxl_ros.simulate.motion import INTERNAL_RATE_HZ, Motion, Path
from adxl_ros.simulate.response import ChainMemo, Response
from adxl_ros.simulate.smoothed_paths import ForcePath, PathErrors, SmoothedPath
from adxl_ros.simulate.trajectories import environment_paths, motion_from_references
import numpy as np

SHORTEST_S = 30.0
"""Shortest time, s, that the recordings of a moving sensor last together. Chosen: a few turns of
the stage."""
SMALLEST_MOTION_G = 0.05
"""Standard deviation of the simulated force, g, from which an axis is compared. Chosen: ten times
the noise of an ADXL203."""
SEARCH_RATE_HZ = 125.0
"""The search uses samples at about this rate, Hz. Chosen: it shows motion up to 60 Hz. Samples
are left out, never averaged, so that aliases of faster signals remain."""
SEARCH_SAMPLES = 25_000
"""Largest number of samples of a recording in the search. Chosen: run time and memory. Five
minutes are then searched at 83 Hz; simulated cases have the same verdicts as at 125 Hz."""
_LOWEST_INTERNAL_RATE_HZ = 250.0
"""Lowest internal rate of the simulator where something moves, Hz. Chosen: twice the rate of the
search."""
_MOST_STEPS = 1_000_000
"""Largest number of steps of the simulator where it runs faster than the samples. Chosen: an
hour at 250 Hz."""
_REST_INTERNAL_RATE_HZ = 1e-3
"""Lowest internal rate where nothing moves, Hz. Chosen: so low that the simulator runs at the rate
of the samples."""
_CACHED_VALUES = 3_000_000
"""Number of values of one path that are kept in memory. Chosen: 24 MB."""
_SMALLEST_TURN_RAD = 2e-3
"""A joint that turns by less, rad, does not move. Chosen: above the step of an encoder."""
_SMALLEST_SHIFT_M = 1e-6
"""A stage that shifts by less, m, does not move. Chosen: above the step of an encoder."""
_REST_RATE = 1e-3
"""A joint rests below this rate, rad/s, and the shift below this acceleration, m/s². Chosen: the
specific force then changes by less than the noise within a second."""
SETTLING_S = 0.3
"""A sample rests if no joint moves within this time before it, s. Where another simulator moves
from its first sample on, samples of this time are not used. Chosen: an RC filter of 15 Hz has
settled."""
_LONGEST_S = 1e3
"""Time since the last move where there was none, s. Chosen: beyond any creep."""


@dataclass(frozen=True)
class DataFault:
    """A fault of the recording."""

    name: str  # Name in the report: `verdict.data_fault`
    status: str  # Status of the verdict: 'bad_data' or 'insufficient'
    message: str  # What is wrong and what to do, one line


class Reference(Enum):
    """
    What determines the motion of a recording.

    STAGE: the angles of the stage. SIMULATOR: specific force by another simulator. NONE: the
    sensor never moves, and its pose is unknown.
    """

    STAGE = 'stage'
    SIMULATOR = 'sim'
    NONE = 'rest'


@dataclass(frozen=True)
class BaselineComparison:
    """Samples of one recording, n of m axes, and what the simulator needs to follow it."""

    name: str  # Path of the recording, for people
    time_s: np.ndarray  # Stamps, s, (n,)
    volts: np.ndarray  # Output of the sensor, V, (n, m)
    motion: Motion  # Motion of the reference
    # The baseline: datasheet values and effects of the parameter file, at this sample rate
    sensor: Sensor
    reference: Reference  # What determines the motion
    has_stage_angles: bool  # Whether the recording holds stage angles, even if they never change
    at_rest: np.ndarray  # Samples at which nothing moves, (n,) bool
    # Samples that are used, (n,) bool; the others are missing, repeated or outliers, or their
    # reference is not known
    used: np.ndarray
    # What was corrected or left out before the comparison, one line each, for people
    notes: tuple[str, ...] = ()
    # Frequency above which the reference lacks half of the motion's power, Hz; None where it does
    # not
    fading_hz: float | None = None
    # Signals that simulations of this recording share
    memo: ChainMemo = field(default_factory=ChainMemo, compare=False, repr=False)

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.time_s)

    @property
    def reference_fades(self) -> bool:
        """Whether the reference lacks fast motion."""
        return self.fading_hz is not None

    @property
    def lacking_hz(self) -> float:
        """Frequency above which the reference lacks a part of the motion, Hz."""
        return np.inf if self.fading_hz is None else self.fading_hz / 2

    @property
    def dt_s(self) -> float:
        """Median time between samples, s."""
        return float(np.median(np.diff(self.time_s)))

    @property
    def span_s(self) -> float:
        """Time from the first sample to the last, s."""
        return float(self.time_s[-1] - self.time_s[0])

    @property
    def scale_v_per_mps2(self) -> np.ndarray:
        """Scale factor of the baseline by axis, V/(m/s²), (m,)."""
        return self.sensor.scale_v_per_g / G0_MPS2

    def simulated_v(self, sensor: Sensor) -> np.ndarray:
        """Return the mean output of a sensor in this recording, V, (n, m)."""
        respond = Response(noiseless(sensor), self.motion, 0, float(self.time_s[0]))
        return respond.whole(self.time_s, self.memo)

    def residual_v(self, sensor: Sensor) -> np.ndarray:
        """
        Return the recording minus the mean output of a sensor, V, (n, m).

        Without a reference the pose is unknown, and the mean of the residual is subtracted.
        """
        residual_v = self.volts - self.simulated_v(replace(sensor, rate_hz=self.sensor.rate_hz))
        if self.reference is Reference.NONE:
            return residual_v - np.nanmean(residual_v, axis=0)
        return residual_v

    def simulated_noise_v(self, sensor: Sensor, seed: int) -> np.ndarray:
        """Draw a sensor's output about its own mean, V, (n, m)."""
        at_rate = replace(sensor, rate_hz=self.sensor.rate_hz)
        noisy = Response(at_rate, self.motion, seed, float(self.time_s[0]))(self.time_s)
        return noisy - self.simulated_v(at_rate)


class CachedPath:
    """A path that keeps its newest values, because it is evaluated at the same times often."""

    def __init__(self, path: Path) -> None:
        self._path: Path = path._path if isinstance(path, CachedPath) else path
        self._values: dict[tuple, np.ndarray] = {}

    def __call__(self, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        """Return the derivative of an order at times."""
        if not len(time_s):
            return self._path(time_s, order)
        key = (order, len(time_s), float(time_s[0]), float(time_s[-1]),
               float(time_s[len(time_s) // 2]))
        if key not in self._values:
            self._values[key] = self._path(time_s, order)
            while sum(map(len, self._values.values())) > _CACHED_VALUES \
                    and len(self._values) > 1:
                del self._values[next(iter(self._values))]
        # The entry moves to the end, so that the one that was not used for longest is deleted.
        self._values[key] = self._values.pop(key)
        return self._values[key]

    def errors(self, time_s: np.ndarray) -> PathErrors | None:
        """Return the errors of the path at times, s, (n,); None where it is exact."""
        if isinstance(self._path, SmoothedPath | CachedPath):
            return self._path.errors(time_s)
        return None


def _cached(motion: Motion, reference: Reference) -> Motion:
    """Return the motion with paths that are evaluated once."""
    if reference is Reference.STAGE:
        motion = replace(motion, alpha=CachedPath(motion.alpha), beta=CachedPath(motion.beta),
                         shift=CachedPath(motion.shift))
    return replace(motion, temperature_c=motion.temperature_c and CachedPath(motion.temperature_c),
                   supply_v=motion.supply_v and CachedPath(motion.supply_v))


def noiseless(sensor: Sensor) -> Sensor:
    """Return the sensor without noise and without the steps of its ADC."""
    mean = tuple(e for e in sensor.effects if effect_named(e).acts_on is ActsOn.MEAN)
    # Without an ADC there are no rails, and pseudo-volts may be negative.
    bits = 48 if sensor.adc_bits else 0
    return replace(sensor, noise_density_g_per_rthz=np.zeros(len(sensor.axes)), adc_bits=bits,
                   effects=mean, values={e: sensor.values[e] for e in mean})


def compare(recording: Recording, sensor: Sensor, sim: Motion | None = None
            ) -> BaselineComparison:
    """Put a recording beside the simulator, at the full rate of the recording."""
    sensor = replace(sensor, rate_hz=recording.rate_hz)
    volts = recording.volts(sensor)
    motion, reference = _motion(recording, sensor, volts, sim)
    if reference is not Reference.NONE:
        wanted_hz = max(_LOWEST_INTERNAL_RATE_HZ, sensor.rate_hz)
        motion = replace(motion, internal_rate_hz=min(wanted_hz, INTERNAL_RATE_HZ,
                                                      _highest_rate_hz(recording.time_s)))
    motion, time_s = _cached(motion, reference), recording.time_s
    at_rest = _at_rest(motion, time_s, reference, volts)
    used = np.ones(len(recording), bool)
    if reference is Reference.SIMULATOR:
        used = at_rest | (time_s > time_s[0] + SETTLING_S)
    return BaselineComparison(
        recording.path, time_s, volts, motion, sensor, reference,
        'alpha_rad' in recording.columns, at_rest, used)


def _highest_rate_hz(time_s: np.ndarray) -> float:
    """Return the internal rate at which a recording has the largest number of steps, Hz."""
    return _MOST_STEPS / max(float(time_s[-1] - time_s[0]), 1.0)


def at_search_rate(comparison: BaselineComparison) -> BaselineComparison:
    """Return every k-th sample of a recording, for the search."""
    rate_wanted_hz = min(SEARCH_RATE_HZ, SEARCH_SAMPLES / max(comparison.span_s, 1.0))
    every = max(1, round(comparison.sensor.rate_hz / rate_wanted_hz))
    part, motion = slice(None, None, every), comparison.motion
    if comparison.reference is not Reference.NONE:
        motion = replace(motion, internal_rate_hz=min(_LOWEST_INTERNAL_RATE_HZ,
                                                      _highest_rate_hz(comparison.time_s)))
    return replace(
        comparison, time_s=comparison.time_s[part], volts=comparison.volts[part],
        motion=_cached(motion, comparison.reference),
        sensor=replace(comparison.sensor, rate_hz=comparison.sensor.rate_hz / every),
        at_rest=comparison.at_rest[part], used=comparison.used[part], memo=ChainMemo())


def _motion(recording: Recording, sensor: Sensor, volts: np.ndarray, sim: Motion | None
            ) -> tuple[Motion, Reference]:
    """Return the motion of a recording and what determines it."""
    paths = environment_paths(recording)
    temperature_c, supply_v = paths.get('temperature_c'), paths.get('supply_v')
    if sim is not None:
        return replace(sim, temperature_c=temperature_c,
                       supply_v=supply_v), Reference.SIMULATOR
    if _stage_moves(recording):
        return motion_from_references(recording, sensor), Reference.STAGE
    # The median output stands for the unknown pose.
    force = signal_chain.inverse(sensor)([float(v) for v in np.nanmedian(volts, axis=0)])
    return Motion(float(recording.time_s[-1] - recording.time_s[0]),
                  internal_rate_hz=_REST_INTERNAL_RATE_HZ,
                  temperature_c=temperature_c, supply_v=supply_v,
                  force=lambda time_s: [np.full(len(time_s), f) for f in force]), Reference.NONE


def _stage_moves(recording: Recording) -> bool:
    """Determine whether both angles were sampled and a joint moves."""
    def span(name: str) -> float:
        """Return the range of a column, NaN where it has no samples."""
        values = recording.columns.get(name, np.array([np.nan]))
        return float(np.nanmax(values) - np.nanmin(values)) if np.isfinite(values).any() \
            else np.nan

    alpha_rad, beta_rad, shift_m = span('alpha_rad'), span('beta_rad'), span('shift_m')
    moves = (alpha_rad > _SMALLEST_TURN_RAD or beta_rad > _SMALLEST_TURN_RAD
             or shift_m > _SMALLEST_SHIFT_M)
    return bool(moves and np.isfinite([alpha_rad, beta_rad]).all())


def _at_rest(motion: Motion, time_s: np.ndarray, reference: Reference, volts: np.ndarray
             ) -> np.ndarray:
    """Return which samples rest, (n,) bool."""
    if reference is Reference.NONE:
        return np.ones(len(time_s), bool)
    if reference is Reference.SIMULATOR:
        # The force of another simulator may be noisy, so that the sensor itself shows its rests.
        finite = np.isfinite(volts).all(axis=1)
        rests = find_rests(time_s[finite], volts[finite], 1 / float(np.median(np.diff(time_s))))
        at_rest = np.zeros(len(time_s), bool)
        for rest in rests:
            at_rest |= (time_s >= rest.time_start_s) & (time_s <= rest.time_stop_s)
        return at_rest
    moving = np.zeros(len(time_s), bool)
    for joint in (motion.alpha, motion.beta):
        moving |= np.abs(joint(time_s, 1)) > _REST_RATE
    moving |= np.abs(motion.shift(time_s, 2)) > _REST_RATE
    last_move_s = np.maximum.accumulate(np.where(moving, time_s, -np.inf))
    return time_s - last_move_s > SETTLING_S


def direction_of_last_move(rate_rad_s: np.ndarray) -> np.ndarray:
    """Return the direction of the last move of a joint, −1 or 1, 0 before the first, (n,)."""
    moving = np.abs(rate_rad_s) > _REST_RATE
    last = np.maximum.accumulate(np.where(moving, np.arange(len(rate_rad_s)), -1))
    return np.where(last >= 0, np.sign(rate_rad_s[np.maximum(last, 0)]), 0.0)


def time_since_move_s(time_s: np.ndarray, rates_rad_s: Sequence[np.ndarray]) -> np.ndarray:
    """Return the time since any joint moved."""
    moving = np.any(np.abs(np.array(rates_rad_s)) > _REST_RATE, axis=0)
    last_s = np.maximum.accumulate(np.where(moving, time_s, -np.inf))
    return np.minimum(time_s - last_s, _LONGEST_S)


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
                         f'time: {basename(recording.path)} is from {recording.time_s[0]:.6g} '
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
