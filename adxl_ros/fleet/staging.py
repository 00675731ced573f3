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
from pathlib import Path
import shutil
import tempfile
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

_LARGEST_BYTES = 16 << 30
"""Largest recording, byte. Chosen: a day of three axes at 2 kHz as CSV."""
_SPARE_BYTES = 64 << 20
"""Space that stays free, byte. Chosen: a task writes some MB."""
_READ_BYTES = 1 << 20
"""Bytes that are copied at a time (chosen: bounds the memory)."""


class StagingError(Exception):
    """A recording could not be copied; it may be possible later, or on another machine."""


class Staged(NamedTuple):
    """The copy of a recording."""

    path: Path  # The file or folder
    content: str  # SHA-256 of the content, as `files.checksum.sha256` gives it
    size_bytes: int  # Its size


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Yield an empty folder; those that killed workers left behind, unlocked, are removed."""
    root = Path(tempfile.gettempdir(), f'adxl_ros_fleet_{os.getuid()}')
    lock = None
    try:
        root.mkdir(mode=0o700, exist_ok=True)
        root_lock = _lock(root, fcntl.LOCK_EX)
        try:
            for left in root.iterdir():
                with suppress(OSError):
                    os.close(_lock(left, fcntl.LOCK_EX | fcntl.LOCK_NB))
                    shutil.rmtree(left)
            folder = Path(tempfile.mkdtemp(dir=root))
            lock = _lock(folder, fcntl.LOCK_EX)
        finally:
            os.close(root_lock)
    except OSError as error:
        raise StagingError(f'{root}: no temporary folder: {error.strerror}') from None
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def _lock(folder: Path, how: int) -> int:
    """Lock a folder as long as this process lives, or until the descriptor is closed."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, how)
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def stage(source: Source, folder: Path) -> Staged:
    """Copy a recording into a folder."""
    url = source.url
    try:
        fs, path = file_system(url, source.secret)
    except Unreachable as reason:
        raise StagingError(one_line(reason)) from None
    before = look_up(fs, path)
    if before.fault:
        raise (UserError if before.fault == NO_FILE else StagingError)(f'{url}: {before.fault}')
    _check_size(url, before.size_bytes, folder)
    target = _inside(folder, file_name(path), url)
    try:
        # A web server answers `isdir` with the whole file.
        is_folder = fs.info(path)['type'] == 'directory'
        files = {name: _inside(target, name.removeprefix(path).lstrip('/'), url)
                 for name in fs.find(path)} if is_folder else {path: target}
        copies = {copy: _copy(fs, name, copy, url) for name, copy in files.items()}
    except UserError:
        raise
    except Exception as error:
        # A connection that broke is not used again.
        fs.clear_instance_cache()
        if isinstance(error, OSError) and error.errno == errno.ENOSPC:
            raise StagingError(f'{url}: no space left in {tempfile.gettempdir()}; set TMPDIR to '
                               'a larger disk') from None
        raise StagingError(f'{url}: {fault_of(error)}') from None
    fs.invalidate_cache()
    after = look_up(fs, path)
    size_bytes = sum(copy.stat().st_size for copy in copies)
    if (after.stamp, after.size_bytes) != (before.stamp, before.size_bytes) or \
            before.size_bytes not in (None, size_bytes):
        raise StagingError(f'{url}: changed while it was read; is it still being written?')
    checksums = [copies[copy] for copy in sorted(copies)]
    content = checksums[0] if len(checksums) == 1 else \
        hashlib.sha256(''.join(f'{line}\n' for line in checksums).encode()).hexdigest()
    return Staged(target, content, size_bytes)


def _check_size(url: str, size_bytes: int | None, folder: Path) -> None:
    """Refuse what is too large, before anything is copied."""
    if size_bytes is None:
        return
    if size_bytes > _LARGEST_BYTES:
        raise UserError(f'{url}: has {size_bytes / 1e9:.3g} GB, expected '
                        f'{_LARGEST_BYTES / 1e9:.3g} GB at most; split it')
    free = shutil.disk_usage(folder).free
    if size_bytes + _SPARE_BYTES > free:
        raise StagingError(f'{url}: needs {size_bytes / 1e6:.3g} MB beside '
                           f'{_SPARE_BYTES / 1e6:.3g} MB that stay free, but '
                           f'{tempfile.gettempdir()} has {free / 1e6:.3g} MB free; set TMPDIR to '
                           'a larger disk')


def _inside(folder: Path, name: str, url: str) -> Path:
    """Return the path of a copy, which must not lie elsewhere."""
    path = folder / name
    if path == folder or folder not in path.parents or '..' in path.parts:
        raise UserError(f'{url}: {name!r} leads outside of its folder')
    return path


def _copy(fs: Any, name: str, copy: Path, url: str) -> str:
    """Copy a file, and return its SHA-256."""
    copy.parent.mkdir(parents=True, exist_ok=True)
    checksum, count = hashlib.sha256(), 0
    # A web server need not offer parts of a file.
    options = {'block_size': 0} if '://' in name else {}
    with fs.open(name, 'rb', **options) as file, open(copy, 'wb') as target:
        while block := file.read(_READ_BYTES):
            count += len(block)
            if count > _LARGEST_BYTES:
                raise UserError(f'{url}: is larger than {_LARGEST_BYTES / 1e9:.3g} GB; split it')
            checksum.update(block)
            target.write(block)
    return checksum.hexdigest()
