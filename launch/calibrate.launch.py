# SPDX-License-Identifier: Apache-2.0

"""
Calibrate a sensor: start the driver, the stage and the calibration, and end with it.

    ros2 launch adxl_ros calibrate.launch.py output:=unit_17.yaml
    ros2 launch adxl_ros calibrate.launch.py output:=unit_17.yaml link_type:=serial \
        link_port:=/dev/ttyACM0 stage_type:=trajectory bridge_alpha_joint:=tilt_joint \
        bridge_beta_joint:=turn_joint
    ros2 launch adxl_ros calibrate.launch.py output:=unit_17.yaml link_type:=serial \
        link_port:=/dev/ttyACM0 stage_mode:=manual
    ros2 launch adxl_ros calibrate.launch.py mode:=gravity output:=unit_17.yaml screen:=true

A log line says how long it takes. The launch ends with the calibration: status 0 where it wrote
its file, else 1. After an interruption the same command resumes. In mode `gravity` there is no
stage, and `ros2 service call /calibration/finish std_srvs/srv/Trigger` fits the rests so far. A
driver or stage that is killed is started again; one that refuses to start ends the launch with an
error.
"""

from typing import Any

from adxl_ros.nodes import launch_nodes
from adxl_ros.nodes.calibration import CalibrationSettings
from adxl_ros.nodes.launch_nodes import arguments, given_anywhere, LINK, make_node, STAGE, text
from launch import LaunchContext, LaunchDescription
from launch.action import Action
from launch.actions import LogInfo

SWEEP = arguments(
    CalibrationSettings,
    'stage.mode',
    'report',
    'resume',
    'sweep.plan',
    'sweep.planes_deg',
    'sweep.step_deg',
    'sweep.dwell_s',
    'sweep.check_poses',
    'sweep.tilt_error_deg',
)
RESUMES = 'its line above says why; accepted poses are kept, and the same command resumes'


def generate_launch_description() -> LaunchDescription:
    return launch_nodes.describe(
        [
            *launch_nodes.common_arguments(*LINK, *STAGE, *SWEEP, *launch_nodes.SPEED),
            launch_nodes.declared(
                'output', 'calibrated.yaml', 'parameter file that the calibration writes'
            ),
            launch_nodes.declared(
                'mode',
                'stage',
                'poses of a stage, rests of a hand-held sensor, or one rest over temperature',
                'stage',
                'gravity',
                'thermal',
            ),
            launch_nodes.declared(
                'screen',
                'false',
                'show the calibration screen in this terminal; logs then go to files',
                'true',
                'false',
            ),
        ],
        make_nodes,
    )


def make_nodes(context: LaunchContext) -> list[Action]:
    """Return the nodes."""
    speed = launch_nodes.given_parameters(context, launch_nodes.SPEED)
    sim_time = {'use_sim_time': True} if speed else {}
    shows_screen = text(context, 'screen') == 'true'
    # A line on the terminal would tear the screen.
    log = {'output': 'log'} if shows_screen else {}
    stage = (
        [
            make_node(
                context, 'stage', sim_time | launch_nodes.given_parameters(context, STAGE), **log
            )
        ]
        if has_stage(context)
        else []
    )
    output, report = text(context, 'output'), text(context, 'report')
    files = ' and '.join(filter(None, (output, report and f'{report}/report.html')))
    success = f'wrote {files}; next: ros2 launch adxl_ros robot.launch.py params_file:={output}'
    sweep: dict[str, Any] = launch_nodes.given_parameters(context, SWEEP)
    return [
        show_screen(context, shows_screen),
        make_node(
            context, 'driver', launch_nodes.simulated_link(context, speed) | sim_time, **log
        ),
        *stage,
        make_node(
            context,
            'calibration',
            {
                **sim_time,
                **sweep,
                'autostart': True,
                'exit_when_done': True,
                'screen': False,
                'mode': text(context, 'mode'),
                'output': output,
            },
            **log,
            on_exit=launch_nodes.end_with(success, RESUMES),
        ),
    ]


def show_screen(context: LaunchContext, is_here: bool) -> Action:
    """Show the screen in the terminal of the launch, or say how to show it in another one."""
    name = launch_nodes.full_name(context, 'calibration')
    if is_here:
        return make_node(
            context,
            'screen',
            {'node': name},
            on_exit=launch_nodes.end_with(
                'the screen has ended; accepted poses are kept, and the same command resumes',
                RESUMES,
            ),
        )
    return LogInfo(
        msg='its screen, in a second terminal: ros2 run adxl_ros screen --ros-args -p '
        f'node:={name}'
    )


def has_stage(context: LaunchContext) -> bool:
    """Return whether there is a stage node; a real sensor never gets a simulated stage unasked."""
    if text(context, 'mode') in ('gravity', 'thermal'):
        return False
    is_real = given_anywhere(context, 'link.type', 'driver') not in ('', 'sim')
    if given_anywhere(context, 'stage.mode', 'calibration') not in ('encoder', 'manual'):
        launch_nodes.refuse_simulated_stage(
            context,
            'stage_mode:=encoder or manual for one '
            'turned by hand, mode:=gravity for a hand-held '
            'sensor, ',
        )
    return bool(given_anywhere(context, 'stage.type', 'stage')) or not is_real
