# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Effects that show in statistics and not in the mean, each against what the file promises."""

from __future__ import annotations

from dataclasses import dataclass

from adxl_ros.diagnose.baseline_comparison import Series
from adxl_ros.diagnose.evidence import bridged
from adxl_ros.diagnose.noise_comparison import simulated_noise
from adxl_ros.diagnose.noise_floor import runs
from adxl_ros.model import noise
from adxl_ros.model.sensor import Sensor
import numpy as np
from scipy.signal import lfilter, periodogram

_MAINS_HZ = (50.0, 60.0)
_MAINS_WITHIN_HZ = 0.6
_LINE_NATS = 14.0
"""Excess of the largest ordinate of a periodogram over what thousands of them reach by chance."""
_SPIKE_SIGMA = 7.0
_EXCESS = 1.2
"""Noise density by the stated one: units differ by less."""
_STEPS = 1.6
_NEAREST, _FEWEST = 2, 500
_CALM_S = 10.0
_LEVELS, _ODD = 0.02, 4.0
"""Of the range: levels that spikes are counted by; how much rarer others may be there."""


@dataclass(frozen=True)
class Sign:
    """
    One noise-like effect that shows.

    Attributes
    ----------
    effect
        Its name; 'unknown' for a line that is no mains.
    values
        Its parameters, by name: arrays by axis, or one figure.
    nats
        How much more likely the recording is with it, about.
    words
        For people.

    """

    effect: str
    values: dict[str, np.ndarray]
    nats: float
    words: str


def bad_samples(volts: np.ndarray, time_s: np.ndarray, sensor: Sensor, coarse: bool = False
                ) -> tuple[np.ndarray, list[Sign]]:
    """
    Find samples that say nothing: stuck, spikes, missing.

    Parameters
    ----------
    volts, time_s
        As recorded, (n, m) and (n,).
    sensor
        The baseline.
    coarse
        Whether the steps of the ADC are so large that samples repeat by them.

    Returns
    -------
    tuple
        Samples that count, (n,); the effects behind those that do not.

    """
    finite = np.isfinite(volts).all(axis=1)
    good, signs = finite.copy(), []
    stuck = _stuck(volts, sensor) & finite & (not coarse)
    if stuck.any():
        begins = runs(stuck)
        span = float(time_s[-1] - time_s[0])
        held_s = float(np.median([time_s[b - 1] - time_s[a] for a, b in begins]))
        good &= ~stuck
        signs.append(Sign('stuck', {
            'rate_hz': np.array(len(begins) / span),
            'duration_s': np.array(max(held_s + 1 / sensor.rate_hz, 1 / sensor.rate_hz))},
            5.0 * len(begins), f'{len(begins)} times the samples repeat, {held_s:.3g} s long'))
    spikes, size = _spikes(volts, good, sensor)
    if spikes.any() and not _by_level(volts, spikes):
        count = int(spikes.any(axis=1).sum())
        good &= ~spikes.any(axis=1)
        rate_hz = spikes.sum() / len(sensor.axes) / float(time_s[-1] - time_s[0])
        signs.append(Sign('spikes', {'rate_hz': np.array(rate_hz), 'amplitude_v': size},
                          10.0 * count, f'{count} samples stand alone, by '
                          f'{size.max() * 1e3:.3g} mV'))
    return good, signs


def still_alone(spikes: Sign, residual_v: np.ndarray, used: np.ndarray, sensor: Sensor) -> bool:
    """
    Tell whether spikes also leave the line in what the best hypothesis leaves.

    The sensor's own motion may look like spikes until it is taken off.

    Parameters
    ----------
    spikes
        As found in the recording.
    residual_v, used
        V, (n, m), and samples that count, (n,): spikes are not among them.
    sensor
        Of the hypothesis.

    """
    alone, _ = _spikes(residual_v, np.isfinite(residual_v).all(axis=1), sensor)
    expected = float(spikes.values['rate_hz']) * len(sensor.axes) * len(used) / sensor.rate_hz
    return bool(alone[~used].sum() > expected / 2)


def _stuck(volts: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Tell samples that repeat the one before in all axes, longer than chance does."""
    same = np.concatenate([[False], (np.diff(volts, axis=0) == 0).all(axis=1)])
    # Neighbours go along with each other: the root is on the safe side.
    usual = float(np.sqrt(np.prod([np.mean(np.diff(v) == 0) for v in volts.T])))
    chance = max(usual, 1e-3 if len(sensor.axes) > 1 else 0.05)
    longest = max(3, int(np.ceil(np.log(1e-4 / len(volts)) / np.log(min(chance, 0.5)))))
    out = np.zeros(len(volts), bool)
    for begin, end in runs(same):
        if end - begin >= longest:
            out[begin:end] = True
    return out


def _spikes(volts: np.ndarray, good: np.ndarray, sensor: Sensor
            ) -> tuple[np.ndarray, np.ndarray]:
    """Tell samples that leave the line between their neighbours and come back."""
    middle = volts - (np.roll(volts, _NEAREST, 0) + np.roll(volts, -_NEAREST, 0)) / 2
    out, size = np.zeros(volts.shape, bool), np.zeros(volts.shape[1])
    # What comes back after samples that repeat, or are missing, is no spike.
    whole = np.convolve(good, np.ones(4 * _NEAREST + 1), 'same') > 4 * _NEAREST
    for d in range(volts.shape[1]):
        off = middle[:, d]
        calm = np.nanmedian(np.abs(off[good])) / 0.6745
        # What moves is not told from spikes by this: compare with what is around it, too.
        local = _local_scale(np.nan_to_num(off), round(max(sensor.rate_hz * 0.2, 9)))
        far = (np.abs(off) > _SPIKE_SIGMA * np.maximum(local, max(calm, sensor.lsb_v))) & whole
        far[:_NEAREST] = far[-_NEAREST:] = False
        # The neighbours of a spike leave the line by half of it.
        peak = np.abs(off) >= np.maximum.reduce([
            np.abs(np.roll(off, k)) for k in range(-_NEAREST, _NEAREST + 1)])
        alone = far & peak
        if alone.sum() >= 3:
            out[:, d] = alone
            size[d] = float(np.median(np.abs(off[alone])))
    return out, size


def _by_level(volts: np.ndarray, spikes: np.ndarray) -> bool:
    """Tell samples that leave the line at some levels only: steps of the ADC do, spikes do not."""
    usual, odd = 0.0, 0
    for v, alone in zip(volts.T, spikes.T):
        level = np.floor(v / (_LEVELS * max(np.nanmax(v) - np.nanmin(v), 1e-9)))
        before = np.roll(level, _NEAREST)
        there = np.isin(before, np.unique(before[alone]))
        usual += float(there.mean()) * alone.sum()
        odd += int(alone.sum())
    return bool(odd > 10 and usual / odd < 1 / _ODD)


def _local_scale(values: np.ndarray, width: int) -> np.ndarray:
    """Rms of the values around, without the largest: by blocks, interpolated."""
    count = max(len(values) // width, 1)
    blocks = np.abs(values[:count * width]).reshape(count, -1)
    scale = np.median(blocks, axis=1) / 0.6745
    return np.interp(np.arange(len(values)), (np.arange(count) + 0.5) * width, scale)


def coarse_steps(volts: np.ndarray, sensor: Sensor) -> Sign | None:
    """Tell an ADC whose codes are coarser than stated."""
    if not sensor.lsb_v:
        return None
    lost = []
    for v in volts.T:
        levels = np.unique(v[np.isfinite(v)])
        apart = np.diff(levels)
        apart = apart[apart > sensor.lsb_v * 0.3]
        if len(apart) < 8:
            return None
        step = float(np.median(apart[apart < 1.5 * apart.min()]))
        lost.append(np.log2(step / sensor.lsb_v))
    bits = float(np.median(lost))
    if bits < np.log2(_STEPS):
        return None
    return Sign('quantisation', {'lost_bits': np.array(bits)}, 1e3,
                f'codes are {2 ** bits:.3g} steps apart')


def of_residual(residual_v: np.ndarray, used: np.ndarray, series: Series) -> list[Sign]:
    """
    Look at what the best hypothesis of the mean leaves.

    Parameters
    ----------
    residual_v
        V, (n, m).
    used
        Samples that count, (n,).
    series
        Of the same samples.

    """
    sensor = series.sensor
    signs = []
    data = bridged(residual_v, used)
    rc_s, _ = noise.electronics(sensor)
    decay = np.exp(-1 / (sensor.rate_hz * np.where(rc_s > 0, rc_s, 1e-9)))
    white = np.column_stack([lfilter([1.0, -a], [1.0], r)[1:] for r, a in zip(data.T, decay)])
    # Differences, so that a wandering zero-g is no line.
    apart, rests = np.diff(white, axis=0), (series.still & used)[2:]
    line = _line(apart, sensor, residual_v, series.time_s)
    if line is not None and line.effect == 'unknown':
        # What does not show while the sensor rests is a trace of how it moves.
        resting = None if rests.sum() < _CALM_S * sensor.rate_hz else _line(
            apart * rests[:, None], sensor, residual_v, series.time_s)
        line = None if resting is None or resting.effect != 'unknown' else line
    if line is not None:
        signs.append(line)
    # Differences, so that a wandering zero-g is none of it; where it moves, what is not modelled
    # would pass for noise.
    made = simulated_noise(series, sensor, 0)
    other = np.diff(np.column_stack([lfilter([1.0, -a], [1.0], r)[1:]
                                     for r, a in zip(made.T, decay)]), axis=0)
    chosen = rests if rests.sum() > _FEWEST else used[2:]
    ratio = np.median(np.abs(apart[chosen]), axis=0) / np.median(np.abs(other[chosen]), axis=0)
    if rests.sum() > _FEWEST:
        # Noise that the filter did not pass looks like more of it, sample by sample.
        ratio = np.minimum(ratio, np.std(data[2:][rests], axis=0) / np.std(made[2:][rests],
                                                                           axis=0))
    # A line is no noise: the median over frequencies does not see it.
    ratio = np.minimum(ratio, _level(apart, sensor) / _level(other, sensor))
    if np.max(ratio) > _EXCESS:
        signs.append(Sign('noise_excess', {'ratio': ratio - 1},
                          len(white) * float(np.log(np.max(ratio)) ** 2),
                          f'white noise is {np.max(ratio):.2f} of what is stated'))
    return signs


def _level(white: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Return the level of noise by its spectrum's median, (m,)."""
    _, power = periodogram(white, sensor.rate_hz, 'hann', axis=0)
    return np.sqrt(np.median(power, axis=0))


def _line(white: np.ndarray, sensor: Sensor, residual_v: np.ndarray, time_s: np.ndarray
          ) -> Sign | None:
    frequency, power = periodogram(white, sensor.rate_hz, 'hann', axis=0)
    keep = frequency > 1.0
    frequency, power = frequency[keep], power[keep]
    if len(frequency) < 64:
        return None
    around = np.column_stack([_local_level(p) for p in power.T])
    excess = (power / around).sum(axis=1)
    best = int(np.argmax(excess))
    nats = float(excess[best]) - np.log(len(frequency)) - len(sensor.axes)
    if nats < _LINE_NATS:
        return None
    at = float(frequency[best])
    for mains in _MAINS_HZ:
        for k in (1, 2):
            alias = abs((k * mains + sensor.rate_hz / 2) % sensor.rate_hz - sensor.rate_hz / 2)
            if abs(alias - at) < _MAINS_WITHIN_HZ:
                turn = np.exp(-2j * np.pi * at * time_s)
                amplitude = 2 * np.abs(np.nanmean(residual_v * turn[:, None], axis=0))
                true = k * mains + (at - alias)
                return Sign('mains_hum', {
                    'amplitude_v': amplitude, 'frequency_hz': np.array(true),
                    'phase_rad': np.array(0.0)}, nats,
                    f'a line at {at:.2f} Hz, {amplitude.max() * 1e3:.3g} mV')
    return Sign('unknown', {}, nats, f'a line at {at:.2f} Hz, which is no mains frequency')


def _local_level(power: np.ndarray, width: int = 201) -> np.ndarray:
    """Mean of the ordinates around by their median."""
    count = max(len(power) // width, 1)
    blocks = power[:count * width].reshape(count, -1) if len(power) >= width else power[None]
    level = np.median(blocks, axis=1) / np.log(2)
    return np.interp(np.arange(len(power)), (np.arange(count) + 0.5) * width, level)
