# SPDX-License-Identifier: Apache-2.0

"""
Investigate the gap of a unit on a stage: start driver, stage and investigation, end with it.

    ros2 launch adxl_ros investigate.launch.py
    ros2 launch adxl_ros investigate.launch.py params_file:=unit_17.yaml link_type:=serial \
        link_port:=/dev/ttyACM0 stage_type:=trajectory bridge_alpha_joint:=tilt_joint \
        bridge_beta_joint:=turn_joint limits_rate_deg_s:=10

Without arguments, sensor and stage are simulated. `unit_file` names another unit for the
simulated sensor, whose gap to `params_file` is then found. The launch ends with the
investigation: status 0 with a verdict, else 1. Ctrl-C leaves the stage at rest.
"""

from adxl_ros.nodes import launch_nodes
from adxl_ros.nodes.investigate import InvestigateSettings
from adxl_ros.nodes.launch_nodes import arguments, given_parameters, make_node, text
from launch import LaunchContext, LaunchDescription
from launch.action import Action

INVESTIGATION = arguments(
    InvestigateSettings,
    'output',
    'limits.alpha_deg',
    'limits.beta_deg',
    'limits.rate_deg_s',
    'limits.minutes',
)
RESULT = 'the lines above have the result'


def generate_launch_description() -> LaunchDescription:
    return launch_nodes.describe(
        [
            *launch_nodes.common_arguments(
                *launch_nodes.LINK, *launch_nodes.STAGE, *INVESTIGATION, *launch_nodes.SPEED
            ),
            launch_nodes.declared(
                'unit_file',
                '',
                'parameter file of the unit that the driver simulates; empty: params_file',
            ),
        ],
        make_nodes,
    )


def make_nodes(context: LaunchContext) -> list[Action]:
    """Return the nodes."""
    speed = given_parameters(context, launch_nodes.SPEED)
    sim_time = {'use_sim_time': True} if speed else {}
    launch_nodes.refuse_simulated_stage(context)
    return [
        make_node(
            context,
            'driver',
            launch_nodes.simulated_link(context, speed) | sim_time,
            params_file=text(context, 'unit_file'),
        ),
        make_node(context, 'stage', sim_time | given_parameters(context, launch_nodes.STAGE)),
        make_node(
            context,
            'investigate',
            sim_time | loses_nothing(context) | given_parameters(context, INVESTIGATION),
            on_exit=launch_nodes.end_with(RESULT, RESULT),
        ),
    ]


def loses_nothing(context: LaunchContext) -> dict[str, str]:
    """Return QoS of the recorded topics: driver and stage repeat what a busy machine misses."""
    policies = {}
    for topic in ('imu/data_raw', 'stage/joint_states'):
        name = launch_nodes.full_name(context, topic)
        policies[f'qos_overrides.{name}.subscription.reliability'] = 'reliable'
    return policies
