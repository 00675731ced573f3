# SPDX-License-Identifier: Apache-2.0
"""Check `diagnose` on recordings whose effects are withheld, and count how often it is right."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from adxl_ros.files.atomic_write import write_text
from adxl_ros.tools.command_line import (
    argument_parser,
    check_least,
    command,
    make_folder,
    note,
    print_end,
    progress,
    quoted,
    run,
)
from adxl_ros.workers import open_pool
from adxl_ros_validation.blind import diagnosis_runs, real_sensors, report_html, trials

PROG = 'blind'
"""Name of the command, for messages."""
_EXAMPLES = {
    'a whole check': '--trials 200 -o check',
    'only draw the trials, and publish the hash of their labels': '--trials 200 --seal check',
    'defects put into recordings of real sensors': '--real recordings --trials 200 -o real',
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
    parse.add_argument('--real', metavar='FOLDER_OR_MANIFEST',
                       help='put defects into recordings of real sensors: CSV files, each with '
                            'NAME_sim.csv where another simulator knows its force')
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
    check_least(options, trials=1, jobs=1, seed=0)
    folder = Path(options.output or options.seal or options.open)
    try:
        return _check(options, folder)
    except KeyboardInterrupt:
        note(f'{PROG}: interrupted; the same command continues')
        return 130


def _check(options: argparse.Namespace, folder: Path) -> int:
    """Draw and seal the trials, diagnose and score them, and write the report."""
    if not options.open:
        make_folder(folder)
    with open_pool(options.scheduler, options.jobs) as pool:
        if not options.open:
            if options.real:
                digest = real_sensors.seal(folder, Path(options.real).resolve(), options.seed,
                                           options.trials, pool, progress)
            else:
                with progress('draw') as show:
                    digest = trials.seal(folder, options.seed, options.trials, trials.plans,
                                         trials.draw_trial, pool, show)
            print(f'SHA-256 of salt and labels: {digest}', flush=True)
        if options.seal:
            print_end([], [folder], command(PROG, f'--open {quoted(folder)}'))
            return 0
        if (folder / 'baseline').exists():
            made = real_sensors.score(folder, pool, progress)
            said, tables = [real_sensors.said(made)], real_sensors.tables(made)
            markdown = report_html.tables_as_markdown(said, tables)
            page = report_html.tables_as_page('Blind check on real sensors', said, tables)
            screen = report_html.terminal_table(tables['Result'])
        else:
            made = diagnosis_runs.score(folder, pool, progress)
            markdown, page = report_html.markdown(made), report_html.page(made)
            screen = report_html.summary(made).splitlines()
    write_text(folder / 'blind.json', json.dumps(made, indent=1, allow_nan=False) + '\n')
    write_text(folder / 'blind.md', markdown)
    write_text(folder / 'blind.html', page)
    print_end([*screen, ''], [folder / f'blind.{suffix}' for suffix in ('html', 'md', 'json')])
    return 0


def main() -> int:
    """Run the tool on the command line."""
    return run(parser(), blind)
