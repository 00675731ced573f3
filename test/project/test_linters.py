# SPDX-License-Identifier: Apache-2.0

"""Style, types and manifest, with the linters of ament where they are installed."""

import importlib.util
import re
import subprocess
import sys

from needs import lack
import numpy as np
from processes import REPO
import pytest

RELEASED_SOURCES = ('adxl_ros', 'adxl_ros_validation', 'launch', 'setup.py')
PYTHON_SOURCES = (*RELEASED_SOURCES, 'test')


def run_module(name: str, *args: str) -> None:
    """Run `python -m name` on the sources; assert that it has no findings."""
    package = name.partition('.')[0]
    if importlib.util.find_spec(package) is None:
        pytest.skip(
            f'{package} is not installed: pip install -r requirements/test.txt, or '
            '-r requirements/ros.txt'
        )
    done = subprocess.run(
        [sys.executable, '-m', name, *args],
        cwd=REPO,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    assert done.returncode == 0, f'{name}:\n{done.stdout}'


@pytest.mark.long
@pytest.mark.parametrize(
    ('linter', 'arguments'),
    [
        ('ament_flake8', ('--config', 'test/project/ament_flake8.ini', *RELEASED_SOURCES)),
        ('ament_pep257', RELEASED_SOURCES),
        ('ament_xmllint', ('package.xml',)),
    ],
)
def test_ament(linter: str, arguments: tuple[str, ...]) -> None:
    run_module(f'{linter}.main', *arguments)


def test_ruff() -> None:
    run_module('ruff', 'check', '--output-format', 'concise', 'docs', *PYTHON_SOURCES)


def test_format() -> None:
    run_module('ruff', 'format', '--check', 'docs', *PYTHON_SOURCES)


@pytest.mark.skipif(
    not np.__version__.startswith('2.4.'),
    reason=lack('the types of numpy 2.4: each release types its functions otherwise'),
)
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
    # A package with a key of pip cannot be released.
    assert not [
        key.name
        for key in package.exec_depends + package.test_depends
        if key.name.endswith('-pip')
    ]
    for maintainer in package.maintainers:
        assert f"maintainer_email='{maintainer.email}'" in setup


def test_changelog() -> None:
    """catkin_pkg reads every entry; it would leave out those of a section in a version."""
    changelog = pytest.importorskip('catkin_pkg.changelog')
    text = (REPO / 'CHANGELOG.rst').read_text(encoding='utf-8')
    log = changelog.Changelog('adxl_ros')
    changelog.populate_changelog_from_rst(
        log, text.replace('Forthcoming\n-----------', '99.0.0 (2000-01-01)\n-------------------')
    )
    read = [
        entry
        for _, _, content in log.foreach_version()
        for part in content
        if isinstance(part, changelog.BulletList)
        for entry in part
    ]
    assert len(read) == len(re.findall(r'^\* ', text, re.MULTILINE))
