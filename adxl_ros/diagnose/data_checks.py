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
Faults of the recording itself, which would make a diagnosis of effects meaningless.

They are axes, units, clocks, the range, the reference, and missing samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from adxl_ros.diagnose.baseline_comparison import at_search_rate, BaselineComparison, Reference
from adxl_ros.diagnose.noise_detectors import (
    coarse_codes,
    code_step_v,
    Detection,
    isolated_samples,
    repeated_samples,
)
from adxl_ros.signals.axis_polarity import find_polarity_fault
import numpy as np

SHORTEST_S = 30.0
"""Shortest time, s, that the recordings of a moving sensor last together. Chosen: a few turns of
the stage."""
_FEWEST_SAMPLES = 50
"""Fewest samples of any recording. Chosen: one for each of 48 blocks."""
_SMALLEST_MOTION_G = 0.05
"""Standard deviation of the simulated force, g, from which an axis is compared. Chosen: ten times
the noise of an ADXL203."""
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
_UNIT_TOLERANCE = 0.1
"""Relative deviation of a gain from the ratio of two units. Chosen: above any scale error."""
_UNIT_RATIOS = {
    9.80665: 'm/s² instead of g',
    1e3: 'mV instead of V',
    1e-3: 'kV instead of V',
    1 / 9.80665: 'g instead of m/s²',
}
"""Gain of an output in the wrong unit, and which unit it has instead of which."""


@dataclass(frozen=True)
class DataFault:
    """
    A fault of the recording.

    Attributes
    ----------
    name
        Name in the report: `verdict.data_fault`.
    status
        Status of the verdict: 'bad_data' or 'insufficient'.
    message
        What is wrong and what to do, one line.

    """

    name: str
    status: str
    message: str


@dataclass(frozen=True)
class CheckedRecording:
    """
    A recording that can be diagnosed.

    Attributes
    ----------
    comparison
        The recording beside the baseline at its full rate.
    search_comparison
        The same at the rate of the search.
    detections
        Noise-like effects that the samples themselves show.
    possible_spikes
        Isolated samples; the residual of the best hypothesis must show them, too.

    """

    comparison: BaselineComparison
    search_comparison: BaselineComparison
    detections: tuple[Detection, ...]
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
    """
    Find what makes a diagnosis of effects meaningless.

    Parameters
    ----------
    comparison
        The recording at its full rate.
    search_comparison
        The recording at the rate of the search.

    Returns
    -------
    DataFault or None
        The first fault that was found.

    """
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
    if comparison.reference is Reference.NONE:
        return _unexplained_motion(comparison, finite)
    return _axis_fault(search_comparison)


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
    moving = np.flatnonzero(simulated_g.std(axis=0) > _SMALLEST_MOTION_G)
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
    return (_order_fault(axes, correlation)
            or _unit_fault(simulated_g, measured_g, np.diag(correlation))
            or _reference_fault(float(np.max(np.abs(correlation)))))


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


def _reference_fault(correlation: float) -> DataFault | None:
    """Find an output that does not follow the reference, by its largest correlation."""
    if correlation >= _UNCORRELATED:
        return None
    return DataFault('reference', 'bad_data', 'the output does not follow the reference '
                     f'(correlation {correlation:.2f}); check that both belong to one recording, '
                     f'with clocks that differ by less than {_LARGEST_DELAY_S:g} s')


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
