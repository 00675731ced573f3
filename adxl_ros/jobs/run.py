# SPDX-License-Identifier: Apache-2.0

"""Tasks in parallel: bounded submission, retries, and a result for each."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import CancelledError, Executor, Future
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.jobs.pools import Pool, PoolLost, TaskLost, WorkerDied

_SLOTS = 32
"""Tasks that are submitted at once to an executor that does not state it. Chosen: each holds its
arguments in memory."""
RETRIES = 2
"""Further attempts of a task that fails, by default; chosen."""
_WAIT_S = 1.0
"""Time after which the number of slots is asked for again, s; chosen."""
_BY_CHANCE = 0.01
"""Expected number of tasks that are blamed for workers that others end; chosen."""
_MOST_DEATHS = 8
"""Deaths of workers that chance may explain. Chosen: a task that kills its workers comes to an end
where many others do so, too."""


class Finished(NamedTuple):
    """The end of a task."""

    arguments: tuple  # Its arguments
    value: Any  # What it returned; None after an error
    error: BaseException | None  # What the last attempt raised; None after a success
    attempts: int  # Number of attempts


class _Attempt(NamedTuple):
    """A task that was submitted or waits; `deaths` is the number of its workers that ended."""

    arguments: tuple
    number: int = 1
    deaths: int = 0


@dataclass
class _Deaths:
    """Attempts of all tasks that ended, and those of them that ended with their worker."""

    attempts: int = 0
    deaths: int = 0

    def explain(self, deaths: int) -> bool:
        """
        Return whether chance explains how often the workers of one task ended.

        Workers end at random if they also end under other tasks. The share of such attempts gives
        the number of tasks that meet so many deaths by chance.
        """
        if deaths > _MOST_DEATHS:
            return False
        share = (self.deaths - deaths) / max(self.attempts - deaths, 1)
        return self.attempts * share ** deaths > _BY_CHANCE


class _Queue:
    """Tasks that wait: repeated ones first, those whose worker ended last."""

    def __init__(self, tasks: Iterable[tuple]) -> None:
        self._todo: Iterator[_Attempt] | None = (_Attempt(arguments) for arguments in tasks)
        self.again: list[_Attempt] = []
        self.suspects: deque[_Attempt] = deque()

    def take(self) -> _Attempt | None:
        """Return the next task; None where none waits."""
        if self.again:
            return self.again.pop()
        attempt = next(self._todo, None) if self._todo is not None else None
        if attempt is None:
            self._todo = None
            return self.suspects.popleft() if self.suspects else None
        return attempt


def finished_tasks(pool: Executor, work: Callable[..., Any], tasks: Iterable[tuple],
                   retries: int = RETRIES) -> Generator[Finished, None, None]:
    """
    Run tasks in parallel; each gives one result, in the order in which they end.

    A task that raises is repeated. A `UserError` is not: it would come again. A task whose worker
    ends is repeated after all others, and more often where workers end at random. Tasks that are
    lost through no fault of their own are submitted again, and that does not count.
    """
    queue, total = _Queue(tasks), _Deaths()
    running: dict[Future, _Attempt] = {}
    ended: SimpleQueue[Future] = SimpleQueue()
    try:
        while True:
            slots = getattr(pool, 'slots', _SLOTS)
            while len(running) < slots and (attempt := queue.take()) is not None:
                future = pool.submit(work, *attempt.arguments)
                running[future] = attempt
                future.add_done_callback(ended.put)
            if not running:
                return
            try:
                future = ended.get(timeout=_WAIT_S)
            except Empty:
                continue
            if future not in running:
                continue
            attempt, error = running.pop(future), _error(future)
            if isinstance(error, TaskLost):
                queue.again.append(attempt)
                if isinstance(pool, Pool) and isinstance(error, PoolLost):
                    pool.renew()
                    queue.again += running.values()
                    running.clear()
                continue
            attempt = _counted(attempt, getattr(future, 'deaths', 0), error, total)
            if _is_last(attempt, error, retries, total):
                yield Finished(attempt.arguments, None if error else future.result(), error,
                               attempt.number)
            elif isinstance(error, WorkerDied):
                queue.suspects.append(attempt._replace(number=attempt.number + 1))
            else:
                queue.again.append(attempt._replace(number=attempt.number + 1))
    finally:
        for future in running:
            future.cancel()


def _counted(attempt: _Attempt, deaths: int, error: BaseException | None, total: _Deaths
             ) -> _Attempt:
    """Return an attempt that ended with the attempts that a cluster repeated unasked."""
    attempts = max(deaths + (not isinstance(error, WorkerDied)), 1)
    total.attempts += attempts
    total.deaths += deaths
    return attempt._replace(number=attempt.number + attempts - 1, deaths=attempt.deaths + deaths)


def _is_last(attempt: _Attempt, error: BaseException | None, retries: int, total: _Deaths
             ) -> bool:
    """Return whether a task is not repeated."""
    if error is None or isinstance(error, UserError):
        return True
    return attempt.number > retries and not (
        isinstance(error, WorkerDied) and total.explain(attempt.deaths))


def _error(future: Future) -> BaseException | None:
    """Return what a task raised."""
    try:
        return future.exception()
    except CancelledError:
        return TaskLost()


def for_each(pool: Executor, work: Callable[..., Any], jobs: Iterable[Callable[[], tuple]],
             keep: Callable[..., None], show: Callable[[float], None], done: int = 0) -> None:
    """Run jobs in parallel and keep each result as soon as it is there."""
    todo = list(jobs)
    total = done + len(todo)
    results = finished_tasks(pool, work, (job() for job in todo))
    try:
        for end in results:
            if end.error is not None:
                raise end.error
            keep(*end.value)
            done += 1
            show(done / total)
    finally:
        results.close()
