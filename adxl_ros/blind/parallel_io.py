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

"""Small files that are written as a whole, and parallel work that can be interrupted."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import Executor, FIRST_COMPLETED, Future, wait
import os
from pathlib import Path
from typing import Any

from adxl_ros.errors import UserError

_AHEAD = 32
"""Largest number of jobs in the pool at once; chosen: each holds its files in memory."""


def write(path: Path, data: bytes) -> None:
    """
    Write a file as a whole or not at all.

    Parameters
    ----------
    path
        The file.
    data
        Its content.

    Raises
    ------
    UserError
        It cannot be written.

    """
    temporary = path.with_name(f'.{path.name}.{os.getpid()}')
    try:
        temporary.write_bytes(data)
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise UserError(f'{path}: cannot be written: {error.strerror}') from None


def make_folder(folder: Path) -> Path:
    """Make a folder and return it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f'{folder}: cannot be made: {error.strerror}') from None
    return folder


def for_each(pool: Executor, work: Callable[..., Any], jobs: Iterable[Callable[[], tuple]],
             keep: Callable[..., None], show: Callable[[float], None], done: int = 0) -> None:
    """
    Run jobs in parallel and keep each result as soon as it is there.

    Parameters
    ----------
    pool
        Threads, processes or a Dask cluster.
    work
        Receives the arguments of a job; returns a tuple.
    jobs
        Each returns the arguments of one job at its turn.
    keep
        Receives what `work` returned, in this process.
    show
        Receives the fraction that is finished.
    done
        Number of jobs that were finished before.

    """
    waiting: dict[Future, Any] = {}
    todo = list(jobs)
    total = done + len(todo)
    try:
        while todo or waiting:
            while todo and len(waiting) < _AHEAD:
                job = todo.pop(0)
                waiting[pool.submit(work, *job())] = None
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                del waiting[future]
                keep(*future.result())
                done += 1
                show(done / total)
    except BaseException:
        for future in waiting:
            future.cancel()
        raise
