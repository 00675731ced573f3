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

"""The two-axis stage: a simulated one, or the bridge to a real one."""

from __future__ import annotations

from adxl_ros.nodes.support import node_support
from adxl_ros.nodes.support.simulated_stage_node import Simulated
from adxl_ros.nodes.support.stage_bridge import Bridge
from rclpy.node import Node


class Stage(Node):
    """The node, and what it is by its parameter `stage.type`."""

    def __init__(self) -> None:
        super().__init__('stage')
        kind = node_support.declare(
            self, 'stage.type', 'simulated', 'the simulated stage, or the bridge to a controller '
            'that takes joint states or trajectories',
            choices=('simulated', 'joint_state', 'trajectory'))
        self.inside = Simulated(self) if kind == 'simulated' else Bridge(self, kind)


def main() -> int:
    """Run the node."""
    return node_support.main(Stage, __doc__)
