# SPDX-License-Identifier: Apache-2.0

"""
The parameter files of the command line: where a parameter is stated, and how one is written into.

It knows YAML and the arguments of rcl, and neither what parameters mean nor what nodes have.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
import re
import sys
from typing import NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.files.atomic_write import write_text
import yaml

_FILE_FLAG = '--params-file'  # Argument of rcl before a parameter file
_RULE_FLAGS = ('-p', '--param')  # Arguments of rcl before one parameter
_OF_LAUNCH = 'launch_params_'
"""Begin of the names of files in which launch_ros gives the parameters of a launch."""


def parameter_error(key: str, reason: str) -> UserError:
    """Make the error of a parameter, with its place where it comes from a file."""
    return UserError(f'{_place_of(key)}{key}: {reason}')


def _place_of(key: str) -> str:
    """
    Return the place of a parameter in the files: 'file:line:column: ', or ''.

    A parameter that no argument gives belongs to the last file.
    """
    sources = [*_sources(key)]
    if not sources:
        return ''.join(f'{path}: ' for path in _paths()[-1:])
    path = sources[0]
    if not path:
        return ''
    mark = next(
        section.values[key].start_mark for section in _sections(path) if key in section.values
    )
    return f'{path}:{mark.line + 1}:{mark.column + 1}: '


def file_of(key: str) -> str:
    """Return the user's file that gives a parameter; '' where another argument or none does."""
    return next(_sources(key), '')


def _sources(key: str) -> Iterator[str]:
    """
    Yield what gives a parameter, the argument that counts first: a user's file, '' for others.

    The last argument that gives a parameter counts.
    """
    for flag, value in reversed(list(pairwise(sys.argv))):
        # A rule is [NODE:]NAME:=VALUE.
        if flag in _RULE_FLAGS and value.split(':=')[0].rsplit(':')[-1] == key:
            yield ''
        if flag == _FILE_FLAG and any(key in section.values for section in _sections(value)):
            yield value if value in _paths() else ''


def _paths() -> list[str]:
    """Return the files of `--params-file` in the order of the command line, without a launch's."""
    return [
        path
        for flag, path in pairwise(sys.argv)
        if flag == _FILE_FLAG and not Path(path).name.startswith(_OF_LAUNCH)
    ]


class _Section(NamedTuple):
    """The parameters of a file for some nodes, at least one."""

    pattern: str  # Of the full names of the nodes
    parameters: yaml.MappingNode  # As they are nested in the file
    values: dict[str, yaml.Node]  # By the names of the parameters

    def is_of(self, node_name: str) -> bool:
        """Return whether it is for a node; * is one part of a name, and ** any number."""
        wild = {'*': r'/[^/]+', '**': r'(/[^/]+)*'}
        parts = [
            wild.get(part, f'/{re.escape(part)}') for part in self.pattern.strip('/').split('/')
        ]
        return bool(re.fullmatch(''.join(parts), node_name))


def _sections(path: str) -> list[_Section]:
    """Return the sections of a file."""
    found = []

    def search(tree: yaml.Node | None, pattern: str) -> None:
        for key, value in tree.value if isinstance(tree, yaml.MappingNode) else ():
            if key.value != 'ros__parameters':
                search(value, f'{pattern}/{key.value.strip("/")}')
            elif isinstance(value, yaml.MappingNode) and (values := dict(_flat(value, ''))):
                found.append(_Section(pattern, value, values))

    search(parameter_file.compose(path), '')
    return found


def _flat(tree: yaml.Node, name: str) -> Iterator[tuple[str, yaml.Node]]:
    """Yield the values in nested mappings with their full names, which begin with a name."""
    if isinstance(tree, yaml.MappingNode):
        for key, value in tree.value:
            yield from _flat(value, f'{name}.{key.value}'.removeprefix('.'))
    else:
        yield name, tree


def _sections_of(path: str, node_name: str) -> list[_Section]:
    return [section for section in _sections(path) if section.is_of(node_name)]


def write_into(path: str, node_name: str, values: Mapping[str, str]) -> None:
    """
    Write parameters of a node into its file; all else in the file stays as it is.

    values: YAML of the values by name. Raises `UserError` where the file cannot be written.
    """
    sections = _sections_of(path, node_name)
    if not sections:
        raise UserError(f'{path}: has no parameters of the node {node_name}')
    section = sections[0].parameters
    text = Path(path).read_text(encoding='utf-8')
    present = {name: value for each in sections for name, value in each.values.items()}
    begin = section.value[0][0].start_mark
    after = ', ' if section.flow_style else f'\n{" " * begin.column}'
    edits = [
        (present[name].start_mark.index, present[name].end_mark.index, value)
        if name in present
        else (begin.index, begin.index, f'{name}: {value}{after}')
        for name, value in values.items()
    ]
    for start, stop, new in sorted(edits, reverse=True):
        text = text[:start] + new + text[stop:]
    write_text(Path(path).resolve(), text)


def check_params_files() -> None:
    """Check the syntax of all parameter files; rcl would name neither line nor column."""
    for path in _paths():
        parameter_file.compose(path)


def check_sections(node_name: str) -> None:
    """Refuse a file that has parameters, but none of a node."""
    for path in _paths():
        sections = _sections(path)
        if sections and not any(section.is_of(node_name) for section in sections):
            patterns = ', '.join(dict.fromkeys(section.pattern for section in sections))
            raise UserError(
                f'{path}: has parameters of {patterns}, but none of the '
                f'node {node_name}; begin the file with /**: or {node_name}:'
            )


def has_section(path: str, node_name: str) -> bool:
    """Return whether a parameter file has parameters for a node."""
    return bool(_sections_of(path, node_name))


def given_text(path: str, node_name: str, key: str) -> str:
    """Return the text of a parameter in the sections of a file for a node."""
    for section in _sections_of(path, node_name):
        if key in section.values:
            return str(section.values[key].value)
    return ''
