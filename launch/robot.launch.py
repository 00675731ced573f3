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

    ros2 launch adxl_ros robot.launch.py params_file:=unit_17.yaml link_type:=serial \
        link_port:=/dev/ttyACM0 namespace:=arm frame_id:=arm_imu

    ros2 launch adxl_ros robot.launch.py params_file:=unit_17.yaml base_frame:=base_link \
        mounting_xyz_m:=0.1,0,0.05 mounting_rpy_rad:=3.14159,0,0

The second line also publishes the static transform from the robot to the case. A node that ends
is started again. The launch ends with an error when a node refuses to start three times.
"""

from adxl_ros.nodes.support import launch_nodes
from launch import LaunchContext, LaunchDescription
from launch.action import Action


def generate_launch_description() -> LaunchDescription:
    return launch_nodes.describe(
        [*launch_nodes.common_arguments(), *launch_nodes.TRANSFORM], make_nodes)


def make_nodes(context: LaunchContext) -> list[Action]:
    """Return the nodes."""
    return [*launch_nodes.static_transform(context), *(
        launch_nodes.make_node(context, executable, {}, respawn=True, respawn_delay=2.0,
                               on_exit=launch_nodes.GiveUp())
        for executable in ('driver', 'compensation'))]
