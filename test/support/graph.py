# SPDX-License-Identifier: Apache-2.0

"""The node of a test, in the graph of the nodes that the test has started."""

from collections import defaultdict
import time

from adxl_ros.files import cdr
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
import numpy as np
from processes import PATIENCE
import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile

RELIABLE = ('-p', 'qos_overrides./imu/data_raw.subscription.reliability:=reliable')
"""Reliable subscription. A best-effort one loses the first samples, and others at many times real
time."""


QUEUE = 100_000
"""Messages that wait for a busy listener."""


def stamp_ns(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def accel(message):
    a = message.linear_acceleration
    return np.array([a.x, a.y, a.z])


def imu_table(raws):
    """Return stamps, ns, (n,), and accelerations, m/s², (n, 3), of serialized Imu messages."""
    (table,) = cdr.tables(raws, cdr.imu)
    return table.stamp_ns(), table.numbers('linear_acceleration')


class Graph:
    """
    The messages of topics; by the name of a node its newest diagnostics and their time, ns.

    Its listeners are reliable and deep. A wait ends with all messages that have come by then, so
    that an assertion sees what came before its condition.
    """

    def __init__(self):
        self.got = defaultdict(list)
        self.arrived_ns = defaultdict(list)
        """Monotonic times at which the messages of a topic were taken, ns."""
        self.diagnostics = {}
        self.reported_ns = {}
        self._statuses = defaultdict(list)
        self._takes = []
        self._context = Context()
        self._clients = {}

    def __enter__(self):
        rclpy.init(args=[], context=self._context)
        self.node = rclpy.create_node('tester', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._subscribe(DiagnosticArray, '/diagnostics', self._diagnose, QoSProfile(depth=QUEUE))
        return self

    def __exit__(self, *_):
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()

    def _diagnose(self, message):
        for status in message.status:
            name = status.name.split(':')[0]
            self.diagnostics[name] = status
            self.reported_ns[name] = stamp_ns(message)
            self._statuses[name].append(status)

    def _subscribe(self, kind, topic, receive, qos, raw=False):
        def take(*first):
            for message in first:
                receive(message)
            for _ in range(QUEUE):
                message = subscription.handle.take_message(kind, raw)
                if message is None:
                    break
                receive(message[0])

        subscription = self.node.create_subscription(kind, topic, take, qos, raw=raw)
        self._takes.append(take)

    def listen(self, kind, topic, latched=False, raw=False):
        """Return the list of the messages of a topic, serialized if `raw`; it grows."""
        qos = QoSProfile(depth=QUEUE)
        if latched:
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        kept, arrived_ns = self.got[topic], self.arrived_ns[topic]

        def receive(message):
            kept.append(message)
            arrived_ns.append(time.monotonic_ns())

        self._subscribe(kind, topic, receive, qos, raw)
        return kept

    def drain(self):
        """Take all messages that wait."""
        for take in self._takes:
            take()

    def spin_until(self, condition, timeout_s, purpose):
        """Listen until a condition holds; fail with the purpose after a multiple of the time."""
        end_s = time.monotonic() + PATIENCE * timeout_s
        while not condition():
            self._executor.spin_once(timeout_sec=0.05)
            if time.monotonic() > end_s:
                received = {topic: len(messages) for topic, messages in self.got.items()}
                pytest.fail(
                    f'{purpose}: not after {PATIENCE} times {timeout_s} s; '
                    f'received: {received}; diagnostics: {self.diagnostics}'
                )
        self.drain()

    def spin(self, seconds):
        end_s = time.monotonic() + seconds
        while (remaining_s := end_s - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=remaining_s)
        self.drain()

    def wait_for_silence(self, topic, seconds=1.0, timeout_s=20.0):
        """Listen until a topic has sent nothing for a time, s: what was under way has come."""

        def is_silent():
            last_ns = max([began_ns, *self.arrived_ns[topic][-1:]])
            return time.monotonic_ns() - last_ns > seconds * 1e9

        began_ns = time.monotonic_ns()
        self.spin_until(is_silent, timeout_s, f'silence on {topic}')

    def call(self, kind, service, request, timeout_s=20.0):
        """
        Return the answer of a service.

        Fast DDS loses the answer to a client that the server has not discovered within 100 ms
        (ros2/rmw_fastrtps issue 842). So each service has one client, and it asks again.
        """
        client = self._clients.get(service)
        if client is None:
            client = self._clients[service] = self.node.create_client(kind, service)
        assert client.wait_for_service(PATIENCE * timeout_s), f'no service {service}'
        futures, ask_again_s = [], 0.0

        def answered():
            nonlocal ask_again_s
            if time.monotonic() >= ask_again_s:
                futures.append(client.call_async(request))
                ask_again_s = time.monotonic() + timeout_s
            return any(future.done() for future in futures)

        self.spin_until(answered, timeout_s, f'answer of {service}')
        return next(future.result() for future in futures if future.done())

    def change(self, node, transition):
        request = ChangeState.Request(transition=Transition(id=transition))
        return self.call(ChangeState, f'{node}/change_state', request).success

    def reports(self, node, text):
        return node in self.diagnostics and text in self.diagnostics[node].message

    def has_reported(self, node, text):
        """Return whether a node has said this at any time."""
        return any(text in status.message for status in self._statuses[node])

    def has_stated(self, node, key, value):
        """Return whether a value in the diagnostics of a node was this at any time."""
        return any(
            (pair.key, pair.value) == (key, value)
            for status in self._statuses[node]
            for pair in status.values
        )

    def value(self, node, key):
        """Return a value in the newest diagnostics of a node; '' while there is none."""
        values = self.diagnostics[node].values if node in self.diagnostics else ()
        return {pair.key: pair.value for pair in values}.get(key, '')

    def number(self, node, key):
        """Return a number in the newest diagnostics of a node; NaN while there is none."""
        return float(self.value(node, key) or 'nan')
