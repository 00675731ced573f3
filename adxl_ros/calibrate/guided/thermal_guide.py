# SPDX-License-Identifier: Apache-2.0

"""The guide of a sensor that rests while it warms and cools: samples in, blocks out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
import math

from adxl_ros.calibrate.fits import thermal_fit
from adxl_ros.calibrate.fits.thermal_fit import PARTS
from adxl_ros.calibrate.guided import running_estimate, screen_contents
from adxl_ros.calibrate.guided.guide import Dwell, Guide, NextPose, went_back
from adxl_ros.calibrate.guided.screen_contents import CoefficientRow, Coverage, Phase, Status
from adxl_ros.calibrate.poses import Poses
from adxl_ros.errors import UserError
from adxl_ros.files.sweep_journal import JournalEntry, PoseRecord
from adxl_ros.model.coefficients import parameter_of
from adxl_ros.model.sensor import Sensor
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

    def __init__(self, sensor: Sensor, base: Sensor, settings: ThermalSettings,
                 accepted: Sequence[PoseRecord] = ()) -> None:
        super().__init__(sensor, accepted)
        self._base, self._settings = base, settings
        self._dwell: Dwell | None = None
        self._update()

    def feed(self, stamps_ns: np.ndarray, volts: np.ndarray) -> None:
        """Take samples: their stamps, ns, (n,), and volts, (n, m)."""
        if not len(stamps_ns):
            return
        if self._dwell is None or went_back(self.newest_ns, int(stamps_ns[0])):
            self._dwell = Dwell(self.sensor, int(stamps_ns[0]))
        self.newest_ns = int(stamps_ns[-1])
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
        record = self.with_ambient(
            dwell.record(max(self.accepted, default=-1) + 1, rest, samples))
        self.refuse('no temperature: nothing on the topic temperature; publish the reading of a '
                    'thermometer at the sensor' if not math.isfinite(record.temperature_c) else
                    self.saturated_text('block') if self.sensor.saturated(
                        dwell.volts(rest)[:samples]).any() else '')
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
        return '' if self._passed.complete else \
            'nothing to skip: finish ends the calibration before the range is covered'

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
        return None if self._passed.complete else \
            NextPose(self.destination(), self.values(), None)

    def values(self) -> dict[str, str | float]:
        """Return span, coverage and expected error for programs, by key."""
        low_c, high_c = self._settings.range_c
        values: dict[str, str | float] = {
            'range_c': f'{low_c:g} to {high_c:g}',
            'warming': f'{self._passed.warming.mean():.0%}',
            'cooling': f'{self._passed.cooling.mean():.0%}'}
        if self.accepted:
            values['span_c'] = f'{self._blocks_c.min():.1f} to {self._blocks_c.max():.1f}'
        if self._error_mg is not None:
            values['expected_error_mg'] = self._error_mg
        return values

    def status(self) -> Status:
        """Return what the guide waits for, with the values that matter."""
        if self.refusal:
            return Status(Phase.REFUSED, self.refusal, True)
        if self._passed.complete:
            return Status(Phase.DONE, self.destination(), False)
        at_rest = self._dwell is not None and self._dwell.at_rest()
        text, values = f'{len(self.accepted)} blocks; ', self.values()
        if 'span_c' in values:
            text += (f'{values["span_c"]} of {values["range_c"]} °C, warming '
                     f'{values["warming"]}, cooling {values["cooling"]}; ')
            if self._error_mg is not None:
                text += f'expected error {self._error_mg:.2g} mg; '
        if self._dwell is not None and not at_rest:
            text += 'the sensor moves; '
        return Status(Phase.DWELL if at_rest else Phase.REST, text + self.destination(), False)

    def progress(self) -> screen_contents.Progress:
        """Return the progress of the calibration, for the screen."""
        direction = 'warming' if self._passed.rises else 'cooling'
        position = f'{self._blocks_c[-1]:.1f} °C, {direction}' if self.accepted else ''
        done = int(self._passed.warming.sum() + self._passed.cooling.sum())
        return screen_contents.Progress(
            number=self.pose_number, destination=self.destination(), position=position,
            accepted=done, total=2 * PARTS)

    def estimate_contents(self) -> screen_contents.Estimate:
        """Return what the blocks determine so far, for the screen."""
        fit, (low_c, high_c) = self._fit, self._settings.range_c
        rows: tuple[CoefficientRow, ...] = ()
        if fit is not None:
            prior = [thermal_fit.PRIOR_WIDTH * parameter_of(name).scale for name in fit.names]
            rows = running_estimate.coefficient_rows(
                fit.names, fit.values, np.sqrt(np.diag(fit.covariance)), np.array(prior))
        error = f'not known yet over {low_c:g} to {high_c:g} °C' if self._error_mg is None else \
            (f'zero-g {self._error_mg:.2g} mg expected over {low_c:g} to {high_c:g} °C, after '
             f'{self._blocks_c.min():.1f} to {self._blocks_c.max():.1f} °C')
        return screen_contents.Estimate(
            coverage=(Coverage('warming', int(self._passed.warming.sum()), PARTS),
                      Coverage('cooling', int(self._passed.cooling.sum()), PARTS)),
            coefficients=rows, range_error=error)

    def tilt_error_rad(self) -> float:
        """Return NaN: blocks in one orientation do not determine the tilt."""
        return math.nan

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
                self._base, thermal_fit.blocks_of(Poses.from_records(records)), False)
            self._error_mg = thermal_fit.expected_error_mg(
                self._fit, self._passed, thermal_fit.calibrated_temperature_c(self._base))
