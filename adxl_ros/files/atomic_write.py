# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Whole files or none."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
import fcntl
from glob import escape
import os
from pathlib import Path
import shutil
import tempfile

from adxl_ros.errors import UserError

_LEFT = '.part'


@contextmanager
def atomic_path(path: str | os.PathLike) -> Iterator[Path]:
    """
    Yield a path beside `path`; what is written there replaces `path` when the block succeeds.

    The new file or directory is synced to disk before the exchange, so that a power cut leaves
    the old or the new, and it is removed when the block fails.

    Raises
    ------
    UserError
        The directory does not exist or cannot be written.

    """
    target = Path(path)
    try:
        folder = Path(tempfile.mkdtemp(_LEFT, f'.{target.name}.', target.parent or '.'))
    except OSError as error:
        raise UserError(f'{target}: cannot write into {target.parent}: {error.strerror}; '
                        'choose a directory that exists and can be written') from None
    fresh = folder / target.name
    try:
        with _locked(folder):
            yield fresh
            _sync(fresh)
            _exchange(fresh, target, folder)
            sync(target.parent)
    except OSError as error:
        raise UserError(f'{target}: cannot write: {error.strerror or error}') from None
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def clear_left(folder: str | os.PathLike, name: str) -> None:
    """
    Remove what writers that were killed have left of files whose names begin with `name`.

    What another process is writing is locked, and stays.
    """
    for left in Path(folder).glob(f'.{escape(name)}*{_LEFT}'):
        with suppress(OSError), _locked(left):
            shutil.rmtree(left, ignore_errors=True)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lock a directory for as long as this process lives, or raise `OSError`."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


def keep_previous(path: str | os.PathLike) -> None:
    """
    Keep the file at `path`, if there is one, as `path`.previous, before it is replaced.

    Raises
    ------
    UserError
        See `atomic_path`.

    """
    if Path(path).is_file():
        with atomic_path(f'{path}.previous') as kept:
            shutil.copyfile(path, kept)


def _exchange(fresh: Path, target: Path, folder: Path) -> None:
    if fresh.is_dir() and target.is_dir():
        # A directory cannot be renamed over one that holds files: the old one moves out first.
        os.replace(target, folder / 'old')
    os.replace(fresh, target)


def _sync(path: Path) -> None:
    if path.is_dir():
        for below in path.iterdir():
            _sync(below)
    sync(path)


def sync(path: Path) -> None:
    """Wait until a file's bytes, or a directory's entries, are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
