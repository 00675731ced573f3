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

"""
Start a calibrated sensor on a robot: the driver and the compensation.

    ros2 launch adxl_ros robot.launch.py params_file:=unit_17.yaml namespace:=arm frame_id:=arm_imu
"""

from adxl_ros.files import parameter_file
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description() -> LaunchDescription:
    params = str(parameter_file.nominal_path())
    frame_id = ParameterValue(LaunchConfiguration('frame_id'), value_type=str)
    nodes = [
        Node(package='adxl_ros', executable=executable, output='screen', respawn=True,
             respawn_delay=2.0, namespace=LaunchConfiguration('namespace'),
             parameters=[LaunchConfiguration('params_file'), {'frame_id': frame_id}],
             ros_arguments=['--log-level', LaunchConfiguration('log_level')])
        for executable in ('driver', 'compensation')
    ]
    return LaunchDescription([
        DeclareLaunchArgument('params_file', default_value=params,
                              description='parameter file of the calibrated sensor and its link'),
        DeclareLaunchArgument('namespace', default_value='',
                              description='namespace of the nodes and their topics'),
        DeclareLaunchArgument('frame_id', default_value='imu_link',
                              description='frame of the case'),
        DeclareLaunchArgument('log_level', default_value='info',
                              description='log level: debug, info, warn, error or fatal'),
        *nodes,
    ])
