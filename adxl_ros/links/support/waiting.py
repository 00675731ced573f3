# SPDX-License-Identifier: Apache-2.0

"""Waiting: when a failed attempt is made again, and whether messages come."""

from __future__ import annotations

import time

_FIRST_S = 0.01
"""First waiting time, s; each failure doubles it."""
_LONGEST_S = 0.08
"""Longest waiting time, s: a device that is back is noticed within it."""
_SLOW_S = 1.0
"""Waiting time for a device that is there but does not fit the parameters, s."""
_MAX_WAIT_S = 0.05
"""Longest wait of one call, s, so that the driver reacts to its end."""


class Backoff:
    """An exponential back-off that a success resets."""

    def __init__(self) -> None:
        """Make the first attempt due at once."""
        self._wait_s = _FIRST_S
        self._due_s = 0.0

    def wait(self) -> bool:
        """Wait for the next attempt, at most 50 ms; return whether it is due."""
        remaining_s = self._due_s - time.monotonic()
        if remaining_s > 0:
            time.sleep(min(remaining_s, _MAX_WAIT_S))
        return remaining_s <= _MAX_WAIT_S

    def fail(self, slow: bool = False) -> None:
        """Schedule the next attempt; `slow` where an early one is not likely to help."""
        self._due_s = time.monotonic() + (_SLOW_S if slow else self._wait_s)
        self._wait_s = min(2 * self._wait_s, _LONGEST_S)

    def reset(self) -> None:
        """Retry soon after the next failure."""
        self._wait_s = _FIRST_S


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
