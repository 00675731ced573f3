# SPDX-License-Identifier: Apache-2.0

"""The two-axis stage: a simulated one, or the bridge to a real one."""

from __future__ import annotations

from adxl_ros.nodes.support.given_parameters import check_given_parameters
from adxl_ros.nodes.support.node_help import NodeHelp
from adxl_ros.nodes.support.parameters import declare
from adxl_ros.nodes.support.run_node import run
from adxl_ros.nodes.support.simulated_stage_node import SimulatedStageNode
from adxl_ros.nodes.support.stage_bridge import StageBridge
from rclpy.node import Node

_EXAMPLES = {
    'the simulated stage': '',
    'the bridge to a controller of ros2_control':
        '--ros-args -p stage.type:=trajectory '
        '-p bridge.alpha.joint:=tilt -p bridge.beta.joint:=turn',
}
"""Examples of arguments, by their purpose."""
_VARIANTS = {'stage.type:=trajectory, or joint_state': (
    'stage.type:=trajectory', 'bridge.alpha.joint:=alpha', 'bridge.beta.joint:=beta')}
"""Parameters of a bridge, with those that have no default."""


class Stage(Node):
    """The node; its parameter `stage.type` chooses what it is."""

    def __init__(self) -> None:
        super().__init__('stage')
        check_given_parameters(self)
        kind = declare(
            self, 'stage.type', 'simulated', 'the simulated stage, or the bridge to a controller '
            'that takes joint states or trajectories',
            choices=('simulated', 'joint_state', 'trajectory'))
        self._stage = SimulatedStageNode(self) if kind == 'simulated' else StageBridge(self, kind)


def main() -> int:
    """Run the node."""
    return run(Stage, NodeHelp(__doc__, _EXAMPLES, _VARIANTS))
