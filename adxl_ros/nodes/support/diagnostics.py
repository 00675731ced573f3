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

"""The diagnostics of a node: tasks by name, published on `/diagnostics`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum

from adxl_ros.nodes.support.topics import create_publisher
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
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
    """
    What a task reports.

    Attributes
    ----------
    level
        How bad it is.
    summary
        One line for people.
    hardware_id
        Serial number of the sensor, or kind of the stage.
    values
        Further values by key; floats keep all digits.

    """

    level: Level
    summary: str
    hardware_id: str
    values: Mapping[str, object]


class DiagnosticsReporter:
    """
    Reports the tasks of a node once a second, and at once when a level changes.

    Parameters
    ----------
    node
        The node; its name stands before the names of the tasks.
    tasks
        Functions by the name of their task. The executor's thread calls them for each report.

    """

    def __init__(self, node: Node, tasks: Mapping[str, Callable[[], Status]]) -> None:
        self._node, self._tasks = node, tasks
        self._levels: dict[str, Level] = {}
        self._publisher = create_publisher(node, DiagnosticArray, '/diagnostics', _QUEUE)
        self._timer = node.create_timer(_PERIOD_S, self._report,
                                        clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._at_once = node.create_guard_condition(self._report)

    def notice(self, task: str, level: Level) -> None:
        """
        Report at once if a task has another level than in the last report; from any thread.

        Parameters
        ----------
        task
            Name of the task.
        level
            The level that it has now.

        """
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
    """
    Make the message of a status.

    Parameters
    ----------
    name
        Name of the task, or of the topic that carries it.
    status
        The status.

    Returns
    -------
    DiagnosticStatus
        The message.

    """
    values = [KeyValue(key=key, value=value if isinstance(value, str) else repr(value))
              for key, value in status.values.items()]
    return DiagnosticStatus(level=status.level.value, name=name, message=status.summary,
                            hardware_id=status.hardware_id, values=values)
