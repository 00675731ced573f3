# SPDX-License-Identifier: Apache-2.0

"""Style, types and manifest, with the linters of ament where they are installed."""

import importlib.util
import re
import subprocess
import sys

from processes import REPO
import pytest

PYTHON_SOURCES = ('adxl_ros', 'adxl_ros_validation', 'launch', 'test', 'setup.py')


def run_module(name: str, *args: str) -> None:
    """Run `python -m name` on the sources; assert that it has no findings."""
    package = name.partition('.')[0]
    if importlib.util.find_spec(package) is None:
        pytest.skip(f'{package} is not installed: pip install -r requirements/test.txt, or '
                    '-r requirements/ros.txt')
    done = subprocess.run([sys.executable, '-m', name, *args], cwd=REPO, text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    assert done.returncode == 0, f'{name}:\n{done.stdout}'


@pytest.mark.parametrize(('linter', 'paths'), [
    ('ament_flake8', PYTHON_SOURCES),
    ('ament_pep257', PYTHON_SOURCES),
    ('ament_xmllint', ('package.xml',)),
])
def test_ament(linter: str, paths: tuple[str, ...]) -> None:
    run_module(f'{linter}.main', *paths)


def test_ruff() -> None:
    run_module('ruff', 'check', '--output-format', 'concise', 'docs', *PYTHON_SOURCES)


def test_mypy() -> None:
    run_module('mypy')


def test_manifest() -> None:
    package = pytest.importorskip('catkin_pkg.package').parse_package(REPO / 'package.xml')
    setup = (REPO / 'setup.py').read_text(encoding='utf-8')
    assert package.name == 'adxl_ros'
    assert package.package_format == 3
    assert package.get_build_type() == 'ament_python'
    assert package.licenses == ['Apache-2.0']
    assert package.version == re.search(r"version='([^']+)'", setup)[1]
    package.validate()
