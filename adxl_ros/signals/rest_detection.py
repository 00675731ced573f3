# SPDX-License-Identifier: Apache-2.0

"""
Rest detection: the intervals of a stream in which the sensor does not move.

One search serves recordings and live streams. It uses the statistics of short blocks, so that the
portions in which a stream is fed do not change the rests. A knock that does not change the mean
does not end a rest, and is left out of the mean. On a live stage, which uses the datasheet noise
only, a knock begins the dwell again. The noise is that of the datasheet, learned from the quietest
parts of the stream, or the larger of both. `recording_finder` and `RecordedRests` are the rests of
a recording, for all tools.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import NamedTuple

from adxl_ros.files.recording_columns import JOINTS, Recording
from adxl_ros.model.constants import G0_MPS2, SAME_ANGLE_RAD
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals import block_statistics as stats
from adxl_ros.signals.block_statistics import Blocks, Spans
from adxl_ros.signals.rest_limits import datasheet_noise
from adxl_ros.signals.rest_means import means_of_blocks
from adxl_ros.signals.rest_search import BY_STREAM, Detection, DRIFT_SIGMAS, Rest, RestRule, search
import numpy as np

_PART_S = 3600.0  # Time after which old blocks are forgotten, s; it bounds the memory
_ANGLES = (JOINTS['alpha'], JOINTS['beta'])  # Columns of the encoder angles
_STATISTICS = {'rms': 'moving', 'drift': 'drifting'}
"""What a sensor does whose statistic is above its limit, by the name of the statistic."""


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
        state = 'at rest' if self.at_rest else _STATISTICS[self.statistic]
        return (
            f'{state}: {self.value * scale:.2g} m/s² on {sensor.axes[self.axis]}, '
            f'must be below {self.limit * scale:.2g}'
        )


class RestMean(NamedTuple):
    """A rest with the mean of its samples."""

    rest: Rest
    mean_v: np.ndarray  # Mean, V, (m,)
    std_v: np.ndarray  # Standard deviation of the mean by noise, V, (m,)


class RestFinder:
    """Finds the rests in a stream while it runs."""

    def __init__(self, rate_hz: float, axes: int, rule: RestRule = BY_STREAM) -> None:
        self.rule = rule
        self._spans = Spans(rate_hz)
        self._settling = rule.settling_blocks(self._spans)
        angles = 0 if rule.angle_tolerance_rad is None else 2
        self._cutter = stats.BlockCutter(rate_hz, axes, angles)
        self._parts = [self._cutter.none()]
        self._newest: Detection | None = None  # Of the newest search

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
        return list(self._detection().rests)

    def by_own_noise(self) -> RestFinder:
        """Return a finder of the same samples that only uses the noise that they show."""
        other = copy(self)
        other.rule = replace(self.rule, noise=None, learns=True)
        other._newest = None
        return other

    def forget(self) -> None:
        """Keep the newest blocks only, in which a drift may begin."""
        self._parts = [self.blocks()[-self._spans.longest :]]
        self._newest = None

    def means(self, rests: Sequence[Rest]) -> list[RestMean]:
        """Return some of the rests with their means."""
        blocks = self.blocks()
        bounds = [np.searchsorted(blocks.start, [rest.start, rest.stop]) for rest in rests]
        parts = [blocks[first:stop] for first, stop in bounds]
        return list(map(RestMean, rests, *means_of_blocks(parts, self._spans, self.rule.noise)))

    def stillness(self) -> Stillness | None:
        """Return whether the newest samples are at rest; None while there are too few."""
        limits = self._detection().limits
        half = self._spans.half
        count = max(2 * half, self._spans.window)
        newest = self.blocks()[-count:]
        is_whole = len(newest) == count and newest.run[0] == newest.run[-1]
        if limits is None or not is_whole:
            return None
        rms = np.sqrt(stats.window_variance(newest, self._spans)[-1])
        halves = newest.mean[-2 * half :].reshape(2, half, -1).mean(axis=1)
        values = np.concatenate([rms, np.abs(halves[1] - halves[0])])
        allowed = np.concatenate(
            [np.sqrt(limits.variance), DRIFT_SIGMAS * limits.drift[0] + limits.step]
        )
        worst = int(np.argmax(values / allowed))
        statistic, axis = divmod(worst, len(rms))
        return Stillness(
            at_rest=bool(values[worst] <= allowed[worst]),
            axis=axis,
            statistic=list(_STATISTICS)[statistic],
            value=float(values[worst]),
            limit=float(allowed[worst]),
        )

    def _detection(self) -> Detection:
        """Find limits and rests of the stream so far; search again only after a new block."""
        blocks = self.blocks()
        if self._newest is None or self._newest.blocks != len(blocks):
            self._newest = search(blocks, self._spans, self.rule, self._settling)
        return self._newest


def find_rests(
    time_s: np.ndarray,
    samples: np.ndarray,
    rate_hz: float,
    rule: RestRule = BY_STREAM,
    angles_rad: np.ndarray | None = None,
) -> list[Rest]:
    """Find the rests of a recording by samples, (n, m), in any unit, and encoder angles."""
    finder = RestFinder(rate_hz, samples.shape[1], rule)
    finder.feed(time_s, samples, angles_rad)
    return finder.rests()


def recording_finder(sensor: Sensor, has_angles: bool) -> RestFinder:
    """Return the finder of rests in a recording that all tools use."""
    is_unknown = 'noise_density_g_per_rthz' in sensor.unstated
    rule = RestRule(
        noise=None if is_unknown else datasheet_noise(sensor),
        angle_tolerance_rad=(
            max(sensor.stage_resolution_rad, SAME_ANGLE_RAD) if has_angles else None
        ),
        gravity=sensor.nominal_scale_v_per_g,
    )
    return RestFinder(sensor.rate_hz, len(sensor.axes), rule)


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
        return finder.means(finder.rests())

    def take(self) -> None:
        """Add the newest rests to `detected`; what was found twice is one rest."""
        for found in self._finder.means(self._finder.rests()):
            newest = self.detected[-1] if self.detected else None
            if newest is None or found.rest.time_start_s > newest.rest.time_stop_s:
                self.detected.append(found)
            else:
                self.detected[-1] = newest._replace(rest=_joined(newest.rest, found.rest))


def _joined(earlier: Rest, later: Rest) -> Rest:
    """Return one rest of two that overlap."""
    disturbed_s = [span for span in later.disturbed_s if span[0] >= earlier.time_stop_s]
    return replace(
        earlier,
        stop=later.stop,
        time_stop_s=later.time_stop_s,
        disturbed_s=(*earlier.disturbed_s, *disturbed_s),
    )


def rests_of(sensor: Sensor, read: Recording) -> list[RestMean]:
    """Return the rests of a whole recording."""
    rests = RecordedRests(sensor, read)
    rests.feed(read)
    rests.take()
    return rests.detected
