# SPDX-License-Identifier: Apache-2.0

"""References and commands with stamps of their own, aligned with the stamps of the samples."""

from __future__ import annotations

from adxl_ros.errors import UserError
import numpy as np

LONGEST_MOVE_NS = 1e8
"""Longest time between two messages in which a joint moves, ns, that is interpolated. Chosen: an
acceleration of 1 rad/s² then bends the path by 1 mrad, which is the noise of an ADXL203."""
USUAL_GAPS = 3.0
"""Gap between messages, in usual ones, that is bridged, however long. Chosen: a slow reference
loses single messages."""
_LEARNT_STEPS = 1000
"""Steps between messages whose median is the usual one. Chosen: enough for a median."""


def seconds(stamp_ns: int) -> str:
    """Return a stamp, ns, as text in seconds with all nanoseconds."""
    whole_s, rest_ns = divmod(int(stamp_ns), 1_000_000_000)
    return f'{whole_s}.{rest_ns:09d} s'


class Track:
    """
    One reference over time, interpolated while its messages and the samples arrive.

    Between two messages the value is on the straight line between theirs; angles are not
    wrapped. Before the first and after the last message their value is held for one period of the
    reference; beyond that the reference is NaN. So it is in a long gap over which it has changed:
    nobody knows how.
    """

    def __init__(self, where: str, longest_ns: float = np.inf) -> None:
        """Start with no message."""
        # Stamp of the newest message, with or without a number, ns. The reference is known up to
        # there. -1 before the second message, which shows the period.
        self.known_until_ns = -1
        self._where, self._longest_ns = where, longest_ns
        self._steps_ns = np.zeros(0, np.int64)
        self._message_count = 0
        self._stamp_ns = np.zeros(0, np.int64)
        self._value = np.zeros(0)
        self._usual_ns = 0.0  # Usual time between messages, ns; 0 before the second one
        self._gap_ns = 0
        self._square_sum = 0.0
        self._square_count = 0

    def add(self, stamp_ns: np.ndarray, value: np.ndarray) -> None:
        """
        Append messages.

        stamp_ns: stamps, ns, (k,). Of messages with the same stamp the last one counts.; value:
        values of the reference, in its unit, (k,); NaN where it was not sampled.
        """
        if not len(stamp_ns):
            return
        self._message_count += len(stamp_ns)
        if self._message_count > 1:
            self.known_until_ns = int(stamp_ns[-1])
        compared = max(len(self._stamp_ns) - 2, 0)
        is_sampled = ~np.isnan(value)
        stamps = np.concatenate([self._stamp_ns, stamp_ns[is_sampled]])
        values = np.concatenate([self._value, value[is_sampled]])
        step = np.diff(stamps)
        if (step < 0).any():
            i = int((step < 0).argmax())
            raise UserError(f'{self._where}: time runs backwards: {seconds(stamps[i + 1])} comes '
                            f'after {seconds(stamps[i])}')
        new = max(len(self._stamp_ns) - 1, 0)
        self._steps_ns = np.concatenate([self._steps_ns, step[new:][step[new:] > 0]])[
            :_LEARNT_STEPS]
        self._usual_ns = float(np.median(self._steps_ns)) if len(self._steps_ns) else 0.0
        is_last = np.append(step > 0, True)[:len(stamps)]
        self._stamp_ns, self._value = stamps[is_last], values[is_last]
        self._compare(compared)

    def _compare(self, start: int) -> None:
        """Compare each message after `start` with the line between its neighbours."""
        time_ns = (self._stamp_ns[start:] - self._stamp_ns[start:start + 1]).astype(float)
        value = self._value[start:]
        if len(time_ns) < 3:
            return
        share = (time_ns[1:-1] - time_ns[:-2]) / (time_ns[2:] - time_ns[:-2])
        residual = value[1:-1] - (value[:-2] + share * (value[2:] - value[:-2]))
        self._square_sum += float(residual @ residual)
        self._square_count += len(residual)

    def interpolate(self, stamp_ns: np.ndarray) -> np.ndarray:
        """Return the reference at ascending stamps, ns, (n,): (n,), NaN where it is unknown."""
        if not len(self._stamp_ns):
            return np.full(len(stamp_ns), np.nan)
        sample_ns = (stamp_ns - self._stamp_ns[0]).astype(float)
        message_ns = (self._stamp_ns - self._stamp_ns[0]).astype(float)
        value = np.interp(sample_ns, message_ns, self._value)
        is_known = (sample_ns >= -self._usual_ns) & (sample_ns <= message_ns[-1] + self._usual_ns)
        value[~is_known | self._in_long_gap(sample_ns, message_ns)] = np.nan
        if is_known.any():
            self._gap_ns = max(self._gap_ns, _largest_gap_ns(sample_ns[is_known], message_ns))
        return value

    def _in_long_gap(self, sample_ns: np.ndarray, message_ns: np.ndarray) -> np.ndarray:
        """Return which samples, ns, (n,), lie in a gap that no line bridges, (n,)."""
        if len(message_ns) < 2:
            return np.zeros(len(sample_ns), bool)
        limit_ns = max(self._longest_ns, USUAL_GAPS * self._usual_ns)
        is_long = (np.diff(message_ns) > limit_ns) & (np.diff(self._value) != 0)
        after = np.searchsorted(message_ns, sample_ns).clip(max=len(message_ns) - 1)
        inside = (sample_ns > message_ns[0]) & (sample_ns < message_ns[after])
        return inside & is_long[np.maximum(after - 1, 0)]

    def forget(self, stamp_ns: int) -> None:
        """Drop the messages that no sample from `stamp_ns` on needs."""
        start = int(np.searchsorted(self._stamp_ns, stamp_ns)) - 2
        if start > 0:
            self._stamp_ns, self._value = self._stamp_ns[start:], self._value[start:]

    @property
    def alignment(self) -> tuple[float, float]:
        """
        How well the reference was aligned so far: residual, in its unit, and largest gap, s.

        The residual is the rms difference between each message and the straight line between its
        neighbours. Interpolation over twice the period misses it, so that it bounds the error
        over one period. It is 0 where every sample has a message with its own stamp.
        """
        if not self._gap_ns or not self._square_count:
            return 0.0, self._gap_ns * 1e-9
        return (self._square_sum / self._square_count) ** 0.5, self._gap_ns * 1e-9


def _largest_gap_ns(sample_ns: np.ndarray, message_ns: np.ndarray) -> int:
    """Return the largest time from a sample, ns, (n,), to its nearest message, ns, (k,)."""
    places = np.interp(sample_ns, message_ns, np.arange(len(message_ns)))
    return int(np.abs(sample_ns - message_ns[np.rint(places).astype(int)]).max())


class Command:
    """
    Commands of one joint over time: each is in force from its stamp to the stamp of the next.

    Commands are few and far between, so that no sample waits for them. A command that is read
    after later samples were handed on counts from the next sample on.
    """

    def __init__(self) -> None:
        """Start with no message."""
        self._stamp_ns = np.zeros(0, np.int64)
        self._value = np.zeros(0)

    def add(self, stamp_ns: np.ndarray, value: np.ndarray) -> None:
        """
        Append messages.

        stamp_ns: stamps, ns, (k,), in any order. Of messages with the same stamp the last one
        counts.; value: commanded positions, rad, (k,); NaN in a message without a position of this
        joint.
        """
        is_given = ~np.isnan(value)
        stamps = np.concatenate([self._stamp_ns, stamp_ns[is_given]])
        order = np.argsort(stamps, kind='stable')
        self._stamp_ns = stamps[order]
        self._value = np.concatenate([self._value, value[is_given]])[order]

    def in_force(self, stamp_ns: np.ndarray) -> np.ndarray:
        """Return the command in force at stamps, ns, (n,): (n,), NaN before the first one."""
        return np.concatenate([[np.nan], self._value])[
            np.searchsorted(self._stamp_ns, stamp_ns, 'right')]

    def forget(self, stamp_ns: int) -> None:
        """Drop the commands that no sample from `stamp_ns` on needs."""
        start = int(np.searchsorted(self._stamp_ns, stamp_ns, 'right')) - 1
        if start > 0:
            self._stamp_ns, self._value = self._stamp_ns[start:], self._value[start:]
