# SPDX-License-Identifier: Apache-2.0
"""
What each axis of a recording says beside its simulation: its range, its unit, and which it is.

An axis at the end of its range, one that does not change, one in another unit, or one that is
swapped or inverted makes a diagnosis meaningless.
"""

from __future__ import annotations

from dataclasses import replace

from adxl_ros.diagnose.comparison import BaselineComparison
from adxl_ros.diagnose.data_faults import DataFault
from adxl_ros.diagnose.motion_shifts import CORRELATED
from adxl_ros.diagnose.reference_checks import check_delay, LARGEST_DELAY_S
from adxl_ros.diagnose.sample_faults import code_step_v, SMALLEST_RANGE_V
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2, TINY
from adxl_ros.model.sensor import to_nominal_mps2
from adxl_ros.report.quantities import listed
from adxl_ros.signals.block_statistics import true_runs
from adxl_ros.signals.polarity import find_polarity_fault
from adxl_ros.signals.stage_angles import SMALLEST_MOTION_G
from adxl_ros.wording import option
import numpy as np

_FEWEST_SAMPLES = 50  # Fewest samples of any recording. Chosen: one for each of 48 blocks
_SWAPPED = 0.7
"""Correlation with its own reference below which an axis may be swapped. Chosen: that of noise as
large as the signal."""
_UNCORRELATED = 0.5
"""Correlation below which nothing follows the reference. Chosen: that of noise 1.7 times as large
as the signal."""
_LARGEST_MISSING_SHARE = 0.3
"""Share of samples that may be missing, or at the end of the range. Chosen: the rest still
shows the effects."""
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


def check_output(comparison: BaselineComparison) -> None:
    """Refuse an output that no sensor has, before any sample is left out."""
    if len(comparison) < _FEWEST_SAMPLES:
        raise DataFault(
            'too_short',
            f'{len(comparison)} samples are too few; a recording needs {_FEWEST_SAMPLES}',
            'insufficient',
        )
    finite = np.isfinite(comparison.volts).all(axis=1)
    if finite.mean() < 1 - _LARGEST_MISSING_SHARE:
        raise DataFault(
            'missing',
            f'{100 * (1 - finite.mean()):.0f} % of the samples are not numbers; record again',
        )
    sensor = comparison.sensor
    volts = comparison.volts[finite]
    _check_ends(comparison, finite)
    _check_changes(comparison, finite)
    level_g = np.abs(np.median(volts, axis=0) - sensor.zero_g_v) / sensor.scale_v_per_g
    worst = int(np.argmax(level_g))
    if level_g[worst] >= _LARGEST_LEVEL_G:
        raise DataFault(
            'unit',
            f'{sensor.axes[worst]} is at {level_g[worst]:.3g} g; correct the '
            f'unit of its column, or {option("sensor")}',
        )


def _check_ends(comparison: BaselineComparison, finite: np.ndarray) -> None:
    """Refuse an axis whose numbers, (n,) bool, are held at an end while it should move on."""
    sensor = comparison.sensor
    volts = comparison.volts[finite]
    simulated_v = comparison.simulated_v(sensor)[finite]
    lsb_v = max(sensor.lsb_v, _SMALLEST_STEP_V)
    # Coarse codes repeat in an extreme pose, so that the simulation must differ, too.
    step_v = np.maximum(code_step_v(volts), lsb_v)
    moves = np.ptp(volts, axis=0) > SMALLEST_RANGE_V
    for end_v in (volts.max(axis=0), volts.min(axis=0)):
        held = (np.abs(volts - end_v) < lsb_v / 2) & (np.abs(simulated_v - end_v) > step_v)
        share = np.where(moves, held.mean(axis=0), 0.0)
        worst = int(np.argmax(share))
        if share[worst] > _LARGEST_MISSING_SHARE:
            end_mps2 = to_nominal_mps2(end_v, sensor)[worst]
            raise DataFault(
                'saturated',
                f'{sensor.axes[worst]} is held at {end_mps2:.4g} m/s², the end of its range, for '
                f'{held[:, worst].sum()} samples ({100 * share[worst]:.0f} %); check supply, '
                'range and wiring',
            )


def _check_changes(comparison: BaselineComparison, finite: np.ndarray) -> None:
    """Refuse an axis whose numbers, (n,) bool, do not change as those of a sensor do."""
    sensor = comparison.sensor
    range_v = np.ptp(comparison.volts[finite], axis=0)
    expected_v = np.ptp(comparison.simulated_v(sensor)[finite], axis=0)
    # At rest, codes may all be the same where their step exceeds the noise.
    noisy = noise.analog_std_v(sensor) > sensor.lsb_v
    is_constant = np.where(
        expected_v > SMALLEST_RANGE_V,
        range_v < _DEAD_SHARE * expected_v,
        (range_v < _SMALLEST_STEP_V) & ((range_v > 0) | noisy),
    )
    if is_constant.any():
        raise DataFault(
            'constant',
            f'{sensor.axes[int(np.argmax(is_constant))]} does not change with '
            'motion or noise; check its wiring',
        )
    share = stuck(comparison).mean(axis=0)
    if share.max() > _LARGEST_MISSING_SHARE:
        raise DataFault(
            'constant',
            f'{sensor.axes[int(np.argmax(share))]} does not change for '
            f'{100 * share.max():.0f} % of the recording, though the motion does; '
            'check its wiring',
        )


def stuck(comparison: BaselineComparison) -> np.ndarray:
    """Return where an axis keeps one value in motion that it should follow, (n, m) bool."""
    volts = comparison.volts
    simulated_v = comparison.simulated_v(comparison.sensor)
    # Within a code, an output may move by its step.
    moved_v = SMALLEST_RANGE_V + code_step_v(volts)
    longest = max(round(_LONGEST_HOLD_S * comparison.sensor.rate_hz), 2)
    found = np.zeros(volts.shape, bool)
    for d, (values_v, expected_v) in enumerate(zip(volts.T, simulated_v.T)):
        # An output that clips, or coarse codes in an extreme pose, hold the largest value.
        held = np.diff(values_v, prepend=np.nan) == 0
        held &= (values_v < np.nanmax(values_v)) & (values_v > np.nanmin(values_v))
        for begin, end in true_runs(held & comparison.used):
            is_long = end - begin > longest
            if is_long and np.ptp(expected_v[begin:end]) > moved_v[d]:
                found[begin:end, d] = True
    return found


def check_axes(comparison: BaselineComparison) -> None:
    """Compare order, sign, unit and time of the axes with the simulated output."""
    sensor = comparison.sensor
    finite = np.isfinite(comparison.volts).all(axis=1)

    def motion_g(volts: np.ndarray) -> np.ndarray:
        return (volts - volts[finite].mean(axis=0)) / sensor.scale_v_per_g

    measured_g = motion_g(comparison.volts)
    simulated_g = motion_g(comparison.simulated_v(sensor))
    _check_units(comparison, measured_g, finite)
    moving = np.flatnonzero(simulated_g.std(axis=0) > SMALLEST_MOTION_G)
    if not len(moving):
        return
    check_delay(simulated_g, np.nan_to_num(measured_g), sensor.rate_hz)
    count = len(moving)
    rows = np.ix_(finite, moving)
    with np.errstate(all='ignore'):
        both = np.corrcoef(measured_g[rows].T, simulated_g[rows].T)
    correlation = np.nan_to_num(both[:count, count:])
    polarity = find_polarity_fault(correlation, list(range(count)), _SWAPPED)
    if polarity is not None:
        axes = [sensor.axes[d] for d in moving]
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
            f'{LARGEST_DELAY_S:g} s',
        )


def _check_units(
    comparison: BaselineComparison, measured_g: np.ndarray, finite: np.ndarray
) -> None:
    """Compare the size of motion on each axis, g, (n, m), with the ratios of two units."""
    gains = _gains(comparison, measured_g, finite)
    for ratio, units in _UNIT_RATIOS.items():
        wrong = [axis for axis in gains if abs(np.log(gains[axis] / ratio)) < _UNIT_TOLERANCE]
        if not wrong:
            continue
        which = f'the output of {listed(wrong, "and")}'
        by_option = ''
        if len(wrong) == len(gains):
            which = 'the output'
            if comparison.simulated_force:
                by_option = f', by {option("unit")} or {option("sim_unit")}'
        raise DataFault(
            'unit',
            f'{which} is {np.median([gains[axis] for axis in wrong]):.4g} times the simulated '
            f'output, as values in {units} are; correct the unit of the columns{by_option}',
        )


def _gains(
    comparison: BaselineComparison, measured_g: np.ndarray, finite: np.ndarray
) -> dict[str, float]:
    """Return the gain over the simulated output of each axis that follows it."""
    sensor = comparison.sensor
    # In another unit the simulated output may be beyond the rails of the ADC.
    simulated_v = comparison.simulated_v(replace(sensor, adc_bits=0))
    simulated_g = (simulated_v / sensor.scale_v_per_g)[finite]
    gains: dict[str, float] = {}
    for axis, simulated, measured in zip(sensor.axes, simulated_g.T, measured_g[finite].T):
        simulated_std_g = float(simulated.std())
        measured_std_g = float(measured.std())
        covariance_g2 = float(np.mean((simulated - simulated.mean()) * measured))
        moves_g = simulated_std_g
        # Only another simulator can be in such a unit that it seems not to move.
        if comparison.simulated_force:
            moves_g = max(simulated_std_g, measured_std_g)
        follows = covariance_g2 > CORRELATED * simulated_std_g * measured_std_g
        if follows and moves_g > SMALLEST_MOTION_G:
            gains[axis] = covariance_g2 / max(simulated_std_g**2, TINY)
    return gains
