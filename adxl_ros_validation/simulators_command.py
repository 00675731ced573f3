# SPDX-License-Identifier: Apache-2.0
"""Diagnose the accelerometers that simulators simulate, against the simulators' own joints."""

from __future__ import annotations

import argparse
from importlib.util import module_from_spec, spec_from_file_location
import json
from pathlib import Path

from adxl_ros.errors import one_line, UserError
from adxl_ros.files.atomic_write import make_folder, write_text
from adxl_ros.tools import command_line as cli
from adxl_ros_validation.simulators import page
from adxl_ros_validation.simulators.base import Checked, Simulator
from adxl_ros_validation.simulators.check import check

PROG = 'simulators'
"""Name of the command, for messages."""


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parse = cli.argument_parser(
        PROG,
        __doc__,
        {
            'those of the documentation': 'docs/measurements/simulators -o simulators',
            'one of your own': 'my_simulator.py -o mine',
        },
    )
    parse.add_argument(
        'place',
        help='Python file, or folder of files, with classes of simulators; what is not installed '
        'is named and left out',
    )
    parse.add_argument('--seed', type=int, default=1, help='seed of the noise (default 1)')
    parse.add_argument(
        '-o',
        dest='output',
        metavar='DIR',
        required=True,
        help='recordings, figures and page; what is there already is not run again',
    )
    return parse


def simulators(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    cli.check_least(options, seed=0)
    place, folder = Path(options.place), make_folder(options.output)
    left_out = []
    for path in sorted(place.glob('*.py')) if place.is_dir() else [place]:
        try:
            _check_file(path, folder, options.seed)
        except UserError:
            raise
        except Exception as error:
            # A simulator is a large library that may lack anything: the others still run.
            left_out.append(f'{path.stem}: {type(error).__name__}: {one_line(error)}')
            cli.note(f'left out: {left_out[-1]}')
    made = [
        Checked(**json.loads(path.read_text('utf-8'))) for path in sorted(folder.glob('*.json'))
    ]
    if not made:
        raise UserError(f'{place}: has no simulator that is installed')
    said = page.report(made, left_out, options.seed)
    write_text(folder / 'simulators.md', said.markdown())
    lines = [f'{each.simulator}, {each.reads}: {each.verdict}' for each in made]
    cli.print_end([*lines, ''], [folder / 'simulators.md'])
    return 0


def _check_file(path: Path, folder: Path, seed: int) -> None:
    """Check the classes of a file that were not checked before."""
    found = spec_from_file_location(path.stem, path)
    if found is None or found.loader is None or not path.is_file():
        raise UserError(f'{path}: no such Python file')
    module = module_from_spec(found)
    found.loader.exec_module(module)
    for name, kind in vars(module).items():
        stem = folder / f'{path.stem}.{name}'
        is_own = isinstance(kind, type) and kind.__module__ == path.stem
        if not is_own or not issubclass(kind, Simulator) or Path(f'{stem}.json').exists():
            continue
        with cli.progress(name) as advance:
            checked = check(kind(), Path(f'{stem}.csv'), seed, advance)
        write_text(f'{stem}.json', json.dumps(vars(checked), indent=1) + '\n')


def main() -> int:
    """Run the tool on the command line."""
    return cli.run(parser(), simulators)
