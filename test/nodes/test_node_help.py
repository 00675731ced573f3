# SPDX-License-Identifier: Apache-2.0

"""`--help` and `--version` of the nodes: what each declares, seen by no graph."""

from collections.abc import Callable
from importlib import import_module
import re

from adxl_ros.links.support import base
from adxl_ros.nodes.parameters import link_specs, node_specs
from adxl_ros.process import NODES
import pytest

PROGRAMS = (*NODES, 'demo', 'bench')


def parts_of(text: str) -> dict[str, str]:
    return {part.split('\n')[0]: part for part in text.split('\n\n')}


@pytest.mark.parametrize('name', PROGRAMS)
def test_version(name: str, run_tool) -> None:
    ros_args = () if name in ('demo', 'bench') else ('--ros-args',)
    done = run_tool(name, *ros_args, '--version')
    assert (done.returncode, done.stderr) == (0, '')
    assert re.fullmatch(r'adxl_ros \d+\.\d+\.\d+( \(\w+\))?\n', done.stdout)


@pytest.mark.parametrize('name', PROGRAMS)
def test_help_has_examples_within_a_terminal(name: str, help_of: Callable[[str], str]) -> None:
    text = help_of(name)
    assert f'    ros2 run adxl_ros {name}' in text.split('examples:')[1]
    assert max(map(len, text.splitlines())) <= 79 and '\x1b' not in text


@pytest.mark.parametrize('name', NODES)
def test_help_lists_each_parameter_with_type_default_and_meaning(
    name: str, help_of: Callable[[str], str]
) -> None:
    listed = re.findall(
        r'^  ([\w.]+)\s+(?:float|floats|int|bool|text|texts)(?:,[^:]+)?:',
        help_of(name),
        re.MULTILINE,
    )
    module = import_module(f'adxl_ros.nodes.{name}')
    assert {spec.name for spec in node_specs(module)} <= set(listed)


def test_help_of_the_driver_has_links_and_sensor(help_of: Callable[[str], str]) -> None:
    parts = parts_of(help_of('driver'))
    for link in base.link_names():
        for spec in link_specs(link):
            assert re.search(rf'^  {spec.name}\s', parts[f'with link.type:={link}:'], re.MULTILINE)
    sensor = help_of('driver').split('parameters of the sensor, usually from')[1]
    assert re.search(r'^  sensor.rate_hz +float, 1000: sample rate, Hz', sensor, re.MULTILINE)
