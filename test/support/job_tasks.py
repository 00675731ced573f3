# SPDX-License-Identifier: Apache-2.0

"""Tasks for tests of pools; worker processes import this module."""

from contextlib import contextmanager
from multiprocessing.connection import Connection
import os
from pathlib import Path
import signal
import socket
import subprocess
import sys
import time

SUPPORT = Path(__file__).resolve().parent
_PART_BYTES = 1000
"""Part of a result that is sent, byte; more than its length has."""


def numbered(number, pause_s=0.01):
    time.sleep(pause_s)
    return number


def deadly(number, fatal, faulty):
    """End the worker at one number, and raise at another."""
    if number == fatal:
        os.kill(os.getpid(), signal.SIGKILL)
    if number == faulty:
        raise ValueError('faulty')
    return number


def long_with_file(folder):
    path = Path(folder) / str(os.getpid())
    try:
        path.write_text('')
        time.sleep(600)
    finally:
        path.unlink(missing_ok=True)


def half_sent(number):
    def send(self, buffer):
        os.write(self.fileno(), bytes(buffer[:_PART_BYTES]))
        if len(buffer) > _PART_BYTES:
            os.kill(os.getpid(), signal.SIGKILL)

    Connection._send = send
    return bytes(number)


def children(pid):
    listed = subprocess.run(
        ['pgrep', '-P', str(pid), '-f', 'spawn_main'], capture_output=True, text=True, check=False
    ).stdout.split()
    return [int(word) for word in listed]


def free_port():
    with socket.socket() as probe:
        probe.bind(('127.0.0.1', 0))
        return probe.getsockname()[1]


class DaskCluster:
    """A scheduler and workers, each a process that a test may kill."""

    def __init__(self, folder):
        self.address = f'tcp://127.0.0.1:{free_port()}'
        self._log = (Path(folder) / 'dask.log').open('ab')
        self._folder = folder
        self.scheduler = self._scheduler()
        self.workers = [self._worker() for _ in range(2)]

    def _start(self, module, *words):
        environment = os.environ | {'PYTHONPATH': os.pathsep.join([str(SUPPORT), *sys.path])}
        return subprocess.Popen(
            [sys.executable, '-m', f'distributed.cli.{module}', *words, '--no-dashboard'],
            env=environment,
            cwd=self._folder,
            stdout=self._log,
            stderr=self._log,
        )

    def _scheduler(self):
        port = self.address.rpartition(':')[2]
        return self._start('dask_scheduler', '--host', '127.0.0.1', '--port', port)

    def _worker(self):
        return self._start(
            'dask_worker',
            self.address,
            '--nthreads',
            '1',
            '--no-nanny',
            '--local-directory',
            str(self._folder),
        )

    def kill_worker(self, number):
        self._end(self.workers[number])
        self.workers[number] = self._worker()

    def kill_scheduler(self):
        """Kill the scheduler, and start another one; workers that ended start again."""
        self._end(self.scheduler)
        self.scheduler = self._scheduler()
        for number in range(len(self.workers)):
            self.kill_worker(number)

    @staticmethod
    def _end(process):
        process.kill()
        process.wait()

    def close(self):
        for process in (*self.workers, self.scheduler):
            self._end(process)
        self._log.close()


@contextmanager
def dask_cluster(folder):
    cluster = DaskCluster(folder)
    try:
        yield cluster
    finally:
        cluster.close()
