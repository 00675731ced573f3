# SPDX-License-Identifier: Apache-2.0

"""Files and directories that appear as a whole under their name, or not at all."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
import ctypes
import errno
import fcntl
from glob import escape
from io import FileIO
from itertools import chain, count
import os
from pathlib import Path
import shutil
import tempfile
from typing import BinaryIO

from adxl_ros.errors import UserError
from adxl_ros.report.arguments import require_path
from adxl_ros.wording import option

AnyPath = str | os.PathLike  # A path, as the functions of Python take it
_SUFFIX = '.part'  # End of the names of directories in which new files are written
_AT_FDCWD = -100  # Of renameat2: paths are those of this process
_RENAME_EXCHANGE = 2  # Of renameat2: swap both names
_MARK = 'user.adxl_ros.written'
"""Extended attribute of what this package wrote: the time of the last change, ns, as text."""
_BAG_FILES = ('*.mcap', '*.db3', 'metadata.yaml')  # Names of the files in a bag
_KEPT_BYTES = 256 << 20
"""Part of a file that stays in the cache for whoever reads it next: a recording of an hour at 1
kHz is smaller, and every computer has so much to spare."""


@contextmanager
def atomic_path(path: AnyPath) -> Iterator[Path]:
    """
    Yield a path next to `path`; a file there replaces `path` if the block succeeds.

    It is synced to disk before the exchange, so that a power cut leaves the old or the new one.
    A folder at `path` is replaced only if it is empty, a bag, or was written by this package.
    """
    target = Path(path)
    _refuse_folder_of_others(target)
    folder = ''
    # The directory is created within the block, so that a signal at any time removes it.
    try:
        try:
            folder = tempfile.mkdtemp(_SUFFIX, f'.{target.name}.', target.parent)
        except OSError as error:
            raise UserError(
                f'{target}: cannot write into {target.parent}: {error.strerror}; '
                'choose a directory that exists and can be written'
            ) from None
        fresh = Path(folder, target.name)
        with _locked(Path(folder)):
            yield fresh
            for written in [*fresh.rglob('*'), fresh]:
                sync(written)
            _mark(fresh)
            if fresh.is_dir() and target.is_dir():
                _exchange(fresh, target)
            else:
                os.replace(fresh, target)
            sync(target.parent)
    except OSError as error:
        raise UserError(f'{target}: cannot write: {error.strerror or error}') from None
    finally:
        if folder:
            shutil.rmtree(folder, ignore_errors=True)


def _exchange(fresh: Path, target: Path) -> None:
    """
    Swap two directories, of which none can be renamed over the other.

    Linux does it in one step. Where a file system or a C library cannot, it takes two: a kill
    between them leaves the earlier directory as `old` beside the new one.
    """
    try:
        swap = ctypes.CDLL(None, use_errno=True).renameat2
        failed = swap(
            _AT_FDCWD, os.fsencode(fresh), _AT_FDCWD, os.fsencode(target), _RENAME_EXCHANGE
        )
    except AttributeError:
        failed = True
    if failed:
        os.replace(target, fresh.with_name('old'))
        os.replace(fresh, target)


def _mark(path: Path) -> None:
    """Mark what this package wrote, where the file system keeps attributes."""
    with suppress(OSError):
        os.setxattr(path, _MARK, str(path.stat().st_mtime_ns).encode())


def is_own(path: AnyPath) -> bool:
    """
    Return whether this package wrote a file or directory that nobody has changed since.

    A copy has no mark, nor has a file on a file system without extended attributes.
    """
    try:
        return os.getxattr(path, _MARK) == str(os.stat(path).st_mtime_ns).encode()
    except OSError:
        return False


def _refuse_folder_of_others(path: Path) -> None:
    """Refuse to replace a folder that holds anything but a bag, unless this package wrote it."""
    if not path.is_dir() or is_own(path):
        return
    of_bag = set(chain.from_iterable(map(path.glob, _BAG_FILES)))
    kept = [each.name for each in path.iterdir() if each not in of_bag]
    if kept:
        raise UserError(
            f'{path}: is a folder that this package did not write, with {kept[0]} in it, and is '
            'never replaced; choose another name'
        )


def require_own(path: AnyPath, may_overwrite: bool = False) -> None:
    """Refuse to replace what others wrote or changed, unless the user permits it."""
    target = require_path(path)
    if may_overwrite or not target.exists():
        return
    is_empty_folder = target.is_dir() and not any(target.iterdir())
    if not (is_empty_folder or is_own(target)):
        raise UserError(
            f'{path}: is there already, and was not written by this package, or was changed '
            f'since; choose another name, or replace it with {option(overwrite=True)}'
        )


def free_name(path: AnyPath) -> Path:
    """Return a path at which nothing is: the given one, or one with a number."""
    wanted = Path(path)
    names = (wanted.with_stem(f'{wanted.stem}_{number}') for number in count(2))
    return next(name for name in chain([wanted], names) if not name.exists())


def write_text(path: AnyPath, text: str) -> None:
    """Write a text file, UTF-8, as a whole or not at all."""
    with atomic_path(path) as fresh:
        fresh.write_text(text, encoding='utf-8')


def write_bytes(path: AnyPath, data: bytes) -> None:
    """Write a file as a whole or not at all."""
    with atomic_path(path) as fresh:
        fresh.write_bytes(data)


def make_folder(folder: AnyPath) -> Path:
    """Create a folder for the output, if it does not exist, and return it."""
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f'{path}: cannot be made: {error.strerror}') from None
    return path


def own_folder(folder: AnyPath, names: Iterable[str], may_overwrite: bool) -> Path:
    """Create a folder for files that replace nothing of others, unless permitted; return it."""
    for name in names:
        require_own(require_path(folder) / name, may_overwrite)
    return make_folder(folder)


def remove_unfinished(folder: AnyPath, name: str) -> None:
    """Remove the unfinished files of writers that were killed; those of others are locked."""
    for unfinished in Path(folder).glob(f'.{escape(name)}*{_SUFFIX}'):
        with suppress(OSError), _locked(unfinished):
            shutil.rmtree(unfinished, ignore_errors=True)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lock a directory for as long as this process lives, or raise `OSError`."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


def keep_previous(path: AnyPath) -> None:
    """Copy the file `path`, if it exists, to `path`.previous before it is replaced."""
    if Path(path).is_file():
        with atomic_path(f'{path}.previous') as fresh:
            shutil.copyfile(path, fresh)


def sync(path: Path) -> None:
    """Wait until the bytes of a file, or the entries of a directory, are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def append_line(file: FileIO, line: str) -> None:
    """
    Append a line to a file that is open to append and read, and wait until it is on the disk.

    A line that a power cut has torn ends before it. Where it cannot be written, nothing of it is.
    """
    size = file.seek(0, os.SEEK_END)
    is_torn = size > 0 and os.pread(file.fileno(), 1, size - 1) != b'\n'
    data = f'{chr(10) * is_torn}{line}\n'.encode()
    try:
        if file.write(data) != len(data):
            raise OSError(errno.ENOSPC, 'the disk is full')
        os.fsync(file.fileno())
    except OSError:
        with suppress(OSError):
            file.truncate(size)
        raise


def release_written(file: BinaryIO) -> None:
    """
    Give back the page cache of what was written, but for the newest 256 MB.

    Without this, a file of 13 GB pushes out what other programs have in the cache.
    """
    end = file.tell() - _KEPT_BYTES
    if end > 0:
        os.posix_fadvise(file.fileno(), 0, end, os.POSIX_FADV_DONTNEED)
