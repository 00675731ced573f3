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
"""Draw, diagnose and score working cases; each part goes on where it was interrupted."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from functools import partial
import json
from pathlib import Path
import sys

from adxl_ros.blind import diagnosis_runs, grading
from adxl_ros.errors import UserError
from adxl_ros.files.atomic_write import write_text
from adxl_ros.jobs.pools import open_pool
from adxl_ros.jobs.run import for_each
from adxl_ros.tools.closing_lines import print_end
from adxl_ros.tools.command_line import argument_parser
from adxl_ros.tools.common import make_folder, progress, run
from adxl_ros.working import cases, scores

PROG = 'working'
"""Name of the command, for messages."""
_TAG_DIGITS = 10
"""Digits of the hash that names the reports of one version of the diagnosis; chosen."""


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parse = argument_parser(PROG, __doc__, {
        'eighty cases, diagnosed and scored': 'cases',
        'one part only': 'cases --only score'})
    parse.add_argument('folder', metavar='DIR', help='folder of the cases')
    parse.add_argument('--cases', type=int, default=80, help='number of cases (default 80)')
    parse.add_argument('--first', type=int, default=0, metavar='N',
                       help='number of the first case (default 0)')
    parse.add_argument('--seed', type=int, default=1, help='seed of the cases (default 1)')
    parse.add_argument('--jobs', type=int, default=2, help='processes at once (default 2)')
    parse.add_argument('--tag', help='name of these reports (default: hash of the diagnosis)')
    parse.add_argument('--only', choices=('draw', 'diagnose', 'score'), help='one part only')
    return parse


def working(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    if min(options.cases, options.jobs) < 1 or min(options.first, options.seed) < 0:
        raise UserError('--cases and --jobs must be at least 1, --first and --seed at least 0')
    folder = Path(options.folder)
    tag = options.tag or diagnosis_runs.code_version(None)[:_TAG_DIGITS]
    reports = folder / 'reports' / tag
    numbers = range(options.first, options.first + options.cases)
    names = {cases.name_of(options.seed, number): number for number in numbers}
    if options.only in (None, 'draw'):
        make_folder(folder)
        with open_pool(None, options.jobs) as pool, progress('draw') as show:
            todo = [number for name, number in names.items()
                    if not (folder / name / f'{name}.json').exists()]
            for_each(pool, _draw, [partial(_case, folder, options.seed, number)
                                   for number in todo],
                     lambda name: None, show, len(names) - len(todo))
    drawn = [name for name in names if (folder / name / f'{name}.json').exists()]
    if options.only in (None, 'diagnose'):
        make_folder(reports)
        with ThreadPoolExecutor(options.jobs) as pool, progress('diagnose') as show:
            _diagnose(folder, reports, drawn, pool, show)
    if options.only in (None, 'score'):
        print(f'reports {tag}')
        print(_scored(folder, reports, drawn), end='')
    print_end([], [reports])
    return 0


def _case(folder: Path, seed: int, number: int) -> tuple:
    """Return the arguments of `_draw`."""
    return folder, seed, number


def _draw(folder: Path, seed: int, number: int) -> tuple[str]:
    """Draw one case and return its name."""
    return (cases.write(folder, seed, number).name,)


def _diagnose(folder: Path, reports: Path, names: list[str], pool: Executor,
              show: Callable[[float], None]) -> None:
    """Diagnose the cases that have no report yet."""
    def job(name: str) -> tuple:
        place = folder / name / name
        return (name, place.with_suffix('.csv').read_bytes(),
                place.with_suffix('.yaml').read_bytes(), None)

    def keep(name: str, result: diagnosis_runs.Result) -> None:
        write_text(reports / f'{name}.json', json.dumps(result))

    todo = [name for name in names if not (reports / f'{name}.json').exists()]
    for_each(pool, diagnosis_runs.diagnose, [partial(job, name) for name in todo],
             keep, show, len(names) - len(todo))


def _scored(folder: Path, reports: Path, names: list[str]) -> str:
    """Return the table of the cases that have a report."""
    graded = [scores.Graded(cases.read(folder / name / f'{name}.json'), grading.answer(
        json.loads((reports / f'{name}.json').read_text(encoding='utf-8'))))
        for name in names if (reports / f'{name}.json').exists()]
    if not graded:
        raise UserError(f'{reports}: no report of these cases; diagnose them first')
    return scores.table(graded)


def main() -> int:
    """Run the tool on the command line."""
    return run(parser(), working)


if __name__ == '__main__':
    sys.exit(main())
