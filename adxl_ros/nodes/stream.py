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
One fast topic, received in a thread of its own.

A turn of rclpy's executor builds its wait set anew from all that the node has, its parameter
services among them, and costs three times what taking, compensating and publishing a sample do.
A wait set of one subscription makes a relay at 1 kHz two to three times cheaper.
"""

from __future__ import annotations

from collections.abc import Callable
import threading
from typing import Any

from adxl_ros.nodes import common
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

_LOOK_UP_NS = 100_000_000
"""Time after which a thread that waits for a message looks whether it shall end."""


class Stream:
    """
    Gives every message of a topic, serialized, to a callback, from a thread of its own.

    Subscribes best effort, so that both kinds of publisher connect.
    """

    def __init__(self, node: Node, kind: Any, topic: str, callback: Callable[[bytes], None],
                 depth: int) -> None:
        """
        Start to receive.

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
            Messages that are kept while the callback is busy.

        """
        self._subscription = common.subscription(node, kind, topic, callback, depth, raw=True,
                                                 group=common.NotForExecutors())
        self._kind, self._callback, self._context = kind, callback, node.context
        self._open = True
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name=topic, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread; raises what ended it before."""
        self._open = False
        self._thread.join()
        if self._failure is not None:
            raise self._failure

    def _run(self) -> None:
        try:
            with self._subscription.handle, self._context.handle:
                self._receive()
        except Exception as error:
            # After the signal nothing can be published: what fails then is the end, not an error.
            if self._context.ok():
                self._failure = error
                self._context.try_shutdown()

    def _receive(self) -> None:
        handle = self._subscription.handle
        waits = rclpy_implementation.WaitSet(1, 0, 0, 0, 0, 0, self._context.handle)
        while self._open and self._context.ok():
            waits.clear_entities()
            waits.add_subscription(handle)
            waits.wait(_LOOK_UP_NS)
            while self._open and (taken := handle.take_message(self._kind, True)) is not None:
                self._callback(taken[0])
