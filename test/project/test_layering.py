# SPDX-License-Identifier: Apache-2.0

"""Imports follow the layers, extras are imported where they are used, folders list their files."""

import ast
from pathlib import Path
import re
import sys

from processes import REPO
import pytest

PACKAGE = REPO / 'adxl_ros'
CORE = {'adxl_ros', 'ament_index_python', 'numpy', 'scipy', 'yaml'}
ROS = {
    'builtin_interfaces',
    'diagnostic_msgs',
    'geometry_msgs',
    'launch',
    'launch_ros',
    'rcl_interfaces',
    'rclpy',
    'rosgraph_msgs',
    'sensor_msgs',
    'std_msgs',
    'std_srvs',
    'trajectory_msgs',
}


def test_contracts(capsys: pytest.CaptureFixture) -> None:
    cli = pytest.importorskip(
        'importlinter.cli', reason='import-linter is not installed: pip install import-linter'
    )
    status = cli.lint_imports(config_filename=str(REPO / 'pyproject.toml'), no_cache=True)
    assert status == 0, capsys.readouterr().out


CHAPTERS = re.compile(r'^    ([\w/]+)  +\S', re.MULTILINE)
"""A row of the table of chapters in the head of a folder: a module, and what is in it."""


@pytest.mark.parametrize(
    'folder',
    ['calibrate', 'diagnose', 'files', 'links', 'model', 'nodes', 'signals', 'simulate'],
)
def test_the_head_of_a_folder_names_all_its_files_once(folder: str) -> None:
    head = ast.get_docstring(ast.parse((PACKAGE / folder / '__init__.py').read_text())) or ''
    modules = [
        str(path.relative_to(PACKAGE / folder).with_suffix(''))
        for path in (PACKAGE / folder).rglob('*.py')
        if path.name != '__init__.py'
    ]
    assert sorted(CHAPTERS.findall(head)) == sorted(modules)


def imported_at_once(path: Path) -> set[str]:
    """Return the packages that the import of a module imports, without those for types only."""
    packages: set[str] = set()
    todo: list[ast.AST] = [ast.parse(path.read_text(encoding='utf-8'))]
    while todo:
        node = todo.pop()
        if isinstance(node, ast.Import):
            packages.update(alias.name.partition('.')[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            packages.add('adxl_ros' if node.level else str(node.module).partition('.')[0])
        elif isinstance(node, ast.If) and 'TYPE_CHECKING' in ast.unparse(node.test):
            todo.extend(node.orelse)
        elif not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
            todo.extend(ast.iter_child_nodes(node))
    return packages


@pytest.mark.parametrize(
    'path', sorted(PACKAGE.rglob('*.py')), ids=lambda path: str(path.relative_to(PACKAGE))
)
def test_extras_are_imported_where_they_are_used(path: Path) -> None:
    allowed = CORE | set(sys.stdlib_module_names)
    if 'nodes' in path.parts:
        allowed |= ROS
    if 'fleet' in path.parts:
        allowed |= {'pandas'}
    assert imported_at_once(path) <= allowed
