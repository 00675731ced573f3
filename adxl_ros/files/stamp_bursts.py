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

"""Stamps that come in bursts, as of samples that a USB packet or a buffer hands on together."""

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
_LAG_BURSTS = 16
"""Bursts over which the rate is taken (chosen: their stamps scatter by a part of one)."""


def burst_samples(time_s: np.ndarray) -> int:
    """
    Return how many samples a burst of stamps has; 1 where there are no bursts.

    Parameters
    ----------
    time_s
        Stamps, s, (n,), in the order of the samples.

    Returns
    -------
    int
        Mean number of samples of a burst.

    """
    steps_s = np.diff(time_s)
    if len(steps_s) < 8 or np.median(steps_s) >= _EVEN * steps_s.mean():
        return 1
    long_s = np.quantile(steps_s, _LONG_QUANTILE)
    short = float(np.mean(steps_s < _SHORT * long_s))
    if short < _SHORT_SHARE or long_s <= 0:
        return 1
    return round(1 / max(1 - short, 1 / len(steps_s)))


def rate_lag(time_s: np.ndarray) -> int:
    """Return over how many samples a step shows the rate: 1, and more for bursts of stamps."""
    size = burst_samples(time_s)
    return 1 if size == 1 else max(1, min(_LAG_BURSTS * size, len(time_s) // 2))


def burst_rate_hz(time_s: np.ndarray) -> float:
    """Return the mean rate of stamps in bursts, Hz."""
    lag = rate_lag(time_s)
    return float(lag / np.median(time_s[lag:] - time_s[:-lag]))


def describe_bursts(time_s: np.ndarray) -> str:
    """Return `; ` and a clause for messages; empty where stamps do not come in bursts."""
    size = burst_samples(time_s)
    if size == 1:
        return ''
    return f'; stamps come in bursts of about {size} samples (USB, or a buffer), at a mean of ' \
           f'{burst_rate_hz(time_s):.4g} Hz'
