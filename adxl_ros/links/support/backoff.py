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

"""When to try again what has failed: for ever, soon at first, then less often."""

from __future__ import annotations

import time

_FIRST_S = 0.01
_LONGEST_S = 0.08
"""A device that is back is noticed within this."""
_SLOW_S = 1.0
"""A device that is there, but not what the parameters say, is not asked more often."""


class Retry:
    """A back-off that ends when something works again."""

    def __init__(self) -> None:
        """Try at once."""
        self._wait_s = _FIRST_S
        self._next_s = 0.0

    def wait(self) -> bool:
        """Wait for the next try, 50 ms at most; tell whether it is time for it."""
        left_s = self._next_s - time.monotonic()
        if left_s > 0:
            time.sleep(min(left_s, 0.05))
        return left_s <= 0.05

    def failed(self, slow: bool = False) -> None:
        """Take the time until the next try; `slow` where trying soon is not likely to help."""
        self._next_s = time.monotonic() + (_SLOW_S if slow else self._wait_s)
        self._wait_s = min(2 * self._wait_s, _LONGEST_S)

    def worked(self) -> None:
        """Be quick again after the next failure."""
        self._wait_s = _FIRST_S
