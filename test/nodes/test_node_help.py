# SPDX-License-Identifier: Apache-2.0

"""`--help` and `--version` of the nodes: what each declares, seen by no graph."""

from functools import cache
import os
import re
import subprocess

from adxl_ros.links.support import base
from adxl_ros.nodes.parameters import specs_of
from adxl_ros.nodes.settings import link_specs, NODES
from graph import Graph
from processes import executable, run_executable
import pytest
from terminal import Terminal

PROGRAMS = (*NODES, 'demo', 'bench')


def parts_of(text: str) -> dict[str, str]:
    return {part.split('\n')[0]: part for part in text.split('\n\n')}


@cache
def help_of(name: str) -> subprocess.CompletedProcess:
    # A path has no place to wrap at; no file of this one is written.
    return run_executable(name, '--help', env=os.environ | {'ROS_HOME': '/ros'})


@pytest.mark.parametrize('name', PROGRAMS)
def test_version(name: str, run_tool) -> None:
    ros_args = () if name in ('demo', 'bench') else ('--ros-args',)
    done = run_tool(name, *ros_args, '--version')
    assert (done.returncode, done.stderr) == (0, '')
    assert re.fullmatch(r'adxl_ros \d+\.\d+\.\d+\n', done.stdout)


@pytest.mark.parametrize('name', PROGRAMS)
def test_help_has_examples_within_a_terminal(name: str, ros_env: dict[str, str]) -> None:
    done = help_of(name)
    assert (done.returncode, done.stderr) == (0, '')
    assert f'    ros2 run adxl_ros {name}' in done.stdout.split('examples:')[1]
    assert max(map(len, done.stdout.splitlines())) <= 79 and '\x1b' not in done.stdout


@pytest.mark.parametrize('name', NODES)
def test_help_lists_each_parameter_with_type_default_and_meaning(
        name: str, ros_env: dict[str, str]) -> None:
    text = help_of(name).stdout
    entries = re.findall(r'^  ([\w.]+)  (float|floats|int|bool|text|texts)(?:, .+)?\n {6}\S',
                         text, re.MULTILINE)
    listed = {entry[0] for entry in entries}
    missing = {spec.name for part in NODES[name] for spec in specs_of(part)} - listed
    assert not missing
    assert '/parameter_events' not in text and 'qos_overrides' not in text


def test_help_of_the_driver_has_links_sensor_and_topics(ros_env: dict[str, str]) -> None:
    parts = parts_of(help_of('driver').stdout)
    for link in base.link_names():
        for spec in link_specs(link):
            assert f'\n  {spec.name}  ' in parts[f'with link.type:={link}']
    sensor = parts['parameters of the sensor, usually from --params-file']
    assert '\n  sensor.rate_hz  float, 1000\n      sample rate, Hz' in sensor
    assert re.search(r'^  imu/data_raw +sensor_msgs/Imu$', parts['publishes'], re.MULTILINE)


def test_help_opens_no_screen_and_is_not_seen(ros_env: dict[str, str], tmp_path) -> None:
    """A terminal, where a calibration opens its screen, shows the text and no more."""
    with Graph() as graph:
        seen: set[str] = set()
        terminal = Terminal([executable('calibration'), '--help'], ros_env, tmp_path, lines=200)
        try:
            def ended() -> bool:
                seen.update(graph.node.get_node_names())
                return terminal.popen.poll() is not None

            graph.spin_until(ended, 60.0, 'the help text')
            screen = terminal.wait_for('~/capture std_srvs/Trigger')
            assert terminal.popen.returncode == 0 and terminal.restored()
        finally:
            terminal.close()
    assert 'usage: calibration' in screen and b'\x1b[?1049h' not in terminal.raw
    assert 'calibration' not in seen
    assert {path.name for path in tmp_path.iterdir()} <= {'ros_log'}
