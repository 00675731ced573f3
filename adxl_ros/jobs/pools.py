# SPDX-License-Identifier: Apache-2.0

"""
Pools of workers: processes of this machine, or a Dask cluster.

A pool is an `Executor`. Its futures raise three further exceptions. `WorkerDied` is for a task
that ran when its worker ended. `TaskLost` is for a task that only waited there, and `PoolLost`
stands for all tasks. A future has the number of workers that ended while they ran its task.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import lru_cache, partial
import logging
from multiprocessing import get_context, parent_process
import os
import pickle
import signal
import sys
from threading import RLock, Thread
from time import monotonic, sleep
from types import FrameType
from typing import Any
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
    """
    Processes of this machine, each an executor of its own.

    A worker that ends breaks only its own executor. The task that it ran is known.
    """

    def __init__(self, count: int, shared: tuple = ()) -> None:
        # A new process reads this before it loads numpy; each uses one core.
        os.environ['OPENBLAS_NUM_THREADS'] = '1'
        self.slots = _TASKS_PER_WORKER * count
        self._workers = [_Worker(shared) for _ in range(count)]

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        """Give a task to the worker that has the fewest."""
        return min(self._workers, key=lambda worker: worker.load).submit(partial(fn, **kwargs),
                                                                         args)

    def kill(self) -> None:
        """End all workers at once; they remove their temporary files."""
        for worker in self._workers:
            worker.kill()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the workers after their tasks."""
        for worker in self._workers:
            worker.shutdown(wait, cancel_futures)


class _Worker:
    """One process at a time, which is started again when it ends."""

    def __init__(self, shared: tuple) -> None:
        self._context = get_context('spawn')
        self._shared = shared
        self._lock = RLock()
        self._number = 0
        self._deaths_at_start = 0
        self._is_open = True
        self._process: Any = None
        self._executor, self._running = self._start()
        self._waiting: OrderedDict[int, TaskFuture] = OrderedDict()

    @property
    def load(self) -> int:
        """Return the number of tasks that are not finished."""
        return len(self._waiting)

    def _start(self) -> tuple[ProcessPoolExecutor, Any]:
        """Return an executor of one process, and the number of the task that it runs."""
        # Without a lock, which a worker that is killed could hold for ever.
        running = self._context.RawValue('Q', 0)
        return ProcessPoolExecutor(1, self._context, _start_worker,
                                   (running, self._shared)), running

    def submit(self, work: Callable[..., Any], arguments: tuple) -> Future:
        """Give a task to the process."""
        outer = TaskFuture()
        with self._lock:
            self._number += 1
            number = self._number
            self._waiting[number] = outer
            try:
                inner = self._executor.submit(_call, number, work, arguments)
            except BrokenProcessPool:
                # The process ended without a task. All that wait are lost, this one, too.
                self._restart(self._executor)
                return outer
            self._process = next(iter((self._executor._processes or {}).values()), self._process)
            # With this end open, a result that its worker sent in part would be waited for.
            results: Any = self._executor._result_queue
            results._writer.close()
            inner.add_done_callback(partial(self._take, number, self._executor))
        return outer

    def _take(self, number: int, executor: ProcessPoolExecutor, inner: Future) -> None:
        """Pass on the result of a task."""
        with self._lock:
            if inner.cancelled():
                outer = self._waiting.pop(number, None)
                if outer is not None:
                    outer.set_exception(TaskLost())
                return
            error = inner.exception()
            if isinstance(error, BrokenProcessPool):
                self._restart(executor)
                return
            self._deaths_at_start = 0
            outer = self._waiting.pop(number, None)
            if outer is None:
                return
            if error is not None:
                outer.set_exception(error)
            else:
                outer.set_result(inner.result())

    def _restart(self, broken: ProcessPoolExecutor) -> None:
        """Start another process in place of one that ended; blame the task that it ran."""
        if broken is not self._executor:
            return
        guilty = self._running.value
        lost, self._waiting = self._waiting, OrderedDict()
        # One that is killed says nothing about the installation.
        was_killed = self._process is not None and (self._process.exitcode or 0) < 0
        if guilty in lost:
            self._deaths_at_start = 0
        elif not was_killed:
            self._deaths_at_start += 1
        broken.shutdown(wait=False)
        if self._is_open:
            self._executor, self._running = self._start()
        for number, outer in lost.items():
            outer.deaths = int(number == guilty)
            if self._deaths_at_start >= _DEATHS_AT_START:
                outer.set_exception(UserError(
                    f'a worker ended {_DEATHS_AT_START} times before it ran a task; is the '
                    'memory of this machine full?'))
            else:
                outer.set_exception(WorkerDied('the worker ended while it ran the task')
                                    if outer.deaths else TaskLost())

    def kill(self) -> None:
        """End the process at once."""
        with self._lock:
            self._is_open = False
            for process in list((self._executor._processes or {}).values()):
                process.terminate()

    def shutdown(self, wait: bool, cancel_futures: bool) -> None:
        """End the process after its tasks."""
        with self._lock:
            self._is_open = False
            executor = self._executor
        executor.shutdown(wait, cancel_futures=cancel_futures)


_worker: dict[str, Any] = {}
"""In a worker process: the number of the last task, whether it runs, and what all tasks share."""


def _start_worker(running: Any, shared: tuple) -> None:
    """
    Prepare a process for tasks.

    Ctrl-C is left to the parent. A terminated worker ends by an exception, so that it removes its
    files and its own processes. A worker ends with its parent, however that ended.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _terminated)
    _worker.update(running=running, shared=shared, is_busy=False)
    Thread(target=_end_with_parent, daemon=True).start()


def _terminated(number: int, frame: FrameType | None) -> None:
    """End the worker; a task that runs may tidy up first."""
    if not _worker['is_busy']:
        os._exit(128 + number)
    sys.exit(128 + number)


def _end_with_parent() -> None:
    """Wait for the end of the parent, and end."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)


def _call(number: int, work: Callable[..., Any], arguments: tuple) -> Any:
    """Run a task in a worker, and note that it runs."""
    _worker['running'].value = number
    _worker['is_busy'] = True
    try:
        return work(*_worker['shared'], *arguments)
    except SystemExit as end:
        # The executor would pass this on as the error of a task, and the worker would live on.
        os._exit(end.code if isinstance(end.code, int) else 1)
    finally:
        _worker['is_busy'] = False


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
            error = WorkerDied('the worker ended while it ran the task') if outer.deaths else \
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
