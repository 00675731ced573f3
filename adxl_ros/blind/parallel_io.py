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

"""Small whole files, and work in parallel that can be cut short."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import Executor, FIRST_COMPLETED, Future, wait
import os
from pathlib import Path
from typing import Any

from adxl_ros.errors import UserError

_AHEAD = 32


def write(path: Path, data: bytes) -> None:
    """Write a file whole or not at all."""
    fresh = path.with_name(f'.{path.name}.{os.getpid()}')
    try:
        fresh.write_bytes(data)
        os.replace(fresh, path)
    except OSError as error:
        fresh.unlink(missing_ok=True)
        raise UserError(f'{path}: cannot be written: {error.strerror}') from None


def make(folder: Path) -> Path:
    """Make a folder and return it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f'{folder}: cannot be made: {error.strerror}') from None
    return folder


def each(pool: Executor, work: Callable[..., Any], jobs: Iterable[Callable[[], tuple]],
         keep: Callable[..., None], show: Callable[[float], None], done: int = 0) -> None:
    """
    Do jobs in parallel and keep each result as it comes.

    Parameters
    ----------
    pool
        Of threads, of processes or of a Dask cluster.
    work
        Called with the arguments of a job; returns a tuple.
    jobs
        Each gives the arguments of one job when its turn comes.
    keep
        Called here with what `work` returned.
    show
        Takes the fraction that is done.
    done
        How many were done before.

    """
    waiting: dict[Future, Any] = {}
    todo = list(jobs)
    total = done + len(todo)
    try:
        while todo or waiting:
            # Not all at once: each brings its files along.
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
