# SPDX-License-Identifier: Apache-2.0

"""What a guided calibration is to do, whatever the unit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from adxl_ros.calibrate.guided import pose_plan, quick_plan
from adxl_ros.calibrate.guided.capture_settings import CaptureSettings, StageMode
from adxl_ros.calibrate.guided.thermal_guide import ThermalSettings
from adxl_ros.files.sweep_journal import unfinished
from adxl_ros.model.sensor import Sensor
import numpy as np

_UNIT_FIELDS = (
    'serial', 'axes', 'rate_hz', 'nominal_zero_g_v', 'nominal_scale_v_per_g',
    'noise_density_g_per_rthz', 'rc_resistance_ohm', 'rc_capacitance_f', 'adc_bits',
    'adc_vref_v', 'range_g', 'local_gravity_mps2', 'stage_resolution_rad')
"""Fields of the sensor that must be the same for a calibration to be resumed."""


@dataclass(frozen=True)
class SessionSettings:
    """What a guided calibration is to do, whatever the unit."""

    mode: str  # 'stage', 'gravity' or 'thermal'
    plan_kind: str  # Kind of the pose plan: 'full' or 'quick'
    # Planes alpha of the plan `full`, rad; empty for those that the axes of the unit need
    planes_rad: tuple[float, ...]
    step_rad: float  # Step of beta of the plan `full`, rad
    tilt_error_rad: float  # Rms error of the tilt that the plan `quick` is to reach, rad
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

    def targets(self, unit: Sensor) -> list[pose_plan.Target]:
        """Return the poses in the order of the visit; none without a stage."""
        if self.mode != 'stage':
            return []
        if self.plan_kind == 'quick':
            return quick_plan.quick(unit, self.capture.dwell_s, self.tilt_error_rad,
                                    self.check_poses)
        planes_rad = self.planes_rad or pose_plan.default_planes_rad(unit.axes)
        return pose_plan.guided(planes_rad, self.step_rad, self.check_poses)

    def outlook(self, unit: Sensor) -> str:
        """Return what is ahead, for people: the poses of a stage, or a range of temperature."""
        if self.mode == 'thermal':
            low_c, high_c = self.thermal.range_c
            return (f'leave it at rest from {low_c:g} to {high_c:g} °C and back; call ~/finish to '
                    'end early')
        targets = self.targets(unit)
        if not targets:
            return ''
        seconds = len(targets) * (self.capture.dwell_s + pose_plan.MOVE_S)
        text = (f'plan {self.plan_kind}: {len(targets)} poses, about '
                f'{max(round(seconds / 60), 1)} min')
        error_rad = quick_plan.expected_tilt_error_rad(unit, self.capture.dwell_s, targets)
        if not np.isfinite(error_rad):
            return text
        text += f', expected tilt error {np.degrees(error_rad):.2g}°'
        if self.plan_kind == 'quick' and error_rad > self.tilt_error_rad:
            text += f' (sweep.tilt_error_deg is {np.degrees(self.tilt_error_rad):.2g}°, ' \
                    'which this stage and this dwell cannot reach)'
        return text

    def head(self, unit: Sensor) -> dict[str, Any]:
        """Return the settings and values, by key, that an interrupted calibration must share."""
        unit_fields = {name: 'measured' if name in unit.measured else
                       np.asarray(getattr(unit, name)).tolist() for name in _UNIT_FIELDS}
        head = {'mode': self.mode, **unit_fields,
                'sweep.temperature_span_c': self.capture.temperature_span_c}
        if self.mode == 'gravity':
            return head
        if self.mode == 'thermal':
            return {**head, 'thermal.range_c': list(self.thermal.range_c),
                    'thermal.block_s': self.thermal.block_s}
        return {**head, 'stage.mode': self.capture.stage_mode.value,
                'stage.tolerance_rad': self.capture.tolerance_rad,
                'stage.near_deg': _degrees(self.capture.near_rad),
                'sweep.dwell_s': self.capture.dwell_s, 'sweep.plan': self.plan_kind,
                'sweep.planes_deg': [_degrees(plane) for plane in self.planes_rad],
                'sweep.step_deg': _degrees(self.step_rad),
                'sweep.tilt_error_rad': self.tilt_error_rad,
                'sweep.check_poses': self.check_poses, 'order': pose_plan.ORDER}

    def question(self, unit: Sensor) -> str:
        """Return the question what to do with an interrupted calibration; '' without one."""
        interrupted = unfinished(self.journal, self.head(unit))
        if interrupted is None:
            return ''
        if interrupted.obstacle:
            return (f'{self.journal} holds {interrupted.poses} poses of an interrupted '
                    f'calibration, which cannot go on: {interrupted.obstacle}. Begin again (n; '
                    'the file is kept), or abort (a) and restore the old setting?')
        return (f'{self.journal} holds {interrupted.poses} poses of an interrupted calibration '
                'of this unit. Go on with them (y), or begin again (n; they are kept)?')


def _degrees(angle_rad: float) -> float:
    return round(float(np.degrees(angle_rad)), 9)
