# SPDX-License-Identifier: Apache-2.0

"""
A fleet from end to end: its rows on disk, which recordings are to be worked on, and the work.

A row is a small file `rows/KEY-URL.json`, written as a whole. `KEY` is the key of the row and
`URL` the begin of the SHA-256 of the address. So a client that is killed loses nothing that was
written. One client at a time works on a folder.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime, timezone
import fcntl
import hashlib
from itertools import islice
import json
import os
from pathlib import Path
from typing import Any, NamedTuple

from adxl_ros.errors import one_line, UserError
from adxl_ros.files.atomic_write import atomic_path, make_folder, write_bytes, write_text
from adxl_ros.fleet.inputs import FoundRecording, stated_by
from adxl_ros.fleet.row import arrow_schema, as_table, Recipe, Row, TABLE
from adxl_ros.fleet.task import make_row, refused, StagingError, TaskResult
from adxl_ros.workers import Finished, finished_tasks, Pool

_ROWS = 'rows'  # Folder of the rows
_REPORTS = 'reports'  # Folder of the files of single recordings
_BATCH_ROWS = 1000  # Rows that are in memory at once while the table is written. Chosen: some MB
_LOCK = 'client.lock'  # File that the client of a folder locks; it names the client
_NAME_DIGITS = 16
"""Digits of a SHA-256 in names of files and folders. Chosen: 10⁵ rows have no pair."""
_SECONDS = {
    'check': (0.02, 30.0),
    'noise': (0.05, 60.0),
    'fit': (1.0, 100.0),
    'diagnose': (10.0, 500.0),
}
"""Usual run time of each task: of any recording, s, and for each GB, s. Measured on one core with
CSV files of 416 s at 250 Hz."""
_IDENTITY = ('url', 'serial', 'date', 'date_source', 'calibration_id', 'calibration_age_days')
"""Columns of a recording whose content is that of another row, which has its other values."""
_KEPT = ('written', 'key', 'outcome', 'serial', 'date', 'date_source')
"""Columns of a row that the client keeps in memory."""


@contextmanager
def only_client(folder: Path) -> Iterator[None]:
    """Lock a folder as long as the block, or this process, lasts; say who holds the lock."""
    with open(folder / _LOCK, 'a+', encoding='utf-8') as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            raise UserError(
                f'{folder}: {file.read() or "another client"} works on it; wait for '
                'its end, or name another folder'
            ) from None
        file.truncate(0)
        file.write(f'process {os.getpid()} on {os.uname().nodename}')
        file.flush()
        yield


class Entry(NamedTuple):
    """What the client keeps in memory of a row."""

    name: str  # Name of the row's file
    stamp: str  # Stamp of the recording
    digest: str  # See `Recipe.digest`
    row: Row  # Columns `_KEPT`


class Results:
    """The folder of a fleet."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder  # The folder
        self.newest: dict[str, Entry] = {}  # The newest row of each recording, by URL
        # Keys of rows whose content need not be worked on again, with the name of a row's file
        self.known: dict[str, str] = {}
        for path in sorted((folder / _ROWS).glob('[!.]*.json')):
            content = _read(path)
            if content is not None:
                self._add(path.name, content)

    def _add(self, name: str, content: dict[str, Any]) -> None:
        """Keep what is needed of a row."""
        row = content['row']
        entry = Entry(name, content['stamp'], content['digest'], {key: row[key] for key in _KEPT})
        present = self.newest.get(row['url'])
        if present is None or present.row['written'] <= row['written']:
            self.newest[row['url']] = entry
        if row['hash'] and row['outcome'] != 'crashed':
            self.known.setdefault(row['key'], name)

    def put(self, result: TaskResult, attempts: int) -> Row:
        """Write what a task left: its files, then its row."""
        row = {
            **result.row,
            'attempts': attempts,
            'written': datetime.now(timezone.utc).isoformat(),
        }
        if result.files:
            row['report'] = f'{_REPORTS}/{row["key"][:_NAME_DIGITS]}'
            folder = make_folder(self.folder / row['report'])
            for file, data in result.files.items():
                write_bytes(folder / file, data)
        of_url = hashlib.sha256(row['url'].encode()).hexdigest()[:_NAME_DIGITS]
        name = f'{row["key"]}-{of_url}.json'
        content = {'stamp': result.stamp, 'digest': result.digest, 'row': row}
        text = json.dumps(content, allow_nan=False, ensure_ascii=False)
        write_text(make_folder(self.folder / _ROWS) / name, text)
        self._add(name, content)
        return row

    def write_table(self) -> Path:
        """Write the table: the newest row of each recording, by URL."""
        from pyarrow import ArrowException, parquet

        path = self.folder / TABLE
        contents = (
            _read(self.folder / _ROWS / self.newest[url].name) for url in sorted(self.newest)
        )
        rows = (content['row'] for content in contents if content is not None)
        try:
            with (
                atomic_path(path) as fresh,
                parquet.ParquetWriter(fresh, arrow_schema(), compression='zstd') as writer,
            ):
                while batch := list(islice(rows, _BATCH_ROWS)):
                    writer.write_table(as_table(batch))
        except ArrowException as error:
            raise UserError(f'{path}: cannot be written: {one_line(error)}') from None
        return path


def _read(path: Path) -> dict[str, Any] | None:
    """Return a row's file; None for one that is not whole, as after a power cut."""
    try:
        content = json.loads(path.read_bytes())
        return content if content['row']['url'] and content['row']['key'] else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


class Plan(NamedTuple):
    """What a run has to do."""

    todo: list[FoundRecording]  # Recordings to work on
    done: int  # Number of recordings that have their row
    outside: int  # Number of recordings that --since, --limit or --only-failed leave out
    size_bytes: int  # Size of the recordings to work on
    core_hours: float  # Expected run time on one core, h


def plan(
    sources: Sequence[FoundRecording],
    recipe: Recipe,
    results: Results,
    only_failed: bool = False,
    since: str = '',
    limit: int | None = None,
) -> Plan:
    """
    Decide which recordings are to be worked on.

    only_failed: whether only those whose row is a refusal or a crash; since: begin of the period,
    ISO 8601, UTC; limit: largest number.
    """
    chosen = _since(sources, since, results) if since else sources
    newest = results.newest
    if only_failed:
        todo = [
            source
            for source in chosen
            if source.url in newest and newest[source.url].row['outcome'] != 'done'
        ]
        done = 0
    else:
        todo = [source for source in chosen if not is_done(source, newest.get(source.url), recipe)]
        done = len(chosen) - len(todo)
    todo = todo[:limit]
    size_bytes = sum(source.size_bytes or 0 for source in todo)
    expected_s = sum(
        _SECONDS[name][0] * len(todo) + _SECONDS[name][1] * size_bytes / 1e9
        for name in recipe.tasks
    )
    return Plan(todo, done, len(sources) - done - len(todo), size_bytes, expected_s / 3600)


def _since(
    sources: Sequence[FoundRecording], since: str, results: Results
) -> list[FoundRecording]:
    """Return the recordings that began at a date or later, and those without a date."""
    dates = {url: entry.row['date'] for url, entry in results.newest.items()}
    unread = [source for source in sources if not (source.date or dates.get(source.url))]
    dates |= {source.url: stated.date for source, stated in zip(unread, stated_by(unread))}
    return [
        source
        for source in sources
        if (source.date or dates.get(source.url) or source.modified or since) >= since
    ]


def is_done(source: FoundRecording, entry: Entry | None, recipe: Recipe) -> bool:
    """Return whether a row is that of a recording as it is now, by the present recipe."""
    if entry is None or source.stamp != entry.stamp or not (source.stamp or source.fault):
        return False
    row = entry.row
    stated_date = row['date'] if row['date_source'] == 'manifest' else ''
    if source.date != stated_date:
        return False
    parameters = recipe.parameters_of(
        source.serial or row['serial'] or '', source.date or row['date'] or '', source.params
    )
    return recipe.digest(parameters, source.serial) == entry.digest


def work(
    pool: Pool,
    sources: Sequence[FoundRecording],
    recipe: Recipe,
    results: Results,
    retries: int,
    show: Callable[[float], None],
) -> Iterator[Row]:
    """Work on recordings, and write each row as soon as it is there."""
    failed = {url for url, entry in results.newest.items() if entry.row['outcome'] != 'done'}
    tasks = ((source, source.url in failed) for source in sources)
    for count, end in enumerate(finished_tasks(pool, make_row, tasks, retries), 1):
        show(count / len(sources))
        yield _written(end, recipe, results)


def _written(end: Finished, recipe: Recipe, results: Results) -> Row:
    """Write the row of a task that ended."""
    source: FoundRecording = end.arguments[0]
    error = end.error
    if isinstance(error, UserError):
        raise error
    if error is None:
        result = end.value
    elif isinstance(error, StagingError):
        result = refused(recipe, source, one_line(error))
    else:
        result = refused(
            recipe,
            source,
            f'{type(error).__name__}: {one_line(error)} ({end.attempts} attempts)',
            'crashed',
        )
    if result.is_known:
        content = _read(results.folder / _ROWS / results.known[result.row['key']])
        assert content is not None, 'rows are never removed'
        identity = {name: result.row[name] for name in _IDENTITY}
        result = result._replace(row={**content['row'], **identity})
    return results.put(result, end.attempts)
