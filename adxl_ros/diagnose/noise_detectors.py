# SPDX-License-Identifier: Apache-2.0

"""
Effects that show in the statistics of the noise and not in the mean, each with its detector.

An effect names its detector in its own file. A detector estimates the parameters of its effect.
"""

from __future__ import annotations

from dataclasses import dataclass

from adxl_ros.model import noise
from adxl_ros.model.constants import MAD_TO_STD
from adxl_ros.model.diagnosis_hints import Detector
from adxl_ros.model.effects import library
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.runs import true_runs
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
