# SPDX-License-Identifier: Apache-2.0

"""The check of what a node is started with: files for another node, and unknown parameters."""

from __future__ import annotations

from itertools import chain

from adxl_ros.nodes.support import link_parameters
from adxl_ros.nodes.support.parameters import nearest, parameter_error
from adxl_ros.nodes.support.params_files import refuse_files_of_others
from adxl_ros.nodes.support.rclpy_internals import given_parameters
from adxl_ros.nodes.support.sensor_parameters import sensor_keys
from rclpy.node import Node

OWN_PARAMETERS = {
    'driver': ('autostart', 'frame_id', 'link.type', 'stamp_offset'),
    'stage': (
        'alpha_rad', 'beta_rad', 'bridge.alpha.joint', 'bridge.alpha.offset_rad',
        'bridge.alpha.sign', 'bridge.beta.joint', 'bridge.beta.offset_rad', 'bridge.beta.sign',
        'bridge.command', 'bridge.joint_states', 'bridge.speed_rad_s', 'delay_s', 'seed',
        'settling_time_s', 'shift_m', 'slew_rate_m_s', 'slew_rate_rad_s', 'stage.type'),
    'calibration': (
        'autostart', 'exit_when_done', 'journal', 'mode', 'output', 'report', 'resume', 'screen',
        'stage.mode', 'stage.near_rad', 'stage.timeout_s', 'stage.tolerance_rad', 'store',
        'sweep.check_poses', 'sweep.dwell_s', 'sweep.plan', 'sweep.planes_deg', 'sweep.planes_rad',
        'sweep.step_deg', 'sweep.step_rad', 'sweep.temperature_span_c', 'sweep.tilt_error_deg',
        'thermal.block_s', 'thermal.range_c'),
    'compensation': (
        'calibration', 'free_acceleration', 'inverse', 'mounting.frame_id', 'mounting.rpy_rad',
        'orientation', 'output_rate_hz', 'store', 'undo_filter'),
    'investigate': (
        'limits.alpha_deg', 'limits.beta_deg', 'limits.minutes', 'limits.rate_deg_s', 'output',
        'seed'),
    'monitor': (
        'diagnose.automatic', 'diagnose.budget_s', 'diagnose.wait_s', 'false_alarms_per_day',
        'history_s', 'output', 'reference', 'reference_topic', 'window_s'),
}
"""Parameters by node, those of sensor and link aside. One file may serve all nodes: a node
ignores what another one has."""
_ANY_NODE = ('use_sim_time', 'start_type_description_service')
"""Parameters of every node of rclpy."""
_FREE_PREFIXES = ('provenance.', 'qos_overrides.', link_parameters.PREFIX)
"""Prefixes whose names are not known here: free keys, topics, and what the driver checks."""


def check_given_parameters(node: Node) -> None:
    """Refuse parameters that no node of this package has, and files that name other nodes."""
    refuse_files_of_others(node.get_fully_qualified_name())
    names = {*_ANY_NODE, *sensor_keys(), *chain(*OWN_PARAMETERS.values())}
    for name, _ in given_parameters(node):
        if name not in names and not name.startswith(_FREE_PREFIXES):
            raise parameter_error(name, 'no node has a parameter of this name; did you mean '
                                  f'{nearest(name, sorted(names))}?')
