# SPDX-License-Identifier: Apache-2.0

"""The messages of the monitor: gap and floor by axis, and what has changed since when."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from adxl_ros.monitor.change_record import iso_time
from adxl_ros.monitor.diagnosis_run import DiagnosisResult
from adxl_ros.monitor.live_gap import AxisGap, GapChange
from adxl_ros.nodes.support.diagnostics import Level, Status, status_message
from adxl_ros.nodes.support.topics import stamp
from diagnostic_msgs.msg import DiagnosticArray

_TOGETHER_NS = 120_000_000_000
"""Time within which changes are one event, ns; chosen: slow axes are found later."""


@dataclass(frozen=True)
class GapState:
    """What the monitor knows at one moment."""

    serial: str  # Serial number of the sensor
    stamp_ns: int  # Stamp of the newest sample, ns; 0 before the first
    obstacle: str  # Why nothing is compared; empty where it is
    axes: Sequence[AxisGap]  # The gap by axis; empty before the first seconds
    changes: Sequence[GapChange]  # Changes so far
    likely: DiagnosisResult | None  # The newest diagnosis; None before it
    window_s: float  # Time over which the gap is taken, s

    @property
    def event(self) -> list[GapChange]:
        """Return the changes of the newest event, the earliest first."""
        if not self.changes:
            return []
        newest_ns = max(change.since_ns for change in self.changes)
        event = [change for change in self.changes if newest_ns - change.since_ns < _TOGETHER_NS]
        return sorted(event, key=lambda change: change.since_ns)

    @property
    def level(self) -> Level:
        """Return OK where the gap is no larger than the floor, and nothing has changed."""
        fine = not self.obstacle and self.axes and not self.changes
        return Level.OK if fine and not any(gap.is_open for gap in self.axes) else Level.WARN

    def text(self) -> str:
        """Return the state in one line."""
        if self.obstacle:
            return self.obstacle
        if not self.axes:
            return 'comparing; the first result takes some seconds'
        gaps = ', '.join(f'{gap.axis} {gap.gap.value:.3g}' for gap in self.axes)
        floors = ', '.join(f'{gap.axis} {gap.floor.value:.3g}' for gap in self.axes)
        parts = [f'gap {gaps} mg, floor {floors} mg']
        event = self.event
        if event:
            latest = {(change.axis, change.quantity): change.text() for change in event}
            parts.append(f'changed since {iso_time(event[0].since_ns)}: '
                         f'{", ".join(latest.values())}')
        if self.likely is not None:
            parts.append(f'likely {self.likely.text}' if self.likely.effects
                         else self.likely.text)
        return '; '.join(parts)

    def values(self) -> dict[str, object]:
        """Return the values of the summary by key."""
        values: dict[str, object] = {'window_s': self.window_s, 'changes': len(self.changes)}
        event = self.event
        if event:
            values |= {'changed_since': iso_time(event[0].since_ns),
                       'changed_since_s': event[0].since_ns * 1e-9,
                       'detected_s': event[0].detected_ns * 1e-9}
        if self.likely is not None:
            values |= {'likely_effect': ', '.join(self.likely.effects),
                       'probability': self.likely.probability, 'report': self.likely.report}
        return values

    def message(self) -> DiagnosticArray:
        """Return the message of the topic `gap`: the summary, then one status for each axis."""
        array = DiagnosticArray()
        array.header.stamp = stamp(self.stamp_ns)
        array.status.append(status_message('gap', Status(
            self.level, self.text(), self.serial, self.values())))
        for gap in () if self.obstacle else self.axes:
            array.status.append(status_message(f'gap: {gap.axis}', Status(
                Level.WARN if gap.is_open else Level.OK, _axis_text(gap), self.serial,
                axis_values(gap))))
        return array


def axis_values(gap: AxisGap) -> dict[str, object]:
    """Return the values of an axis by key; `explained` is absent where nothing is to explain."""
    values: dict[str, object] = {
        'gap_mg': gap.gap.value, 'gap_low_mg': gap.gap.low, 'gap_high_mg': gap.gap.high,
        'floor_mg': gap.floor.value, 'floor_low_mg': gap.floor.low,
        'floor_high_mg': gap.floor.high, 'offset_mg': gap.offset_mg,
        'floor_source': gap.floor_source}
    return values if gap.explained is None else values | {'explained': gap.explained}


def _axis_text(gap: AxisGap) -> str:
    """Return the gap of an axis in words."""
    share = '' if gap.explained is None else \
        f'; the parameters explain {100 * gap.explained:.0f} %'
    return (f'gap {gap.gap.value:.3g} mg ({gap.gap.low:.3g} to {gap.gap.high:.3g}), floor '
            f'{gap.floor.value:.3g} mg{share}')
