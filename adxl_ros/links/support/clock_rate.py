# SPDX-License-Identifier: Apache-2.0

"""Whether a device samples at the rate that it states, by its own clock."""

from __future__ import annotations

from collections import deque

from adxl_ros.links.support import wire_format
import numpy as np

_RATE_SAMPLES = 25
"""Samples over which the clock of a device is compared with its stated rate. Chosen: all rates are
known a fifth of a second after the start at 1 kHz."""
_RATES = 8  # Rates in a row that must agree. Chosen: a device that stalls has other ones each time
_RATE_SCATTER = 0.02
"""Largest relative difference of rates that agree. Chosen: half a period of 25."""
_USUAL_STEP = 1.5  # Largest step of one sample, in medians of all steps: halfway to two samples
_MAX_RATE_ERROR = 0.05
"""Largest relative error of a stated rate. Chosen: above the error of any oscillator."""


class ClockRate:
    """The rate of samples by the clock of a device, where it is not the stated one."""

    def __init__(self, stated_hz: float) -> None:
        self._stated_hz = stated_hz
        self.used_hz = stated_hz
        self._first: tuple[int, float] | None = None  # Number and time, µs, of a sample
        self._steps_us: list[float] = []  # Times between samples that are not counted, µs
        self._newest_hz: deque[float] = deque(maxlen=_RATES)

    @property
    def fault(self) -> str:
        """Return that clock and stated rate contradict each other, or ''."""
        if self.used_hz == self._stated_hz:
            return ''
        return (
            f'states {self._stated_hz:g} Hz, but its clock shows {self.used_hz:.4g} samples a '
            'second, which is used; correct the rate'
        )

    def compare(self, index: int, time_us: float) -> bool:
        """
        Take number and time, µs, of a sample; return whether they change the rate to use.

        The number counts lost samples, too.
        """
        first = self._first
        if first is None:
            self._first = index, time_us
            return False
        # The numbers of samples may wrap at 2^32.
        count = (index - first[0]) % 2**32
        if count < _RATE_SAMPLES:
            return False
        self._first = index, time_us
        return self._take(count / max(time_us - first[1], 1.0) * 1e6)

    def compare_steps(self, steps_us: np.ndarray) -> bool:
        """
        Take steps, µs, (n,), between samples; return whether they change the rate to use.

        Nothing counts the samples, so that longer steps than usual are losses and no rate.
        """
        self._steps_us.extend(steps_us.tolist())
        if len(self._steps_us) < _RATE_SAMPLES:
            return False
        taken_us = np.array(self._steps_us)
        self._steps_us.clear()
        usual_us = taken_us[taken_us < _USUAL_STEP * np.median(taken_us)]
        return self._take(1e6 / float(usual_us.mean()))

    def _take(self, newest_hz: float) -> bool:
        """Take the rate of some samples, Hz; return whether it changes the rate to use."""
        self._newest_hz.append(newest_hz)
        clock_hz = float(np.median(self._newest_hz))
        low_hz, high_hz = min(self._newest_hz), max(self._newest_hz)
        if len(self._newest_hz) < _RATES or high_hz > (1 + _RATE_SCATTER) * low_hz:
            return False
        if abs(clock_hz / self._stated_hz - 1) <= _MAX_RATE_ERROR:
            clock_hz = self._stated_hz
        lowest_hz, highest_hz = wire_format.RATES_HZ
        if (
            abs(clock_hz / self.used_hz - 1) <= _MAX_RATE_ERROR
            or not lowest_hz <= clock_hz <= highest_hz
        ):
            return False
        self.used_hz = clock_hz
        return True
