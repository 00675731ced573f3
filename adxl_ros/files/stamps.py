# SPDX-License-Identifier: Apache-2.0

"""
The rate of stamps: samples over the time in which they came.

A clock of a host delays stamps, rounds them, or gives them to many samples at once, and none of
this changes how many samples come in a second. A median of the steps does change: a host that
polls every 4.25 ms stamps a sensor of 100 Hz in steps of 8.5 and 12.75 ms. Therefore steps are
averaged. Only those in which samples are missing are left out, with their samples.
"""

from __future__ import annotations

from typing import NamedTuple

from adxl_ros.model.constants import TINY
import numpy as np

_FEWEST_STEPS = 8  # Steps in which bursts are looked for. Chosen: fewer hold no two bursts
_BETWEEN_BURSTS_QUANTILE = 0.985
"""Quantile of the steps that is one between bursts (chosen: a burst has at most 64 samples)."""
_WITHIN_BURST = 0.1
"""Longest step within a burst, as a share of one between bursts (chosen: beyond jitter)."""
_LEAST_WITHIN_BURSTS = 0.45
"""Smallest share of such steps among all (chosen: bursts of two samples have 0.5)."""
_MEDIAN_OF_BURSTS = 0.25
"""Share of the mean step that the median step is below where stamps come in bursts (chosen: most
steps are within one)."""
_EVEN_DEVIATION = 0.02
"""Largest deviation of even steps, as a share of them (chosen: rate right to 0.5 %)."""
_EVEN_QUANTILE = 0.9
"""Share of the steps that are even (chosen: a few losses or delays are common)."""
_MOST_APART = 64
"""Most samples, or bursts, over which the first estimate of a period is taken (chosen: delays
hardly change their time, and most such spans hold no pause)."""
_LARGEST_PART = 4
"""Part of all of them, 1/4, that it is taken over at most (chosen: a median of many spans)."""
_LACKING_STEP = 1.5
"""Step from which a sample may be missing, periods (between one period and two)."""
_NEARBY = (0.75, 1.5, 3.0, 6.0)
"""Samples on both sides of a long step in which its time may be made up, as multiples of the
samples that it may lack. Chosen: a host that catches up takes its samples at once, or faster than
they are made, and the longest ones average out jitter. The first one ends before the next burst
begins."""
_PERMANENT = 0.5
"""Share of a long step that nearby steps do not make up where samples are missing (half way)."""
_ROUNDS = 8  # Most rounds of period and missing samples (chosen: two or three suffice)


def burst_ends(time_s: np.ndarray) -> np.ndarray:
    """Return the samples, (k,), that end a burst of stamps, s, (n,): all where none is seen."""
    steps_s = np.diff(time_s)
    if len(steps_s) >= _FEWEST_STEPS and np.median(steps_s) < _MEDIAN_OF_BURSTS * steps_s.mean():
        is_short = steps_s < _WITHIN_BURST * np.quantile(steps_s, _BETWEEN_BURSTS_QUANTILE)
        if is_short.mean() >= _LEAST_WITHIN_BURSTS:
            return np.flatnonzero(~is_short)
    return np.arange(len(time_s))


def burst_samples(time_s: np.ndarray) -> int:
    """Return the mean number of samples of a burst of stamps, s, (n,); 1 where there is none."""
    return round((len(time_s) - 1) / max(len(burst_ends(time_s)), 1))


def lacks_samples(time_s: np.ndarray, period_s: float) -> np.ndarray:
    """
    Return in which steps of stamps, s, (n,), samples are missing, (n − 1,) bool.

    They are longer than a period, s, and the stamps nearby do not make up for it. A host that
    stalls takes the samples that have waited at once, so that nothing is missing.
    """
    lacks = np.diff(time_s) > _LACKING_STEP * period_s
    long = np.flatnonzero(lacks)
    excess_s = time_s[long + 1] - time_s[long] - period_s
    lacking = np.maximum(np.rint(excess_s / period_s), 1)
    for factor in _NEARBY:
        reach = np.rint(factor * lacking).astype(np.intp)
        first = np.maximum(long - reach, 0)
        last = np.minimum(long + 1 + reach, len(time_s) - 1)
        late_s = time_s[last] - time_s[first] - (last - first) * period_s
        lacks[long[late_s <= _PERMANENT * excess_s]] = False
    return lacks


def without_stalls(time_s: np.ndarray, period_s: float, shortest_s: float) -> np.ndarray:
    """
    Return stamps, s, (n,), as they were without stalls of a host of some time, s, or more.

    What waited came at once: it is evenly spaced from the sample before.
    """
    mended_s = time_s.copy()
    late_s = time_s - period_s * np.arange(len(time_s))
    is_stall = (np.diff(time_s) > period_s + shortest_s) & ~lacks_samples(time_s, period_s)
    for i in np.flatnonzero(is_stall).tolist():
        usual_s = mended_s[i] - period_s * i + period_s / 2
        stop = i + 1
        while stop < len(time_s) and late_s[stop] > usual_s:
            stop += 1
        mended_s[i + 1 : stop] = mended_s[i] + period_s * np.arange(1, stop - i)
    return mended_s


def mean_period_s(time_s: np.ndarray) -> float:
    """Return the mean period of two or more stamps, s, (n,); 0 where they stand still."""
    ends = burst_ends(time_s)
    if len(ends) < 2:
        ends = np.array([0, len(time_s) - 1])
    apart = max(min(_MOST_APART, (len(ends) - 1) // _LARGEST_PART), 1)
    begin = ends[:-apart]
    end = ends[apart:]
    period_s = float(np.median((time_s[end] - time_s[begin]) / (end - begin)))
    # From the end of a burst to the end of another one, so that all of them are whole.
    whole_s = time_s[ends[0] : ends[-1] + 1]
    steps_s = np.diff(whole_s)
    before_s = 0.0
    for _ in range(_ROUNDS):
        if period_s == before_s or not period_s > 0:
            break
        is_complete = ~lacks_samples(whole_s, period_s)
        if not is_complete.any():
            break
        before_s = period_s
        period_s = float(steps_s[is_complete].mean())
    return max(period_s, 0.0)


def stamped_rate_hz(time_s: np.ndarray) -> float:
    """Return the sample rate of two or more stamps, s, (n,), Hz, to 1e-6; NaN where they stand."""
    step_s = mean_period_s(time_s)
    return round(1 / step_s, 6) if step_s > 0 else float('nan')


def is_even(time_s: np.ndarray) -> bool:
    """Return whether nearly all steps of stamps, s, (n,), are one period."""
    step_s = mean_period_s(time_s)
    deviation_s = np.quantile(np.abs(np.diff(time_s) - step_s), _EVEN_QUANTILE)
    return bool(deviation_s <= _EVEN_DEVIATION * step_s)


class Halves(NamedTuple):
    """
    The rates of both halves of some stamps, and of all of them with what seems to be missing, Hz.

    A host that stalls makes one half slower, and the other one or a later one faster.
    """

    first_hz: float
    second_hz: float
    counted_hz: float

    def agree(self, tolerance: float) -> bool:
        """Return whether the halves are the same within a share of their rates."""
        return abs(self.first_hz - self.second_hz) <= tolerance * (self.first_hz + self.second_hz)

    def contradict(self, rate_hz: float, tolerance: float) -> bool:
        """Return whether all are above a rate, Hz, by more than a share of it, or all below."""
        ratios = np.array(self) / rate_hz - 1
        return bool(ratios.min() > tolerance or ratios.max() < -tolerance)


def halves(time_s: np.ndarray) -> Halves:
    """Return the rates of both halves, in time, of three or more stamps, s, (n,)."""
    middle = int(np.searchsorted(time_s, (time_s[0] + time_s[-1]) / 2))
    middle = min(max(middle, 1), len(time_s) - 2)
    span_s = max(float(time_s[-1] - time_s[0]), TINY)
    return Halves(
        stamped_rate_hz(time_s[: middle + 1]),
        stamped_rate_hz(time_s[middle:]),
        (len(time_s) - 1) / span_s,
    )


def late_by(stamps: np.ndarray) -> np.ndarray:
    """Return by how much each stamp, (n,), is earlier than the latest one before it; 0 if not."""
    return np.maximum.accumulate(stamps) - stamps


def describe_bursts(time_s: np.ndarray) -> str:
    """Return a clause for messages; empty where stamps fall, or do not come in bursts."""
    if (np.diff(time_s) < 0).any():
        return ''
    size = burst_samples(time_s)
    if size == 1:
        return ''
    return (
        f'stamps come in bursts of about {size} samples (USB, or a buffer), at a mean of '
        f'{stamped_rate_hz(time_s):.4g} Hz'
    )
