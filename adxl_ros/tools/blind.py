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

"""Check `diagnose` on recordings whose effects are withheld, and count how often it is right."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from adxl_ros.blind import blind_check, real_recordings, report_html
from adxl_ros.errors import UserError
from adxl_ros.files.atomic_write import write_text
from adxl_ros.files.plot_file import pyplot
from adxl_ros.jobs.pools import open_pool
from adxl_ros.tools import blind_forest
from adxl_ros.tools.closing_lines import print_end, quoted
from adxl_ros.tools.command_line import argument_parser, command
from adxl_ros.tools.common import make_folder, note, progress, run

PROG = 'blind'
"""Name of the command, for messages."""
_EXAMPLES = {
    'a whole check': '--trials 200 -o check',
    'only draw the trials, and publish the hash of their labels': '--trials 200 --seal check',
    'diagnose the sealed trials and score them': '--open check',
}
"""Examples of arguments, by their purpose."""


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parse = argument_parser(PROG, __doc__, _EXAMPLES)
    parse.add_argument('--trials', type=int, default=600,
                       help='number of trials (default 600); a twelfth more has strength zero')
    parse.add_argument('--seed', type=int, default=None,
                       help='seed of the trials (default: drawn; the report states it)')
    parse.add_argument('--real', metavar='RECORDING:PARAMS[:SIM]', action='append', default=[],
                       help='a real recording with calibrated parameters, whose effects are '
                            'deleted one by one to see whether they are put back; may be repeated')
    parse.add_argument('--forest', action='store_true',
                       help='compare with a random forest that is trained on recordings of '
                            "the package's own simulator (needs scikit-learn; 6 min of one core)")
    pool = parse.add_mutually_exclusive_group()
    pool.add_argument('--scheduler', metavar='ADDRESS', help='of a Dask cluster to run on')
    pool.add_argument('--jobs', metavar='N', type=int,
                      help='processes of this machine (default: one for each core)')
    where = parse.add_mutually_exclusive_group(required=True)
    where.add_argument('-o', dest='output', metavar='DIR', help='draw, diagnose and score')
    where.add_argument('--seal', metavar='DIR',
                       help='only draw the trials and publish the hash of their labels')
    where.add_argument('--open', metavar='DIR',
                       help='diagnose all recordings without a report, and score')
    return parse


def blind(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    if options.trials < 1:
        raise UserError(f'--trials {options.trials}: at least 1 is needed')
    if options.jobs is not None and options.jobs < 1:
        raise UserError(f'--jobs {options.jobs}: at least 1 is needed')
    if options.seed is not None and options.seed < 0:
        raise UserError(f'--seed {options.seed}: must not be negative')
    arms = [real_recordings.read_arm(option) for option in options.real]
    folder = Path(options.output or options.seal or options.open)
    try:
        return _check(options, folder, arms)
    except KeyboardInterrupt:
        note(f'{PROG}: interrupted; the same command continues')
        return 130


def _check(options: argparse.Namespace, folder: Path, arms: list[real_recordings.Arm]) -> int:
    """Draw and seal the trials, diagnose and score them, and write the report."""
    draw = pyplot()
    others: dict[str, blind_check.OtherMethod] = {}
    if options.forest:
        blind_forest.forest_class()
        others['random forest'] = blind_forest.answers
    if not options.open:
        make_folder(folder)
    with open_pool(options.scheduler, options.jobs) as pool:
        if not options.open:
            with progress('draw') as show:
                digest = blind_check.draw(folder, options.seed, options.trials, pool, show)
            print(f'SHA-256 of salt and labels: {digest}', flush=True)
            if options.forest:
                with progress('random forest') as show:
                    blind_forest.train(folder, pool, show)
        if options.seal:
            print_end([], [folder], command(PROG, f'--open {quoted(folder)}'))
            return 0
        made = blind_check.score(folder, None, pool, progress, others)
        if arms:
            with progress('real') as show:
                made['real'] = real_recordings.put_back(arms, None, pool, show)
    write_text(folder / 'blind.json', json.dumps(made, indent=1, allow_nan=False) + '\n')
    write_text(folder / 'blind.md', report_html.markdown(made))
    write_text(folder / 'blind.html', report_html.page(made, draw))
    print_end([*report_html.summary(made).splitlines(), ''],
              [folder / f'blind.{suffix}' for suffix in ('html', 'md', 'json')])
    return 0


def main() -> int:
    """Run the tool on the command line."""
    return run(parser(), blind)
