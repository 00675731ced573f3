# SPDX-License-Identifier: Apache-2.0
"""
The noise of a recording beside that of its simulation, statistic by statistic.

The rms of a gap does not show effects on the noise, and the simulator gives a line a phase, and
spikes their instants, that are not those of the recording. The same statistic of both is compared
instead: power by band, the amplitude of a line, the rate and size of spikes, the share of
repeated samples, the distance of codes, the level of the noise.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

from adxl_ros.diagnose.comparison import BaselineComparison
from adxl_ros.diagnose.detection import Detection
from adxl_ros.diagnose.noise_effects import line_amplitude_v, periodogram, white_noise_v
from adxl_ros.diagnose.sample_faults import code_step_v, isolated_samples, repeated_samples
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Detector
from adxl_ros.model.error_sizes import rms
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.block_statistics import bridged
import numpy as np

_BANDS = 5  # Bands of frequency in which noise is compared. Chosen: half a decade each
_LOWEST_EDGE_HZ = 0.05  # Smallest edge of a band, Hz. Chosen: a period of 20 s
_TIMES_S = (0.1, 1.0, 10.0)  # Averaging times of the Allan deviation, s. Chosen: a decade apart


class NoiseSensors(NamedTuple):
    """The sensors with which recorded and simulated noise are compared."""

    mean: Sensor  # Its mean output is subtracted from the recording
    noise: Sensor  # Its noise is drawn


def compare_noise(
    comparison: BaselineComparison, before: NoiseSensors, after: NoiseSensors, seed: int
) -> dict[str, Any]:
    """
    Return recorded noise relative to simulated noise, all axes together, before and after.

    The log likelihood is that of the recorded spectrum under the simulated power of each band
    (Whittle 1953).
    """
    rate_hz = comparison.sensor.rate_hz
    scale = comparison.scale_v_per_mps2
    times_s = [t for t in _TIMES_S if t * rate_hz >= 2 and 10 * t < len(comparison) / rate_hz]
    frequency_hz = np.fft.rfftfreq(len(comparison), 1 / rate_hz)
    edges_hz = np.geomspace(max(frequency_hz[1], _LOWEST_EDGE_HZ), rate_hz / 2, _BANDS + 1)
    edges_hz[0] = 0.0
    bands = [(frequency_hz > low) & (frequency_hz <= high) for low, high in pairwise(edges_hz)]
    counts = [round(t * rate_hz) for t in times_s]
    log_likelihoods: dict[str, float] = {}
    ratios: dict[str, Any] = {}
    for label, sensors in {'before': before, 'after': after}.items():
        recorded_v = comparison.residual_v(sensors.mean)
        simulated_v = comparison.simulated_noise_v(sensors.noise, seed)
        recorded = bridged(recorded_v, comparison.used) / scale
        simulated = bridged(simulated_v, comparison.used) / scale
        recorded_power = periodogram(recorded, rate_hz)[1]
        simulated_power = periodogram(simulated, rate_hz)[1]
        power_ratios = []
        log_likelihood = 0.0
        for band in bands:
            power = recorded_power[band]
            drawn = simulated_power[band]
            power_ratios.append(float(power.sum() / drawn.sum()))
            if band.any():
                level = drawn.mean(axis=0)
                log_likelihood -= float(np.sum(power / level + np.log(level)))
        log_likelihoods[label] = log_likelihood
        ratios[f'power_ratio_{label}'] = power_ratios
        ratios[f'allan_ratio_{label}'] = [
            rms(allan_deviation(recorded, count) / allan_deviation(simulated, count))
            for count in counts
        ]
    return {
        'recording': comparison.name,
        'bands_hz': edges_hz.tolist(),
        'allan_s': times_s,
        'log_likelihood_gain': log_likelihoods['after'] - log_likelihoods['before'],
        **ratios,
    }


def allan_deviation(values: np.ndarray, count: int) -> np.ndarray:
    """Return the overlapping Allan deviation of means of `count` samples (IEEE 1554), (m,)."""
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    second_difference = total[2 * count :] - 2 * total[count:-count] + total[: -2 * count]
    return np.sqrt(np.mean(second_difference**2, axis=0) / 2) / count


class NoiseRemainder(NamedTuple):
    """One statistic of a noise-like effect on the axis where it is largest."""

    effect: str  # Name of the effect
    quantity: str  # What is compared, for people
    unit: str  # Unit of the values: 'm/s^2', '1/s' or '1'
    axis: str  # Measured axis, or empty where all have the same value
    recorded: float  # Value in the recordings
    simulated: float  # The same in the simulation with the effect
    mean_square: float  # Mean square over axes of the values in the recordings

    @property
    def left(self) -> float:
        """Difference of both values."""
        return abs(self.recorded - self.simulated)


def noise_remainders(
    comparisons: Sequence[BaselineComparison],
    mean_sensor: Sensor,
    named_sensor: Sensor,
    detections: Sequence[Detection],
    seed: int,
) -> list[NoiseRemainder]:
    """Compare the noise-like effects of the recordings with those of their simulation."""
    # By effect, quantity and unit: pairs of recorded and simulated values, one of each recording
    values: dict[tuple[str, str, str], list] = {}
    for c in comparisons if detections else ():
        residual_v = c.residual_v(mean_sensor)
        recording = _Series(c.volts, residual_v, bridged(residual_v, c.used))
        simulation = _simulated(c, named_sensor, seed)
        for detection in detections:
            for one, other in zip(
                _statistics(c, detection, recording), _statistics(c, detection, simulation)
            ):
                key = detection.effect, one.quantity, one.unit
                values.setdefault(key, []).append((one.values, other.values))
    remainders: list[NoiseRemainder] = []
    for key, pairs in values.items():
        recorded, simulated = np.sqrt(np.mean(np.square(np.array(pairs, float)), axis=0))
        axes = named_sensor.axes
        largest = int(np.argmax(recorded))
        remainders.append(
            NoiseRemainder(
                *key,
                axes[largest] if len(recorded) == len(axes) else '',
                float(recorded[largest]),
                float(simulated[largest]),
                float(np.mean(recorded**2)),
            )
        )
    return remainders


class _Series(NamedTuple):
    """A recording, or a simulation with noise, V, (n, m) each."""

    volts: np.ndarray  # Output
    residual_v: np.ndarray  # Output minus the mean output
    noise_v: np.ndarray  # The same without samples that repeat or stand alone


def _simulated(comparison: BaselineComparison, sensor: Sensor, seed: int) -> _Series:
    """Simulate the recording with noise."""
    at_rate = comparison.at_rate(sensor)
    time_s = comparison.time_s
    volts = comparison.drawn_v(at_rate, seed)
    # What is left out of the recording is left out, and spikes and repeated samples are, too.
    changing = repeated_samples(volts, time_s, np.ones(len(volts), bool), at_rate).regular
    residual_v = volts - comparison.simulated_v(at_rate)
    used = isolated_samples(volts, residual_v, time_s, changing, at_rate).regular
    return _Series(volts, residual_v, bridged(residual_v, used & comparison.used))


class _Statistic(NamedTuple):
    """What a noise-like effect shows in one series."""

    quantity: str  # What it is, for people
    unit: str
    values: np.ndarray  # By axis, (m,), or of all, (1,)


def _statistics(
    comparison: BaselineComparison, detection: Detection, series: _Series
) -> Iterator[_Statistic]:
    """Yield what a detection shows in one series."""
    sensor = comparison.sensor
    time_s = comparison.time_s
    scale = comparison.scale_v_per_mps2
    detector = effect_named(detection.effect).diagnosis.detector
    finite = np.isfinite(series.volts).all(axis=1) & (comparison.used | comparison.disturbed)
    if detector is Detector.MAINS_LINE:
        line_hz = float(detection.values['frequency_hz'])
        amplitude_v = line_amplitude_v(series.noise_v, time_s, line_hz)
        yield _Statistic(f'line at {line_hz:.4g} Hz', 'm/s^2', amplitude_v / scale)
    elif detector is Detector.NOISE_LEVEL:
        level_v = white_noise_v(series.noise_v, sensor)
        yield _Statistic('white noise', 'm/s^2', level_v / scale)
    elif detector is Detector.ISOLATED_SAMPLES:
        lone = isolated_samples(series.volts, series.residual_v, time_s, finite, sensor)
        values = {'rate_hz': np.zeros(1), 'amplitude_v': np.zeros(len(scale))}
        for spikes in lone.detections:
            values = spikes.values
        yield _Statistic('spikes per second and axis', '1/s', np.atleast_1d(values['rate_hz']))
        yield _Statistic('size of a spike', 'm/s^2', values['amplitude_v'] / scale)
    elif detector is Detector.REPEATED_SAMPLES:
        used = repeated_samples(series.volts, time_s, finite, sensor).regular
        share = np.array([float(np.mean(~used[finite]))])
        yield _Statistic('share of repeated samples', '1', share)
    elif detector is Detector.COARSE_CODES:
        yield _Statistic('distance of codes', 'm/s^2', code_step_v(series.volts) / scale)


def floor_without(
    floor_mps2: float, remainders: Sequence[NoiseRemainder], stated_mps2: float
) -> float:
    """
    Return the noise floor, m/s², without the line and the excess noise of the recordings.

    Both are effects that a model can have, so that they are a part of the gap.
    """
    square = floor_mps2**2
    for r in remainders:
        detector = effect_named(r.effect).diagnosis.detector
        if detector is Detector.MAINS_LINE:
            square -= r.mean_square / 2
        elif detector is Detector.NOISE_LEVEL:
            square -= r.mean_square - stated_mps2**2
    return float(np.sqrt(max(square, min(stated_mps2, floor_mps2) ** 2)))
