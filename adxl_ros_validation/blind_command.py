# SPDX-License-Identifier: Apache-2.0
"""Check `diagnose` on recordings whose effects are withheld, and count how often it is right."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from adxl_ros.files.atomic_write import make_folder, write_text
from adxl_ros.process import command
from adxl_ros.report import page
from adxl_ros.tools import command_line as cli
from adxl_ros.workers import open_pool
from adxl_ros_validation.blind import diagnosis_runs, real_sensors, report, trials

PROG = 'blind'
"""Name of the command, for messages."""


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parse = cli.argument_parser(
        PROG,
        __doc__,
        {
            'a whole check': '--trials 200 -o check',
            'only draw the trials, and publish the hash of their labels': (
                '--trials 200 --seal check'
            ),
            'defects put into recordings of real sensors': (
                '--real recordings --trials 200 -o real'
            ),
            'diagnose the sealed trials and score them': '--open check',
        },
    )
    parse.add_argument(
        '--trials',
        type=int,
        default=600,
        help='number of trials (default 600); a twelfth more has strength zero',
    )
    parse.add_argument(
        '--seed',
        type=int,
        default=None,
        help='seed of the trials (default: drawn; the report states it)',
    )
    parse.add_argument(
        '--real',
        metavar='FOLDER',
        help='put defects into recordings of real sensors: CSV files, each with '
        'NAME_sim.csv where another simulator knows its force',
    )
    pool = parse.add_mutually_exclusive_group()
    pool.add_argument('--scheduler', metavar='ADDRESS', help='of a Dask cluster to run on')
    pool.add_argument(
        '--jobs',
        metavar='N',
        type=int,
        help='processes of this machine (default: one for each core)',
    )
    where = parse.add_mutually_exclusive_group(required=True)
    where.add_argument('-o', dest='output', metavar='DIR', help='draw, diagnose and score')
    where.add_argument(
        '--seal', metavar='DIR', help='only draw the trials and publish the hash of their labels'
    )
    where.add_argument(
        '--open', metavar='DIR', help='diagnose all recordings without a report, and score'
    )
    return parse


def blind(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    cli.check_least(options, trials=1, jobs=1, seed=0)
    folder = Path(options.output or options.seal or options.open)
    try:
        return _check(options, folder)
    except KeyboardInterrupt:
        cli.note(f'{PROG}: interrupted; the same command continues')
        return 130


def _check(options: argparse.Namespace, folder: Path) -> int:
    """Draw and seal the trials, diagnose and score them, and write the report."""
    with open_pool(options.scheduler, options.jobs) as pool:
        if not options.open:
            make_folder(folder)
            arguments = options.seed, options.trials, pool, cli.progress
            digest = (
                real_sensors.seal(folder, Path(options.real).resolve(), *arguments)
                if options.real
                else trials.seal(folder, trials.plans, trials.draw_trial, *arguments)
            )
            print(f'SHA-256 of salt and labels: {digest}', flush=True)
        if options.seal:
            cli.print_end([], [folder], command(PROG, f'--open {cli.quoted(folder)}'))
            return 0
        page.check_libraries()
        is_real = (folder / 'baseline').exists()
        made = (real_sensors if is_real else diagnosis_runs).score(folder, pool, cli.progress)
    said = (real_sensors.report if is_real else report.of_simulated)(made)
    write_text(folder / 'blind.json', json.dumps(made, indent=1, allow_nan=False) + '\n')
    write_text(folder / 'blind.md', said.markdown())
    write_text(folder / 'blind.html', said.html())
    cli.print_end(
        [*said.screen(), ''], [folder / f'blind.{suffix}' for suffix in ('html', 'md', 'json')]
    )
    return 0


def main() -> int:
    """Run the tool on the command line."""
    return cli.run(parser(), blind)
