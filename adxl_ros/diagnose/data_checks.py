# SPDX-License-Identifier: Apache-2.0
"""
What is corrected or left out before a comparison, and faults that make a diagnosis meaningless.

They are stamps, axes, units, clocks, the range, the reference, and missing samples. At rest
f = g·[sin α·cos β, −sin α·sin β, cos α]: a wrong sign of β looks like an inverted y, and one of α
like inverted x and y. The explanation with fewer changes is named.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

from adxl_ros.diagnose.comparison import (
    align_force,
    at_search_rate,
    BaselineComparison,
    compare,
    DataFault,
    Reference,
    SHORTEST_S,
    SMALLEST_MOTION_G,
)
from adxl_ros.diagnose.noise_effects import (
    coarse_codes,
    code_step_v,
    Detection,
    isolated_samples,
    repeated_samples,
)
from adxl_ros.diagnose.reference import (
    fading_frequency_hz,
    LeftOut,
    seen_step_rad,
    stated_poses,
    too_coarse,
    without_reading,
)
from adxl_ros.files.recording_columns import JOINTS, Recording
from adxl_ros.model import noise
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.recorded_sensor import find_polarity_fault
from adxl_ros.simulate.motion import Motion
import numpy as np

_SAME_ROUGHNESS = 1.05
"""Ratio of the steps of two residuals up to which they are equal. Chosen: above its scatter by
noise in a thousand samples."""
_LONGEST_STEP_S = 0.5
"""Longest time between samples, s, that follow a moving stage. Chosen: the motion between two
samples is unknown, and stamps in milliseconds are far beyond."""
_SMALLEST_MOVE_RAD = 0.01
"""Range of an angle, rad, above which the stage moves. Chosen: beyond the jitter of an encoder."""
_ROUNDINGS_S = (0.1, 0.01, 1e-3, 1e-4, 1e-5, 1e-6)
"""Steps that stamps may be rounded to, s, the largest first: decimals of a second."""
_ROUNDING_TOLERANCE = 0.01
"""Deviation from a rounded stamp, in its steps, that is accepted. Chosen: float64 seconds since
1970 deviate by 0.2 µs."""
_EVEN_STAMPS = 1e-4
"""Deviation from a line, in samples, up to which stamps are even. Chosen: the simulator then
needs no interpolation."""
_MENTIONED = 0.01
"""Deviation from a line, in samples, from which the report mentions it. Chosen: below it nothing
shows in the slowest motion."""
_LARGEST_SCATTER = 0.45
"""Largest deviation from a line, in samples, by which a stamp still shows the number of its
sample. Chosen: below one half."""
_LARGEST_BURST = 64.0
"""Largest deviation of stamps in bursts, in samples. Chosen: a buffer of a serial port."""
_BURSTS = 0.5
"""Median step of stamps in bursts, divided by the mean step, is below this. Chosen: a few lost
samples do not change the one, and hardly the other."""
_USUAL_STEPS = 1.5
"""Steps up to this many medians count as one sample. Chosen: halfway to two."""
_EVEN = 'an even rate of {:.6g} Hz explains them: it is used'
_ROUNDS = 3
"""Rounds that number the samples by the line and fit the line. Chosen: numbers then stay."""
_SAMPLES = 4000
"""Largest number of samples that are compared. Chosen: a few for each second."""
_WRONG = 0.2
"""Share of the output's variance that the angles do not explain, from which they may be wrong.
Chosen: it is 0.03 where the sensor is mounted 10° off."""
_RIGHT = 0.1
"""The same share up to which changed angles explain the output. Chosen: half of `_WRONG`."""
_AGED_ZERO_G = 0.01
"""Zero-g, g, from which its sign tells an inverted axis from a wrong angle. Chosen: that of a
healthy unit ages by less."""
_TURN = 2 * np.pi
"""Largest angle, rad, that is not looked at as one in degrees."""
_FEWEST_SAMPLES = 50
"""Fewest samples of any recording. Chosen: one for each of 48 blocks."""
_LARGEST_UNEXPLAINED_MOTION_G = 0.3
"""Range of the output, g, that drift and noise cannot explain without a reference. Chosen: 17°
of tilt."""
_RANGE_QUANTILES = (0.02, 0.98)
"""Quantiles of the output between which that range lies. Chosen: they ignore outliers."""
_CORRELATED = 0.9
"""Correlation from which two signals are the same one. Chosen: noise of half the signal."""
_SWAPPED_CORRELATION = 0.7
"""An axis is swapped only if its correlation with its own reference is smaller. Chosen: halfway
between two signals that are the same and two that have nothing in common."""
_UNCORRELATED = 0.5
"""Correlation below which the output does not follow the reference. Chosen: noise of 1.7
times the signal."""
_LARGEST_MISSING_SHARE = 0.3
"""Share of samples that may be missing, or at the end of the range. Chosen: the rest still
shows the effects."""
_SEARCHED_DELAY_S = 1.0
"""Largest delay that the effect of a time offset models, s: its upper bound."""
_LARGEST_DELAY_S = 30.0
"""Largest delay that is looked for, s. Chosen: a recording started by hand."""
_CORRELATION_GAIN = 0.05
"""Correlation that a delay must gain to be a fault. Chosen: above its error by noise."""
_JUMP_STEPS = 20.0
"""A step of the stamps of this many usual steps is a jump. Chosen: lost samples make
shorter gaps."""
_LARGEST_JUMP_SHARE = 0.2
"""Share of the recording that jumps of the stamps may have. Chosen: gaps of a lossy
link are no fault of the clock."""
_COARSE_CODES = 3.0
"""Distance of codes, in stated steps, from which they are coarse. Chosen: noise moves finer ones.
"""
_RAIL_SHARE = 0.05
"""Share of the samples at one extreme value from which it is the end of the range.
Chosen: a sensor at rest has an extreme value seldom."""
_SMALLEST_RANGE_V = 0.05
"""Range of the output, V, below which an extreme value is not the end of the range.
Chosen: 50 mg, a sensor that hardly moves."""
_SMALLEST_STEP_V = 1e-9
"""Step of an ADC, V, that stands for none. Chosen: above rounding errors."""
_SMALLEST_NORM = 1e-12
"""Smallest product of the norms of two signals: it keeps the divisor from 0."""
_DEAD_SHARE = 1e-4
"""Share of its simulated range that a wired axis covers. Chosen: below that of any wrong unit."""
_LARGEST_LEVEL_G = 1e3
"""Largest median output, g. Chosen: above that of any sensor on a stage."""
_UNIT_TOLERANCE = 0.1
"""Relative deviation of a gain from the ratio of two units. Chosen: above any scale error."""
_UNIT_RATIOS = {
    9.80665: 'm/s² instead of g',
    1e3: 'mV instead of V',
    1e-3: 'kV instead of V',
    1 / 9.80665: 'g instead of m/s²',
}
"""Gain of an output in the wrong unit, and which unit it has instead of which."""


def compare_checked(recording: Recording, sensor: Sensor, sim: Motion | None, may_shift: bool
                    ) -> BaselineComparison | DataFault:
    """Put a recording beside the simulator, without the parts that have no reference."""
    notes: list[str] = []
    even = even_stamps(recording.time_s)
    if even is not None and even.certain:
        recording = replace(recording, time_s=even.time_s)
        notes += [even.note] if even.note else []
    fault = find_clock_fault(recording.time_s) or _too_slow(recording)
    if fault is None and sim is None:
        fault = find_encoder_fault(recording, sensor)
    if fault is not None:
        return fault
    if sim is not None:
        aligned = align_force(recording, sensor, sim, may_shift)
        if isinstance(aligned, DataFault):
            return aligned
        recording, sim = aligned.recording, aligned.sim
        notes += aligned.notes
    left_out: list[LeftOut] = []
    if sim is None:
        step_rad = seen_step_rad(recording, sensor.stage_resolution_rad)
        if step_rad > sensor.stage_resolution_rad:
            notes.append(f'the stage reads in steps of {np.degrees(step_rad):.3g}°, not of '
                         f'{np.degrees(sensor.stage_resolution_rad):.3g}° as stated: this is used')
            sensor = replace(sensor, stage_resolution_rad=step_rad)
        recording, left_out = stated_poses(recording, sensor)
    comparison = compare(recording, sensor, sim)
    if even is not None and not even.certain and len(even.time_s) == len(recording):
        evenly = replace(recording, time_s=even.time_s)
        even_comparison = compare(evenly, sensor, sim)
        if _roughness(even_comparison) < _SAME_ROUGHNESS * _roughness(comparison):
            recording, comparison = evenly, even_comparison
            notes += [even.note] if even.note else []
    stated = left_out if comparison.reference is Reference.STAGE else []
    left_out = [*stated, *without_reading(recording, comparison)]
    # What moves too fast is looked for where the reference is stated.
    for found in (left_out, too_coarse(recording, _without(comparison, left_out))):
        comparison = _without(comparison, found)
        notes += [part.text(recording.time_s) for part in found]
    fading_hz = fading_frequency_hz(comparison)
    if fading_hz is not None:
        notes.append(f'--sim is smoother than the sensor: above {fading_hz:.3g} Hz it lacks '
                     'motion that the recording has; effects that show in fast motion are not '
                     'named')
    return replace(comparison, notes=tuple(notes), fading_hz=fading_hz)


def _roughness(comparison: BaselineComparison) -> float:
    """Return the mean square of the residual's steps, V²: wrong instants add to it in motion."""
    return float(np.nanmean(np.diff(comparison.residual_v(comparison.sensor), axis=0) ** 2))


def _too_slow(recording: Recording) -> DataFault | None:
    """Find stamps that are too far apart to follow the stage, as milliseconds in place of s."""
    step_s = float(np.median(np.diff(recording.time_s)))
    angles = [recording.columns[name] for name in ('alpha_rad', 'beta_rad')
              if name in recording.columns]
    moves = any(np.nanmax(angle) - np.nanmin(angle) > _SMALLEST_MOVE_RAD for angle in angles
                if np.isfinite(angle).any())
    if not moves or step_s <= _LONGEST_STEP_S:
        return None
    return DataFault('unit', 'bad_data', f'time_s: {step_s:.3g} s between samples while the stage '
                     f'moves, at most {_LONGEST_STEP_S:g} s are followed; divide stamps in '
                     'milliseconds by 1000')


@dataclass(frozen=True)
class EvenStamps:
    """The instants of samples that were taken evenly."""

    time_s: np.ndarray  # The instants, s, (n,)
    # Whether rounding or bursts explain all deviations; otherwise the samples themselves may have
    # been taken unevenly
    certain: bool
    note: str  # What was changed, for people; empty where it does not matter


def even_stamps(stamps_s: np.ndarray) -> EvenStamps | None:
    """Find the even instants behind stamps."""
    steps_s = np.diff(stamps_s)
    if len(steps_s) < 2 or steps_s.min() <= 0:
        return None
    if np.median(steps_s) < _BURSTS * steps_s.mean():
        return _from_bursts(stamps_s)
    # Stamps that scatter by more than their steps look like lost samples.
    time_s, slope_s, largest = min(
        (_line(stamps_s, number) for number in (np.arange(len(stamps_s)),
                                                _numbers(stamps_s, steps_s))),
        key=lambda line: line[2])
    if largest < _EVEN_STAMPS or largest > _LARGEST_SCATTER:
        return None
    rounding_s = _rounding_s(stamps_s)
    if largest * slope_s < (0.5 + _ROUNDING_TOLERANCE) * rounding_s:
        note = f'stamps are rounded to {rounding_s:g} s, and {_EVEN.format(1 / slope_s)}'
        return EvenStamps(time_s, True, note if largest > _MENTIONED else '')
    note = (f'stamps scatter by up to {1e3 * largest * slope_s:.3g} ms, and '
            f'{_EVEN.format(1 / slope_s)}')
    return EvenStamps(time_s, False, note if largest > _MENTIONED else '')


def _line(stamps_s: np.ndarray, number: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Return stamps on a line over their numbers, s, its slope, s, and the largest deviation."""
    slope_s, begin_s = np.polyfit(number, stamps_s - stamps_s[0], 1)
    time_s = stamps_s[0] + begin_s + slope_s * number
    return time_s, float(slope_s), float(np.abs(stamps_s - time_s).max() / slope_s)


def _numbers(stamps_s: np.ndarray, steps_s: np.ndarray) -> np.ndarray:
    """Return the number of each sample, counting missing ones, (n,)."""
    step_s = float(np.mean(steps_s[steps_s < _USUAL_STEPS * np.median(steps_s)]))
    number = np.concatenate([[0.0], np.cumsum(np.maximum(np.rint(steps_s / step_s), 1.0))])
    for _ in range(_ROUNDS):
        slope_s, begin_s = np.polyfit(number, stamps_s - stamps_s[0], 1)
        again = np.rint((stamps_s - stamps_s[0] - begin_s) / slope_s)
        if np.diff(again).min() < 1:
            break
        number = again
    return number


def _rounding_s(stamps_s: np.ndarray) -> float:
    """Return the decimal of a second that all stamps are rounded to, s; 0 for none."""
    for rounding_s in _ROUNDINGS_S:
        steps = stamps_s / rounding_s
        if np.abs(steps - np.rint(steps)).max() < _ROUNDING_TOLERANCE:
            return rounding_s
    return 0.0


def _from_bursts(stamps_s: np.ndarray) -> EvenStamps | None:
    """Return the instants of samples whose stamps come in bursts; None where samples are lost."""
    time_s, slope_s, largest = _line(stamps_s, np.arange(len(stamps_s)))
    if largest > _LARGEST_BURST:
        return None
    return EvenStamps(time_s, True, f'stamps come in bursts, and {_EVEN.format(1 / slope_s)}')


def find_encoder_fault(recording: Recording, sensor: Sensor) -> DataFault | None:
    """Find an angle with the wrong sign, or in degrees."""
    angles_rad = recording.stage_angles
    if angles_rad is None:
        return None
    volts = recording.volts(sensor)
    rows = np.flatnonzero(np.isfinite(angles_rad).all(axis=1) & np.isfinite(volts).all(axis=1))
    if len(rows) < 2:
        return None
    rows = rows[::max(1, len(rows) // _SAMPLES)]
    angles_rad, volts = angles_rad[rows], volts[rows]
    measured_g = (volts - sensor.zero_g_v) / sensor.scale_v_per_g
    variance = float(np.sum(np.var(measured_g, axis=0)))
    if variance < SMALLEST_MOTION_G ** 2:
        return None

    def unexplained(factors: tuple[float, float]) -> float:
        """Return the share of the variance that angles times factors do not explain."""
        force_g = _force_g(angles_rad * factors, len(sensor.axes))
        return float(np.sum(np.var(measured_g - force_g, axis=0))) / variance

    recorded = unexplained((1.0, 1.0))
    if recorded < _WRONG:
        return None
    factors = min(_factors(angles_rad), key=unexplained)
    if unexplained(factors) > min(_RIGHT, recorded / 2):
        return None
    correlation = np.sqrt(1 - unexplained(factors))
    return (_angle_unit_fault(recording, rows, angles_rad, factors, correlation)
            or _sign_fault(angles_rad, measured_g, sensor, factors, correlation))


def _force_g(angles_rad: np.ndarray, axes: int) -> np.ndarray:
    """Return the specific force at rest, g, (n, m)."""
    return np.column_stack(specific_force(angles_rad[:, 0], angles_rad[:, 1], 1.0)[:axes])


def _factors(angles_rad: np.ndarray) -> Iterator[tuple[float, float]]:
    """Yield what alpha and beta may have to be multiplied by, the fewest changes first."""
    in_degrees = np.nanmax(np.abs(angles_rad), axis=0) > _TURN
    units = product(*([1.0, np.pi / 180] if large else [1.0] for large in in_degrees))
    for alpha_unit, beta_unit in units:
        for alpha_sign, beta_sign in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            yield alpha_sign * alpha_unit, beta_sign * beta_unit


def _angle_unit_fault(recording: Recording, rows: np.ndarray, angles_rad: np.ndarray,
                      factors: tuple[float, float], correlation: float) -> DataFault | None:
    """Name the columns in degrees."""
    names = [JOINTS[joint] for joint, factor in zip(('alpha', 'beta'), factors)
             if abs(factor) != 1]
    if not names:
        return None
    largest = {name: int(np.argmax(np.abs(recording.columns[name][rows]))) for name in names}
    reached = ' and '.join(
        f'{name} is {recording.columns[name][rows[i]]:.4g} at {recording.time_s[rows[i]]:.4g} s'
        for name, i in largest.items())
    return DataFault('unit', 'bad_data', f'{reached}: degrees in a column of radians (as degrees '
                     f'it fits the output, correlation {correlation:.2f}); multiply '
                     f'{" and ".join(names)} by π/180')


def _sign_fault(angles_rad: np.ndarray, measured_g: np.ndarray, sensor: Sensor,
                factors: tuple[float, float], correlation: float) -> DataFault | None:
    """Name the encoders that count in the opposite direction; None where an axis is simpler."""
    joints = [JOINTS[joint] for joint, factor in zip(('alpha', 'beta'), factors) if factor < 0]
    recorded_g, turned_g = (_force_g(angles_rad * f, len(sensor.axes)) for f in (1.0, factors))
    mirrored = np.flatnonzero(np.std(turned_g - recorded_g, axis=0) > SMALLEST_MOTION_G)
    if len(mirrored) < len(joints):
        return None
    axes = ' and '.join(sensor.axes[d] for d in mirrored)
    rival = f'the sensor is mounted half a turn about z, with {axes} mirrored'
    if len(mirrored) == len(joints):
        d = int(mirrored[0])
        if _zero_g_is_mirrored(float(np.mean(measured_g[:, d] - turned_g[:, d])), d, sensor):
            return None
        rival = f'the axis {axes} is inverted'
    names = ' and '.join(joints)
    return DataFault('encoder_sign', 'bad_data', f'{names}: opposite sign of the encoder '
                     f'(correlation {correlation:.2f} with the sign changed); change the sign of '
                     f'{names}, unless {rival}')


def _zero_g_is_mirrored(offset_g: float, axis: int, sensor: Sensor) -> bool:
    """Determine whether the zero-g of an axis is mirrored, as that of an inverted axis is."""
    zero_g = float((sensor.zero_g_v - sensor.nominal_zero_g_v)[axis] / sensor.scale_v_per_g[axis])
    return abs(zero_g) > _AGED_ZERO_G and abs(offset_g + 2 * zero_g) < abs(offset_g)


@dataclass(frozen=True)
class CheckedRecording:
    """A recording that can be diagnosed."""

    comparison: BaselineComparison  # The recording beside the baseline at its full rate
    search_comparison: BaselineComparison  # The same at the rate of the search
    detections: tuple[Detection, ...]  # Noise-like effects that the samples themselves show
    # Isolated samples; the residual of the best hypothesis must show them, too
    possible_spikes: Detection | None


def check_recording(comparison: BaselineComparison) -> CheckedRecording | DataFault:
    """
    Check a recording, and mark the samples that are not used.

    Where the codes of the ADC are coarser than stated, the baseline gets their true number of
    bits.
    """
    search_comparison = at_search_rate(comparison)
    fault = find_data_fault(comparison, search_comparison)
    if fault is not None:
        return fault
    detections: list[Detection] = []
    coarse = coarse_codes(comparison.volts, comparison.sensor)
    if coarse is not None:
        detections.append(coarse)
        bits = round(comparison.sensor.adc_bits - float(coarse.values['lost_bits']))
        comparison, search_comparison = (
            replace(c, sensor=replace(c.sensor, adc_bits=bits))
            for c in (comparison, search_comparison))
    used = comparison.used & np.isfinite(comparison.volts).all(axis=1)
    # Coarse codes repeat by themselves.
    if coarse is None:
        used, repeated = repeated_samples(comparison.volts, comparison.time_s, used,
                                          comparison.sensor)
        detections += repeated
    used, spikes = isolated_samples(comparison.volts, comparison.time_s, used, comparison.sensor)
    every = round(comparison.sensor.rate_hz / search_comparison.sensor.rate_hz)
    return CheckedRecording(replace(comparison, used=used),
                            replace(search_comparison, used=used[::every]),
                            tuple(detections), spikes)


def find_length_fault(comparisons: Sequence[BaselineComparison]) -> DataFault | None:
    """Find recordings that are too short together; one at rest may have any length."""
    span_s = sum(c.span_s for c in comparisons)
    used_s = sum(c.span_s * float(c.used.mean()) for c in comparisons)
    if used_s >= SHORTEST_S or all(c.reference is Reference.NONE for c in comparisons):
        return None
    if span_s < SHORTEST_S:
        return DataFault('too_short', 'insufficient', f'{span_s:.3g} s in all are too short for '
                         'a verdict; record at least one minute')
    return DataFault('too_short', 'insufficient', f'{used_s:.3g} of {span_s:.3g} s have a usable '
                     'reference, which is too short for a verdict; the note says why')


def find_data_fault(comparison: BaselineComparison, search_comparison: BaselineComparison
                    ) -> DataFault | None:
    """Find what makes a diagnosis of effects meaningless."""
    if len(comparison) < _FEWEST_SAMPLES:
        return DataFault('too_short', 'insufficient', f'{len(comparison)} samples are too few; '
                         f'a recording needs {_FEWEST_SAMPLES}')
    finite = np.isfinite(comparison.volts).all(axis=1)
    if finite.mean() < 1 - _LARGEST_MISSING_SHARE:
        return DataFault('missing', 'bad_data', f'{100 * (1 - finite.mean()):.0f} % of the '
                         'samples are not numbers; record again')
    clock = find_clock_fault(comparison.time_s)
    if clock is not None:
        return clock
    railed = _share_at_rail(comparison, finite)
    if railed > _LARGEST_MISSING_SHARE:
        return DataFault('saturated', 'bad_data', f'{100 * railed:.0f} % of the samples are at '
                         'the end of the range; check supply, range and wiring')
    return (_constant_fault(comparison, finite)
            or (_unexplained_motion(comparison, finite) if comparison.reference is Reference.NONE
                else _axis_fault(search_comparison))
            or _level_fault(comparison, finite))


def _constant_fault(comparison: BaselineComparison, finite: np.ndarray) -> DataFault | None:
    """Find an axis that does not change as a sensor does."""
    range_v = np.ptp(comparison.volts[finite], axis=0)
    expected_v = np.ptp(comparison.simulated_v(comparison.sensor)[finite], axis=0)
    # At rest, codes may all be the same where their step exceeds the noise.
    noisy = noise.analog_std_v(comparison.sensor) > comparison.sensor.lsb_v
    dead = np.where(expected_v > _SMALLEST_RANGE_V, range_v < _DEAD_SHARE * expected_v,
                    (range_v < _SMALLEST_STEP_V) & ((range_v > 0) | noisy))
    if not dead.any():
        return None
    return DataFault('constant', 'bad_data', f'{comparison.sensor.axes[int(np.argmax(dead))]} '
                     'does not change with motion or noise; check its wiring')


def _level_fault(comparison: BaselineComparison, finite: np.ndarray) -> DataFault | None:
    """Find an axis that no sensor can output."""
    sensor = comparison.sensor
    level_g = np.abs(np.median(comparison.volts[finite], axis=0) - sensor.zero_g_v) \
        / sensor.scale_v_per_g
    worst = int(np.argmax(level_g))
    if level_g[worst] < _LARGEST_LEVEL_G:
        return None
    return DataFault('unit', 'bad_data', f'{sensor.axes[worst]} is at {level_g[worst]:.3g} g; '
                     'correct the unit of its column, or --params')


def _unexplained_motion(comparison: BaselineComparison, finite: np.ndarray) -> DataFault | None:
    """Find a sensor that moves although no reference describes the motion."""
    force_g = comparison.volts[finite] / comparison.sensor.scale_v_per_g
    step_g = np.std(np.diff(force_g, axis=0), axis=0)
    low_g, high_g = np.quantile(force_g, _RANGE_QUANTILES, axis=0)
    range_g = high_g - low_g
    worst = int(np.argmax(range_g))
    if range_g[worst] < _LARGEST_UNEXPLAINED_MOTION_G or step_g[worst] > range_g[worst]:
        return None
    angles = 'its stage angles do not change' if comparison.has_stage_angles else \
        'it has no stage angles'
    return DataFault('reference', 'bad_data', f'{comparison.sensor.axes[worst]} moves by '
                     f'{range_g[worst]:.2f} g, but {angles}; give the angles, or --sim with the '
                     'specific force of the same manoeuvre')


def find_clock_fault(time_s: np.ndarray) -> DataFault | None:
    """Find stamps that run backwards or jump."""
    steps_s = np.diff(time_s)
    backward = np.flatnonzero(steps_s <= 0)
    if len(backward):
        return DataFault('clock_jump', 'bad_data', 'the stamps run backwards at '
                         f'{time_s[backward[0]]:.6g} s; record again with a steady clock')
    wide = np.flatnonzero(steps_s > _JUMP_STEPS * float(np.median(steps_s)))
    if len(wide) and float(steps_s[wide].sum()) > _LARGEST_JUMP_SHARE * float(steps_s.sum()):
        return DataFault('clock_jump', 'bad_data', f'the stamps jump by '
                         f'{steps_s[wide].max():.3g} s at {time_s[wide[0]]:.6g} s; cut the '
                         'recording there, and diagnose the parts together')
    return None


def _share_at_rail(comparison: BaselineComparison, finite: np.ndarray) -> float:
    """
    Return the largest share of an axis's samples at an extreme value; 0 below `_RAIL_SHARE`.

    Coarse codes repeat in an extreme pose, so that the simulation must then differ by a step.
    """
    largest, lsb_v = 0.0, max(comparison.sensor.lsb_v, _SMALLEST_STEP_V)
    volts, simulated_v = (v[finite] for v in (comparison.volts,
                                              comparison.simulated_v(comparison.sensor)))
    for axis_v, expected_v, step_v in zip(volts.T, simulated_v.T, code_step_v(volts)):
        for rail_v in (axis_v.max(), axis_v.min()):
            at_rail = np.abs(axis_v - rail_v) < lsb_v / 2
            if step_v > _COARSE_CODES * lsb_v:
                at_rail &= np.abs(expected_v - rail_v) > step_v
            share = float(np.mean(at_rail))
            if share > _RAIL_SHARE and np.ptp(axis_v) > _SMALLEST_RANGE_V:
                largest = max(largest, share)
    return largest


def _axis_fault(comparison: BaselineComparison) -> DataFault | None:
    """Compare order, sign, unit and time of the axes with the simulated output."""
    sensor = comparison.sensor
    finite = np.isfinite(comparison.volts).all(axis=1)
    simulated_v = comparison.simulated_v(sensor)
    simulated_g = (simulated_v - simulated_v.mean(axis=0)) / sensor.scale_v_per_g
    measured_g = (comparison.volts - comparison.volts[finite].mean(axis=0)) \
        / sensor.scale_v_per_g
    moving = np.flatnonzero(simulated_g.std(axis=0) > SMALLEST_MOTION_G)
    if not len(moving):
        return None
    delay = _delay_fault(simulated_g, np.where(finite[:, None], measured_g, 0.0), sensor.rate_hz)
    if delay is not None:
        return delay
    simulated_g, measured_g = simulated_g[finite][:, moving], measured_g[finite][:, moving]
    correlation = np.empty((len(moving), len(moving)))
    for i, measured in enumerate(measured_g.T):
        correlation[i] = [_correlation(measured, simulated) for simulated in simulated_g.T]
    axes = [sensor.axes[d] for d in moving]
    fault = _order_fault(axes, correlation) or _unit_fault(simulated_g, measured_g,
                                                           np.diag(correlation))
    largest = float(np.max(np.abs(correlation)))
    if fault is not None or largest >= _UNCORRELATED:
        return fault
    return DataFault('reference', 'bad_data', 'the output does not follow the reference '
                     f'(correlation {largest:.2f}); check that both belong to one recording, '
                     f'with clocks that differ by less than {_LARGEST_DELAY_S:g} s')


def _order_fault(axes: list[str], correlation: np.ndarray) -> DataFault | None:
    """Find an inverted or swapped axis; rows of the correlation are measured axes."""
    fault = find_polarity_fault(correlation, list(range(len(axes))), _SWAPPED_CORRELATION)
    if fault is None:
        return None
    return DataFault('axis_inverted' if fault.axis == fault.follows else 'axis_swapped',
                     'bad_data', fault.describe(axes[fault.axis], axes[fault.follows]))


def _unit_fault(simulated_g: np.ndarray, measured_g: np.ndarray, correlation: np.ndarray
                ) -> DataFault | None:
    """Find an output in the wrong unit, by its gain; the arguments are of the moving axes."""
    gains = [float(np.polyfit(simulated_g[:, d], measured_g[:, d], 1)[0])
             for d in np.flatnonzero(correlation > _CORRELATED)]
    if not gains:
        return None
    gain = np.median(gains)
    for ratio, units in _UNIT_RATIOS.items():
        if abs(np.log(gain / ratio)) < _UNIT_TOLERANCE:
            return DataFault('unit', 'bad_data', f'the output is {gain:.4g} times the simulated '
                             f'output, as values in {units} are; correct the unit of the columns')
    return None


def _delay_fault(simulated_g: np.ndarray, measured_g: np.ndarray, rate_hz: float
                 ) -> DataFault | None:
    """Find a delay beyond the range of the search, by the cross-correlation of each axis."""
    largest_lag = min(round(_LARGEST_DELAY_S * rate_hz), len(simulated_g) // 3)
    best, best_lag, undelayed = 0.0, 0, 0.0
    for simulated, measured in zip(simulated_g.T, measured_g.T):
        # Twice the length, so that the circular correlation has no overlap.
        size = 2 ** int(np.ceil(np.log2(2 * len(simulated))))
        products = np.fft.irfft(np.fft.rfft(measured, size)
                                * np.conj(np.fft.rfft(simulated, size)), size)
        norm = np.sqrt(np.sum(simulated * simulated) * np.sum(measured * measured)) \
            + _SMALLEST_NORM
        lags = np.concatenate([products[-largest_lag:], products[:largest_lag + 1]]) / norm
        if lags.max() > best:
            best, best_lag = float(lags.max()), int(np.argmax(lags)) - largest_lag
            undelayed = float(products[0] / norm)
    delay_s = best_lag / rate_hz
    if best > _CORRELATED and best - undelayed > _CORRELATION_GAIN \
            and abs(delay_s) > _SEARCHED_DELAY_S:
        return DataFault('time_misaligned', 'bad_data', f'the sensor is {abs(delay_s):.2f} s '
                         f'{"later" if delay_s > 0 else "earlier"} than the reference, but the '
                         f'search covers {_SEARCHED_DELAY_S:g} s; shift its stamps')
    return None


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Return the correlation of two signals, 0 where one is constant."""
    with np.errstate(all='ignore'):
        return float(np.nan_to_num(np.corrcoef(a, b)[0, 1]))


def _without(comparison: BaselineComparison, left_out: Sequence[LeftOut]) -> BaselineComparison:
    """Return a comparison that does not use some samples."""
    rows = np.logical_or.reduce([~comparison.used, *(part.rows for part in left_out)])
    return replace(comparison, used=~rows)
