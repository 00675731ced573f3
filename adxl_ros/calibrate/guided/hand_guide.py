# SPDX-License-Identifier: Apache-2.0

"""The guide of a hand-held sensor: samples go in, accepted rests come out."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace

from adxl_ros.calibrate.fits import gravity_model
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
from adxl_ros.calibrate.guided import pose_checks, pose_plan, running_estimate
from adxl_ros.calibrate.guided.guide import NewestSamples, NextPose, StagelessGuide, went_back
from adxl_ros.calibrate.guided.screen_contents import Estimate, Phase, Progress, Status
from adxl_ros.files.sweep_journal import PoseRecord
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.rest_detection import datasheet_noise, Rest, RestFinder, Stillness
import numpy as np

ENOUGH_RESTS = 24
"""Rests that are recommended; chosen: nearly all of the 26 orientations."""
_ENDED_S = 1.0
"""A rest is announced when the stream has gone on for this long after it, s."""
_SEARCH_PERIOD_NS = 500_000_000
"""Shortest time between two searches for rests, ns: each one looks at the whole stream."""
_STEPS = 3
"""Gauss-Newton steps after each rest; chosen: the estimate changes little with each rest."""
_MOST_SATURATED = 0.01
"""Largest share of a rest's samples at a rail; chosen: a knock does not spoil the mean."""
_UP_SAMPLES = 20
"""Samples whose mean shows what points up at present; chosen: quick and still steady."""
_MIN_FORCE_G = 1e-9
"""Lower bound of the measured force, g, so that a sensor without signal has a direction."""


@dataclass(frozen=True)
class _Interval:
    """Stamps of the first and the last sample of a rest, ns."""

    first_ns: int
    last_ns: int

    def overlaps(self, record: PoseRecord) -> bool:
        """Return whether a rest shares a sample with this one."""
        return self.first_ns <= record.stop_ns and record.start_ns <= self.last_ns


class HandGuide(StagelessGuide):
    """
    Collects the rests of a hand-held sensor, and asks for the next direction; a `Guide`.

    The noise of the unit is learned from the quietest parts of the stream. The rests can therefore
    change while the stream runs. Rests are announced as they end. `poses_to_fit` finds
    the rests of the complete stream once more, as `fit` does with a recording.
    """

    is_over = False

    def __init__(self, sensor: Sensor, temperature_span_c: float,
                 accepted: Sequence[PoseRecord] = ()) -> None:
        super().__init__(sensor, accepted)
        self._span_c = temperature_span_c
        self._skipped = np.zeros(len(gravity_model.UP), bool)
        self._begin_stream()
        self._update_estimate()

    def _begin_stream(self) -> None:
        """Begin a stream: the rests so far belong to another one."""
        self._resumed = list(self.accepted.values())
        self._stamps: list[np.ndarray] = []
        self._newest = NewestSamples(self.sensor)
        self._announced_ns = self._next_search_ns = 0
        self._dropped: list[_Interval] = []
        self._saturated_ns: list[int] = []
        self._finder = RestFinder(
            self.sensor.rate_hz, len(self.sensor.axes), datasheet_noise(self.sensor), learn=True)

    def feed(self, stamps_ns: np.ndarray, volts: np.ndarray) -> None:
        """
        Take samples.

        stamps_ns: their stamps, ns, (n,); volts: the samples, V, (n, m).
        """
        if not len(stamps_ns):
            return
        if self.newest_ns is not None and went_back(self.newest_ns, stamps_ns[0]):
            self._begin_stream()
        self.newest_ns = int(stamps_ns[-1])
        self._stamps.append(stamps_ns)
        self._newest.feed(stamps_ns, volts)
        self._saturated_ns += stamps_ns[self.sensor.saturated(volts).any(axis=1)].tolist()
        self._finder.feed(self._time_s(stamps_ns), volts)

    def accept(self) -> PoseRecord | None:
        """Return the next rest that has ended, for the journal, else None."""
        if not self._stamps or self._stamps[-1][-1] < self._next_search_ns:
            return None
        stamps = self._all_stamps()
        self._next_search_ns = int(stamps[-1]) + _SEARCH_PERIOD_NS
        for rest in self._finder.rests():
            record = self._record(self.next_number, rest, stamps)
            has_ended = (stamps[-1] - record.stop_ns) * 1e-9 > _ENDED_S
            if has_ended and record.start_ns > self._announced_ns:
                self._announced_ns = record.stop_ns
                self._next_search_ns = 0
                self._new_refusal = self._fault(record)
                return None if self._new_refusal else record
        return None

    def take(self, record: PoseRecord) -> None:
        """Count a rest that is on disk."""
        self.accepted[record.pose] = record
        self._update_estimate()

    def retry(self) -> None:
        """Announce the newest rest once more, since its record is not on disk."""
        resumed = {record.pose for record in self._resumed}
        self._announced_ns = max((record.stop_ns for number, record in self.accepted.items()
                                  if number not in resumed), default=0)
        self._next_search_ns = (self.newest_ns or 0) + 2 * _SEARCH_PERIOD_NS

    def capture(self) -> str:
        """Return that nothing needs a capture."""
        return 'nothing to capture: hold the sensor still, and each rest is taken by itself'

    def skip(self) -> str:
        """Ask for another direction; return a line for people."""
        if self.next_up is None:
            return 'there is no direction left to skip'
        self._skipped[self.next_up] = True
        skipped = gravity_model.name_up(self.next_up)
        self._choose_next_up()
        return f'{skipped} up is left out'

    def redo(self) -> str:
        """Forget the newest rest; return a line for people, or '' where there is none."""
        number = self.previous
        if number is None:
            return ''
        self.drop(self.accepted[number])
        return f'rest {number + 1} is forgotten; hold the sensor in that direction again'

    def drop(self, record: PoseRecord) -> None:
        """Leave a rest out of the fit."""
        del self.accepted[record.pose]
        resumed = [other for other in self._resumed if other.pose != record.pose]
        if len(resumed) == len(self._resumed):
            self._dropped.append(_Interval(record.start_ns, record.stop_ns))
        self._resumed = resumed
        self._update_estimate()

    def poses_to_fit(self) -> list[PoseRecord]:
        """Return the rests of the interrupted calibration, and all rests of this stream."""
        records = list(self._resumed)
        if not self._stamps:
            return records
        stamps = self._all_stamps()
        for rest in self._finder.rests():
            record = self._record(len(records), rest, stamps)
            is_dropped = any(interval.overlaps(record) for interval in self._dropped)
            if not is_dropped and not self._fault(record):
                records.append(record)
        return records

    def stillness(self, newest: NewestSamples) -> Stillness | None:
        """Return whether the newest samples are at rest, by the noise that the stream shows."""
        return self._finder.stillness()

    def up(self) -> np.ndarray | None:
        """Return the direction that points up at present, (3,); None without samples."""
        if not len(self._newest.volts):
            return None
        mean_v = self._newest.volts[-_UP_SAMPLES:].mean(axis=0, keepdims=True)
        rests = nominal_rests(mean_v, 0 * mean_v, self.sensor)
        force = force_g(rests.mean, self._coefficients)[0]
        return force / max(float(np.linalg.norm(force)), _MIN_FORCE_G)

    def destination(self) -> str:
        """Name the direction to turn to, for people."""
        if self.next_up is None:
            return 'turn it to any direction not yet covered, and hold it still'
        direction = gravity_model.points_up(gravity_model.name_up(self.next_up))
        return f'turn it so that {direction}, and hold it still'

    def next_pose(self) -> NextPose:
        """Return the direction to announce."""
        values: dict[str, str | float] = {'pose': str(self.pose_number)}
        if self.next_up is not None:
            up_x, up_y, up_z = map(float, gravity_model.UP[self.next_up])
            values |= {'up_x': up_x, 'up_y': up_y, 'up_z': up_z}
        return NextPose(self.destination(), values, None)

    def status(self) -> Status:
        """Return what the guide waits for, with the values that matter."""
        rests = f'{len(self.accepted)} rests ({self._advice()})'
        stillness = self._finder.stillness()
        if stillness is None:
            return Status(Phase.REST, f'{rests}; waiting for samples', False)
        phase = Phase.DWELL if stillness.at_rest else Phase.REST
        return Status(phase, f'{rests}; {stillness.describe_mps2(self.sensor)}; '
                      f'{self.destination()}', False)

    def _advice(self) -> str:
        """Return how many rests are still needed, for people."""
        count = len(self.accepted)
        if count < MIN_RESTS:
            return f'{MIN_RESTS - count} more at least'
        return 'more make it better' if count < ENOUGH_RESTS else 'call finish when done'

    def progress(self) -> Progress:
        """Return the progress of the calibration, for the screen."""
        up = self.up()
        position = '' if up is None else \
            f'{gravity_model.points_up(gravity_model.name_nearest(up))} now'
        return Progress(
            number=self.pose_number, destination=self.destination(), position=position,
            accepted=len(self.accepted), total=ENOUGH_RESTS, skipped=0,
            open_poses=self.open_poses, remaining_s=None, dwelt_s=None, dwell_s=None)

    def estimate_contents(self) -> Estimate:
        """Return what the rests determine so far, for the screen."""
        return Estimate(
            coverage=pose_plan.by_orientation(self._covered),
            covered_faces=pose_plan.faces(self._covered), coefficients=self._rows,
            tilt_error_deg=running_estimate.degrees_or_none(self.tilt_error_rad()),
            final_tilt_error_deg=None)

    def values(self) -> dict[str, str | float]:
        """Return no further values for programs."""
        return {}

    def tilt_error_rad(self) -> float:
        """Return the expected rms error of alpha and beta by the rests so far, rad."""
        std_v = np.mean([record.std_v for record in self.accepted.values()] or
                        [tuple(datasheet_noise(self.sensor).sigma)], axis=0)
        return running_estimate.tilt_error_rad(self._fitted, std_v)

    def _update_estimate(self) -> None:
        """Fit the gravity model to the rests so far, with the priors of the datasheet."""
        records = self._accepted_records()
        mean_v = np.array([record.mean_v for record in records]).reshape(-1, 3)
        std_v = np.array([record.std_v for record in records]).reshape(-1, 3)
        rests = nominal_rests(mean_v, std_v, self.sensor)
        self._coefficients = np.zeros(len(NAMES))
        if records:
            self._coefficients = regularised_fit(rests, self._coefficients, _STEPS)
        information = posterior_information(rests, self._coefficients, TRIAL_STD_G ** 2)
        values, to_units = effect_values(self._coefficients, self.sensor)
        covariance = np.linalg.inv(information) * np.outer(to_units, to_units)
        self._rows = running_estimate.coefficient_rows(
            NAMES, self._coefficients * to_units, np.sqrt(np.diag(covariance)),
            PRIOR_STD * to_units)
        self._fitted = replace(self.sensor, effects=tuple(values), values=values,
                               covariance=covariance, covariance_names=NAMES)
        force = force_g(rests.mean, self._coefficients)
        self._covered = gravity_model.covered(force / np.linalg.norm(force, axis=1, keepdims=True))
        self._gain = gravity_model.information_gain(information, self._coefficients,
                                                    rests.gravity_g).gain
        self._choose_next_up()

    def _choose_next_up(self) -> None:
        """Choose the orientation to ask for."""
        available = ~self._covered & ~self._skipped
        self.next_up = gravity_model.next_up(self._gain, available, self.up())

    def _fault(self, record: PoseRecord) -> str:
        """Return why a rest is refused, or ''."""
        saturated = (bisect_right(self._saturated_ns, record.stop_ns)
                     - bisect_left(self._saturated_ns, record.start_ns))
        if saturated > _MOST_SATURATED * record.samples:
            return self._saturated('rest')
        first_c = next((accepted.temperature_c for accepted in self.accepted.values()
                        if np.isfinite(accepted.temperature_c)), np.nan)
        return pose_checks.temperature_fault(first_c, record.temperature_c, self._span_c)

    def _time_s(self, stamps_ns: np.ndarray) -> np.ndarray:
        """Return times since the first stamp, s: since 1970 they would resolve only 0.2 µs."""
        return (stamps_ns - self._stamps[0][0]) * 1e-9

    def _all_stamps(self) -> np.ndarray:
        self._stamps = [np.concatenate(self._stamps)]
        return self._stamps[0]

    def _record(self, number: int, rest: Rest, stamps_ns: np.ndarray) -> PoseRecord:
        mean_v, std_v = self._finder.means([rest])
        span = int(stamps_ns[rest.start]), int(stamps_ns[rest.stop - 1])
        return PoseRecord(
            pose=number, start_ns=span[0], stop_ns=span[1], samples=rest.stop - rest.start,
            mean_v=tuple(mean_v[0].tolist()), std_v=tuple(std_v[0].tolist()),
            temperature_c=self.surroundings.temperature_c.mean(*span),
            supply_v=self.surroundings.supply_v.mean(*span))
