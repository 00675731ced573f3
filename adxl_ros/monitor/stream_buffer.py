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

"""Rows of numbers with stamps, of the newest time only."""

from __future__ import annotations

import numpy as np

_MOST_ROWS = 4_000_000
"""Largest number of rows in memory; chosen: an hour at 1 kHz, 130 MB with three columns."""
_FIRST_ROWS = 1024
"""Rows that have a place from the beginning; chosen."""


class StreamBuffer:
    """
    Keeps the newest rows of a stream; stamps ascend.

    Parameters
    ----------
    columns
        Numbers of a row.
    span_ns
        Time that is kept, ns. Older rows are forgotten, at the latest when they are as many again.

    """

    def __init__(self, columns: int, span_ns: int) -> None:
        self._span_ns = span_ns
        self._stamps = np.zeros(_FIRST_ROWS, np.int64)
        self._rows = np.zeros((_FIRST_ROWS, columns))
        self._begin = self._end = 0

    def __len__(self) -> int:
        """Return the number of rows."""
        return self._end - self._begin

    @property
    def newest_ns(self) -> int | None:
        """Return the newest stamp, ns; None without rows."""
        return int(self._stamps[self._end - 1]) if len(self) else None

    def add(self, stamp_ns: np.ndarray, rows: np.ndarray) -> int:
        """
        Append rows, and drop those whose stamp does not increase.

        Parameters
        ----------
        stamp_ns
            Stamps, ns, (n,).
        rows
            Numbers, (n, k).

        Returns
        -------
        int
            Number of dropped rows.

        """
        if not len(stamp_ns):
            return 0
        newest_ns = self.newest_ns
        before = np.concatenate([[stamp_ns[0] - 1 if newest_ns is None else newest_ns], stamp_ns])
        later = stamp_ns > np.maximum.accumulate(before)[:-1]
        stamps, rows = stamp_ns[later][-_MOST_ROWS:], rows[later][-_MOST_ROWS:]
        self._make_room(len(stamps))
        part = slice(self._end, self._end + len(stamps))
        self._stamps[part], self._rows[part] = stamps, rows
        self._end += len(stamps)
        return int((~later).sum())

    def between(self, begin_ns: int, end_ns: int) -> tuple[np.ndarray, np.ndarray]:
        """
        Return copies of the rows of a time.

        Parameters
        ----------
        begin_ns, end_ns
            First stamp, and the stamp after the last, ns.

        Returns
        -------
        tuple
            Stamps, ns, (n,), and rows, (n, k).

        """
        kept = self._stamps[self._begin:self._end]
        part = slice(*(self._begin + np.searchsorted(kept, [begin_ns, end_ns])))
        return self._stamps[part].copy(), self._rows[part].copy()

    def clear(self) -> None:
        """Forget all rows."""
        self._begin = self._end = 0

    def _make_room(self, count: int) -> None:
        """Forget old rows, and make room for new ones."""
        if self._end + count <= len(self._stamps):
            return
        newest_ns = self.newest_ns
        if newest_ns is not None:
            kept = self._stamps[self._begin:self._end]
            self._begin += int(np.searchsorted(kept, newest_ns - self._span_ns))
        self._begin = max(self._begin, self._end - (_MOST_ROWS - count))
        size = max(2 * (len(self) + count), _FIRST_ROWS)
        stamps = np.zeros(size, np.int64)
        rows = np.zeros((size, self._rows.shape[1]))
        stamps[:len(self)] = self._stamps[self._begin:self._end]
        rows[:len(self)] = self._rows[self._begin:self._end]
        self._stamps, self._rows, self._begin, self._end = stamps, rows, 0, len(self)
