# SPDX-License-Identifier: Apache-2.0

"""A guided calibration from its first pose to its parameter file, free of ROS."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
import os
from pathlib import Path

from adxl_ros.calibrate import calibration, thermal_calibration
from adxl_ros.calibrate.guided import pose_checks
from adxl_ros.calibrate.guided.guide import Guide
from adxl_ros.calibrate.guided.hand_guide import HandGuide
from adxl_ros.calibrate.guided.live_window import NewestSamples
from adxl_ros.calibrate.guided.session_settings import SessionSettings
from adxl_ros.calibrate.guided.stage_guide import StageGuide
from adxl_ros.calibrate.guided.thermal_guide import ThermalGuide
from adxl_ros.calibrate.poses import Poses
from adxl_ros.errors import UserError
from adxl_ros.files import calibration_store
from adxl_ros.files.atomic_write import remove_unfinished
from adxl_ros.files.sweep_journal import (
    accepted_poses,
    Fitted,
    Journal,
    MountingUnchecked,
    PoseDropped,
    PoseRecord,
    skipped_poses,
)
from adxl_ros.model.constants import AXES
from adxl_ros.model.sensor import Sensor, with_axes
import numpy as np


class Session:
    """One calibration of one unit: a guide, its journal, and the fit."""

    def __init__(self, unit: Sensor, settings: SessionSettings, start_over: bool,
                 base: Sensor | None = None) -> None:
        if not os.access(settings.output.parent, os.W_OK):
            raise UserError(f'output: {settings.output}: {settings.output.parent} is not a '
                            'directory that can be written; choose another')
        if settings.mode == 'gravity' and unit.axes != AXES:
            raise UserError(f'mode: gravity needs the axes x, y and z, but the sensor has '
                            f'{unit.axes}; use mode:=stage')
        targets = settings.targets(unit)
        self._base = _calibrated(base, unit) if settings.mode == 'thermal' else unit
        self.unit, self.settings = unit, settings
        self.newest = NewestSamples(unit)  # The newest samples
        # The accepted poses on disk
        self.journal = Journal(settings.journal, settings.head(unit), start_over)
        self._remove_unfinished()
        self._fitted: list[PoseRecord] = []
        self._is_mounting_unchecked = any(isinstance(entry, MountingUnchecked)
                                          for entry in self.journal.entries)
        accepted = accepted_poses(self.journal.entries)
        self.resumed = len(accepted)  # Number of the poses of an interrupted calibration
        self.guide: Guide  # Leads through the poses
        if settings.mode == 'gravity':
            self.guide = HandGuide(unit, settings.capture.temperature_span_c, accepted)
        elif settings.mode == 'thermal':
            self.guide = ThermalGuide(unit, self._base, settings.thermal, accepted)
        else:
            self.guide = StageGuide(unit, targets, settings.capture, accepted,
                                    skipped_poses(self.journal.entries))

    @property
    def accepted_count(self) -> int:
        """Return the number of accepted poses."""
        return len(self.guide.accepted)

    def feed(self, stamps_ns: np.ndarray, volts: np.ndarray) -> str:
        """
        Take samples.

        stamps_ns: their stamps, ns, (n,); volts: the samples, V, (n, m).
        """
        self.newest.feed(stamps_ns, volts)
        fault = pose_checks.rate_fault(self.newest.rate_hz(), self.unit)
        if not fault:
            self.guide.feed(stamps_ns, volts)
        return fault

    def take_poses(self) -> Iterator[str]:
        """Take the poses that are complete."""
        unverified = self.guide.poses_to_verify
        while (record := self.guide.accept()) is not None:
            try:
                self.journal.append(record)
            except UserError:
                self.guide.retry()
                raise
            self.guide.take(record)
            yield f'pose {record.pose + 1} is on disk'
        if unverified > self.guide.poses_to_verify:
            yield 'this pose reads the same as before; one more pose checks the mounting' \
                if self.guide.poses_to_verify else 'the sensor is mounted as it was'

    def skip(self) -> str:
        """Leave out the open pose; return a line for people, or '' where none is open."""
        if self.guide.is_over:
            return ''
        entry = self.guide.skip_entry()
        if entry is not None:
            self.journal.append(entry)
        if isinstance(entry, MountingUnchecked):
            self._is_mounting_unchecked = True
        return self.guide.skip()

    def redo(self) -> str:
        """Take the previous pose again; return a line for people, or '' where there is none."""
        number = self.guide.previous
        if number is not None:
            # The fit must not use the pose, even if it is not taken again.
            self.journal.append(PoseDropped(number))
        return self.guide.redo()

    def finish(self) -> calibration.CalibrationResult:
        """
        Fit the poses so far and write the parameter file.

        Call `end` once the report and the copy in the store are written, too.
        """
        records = self.guide.poses_to_fit()
        if not records:
            raise UserError('no pose is taken yet')
        if all(record.check for record in records):
            raise UserError('only check poses are taken, which the fit does not use; take other '
                            'poses, too')
        poses = Poses.from_records(records)
        result = thermal_calibration.calibrate(
            self._base, poses, self.journal.path.name, range_c=self.settings.thermal.range_c) \
            if self.settings.mode == 'thermal' else calibration.calibrate(
                self.unit, [calibration.RecordedPoses(self.journal.path.name, poses)])
        if self._is_mounting_unchecked:
            provenance = {**result.fitted.provenance,
                          'mounting': 'not checked after an interruption'}
            result = replace(result, fitted=replace(result.fitted, provenance=provenance))
        result.save(self.settings.output)
        self._fitted = records
        return result

    def end(self) -> None:
        """
        Note in the journal that the fit is written; a sweep with open poses can be resumed.

        Without this note the next start fits and writes the files again.
        """
        try:
            self.journal.append(Fitted(tuple(self._fitted), not self.guide.open_poses))
        except UserError as error:
            raise UserError(f'{self.settings.output} is written, but {error}') from None

    def close(self) -> None:
        """Close the journal."""
        self.journal.close()

    def _remove_unfinished(self) -> None:
        """Remove the unfinished files of a process that was killed while it wrote."""
        settings = self.settings
        places = [(path.parent, path.name) for path in (settings.output, settings.journal)]
        if settings.report:
            places += [(Path(settings.report), 'report.html'),
                       (Path(settings.report), 'calibration.png')]
        if settings.store:
            places.append((calibration_store.unit_folder(settings.store, self.unit.serial), ''))
        for folder, name in places:
            remove_unfinished(folder, name)


def _calibrated(base: Sensor | None, unit: Sensor) -> Sensor:
    """Return the calibrated unit with the nominal values of its stream."""
    if base is None or not base.effects:
        return unit
    return replace(with_axes(base, unit.axes), serial=unit.serial, rate_hz=unit.rate_hz)
