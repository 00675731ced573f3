# SPDX-License-Identifier: Apache-2.0

"""The table of the benchmark: each job beside what does it elsewhere, measured in turns."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from datetime import date
from importlib.metadata import version
import os
import platform
import resource
import time

from adxl_ros.errors import UserError
import numpy as np

_PACKAGES = ('numpy', 'scipy', 'pyarrow', 'polars', 'orjson', 'rosbags', 'allantools', 'imucal',
             'mujoco')
"""Libraries whose versions the table states."""


def cpu_s() -> float:
    """Return the processor time of this process and of its finished children, s."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


@dataclass(frozen=True)
class Job:
    """A job that is measured."""

    name: str  # What is done
    run: Callable[[], object]  # Does it with this package
    # Largest ratio to the first rival, or largest processor time, s, without a rival; 0 without a
    # goal
    goal: float = 0.0
    # Others that do the same, by name
    rivals: Mapping[str, Callable[[], object]] = field(default_factory=dict)
    rounds: int = 100  # Largest number of rounds; a long job has few
    # Returns what is to be said of the finished job beside its time
    detail: Callable[[], str] = str
    clock: Callable[[], float] = cpu_s  # What is measured, s; processor time without it


def print_table(jobs: Iterable[Job], rounds: int) -> None:
    """Measure each job and its rivals in turns, and print a table."""
    print(f'\n{date.today()}, adxl_ros {version("adxl-ros")}, CPython '
          f'{platform.python_version()}, {platform.machine()}, {os.cpu_count()} cores')
    print(', '.join(f'{name} {text}' for name in _PACKAGES if (text := _version(name))))
    print(f'\nProcessor time, s, and ratio: median (least to greatest) of {rounds} rounds in '
          'turns\n')
    print('| job | s | beside | ratio | goal |\n|---|---|---|---|---|', flush=True)
    for job in jobs:
        try:
            rows = rows_of(job, min(rounds, job.rounds))
        except UserError as error:
            rows = [f'| {job.name} | {error} | – | – | – |']
        print(*rows, sep='\n', flush=True)


def _version(name: str) -> str:
    """Return the version of an installed package, or an empty text."""
    try:
        return version(name)
    except ImportError:
        return ''


def rows_of(job: Job, rounds: int) -> list[str]:
    """Measure one job and its rivals in turns."""
    runs = {'': job.run, **job.rivals}
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    missing = set()
    # The first of several rounds imports and allocates.
    warm_up = rounds > 1
    for number in range(rounds + warm_up):
        for name, run in runs.items():
            if name in missing:
                continue
            began_s = job.clock()
            try:
                run()
            except ImportError:
                missing.add(name)
                continue
            if number or not warm_up:
                seconds[name].append(job.clock() - began_s)
    measured = np.array(seconds[''])
    limit = f'{job.goal:g}' if job.goal else '–'
    job_name = job.name + job.detail()
    if not job.rivals:
        return [f'| {job_name} | {_spread(measured)} | – | – | {limit} s |'.replace('– s', '–')]
    rows = []
    for name in job.rivals:
        ratio = 'not installed' if name in missing else _spread(measured / np.array(seconds[name]))
        rows.append(f'| {job_name} | {_spread(measured)} | {name} | {ratio} | {limit} |')
        limit = '–'
    return rows


def _spread(values: np.ndarray) -> str:
    """Return median, least and greatest of values as text."""
    return f'{np.median(values):.2g} ({values.min():.2g}–{values.max():.2g})'
