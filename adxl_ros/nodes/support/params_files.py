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
    """Return the place of a parameter in the last file: 'file:line:column: ', or ''."""
    paths = _paths()
    if not paths:
        return ''
    mark = _find_value(compose(paths[-1]), key)
    return f'{paths[-1]}:{mark.line + 1}:{mark.column + 1}: ' if mark else f'{paths[-1]}: '


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
