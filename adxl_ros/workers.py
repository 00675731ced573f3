# SPDX-License-Identifier: Apache-2.0

"""
Many tasks in parallel: workers on this machine or a Dask cluster, retries, and what tasks write.

A pool is an `Executor`. Its futures raise three further exceptions. `WorkerDied` is for a task
that ran when its worker ended. `TaskLost` is for a task that only waited there, and `PoolLost`
stands for all tasks. A future has the number of workers that ended while they ran its task.
Nothing here knows what a task computes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import CancelledError, Executor, Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache, partial
import logging
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection
import os
from pathlib import Path
import pickle
from queue import Empty, SimpleQueue
import signal
import sys
from threading import Thread
from time import monotonic, sleep
import traceback
from types import FrameType
from typing import Any, NamedTuple
from uuid import uuid4

from adxl_ros.errors import install_hint, one_line, UserError

_TASKS_PER_WORKER = 3
"""Tasks that are submitted for each worker: one runs, two wait. Chosen: a worker is not idle where
the client is slow, and an executor of one process takes no more."""
_FEWEST_TASKS = 4
"""Tasks that are submitted to a cluster at least. Chosen: one that grows by demand sees it."""
_DEATHS_AT_START = 20
"""Deaths of a worker in succession, before it runs a task, that end a run. Chosen: an
installation that does not work, not an accident."""
_LOSSES_AT_START = 60
"""Tasks in succession that a cluster gives up before any of them runs, that end a run. Chosen: an
installation that does not work, not an accident."""
_CONNECT_S = 20.0
"""Time in which a scheduler must answer, s; chosen."""
_RECONNECT_S = 600.0
"""Time in which a scheduler that was lost must be back, s. Chosen: a node restarts in minutes."""
_FETCH_S = 60.0
"""Time in which a cluster must deliver a result, s; chosen: some MB over a slow line."""
_COUNT_S = 5.0
"""Time after which the threads of a cluster are counted again, s; chosen."""
_TOPIC = 'adxl_ros-tasks'
"""Topic of a scheduler on which workers state that they begin or end a task."""
_CLIENTS = 4
"""Clients whose shared values a worker of a cluster keeps. Chosen: some MB each."""
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
_DIED = 'the worker ended while it ran the task'
"""Message of a task whose worker ended."""


class WorkerDied(Exception):
    """The worker ended while it ran a task."""


class TaskLost(Exception):
    """A task did not run to its end through no fault of its own."""


class PoolLost(TaskLost):
    """All tasks are lost, and the pool must be renewed."""


class TaskFuture(Future):
    """A task that cannot be cancelled, so that its result may come at any time."""

    def __init__(self) -> None:
        super().__init__()
        self.deaths = 0  # Number of workers that ended while they ran the task
        self.set_running_or_notify_cancel()


class Pool(Executor):
    """A pool that says how many tasks it takes at once, and that can be made again."""

    slots: int  # Number of tasks that are submitted at once at most

    def renew(self) -> None:
        """Make the pool usable after all its tasks were lost."""

    def kill(self) -> None:
        """End all workers at once."""


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else \
        os.cpu_count() or 1


@contextmanager
def open_pool(scheduler: str | None, jobs: int | None = None, shared: tuple = ()
              ) -> Iterator[Pool]:
    """Open a pool. Its workers end with the block, at once if an exception ends it."""
    pool: Pool = Cluster(scheduler, shared) if scheduler else \
        Processes(jobs or cores(), shared)
    try:
        yield pool
    except BaseException:
        pool.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


class Processes(Pool):
    """Processes of this machine, each with a thread and a pipe of its own: no lock is shared."""

    def __init__(self, count: int, shared: tuple = ()) -> None:
        # A new process reads this before it loads numpy; each uses one core.
        os.environ['OPENBLAS_NUM_THREADS'] = '1'
        self.slots = _TASKS_PER_WORKER * count
        self._todo: SimpleQueue[tuple[TaskFuture, tuple] | None] = SimpleQueue()
        self._workers = [_Worker(shared, self._todo) for _ in range(count)]

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        """Give a task to the first worker that is free."""
        future = TaskFuture()
        self._todo.put((future, (partial(fn, **kwargs), args)))
        return future

    def kill(self) -> None:
        """End all workers at once; they remove their temporary files."""
        for worker in self._workers:
            worker.is_open = False
            worker.process.terminate()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the workers after their tasks."""
        while cancel_futures and not self._todo.empty():
            with suppress(Empty):
                waiting = self._todo.get_nowait()
                if waiting is not None:
                    waiting[0].set_exception(TaskLost())
        for _ in self._workers:
            self._todo.put(None)
        for worker in self._workers * wait:
            worker.thread.join()


class _Raised(NamedTuple):
    """What a task raised, with its traceback, which an error loses on its way to the parent."""

    error: Exception
    text: str


class _Worker:
    """One process at a time, which is started again when it ends."""

    def __init__(self, shared: tuple, todo: SimpleQueue) -> None:
        self._context = get_context('spawn')
        self._shared, self._todo = shared, todo
        self.is_open = True
        self._start()
        self.thread = Thread(target=self._serve, daemon=True)
        self.thread.start()

    def _start(self) -> None:
        """Start a process; the only other end of its pipe is in it, so that its end shows."""
        self._pipe, other = self._context.Pipe()
        self.process = self._context.Process(target=_work, args=(other, self._shared))
        self.process.start()
        other.close()
        if not self.is_open:
            self.process.terminate()

    def _serve(self) -> None:
        """Pass tasks to the process until there are no more."""
        while (given := self._todo.get()) is not None:
            future, task = given
            try:
                raised, value = self._run(future, task)
                error: BaseException | None = raised
                if isinstance(raised, _Raised):
                    error = raised.error
                    error.__cause__ = RuntimeError(raised.text)
            except Exception as problem:
                # The task, its result or its error cannot be sent.
                error, value = problem, None
            if error is not None:
                future.set_exception(error)
            else:
                future.set_result(value)
        self._pipe.close()
        self.process.join()

    def _run(self, future: TaskFuture, task: tuple) -> tuple[Any, Any]:
        """Return error and result of a task; a process that ends before it begins is replaced."""
        for _ in range(_DEATHS_AT_START):
            has_begun = False
            try:
                self._pipe.send(task)
                has_begun = self._pipe.recv()
                return self._pipe.recv()
            except (EOFError, OSError):
                self._pipe.close()
                self.process.join()
                if self.is_open:
                    self._start()
            if has_begun:
                future.deaths = 1
                return WorkerDied(_DIED), None
            if not self.is_open:
                return TaskLost(), None
        return UserError(f'a worker ended {_DEATHS_AT_START} times before it ran a task; is the '
                         'memory of this machine full?'), None


def _work(pipe: Connection, shared: tuple) -> None:
    """
    Run tasks in a process until the pipe is closed.

    Ctrl-C is left to the parent. A terminated worker ends by an exception, so that it removes its
    files and its own processes. A worker ends with its parent, however that ended.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _terminated)
    Thread(target=_end_with_parent, daemon=True).start()
    try:
        while True:
            work, arguments = pipe.recv()
            pipe.send(True)
            answer: tuple[_Raised | None, Any]
            try:
                answer = None, work(*shared, *arguments)
            except Exception as error:
                answer = _Raised(error, traceback.format_exc()), None
            try:
                pipe.send(answer)
            except (pickle.PicklingError, TypeError, AttributeError) as error:
                pipe.send((_Raised(error, ''), None))
    except (SystemExit, EOFError, ConnectionError):
        # Threads of a task do not keep the process.
        os._exit(0)


def _terminated(number: int, frame: FrameType | None) -> None:
    """End the worker by an exception."""
    sys.exit(128 + number)


def _end_with_parent() -> None:
    """Wait for the end of the parent, and end."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)


class Cluster(Pool):
    """A Dask cluster."""

    def __init__(self, address: str, shared: tuple = ()) -> None:
        try:
            from distributed import client, comm, scheduler
        except ImportError:
            raise UserError(f'--scheduler needs Dask; {install_hint("distributed")}') from None
        import asyncio
        # A lost scheduler is reported by this module, in one line.
        for name in ('distributed', 'distributed.client', 'distributed.utils',
                     'tornado.application'):
            logging.getLogger(name).setLevel(logging.CRITICAL)
        self._client_class = client.Client
        self._death = scheduler.KilledWorker
        self._losses = (CancelledError, asyncio.CancelledError, comm.CommClosedError)
        self._refusals = (OSError, RuntimeError, client.ClosedClientError)
        self._address = address
        self._shared = pickle.dumps(shared)
        self._name = f'adxl_ros-{uuid4().hex}'
        self._counted_s = -_COUNT_S
        self._slots = _FEWEST_TASKS
        self._running: dict[str, int] = {}
        self._losses_at_start = 0
        try:
            self._connect()
        except (OSError, ValueError) as error:
            raise UserError(f'--scheduler {address}: no scheduler answers: {one_line(error)}'
                            ) from None

    def _connect(self) -> None:
        """Connect to the scheduler, and give it what all tasks share."""
        self._running = {}
        self._client = self._client_class(self._address, timeout=_CONNECT_S,
                                          set_as_default=False)
        self._client.subscribe_topic(_TOPIC, self._count)
        # The scheduler keeps it, because all workers may end.
        self._client.set_metadata([self._name], self._shared)

    def _count(self, event: tuple[float, tuple[str, int]]) -> None:
        """Count the workers that began a task and did not end it."""
        key, change = event[1]
        if key in self._running:
            self._running[key] += change
            self._losses_at_start = 0

    @property
    def slots(self) -> int:  # type: ignore[override]
        """Return the number of tasks that keep the present workers busy."""
        if monotonic() - self._counted_s > _COUNT_S:
            with suppress(Exception):
                threads = sum(self._client.nthreads().values())
                self._slots = max(_TASKS_PER_WORKER * threads, _FEWEST_TASKS)
            self._counted_s = monotonic()
        return self._slots

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        """Give a task to the scheduler."""
        outer = TaskFuture()
        key = f'{getattr(fn, "__name__", "task")}-{uuid4().hex}'
        self._running[key] = 0
        try:
            inner = self._client.submit(_call_on_cluster, self._name, partial(fn, **kwargs), args,
                                        key=key)
        except self._refusals:
            # The client is closed, or closes.
            outer.set_exception(PoolLost())
            return outer
        inner.add_done_callback(partial(self._take, outer))
        return outer

    def _take(self, outer: TaskFuture, inner: Any) -> None:
        """
        Pass on the result of a task; where it cannot be fetched, the scheduler is lost.

        Dask blames each task that a worker held when it ended. Here only those count that ran.
        """
        try:
            error = inner.exception(timeout=_FETCH_S)
            value = inner.result(timeout=_FETCH_S) if error is None else None
        except Exception:
            outer.set_exception(PoolLost())
            return
        outer.deaths = self._running.pop(inner.key, 0)
        if isinstance(error, self._death):
            error = WorkerDied(_DIED) if outer.deaths else \
                self._loss_at_start()
        elif isinstance(error, self._losses):
            error = PoolLost()
        if error is not None:
            outer.set_exception(error)
        else:
            outer.set_result(value)

    def _loss_at_start(self) -> Exception:
        """Return the error of a task whose workers ended before they ran it."""
        self._losses_at_start += 1
        if self._losses_at_start < _LOSSES_AT_START:
            return TaskLost()
        return UserError('the workers end before they run a task; their log has the reason')

    def renew(self) -> None:
        """Connect again to a scheduler that was lost."""
        end_s = monotonic() + _RECONNECT_S
        while True:
            self._close()
            try:
                self._connect()
                return
            except (OSError, ValueError) as error:
                if monotonic() > end_s:
                    raise UserError(
                        f'--scheduler {self._address}: was lost, and is not back after '
                        f'{_RECONNECT_S / 60:.0f} min ({one_line(error)}); the same command '
                        'continues') from None
                sleep(1.0)

    def _close(self) -> None:
        """Leave the cluster; its tasks are given up."""
        with suppress(Exception):
            self._client.close(timeout=_COUNT_S)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Leave the cluster, which runs on."""
        with suppress(Exception):
            self._client.set_metadata([self._name], None)
        self._close()


def _call_on_cluster(name: str, work: Callable[..., Any], arguments: tuple) -> Any:
    """
    Run a task on a worker of a cluster; its begin and its end are stated to the client.

    The scheduler has the begin before the task runs, so that the end of the worker cannot hide it.
    """
    from distributed import get_worker
    shared = _shared_on_cluster(name)
    worker = get_worker()
    key = worker.get_current_task()
    _ask(worker.scheduler.log_event, topic=_TOPIC, msg=(key, 1))
    try:
        return work(*shared, *arguments)
    finally:
        worker.log_event(_TOPIC, (key, -1))


@lru_cache(maxsize=_CLIENTS)
def _shared_on_cluster(name: str) -> tuple:
    """Return what all tasks of a client share."""
    from distributed import get_worker
    content = _ask(get_worker().scheduler.get_metadata, keys=[name], default=None)
    if content is None:
        raise TaskLost
    return pickle.loads(content)


def _ask(question: Callable[..., Any], **words: Any) -> Any:
    """Return the answer of the scheduler to a worker; without one, the task is lost."""
    from distributed import get_worker
    from distributed.utils import sync
    try:
        return sync(get_worker().loop, question, callback_timeout=_FETCH_S, **words)
    except OSError:
        raise TaskLost from None


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


def write(path: Path, data: bytes) -> None:
    """Write a file as a whole or not at all; several processes may write the same one at once."""
    temporary = path.with_name(f'.{path.name}.{os.uname().nodename}.{os.getpid()}')
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
