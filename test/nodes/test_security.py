# SPDX-License-Identifier: Apache-2.0

"""The policy for SROS 2 permits the topics and services of the nodes, and no others."""

import os
import pty
import subprocess
from xml.etree import ElementTree

from adxl_ros.files import parameter_file
from adxl_ros_validation.kept_robots import calibrated
from ament_index_python.packages import get_package_share_directory
from graph import Graph
import pytest

POLICY = os.path.join(get_package_share_directory('adxl_ros'), 'security', 'adxl_ros.policy.xml')
ENCLAVES = {
    enclave.get('path'): enclave.find('profiles/profile')
    for enclave in ElementTree.parse(POLICY).iter('enclave')
}
NODES = [profile.get('node') for profile in ENCLAVES.values()]
# Topics that depend on parameters, such as use_sim_time and link.speed, or on a replay.
SOMETIMES = {'/clock', '/imu/linear_acceleration_free', '/stage/joint_states'}
# Only a simulated sensor senses the stage, and only an emulated one a simulator.
SOMETIMES_OF_DRIVER = {'/stage/true_joint_states', '/imu/ideal', '/temperature'}
KINDS = (
    'topics[@publish="ALLOW"]',
    'topics[@subscribe="ALLOW"]',
    'services[@reply="ALLOW"]',
    'services[@request="ALLOW"]',
)


def joined(name, node):
    """Join a name to that of its node as sros2 does: a ~ gets no slash."""
    return f'/{node}{name[1:]}' if name[0] == '~' else name if name[0] == '/' else f'/{name}'


def permitted(profile):
    return [
        {joined(entry.text, profile.get('node')) for entry in profile.findall(f'{kind}/*')}
        for kind in KINDS
    ]


def existing(graph, node):
    def of_topics(find):
        # A node of the same name that ended a moment ago may still be in the graph, so that the
        # queries by the name of a node may answer for that one.
        return {
            topic
            for topic, _ in graph.node.get_topic_names_and_types()
            if any(point.node_name == node for point in find(topic))
        }

    return [
        of_topics(graph.node.get_publishers_info_by_topic),
        of_topics(graph.node.get_subscriptions_info_by_topic),
        {
            name
            for name, _ in graph.node.get_service_names_and_types()
            if name.startswith(f'/{node}/')
        },
        {
            name
            for name, _ in graph.node.get_client_names_and_types_by_node(node, '/')
            if not name.startswith(f'/{node}/')
        },
    ]


@pytest.fixture
def run_node(start, in_terminal, tmp_path):
    """Give a function that starts a node with all topics that one set of parameters can give."""
    pty_fds = pty.openpty()
    parameter_file.save(tmp_path / 'unit.yaml', calibrated())

    def run(node):
        if node == 'screen':  # it needs a terminal
            in_terminal(node)
            return
        port = (
            '--ros-args',
            '-p',
            'link.type:=serial',
            '-p',
            'link.channels:=x,y,supply,temperature',
            '-p',
            f'link.port:={os.ttyname(pty_fds[1])}',
        )
        # Only with a calibration has it something to hand over.
        calibration = '--ros-args', '--params-file', tmp_path / 'unit.yaml'
        arguments = {'driver': port, 'keep_calibrated': calibration}
        start(node, *arguments.get(node, ()))

    yield run
    for fd in pty_fds:
        os.close(fd)


def test_the_policy_is_what_the_nodes_need(run_node):
    for node in NODES:
        run_node(node)
    with Graph() as graph:
        for node in NODES:
            may = permitted(ENCLAVES[f'/adxl_ros/{node}'])
            needless = SOMETIMES | SOMETIMES_OF_DRIVER if node == 'driver' else SOMETIMES

            def has_all(node=node, may=may, needless=needless):
                return node in graph.node.get_node_names() and all(
                    names - has <= needless for names, has in zip(may, existing(graph, node))
                )

            graph.spin_until(has_all, 30, f'all that {node} is permitted')
            for names, has in zip(may, existing(graph, node)):
                assert has <= names, node


def test_sros2_makes_the_enclaves_of_the_policy(tmp_path):
    """Its generator joins the names as this test does, so that each node gets what it has."""
    pytest.importorskip('sros2')
    subprocess.run(
        ['ros2', 'security', 'generate_artifacts', '-k', tmp_path, '-p', POLICY],
        check=True,
        timeout=100,
    )
    for path, profile in ENCLAVES.items():
        publish, subscribe, reply, request = permitted(profile)
        permissions = ElementTree.parse(f'{tmp_path}/enclaves{path}/permissions.xml')
        rule = permissions.find('.//allow_rule')
        for direction, topics, requests, replies in (
            ('publish', publish, request, reply),
            ('subscribe', subscribe, reply, request),
        ):
            assert {topic.text for topic in rule.findall(f'{direction}//topic')} == {
                *(f'rt{name}' for name in topics),
                *(f'rq{name}Request' for name in requests),
                *(f'rr{name}Reply' for name in replies),
            }
