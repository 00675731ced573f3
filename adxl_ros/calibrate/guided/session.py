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

"""A guided calibration from its start to its file, free of ROS: poses, journal, fit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
import os
from pathlib import Path
from typing import Any

from adxl_ros.calibrate import calibration
from adxl_ros.calibrate.guided import pose_checks, pose_plan, quick_plan
from adxl_ros.calibrate.guided.capture_settings import Settings
from adxl_ros.calibrate.guided.hand_guide import Tumble
from adxl_ros.calibrate.guided.live_window import Newest
from adxl_ros.calibrate.guided.stage_guide import Sweep
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
    PoseSkipped,
    skipped_poses,
    unfinished,
)
from adxl_ros.model.sensor import Sensor
import numpy as np

_FIGURES = ('serial', 'axes', 'rate_hz', 'nominal_zero_g_v', 'nominal_scale_v_per_g',
            'noise_density_g_per_rthz', 'rc_resistance_ohm', 'rc_capacitance_f', 'adc_bits',
            'adc_vref_v', 'range_g', 'local_gravity_mps2', 'stage_resolution_rad')


@dataclass(frozen=True)
class Plan:
    """
    What is asked for, whatever the unit.

    Attributes
    ----------
    mode
        'stage' or 'gravity'.
    kind
        'full' or 'quick'.
    planes_rad
        Planes alpha of the plan full; none takes those that the unit's axes need.
    step_rad
        Step of beta of the plan full.
    tilt_error_rad
        Rms error of the tilt that the plan quick is to reach.
    checks
        Poses that judge the fit and stay out of it.
    settings
        How poses are taken.
    output, journal
        Files: parameters, accepted poses.
    report, store
        Folders for the report and for a copy of the calibration, or ''.

    """

    mode: str
    kind: str
    planes_rad: tuple[float, ...]
    step_rad: float
    tilt_error_rad: float
    checks: int
    settings: Settings
    output: Path
    journal: Path
    report: str
    store: str

    def targets(self, unit: Sensor) -> list[pose_plan.Target]:
        """
        Return the poses in the order of the visit; none without a stage.

        Raises
        ------
        UserError
            The parameters make no plan.

        """
        if self.mode == 'gravity':
            return []
        if self.kind == 'quick':
            return quick_plan.quick(unit, self.settings.dwell_s, self.tilt_error_rad, self.checks)
        planes = self.planes_rad or pose_plan.default_planes_rad(unit.axes)
        return pose_plan.guided(planes, self.step_rad, self.checks)

    def outlook(self, unit: Sensor) -> str:
        """Say how many poses there are, how long they take and what tilt error to expect."""
        targets = self.targets(unit)
        if not targets:
            return ''
        minutes = max(round(len(targets) * (self.settings.dwell_s + pose_plan.MOVE_S) / 60), 1)
        error_rad = quick_plan.expected_tilt_error_rad(unit, self.settings.dwell_s, targets)
        text = f'plan {self.kind}: {len(targets)} poses, about {minutes} min'
        if not np.isfinite(error_rad):
            return text
        text += f', expected tilt error {np.degrees(error_rad):.2g}°'
        if self.kind == 'quick' and error_rad > self.tilt_error_rad:
            text += f' (sweep.tilt_error_deg asks for {np.degrees(self.tilt_error_rad):.2g}°: ' \
                    'too little for this stage and this dwell)'
        return text

    def head(self, unit: Sensor) -> dict[str, Any]:
        """Return what must be the same for a calibration of this unit to go on."""
        head = {'mode': self.mode,
                **{name: np.asarray(getattr(unit, name)).tolist() for name in _FIGURES}}
        head['sweep.temperature_span_c'] = self.settings.temperature_span_c
        if self.mode == 'gravity':
            return head
        return {**head, 'stage.mode': self.settings.stage_mode,
                'stage.tolerance_rad': self.settings.tolerance_rad,
                'stage.near_rad': self.settings.near_rad,
                'sweep.dwell_s': self.settings.dwell_s, 'sweep.plan': self.kind,
                'sweep.planes_rad': self.planes_rad, 'sweep.step_rad': self.step_rad,
                'sweep.tilt_error_rad': self.tilt_error_rad, 'sweep.check_poses': self.checks,
                'order': pose_plan.ORDER}

    def question(self, unit: Sensor) -> str:
        """Ask what to do with an interrupted calibration; '' where there is none."""
        found = unfinished(self.journal, self.head(unit))
        if found is None:
            return ''
        if found.obstacle:
            return (f'{self.journal} holds {found.poses} poses of an interrupted calibration, '
                    f'which cannot go on: {found.obstacle}. Begin anew (n; it is kept), or abort '
                    '(a) and put that back?')
        return (f'{self.journal} holds {found.poses} poses of an interrupted calibration of this '
                'unit. Go on with them (y), or begin anew (n; they are kept)?')


class Session:
    """
    One calibration of one unit.

    Parameters
    ----------
    unit
        The nominal sensor of the stream.
    asked
        What to do.
    anew
        Begin anew even if an interrupted calibration could go on.

    Raises
    ------
    UserError
        The output or the journal cannot be written, or the interrupted one is another's.

    """

    def __init__(self, unit: Sensor, asked: Plan, anew: bool) -> None:
        if not os.access(asked.output.parent, os.W_OK):
            raise UserError(f'output: {asked.output}: {asked.output.parent} is not a directory '
                            'that can be written; choose another')
        if asked.mode == 'gravity' and unit.axes != 'xyz':
            raise UserError(f'mode: gravity needs the axes x, y and z, but the sensor has '
                            f'{unit.axes}; use mode:=stage')
        targets = asked.targets(unit)
        self.unit, self.asked = unit, asked
        self.newest = Newest(unit)
        self.journal = Journal(asked.journal, asked.head(unit), anew)
        self._remove_unfinished()
        self._fitted: list[PoseRecord] = []
        self._unchecked = any(isinstance(entry, MountingUnchecked)
                              for entry in self.journal.entries)
        accepted = accepted_poses(self.journal.entries)
        self.resumed = len(accepted)
        self.walk = Sweep(unit, targets, asked.settings, accepted,
                          skipped_poses(self.journal.entries)) if targets else \
            Tumble(unit, asked.settings.temperature_span_c, accepted)

    def _remove_unfinished(self) -> None:
        """Clear what a kill within a write has left."""
        asked = self.asked
        places = [(path.parent, path.name) for path in (asked.output, asked.journal)]
        if asked.report:
            places += [(Path(asked.report), name) for name in ('report.html', 'calibration.png')]
        if asked.store:
            places.append((calibration_store.unit_folder(asked.store, self.unit.serial), ''))
        for folder, name in places:
            remove_unfinished(folder, name)

    @property
    def done(self) -> int:
        """Count the accepted poses."""
        return len(self.walk.accepted)

    @property
    def over(self) -> bool:
        """Tell whether all poses of a sweep are taken or left out."""
        return isinstance(self.walk, Sweep) and self.walk.target is None

    @property
    def left(self) -> int:
        """Count the poses of a sweep that are still open."""
        return len(self.walk.targets) - len(self.walk.accepted.keys() | self.walk.skipped) \
            if isinstance(self.walk, Sweep) else 0

    @property
    def _unverified(self) -> int:
        return self.walk.to_verify if isinstance(self.walk, Sweep) else 0

    def feed(self, stamps_ns: np.ndarray, volts: np.ndarray) -> str:
        """Take samples, ns, (n,), and V, (n, m); return why they are of no use, or ''."""
        self.newest.feed(stamps_ns, volts)
        wrong = pose_checks.rate(self.newest.rate_hz(), self.unit.rate_hz)
        if not wrong:
            self.walk.feed(stamps_ns, volts)
        return wrong

    def accepted(self) -> Iterator[str]:
        """
        Take the poses that are ready, each on disk before it is named.

        Raises
        ------
        MountingError
            See `Sweep.accept`.
        UserError
            The disk does not take a pose; it is taken anew.

        """
        unverified = self._unverified
        while (entry := self.walk.accept()) is not None:
            try:
                self.journal.append(entry)
            except UserError:
                self.walk.retry()
                raise
            self.walk.take(entry)
            yield f'pose {entry.pose + 1} is on disk'
        if unverified > self._unverified:
            yield 'the sensor is mounted as it was' if not self._unverified else \
                'this pose reads what it did before; one more shows the mounting as a whole'

    def skip(self) -> str:
        """Leave the pose at hand out; return what is done, or '' where none is left."""
        if self._unverified:
            self.journal.append(MountingUnchecked())
            self._unchecked = True
        elif isinstance(self.walk, Sweep) and not self.over:
            self.journal.append(PoseSkipped(self.walk.index))
        return self.walk.skip() if not self.over else ''

    def redo(self) -> str:
        """Take the pose before again; return what is done, or '' where there is none."""
        number = self.walk.before
        if number is not None:
            # It is bad, and no part of a fit even if it is not taken again.
            self.journal.append(PoseDropped(number))
        return self.walk.redo()

    def finish(self) -> calibration.CalibrationResult:
        """
        Fit what there is, and write the parameter file; `end` is due when all is written.

        Raises
        ------
        UserError
            There are too few poses, or the file cannot be written; what was taken stays.

        """
        entries = self.walk.results()
        if not entries:
            raise UserError('no pose is taken yet')
        if all(entry.check for entry in entries):
            raise UserError('only check poses are taken, which judge a fit and are no part of '
                            'it; take poses of the planes, too')
        found = calibration.calibrate(self.unit, [calibration.RecordedPoses(
            self.journal.path.name, Poses.from_records(entries))])
        if self._unchecked:
            found = replace(found, fitted=replace(found.fitted, provenance={
                **found.fitted.provenance, 'mounting': 'not checked after an interruption'}))
        found.save(self.asked.output)
        self._fitted = entries
        return found

    def end(self) -> None:
        """
        Note that what was fitted is written; a sweep with open poses can go on.

        Until then a new start fits and writes once more.

        Raises
        ------
        UserError
            The disk does not take it.

        """
        try:
            self.journal.append(Fitted(tuple(self._fitted), not self.left))
        except UserError as error:
            raise UserError(f'{self.asked.output} is written, but {error}') from None

    def close(self) -> None:
        """Let the journal go."""
        self.journal.close()
