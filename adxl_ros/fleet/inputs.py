# SPDX-License-Identifier: Apache-2.0

"""
The recordings of a fleet: files, folders, globs, URLs of fsspec, and manifests.

A folder with a `metadata.yaml` is one recording, a bag. A manifest is a CSV or Parquet file with a
column `url`, and optionally `serial`, `params` and `date`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
import csv
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from glob import has_magic
import hashlib
from io import TextIOWrapper
import os
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from adxl_ros.errors import install_hint, one_line, UserError
from adxl_ros.files import recording
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import NO_SERIAL
from adxl_ros.files.tables import TABLE_ENDINGS
from adxl_ros.fleet.row import as_date, TABLE
from adxl_ros.report.page import as_utf_8, without_secrets

_ENDINGS = ('.csv', '.mcap', '.db3')
"""Ends of the names of recordings in a folder, beside those of other tables."""
_BAG = 'metadata.yaml'  # File that makes a folder a bag
_TIMES = ('mtime', 'LastModified', 'last_modified', 'updated', 'modified')
"""Properties of an object that are the time of the last change, by the names of file systems."""
_STAMPS = (
    'ETag',
    'etag',
    'e_tag',
    'md5Hash',
    'Content-MD5',
    'Digest',
    'created',
    'ino',
    'Last-Modified',
    *_TIMES,
)
"""Properties of an object that change with its content."""
_THREADS = 32
"""Objects of a manifest that are looked up at once. Chosen: a server answers in 0.1 s."""
_SILENCE_S = 60.0
"""Time in which a web server must accept a connection and send something, s. Chosen: the whole may
take as long as it likes, where aiohttp would stop after five minutes."""
_DATES_S = (946684800.0, 4102444800.0)
"""Stamps between these count from 1970, s: the years 2000 to 2100. Others count from a start."""
NO_FILE = 'no such file'  # Fault of a recording that is not there
_MANIFEST_COLUMNS = ('url', 'serial', 'params', 'date')  # Columns of a manifest


@dataclass(frozen=True)
class FoundRecording:
    """One recording, as it was found."""

    url: str  # Its address; an absolute path for a file of this machine
    size_bytes: int | None = None  # Its size; None if unknown
    stamp: str = ''  # A text that changes with the content; empty if the server states nothing
    modified: str = ''  # Time of the last change, ISO 8601, UTC; empty if unknown
    # serial, params, date: What a manifest states: serial number, parameter file, and begin of the
    # recording, ISO 8601; empty for nothing
    serial: str = ''
    params: str = ''
    date: str = ''
    fault: str = ''  # Why it cannot be read; empty if it was found
    address: str = field(default='', repr=False)  # With its secrets; empty if it has none


def file_system(address: str) -> tuple[Any, str]:
    """Return the file system of an address, and the path in it."""
    from fsspec.core import url_to_fs
    from fsspec.implementations.local import LocalFileSystem

    # A path of this machine may have two colons, which join addresses.
    if '://' not in address or address.startswith('file://'):
        return LocalFileSystem(), os.path.normpath(LocalFileSystem._strip_protocol(address))
    options: dict[str, Any] = {}
    try:
        if address.lower().startswith(('http://', 'https://')):
            from aiohttp import ClientTimeout

            options['client_kwargs'] = {
                'timeout': ClientTimeout(total=None, sock_connect=_SILENCE_S, sock_read=_SILENCE_S)
            }
        return url_to_fs(address, **options)
    except (ImportError, ValueError) as error:
        # fsspec itself says what to install.
        name = getattr(error, 'name', None)
        reason = one_line(error) + (f'; {install_hint(name)}' if name else '')
    except Exception as error:
        reason = f'cannot be opened: {one_line(error)}'
    raise UserError(without_secrets(f'{address}: {reason}'))


def find_sources(inputs: Iterable[str]) -> list[FoundRecording]:
    """Find the recordings of a command line; the table of a fleet is none."""
    sources: dict[str, FoundRecording] = {}
    for text in inputs:
        try:
            sources |= {source.url: source for source in _of_input(text)}
        except UserError as error:
            raise UserError(without_secrets(str(error))) from None
        except Exception as error:
            raise UserError(
                without_secrets(f'{text}: cannot be listed: {one_line(error)}')
            ) from None
    return [sources[url] for url in sorted(sources)]


def _of_input(text: str) -> Iterable[FoundRecording]:
    """Return the recordings of one input."""
    fs, path = file_system(text)
    # In a web address only * makes a glob.
    is_glob = '*' in path or ('://' not in path and has_magic(path))
    if is_glob and not os.path.exists(path):
        return _of_listing(text, fs, path, fs.glob(path, detail=True))
    # A web server answers `isdir` with the whole file.
    if os.path.isdir(path) or (not _is_recording_name(path) and fs.isdir(path)):
        return _of_listing(text, fs, path, {path: {'type': 'directory'}})
    rows = _manifest_rows(text, fs, path)
    return [look_up(fs, path)] if rows is None else _of_manifest(text, rows)


def _of_listing(
    text: str, fs: Any, path: str, named: Mapping[str, Mapping[str, Any]]
) -> list[FoundRecording]:
    """
    Return the recordings of a folder or a glob, those in folders too; a bag is one recording.

    named: what the folder or the glob names, by path. Hidden files do not count, unless the input
    asks for them.
    """
    files: dict[str, Mapping[str, Any]] = {}
    for name, info in named.items():
        files |= fs.find(name, detail=True) if info['type'] == 'directory' else {name: info}
    bags = {name.rpartition('/')[0] for name in files if file_name(name) == _BAG}
    found: dict[str, dict[str, Mapping[str, Any]]] = {}
    for name, info in files.items():
        bag = next(
            (str(folder) for folder in PurePosixPath(name).parents if str(folder) in bags), ''
        )
        is_recording = name in named or _is_recording_name(name)
        if bag or (is_recording and file_name(name) != TABLE):
            found.setdefault(bag or name, {})[name] = info
    sources = [
        _of_files(fs, name, content)
        for name, content in found.items()
        if name.count('/.') <= path.count('/.')
    ]
    if not sources:
        raise UserError(
            f'{text}: matches nothing'
            if path not in named
            else f'{text}: has no recording (*{", *".join(_ENDINGS)}, a bag or a table)'
        )
    return sources


def file_name(path: str) -> str:
    """Return the name of the file of a path; that of a web address ends before its query."""
    return PurePosixPath(urlsplit(path).path if '://' in path else path).name


def _is_recording_name(path: str) -> bool:
    """Return whether the name of a file is that of a recording, for folders and manifests."""
    return PurePosixPath(file_name(path)).suffix.lower() in (*_ENDINGS, *TABLE_ENDINGS)


def look_up(fs: Any, path: str) -> FoundRecording:
    """Look up one recording."""
    try:
        info = fs.info(path)
        if info['type'] != 'directory':
            return _of_files(fs, path, {path: info})
        files = fs.find(path, detail=True)
        return (
            _of_files(fs, path, files)
            if _BAG in map(file_name, files)
            else _source(fs, path, fault=f'is a folder without {_BAG}, not a recording')
        )
    except Exception as error:
        if not isinstance(error, FileNotFoundError):
            # A connection that broke is not used again.
            fs.clear_instance_cache()
        return _source(fs, path, fault=fault_of(error))


def fault_of(error: BaseException) -> str:
    """Return in words why a file cannot be read."""
    cause = error.__cause__
    # fsspec reports every failure of a web server as a file that is not found.
    if isinstance(error, FileNotFoundError) and (
        cause is None or getattr(cause, 'status', None) == 404
    ):
        return NO_FILE
    reason = getattr(error, 'strerror', None) or one_line(cause or error) or type(error).__name__
    return f'cannot be read: {without_secrets(reason)}'


def _source(fs: Any, path: str, **known: Any) -> FoundRecording:
    """Return a recording by its address, which is the path itself on this machine."""
    # A name that is not UTF-8 has no place in a table.
    address = as_utf_8(str(fs.unstrip_protocol(path)))
    options = fs.storage_options
    host = options.get('host')
    port = options.get('port')
    user = options.get('username')
    password = options.get('password')
    if host:
        # The path in a server does not name the server.
        server = f'{host}:{port}' if port else host
        if user and password:
            server = f'{user}:{password}@{server}'
        elif user:
            server = f'{user}@{server}'
        address = address.replace(':///', f'://{server}/', 1)
    url = without_secrets(address)
    return FoundRecording(
        url.removeprefix('file://'), **known, address=address if address != url else ''
    )


def _of_files(fs: Any, path: str, files: Mapping[str, Mapping[str, Any]]) -> FoundRecording:
    """Return the recording that a file, or all files of a bag, make."""
    if any(info['type'] not in ('file', 'link') for info in files.values()):
        return _source(fs, path, fault='is no file')
    if as_utf_8(path) != path:
        return _source(fs, path, fault='its name is not UTF-8; rename it')
    sizes = [info.get('size') for info in files.values()]
    stated = [
        [name, *(str(info.get(key)) for key in ('size', *_STAMPS))]
        for name, info in sorted(files.items())
        if any(map(info.get, _STAMPS))
    ]
    stamp = hashlib.sha256(repr(stated).encode()).hexdigest()
    return _source(
        fs,
        path,
        size_bytes=None if None in sizes else sum(filter(None, sizes)),
        stamp=stamp if len(stated) == len(files) else '',
        modified=max(map(_modified, files.values())),
    )


def _modified(info: Mapping[str, Any]) -> str:
    """Return the time of the last change, ISO 8601, UTC; empty if unknown."""
    value = next((info[name] for name in _TIMES if info.get(name)), '')
    if isinstance(value, (int, float)):
        value = datetime.fromtimestamp(value, timezone.utc)
    return as_date(str(value))


def _manifest_rows(text: str, fs: Any, path: str) -> list[dict[str, str]] | None:
    """
    Return the rows of a manifest.

    It is None for a recording, and where nothing can be read: its task reports why.
    """
    suffix = PurePosixPath(file_name(path)).suffix.lower()
    if suffix not in ('.csv', '.parquet', '.pq') or (
        os.path.exists(path) and not os.path.isfile(path)
    ):  # a pipe may never end
        return None
    try:
        with fs.open(path, 'rb') as file:
            if suffix == '.csv':
                return _csv_rows(text, TextIOWrapper(file, 'utf-8-sig', newline=''))
            from pyarrow import parquet

            content = parquet.ParquetFile(file)
            names = [name for name in _MANIFEST_COLUMNS if name in content.schema_arrow.names]
            if 'url' not in names:
                return None
            return [
                {name: '' if value is None else str(value) for name, value in row.items()}
                for row in content.read(names).to_pylist()
            ]
    except UserError:
        raise
    except Exception:
        return None


def _csv_rows(text: str, file: Iterable[str]) -> list[dict[str, str]] | None:
    """Return the rows of a manifest; None for a recording."""
    lines = (line for line in file if line.strip() and not line.startswith('#'))
    table = csv.DictReader(lines, skipinitialspace=True)
    if 'url' not in (table.fieldnames or ()):
        return None
    rows = list(table)
    for number, row in enumerate(rows, 1):
        if None in row or None in row.values():
            raise UserError(
                f'{text}: row {number}: has not the {len(table.fieldnames or ())} '
                'columns of the header'
            )
    return rows


def _of_manifest(text: str, rows: list[dict[str, str]]) -> Iterable[FoundRecording]:
    """Return the recordings that a manifest lists; the last row of a recording counts."""
    folder = text.rpartition('/')[0]
    if not rows:
        raise UserError(f'{text}: the manifest has no row below its header')
    for number, row in enumerate(rows, 1):
        if not row['url']:
            raise UserError(f'{text}: row {number}: url is empty')
        if row.get('date') and not as_date(row['date']):
            raise UserError(
                f'{text}: row {number}: date is {row["date"]!r}, expected ISO 8601, '
                'for example 2026-11-01T10:00:00Z'
            )

    def source(row: dict[str, str]) -> FoundRecording:
        url = row.get('url', '')
        params = row.get('params', '')
        serial = row.get('serial', '')
        try:
            recorded = look_up(*file_system(_beside(folder, url)))
        except UserError as error:
            plain = without_secrets(url)
            recorded = FoundRecording(plain, fault=one_line(error).removeprefix(f'{plain}: '))
        return replace(
            recorded,
            serial='' if serial == NO_SERIAL else serial,
            params=_beside(folder, params) if set(params) & set('/.') else params,
            date=as_date(row.get('date', '')),
        )

    with ThreadPoolExecutor(_THREADS) as pool:
        return list(pool.map(source, rows))


def _beside(folder: str, url: str) -> str:
    """Return an address of a manifest; one that is relative counts from the manifest's folder."""
    is_whole = '://' in url or Path(url).is_absolute()
    return f'{folder}/{url}' if folder and url and not is_whole else url


class Stated(NamedTuple):
    """What a recording states of itself; '' where it states nothing."""

    serial: str = ''
    date: str = ''  # Its begin, ISO 8601 in UTC


def stated_by(sources: Iterable[FoundRecording]) -> list[Stated]:
    """Return what recordings of this machine state."""
    with ThreadPoolExecutor(_THREADS) as pool:
        return list(pool.map(_stated, sources))


def _stated(source: FoundRecording) -> Stated:
    if source.fault or '://' in source.url:
        return Stated()
    try:
        first = next(recording.blocks(source.url, 1))
        return Stated(first.stream_info.texts.get('serial', ''), begin_of(first).text)
    except Exception:
        # Whatever it is, the task of this recording reports it.
        return Stated()


class Date(NamedTuple):
    """When a recording was made."""

    text: str = ''  # ISO 8601 in UTC; empty where it is not known
    source: str = ''  # What states it: manifest, header, stamps or file


def begin_of(first: Recording) -> Date:
    """Return the begin that a recording states."""
    stated = as_date(first.info.get('date', ''))
    if stated:
        return Date(stated, 'header')
    begin_s = first.epoch_ns / 1e9 + float(first.time_s[0]) if len(first) else 0.0
    if _DATES_S[0] < begin_s < _DATES_S[1]:
        return Date(datetime.fromtimestamp(begin_s, timezone.utc).isoformat(), 'stamps')
    return Date()
