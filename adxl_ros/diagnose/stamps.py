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

"""
Stamps that are rounded, scatter or come in bursts, although the sensor samples evenly.

A converter samples by a clock of its own, and software makes the stamps later. A straight line
over the number of the sample then is nearer to the instants than the stamps are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_ROUNDINGS_S = (0.1, 0.01, 1e-3, 1e-4, 1e-5, 1e-6)
"""Steps that stamps may be rounded to, s, the largest first: decimals of a second."""
_ROUNDING_TOLERANCE = 0.01
"""Deviation from a rounded stamp, in its steps, that is accepted. Chosen: float64 seconds since
1970 deviate by 0.2 µs."""
_EVEN = 1e-4
"""Deviation from a line, in samples, up to which stamps are even. Chosen: the simulator then
needs no interpolation."""
_MENTIONED = 0.01
"""Deviation from a line, in samples, from which the report mentions it. Chosen: below it nothing
shows in the slowest motion."""
_LARGEST_SCATTER = 0.45
"""Largest deviation from a line, in samples, by which a stamp still shows the number of its
sample. Chosen: below one half."""
_LARGEST_BURST = 64.0
"""Largest deviation of stamps in bursts, in samples. Chosen: a buffer of a serial port."""
_BURSTS = 0.5
"""Median step of stamps in bursts, divided by the mean step, is below this. Chosen: a few lost
samples do not change the one, and hardly the other."""
_USUAL_STEPS = 1.5
"""Steps up to this many medians count as one sample. Chosen: halfway to two."""
_ROUNDS = 3
"""Rounds that number the samples by the line and fit the line. Chosen: numbers then stay."""


@dataclass(frozen=True)
class EvenStamps:
    """
    The instants of samples that were taken evenly.

    Attributes
    ----------
    time_s
        The instants, s, (n,).
    certain
        Whether rounding or bursts explain all deviations; otherwise the samples themselves may
        have been taken unevenly.
    note
        What was changed, for people; empty where it does not matter.

    """

    time_s: np.ndarray
    certain: bool
    note: str


def even_stamps(stamps_s: np.ndarray) -> EvenStamps | None:
    """
    Find the even instants behind stamps.

    Parameters
    ----------
    stamps_s
        Stamps, s, (n,), strictly increasing.

    Returns
    -------
    EvenStamps or None
        None where the stamps are even, or where no even clock explains them.

    """
    steps_s = np.diff(stamps_s)
    if len(steps_s) < 2 or steps_s.min() <= 0:
        return None
    if np.median(steps_s) < _BURSTS * steps_s.mean():
        return _from_bursts(stamps_s)
    # Stamps that scatter by more than their steps look like lost samples.
    time_s, slope_s, largest = min(
        (_line(stamps_s, number) for number in (np.arange(len(stamps_s)),
                                                _numbers(stamps_s, steps_s))),
        key=lambda line: line[2])
    if largest < _EVEN or largest > _LARGEST_SCATTER:
        return None
    rounding_s = _rounding_s(stamps_s)
    if largest * slope_s < (0.5 + _ROUNDING_TOLERANCE) * rounding_s:
        note = f'stamps are rounded to {rounding_s:g} s, and {_even_text(slope_s)}'
        return EvenStamps(time_s, True, note if largest > _MENTIONED else '')
    note = f'stamps scatter by up to {1e3 * largest * slope_s:.3g} ms, and {_even_text(slope_s)}'
    return EvenStamps(time_s, False, note if largest > _MENTIONED else '')


def _line(stamps_s: np.ndarray, number: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Return stamps on a line over their numbers, s, its slope, s, and the largest deviation."""
    slope_s, begin_s = np.polyfit(number, stamps_s - stamps_s[0], 1)
    time_s = stamps_s[0] + begin_s + slope_s * number
    return time_s, float(slope_s), float(np.abs(stamps_s - time_s).max() / slope_s)


def _even_text(step_s: float) -> str:
    """Return which clock is used."""
    return f'an even rate of {1 / step_s:.6g} Hz explains them: it is used'


def _numbers(stamps_s: np.ndarray, steps_s: np.ndarray) -> np.ndarray:
    """Return the number of each sample, counting missing ones, (n,)."""
    step_s = float(np.mean(steps_s[steps_s < _USUAL_STEPS * np.median(steps_s)]))
    number = np.concatenate([[0.0], np.cumsum(np.maximum(np.rint(steps_s / step_s), 1.0))])
    for _ in range(_ROUNDS):
        slope_s, begin_s = np.polyfit(number, stamps_s - stamps_s[0], 1)
        again = np.rint((stamps_s - stamps_s[0] - begin_s) / slope_s)
        if np.diff(again).min() < 1:
            break
        number = again
    return number


def _rounding_s(stamps_s: np.ndarray) -> float:
    """Return the decimal of a second that all stamps are rounded to, s; 0 for none."""
    for rounding_s in _ROUNDINGS_S:
        steps = stamps_s / rounding_s
        if np.abs(steps - np.rint(steps)).max() < _ROUNDING_TOLERANCE:
            return rounding_s
    return 0.0


def _from_bursts(stamps_s: np.ndarray) -> EvenStamps | None:
    """Return the instants of samples whose stamps come in bursts; None where samples are lost."""
    time_s, slope_s, largest = _line(stamps_s, np.arange(len(stamps_s)))
    if largest > _LARGEST_BURST:
        return None
    return EvenStamps(time_s, True, f'stamps come in bursts, and {_even_text(slope_s)}')
