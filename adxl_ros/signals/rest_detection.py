# SPDX-License-Identifier: Apache-2.0

"""
Rest detection: the intervals of a stream in which the sensor does not move.

One search serves recordings and live streams. It uses the statistics of short blocks, so that the
portions in which a stream is fed do not change the rests. A block is quiet if the variance around
it is that of the noise. A sequence of quiet blocks is a rest if its mean is constant as well. The
mean is compared over 0.5 s to 4 s anywhere in it, and at its ends, where a filter or a stage
settles. A knock that does not change the mean does not end a rest, and is left out of the mean. On
a live stage, which uses the datasheet noise only, a knock begins the dwell again. The noise is
that of the datasheet, learned from the quietest parts of the stream, or the larger of both.
`recording_finder` and `RecordedRests` are the rests of a recording, for all tools.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import NamedTuple

from adxl_ros.files.recording_columns import JOINTS, Recording
from adxl_ros.model.constants import G0_MPS2, SAME_ANGLE_RAD
from adxl_ros.model.noise import effective_samples, sample_std_v
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals import block_statistics as stats
from adxl_ros.signals.block_statistics import Blocks, Spans
import numpy as np
import scipy

_HAND_HELD_S = 1.4  # Shortest rest by hand, s, without 0.3 s of margins. Chosen: beyond pauses
_STAGE_S = 0.6  # Shortest rest on a stage, s, without these margins. Chosen: dwells are longer
_KNOCK_S = 1.0  # Longest disturbance within a rest, s. Chosen: a knock has decayed
_PART_S = 3600.0  # Time after which old blocks are forgotten, s; it bounds the memory
MOST_BATCHES = 20  # Most batches that show the error of a mean. Chosen: the usual number
_MIN_BATCH_BLOCKS = 2  # Smallest length of such a batch, blocks: 0.1 s
_DRIFT_SIGMAS = 5.0  # Smallest drift, stds. Chosen: one false alarm in hours
_SETTLE_TAUS = 8.0  # Settling time, RC. Chosen: 0.03 % of a step is below the noise of a mean
_ANGLES = (JOINTS['alpha'], JOINTS['beta'])  # Columns of the encoder angles
_FALSE_ALARM = 1e-6  # Probability that the variance of noise exceeds its limit
_QUARTILE_TO_STD = 0.3186  # First quartile of |normal deviate|, stds
_END_SIGMAS = 3.5  # Difference of an end of a rest that is cut, stds
_LARGEST_SWING_G = 0.1
"""Rms of the means of blocks, g, up to which a sensor may be at rest. Chosen: far above noise, and
what stands swings by less below 10 Hz."""
_SWING_CORRELATION = -0.5
"""Autocorrelation that a swing falls to after half a period. Chosen: that of noise stays above."""


@dataclass(frozen=True)
class SampleNoise:
    """Noise of one sample."""

    sigma: np.ndarray  # Standard deviation by axis, in the unit of the samples, (m,)
    tau_s: float = 0.0  # Time constant of the filter that correlates it, s


def datasheet_noise(sensor: Sensor) -> SampleNoise:
    """Return the noise of a sample by the datasheet values of a sensor, V."""
    return SampleNoise(sample_std_v(sensor), sensor.rc_s)


@dataclass(frozen=True)
class NoiseLimits:
    """Limits of what noise explains, for m axes."""

    variance: np.ndarray  # Largest variance within a window, (m,)
    # Standard deviation of the difference of two neighbouring halves, by octaves of their length,
    # (DRIFT_OCTAVES, m)
    drift: np.ndarray
    # Largest change of a mean by rounding of the ADC, where the input does not change, (m,)
    step: np.ndarray

    @property
    def flicker(self) -> np.ndarray:
        """Return the standard deviation of the difference of two very long means, (m,)."""
        # The longest halves have 2^(DRIFT_OCTAVES − 1) times the length of the shortest.
        white = self.drift[0] ** 2 / (1 << stats.DRIFT_OCTAVES - 1)
        return np.sqrt(np.maximum(self.drift[-1] ** 2 - white, 0))

    def block_noise(self, spans: Spans) -> np.ndarray:
        """Return the standard deviation of the mean of one block, (m,)."""
        return self.drift[0] * np.sqrt(spans.half / 2)

    def differ(self, before: np.ndarray, after: np.ndarray, spans: Spans) -> bool:
        """Return whether two sequences of means of blocks, (k, m), differ by more than noise."""
        white = self.block_noise(spans) ** 2 * (1 / len(before) + 1 / len(after))
        allowed = _END_SIGMAS * np.sqrt(white + self.flicker**2) + self.step
        return bool((np.abs(before.mean(axis=0) - after.mean(axis=0)) > allowed).any())


def _largest(limits: list[NoiseLimits]) -> NoiseLimits | None:
    if not limits:
        return None
    names = [field.name for field in fields(NoiseLimits)]
    return NoiseLimits(
        **{name: np.maximum.reduce([getattr(each, name) for each in limits]) for name in names}
    )


def stated_limits(noise: SampleNoise, step: np.ndarray, spans: Spans) -> NoiseLimits:
    """
    Return the limits for a given noise, whose sample variance is chi-squared.

    A first-order filter correlates neighbours by a = exp(−dt/τ). The variance of n such samples
    scatters as the variance of n·(1 − a²)/(1 + a²) independent samples.
    """
    a = np.exp(-1 / (spans.rate_hz * noise.tau_s)) if noise.tau_s else 0.0
    freedom = max((spans.window * spans.size - 1) * (1 - a * a) / (1 + a * a), 1.0)
    ratio = max(scipy.special.chdtri(freedom, _FALSE_ALARM) / freedom, stats.MIN_VARIANCE_RATIO)
    sigma = np.hypot(noise.sigma, step / np.sqrt(12))
    halves = spans.half * spans.size << np.arange(stats.DRIFT_OCTAVES)
    drift = np.sqrt(2 / effective_samples(halves, 1 / spans.rate_hz, noise.tau_s))[:, None] * sigma
    return NoiseLimits(ratio * sigma**2, drift, stats.undithered(step, sigma))


def learned_limits(
    blocks: Blocks, windows: np.ndarray, step: np.ndarray, spans: Spans
) -> NoiseLimits | None:
    """Learn the limits from the quietest windows; None while the stream is too short."""
    if len(blocks) < max(spans.window, 2 * spans.half):
        return None
    variance, limit = stats.quiet_variance(blocks, windows, step)
    quiet = stats.quiet_blocks(blocks, windows, limit, spans.window)
    drift = np.empty((stats.DRIFT_OCTAVES, len(step)))
    for octave in range(stats.DRIFT_OCTAVES):
        half = spans.half << octave
        noise = _drift_noise(*stats.half_differences(blocks, quiet, half), half)
        white = np.sqrt(2 * variance / (half * spans.size))
        if octave:
            # Noise falls with the length, by no more than that of white noise.
            shorter = drift[octave - 1]
            noise = shorter / np.sqrt(2) if noise is None else np.minimum(noise, shorter)
        drift[octave] = white if noise is None else np.maximum(noise, white)
    return NoiseLimits(limit, drift, stats.undithered(step, np.sqrt(variance)))


def _drift_noise(differences: np.ndarray, valid: np.ndarray, half: int) -> np.ndarray | None:
    """
    Learn the standard deviation of the valid differences of halves, (m,); None if none is valid.

    A steady turn adds the same to all differences. Differences of two differences remove it. The
    first quartile of the magnitude is right even if most quiet blocks are no rest.
    """
    both = valid[: -2 * half] & valid[2 * half :]
    if both.any():
        noise = (differences[2 * half :] - differences[: -2 * half])[both] / np.sqrt(2)
    elif valid.any():
        noise = differences[valid]
    else:
        return None
    return np.quantile(np.abs(noise), 0.25, axis=0) / _QUARTILE_TO_STD


def differing_start(
    means: np.ndarray, longest: int, white: np.ndarray, flicker: np.ndarray, step: np.ndarray
) -> int:
    """
    Count the blocks at the start of a rest whose mean differs from the mean of the others.

    Starts of 1, 2, 4, … of the means, (k, m), are compared with the remainder of the rest. A start
    that differs is cut, up to `longest` blocks, and the search begins again after it. The noise is
    `white` for the mean of one block and `flicker` for the difference of very long means.
    """
    total = np.cumsum(means, axis=0)
    lengths = 1 << np.arange(max(longest, 1).bit_length())
    cut = 0
    while (lengths := lengths[cut + lengths <= longest]).size:
        remaining = len(means) - cut - lengths
        start_total = total[cut + lengths - 1]
        start_mean = (start_total - (total[cut - 1] if cut else 0.0)) / lengths[:, None]
        remaining_mean = (total[-1] - start_total) / remaining[:, None]
        noise = np.sqrt(white**2 * (1 / lengths + 1 / remaining)[:, None] + flicker**2)
        differs = (np.abs(start_mean - remaining_mean) > _END_SIGMAS * noise + step).any(axis=1)
        if not differs.any():
            break
        cut += int(lengths[differs.argmax()])
    return cut


@dataclass(frozen=True)
class Rest:
    """A rest of a stream."""

    start: int  # Its first row
    stop: int  # The row after its last
    time_start_s: float  # Time of its first row
    time_stop_s: float  # Time of its last row
    # Times between which it was disturbed, or has no samples, s
    disturbed_s: tuple[tuple[float, float], ...] = ()

    @property
    def span_s(self) -> float:
        """Return the time of the rest, s."""
        return self.time_stop_s - self.time_start_s

    def includes(self, time_s: np.ndarray) -> np.ndarray:
        """Return which stamps, s, (n,), are in the rest and not in a disturbance of it, (n,)."""
        inside = (time_s >= self.time_start_s) & (time_s <= self.time_stop_s)
        for start_s, stop_s in self.disturbed_s:
            inside &= (time_s <= start_s) | (time_s >= stop_s)
        return np.asarray(inside)


@dataclass(frozen=True)
class Stillness:
    """Whether the newest samples are at rest, with the statistic that decides it."""

    at_rest: bool  # Whether all statistics are within their limits
    axis: int  # Index of the axis with the largest motion
    # 'rms' of the samples about their mean over 0.25 s, or 'drift' of the mean over 0.5 s
    statistic: str
    # value, limit: The statistic and its limit, in the unit of the samples
    value: float
    limit: float

    def describe_mps2(self, sensor: Sensor) -> str:
        """Return one line in m/s², for samples that are volts of a sensor."""
        scale = G0_MPS2 / float(sensor.nominal_scale_v_per_g[self.axis])
        state = (
            'at rest' if self.at_rest else {'rms': 'moving', 'drift': 'drifting'}[self.statistic]
        )
        return (
            f'{state}: {self.value * scale:.2g} m/s² on {sensor.axes[self.axis]}, '
            f'must be below {self.limit * scale:.2g}'
        )


class RestFinder:
    """Finds the rests in a stream while it runs."""

    def __init__(
        self,
        rate_hz: float,
        axes: int,
        noise: SampleNoise | None = None,
        learn: bool | None = None,
        angle_tolerance_rad: float | None = None,
        gravity: np.ndarray | float = np.inf,
    ):
        self.noise = noise
        self.learn = noise is None if learn is None else learn
        self.angle_tolerance_rad = angle_tolerance_rad
        self._largest_swing = _LARGEST_SWING_G * np.asarray(gravity)
        self._spans = Spans(rate_hz)
        on_stage = not self.learn or angle_tolerance_rad is not None
        shortest_s = _STAGE_S if on_stage else _HAND_HELD_S
        self._min_blocks = max(round(shortest_s / self._spans.block_s), self._spans.window)
        # A motion that has decayed below the limits may still be in the first block.
        settle_s = _SETTLE_TAUS * noise.tau_s if noise is not None else 0.0
        self._settle = max(int(np.ceil(settle_s / self._spans.block_s)), 1)
        self._cutter = stats.BlockCutter(rate_hz, axes, 0 if angle_tolerance_rad is None else 2)
        self._parts = [self._cutter.none()]
        self._result: tuple[int, NoiseLimits | None, list[Rest]] | None = None

    def feed(
        self, time_s: np.ndarray, samples: np.ndarray, angles_rad: np.ndarray | None = None
    ) -> None:
        """Add samples, (n, m), and encoder angles, rad, (n, 2), if the stream has them."""
        self._parts.append(self._cutter.feed(time_s, samples, angles_rad))

    def blocks(self) -> Blocks:
        """Return the blocks of the stream so far."""
        if len(self._parts) > 1:
            self._parts = [Blocks.join(self._parts)]
        return self._parts[0]

    def rests(self) -> list[Rest]:
        """Return the rests so far; the last rest may not have ended yet."""
        return list(self._detect()[1])

    def by_own_noise(self) -> RestFinder:
        """Return a finder of the same samples that only uses the noise that they show."""
        other = copy(self)
        other.noise = None
        other.learn = True
        other._result = None
        return other

    def forget(self) -> None:
        """Keep the newest blocks only, in which a drift may begin."""
        self._parts = [self.blocks()[-self._spans.longest :]]
        self._result = None

    def means(self, rests: list[Rest]) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean of each rest and its standard deviation, (k, m) each."""
        blocks = self.blocks()
        bounds = [np.searchsorted(blocks.start, [rest.start, rest.stop]) for rest in rests]
        return _means([blocks[first:stop] for first, stop in bounds], self._spans, self.noise)

    def stillness(self) -> Stillness | None:
        """Return whether the newest samples are at rest; None while there are too few."""
        limits, _ = self._detect()
        half = self._spans.half
        count = max(2 * half, self._spans.window)
        newest = self.blocks()[-count:]
        if limits is None or len(newest) < count or newest.run[0] != newest.run[-1]:
            return None
        rms = np.sqrt(stats.window_variance(newest, self._spans)[-1])
        halves = newest.mean[-2 * half :].reshape(2, half, -1).mean(axis=1)
        values = np.concatenate([rms, np.abs(halves[1] - halves[0])])
        allowed = np.concatenate(
            [np.sqrt(limits.variance), _DRIFT_SIGMAS * limits.drift[0] + limits.step]
        )
        worst = int(np.argmax(values / allowed))
        statistic, axis = divmod(worst, len(rms))
        return Stillness(
            bool(values[worst] <= allowed[worst]),
            axis,
            ('rms', 'drift')[statistic],
            float(values[worst]),
            float(allowed[worst]),
        )

    def _detect(self) -> tuple[NoiseLimits | None, list[Rest]]:
        """Find limits and rests of the stream so far; search again only after a new block."""
        blocks = self.blocks()
        if self._result is None or self._result[0] != len(blocks):
            step = stats.adc_step(blocks)
            windows = stats.without_stuck(blocks, stats.window_variance(blocks, self._spans), step)
            found = [
                stated_limits(self.noise, step, self._spans) if self.noise else None,
                learned_limits(blocks, windows, step, self._spans) if self.learn else None,
            ]
            limits = _largest([each for each in found if each is not None])
            rests = [] if limits is None else self._rests(blocks, windows, limits)
            self._result = len(blocks), limits, rests
        return self._result[1:]

    def _rests(self, blocks: Blocks, windows: np.ndarray, limits: NoiseLimits) -> list[Rest]:
        """Find the rests among the blocks of the whole stream."""
        quiet = stats.quiet_blocks(blocks, windows, limits.variance, self._spans.window)
        still = quiet & ~self._drifting(blocks, quiet, limits)
        bounds = None if self.angle_tolerance_rad is None else stats.angle_bounds(blocks)
        parts = []
        for run in stats.true_runs(still, blocks.run):
            for first, stop in self._split_by_angle(bounds, *run):
                first, stop = self._without_ends(blocks.mean, first + self._settle, stop, limits)
                if stop - first >= self._spans.window:
                    parts.append((first, stop))
        groups = [[part] for part in parts]
        if self.learn:
            groups = self._join_across_knocks(blocks, bounds, parts, limits, quiet)
        first_s, last_s = blocks.time_s.T.tolist()
        return [
            Rest(
                int(blocks.start[group[0][0]]),
                int(blocks.start[group[-1][1] - 1]) + self._spans.size,
                first_s[group[0][0]],
                last_s[group[-1][1] - 1],
                tuple(
                    (last_s[end - 1], first_s[first]) for (_, end), (first, _) in pairwise(group)
                ),
            )
            for group in groups
            if group[-1][1] - group[0][0] >= self._min_blocks
            and not self._swings(np.concatenate([blocks.mean[a:b] for a, b in group]))
        ]

    def _swings(self, means: np.ndarray) -> bool:
        """
        Return whether means of blocks, (k, m), swing as a shaker does that never stops.

        The quietest parts of such a stream are motion, too, so that it passes for noise.
        """
        swing = means - means.mean(axis=0)
        if (swing.std(axis=0) <= self._largest_swing).all():
            return False
        power = np.abs(np.fft.rfft(swing, 2 * len(swing), axis=0)) ** 2
        correlation = np.fft.irfft(power.sum(axis=1))[: len(swing) // 4]
        return bool(correlation.min() < _SWING_CORRELATION * correlation[0])

    def _drifting(self, blocks: Blocks, quiet: np.ndarray, limits: NoiseLimits) -> np.ndarray:
        """
        Mark the blocks where the mean moves, (k,) bool, by comparing neighbouring halves.

        Short halves come first, and longer halves compare only the blocks that are not marked yet.
        A slip thus marks only half a length on either side; a slower drift marks more. Blocks
        between two marked parts are marked as well, unless they are enough for the longest halves.
        """
        drifting = np.zeros(len(blocks), bool)
        for octave in range(stats.DRIFT_OCTAVES):
            half = self._spans.half << octave
            differences, valid = stats.half_differences(blocks, quiet & ~drifting, half)
            allowed = _DRIFT_SIGMAS * limits.drift[octave] + limits.step
            places = half + np.flatnonzero(valid & (np.abs(differences) > allowed).any(axis=1))
            marks = np.zeros(len(blocks) + 1)
            np.add.at(marks, places - half // 2, 1)
            np.add.at(marks, places + half // 2, -1)
            drifting |= np.cumsum(marks)[:-1] > 0
        for first, stop in stats.true_runs(quiet & ~drifting, blocks.run):
            between = first and stop < len(blocks) and drifting[first - 1] and drifting[stop]
            if between and stop - first < self._spans.longest:
                drifting[first:stop] = True
        return drifting

    def _without_ends(
        self, means: np.ndarray, first: int, stop: int, limits: NoiseLimits
    ) -> tuple[int, int]:
        """Cut the ends that differ from the middle: settling, or an approaching hand."""
        longest = min((stop - first) // 4, self._spans.longest // 2)
        if longest > 0:
            noise = limits.block_noise(self._spans), limits.flicker, limits.step
            first += differing_start(means[first:stop], longest, *noise)
            stop -= differing_start(means[first:stop][::-1], longest, *noise)
        return first, stop

    def _split_by_angle(
        self, bounds: np.ndarray | None, first: int, stop: int
    ) -> list[tuple[int, int]]:
        """Split blocks `first` to `stop` where an encoder angle leaves its tolerance."""
        if bounds is None:
            return [(first, stop)]
        parts = []
        begin = first
        widest = bounds[first]
        changed = (bounds[first + 1 : stop] != bounds[first : stop - 1]).any(axis=(1, 2))
        for i in (first + 1 + np.flatnonzero(changed)).tolist():
            widest = np.fmax(widest, bounds[i])
            if not self._is_one_pose(widest):
                parts.append((begin, i))
                begin = i
                widest = bounds[i]
        return [*parts, (begin, stop)]

    def _join_across_knocks(
        self,
        blocks: Blocks,
        bounds: np.ndarray | None,
        parts: list[tuple[int, int]],
        limits: NoiseLimits,
        quiet: np.ndarray,
    ) -> list[list[tuple[int, int]]]:
        """
        Group parts if the disturbance or gap between them has not changed mean and angles.

        A drift without motion that returns to the same mean is noise, and part of the rest.
        """
        spans = self._spans
        means = blocks.mean
        longest_s = (max(_KNOCK_S / spans.block_s, spans.window) + 1) * spans.block_s
        reach = spans.longest // 2
        groups: list[list[tuple[int, int]]] = []
        for first, stop in parts:
            if groups:
                begin = groups[-1][0][0]
                end = groups[-1][-1][1]
                has_drifted = (
                    first - end <= spans.longest
                    and quiet[end:first].all()
                    and blocks.run[end - 1] == blocks.run[first]
                )
                between_s = float(blocks.time_s[first, 0] - blocks.time_s[end - 1, 1])
                if (
                    (has_drifted or 0 <= between_s <= longest_s)
                    and (bounds is None or self._is_one_pose(np.fmax.reduce(bounds[begin:stop])))
                    and not limits.differ(
                        means[max(begin, end - reach) : end],
                        means[first : min(stop, first + reach)],
                        spans,
                    )
                ):
                    start = groups[-1].pop()[0] if has_drifted else first
                    groups[-1].append((start, stop))
                    continue
            groups.append([(first, stop)])
        return groups

    def _is_one_pose(self, bounds: np.ndarray) -> bool:
        """Return whether the angles within (−lowest, highest), (2, a), are those of one pose."""
        assert self.angle_tolerance_rad is not None, 'angles have a tolerance'
        allowed = 2 * self.angle_tolerance_rad * (1 + 1e-9)  # of rounding
        return not (bounds.sum(axis=0) > allowed).any()


def recording_finder(sensor: Sensor, has_angles: bool) -> RestFinder:
    """Return the finder of rests in a recording that all tools use."""
    noise = None if 'noise_density_g_per_rthz' in sensor.unstated else datasheet_noise(sensor)
    tolerance_rad = max(sensor.stage_resolution_rad, SAME_ANGLE_RAD) if has_angles else None
    gravity_v = sensor.nominal_scale_v_per_g
    return RestFinder(sensor.rate_hz, len(sensor.axes), noise, True, tolerance_rad, gravity_v)


class RestMean(NamedTuple):
    """A rest of a recording with the mean of its samples."""

    rest: Rest
    mean_v: np.ndarray  # Mean, V, (m,)
    std_v: np.ndarray  # Standard deviation of the mean by noise, V, (m,)


class RecordedRests:
    """Finds the rests of a recording of any length; the memory is that of an hour."""

    def __init__(self, sensor: Sensor, first: Recording) -> None:
        self._sensor = replace(sensor, rate_hz=first.rate_hz)
        self._has_angles = set(_ANGLES) <= set(first.columns)
        self._finder = recording_finder(self._sensor, self._has_angles)
        self._taken_s = float(first.time_s[0])
        self.detected: list[RestMean] = []  # Rests of all blocks up to the last `take`

    def feed(self, block: Recording) -> None:
        """Add a block of the recording."""
        angles_rad = (
            np.column_stack([block.columns[name] for name in _ANGLES])
            if self._has_angles
            else None
        )
        self._finder.feed(block.time_s, block.volts(self._sensor), angles_rad)
        if block.time_s[-1] - self._taken_s > _PART_S:
            self.take()
            self._finder.forget()
            self._taken_s = float(block.time_s[-1])

    def by_own_noise(self) -> list[RestMean]:
        """Return the rests of the newest hour by the noise that the samples show alone."""
        finder = self._finder.by_own_noise()
        rests = finder.rests()
        return [RestMean(*found) for found in zip(rests, *finder.means(rests))]

    def take(self) -> None:
        """Add the newest rests to `detected`; what was found twice is one rest."""
        rests = self._finder.rests()
        for rest, mean_v, std_v in zip(rests, *self._finder.means(rests)):
            newest = self.detected[-1] if self.detected else None
            if newest is None or rest.time_start_s > newest.rest.time_stop_s:
                self.detected.append(RestMean(rest, mean_v, std_v))
                continue
            last = newest.rest
            later = [span for span in rest.disturbed_s if span[0] >= last.time_stop_s]
            joined = replace(
                last,
                stop=rest.stop,
                time_stop_s=rest.time_stop_s,
                disturbed_s=(*last.disturbed_s, *later),
            )
            self.detected[-1] = newest._replace(rest=joined)


def find_rests(
    time_s: np.ndarray,
    samples: np.ndarray,
    rate_hz: float,
    angles_rad: np.ndarray | None = None,
    noise: SampleNoise | None = None,
    learn: bool | None = None,
    angle_tolerance_rad: float | None = None,
    gravity: np.ndarray | float = np.inf,
) -> list[Rest]:
    """
    Find the rests of a recording by samples, (n, m), in any unit, and encoder angles.

    gravity: 1 g in the unit of the samples; only with it is a steady swing told from a rest.
    """
    finder = RestFinder(rate_hz, samples.shape[1], noise, learn, angle_tolerance_rad, gravity)
    finder.feed(time_s, samples, angles_rad)
    return finder.rests()


def rest_means(
    time_s: np.ndarray,
    samples: np.ndarray,
    rests: list[Rest],
    rate_hz: float,
    noise: SampleNoise | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """
    Average the rests of a recording, as `RestFinder.means` does: mean and std, (k, m) each.

    The std is that by the scatter between parts of the rest, and at least that of the noise.
    """
    parts = [
        stats.BlockCutter(rate_hz, samples.shape[1]).feed(
            time_s[rest.start : rest.stop], samples[rest.start : rest.stop]
        )
        for rest in rests
    ]
    return _means(parts, Spans(rate_hz), noise)


def _means(
    parts: list[Blocks], spans: Spans, noise: SampleNoise | None
) -> tuple[np.ndarray, np.ndarray]:
    """Average the blocks of each rest; mean and standard deviation, (k, m) each."""
    # The step is that of all rests: a rest with constant codes does not show it.
    step = stats.adc_step(Blocks.join(parts)) if parts else np.empty(0)
    pairs = [_mean(_without_knocks(part, step, spans), step, spans, noise) for part in parts]
    mean, error = zip(*pairs) if pairs else ((), ())
    return np.array(mean), np.array(error)


def _mean(
    part: Blocks, step: np.ndarray, spans: Spans, noise: SampleNoise | None
) -> tuple[np.ndarray, np.ndarray]:
    """
    Average the blocks of a rest; mean and standard deviation, (m,) each.

    The noise may have any spectrum. The means of up to twenty batches of the rest are nearly
    independent, and their scatter is the long-run variance (batch means; Law and Kelton 2000).
    """
    mean = part.mean.mean(axis=0)
    white = part.squares.sum(axis=0) / max((spans.size - 1) * len(part), 1)
    length = max(-(-len(part) // MOST_BATCHES), _MIN_BATCH_BLOCKS)
    count = len(part) // length
    long_run = np.zeros(len(mean))
    if count > 1:
        batches = part.mean[: count * length].reshape(count, length, -1).mean(axis=1)
        squares = ((batches - batches.mean(axis=0)) ** 2).sum(axis=0)
        long_run = length * squares / (count - 1)
    variance = np.maximum(long_run, white / spans.size) / len(part)
    if noise is not None:
        independent = effective_samples(len(part) * spans.size, 1 / spans.rate_hz, noise.tau_s)
        variance = np.maximum(variance, noise.sigma**2 / independent)
    rounding = stats.undithered(step, np.sqrt(white)) ** 2 / 12
    return mean, np.sqrt(variance + rounding)


def _without_knocks(part: Blocks, step: np.ndarray, spans: Spans) -> Blocks:
    """Leave out the blocks of a rest whose variance differs from that of most blocks."""
    windows = stats.window_variance(part, spans)
    _, limit = stats.quiet_variance(part, windows, step)
    calm = part[stats.quiet_blocks(part, windows, limit, spans.window)]
    return calm if 2 * len(calm) > len(part) else part
