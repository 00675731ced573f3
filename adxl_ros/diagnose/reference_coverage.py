# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
Samples whose reference is not known: empty cells, and motion that is sampled too coarsely.

A spline follows the readings of a joint, or the force of another simulator. Between readings that
are far apart, and near half their rate, it is not the motion.
"""

from __future__ import annotations

from dataclasses import dataclass

from adxl_ros.diagnose.baseline_comparison import BaselineComparison, Reference
from adxl_ros.diagnose.noise_detectors import code_step_v
from adxl_ros.files.recording_columns import JOINTS, Recording
from adxl_ros.files.reference_alignment import LONGEST_MOVE_NS, USUAL_GAPS
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.runs import true_runs
from adxl_ros.simulate.smoothed_paths import BAND_LIMITED_DEGREE, ForcePath, KNOT_S
import numpy as np
import scipy

LONGEST_BRIDGE_S = LONGEST_MOVE_NS / 1e9
"""Longest time without a reading of a joint, s, that is bridged: as between messages of a bag."""
LONGEST_SLOW_BRIDGE_S = 10.0
"""The same for temperature and supply. Chosen: a board warms by less than 0.1 K."""
_BEFORE_S, _AFTER_S = 0.1, 0.3
"""Times that are left out beside a gap in which a joint moves, s. Chosen: the spline is uncertain
before it, and an RC filter of 15 Hz has settled after it."""
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
_EVEN = 0.02
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


@dataclass(frozen=True)
class LeftOut:
    """
    Samples that are not used, and why.

    Attributes
    ----------
    rows
        The samples, (n,) bool.
    reason
        Reason, for people.

    """

    rows: np.ndarray
    reason: str

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
    """
    Find samples in gaps of the reference that are too long to be bridged.

    Parameters
    ----------
    recording
        The recording.
    comparison
        The same beside the simulator.

    Returns
    -------
    list
        What is left out, one entry for each column.

    """
    left_out: list[LeftOut] = []
    time_s, force = recording.time_s, comparison.motion.force
    if comparison.reference is Reference.SIMULATOR and isinstance(force, ForcePath):
        left_out += _in_gaps(time_s, '--sim', force.time_s, None, 0.0, LONGEST_BRIDGE_S)
    if comparison.reference is Reference.STAGE:
        step_rad = comparison.sensor.stage_resolution_rad
        for joint, name in JOINTS.items():
            left_out += _empty_cells(recording, name, 0.0 if joint == 'shift' else step_rad,
                                     LONGEST_BRIDGE_S)
    for name in ('temperature_c', 'supply_v'):
        left_out += _empty_cells(recording, name, np.inf, LONGEST_SLOW_BRIDGE_S)
    return left_out


def _empty_cells(recording: Recording, name: str, step: float, longest_s: float
                 ) -> list[LeftOut]:
    """Find samples in the gaps of a column; none where it is missing or empty."""
    values = recording.columns.get(name)
    if values is None or not np.isfinite(values).any():
        return []
    sampled = np.isfinite(values)
    return _in_gaps(recording.time_s, name, recording.time_s[sampled], values[sampled], step,
                    longest_s)


def _in_gaps(time_s: np.ndarray, name: str, read_s: np.ndarray, values: np.ndarray | None,
             step: float, longest_s: float) -> list[LeftOut]:
    """
    Find samples in the gaps of a reference.

    Parameters
    ----------
    time_s
        Times of the samples, s, (n,).
    name
        Name of the reference, for people.
    read_s
        Times of its readings, s, (k,).
    values
        The readings, (k,); None where no gap counts as a rest.
    step
        Step of the readings; infinite where a gap never hides a move.
    longest_s
        Longest gap that is bridged, s.

    Returns
    -------
    list
        One entry or none.

    """
    limit_s = max(longest_s, USUAL_GAPS * float(np.median(np.diff(read_s)))
                  if len(read_s) > 1 else 0.0)
    rows = np.zeros(len(time_s), bool)
    if time_s[0] < read_s[0] - limit_s:
        rows |= time_s < read_s[0]
    if time_s[-1] > read_s[-1] + limit_s:
        rows |= time_s > read_s[-1]
    for i in np.flatnonzero(np.diff(read_s) > limit_s):
        begin_s, end_s = read_s[i], read_s[i + 1]
        moved = values is None or abs(values[i + 1] - values[i]) > _SAME_STEPS * step
        before_s, after_s = (_BEFORE_S, _AFTER_S) if moved and np.isfinite(step) else (0.0, 0.0)
        rows |= (time_s > begin_s - before_s) & (time_s < end_s + after_s)
    if not rows.any():
        return []
    return [LeftOut(rows, f'no reading of {name} for more than {limit_s:.3g} s')]


def too_coarse(recording: Recording, comparison: BaselineComparison) -> list[LeftOut]:
    """
    Find samples at which the reference moves faster than its readings show.

    Parameters
    ----------
    recording
        The recording.
    comparison
        The same beside the simulator.

    Returns
    -------
    list
        What is left out, one entry for each reference.

    """
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
            sampled = np.isfinite(values) if len(values) else np.zeros(0, bool)
            if not sampled.any() or np.ptp(values[sampled]) == 0:
                continue
            if joint == 'shift':
                error_g = _spline_error(time_s[sampled], values[sampled] / G0_MPS2,
                                        BAND_LIMITED_DEGREE, 2, 0.0)
                leave_out(name, time_s[sampled], error_g, limit_g)
            else:
                error_g = _spline_error(time_s[sampled], values[sampled], 5, 0,
                                        KNOT_S if step_rad else 0.0)
                leave_out(name, time_s[sampled], error_g,
                          np.sqrt(limit_g ** 2 + _ENCODER_SQUARES * step_rad ** 2 / 12))
    return left_out


def _jumps(sensor: Sensor, force: ForcePath, largest_g: float) -> tuple[np.ndarray, float]:
    """
    Find jumps of a simulator's force, whose exact time is unknown.

    Parameters
    ----------
    sensor
        The sensor.
    force
        The force.
    largest_g
        Error from which a jump counts, g.

    Returns
    -------
    numpy.ndarray
        Which of the readings are those of a jump, (k,) bool.
    float
        Largest error of a jump, g.

    """
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

    Parameters
    ----------
    read_s
        Times of the readings, s, (k,).
    values
        The readings, (k,).
    degree
        Degree of the spline.
    order
        Order of the derivative that is used.
    knots_s
        Distance of the knots, s, where it exceeds that of the readings.
    jumps
        Even readings that do not count, (k,) bool; None for none.

    Returns
    -------
    numpy.ndarray
        Rms error around each reading, in the unit of the derivative, (k,).

    """
    gaps_s = np.diff(read_s)
    step_s = float(np.median(gaps_s))
    wide = np.flatnonzero(gaps_s > max(LONGEST_BRIDGE_S, USUAL_GAPS * step_s)) + 1
    spacing = max(knots_s, float(np.quantile(gaps_s, _USUAL_QUANTILE))) / step_s
    left_out = np.zeros(len(values), bool) if jumps is None else jumps
    errors = []
    for times_s, part, ignored in zip(*(np.split(array, wide)
                                        for array in (read_s, values, left_out))):
        if len(part) > 1 and np.ptp(np.diff(times_s)) > _EVEN * step_s:
            even_s = np.arange(times_s[0], times_s[-1], step_s)
            even = _windowed_error(scipy.interpolate.CubicSpline(times_s, part)(even_s), step_s,
                                   np.zeros(len(even_s), bool), spacing, degree, order)
            errors.append(np.interp(times_s, even_s, even))
        else:
            errors.append(_windowed_error(part, step_s, ignored, spacing, degree, order))
    return np.concatenate(errors)


def _windowed_error(values: np.ndarray, step_s: float, ignored: np.ndarray, spacing: float,
                    degree: int, order: int) -> np.ndarray:
    """
    Return the error of a spline in windows of even readings.

    Parameters
    ----------
    values
        The readings, (k,).
    step_s
        Time between them, s.
    ignored
        Readings whose fourth differences do not count, (k,) bool.
    spacing
        Distance of the knots in readings.
    degree
        Degree of the spline.
    order
        Order of the derivative that is used.

    Returns
    -------
    numpy.ndarray
        Rms error around each reading, in the unit of the derivative, (k,).

    """
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
