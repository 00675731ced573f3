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
    path = file_of(key)
    if path:
        mark = next(value.start_mark for _, name, value in _entries(path) if name == key)
        return f'{path}:{mark.line + 1}:{mark.column + 1}: '
    return f'{_paths()[-1]}: ' if _paths() and path is None else ''


def file_of(key: str) -> str | None:
    """
    Return the file that gives a parameter, '' where another argument does, None where none does.

    The last argument that gives a parameter counts.
    """
    for flag, value in reversed(list(pairwise(sys.argv))):
        # A rule is [NODE:]NAME:=VALUE.
        if flag in _RULE_FLAGS and value.split(':=')[0].rsplit(':')[-1] == key:
            return ''
        if flag == _FILE_FLAG and any(name == key for _, name, _ in _entries(value)):
            return value if value in _paths() else ''
    return None


def _paths() -> list[str]:
    """Return the files of `--params-file` in the order of the command line, without a launch's."""
    return [
        path
        for flag, path in pairwise(sys.argv)
        if flag == _FILE_FLAG and not Path(path).name.startswith(_OF_LAUNCH)
    ]


def _entries(path: str) -> Iterator[tuple[str, str, yaml.Node]]:
    """Yield the pattern of the node's name, the parameter's name and its value in a file."""

    def inside(tree: yaml.Node, keys: list[str]) -> Iterator[tuple[str, yaml.Node]]:
        if isinstance(tree, yaml.MappingNode):
            for key, value in tree.value:
                yield from inside(value, [*keys, key.value])
        else:
            yield '.'.join(keys), tree

    for section, parameters in _sections(path):
        for name, value in inside(parameters, []):
            yield section, name, value


def _sections(path: str) -> Iterator[tuple[str, yaml.MappingNode]]:
    """Yield the pattern of the node's name and the parameters of each section of a file."""

    def inside(tree: yaml.Node | None, keys: list[str]) -> Iterator[tuple[str, yaml.MappingNode]]:
        for key, value in tree.value if isinstance(tree, yaml.MappingNode) else ():
            if key.value != 'ros__parameters':
                yield from inside(value, [*keys, key.value.strip('/')])
            elif isinstance(value, yaml.MappingNode):
                yield ''.join(f'/{part}' for part in keys), value

    return inside(parameter_file.compose(path), [])


def write_into(path: str, node_name: str, values: Mapping[str, str]) -> None:
    """
    Write parameters of a node into its file; all else in the file stays as it is.

    values: YAML of the values by name. Raises `UserError` where the file cannot be written.
    """
    section = next(
        (
            parameters
            for pattern, parameters in _sections(path)
            if parameters.value and _matches(pattern, node_name)
        ),
        None,
    )
    if section is None:
        raise UserError(f'{path}: has no parameters of the node {node_name}')
    text = Path(path).read_text(encoding='utf-8')
    present = {
        name: value for pattern, name, value in _entries(path) if _matches(pattern, node_name)
    }
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
        sections = dict.fromkeys(section for section, _, _ in _entries(path))
        if sections and not any(_matches(section, node_name) for section in sections):
            raise UserError(
                f'{path}: has parameters of {", ".join(sections)}, but none of the '
                f'node {node_name}; begin the file with /**: or {node_name}:'
            )


def has_section(path: str, node_name: str) -> bool:
    """Return whether a parameter file has a section for a node."""
    return any(_matches(section, node_name) for section, _, _ in _entries(path))


def given_text(path: str, node_name: str, key: str) -> str:
    """Return the text of a parameter in the sections of a file for a node."""
    return next(
        (
            str(value.value)
            for section, name, value in _entries(path)
            if name == key and _matches(section, node_name)
        ),
        '',
    )


def _matches(pattern: str, node_name: str) -> bool:
    """Return whether a pattern means a node; * is one part of a name, and ** any number."""
    wild = {'*': r'/[^/]+', '**': r'(/[^/]+)*'}
    parts = [wild.get(part, f'/{re.escape(part)}') for part in pattern.strip('/').split('/')]
    return bool(re.fullmatch(''.join(parts), node_name))
