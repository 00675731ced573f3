# SPDX-License-Identifier: Apache-2.0

"""
Many tasks in parallel: workers on this machine or a Dask cluster, retries, and what tasks write.

A worker may end at any time. Its task then raises `WorkerDied`, and no other task is touched.
Nothing here knows what a task computes.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager, suppress
from functools import partial
import logging
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection
from multiprocessing.pool import ExceptionWithTraceback  # type: ignore[attr-defined]
import os
from pathlib import Path
from queue import Empty, SimpleQueue
import signal
import sys
from threading import Thread
from time import monotonic, sleep
from typing import Any, cast, NamedTuple
from uuid import uuid4
import warnings

from adxl_ros.errors import install_hint, one_line, UserError

RETRIES = 2
"""Further attempts of a task that fails, by default; chosen."""
_TASKS_PER_WORKER = 3
"""Tasks that are submitted for each worker: one runs, two wait. Chosen: a worker is not idle where
the client is slow, and no more arguments are in memory."""
_FEWEST_TASKS = 4
"""Tasks that are submitted to a cluster at least. Chosen: one that grows by demand sees it."""
_CONNECT_S = 20.0
"""Time in which a scheduler must answer, s; chosen."""
_RECONNECT_S = 600.0
"""Time in which a scheduler that was lost must be back, s. Chosen: a node restarts in minutes."""
_FETCH_S = 60.0
"""Time in which a cluster must deliver a result, s; chosen: some MB over a slow line."""
_WAIT_S = 1.0
"""Time after which the number of slots is asked for again, s; chosen."""


class WorkerDied(Exception):
    """The worker ended while it ran a task."""

    def __str__(self) -> str:
        return 'the worker ended while it ran the task'


class PoolLost(Exception):
    """All tasks are lost, and the pool must be renewed."""


class Pool(Executor):
    """Workers, and how many tasks are submitted to them at once."""

    slots: int

    def end(self, future: Any) -> tuple[Any, BaseException | None]:
        """Return what a task that ended returned, and what it raised."""
        error = future.exception()
        return (None, error) if error else (future.result(), None)

    def renew(self) -> None:
        """Make the pool usable after all its tasks were lost."""

    def kill(self) -> None:
        """End all workers at once."""


@contextmanager
def open_pool(scheduler: str | None, jobs: int | None = None, shared: tuple = ()
              ) -> Iterator[Pool]:
    """
    Open a pool; the values of `shared` are the first arguments of all its tasks.

    Its workers end with the block, at once if an exception ends it.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else os.cpu_count()
    pool = Cluster(scheduler, shared) if scheduler else Processes(jobs or cores or 1, shared)
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
        self._shared = shared
        self._is_killed = False
        self._todo: SimpleQueue[tuple[Future, tuple] | None] = SimpleQueue()
        self._processes: dict[int, Any] = {}
        self._threads = [Thread(target=self._serve, args=(number,), daemon=True)
                         for number in range(count)]
        for thread in self._threads:
            thread.start()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        """Give a task to the first worker that is free."""
        future: Future = Future()
        future.set_running_or_notify_cancel()
        self._todo.put((future, (partial(fn, **kwargs), args)))
        return future

    def _serve(self, number: int) -> None:
        """Pass tasks to a process, which is started again when it ends, until there are none."""
        pipe: Connection | None = None
        while (item := self._todo.get()) is not None:
            future, task = item
            try:
                if pipe is None or not self._processes[number].is_alive():
                    pipe = self._start(number)
                pipe.send(task)
                value, error = pipe.recv()
            except (EOFError, OSError):
                pipe, value, error = None, None, WorkerDied()
            except Exception as problem:
                # The task or its error cannot be sent.
                value, error = None, problem
            if error is not None:
                future.set_exception(error)
            else:
                future.set_result(value)
        if pipe is not None:
            pipe.close()
            self._processes[number].join()

    def _start(self, number: int) -> Connection:
        """Start a process; the only other end of its pipe is in it, so that its end shows."""
        context = get_context('spawn')
        pipe, other = context.Pipe()
        process = context.Process(target=_work, args=(other, self._shared))
        process.start()
        other.close()
        self._processes[number] = process
        if self._is_killed:
            process.terminate()
        return pipe

    def kill(self) -> None:
        """End all workers at once; they remove their temporary files."""
        self._is_killed = True
        for process in list(self._processes.values()):
            process.terminate()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the workers after their tasks."""
        with suppress(Empty):
            while cancel_futures:
                self._todo.get_nowait()
        for _ in self._threads:
            self._todo.put(None)
        for thread in self._threads * wait:
            thread.join()


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
                pipe.send((work(*shared, *arguments), None))
            except Exception as error:
                pipe.send((None, ExceptionWithTraceback(error, error.__traceback__)))
    except (SystemExit, EOFError, ConnectionError):
        # Threads of a task do not keep the process.
        os._exit(0)


class Cluster(Pool):
    """A Dask cluster."""

    def __init__(self, address: str, shared: tuple = ()) -> None:
        try:
            import distributed  # noqa: F401
        except ImportError:
            raise UserError(f'--scheduler needs Dask; {install_hint("distributed")}') from None
        # A lost scheduler is reported by this module, in one line.
        for name in ('distributed', 'distributed.client', 'distributed.utils',
                     'tornado.application'):
            logging.getLogger(name).setLevel(logging.CRITICAL)
        warnings.filterwarnings('ignore', 'Sending large graph')
        self._address, self._values = address, shared
        self._slots = _FEWEST_TASKS
        try:
            self._connect()
        except (OSError, ValueError) as error:
            raise UserError(f'--scheduler {address}: no scheduler answers: {one_line(error)}'
                            ) from None

    def _connect(self) -> None:
        """Connect to the scheduler, and give it what all tasks share."""
        from distributed import Client
        self._client = Client(self._address, timeout=_CONNECT_S, set_as_default=False)
        # The cluster makes it again where all workers that have it end.
        self._shared = self._client.submit(tuple, self._values, key=f'shared-{uuid4().hex}')

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
            return self._client.submit(lambda shared: fn(*shared, *args, **kwargs), self._shared,
                                       key=f'task-{uuid4().hex}')
        except (OSError, RuntimeError, ClosedClientError):
            # The client is closed, or closes.
            lost: Future = Future()
            lost.set_exception(PoolLost())
            return lost

    def end(self, future: Any) -> tuple[Any, BaseException | None]:
        """Return what a task returned and raised; where it cannot be fetched, the pool is lost."""
        from distributed.scheduler import KilledWorker
        try:
            return future.result(timeout=_FETCH_S), None
        except (Exception, asyncio.CancelledError) as error:
            if getattr(future, 'status', 'error') != 'error':
                return None, PoolLost()
            return None, WorkerDied() if isinstance(error, KilledWorker) else error

    def renew(self) -> None:
        """Connect again to a scheduler that was lost."""
        end_s = monotonic() + _RECONNECT_S
        while True:
            self.shutdown()
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

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Leave the cluster, which runs on; tasks are given up."""
        with suppress(Exception):
            self._client.close(timeout=_WAIT_S)


class Finished(NamedTuple):
    """The end of a task."""

    arguments: tuple  # Its arguments
    value: Any  # What it returned; None after an error
    error: BaseException | None  # What the last attempt raised; None after a success
    attempts: int  # Number of attempts


def finished_tasks(pool: Pool, work: Callable[..., Any], tasks: Iterable[tuple],
                   retries: int = RETRIES) -> Generator[Finished, None, None]:
    """
    Run tasks in parallel; each gives one result, in the order in which they end.

    A task that raises, or whose worker ends, is repeated after all others. A `UserError` is not:
    it would come again. After the loss of a pool its tasks are submitted again, which does not
    count.
    """
    todo = ((arguments, 1) for arguments in tasks)
    again: deque[tuple[tuple, int]] = deque()
    running: dict[Any, tuple[tuple, int]] = {}
    ended: SimpleQueue[Any] = SimpleQueue()
    try:
        while True:
            slots = pool.slots
            while len(running) < slots and (
                    item := next(todo, None) or (again.popleft() if again else None)):
                future = pool.submit(work, *item[0])
                running[future] = item
                future.add_done_callback(ended.put)
            if not running:
                return
            try:
                future = ended.get(timeout=_WAIT_S)
                arguments, attempt = running.pop(future)
            except (Empty, KeyError):  # KeyError: a task of a pool that was lost
                continue
            value, error = pool.end(future)
            if isinstance(error, PoolLost):
                again.extend([(arguments, attempt), *running.values()])
                running.clear()
                pool.renew()
            elif error is None or isinstance(error, UserError) or attempt > retries:
                yield Finished(arguments, value, error, attempt)
            else:
                again.append((arguments, attempt + 1))
    finally:
        for future in running:
            future.cancel()


def for_each(pool: Pool, work: Callable[..., Any], jobs: Iterable[Callable[[], tuple]],
             keep: Callable[..., None], show: Callable[[float], None], done: int = 0) -> None:
    """Run jobs in parallel and keep each result as soon as it is there."""
    todo = list(jobs)
    for number, end in enumerate(finished_tasks(pool, work, (job() for job in todo)), done + 1):
        if end.error is not None:
            raise end.error
        keep(*end.value)
        show(number / (done + len(todo)))


def write(path: Path, data: bytes) -> None:
    """
    Write a file as a whole or not at all, in a folder that is made.

    Several processes may write the same one at once.
    """
    temporary = path.with_name(f'.{path.name}.{os.uname().nodename}.{os.getpid()}')
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(data)
        os.replace(temporary, path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink()
        raise UserError(f'{path}: cannot be written: {error.strerror}') from None
