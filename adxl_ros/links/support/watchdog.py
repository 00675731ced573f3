# SPDX-License-Identifier: Apache-2.0

"""Watch whether messages of a topic come."""

from __future__ import annotations

import time


class Watchdog:
    """
    Measures for how long nothing has come, in time during which the node could listen.

    A node that was held up for seconds finds its messages waiting: they were not missing. And a
    machine that was held up has stopped whoever publishes them, too. So a turn counts as
    `longest_turn_s` at most.
    """

    def __init__(self, longest_turn_s: float) -> None:
        self._longest_turn_s = longest_turn_s
        self._checked_s = time.monotonic()
        self._silent_s = 0.0

    def feed(self) -> None:
        """Note that a message has come; any thread may call this."""
        self._silent_s = 0.0

    def check(self) -> float:
        """Return for how long nothing has come, s; to be called in every turn of the node."""
        now_s = time.monotonic()
        self._silent_s += min(now_s - self._checked_s, self._longest_turn_s)
        self._checked_s = now_s
        return self._silent_s
