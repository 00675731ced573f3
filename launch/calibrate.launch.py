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
Start a guided calibration: the driver, the stage and the calibration.

    ros2 launch adxl_ros calibrate.launch.py output:=unit_17.yaml
    ros2 launch adxl_ros calibrate.launch.py mode:=gravity output:=unit_17.yaml

The calibration starts by itself and stays up to show its result. In mode `gravity` there is no
stage, and `ros2 service call /calibration/finish std_srvs/srv/Trigger` fits the rests so far.
"""

from adxl_ros.files import parameter_file
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, Shutdown
from launch.conditions import IfCondition
from launch.substitutions import EqualsSubstitution, LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description() -> LaunchDescription:
    params = str(parameter_file.nominal_path())
    mode = LaunchConfiguration('mode')
    common = {
        'package': 'adxl_ros',
        'namespace': LaunchConfiguration('namespace'),
        'output': 'screen',
        'ros_arguments': ['--log-level', LaunchConfiguration('log_level')],
    }
    params_file = LaunchConfiguration('params_file')
    return LaunchDescription([
        DeclareLaunchArgument('params_file', default_value=params,
                              description='parameter file of sensor, link, stage and sweep'),
        DeclareLaunchArgument('output', default_value='calibrated.yaml',
                              description='parameter file that the calibration writes'),
        DeclareLaunchArgument('mode', default_value='stage', choices=['stage', 'gravity'],
                              description='poses of a stage, or rests of a hand-held sensor'),
        DeclareLaunchArgument('namespace', default_value='',
                              description='namespace of the nodes and their topics'),
        DeclareLaunchArgument('frame_id', default_value='imu_link',
                              description='frame of the case'),
        DeclareLaunchArgument('log_level', default_value='info',
                              description='log level: debug, info, warn, error or fatal'),
        Node(executable='driver',
             parameters=[params_file, {'frame_id': text(LaunchConfiguration('frame_id'))}],
             **common),
        Node(executable='stage', condition=IfCondition(EqualsSubstitution(mode, 'stage')),
             parameters=[params_file], **common),
        Node(executable='calibration', on_exit=Shutdown(),
             parameters=[params_file, {
                 'autostart': True,
                 'mode': mode,
                 'output': text(LaunchConfiguration('output')),
             }], **common),
    ])


def text(value: LaunchConfiguration) -> ParameterValue:
    """Return an argument as a string, also where it looks like a number."""
    return ParameterValue(value, value_type=str)
