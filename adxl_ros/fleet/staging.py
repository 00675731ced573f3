# SPDX-License-Identifier: Apache-2.0

"""
A recording of any address as a local file, for the time of a task.

It is copied into a temporary folder that only this task uses. Size and free space are checked
first, and the copy is hashed. A recording that changes meanwhile is refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
import errno
import fcntl
import hashlib
import os
from pathlib import Path, PurePosixPath
import shutil
import tempfile
from time import time
from typing import Any, NamedTuple

from adxl_ros.errors import one_line, UserError
from adxl_ros.fleet.inputs import (
    fault_of,
    file_name,
    file_system,
    look_up,
    NO_FILE,
    Source,
    Unreachable,
)
import yaml

LARGEST_BYTES = 16 << 30
"""Largest recording, byte. Chosen: a day of three axes at 2 kHz as CSV."""
_SPARE_BYTES = 64 << 20
"""Space that stays free, byte. Chosen: a task writes some MB."""
_READ_BYTES = 1 << 20
"""Bytes that are copied at a time (chosen: bounds the memory)."""
_ABANDONED_S = 600.0
"""Age of an empty folder that no worker uses, s. Chosen: far longer than it takes to lock one."""
_BAG = 'metadata.yaml'
"""File of a bag that names its other files."""


class StagingError(Exception):
    """A recording could not be copied; it may be possible later, or on another machine."""


class Staged(NamedTuple):
    """The copy of a recording."""

    path: Path  # The file or folder
    content: str  # SHA-256 of the content, as `files.checksum.sha256` gives it
    size_bytes: int  # Its size


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Yield an empty folder; those that killed workers left behind are removed first."""
    root = Path(tempfile.gettempdir(), f'adxl_ros_fleet_{os.getuid()}')
    try:
        root.mkdir(mode=0o700, exist_ok=True)
        _remove_abandoned(root)
        folder = Path(tempfile.mkdtemp(dir=root))
    except OSError as error:
        raise StagingError(f'{root}: no temporary folder: {error.strerror}') from None
    lock = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def _remove_abandoned(root: Path) -> None:
    """Remove folders whose worker is gone: nobody locks them."""
    for folder in root.iterdir():
        with suppress(OSError):
            lock = os.open(folder, os.O_RDONLY)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                # One that is just being made is empty, and not locked yet.
                if any(folder.iterdir()) or time() - folder.stat().st_mtime > _ABANDONED_S:
                    shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(lock)


def stage(source: Source, folder: Path, largest_bytes: int = LARGEST_BYTES) -> Staged:
    """Copy a recording into a folder."""
    try:
        fs, path = file_system(source.url, source.secret)
    except Unreachable as reason:
        raise StagingError(one_line(reason)) from None
    before = look_up(fs, path, source.url)
    if before.fault:
        error = UserError if before.fault == NO_FILE else StagingError
        raise error(f'{source.url}: {before.fault}')
    _check_size(source.url, before.size_bytes, folder, largest_bytes)
    budget = _Budget(source.url, before.size_bytes, largest_bytes)
    try:
        # A web server answers `isdir` with the whole file.
        if fs.info(path)['type'] == 'directory':
            target, content = _copy_folder(fs, path, source.url, folder, budget)
        else:
            target = folder / _safe_name(file_name(path), source.url)
            content = _copy(fs, path, target, budget)
    except (UserError, StagingError):
        raise
    except Exception as error:
        # A connection that broke is not used again.
        fs.clear_instance_cache()
        raise StagingError(_reason(source.url, error)) from None
    fs.invalidate_cache()
    after = look_up(fs, path, source.url)
    if (after.stamp, after.size_bytes) != (before.stamp, before.size_bytes) or \
            before.size_bytes not in (None, budget.used_bytes):
        raise _changed(source.url)
    return Staged(target, content, budget.used_bytes)


def _changed(url: str) -> StagingError:
    """Return the error of a recording that changes."""
    return StagingError(f'{url}: changed while it was read; is it still being written?')


def _reason(url: str, error: Exception) -> str:
    """Return in one line why a copy failed."""
    if isinstance(error, OSError) and error.errno == errno.ENOSPC:
        return f'{url}: no space left in {tempfile.gettempdir()}; set TMPDIR to a larger disk'
    return f'{url}: {fault_of(error)}'


def _check_size(url: str, size_bytes: int | None, folder: Path, largest_bytes: int) -> None:
    """Refuse what is too large, before anything is copied."""
    if size_bytes is None:
        return
    if size_bytes > largest_bytes:
        raise UserError(f'{url}: has {size_bytes / 1e9:.3g} GB, expected '
                        f'{largest_bytes / 1e9:.3g} GB at most; split it')
    free = shutil.disk_usage(folder).free
    if size_bytes + _SPARE_BYTES > free:
        raise StagingError(f'{url}: needs {size_bytes / 1e6:.3g} MB beside '
                           f'{_SPARE_BYTES / 1e6:.3g} MB that stay free, but '
                           f'{tempfile.gettempdir()} has {free / 1e6:.3g} MB free; set TMPDIR to '
                           'a larger disk')


class _Budget:
    """Counts the copied bytes of a recording, whose size may be unknown before."""

    def __init__(self, url: str, size_bytes: int | None, largest_bytes: int) -> None:
        self._url, self._size_bytes, self._largest_bytes = url, size_bytes, largest_bytes
        self.used_bytes = 0

    def use(self, count: int) -> None:
        """Count bytes, and refuse too many."""
        self.used_bytes += count
        if self._size_bytes is not None and self.used_bytes > self._size_bytes:
            raise _changed(self._url)
        if self.used_bytes > self._largest_bytes:
            raise UserError(f'{self._url}: is larger than {self._largest_bytes / 1e9:.3g} GB; '
                            'split it')


def _copy(fs: Any, path: str, target: Path, budget: _Budget) -> str:
    """Copy a file, and return its SHA-256."""
    checksum = hashlib.sha256()
    # A web server need not offer parts of a file.
    options = {'block_size': 0} if '://' in path else {}
    with fs.open(path, 'rb', **options) as file, open(target, 'wb') as copy:
        while block := file.read(_READ_BYTES):
            budget.use(len(block))
            checksum.update(block)
            copy.write(block)
    return checksum.hexdigest()


def _safe_name(name: str, url: str) -> str:
    """Return the name of a file, which must lead nowhere else."""
    if not name or name in ('.', '..') or set(name) & set('/\\\0'):
        raise UserError(f'{url}: {name!r} is no name of a file')
    return name


def _copy_folder(fs: Any, base: str, url: str, folder: Path, budget: _Budget) -> tuple[Path, str]:
    """Copy a bag, and return its folder and its SHA-256."""
    target = folder / _safe_name(PurePosixPath(base).name, url)
    checksums = {}
    for name, info in fs.find(base, detail=True).items():
        relative = PurePosixPath(name).relative_to(PurePosixPath(base))
        _refuse_outside(relative, name, base, info, url)
        copy = target / relative
        copy.parent.mkdir(parents=True, exist_ok=True)
        checksums[copy] = _copy(fs, name, copy, budget)
    _check_metadata(target, url)
    ordered = [checksums[path] for path in sorted(checksums)]
    if len(ordered) == 1:
        return target, ordered[0]
    return target, hashlib.sha256(''.join(f'{line}\n' for line in ordered).encode()).hexdigest()


def _refuse_outside(relative: PurePosixPath, name: str, base: str, info: Any, url: str) -> None:
    """Refuse a file of a folder that lies elsewhere: by its name, or by a link."""
    is_outside = relative.is_absolute() or '..' in relative.parts or \
        any(set(part) & set('\\\0') for part in relative.parts)
    if info.get('islink'):
        is_outside |= not Path(name).resolve().is_relative_to(Path(base).resolve())
    if is_outside:
        raise UserError(f'{url}: {relative} leads outside of the folder')


def _check_metadata(target: Path, url: str) -> None:
    """Refuse a bag whose metadata name files outside of its folder."""
    try:
        metadata = yaml.safe_load((target / _BAG).read_text(encoding='utf-8'))
        names = metadata['rosbag2_bagfile_information']['relative_file_paths']
    except (OSError, ValueError, KeyError, TypeError, yaml.YAMLError):
        # The reader of bags reports what is wrong.
        return
    for name in names if isinstance(names, list) else []:
        if PurePosixPath(str(name)).is_absolute() or '..' in PurePosixPath(str(name)).parts:
            raise UserError(f'{url}: {_BAG}: {name} leads outside of the folder')
