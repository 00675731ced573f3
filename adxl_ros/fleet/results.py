# SPDX-License-Identifier: Apache-2.0

"""
The rows of a fleet on disk, and the table that is made of them.

A row is a small file `rows/KEY-URL.json`, written as a whole. `KEY` is the key of the row and
`URL` the begin of the SHA-256 of the address. So two clients that write the same row replace one
file by an equal one, and a client that is killed loses nothing that was written.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from datetime import datetime, timezone
import hashlib
import json
import os
from pathlib import Path
from time import monotonic
from typing import Any, NamedTuple

from adxl_ros.errors import one_line, UserError
from adxl_ros.files.atomic_write import atomic_path
from adxl_ros.fleet.inputs import Source
from adxl_ros.fleet.row import arrow_schema, as_table, Row, TABLE
from adxl_ros.fleet.task import Result
from adxl_ros.jobs.whole_files import make_folder, write

_ROWS = 'rows'
"""Folder of the rows."""
_REPORTS = 'reports'
"""Folder of the files of single recordings."""
_BATCH_ROWS = 1000
"""Rows that are in memory at once while the table is written. Chosen: some MB."""
_LOOK_S = 5.0
"""Time after which the folder is searched for rows of other clients, s; chosen."""
_NAME_DIGITS = 16
"""Digits of a SHA-256 in names of files and folders. Chosen: 10⁵ rows have no pair."""


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
        self._names: set[str] = set()
        self._looked_s = -_LOOK_S
        self._by_size: dict[int, set[str]] = {}
        self.look()

    def look(self) -> None:
        """Read rows that were written since the last time, by this client or another one."""
        if monotonic() - self._looked_s < _LOOK_S:
            return
        rows = self.folder / _ROWS
        names = {entry.name for entry in os.scandir(rows) if entry.name.endswith('.json')
                 and not entry.name.startswith('.')} if rows.is_dir() else set()
        for name in names - self._names:
            content = _read(rows / name)
            if content is not None:
                self._add(name, content)
        self._looked_s = monotonic()

    def _add(self, name: str, content: dict[str, Any]) -> None:
        """Keep what is needed of a row."""
        row = content['row']
        entry = Entry(name, row['written'], content['stamp'], content['digest'], row['key'],
                      row['outcome'], row['serial'] or '', row['date'] or '',
                      row['date_source'] or '', row['size_bytes'] or 0,
                      row['seconds'] or 0.0, tuple(row['tasks']))
        self._names.add(name)
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
        self._looked_s = -_LOOK_S
        self.look()
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
