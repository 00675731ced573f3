# SPDX-License-Identifier: Apache-2.0
"""
What the samples themselves show: some repeat, stand alone, or are held, or codes are coarse.

An effect names its detector in its own file; the detector estimates its parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from adxl_ros.diagnose.comparison import BaselineComparison
from adxl_ros.diagnose.detection import Detection, detection_of, effect_of
from adxl_ros.model import noise
from adxl_ros.model.constants import MAD_TO_STD
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Detector
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.block_statistics import true_runs
import numpy as np
import scipy

SPIKE_STDS = 7.0
"""Deviation of a spike from its neighbours, in robust standard deviations. Chosen: normal noise
exceeds it once in 4·10¹¹ samples."""
_SPIKE_FEWEST = 3  # Fewest spikes of an axis. Chosen: one or two may be anything
_SPIKE_NEIGHBOUR = 2
"""Distance of the neighbours of a spike, samples. Chosen: the next sample shares an RC filter."""
_OTHER_NEIGHBOUR = 3
"""The same where another spike is the neighbour: two of the same sign hide each other."""
_SPIKE_LOCAL_S = 0.2  # Width of the blocks of the local scale, s. Chosen: shorter than a move
_SPIKE_LOCAL_FEWEST = 21  # The same in samples. Chosen: two spikes and their neighbours are 6
_SPIKE_LOCAL_SHARE = 0.7
"""Quantile of the deviations that is the local scale. Chosen: a burst of vibration in a third of a
block is no spike."""
_SPIKE_LOCAL_TO_STD = 1 / scipy.stats.norm.ppf((1 + _SPIKE_LOCAL_SHARE) / 2)
"""Standard deviation of normal deviations, divided by that quantile of their magnitudes."""
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


class SampleFaults(NamedTuple):
    """What the samples themselves show of a sensor, before any effect on the mean is known."""

    repeated: np.ndarray  # Samples that repeat the one before, (n,) bool
    isolated: np.ndarray  # Samples that stand alone, (n,) bool
    held: np.ndarray  # Samples at an end of the range of an axis, (n, m) bool
    detections: list[Detection]  # Repeated samples, coarse codes, and ends of the range
    # Isolated samples; the residual of the best hypothesis must show them, too
    possible_spikes: Sequence[Detection]
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
    if coarse is None:
        repeats = repeated_samples(volts, time_s, finite, sensor)
    else:
        # Coarse codes repeat by themselves.
        repeats = SampleSearch(finite, [coarse])
        sensor = coarse.added_to(sensor)
    compared = repeats.regular & known
    lone = isolated_samples(volts, residual_v, time_s, compared, comparison.sensor)
    if lone.detections and coarse is None:
        isolated = compared & ~lone.regular
        repeats = repeated_samples(volts, time_s, finite, sensor, isolated)
        compared = repeats.regular & known
        lone = isolated_samples(volts, residual_v, time_s, compared, sensor)
    detections = [*repeats.detections]
    held, clipping = _held(comparison)
    if clipping is not None:
        detections.append(clipping)
    return SampleFaults(
        repeated=finite & ~repeats.regular,
        isolated=compared & ~lone.regular,
        held=held,
        detections=detections,
        possible_spikes=lone.detections,
        sensor=sensor,
    )


class SampleSearch(NamedTuple):
    """What the search for one fault of samples finds."""

    regular: np.ndarray  # Used samples without the fault, (n,) bool
    detections: Sequence[Detection] = ()  # The effect; empty where no sample has the fault


def repeated_samples(
    volts: np.ndarray,
    time_s: np.ndarray,
    used: np.ndarray,
    sensor: Sensor,
    isolated: np.ndarray | None = None,
) -> SampleSearch:
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
        return SampleSearch(used)
    duration_s = float(np.median([time_s[end - 1] - time_s[begin] for begin, end in repeats]))
    found = detection_of(
        Detector.REPEATED_SAMPLES,
        np.inf,
        sensor,
        rate_hz=len(repeats) / np.ptp(time_s),
        duration_s=duration_s + 1 / sensor.rate_hz,
    )
    return SampleSearch(used & ~repeated, [found])


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
) -> SampleSearch:
    """
    Find single samples that deviate from the straight line between their neighbours.

    The residual does so, V, (n, m), and the recording itself, or the reference would be wrong.
    """
    if not used.any():
        return SampleSearch(used)
    spikes, size_v = _spikes(residual_v, code_step_v(volts), used, sensor)
    spikes &= 2 * _deviation_v(volts) > _deviation_v(residual_v)
    if not spikes.any():
        return SampleSearch(used)
    found = detection_of(
        Detector.ISOLATED_SAMPLES,
        spikes.mean(axis=0) * size_v**2,
        sensor,
        rate_hz=spikes.mean(axis=1).sum() / float(np.mean(used) * np.ptp(time_s)),
        amplitude_v=size_v,
    )
    return SampleSearch(used & ~spikes.any(axis=1), [found])


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
    levels_v = _SPIKE_LOCAL_TO_STD * np.quantile(parts_v, _SPIKE_LOCAL_SHARE, axis=1)
    return np.maximum(np.interp(np.arange(len(volts)), middles, levels_v), std_v)


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
    return detection_of(
        Detector.HELD_AT_END,
        np.mean(missing_v**2, axis=0),
        sensor,
        limit_g=np.where(is_low | is_high, (high_g - low_g) / 2, neutral),
        offset_g=np.where(is_low | is_high, (high_g + low_g) / 2, 0.0),
    )


def coarse_codes(volts: np.ndarray, sensor: Sensor) -> Detection | None:
    """
    Find codes that are coarser than those of the stated ADC, on all axes or on some.

    Where none is stated, its rounding is a part of the stated noise.
    """
    stated_v = np.where(sensor.lsb_v, sensor.lsb_v, np.sqrt(12) * noise.analog_std_v(sensor))
    bits = np.array([_lost_bits(*of_axis) for of_axis in zip(volts.T, stated_v)])
    threshold = np.log2(COARSE_STEPS)
    if not (bits >= threshold).any():
        return None
    steps_v = np.where(bits >= threshold, stated_v * 2**bits, sensor.lsb_v)
    fewest = float(np.nanmin(bits))
    common = fewest if fewest >= threshold else 0.0
    further = np.where(bits - common >= threshold, bits - common, 0.0)
    lost = {'lost_bits': common, 'axis_lost_bits': further}
    values = lost if sensor.lsb_v else {'step_v': steps_v}
    return detection_of(Detector.COARSE_CODES, steps_v**2 / 12, sensor, **values)


def _lost_bits(volts: np.ndarray, stated_v: float) -> float:
    """Return how many bits the codes of one axis, V, (n,), lack; NaN where too few differ."""
    distance_v = np.diff(np.unique(volts[np.isfinite(volts)]))
    distance_v = distance_v[distance_v > stated_v * _SMALLEST_CODE_STEPS]
    if len(distance_v) < _CODES_FEWEST or not stated_v:
        return float('nan')
    step_v = float(np.median(distance_v[distance_v < _NEAREST_CODES_RATIO * distance_v.min()]))
    # A slow motion through few samples leaves codes out; all multiples of a step are occupied.
    steps = distance_v / step_v
    between = np.mean(np.abs(steps - np.rint(steps)) > _BETWEEN_CODES_STEPS)
    return 0.0 if between > _BETWEEN_CODES_SHARE else float(np.log2(step_v / stated_v))


def code_step_v(volts: np.ndarray) -> np.ndarray:
    """Return the smallest change of an output on each axis, V; 0 where it never changes."""
    changes_v = np.abs(np.diff(volts, axis=0))
    smallest = np.min(changes_v, axis=0, initial=np.inf, where=changes_v > 0)
    return np.nan_to_num(smallest, posinf=0.0)
