# SPDX-License-Identifier: Apache-2.0
"""What is known of the reference: empty cells, too coarse sampling, and fading."""

from __future__ import annotations

from dataclasses import dataclass, replace

from adxl_ros.diagnose.comparison import (
    BaselineComparison,
    Reference,
    SMALLEST_MOTION_G,
)
from adxl_ros.diagnose.noise_effects import code_step_v
from adxl_ros.files.recording_columns import JOINTS, Recording
from adxl_ros.files.reference_alignment import LONGEST_MOVE_NS, USUAL_GAPS
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.block_statistics import true_runs
from adxl_ros.simulate.smoothed_paths import BAND_LIMITED_DEGREE, ForcePath, KNOT_S
import numpy as np
import scipy

LONGEST_BRIDGE_S = LONGEST_MOVE_NS / 1e9
"""Longest time without a reading of a joint, s, that is bridged: as between messages of a bag."""
_SLOWEST_S = 1.0
"""Longest distance of readings, s, that may be the rate of a slow encoder. Chosen: a move."""
LONGEST_SLOW_BRIDGE_S = 10.0
"""The same for temperature and supply. Chosen: a board warms by less than 0.1 K."""
_BEFORE_S, _AFTER_S = 0.1, 0.3
"""Times that are left out beside a gap in which a joint moves, s. Chosen: the spline is uncertain
before it, and an RC filter of 15 Hz has settled after it."""
_FEWEST_CHANGES = 100
"""Fewest changes of a reading that show the step of its encoder. Chosen: two turns by hand."""
_LARGEST_STEP_RAD = 0.02
"""Largest step of an encoder, rad. Chosen: 1°; poses of a table differ by more."""
_COARSER = 1.05
"""Seen step, divided by the stated one, from which it counts. Chosen: 1/12° may be 0.083°."""
_ROUNDING_ERROR = 1e-9
"""Change of a reading, rad or m, that is a rounding error. Chosen: text files have larger ones."""
_SAME_POSE = 1e-4
"""Change of a joint, rad or m, that is the same pose. Chosen: 0.1 mg."""
_LAG_S, _SLOW = 0.02, 3.0
"""Lag of differences, s, and standard deviation of the output, divided by theirs, up to which it
rests. Chosen: an RC filter has forgotten its noise, and motion below 2 Hz exceeds it."""
_WHOLE, _WHOLE_SHARE = 0.2, 0.9
"""Deviation from whole steps, and share of the changes within it, by encoders. Chosen: 40 % of the
changes of exact readings are within it."""
_SAME_STEPS = 2.0
"""Steps of the encoder by which a reading may change over a gap without a move. Chosen: both
readings scatter by one."""
_WINDOW_S = 1.0
"""Length of a window whose spectrum is taken, s. Chosen: shorter than a move."""
_WINDOW_READINGS = 64
"""Fewest readings of a window. Chosen: a shaker then has some periods in it."""
_LARGEST_ERROR = 0.3
"""Error of the force by the spline, divided by the noise, up to which a window is used. Chosen: it
adds 4 % to the noise."""
_ENCODER_SQUARES = 3.0
"""Mean square of what looks like motion by the steps of an encoder, divided by step²/12, that is
accepted. Chosen: the steps are not white in slow motion."""
_SAME_MOTION = 2.0
"""Ratio of the recorded to the simulated motion beside a part that is too coarse, from which it is
an alias. Chosen: an alias below 0.2 of the rate has a ratio of 4."""
_USUAL_QUANTILE = 0.9
"""Quantile of the gaps that stands for the distance of uneven readings. Chosen: single lost ones
do not count."""
_EVEN_READINGS = 0.02
"""Range of the gaps, divided by the usual one, up to which readings are even. Chosen: far above
rounding errors."""
_MOVES = 3.0
"""Motion, divided by the noise, from which an alias is looked for. Chosen: noise alone has 1."""
_ABRUPT = 10.0
"""Fourth difference of a force, divided by its median around, of a jump. Chosen: vibrations and
noise stay below 8."""
_LARGEST_JUMP = 0.03
"""Error of a jump, divided by the noise, up to which it is used. Chosen: a tenth of that of a
window, because the errors of jumps have one sign."""
_AROUND_S = 0.5
"""Time whose fourth differences are usual, s. Chosen: a move is longer."""
_JUMP_DIFFERENCE = 6.0
"""Fourth difference of a jump, divided by the largest error of its time. Chosen: a jump of 1 has a
difference of 3, and half of it may be on the other side of a reading."""
_SETTLED_TAU = 5.0
"""Time constants of the sensor that are left out after a jump. Chosen: 1 % of the error stays."""
_IMAGES = np.arange(-8, 9)
"""Orders of the images of a spline that are summed. Chosen: the rest is below 1e-6."""
_NAMED_PARTS = 4
"""Parts that a note names. Chosen: it stays one or two lines."""
_SPECTRUM_S = 1.0
"""Length of the windows of the spectra, s. Chosen: it separates frequencies of 1 Hz."""
_SHORTEST_WINDOW = 64
"""Fewest samples of a window. Chosen: 33 frequencies."""
_USED = 0.9
"""Share of the samples of a window that are compared. Chosen: jumps of the force take a few."""
_FEWEST_WINDOWS = 20
"""Fewest windows. Chosen: noise then has a coherence of 0.05."""
_QUIET = 0.1
"""Share of the windows, those of the smallest power, that show the noise. Chosen: a recording
begins with a rest of some seconds."""
_BAND = 2
"""Frequencies that are averaged. Chosen: 2 Hz, so that a line of the mains is one value."""
_MOTION = 10.0
"""Power, divided by that of the noise, from which motion shows. Chosen: far above its scatter."""
_COHERENCE = 0.5
"""Coherence from which the recording follows the reference. Chosen: half of the power."""
_GAIN = 1.5
"""Gain of the recording over the reference, beyond that of a missing RC filter, that no sensor
has. Chosen: a third of the motion is then missing."""
_FADED = 0.5
"""Power of the reference, divided by the recorded one, below which it has faded."""


@dataclass(frozen=True)
class LeftOut:
    """Samples that are not used, and why."""

    rows: np.ndarray  # The samples, (n,) bool
    reason: str  # Reason, for people

    def text(self, time_s: np.ndarray) -> str:
        """Return the reason with the times, s, of the samples; `time_s` are those of all."""
        step_s = float(np.median(np.diff(time_s)))
        runs = [(float(time_s[a]), float(time_s[b - 1])) for a, b in true_runs(self.rows)]
        total_s = sum(end - begin + step_s for begin, end in runs)
        longest = sorted(sorted(runs, key=lambda run: run[0] - run[1])[:_NAMED_PARTS])
        parts = ', '.join(f'{begin:.5g} to {end:.5g} s' for begin, end in longest)
        others = f' and {len(runs) - len(longest)} more' if len(runs) > len(longest) else ''
        return f'left out: {total_s:.3g} s ({parts}{others}): {self.reason}'


def without_reading(recording: Recording, comparison: BaselineComparison) -> list[LeftOut]:
    """Find samples in gaps of another simulator, of temperature and of supply."""
    readings = {name: (recording.time_s[np.isfinite(values)], LONGEST_SLOW_BRIDGE_S)
                for name, values in recording.columns.items()
                if name in ('temperature_c', 'supply_v')}
    force = comparison.motion.force
    if comparison.reference is Reference.SIMULATOR and isinstance(force, ForcePath):
        readings['--sim'] = force.time_s, LONGEST_BRIDGE_S
    left_out = []
    for name, (read_s, longest_s) in readings.items():
        if len(read_s) < 2:
            continue
        limit_s = max(longest_s, USUAL_GAPS * float(np.median(np.diff(read_s))))
        after = np.searchsorted(read_s, recording.time_s)
        begins_s, ends_s = (np.concatenate(edges)[after] for edges in (
            ([-np.inf], read_s), (read_s, [np.inf])))
        # Before the first reading and after the last, the ends of the recording count.
        begins_s = np.maximum(begins_s, min(recording.time_s[0], read_s[0]))
        ends_s = np.minimum(ends_s, max(recording.time_s[-1], read_s[-1]))
        unknown = (ends_s - begins_s > limit_s) & (recording.time_s < ends_s)
        margin = (_BEFORE_S, _AFTER_S) if name == '--sim' else (0.0, 0.0)
        if unknown.any():
            for begin, end in true_runs(unknown):
                unknown |= ((recording.time_s > recording.time_s[begin] - margin[0])
                            & (recording.time_s < recording.time_s[end - 1] + margin[1]))
            left_out.append(LeftOut(unknown, f'no reading of {name} for more than '
                                    f'{limit_s:.3g} s'))
    return left_out


def too_coarse(recording: Recording, comparison: BaselineComparison) -> list[LeftOut]:
    """Find samples at which the reference moves faster than its readings show."""
    sensor, time_s, force = comparison.sensor, recording.time_s, comparison.motion.force
    noise_g = float(np.min(noise.analog_std_v(sensor) / sensor.scale_v_per_g))
    limit_g = _LARGEST_ERROR * max(noise_g, float(np.min(sensor.lsb_v / sensor.scale_v_per_g)))
    left_out: list[LeftOut] = []

    def leave_out(name: str, read_s: np.ndarray, error_g: np.ndarray, largest_g: float,
                  advice: str = '') -> None:
        """Add the windows whose error exceeds a limit."""
        coarse = np.interp(time_s, read_s, error_g) > largest_g
        if coarse.any():
            rate_hz = 1 / float(np.median(np.diff(read_s)))
            coarse = _with_aliases(comparison, coarse, noise_g)
            # The motion begins and ends within a window.
            margin = round(_WINDOW_S / 2 * sensor.rate_hz)
            coarse = np.convolve(coarse, np.ones(2 * margin + 1), 'same') > 0.5
            left_out.append(LeftOut(
                coarse, f'{name} moves too fast for its {rate_hz:.4g} readings a second (error '
                f'up to {1e3 * error_g.max():.2g} mg){advice}'))

    if comparison.reference is Reference.SIMULATOR and isinstance(force, ForcePath):
        jumps, jump_g = _jumps(sensor, force, _LARGEST_JUMP * noise_g)
        if jumps.any():
            left_out.append(LeftOut(
                _after_jumps(time_s, sensor, force.time_s, jumps), '--sim jumps between its '
                f'readings (error up to {1e3 * jump_g:.2g} mg); write it at a higher rate'))
        squares = [_spline_error(force.time_s, f / G0_MPS2, 3, 0, 0.0, jumps) ** 2
                   for f in force(force.time_s)[:len(sensor.axes)]]
        leave_out('--sim', force.time_s, np.sqrt(np.max(squares, axis=0)), limit_g,
                  '; write it at a higher rate, and switch off noise that the simulator adds')
    if comparison.reference is Reference.STAGE:
        step_rad = sensor.stage_resolution_rad
        for joint, name in JOINTS.items():
            values = recording.columns.get(name, np.zeros(0))
            sampled = np.isfinite(values)
            if sampled.sum() < 2 or np.ptp(values[sampled]) == 0:
                continue
            sampled, unknown = np.flatnonzero(sampled), ~comparison.used[sampled]
            if joint == 'shift':
                error_g = _spline_error(time_s[sampled], values[sampled] / G0_MPS2,
                                        BAND_LIMITED_DEGREE, 2, 0.0, unknown)
                leave_out(name, time_s[sampled], error_g, limit_g)
            else:
                error_g = _spline_error(time_s[sampled], values[sampled], 5, 0,
                                        KNOT_S if step_rad else 0.0, unknown)
                leave_out(name, time_s[sampled], error_g,
                          np.sqrt(limit_g ** 2 + _ENCODER_SQUARES * step_rad ** 2 / 12))
    return left_out


def _jumps(sensor: Sensor, force: ForcePath, largest_g: float) -> tuple[np.ndarray, float]:
    """Find jumps of a simulator's force, whose exact time is unknown."""
    step_s = float(np.median(np.diff(force.time_s)))
    around = max(round(_AROUND_S / step_s), 2) // 2 * 2 + 1
    # The filter of the sensor averages what is uncertain for a part of a step.
    tau_s = float(np.max(noise.electronics(sensor)[0]))
    error_per_difference = step_s / (step_s + 2 * tau_s) / _JUMP_DIFFERENCE
    jumps, largest = np.zeros(len(force.time_s), bool), 0.0
    for values in force(force.time_s)[:len(sensor.axes)]:
        fourth = np.abs(_fourth_differences(values / G0_MPS2))
        error_g = error_per_difference * fourth
        abrupt = (error_g > largest_g) & (
            fourth > _ABRUPT * scipy.ndimage.median_filter(fourth, around))
        largest = max(largest, float(np.max(error_g[abrupt], initial=0.0)))
        jumps |= scipy.ndimage.binary_dilation(abrupt, iterations=2)
    return jumps, largest


def _after_jumps(time_s: np.ndarray, sensor: Sensor, read_s: np.ndarray, jumps: np.ndarray
                 ) -> np.ndarray:
    """Return which samples, s, (n,), follow jumps among readings, s, (k,), before they settle."""
    settling_s = _SETTLED_TAU * float(np.max(noise.electronics(sensor)[0]))
    rows = np.zeros(len(time_s), bool)
    for begin, end in true_runs(jumps):
        rows |= (time_s >= read_s[begin]) & (time_s <= read_s[end - 1] + settling_s)
    return rows


def _fourth_differences(values: np.ndarray) -> np.ndarray:
    """Return fourth differences around readings, (k,)."""
    return np.diff(values, 4, prepend=values[:2], append=values[-2:])[:len(values)]


def _spline_error(read_s: np.ndarray, values: np.ndarray, degree: int, order: int, knots_s: float,
                  jumps: np.ndarray | None = None) -> np.ndarray:
    """
    Return how much a spline through readings may differ from what was read, by its spectrum.

    A cardinal spline reproduces the frequency ν, in units of the rate, with the gain
    sinc(ν)ⁿ/Σ sinc(ν + k)ⁿ, n = degree + 1. The other terms of the sum are its images.
    """
    gaps_s = np.diff(read_s)
    step_s = float(np.median(gaps_s))
    wide = np.flatnonzero(gaps_s > max(LONGEST_BRIDGE_S, USUAL_GAPS * step_s)) + 1
    spacing = max(knots_s, float(np.quantile(gaps_s, _USUAL_QUANTILE))) / step_s
    left_out = np.zeros(len(values), bool) if jumps is None else jumps
    errors = []
    for times_s, part, ignored in zip(*(np.split(array, wide)
                                        for array in (read_s, values, left_out))):
        if len(part) > 1 and np.ptp(np.diff(times_s)) > _EVEN_READINGS * step_s:
            even_s = np.arange(times_s[0], times_s[-1], step_s)
            even = _windowed_error(scipy.interpolate.CubicSpline(times_s, part)(even_s), step_s,
                                   np.interp(even_s, times_s, ignored) > 0, spacing, degree, order)
            errors.append(np.interp(times_s, even_s, even))
        else:
            errors.append(_windowed_error(part, step_s, ignored, spacing, degree, order))
    return np.concatenate(errors)


def _windowed_error(values: np.ndarray, step_s: float, ignored: np.ndarray, spacing: float,
                    degree: int, order: int) -> np.ndarray:
    """Return the error of a spline in windows of even readings."""
    size = max(round(_WINDOW_S / step_s), _WINDOW_READINGS) // 2 * 2
    if len(values) < size:
        return np.zeros(len(values))
    # Differences keep slow motion from leaking into high frequencies.
    differences = np.where(ignored, 0.0, _fourth_differences(values))
    cycles = np.fft.rfftfreq(size)[1:]
    gain = _error_gain(cycles * spacing, degree, order) \
        * (2 * np.pi * cycles / step_s) ** order / (2 * np.sin(np.pi * cycles)) ** 4
    window = np.hanning(size)
    starts = np.arange(0, len(values) - size + 1, size // 2)
    errors = np.empty(len(starts))
    for i, start in enumerate(starts):
        spectrum = np.abs(np.fft.rfft(differences[start:start + size] * window))[1:]
        errors[i] = np.sqrt(2 * np.sum((gain * spectrum) ** 2) / size / np.sum(window ** 2))
    # A reading counts in all windows that hold it.
    halves = np.concatenate([errors[:1], np.maximum(errors[1:], errors[:-1]), errors[-1:]])
    return halves[np.minimum(np.arange(len(values)) // (size // 2), len(halves) - 1)]


def _error_gain(cycles: np.ndarray, degree: int, order: int) -> np.ndarray:
    """Return the error of a derivative of a cardinal spline, divided by it, (k,)."""
    followed = np.minimum(cycles, 0.5)
    weights = np.sinc(followed + _IMAGES[:, None]) ** (degree + 1)
    weights /= weights.sum(axis=0)
    middle = np.flatnonzero(_IMAGES == 0)[0]
    images = weights * ((followed + _IMAGES[:, None]) / followed) ** order
    lost = 1 - weights[middle]
    images[middle] = 0.0
    error = np.sqrt(lost ** 2 + np.sum(images ** 2, axis=0))
    # Beyond half the rate of the knots nothing is followed.
    return np.where(cycles > 0.5, np.maximum(error, 1.0), error)


def _with_aliases(comparison: BaselineComparison, coarse: np.ndarray, noise_g: float
                  ) -> np.ndarray:
    """Extend samples to the neighbours that move otherwise than the simulator, (n,) bool."""
    sensor = comparison.sensor
    size = max(round(_WINDOW_S * sensor.rate_hz), _WINDOW_READINGS)
    simulated_v = comparison.simulated_v(sensor)
    # Coarse codes jump by themselves.
    scatter_g = np.maximum(noise_g, code_step_v(comparison.volts) / sensor.scale_v_per_g)
    parts = np.array_split(np.arange(len(coarse)), max(len(coarse) // size, 1))
    differs, touched = np.zeros(len(parts), bool), np.zeros(len(parts), bool)
    for i, part in enumerate(parts):
        recorded_g, simulated_g = (np.nanstd(np.diff(v[part], axis=0) / sensor.scale_v_per_g,
                                             axis=0) for v in (comparison.volts, simulated_v))
        touched[i] = coarse[part].any()
        ratio = np.hypot(recorded_g, scatter_g) / np.hypot(simulated_g, scatter_g)
        moves = np.maximum(recorded_g, simulated_g) > _MOVES * scatter_g
        differs[i] = np.any(moves & ((ratio < 1 / _SAME_MOTION) | (ratio > _SAME_MOTION)))
    extended = coarse.copy()
    for begin, end in true_runs(differs | touched):
        if touched[begin:end].any():
            for i in range(begin, end):
                if differs[i]:
                    extended[parts[i]] = True
    return extended


def fading_frequency_hz(comparison: BaselineComparison) -> float | None:
    """Find the frequency above which the reference has less motion than the sensor."""
    if comparison.reference is not Reference.SIMULATOR:
        return None
    sensor = comparison.sensor
    size = max(round(_SPECTRUM_S * sensor.rate_hz), _SHORTEST_WINDOW) // 2 * 2
    recorded_g, simulated_g = (v / sensor.scale_v_per_g for v in (
        comparison.volts, comparison.simulated_v(sensor)))
    is_finite = np.isfinite(recorded_g + simulated_g).all(axis=1)
    starts = [i for i in range(0, len(is_finite) - size + 1, size // 2)
              if is_finite[i:i + size].all() and comparison.used[i:i + size].mean() > _USED]
    if len(starts) < _FEWEST_WINDOWS:
        return None
    rows = np.array(starts)[:, None] + np.arange(size)
    recorded, simulated = (
        np.fft.rfft(scipy.signal.detrend(accel_g[rows], axis=1) * np.hanning(size)[None, :, None],
                    axis=1)
        for accel_g in (recorded_g, simulated_g))
    power = np.sum(np.abs(recorded) ** 2, axis=2)
    quiet = np.argsort(power.sum(axis=1))[:max(round(_QUIET * len(starts)), 2)]
    quiet_power = _bands(power[quiet].mean(axis=0))
    recorded_power = _bands(power.mean(axis=0))
    simulated_power = _bands(np.mean(np.sum(np.abs(simulated) ** 2, axis=2), axis=0))
    shared = np.abs(_bands(np.mean(np.sum(np.conj(simulated) * recorded, axis=2), axis=0)))
    frequency_hz = _bands(np.fft.rfftfreq(size, 1 / sensor.rate_hz))
    # Without its RC filter the sensor has this gain over its simulation.
    rc_s = float(np.max(noise.electronics(sensor)[0]))
    unfiltered = np.sqrt(1 + (2 * np.pi * frequency_hz * rc_s) ** 2)
    moves = recorded_power > _MOTION * quiet_power
    follows = shared ** 2 > _COHERENCE * simulated_power * recorded_power
    exceeds = moves & follows & (shared > _GAIN * unfiltered * simulated_power)
    faded = simulated_power < _FADED * recorded_power
    if not exceeds.any() or not faded[moves & (frequency_hz >= frequency_hz[exceeds][0])].all():
        return None
    followed = np.flatnonzero(moves & ~faded)
    first = followed[-1] + 1 if len(followed) else 0
    return float(frequency_hz[first])


def _bands(values: np.ndarray) -> np.ndarray:
    """Return means of neighbouring frequencies without the lowest one."""
    count = (len(values) - 1) // _BAND
    return values[1:1 + count * _BAND].reshape(count, _BAND).mean(axis=1)


def seen_step_rad(recording: Recording, stated_rad: float) -> float:
    """Return the step that the encoders show, where it exceeds the stated one, rad."""
    largest_rad = stated_rad
    for name in ('alpha_rad', 'beta_rad'):
        changes = np.abs(np.diff(recording.columns.get(name, np.zeros(0))))
        changes = changes[changes > _ROUNDING_ERROR]
        if len(changes) < _FEWEST_CHANGES:
            continue
        # Readings with decimals differ by one step more or less exactly.
        step_rad = float(np.median(changes[changes < 1.5 * changes.min()]))
        few = changes[changes < 4.5 * step_rad]
        steps = np.rint(few / step_rad)
        step_rad = float(few.sum() / steps.sum())
        whole = np.abs(few / step_rad - steps) < _WHOLE
        if len(few) >= _FEWEST_CHANGES and whole.mean() > _WHOLE_SHARE \
                and _COARSER * largest_rad < step_rad < _LARGEST_STEP_RAD:
            largest_rad = step_rad
    return largest_rad


def stated_poses(recording: Recording, sensor: Sensor) -> tuple[Recording, list[LeftOut]]:
    """
    Fill the gaps of the stage's joints, and return what is not known there.

    A pose that is stated before and after a gap, while the output rests, holds in between. In
    other gaps the joint moves smoothly from pose to pose, and the samples are left out.
    """
    time_s, volts = recording.time_s, recording.volts(sensor)
    columns, left_out = dict(recording.columns), []
    lag = max(1, round(_LAG_S * recording.rate_hz))
    for joint, name in JOINTS.items():
        read = np.flatnonzero(np.isfinite(columns.get(name, np.zeros(0))))
        if len(read) < 2:
            continue
        step = 0.0 if joint == 'shift' else sensor.stage_resolution_rad
        values, read_s = columns[name].copy(), time_s[read]
        limit_s = max(LONGEST_BRIDGE_S,
                      min(USUAL_GAPS * float(np.median(np.diff(read_s))), _SLOWEST_S))
        unknown = (time_s < read_s[0]) & (time_s[0] < read_s[0] - limit_s)
        unknown |= (time_s > read_s[-1]) & (time_s[-1] > read_s[-1] + limit_s)
        wide = np.flatnonzero(np.diff(read_s) > LONGEST_BRIDGE_S)
        if len(wide):
            path = scipy.interpolate.PchipInterpolator(read_s, values[read])
        for begin, end in zip(read[wide], read[wide + 1]):
            gap_s, inside = time_s[end] - time_s[begin], slice(begin + 1, end)
            holds = end > begin + 1 and _rests(volts[inside] / sensor.scale_v_per_g, lag) \
                and abs(values[end] - values[begin]) <= _SAME_STEPS * step + _SAME_POSE
            if gap_s <= (LONGEST_BRIDGE_S if holds else limit_s):
                continue
            moved = path(time_s[inside]) - values[begin]
            values[inside] = values[begin] + (np.rint(moved / step) * step if step else moved)
            if not holds:
                unknown |= ((time_s > time_s[begin] - _BEFORE_S)
                            & (time_s < time_s[end] + _AFTER_S))
        columns[name] = values
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
