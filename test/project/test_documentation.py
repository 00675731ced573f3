# SPDX-License-Identifier: Apache-2.0

"""What the documentation shows works: parameter files load, and ROS parses the arguments."""

import math
from pathlib import Path
import re
import shlex

from adxl_ros.files import parameter_file
from processes import REPO
import pytest
import rclpy
from rclpy.context import Context

PAGES = [REPO / 'README.md', *sorted((REPO / 'docs').glob('*.md'))]


def blocks(page: Path, language: str) -> list[str]:
    """Return the code blocks of a page in a language."""
    return re.findall(rf'^```{language}\n(.*?)^```', page.read_text('utf-8'),
                      re.DOTALL | re.MULTILINE)


def ros_arguments(page: Path) -> list[list[str]]:
    """Return what stands after `--ros-args` in the commands of a page, without files."""
    lines = '\n'.join(blocks(page, 'sh')).replace('\\\n', ' ').splitlines()
    words = [shlex.split(line, comments=True) for line in lines if '--ros-args' in line]
    return [line[line.index('--ros-args'):] for line in words if '--params-file' not in line]


def test_own_sensor_loads(tmp_path: Path) -> None:
    """The file of docs/sensor.md has eight lines below its head; its additions fit."""
    head, *additions = blocks(REPO / 'docs' / 'sensor.md', 'yaml')
    path = tmp_path / 'my_sensor.yaml'
    path.write_text(head)
    assert len(head.splitlines()) == 2 + 8
    assert parameter_file.load(path).effects == ()
    path.write_text(''.join([head, *additions]))
    assert parameter_file.load(path).effects == ('supply',)


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)
def test_ros_parses_the_arguments(page: Path) -> None:
    for arguments in ros_arguments(page):
        context = Context()
        rclpy.init(args=['node', *arguments], context=context)
        context.shutdown()


def test_an_argument_that_ros_does_not_parse() -> None:
    with pytest.raises(RuntimeError, match='parse'):
        rclpy.init(args=['node', '--ros-args', '-p', 'link.uri:=local:'], context=Context())


def sensor_row(path: Path) -> str:
    """Return the row of docs/sensor.md for a parameter file: values with three digits."""
    sensor = parameter_file.load(path)
    noise = dict.fromkeys(f'{density * 1e6:.3g}' for density in sensor.noise_density_g_per_rthz)
    filter_hz = 1 / (2 * math.pi * sensor.rc_s)
    step_mg = 1e3 * sensor.lsb_v / sensor.nominal_scale_v_per_g[0]
    cells = (f'[{path.stem}](../params/{path.name})', sensor.axes, f'±{sensor.range_g:.3g}',
             ', z '.join(noise), f'{float(f"{filter_hz:.3g}"):g}',
             f'{sensor.rate_hz:g}', f'{step_mg:.3g}')
    return f'| {" | ".join(cells)} |'


def test_the_table_of_sensors_has_their_values() -> None:
    """docs/sensor.md lists every complete file of `params/` with its values, and no other."""
    text = (REPO / 'docs' / 'sensor.md').read_text('utf-8')
    rows = [line for line in text.splitlines() if '(../params/' in line and line.startswith('|')]
    files = [path for path in sorted((REPO / 'params').glob('*.yaml'))
             if not parameter_file.load(path, may_measure=True).unstated]
    assert rows == [sensor_row(path) for path in files]


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    """Links to files and to headings of pages."""
    for target, anchor in re.findall(r'\]\((?!https?:)([^)#\s]*)(#[^)\s]*)?\)',
                                     page.read_text('utf-8')):
        linked = page.parent / target if target else page
        assert linked.exists(), f'{page.name} links to {target}'
        if anchor and linked.suffix == '.md':
            headings = re.findall(r'^#+ (.*)$', linked.read_text('utf-8'), re.MULTILINE)
            assert anchor in {'#' + re.sub(r'[^\w\- ]', '', heading).lower().replace(' ', '-')
                              for heading in headings}, f'{page.name} links to {target}{anchor}'
