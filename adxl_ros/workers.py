# SPDX-License-Identifier: Apache-2.0

"""
Many tasks in parallel: workers on this machine or a Dask cluster, and retries.

A worker may end at any time. Its task then raises `WorkerDied`, and no other task is touched.
Nothing here knows what a task computes.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
import logging
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection
from multiprocessing.pool import ExceptionWithTraceback  # type: ignore[attr-defined]
import os
from queue import Empty, SimpleQueue
import signal
import sys
from threading import local, Lock, Thread
from typing import Any, cast, NamedTuple
from uuid import uuid4
import warnings

from adxl_ros.errors import install_hint, one_line, UserError

RETRIES = 2
"""Further attempts of a task that fails, by default. A machine that is shut down fails a task
once, rarely twice; a task that fails three times fails by itself."""
_TASKS_PER_WORKER = 3
"""Tasks that are submitted for each worker: one runs, two wait. With one waiting, a client that is
slow for a task leaves a worker idle; each further one is more arguments in memory."""
_FEWEST_TASKS = 4
"""Tasks that are submitted to a cluster at least, so that one that grows by demand sees some."""
_CONNECT_S = 20.0
"""Time in which a scheduler must answer, s: one that runs answers within 1 s, and behind a slow
network within some."""
_FETCH_S = 60.0
"""Time in which a cluster must deliver a result, s: a page of 3 MB over 0.4 Mbit/s takes as
long."""
_LOGGERS_OF_DASK = (
    'distributed',
    'distributed.client',
    'distributed.utils',
    'tornado.application',
)
_THREADS = 'OPENBLAS_NUM_THREADS'  # Variable that a new process reads before it loads numpy
_STARTS = Lock()  # Held while the environment is that of a new process
_DIED = 'the worker ended while it ran the task'
_WAIT_S = 1.0
"""Time after which the number of slots is asked for again, s: a cluster starts workers over
minutes."""


class WorkerDied(Exception):
    """The worker ended while it ran a task."""


class End(NamedTuple):
    """How an attempt at a task ended."""

    value: Any  # What it returned; None after an error
    error: BaseException | None = None  # What it raised; None after a success


class Pool(Executor):
    """Workers, and how many tasks are submitted to them at once."""

    slots: int

    def end(self, future: Any) -> End:
        """Return how a task ended."""
        error = future.exception()
        return End(None, error) if error else End(future.result())

    def kill(self) -> None:
        """End all workers at once."""


@contextmanager
def open_pool(
    scheduler: str | None, jobs: int | None = None, shared: tuple = ()
) -> Iterator[Pool]:
    """
    Open a pool; the values of `shared` are the first arguments of all its tasks.

    Its workers end with the block, at once if an exception ends it.
    """
    with _without_messages_of_dask() if scheduler else nullcontext():
        pool = Cluster(scheduler, shared) if scheduler else Processes(jobs or _cores(), shared)
        try:
            yield pool
        except BaseException:
            pool.kill()
            raise
        finally:
            pool.shutdown(cancel_futures=True)


def _cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, 'sched_getaffinity'):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def _without_messages_of_dask() -> Iterator[None]:
    """
    Silence Dask for a while: a lost scheduler is reported by this module, in one line.

    After an error it stays silent, because the threads of a lost client go on reporting.
    """
    with suppress(ImportError):  # It sets these levels when it loads.
        import distributed  # noqa: F401
    loggers = list(map(logging.getLogger, _LOGGERS_OF_DASK))
    levels = [logger.level for logger in loggers]
    with warnings.catch_warnings():
        warnings.filterwarnings('ignore', 'Sending large graph')
        for logger in loggers:
            logger.setLevel(logging.CRITICAL)
        yield
    for logger, level in zip(loggers, levels):
        logger.setLevel(level)


@contextmanager
def _environment_of_worker() -> Iterator[None]:
    """Let processes that start meanwhile use one core each."""
    with _STARTS:
        before = os.environ.get(_THREADS)
        os.environ[_THREADS] = '1'
        try:
            yield
        finally:
            del os.environ[_THREADS]
            if before is not None:
                os.environ[_THREADS] = before


class Processes(Pool):
    """Processes of this machine, each with a thread and a pipe of its own."""

    def __init__(self, count: int, shared: tuple = ()) -> None:
        self.slots = _TASKS_PER_WORKER * count
        self._shared = shared
        self._is_killed = False
        self._processes: list[Any] = []
        self._threads = ThreadPoolExecutor(count)
        self._own = local()  # Process and pipe of a thread; a process ends with its pipe

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        """Give a task to the first worker that is free."""
        return self._threads.submit(self._run, partial(fn, **kwargs), args)

    def _run(self, *task: Any) -> Any:
        """Run a task in the process of this thread, which is started again where it ended."""
        own = self._own
        try:
            if getattr(own, 'pipe', None) is None or not own.process.is_alive():
                own.process, own.pipe = self._start()
            own.pipe.send(task)
            end: End = own.pipe.recv()
        except (EOFError, OSError):
            own.pipe = None
            raise WorkerDied(_DIED) from None
        if end.error is not None:
            raise end.error
        return end.value

    def _start(self) -> tuple[Any, Connection]:
        """Start a process; the only other end of its pipe is in it, so that its end shows."""
        context = get_context('spawn')
        pipe, other = context.Pipe()
        process = context.Process(target=_work, args=(other, self._shared))
        with _environment_of_worker():
            process.start()
        other.close()
        self._processes.append(process)
        if self._is_killed:
            process.terminate()
        return process, pipe

    def kill(self) -> None:
        """End all workers at once; they remove their temporary files."""
        self._is_killed = True
        for process in self._processes:
            process.terminate()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the workers after their tasks."""
        self._threads.shutdown(wait, cancel_futures=cancel_futures)


def in_background(work: Callable[..., Any], *arguments: Any) -> tuple[Future, Callable[[], None]]:
    """Start a task in a process of its own; return its end, and what ends it at once."""
    pool = Processes(1)
    end = pool.submit(work, *arguments)
    pool.shutdown(wait=False)
    return end, pool.kill


def _work(pipe: Connection, shared: tuple) -> None:
    """
    Run tasks in a process until the pipe is closed.

    Ctrl-C is left to the parent. A terminated worker ends by an exception, so that it removes its
    files and its own processes. A worker ends with its parent, however that ended.
    """

    def end_with_parent() -> None:
        cast(Any, parent_process()).join()
        os.kill(os.getpid(), signal.SIGTERM)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    Thread(target=end_with_parent, daemon=True).start()
    try:
        while True:
            work, arguments = pipe.recv()
            try:
                pipe.send(End(work(*shared, *arguments)))
            except Exception as error:
                pipe.send(End(None, ExceptionWithTraceback(error, error.__traceback__)))
    except (SystemExit, EOFError, ConnectionError):
        # Threads of a task do not keep the process.
        os._exit(0)


class Cluster(Pool):
    """A Dask cluster."""

    def __init__(self, address: str, shared: tuple = ()) -> None:
        try:
            import distributed
        except ImportError:
            raise UserError(f'--scheduler needs Dask; {install_hint("distributed")}') from None
        self._address = address
        self._slots = _FEWEST_TASKS
        try:
            self._client = distributed.Client(address, timeout=_CONNECT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise UserError(
                f'--scheduler {address}: no scheduler answers: {one_line(error)}'
            ) from None
        # The cluster makes it again where all workers that have it end.
        self._shared = self._client.submit(tuple, shared, key=f'shared-{uuid4().hex}')

    @property
    def slots(self) -> int:  # type: ignore[override]
        """Return the number of tasks that keep the present workers busy."""
        with suppress(Exception):
            threads = sum(self._client.nthreads().values())
            self._slots = max(_TASKS_PER_WORKER * threads, _FEWEST_TASKS)
        return self._slots

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Any:
        """Give a task to the scheduler."""
        from distributed.client import ClosedClientError

        try:
            return self._client.submit(
                lambda shared: fn(*shared, *args, **kwargs),
                self._shared,
                key=f'task-{uuid4().hex}',
            )
        except (OSError, RuntimeError, ClosedClientError):
            raise self._lost() from None

    def end(self, future: Any) -> End:
        """Return how a task ended."""
        from distributed.scheduler import KilledWorker

        try:
            return End(future.result(timeout=_FETCH_S))
        except KilledWorker:
            return End(None, WorkerDied(_DIED))
        except (Exception, asyncio.CancelledError) as error:
            if getattr(future, 'status', 'error') != 'error':
                raise self._lost() from None
            return End(None, error)

    def _lost(self) -> UserError:
        return UserError(
            f'--scheduler {self._address}: was lost; start it again, and the same '
            'command continues'
        )

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Leave the cluster, which runs on; tasks are given up."""
        with suppress(Exception):
            self._client.close(timeout=_WAIT_S)


class _Task(NamedTuple):
    """A task that is to run."""

    arguments: tuple
    attempt: int = 1  # Number of the next attempt


class Finished(NamedTuple):
    """The end of a task."""

    arguments: tuple  # Its arguments
    value: Any  # What it returned; None after an error
    error: BaseException | None  # What the last attempt raised; None after a success
    attempts: int  # Number of attempts


def finished_tasks(
    pool: Pool, work: Callable[..., Any], tasks: Iterable[tuple], retries: int = RETRIES
) -> Generator[Finished, None, None]:
    """
    Run tasks in parallel; each gives one result, in the order in which they end.

    A task that raises, or whose worker ends, is repeated after all others. A `UserError` is not:
    it would come again.
    """
    todo = map(_Task, tasks)
    again: deque[_Task] = deque()  # Failed tasks
    running: dict[Any, _Task] = {}
    ended: SimpleQueue[Any] = SimpleQueue()
    try:
        while True:
            slots = pool.slots
            while len(running) < slots:
                task = next(todo, None)
                if task is None and again:
                    task = again.popleft()
                if task is None:
                    break
                future = pool.submit(work, *task.arguments)
                running[future] = task
                future.add_done_callback(ended.put)
            if not running:
                return
            with suppress(Empty):
                future = ended.get(timeout=_WAIT_S)
                task = running.pop(future)
                value, error = pool.end(future)
                is_final = error is None or isinstance(error, UserError)
                if is_final or task.attempt > retries:
                    yield Finished(task.arguments, value, error, task.attempt)
                else:
                    again.append(task._replace(attempt=task.attempt + 1))
    finally:
        for future in running:
            with suppress(Exception):  # of a scheduler that is gone
                future.cancel()
