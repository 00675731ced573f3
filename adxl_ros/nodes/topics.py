# SPDX-License-Identifier: Apache-2.0

"""
Topics: publishers, subscriptions, threads that receive, diagnostics, and serialized messages.

Many messages are taken and decoded at once: this takes a tenth of the time of one after the other.
`Inbox` and what stands before it use undocumented parts of rclpy, each for the reason it names.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import nan
import struct
import sys
import threading
import time
from typing import Any, NamedTuple

from adxl_ros.errors import one_line, UserError
from adxl_ros.files import cdr, imu_message
from adxl_ros.files.stream_info import StreamInfo
from adxl_ros.nodes.parameter_checks import QOS_POLICIES
from adxl_ros.nodes.parameters import SI
from adxl_ros.report.level import Level
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
import numpy as np
from rclpy.callback_groups import CallbackGroup, ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import serialize_message
from rclpy.subscription import Subscription
from sensor_msgs.msg import BatteryState, Imu, Temperature
from std_srvs.srv import Trigger

# The package of each message imports the generator of Python from .msg files, with its parser and
# templates: a tenth of the time in which a node starts. The package can do without it.
sys.modules.setdefault('rosidl_generator_py.generate_py_impl', None)  # type: ignore[arg-type]

_OVERRIDING = QoSOverridingOptions([QoSPolicyKind[name.upper()] for name in QOS_POLICIES])
"""What parameters can override."""
STEADY = Clock(clock_type=ClockType.STEADY_TIME)  # The clock of intervals
_SILENT_S = 3.0
"""Time without messages after which a topic is silent, s: three of the slowest usual periods, 1 s.
With half, one late message would warn; twice hides a broken cable for longer."""
_LONGEST_LOOK_S = 1.0
"""Longest time between two looks that counts as silence, s. It is above the period of each node; a
process that was held up as a whole looks before its middleware has received."""
_LONGEST_WAIT_NS = 100_000_000
"""Longest wait for a message, ns: a thread sees within it that it shall end, and wakes 10 times a
s."""
_MIXED_S = 3.0
"""Time within which sequence numbers step back twice where two publishers mix, s: longer than the
period of slow samples, 1 s, and shorter than two starts of a driver."""


def create_publisher(
    node: Node, kind: Any, topic: str, depth: int, latched: bool = False
) -> Publisher:
    """Create a reliable keep-last publisher whose QoS can be overridden by parameters."""
    qos = QoSProfile(depth=depth)
    if latched:
        qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
    with _qos_errors(node.resolve_topic_name(topic), 'publisher'):
        return node.create_publisher(kind, topic, qos, qos_overriding_options=_OVERRIDING)


def create_subscription(
    node: Node,
    kind: Any,
    topic: str,
    callback: Callable[[Any], object],
    depth: int,
    latched: bool = False,
    raw: bool = False,
    group: CallbackGroup | None = None,
    reliable: bool = False,
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
            kind,
            topic,
            take_all,
            qos,
            raw=raw,
            callback_group=group,
            qos_overriding_options=_OVERRIDING,
        )
    return subscription


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


def log(node: Node, level: Level, text: str) -> None:
    """Log a line; rclpy permits one severity for each place in the code."""
    if level is Level.OK:
        node.get_logger().info(text)
    elif level is Level.WARN:
        node.get_logger().warning(text)
    else:
        node.get_logger().error(text)


def stamp(time_ns: int) -> Time:
    """Make the stamp of a ROS time, ns."""
    sec, nanosec = divmod(int(time_ns), 10**9)
    return Time(sec=sec, nanosec=nanosec)


class RepeatingThread:
    """
    Calls a function again and again until closed; an exception from it ends the node.

    A `UserError` ends the thread only, where a function takes it.
    """

    def __init__(
        self,
        node: Node,
        turn: Callable[[], None],
        name: str,
        on_error: Callable[[UserError], None] | None = None,
    ) -> None:
        self._turn = turn
        self._context = node.context
        self._on_error = on_error
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


class NotForExecutors(ReentrantCallbackGroup):
    """
    Keeps a subscription or service out of the executor that spins its node; others take from it.

    rclpy does not document what an executor asks of a callback group.
    """

    def can_execute(self, entity: Any) -> bool:
        """Return False: no executor may take."""
        return False


def take_messages(
    subscription: Subscription,
    kind: Any,
    raw: bool,
    limit: int,
    accept: Callable[[int | None], bool] = lambda _: True,
) -> Iterator[Any]:
    """
    Take the messages that wait in a subscription, without a turn of an executor.

    A turn costs as much as ten messages, and rclpy takes one message a turn: a node cannot follow
    10 kHz like that.
    """
    with subscription.handle:
        for _ in range(limit):
            message_and_info = subscription.handle.take_message(kind, raw)
            if message_and_info is None:
                return
            if accept(message_and_info[1]['publication_sequence_number']):
                yield message_and_info[0]


class LateService:
    """
    A service of the type Trigger whose requests are answered later.

    An executor wants the answer at once, and polls a coroutine that waits without a pause.
    """

    def __init__(self, node: Node, name: str) -> None:
        self._node = node
        self._service = node.create_service(
            Trigger, name, lambda _, answer: answer, callback_group=NotForExecutors()
        )

    def take(self) -> list[Any]:
        """Return the requests that have come since the last call, to be answered."""
        handle = self._service.handle
        with handle:
            return list(iter(lambda: handle.service_take_request(Trigger.Request)[1], None))

    def answer(self, requests: Sequence[Any], success: bool, text: str) -> None:
        """Answer requests."""
        for request in requests:
            self._service.send_response(Trigger.Response(success=success, message=text), request)

    def destroy(self) -> None:
        """Remove the service; a request that waits gets no answer."""
        self._node.destroy_service(self._service)


class Inbox:
    """
    Keeps the serialized messages of a topic until they are taken, without waking an executor.

    At 1 kHz an executor that wakes for each message takes a tenth of a core. It subscribes best
    effort. Samples (sensor_msgs/Imu) are withheld while several nodes send them, because a mixture
    is no signal. Each publisher numbers its messages: the number steps back once where a publisher
    was started again, and over and over where two send by turns.
    """

    def __init__(
        self, node: Node, kind: Any, topic: str, depth: int, unit: str = SI, **options: bool
    ) -> None:
        """
        Subscribe; `reliable` and `latched` are those of `create_subscription`.

        unit: that of the accelerations of a sensor_msgs/Imu, which are taken in m/s².
        """
        self._unit = unit
        self._node = node
        self._kind = kind
        self._depth = depth
        self._looked_s = time.monotonic()  # When messages were taken last
        self._silent_s = 0.0  # Time without a message until then
        self._topic = node.resolve_topic_name(topic)
        self._number = 0
        self._back_s = -_MIXED_S
        self._mixed_until_s = 0.0
        self._subscription = create_subscription(
            node, kind, topic, lambda _: None, depth, raw=True, group=NotForExecutors(), **options
        )
        self._wait_set: Any = None

    def wait(self) -> None:
        """
        Wait for a message for up to 0.1 s.

        A turn of an executor builds its wait set from all that the node has. A wait set of one
        subscription makes a relay at 1 kHz two to three times cheaper.
        """
        handle = self._subscription.handle
        context = self._node.context.handle
        assert context is not None, 'a node has a context'
        with handle, context:
            if self._wait_set is None:
                self._wait_set = rclpy_implementation.WaitSet(1, 0, 0, 0, 0, 0, context)
            self._wait_set.clear_entities()
            self._wait_set.add_subscription(handle)
            self._wait_set.wait(_LONGEST_WAIT_NS)

    def take(self) -> list[bytes]:
        """Return the messages since the last call, at most as many as are kept."""
        accept = (self._accepts,) if self._kind is Imu else ()
        now_s = time.monotonic()
        self._silent_s += min(now_s - self._looked_s, _LONGEST_LOOK_S)
        self._looked_s = now_s
        messages = [*take_messages(self._subscription, self._kind, True, self._depth, *accept)]
        if messages:
            self._silent_s = 0.0
        return messages if self._unit == SI else [*map(self._in_si, messages)]

    def _in_si(self, raw: bytes) -> bytes:
        """Return samples in m/s²; damaged ones as they are, for those who count them."""
        try:
            return imu_message.in_mps2(raw, self._unit)
        except cdr.CdrError:
            return raw

    def _accepts(self, number: int | None) -> bool:
        """Return whether to take a message of a sequence number; None where the RMW has none."""
        if number is not None:
            if number <= self._number:
                now_s = time.monotonic()
                if now_s - self._back_s < _MIXED_S:
                    self._mixed_until_s = now_s + _MIXED_S
                self._back_s = now_s
            self._number = number
        return time.monotonic() > self._mixed_until_s

    def silence(self) -> str:
        """
        Return why or for how long nothing has come; '' while messages come.

        It ends with the last look. Where the node was held up, what came has not been taken yet.
        """
        if (fault := self.fault()) or self._silent_s < _SILENT_S:
            return fault
        nobody = '' if self._node.count_publishers(self._topic) else ', and nobody publishes it'
        return f'nothing on {self._topic} for {self._silent_s:.0f} s{nobody}'

    def restart_silence(self) -> None:
        """Restart the time without messages."""
        self._silent_s = 0.0

    def fault(self) -> str:
        """Return that several nodes publish on the topic, so that nothing is taken, or ''."""
        if time.monotonic() > self._mixed_until_s:
            return ''
        count = max(self._node.count_publishers(self._topic), 2)
        return f'{self._topic}: {count} nodes publish it, and their samples mix; end all but one'

    def destroy(self) -> None:
        """Remove the subscription; a thread that waits must have ended."""
        self._node.destroy_subscription(self._subscription)


_SURROUNDINGS = {
    'temperature': (Temperature, cdr.temperature, 'temperature'),
    'supply': (BatteryState, cdr.battery_state, 'voltage'),
}
"""Type, layout and field of each topic."""


class SurroundingTopics:
    """Keeps temperature, °C, and supply, V, until they are taken, before samples of that time."""

    def __init__(self, node: Node, depth: int) -> None:
        self._inboxes = {
            topic: Inbox(node, kind, topic, depth) for topic, (kind, _, _) in _SURROUNDINGS.items()
        }

    def take(self) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
        """Yield each topic with stamps, ns, (n,), and values, (n, 1), since the last call."""
        for topic, inbox in self._inboxes.items():
            if messages := inbox.take():
                _, layout, field = _SURROUNDINGS[topic]
                stamps_ns, fields = decoded(messages, layout, **{field: 1})
                yield topic, stamps_ns, fields[field]


_PERIOD_S = 1.0  # Time between two reports, s; the usual rate of ROS diagnostics
_REPORTS = 10  # Reports that are kept for a slow subscriber


@dataclass(frozen=True)
class Status:
    """What a task reports."""

    level: Level  # How bad it is
    summary: str  # One line for people
    hardware_id: str  # Serial number of the sensor, or kind of the stage
    values: Mapping[str, object]  # Further values by key; floats keep all digits


class DiagnosticsReporter:
    """Reports the state of a node once a second, and at once when its level changes."""

    def __init__(self, node: Node, task: str, status: Callable[[], Status]) -> None:
        self._node = node
        self._task = task
        self._status = status
        self._level: Level | None = None
        self._publisher = create_publisher(node, DiagnosticArray, '/diagnostics', _REPORTS)
        self._timer = node.create_timer(_PERIOD_S, self._report, clock=STEADY)
        self._at_once = node.create_guard_condition(self._report)

    def notice(self, level: Level) -> None:
        """Report at once if the level is another than in the last report; from any thread."""
        if self._level not in (None, level):
            self._level = level
            self._at_once.trigger()

    def _report(self) -> None:
        self._timer.reset()
        status = self._status()
        self._level = status.level
        name = f'{self._node.get_fully_qualified_name().lstrip("/")}: {self._task}'
        array = DiagnosticArray(status=[status_message(name, status)])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)


def status_message(name: str, status: Status) -> DiagnosticStatus:
    """Make the message of a status."""
    values = [
        KeyValue(key=key, value=value if isinstance(value, str) else repr(value))
        for key, value in status.values.items()
    ]
    return DiagnosticStatus(
        level=getattr(DiagnosticStatus, status.level.name),
        name=name,
        message=status.summary,
        hardware_id=status.hardware_id,
        values=values,
    )


def imu_samples(batch: Sequence[bytes]) -> tuple[np.ndarray, np.ndarray]:
    """Return the samples of serialized messages: stamps, ns, (n,), and m/s², (n, 3)."""
    stamps, fields = decoded(batch, cdr.imu, linear_acceleration=3)
    return stamps, fields['linear_acceleration']


def finite_samples(batch: Sequence[bytes]) -> tuple[np.ndarray, np.ndarray]:
    """Return the samples of serialized messages whose numbers are finite."""
    stamps, accel = imu_samples(batch)
    finite = np.isfinite(accel).all(axis=1)
    return stamps[finite], accel[finite]


def decoded(
    messages: Sequence[bytes], layout: Callable[[bytes], cdr.Layout], **counts: int
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return stamps, ns, (n,), and fields of a count of numbers, (n, k), of n messages."""
    stamps_ns = np.empty(len(messages), np.int64)
    fields = {name: np.empty((len(messages), count)) for name, count in counts.items()}
    for table in cdr.tables(messages, layout):
        stamps_ns[table.rows] = table.stamp_ns()
        for name, values in fields.items():
            values[table.rows] = table.numbers(name)
    return stamps_ns, fields


class JointReading(NamedTuple):
    """Motion of the joints at one stamp."""

    stamp_ns: int  # Stamp, ns
    position: dict[str, float]  # Position by joint, rad or m
    velocity: dict[str, float]  # Velocity by joint, rad/s or m/s; empty where the message has none

    @property
    def angles(self) -> tuple[float, float]:
        """Return alpha and beta, rad; NaN for a joint that is not named."""
        return self.position.get('alpha', nan), self.position.get('beta', nan)


def joint_readings(messages: Sequence[bytes]) -> list[JointReading]:
    """Return the readings of serialized sensor_msgs/JointState, in their order."""
    readings: dict[int, JointReading] = {}
    for table in cdr.tables(messages, cdr.joint_state):

        def numbers(field: str, table: cdr.MessageTable = table) -> list[list[float]]:
            has_field = field in table.layout.fields
            return table.numbers(field).tolist() if has_field else [[]] * len(table.rows)

        positions, velocities = numbers('position'), numbers('velocity')
        for row, stamp_ns, position, velocity in zip(
            table.rows.tolist(), table.stamp_ns().tolist(), positions, velocities
        ):
            readings[row] = JointReading(
                stamp_ns, dict(zip(table.joints, position)), dict(zip(table.joints, velocity))
            )
    return [readings[row] for row in sorted(readings)]


class MessageWriter:
    """
    Makes serialized messages with a stamp, by replacing numbers in the bytes of a template.

    Messages are one or few that come after a pause of the processor. Calls of numpy are slow then:
    these messages would take twice the time.
    """

    def __init__(
        self, template: Any, layout_of: Callable[[bytes], cdr.Layout], **counts: int
    ) -> None:
        """Find the fields; of those that `counts` names, only so many numbers are written."""
        self._template = serialize_message(template)
        layout = layout_of(self._template)
        self._stamp = struct.Struct(f'{layout.order}iI')
        self._stamp_offset = layout.fields['sec'].offset
        self._fields = {
            name: (struct.Struct(f'{layout.order}{counts.get(name, field.count)}d'), field.offset)
            for name, field in layout.fields.items()
            if field.code == 'f8'
        }

    def messages(self, stamp_ns: np.ndarray, **fields: np.ndarray) -> list[bytes]:
        """Serialize messages with stamps, ns, (n,), and number fields, (n, k)."""
        columns = [(*self._fields[name], rows.tolist()) for name, rows in fields.items()]
        messages = []
        for i, time_ns in enumerate(stamp_ns.tolist()):
            message = bytearray(self._template)
            self._stamp.pack_into(message, self._stamp_offset, *divmod(time_ns, 10**9))
            for packer, offset, rows in columns:
                packer.pack_into(message, offset, *rows[i])
            messages.append(bytes(message))
        return messages
