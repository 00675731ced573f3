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

"""The parameters of the calibration node that say what is asked for."""

from __future__ import annotations

from pathlib import Path

from adxl_ros.calibrate.guided import pose_plan
from adxl_ros.calibrate.guided.capture_settings import Settings, STAGE_MODES
from adxl_ros.calibrate.guided.session import Plan
from adxl_ros.files import calibration_store
from adxl_ros.nodes.support.parameters import declare, parameter_error
import numpy as np
from rclpy.node import Node

_CHECKS = {'full': 16, 'quick': 8}
"""Poses that judge the fit and stay out of it, by plan."""


def declare_plan(node: Node) -> Plan:
    """
    Declare the parameters and return what they ask for.

    Raises
    ------
    UserError
        A parameter is out of range, or they make no plan.

    """
    degrees = np.radians
    mode = declare(node, 'mode', 'stage', 'what the reference is', choices=('stage', 'gravity'))
    output = Path(declare(node, 'output', 'calibration.yaml', 'parameter file to write'))
    journal = declare(node, 'journal', '', 'file of accepted poses; empty: beside the output')
    report = declare(node, 'report', '', 'directory for the report; empty: none')
    kept = declare(node, 'store', str(calibration_store.default_folder()),
                   'folder of calibrations that gets a copy; empty: none')
    dwell = declare(node, 'sweep.dwell_s', 5.0, 'time at rest a pose', 's', 0.5, 3600.0)
    settings = Settings(
        dwell,
        declare(node, 'stage.tolerance_rad', float(degrees(0.2)), 'arrived within this', 'rad',
                1e-6, 0.2),
        declare(node, 'stage.timeout_s', 60.0, 'a pose that takes longer is said to be late', 's',
                1.0, 86400.0),
        declare(node, 'stage.mode', 'commanded', 'who turns the stage', choices=STAGE_MODES),
        declare(node, 'stage.near_rad', float(degrees(2)),
                'a stage turned by hand is captured within this of the pose', 'rad', 1e-4, 0.5),
        declare(node, 'sweep.temperature_span_c', 3.0,
                'how far the temperature may be from that of the first pose', 'degC', 0.1,
                1000.0))
    kind, planes, step, checks = _poses(node, settings.stage_mode != 'commanded')
    tilt_error = declare(node, 'sweep.tilt_error_deg', 0.1,
                         'rms tilt error that the plan quick is to reach', 'deg', 1e-3, 10.0)
    journal = Path(journal or f'{output}.journal')
    for name, path in (('output', output), ('journal', journal)):
        if path.is_dir():
            raise parameter_error(name, f'{path} is a directory; name a file')
    return Plan(mode, kind, planes, step, float(degrees(tilt_error)), checks, settings, output,
                journal, report, kept)


def _poses(node: Node, by_hand: bool) -> tuple[str, tuple[float, ...], float, int]:
    """Return the kind of the plan, its planes and step of beta, rad, and its check poses."""
    kind = declare(node, 'sweep.plan', 'auto', 'poses: full (planes), quick (the fewest for '
                   'sweep.tilt_error_deg), or auto: quick where the stage is turned by hand and '
                   'no planes are given', choices=('auto', *pose_plan.KINDS))
    usual = list(pose_plan.default_planes_rad('xy'))
    planes = list(declare(node, 'sweep.planes_rad', usual,
                          'planes alpha of the plan full, rad; the default becomes 0 to pi for a '
                          'sensor with a z axis'))
    step_rad = declare(node, 'sweep.step_rad', pose_plan.STEP_RAD, 'step of beta', 'rad',
                       0.005, 1.6)
    step_deg = declare(node, 'sweep.step_deg', 0.0,
                       'step of beta in degrees; 0: sweep.step_rad counts', 'deg', 0.0, 90.0)
    checks = declare(node, 'sweep.check_poses', -1, 'poses kept out of the fit for the verdict; '
                     '-1: 16, or 8 in the plan quick', '', -1, 1000)
    if step_deg and step_rad != pose_plan.STEP_RAD:
        raise parameter_error('sweep.step_deg', f'{step_deg:g} deg and sweep.step_rad '
                                f'{step_rad:g} rad are both given; keep one')
    if step_deg:
        step_rad = float(np.radians(step_deg))
    default = planes == usual and step_rad == pose_plan.STEP_RAD
    if kind == 'auto':
        kind = 'quick' if by_hand and default else 'full'
    # A bad plan is refused before there is a sensor.
    pose_plan.guided(planes, step_rad, 0)
    chosen = () if planes == usual else tuple(planes)
    return kind, chosen, step_rad, (_CHECKS[kind] if checks < 0 else checks)
