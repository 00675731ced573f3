# SPDX-License-Identifier: Apache-2.0

"""`--help` and `--version` of the nodes: what each declares, seen by no graph."""

from functools import cache
from importlib import import_module
import os
import re
import subprocess

from adxl_ros.links.support import base
from adxl_ros.nodes.parameters import link_specs, node_specs
from adxl_ros.process import NODES
from processes import run_executable
import pytest

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
    assert re.fullmatch(r'adxl_ros \d+\.\d+\.\d+( \(\w+\))?\n', done.stdout)


@pytest.mark.parametrize('name', PROGRAMS)
def test_help_has_examples_within_a_terminal(name: str, ros_env: dict[str, str]) -> None:
    done = help_of(name)
    assert (done.returncode, done.stderr) == (0, '')
    assert f'    ros2 run adxl_ros {name}' in done.stdout.split('examples:')[1]
    assert max(map(len, done.stdout.splitlines())) <= 79 and '\x1b' not in done.stdout


@pytest.mark.parametrize('name', NODES)
def test_help_lists_each_parameter_with_type_default_and_meaning(
        name: str, ros_env: dict[str, str]) -> None:
    listed = re.findall(r'^  ([\w.]+)\s+(?:float|floats|int|bool|text|texts)(?:,[^:]+)?:',
                        help_of(name).stdout, re.MULTILINE)
    module = import_module(f'adxl_ros.nodes.{name}')
    assert {spec.name for spec in node_specs(module)} <= set(listed)


def test_help_of_the_driver_has_links_and_sensor(ros_env: dict[str, str]) -> None:
    parts = parts_of(help_of('driver').stdout)
    for link in base.link_names():
        for spec in link_specs(link):
            assert re.search(rf'^  {spec.name}\s', parts[f'with link.type:={link}:'], re.MULTILINE)
    sensor = help_of('driver').stdout.split('parameters of the sensor, usually from')[1]
    assert re.search(r'^  sensor.rate_hz +float, 1000: sample rate, Hz', sensor, re.MULTILINE)
