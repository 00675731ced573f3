# SPDX-License-Identifier: Apache-2.0

"""Check, fit and diagnose many recordings of many units, on this machine or a Dask cluster."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from time import monotonic

from adxl_ros.errors import install_hint, UserError
from adxl_ros.files import calibration_store
from adxl_ros.files.atomic_write import make_folder
from adxl_ros.files.stream_info import NO_SERIAL
from adxl_ros.fleet.inputs import find_sources, FoundRecording, stated_by
from adxl_ros.fleet.row import (
    as_date,
    make_recipe,
    OUTCOMES,
    PAGE,
    Recipe,
    Row,
    TABLE,
    task_names,
    TASKS,
)
from adxl_ros.fleet.run import only_client, Plan, plan, Results, work
from adxl_ros.report.page import command_of_this_process
from adxl_ros.report.quantities import counted, duration, number
from adxl_ros.tools import command_line as cli
from adxl_ros.workers import open_pool, RETRIES

PROG = 'fleet'  # Name of the command, for messages
_EXAMPLES = {
    'all recordings of a folder': 'recordings -o results',
    'a bucket, on a Dask cluster': (
        "'s3://robots/**/*.mcap' --scheduler tcp://head:8786 -o results"
    ),
    'what it would cost': 'manifest.csv -o results --dry-run',
}
"""Examples of arguments, by their purpose."""
_UNITS = 5  # Units that a plan names. Chosen: one or two lines
_SHOWN = ('outcome', 'refused_by', 'serial', 'status')
"""What the screen needs of a row; the others are not kept."""


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parse = cli.argument_parser(PROG, __doc__, _EXAMPLES)
    parse.add_argument(
        'input',
        nargs='+',
        metavar='INPUT',
        help='file, folder, glob, URL of fsspec (s3://, gs://, https://, sftp://), '
        'or a manifest: CSV or Parquet with url, serial, params, date',
    )
    parse.add_argument(
        '--do',
        metavar='TASKS',
        default=','.join(TASKS),
        help='tasks, with commas (default: %(default)s)',
    )
    parse.add_argument(
        '-o',
        dest='output',
        metavar='DIR',
        required=True,
        help='rows, table, page and single reports; an interrupted run continues',
    )
    cli.add_overwrite_option(parse)
    parse.add_argument(
        '--params',
        metavar='FILE',
        help='parameter file of all recordings (default: the calibration of each '
        'unit at the date of the recording, else the nominal sensor)',
    )
    parse.add_argument(
        '--store',
        metavar='DIR',
        default=str(calibration_store.default_folder()),
        help='the calibration store (default: %(default)s); empty for none',
    )
    pool = parse.add_mutually_exclusive_group()
    pool.add_argument('--scheduler', metavar='ADDRESS', help='of a Dask cluster to run on')
    pool.add_argument(
        '--jobs',
        metavar='N',
        type=int,
        help='processes of this machine (default: one for each core)',
    )
    parse.add_argument(
        '--retries',
        metavar='N',
        type=int,
        default=RETRIES,
        help='further attempts where a copy fails or a worker ends (default: %(default)s)',
    )
    parse.add_argument(
        '--only-failed',
        action='store_true',
        help='repeat the recordings that were refused or crashed, no others',
    )
    parse.add_argument(
        '--since',
        metavar='DATE',
        default='',
        help='leave out earlier recordings, by the date that they or a manifest '
        'state, else by the last change of the file',
    )
    parse.add_argument('--limit', metavar='N', type=int, help='work on N recordings at most')
    parse.add_argument('--dry-run', action='store_true', help='only show what there is to do')
    cli.add_recording_options(parse)
    return parse


def fleet(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    cli.check_least(options, jobs=1, retries=0, limit=1)
    missing = [name for name in ('fsspec', 'pyarrow') if find_spec(name) is None]
    if missing:
        raise UserError(f'{PROG} needs {" and ".join(missing)}; {install_hint(*missing)}')
    begin_s = monotonic()
    since = as_date(options.since)
    if options.since and not since:
        raise UserError(f'--since {options.since}: expected a date, for example 2026-11-01')
    tasks = task_names(options.do)
    sources = find_sources(options.input)
    recipe = make_recipe(
        tasks,
        options.params,
        (source.params for source in sources),
        options.store,
        cli.reading_options(options),
    )
    folder = Path(options.output)
    cli.check_outputs(options, folder / TABLE, folder / PAGE)
    plan_after = partial(
        plan,
        sources,
        recipe,
        only_failed=options.only_failed,
        since=since,
        limit=options.limit,
    )
    if options.dry_run:
        results = Results(folder)
        cli.print_end(
            _plan_lines(plan_after(results), results),
            [],
            command_of_this_process().replace(' --dry-run', ''),
        )
        return 0
    make_folder(folder)
    with only_client(folder):
        results = Results(folder)
        to_do = plan_after(results)
        try:
            rows = _worked(options, recipe, to_do.todo, results) if to_do.todo else []
        finally:
            # Ctrl-C leaves table and page of what is done.
            files, findings = _written(folder, results)
    is_repeated = any(row['outcome'] == 'crashed' or row['refused_by'] == 'stage' for row in rows)
    lines = [*_result_lines(rows, to_do), '']
    if findings:
        lines += [*findings, '']
    cli.print_end(
        lines,
        files,
        f'{command_of_this_process()} --only-failed' if is_repeated else '',
        monotonic() - begin_s,
    )
    return 1 if rows and not any(row['outcome'] == 'done' for row in rows) else 0


def _worked(
    options: argparse.Namespace, recipe: Recipe, todo: Sequence[FoundRecording], results: Results
) -> list[Row]:
    """Work on recordings; return what the screen shows of each."""
    shared = (recipe, frozenset(results.known))
    rows = []
    with (
        open_pool(options.scheduler, options.jobs, shared) as pool,
        cli.progress(PROG) as show,
    ):
        for row in work(pool, todo, recipe, results, options.retries, show):
            rows.append({name: row[name] for name in _SHOWN})
    return rows


def _written(folder: Path, results: Results) -> tuple[list[Path], list[str]]:
    """Write table and page; return files and findings, or report that a page is not possible."""
    from adxl_ros.fleet import page  # only the end of a run needs it

    files = [results.write_table()]
    findings = list[str]()
    try:
        written = page.write(folder)
        files = [*written.files, *files]
        findings = written.findings
    except UserError as error:
        cli.note(f'{PROG}: no page: {error}')
    return [*files, folder / 'reports'], findings


def _plan_lines(to_do: Plan, results: Results) -> list[str]:
    known = {url: entry.row['serial'] for url, entry in results.newest.items()}
    units = Counter(
        source.serial or stated or known.get(source.url) or NO_SERIAL
        for source, (stated, _) in zip(to_do.todo, stated_by(to_do.todo))
    )
    unknown = units.pop(NO_SERIAL, 0)
    largest = ', '.join(f'{serial} ({count})' for serial, count in units.most_common(_UNITS))
    if len(units) > _UNITS:
        largest += ', ...'
    rows = {
        'done already': str(to_do.done),
        'left out': _left_out(to_do),
        'core hours': f'{to_do.core_hours:.3g}',
        'units': largest and f'{len(units)}: {largest}',
        'unknown unit': counted(unknown, 'recording'),
    }
    size_gb = number(to_do.size_bytes / 1e9, digits=2)
    return [
        f'{counted(len(to_do.todo), "recording")} to do, {size_gb} GB, about '
        f'{duration(3600 * to_do.core_hours)} of one core',
        '',
        *(f' {name:13}{text}' for name, text in rows.items() if text),
        '',
    ]


def _left_out(to_do: Plan) -> str:
    return f'{to_do.outside} by --since, --limit or --only-failed' if to_do.outside else ''


def _result_lines(rows: Sequence[Row], to_do: Plan) -> list[str]:
    if not rows:
        left_out = f' left out  {_left_out(to_do)}' if to_do.outside else ''
        return [f'Nothing to do: {counted(to_do.done, "recording")} had a row before', left_out]
    outcomes = Counter(row['outcome'] for row in rows)
    parts = [f'{outcomes[name]} {name}' for name in OUTCOMES if outcomes[name] or name == 'done']

    def counts(column: str) -> str:
        values = Counter(row[column] for row in rows if row[column])
        return ', '.join(f'{count} {value}' for value, count in values.most_common())

    figures = {
        'units': str(len({row['serial'] for row in rows if row['serial']})),
        'left out': _left_out(to_do),
        'verdicts': counts('status'),
        'refused by': counts('refused_by'),
    }
    return [
        f'{counted(len(rows), "recording")}: {", ".join(parts)}'
        + (f'; {to_do.done} had their row before' if to_do.done else ''),
        '',
        *(f' {name:11}{value}' for name, value in figures.items() if value),
    ]


def main() -> int:
    """Run the tool on the command line."""
    return cli.run(parser(), fleet)
