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

"""The keys that are pressed, out of the bytes that a terminal sends."""

from __future__ import annotations

import re

_PLAIN = b'abcdefghijklmnopqrstuvwxyz '
_ESCAPED = re.compile(
    rb'\x1b+(\[\[.|\[M...|\[[0-?]*[ -/]*[@-~]|O[0-9;]*[^0-9;]|[^\x1b\[O])', re.S)
"""Of xterm, with X10's mouse and the function keys of the Linux console; or Alt and a letter."""
_BEGUN = re.compile(rb'\x1b+(\[(\[|M.{0,2}|[0-?]*[ -/]*)?|O[0-9;]*)?\Z', re.S)
_LONELY_S = 1.0
"""The key Escape takes nothing with it that comes so much later."""


class Keys:
    """
    Letters and the space; what comes with an escape, whole or in pieces, is no key of ours.

    Arrows, the wheel of a mouse and function keys end with a letter: an arrow upwards is no A.
    """

    def __init__(self) -> None:
        self._begun, self._at_s = b'', 0.0

    def read(self, data: bytes, now_s: float) -> str:
        """
        Return the keys that were pressed, in lower case.

        Parameters
        ----------
        data
            What was read from the terminal.
        now_s
            When, s.

        """
        if self._begun.strip(b'\x1b') or now_s - self._at_s < _LONELY_S:
            data = self._begun + data
        begun = _BEGUN.search(data)
        whole = data[:begun.start()] if begun else data
        self._begun, self._at_s = data[len(whole):], now_s
        return bytes(byte for byte in _ESCAPED.sub(b'', whole).lower() if byte in _PLAIN).decode()
