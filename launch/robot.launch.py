# SPDX-License-Identifier: Apache-2.0

"""
Start a calibrated sensor on a robot: the driver and the compensation.

    ros2 launch adxl_ros robot.launch.py params_file:=unit_17.yaml link_type:=serial \
        link_port:=/dev/ttyACM0 namespace:=arm frame_id:=arm_imu

    ros2 launch adxl_ros robot.launch.py params_file:=unit_17.yaml base_frame:=base_link \
        mounting_xyz_m:=0.1,0,0.05 mounting_rpy_rad:=3.14159,0,0

    ros2 launch adxl_ros robot.launch.py params_file:=cam7.yaml imu_topic:=/camera/imu \
        output_rate_hz:=50

    ros2 launch adxl_ros robot.launch.py params_file:=unit_17.yaml link_type:=serial keep:=true

    ros2 launch adxl_ros robot.launch.py params_file:=cam7.yaml imu_topic:=/camera/imu filter:=true

The second line also publishes the static transform from the robot to the case. The third one
corrects the IMU of another driver, and publishes 50 samples a second. The
fourth one keeps the calibration up to date. The fifth one joins tilt and gyroscope by the EKF of
robot_localization: odometry/filtered. A node that ends is started again, unless `respawn` is
false. The launch ends with an error when a node refuses to start.
"""

from pathlib import Path
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.nodes import launch_nodes
from adxl_ros.nodes.compensation import CompensationSettings
from adxl_ros.nodes.launch_nodes import arguments, LINK, text
from ament_index_python.packages import get_package_prefix, PackageNotFoundError
from launch import LaunchContext, LaunchDescription
from launch.action import Action
from launch_ros.actions import Node

OUTPUT_RATE = arguments(CompensationSettings, 'output_rate_hz')


def generate_launch_description() -> LaunchDescription:
    return launch_nodes.describe(
        [
            *launch_nodes.common_arguments(*LINK, *OUTPUT_RATE),
            *launch_nodes.TRANSFORM,
            launch_nodes.declared(
                'imu_topic',
                '',
                "topic of another driver's sensor_msgs/Imu, such "
                'as /camera/imu, which is corrected in place of that of our driver; '
                'empty: start our driver',
            ),
            launch_nodes.declared(
                'keep',
                'false',
                'keep the calibration up to date by the rests of the robot',
                'true',
                'false',
            ),
            launch_nodes.declared(
                'filter',
                'false',
                'join tilt and gyroscope of imu/data by ekf_node of robot_localization',
                'true',
                'false',
            ),
            launch_nodes.declared(
                'filter_file',
                str(Path(__file__).with_name('ekf.yaml')),
                'parameter file of ekf_node',
            ),
            launch_nodes.declared('use_sim_time', 'false', 'follow /clock', 'true', 'false'),
            launch_nodes.declared(
                'respawn', 'true', 'start a node again that ends', 'true', 'false'
            ),
        ],
        make_nodes,
    )


def make_nodes(context: LaunchContext) -> list[Action]:
    """Return the nodes."""
    imu_topic, respawn = text(context, 'imu_topic'), text(context, 'respawn') == 'true'
    if imu_topic and text(context, 'link_type'):
        raise UserError(f'imu_topic:={imu_topic} starts no driver; leave link_type out')
    nodes = {'compensation': launch_nodes.given_parameters(context, OUTPUT_RATE)}
    if text(context, 'keep') == 'true':
        nodes |= {'keep_calibrated': {}}
    if not imu_topic:
        nodes = {'driver': {}} | nodes
    sim_time = {'use_sim_time': True} if text(context, 'use_sim_time') == 'true' else {}
    return [
        *launch_nodes.static_transform(context),
        *(
            launch_nodes.make_node(
                context,
                executable,
                parameters | sim_time,
                respawn=respawn,
                remappings=[('imu/data_raw', imu_topic)] if imu_topic else [],
            )
            for executable, parameters in nodes.items()
        ),
        *tilt_filter(context, sim_time, respawn),
    ]


def tilt_filter(context: LaunchContext, sim_time: dict[str, Any], respawn: bool) -> list[Action]:
    """Join tilt and gyroscope, if the launch is asked to."""
    if text(context, 'filter') == 'false':
        return []
    package = 'robot_localization'
    try:
        get_package_prefix(package)
    except PackageNotFoundError:
        raise UserError(
            f'filter:=true: {package} is not installed; '
            'apt install ros-$ROS_DISTRO-robot-localization, or leave filter out'
        ) from None
    frame = text(context, 'base_frame')
    return [
        Node(
            package=package,
            executable='ekf_node',
            namespace=text(context, 'namespace'),
            parameters=[
                text(context, 'filter_file'),
                sim_time | ({'base_link_frame': frame} if frame else {}),
            ],
            ros_arguments=['--log-level', text(context, 'log_level')],
            output='screen',
            respawn=respawn,
            respawn_delay=2.0,
        )
    ]
