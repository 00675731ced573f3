# SPDX-License-Identifier: Apache-2.0

"""
Threads of a node beside the executor that spins it.

A turn of rclpy's executor costs more than a sample does: at 250 turns a second it takes 5 to 10 %
of a core, three times what taking, compensating and publishing a sample costs.
"""

from __future__ import annotations

from collections.abc import Callable
import threading
from typing import Any

from adxl_ros.nodes.support.rclpy_internals import MessageWait, NotForExecutors
from adxl_ros.nodes.support.topics import create_subscription, OnePublisher
from rclpy.node import Node


class RepeatingThread:
    """Calls a function again and again until closed; an exception from it ends the node."""

    def __init__(self, node: Node, turn: Callable[[], None], name: str) -> None:
        self._turn, self._context = turn, node.context
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
            if self._context.ok():
                self._failure = error
                self._context.try_shutdown()


class ReceiveTurn:
    """
    A turn of a thread: waits for the samples of one topic, and gives each to a callback.

    Subscribes best effort, so that both kinds of publisher connect. Samples of several publishers
    are withheld.
    """

    def __init__(self, node: Node, kind: Any, topic: str, callback: Callable[[bytes], None],
                 depth: int) -> None:
        self._node = node
        self._subscription = create_subscription(node, kind, topic, callback, depth, raw=True,
                                                 group=NotForExecutors())
        self._wait = MessageWait(self._subscription, node)
        self._kind, self._callback, self._depth = kind, callback, depth
        self._publishers = OnePublisher(node, topic)

    def __call__(self) -> None:
        """Wait for a message, and take all that have come."""
        self._wait(self._kind, self._callback, self._depth, self._publishers)

    def fault(self) -> str:
        """Return that several nodes publish on the topic, so that nothing is taken, or ''."""
        return self._publishers.fault()

    def destroy(self) -> None:
        """Remove the subscription; the thread must have ended."""
        self._node.destroy_subscription(self._subscription)
