# SPDX-License-Identifier: Apache-2.0

"""Publishers, subscriptions and diagnostics of this package, and threads that receive."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
import threading
import time
from typing import Any

from adxl_ros.errors import one_line, UserError
from adxl_ros.files.stream_info import StreamInfo
from adxl_ros.nodes.rclpy_internals import MessageWait, NotForExecutors, take_messages
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from sensor_msgs.msg import Imu

_OVERRIDING = QoSOverridingOptions((QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH,
                                    QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY))
"""Policies that parameters can override."""
STEADY = Clock(clock_type=ClockType.STEADY_TIME)
"""The clock of intervals."""
_MIXED_S = 3.0
"""Time within which sequence numbers step back twice where two publishers mix, s; chosen: longer
than the period of slow samples, shorter than two starts of a driver."""


def create_publisher(node: Node, kind: Any, topic: str, depth: int, latched: bool = False
                     ) -> Publisher:
    """Create a reliable keep-last publisher whose QoS can be overridden by parameters."""
    qos = QoSProfile(depth=depth)
    if latched:
        qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
    with _qos_errors(node.resolve_topic_name(topic), 'publisher'):
        return node.create_publisher(kind, topic, qos, qos_overriding_options=_OVERRIDING)


def create_subscription(node: Node, kind: Any, topic: str, callback: Callable[[Any], object],
                        depth: int, latched: bool = False, raw: bool = False,
                        group: CallbackGroup | None = None, reliable: bool = False
                        ) -> Subscription:
    """
    Subscribe best effort, so that both kinds of publisher connect; QoS can be overridden.

    One turn of the executor gives all waiting messages to the callback, one after the other.
    """
    def take_all(first: Any) -> None:
        callback(first)
        for message in take_messages(subscription, kind, raw, depth):
            callback(message)

    qos = QoSProfile(depth=depth)
    if latched:
        qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
    elif not reliable:
        qos.reliability = ReliabilityPolicy.BEST_EFFORT
    with _qos_errors(node.resolve_topic_name(topic), 'subscription'):
        subscription = node.create_subscription(
            kind, topic, take_all, qos, raw=raw, callback_group=group,
            qos_overriding_options=_OVERRIDING)
    return subscription


class OnePublisher:
    """
    Withholds messages while several nodes send them on one topic, because a mixture is no signal.

    Each publisher numbers its messages. The number steps back once where a publisher was started
    again, and over and over where two send by turns.
    """

    def __init__(self, node: Node, topic: str) -> None:
        self._node, self._topic = node, node.resolve_topic_name(topic)
        self._number = 0
        self._back_s, self._until_s = -_MIXED_S, 0.0

    def __call__(self, number: int | None) -> bool:
        """Return whether to take a message of a sequence number; None where the RMW has none."""
        if number is not None:
            if number <= self._number:
                now_s = time.monotonic()
                if now_s - self._back_s < _MIXED_S:
                    self._until_s = now_s + _MIXED_S
                self._back_s = now_s
            self._number = number
        return not self._mixes

    @property
    def _mixes(self) -> bool:
        return bool(self._until_s) and time.monotonic() <= self._until_s

    def fault(self) -> str:
        """Return how many nodes publish on the topic while messages are withheld, or ''."""
        if not self._mixes:
            return ''
        count = max(self._node.count_publishers(self._topic), 2)
        return f'{self._topic}: {count} nodes publish it, and their samples mix; end all but one'


@contextmanager
def _qos_errors(topic: str, entity: str) -> Iterator[None]:
    """Turn rclpy's errors of an invalid QoS override into one line for the user."""
    try:
        yield
    except (RuntimeError, ParameterException) as error:
        # rclpy has no class for a policy that it does not know.
        raise UserError(f'qos_overrides.{topic}.{entity}: {one_line(error)}') from None


def stream_info(message: DiagnosticStatus, topic: str) -> StreamInfo:
    """Return what a stream states of itself on `sensor_info`."""
    return StreamInfo({pair.key: pair.value for pair in message.values}, topic)


def log(node: Node, severity: str, text: str) -> None:
    """Log a line; rclpy permits one severity for each place in the code."""
    if severity in ('OK', 'INFO'):
        node.get_logger().info(text)
    elif severity in ('WARN', 'WARNING'):
        node.get_logger().warning(text)
    else:
        node.get_logger().error(text)


def type_name(kind: Any) -> str:
    """Return the name of the class of a message or service, with its package."""
    return f'{kind.__module__.partition(".")[0]}/{kind.__name__}'


def stamp(time_ns: int) -> Time:
    """Make the stamp of a ROS time, ns."""
    sec, nanosec = divmod(int(time_ns), 10 ** 9)
    return Time(sec=sec, nanosec=nanosec)


class RepeatingThread:
    """
    Calls a function again and again until closed; an exception from it ends the node.

    A `UserError` ends the thread only, where a function takes it.
    """

    def __init__(self, node: Node, turn: Callable[[], None], name: str,
                 on_error: Callable[[UserError], None] | None = None) -> None:
        self._turn, self._context, self._on_error = turn, node.context, on_error
        self._open = True
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread; raise the exception that has ended it before."""
        self._open = False
        self._thread.join()
        if self._failure is not None:
            raise self._failure

    def _run(self) -> None:
        try:
            while self._open and self._context.ok():
                self._turn()
        except Exception as error:
            # After the signal nothing can be published: a failure then belongs to the end.
            if not self._context.ok():
                return
            if isinstance(error, UserError) and self._on_error is not None:
                self._on_error(error)
            else:
                self._failure = error
                self._context.try_shutdown()


class Inbox:
    """
    Keeps the serialized messages of a topic until they are taken, without waking an executor.

    At 1 kHz an executor that wakes for each message takes a tenth of a core. It subscribes best
    effort. Samples (sensor_msgs/Imu) of several publishers are withheld.
    """

    def __init__(self, node: Node, kind: Any, topic: str, depth: int, reliable: bool = False
                 ) -> None:
        self._node, self._kind, self._depth = node, kind, depth
        self._publishers = OnePublisher(node, topic)
        self._subscription = create_subscription(
            node, kind, topic, lambda _: None, depth, raw=True, group=NotForExecutors(),
            reliable=reliable)
        self.wait = MessageWait(self._subscription, node)  # Waits for a message for up to 0.1 s

    def take(self) -> list[bytes]:
        """Return the messages since the last call, at most as many as are kept."""
        return list(self._waiting())

    def receive(self, callback: Callable[[bytes], object]) -> None:
        """Wait for a message for up to 0.1 s, and give all that have come to a function."""
        self.wait()
        for message in self._waiting():
            callback(message)

    def _waiting(self) -> Iterator[bytes]:
        accept = (self._publishers,) if self._kind is Imu else ()
        return take_messages(self._subscription, self._kind, True, self._depth, *accept)

    def fault(self) -> str:
        """Return that several nodes publish on the topic, so that nothing is taken, or ''."""
        return self._publishers.fault()

    def destroy(self) -> None:
        """Remove the subscription; a thread that waits must have ended."""
        self._node.destroy_subscription(self._subscription)


_PERIOD_S = 1.0
"""Time between two reports, s; the usual rate of ROS diagnostics."""
_REPORTS = 10
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
        self._publisher = create_publisher(node, DiagnosticArray, '/diagnostics', _REPORTS)
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
