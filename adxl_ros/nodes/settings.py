# SPDX-License-Identifier: Apache-2.0

"""The parameters of each node, in a dataclass; those of sensor and link are not among them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from difflib import get_close_matches
from itertools import chain
from typing import Any

from adxl_ros.compensate.inversions import HALF
from adxl_ros.files import calibration_store
from adxl_ros.files.parameter_file import SENSOR_FIELDS
from adxl_ros.files.recording_columns import NO_UNIT
from adxl_ros.links.support import base
from adxl_ros.nodes import parameters
from adxl_ros.nodes.parameters import declare, Kind, parameter, parameter_error, Spec
from adxl_ros.nodes.rclpy_internals import given_parameters
import numpy as np
from rclpy.node import Node

LINK = 'link.'
"""Begin of the names of all parameters of a link; the driver alone has them."""
_TYPE = 'link.type'
"""Parameter that chooses the link."""
DEFAULT_FRAME = 'imu_link'
"""Frame of the case, unless a parameter or a simulator states it."""
_ANY_NODE = ('use_sim_time', 'start_type_description_service')
"""Parameters of every node of rclpy."""
_FREE_PREFIXES = ('provenance.', 'qos_overrides.', LINK)
"""Prefixes whose names are not known here: free keys, topics, and what the driver checks."""
_SEEDS = (0, 2 ** 31 - 1)
"""Range of seeds."""
_STORE = str(calibration_store.default_folder())
"""Default folder of calibrations."""
_RESOLUTION = SENSOR_FIELDS['stage.resolution_rad'].metadata
"""Description of the resolution of the encoders."""


@dataclass(frozen=True)
class DriverSettings:
    """The driver."""

    link: str = parameter('link.type', base.DEFAULT_LINK, 'where the samples come from',
                          choices=base.link_names())
    stamp_offset_s: float = parameter(
        'stamp_offset', 0.0, 'delay of the sensor, such as that of its RC filter, by which the '
        'stamps are earlier', 's', -10.0, 10.0)
    frame_id: str = parameter('frame_id', '', 'frame of the case; empty: imu_link, or as a '
                              'simulator states it')
    autostart: bool = parameter('autostart', True, 'configure and activate at the start')


@dataclass(frozen=True)
class StageSettings:
    """The choice of the stage."""

    kind: str = parameter(
        'stage.type', 'simulated', 'the simulated stage, or the bridge to a controller that takes '
        'joint states or trajectories', choices=('simulated', 'joint_state', 'trajectory'))


@dataclass(frozen=True)
class SimulatedStageSettings:
    """The simulated stage."""

    resolution_rad: float = parameter(
        'stage.resolution_rad', float(np.radians(5 / 60)), _RESOLUTION['doc'],
        _RESOLUTION['unit'], _RESOLUTION['lower'], _RESOLUTION['upper'])
    delay_s: float = parameter('delay_s', 0.1, 'time from a command to its effect', 's', 0.02, 1.0)
    slew_rate_rad_s: float = parameter('slew_rate_rad_s', 0.5, 'largest speed of a turn', 'rad/s',
                                       1e-6, 100.0)
    slew_rate_m_s: float = parameter('slew_rate_m_s', 0.01, 'largest speed of a shift', 'm/s',
                                     1e-9, 10.0)
    settling_time_s: float = parameter('settling_time_s', 0.3, 'settling time of a step, to 1 %',
                                       's', 0.01, 60.0)
    alpha_rad: float = parameter('alpha_rad', 0.0, 'position at the start', 'rad', -100.0, 100.0)
    beta_rad: float = parameter('beta_rad', 0.0, 'position at the start', 'rad', -100.0, 100.0)
    shift_m: float = parameter('shift_m', 0.0, 'position at the start', 'm', -10.0, 10.0)
    seed: int = parameter('seed', 0, "seed of the positions within an encoder's step", '', *_SEEDS)


def _joint(name: str) -> Any:
    return parameter(f'bridge.{name}.joint', Kind.STRING, f"the controller's name of {name}")


def _sign(name: str) -> Any:
    return parameter(f'bridge.{name}.sign', 1, 'direction in which it turns: 1 or -1', '', -1, 1)


def _offset(name: str) -> Any:
    return parameter(f'bridge.{name}.offset_rad', 0.0, f"{name} where the controller's joint is "
                     'at 0', 'rad', -100.0, 100.0)


@dataclass(frozen=True)
class BridgeSettings:
    """The bridge to a real stage."""

    alpha_joint: str = _joint('alpha')
    alpha_sign: int = _sign('alpha')
    alpha_offset_rad: float = _offset('alpha')
    beta_joint: str = _joint('beta')
    beta_sign: int = _sign('beta')
    beta_offset_rad: float = _offset('beta')
    joint_states: str = parameter('bridge.joint_states', '/joint_states',
                                  "topic of the controller's joint states")
    command: str = parameter('bridge.command', '', 'topic on which the controller listens; empty: '
                             '/joint_commands, or /joint_trajectory_controller/joint_trajectory')
    speed_rad_s: float = parameter('bridge.speed_rad_s', 0.3, 'speed of a trajectory', 'rad/s',
                                   1e-4, 10.0)


@dataclass(frozen=True)
class CalibrationSettings:
    """The guided calibration."""

    mode: str = parameter('mode', 'stage', 'what the reference is',
                          choices=('stage', 'gravity', 'thermal'))
    autostart: bool = parameter('autostart', False, 'start without a call of ~/start')
    resume: str = parameter('resume', 'ask', 'go on with an interrupted calibration; without a '
                            'screen, ask is continue', choices=('ask', 'continue', 'anew'))
    exit_when_done: bool = parameter('exit_when_done', False, 'end the node after a calibration: '
                                     'status 0 where it wrote its file, else 1')
    screen: bool = parameter('screen', True, 'show a screen, where the node runs in a terminal')
    output: str = parameter('output', 'calibration.yaml', 'parameter file to write')
    journal: str = parameter('journal', '', 'file of accepted poses; empty: beside the output')
    report: str = parameter('report', '', 'directory for the report; empty: none')
    store: str = parameter('store', _STORE, 'folder of calibrations that gets a copy; empty: none')
    dwell_s: float = parameter('sweep.dwell_s', 5.0, 'time at rest a pose', 's', 0.5, 3600.0)
    # A stage of 5 arcmin arrives within this default.
    tolerance_rad: float = parameter('stage.tolerance_rad', float(np.radians(0.2)),
                                     'arrived within this', 'rad', 1e-6, 0.2)
    timeout_s: float = parameter('stage.timeout_s', 60.0, 'time after which a pose is late', 's',
                                 1.0, 86400.0)
    stage_mode: str = parameter(
        'stage.mode', 'commanded', 'commanded turns itself, encoder and manual are turned by hand',
        choices=('commanded', 'encoder', 'manual'))
    near_deg: float = parameter('stage.near_deg', 2.0, 'a stage turned by hand is captured within '
                                'this of the pose', 'deg', 0.01, 30.0)
    temperature_span_c: float = parameter('sweep.temperature_span_c', 3.0, 'largest change of the '
                                          'temperature since the first pose', 'degC', 0.1, 1000.0)
    plan: str = parameter(
        'sweep.plan', 'auto', 'full (planes, 25 minutes), quick (about 38 poses), or auto: quick '
        'where a stage is turned by hand without planes', choices=('auto', 'full', 'quick'))
    planes_deg: Any = parameter('sweep.planes_deg', (), 'planes alpha of the plan full; empty: 30 '
                                'to 150, or 0 to 180 for a sensor with a z axis', 'deg')
    step_deg: float = parameter('sweep.step_deg', 30.0, 'step of beta of the plan full', 'deg',
                                0.5, 90.0)
    check_poses: int = parameter('sweep.check_poses', -1, 'poses kept out of the fit for the '
                                 'verdict; -1: 16, or 8 in the plan quick', '', -1, 1000)
    tilt_error_deg: float = parameter('sweep.tilt_error_deg', 0.1, 'rms tilt error that the plan '
                                      'quick is to reach', 'deg', 1e-3, 10.0)
    range_c: Any = parameter('thermal.range_c', (), 'lowest and highest temperature that mode '
                             'thermal is to cover; empty: 0 to 50', 'degC')
    block_s: float = parameter('thermal.block_s', 10.0, 'length of a block of samples in mode '
                               'thermal', 's', 0.5, 600.0)


@dataclass(frozen=True)
class CompensationSettings:
    """The compensation."""

    calibration: str = parameter('calibration', '', 'parameter file to use; setting it loads the '
                                 'whole file or nothing of it', live=True)
    inverse: str = parameter('inverse', 'exact', "inverse of the model: exact, or the paper's "
                             'approximation', choices=('exact', 'paper'))
    undo_filter: bool = parameter('undo_filter', False, 'take the RC filter out; a sample is '
                                  f'published {HALF} samples late, with its own stamp')
    orientation: str = parameter('orientation', 'keep', 'of a sample that states one: keep it, or '
                                 'that of the tilt', choices=('keep', 'tilt'))
    store: str = parameter('store', _STORE, 'folder of calibrations, whose newest of the unit is '
                           'used where none is named; empty: none')
    output_rate_hz: float = parameter(
        'output_rate_hz', 0.0, 'one sample of so many is published as it is, so that vibration '
        'above half of this rate folds into it; 0: every sample', 'Hz', 0.0, 1e5)
    free_acceleration: bool = parameter('free_acceleration', False, 'publish imu/linear_'
                                        'acceleration_free of samples that state an orientation')
    rpy_rad: Any = parameter('mounting.rpy_rad', [0.0, 0.0, 0.0], 'roll, pitch and yaw of the '
                             'case on the robot, as in a URDF joint', 'rad', live=True)
    mounting_frame_id: str = parameter('mounting.frame_id', 'base_link', 'frame of the robot, in '
                                       'the header where the case is turned')


@dataclass(frozen=True)
class InvestigateSettings:
    """The investigation."""

    output: str = parameter('output', 'investigation', 'folder of bag, report and parameters; a '
                            'number is added where it has a diagnosis')
    alpha_deg: Any = parameter('limits.alpha_deg', (), 'range of alpha; empty: 0 to 180', 'deg')
    beta_deg: Any = parameter('limits.beta_deg', (), 'range of beta; empty: 0 to 360', 'deg')
    # The default is that of the bridge, 0.3 rad/s.
    rate_deg_s: float = parameter('limits.rate_deg_s', 17.0, 'largest rate of each joint', 'deg/s',
                                  0.1, 180.0)
    minutes: float = parameter('limits.minutes', 15.0, 'largest time of all manoeuvres together',
                               'min', 0.5, 240.0)
    seed: int = parameter('seed', 0, 'seed of the diagnosis', '', *_SEEDS)


@dataclass(frozen=True)
class MonitorSettings:
    """The monitor."""

    reference: str = parameter(
        'reference', 'stage', 'what the sensor is compared with: the joints of a stage, the '
        'ideal Imu of a simulator, or the joints of a robot', choices=('stage', 'imu', 'robot'))
    reference_topic: str = parameter('reference_topic', '', 'topic of the reference; empty: '
                                     'stage/joint_states, imu/ideal, or joint_states')
    urdf: str = parameter('urdf', '', 'file of the robot; its base rests')
    frame: str = parameter('frame', 'imu_link', 'frame of the robot that carries the sensor')
    window_s: float = parameter('window_s', 60.0, 'time over which gap and floor are taken', 's',
                                5.0, 3600.0)
    false_alarms_per_day: float = parameter('false_alarms_per_day', 0.0333, 'largest rate of '
                                            'reported changes that are none', '1/day', 1e-5, 10.0)
    history_s: float = parameter('history_s', 600.0, 'time that is kept for a diagnosis', 's',
                                 60.0, 3600.0)
    wait_s: float = parameter('diagnose.wait_s', 120.0, 'time of samples that an automatic '
                              'diagnosis needs', 's', 20.0, 3600.0)
    output: str = parameter('output', str(calibration_store.default_folder().with_name('monitor')),
                            'folder of the record of changes and of the diagnoses')
    automatic: bool = parameter('diagnose.automatic', True, 'diagnose a change, or an open gap')
    budget_s: float = parameter('diagnose.budget_s', 300.0, 'longest time of a diagnosis', 's',
                                1.0, 3600.0)


@dataclass(frozen=True)
class ScreenSettings:
    """The screen."""

    node: str = parameter('node', 'calibration', 'name of the calibration node')
    node_pid: int = parameter('node_pid', 0, 'process of the node that has started this screen')


NODES: dict[str, tuple[type, ...]] = {
    'driver': (DriverSettings,),
    'stage': (StageSettings, SimulatedStageSettings, BridgeSettings),
    'calibration': (CalibrationSettings,), 'compensation': (CompensationSettings,),
    'investigate': (InvestigateSettings,), 'monitor': (MonitorSettings,),
    'screen': (ScreenSettings,)}
"""Parameters by node. One file may serve all nodes: a node ignores what another one has."""


def check_given_parameters(node: Node) -> None:
    """Refuse parameters that no node of this package has, and files that name other nodes."""
    parameters.refuse_files_of_others(node.get_fully_qualified_name())
    of_nodes = (spec.name for part in chain(*NODES.values()) for spec in parameters.specs_of(part))
    names = {*_ANY_NODE, *parameters.sensor_keys(), *of_nodes}
    for name, _ in given_parameters(node):
        if name not in names and not name.startswith(_FREE_PREFIXES):
            raise parameter_error(name, 'no node has a parameter of this name; did you mean '
                                  f'{get_close_matches(name, sorted(names), 1, 0.0)[0]}?')


def link_specs(link: str) -> list[Spec]:
    """Return the parameters of a link, `link.type` aside."""
    return [Spec(f'{LINK}{option.name}', option.default, **option.metadata)
            for option in fields(base.link_module(link).Settings)]


def given_link(node: Node) -> dict[str, Any]:
    """Return the given parameters of the link by name, for a file that carries them."""
    return {name.removeprefix(LINK): value for name, value in given_parameters(node)
            if name.startswith(LINK)}


def declare_driver(node: Node, serial: str) -> tuple[DriverSettings, base.LinkModule, Any]:
    """
    Declare the parameters of the driver and of its link, which are returned with its module.

    No real unit gets simulated data: a link must then be named.
    """
    given = [f'{LINK}{name}' for name in given_link(node)]
    reason = f'{given[0]} is given' if given else \
        f'the sensor is the unit {serial}' if serial != NO_UNIT else ''
    if reason and _TYPE not in given:
        devices = [name for name in base.link_names() if name != base.DEFAULT_LINK]
        raise parameter_error(_TYPE, f'is not set, but {reason}; set it to {", ".join(devices)}, '
                              f'or to {base.DEFAULT_LINK} for a simulated sensor')
    settings = parameters.declare_all(node, DriverSettings)
    module, specs = base.link_module(settings.link), link_specs(settings.link)
    own = [_TYPE, *(spec.name for spec in specs)]
    for name in given:
        if name not in own:
            raise parameter_error(name, f'the link {settings.link} has no such parameter; it has '
                                  f'{", ".join(own)}')
    values = {spec.name.removeprefix(LINK): declare(node, spec) for spec in specs}
    return settings, module, module.Settings(**values)
