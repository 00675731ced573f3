# SPDX-License-Identifier: Apache-2.0

"""Pools of workers that end, raise, or lose their scheduler or their parent."""

from contextlib import suppress
import os
import random
import signal
import subprocess
import sys
from threading import Event, Thread
import time

from adxl_ros.workers import finished_tasks, open_pool, WorkerDied
from job_tasks import children, deadly, half_sent, numbered, SUPPORT
import pytest

pytestmark = pytest.mark.long

_LONG_WAIT_S = 300.0
"""Longest wait of a test for something, s."""


def wait_for(condition):
    end_s = time.monotonic() + _LONG_WAIT_S
    while not condition():
        assert time.monotonic() < end_s, 'waited too long'
        time.sleep(0.02)


def is_alive(pid):
    try:
        with open(f'/proc/{pid}/stat', encoding='utf-8') as file:
            return file.read().rpartition(')')[2].split()[0] != 'Z'
    except OSError:
        return False


def test_only_the_task_that_ends_its_worker_fails():
    with open_pool(None, 2) as pool:
        results = {
            end.arguments[0]: end
            for end in finished_tasks(
                pool, deadly, ((number, 3, 5) for number in range(12)), retries=1
            )
        }
    assert set(results) == set(range(12))
    assert isinstance(results[3].error, WorkerDied) and isinstance(results[5].error, ValueError)
    assert results[3].attempts == results[5].attempts == 2
    for number, end in results.items():
        if number not in (3, 5):
            assert (end.value, end.error, end.attempts) == (number, None, 1)


def test_a_worker_that_ends_while_it_sends_its_result():
    with open_pool(None, 1) as pool:
        error = pool.submit(half_sent, 1_000_000).exception(timeout=_LONG_WAIT_S)
        assert isinstance(error, WorkerDied)
        assert pool.submit(numbered, 4).result(timeout=_LONG_WAIT_S) == 4


def test_no_task_is_lost_while_workers_are_killed():
    chance, stop = random.Random(3), Event()

    def kill():
        while not stop.wait(chance.uniform(0.1, 0.4)):
            for pid in children(os.getpid())[:1]:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)

    killer = Thread(target=kill)
    killer.start()
    try:
        with open_pool(None, 2) as pool:
            results = list(finished_tasks(pool, numbered, ((n,) for n in range(200)), retries=20))
    finally:
        stop.set()
        killer.join()
    assert sorted(end.value for end in results) == list(range(200))


@pytest.mark.parametrize('sent', [signal.SIGKILL, signal.SIGINT])
def test_workers_end_with_their_parent_and_tidy_up(tmp_path, sent):
    program = f"""
import sys
sys.path.append({str(SUPPORT)!r})
from adxl_ros.workers import finished_tasks, open_pool
from job_tasks import long_with_file
if __name__ == '__main__':
    with open_pool(None, 2) as pool:
        list(finished_tasks(pool, long_with_file, [({str(tmp_path)!r},)] * 4))
"""
    (tmp_path / 'program').mkdir()
    script = tmp_path / 'program' / 'parent.py'
    script.write_text(program)
    environment = os.environ | {'PYTHONPATH': os.pathsep.join(sys.path)}
    with subprocess.Popen(
        [sys.executable, str(script)], env=environment, stderr=subprocess.DEVNULL
    ) as parent:
        wait_for(lambda: len(list(tmp_path.iterdir())) == 3)
        pids = [int(path.name) for path in tmp_path.iterdir() if path.name.isdigit()]
        parent.send_signal(sent)
    wait_for(lambda: not any(map(is_alive, pids)))
    assert [path.name for path in tmp_path.iterdir()] == ['program']
