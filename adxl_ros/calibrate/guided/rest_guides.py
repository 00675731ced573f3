# SPDX-License-Identifier: Apache-2.0

"""The guide of a hand-held sensor: samples go in, accepted rests come out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

from adxl_ros.calibrate.fits import cube_directions, gravity_fit
from adxl_ros.calibrate.fits.gravity_fit import force_g, NAMES, NINE, nominal_rests, SIX
from adxl_ros.calibrate.guided import guide, running_estimate
from adxl_ros.calibrate.guided.guide import Guide, NextPose
from adxl_ros.calibrate.guided.screen_contents import (
    EstimateRows,
    GuideStatus,
    Phase,
    ScreenRow,
    tilt_row,
)
from adxl_ros.calibrate.poses import Poses
from adxl_ros.files.sweep_journal import JournalEntry, PoseRecord
from adxl_ros.model.error_sizes import stds
from adxl_ros.model.kinematics import unit_vectors
from adxl_ros.model.noise import means_at_a_rail
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.rest_detection import RestFinder, Stillness
from adxl_ros.signals.rest_limits import datasheet_noise
from adxl_ros.signals.rest_search import RestRule
import numpy as np

ENOUGH_RESTS = 24  # Rests that are recommended; chosen: nearly all of the 26 orientations
_ENDED_NS = 1_000_000_000  # A rest is announced when the stream has gone on for longer after it
_SEARCH_PERIOD_NS = 500_000_000
"""Shortest time between two searches for rests, ns: each one looks at the whole stream."""
_STEPS = 3
"""Gauss-Newton steps after each rest; chosen: the estimate changes little with each rest."""
_UP_SAMPLES = 20
"""Samples whose mean shows what points up at present; chosen: quick and still steady."""
_MIN_FORCE_G = 1e-9
"""Lower bound of the measured force, g, so that a sensor without signal has a direction."""


@dataclass(frozen=True)
class GravityEstimate:
    """The gravity model by the rests so far, with the priors of the datasheet."""

    parameters: np.ndarray  # Those of `gravity_fit`, (9,)
    rows: list[ScreenRow]  # The coefficients, for the screen
    fitted: Sensor
    covered: np.ndarray  # Orientations with a rest, bool


def estimated_by_gravity(sensor: Sensor, records: Sequence[PoseRecord]) -> GravityEstimate:
    """Fit the gravity model to rests; without any, it is that of the priors."""
    mean_v = np.array([record.mean_v for record in records]).reshape(-1, 3)
    std_v = np.array([record.std_v for record in records]).reshape(-1, 3)
    rests = nominal_rests(mean_v, std_v, sensor)
    parameters = np.zeros(len(NAMES))
    if records:
        parameters = gravity_fit.regularised_fit(rests, _STEPS)
    information = gravity_fit.posterior_information(rests, parameters, gravity_fit.TRIAL_STD_G**2)
    values, to_units = gravity_fit.effect_values(parameters, sensor)
    covariance = np.linalg.inv(information) * np.outer(to_units, to_units)
    rows = running_estimate.coefficient_rows(
        NAMES,
        parameters * to_units,
        stds(covariance),
        gravity_fit.PRIOR_STD * to_units,
    )
    fitted = replace(
        sensor,
        effects=tuple(values),
        values=values,
        covariance=covariance,
        covariance_names=NAMES,
    )
    force = force_g(rests.mean, parameters)
    covered = cube_directions.covered(unit_vectors(force))
    return GravityEstimate(parameters, rows, fitted, covered)


class HandRests(Guide):
    """
    Collects the rests of a hand-held sensor, which are announced as they end.

    The noise is learned from the quietest parts of the stream, so that rests can change while it
    runs: `poses_to_fit` finds those of the complete stream once more, as `fit` does.
    """

    estimate: GravityEstimate  # By the rests so far
    next_up: int | None  # Orientation to ask for

    def __init__(
        self, sensor: Sensor, temperature_span_c: float, accepted: Sequence[PoseRecord] = ()
    ) -> None:
        super().__init__(sensor, accepted)
        self._span_c = temperature_span_c
        self._skipped = np.zeros(len(cube_directions.UP), bool)
        self.begin_stream()
        self._update_estimate()

    def begin_stream(self, back_s: float = 0.0) -> None:
        """Begin a stream: the rests so far belong to another one."""
        self._resumed = list(self.accepted.values())
        self._stamps: list[np.ndarray] = []
        self._announced_ns = self._next_search_ns = 0
        self._dropped: list[PoseRecord] = []
        rule = RestRule(datasheet_noise(self.sensor))
        self._finder = RestFinder(self.sensor.rate_hz, len(self.sensor.axes), rule)

    def take_samples(self, stamps_ns: np.ndarray, volts: np.ndarray) -> None:
        """Give samples to the search for rests."""
        self._stamps.append(stamps_ns)
        # Since the first stamp: seconds since 1970 would resolve only 0.2 µs.
        self._finder.feed((stamps_ns - self._stamps[0][0]) * 1e-9, volts)

    def accept(self) -> PoseRecord | None:
        """Return the next rest that has ended, for the journal, else None."""
        if not self._stamps or self.now_ns < self._next_search_ns:
            return None
        self._next_search_ns = self.now_ns + _SEARCH_PERIOD_NS
        for record in self._records(max(self.accepted, default=-1) + 1):
            has_ended = self.now_ns - record.stop_ns > _ENDED_NS
            if has_ended and record.start_ns > self._announced_ns:
                fault = self._fault(record)
                if not fault:
                    return record
                self._announced_ns = record.stop_ns
                self._next_search_ns = 0
                self._new_refusal = fault
                return None
        return None

    def take(self, record: PoseRecord) -> None:
        """Count a rest that is on disk."""
        self._announced_ns = record.stop_ns
        self._next_search_ns = 0
        self.accepted[record.pose] = record
        self._update_estimate()

    def capture(self) -> str:
        """Return that nothing needs a capture."""
        return 'nothing to capture: hold the sensor still, and each rest is taken by itself'

    def skip(self, append: Callable[[JournalEntry], None]) -> str:
        """Ask for another direction; return a line for people."""
        if self.next_up is None:
            return 'there is no direction left to skip'
        self._skipped[self.next_up] = True
        skipped = cube_directions.points_up(self.next_up)
        self._choose_next()
        return f'the direction in which {skipped} is left out'

    def forget(self, number: int) -> str:
        """Leave a rest out of the fit; return a line for people."""
        record = self.accepted.pop(number)
        if record in self._resumed:
            self._resumed.remove(record)
        else:
            self._dropped.append(record)
        self._update_estimate()
        return f'rest {number + 1} is forgotten; hold the sensor in that direction again'

    def poses_to_fit(self) -> list[PoseRecord]:
        """Return the rests of the interrupted calibration, and all rests of this stream."""
        kept = [
            record
            for record in self._records(0)
            if not self._fault(record)
            and not any(
                record.start_ns <= other.stop_ns and other.start_ns <= record.stop_ns
                for other in self._dropped
            )
        ]
        return [
            *self._resumed,
            *(
                replace(record, pose=number)
                for number, record in enumerate(kept, len(self._resumed))
            ),
        ]

    def stillness(self) -> Stillness | None:
        """Return whether the newest samples are at rest, by the noise that the stream shows."""
        return self._finder.stillness()

    def up(self) -> np.ndarray | None:
        """Return the direction that points up at present, (3,); None without samples."""
        if not len(self.newest.volts):
            return None
        mean_v = self.newest.volts[-_UP_SAMPLES:].mean(axis=0, keepdims=True)
        rests = nominal_rests(mean_v, 0 * mean_v, self.sensor)
        force = force_g(rests.mean, self.estimate.parameters)[0]
        return force / max(float(np.linalg.norm(force)), _MIN_FORCE_G)

    def _update_estimate(self) -> None:
        """Fit the rests so far, and choose the direction to ask for."""
        records = [self.accepted[number] for number in sorted(self.accepted)]
        self.estimate = estimated_by_gravity(self.sensor, records)
        self._choose_next()

    def _choose_next(self) -> None:
        is_open = ~self.estimate.covered & ~self._skipped
        self.next_up = cube_directions.next_up(is_open, self.up())

    def _fault(self, record: PoseRecord) -> str:
        """Return why a rest is refused, or ''."""
        if means_at_a_rail(self.sensor, Poses.from_records([record]).volts).any():
            return 'saturated: the ADC is at its rail in this rest; check supply and wiring'
        return guide.temperature_fault(self.accepted, record.temperature_c, self._span_c)

    def _records(self, number: int) -> Iterator[PoseRecord]:
        """Give a record of each rest of the stream, each with the same number."""
        if not self._stamps:
            return
        self._stamps = [np.concatenate(self._stamps)]
        stamps_ns = self._stamps[0]
        for rest in self._finder.rests():
            found = self._finder.means([rest])[0]
            span = int(stamps_ns[rest.start]), int(stamps_ns[rest.stop - 1])
            yield guide.with_ambient(
                PoseRecord(
                    pose=number,
                    start_ns=span[0],
                    stop_ns=span[1],
                    samples=rest.stop - rest.start,
                    mean_v=tuple(found.mean_v.tolist()),
                    std_v=tuple(found.std_v.tolist()),
                ),
                self.readings,
            )


class HandGuide(HandRests):
    """Leads through the directions of a hand-held sensor: it says which one is next."""

    def destination(self) -> str:
        """Name the direction to turn to, for people."""
        if self.next_up is None:
            return 'turn it to any direction not yet covered, and hold it still'
        return f'turn it so that {cube_directions.points_up(self.next_up)}, and hold it still'

    def next_pose(self) -> NextPose:
        """Return the direction to announce."""
        values: dict[str, str | float] = {'pose': str(self.pose_number)}
        if self.next_up is not None:
            values |= zip(('up_x', 'up_y', 'up_z'), cube_directions.UP[self.next_up].tolist())
        return NextPose(self.destination(), values, None)

    def status(self) -> GuideStatus:
        """Return what the guide waits for, with the values that matter."""
        count = len(self.accepted)
        stillness = self._finder.stillness()
        rests = f'{count} rests ({_advice(count)})'
        if stillness is None:
            return GuideStatus(Phase.REST, f'{rests}; waiting for samples')
        phase = Phase.DWELL if stillness.at_rest else Phase.REST
        return GuideStatus(
            phase, f'{rests}; {stillness.describe_mps2(self.sensor)}; {self.destination()}'
        )

    def progress(self) -> list[ScreenRow]:
        """Return direction, readings and progress, for the screen."""
        up = self.up()
        count = len(self.accepted)
        now = []
        if up is not None:
            nearest = int(np.argmax(cube_directions.UP @ up))
            now = [ScreenRow('now', f'{cube_directions.points_up(nearest)} now')]
        return [
            ScreenRow('pose', f'{self.pose_number}: {self.destination()}'),
            *now,
            *self.newest.rows(self.stillness()),
            ScreenRow(
                'poses',
                f'{count} done, {max(ENOUGH_RESTS - count, 0)} left for a good fit',
                count / ENOUGH_RESTS,
            ),
        ]

    def estimated(self) -> EstimateRows:
        """Return what the rests so far show, for the screen."""
        groups = {
            name: self.estimate.covered[axes == cube_directions.AXES_UP]
            for name, axes in (('faces', 1), ('edges', 2), ('corners', 3))
        }
        texts = [f'{name} up {group.sum()}/{len(group)}' for name, group in groups.items()]
        coverage = ScreenRow('coverage', ', '.join(texts))
        return EstimateRows([coverage, tilt_row(self.tilt_error_rad())], self.estimate.rows)

    def tilt_error_rad(self) -> float:
        """Return the expected rms error of alpha and beta by the rests so far, rad."""
        std_v = datasheet_noise(self.sensor).sigma
        if self.accepted:
            std_v = np.mean([record.std_v for record in self.accepted.values()], axis=0)
        return running_estimate.tilt_error_rad(self.estimate.fitted, std_v)


def _advice(count: int) -> str:
    """Return what so many rests determine, and how many more are needed, for people."""
    if count < SIX.min_rests:
        return f'{SIX.min_rests - count} more at least'
    if count < NINE.min_rests:
        return f'{SIX.text} only; {NINE.min_rests - count} more for the angles'
    return 'more make it better' if count < ENOUGH_RESTS else 'call finish when done'
