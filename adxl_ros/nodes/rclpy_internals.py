# SPDX-License-Identifier: Apache-2.0

"""Every use of undocumented parts of rclpy, each with its reason."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
import re
import sys
from typing import Any

from adxl_ros.errors import one_line
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.service import Service
from rclpy.subscription import Subscription

# The package of each message imports the generator of Python from .msg files, with its parser and
# templates: a tenth of the time in which a node starts. The package can do without it.
sys.modules.setdefault('rosidl_generator_py.generate_py_impl', None)  # type: ignore[arg-type]

_LONGEST_WAIT_NS = 100_000_000
"""Longest wait for a message, ns; chosen: a thread that waits sees within it that it shall end."""


class NotForExecutors(ReentrantCallbackGroup):
    """
    Keeps a subscription out of the executor that spins its node.

    A thread takes its messages instead. rclpy has no subscription without an executor, and does
    not document what an executor asks of a callback group.
    """

    def can_execute(self, entity: Any) -> bool:
        """Return False: no executor may take from the subscription."""
        return False


def take_messages(subscription: Subscription, kind: Any, raw: bool, limit: int,
                  accept: Callable[[int | None], bool] = lambda _: True) -> Iterator[Any]:
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


def take_request(service: Service, kind: Any) -> tuple[Any, Any] | None:
    """
    Take a request that waits in a service, to answer it later by `Service.send_response`.

    An executor wants the answer at once, and polls a coroutine that waits without a pause.
    """
    with service.handle:
        request, header = service.handle.service_take_request(kind.Request)
    return None if header is None else (request, header)


class MessageWait:
    """
    Waits in a thread for the messages of one subscription.

    A turn of rclpy's executor builds its wait set from all that the node has, its parameter
    services among them. A wait set of one subscription makes a relay at 1 kHz two to three times
    cheaper.
    """

    def __init__(self, subscription: Subscription, node: Node) -> None:
        self._subscription, self._context = subscription, node.context
        self._wait_set: Any = None

    def __call__(self) -> None:
        """Wait for a message for up to 0.1 s."""
        handle, context = self._subscription.handle, self._context.handle
        assert context is not None, 'a node has a context'
        with handle, context:
            if self._wait_set is None:
                self._wait_set = rclpy_implementation.WaitSet(1, 0, 0, 0, 0, 0, context)
            self._wait_set.clear_entities()
            self._wait_set.add_subscription(handle)
            self._wait_set.wait(_LONGEST_WAIT_NS)


def store_empty(node: Node, name: str, kind: Parameter.Type, number: float) -> None:
    """
    Give a declared parameter without a value an empty one of its type.

    rclpy answers a request for several parameters with nothing when one of them has no value, and
    takes an empty list as a list of bytes when it declares a parameter.
    """
    empty: dict[Parameter.Type, Any] = {
        Parameter.Type.STRING: '', Parameter.Type.INTEGER: round(number),
        Parameter.Type.DOUBLE: float(number)}
    node._parameters[name] = Parameter(name, kind, empty.get(kind, []))


def given_parameters(node: Node) -> Iterable[tuple[str, Any]]:
    """
    Return the names and values of all parameters that a node is started with.

    rclpy shows a given parameter only once it is declared. The keys of a provenance are free, so
    that no declaration can know their names.
    """
    return ((name, parameter.value) for name, parameter in node._parameter_overrides.items())


def start_error_text(error: BaseException) -> str:
    """Return the text of rclpy's refusal of its arguments: one line, without places in rcl."""
    return re.sub(r', at /\S+:\d+', '', one_line(error))
