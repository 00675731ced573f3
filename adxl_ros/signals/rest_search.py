# SPDX-License-Identifier: Apache-2.0

"""
The search for rests among the blocks of a stream.

A block is quiet if the variance around it is that of the noise. A sequence of quiet blocks is a
rest if its mean is constant as well. The mean is compared over 0.5 s to 4 s anywhere in it, and at
its ends, where a filter or a stage settles.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from adxl_ros.signals import block_statistics as stats
from adxl_ros.signals.block_statistics import Blocks, Spans
from adxl_ros.signals.rest_limits import (
    differing_start,
    largest_limits,
    learned_limits,
    NoiseLimits,
    SampleNoise,
    stated_limits,
)
import numpy as np

_HAND_HELD_S = 1.4  # Shortest rest by hand, s, without 0.3 s of margins. Chosen: beyond pauses
_STAGE_S = 0.6  # Shortest rest on a stage, s, without these margins. Chosen: dwells are longer
_KNOCK_S = 1.0  # Longest disturbance within a rest, s. Chosen: a knock has decayed
DRIFT_SIGMAS = 5.0  # Smallest drift, stds. Chosen: one false alarm in hours
_SETTLE_TAUS = 8.0  # Settling time, RC. Chosen: 0.03 % of a step is below the noise of a mean
_LARGEST_SWING_G = 0.1
"""Rms of the means of blocks, g, up to which a sensor may be at rest. Chosen: far above noise, and
what stands swings by less below 10 Hz."""
_SWING_CORRELATION = -0.5
"""Autocorrelation that a swing falls to after half a period. Chosen: that of noise stays above."""


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
        return inside


@dataclass(frozen=True)
class RestRule:
    """What counts as a rest."""

    # Noise that is known of the sensor; None where only the stream shows it
    noise: SampleNoise | None = None
    # Whether the quietest parts of the stream show the noise, too. The larger one then counts, and
    # a knock does not end a rest.
    learns: bool = True
    # By how much the angles of one pose differ from their middle, rad; None without encoders
    angle_tolerance_rad: float | None = None
    # 1 g in the unit of the samples. Only with it is a steady swing told from a rest.
    gravity: np.ndarray | float = np.inf

    def shortest_blocks(self, spans: Spans) -> int:
        """Return the length of the shortest rest, blocks."""
        on_stage = not self.learns or self.angle_tolerance_rad is not None
        shortest_s = _STAGE_S if on_stage else _HAND_HELD_S
        return max(round(shortest_s / spans.block_s), spans.window)

    def settling_blocks(self, spans: Spans) -> int:
        """Return how long a motion that is below the limits may still go on, blocks."""
        settle_s = _SETTLE_TAUS * self.noise.tau_s if self.noise is not None else 0.0
        return max(int(np.ceil(settle_s / spans.block_s)), 1)


BY_STREAM = RestRule()  # The rule for a stream of which nothing else is known


class Part(NamedTuple):
    """Blocks in a row, by their numbers."""

    first: int
    stop: int  # The one after the last


class Detection(NamedTuple):
    """What a search found."""

    blocks: int  # Number of blocks that were searched
    limits: NoiseLimits | None  # Limits of the noise; None while the stream is too short
    rests: list[Rest]


def search(blocks: Blocks, spans: Spans, rule: RestRule, settling: int) -> Detection:
    """Find limits and rests of the blocks of a whole stream; `settling` blocks begin a rest."""
    step = stats.adc_step(blocks)
    windows = stats.without_stuck(blocks, stats.window_variance(blocks, spans), step)
    limits = largest_limits(
        stated_limits(rule.noise, step, spans) if rule.noise else None,
        learned_limits(blocks, windows, step, spans) if rule.learns else None,
    )
    if limits is None:
        return Detection(len(blocks), None, [])
    return Detection(
        len(blocks), limits, _Search(blocks, windows, limits, spans, rule).rests(settling)
    )


class _Search:
    """One search for the rests among the blocks of a stream."""

    def __init__(
        self,
        blocks: Blocks,
        windows: np.ndarray,
        limits: NoiseLimits,
        spans: Spans,
        rule: RestRule,
    ) -> None:
        self._blocks = blocks
        self._limits = limits
        self._spans = spans
        self._rule = rule
        # Bounds of the encoder angles of each block; None without encoders
        self._bounds = None if rule.angle_tolerance_rad is None else stats.angle_bounds(blocks)
        self._quiet = stats.quiet_blocks(blocks, windows, limits.variance, spans.window)

    def rests(self, settling: int) -> list[Rest]:
        """Return the rests; each may move in its first blocks, `settling` of them."""
        still = self._quiet & ~self._drifting()
        parts = []
        for run in stats.true_runs(still, self._blocks.run):
            for first, stop in self._split_by_angle(Part(*run)):
                part = self._without_ends(Part(first + settling, stop))
                if part.stop - part.first >= self._spans.window:
                    parts.append(part)
        groups = self._joined_across_knocks(parts) if self._rule.learns else [[p] for p in parts]
        shortest = self._rule.shortest_blocks(self._spans)
        return [
            self._rest(group)
            for group in groups
            if group[-1].stop - group[0].first >= shortest and not self._swings(group)
        ]

    def _rest(self, group: list[Part]) -> Rest:
        """Return the rest of some parts, between which it is disturbed."""
        blocks = self._blocks
        first = group[0].first
        last = group[-1].stop - 1
        return Rest(
            start=int(blocks.start[first]),
            stop=int(blocks.start[last]) + self._spans.size,
            time_start_s=float(blocks.time_s[first, 0]),
            time_stop_s=float(blocks.time_s[last, 1]),
            disturbed_s=tuple(
                (float(blocks.time_s[before.stop - 1, 1]), float(blocks.time_s[after.first, 0]))
                for before, after in pairwise(group)
            ),
        )

    def _swings(self, group: list[Part]) -> bool:
        """
        Return whether the means of blocks swing as a shaker does that never stops.

        The quietest parts of such a stream are motion, too, so that it passes for noise.
        """
        means = np.concatenate([self._blocks.mean[part.first : part.stop] for part in group])
        swing = means - means.mean(axis=0)
        if (swing.std(axis=0) <= _LARGEST_SWING_G * self._rule.gravity).all():
            return False
        power = np.abs(np.fft.rfft(swing, 2 * len(swing), axis=0)) ** 2
        correlation = np.fft.irfft(power.sum(axis=1))[: len(swing) // 4]
        return bool(correlation.min() < _SWING_CORRELATION * correlation[0])

    def _drifting(self) -> np.ndarray:
        """
        Mark the blocks where the mean moves, (k,) bool, by comparing neighbouring halves.

        Short halves come first, and longer halves compare only the blocks that are not marked yet.
        A slip thus marks only half a length on either side; a slower drift marks more. Blocks
        between two marked parts are marked as well, unless they are enough for the longest halves.
        """
        blocks = self._blocks
        quiet = self._quiet
        drifting = np.zeros(len(blocks), bool)
        for octave in range(stats.DRIFT_OCTAVES):
            half = self._spans.half << octave
            differences, valid = stats.half_differences(blocks, quiet & ~drifting, half)
            allowed = DRIFT_SIGMAS * self._limits.drift[octave] + self._limits.step
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

    def _without_ends(self, part: Part) -> Part:
        """Cut the ends that differ from the middle: settling, or an approaching hand."""
        first, stop = part
        means = self._blocks.mean
        longest = min((stop - first) // 4, self._spans.longest // 2)
        if longest > 0:
            first += differing_start(means[first:stop], longest, self._limits, self._spans)
            stop -= differing_start(means[first:stop][::-1], longest, self._limits, self._spans)
        return Part(first, stop)

    def _split_by_angle(self, part: Part) -> list[Part]:
        """Split blocks where an encoder angle leaves its tolerance."""
        first, stop = part
        bounds = self._bounds
        if bounds is None:
            return [part]
        parts = []
        begin = first
        widest = bounds[first]
        changed = (bounds[first + 1 : stop] != bounds[first : stop - 1]).any(axis=(1, 2))
        for i in (first + 1 + np.flatnonzero(changed)).tolist():
            widest = np.fmax(widest, bounds[i])
            if not self._is_one_pose(widest):
                parts.append(Part(begin, i))
                begin = i
                widest = bounds[i]
        return [*parts, Part(begin, stop)]

    def _joined_across_knocks(self, parts: list[Part]) -> list[list[Part]]:
        """
        Group parts if the disturbance or gap between them has not changed mean and angles.

        A drift without motion that returns to the same mean is noise, and part of the rest.
        """
        groups: list[list[Part]] = []
        for part in parts:
            if not groups:
                groups.append([part])
                continue
            group = groups[-1]
            before = group[-1]
            has_drifted = self._has_only_drifted(before, part)
            is_near = has_drifted or self._is_knock(before, part)
            if not is_near or not self._is_same_pose(group, part):
                groups.append([part])
            elif has_drifted:
                group[-1] = Part(before.first, part.stop)
            else:
                group.append(part)
        return groups

    def _has_only_drifted(self, before: Part, after: Part) -> bool:
        """Return whether a few quiet blocks without a gap are between two parts."""
        blocks = self._blocks
        return bool(
            after.first - before.stop <= self._spans.longest
            and self._quiet[before.stop : after.first].all()
            and blocks.run[before.stop - 1] == blocks.run[after.first]
        )

    def _is_knock(self, before: Part, after: Part) -> bool:
        """Return whether a disturbance between two parts is as short as a knock."""
        spans = self._spans
        longest_s = (max(_KNOCK_S / spans.block_s, spans.window) + 1) * spans.block_s
        time_s = self._blocks.time_s
        return bool(0 <= time_s[after.first, 0] - time_s[before.stop - 1, 1] <= longest_s)

    def _is_same_pose(self, group: list[Part], after: Part) -> bool:
        """Return whether neither angles nor mean of a rest change in the part after it."""
        bounds = self._bounds
        if bounds is not None:
            widest = np.fmax.reduce(bounds[group[0].first : after.stop])
            if not self._is_one_pose(widest):
                return False
        means = self._blocks.mean
        reach = self._spans.longest // 2
        end = group[-1].stop
        return not self._limits.differ(
            means[max(group[0].first, end - reach) : end],
            means[after.first : min(after.stop, after.first + reach)],
            self._spans,
        )

    def _is_one_pose(self, bounds: np.ndarray) -> bool:
        """Return whether the angles within (−lowest, highest), (2, a), are those of one pose."""
        assert self._rule.angle_tolerance_rad is not None, 'angles have a tolerance'
        allowed = 2 * self._rule.angle_tolerance_rad * (1 + 1e-9)  # of rounding
        return not (bounds.sum(axis=0) > allowed).any()
