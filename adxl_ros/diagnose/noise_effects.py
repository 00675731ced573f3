# SPDX-License-Identifier: Apache-2.0
"""
Effects that show in the statistics of the noise and not in the mean.

An effect names its detector in its own file; the detector estimates its parameters. The rms of a
gap does not show such effects, and the simulator gives a line a phase, and spikes their instants,
that are not those of the recording. The same statistic of recording and simulation is compared
instead: power by band, the amplitude of a line, the rate and size of spikes, the share of
repeated samples, the distance of codes, the level of the noise.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

from adxl_ros.diagnose.comparison import BaselineComparison, bridged, code_step_v, with_values
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2, MAD_TO_STD
from adxl_ros.model.effects import effect_named, library
from adxl_ros.model.effects.base import Detector
from adxl_ros.model.sensor import Sensor, with_neutral
from adxl_ros.signals.block_statistics import rms, true_runs
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
SPIKE_STDS = 7.0
"""Deviation of a spike from its neighbours, in robust standard deviations. Chosen: normal noise
exceeds it once in 4·10¹¹ samples."""
_SPIKE_FEWEST = 3  # Fewest spikes of an axis. Chosen: one or two may be anything
_SPIKE_NEIGHBOUR = 2
"""Distance of the neighbours of a spike, samples. Chosen: the next sample shares an RC filter."""
_OTHER_NEIGHBOUR = 3
"""The same where another spike is the neighbour: two of the same sign hide each other."""
_SPIKE_LOCAL_S = 0.2  # Width of the blocks of the local scale, s. Chosen: shorter than a move
_SPIKE_LOCAL_FEWEST = 9  # The same in samples. Chosen: a median of nine ignores a spike
NOISE_EXCESS = 1.2
"""Noise, divided by the stated noise, from which it is excessive. Chosen: units differ by less."""
_RESTING_FEWEST = 500
"""Fewest resting samples that show excess noise. Chosen: a standard deviation of 3 %."""
COARSE_STEPS = 1.6
"""Distance of codes, in stated steps, from which they are coarse. Chosen: below that of one lost
bit."""
_SMALLEST_CODE_STEPS = 0.3
"""Distance, in stated steps, below which two values are one code. Chosen: above rounding."""
_NEAREST_CODES_RATIO = 1.5
"""Distance, divided by the smallest one, up to which no code is between. Chosen: below two."""
_CODES_FEWEST = 8
"""Fewest distances of codes that show a step. Chosen: a distance is an even number of steps with
a chance of one half at most, so that all of them are in one of 256 recordings."""
_BETWEEN_CODES_STEPS = 0.2
"""Distance from a multiple of the step, in steps, at which a value is between codes. Chosen: far
above rounding."""
_BETWEEN_CODES_SHARE = 0.1
"""Share of such values from which the step is none of the ADC. Chosen: values without a step have
0.6 between codes, and one glitch in ten distances is none of the ADC."""
_REPEAT_CHANCE = 1e-4
"""Probability of one run of equal samples by chance in a recording. Chosen: one of ten
thousand sound recordings is said to repeat samples."""
_REPEAT_SHORTEST = 3  # Shortest such run, samples. Chosen: two may be equal by rounding
_REPEAT_LEAST = 0.05
"""Smallest assumed probability that a sample equals the last one on one axis. Chosen: in 10⁵
samples, chance explains runs of 7."""
_REPEAT_LEAST_OF_SEVERAL = 1e-3
"""The same on all of several axes. Chosen: chance explains runs of 3."""
_REPEAT_MOST = 0.5  # The largest one. Chosen: chance explains runs of 30
SMALLEST_RANGE_V = 0.05  # Range of an output that moves, V. Chosen: 50 mg
_HELD_STEPS = 3.0
"""The same in steps of its codes, beyond an end at which it is held. Chosen: a peak within one
code moves by less, whatever its scale factor."""
_LARGEST_HELD_SHARE = 0.5
"""Share of samples that are left out as held. Chosen: where most are, little else is left, and the
saturation is fitted to the samples themselves."""
_BANDS = 5  # Bands of frequency in which noise is compared. Chosen: half a decade each
_LOWEST_EDGE_HZ = 0.05  # Smallest edge of a band, Hz. Chosen: a period of 20 s
_TIMES_S = (0.1, 1.0, 10.0)  # Averaging times of the Allan deviation, s. Chosen: a decade apart


@dataclass(frozen=True)
class Detection:
    """One noise-like effect that shows."""

    effect: str  # Name of the effect
    values: dict[str, np.ndarray]  # Parameters of the effect by name, (m,) or () each
    # Mean square over samples and axes that the effect adds, (m/s²)²; infinite for repeated
    # samples, because nobody knows what they hide
    power_mps2: float

    @property
    def is_left_out(self) -> bool:
        """Whether its samples are left out of the comparison."""
        detector = effect_named(self.effect).diagnosis.detector
        return detector in (
            Detector.REPEATED_SAMPLES,
            Detector.ISOLATED_SAMPLES,
            Detector.HELD_AT_END,
        )

    def added_to(self, sensor: Sensor) -> Sensor:
        """Return a sensor with the effect as it was found."""
        return with_values(with_neutral(sensor, [self.effect]), self.effect, self.values)


def effect_of(detector: Detector) -> str:
    """Return the name of the effect that a detector finds."""
    return next(e.name for e in library().values() if e.diagnosis.detector is detector)


def _detection(
    detector: Detector, power_v2: np.ndarray | float, sensor: Sensor, **values: np.ndarray | float
) -> Detection:
    """Return the detection of a detector's effect, with its mean square, V², (m,) or ()."""
    arrays = {key: np.asarray(value) for key, value in values.items()}
    return Detection(
        effect_of(detector),
        arrays,
        float(np.mean(power_v2 * (G0_MPS2 / sensor.scale_v_per_g) ** 2)),
    )


def repeated_samples(
    volts: np.ndarray,
    time_s: np.ndarray,
    used: np.ndarray,
    sensor: Sensor,
    isolated: np.ndarray | None = None,
) -> tuple[np.ndarray, list[Detection]]:
    """
    Find samples that repeat the one before in all axes, in runs too long for chance.

    In fast motion a short run counts, too: one of its samples is isolated, (n,) bool, and the one
    that it repeats is not.
    """
    same = np.concatenate([[False], (np.diff(volts, axis=0) == 0).all(axis=1)])
    # At their rails all axes repeat, too.
    same &= ~sensor.saturated(volts).all(axis=1)
    shortest = shortest_repeat(volts, len(sensor.axes))
    repeated = np.zeros(len(volts), bool)
    alone = np.zeros(len(volts), bool) if isolated is None else isolated
    for begin, end in true_runs(same):
        is_held = alone[begin:end].any() and not alone[begin - 1]
        repeated[begin:end] = end - begin >= shortest or is_held
    repeats = true_runs(repeated & used)
    if not repeats:
        return used, []
    duration_s = float(np.median([time_s[end - 1] - time_s[begin] for begin, end in repeats]))
    return used & ~repeated, [
        _detection(
            Detector.REPEATED_SAMPLES,
            np.inf,
            sensor,
            rate_hz=len(repeats) / np.ptp(time_s),
            duration_s=duration_s + 1 / sensor.rate_hz,
        )
    ]


def shortest_repeat(volts: np.ndarray, axes: int) -> int:
    """Return how many equal samples, (n, m), in a row are too many for chance."""
    # Neighbours are correlated, so that the root of the independent probability is safe.
    probability = float(np.sqrt(np.prod(np.mean(np.diff(volts, axis=0) == 0, axis=0))))
    least = _REPEAT_LEAST_OF_SEVERAL if axes > 1 else _REPEAT_LEAST
    probability = min(max(probability, least), _REPEAT_MOST)
    by_chance = int(np.ceil(np.log(_REPEAT_CHANCE / len(volts)) / np.log(probability)))
    return max(_REPEAT_SHORTEST, by_chance)


def isolated_samples(
    volts: np.ndarray, residual_v: np.ndarray, time_s: np.ndarray, used: np.ndarray, sensor: Sensor
) -> tuple[np.ndarray, list[Detection]]:
    """
    Find single samples that deviate from the straight line between their neighbours.

    The residual does so, V, (n, m), and the recording itself, or the reference would be wrong.
    """
    if not used.any():
        return used, []
    spikes, size_v = _spikes(residual_v, code_step_v(volts), used, sensor)
    spikes &= 2 * _deviation_v(volts) > _deviation_v(residual_v)
    if not spikes.any():
        return used, []
    rate_hz = spikes.sum() / len(sensor.axes) / float(np.mean(used) * np.ptp(time_s))
    return used & ~spikes.any(axis=1), [
        _detection(
            Detector.ISOLATED_SAMPLES,
            spikes.mean(axis=0) * size_v**2,
            sensor,
            rate_hz=rate_hz,
            amplitude_v=size_v,
        )
    ]


def residual_shows_spikes(
    spikes: Detection, residual_v: np.ndarray, used: np.ndarray, sensor: Sensor
) -> bool:
    """
    Determine whether the residual of the best hypothesis shows the spikes of the recording.

    Without this check, motion of the sensor may look like spikes, which are not among `used`.
    """
    isolated, _ = _spikes(
        residual_v, code_step_v(residual_v), np.isfinite(residual_v).all(axis=1), sensor
    )
    expected = float(spikes.values['rate_hz']) * len(sensor.axes) * used.sum() / sensor.rate_hz
    return bool(isolated[~used].sum() > expected / 2)


def _deviation_v(volts: np.ndarray, distance: int = _SPIKE_NEIGHBOUR) -> np.ndarray:
    """Return by how much each sample deviates from the line between its neighbours, V, (n, m)."""
    around_v = np.roll(volts, distance, 0) + np.roll(volts, -distance, 0)
    return np.nan_to_num(np.abs(volts - around_v / 2))


def _usual_deviation_v(
    volts: np.ndarray, used: np.ndarray, step_v: float, rate_hz: float, distance: int
) -> np.ndarray:
    """Return the deviation from the line between neighbours that is usual around a sample, V."""
    deviation_v = _deviation_v(volts, distance)
    std_v = max(MAD_TO_STD * np.median(deviation_v[used]), step_v)
    # Motion also deviates from the line, so that a spike must exceed its surroundings, too.
    width = round(max(rate_hz * _SPIKE_LOCAL_S, _SPIKE_LOCAL_FEWEST))
    blocks = max(len(volts) // width, 1)
    parts_v = deviation_v[: blocks * width].reshape(blocks, -1)
    middles = (np.arange(blocks) + 0.5) * width
    local_v = np.interp(np.arange(len(volts)), middles, MAD_TO_STD * np.median(parts_v, axis=1))
    return np.maximum(local_v, std_v)


def _stands_alone(volts: np.ndarray, smallest_v: np.ndarray, distance: int) -> np.ndarray:
    """Determine which samples deviate by so much, and more than those around them, (n,) bool."""
    deviation_v = _deviation_v(volts, distance)
    # A spike differs from the samples on both sides, and a pulse from those on one.
    on_both_sides = 2 * _least_difference_v(volts, distance) > deviation_v
    # The neighbours of a spike deviate by half of it.
    highest_v = scipy.ndimage.maximum_filter1d(deviation_v, 2 * distance + 1)
    return (deviation_v > smallest_v) & on_both_sides & (deviation_v >= highest_v)


def _least_difference_v(volts: np.ndarray, distance: int) -> np.ndarray:
    """Return the smaller difference of each sample from those before and behind it, V, (n,)."""
    before_v = np.abs(volts - np.roll(volts, distance))
    behind_v = np.abs(volts - np.roll(volts, -distance))
    return np.minimum(before_v, behind_v)


def _spikes(
    volts: np.ndarray, steps_v: np.ndarray, used: np.ndarray, sensor: Sensor
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return isolated samples, (n, m) bool, and their median size by axis, V, (m,).

    steps_v: smallest change of the recorded output by axis, V, (m,): rounding is no spike.
    """
    isolated, size_v = np.zeros(volts.shape, bool), np.zeros(volts.shape[1])
    far = 2 * _SPIKE_NEIGHBOUR
    # The first samples after repeated or missing ones may step, which is no spike.
    undisturbed = np.convolve(used, np.ones(2 * far + 1), 'same') > 2 * far
    undisturbed[:far] = undisturbed[-far:] = False
    for d, step_v in enumerate(np.maximum(steps_v, noise.electronics(sensor).lsb_v)):
        spikes = np.zeros(len(volts), bool)
        bridged_v = volts[:, d].copy()
        for distance in (_SPIKE_NEIGHBOUR, _OTHER_NEIGHBOUR):
            usual_v = _usual_deviation_v(volts[:, d], used, step_v, sensor.rate_hz, distance)
            smallest_v = SPIKE_STDS * usual_v
            # Over a larger distance, a pulse of some samples stands alone, too.
            is_single = undisturbed
            if distance > _SPIKE_NEIGHBOUR:
                is_single = undisturbed & (_least_difference_v(volts[:, d], 1) > smallest_v)
            # A spike next to a larger one stands alone once that one is bridged.
            while True:
                found = is_single & ~spikes & _stands_alone(bridged_v, smallest_v, distance)
                if not found.any():
                    break
                spikes |= found
                beside = scipy.ndimage.binary_dilation(spikes, iterations=_SPIKE_NEIGHBOUR - 1)
                bridged_v[beside] = np.interp(
                    np.flatnonzero(beside), np.flatnonzero(~beside), volts[~beside, d]
                )
        if spikes.sum() >= _SPIKE_FEWEST:
            isolated[:, d] = spikes
            size_v[d] = float(np.median(np.abs(volts[:, d] - bridged_v)[spikes]))
    return isolated, size_v


def _held_at_end(volts: np.ndarray, simulated_v: np.ndarray, moved_v: np.ndarray) -> np.ndarray:
    """
    Return where axes are held at the upper end of their range, (n, m) bool.

    The simulation, (n, m), moves on beyond it, by more than `moved_v`, (m,). In an extreme pose
    codes repeat, too, but nothing moves.
    """
    end_v = np.nanmax(volts, axis=0)
    beyond_v = simulated_v - end_v
    at_end = volts == end_v
    for d in range(len(end_v)):
        is_held = any(
            min(beyond_v[a:b, d].max(), np.ptp(beyond_v[a:b, d])) > moved_v[d]
            for a, b in true_runs(at_end[:, d])
            if b - a >= _REPEAT_SHORTEST
        )
        at_end[:, d] &= is_held
    return at_end


def _clipping(comparison: BaselineComparison, low: np.ndarray, high: np.ndarray) -> Detection:
    """Return the limits of axes that are held at the lower or the upper end, (n, m) bool each."""
    sensor = comparison.sensor
    output_g = (comparison.volts - sensor.zero_g_v) / sensor.scale_v_per_g
    lowest_g, highest_g = np.nanmin(output_g, axis=0), np.nanmax(output_g, axis=0)
    is_low, is_high = low.any(axis=0), high.any(axis=0)
    # An end that was not reached is at least as far as the samples, and as the other end.
    low_g = np.where(is_low, lowest_g, np.minimum(lowest_g, -highest_g))
    high_g = np.where(is_high, highest_g, np.maximum(highest_g, -lowest_g))
    neutral = effect_named(effect_of(Detector.HELD_AT_END)).parameters[0].neutral
    missing_v = np.where(low | high, comparison.residual_v(sensor), 0.0)
    return _detection(
        Detector.HELD_AT_END,
        np.mean(missing_v**2, axis=0),
        sensor,
        limit_g=np.where(is_low | is_high, (high_g - low_g) / 2, neutral),
        offset_g=np.where(is_low | is_high, (high_g + low_g) / 2, 0.0),
    )


class SampleFaults(NamedTuple):
    """What the samples themselves show of a sensor, before any effect on the mean is known."""

    repeated: np.ndarray  # Samples that repeat the one before, (n,) bool
    isolated: np.ndarray  # Samples that stand alone, (n,) bool
    held: np.ndarray  # Samples at an end of the range of an axis, (n, m) bool
    detections: list[Detection]  # Repeated samples, coarse codes, and ends of the range
    # Isolated samples; the residual of the best hypothesis must show them, too
    possible_spikes: list[Detection]
    sensor: Sensor  # The baseline with the steps that the codes show, axis by axis


def sample_faults(comparison: BaselineComparison) -> SampleFaults:
    """
    Find coarse codes, else repeated samples, samples at an end, and isolated ones of a recording.

    Where the reference is not known, a jerk of the motion would look like an isolated sample.
    """
    sensor = comparison.sensor
    volts = comparison.volts
    time_s = comparison.time_s
    residual_v = comparison.residual_v(sensor)
    finite = np.isfinite(volts).all(axis=1)
    known = comparison.used | comparison.disturbed
    coarse = coarse_codes(volts, sensor)
    changing = finite
    if coarse is None:
        changing, detections = repeated_samples(volts, time_s, finite, sensor)
    else:
        # Coarse codes repeat by themselves.
        detections = [coarse]
        sensor = coarse.added_to(sensor)
    compared = changing & known
    regular, spikes = isolated_samples(volts, residual_v, time_s, compared, comparison.sensor)
    if spikes and coarse is None:
        isolated = compared & ~regular
        changing, detections = repeated_samples(volts, time_s, finite, sensor, isolated)
        compared = changing & known
        regular, spikes = isolated_samples(volts, residual_v, time_s, compared, sensor)
    held, clipping = _held(comparison)
    if clipping is not None:
        detections = [*detections, clipping]
    return SampleFaults(
        repeated=finite & ~changing,
        isolated=compared & ~regular,
        held=held,
        detections=detections,
        possible_spikes=spikes,
        sensor=sensor,
    )


def _held(comparison: BaselineComparison) -> tuple[np.ndarray, Detection | None]:
    """Find samples at an end of the range of an axis, (n, m) bool, unless most of them are."""
    volts = comparison.volts
    sensor = comparison.sensor
    simulated_v = comparison.simulated_v(sensor)
    steps_v = np.maximum(code_step_v(volts), sensor.lsb_v)
    moved_v = np.maximum(_HELD_STEPS * steps_v, SMALLEST_RANGE_V)
    low = _held_at_end(-volts, -simulated_v, moved_v)
    high = _held_at_end(volts, simulated_v, moved_v)
    held = low | high
    is_most = held.any(axis=1).mean() > _LARGEST_HELD_SHARE
    if is_most or not held.any():
        return np.zeros_like(held), None
    return held, _clipping(comparison, low, high)


def coarse_codes(volts: np.ndarray, sensor: Sensor) -> Detection | None:
    """Find an ADC whose codes are coarser than stated, on all axes or on some."""
    if not sensor.lsb_v:
        return None
    bits = np.array([_lost_bits(v, sensor) for v in volts.T])
    threshold = np.log2(COARSE_STEPS)
    if not (bits >= threshold).any():
        return None
    fewest = float(np.nanmin(bits))
    common = fewest if fewest >= threshold else 0.0
    return _detection(
        Detector.COARSE_CODES,
        (sensor.lsb_v * 2 ** np.nan_to_num(bits)) ** 2 / 12,
        sensor,
        lost_bits=common,
        axis_lost_bits=np.where(bits - common >= threshold, bits - common, 0.0),
    )


def _lost_bits(volts: np.ndarray, sensor: Sensor) -> float:
    """Return how many bits the codes of one axis, V, (n,), lack; NaN where too few differ."""
    distance_v = np.diff(np.unique(volts[np.isfinite(volts)]))
    distance_v = distance_v[distance_v > sensor.lsb_v * _SMALLEST_CODE_STEPS]
    if len(distance_v) < _CODES_FEWEST:
        return float('nan')
    step_v = float(np.median(distance_v[distance_v < _NEAREST_CODES_RATIO * distance_v.min()]))
    # A slow motion through few samples leaves codes out; all multiples of a step are occupied.
    steps = distance_v / step_v
    between = np.mean(np.abs(steps - np.rint(steps)) > _BETWEEN_CODES_STEPS)
    return 0.0 if between > _BETWEEN_CODES_SHARE else float(np.log2(step_v / sensor.lsb_v))


def residual_detections(
    comparison: BaselineComparison, residual_v: np.ndarray, sensor: Sensor
) -> list[Detection]:
    """Find lines and excess noise in a residual, V, (n, m), beside the noise of a sensor."""
    sensor = replace(sensor, rate_hz=comparison.sensor.rate_hz)
    residual_v = bridged(residual_v, comparison.used)
    at_rest = comparison.at_rest & comparison.used
    white = np.diff(_innovations(residual_v, sensor)[0], axis=0)
    line = _line(white, residual_v, comparison.time_s, sensor)
    # In motion, effects that are not modelled would look like noise, so that rests are preferred.
    resting = at_rest.sum() > _RESTING_FEWEST
    excess = _excess(
        residual_v,
        comparison.simulated_noise_v(sensor, 0),
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
    drawn = white_noise_v(simulated_v, sensor, rows)
    # The level of noise far below a step of the ADC does not show.
    shows = (noise.held_rounding(sensor) <= 0.5) & (drawn > 0)
    ratio = recorded / np.where(shows, drawn, np.inf)
    if resting:
        # Noise past the RC filter looks excessive in the innovations, but not in the samples.
        recorded_v = np.std(residual_v[rows], axis=0)
        drawn_v = np.std(simulated_v[rows], axis=0)
        ratio = np.minimum(ratio, recorded_v / np.where(drawn_v > 0, drawn_v, np.inf))
    if np.max(ratio) <= NOISE_EXCESS:
        return None
    power_v2 = np.maximum(ratio**2 - 1, 0.0) * noise.analog_std_v(sensor) ** 2
    return _detection(Detector.NOISE_LEVEL, power_v2, sensor, ratio=ratio - 1)


def _periodogram(
    values: np.ndarray, rate_hz: float, window: str = 'boxcar'
) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies, Hz, (k,), and spectra of m axes, (n, m); one by one, to save memory."""
    spectra = [scipy.signal.periodogram(v, rate_hz, window) for v in values.T]
    return spectra[0][0], np.array([power for _, power in spectra]).T


def white_noise_v(
    noise_v: np.ndarray, sensor: Sensor, rows: np.ndarray | None = None
) -> np.ndarray:
    """
    Estimate the standard deviation of the white noise behind the RC filter, V, (m,).

    The median over the upper half of the frequencies ignores lines, drift and motion. That over
    first differences of samples, (n,) bool, ignores spikes. The smaller one counts.
    """
    innovations, decay = _innovations(noise_v, sensor)
    frequency_hz, power = _periodogram(innovations, sensor.rate_hz, 'hann')
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
    frequency_hz, power = _periodogram(white, sensor.rate_hz, 'hann')
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
    return _detection(
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


def compare_noise(
    comparison: BaselineComparison, sensors: Mapping[str, tuple[Sensor, Sensor]], seed: int
) -> dict[str, Any]:
    """
    Return recorded noise relative to simulated noise, all axes together, by label of `sensors`.

    A label has the sensor whose mean output is subtracted, and the one whose noise is drawn. The
    log likelihood is that of the recorded spectrum under the simulated power of each band
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
    log_likelihoods = []
    ratios: dict[str, Any] = {}
    for label, (mean, noisy) in sensors.items():
        recorded = bridged(comparison.residual_v(mean), comparison.used) / scale
        simulated = bridged(comparison.simulated_noise_v(noisy, seed), comparison.used) / scale
        recorded_power = _periodogram(recorded, rate_hz)[1]
        simulated_power = _periodogram(simulated, rate_hz)[1]
        power_ratios = []
        log_likelihood = 0.0
        for band in bands:
            power = recorded_power[band]
            drawn = simulated_power[band]
            power_ratios.append(float(power.sum() / drawn.sum()))
            if band.any():
                level = drawn.mean(axis=0)
                log_likelihood -= float(np.sum(power / level + np.log(level)))
        log_likelihoods.append(log_likelihood)
        ratios[f'power_ratio_{label}'] = power_ratios
        ratios[f'allan_ratio_{label}'] = [
            rms(allan_deviation(recorded, count) / allan_deviation(simulated, count))
            for count in counts
        ]
    return {
        'recording': comparison.name,
        'bands_hz': edges_hz.tolist(),
        'allan_s': times_s,
        'log_likelihood_gain': log_likelihoods[-1] - log_likelihoods[0],
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
    at_rate = replace(sensor, rate_hz=comparison.sensor.rate_hz)
    time_s = comparison.time_s
    volts = comparison.drawn_v(at_rate, seed)
    # Spikes and repeated samples are left out, as those of the recording are.
    used, _ = repeated_samples(volts, time_s, np.ones(len(volts), bool), at_rate)
    residual_v = volts - comparison.simulated_v(at_rate)
    used, _ = isolated_samples(volts, residual_v, time_s, used, at_rate)
    return _Series(volts, residual_v, bridged(residual_v, used))


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
        _, found = isolated_samples(series.volts, series.residual_v, time_s, finite, sensor)
        values = {'rate_hz': np.zeros(1), 'amplitude_v': np.zeros(len(scale))}
        if found:
            values = found[0].values
        yield _Statistic('spikes per second and axis', '1/s', np.atleast_1d(values['rate_hz']))
        yield _Statistic('size of a spike', 'm/s^2', values['amplitude_v'] / scale)
    elif detector is Detector.REPEATED_SAMPLES:
        used, _ = repeated_samples(series.volts, time_s, finite, sensor)
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
