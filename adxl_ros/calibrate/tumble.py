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

"""The guided calibration by hand, free of ROS: samples in, rests out, no stage."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from adxl_ros.calibrate.gravity import MIN_RESTS
from adxl_ros.calibrate.recorded import known_noise
from adxl_ros.calibrate.rests import Rest, RestFinder
from adxl_ros.calibrate.sweep import State
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.sensor import Sensor
import numpy as np

_ENDED_S = 1.0
"""A rest is announced when the stream has gone on for this long after it."""
ENOUGH_RESTS = 24
_JUDGE_NS = 500_000_000
"""The whole stream is judged anew no more often than this: it costs more as it grows."""


class Tumble:
    """
    Collects rests of a sensor that is turned by hand.

    The noise of the unit is learned from its quietest stretches, so that what counts as a rest
    can change while the stream runs: rests are announced as they end, and `results` judges the
    whole stream once more, as `fit` does with a recording.

    Parameters
    ----------
    sensor
        The nominal sensor of the stream.
    done
        How many rests an interrupted calibration has left.

    """

    target = None

    def __init__(self, sensor: Sensor, done: int):
        self.index = done
        self._sensor = sensor
        self._resumed = done
        self._stamps: list[np.ndarray] = []
        self._said_ns = self._judge_ns = 0
        self._finder = RestFinder(sensor.rate_hz, len(sensor.axes), known_noise(sensor),
                                  learn=True)

    def feed(self, stamps_ns: np.ndarray, volts: np.ndarray) -> None:
        """Take samples: stamps, ns, (n,), and volts, (n, m)."""
        if not len(stamps_ns):
            return
        self._stamps.append(stamps_ns)
        self._finder.feed(self._time_s(stamps_ns), volts)

    def accept(self) -> dict[str, Any] | None:
        """Return the next rest that has ended, for the journal, else None."""
        if not self._stamps or self._stamps[-1][-1] < self._judge_ns:
            return None
        stamps = self._all_stamps()
        self._judge_ns = int(stamps[-1]) + _JUDGE_NS
        for rest in self._finder.rests():
            entry = self._entry(self.index, rest, stamps)
            ended = (stamps[-1] - entry['stop_ns']) * 1e-9 > _ENDED_S
            if ended and entry['start_ns'] > self._said_ns:
                self._said_ns = entry['stop_ns']
                self._judge_ns = 0
                return entry
        return None

    def move(self, index: int) -> None:
        """Count on from that number of rests."""
        self.index = index

    def results(self, accepted: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
        """Return the rests to fit: those resumed, and all of this stream judged as a whole."""
        entries = list(accepted[:self._resumed])
        if self._stamps:
            stamps = self._all_stamps()
            entries += [self._entry(self._resumed + i, rest, stamps)
                        for i, rest in enumerate(self._finder.rests())]
        return entries

    def state(self) -> State:
        """Say what is waited for, and by how much it is off."""
        count = self.index
        need = f'{max(MIN_RESTS - count, 0)} more at least' if count < MIN_RESTS else \
            'call finish when done' if count >= ENOUGH_RESTS else 'more make it better'
        still = self._finder.stillness()
        if still is None:
            return State('rest', f'{count} rests ({need}); waiting for samples', False)
        unit = G0_MPS2 / float(self._sensor.nominal_scale_v_per_g[still.axis])
        text = still.describe('m/s²', unit, self._sensor.axes)
        if still.still:
            return State('dwell', f'{count} rests ({need}); {text}; hold, then turn on', False)
        return State('rest', f'{count} rests ({need}); {text}', False)

    def _time_s(self, stamps_ns: np.ndarray) -> np.ndarray:
        # From the first stamp: float64 seconds since 1970 resolve only 0.2 µs.
        return (stamps_ns - self._stamps[0][0]) * 1e-9

    def _all_stamps(self) -> np.ndarray:
        self._stamps = [np.concatenate(self._stamps)]
        return self._stamps[0]

    def _entry(self, number: int, rest: Rest, stamps: np.ndarray) -> dict[str, Any]:
        mean, std = self._finder.means([rest])
        return {'pose': number, 'start_ns': int(stamps[rest.start]),
                'stop_ns': int(stamps[rest.stop - 1]), 'samples': rest.stop - rest.start,
                'mean_v': mean[0].tolist(), 'std_v': std[0].tolist()}
