# SPDX-License-Identifier: Apache-2.0

"""The sensor of a recording: its parameter file, and what is measured where the file is silent."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from math import ceil, log2
from pathlib import Path

from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stamps import halves, late_by, stamped_rate_hz
from adxl_ros.model.constants import AXES, MEASURED_AXES
from adxl_ros.model.effects import effect_named
from adxl_ros.model.sensor import names_of, put, Sensor, to_volts, with_axes, with_neutral
from adxl_ros.process import usage
from adxl_ros.signals import block_statistics as stats
from adxl_ros.signals.block_statistics import Spans
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
import scipy


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


SHORTEST_S = 2.0  # Shortest time that shows noise, s. Chosen: some windows of 0.25 s
FEWEST_SAMPLES = 64  # Fewest samples that show it. Chosen: the variance is within a fifth
_MOST_BACKWARD = 0.1  # Largest share of stamps that step back. Chosen: two drivers make half
_STEADY = 0.05  # Largest difference of the rate of half of the samples. Chosen: above any clock's
_SMALLEST_RANGE_G = 2.0  # Smallest range that is taken, g: of common digital sensors
_FILTER_START_SAMPLES = 2.0  # First RC of the search, periods. Chosen: slower ones are reached
_MAX_NOISE_G_PER_RTHZ = 0.1  # Largest density of a parameter file, g/√Hz
_NO_FILTER = 'filter: the noise at rest shows none'
RESISTANCE_OHM = 1.0e4  # Resistor of a measured filter, Ω: only R·C has a meaning


def _measured(
    sensor: Sensor, time_s: np.ndarray, volts: np.ndarray, where: str = ''
) -> tuple[Sensor, list[str]]:
    """
    Fill in what a parameter file leaves out; return the sensor, and what is measured, for people.

    The noise is that of the quietest quarter seconds, so that the samples may hold motion.
    """
    scale_v_per_g = sensor.nominal_scale_v_per_g
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
    noise_g = np.sqrt(variance_v2) / scale_v_per_g
    largest_g = float(np.max(np.abs(volts - sensor.nominal_zero_g_v) / scale_v_per_g))
    # A common range: a power of two
    range_g = 2.0 ** ceil(log2(max(largest_g, _SMALLEST_RANGE_G)))
    # Noise bandwidth of the filter, or that of samples without one
    bandwidth_hz = 0.25 / rc_s if rc_s else sensor.rate_hz / 2
    density_g_per_rthz = noise_g / np.sqrt(bandwidth_hz)
    values = {
        'noise_density_g_per_rthz': np.minimum(density_g_per_rthz, _MAX_NOISE_G_PER_RTHZ),
        'range_g': range_g,
        'rc_resistance_ohm': RESISTANCE_OHM,
        'rc_capacitance_f': rc_s / RESISTANCE_OHM,
        'filter_rate_hz': sensor.rate_hz,
    }
    texts = {
        'noise_density_g_per_rthz': 'noise of a sample: ' + _by_axis(sensor, noise_g),
        'adc_bits': 'resolution: ' + _by_axis(sensor, step_v / scale_v_per_g),
        'rc_capacitance_f': f'filter: {rc_s * 1e3:.3g} ms' if rc_s else _NO_FILTER,
        'range_g': f'range: ±{range_g:g} g (largest reading {largest_g:.3g} g)',
    }
    lines = [text for name, text in texts.items() if name in sensor.unstated]
    unknown = {*sensor.unstated}
    if 'rc_capacitance_f' in unknown:
        unknown.add('filter_rate_hz')  # The measured filter is that at this rate.
    used = {name: value for name, value in values.items() if name in unknown}
    return replace(sensor, unstated=(), measured=sensor.unstated, **used), lines


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
    if len(time_s) < 3 or time_s[-1] < SHORTEST_S:
        raise UserError(
            f'{len(time_s)} samples in {np.ptp(time_s) if len(time_s) else 0:.1f} s; '
            f'{SHORTEST_S:g} s show rate and noise'
        )
    rate_hz = stamped_rate_hz(time_s)
    if not rate_hz > 0:
        raise UserError(
            f'the stamps of {len(stamps_ns)} samples do not advance; the driver must '
            'stamp each sample'
        )
    rates = halves(time_s)
    if not rates.agree(_STEADY):
        raise UserError(
            f'stamps are uneven: {rates.first_hz:.4g} and then {rates.second_hz:.4g} '
            f'a second within {time_s[-1]:.1f} s; the host stalls, or the driver '
            'stamps samples when they arrive'
        )
    present = ''.join(axis for axis, values in zip(AXES, accel_mps2.T) if values.any())
    axes = present if present in MEASURED_AXES else AXES
    if not sensor.effects:
        sensor = with_axes(sensor, axes)
    sensor = replace(sensor, rate_hz=round(rate_hz, 3))
    volts = to_volts(accel_mps2[:, : len(sensor.axes)], sensor)
    sensor, lines = _measured(sensor, time_s, volts)
    return (
        replace(sensor, measured=(*sensor.measured, 'rate_hz')),
        [
            f'rate: {sensor.rate_hz:.4g} Hz, axes: {sensor.axes}',
            *lines,
            *([f'left out: {backward}'] if late_ns.any() else []),
        ],
    )


def _by_axis(sensor: Sensor, values_g: np.ndarray) -> str:
    return ', '.join(f'{axis} {value * 1e3:.2g} mg' for axis, value in zip(sensor.axes, values_g))


_SEGMENT_S = 1.0  # Length of a segment of the periodogram, s. Chosen: several fit into a rest
_MIN_SEGMENT_SAMPLES = 16  # Fewest samples of a segment. Chosen: fewer show no filter
_LOWEST_BINS = 2  # Highest bin that is left out: mean, drift and flicker dominate in bins 0 to 2
_INDEPENDENT_SEGMENTS = 0.95  # Independent periodograms a segment: Hann, half overlap
_CORRELATED_ORDINATES = 35 / 18  # Ordinates a degree of freedom behind a Hann window
_ADC_NOISE_PRIOR_STD = 0.7  # Prior std of ln(ADC variance / (LSB²/12)). Chosen: factor 2
_MIN_VARIANCE_V2 = 1e-18  # Lower bound of the start value of the noise variance, V²
_MIN_LSB_V = 1e-9  # Lower bound of the ADC's step, V, for samples without rounding
_LOG_STEP = 1e-4  # Step of the central differences, in the logarithm of a parameter
_MAX_LOG = 80.0  # Largest |ln| of a parameter, so that exp stays finite
_MIN_EXPECTED_V2 = 1e-300  # Lower bound of an ordinate, V², for its logarithm
_MAX_CONDITION = 1e12  # Largest condition number of the information matrix that can be inverted
_MAX_RATIO_STD = 0.1  # Largest relative std of a credible RC. Chosen: below the ±25 % of R
_MAX_SCATTER = 2.0  # Largest relative scatter. Chosen: flicker and hum exceed it


@dataclass(frozen=True)
class FilterNoise:
    """Estimate of the filter of one axis."""

    rc_s: float  # Time constant, s
    ratio_std: float  # Relative standard deviation of the time constant
    # Mean square of the ordinates' deviations, relative to that of filtered white noise
    scatter: float

    @property
    def credible(self) -> bool:
        """Return whether the noise fits filtered white noise and determines the filter."""
        return self.scatter < _MAX_SCATTER and self.ratio_std < _MAX_RATIO_STD


def estimate_filter(
    rests: Iterable[np.ndarray], rate_hz: float, rc_s: float, lsb_v: float
) -> FilterNoise | None:
    """Estimate the RC of one axis by the likelihood of the periodogram of its rests (Whittle)."""
    # scipy.signal takes 0.3 s to import, which a calibration needs only at its end.
    from scipy.signal.windows import hann

    size = max(_MIN_SEGMENT_SAMPLES, round(_SEGMENT_S * rate_hz))
    window = hann(size, sym=False)
    window /= np.sqrt(np.sum(window**2))
    power, count = _mean_periodogram(rests, window)
    if count < 2 or not rc_s or not np.any(power):
        return None
    weight = _INDEPENDENT_SEGMENTS * count
    lags = np.correlate(window, window, 'full')[size - 1 :]
    start = np.log(
        [
            max(float(np.mean(power)) / size, lsb_v**2, _MIN_VARIANCE_V2),
            rc_s * rate_hz,
            max(lsb_v, _MIN_LSB_V) ** 2 / 12,
        ]
    )

    def cost(x: np.ndarray) -> float:
        """Return the negative log posterior for the parameters of `_expected`."""
        expected = _expected(x, lags)
        prior = ((x[2] - start[2]) / _ADC_NOISE_PRIOR_STD) ** 2
        return float(np.sum(power / expected + np.log(expected)) + prior / (2 * weight))

    best = scipy.optimize.minimize(
        cost, start, method='Nelder-Mead', options={'xatol': 1e-5, 'fatol': 1e-6, 'maxiter': 2000}
    ).x
    information = _information(best, lags, weight)
    # White noise does not show a filter.
    if np.linalg.cond(information) > _MAX_CONDITION:
        return None
    scatter = float(np.mean((power / _expected(best, lags) - 1) ** 2) * weight)
    ratio_std = float(np.sqrt(np.linalg.inv(information)[1, 1] * max(scatter, 1.0)))
    return FilterNoise(float(np.exp(best[1]) / rate_hz), ratio_std, scatter)


def _information(x: np.ndarray, lags: np.ndarray, weight: float) -> np.ndarray:
    """Return the information on the parameters of `_expected`, (3, 3), the prior included."""
    ratios = [
        np.log(_expected(x + step, lags) / _expected(x - step, lags))
        for step in _LOG_STEP * np.eye(3)
    ]
    slopes = np.array(ratios) / (2 * _LOG_STEP)
    information = slopes @ slopes.T * weight / _CORRELATED_ORDINATES
    information += np.diag([0.0, 0.0, _ADC_NOISE_PRIOR_STD**-2])
    return information


def _mean_periodogram(rests: Iterable[np.ndarray], window: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the mean periodogram of all segments above the lowest bins, V², and their number."""
    size = len(window)
    parts = np.concatenate(
        [
            np.empty((0, size)),
            *(
                sliding_window_view(volts, size)[:: size // 2]
                for volts in rests
                if len(volts) >= size
            ),
        ]
    )
    spectra = np.fft.rfft(window * (parts - parts.mean(axis=1, keepdims=True)))
    power = (np.abs(spectra) ** 2).sum(axis=0) / max(len(parts), 1)
    return power[_LOWEST_BINS + 1 :], len(parts)


def _expected(x: np.ndarray, lags: np.ndarray) -> np.ndarray:
    """Return the expected periodogram, V², for the logarithms of σ², RC/dt and the ADC's σ²."""
    variance_v2, rc_samples, adc_variance_v2 = np.exp(np.clip(x, -_MAX_LOG, _MAX_LOG))
    covariance = variance_v2 * np.exp(-np.arange(len(lags)) / rc_samples)
    covariance[0] += adc_variance_v2
    terms = covariance * lags
    expected = 2 * np.fft.rfft(terms).real - terms[0]
    return np.maximum(expected[_LOWEST_BINS + 1 :], _MIN_EXPECTED_V2)


def with_filter(
    fitted: Sensor, estimates: Sequence[Sequence[FilterNoise | None]]
) -> tuple[Sensor, list[str]]:
    """Add the effect `bandwidth` with its variance to a fitted sensor."""
    if not fitted.rc_s or not estimates:
        return fitted, []
    ratios = []
    variances = []
    for axis, axis_estimates in zip(fitted.axes, zip(*estimates)):
        credible = [
            estimate for estimate in axis_estimates if estimate is not None and estimate.credible
        ]
        if not credible:
            return fitted, [
                f'{axis}: the noise at rest does not fit white noise behind the '
                'stated filter; the fit keeps the stated resistor'
            ]
        weights = np.array([estimate.ratio_std**-2 for estimate in credible])
        rc_s = np.average([estimate.rc_s for estimate in credible], weights=weights)
        ratios.append(rc_s / fitted.rc_s - 1)
        variances.append((rc_s / fitted.rc_s) ** 2 / weights.sum())
    names = names_of(effect_named('bandwidth'), fitted.axes)
    filtered = put(with_neutral(fitted, ['bandwidth']), names, ratios)
    return replace(
        filtered,
        covariance=scipy.linalg.block_diag(fitted.covariance, np.diag(variances)),
        covariance_names=(*fitted.covariance_names, *names),
    ), []


CERTAIN_CORRELATION = 0.9  # Correlation that identifies an axis. Chosen: errors cost few percent


@dataclass(frozen=True)
class PolarityFault:
    """An axis that does not follow its reference."""

    axis: int  # Index of the measured axis
    follows: int  # Index of the reference axis that it follows: its own if it is inverted
    correlation: float  # Correlation with that reference, −1 to 1

    def describe(self, axis: str, reference: str) -> str:
        """Return the fault and its remedy as one line."""
        if axis == reference:
            return (
                f'{axis} reads against its reference (correlation {self.correlation:.2f}): '
                'the axis is inverted; correct its sign or the mounting'
            )
        sign = 'against' if self.correlation < 0 else 'with'
        return (
            f'{axis} moves {sign} the reference of {reference} (correlation '
            f'{self.correlation:.2f}): axes are swapped; correct the wiring or the mounting'
        )


def find_polarity_fault(
    correlation: np.ndarray, references: list[int], swap_limit: float
) -> PolarityFault | None:
    """
    Find the first axis that is inverted or follows the reference of another axis.

    correlation: of m measured axes with r reference axes, (m, r), NaN where an axis is constant;
    references: index of the reference of each measured axis, (m,).
    """
    for axis, (row, reference) in enumerate(zip(correlation, references)):
        if not np.isfinite(row[reference]):
            continue
        if row[reference] < -CERTAIN_CORRELATION:
            return PolarityFault(axis, reference, float(row[reference]))
        other = int(np.nanargmax(np.abs(row)))
        if (
            other != reference
            and abs(row[other]) > CERTAIN_CORRELATION
            and abs(row[reference]) < swap_limit
        ):
            return PolarityFault(axis, other, float(row[other]))
    return None
