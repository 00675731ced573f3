# SPDX-License-Identifier: Apache-2.0

"""The parameter files that a node is started with, checked and searched by line and column."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
import re
import sys

from adxl_ros.errors import UserError
from adxl_ros.files.parameter_file import compose
import yaml

_FILE_FLAG = '--params-file'
"""Argument of rcl before a parameter file."""
_RULE_FLAGS = ('-p', '--param')
"""Arguments of rcl before one parameter."""
_LAUNCH_PLACE = 'parameters of the launch file: '
"""Place of a parameter that launch_ros passes on in a temporary file."""


def check_params_files() -> None:
    """
    Check the syntax of all files of `--params-file`.

    rcl refuses such a file too, but it names neither line nor column.
    """
    for path in _paths():
        _check_lists(path, compose(path))


def place_of(key: str) -> str:
    """
    Return the place of a parameter in the files: 'file:line:column: ', or ''.

    The last argument that gives a parameter counts. A parameter that none gives belongs to the
    last file of a sensor, which has a format.
    """
    for flag, value in reversed(list(pairwise(sys.argv))):
        if flag in _RULE_FLAGS and _rule_name(value) == key:
            return ''
        tree = _find_value(compose(value), key) if flag == _FILE_FLAG else None
        if tree is not None:
            mark = tree.start_mark
            return _LAUNCH_PLACE if _is_of_launch(value) else \
                f'{value}:{mark.line + 1}:{mark.column + 1}: '
    files = [path for path in reversed(_paths()) if not _is_of_launch(path)]
    return next((f'{path}: ' for path in files if _find_value(compose(path), 'format')),
                f'{files[0]}: ' if files else '')


def _rule_name(rule: str) -> str:
    """Return the name of the parameter in the rule [NODE:]NAME:=VALUE of a command line."""
    return rule.split(':=')[0].rsplit(':')[-1]


def _is_of_launch(path: str) -> bool:
    """Return whether launch_ros wrote a file for the parameters of a launch file."""
    return Path(path).name.startswith('launch_params_')


def refuse_files_of_others(node_name: str) -> None:
    """Refuse a file whose sections name other nodes only: the node would run without it."""
    for path in _paths():
        sections = [section for section, _ in _sections(compose(path), '')]
        if sections and not any(_matches(section, node_name) for section in sections):
            raise UserError(f'{path}: has parameters of {", ".join(sections)}, but none of the '
                            f'node {node_name}; begin the file with /**: or {node_name}:')


def has_section(path: str, node_name: str) -> bool:
    """Return whether a parameter file has a section for a node."""
    return any(_matches(section, node_name) for section, _ in _sections(compose(path), ''))


def given_text(path: str, node_name: str, key: str) -> str:
    """Return the text of a parameter in the sections of a file for a node."""
    values = [_find_value(tree, key) for section, tree in _sections(compose(path), '')
              if _matches(section, node_name)]
    return next((str(value.value) for value in values if value is not None), '')


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
    return [path for flag, path in pairwise(sys.argv) if flag == _FILE_FLAG]


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


def _find_value(node: yaml.Node | None, key: str) -> yaml.Node | None:
    """Find a dotted key's value at any depth of a tree."""
    if not isinstance(node, yaml.MappingNode):
        return None
    for name, value in node.value:
        if name.value == key:
            return value
        subkey = key.removeprefix(f'{name.value}.')
        nested = _find_value(value, subkey)
        if nested is None and subkey != key:
            nested = _find_value(value, key)
        if nested is not None:
            return nested
    return None
