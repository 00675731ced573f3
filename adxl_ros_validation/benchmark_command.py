# SPDX-License-Identifier: Apache-2.0
"""Compare diagnoses on public recordings of real sensors, with withheld or documented defects."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import json
from pathlib import Path
from typing import NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.files.atomic_write import make_folder, write_text
from adxl_ros.report import page as layout
from adxl_ros.report.figures import png
from adxl_ros.tools import command_line as cli
from adxl_ros.workers import open_pool, Pool
from adxl_ros_validation.benchmark import defects, manifest, methods, page, results, run
from adxl_ros_validation.blind import trials
from adxl_ros_validation.blind.real_sensors import Half

PROG = 'benchmark'
"""Name of the command, for messages."""


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parse = cli.argument_parser(
        PROG,
        __doc__,
        {
            'all methods on the recordings that are in a folder': 'recordings -o benchmark',
            'recordings of your own': 'recordings --manifest mine.yaml -o benchmark',
            'a method of your own beside that of the package': (
                'recordings --method diagnose --method my_module:method -o benchmark'
            ),
        },
    )
    parse.add_argument(
        'folder', help='folder of fetched recordings; those that are missing are named'
    )
    parse.add_argument(
        '--manifest',
        metavar='FILE',
        default=str(manifest.SHIPPED),
        help='what the recordings are and how they are read (default: that of the package)',
    )
    parse.add_argument(
        '--method',
        metavar='NAME',
        action='append',
        default=[],
        help=f'{", ".join(methods.METHODS)}, or MODULE:FUNCTION; repeat it for several '
        '(default: all that are installed)',
    )
    parse.add_argument(
        '--trials', type=int, default=60, help='number of trials of level A (default 60)'
    )
    parse.add_argument(
        '--seed',
        type=int,
        default=None,
        help='seed of the trials (default: drawn; the page states it)',
    )
    parse.add_argument('--jobs', type=int, default=1, help='processes at once (default 1)')
    parse.add_argument('-o', dest='output', metavar='DIR', required=True, help='page and figures')
    return parse


def benchmark(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    cli.check_least(options, trials=0, jobs=1, seed=0)
    layout.check_libraries()
    chosen, left_out = methods.chosen(options.method)
    sources = manifest.load(Path(options.manifest))
    if not Path(options.folder).is_dir():
        raise UserError(f'{options.folder}: no such folder; fetch the recordings into one')
    folder = make_folder(options.output)
    loaded, missing = manifest.read_all(sources, Path(options.folder))
    parts, unusable = defects.halves(loaded, folder / 'read')
    left_out += [*missing, *unusable]
    for text in left_out:
        cli.note(f'left out: {text}')
    if not loaded:
        raise UserError(f'{options.folder}: has none of the {len(sources)} recordings')
    with open_pool(None, options.jobs) as pool:
        asked = _ask(folder, loaded, parts, chosen, options, pool)
    facts = results.draw_facts(folder / 'level_a', parts, asked.labels)
    made = page.Made(
        asked.seed,
        len(asked.labels),
        asked.sealed,
        loaded,
        left_out,
        facts,
        results.grade(facts, asked.answers),
        results.grade_physical(asked.physical, asked.answers),
    )
    return _write(folder, made)


class _Asked(NamedTuple):
    """The answers of all methods, and what was asked."""

    seed: int
    sealed: str  # SHA-256 of salt and labels; '' without trials
    labels: Sequence[trials.Label]
    physical: dict[str, manifest.Loaded]
    answers: results.Answers


def _ask(
    folder: Path,
    loaded: Sequence[manifest.Loaded],
    parts: Sequence[Half],
    chosen: dict[str, str],
    options: argparse.Namespace,
    pool: Pool,
) -> _Asked:
    """Draw and seal level A, ask all methods, and open the labels."""
    drawn, sealed = folder / 'level_a', ''
    physical = run.save_cases(folder / 'physical', loaded)
    stems = [folder / 'physical' / name for name in physical]
    if parts and options.trials:
        sealed = defects.seal(drawn, parts, options.seed, options.trials, pool, cli.progress)
        print(f'SHA-256 of salt and labels: {sealed}', flush=True)
        stems += defects.save_untouched(folder / 'untouched', parts)
        stems += [path.with_suffix('') for path in sorted(drawn.glob('recordings/*.csv'))]
    answers = run.ask_all(folder, chosen, stems, pool, cli.progress)
    if not sealed:
        return _Asked(options.seed or 0, '', [], physical, answers)
    setup, labels = trials.committed_labels(drawn)
    return _Asked(setup.seed, sealed, labels, physical, answers)


def _write(folder: Path, made: page.Made) -> int:
    """Write page, figures and picture, and print the result."""
    said = page.report(made)
    figures = results.as_json(made.facts, made.rows, made.physical)
    write_text(folder / 'benchmark.json', json.dumps(figures, indent=1) + '\n')
    write_text(folder / 'benchmark.md', said.markdown())
    picture = page.picture(made) if made.rows else None
    write_text(folder / 'benchmark.html', said.html(picture))
    if picture is not None:
        (folder / 'benchmark.png').write_bytes(png(picture))
    cli.print_end(
        [said.said[0], '', *page.screen(made), ''],
        [folder / f'benchmark.{end}' for end in ('html', 'md', 'json', 'png')],
    )
    return 0


def main() -> int:
    """Run the tool on the command line."""
    return cli.run(parser(), benchmark)
