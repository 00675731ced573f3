# SPDX-License-Identifier: Apache-2.0

"""
Thousands of recordings while workers, scheduler and client are killed: `make fleet`.

    make fleet ARGS='--recordings 1000 --seed 1'

The recordings are worked on three times: on the processes of this machine without a kill, a tenth
of them on 16 processes, and on a Dask cluster under kills. It prints a table for docs/fleet.md.
"""

import argparse
from contextlib import suppress
from dataclasses import dataclass
from datetime import date, timedelta
import os
from pathlib import Path
import random
import signal
import subprocess
import sys
import tempfile
from threading import Event, Thread
import time

from adxl_ros.files.package_version import package_version
from fleets import row_files, table_of, without_timing, write_fleet
from job_tasks import dask_cluster
from processes import executable

_DAYS = 50
"""Recordings of each unit."""
_SPAN_S = 4.0
"""Length of a recording, s."""
_MANY_JOBS = 16
"""Processes of the second run."""
_ROWS_BETWEEN_KILLS = (5, 120)
"""New rows after which a worker is killed again: one that never works shows nothing."""
_STALLED_S = 600.0
"""Time without a new row from which the run has failed, s."""
_LARGEST_LOST_SHOWN = 3
"""Lost rows that are named."""


def peak_mb(process: subprocess.Popen) -> float:
    """Return the largest memory of a process, MB; 0 for one that ended."""
    with suppress(OSError, StopIteration):
        lines = Path(f'/proc/{process.pid}/status').read_text().splitlines()
        return int(next(line for line in lines if line.startswith('VmHWM')).split()[1]) / 1024
    return 0.0


class Client:
    """
    A client and its largest memory.

    peak_mb: largest memory so far, MB; processor_s: processor time so far, s.
    """

    def __init__(self, folder: Path, *words: object) -> None:
        # The process of the command
        self.process = subprocess.Popen([executable('fleet'), *map(str, words)], cwd=folder,
                                        stdout=subprocess.DEVNULL, start_new_session=True)
        self.peak_mb = self.processor_s = 0.0

    def is_running(self) -> bool:
        """Measure the memory; return whether the client runs."""
        self.peak_mb = max(self.peak_mb, peak_mb(self.process))
        with suppress(OSError):
            fields = Path(f'/proc/{self.process.pid}/stat').read_text().rpartition(')')[2].split()
            self.processor_s = (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')
        return self.process.poll() is None

    def finish(self) -> None:
        """Wait for the end."""
        while self.is_running():
            time.sleep(0.1)
        assert self.process.returncode == 0, f'exit status {self.process.returncode}'


def busy_share(rows: list[dict], jobs: int) -> float:
    """Return the share of the workers' time that tasks used."""
    begin = min(row['written'] - timedelta(seconds=row['seconds']) for row in rows)
    span_s = (max(row['written'] for row in rows) - begin).total_seconds()
    return sum(row['seconds'] for row in rows) / (jobs * span_s)


def count_rows(folder: Path) -> int:
    """Return the number of rows that are written."""
    with suppress(FileNotFoundError):
        return sum(not entry.name.startswith('.') for entry in os.scandir(folder / 'rows'))
    return 0


@dataclass
class KilledRun:
    """What a run under kills shows."""

    # workers, scheduler, client: Number of kills
    workers: int = 0
    scheduler: int = 0
    client: int = 0
    # client_mb, scheduler_mb: Largest memory, MB
    client_mb: float = 0.0
    scheduler_mb: float = 0.0
    changed: int = 0  # Rows that changed after they were written
    span_s: float = 0.0  # Time of the run, s


def killed_run(folder: Path, words: list[object], count: int, seed: int) -> KilledRun:
    """Work on all recordings on a cluster under kills."""
    chance, stop, run = random.Random(seed), Event(), KilledRun()
    begin_s = time.monotonic()
    with dask_cluster(folder) as cluster:
        def kill_workers() -> None:
            wanted = 0
            while not stop.wait(0.1):
                if count_rows(folder / 'killed') >= wanted:
                    cluster.kill_worker(chance.randrange(len(cluster.workers)))
                    run.workers += 1
                    wanted = count_rows(folder / 'killed') + chance.randint(*_ROWS_BETWEEN_KILLS)
        killer = Thread(target=kill_workers)
        killer.start()
        command = (*words, '-o', 'killed', '--scheduler', cluster.address)
        client = Client(folder, *command)
        wait_for_rows(folder / 'killed', count // 3, client)
        client.process.send_signal(signal.SIGKILL)
        client.process.wait()
        run.client += 1
        before = row_files(folder / 'killed')
        second = Client(folder, *command)
        wait_for_rows(folder / 'killed', 2 * count // 3, second)
        run.scheduler_mb = peak_mb(cluster.scheduler)
        cluster.kill_scheduler()
        run.scheduler += 1
        second.finish()
        run.scheduler_mb = max(run.scheduler_mb, peak_mb(cluster.scheduler))
        stop.set()
        killer.join()
    run.client_mb, run.span_s = max(client.peak_mb, second.peak_mb), time.monotonic() - begin_s
    after = row_files(folder / 'killed')
    run.changed = sum(after.get(name) != content for name, content in before.items())
    return run


def wait_for_rows(folder: Path, count: int, client: Client) -> None:
    """Wait until a number of rows is written."""
    last, last_s = 0, time.monotonic()
    while (now := count_rows(folder)) < count:
        assert client.is_running(), 'the client ended'
        if now != last:
            last, last_s = now, time.monotonic()
        assert time.monotonic() - last_s < _STALLED_S, 'no new row'
        time.sleep(0.1)


def main() -> None:
    """Run and print the table."""
    parse = argparse.ArgumentParser(description=__doc__)
    parse.add_argument('--recordings', type=int, default=10_000)
    parse.add_argument('--jobs', type=int, default=len(os.sched_getaffinity(0)))
    parse.add_argument('--do', default='check')
    parse.add_argument('--seed', type=int, default=0)
    options = parse.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        units = -(-options.recordings // _DAYS)
        write_fleet(folder / 'all', units, _DAYS, options.seed, _SPAN_S)
        (folder / 'some').mkdir()
        for path in sorted((folder / 'all').iterdir())[::10]:
            (folder / 'some' / path.name).hardlink_to(path)
        load = os.getloadavg()[0]
        begin_s = time.monotonic()
        calm = Client(folder, 'all', '--do', options.do, '-o', 'calm', '--jobs', options.jobs)
        calm.finish()
        calm_s = time.monotonic() - begin_s
        print(f'without kills: {calm_s:.0f} s', file=sys.stderr)
        expected = table_of(folder / 'calm')
        Client(folder, 'some', '--do', options.do, '-o', 'many', '--jobs', _MANY_JOBS).finish()
        many = {row['key']: row for row in without_timing(table_of(folder / 'many'))}
        differ = sum({**row, 'url': ''} != {**many[row['key']], 'url': ''}
                     for row in without_timing(expected) if row['key'] in many)
        killed = killed_run(folder, ['all', '--do', options.do], len(expected), options.seed)
        rows = table_of(folder / 'killed')
    by_url = {row['url']: row for row in without_timing(rows)}
    lost = [row['url'] for row in expected if row['url'] not in by_url]
    print(lost[:_LARGEST_LOST_SHOWN] or '')
    wrong = sum(row != by_url.get(row['url']) for row in without_timing(expected)
                if row['url'] in by_url)
    client_time = f'{1e3 * calm.processor_s / len(expected):.1f} ms'
    busy = f'{busy_share(expected, options.jobs):.3f}'
    print(f'{date.today()}, adxl_ros {package_version()}, seed {options.seed}, '
          f'{len(os.sched_getaffinity(0))} cores, load before {load:.1f}.\n')
    figures = {
        'recordings': len(expected), 'tasks': options.do,
        'kills of workers, scheduler, client':
            f'{killed.workers}, {killed.scheduler}, {killed.client}',
        'rows lost': len(lost), 'rows duplicated': len(rows) - len(by_url),
        'rows that differ from a run without kills': wrong,
        'written rows that changed after the client was killed': killed.changed,
        f'rows that differ on {_MANY_JOBS} workers (of {len(many)})': differ,
        f'share of the time in which {options.jobs} workers compute': busy,
        'time without kills, and with kills': f'{calm_s:.0f} s, {killed.span_s:.0f} s',
        'processor time of the client for each row, with table and page': client_time,
        'most attempts of a row': max(row['attempts'] for row in rows),
        'largest memory of a client': f'{max(calm.peak_mb, killed.client_mb):.0f} MB',
        'largest memory of a scheduler': f'{killed.scheduler_mb:.0f} MB',
    }
    for label, value in figures.items():
        print(f'| {label} | {value} |')


if __name__ == '__main__':
    main()
