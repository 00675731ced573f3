# SPDX-License-Identifier: Apache-2.0

"""The guide of a sensor that rests while its temperature changes: samples in, blocks out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
import math

from adxl_ros.calibrate.fits import thermal_fit
from adxl_ros.calibrate.fits.thermal_fit import PARTS
from adxl_ros.calibrate.guided import guide, pose_plan, running_estimate
from adxl_ros.calibrate.guided.guide import Dwell, Guide, NextPose
from adxl_ros.calibrate.guided.screen_contents import EstimateRows, GuideStatus, Phase, ScreenRow
from adxl_ros.calibrate.poses import Poses
from adxl_ros.errors import UserError
from adxl_ros.files.sweep_journal import JournalEntry, PoseRecord
from adxl_ros.model.error_sizes import stds
from adxl_ros.model.sensor import parameter_of, Sensor
import numpy as np

_PATIENCE = 3
"""Lengths of a block without rest after which its samples are forgotten. Chosen: memory."""


@dataclass(frozen=True)
class ThermalSettings:
    """What a calibration over temperature is to cover."""

    range_c: tuple[float, float] = (0.0, 50.0)  # Lowest and highest wanted temperature, °C
    block_s: float = thermal_fit.BLOCK_S  # Length of a block, s


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
            return GuideStatus(Phase.REFUSED, self.refusal, late=True)
        if self._passed.complete:
            return GuideStatus(Phase.DONE, self.destination())
        at_rest = self._dwell is not None and self._dwell.at_rest()
        motion = '' if at_rest or self._dwell is None else 'the sensor moves; '
        coverage, error = self._expected()
        return GuideStatus(
            Phase.DWELL if at_rest else Phase.REST,
            f'{len(self.accepted)} blocks; '
            f'{coverage.text}; {error.text}; {motion}{self.destination()}',
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
                fit.names, fit.values, stds(fit.covariance), np.array(prior)
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
