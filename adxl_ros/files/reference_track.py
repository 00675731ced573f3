# SPDX-License-Identifier: Apache-2.0

"""A reference over time, which is interpolated at the stamps of samples."""

from __future__ import annotations

from adxl_ros.errors import UserError
from adxl_ros.model.error_sizes import rms
import numpy as np

LONGEST_MOVE_NS = 1e8
"""Longest time between two messages in which a joint moves, ns, that is interpolated. Chosen: an
acceleration of 1 rad/s² then bends the path by 1 mrad, which is the noise of an ADXL203."""
USUAL_GAPS = 3.0
"""Gap between messages, in usual ones, that is bridged, however long. Chosen: a slow reference
loses single messages."""


def seconds(stamp_ns: int) -> str:
    """Return a stamp, ns, as text in seconds with all nanoseconds."""
    whole_s, rest_ns = divmod(int(stamp_ns), 1_000_000_000)
    return f'{whole_s}.{rest_ns:09d} s'


class Track:
    """
    One reference over time.

    Between two messages the value is on the straight line between theirs; angles are not
    wrapped. Before the first and after the last message their value is held for one period of the
    reference; beyond that the reference is NaN. So it is in a long gap over which it has changed:
    nobody knows how.
    """

    def __init__(
        self, where: str, stamp_ns: np.ndarray, value: np.ndarray, longest_ns: float = np.inf
    ) -> None:
        """
        Take the messages.

        stamp_ns: stamps, ns, (k,). Of messages with the same stamp the last one counts; value:
        values, (k,); NaN where it was not sampled; longest_ns: gap that is bridged, ns.
        """
        stamps = stamp_ns[~np.isnan(value)]
        values = value[~np.isnan(value)]
        step = np.diff(stamps)
        if (step < 0).any():
            i = int((step < 0).argmax())
            raise UserError(
                f'{where}: time runs backwards: {seconds(stamps[i + 1])} comes '
                f'after {seconds(stamps[i])}'
            )
        is_last = np.append(step > 0, True)[: len(stamps)]
        self._stamp_ns = stamps[is_last]
        self._value = values[is_last]
        step = step[step > 0]
        self._usual_ns = float(np.median(step)) if len(step) else 0.0
        self._longest_ns = max(longest_ns, USUAL_GAPS * self._usual_ns)
        self._is_exact = True  # Whether each sample so far has a message with its own stamp

    def interpolate(self, stamp_ns: np.ndarray) -> np.ndarray:
        """Return the reference at ascending stamps, ns, (n,): (n,), NaN where it is unknown."""
        if not len(self._stamp_ns) or not len(stamp_ns):
            return np.full(len(stamp_ns), np.nan)
        first, last = np.searchsorted(self._stamp_ns, stamp_ns[[0, -1]])
        part = slice(max(first - 1, 0), last + 1)  # The messages around the samples
        values = self._value[part]
        begin_ns = self._stamp_ns[part][0]
        sample_ns = stamp_ns - begin_ns
        message_ns = self._stamp_ns[part] - begin_ns
        result = np.interp(sample_ns, message_ns, values)
        is_known = (sample_ns >= -self._usual_ns) & (sample_ns <= message_ns[-1] + self._usual_ns)
        after = np.searchsorted(message_ns, sample_ns).clip(max=len(message_ns) - 1)
        is_long = np.append(
            False, (np.diff(message_ns) > self._longest_ns) & (np.diff(values) != 0)
        )
        is_inside = (sample_ns > message_ns[0]) & (sample_ns < message_ns[after])
        result[~is_known | (is_inside & is_long[after])] = np.nan
        self._is_exact &= bool((sample_ns == message_ns[after])[is_known].all())
        return result

    @property
    def alignment(self) -> float:
        """
        How well the reference was aligned so far: its residual, in its unit.

        It is the rms difference between each message and the straight line between its
        neighbours. Interpolation over twice the period misses it, so that it bounds the error
        over one period. It is 0 where every sample has a message with its own stamp.
        """
        if self._is_exact or len(self._value) < 3:
            return 0.0
        time_ns = self._stamp_ns - self._stamp_ns[0]
        value = self._value
        share = (time_ns[1:-1] - time_ns[:-2]) / (time_ns[2:] - time_ns[:-2])
        residual = value[1:-1] - (value[:-2] + share * (value[2:] - value[:-2]))
        return rms(residual)
