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
    ros2 launch adxl_ros calibrate.launch.py output:=unit_17.yaml link_type:=serial \
        link_port:=/dev/ttyACM0
    ros2 launch adxl_ros calibrate.launch.py mode:=gravity output:=unit_17.yaml

The calibration starts by itself and stays up to show its result. In mode `gravity` there is no
stage, and `ros2 service call /calibration/finish std_srvs/srv/Trigger` fits the rests so far. A
driver that is killed is started again; one that refuses to start three times ends the launch.
"""

from adxl_ros.nodes.support import launch_nodes
from adxl_ros.nodes.support.launch_nodes import argument, make_node, text
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription([
        *launch_nodes.common_arguments(),
        DeclareLaunchArgument('output', default_value='calibrated.yaml',
                              description='parameter file that the calibration writes'),
        DeclareLaunchArgument('mode', default_value='stage', choices=['stage', 'gravity'],
                              description='poses of a stage, or rests of a hand-held sensor'),
        OpaqueFunction(function=make_nodes)])


def make_nodes(context: LaunchContext) -> list[Node]:
    """Return the nodes; a driver that is killed is started again."""
    mode = argument(context, 'mode')
    stage = [make_node(context, 'stage', {})] if mode == 'stage' else []
    return [
        make_node(context, 'driver', {}, respawn=True, respawn_delay=2.0,
                  on_exit=launch_nodes.GiveUp()), *stage,
        make_node(context, 'calibration', {
            'autostart': True, 'mode': mode, 'output': text(argument(context, 'output'))},
            on_exit=Shutdown())]
