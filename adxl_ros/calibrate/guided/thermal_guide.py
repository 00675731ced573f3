# SPDX-License-Identifier: Apache-2.0

"""The guide of a sensor that rests while it warms and cools: samples in, blocks out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from adxl_ros.calibrate import thermal_calibration
from adxl_ros.calibrate.fits import thermal_fit
from adxl_ros.calibrate.fits.thermal_fit import ThermalFit
from adxl_ros.calibrate.guided import running_estimate
from adxl_ros.calibrate.guided.guide import NewestSamples, NextPose, StagelessGuide, went_back
from adxl_ros.calibrate.guided.pose_checks import Dwell
from adxl_ros.calibrate.guided.screen_contents import (
    CoefficientRow,
    Coverage,
    Estimate,
    Phase,
    Progress,
    Status,
)
from adxl_ros.calibrate.poses import Poses
from adxl_ros.calibrate.thermal_calibration import expected_error_mg, PARTS, passed
from adxl_ros.errors import UserError
from adxl_ros.files.sweep_journal import PoseRecord
from adxl_ros.model.coefficients import parameter_of
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.rest_detection import Stillness
import numpy as np

_PATIENCE = 3
"""Lengths of a block without rest after which its samples are forgotten. Chosen: memory."""


@dataclass(frozen=True)
class ThermalSettings:
    """What a calibration over temperature is to cover."""

    range_c: tuple[float, float] = (0.0, 50.0)  # Lowest and highest wanted temperature, °C
    block_s: float = thermal_calibration.BLOCK_S  # Length of a block, s


class ThermalGuide(StagelessGuide):
    """Averages a resting sensor block by block while its temperature changes; a `Guide`."""

    def __init__(self, sensor: Sensor, base: Sensor, settings: ThermalSettings,
                 accepted: Sequence[PoseRecord] = ()) -> None:
        super().__init__(sensor, accepted)
        self._base, self._settings = base, settings
        self._refusal = ''
        self._begin_block()
        self._update()

    def _begin_block(self) -> None:
        """Begin a block with the next sample."""
        self._stamps: list[np.ndarray] = []
        self._volts: list[np.ndarray] = []
        self._dwell: Dwell | None = None

    @property
    def is_over(self) -> bool:
        """Return whether the wanted range is covered in both directions."""
        return self._passed.complete

    def feed(self, stamps_ns: np.ndarray, volts: np.ndarray) -> None:
        """
        Take samples.

        stamps_ns: their stamps, ns, (n,); volts: the samples, V, (n, m).
        """
        if not len(stamps_ns):
            return
        if self.newest_ns is not None and went_back(self.newest_ns, int(stamps_ns[0])):
            self._begin_block()
        self.newest_ns = int(stamps_ns[-1])
        self._stamps.append(stamps_ns)
        self._volts.append(volts)
        if self._dwell is None:
            self._dwell = Dwell(self.sensor, int(stamps_ns[0]))
        self._dwell.feed(stamps_ns, volts)

    def accept(self) -> PoseRecord | None:
        """Return the block that is complete, for the journal, else None."""
        dwell = self._dwell
        samples = max(round(self._settings.block_s * self.sensor.rate_hz), 2)
        if dwell is None or sum(map(len, self._stamps)) < samples:
            return None
        rest = next((r for r in dwell.rests() if r.stop - r.start >= samples), None)
        if rest is None:
            if sum(map(len, self._stamps)) > _PATIENCE * samples:
                self._begin_block()
            return None
        mean = dwell.mean(rest, samples)
        temperature_c = self.surroundings.temperature_c.mean(mean.start_ns, mean.stop_ns)
        self._refuse(self._fault(temperature_c, dwell.volts(rest)[:samples]))
        if self._refusal:
            self._continue_after(mean.stop_ns)
            return None
        return PoseRecord(
            pose=self.next_number, start_ns=mean.start_ns,
            stop_ns=mean.stop_ns, samples=mean.samples, mean_v=mean.mean_v, std_v=mean.std_v,
            temperature_c=temperature_c,
            supply_v=self.surroundings.supply_v.mean(mean.start_ns, mean.stop_ns))

    def _fault(self, temperature_c: float, volts: np.ndarray) -> str:
        """Return why a block is refused, or ''."""
        if not np.isfinite(temperature_c):
            return ('no temperature: nothing on the topic temperature; publish the reading of a '
                    'thermometer at the sensor')
        if self.sensor.saturated(volts).any():
            return self._saturated('block')
        return ''

    def _refuse(self, reason: str) -> None:
        """Keep a new reason for `new_refusal`."""
        if reason != self._refusal:
            self._new_refusal = reason
        self._refusal = reason

    def _continue_after(self, stop_ns: int) -> None:
        """Begin a block with the samples after a stamp."""
        stamps_ns, volts = np.concatenate(self._stamps), np.concatenate(self._volts)
        self._begin_block()
        later = stamps_ns > stop_ns
        self.feed(stamps_ns[later], volts[later])

    def take(self, record: PoseRecord) -> None:
        """Count a block that is on disk."""
        self.accepted[record.pose] = record
        self._continue_after(record.stop_ns)
        self._update()

    def retry(self) -> None:
        """Keep the samples, so that the block is offered again."""

    def capture(self) -> str:
        """Return that nothing needs a capture."""
        return 'nothing to capture: leave the sensor at rest, and each block is taken by itself'

    def skip(self) -> str:
        """Return that nothing can be left out."""
        return 'nothing to skip: finish ends the calibration before the range is covered'

    def redo(self) -> str:
        """Forget the newest block; return a line for people, or '' where there is none."""
        number = self.previous
        if number is None:
            return ''
        del self.accepted[number]
        self._update()
        return f'block {number + 1} is forgotten'

    def poses_to_fit(self) -> list[PoseRecord]:
        """Return the blocks, by number."""
        return self._accepted_records()

    def stillness(self, newest: NewestSamples) -> Stillness | None:
        """Return whether the newest samples are at rest; None while they are too few."""
        return newest.stillness()

    def destination(self) -> str:
        """Return what to do with the temperature, for people."""
        return self._passed.advice()

    def next_pose(self) -> NextPose | None:
        """Return what to announce; None once the range is covered."""
        return None if self.is_over else NextPose(self.destination(), self.values(), None)

    def values(self) -> dict[str, str | float]:
        """Return span, coverage and expected error for programs, by key."""
        low_c, high_c = self._settings.range_c
        values: dict[str, str | float] = {
            'range_c': f'{low_c:g} to {high_c:g}',
            'warming': f'{self._passed.warming.mean():.0%}',
            'cooling': f'{self._passed.cooling.mean():.0%}'}
        if self.accepted:
            temperatures_c = self._temperatures_c()
            values['span_c'] = f'{temperatures_c.min():.1f} to {temperatures_c.max():.1f}'
        if self._error_mg is not None:
            values['expected_error_mg'] = self._error_mg
        return values

    def status(self) -> Status:
        """Return what the guide waits for, with the values that matter."""
        if self._refusal:
            return Status(Phase.REFUSED, self._refusal, True)
        if self.is_over:
            return Status(Phase.DONE, self.destination(), False)
        at_rest = self._dwell is not None and self._dwell.at_rest()
        rest = '' if at_rest or self._dwell is None else 'the sensor moves; '
        return Status(Phase.DWELL if at_rest else Phase.REST,
                      f'{len(self.accepted)} blocks; {self._covered_text()}{rest}'
                      f'{self.destination()}', False)

    def _covered_text(self) -> str:
        """Return span and expected error, for people."""
        values = self.values()
        if 'span_c' not in values:
            return ''
        error = '' if self._error_mg is None else f'expected error {self._error_mg:.2g} mg; '
        return (f'{values["span_c"]} of {values["range_c"]} °C, warming {values["warming"]}, '
                f'cooling {values["cooling"]}; {error}')

    def progress(self) -> Progress:
        """Return the progress of the calibration, for the screen."""
        position = ''
        if self.accepted:
            direction = 'warming' if self._passed.rises else 'cooling'
            position = f'{self._temperatures_c()[-1]:.1f} °C, {direction}'
        done = int(self._passed.warming.sum() + self._passed.cooling.sum())
        return Progress(
            number=self.pose_number, destination=self.destination(), position=position,
            accepted=done, total=2 * PARTS, skipped=0, open_poses=self.open_poses,
            remaining_s=None, dwelt_s=None, dwell_s=None)

    def estimate_contents(self) -> Estimate:
        """Return what the blocks determine so far, for the screen."""
        coverage = (Coverage('warming', int(self._passed.warming.sum()), PARTS),
                    Coverage('cooling', int(self._passed.cooling.sum()), PARTS))
        rows: tuple[CoefficientRow, ...] = ()
        if self._fit is not None:
            prior = np.array([thermal_fit.PRIOR_WIDTH * parameter_of(name).scale
                              for name in self._fit.names])
            rows = running_estimate.coefficient_rows(
                self._fit.names, self._fit.values, np.sqrt(np.diag(self._fit.covariance)), prior)
        return Estimate(coverage=coverage, covered_faces='', coefficients=rows,
                        tilt_error_deg=None, final_tilt_error_deg=None,
                        range_error=self._range_error())

    def _range_error(self) -> str:
        """Return the expected error over the wanted range, for people."""
        low_c, high_c = self._settings.range_c
        if self._error_mg is None:
            return f'not known yet over {low_c:g} to {high_c:g} °C'
        span_c = self._temperatures_c()
        return (f'zero-g {self._error_mg:.2g} mg expected over {low_c:g} to {high_c:g} °C, after '
                f'{span_c.min():.1f} to {span_c.max():.1f} °C')

    def tilt_error_rad(self) -> float:
        """Return NaN: blocks in one orientation do not determine the tilt."""
        return float('nan')

    def _temperatures_c(self) -> np.ndarray:
        """Return the temperatures of the blocks in the order of time, °C, (k,)."""
        return np.array([record.temperature_c for record in self.poses_to_fit()])

    def _update(self) -> None:
        """Bring coverage, fit and expected error up to date."""
        self._passed = passed(self._temperatures_c(), self._settings.range_c)
        self._fit: ThermalFit | None = None
        self._error_mg: float | None = None
        if not self.accepted:
            return
        poses = Poses.from_records(self.poses_to_fit())
        try:
            self._fit = thermal_fit.fit(self._base, thermal_calibration.blocks_of(poses), False)
        except UserError:
            return
        self._error_mg = expected_error_mg(
            self._fit, self._passed, thermal_calibration.calibrated_temperature_c(self._base))
