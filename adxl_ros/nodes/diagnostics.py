# SPDX-License-Identifier: Apache-2.0

"""The diagnostics of a node: tasks by name, published on `/diagnostics`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum

from adxl_ros.nodes.topics import create_publisher, STEADY
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

_PERIOD_S = 1.0
"""Time between two reports, s; the usual rate of ROS diagnostics."""
_QUEUE = 10
"""Reports that are kept for a slow subscriber."""


class Level(Enum):
    """Levels of a diagnostic status."""

    OK = DiagnosticStatus.OK
    WARN = DiagnosticStatus.WARN
    ERROR = DiagnosticStatus.ERROR


@dataclass(frozen=True)
class Status:
    """What a task reports."""

    level: Level  # How bad it is
    summary: str  # One line for people
    hardware_id: str  # Serial number of the sensor, or kind of the stage
    values: Mapping[str, object]  # Further values by key; floats keep all digits


class DiagnosticsReporter:
    """Reports the tasks of a node once a second, and at once when a level changes."""

    def __init__(self, node: Node, tasks: Mapping[str, Callable[[], Status]]) -> None:
        self._node, self._tasks = node, tasks
        self._levels: dict[str, Level] = {}
        self._publisher = create_publisher(node, DiagnosticArray, '/diagnostics', _QUEUE)
        self._timer = node.create_timer(_PERIOD_S, self._report,
                                        clock=STEADY)
        self._at_once = node.create_guard_condition(self._report)

    def notice(self, task: str, level: Level) -> None:
        """Report at once if a task has another level than in the last report; from any thread."""
        if level != self._levels.get(task, level):
            self._levels[task] = level
            self._at_once.trigger()

    def _report(self) -> None:
        self._timer.reset()
        prefix = self._node.get_fully_qualified_name().lstrip('/')
        array = DiagnosticArray()
        array.header.stamp = self._node.get_clock().now().to_msg()
        for name, task in self._tasks.items():
            status = task()
            self._levels[name] = status.level
            array.status.append(status_message(f'{prefix}: {name}', status))
        self._publisher.publish(array)


def status_message(name: str, status: Status) -> DiagnosticStatus:
    """Make the message of a status."""
    values = [KeyValue(key=key, value=value if isinstance(value, str) else repr(value))
              for key, value in status.values.items()]
    return DiagnosticStatus(level=status.level.value, name=name, message=status.summary,
                            hardware_id=status.hardware_id, values=values)
