# SPDX-License-Identifier: Apache-2.0

"""
Results of many jobs, each on disk as soon as it is there.

The blind check may not import `adxl_ros.files`, which knows the package's model of a sensor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
import os
from pathlib import Path
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.workers import finished_tasks, Pool


def write(path: Path, data: bytes) -> None:
    """Write a file as a whole or not at all; several processes may write the same one at once."""
    temporary = path.with_name(f'.{path.name}.{os.uname().nodename}.{os.getpid()}')
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(data)
        os.replace(temporary, path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink()
        raise UserError(f'{path}: cannot be written: {error.strerror}') from None


def for_each(
    pool: Pool,
    work: Callable[..., Any],
    jobs: Iterable[Callable[[], tuple]],
    keep: Callable[..., None],
    show: Callable[[float], None],
    done: int = 0,
) -> None:
    """Run jobs in parallel and keep each result as soon as it is there."""
    todo = list(jobs)
    for number, end in enumerate(finished_tasks(pool, work, (job() for job in todo)), done + 1):
        if end.error is not None:
            raise end.error
        keep(*end.value)
        show(number / (done + len(todo)))
