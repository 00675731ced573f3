# SPDX-License-Identifier: Apache-2.0

"""The launch files under `ros2 launch`: refusals, failed starts, a killed driver, the end."""

from collections.abc import Callable
import os
import re
import shutil
import signal

from adxl_ros.files import parameter_file
from graph import Graph
from processes import NEEDS_ROS2, Started, wait_until
import pytest
from rcl_interfaces.srv import GetParameters
from units import NOMINAL, nominal

pytestmark = NEEDS_ROS2
SHORT = (
    'speed:=20',
    'sweep_planes_deg:=30,60,90',
    'sweep_step_deg:=60',
    'sweep_dwell_s:=1',
    'sweep_check_poses:=3',
)
OUTER = (
    '<launch><push-ros-namespace namespace="arm"/><include file="$(find-pkg-share adxl_ros)/'
    'launch/robot.launch.py"/></launch>'
)


@pytest.fixture
def launch(start: Callable[..., Started]) -> Callable[..., Started]:
    return lambda name, *arguments: start(
        shutil.which('ros2'),
        'launch',
        *([name] if '.' in name else ['adxl_ros', f'{name}.launch.py']),
        *arguments,
    )


@pytest.mark.parametrize(
    'name, argument, words',
    [
        ('robot', 'parms_file:=none.yaml', 'no such argument; did you mean params_file?'),
        ('robot', 'params_file:=none.yaml', 'none.yaml: cannot be read'),
        (
            'calibrate',
            'params_file:=other.yaml',
            'other.yaml: has no parameters of the node /driver',
        ),
        ('robot', 'link_type:=seral', '"seral" is not valid'),
        ('robot', 'link_baud:=fast', 'link_baud:=fast: expected a number'),
        ('robot', 'log_level:=loud', '"loud" is not valid'),
        ('robot', 'filter:=true', 'apt install ros-$ROS_DISTRO-robot-localization, or leave'),
        ('calibrate', 'screen:=maybe', '"maybe" is not valid'),
        ('robot', 'output_rate_hz:=slow', 'output_rate_hz:=slow: expected a number'),
        ('robot', 'mounting_xyz_m:=0.1', 'mounting_xyz_m:=0.1: expected three numbers'),
        ('emulate', 'seed:=odd', 'seed:=odd: expected a number'),
        ('calibrate', 'sweep_planes_deg:=flat', 'sweep_planes_deg:=flat: expected a number'),
        (
            'calibrate',
            'link_type:=serial',
            'link_type is serial, but the stage would be simulated',
        ),
        (
            'investigate',
            'link_type:=serial',
            'link_type is serial, but the stage would be simulated',
        ),
        ('investigate', 'limits_beta_deg:=wide', 'limits_beta_deg:=wide: expected a number'),
        ('calibrate', 'params_file:=serial.yaml', 'link_type is serial, but the stage would be'),
    ],
)
def test_a_launch_refuses_bad_arguments(launch, tmp_path, name, argument, words):
    text = NOMINAL.read_text()
    (tmp_path / 'other.yaml').write_text(text.replace('/**:', 'other:'))
    parameter_file.save(
        tmp_path / 'serial.yaml',
        nominal(serial='17', link={'type': 'serial', 'port': '/dev/ttyACM0'}),
    )
    frame = ['base_frame:=base_link'] if 'mounting' in argument else []
    launched = launch(name, argument, *frame)
    assert launched.wait() == 1
    assert words in launched.output()
    assert 'Traceback' not in launched.output()
    assert 'process started' not in launched.output()


@pytest.mark.parametrize('name', ['robot', 'calibrate'])
def test_a_driver_that_refuses_to_start_ends_the_launch_at_once(launch, tmp_path, name):
    parameter_file.save(tmp_path / 'unit.yaml', nominal(serial='17'))
    launched = launch(name, 'params_file:=unit.yaml')
    assert launched.wait(60) == 1
    assert launched.output().count('driver: unit.yaml: link.type: is not set') == 1
    assert 'driver-1 has refused to start' in launched.output()


@pytest.mark.parametrize('name', ['robot', 'calibrate'])
def test_a_killed_driver_starts_again(launch, kill, name):
    launched = launch(name)
    launched.wait_for('active: link sim', 30)
    (pid,) = re.findall(r'\[driver-1\]: process started with pid \[(\d+)\]', launched.output())
    kill(int(pid))
    wait_until(lambda: launched.output().count('active: link sim') == 2, 30, 'active again')
    launched.popen.send_signal(signal.SIGINT)
    assert launched.wait(30) == 0
    assert 'Traceback' not in launched.output()


@pytest.mark.parametrize('name, node', [('robot', 'driver'), ('outer.launch.xml', '/arm/driver')])
def test_the_arguments_count_before_the_file(launch, tmp_path, name, node):
    """A section of the file for the node itself counts before a wildcard, but not before them."""
    (tmp_path / 'outer.launch.xml').write_text(OUTER)
    (tmp_path / 'own.yaml').write_text(
        NOMINAL.read_text() + f'{node}:\n  ros__parameters:\n    link.type: serial\n'
    )
    launched = launch(name, 'params_file:=own.yaml', 'link_type:=sim')
    launched.wait_for('active: link sim, unit nominal')


def test_arguments_of_a_launch_file_around_ours_are_its_own(launch, tmp_path):
    (tmp_path / 'outer.launch.xml').write_text(OUTER)
    launched = launch('outer.launch.xml', 'camera:=left', 'link_typ:=serial')
    launched.wait_for('link_typ:=...: this launch has no such argument; did you mean link_type?')
    launched.wait_for('active: link sim, unit nominal')
    assert 'camera:=' not in launched.output()


def test_a_robot_takes_the_imu_of_another_driver(launch):
    launch(
        'robot',
        'imu_topic:=/camera/imu',
        'output_rate_hz:=25',
        'use_sim_time:=true',
        'enclave:=/adxl_ros',
    )
    with Graph() as graph:

        def nodes():
            return graph.node.get_node_names_and_namespaces_with_enclaves()

        graph.spin_until(
            lambda: ('compensation', '/', '/adxl_ros/compensation') in nodes(),
            30,
            'the node in its enclave',
        )
        graph.spin_until(
            lambda: (
                graph.node.count_subscribers('/camera/imu')
                and graph.node.count_subscribers('/clock')
            ),
            30,
            'its topics',
        )
        assert 'driver' not in graph.node.get_node_names()
        values = graph.call(
            GetParameters,
            '/compensation/get_parameters',
            GetParameters.Request(names=['output_rate_hz', 'use_sim_time']),
        ).values
        assert (values[0].double_value, values[1].bool_value) == (25.0, True)


def test_a_robot_joins_tilt_and_gyroscope(launch, ros_env, tmp_path):
    """A program that shows what it is given stands for the node of robot_localization."""
    packages = tmp_path / 'share' / 'ament_index' / 'resource_index' / 'packages'
    node = tmp_path / 'lib' / 'robot_localization' / 'ekf_node'
    for folder in (packages, node.parent):
        folder.mkdir(parents=True)
    (packages / 'robot_localization').touch()
    node.write_text('#!/bin/sh\nfor a; do echo "given $a"; [ ! -f "$a" ] || cat "$a"; done\n')
    node.chmod(0o755)
    ros_env['AMENT_PREFIX_PATH'] += f'{os.pathsep}{tmp_path}'
    launched = launch('robot', 'filter:=true', 'namespace:=arm', 'use_sim_time:=true')
    launched.wait_for('active: link sim')
    for given in ('ekf.yaml', '__ns:=/arm', 'use_sim_time: true', 'imu0: imu/data'):
        launched.wait_for(given)


def test_a_launch_puts_a_sensor_behind_a_simulator(launch, tmp_path):
    parameter_file.save(tmp_path / 'unit.yaml', nominal(serial='17'))
    launched = launch(
        'emulate',
        'params_file:=unit.yaml',
        'in_topic:=/sim/imu',
        'out_topic:=/robot/imu',
        'seed:=3',
    )
    launched.wait_for('active: link topic, unit 17, 1000 Hz, topic /robot/imu', 30)
    launched.wait_for('/sim/imu: nobody publishes it', 30)


@pytest.mark.parametrize('output, status', [('unit.yaml', 0), ('none/unit.yaml', 1)])
def test_the_launch_of_a_calibration_ends_with_it(launch, tmp_path, output, status):
    launched = launch('calibrate', f'output:={output}', *SHORT, 'report:=report')
    assert launched.wait(120) == status
    assert (tmp_path / output).exists() == (status == 0)
    if status == 0:
        assert re.search(r'plan full: \d+ poses, about \d+ min', launched.output())
        assert (tmp_path / 'report' / 'report.html').exists()
        assert 'robot.launch.py params_file:=unit.yaml' in launched.output()
        assert parameter_file.load(tmp_path / output).model != 'nominal'
    else:
        assert 'calibration-3 has ended with the status 1' in launched.output()


@pytest.mark.parametrize('key, words', [('q', 'same command resumes'), ('', 'wrote unit.yaml')])
def test_a_launch_shows_the_screen_in_its_terminal(in_terminal, tmp_path, key, words):
    seen = in_terminal(
        shutil.which('ros2'),
        'launch',
        'adxl_ros',
        'calibrate.launch.py',
        'output:=unit.yaml',
        'screen:=true',
        *SHORT,
    )
    seen.wait_for('redo', timeout_s=60)
    assert '[INFO]' not in seen.text()
    seen.press(key)
    assert seen.wait(120) == 0
    seen.wait_for(words)
    assert key or parameter_file.load(tmp_path / 'unit.yaml').model != 'nominal'
    assert 'Traceback' not in seen.raw.decode()
