# SPDX-License-Identifier: Apache-2.0

"""The guides of a sensor that no stage carries: samples go in, accepted rests come out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
import math

from adxl_ros.calibrate.fits import cube_directions, gravity_fit, thermal_fit
from adxl_ros.calibrate.fits.gravity_fit import force_g, NAMES, NINE, nominal_rests, SIX
from adxl_ros.calibrate.fits.thermal_fit import PARTS
from adxl_ros.calibrate.guided import guide, pose_plan, running_estimate
from adxl_ros.calibrate.guided.guide import Dwell, Guide, NextPose
from adxl_ros.calibrate.guided.screen_contents import (
    EstimateRows,
    GuideStatus,
    Phase,
    ScreenRow,
    tilt_row,
)
from adxl_ros.calibrate.poses import Poses
from adxl_ros.errors import UserError
from adxl_ros.files.sweep_journal import JournalEntry, PoseRecord
from adxl_ros.model.noise import means_at_a_rail
from adxl_ros.model.sensor import parameter_of, Sensor
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
        np.sqrt(np.diag(covariance)),
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
    up = force / np.linalg.norm(force, axis=1, keepdims=True)
    return GravityEstimate(parameters, rows, fitted, cube_directions.covered(up))


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
        if not self._stamps or (self.newest_ns or 0) < self._next_search_ns:
            return None
        self._next_search_ns = (self.newest_ns or 0) + _SEARCH_PERIOD_NS
        for record in self._records(max(self.accepted, default=-1) + 1):
            has_ended = (self.newest_ns or 0) - record.stop_ns > _ENDED_NS
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
            return GuideStatus(Phase.REST, f'{rests}; waiting for samples', False)
        phase = Phase.DWELL if stillness.at_rest else Phase.REST
        return GuideStatus(
            phase, f'{rests}; {stillness.describe_mps2(self.sensor)}; {self.destination()}', False
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


_PATIENCE = 3
"""Lengths of a block without rest after which its samples are forgotten. Chosen: memory."""


@dataclass(frozen=True)
class ThermalSettings:
    """What a calibration over temperature is to cover."""

    range_c: tuple[float, float] = (0.0, 50.0)  # Lowest and highest wanted temperature, °C
    block_s: float = thermal_fit.BLOCK_S  # Length of a block, s


def _advice(count: int) -> str:
    """Return what so many rests determine, and how many more are needed, for people."""
    if count < SIX.min_rests:
        return f'{SIX.min_rests - count} more at least'
    if count < NINE.min_rests:
        return f'{SIX.text} only; {NINE.min_rests - count} more for the angles'
    return 'more make it better' if count < ENOUGH_RESTS else 'call finish when done'


class ThermalGuide(Guide):
    """Averages a resting sensor block by block while its temperature changes."""

    def __init__(
        self,
        sensor: Sensor,
        base: Sensor,
        settings: ThermalSettings,
        accepted: Sequence[PoseRecord] = (),
    ) -> None:
        super().__init__(sensor, accepted)
        self._base = base
        self._settings = settings
        self._dwell: Dwell | None = None
        self._update()

    def begin_stream(self, back_s: float) -> None:
        """Begin the block again."""
        self._dwell = None

    def take_samples(self, stamps_ns: np.ndarray, volts: np.ndarray) -> None:
        """Add samples to the block."""
        self._dwell = self._dwell or Dwell(self.sensor, int(stamps_ns[0]))
        self._dwell.feed(stamps_ns, volts)

    def accept(self) -> PoseRecord | None:
        """Return the block that is complete, for the journal, else None."""
        dwell = self._dwell
        samples = max(round(self._settings.block_s * self.sensor.rate_hz), 2)
        if dwell is None or len(dwell) < samples:
            return None
        rest = dwell.full_rest(samples)
        if rest is None:
            if len(dwell) > _PATIENCE * samples:
                self._dwell = None
            return None
        record = guide.with_ambient(
            dwell.record(max(self.accepted, default=-1) + 1, rest, samples), self.readings
        )
        self.refuse(
            'no temperature: nothing on the topic temperature; publish the reading of a '
            'thermometer at the sensor'
            if not math.isfinite(record.temperature_c)
            else pose_plan.saturation_fault(self.sensor, dwell.volts(rest)[:samples])
        )
        if self.refusal:
            self._dwell = dwell.after(record.stop_ns)
            return None
        return record

    def take(self, record: PoseRecord) -> None:
        """Count a block that is on disk."""
        self.accepted[record.pose] = record
        self._dwell = self._dwell and self._dwell.after(record.stop_ns)
        self._update()

    def capture(self) -> str:
        """Return that nothing needs a capture."""
        return 'nothing to capture: leave the sensor at rest, and each block is taken by itself'

    def skip(self, append: Callable[[JournalEntry], None]) -> str:
        """Return that nothing can be left out."""
        return (
            ''
            if self._passed.complete
            else 'nothing to skip: finish ends the calibration before the range is covered'
        )

    def forget(self, number: int) -> str:
        """Forget a block; return a line for people."""
        del self.accepted[number]
        self._update()
        return f'block {number + 1} is forgotten'

    def destination(self) -> str:
        """Return what to do with the temperature, for people."""
        return self._passed.advice()

    def next_pose(self) -> NextPose | None:
        """Return what to announce; None once the range is covered."""
        return None if self._passed.complete else NextPose(self.destination(), {}, None)

    def status(self) -> GuideStatus:
        """Return what the guide waits for, with the values that matter."""
        if self.refusal:
            return GuideStatus(Phase.REFUSED, self.refusal, True)
        if self._passed.complete:
            return GuideStatus(Phase.DONE, self.destination(), False)
        at_rest = self._dwell is not None and self._dwell.at_rest()
        motion = '' if at_rest or self._dwell is None else 'the sensor moves; '
        coverage, error = self._expected()
        return GuideStatus(
            Phase.DWELL if at_rest else Phase.REST,
            f'{len(self.accepted)} blocks; '
            f'{coverage.text}; {error.text}; {motion}{self.destination()}',
            False,
        )

    def progress(self) -> list[ScreenRow]:
        """Return temperature, readings and progress, for the screen."""
        passed = self._passed
        rows = [ScreenRow('pose', f'{self.pose_number}: {self.destination()}')]
        if self.accepted:
            change = 'warming' if passed.rises else 'cooling'
            rows.append(ScreenRow('now', f'{self._blocks_c[-1]:.1f} °C, {change}'))
        done = int(passed.warming.sum() + passed.cooling.sum())
        return [
            *rows,
            *self.newest.rows(self.stillness()),
            ScreenRow(
                'parts', f'{done} done, {2 * PARTS - done} left for a good fit', done / (2 * PARTS)
            ),
        ]

    def estimated(self) -> EstimateRows:
        """Return what the blocks so far show, for the screen."""
        fit = self._fit
        rows = []
        if fit is not None:
            prior = [thermal_fit.PRIOR_WIDTH * parameter_of(name).scale for name in fit.names]
            rows = running_estimate.coefficient_rows(
                fit.names, fit.values, np.sqrt(np.diag(fit.covariance)), np.array(prior)
            )
        return EstimateRows(self._expected(), rows)

    def _expected(self) -> list[ScreenRow]:
        """Return which parts are covered, and the expected error."""
        low_c, high_c = self._settings.range_c
        error = f'not known yet over {low_c:g} to {high_c:g} °C'
        if self._error_mg is not None:
            error = (
                f'zero-g {self._error_mg:.2g} mg expected over {low_c:g} to {high_c:g} °C, after '
                f'{self._blocks_c.min():.1f} to {self._blocks_c.max():.1f} °C'
            )
        return [
            ScreenRow(
                'coverage',
                f'warming {self._passed.warming.sum()}/{PARTS}, '
                f'cooling {self._passed.cooling.sum()}/{PARTS}',
            ),
            ScreenRow('error', error),
        ]

    def _update(self) -> None:
        """Bring coverage, fit and expected error up to date."""
        records = self.poses_to_fit()
        self._blocks_c = np.array([record.temperature_c for record in records])
        self._passed = thermal_fit.passed(self._blocks_c, self._settings.range_c)
        self._fit: thermal_fit.ThermalFit | None = None
        self._error_mg: float | None = None
        if not records:
            return
        with suppress(UserError):
            self._fit = thermal_fit.fit(
                self._base, Poses.from_records(records).with_temperature(), False
            )
            self._error_mg = thermal_fit.expected_error_mg(
                self._fit, self._passed, thermal_fit.calibrated_temperature_c(self._base)
            )
