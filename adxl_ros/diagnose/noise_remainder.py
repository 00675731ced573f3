# SPDX-License-Identifier: Apache-2.0

"""
What remains of noise-like effects after they are added to the simulation.

The simulator gives a line a phase, and spikes their instants, that are not those of the recording.
Recording minus simulation therefore does not shrink. The same statistic of both is compared
instead: the amplitude of the line, the rate and size of the spikes, the share of repeated samples,
the distance of codes, the level of the noise, the Allan deviation of a drift.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from adxl_ros.diagnose import noise_detectors
from adxl_ros.diagnose.comparison import at_search_rate, BaselineComparison
from adxl_ros.diagnose.evidence import bridged
from adxl_ros.diagnose.noise_comparison import allan_deviation
from adxl_ros.diagnose.noise_detectors import Detection
from adxl_ros.diagnose.noise_whitening import drifts_among
from adxl_ros.model.diagnosis_hints import Detector
from adxl_ros.model.effects import effect_named
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate.response import Response
import numpy as np

_DRAWS = 4
"""Number of drawn recordings of a drift. Chosen: the Allan deviation of one minute varies by a
fifth."""
_HARMONICS = (2, 3)
"""Harmonics of a line that are looked for. Chosen: mains hum has these, behind rectifiers."""
_HARMONIC_SHARE = 0.2
"""Smallest amplitude of a harmonic, divided by that of the line. Chosen: its square is then 4 % of
that of the line."""
_DISTINCT_HZ = 1.0
"""Smallest distance of the frequencies of two lines, Hz. Chosen: a few widths of a line."""
_LONGEST_ALLAN_S = 10.0
"""Longest averaging time of the Allan deviation of a drift, s. Chosen: white noise is small
beside it."""
_ALLAN_WINDOWS = 10
"""Length of the shortest recording, in averaging times. Chosen: fewer means scatter by more."""


@dataclass(frozen=True)
class NoiseRemainder:
    """One statistic of a noise-like effect, in the recordings and in their simulation."""

    effect: str  # Name of the effect
    quantity: str  # What is compared, for people
    unit: str  # Unit of the values: 'm/s^2', '1/s' or '1'
    axes: str  # Measured axes, or empty where all have the same value
    recorded: np.ndarray  # Value in the recordings by axis, (m,) or (1,)
    simulated: np.ndarray  # The same in the simulation with the effect

    @property
    def largest(self) -> int:
        """Return the number of the axis on which the recorded value is largest."""
        return int(np.argmax(self.recorded))

    @property
    def remains(self) -> np.ndarray:
        """Return the magnitude of recorded minus simulated, in the shape of `recorded`."""
        return np.abs(self.recorded - self.simulated)


@dataclass(frozen=True)
class _Series:
    """One recording or its simulation: `volts`, and `noise_v` about its mean, V, (n, m) each."""

    volts: np.ndarray
    noise_v: np.ndarray


def noise_remainders(comparisons: Sequence[BaselineComparison], mean_sensor: Sensor,
                     named_sensor: Sensor, detections: Sequence[Detection], seed: int
                     ) -> list[NoiseRemainder]:
    """Compare the noise-like effects of the recordings with those of their simulation."""
    named = [d for d in detections if d.effect != noise_detectors.UNKNOWN]
    remainders: list[NoiseRemainder] = []
    pairs = [(c, _recorded(c, mean_sensor), _simulated(c, named_sensor, seed))
             for c in comparisons] if named else []
    for detection in named:
        if effect_named(detection.effect).diagnosis.detector is Detector.MAINS_LINE:
            remainders += _lines(detection, named_sensor.axes, pairs)
            continue
        for quantity, unit, statistic in _statistics(detection, named_sensor):
            remainders.append(_remainder(
                detection.effect, quantity, unit, named_sensor.axes,
                [(statistic(c, recorded), statistic(c, simulated))
                 for c, recorded, simulated in pairs]))
    averaging_s = min(_LONGEST_ALLAN_S, min(c.span_s for c in comparisons) / _ALLAN_WINDOWS)
    for drift in drifts_among(named_sensor.effects):
        remainders.append(_remainder(
            drift, f'Allan deviation at {averaging_s:.2g} s', 'm/s^2', named_sensor.axes,
            [_allan_values(at_search_rate(c), mean_sensor, named_sensor, averaging_s, seed)
             for c in comparisons]))
    return remainders


def _lines(detection: Detection, axes: str,
           pairs: Sequence[tuple[BaselineComparison, _Series, _Series]]) -> list[NoiseRemainder]:
    """Return a line, and those of its harmonics that show; no effect models the harmonics."""
    hz = float(detection.values['frequency_hz'])
    rate_hz = min(c.sensor.rate_hz for c, _, _ in pairs)
    line = _line_remainder(detection.effect, hz, axes, pairs)
    lines = [line]
    aliases_hz = [_alias_hz(hz, rate_hz)]
    for k in _HARMONICS:
        alias_hz = _alias_hz(k * hz, rate_hz)
        if min(abs(alias_hz - other) for other in (0.0, *aliases_hz)) < _DISTINCT_HZ:
            continue
        aliases_hz.append(alias_hz)
        harmonic = _line_remainder(detection.effect, k * hz, axes, pairs)
        if harmonic.recorded.max() > _HARMONIC_SHARE * line.recorded.max():
            lines.append(harmonic)
    return lines


def _alias_hz(frequency_hz: float, rate_hz: float) -> float:
    """Return the frequency at which a line shows."""
    return abs((frequency_hz + rate_hz / 2) % rate_hz - rate_hz / 2)


def _line_remainder(effect: str, hz: float, axes: str,
                    pairs: Sequence[tuple[BaselineComparison, _Series, _Series]]
                    ) -> NoiseRemainder:
    """Compare the amplitudes of a line."""
    def amplitude(comparison: BaselineComparison, series: _Series) -> np.ndarray:
        """Return the amplitude in one series, m/s², (m,)."""
        return noise_detectors.line_amplitude_v(series.noise_v, comparison.time_s, hz) \
            / comparison.scale_v_per_mps2

    return _remainder(effect, f'line at {hz:.4g} Hz', 'm/s^2', axes, [
        (amplitude(c, recorded), amplitude(c, simulated)) for c, recorded, simulated in pairs])


def _remainder(effect: str, quantity: str, unit: str, axes: str,
               values: Sequence[tuple[np.ndarray, np.ndarray]]) -> NoiseRemainder:
    """Return the rms over recordings of pairs of recorded and simulated values."""
    recorded, simulated = np.sqrt(np.mean(np.square(np.array(values, float)), axis=0))
    return NoiseRemainder(effect, quantity, unit, axes if len(recorded) == len(axes) else '',
                          recorded, simulated)


def _recorded(comparison: BaselineComparison, mean_sensor: Sensor) -> _Series:
    """Return the recording, and its residual, bridged over samples that are not used."""
    return _Series(comparison.volts,
                   bridged(comparison.residual_v(mean_sensor), comparison.used))


def _simulated(comparison: BaselineComparison, sensor: Sensor, seed: int) -> _Series:
    """Simulate the recording with noise."""
    at_rate, time_s = replace(sensor, rate_hz=comparison.sensor.rate_hz), comparison.time_s
    volts = Response(at_rate, comparison.motion, seed, float(time_s[0]))(time_s)
    # Spikes and repeated samples are left out, as those of the recording are.
    used, _ = noise_detectors.repeated_samples(volts, time_s, np.ones(len(volts), bool), at_rate)
    used, _ = noise_detectors.isolated_samples(volts, time_s, used, at_rate)
    return _Series(volts, bridged(volts - comparison.simulated_v(at_rate), used))


_Statistic = Callable[[BaselineComparison, _Series], np.ndarray]
"""Statistic of a series by axis, (m,)."""


def _statistics(detection: Detection, sensor: Sensor) -> list[tuple[str, str, _Statistic]]:
    """Return quantity, unit and statistic of what a detection shows."""
    detector = effect_named(detection.effect).diagnosis.detector
    if detector is Detector.NOISE_LEVEL:
        return [('white noise', 'm/s^2', lambda c, s: noise_detectors.white_noise_v(
            s.noise_v, c.sensor) / c.scale_v_per_mps2)]
    if detector is Detector.ISOLATED_SAMPLES:
        return [('spikes per second and axis', '1/s', lambda c, s: _spikes(c, s)[0]),
                ('size of a spike', 'm/s^2', lambda c, s: _spikes(c, s)[1])]
    if detector is Detector.REPEATED_SAMPLES:
        return [('share of repeated samples', '1', _repeated_share)]
    stated = replace(sensor, effects=(), values={})
    return [('distance of codes', 'm/s^2', lambda c, s: _code_distance(c, s, stated))]


def _spikes(comparison: BaselineComparison, series: _Series) -> tuple[np.ndarray, np.ndarray]:
    """Return the rate of spikes, 1/s, (1,), and their median size, m/s², (m,)."""
    finite = np.isfinite(series.volts).all(axis=1)
    _, spikes = noise_detectors.isolated_samples(series.volts, comparison.time_s, finite,
                                                 comparison.sensor)
    if spikes is None:
        return np.zeros(1), np.zeros(len(comparison.sensor.axes))
    return (np.atleast_1d(spikes.values['rate_hz']),
            spikes.values['amplitude_v'] / comparison.scale_v_per_mps2)


def _repeated_share(comparison: BaselineComparison, series: _Series) -> np.ndarray:
    """Return the share of samples that repeat the one before, (1,)."""
    finite = np.isfinite(series.volts).all(axis=1)
    used, _ = noise_detectors.repeated_samples(series.volts, comparison.time_s, finite,
                                               comparison.sensor)
    return np.array([float(np.mean(finite & ~used))])


def _code_distance(comparison: BaselineComparison, series: _Series, stated: Sensor) -> np.ndarray:
    """Return the distance of the codes of an ADC that has the stated bits, m/s², (m,)."""
    coarse = noise_detectors.coarse_codes(series.volts, stated)
    lost_bits = 0.0 if coarse is None \
        else coarse.values['lost_bits'] + coarse.values['axis_lost_bits']
    return stated.lsb_v * 2 ** lost_bits / comparison.scale_v_per_mps2


def _allan_values(comparison: BaselineComparison, mean_sensor: Sensor, named_sensor: Sensor,
                  averaging_s: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return Allan deviations of the recording and of the simulation, m/s², (m,) each."""
    count = round(averaging_s * comparison.sensor.rate_hz)
    recorded_v = bridged(comparison.residual_v(mean_sensor), comparison.used)
    squares = [allan_deviation(comparison.simulated_noise_v(named_sensor, seed + i), count) ** 2
               for i in range(_DRAWS)]
    return (allan_deviation(recorded_v, count) / comparison.scale_v_per_mps2,
            np.sqrt(np.mean(squares, axis=0)) / comparison.scale_v_per_mps2)


def floor_without(floor_mps2: float, remainders: Sequence[NoiseRemainder], stated_mps2: float
                  ) -> float:
    """
    Return the noise floor without the line and the excess noise of the recordings.

    Both are effects that a model can have, so that they are a part of the gap.

    returns: noise floor, m/s².
    """
    square = floor_mps2 ** 2
    for r in remainders:
        detector = effect_named(r.effect).diagnosis.detector
        recorded_square = float(np.mean(r.recorded ** 2))
        if detector is Detector.MAINS_LINE:
            square -= recorded_square / 2
        elif detector is Detector.NOISE_LEVEL:
            square -= recorded_square - stated_mps2 ** 2
    return float(np.sqrt(max(square, min(stated_mps2, floor_mps2) ** 2)))
