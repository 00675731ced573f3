# SPDX-License-Identifier: Apache-2.0

"""The layouts, the xacro and the rules of share/ parse, and show what the nodes publish."""

from importlib import import_module
import json
from operator import attrgetter
import re
import shutil
import subprocess
from xml.etree import ElementTree

from adxl_ros.files.bag_writer import FRAME
from processes import REPO
import pytest
import yaml

SHARE = REPO / 'share'
TYPES = dict(
    re.findall(
        r'^\| `([\w/]+)` \((\w+/\w+)\)',
        (REPO / 'docs' / 'reference' / 'nodes.md').read_text('utf-8'),
        re.MULTILINE,
    )
)
"""Topics of the nodes and their types; a test compares the page with the nodes."""


def check_path(path: str) -> None:
    """Assert that a topic has the field that a plot shows: /imu/data.linear_acceleration.x."""
    topic = next(
        name
        for name in sorted(TYPES, key=len, reverse=True)
        if path.startswith((f'/{name}/', f'/{name}.'))
    )
    package, name = TYPES[topic].split('/')
    field = path[len(topic) + 2 :].replace('/', '.').partition('.@')[0]
    attrgetter(field)(getattr(import_module(f'{package}.msg'), name)())


def test_plotjuggler() -> None:
    curves = ElementTree.parse(SHARE / 'layouts' / 'plotjuggler.xml').findall('.//curve')
    assert curves
    for curve in curves:
        check_path(curve.get('name'))


def test_foxglove() -> None:
    text = (SHARE / 'layouts' / 'foxglove.json').read_text('utf-8')
    panels = json.loads(text)['configById']
    assert panels.pop('DiagnosticSummary!state')['topicToRender'].removeprefix('/') in TYPES
    for name, panel in panels.items():
        assert text.count(f'"{name}"') == 2  # stated, and placed
        for path in panel['paths']:
            check_path(path['value'])


def test_rviz() -> None:
    layout = yaml.safe_load((SHARE / 'layouts' / 'imu.rviz').read_text('utf-8'))
    manager = layout['Visualization Manager']
    assert manager['Global Options']['Fixed Frame'] == FRAME
    imu = manager['Displays'][-1]
    assert TYPES[imu['Topic']['Value'].removeprefix('/')] == 'sensor_msgs/Imu'


def test_xacro() -> None:
    macro = ElementTree.parse(SHARE / 'urdf' / 'sensor.urdf.xacro').getroot()[0]
    assert f' frame:={FRAME} ' in macro.get('params')


@pytest.mark.skipif(shutil.which('bash') is None, reason='no bash')
def test_completion_parses() -> None:
    subprocess.run(['bash', '-n', SHARE / 'completion' / 'adxl_ros.bash'], check=True)
