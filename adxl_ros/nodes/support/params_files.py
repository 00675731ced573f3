# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The parameter files that a node is started with, checked and searched by line and column."""

from __future__ import annotations

from collections.abc import Iterator
import re
import sys

from adxl_ros.errors import UserError
from adxl_ros.files.parameter_file import compose
import yaml


def check_params_files() -> None:
    """
    Check the syntax of all files of `--params-file`.

    rcl refuses such a file too, but it names neither line nor column.

    Raises
    ------
    UserError
        A file cannot be read, is not YAML, or has a list of mixed types.

    """
    for path in _paths():
        _check_lists(path, compose(path))


def place_of(key: str) -> str:
    """
    Return the place of a parameter in the files: 'file:line:column: ', or ''.

    A parameter that no file has belongs to the last file of a sensor, which has a format: a launch
    adds files of its own.
    """
    trees = [(path, compose(path)) for path in reversed(_paths())]
    for path, tree in trees:
        mark = _find_value(tree, key)
        if mark:
            return f'{path}:{mark.line + 1}:{mark.column + 1}: '
    return next((f'{path}: ' for path, tree in trees if _find_value(tree, 'format')),
                f'{trees[0][0]}: ' if trees else '')


def refuse_files_of_others(node_name: str) -> None:
    """
    Refuse a file whose sections name other nodes only: the node would run without it.

    Parameters
    ----------
    node_name
        Fully qualified name of the node.

    Raises
    ------
    UserError
        No section of a file is for the node.

    """
    for path in _paths():
        sections = [section for section, _ in _sections(compose(path), '')]
        if sections and not any(_matches(section, node_name) for section in sections):
            raise UserError(f'{path}: has parameters of {", ".join(sections)}, but none of the '
                            f'node {node_name}; begin the file with /**: or {node_name}:')


def has_section(path: str, node_name: str) -> bool:
    """
    Return whether a parameter file has a section for a node.

    Parameters
    ----------
    path
        The file.
    node_name
        Fully qualified name of the node.

    Returns
    -------
    bool
        Whether there is one.

    Raises
    ------
    UserError
        The file cannot be read, or is not YAML.

    """
    return any(_matches(section, node_name) for section, _ in _sections(compose(path), ''))


def _sections(node: yaml.Node | None, name: str) -> Iterator[tuple[str, yaml.Node]]:
    """Yield the sections of a file by the pattern of their node's name."""
    if not isinstance(node, yaml.MappingNode):
        return
    for key, value in node.value:
        if key.value == 'ros__parameters':
            yield name, value
        else:
            yield from _sections(value, f'{name}/{key.value.strip("/")}')


def _matches(pattern: str, node_name: str) -> bool:
    """Return whether a pattern means a node; * is one part of a name, and ** any number."""
    wild = {'*': r'/[^/]+', '**': r'(/[^/]+)*'}
    parts = [wild.get(part, f'/{re.escape(part)}') for part in pattern.strip('/').split('/')]
    return bool(re.fullmatch(''.join(parts), node_name))


def _paths() -> list[str]:
    """Return the files of `--params-file` in the order of the command line."""
    return [path for flag, path in zip(sys.argv, sys.argv[1:]) if flag == '--params-file']


def _check_lists(path: str, node: yaml.Node | None) -> None:
    """Refuse lists of mixed types at any depth of a tree."""
    if isinstance(node, yaml.MappingNode):
        for _, value in node.value:
            _check_lists(path, value)
    elif isinstance(node, yaml.SequenceNode):
        for item in node.value[1:]:
            if item.tag != node.value[0].tag:
                mark = item.start_mark
                raise UserError(
                    f'{path}:{mark.line + 1}:{mark.column + 1}: {item.value} is not of the type '
                    f'of {node.value[0].value} before it; a list has one type (1.0, never 1)')


def _find_value(node: yaml.Node | None, key: str) -> yaml.Mark | None:
    """Find the place of a dotted key's value at any depth of a tree."""
    if not isinstance(node, yaml.MappingNode):
        return None
    for name, value in node.value:
        if name.value == key:
            return value.start_mark
        subkey = key.removeprefix(f'{name.value}.')
        mark = _find_value(value, subkey)
        if mark is None and subkey != key:
            mark = _find_value(value, key)
        if mark is not None:
            return mark
    return None
