# SPDX-License-Identifier: Apache-2.0

"""The newest samples of a stream, and readings of temperature and supply over time."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import deque

from adxl_ros.files.recording_columns import stamped_rate_hz
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from adxl_ros.signals.noise_limits import datasheet_noise
from adxl_ros.signals.rest_detection import RestFinder, Stillness
import numpy as np

_REST_WINDOW_S = 1.2
"""Newest samples that stay in memory, s; chosen: more than the rest detection looks at."""
_SHOWN_S = 0.5
"""Newest samples whose mean is shown, s; chosen: steady to read and still quick."""
_FEWEST_SAMPLES = 20
"""Samples that stay at the lowest rates; chosen: they give the rate."""
_BACK_NS = 1_000_000_000
"""A stamp that is earlier than the one before by more is of another clock, ns.

Chosen: messages in wrong order differ by less.
"""
_KEPT_READINGS = 100_000
"""Readings that stay in memory; chosen: 1000 s at 100 Hz."""
STALE_NS = 60_000_000_000
"""A reading counts for samples up to this far from its stamp, ns.

Chosen: temperature and supply hardly change in a minute.
"""


def went_back(newest_ns: int, stamp_ns: int) -> bool:
    """Return whether stamps go back, since the driver was restarted or a clock was set."""
    return stamp_ns < newest_ns - _BACK_NS


class NewestSamples:
    """The newest 1.2 s of a stream, and at least twenty samples."""

    def __init__(self, sensor: Sensor) -> None:
        self._sensor = sensor
        self._keep = max(round(_REST_WINDOW_S * sensor.rate_hz), _FEWEST_SAMPLES)
        self._show = max(round(_SHOWN_S * sensor.rate_hz), _FEWEST_SAMPLES)
        self.stamps_ns = np.zeros(0, np.int64)  # Stamps, ns, (n,)
        self.volts = np.zeros((0, len(sensor.axes)))  # Samples, V, (n, m)

    def feed(self, stamps_ns: np.ndarray, volts: np.ndarray) -> None:
        """
        Take samples.

        stamps_ns: their stamps, ns, (n,); volts: the samples, V, (n, m).
        """
        self.stamps_ns = np.concatenate([self.stamps_ns, stamps_ns])[-self._keep:]
        self.volts = np.concatenate([self.volts, volts])[-self._keep:]

    def mean_mps2(self) -> list[float]:
        """Return the mean of each axis, m/s², (m,)."""
        return self._shown().mean(axis=0).tolist()

    def rms_mps2(self) -> list[float]:
        """Return the rms of each axis about its mean, m/s², (m,)."""
        return self._shown().std(axis=0).tolist()

    def stillness(self) -> Stillness | None:
        """Return whether the samples are at rest, by the datasheet's noise; None if too few."""
        finder = RestFinder(self._sensor.rate_hz, len(self._sensor.axes),
                            datasheet_noise(self._sensor), learn=False)
        if len(self.stamps_ns):
            finder.feed((self.stamps_ns - self.stamps_ns[0]) * 1e-9, self.volts)
        return finder.stillness()

    def rate_hz(self) -> float:
        """Return the rate of the stamps, Hz; NaN while there are too few of them."""
        if len(self.stamps_ns) < _FEWEST_SAMPLES:
            return float('nan')
        return stamped_rate_hz((self.stamps_ns - self.stamps_ns[0]) * 1e-9)

    def _shown(self) -> np.ndarray:
        return to_nominal_mps2(self.volts[-self._show:], self._sensor)


class Readings:
    """Readings of one quantity over time."""

    def __init__(self) -> None:
        self._stamps_ns: deque[int] = deque(maxlen=_KEPT_READINGS)
        self._values: deque[float] = deque(maxlen=_KEPT_READINGS)

    def add(self, stamp_ns: int, value: float) -> None:
        """Take a reading; one that is not finite is left out."""
        if not np.isfinite(value):
            return
        if self._stamps_ns and stamp_ns < self._stamps_ns[-1]:
            self._stamps_ns.clear()
            self._values.clear()
        self._stamps_ns.append(stamp_ns)
        self._values.append(value)

    def mean(self, first_ns: int, last_ns: int) -> float:
        """Average the readings between two stamps, or return the last reading before."""
        begin = bisect_left(self._stamps_ns, first_ns)
        end = bisect_right(self._stamps_ns, last_ns)
        if begin == end and end and first_ns - self._stamps_ns[end - 1] < STALE_NS:
            begin = end - 1
        if begin == end:
            return float('nan')
        return float(np.mean([self._values[i] for i in range(begin, end)]))


class Surroundings:
    """Temperature and supply over time."""

    def __init__(self) -> None:
        self.temperature_c = Readings()  # Readings of the temperature, °C
        self.supply_v = Readings()  # Readings of the supply, V
