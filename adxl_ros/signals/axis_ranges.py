# SPDX-License-Identifier: Apache-2.0

"""The range of each axis of a recording: where it stays at an end of it, or does not change."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from adxl_ros.files.recording_columns import GYRO
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.signals.block_statistics import true_runs
import numpy as np

_CLIPPED_SAMPLES = 3  # Equal samples at an extreme that are clipped. Chosen: noise repeats fewer
_CLIPPED_STEP = 0.05 * G0_MPS2
"""Change before or after them, m/s² or rad/s. Chosen: a sensor at rest has none."""
_CLIPPED_WINDOW_S = 0.1  # Longest time beside them in which it moves, s. Chosen: a hand is faster
_CLIPPED_CODES = 20
"""Change, in steps of the resolution, that a smooth peak does not reach within the time that it
stays at its top. Chosen: a parabola reaches nine."""
_STUCK_S = 5.0
"""Shortest time without change that is reported, s. Chosen: a coarse axis may rest for some
seconds between two codes."""
_STUCK_SAMPLES = 20  # Fewest samples of such a time. Chosen: a slow sensor repeats a few
_CHANGING = 0.5  # Share of the other samples that change. Chosen: fewer of a coarse axis at rest
_FEWEST_CLIPPED = 3  # Clippings from which a log is not sound. Chosen: one may be a knock


@dataclass(frozen=True)
class AxisRange:
    """The samples of one axis."""

    name: str  # Its column
    # lowest, highest: Its extreme values, m/s², or rad/s of a gyroscope
    lowest: float
    highest: float
    clipped: int  # Times at which it stays at an extreme value in motion
    is_stuck: bool  # Whether it never changes
    # Longest time in which it does not change although it usually does, s; 0 for none
    stuck_s: float


class _End:
    """The largest value of a signal, and how often it stays there in motion."""

    def __init__(self) -> None:
        self.value = -np.inf
        self.clipped = 0

    def feed(self, values: np.ndarray, drop: float, longest: int) -> None:
        """Add values, (n,); in motion they are lower by a drop within `longest` samples."""
        largest = float(values.max())
        if largest > self.value:
            self.value = largest
            self.clipped = 0
        if largest == self.value:
            self.clipped += sum(
                _falls(values, largest - drop, first, stop, longest)
                for first, stop in true_runs(values == largest)
                if stop - first >= _CLIPPED_SAMPLES
            )


def _falls(values: np.ndarray, low: float, first: int, stop: int, longest: int) -> bool:
    """Return whether values are below another one soon before or after some samples."""
    window = max(min(stop - first, longest), 1)
    beside = np.append(values[max(first - window, 0) : first], values[stop : stop + window])
    return bool((beside < low).any())


class AxisLook:
    """Extreme values of an axis, and the longest time in which it does not change."""

    def __init__(self, name: str, period_s: float) -> None:
        self.name = name
        self._period_s = period_s
        self._low = _End()  # Of minus the samples
        self._high = _End()
        self._last = np.nan
        self._count = 0
        self._changes = 0
        self._equal = self._most_equal = 0  # Samples since the last change, and most between two

    def feed(self, values: np.ndarray) -> None:
        """Add further samples, m/s² or rad/s, (n,); those that are no numbers do not count."""
        values = values[np.isfinite(values)]
        if not len(values):
            return
        changes = np.flatnonzero(np.diff(values, prepend=self._last))
        equal = np.diff(changes, prepend=-1 - self._equal, append=len(values)) - 1
        self._equal = int(equal[-1])
        self._most_equal = max(self._most_equal, int(equal.max()))
        self._count += len(values)
        self._changes += len(changes)
        self._last = values[-1]
        steps = np.abs(np.diff(values))
        smallest = float(steps[steps > 0].min(initial=np.inf))
        drop = max(_CLIPPED_STEP, _CLIPPED_CODES * smallest)
        longest = round(_CLIPPED_WINDOW_S / self._period_s)
        self._low.feed(-values, drop, longest)
        self._high.feed(values, drop, longest)

    def result(self) -> AxisRange:
        """Return the range of the axis."""
        low = -self._low.value
        high = self._high.value
        is_stuck = low == high
        stuck_s = self._most_equal * self._period_s
        is_long = stuck_s >= _STUCK_S and self._most_equal >= _STUCK_SAMPLES
        changes_else = self._changes > _CHANGING * (self._count - self._most_equal)
        is_reported = is_long and changes_else
        return AxisRange(
            name=self.name,
            lowest=low,
            highest=high,
            clipped=self._low.clipped + self._high.clipped,
            is_stuck=is_stuck,
            stuck_s=stuck_s if is_stuck or is_reported else 0.0,
        )


def axis_faults(axes: Iterable[AxisRange]) -> list[str]:
    """Return which axes stay at an end of their range, or do not change, one line each."""
    faults = []
    for axis in axes:
        if axis.clipped >= _FEWEST_CLIPPED:
            size, unit = (1.0, 'rad/s') if axis.name in GYRO else (G0_MPS2, 'g')
            faults.append(
                f'{axis.name} stays at its extreme value {axis.clipped} times in motion; its '
                f'range ends at {axis.lowest / size:.3g} or {axis.highest / size:.3g} {unit}'
            )
        elif axis.is_stuck:
            faults.append(f'{axis.name} never changes; the axis is stuck, or not connected')
        elif axis.stuck_s:
            at_end = 'at the end of its range, ' if axis.clipped else ''
            faults.append(
                f'{axis.name} does not change for {axis.stuck_s:.3g} s; the axis is {at_end}'
                'stuck, or the driver repeats a sample'
            )
    return faults
