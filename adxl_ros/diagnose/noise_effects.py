# SPDX-License-Identifier: Apache-2.0
"""
Effects that show in the statistics of the noise and not in the mean.

An effect names its detector in its own file; the detector estimates its parameters. The rms of a
gap does not show such effects, and the simulator gives a line a phase, and spikes their instants,
that are not those of the recording. The same statistic of recording and simulation is compared
instead: power by band, the amplitude of a line, the rate and size of spikes, the share of
repeated samples, the distance of codes, the level of the noise, the Allan deviation of a drift.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

from adxl_ros.diagnose.comparison import at_search_rate, BaselineComparison
from adxl_ros.diagnose.evidence import bridged
from adxl_ros.diagnose.noise_model import drifts_among
from adxl_ros.model import noise
from adxl_ros.model.constants import MAD_TO_STD
from adxl_ros.model.diagnosis_hints import Detector
from adxl_ros.model.effects import effect_named, library
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.block_statistics import true_runs
from adxl_ros.simulate.response import Response
import numpy as np
import scipy

UNKNOWN = 'unknown'
"""Name of what no effect of the library explains."""
_MAINS_HZ = (50.0, 60.0)
"""Mains frequencies, Hz."""
_MAINS_TOLERANCE_HZ = 0.6
"""Largest deviation of a mains line, Hz. Chosen: 1 % of the clock or of the mains."""
_LINE_LOWEST_HZ = 1.0
"""Lowest frequency of a line, Hz. Chosen: below it the residual of slow effects is no line."""
_LINE_FEWEST_ORDINATES = 64
"""Fewest ordinates of a periodogram in which a line is looked for. Chosen: their level needs
some."""
LINE_LOG_EXCESS = 14.0
"""Log likelihood ratio of a line, above that of the largest ordinate by chance, from which it is a
line. Chosen: exp(−14) is one in a million."""
_LOCAL_ORDINATES = 201
"""Ordinates over which the local level of a periodogram is taken. Chosen: much wider than a
line."""
_LINE_PART_S = 4.0
"""Length of the parts of which the amplitude of a line is taken, s. Chosen: the phase of the mains
wanders little within it."""
_LINE_BESIDE = 4.0
"""Distance at which the power beside a line is taken, in inverse parts. Chosen: beyond the main
lobe of the window."""
SPIKE_STDS = 7.0
"""Deviation of a spike from its neighbours, in robust standard deviations. Chosen: normal noise
exceeds it once in 4·10¹¹ samples."""
_SPIKE_FEWEST = 3
"""Fewest spikes of an axis. Chosen: one or two may be anything."""
_SPIKE_NEIGHBOUR = 2
"""Distance of the neighbours to which a sample is compared, samples. Chosen: beyond the sample
next to it, which an RC filter shares."""
_SPIKE_LOCAL_S = 0.2
"""Width of the blocks of the local scale, s. Chosen: shorter than a move of the stage."""
_SPIKE_LOCAL_FEWEST = 9
"""Fewest samples of such a block. Chosen: a median of nine."""
_SPIKE_LOG_BAYES_FACTOR = 10.0
"""Log Bayes factor of one isolated sample, rough: it only ranks detections."""
NOISE_EXCESS = 1.2
"""Noise, divided by the stated noise, from which it is excessive. Chosen: units differ by less."""
COARSE_STEPS = 1.6
"""Distance of codes, in stated steps, from which codes are coarse. Chosen: between 1 and 2."""
_SMALLEST_CODE_STEPS = 0.3
"""Distance of two values, in stated steps, below which they are one code. Chosen: below half a
step."""
_NEAREST_CODES_RATIO = 1.5
"""Distance of codes, divided by the smallest one, up to which no code lies between them. Chosen:
between 1 and 2."""
_BETWEEN_CODES_STEPS = 0.2
"""Distance from a multiple of the step, in steps, at which a value is between codes. Chosen: far
above rounding."""
_BETWEEN_CODES_SHARE = 0.1
"""Share of values between codes from which the step is no step of the ADC. Chosen: a curve of the
converter moves some codes."""
_COARSE_LOG_BAYES_FACTOR = 1e3
"""Log Bayes factor of coarse codes, rough: there is no other explanation."""
_CONSTANT_V = 1e3
"""Smallest change of an output that never changes, V. Chosen: above any change."""
_CODES_FEWEST = 8
"""Fewest distances between codes from which their step is estimated. Chosen: a median."""
_RESTING_FEWEST = 500
"""Fewest resting samples from which the level of the noise is estimated. Chosen: its standard
deviation is then 3 %."""
_LINE_REST_S = 10.0
"""Shortest total rest that can show a line of another frequency than the mains, s. Chosen: a
resolution of 0.1 Hz."""
_LEVEL_CELL = 0.02
"""Width of a level, as a share of the range of the output. Spikes are counted by level. Chosen:
wider than the noise in a slow motion."""
_LEVEL_RARITY = 4.0
"""Spikes cluster if the levels at which they occur hold less than 1/4, the inverse of this, of all
samples. Tuned by hand on simulated recordings of the working seeds of the blind check."""
_LEVEL_FEWEST = 10
"""Fewest spikes of which the levels are compared. Chosen: fewer say little."""
_REPEAT_CHANCE = 1e-4
"""Probability of one run of equal samples by chance in a recording. Chosen: one in 10⁴
recordings."""
_REPEAT_SHORTEST = 3
"""Shortest run of equal samples, samples. Chosen: two may be equal by rounding."""
_REPEAT_PROBABILITY_ONE_AXIS = 0.05
"""Smallest assumed probability that a sample of one axis equals the last one. Chosen: in
10⁵ samples, chance then explains runs of up to 7."""
_REPEAT_PROBABILITY_MORE_AXES = 1e-3
"""The same for all of several axes. Chosen: in 10⁵ samples, runs of up to 3."""
_REPEAT_LARGEST_PROBABILITY = 0.5
"""Largest assumed probability of the same. Chosen: in 10⁵ samples, runs of up to 30."""
_REPEAT_LOG_BAYES_FACTOR = 5.0
"""Log Bayes factor of one run of equal samples, rough: it only ranks detections."""


@dataclass(frozen=True)
class Detection:
    """One noise-like effect that shows."""

    effect: str  # Name of the effect; 'unknown' for a line that is no mains frequency
    values: dict[str, np.ndarray]  # Parameters of the effect by name, (m,) or () each
    log_bayes_factor: float  # Approximate log Bayes factor of the effect
    message: str  # What was found, for people


def detected_effect(detector: Detector) -> str:
    """Return the name of the effect that a detector shows."""
    return next(e.name for e in library().values() if e.diagnosis.detector is detector)


def repeated_samples(volts: np.ndarray, time_s: np.ndarray, used: np.ndarray, sensor: Sensor
                     ) -> tuple[np.ndarray, list[Detection]]:
    """
    Find samples that repeat the one before in all axes, in runs too long for chance.

    volts: as recorded, V, (n, m); time_s: stamps, s, (n,); used: samples that are used so far,
    (n,) bool; returns: the samples that are used, (n,) bool, and the detection or none.
    """
    same = np.concatenate([[False], (np.diff(volts, axis=0) == 0).all(axis=1)])
    shortest = shortest_repeat(volts, len(sensor.axes))
    repeated = np.zeros(len(volts), bool)
    for begin, end in true_runs(same):
        if end - begin >= shortest:
            repeated[begin:end] = True
    repeated &= used
    if not repeated.any():
        return used, []
    repeats = true_runs(repeated)
    duration_s = float(np.median([time_s[end - 1] - time_s[begin] for begin, end in repeats]))
    return used & ~repeated, [Detection(detected_effect(Detector.REPEATED_SAMPLES), {
        'rate_hz': np.array(len(repeats) / float(time_s[-1] - time_s[0])),
        'duration_s': np.array(max(duration_s + 1 / sensor.rate_hz, 1 / sensor.rate_hz))},
        _REPEAT_LOG_BAYES_FACTOR * len(repeats),
        f'samples repeat {len(repeats)} times, for {duration_s:.3g} s (median)')]


def shortest_repeat(volts: np.ndarray, axes: int) -> int:
    """Return how many equal samples, (n, m), in a row are too many for chance."""
    # Neighbours are correlated, so that the root of the independent probability is safe.
    probability = float(np.sqrt(np.prod([np.mean(np.diff(v) == 0) for v in volts.T])))
    smallest = _REPEAT_PROBABILITY_MORE_AXES if axes > 1 else _REPEAT_PROBABILITY_ONE_AXIS
    probability = min(max(probability, smallest), _REPEAT_LARGEST_PROBABILITY)
    by_chance = int(np.ceil(np.log(_REPEAT_CHANCE / len(volts)) / np.log(probability)))
    return max(_REPEAT_SHORTEST, by_chance)


def isolated_samples(volts: np.ndarray, time_s: np.ndarray, used: np.ndarray, sensor: Sensor
                     ) -> tuple[np.ndarray, Detection | None]:
    """
    Find single samples that deviate from the straight line between their neighbours.

    volts: as recorded, V, (n, m); time_s: stamps, s, (n,); used: samples that are used so far,
    (n,) bool; returns: the samples that are used, (n,) bool, and the detection or None.
    """
    spikes, size_v = _spikes(volts, used, sensor)
    if not spikes.any() or _at_few_levels(volts, spikes):
        return used, None
    count = int(spikes.any(axis=1).sum())
    rate_hz = spikes.sum() / len(sensor.axes) / float(time_s[-1] - time_s[0])
    return used & ~spikes.any(axis=1), Detection(
        detected_effect(Detector.ISOLATED_SAMPLES),
        {'rate_hz': np.array(rate_hz), 'amplitude_v': size_v}, _SPIKE_LOG_BAYES_FACTOR * count,
        f'{count} single samples deviate, by up to {size_v.max() * 1e3:.3g} mV (median by axis)')


def residual_shows_spikes(spikes: Detection, residual_v: np.ndarray, used: np.ndarray,
                          sensor: Sensor) -> bool:
    """
    Determine whether the residual of the best hypothesis shows the spikes of the recording.

    Without this check, motion of the sensor may look like spikes.

    residual_v: residual, V, (n, m); used: samples that are used, (n,) bool; spikes are not among
    them.
    """
    isolated, _ = _spikes(residual_v, np.isfinite(residual_v).all(axis=1), sensor)
    expected = float(spikes.values['rate_hz']) * len(sensor.axes) * len(used) / sensor.rate_hz
    return bool(isolated[~used].sum() > expected / 2)


def _spikes(volts: np.ndarray, used: np.ndarray, sensor: Sensor
            ) -> tuple[np.ndarray, np.ndarray]:
    """Return isolated samples, (n, m) bool, and their median size by axis, V, (m,)."""
    near = _SPIKE_NEIGHBOUR
    deviation_v = volts - (np.roll(volts, near, 0) + np.roll(volts, -near, 0)) / 2
    isolated, size_v = np.zeros(volts.shape, bool), np.zeros(volts.shape[1])
    step_v = np.where(code_step_v(volts) < _CONSTANT_V, code_step_v(volts), 0.0)
    # The first samples after repeated or missing ones may step, which is no spike.
    undisturbed = np.convolve(used, np.ones(4 * near + 1), 'same') > 4 * near
    for d, deviation in enumerate(deviation_v.T):
        # The rounding of a file makes steps, which are no spikes.
        std_v = max(MAD_TO_STD * np.nanmedian(np.abs(deviation[used])), step_v[d])
        # Motion also deviates from the line, so that a spike must exceed its surroundings, too.
        local_v = _local_std(np.nan_to_num(deviation),
                             round(max(sensor.rate_hz * _SPIKE_LOCAL_S, _SPIKE_LOCAL_FEWEST)))
        outside = (np.abs(deviation)
                   > SPIKE_STDS * np.maximum(local_v, max(std_v, sensor.lsb_v))) & undisturbed
        outside[:near] = outside[-near:] = False
        # The neighbours of a spike deviate by half of it.
        peak = np.abs(deviation) >= np.maximum.reduce([
            np.abs(np.roll(deviation, k)) for k in range(-near, near + 1)])
        axis_spikes = outside & peak
        if axis_spikes.sum() >= _SPIKE_FEWEST:
            isolated[:, d] = axis_spikes
            size_v[d] = float(np.median(np.abs(deviation[axis_spikes])))
    return isolated, size_v


def _at_few_levels(volts: np.ndarray, spikes: np.ndarray) -> bool:
    """Determine whether spikes cluster at some levels, as steps of an ADC do."""
    expected, count = 0.0, 0
    for v, isolated in zip(volts.T, spikes.T):
        level = np.floor(v / (_LEVEL_CELL * max(np.nanmax(v) - np.nanmin(v), 1e-9)))
        level_before = np.roll(level, _SPIKE_NEIGHBOUR)
        at_levels = np.isin(level_before, np.unique(level_before[isolated]))
        expected += float(at_levels.mean()) * isolated.sum()
        count += int(isolated.sum())
    return bool(count > _LEVEL_FEWEST and expected / count < 1 / _LEVEL_RARITY)


def _local_std(values: np.ndarray, width: int) -> np.ndarray:
    """Return a robust standard deviation around each value, interpolated between blocks."""
    count = max(len(values) // width, 1)
    blocks = np.abs(values[:count * width]).reshape(count, -1)
    std = MAD_TO_STD * np.median(blocks, axis=1)
    return np.interp(np.arange(len(values)), (np.arange(count) + 0.5) * width, std)


def coarse_codes(volts: np.ndarray, sensor: Sensor) -> Detection | None:
    """
    Find an ADC whose codes are coarser than stated, on all axes or on some.

    volts: as recorded, V, (n, m).
    """
    if not sensor.lsb_v:
        return None
    bits, threshold = np.array([_lost_bits(v, sensor) for v in volts.T]), np.log2(COARSE_STEPS)
    if not (bits >= threshold).any():
        return None
    common = 0.0
    if not (bits < threshold).any():
        common = float(np.nanmedian(bits) if np.nanmax(bits) - np.nanmin(bits) < threshold
                       else np.nanmin(bits))
    further = np.where(bits - common >= threshold, bits - common, 0.0)
    where = '' if common or len(bits) == 1 else ' on ' + ', '.join(
        axis for axis, lost in zip(sensor.axes, further) if lost)
    return Detection(detected_effect(Detector.COARSE_CODES), {
        'lost_bits': np.array(common), 'axis_lost_bits': further}, _COARSE_LOG_BAYES_FACTOR,
        f'codes are {2 ** np.nanmax(bits):.3g} steps apart{where}')


def code_step_v(volts: np.ndarray) -> np.ndarray:
    """
    Return the smallest change of the output on each axis.

    volts: as recorded, V, (n, m); returns: changes, V, (m,); 1000 V for an axis that never
    changes.
    """
    changes_v = np.abs(np.diff(volts, axis=0))
    return np.min(changes_v, axis=0, initial=_CONSTANT_V, where=changes_v > 0)


def _lost_bits(volts: np.ndarray, sensor: Sensor) -> float:
    """Return how many bits the codes of one axis, V, (n,), lack; NaN where too few differ."""
    values_v = np.unique(volts[np.isfinite(volts)])
    distance_v = np.diff(values_v)
    distance_v = distance_v[distance_v > sensor.lsb_v * _SMALLEST_CODE_STEPS]
    if len(distance_v) < _CODES_FEWEST:
        return float('nan')
    step_v = float(np.median(distance_v[distance_v < _NEAREST_CODES_RATIO * distance_v.min()]))
    # A slow motion through few samples leaves codes out; all multiples of a step are occupied.
    whole_steps = distance_v / step_v
    between = np.abs(whole_steps - np.rint(whole_steps)) > _BETWEEN_CODES_STEPS
    if between.mean() > _BETWEEN_CODES_SHARE:
        return 0.0
    return float(np.log2(step_v / sensor.lsb_v))


@dataclass(frozen=True)
class NoiseSamples:
    """The residual of the best hypothesis beside drawn noise, n samples of m axes."""

    time_s: np.ndarray  # Stamps, s, (n,)
    residual_v: np.ndarray  # Residual, bridged over samples that are not used, V, (n, m)
    simulated_v: np.ndarray  # Noise that the simulator draws, V, (n, m)
    at_rest: np.ndarray  # Samples that rest and are used, (n,) bool
    used: np.ndarray  # Samples that are used, (n,) bool


def residual_detections(samples: NoiseSamples, sensor: Sensor) -> list[Detection]:
    """Find lines and excess noise in the residual of the best hypothesis."""
    # First differences remove a zero-g that drifts.
    white = np.diff(_before_filter(samples.residual_v, sensor), axis=0)
    at_rest = samples.at_rest[2:]
    detections = [_line(white, at_rest, samples, sensor), _excess(white, at_rest, samples, sensor)]
    return [detection for detection in detections if detection is not None]


def _before_filter(volts: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Undo the RC filter for noise: innovations of an AR(1) sequence, (n − 1, m)."""
    rc_s = noise.electronics(sensor).rc_s
    decay = np.exp(-1 / (sensor.rate_hz * np.where(rc_s > 0, rc_s, 1e-9)))
    return np.column_stack([scipy.signal.lfilter([1.0, -a], [1.0], v)[1:]
                            for v, a in zip(volts.T, decay)])


def _excess(white: np.ndarray, at_rest: np.ndarray, samples: NoiseSamples, sensor: Sensor
            ) -> Detection | None:
    """Find noise above the level of drawn noise."""
    simulated = np.diff(_before_filter(samples.simulated_v, sensor), axis=0)
    enough_rest = at_rest.sum() > _RESTING_FEWEST
    # In motion, effects that are not modelled would look like noise, so that rests are preferred.
    chosen = at_rest if enough_rest else samples.used[2:]
    drawn = np.median(np.abs(simulated[chosen]), axis=0)
    # The level of noise far below a step of the ADC does not show.
    shows = np.array([r.held_v2 <= r.white_v2 for r in
                      (noise.rounding(sensor, d) for d in range(len(drawn)))]) & (drawn > 0)
    if not shows.any():
        return None
    ratio = np.median(np.abs(white[chosen]), axis=0) / np.where(shows, drawn, np.inf)
    if enough_rest:
        # Noise past the RC filter looks excessive in the innovations, but not in the samples.
        ratio = np.minimum(ratio, np.std(samples.residual_v[2:][at_rest], axis=0)
                           / np.std(samples.simulated_v[2:][at_rest], axis=0))
    # The median over frequencies ignores a line.
    ratio = np.minimum(ratio, _spectral_level(white, sensor.rate_hz)
                       / _spectral_level(simulated, sensor.rate_hz))
    largest = np.max(ratio)
    if largest <= NOISE_EXCESS:
        return None
    return Detection(detected_effect(Detector.NOISE_LEVEL), {'ratio': ratio - 1},
                     (len(white) + 1) * float(np.log(largest) ** 2),
                     f'white noise is {largest:.2f} times the stated noise')


def _spectral_level(white: np.ndarray, rate_hz: float) -> np.ndarray:
    """Return the root of the median of the power spectrum, (m,)."""
    _, power = scipy.signal.periodogram(white, rate_hz, 'hann', axis=0)
    return np.sqrt(np.median(power, axis=0))


def _line(white: np.ndarray, at_rest: np.ndarray, samples: NoiseSamples, sensor: Sensor
          ) -> Detection | None:
    """
    Find a line in the spectrum, None where chance explains it.

    A line of another frequency than the mains must also show at rest.
    """
    line = _strongest_line(white, samples, sensor)
    if line is None or line.effect != UNKNOWN:
        return line
    if at_rest.sum() < _LINE_REST_S * sensor.rate_hz:
        return None
    resting = _strongest_line(white * at_rest[:, None], samples, sensor)
    return line if resting is not None and resting.effect == UNKNOWN else None


def _strongest_line(white: np.ndarray, samples: NoiseSamples, sensor: Sensor
                    ) -> Detection | None:
    """Return the strongest line of a spectrum, None where chance explains it."""
    frequency_hz, power = scipy.signal.periodogram(white, sensor.rate_hz, 'hann', axis=0)
    kept = frequency_hz > _LINE_LOWEST_HZ
    frequency_hz, power = frequency_hz[kept], power[kept]
    if len(frequency_hz) < _LINE_FEWEST_ORDINATES:
        return None
    level = np.column_stack([_local_level(p) for p in power.T])
    excess = (power / level).sum(axis=1)
    best = int(np.argmax(excess))
    log_excess = float(excess[best]) - np.log(len(frequency_hz)) - len(sensor.axes)
    if log_excess < LINE_LOG_EXCESS:
        return None
    line_hz = float(frequency_hz[best])
    mains_hz = _mains_frequency_hz(line_hz, sensor.rate_hz)
    if mains_hz is None:
        return Detection(UNKNOWN, {}, log_excess,
                         f'the spectrum has a line at {line_hz:.2f} Hz, which is no mains '
                         'frequency')
    amplitude_v = line_amplitude_v(samples.residual_v, samples.time_s, mains_hz)
    return Detection(detected_effect(Detector.MAINS_LINE), {
        'amplitude_v': amplitude_v, 'frequency_hz': np.array(mains_hz),
        'phase_rad': np.array(0.0)}, log_excess,
        f'the spectrum has a line at {line_hz:.2f} Hz, {amplitude_v.max() * 1e3:.3g} mV')


def line_amplitude_v(values_v: np.ndarray, time_s: np.ndarray, line_hz: float) -> np.ndarray:
    """
    Estimate the amplitude of a line whose phase may wander.

    It is the rms of the amplitudes of short parts. The power beside the line is subtracted.

    values_v: series with the line, without gaps, V, (n, m); time_s: stamps, s, (n,); returns:
    amplitude by axis, V, (m,).
    """
    length = int(np.searchsorted(time_s, time_s[0] + _LINE_PART_S))
    parts = max(len(values_v) // max(length, 1), 1)
    length = len(values_v) // parts
    window = np.hanning(length + 2)[1:-1]
    shape = (parts, length)
    squares = []
    for offset in (0.0, -_LINE_BESIDE, _LINE_BESIDE):
        hz = line_hz + offset / _LINE_PART_S
        turn = np.exp(-2j * np.pi * hz * time_s[:parts * length]).reshape(shape) * window
        series = values_v[:parts * length].reshape(*shape, -1)
        peaks = 2 * np.einsum('pl,plm->pm', turn, series) / window.sum()
        squares.append(np.mean(np.abs(peaks) ** 2, axis=0))
    return np.sqrt(np.maximum(squares[0] - (squares[1] + squares[2]) / 2, 0.0))


def white_noise_v(noise_v: np.ndarray, sensor: Sensor) -> np.ndarray:
    """
    Estimate the standard deviation of the white noise behind the RC filter.

    The median over the upper half of the frequencies ignores lines, drift and motion. That over
    the samples ignores spikes. The smaller one counts.

    noise_v: noise about the mean output, V, (n, m); returns: standard deviation of the samples by
    axis, V, (m,).
    """
    innovations = _before_filter(noise_v, sensor)
    frequency_hz, power = scipy.signal.periodogram(innovations, sensor.rate_hz, 'hann', axis=0)
    level = np.median(power[frequency_hz > sensor.rate_hz / 4], axis=0) / np.log(2)
    rc_s = noise.electronics(sensor).rc_s
    decay = np.exp(-1 / (sensor.rate_hz * np.where(rc_s > 0, rc_s, 1e-9)))
    std = np.minimum(np.sqrt(level * sensor.rate_hz / 2),
                     MAD_TO_STD * np.median(np.abs(innovations), axis=0))
    return std / np.sqrt(1 - decay ** 2)


def _mains_frequency_hz(line_hz: float, rate_hz: float) -> float | None:
    """Return the true frequency of a line that is an alias of the mains or its double."""
    for mains_hz in _MAINS_HZ:
        for harmonic in (1, 2):
            folded_hz = (harmonic * mains_hz + rate_hz / 2) % rate_hz - rate_hz / 2
            deviation_hz = line_hz - abs(folded_hz)
            if abs(deviation_hz) < _MAINS_TOLERANCE_HZ:
                return harmonic * mains_hz + (deviation_hz if folded_hz >= 0 else -deviation_hz)
    return None


def _local_level(power: np.ndarray) -> np.ndarray:
    """Return the mean of the ordinates around each ordinate, estimated by their median."""
    width = _LOCAL_ORDINATES
    count = max(len(power) // width, 1)
    blocks = power[:count * width].reshape(count, -1) if len(power) >= width else power[None]
    level = np.median(blocks, axis=1) / np.log(2)
    return np.interp(np.arange(len(power)), (np.arange(count) + 0.5) * width, level)


_BANDS = 5
"""Number of bands of frequency. Chosen: some half a decade each."""
_LOWEST_EDGE_HZ = 0.05
"""Smallest frequency from which the edges of the bands are spaced, Hz. Chosen: a period of 20 s.
The lowest band begins at 0."""
_TIMES_S = (0.1, 1.0, 10.0)
"""Averaging times of the Allan deviation, s. Chosen: one for each decade."""
_SEGMENT_S = 16.0
"""Length of a segment of the simulated spectrum, s. Chosen: some ten segments in three minutes."""
_LOWEST_POWER = 1e-6
"""Smallest power of the simulated spectrum, divided by its largest. Chosen: above rounding
errors."""


@dataclass(frozen=True)
class NoiseComparison:
    """Recorded noise relative to simulated noise, all axes together."""

    band_edges_hz: tuple[float, ...]  # Edges of the k bands of frequency, Hz, (k + 1,)
    # Recorded power divided by simulated power, for each band, (k,)
    power_ratio: tuple[float, ...]
    averaging_times_s: tuple[float, ...]  # Averaging times of the Allan deviation, s, (j,)
    allan_ratio: tuple[float, ...]  # Recorded Allan deviation divided by the simulated one, (j,)
    # Log likelihood of the recorded spectrum under the simulated one (Whittle 1953)
    log_likelihood: float
    simulated_std_mps2: float  # Rms of the simulated noise over samples and axes, m/s²


def compare_noise(residual_v: np.ndarray, simulated_v: np.ndarray, rate_hz: float,
                  scale_v_per_mps2: np.ndarray) -> NoiseComparison:
    """
    Compare a residual with drawn noise.

    residual_v: residual, bridged over samples that are not used, V, (n, m); simulated_v: drawn
    noise, V, (n, m); scale_v_per_mps2: scale factor by axis, V/(m/s²), (m,).
    """
    recorded = (residual_v - residual_v.mean(axis=0)) / scale_v_per_mps2
    simulated = (simulated_v - simulated_v.mean(axis=0)) / scale_v_per_mps2
    frequency_hz, power = scipy.signal.periodogram(recorded, rate_hz, axis=0)
    _, simulated_power = scipy.signal.periodogram(simulated, rate_hz, axis=0)
    edges_hz = np.geomspace(max(frequency_hz[1], _LOWEST_EDGE_HZ), rate_hz / 2, _BANDS + 1)
    edges_hz[0] = 0.0
    bands = [(frequency_hz > low) & (frequency_hz <= high) for low, high in pairwise(edges_hz)]
    length = min(round(_SEGMENT_S * rate_hz), len(simulated))
    welch_hz, level = scipy.signal.welch(simulated, rate_hz, nperseg=max(length, 8), axis=0)
    expected = np.column_stack([np.interp(frequency_hz[1:], welch_hz[1:], v[1:])
                                for v in level.T])
    expected = np.maximum(expected, _LOWEST_POWER * expected.max())
    times_s = [t for t in _TIMES_S
               if t * rate_hz >= 2 and t * 10 < len(recorded) / rate_hz]
    return NoiseComparison(
        band_edges_hz=tuple(edges_hz.tolist()),
        power_ratio=tuple(float(power[band].sum() / simulated_power[band].sum())
                          for band in bands),
        averaging_times_s=tuple(times_s),
        allan_ratio=tuple(float(np.sqrt(np.mean((
            allan_deviation(recorded, round(t * rate_hz))
            / allan_deviation(simulated, round(t * rate_hz))) ** 2))) for t in times_s),
        log_likelihood=-float(np.sum(power[1:] / expected + np.log(expected))),
        simulated_std_mps2=float(np.sqrt(np.mean(simulated ** 2))))


def allan_deviation(values: np.ndarray, count: int) -> np.ndarray:
    """
    Compute the overlapping Allan deviation of means of `count` samples (IEEE 1554).

    values: series of m axes, (n, m); returns: allan deviation by axis, in the unit of the values,
    (m,).
    """
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    second_difference = total[2 * count:] - 2 * total[count:-count] + total[:-2 * count]
    return np.sqrt(np.mean(second_difference ** 2, axis=0) / 2) / count


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
    named = [d for d in detections if d.effect != UNKNOWN]
    remainders: list[NoiseRemainder] = []
    pairs = [(c, _Series(c.volts, bridged(c.residual_v(mean_sensor), c.used)),
              _simulated(c, named_sensor, seed))
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
        return line_amplitude_v(series.noise_v, comparison.time_s, hz) \
            / comparison.scale_v_per_mps2

    return _remainder(effect, f'line at {hz:.4g} Hz', 'm/s^2', axes, [
        (amplitude(c, recorded), amplitude(c, simulated)) for c, recorded, simulated in pairs])


def _remainder(effect: str, quantity: str, unit: str, axes: str,
               values: Sequence[tuple[np.ndarray, np.ndarray]]) -> NoiseRemainder:
    """Return the rms over recordings of pairs of recorded and simulated values."""
    recorded, simulated = np.sqrt(np.mean(np.square(np.array(values, float)), axis=0))
    return NoiseRemainder(effect, quantity, unit, axes if len(recorded) == len(axes) else '',
                          recorded, simulated)


def _simulated(comparison: BaselineComparison, sensor: Sensor, seed: int) -> _Series:
    """Simulate the recording with noise."""
    at_rate, time_s = replace(sensor, rate_hz=comparison.sensor.rate_hz), comparison.time_s
    volts = Response(at_rate, comparison.motion, seed, float(time_s[0]))(time_s)
    # Spikes and repeated samples are left out, as those of the recording are.
    used, _ = repeated_samples(volts, time_s, np.ones(len(volts), bool), at_rate)
    used, _ = isolated_samples(volts, time_s, used, at_rate)
    return _Series(volts, bridged(volts - comparison.simulated_v(at_rate), used))


_Statistic = Callable[[BaselineComparison, _Series], np.ndarray]
"""Statistic of a series by axis, (m,)."""


def _statistics(detection: Detection, sensor: Sensor) -> list[tuple[str, str, _Statistic]]:
    """Return quantity, unit and statistic of what a detection shows."""
    detector = effect_named(detection.effect).diagnosis.detector
    if detector is Detector.NOISE_LEVEL:
        return [('white noise', 'm/s^2', lambda c, s: white_noise_v(
            s.noise_v, c.sensor) / c.scale_v_per_mps2)]
    if detector is Detector.ISOLATED_SAMPLES:
        return [('spikes per second and axis', '1/s', lambda c, s: _spike_rate_and_size(c, s)[0]),
                ('size of a spike', 'm/s^2', lambda c, s: _spike_rate_and_size(c, s)[1])]
    if detector is Detector.REPEATED_SAMPLES:
        return [('share of repeated samples', '1', _repeated_share)]
    stated = replace(sensor, effects=(), values={})
    return [('distance of codes', 'm/s^2', lambda c, s: _code_distance(c, s, stated))]


def _spike_rate_and_size(comparison: BaselineComparison, series: _Series
                         ) -> tuple[np.ndarray, np.ndarray]:
    """Return the rate of spikes, 1/s, (1,), and their median size, m/s², (m,)."""
    finite = np.isfinite(series.volts).all(axis=1)
    _, spikes = isolated_samples(series.volts, comparison.time_s, finite,
                                 comparison.sensor)
    if spikes is None:
        return np.zeros(1), np.zeros(len(comparison.sensor.axes))
    return (np.atleast_1d(spikes.values['rate_hz']),
            spikes.values['amplitude_v'] / comparison.scale_v_per_mps2)


def _repeated_share(comparison: BaselineComparison, series: _Series) -> np.ndarray:
    """Return the share of samples that repeat the one before, (1,)."""
    finite = np.isfinite(series.volts).all(axis=1)
    used, _ = repeated_samples(series.volts, comparison.time_s, finite,
                               comparison.sensor)
    return np.array([float(np.mean(finite & ~used))])


def _code_distance(comparison: BaselineComparison, series: _Series, stated: Sensor) -> np.ndarray:
    """Return the distance of the codes of an ADC that has the stated bits, m/s², (m,)."""
    coarse = coarse_codes(series.volts, stated)
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
