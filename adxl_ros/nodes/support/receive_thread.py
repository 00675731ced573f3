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

"""
What a node does in a thread of its own, beside the executor that spins it.

A turn of rclpy's executor builds its wait set anew from all that the node has, its parameter
services among them, and wakes twice for a timer: at 250 turns a second that alone is 5 to 10 % of
a core, and three times what taking, compensating and publishing a sample costs.
"""

from __future__ import annotations

from collections.abc import Callable
import threading
import time
from typing import Any

from adxl_ros.nodes.support import node_support
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

_LOOK_UP_NS = 100_000_000
"""Time after which a thread that waits for a message looks whether it shall end."""


class Loop:
    """Calls a function again and again, until closed; an exception from it ends the node."""

    def __init__(self, node: Node, turn: Callable[[], None], name: str) -> None:
        """
        Start the thread.

        Parameters
        ----------
        node
            Which ends with what the function raises.
        turn
            Called without a pause: it waits itself, and not for long.
        name
            Of the thread.

        """
        self._turn, self._context = turn, node.context
        self._open = True
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread; raises what ended it before."""
        self._open = False
        self._thread.join()
        if self._failure is not None:
            raise self._failure

    def _run(self) -> None:
        try:
            while self._open and self._context.ok():
                self._turn()
        except Exception as error:
            # After the signal nothing can be published: what fails then is the end, not an error.
            if self._context.ok():
                self._failure = error
                self._context.try_shutdown()


class Steadily:
    """A turn at a steady pace: a function, and the wait until it is due again."""

    def __init__(self, function: Callable[[], None], period_s: float) -> None:
        self._function, self._period_s = function, period_s
        self._due_s = time.monotonic()

    def __call__(self) -> None:
        """Do it and wait."""
        self._function()
        now_s = time.monotonic()
        self._due_s = max(self._due_s + self._period_s, now_s)
        time.sleep(self._due_s - now_s)


class Received:
    """
    A turn that waits for the messages of one topic, and gives each, serialized, to a callback.

    Subscribes best effort, so that both kinds of publisher connect. A wait set of one
    subscription makes a relay at 1 kHz two to three times cheaper than an executor.
    """

    def __init__(self, node: Node, kind: Any, topic: str, callback: Callable[[bytes], None],
                 depth: int) -> None:
        """
        Subscribe.

        Parameters
        ----------
        node
            Whose subscription it is.
        kind
            Type of the messages.
        topic
            Its name.
        callback
            Takes the bytes of a message.
        depth
            Messages that are kept while the callback is busy, and the most of a turn.

        """
        self._subscription = node_support.subscription(
            node, kind, topic, callback, depth, raw=True, group=node_support.NotForExecutors())
        self._kind, self._callback, self._depth = kind, callback, depth
        self._context = node.context
        self._waits: Any = None

    def __call__(self) -> None:
        """Wait for a message, not for long, and take what is there."""
        handle = self._subscription.handle
        with handle, self._context.handle:
            if self._waits is None:
                self._waits = rclpy_implementation.WaitSet(1, 0, 0, 0, 0, 0, self._context.handle)
            self._waits.clear_entities()
            self._waits.add_subscription(handle)
            self._waits.wait(_LOOK_UP_NS)
            for _ in range(self._depth):
                taken = handle.take_message(self._kind, True)
                if taken is None:
                    break
                self._callback(taken[0])
