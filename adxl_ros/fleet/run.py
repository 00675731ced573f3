# SPDX-License-Identifier: Apache-2.0

"""A fleet from end to end: which recordings are to be worked on, the work, and what it costs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
import os
import random
from typing import NamedTuple

from adxl_ros.errors import one_line, UserError
from adxl_ros.fleet.inputs import as_date, Source, stated_by
from adxl_ros.fleet.recipe import Recipe
from adxl_ros.fleet.results import Entry, Results
from adxl_ros.fleet.row import Row
from adxl_ros.fleet.staging import StagingError
from adxl_ros.fleet.task import make_row, refused, Result, TaskCrashed
from adxl_ros.jobs.run import Finished, finished_tasks

_SECONDS = {'check': (0.02, 30.0), 'noise': (0.05, 60.0), 'fit': (1.0, 100.0),
            'diagnose': (10.0, 500.0)}
"""Usual run time of each task: of any recording, s, and for each GB, s. Measured on one core with
CSV files of 416 s at 250 Hz; replaced by the run times of earlier rows where there are some."""
_IDENTITY = ('url', 'serial', 'date', 'date_source', 'calibration_id', 'calibration_age_days')
"""Columns of a recording whose content is that of another row."""
_COST = ('seconds', 'memory_mb', 'worker')
"""Columns of what a row costs. A copy costs next to nothing; a file that is read again has the
cost of its tasks, by which a further run is estimated."""


@dataclass(frozen=True)
class Plan:
    """What a run has to do."""

    todo: tuple[Source, ...]  # Recordings to work on
    done: int  # Number of recordings that have their row
    outside: int  # Number of recordings that --since, --limit or --only-failed leave out
    # Serial numbers of the recordings to work on as far as they are known before; else empty
    serials: tuple[str, ...]
    size_bytes: int  # Size of the recordings to work on
    core_hours: float  # Expected run time on one core, h


class Selection(NamedTuple):
    """Which recordings a run works on."""

    only_failed: bool = False  # Whether only those whose row is a refusal or a crash
    since: str = ''  # Begin of the period, ISO 8601, UTC; empty for all
    limit: int | None = None  # Largest number; None for all


def plan(sources: Sequence[Source], recipe: Recipe, results: Results,
         selection: Selection) -> Plan:
    """Decide which recordings are to be worked on."""
    todo, done = [], 0
    chosen = _since(sources, selection.since, results) if selection.since else sources
    outside = len(sources) - len(chosen)
    for source in chosen:
        entry = results.newest.get(source.url)
        if selection.only_failed:
            if entry is not None and entry.outcome != 'done':
                todo.append(source)
            else:
                outside += 1
        elif entry is not None and is_done(source, entry, recipe):
            done += 1
        else:
            todo.append(source)
    if selection.limit is not None:
        outside += max(len(todo) - selection.limit, 0)
        todo = todo[:selection.limit]
    serials = [source.serial or _serial(source, results) for source in todo]
    size_bytes = sum(source.size_bytes or 0 for source in todo)
    return Plan(tuple(todo), done, outside, tuple(serials), size_bytes,
                _expected_s(len(todo), size_bytes, recipe, results) / 3600)


def _since(sources: Sequence[Source], since: str, results: Results) -> list[Source]:
    """Return the recordings that began at a date or later, and those without a date."""
    dates = {url: entry.date for url, entry in results.newest.items()}
    # The server of an object states truly when it was written, which is after it began.
    unread = [source for source in sources if not (source.date or dates.get(source.url))
              and ('://' not in source.url or (source.modified or since) >= since)]
    dates |= {source.url: stated.date for source, stated in zip(unread, stated_by(unread))}
    return [source for source in sources
            if (source.date or dates.get(source.url) or source.modified or since) >= since]


def _serial(source: Source, results: Results) -> str:
    """Return the serial number that an earlier row of a recording has; empty for none."""
    entry = results.newest.get(source.url)
    return entry.serial if entry else ''


def is_done(source: Source, entry: Entry, recipe: Recipe) -> bool:
    """Return whether a row is that of a recording as it is now, by the present recipe."""
    if source.stamp != entry.stamp or not (source.stamp or source.fault):
        return False
    if source.date != (entry.date if entry.date_source == 'manifest' else ''):
        return False
    parameters = recipe.parameters_of(source.serial or entry.serial, source.date or entry.date,
                                      source.params)
    return recipe.digest(parameters, source.serial) == entry.digest


def _expected_s(count: int, size_bytes: int, recipe: Recipe, results: Results) -> float:
    """Return the expected run time on one core, s: by earlier rows, else by usual times."""
    earlier = [entry for entry in results.newest.values()
               if entry.tasks == recipe.tasks and entry.outcome == 'done' and entry.size_bytes]
    read = sum(entry.size_bytes for entry in earlier)
    if read:
        return size_bytes * sum(entry.seconds for entry in earlier) / read
    return sum(_SECONDS[name][0] * count + _SECONDS[name][1] * size_bytes / 1e9
               for name in recipe.tasks)


def work(pool: Executor, sources: Sequence[Source], recipe: Recipe, results: Results,
         retries: int, show: Callable[[float], None]) -> Iterator[Row]:
    """Work on recordings, and write each row as soon as it is there."""
    # Two clients on one folder begin at different recordings.
    order = random.Random(os.getpid()).sample(sources, len(sources))
    count = 0
    tasks = finished_tasks(pool, make_row, _arguments(order, recipe, results), retries)
    try:
        for end in tasks:
            row = _written(end, recipe, results)
            count += 1
            show(count / len(order))
            if row is not None:
                yield row
    finally:
        tasks.close()


def _arguments(sources: Iterable[Source], recipe: Recipe, results: Results) -> Iterator[tuple]:
    """Yield the arguments of the tasks, without recordings that another client has done."""
    before = dict(results.newest)
    for source in sources:
        results.look()
        entry = results.newest.get(source.url)
        if entry is not None and entry is not before.get(source.url) \
                and is_done(source, entry, recipe):
            continue
        yield source, entry is not None and entry.outcome != 'done'


def _written(end: Finished, recipe: Recipe, results: Results) -> Row | None:
    """Write the row of a task that ended; None where its content has a row no longer."""
    source: Source = end.arguments[0]
    error = end.error
    if isinstance(error, UserError):
        raise error
    if isinstance(error, TaskCrashed):
        result = error.result
    elif isinstance(error, StagingError):
        result = refused(recipe, source, one_line(error).removeprefix(f'{source.url}: '))
    elif error is not None:
        reason = f'{type(error).__name__}: {one_line(error)}'
        result = refused(recipe, source, f'{reason} ({end.attempts} attempts)', 'crashed')
    else:
        result = end.value
    # What a row costs in this run need not be what its tasks took.
    spent = {name: result.row[name] for name in _COST}
    return {**results.put(_with_known(result, results), end.attempts), **spent}


def _with_known(result: Result, results: Results) -> Result:
    """Return a result; one whose content has a row already gets the values of that row."""
    if not result.is_known:
        return result
    row = results.row_with_key(result.row['key'], result.row['url'])
    assert row is not None, 'rows are never removed'
    is_copy = row['url'] != result.row['url']
    names = (*_IDENTITY, *_COST) if is_copy else _IDENTITY
    return result._replace(row={**row, **{name: result.row[name] for name in names}})


def since_text(text: str) -> str:
    """Return the date of --since, ISO 8601 in UTC; raise `UserError` for another text."""
    date = as_date(text)
    if date is None:
        raise UserError(f'--since {text}: expected a date, for example 2026-11-01')
    return date
