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

"""References that were sampled by a clock of their own, brought to the sensor's stamps."""

from __future__ import annotations

from adxl_ros.errors import UserError
import numpy as np


def seconds(stamp_ns: int) -> str:
    """Write a stamp, ns, in seconds, to the nanosecond."""
    whole, rest = divmod(int(stamp_ns), 1_000_000_000)
    return f'{whole}.{rest:09d} s'


class Track:
    """
    One reference over time, interpolated as its messages and the sensor's samples come in.

    Between two messages the value is on the straight line between theirs; angles are taken as
    they are, unwrapped. Up to one period of the reference beyond its first and last message the
    value there is held; farther out it is NaN.

    Attributes
    ----------
    seen_ns
        Stamp of the newest message, whether it had a number or not: up to there, the reference
        is known. Less than any stamp before the second message, which shows the period.

    """

    def __init__(self, where: str) -> None:
        """Start with no message; `where` names the topic in error messages."""
        self.seen_ns = -1
        self._seen = 0
        self._where = where
        self._stamp_ns = np.zeros(0, np.int64)
        self._value = np.zeros(0)
        self._period_ns = 0.0
        self._gap_ns = 0
        self._square_sum = 0.0
        self._square_count = 0

    def add(self, stamp_ns: np.ndarray, value: np.ndarray) -> None:
        """
        Append messages; one without a number is one that was not sampled.

        Parameters
        ----------
        stamp_ns
            Stamps, ns, (k,). Of messages with the same stamp the last one counts.
        value
            What the reference said, (k,).

        Raises
        ------
        UserError
            The stamps run backwards.

        """
        if not len(stamp_ns):
            return
        self._seen += len(stamp_ns)
        if self._seen > 1:
            self.seen_ns = int(stamp_ns[-1])
        known = len(self._stamp_ns)
        sampled = ~np.isnan(value)
        stamps = np.concatenate([self._stamp_ns, stamp_ns[sampled]])
        values = np.concatenate([self._value, value[sampled]])
        step = np.diff(stamps)
        if (step < 0).any():
            i = int((step < 0).argmax())
            raise UserError(f'{self._where}: time runs backwards: {seconds(stamps[i + 1])} comes '
                            f'after {seconds(stamps[i])}')
        last = np.append(step > 0, True)[:len(stamps)]
        self._stamp_ns, self._value = stamps[last], values[last]
        if len(self._stamp_ns) > 1:
            self._period_ns = float(np.median(np.diff(self._stamp_ns)))
        self._compare(max(known - 2, 0))

    def _compare(self, start: int) -> None:
        """Compare each message after `start` with the line between its neighbours."""
        x = (self._stamp_ns[start:] - self._stamp_ns[start:start + 1]).astype(float)
        y = self._value[start:]
        if len(x) < 3:
            return
        share = (x[1:-1] - x[:-2]) / (x[2:] - x[:-2])
        miss = y[1:-1] - (y[:-2] + share * (y[2:] - y[:-2]))
        self._square_sum += float(miss @ miss)
        self._square_count += len(miss)

    def at(self, stamp_ns: np.ndarray) -> np.ndarray:
        """Return the reference at ascending stamps, ns, (n,): (n,), NaN where it is not known."""
        if not len(self._stamp_ns):
            return np.full(len(stamp_ns), np.nan)
        here = (stamp_ns - self._stamp_ns[0]).astype(float)
        there = (self._stamp_ns - self._stamp_ns[0]).astype(float)
        value = np.interp(here, there, self._value)
        known = (here >= -self._period_ns) & (here <= there[-1] + self._period_ns)
        value[~known] = np.nan
        if known.any():
            after = np.searchsorted(there, here[known]).clip(1, max(len(there) - 1, 1))
            nearest = np.minimum(np.abs(here[known] - there[after - 1]),
                                 np.abs(here[known] - there[after.clip(max=len(there) - 1)]))
            self._gap_ns = max(self._gap_ns, int(nearest.max()))
        return value

    def forget(self, stamp_ns: int) -> None:
        """Drop what no sample from `stamp_ns` on needs."""
        start = int(np.searchsorted(self._stamp_ns, stamp_ns)) - 2
        if start > 0:
            self._stamp_ns, self._value = self._stamp_ns[start:], self._value[start:]

    @property
    def gap_s(self) -> float:
        """Largest time between a sample and the message nearest to it, s."""
        return self._gap_ns * 1e-9

    @property
    def residual(self) -> float:
        """
        Residual of the alignment, in the unit of the reference.

        Rms difference between each message and the straight line between the two beside it,
        which is what interpolation over twice the period misses: a bound for what it misses over
        one. 0 where every sample has a message with its own stamp, so that none is interpolated.
        """
        if not self._gap_ns or not self._square_count:
            return 0.0
        return (self._square_sum / self._square_count) ** 0.5


class Command:
    """
    One joint's commands over time: each is in force from its stamp to the stamp of the next.

    Commands are few and far between, so that samples are not held back for them: a command that
    is read after later samples have been handed on counts from the next sample on.
    """

    def __init__(self) -> None:
        """Start with no message."""
        self._stamp_ns = np.zeros(0, np.int64)
        self._value = np.zeros(0)

    def add(self, stamp_ns: np.ndarray, value: np.ndarray) -> None:
        """
        Append messages.

        Parameters
        ----------
        stamp_ns
            Stamps, ns, (k,), in any order. Of messages with the same stamp the last one counts.
        value
            Where the joint shall go, (k,); NaN in a message that does not say it.

        """
        given = ~np.isnan(value)
        stamps = np.concatenate([self._stamp_ns, stamp_ns[given]])
        order = np.argsort(stamps, kind='stable')
        self._stamp_ns = stamps[order]
        self._value = np.concatenate([self._value, value[given]])[order]

    def at(self, stamp_ns: np.ndarray) -> np.ndarray:
        """Return the command in force at stamps, ns, (n,): (n,), NaN before the first one."""
        return np.concatenate([[np.nan], self._value])[
            np.searchsorted(self._stamp_ns, stamp_ns, 'right')]

    def forget(self, stamp_ns: int) -> None:
        """Drop what no sample from `stamp_ns` on needs."""
        start = int(np.searchsorted(self._stamp_ns, stamp_ns, 'right')) - 1
        if start > 0:
            self._stamp_ns, self._value = self._stamp_ns[start:], self._value[start:]
