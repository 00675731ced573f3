# SPDX-License-Identifier: Apache-2.0

"""Nominal values that a parameter file leaves out, measured from the samples of the sensor."""

from __future__ import annotations

from dataclasses import replace
from math import ceil, log2
from typing import NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import stamped_rate_hz
from adxl_ros.model.constants import AXES, MEASURED_AXES
from adxl_ros.model.sensor import Sensor, to_volts, with_axes
from adxl_ros.signals.block_statistics import block_samples, BlockCutter, Blocks
from adxl_ros.signals.filter_time_constant import estimate_filter
from adxl_ros.signals.noise_limits import (
    adc_step,
    quiet_blocks,
    quiet_variance,
    Spans,
    window_variance,
)
from adxl_ros.signals.runs import true_runs
import numpy as np

SHORTEST_S = 2.0
"""Shortest time that shows the noise of a sensor, s. Chosen: some windows of a quarter second."""
_FEWEST_SAMPLES = 64
"""Smallest number of samples that shows it. Chosen: the variance then scatters by a fifth."""
_SMALLEST_RANGE_G = 2.0
"""Smallest measuring range that is taken, g: the smallest one of common digital sensors."""
_FILTER_START_SAMPLES = 2.0
"""Time constant with which the search for a filter begins, sample periods. Chosen: a filter that
is much faster does not show, and one that is slower is reached from there."""
_MAX_NOISE_G_PER_RTHZ = 0.1
"""Largest density of a parameter file, g/√Hz."""
_RESISTANCE_OHM = 1.0e4
"""Resistor that a measured filter is written with, Ω: only its product with C has a meaning."""


class MeasuredValues(NamedTuple):
    """What samples show of their sensor."""

    noise_v: np.ndarray  # Standard deviation of one sample at rest by axis, V, (m,)
    step_v: np.ndarray  # Smallest change of the samples by axis, V, (m,)
    rc_s: float  # Time constant of the filter, s; 0 where the noise shows none
    largest_g: float  # Magnitude of the largest reading of an axis, g

    @property
    def range_g(self) -> float:
        """Return the next power of two above the largest reading, g: a common range."""
        return max(_SMALLEST_RANGE_G, 2.0 ** ceil(log2(max(self.largest_g, _SMALLEST_RANGE_G))))


def measure(time_s: np.ndarray, volts: np.ndarray, sensor: Sensor) -> MeasuredValues:
    """
    Measure noise, step, filter and largest reading.

    The noise is that of the quietest quarter seconds, so that the samples may hold motion.

    time_s: stamps, s, (n,); volts: samples, V, (n, m).
    """
    cutter = BlockCutter(sensor.rate_hz, len(sensor.axes))
    blocks, spans = cutter.feed(time_s, volts), Spans.for_rate(sensor.rate_hz)
    windows = window_variance(blocks, spans)
    if len(time_s) < _FEWEST_SAMPLES or not np.isfinite(windows).any():
        raise UserError(f'{len(time_s)} samples at {sensor.rate_hz:g} Hz do not show the noise of '
                        f'the sensor; record at least {SHORTEST_S:g} s, or state '
                        'sensor.noise_density_g_per_rthz in the parameter file')
    step_v = adc_step(blocks)
    variance_v2, limit_v2 = quiet_variance(blocks, windows, step_v)
    quiet = quiet_blocks(blocks, windows, limit_v2, spans.window)
    readings_g = np.abs(volts - sensor.nominal_zero_g_v) / sensor.nominal_scale_v_per_g
    return MeasuredValues(np.sqrt(variance_v2), step_v,
                          _filter_s(volts, blocks, quiet, sensor, float(np.max(step_v))),
                          float(np.nanmax(readings_g)))


def _filter_s(volts: np.ndarray, blocks: Blocks, quiet: np.ndarray, sensor: Sensor,
              step_v: float) -> float:
    """Return the mean time constant of the axes, s; 0 where the noise of one shows no filter."""
    size = block_samples(sensor.rate_hz)
    rests = [volts[blocks.start[begin]:blocks.start[end - 1] + size]
             for begin, end in true_runs(quiet, blocks.run)]
    time_constants = []
    for axis in range(volts.shape[1]):
        estimate = estimate_filter([rest[:, axis] for rest in rests], sensor.rate_hz,
                                   _FILTER_START_SAMPLES / sensor.rate_hz, step_v)
        if estimate is None or not estimate.credible:
            return 0.0
        time_constants.append(estimate.rc_s)
    return float(np.mean(time_constants))


def with_measured_values(sensor: Sensor, values: MeasuredValues) -> Sensor:
    """Fill in what the parameter file of a sensor leaves out."""
    rc_s = sensor.rc_s if _states_filter(sensor) else values.rc_s
    bandwidth_hz = 0.25 / rc_s if rc_s else sensor.rate_hz / 2
    density = values.noise_v / sensor.nominal_scale_v_per_g / np.sqrt(bandwidth_hz)
    measured = {
        'noise_density_g_per_rthz': np.minimum(density, _MAX_NOISE_G_PER_RTHZ),
        'range_g': values.range_g}
    if not _states_filter(sensor):
        measured |= {'rc_resistance_ohm': _RESISTANCE_OHM,
                     'rc_capacitance_f': rc_s / _RESISTANCE_OHM}
    used = {name: value for name, value in measured.items() if name in sensor.unstated}
    return replace(sensor, unstated=(), measured=sensor.unstated, **used)


def unit_of_stream(sensor: Sensor, stamps_ns: np.ndarray, accel_mps2: np.ndarray
                   ) -> tuple[Sensor, list[str]]:
    """
    Return the unit of a live stream that states nothing of itself.

    stamps_ns: stamps, ns, (n,); accel_mps2: specific force, m/s², (n, 3); an axis that is always 0
    is not measured.
    """
    steps_s = np.diff(stamps_ns) * 1e-9
    if steps_s.sum() < SHORTEST_S:
        raise UserError(f'{len(stamps_ns)} samples in {max(steps_s.sum(), 0):.1f} s; '
                        f'{SHORTEST_S:g} s show rate and noise')
    rate_hz = stamped_rate_hz((stamps_ns - stamps_ns[0]) * 1e-9)
    if not rate_hz > 0:
        raise UserError(f'the stamps of {len(stamps_ns)} samples do not advance; the driver must '
                        'stamp each sample')
    present = ''.join(axis for axis, values in zip(AXES, accel_mps2.T) if values.any())
    axes = present if present in MEASURED_AXES else AXES
    unit = sensor if sensor.effects else with_axes(sensor, axes)
    unit = replace(unit, rate_hz=round(rate_hz, 3))
    volts = to_volts(accel_mps2[:, :len(unit.axes)], unit)
    values = measure((stamps_ns - stamps_ns[0]) * 1e-9, volts, unit)
    unit, lines = with_measured_values(unit, values), describe(unit, values)
    return (replace(unit, measured=(*unit.measured, 'rate_hz')),
            [f'rate: {unit.rate_hz:.4g} Hz, axes: {unit.axes}', *lines])


def _states_filter(sensor: Sensor) -> bool:
    """Return whether the file states resistor and capacitor."""
    return not {'rc_resistance_ohm', 'rc_capacitance_f'} & set(sensor.unstated)


def describe(sensor: Sensor, values: MeasuredValues) -> list[str]:
    """Return what is measured in place of the file, for people."""
    lines = []
    scale_v_per_g = sensor.nominal_scale_v_per_g
    if 'noise_density_g_per_rthz' in sensor.unstated:
        lines.append('noise of a sample: ' + _by_axis(sensor, values.noise_v / scale_v_per_g))
    if 'adc_bits' in sensor.unstated:
        lines.append('resolution: ' + _by_axis(sensor, values.step_v / scale_v_per_g))
    if not _states_filter(sensor):
        lines.append(f'filter: {values.rc_s * 1e3:.3g} ms' if values.rc_s else
                     'filter: the noise at rest shows none')
    if 'range_g' in sensor.unstated:
        lines.append(f'range: ±{values.range_g:g} g (largest reading {values.largest_g:.3g} g)')
    return lines


def _by_axis(sensor: Sensor, values_g: np.ndarray) -> str:
    return ', '.join(f'{axis} {value * 1e3:.2g} mg' for axis, value in zip(sensor.axes, values_g))
