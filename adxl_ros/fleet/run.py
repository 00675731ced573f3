# SPDX-License-Identifier: Apache-2.0

"""
A fleet from end to end: its rows on disk, which recordings are to be worked on, and the work.

A row is a small file `rows/KEY-URL.json`, written as a whole. `KEY` is the key of the row and
`URL` the begin of the SHA-256 of the address. So a client that is killed loses nothing that was
written. One client at a time works on a folder.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timezone
import fcntl
import hashlib
import json
import os
from pathlib import Path
from typing import Any, NamedTuple

from adxl_ros.errors import one_line, UserError
from adxl_ros.files.atomic_write import atomic_path
from adxl_ros.fleet.inputs import as_date, Source, stated_by
from adxl_ros.fleet.recipe import Recipe
from adxl_ros.fleet.row import arrow_schema, as_table, Row, TABLE
from adxl_ros.fleet.staging import StagingError
from adxl_ros.fleet.task import make_row, refused, Result, TaskCrashed
from adxl_ros.workers import Finished, finished_tasks, make_folder, write

_ROWS = 'rows'
"""Folder of the rows."""
_REPORTS = 'reports'
"""Folder of the files of single recordings."""
_BATCH_ROWS = 1000
"""Rows that are in memory at once while the table is written. Chosen: some MB."""
_LOCK = 'client.lock'
"""File that the client of a folder locks; it names the client."""
_NAME_DIGITS = 16
"""Digits of a SHA-256 in names of files and folders. Chosen: 10⁵ rows have no pair."""
_SECONDS = {'check': (0.02, 30.0), 'noise': (0.05, 60.0), 'fit': (1.0, 100.0),
            'diagnose': (10.0, 500.0)}
"""Usual run time of each task: of any recording, s, and for each GB, s. Measured on one core with
CSV files of 416 s at 250 Hz; replaced by the run times of earlier rows where there are some."""
_IDENTITY = ('url', 'serial', 'date', 'date_source', 'calibration_id', 'calibration_age_days')
"""Columns of a recording whose content is that of another row."""
_COST = ('seconds', 'memory_mb', 'worker')
"""Columns of what a row costs. A copy costs next to nothing; a file that is read again has the
cost of its tasks, by which a further run is estimated."""


@contextmanager
def only_client(folder: Path) -> Iterator[None]:
    """Lock a folder as long as the block, or this process, lasts; say who holds the lock."""
    with open(make_folder(folder) / _LOCK, 'a+', encoding='utf-8') as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            raise UserError(f'{folder}: {file.read() or "another client"} works on it; wait for '
                            'its end, or name another folder') from None
        file.truncate(0)
        file.write(f'process {os.getpid()} on {os.uname().nodename}')
        file.flush()
        yield


class Entry(NamedTuple):
    """What the client keeps in memory of a row."""

    name: str  # Name of the row's file
    written: str  # When it was written, ISO 8601, UTC
    stamp: str  # Stamp of the recording
    digest: str  # See `Recipe.digest`
    key: str  # Key of the row
    outcome: str  # One of `row.OUTCOMES`
    # serial, date: Unit and begin of the recording; empty if unknown
    serial: str
    date: str
    date_source: str  # Where the date is from; empty if unknown
    size_bytes: int  # Size of the recording, byte
    seconds: float  # Run time of its tasks, s
    tasks: tuple[str, ...]  # Its tasks


class Results:
    """The folder of a fleet."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder  # The folder
        self.newest: dict[str, Entry] = {}  # The newest row of each recording, by URL
        self._by_size: dict[int, set[str]] = {}
        rows = folder / _ROWS
        for path in rows.iterdir() if rows.is_dir() else ():
            if path.suffix == '.json' and not path.name.startswith('.'):
                content = _read(path)
                if content is not None:
                    self._add(path.name, content)

    def _add(self, name: str, content: dict[str, Any]) -> None:
        """Keep what is needed of a row."""
        row = content['row']
        entry = Entry(name, row['written'], content['stamp'], content['digest'], row['key'],
                      row['outcome'], row['serial'] or '', row['date'] or '',
                      row['date_source'] or '', row['size_bytes'] or 0,
                      row['seconds'] or 0.0, tuple(row['tasks']))
        present = self.newest.get(row['url'])
        if present is None or (present.written, present.name) <= (entry.written, name):
            self.newest[row['url']] = entry
        if row['hash'] and entry.outcome != 'crashed':
            self._by_size.setdefault(entry.size_bytes, set()).add(row['key'])

    def keys_of(self, sources: Iterable[Source]) -> frozenset[str]:
        """Return the keys of rows that may have the content of recordings, by their sizes."""
        sizes = {source.size_bytes or 0 for source in sources}
        return frozenset(key for size in sizes for key in self._by_size.get(size, ()))

    def row_with_key(self, key: str, url: str) -> Row | None:
        """Return a row with a key."""
        of_url = _row_name(key, url)
        for path in sorted((self.folder / _ROWS).glob(f'{key}-*.json'),
                           key=lambda path: (path.name != of_url, path.name)):
            content = _read(path)
            if content is not None:
                return content['row']
        return None

    def put(self, result: Result, attempts: int) -> Row:
        """Write what a task left: its files, then its row."""
        row = {**result.row, 'attempts': attempts,
               'written': datetime.now(timezone.utc).isoformat()}
        if result.files:
            name = f'{_REPORTS}/{row["key"][:_NAME_DIGITS]}'
            folder = make_folder(self.folder / name)
            for file, data in result.files.items():
                write(folder / file, data)
            row['report'] = name
        name = _row_name(row['key'], row['url'])
        content = {'stamp': result.stamp, 'digest': result.digest, 'row': row}
        write(make_folder(self.folder / _ROWS) / name,
              json.dumps(content, allow_nan=False, ensure_ascii=False).encode())
        self._add(name, content)
        return row

    def rows(self) -> Iterator[Row]:
        """Yield the newest row of each recording, by URL."""
        for url in sorted(self.newest):
            content = _read(self.folder / _ROWS / self.newest[url].name)
            if content is not None:
                yield content['row']

    def write_table(self) -> Path:
        """Write the table."""
        from pyarrow import ArrowException, parquet
        path = self.folder / TABLE
        try:
            with atomic_path(path) as fresh, \
                    parquet.ParquetWriter(fresh, arrow_schema(), compression='zstd') as writer:
                for batch in _batches(self.rows()):
                    writer.write_table(as_table(batch))
        except ArrowException as error:
            raise UserError(f'{path}: cannot be written: {one_line(error)}') from None
        return path


def _row_name(key: str, url: str) -> str:
    """Return the name of the file of a row."""
    return f'{key}-{hashlib.sha256(url.encode()).hexdigest()[:_NAME_DIGITS]}.json'


def _batches(rows: Iterable[Row]) -> Iterator[list[Row]]:
    """Yield rows in lists of some length."""
    batch: list[Row] = []
    for row in rows:
        batch.append(row)
        if len(batch) == _BATCH_ROWS:
            yield batch
            batch = []
    yield batch


def _read(path: Path) -> dict[str, Any] | None:
    """Return a row's file; None for one that is not whole, as after a power cut."""
    try:
        content = json.loads(path.read_bytes())
        return content if content['row']['url'] and content['row']['key'] else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


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
    failed = {url for url, entry in results.newest.items() if entry.outcome != 'done'}
    tasks = finished_tasks(pool, make_row, ((source, source.url in failed) for source in sources),
                           retries)
    try:
        for count, end in enumerate(tasks, 1):
            show(count / len(sources))
            yield _written(end, recipe, results)
    finally:
        tasks.close()


def _written(end: Finished, recipe: Recipe, results: Results) -> Row:
    """Write the row of a task that ended."""
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
