# SPDX-License-Identifier: Apache-2.0

"""One command for all tools: `adxl_ros TOOL ...`, or `python3 -m adxl_ros TOOL ...`."""

import ast
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import find_spec
import os
from pkgutil import iter_modules, resolve_name
import sys

from adxl_ros.process import (
    ended_by_closed_output,
    NODES,
    ONE_COMMAND,
    package_version,
    STARTED_BY,
)

_NODES = ('demo', *NODES)
"""What needs ROS 2."""
_COMMANDS = 'adxl_ros.commands'
"""Entry points by which another package adds a command."""


def main() -> int:
    """Run a tool by its name."""
    is_module = os.path.basename(sys.argv[0]) == '__main__.py'
    os.environ[STARTED_BY] = f'python3 -m {ONE_COMMAND}' if is_module else ONE_COMMAND
    name = sys.argv[1] if len(sys.argv) > 1 else '--help'
    if further := entry_points(group=_COMMANDS, name=name):
        sys.argv = [name, *sys.argv[2:]]
        return next(iter(further)).load()()
    if name in _tools():
        package = 'tools'
    elif name in _NODES:
        package = 'nodes'
    else:
        return _answer(name)
    if package == 'nodes' and find_spec('rclpy') is None:
        print(
            f'{ONE_COMMAND}: {name} needs ROS 2; install it, and source its setup.bash',
            file=sys.stderr,
        )
        return 1
    sys.argv = [name, *sys.argv[2:]]
    return import_module(f'adxl_ros.{package}.{name}').main()


@ended_by_closed_output()
def _answer(word: str) -> int:
    """Print help or version; refuse any other word."""
    if word in ('-h', '--help'):
        print('\n'.join(_help()))
        return 0
    if word == '--version':
        print(f'adxl_ros {package_version()}')
        return 0
    print(f'{ONE_COMMAND}: no tool {word!r}; the tools are {", ".join(_tools())}', file=sys.stderr)
    return 2


def _help() -> list[str]:
    """Return the tools with what they do."""
    return [
        f'usage: {ONE_COMMAND} TOOL ...',
        '',
        __doc__,
        '',
        'tools:',
        *(f'  {name:10}{about}' for name, about in _tools().items()),
        '',
        f'with ROS 2 also: {", ".join(_NODES)}',
        f'by other packages: {", ".join(entry_points(group=_COMMANDS).names) or "none"}',
        '',
        f'{ONE_COMMAND} TOOL --help shows options and examples.',
    ]


def _tools() -> dict[str, str]:
    """Return the tools with the first sentence of their modules, which are not loaded for it."""
    found = {}
    for module in iter_modules(resolve_name('adxl_ros.tools').__path__, 'adxl_ros.tools.'):
        spec = find_spec(module.name)
        source = spec.loader.get_source(module.name) if spec else ''  # type: ignore[union-attr]
        if source and '\ndef main(' in source:
            found[module.name.rpartition('.')[2]] = ast.get_docstring(ast.parse(source)) or ''
    return found


if __name__ == '__main__':
    sys.exit(main())
