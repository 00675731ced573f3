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

"""The next pose of a calibration: announced to people and programs, commanded to a stage."""

from __future__ import annotations

from adxl_ros.calibrate.fits import orientations
from adxl_ros.calibrate.guided.hand_guide import Tumble
from adxl_ros.calibrate.guided.stage_guide import Sweep
from adxl_ros.nodes.support.diagnostics import Level, Status, status_message
from adxl_ros.nodes.support.topics import create_publisher
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from sensor_msgs.msg import JointState

_REPEAT_NS = 500_000_000


class Announcer:
    """
    Says where to go next.

    `~/next_pose` has it in words and figures, latched, whoever turns the sensor; `stage/command`
    only for a stage that moves itself, and again and again, so that a stage that starts later or
    has lost a message goes there, too.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        # A recorder that stalls for seconds still gets each command: a bag tells what has moved.
        self._command = create_publisher(node, JointState, 'stage/command', 10)
        self._next = create_publisher(node, DiagnosticStatus, '~/next_pose', 1, latched=True)
        self._said = ''
        self._commanded: tuple[int, int] = (-1, 0)

    def announce(self, walk: Sweep | Tumble, now_ns: int) -> None:
        """Announce where the walk goes, if that is news, and command the stage."""
        if isinstance(walk, Tumble):
            self._say(walk.where(), _up(walk))
            return
        target = walk.target
        mode = walk.settings.stage_mode
        by_hand = '' if mode == 'commanded' else 'turn the stage to '
        then = '' if mode == 'commanded' else ', then capture'
        number = walk.index + 1
        self._say(f'pose {number} of {len(walk.targets)}: {by_hand}{walk.where()}{then}', {
            'pose': str(number), 'poses': str(len(walk.targets)), 'stage_mode': mode,
            'alpha_rad': target.alpha_rad, 'beta_rad': target.beta_rad,
            'check': 'true' if target.check else 'false'})
        before, at_ns = self._commanded
        if mode == 'commanded' and (walk.index != before or now_ns - at_ns >= _REPEAT_NS):
            self._commanded = walk.index, now_ns
            command = JointState(name=['alpha', 'beta'],
                                 position=[target.alpha_rad, target.beta_rad])
            command.header.stamp = self._node.get_clock().now().to_msg()
            self._command.publish(command)

    def end(self, why: str) -> None:
        """Take the pose back that was announced, if one was: it is latched."""
        if self._said:
            self._publish(f'no pose: {why}', {})
        self._said = ''

    def _say(self, text: str, values: dict[str, str | float]) -> None:
        if text != self._said:
            self._node.get_logger().info(text)
            self._publish(text, values)
        self._said = text

    def _publish(self, text: str, values: dict[str, str | float]) -> None:
        self._next.publish(status_message('next_pose', Status(Level.OK, text, '', values)))


def _up(walk: Tumble) -> dict[str, str | float]:
    values: dict[str, str | float] = {'pose': str(len(walk.accepted) + 1)}
    if walk.next_up is not None:
        for axis, part in zip('xyz', orientations.UP[walk.next_up]):
            values[f'up_{axis}'] = float(part)
    return values
