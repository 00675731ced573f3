# SPDX-License-Identifier: Apache-2.0

"""The sensor of a recording: its parameter file, and what is measured where the file is silent."""

from __future__ import annotations

from dataclasses import replace
from math import ceil, log2
from pathlib import Path
from typing import NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stamps import halves, late_by, stamped_rate_hz
from adxl_ros.model.constants import AXES, MEASURED_AXES
from adxl_ros.model.sensor import Sensor, to_volts, with_axes
from adxl_ros.signals import block_statistics as stats
from adxl_ros.signals.block_statistics import Spans
from adxl_ros.signals.filter_noise import estimate_filter
from adxl_ros.wording import usage
import numpy as np

SHORTEST_S = 2.0  # Shortest time that shows noise, s. Chosen: some windows of 0.25 s
FEWEST_SAMPLES = 64  # Fewest samples that show it. Chosen: the variance is within a fifth
_MOST_BACKWARD = 0.1  # Largest share of stamps that step back. Chosen: two drivers make half
_STEADY = 0.05  # Largest difference of the rate of half of the samples. Chosen: above any clock's
_SMALLEST_RANGE_G = 2.0  # Smallest range that is taken, g: of common digital sensors
_FILTER_START_SAMPLES = 2.0  # First RC of the search, periods. Chosen: slower ones are reached
_MAX_NOISE_G_PER_RTHZ = 0.1  # Largest density of a parameter file, g/√Hz
_NO_FILTER = 'filter: the noise at rest shows none'
RESISTANCE_OHM = 1.0e4  # Resistor of a measured filter, Ω: only R·C has a meaning


def load_sensor(params: Sensor | str | None, read: Recording) -> Sensor:
    """Load the parameter file of a recording, unless the sensor itself is given."""
    if isinstance(params, Sensor):
        return params
    if params is None:
        return parameter_file.usual(read.is_of_nominal)
    return parameter_file.load(params, may_measure=True)


def measure_unstated(sensor: Sensor, read: Recording) -> tuple[Sensor, list[str]]:
    """Measure from a recording its rate and what the parameter file leaves out."""
    name = Path(read.path).name
    if len(read) > 1:
        sensor = replace(
            sensor,
            rate_hz=round(read.rate_hz, 6),
            provenance={**sensor.provenance, 'rate_from': name},
        )
    if not sensor.unstated:
        return sensor, []
    if not sensor.effects:
        sensor = with_axes(sensor, read.axes)
    if 'noise_density_g_per_rthz' in sensor.unstated:
        sensor = replace(sensor, provenance={**sensor.provenance, 'noise_from': name})
    return _measured(sensor, read.time_s, read.volts(sensor), f'{read.path}: ')


def measured_lines(measured: list[str]) -> list[str]:
    """Return the lines of `measure_unstated` below a heading; none where nothing is measured."""
    return (
        ['', 'Measured, as no parameter file states it:', *(f'  {line}' for line in measured)]
        if measured
        else []
    )


class BeyondRange:
    """Counts the readings of a recording that are beyond the stated range of its sensor."""

    def __init__(self) -> None:
        self._samples = 0
        self._largest_g = 0.0

    def add(self, volts: np.ndarray, sensor: Sensor) -> None:
        """Count further samples, V, (n, m)."""
        readings_g = np.abs(volts - sensor.nominal_zero_g_v) / sensor.nominal_scale_v_per_g
        beyond = readings_g > sensor.range_g
        if beyond.any():
            self._samples += int(beyond.any(axis=1).sum())
            self._largest_g = max(self._largest_g, float(readings_g[beyond].max()))

    def describe(self, sensor: Sensor) -> str:
        """Return the count for people; '' where no reading is beyond the range."""
        if not self._samples:
            return ''
        return (
            f'{self._samples} samples are beyond the stated range of ±{sensor.range_g:g} g '
            f'(largest reading {self._largest_g:.3g} g); check sensor.range_g'
        )


def _measured(
    sensor: Sensor, time_s: np.ndarray, volts: np.ndarray, where: str = ''
) -> tuple[Sensor, list[str]]:
    """
    Fill in what a parameter file leaves out; return the sensor, and what is measured, for people.

    The noise is that of the quietest quarter seconds, so that the samples may hold motion.
    """
    shown = _shown(sensor, time_s, volts, where)
    scale_v_per_g = sensor.nominal_scale_v_per_g
    noise_g = shown.noise_v / scale_v_per_g
    largest_g = float(np.max(np.abs(volts - sensor.nominal_zero_g_v) / scale_v_per_g))
    # A common range: a power of two
    range_g = 2.0 ** ceil(log2(max(largest_g, _SMALLEST_RANGE_G)))
    # Noise bandwidth of the filter, or that of samples without one
    bandwidth_hz = 0.25 / shown.rc_s if shown.rc_s else sensor.rate_hz / 2
    density_g_per_rthz = noise_g / np.sqrt(bandwidth_hz)
    values = {
        'noise_density_g_per_rthz': np.minimum(density_g_per_rthz, _MAX_NOISE_G_PER_RTHZ),
        'range_g': range_g,
        'rc_resistance_ohm': RESISTANCE_OHM,
        'rc_capacitance_f': shown.rc_s / RESISTANCE_OHM,
        'filter_rate_hz': sensor.rate_hz,
    }
    texts = {
        'noise_density_g_per_rthz': 'noise of a sample: ' + _by_axis(sensor, noise_g),
        'adc_bits': 'resolution: ' + _by_axis(sensor, shown.step_v / scale_v_per_g),
        'rc_capacitance_f': f'filter: {shown.rc_s * 1e3:.3g} ms' if shown.rc_s else _NO_FILTER,
        'range_g': f'range: ±{range_g:g} g (largest reading {largest_g:.3g} g)',
    }
    lines = [text for name, text in texts.items() if name in sensor.unstated]
    unknown = {*sensor.unstated}
    if 'rc_capacitance_f' in unknown:
        unknown.add('filter_rate_hz')  # The measured filter is that at this rate.
    used = {name: value for name, value in values.items() if name in unknown}
    return replace(sensor, unstated=(), measured=sensor.unstated, **used), lines


class _Shown(NamedTuple):
    """What samples show of a sensor."""

    noise_v: np.ndarray  # Standard deviation of a sample by axis, V, (m,)
    step_v: np.ndarray  # Step of the samples by axis, V, (m,)
    rc_s: float  # Time constant of the filter, s: the stated one, or the measured one


def _shown(sensor: Sensor, time_s: np.ndarray, volts: np.ndarray, where: str) -> _Shown:
    """Measure noise, steps and filter; refuse samples that do not show them."""
    spans = Spans(sensor.rate_hz)
    blocks = stats.BlockCutter(sensor.rate_hz, len(sensor.axes)).feed(time_s, volts)
    windows = stats.window_variance(blocks, spans)
    if len(time_s) < FEWEST_SAMPLES or not np.isfinite(windows).any():
        raise UserError(f'{where}{_noise_is_hidden(sensor, time_s)}')
    step_v = stats.adc_step(blocks)
    windows = stats.without_stuck(blocks, windows, step_v)
    variance_v2, limit_v2 = stats.quiet_variance(blocks, windows, step_v)
    rc_s = sensor.rc_s
    if 'rc_capacitance_f' in sensor.unstated:
        quiet = stats.quiet_blocks(blocks, windows, limit_v2, spans.window)
        rests = _runs_of(volts, blocks, quiet, spans.size)
        rc_s = _filter_s(rests, sensor.rate_hz, float(np.max(step_v)))
    return _Shown(np.sqrt(variance_v2), step_v, rc_s)


def _runs_of(
    volts: np.ndarray, blocks: stats.Blocks, quiet: np.ndarray, size: int
) -> list[np.ndarray]:
    """Return the samples of each run of quiet blocks, V, (k, m)."""
    return [
        volts[blocks.start[begin] : blocks.start[end - 1] + size]
        for begin, end in stats.true_runs(quiet, blocks.run)
    ]


def _noise_is_hidden(sensor: Sensor, time_s: np.ndarray) -> str:
    """Return that samples do not show the noise of a sensor, why, and what does."""
    needed_s = max(SHORTEST_S, FEWEST_SAMPLES / sensor.rate_hz)
    longest_s = np.diff(time_s).max(initial=0.0)
    has_gaps = longest_s > stats.gap_s(sensor.rate_hz)
    why = f'; they come with gaps of up to {longest_s:.2g} s' if has_gaps else ''
    fields = parameter_file.SENSOR_FIELDS.items()
    keys = [key for key, field in fields if field.name in sensor.unstated]
    return (
        f'{len(time_s)} samples at {sensor.rate_hz:g} Hz do not show the noise of the '
        f'sensor{why}; record at least {needed_s:.3g} s without gaps, or state '
        f'{", ".join(keys)} in the parameter file; {usage("fit", means=True)} takes a table of '
        'which each row is the mean of a rest'
    )


def _filter_s(rests: list[np.ndarray], rate_hz: float, step_v: float) -> float:
    """Return the mean time constant of the axes, s; 0 where the noise of one shows no filter."""
    time_constants = []
    for axis in range(rests[0].shape[1] if rests else 0):
        estimate = estimate_filter(
            [rest[:, axis] for rest in rests], rate_hz, _FILTER_START_SAMPLES / rate_hz, step_v
        )
        if estimate is None or not estimate.credible:
            return 0.0
        time_constants.append(estimate.rc_s)
    return float(np.mean(time_constants)) if time_constants else 0.0


def _steady_rate_hz(time_s: np.ndarray) -> float:
    """Return the rate of rising stamps of a stream, s, (n,), Hz; refuse those that show none."""
    if len(time_s) < 3 or time_s[-1] < SHORTEST_S:
        raise UserError(
            f'{len(time_s)} samples in {np.ptp(time_s) if len(time_s) else 0:.1f} s; '
            f'{SHORTEST_S:g} s show rate and noise'
        )
    rate_hz = stamped_rate_hz(time_s)
    if not rate_hz > 0:
        raise UserError(
            f'the stamps of {len(time_s)} samples do not advance; the driver must stamp each '
            'sample'
        )
    rates = halves(time_s)
    if not rates.agree(_STEADY):
        raise UserError(
            f'stamps are uneven: {rates.first_hz:.4g} and then {rates.second_hz:.4g} '
            f'a second within {time_s[-1]:.1f} s; the host stalls, or the driver '
            'stamps samples when they arrive'
        )
    return rate_hz


def sensor_of_stream(
    sensor: Sensor, stamps_ns: np.ndarray, accel_mps2: np.ndarray
) -> tuple[Sensor, list[str]]:
    """
    Return the unit of a live stream that states nothing of itself, and what was measured.

    An axis of the specific force, (n, 3), that is always 0 is not measured.
    """
    late_ns = late_by(stamps_ns)
    backward = (
        f'{np.count_nonzero(late_ns)} of {len(stamps_ns)} samples, whose stamp steps '
        f'back by up to {late_ns.max(initial=0) * 1e-6:.3g} ms'
    )
    if np.count_nonzero(late_ns) > _MOST_BACKWARD * len(stamps_ns):
        raise UserError(f'{backward}; one driver must stamp them, in their order')
    stamps_ns = stamps_ns[late_ns == 0]
    accel_mps2 = accel_mps2[late_ns == 0]
    time_s = (stamps_ns - stamps_ns[:1]) * 1e-9
    rate_hz = _steady_rate_hz(time_s)
    present = ''.join(axis for axis, values in zip(AXES, accel_mps2.T) if values.any())
    axes = present if present in MEASURED_AXES else AXES
    if not sensor.effects:
        sensor = with_axes(sensor, axes)
    sensor = replace(sensor, rate_hz=round(rate_hz, 3))
    volts = to_volts(accel_mps2[:, : len(sensor.axes)], sensor)
    sensor, lines = _measured(sensor, time_s, volts)
    lines.insert(0, f'rate: {sensor.rate_hz:.4g} Hz, axes: {sensor.axes}')
    if late_ns.any():
        lines.append(f'left out: {backward}')
    return replace(sensor, measured=(*sensor.measured, 'rate_hz')), lines


def _by_axis(sensor: Sensor, values_g: np.ndarray) -> str:
    return ', '.join(f'{axis} {value * 1e3:.2g} mg' for axis, value in zip(sensor.axes, values_g))
