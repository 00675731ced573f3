# SPDX-License-Identifier: Apache-2.0
"""
Noise that the residual shows beside that of a sensor: a line of the mains, and a higher level.

Both are looked for behind the RC filter, where the noise of the sensor is white.
"""

from __future__ import annotations

from adxl_ros.diagnose.comparison import BaselineComparison
from adxl_ros.diagnose.detection import Detection, detection_of
from adxl_ros.diagnose.weighing import SHARE_OF_FORM
from adxl_ros.model import noise
from adxl_ros.model.constants import MAD_TO_STD, Z_90
from adxl_ros.model.effects.base import Detector
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.block_statistics import bridged
import numpy as np
import scipy

_MAINS_HZ = (50.0, 100.0, 60.0, 120.0)  # Mains frequencies and their doubles, Hz
_MAINS_TOLERANCE_HZ = 0.6  # Largest deviation of a line, Hz. Chosen: 1 % of clock or mains
_LINE_LOWEST_HZ = 1.0  # Lowest frequency of a line, Hz. Chosen: below it slow effects are no line
_LINE_FEWEST_ORDINATES = 64
"""Fewest ordinates of a periodogram that shows a line. Chosen: their mean is then known to 1/8."""
_LOCAL_ORDINATES = 201  # Ordinates of the level around a line. Chosen: much wider than a line
LINE_LOG_EXCESS = 14.0
"""Log likelihood ratio of a line, above that of the largest ordinate by chance, from which it is a
line. Chosen: exp(−14) is one in a million."""
_LINE_PART_S = 4.0
"""Length of the parts of which the amplitude of a line is taken, s. Chosen: the phase of the mains
wanders little within it."""
_LINE_BESIDE = 4.0
"""Distance at which the power beside a line is taken, in inverse parts. Chosen: beyond the main
lobe of the window."""
NOISE_EXCESS = 1.2
"""Noise, divided by the stated noise, from which it is excessive, beyond its interval. Chosen:
units differ by less."""
_MEDIAN_SCATTER = 1.166
"""Relative standard deviation of a level by the median of n magnitudes, times √n: of normal ones,
1/(4·φ(z)·z), z = 0.6745."""
_RESTING_FEWEST = 500
"""Fewest resting samples that show excess noise. Chosen: a standard deviation of 3 %."""


def residual_detections(
    comparison: BaselineComparison, residual_v: np.ndarray, sensor: Sensor
) -> list[Detection]:
    """Find lines and excess noise in a residual, V, (n, m), beside the noise of a sensor."""
    sensor = comparison.at_rate(sensor)
    residual_v = bridged(residual_v, comparison.used)
    at_rest = comparison.at_rest & comparison.used
    white = np.diff(_innovations(residual_v, sensor)[0], axis=0)
    line = _line(white, residual_v, comparison.time_s, sensor)
    # In motion, effects that are not modelled would look like noise, so that rests are preferred.
    resting = at_rest.sum() > _RESTING_FEWEST
    # Bridges have no noise, and spread a line: both series have the same bridges, and the line.
    drawn_v = comparison.simulated_noise_v(line.added_to(sensor) if line else sensor, 0)
    excess = _excess(
        residual_v,
        bridged(drawn_v, comparison.used),
        sensor,
        at_rest if resting else comparison.used,
        resting,
    )
    return [d for d in (line, excess) if d is not None]


def _innovations(volts: np.ndarray, sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Undo the RC filter for noise: innovations of an AR(1) sequence, (n − 1, m), and its a."""
    rc_s = noise.electronics(sensor).rc_s
    decay = np.exp(-1 / (sensor.rate_hz * np.where(rc_s > 0, rc_s, 1e-9)))
    return volts[1:] - decay * volts[:-1], decay


def _excess(
    residual_v: np.ndarray,
    simulated_v: np.ndarray,
    sensor: Sensor,
    rows: np.ndarray,
    resting: bool,
) -> Detection | None:
    """Find noise above the level of drawn noise in samples, (n,) bool, that may rest."""
    recorded = white_noise_v(residual_v, sensor, rows)
    # Rounding that stays in one pose is noise in another.
    drawn = np.hypot(
        white_noise_v(simulated_v, sensor, rows), np.sqrt(noise.held_rounding_v2(sensor))
    )
    # The level of noise far below a step of the ADC does not show.
    shows = (noise.held_rounding(sensor) <= 0.5) & (drawn > 0)
    ratio = recorded / np.where(shows, drawn, np.inf)
    drawn_v = np.std(simulated_v[rows], axis=0)
    if resting:
        # Noise past the RC filter looks excessive in the innovations, but not in the samples.
        recorded_v = np.std(residual_v[rows], axis=0)
        ratio = np.minimum(ratio, recorded_v / np.where(drawn_v > 0, drawn_v, np.inf))
    # Both levels scatter.
    scatter = np.sqrt(2 / np.count_nonzero(rows)) * _MEDIAN_SCATTER
    if np.max(ratio) * (1 - Z_90 * scatter) <= NOISE_EXCESS:
        return None
    stated_v2 = noise.analog_std_v(sensor) ** 2
    power_v2 = np.maximum(ratio**2 - 1, 0.0) * stated_v2
    # A tenth of a drift may be an error of its form.
    if power_v2.sum() < SHARE_OF_FORM * (drawn_v**2 - stated_v2).sum():
        return None
    return detection_of(Detector.NOISE_LEVEL, power_v2, sensor, ratio=ratio - 1)


def periodogram(
    values: np.ndarray, rate_hz: float, window: str = 'boxcar'
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return frequencies, Hz, (k,), and spectra of m axes, (n, m); one by one, to save memory.

    They are those of `scipy.signal.periodogram`, which takes eight times as long.
    """
    count = len(values)
    weights = scipy.signal.get_window(window, count)
    spectra = [np.abs(np.fft.rfft(weights * (v - v.mean()))) ** 2 for v in values.T]
    power = 2 / (rate_hz * np.sum(weights**2)) * np.array(spectra).T
    # The mean has one side alone, and so has half of an even rate.
    power[0] /= 2
    power[-1] /= 2 - count % 2
    return np.fft.rfftfreq(count, 1 / rate_hz), power


def white_noise_v(
    noise_v: np.ndarray, sensor: Sensor, rows: np.ndarray | None = None
) -> np.ndarray:
    """
    Estimate the standard deviation of the white noise behind the RC filter, V, (m,).

    The median over the upper half of the frequencies ignores lines, drift and motion. That over
    first differences of samples, (n,) bool, ignores spikes. The smaller one counts.
    """
    innovations, decay = _innovations(noise_v, sensor)
    frequency_hz, power = periodogram(innovations, sensor.rate_hz, 'hann')
    level = np.median(power[frequency_hz > sensor.rate_hz / 4], axis=0) / np.log(2)
    changes = np.abs(np.diff(innovations, axis=0)) / np.sqrt(2)
    std = np.minimum(
        np.sqrt(level * sensor.rate_hz / 2),
        MAD_TO_STD * np.median(changes if rows is None else changes[rows[2:]], axis=0),
    )
    return std / np.sqrt(1 - decay**2)


def _line(
    white: np.ndarray, residual_v: np.ndarray, time_s: np.ndarray, sensor: Sensor
) -> Detection | None:
    """Return the mains line that is the strongest of a whitened residual, or None."""
    frequency_hz, power = periodogram(white, sensor.rate_hz, 'hann')
    kept = frequency_hz > _LINE_LOWEST_HZ
    frequency_hz = frequency_hz[kept]
    power = power[kept]
    if len(frequency_hz) < _LINE_FEWEST_ORDINATES:
        return None
    # The local level is the mean of the ordinates around, by their median.
    width = min(_LOCAL_ORDINATES, len(power))
    blocks = len(power) // width
    level = np.median(power[: blocks * width].reshape(blocks, width, -1), axis=1) / np.log(2)
    middles = (np.arange(blocks) + 0.5) * width
    excess = sum(p / np.interp(np.arange(len(p)), middles, v) for p, v in zip(power.T, level.T))
    best = int(np.argmax(excess))
    log_excess = float(excess[best]) - np.log(len(frequency_hz)) - len(sensor.axes)
    mains_hz = _mains_frequency_hz(float(frequency_hz[best]), sensor.rate_hz)
    if not log_excess >= LINE_LOG_EXCESS or mains_hz is None:
        return None
    amplitude_v = line_amplitude_v(residual_v, time_s, mains_hz)
    return detection_of(
        Detector.MAINS_LINE,
        amplitude_v**2 / 2,
        sensor,
        amplitude_v=amplitude_v,
        frequency_hz=mains_hz,
        phase_rad=0.0,
    )


def line_amplitude_v(values_v: np.ndarray, time_s: np.ndarray, line_hz: float) -> np.ndarray:
    """
    Estimate the amplitude of a line whose phase may wander, V, (m,).

    It is the rms of the amplitudes of short parts, without the power beside the line.
    """
    parts = max(len(values_v) // max(int(np.searchsorted(time_s, time_s[0] + _LINE_PART_S)), 1), 1)
    length = len(values_v) // parts
    window = np.hanning(length + 2)[1:-1]
    at_s = time_s[: parts * length].reshape(parts, length)
    series = values_v[: parts * length].reshape(parts, length, -1)
    squares = []
    for offset in (0.0, -_LINE_BESIDE, _LINE_BESIDE):
        turn = np.exp(-2j * np.pi * (line_hz + offset / _LINE_PART_S) * at_s) * window
        peaks = 2 * np.einsum('pl,plm->pm', turn, series) / window.sum()
        squares.append(np.mean(np.abs(peaks) ** 2, axis=0))
    return np.sqrt(np.maximum(squares[0] - (squares[1] + squares[2]) / 2, 0.0))


def _mains_frequency_hz(line_hz: float, rate_hz: float) -> float | None:
    """Return the true frequency of a line that is an alias of the mains or its double."""
    for mains_hz in _MAINS_HZ:
        folded_hz = (mains_hz + rate_hz / 2) % rate_hz - rate_hz / 2
        deviation_hz = line_hz - abs(folded_hz)
        if abs(deviation_hz) < _MAINS_TOLERANCE_HZ:
            return mains_hz + (deviation_hz if folded_hz >= 0 else -deviation_hz)
    return None
