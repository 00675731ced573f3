# SPDX-License-Identifier: Apache-2.0

"""The parameters of the calibration node that describe a calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from adxl_ros.calibrate.guided import pose_plan
from adxl_ros.calibrate.guided.capture_settings import CaptureSettings, StageMode
from adxl_ros.calibrate.guided.session_settings import SessionSettings
from adxl_ros.calibrate.guided.thermal_guide import ThermalSettings
from adxl_ros.files import calibration_store
from adxl_ros.nodes.support.parameters import declare, parameter_error
import numpy as np
from rclpy.node import Node

_CHECK_POSES = {'full': 16, 'quick': 8}
"""Check poses by kind of the pose plan; chosen: about a tenth, or a fifth, of the poses."""
_TOLERANCE_RAD = float(np.radians(0.2))
"""Default of `stage.tolerance_rad`; chosen: a stage of 5 arcmin arrives within it."""
_NEAR_RAD = float(np.radians(2))
"""Default of `stage.near_rad`; chosen: easy to reach by hand."""


class _PosePlan(NamedTuple):
    """Parameters of the pose plan."""

    kind: str  # 'full' or 'quick'
    planes_rad: tuple[float, ...]  # Planes alpha, rad; empty for the default
    step_rad: float  # Step of beta, rad
    check_poses: int  # Number of check poses


def declare_settings(node: Node) -> SessionSettings:
    """Declare the parameters and return the settings of a calibration."""
    mode = declare(node, 'mode', 'stage', 'what the reference is',
                   choices=('stage', 'gravity', 'thermal'))
    output = Path(declare(node, 'output', 'calibration.yaml', 'parameter file to write'))
    journal_name = declare(node, 'journal', '', 'file of accepted poses; empty: beside the output')
    journal = Path(journal_name or f'{output}.journal')
    report = declare(node, 'report', '', 'directory for the report; empty: none')
    store = declare(node, 'store', str(calibration_store.default_folder()),
                    'folder of calibrations that gets a copy; empty: none')
    capture = _declare_capture(node)
    plan = _declare_plan(node, capture.stage_mode is not StageMode.COMMANDED)
    tilt_error_deg = declare(node, 'sweep.tilt_error_deg', 0.1,
                             'rms tilt error that the plan quick is to reach', 'deg', 1e-3, 10.0)
    thermal = _declare_thermal(node)
    if mode == 'thermal' and report:
        raise parameter_error('report', 'mode thermal writes no page; leave it empty')
    for name, path in (('output', output), ('journal', journal)):
        if path.is_dir():
            raise parameter_error(name, f'{path} is a directory; name a file')
    return SessionSettings(
        mode=mode, plan_kind=plan.kind, planes_rad=plan.planes_rad, step_rad=plan.step_rad,
        tilt_error_rad=float(np.radians(tilt_error_deg)), check_poses=plan.check_poses,
        capture=capture, output=output, journal=journal, report=report, store=store,
        thermal=thermal)


def _declare_thermal(node: Node) -> ThermalSettings:
    """Declare the parameters of the mode `thermal`."""
    given = declare(node, 'thermal.range_c', (), 'lowest and highest temperature that mode '
                    'thermal is to cover, a list of numbers; empty: 0 to 50', 'degC') \
        or ThermalSettings.range_c
    if len(given) != 2 or not given[0] < given[1]:
        raise parameter_error('thermal.range_c', f'{list(given)} is no lowest and highest '
                              'temperature; give two, as [0.0, 50.0]')
    return ThermalSettings((float(given[0]), float(given[1])), declare(
        node, 'thermal.block_s', 10.0, 'length of a block of samples in mode thermal', 's', 0.5,
        600.0))


def _declare_capture(node: Node) -> CaptureSettings:
    """Declare the parameters of the stage and the poses."""
    return CaptureSettings(
        dwell_s=declare(node, 'sweep.dwell_s', 5.0, 'time at rest a pose', 's', 0.5, 3600.0),
        tolerance_rad=declare(node, 'stage.tolerance_rad', _TOLERANCE_RAD, 'arrived within this',
                              'rad', 1e-6, 0.2),
        timeout_s=declare(node, 'stage.timeout_s', 60.0,
                          'a pose that takes longer is said to be late', 's', 1.0, 86400.0),
        stage_mode=StageMode(declare(node, 'stage.mode', 'commanded', 'who turns the stage',
                                     choices=tuple(mode.value for mode in StageMode))),
        near_rad=declare(node, 'stage.near_rad', _NEAR_RAD,
                         'a stage turned by hand is captured within this of the pose', 'rad',
                         1e-4, 0.5),
        temperature_span_c=declare(node, 'sweep.temperature_span_c', 3.0,
                                   'how far the temperature may be from that of the first pose',
                                   'degC', 0.1, 1000.0))


def _declare_plan(node: Node, by_hand: bool) -> _PosePlan:
    """Declare the parameters of the pose plan; `by_hand` where an operator turns the stage."""
    kind = declare(node, 'sweep.plan', 'auto', 'poses: full (planes), quick (the fewest for '
                   'sweep.tilt_error_deg), or auto: quick where the stage is turned by hand and '
                   'no planes are given', choices=('auto', *pose_plan.KINDS))
    default_planes_rad = list(pose_plan.default_planes_rad('xy'))
    planes_rad = list(declare(node, 'sweep.planes_rad', default_planes_rad,
                              'planes alpha of the plan full, rad; the default becomes 0 to pi '
                              'for a sensor with a z axis'))
    planes_deg = declare(node, 'sweep.planes_deg', (), 'the same in degrees, a list of numbers; '
                         'empty: sweep.planes_rad counts', 'deg')
    step_rad = declare(node, 'sweep.step_rad', pose_plan.STEP_RAD, 'step of beta', 'rad',
                       0.005, 1.6)
    step_deg = declare(node, 'sweep.step_deg', 0.0,
                       'step of beta in degrees; 0: sweep.step_rad counts', 'deg', 0.0, 90.0)
    check_poses = declare(node, 'sweep.check_poses', -1, 'poses kept out of the fit for the '
                          'verdict; -1: 16, or 8 in the plan quick', '', -1, 1000)
    if step_deg and step_rad != pose_plan.STEP_RAD:
        raise parameter_error('sweep.step_deg', f'{step_deg:g} deg and sweep.step_rad '
                              f'{step_rad:g} rad are both given; keep one')
    if step_deg:
        step_rad = float(np.radians(step_deg))
    if planes_deg and planes_rad != default_planes_rad:
        raise parameter_error('sweep.planes_deg', 'sweep.planes_rad is given, too; keep one')
    if planes_deg:
        planes_rad = _planes_rad(planes_deg)
    if kind == 'auto':
        is_default = planes_rad == default_planes_rad and step_rad == pose_plan.STEP_RAD
        kind = 'quick' if by_hand and is_default else 'full'
    # A bad plan is refused before there is a sensor.
    pose_plan.guided(planes_rad, step_rad, 0)
    return _PosePlan(kind, () if planes_rad == default_planes_rad else tuple(planes_rad), step_rad,
                     _CHECK_POSES[kind] if check_poses < 0 else check_poses)


def _planes_rad(planes_deg: Any) -> list[float]:
    """Return planes, rad, from a list of degrees; one number alone is one plane."""
    try:
        return [float(np.radians(float(plane))) for plane in np.atleast_1d(planes_deg)]
    except (TypeError, ValueError):
        raise parameter_error('sweep.planes_deg', f'{planes_deg!r} is no list of degrees; write '
                              '[30.0, 60.0, 90.0]') from None
