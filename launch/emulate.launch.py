# SPDX-License-Identifier: Apache-2.0

"""
Start a realistic sensor in another simulator: the driver on its ideal Imu.

    ros2 launch adxl_ros emulate.launch.py in_topic:=/imu params_file:=gap/params.yaml

    ros2 launch adxl_ros emulate.launch.py in_topic:=/imu out_topic:=/robot/imu/data_raw \
        params_file:=unit_17.yaml seed:=3 frame_id:=imu_link

The simulator publishes sensor_msgs/Imu with specific force, and /clock. The sensor of the
parameter file appears on imu/data_raw with the stamps of the simulator. A driver that ends is
started again. The launch ends with an error when the driver refuses to start.
"""

from adxl_ros.nodes import launch_nodes
from adxl_ros.nodes.driver import DriverSettings
from adxl_ros.nodes.launch_nodes import arguments, text
from launch import LaunchContext, LaunchDescription
from launch.action import Action

LINK = arguments(
    DriverSettings,
    'frame_id',
    in_topic='link.topic',
    temperature_topic='link.temperature_topic',
    seed='link.seed',
)


def generate_launch_description() -> LaunchDescription:
    return launch_nodes.describe(
        [
            *launch_nodes.common_arguments(*LINK),
            launch_nodes.declared('out_topic', 'imu/data_raw', 'topic of the realistic samples'),
            launch_nodes.declared(
                'use_sim_time', 'true', 'follow the clock of the simulator', 'true', 'false'
            ),
        ],
        make_nodes,
    )


def make_nodes(context: LaunchContext) -> list[Action]:
    """Return the driver."""
    return [
        launch_nodes.make_node(
            context,
            'driver',
            {
                'link.type': 'topic',
                **launch_nodes.given_parameters(context, LINK),
                'use_sim_time': text(context, 'use_sim_time') == 'true',
            },
            remappings=[('imu/data_raw', text(context, 'out_topic'))],
        )
    ]
