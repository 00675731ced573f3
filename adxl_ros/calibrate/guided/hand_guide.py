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

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import replace

from adxl_ros.calibrate.fits import orientations
from adxl_ros.calibrate.fits.gravity_fit import MIN_RESTS
from adxl_ros.calibrate.fits.gravity_model import (
    effect_values,
    force_g,
    NAMES,
    nominal_rests,
    posterior_information,
    PRIOR_STD,
    regularised_fit,
    TRIAL_STD_G,
)
from adxl_ros.calibrate.guided import pose_checks, running_estimate
from adxl_ros.calibrate.guided.capture_settings import State
from adxl_ros.calibrate.guided.live_window import Newest, Surroundings, went_back
from adxl_ros.files.sweep_journal import PoseRecord
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.noise_limits import datasheet_noise
from adxl_ros.signals.rest_detection import Rest, RestFinder, Stillness
import numpy as np

_ENDED_S = 1.0
"""A rest is announced when the stream has gone on for this long after it."""
ENOUGH_RESTS = 24
_JUDGE_NS = 500_000_000
"""The whole stream is judged anew no more often than this: it costs more as it grows."""
_STEPS = 3
_SHARE = 0.01
_NOW = 20


class Tumble:
    """
    Collects rests of a sensor that is turned by hand, and says where to turn it next.

    The noise of the unit is learned from its quietest stretches, so that what counts as a rest
    can change while the stream runs: rests are announced as they end, and `results` judges the
    whole stream once more, as `fit` does with a recording.

    Parameters
    ----------
    sensor
        The nominal sensor of the stream, of three axes.
    temperature_span_c
        How far the temperature may be from that of the first rest.
    accepted
        Rests that an interrupted calibration has left.

    """

    def __init__(self, sensor: Sensor, temperature_span_c: float,
                 accepted: Sequence[PoseRecord] = ()):
        self.sensor = sensor
        self.accepted = {record.pose: record for record in accepted}
        self.surroundings = Surroundings()
        self.newest_ns: int | None = None
        self._span_c = temperature_span_c
        self._passed = np.zeros(len(orientations.UP), bool)
        self._unsaid = ''
        self._begin()
        self._learn()

    def _begin(self) -> None:
        """Begin to listen: what is accepted so far is of another stream."""
        self._resumed = list(self.accepted.values())
        self._stamps: list[np.ndarray] = []
        self._newest = Newest(self.sensor)
        self._said_ns = self._judge_ns = 0
        self._dropped: list[tuple[int, int]] = []
        self._saturated: list[int] = []
        self._finder = RestFinder(self.sensor.rate_hz, len(self.sensor.axes),
                                  datasheet_noise(self.sensor), learn=True)

    def feed(self, stamps_ns: np.ndarray, volts: np.ndarray) -> None:
        """Take samples: stamps, ns, (n,), and volts, (n, m)."""
        if not len(stamps_ns):
            return
        if self.newest_ns is not None and went_back(self.newest_ns, stamps_ns[0]):
            self._begin()
        self.newest_ns = int(stamps_ns[-1])
        self._stamps.append(stamps_ns)
        self._newest.feed(stamps_ns, volts)
        self._saturated += stamps_ns[self.sensor.saturated(volts).any(axis=1)].tolist()
        self._finder.feed(self._time_s(stamps_ns), volts)

    def accept(self) -> PoseRecord | None:
        """Return the next rest that has ended, for the journal, else None."""
        if not self._stamps or self._stamps[-1][-1] < self._judge_ns:
            return None
        stamps = self._all_stamps()
        self._judge_ns = int(stamps[-1]) + _JUDGE_NS
        for rest in self._finder.rests():
            entry = self._entry(self._number(), rest, stamps)
            ended = (stamps[-1] - entry.stop_ns) * 1e-9 > _ENDED_S
            if ended and entry.start_ns > self._said_ns:
                self._said_ns = entry.stop_ns
                self._judge_ns = 0
                self._unsaid = self._wrong(entry)
                return None if self._unsaid else entry
        return None

    def take(self, entry: PoseRecord) -> None:
        """Count a rest that is on disk."""
        self.accepted[entry.pose] = entry
        self._learn()

    def retry(self) -> None:
        """Announce the newest rest once more."""
        before = {e.pose for e in self._resumed}
        self._said_ns = max((e.stop_ns for number, e in self.accepted.items()
                             if number not in before), default=0)
        self._judge_ns = (self.newest_ns or 0) + 2 * _JUDGE_NS

    def capture(self) -> str:
        """Say that nothing needs a capture."""
        return 'nothing to capture: hold the sensor still, and each rest is taken by itself'

    def skip(self) -> str:
        """Ask for another direction; return what is done, for people."""
        if self.next_up is None:
            return 'there is no direction left to skip'
        self._passed[self.next_up] = True
        left_out = orientations.name_up(self.next_up)
        self._choose()
        return f'{left_out} up is left out'

    @property
    def before(self) -> int | None:
        """Return the number of the newest rest."""
        return max(self.accepted, default=None)

    def redo(self) -> str:
        """Forget the newest rest; return what is done, or '' where there is none."""
        number = self.before
        if number is None:
            return ''
        self.drop(self.accepted[number])
        return f'rest {number + 1} is forgotten; hold the sensor in that direction again'

    def drop(self, entry: PoseRecord) -> None:
        """Leave a rest out."""
        del self.accepted[entry.pose]
        resumed = [e for e in self._resumed if e.pose != entry.pose]
        if len(resumed) == len(self._resumed):
            self._dropped.append((entry.start_ns, entry.stop_ns))
        self._resumed = resumed
        self._learn()

    def results(self) -> list[PoseRecord]:
        """Return the rests to fit: those resumed, and all of this stream judged as a whole."""
        entries = list(self._resumed)
        if self._stamps:
            stamps = self._all_stamps()
            for rest in self._finder.rests():
                entry = self._entry(len(entries), rest, stamps)
                if not self._wrong(entry) and not any(
                        first <= entry.stop_ns and entry.start_ns <= last
                        for first, last in self._dropped):
                    entries.append(entry)
        return entries

    def refused(self) -> str:
        """Return why a rest was refused since the last call, or ''."""
        text, self._unsaid = self._unsaid, ''
        return text

    def stillness(self) -> Stillness | None:
        """Judge the newest samples."""
        return self._finder.stillness()

    def up(self) -> np.ndarray | None:
        """Return what points up at present, (3,); None without samples."""
        if not len(self._newest.volts):
            return None
        mean = self._newest.volts[-_NOW:].mean(axis=0, keepdims=True)
        force = force_g(nominal_rests(mean, 0 * mean, self.sensor).mean, self._found)[0]
        return force / max(float(np.linalg.norm(force)), 1e-9)

    def where(self) -> str:
        """Name the direction to turn to, in words."""
        if self.next_up is None:
            return 'turn it to any direction not yet covered, and hold it still'
        return f'turn it so that {orientations.points_up(orientations.name_up(self.next_up))}, ' \
               'and hold it still'

    def state(self) -> State:
        """Say what is waited for, and by how much it is off."""
        count = len(self.accepted)
        need = f'{max(MIN_RESTS - count, 0)} more at least' if count < MIN_RESTS else \
            'call finish when done' if count >= ENOUGH_RESTS else 'more make it better'
        said = f'{count} rests ({need})'
        still = self._finder.stillness()
        if still is None:
            return State('rest', f'{said}; waiting for samples', False)
        if still.still:
            return State('dwell', f'{said}; {still.describe_mps2(self.sensor)}; {self.where()}',
                         False)
        return State('rest', f'{said}; {still.describe_mps2(self.sensor)}; {self.where()}', False)

    def _learn(self) -> None:
        entries = [self.accepted[number] for number in sorted(self.accepted)]
        mean = np.array([record.mean_v for record in entries]).reshape(-1, 3)
        rests = nominal_rests(mean, np.array([record.std_v for record in entries]).reshape(-1, 3),
                         self.sensor)
        self._found = np.zeros(len(NAMES))
        if len(mean):
            self._found = regularised_fit(rests, self._found, _STEPS)
        information = posterior_information(rests, self._found, TRIAL_STD_G ** 2)
        values, to_units = effect_values(self._found, self.sensor)
        self.names, self.values, self.prior = NAMES, self._found * to_units, PRIOR_STD * to_units
        covariance = np.linalg.inv(information) * np.outer(to_units, to_units)
        self.std = np.sqrt(np.diag(covariance))
        self._fitted = replace(self.sensor, effects=tuple(values), values=values,
                               covariance=covariance, covariance_names=NAMES)
        force = force_g(rests.mean, self._found)
        self.covered = orientations.covered(force / np.linalg.norm(force, axis=1, keepdims=True))
        self._told = orientations.information_gain(information, self._found, rests.gravity_g)[0]
        self._choose()

    def tilt_error_rad(self) -> float:
        """Return the rms error of alpha and beta to expect after the rests so far, rad."""
        std_v = np.mean([e.std_v for e in self.accepted.values()] or
                        [tuple(datasheet_noise(self.sensor).sigma)], axis=0)
        return running_estimate.tilt_error_rad(self._fitted, std_v)

    def _choose(self) -> None:
        self.next_up = orientations.next_up(self._told, ~self.covered & ~self._passed, self.up())

    def _wrong(self, entry: PoseRecord) -> str:
        first = next((record.temperature_c for record in self.accepted.values()
                      if np.isfinite(record.temperature_c)), np.nan)
        # A knock at the rail that leaves the rest as it was is left out of the mean.
        at_rail = _SHARE * entry.samples < (bisect_right(self._saturated, entry.stop_ns)
                                               - bisect_left(self._saturated, entry.start_ns))
        return ('saturated: samples of the rest are beyond the range of '
                f'±{self.sensor.range_g:g} g or at a rail of the ADC; check supply and wiring'
                if at_rail else pose_checks.temperature(first, entry.temperature_c, self._span_c))

    def _number(self) -> int:
        return max(self.accepted, default=-1) + 1

    def _time_s(self, stamps_ns: np.ndarray) -> np.ndarray:
        # From the first stamp: float64 seconds since 1970 resolve only 0.2 µs.
        return (stamps_ns - self._stamps[0][0]) * 1e-9

    def _all_stamps(self) -> np.ndarray:
        self._stamps = [np.concatenate(self._stamps)]
        return self._stamps[0]

    def _entry(self, number: int, rest: Rest, stamps: np.ndarray) -> PoseRecord:
        mean, std = self._finder.means([rest])
        span = int(stamps[rest.start]), int(stamps[rest.stop - 1])
        return PoseRecord(
            pose=number, start_ns=span[0], stop_ns=span[1], samples=rest.stop - rest.start,
            mean_v=tuple(mean[0].tolist()), std_v=tuple(std[0].tolist()),
            temperature_c=self.surroundings.temperature_c.mean(*span),
            supply_v=self.surroundings.supply_v.mean(*span))
