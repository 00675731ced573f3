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

"""The policy for SROS 2 permits the topics and services of the nodes, and no others."""

import os
import pty
from xml.etree import ElementTree

from ament_index_python.packages import get_package_share_directory
from graph import Graph
from processes import executable
import pytest
from terminal import Terminal

POLICY = os.path.join(get_package_share_directory('adxl_ros'), 'security', 'adxl_ros.policy.xml')
# Topics that depend on parameters, such as use_sim_time and link.speed, or on a replay.
SOMETIMES = {'/clock', '/imu/linear_acceleration_free', '/stage/joint_states'}


def allowed(node):
    """Return the names that a node may publish, subscribe and reply to."""
    tree = ElementTree.parse(POLICY)
    profile = tree.find(f".//enclave[@path='/adxl_ros/{node}']//profile[@node='{node}']")

    def names(path):
        return {f'/{node}/{e.text[1:]}' if e.text.startswith('~') else f'/{e.text}'
                for e in profile.findall(path)}
    return (names("topics[@publish='ALLOW']/topic"), names("topics[@subscribe='ALLOW']/topic"),
            names("services[@reply='ALLOW']/service"))


def test_the_policy_has_the_services_that_the_screen_calls(ros_env, tmp_path):
    tree = ElementTree.parse(POLICY)
    requests = {f'/{e.text}' for e in tree.findall(
        ".//profile[@node='screen']/services[@request='ALLOW']/service")}
    seen = Terminal([executable('screen')], ros_env, tmp_path)
    seen.wait_for('waiting for /calibration')
    with Graph() as graph:
        def called():
            return {name for name in names_of(graph.node.get_client_names_and_types_by_node(
                'screen', '/')) if not name.endswith('/get_type_description')}
        graph.spin_until(lambda: 'screen' in graph.node.get_node_names(), 20, 'the screen')
        graph.spin_until(lambda: called() >= requests, 20, 'all that is permitted')
        assert called() == requests
    seen.close()


def names_of(entities):
    return {name for name, _ in entities}


@pytest.mark.parametrize('node', [
    'driver', 'stage', 'calibration', 'compensation', 'investigate', 'monitor'])
def test_the_policy_is_what_the_node_needs(start, node):
    board_fd, driver_fd = pty.openpty()
    extra = () if node != 'driver' else (
        '-p', 'link.type:=serial', '-p', f'link.port:={os.ttyname(driver_fd)}', '-p',
        'link.channels:=x,y,supply,temperature')
    start(node, '--ros-args', *extra)
    # Only a simulated sensor senses the stage, and only an emulated one a simulator.
    only_subscribed = {'/stage/true_joint_states', '/imu/ideal', '/temperature'} \
        if node == 'driver' else set()
    optional = SOMETIMES, SOMETIMES | only_subscribed, SOMETIMES
    permitted = allowed(node)
    with Graph() as graph:
        def existing():
            # A node of the same name that ended a moment ago may still be in the graph, so that
            # the queries by the name of a node may answer for that one.
            topics = names_of(graph.node.get_topic_names_and_types())
            return [{topic for topic in topics
                     if any(point.node_name == node for point in find(topic))} for find in (
                         graph.node.get_publishers_info_by_topic,
                         graph.node.get_subscriptions_info_by_topic)] + [
                {name for name in names_of(graph.node.get_service_names_and_types())
                 if name.startswith(f'/{node}/')}]

        graph.spin_until(lambda: node in graph.diagnostics, 20, 'diagnostics')
        # Discovery of the other topics and services may come after the first message.
        graph.spin_until(lambda: all(may - has <= some for may, has, some in
                                     zip(permitted, existing(), optional)), 20,
                         'all that is permitted')
        actual = existing()
    os.close(board_fd)
    os.close(driver_fd)
    for may, has in zip(permitted, actual):
        assert has <= may
