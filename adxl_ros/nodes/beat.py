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
What a node does at a steady pace, in a thread of its own.

A turn of rclpy's executor builds its wait set anew from all that the node has, its parameter
services among them, and wakes twice for a timer: at 250 turns a second that alone is 5 to 10 % of
a core.
"""

from __future__ import annotations

from collections.abc import Callable
import threading
import time

from rclpy.node import Node


class Beat:
    """Calls a function again and again; an exception from it ends the node."""

    def __init__(self, node: Node, function: Callable[[], None], period_s: float) -> None:
        self._function, self._period_s, self._context = function, period_s, node.context
        self._open = True
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name='beat', daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread; raises what ended it before."""
        self._open = False
        self._thread.join()
        if self._failure is not None:
            raise self._failure

    def _run(self) -> None:
        due_s = time.monotonic()
        try:
            while self._open and self._context.ok():
                self._function()
                now_s = time.monotonic()
                due_s = max(due_s + self._period_s, now_s)
                time.sleep(due_s - now_s)
        except Exception as error:
            # After the signal nothing can be published: what fails then is the end, not an error.
            if self._context.ok():
                self._failure = error
                self._context.try_shutdown()
