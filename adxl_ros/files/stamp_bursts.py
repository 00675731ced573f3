# SPDX-License-Identifier: Apache-2.0

"""The rate of stamps, also of those that jitter or come in bursts (a USB packet, a buffer)."""

from __future__ import annotations

import numpy as np

_LONG_QUANTILE = 0.985
"""Quantile of the steps that is a step between bursts, if there are any (chosen: a burst has at
most 64 samples)."""
_SHORT = 0.1
"""Steps within a burst are shorter than this share of those between bursts (chosen: jitter and
lost samples give no such steps)."""
_SHORT_SHARE = 0.45
"""Smallest share of such steps among all (chosen: bursts of two samples have 0.5)."""
_EVEN = 0.25
"""A median step from this share of the mean step shows stamps without bursts."""
_EVEN_STEPS = 0.02
"""Largest median deviation of even steps from their median, as a share of it (chosen: the median
of 50 steps then is right to 0.5 %)."""
_LAG = 64
"""Most samples, or bursts, over which the rate of uneven stamps is taken (chosen: a jitter of a
whole period then is 2 % of a step)."""


def burst_ends(time_s: np.ndarray) -> np.ndarray:
    """Return the samples, (k,), that end a burst of stamps, s, (n,): all where none is seen."""
    steps_s = np.diff(time_s)
    every = np.arange(len(time_s))
    if len(steps_s) < 8 or np.median(steps_s) >= _EVEN * steps_s.mean():
        return every
    long_s = np.quantile(steps_s, _LONG_QUANTILE)
    is_short = steps_s < _SHORT * long_s
    if is_short.mean() < _SHORT_SHARE or long_s <= 0:
        return every
    return every[:-1][~is_short]


def burst_samples(time_s: np.ndarray) -> int:
    """Return the mean number of samples of a burst of stamps, s, (n,); 1 where there is none."""
    return round((len(time_s) - 1) / max(len(burst_ends(time_s)), 1))


def is_even(time_s: np.ndarray) -> bool:
    """Return whether most steps of stamps, s, (n,), are one period."""
    steps_s = np.diff(time_s)
    step_s = np.median(steps_s)
    return bool(np.median(np.abs(steps_s - step_s)) <= _EVEN_STEPS * step_s)


def period_s(time_s: np.ndarray) -> float:
    """
    Return the period of two or more stamps, s, (n,); 0 where they stand.

    It is the median of many steps: over one sample, or over a quarter of few stamps where they
    jitter or come in bursts. So gaps and lost samples do not change it.
    """
    last = burst_ends(time_s)
    if len(last) < 2:
        last = np.array([0, len(time_s) - 1])
    is_single = len(last) == len(time_s) and is_even(time_s)
    lag = 1 if is_single else max(min(_LAG, len(last) // 4), 1)
    return float(np.median((time_s[last[lag:]] - time_s[last[:-lag]])
                           / (last[lag:] - last[:-lag])))


def stamped_rate_hz(time_s: np.ndarray) -> float:
    """Return the sample rate of two or more stamps, s, (n,), Hz, to 1e-6; NaN where they stand."""
    step_s = period_s(time_s)
    return round(1 / step_s, 6) if step_s > 0 else float('nan')


def describe_bursts(time_s: np.ndarray) -> str:
    """Return `; ` and a clause for messages; empty where stamps do not come in bursts."""
    size = burst_samples(time_s)
    if size == 1:
        return ''
    return f'; stamps come in bursts of about {size} samples (USB, or a buffer), at a mean of ' \
           f'{stamped_rate_hz(time_s):.4g} Hz'
