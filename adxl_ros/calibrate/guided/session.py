# SPDX-License-Identifier: Apache-2.0

"""A guided calibration from its first pose to its parameter file, free of ROS."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
import os
from pathlib import Path
from typing import Any

from adxl_ros.calibrate.calibration import (
    calibrate,
    calibrate_thermal,
    CalibrationResult,
    RecordedPoses,
)
from adxl_ros.calibrate.guided import pose_plan, running_estimate
from adxl_ros.calibrate.guided.rest_guides import HandGuide
from adxl_ros.calibrate.guided.screen_contents import CaptureSettings, EstimateRows, StageMode
from adxl_ros.calibrate.guided.stage_guide import StageGuide
from adxl_ros.calibrate.guided.thermal_guide import ThermalGuide, ThermalSettings
from adxl_ros.calibrate.poses import Poses
from adxl_ros.calibrate.report import page
from adxl_ros.errors import UserError
from adxl_ros.files import calibration_store, sweep_journal
from adxl_ros.files.atomic_write import make_folder, remove_unfinished
from adxl_ros.files.sweep_journal import MountingUnchecked, PoseRecord
from adxl_ros.model.constants import AXES
from adxl_ros.model.sensor import Sensor, with_axes
from adxl_ros.signals.gravity_at_rest import of_volts
import numpy as np

_SENSOR_FIELDS = (
    'serial',
    'axes',
    'rate_hz',
    'nominal_zero_g_v',
    'nominal_scale_v_per_g',
    'noise_density_g_per_rthz',
    'rc_resistance_ohm',
    'rc_capacitance_f',
    'filter_rate_hz',
    'adc_bits',
    'adc_vref_v',
    'range_g',
    'local_gravity_mps2',
    'stage_resolution_rad',
)
"""Fields of the sensor that must be the same for a calibration to be resumed."""


@dataclass(frozen=True)
class SessionSettings:
    """What a guided calibration is to do, whatever the sensor."""

    mode: str  # 'stage', 'gravity' or 'thermal'
    plan_kind: str  # Kind of the pose plan: 'full' or 'quick'
    # Planes alpha of the plan `full`, rad; empty for those that the axes of the sensor need
    planes_rad: tuple[float, ...]
    step_rad: float  # Step of beta of the plan `full`
    tilt_error_rad: float  # That the plan `quick` is to reach, rms
    check_poses: int  # Number of poses that are kept out of the fit
    capture: CaptureSettings  # How poses are taken
    output: Path  # The parameter file to write
    journal: Path  # The journal of the accepted poses
    report: str  # Folder of the report, or ''
    store: str  # Folder of the calibration store, or ''
    thermal: ThermalSettings = ThermalSettings()  # What a calibration over temperature is to cover

    @property
    def operator_captures(self) -> bool:
        """Return whether an operator turns a stage and captures."""
        return self.mode == 'stage' and self.capture.stage_mode is not StageMode.COMMANDED

    def targets(self, nominal: Sensor) -> list[pose_plan.Target]:
        """Return the poses in the order of the visit; none without a stage."""
        if self.mode != 'stage':
            return []
        if self.plan_kind == 'quick':
            return running_estimate.quick(
                nominal, self.capture.dwell_s, self.tilt_error_rad, self.check_poses
            )
        planes_rad = self.planes_rad or pose_plan.default_planes_rad(nominal.axes)
        return pose_plan.guided(planes_rad, self.step_rad, self.check_poses)

    def outlook(self, nominal: Sensor) -> str:
        """Return what is ahead, for people: the poses of a stage, or a range of temperature."""
        if self.mode == 'thermal':
            low_c, high_c = self.thermal.range_c
            return (
                f'leave it at rest from {low_c:g} to {high_c:g} °C and back; call ~/finish to '
                'end early'
            )
        targets = self.targets(nominal)
        if not targets:
            return ''
        seconds = len(targets) * (self.capture.dwell_s + pose_plan.MOVE_S)
        text = (
            f'plan {self.plan_kind}: {len(targets)} poses, about {max(round(seconds / 60), 1)} min'
        )
        error_rad = running_estimate.expected_tilt_error_rad(
            nominal, self.capture.dwell_s, targets
        )
        if not np.isfinite(error_rad):
            return text
        return f'{text}, expected tilt error {np.degrees(error_rad):.2g}°'

    def head(self, nominal: Sensor) -> dict[str, Any]:
        """Return the settings and values, by key, that an interrupted calibration must share."""
        head: dict[str, Any] = {'mode': self.mode}
        for name in _SENSOR_FIELDS:
            is_measured = name in nominal.measured
            value = getattr(nominal, name)
            head[name] = 'measured' if is_measured else np.asarray(value).tolist()
        head['sweep.temperature_span_c'] = self.capture.temperature_span_c
        if self.mode == 'gravity':
            return head
        if self.mode == 'thermal':
            return {
                **head,
                'thermal.range_c': list(self.thermal.range_c),
                'thermal.block_s': self.thermal.block_s,
            }
        return {
            **head,
            'stage.mode': self.capture.stage_mode.value,
            'stage.tolerance_rad': self.capture.tolerance_rad,
            'stage.near_deg': _degrees(self.capture.near_rad),
            'sweep.dwell_s': self.capture.dwell_s,
            'sweep.plan': self.plan_kind,
            'sweep.planes_deg': [_degrees(plane) for plane in self.planes_rad],
            'sweep.step_deg': _degrees(self.step_rad),
            'sweep.tilt_error_rad': self.tilt_error_rad,
            'sweep.check_poses': self.check_poses,
            'order': pose_plan.ORDER,
        }

    def question(self, nominal: Sensor) -> str:
        """Return the question what to do with an interrupted calibration; '' without one."""
        interrupted = sweep_journal.unfinished(self.journal, self.head(nominal))
        if interrupted is None:
            return ''
        choices = (
            f'which cannot go on: {interrupted.obstacle}. Restore the old setting (a)'
            if interrupted.obstacle
            else 'of this unit. Go on with them (y)'
        )
        return (
            f'{self.journal} holds {interrupted.poses} poses of an interrupted calibration '
            f'{choices}, or begin again (n; they are kept)?'
        )


def _degrees(angle_rad: float) -> float:
    return round(float(np.degrees(angle_rad)), 9)


class GravityError(UserError):
    """The rests do not read gravity, so that no calibration follows from them."""


class Session:
    """One calibration of one sensor: a guide, its journal, and the fit."""

    def __init__(
        self,
        nominal: Sensor,
        settings: SessionSettings,
        start_over: bool,
        base: Sensor | None = None,
    ) -> None:
        if not os.access(settings.output.parent, os.W_OK):
            raise UserError(
                f'output: {settings.output}: {settings.output.parent} is not a '
                'directory that can be written; choose another'
            )
        if settings.mode == 'gravity' and nominal.axes != AXES:
            raise UserError(
                f'mode: gravity needs the axes x, y and z, but the sensor has '
                f'{nominal.axes}; use mode:=stage'
            )
        targets = settings.targets(nominal)
        self._base = nominal
        if settings.mode == 'thermal' and base is not None and base.effects:
            # The calibrated sensor, with the nominal values of its stream.
            self._base = replace(
                with_axes(base, nominal.axes), serial=nominal.serial, rate_hz=nominal.rate_hz
            )
        self.nominal = nominal
        self.settings = settings
        self.fault = ''  # What is wrong with the samples, or ''
        self.doubt = ''  # What is wrong with the length of gravity, but by less than a unit
        # The accepted poses on disk
        self.journal = sweep_journal.Journal(settings.journal, settings.head(nominal), start_over)
        # A process that was killed while it wrote has left unfinished files.
        places = [
            *([Path(settings.report, page.PAGE)] if settings.report else []),
            settings.output,
            settings.journal,
        ]
        for place in places:
            remove_unfinished(place.parent, place.name)
        if settings.store:
            remove_unfinished(calibration_store.sensor_folder(settings.store, nominal.serial), '')
        self._fitted: list[PoseRecord] = []
        self._estimated: tuple[list[int], EstimateRows] | None = None
        entries = self.journal.entries
        accepted = sweep_journal.accepted_poses(entries)
        self.resumed = len(accepted)  # Number of the poses of an interrupted calibration
        self.stage: StageGuide | None = None
        self.guide: StageGuide | HandGuide | ThermalGuide
        if settings.mode == 'gravity':
            self.guide = HandGuide(nominal, settings.capture.temperature_span_c, accepted)
        elif settings.mode == 'thermal':
            self.guide = ThermalGuide(nominal, self._base, settings.thermal, accepted)
        else:
            self.guide = self.stage = StageGuide(
                nominal, targets, settings.capture, accepted, sweep_journal.skipped_poses(entries)
            )

    @property
    def accepted_count(self) -> int:
        """Return the number of accepted poses."""
        return len(self.guide.accepted)

    def feed(self, stamps_ns: np.ndarray, volts: np.ndarray, fault: str = '') -> str:
        """Take samples, (n,) and (n, m), and what is wrong with them; return a new fault."""
        if not len(stamps_ns) and not fault:
            return ''
        fault = fault or self.guide.feed(stamps_ns, volts)
        before = self.fault
        self.fault = fault
        return '' if before else fault

    def take_poses(self) -> Iterator[str]:
        """Take the poses that are complete."""
        unverified = len(self.guide.to_verify)
        while (record := self.guide.accept()) is not None:
            self._check_gravity([*self.guide.accepted.values(), record])
            try:
                self.journal.append(record)
            except UserError:
                if self.stage is not None:
                    self.stage.go(self.stage.course.index)
                raise
            self.guide.take(record)
            yield f'pose {record.pose + 1} is on disk'
        if unverified > len(self.guide.to_verify):
            yield 'the sensor is mounted as it was'

    def _check_gravity(self, records: Sequence[PoseRecord]) -> None:
        """Refuse rests in another unit, or without gravity, from the first one on."""
        poses = Poses.from_records(records)
        fault = of_volts(poses.volts, poses.std_v, self._base).fault
        if fault is not None and fault.is_clear:
            raise GravityError(f'imu/data_raw: {fault.live_text}')
        self.doubt = '' if fault is None else fault.live_text

    def rows(self) -> EstimateRows:
        """Return the rows of the screen, with the progress; estimated once for each pose."""
        key = [record.stop_ns for record in self.guide.accepted.values()]
        if self._estimated is None or key != self._estimated[0]:
            self._estimated = key, self.guide.estimated()
        _, estimated = self._estimated
        return estimated._replace(expected=[*self.guide.progress(), *estimated.expected])

    def finish(self) -> CalibrationResult:
        """Fit the poses so far and write the parameter file; `end` follows all other files."""
        records = self.guide.poses_to_fit()
        source = self.journal.path.name
        if not records:
            raise UserError('no pose is taken yet')
        if all(record.check for record in records):
            raise UserError(
                'only check poses are taken, which the fit does not use; take other poses, too'
            )
        poses = Poses.from_records(records)
        if self.settings.mode == 'thermal':
            range_c = self.settings.thermal.range_c
            result = calibrate_thermal(self._base, poses, source, range_c=range_c)
        else:
            recorded = RecordedPoses(source, poses)
            result = calibrate(self.nominal, [recorded])
        entries = sweep_journal.read(self.journal.path).entries
        if any(isinstance(entry, MountingUnchecked) for entry in entries):
            provenance = {
                **result.fitted.provenance,
                'mounting': 'not checked after an interruption',
            }
            result = replace(result, fitted=replace(result.fitted, provenance=provenance))
        result.save(self.settings.output)
        self._fitted = records
        return result

    def write_report(self, result: CalibrationResult) -> None:
        """Write the report if one is asked for."""
        if self.settings.report:
            page.write(make_folder(self.settings.report), result, self.settings.store)

    def end(self) -> None:
        """Note in the journal that the fit is written, else the next start writes it again."""
        try:
            done = not self.guide.open_poses
            self.journal.append(sweep_journal.Fitted(tuple(self._fitted), done))
        except UserError as error:
            raise UserError(f'{self.settings.output} is written, but {error}') from None
