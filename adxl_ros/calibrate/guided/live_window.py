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

"""What arrives while a calibration runs, beside the poses: the newest samples, surroundings."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import deque

from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from adxl_ros.signals.noise_limits import datasheet_noise
from adxl_ros.signals.rest_detection import RestFinder, Stillness
import numpy as np

_JUDGED_S, _SHOWN_S = 1.2, 0.5
_SAMPLES = 20
_BACK_NS = 1_000_000_000
STALE_NS = 60_000_000_000
"""A temperature or supply that is stamped so far from the samples is not theirs."""


def went_back(newest_ns: int, stamp_ns: int) -> bool:
    """Tell whether stamps go back: a driver that was started anew, or a clock that was set."""
    return stamp_ns < newest_ns - _BACK_NS


class Newest:
    """The newest second of a stream, and at least twenty samples."""

    def __init__(self, sensor: Sensor) -> None:
        self._sensor = sensor
        self._keep, self._show = (max(round(seconds * sensor.rate_hz), _SAMPLES)
                                  for seconds in (_JUDGED_S, _SHOWN_S))
        self.stamps_ns = np.zeros(0, np.int64)
        self.volts = np.zeros((0, len(sensor.axes)))

    def feed(self, stamps_ns: np.ndarray, volts: np.ndarray) -> None:
        """Take samples: stamps, ns, (n,), and volts, (n, m)."""
        self.stamps_ns = np.concatenate([self.stamps_ns, stamps_ns])[-self._keep:]
        self.volts = np.concatenate([self.volts, volts])[-self._keep:]

    def mean_mps2(self) -> list[float]:
        """Return what the axes read on average, m/s², (m,)."""
        return self._shown().mean(axis=0).tolist()

    def rms_mps2(self) -> list[float]:
        """Return how they scatter about it, m/s², (m,)."""
        return self._shown().std(axis=0).tolist()

    def stillness(self) -> Stillness | None:
        """Judge by the noise of the figures whether they are at rest; None if too few."""
        finder = RestFinder(self._sensor.rate_hz, len(self._sensor.axes),
                            datasheet_noise(self._sensor), learn=False)
        if len(self.stamps_ns):
            finder.feed((self.stamps_ns - self.stamps_ns[0]) * 1e-9, self.volts)
        return finder.stillness()

    def rate_hz(self) -> float:
        """Return the rate of the stamps, Hz; NaN while there are too few of them."""
        if len(self.stamps_ns) < _SAMPLES:
            return float('nan')
        period_ns = float(np.median(np.diff(self.stamps_ns)))
        return 1e9 / period_ns if period_ns > 0 else float('nan')

    def _shown(self) -> np.ndarray:
        return to_nominal_mps2(self.volts[-self._show:], self._sensor)


class Surroundings:
    """Temperature and supply over time."""

    def __init__(self) -> None:
        self._kept: dict[str, tuple[deque[int], deque[float]]] = {}

    def add(self, name: str, stamp_ns: int, value: float) -> None:
        """Take a reading of `temperature_c` or `supply_v`; what is not finite is left out."""
        if np.isfinite(value):
            stamps, values = self._kept.setdefault(name, (deque(maxlen=100_000),
                                                          deque(maxlen=100_000)))
            if stamps and stamp_ns < stamps[-1]:
                stamps.clear()
                values.clear()
            stamps.append(stamp_ns)
            values.append(value)

    def means(self, first_ns: int, last_ns: int) -> dict[str, float]:
        """Average what was read between two stamps, or else the last reading before, by name."""
        found = {}
        for name, (stamps, values) in self._kept.items():
            begin, end = bisect_left(stamps, first_ns), bisect_right(stamps, last_ns)
            if begin == end and end and first_ns - stamps[end - 1] < STALE_NS:
                begin = end - 1
            if begin < end:
                found[name] = float(np.mean([values[i] for i in range(begin, end)]))
        return found
