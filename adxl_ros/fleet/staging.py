# SPDX-License-Identifier: Apache-2.0

"""
A recording of any address as a local file, for the time of a task.

It is copied into a temporary folder that only this task uses. Size and free space are checked
first, and the copy is hashed. A recording that changes meanwhile is refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, ExitStack, suppress
import fcntl
import os
from pathlib import Path
import shutil
import tempfile
from typing import NamedTuple

from adxl_ros.errors import one_line, UserError
from adxl_ros.files.calibration_store import sha256
from adxl_ros.fleet import inputs
from adxl_ros.fleet.inputs import Source

_SPARE_MB = 64
"""Space that stays free, MB. Chosen: a task writes some MB."""


class StagingError(Exception):
    """A recording could not be copied; it may be possible later, or on another machine."""


class Staged(NamedTuple):
    """The copy of a recording."""

    path: Path  # The file or folder
    content: str  # SHA-256 of the content
    size_bytes: int  # Its size


@contextmanager
def locked(folder: Path, how: int = fcntl.LOCK_EX) -> Iterator[None]:
    """Lock a folder as long as the block, or this process, lasts; raise `OSError` if it cannot."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, how)
        yield
    finally:
        os.close(descriptor)


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Yield an empty folder; those that killed workers left behind, unlocked, are removed."""
    root = Path(tempfile.gettempdir(), f'adxl_ros_fleet_{os.getuid()}')
    with ExitStack() as stack:
        try:
            root.mkdir(mode=0o700, exist_ok=True)
            with locked(root):
                for left in root.iterdir():
                    with suppress(OSError), locked(left, fcntl.LOCK_EX | fcntl.LOCK_NB):
                        shutil.rmtree(left)
                folder = Path(stack.enter_context(
                    tempfile.TemporaryDirectory(dir=root, ignore_cleanup_errors=True)))
                stack.enter_context(locked(folder))
        except OSError as error:
            raise StagingError(f'{root}: no temporary folder: {error.strerror}') from None
        yield folder


def stage(source: Source, folder: Path) -> Staged:
    """Copy a recording into a folder."""
    url = source.url
    try:
        fs, path = inputs.file_system(url, source.secret)
    except inputs.Unreachable as reason:
        raise StagingError(one_line(reason)) from None
    before = inputs.look_up(fs, path)
    if before.fault:
        error = UserError if before.fault == inputs.NO_FILE else StagingError
        raise error(f'{url}: {before.fault}')
    size_mb, free_mb = (before.size_bytes or 0) / 1e6, shutil.disk_usage(folder).free / 1e6
    if size_mb + _SPARE_MB > free_mb:
        raise StagingError(f'{url}: needs {size_mb:.3g} MB beside {_SPARE_MB} MB that stay free, '
                           f'but {tempfile.gettempdir()} has {free_mb:.3g} MB free; set TMPDIR '
                           'to a larger disk')
    target = folder / inputs.file_name(path)
    try:
        # A web server answers `isdir` with the whole file.
        is_folder = fs.info(path)['type'] == 'directory'
        for name in fs.find(path) if is_folder else [path]:
            copy = target / name.removeprefix(path).lstrip('/') if is_folder else target
            if folder not in copy.parents or '..' in copy.parts:
                raise UserError(f'{url}: {name!r} leads outside of its folder')
            copy.parent.mkdir(parents=True, exist_ok=True)
            fs.get_file(name, str(copy))
    except UserError:
        raise
    except Exception as problem:
        # A connection that broke is not used again.
        fs.clear_instance_cache()
        raise StagingError(f'{url}: {inputs.fault_of(problem)}') from None
    fs.invalidate_cache()
    after = inputs.look_up(fs, path)
    size_bytes = sum(copy.stat().st_size for copy in [target, *target.rglob('*')]
                     if copy.is_file())
    if (after.stamp, after.size_bytes) != (before.stamp, before.size_bytes) or \
            before.size_bytes not in (None, size_bytes):
        raise StagingError(f'{url}: changed while it was read; is it still being written?')
    return Staged(target, sha256([target]), size_bytes)
