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

"""The pressed keys, from the bytes that a terminal sends."""

from __future__ import annotations

import re

_PLAIN = b'abcdefghijklmnopqrstuvwxyz '
"""Keys that have an action."""
_ESCAPED = re.compile(
    rb'\x1b+(\[\[.|\[M...|\[[0-?]*[ -/]*[@-~]|O[0-9;]*[^0-9;]|[^\x1b\[O])', re.S)
"""A sequence of xterm, of X10's mouse, of the function keys of the Linux console, or with Alt."""
_BEGUN = re.compile(rb'\x1b+(\[(\[|M.{0,2}|[0-?]*[ -/]*)?|O[0-9;]*)?\Z', re.S)
"""The beginning of such a sequence at the end of the bytes."""
_LONELY_S = 1.0
"""The key Escape does not belong to bytes that come so much later, s."""


class Keys:
    """
    Letters and the space among the bytes; sequences with an escape are left out.

    Arrows, the wheel of a mouse and function keys end with a letter: an arrow upwards is no A.
    """

    def __init__(self) -> None:
        self._begun, self._read_s = b'', 0.0

    def read(self, data: bytes, now_s: float) -> str:
        """
        Return the keys that were pressed, in lower case.

        Parameters
        ----------
        data
            Bytes of the terminal.
        now_s
            Time at which they were read, s.

        Returns
        -------
        str
            The keys.

        """
        if self._begun.strip(b'\x1b') or now_s - self._read_s < _LONELY_S:
            data = self._begun + data
        begun = _BEGUN.search(data)
        complete = data[:begun.start()] if begun else data
        self._begun, self._read_s = data[len(complete):], now_s
        plain = _ESCAPED.sub(b'', complete).lower()
        return bytes(byte for byte in plain if byte in _PLAIN).decode()
