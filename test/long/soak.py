# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
1 kHz of three channels for half an hour, with a random fault every 20 s; a sweep killed 200 times.

    make soak                       prints tables for docs/links.md and docs/guided.md
    make soak ARGS='--minutes 5 --kills 20 --seed 3'
"""

import argparse
from collections import defaultdict
from importlib.metadata import version
import os
import sys
import tempfile
import time

from domain import BY_UDP
from faults import driver, line, Row, run, SERIAL
from kills import kill
import numpy as np
from rig import Book, graph_of_own, memory_mib, SerialRig

_EVERY_S = 20.0


def soak(minutes, seed):
    """Run; returns the books by row, and the memory of the driver at 1 minute and at the end."""
    rng = np.random.default_rng(seed)
    books = defaultdict(list)
    quiet = Row('no fault', lambda rig, pid, seconds: rig.graph.spin(seconds) or 0)
    with tempfile.TemporaryDirectory() as folder, graph_of_own() as graph:
        rig = SerialRig(graph, folder, {'seed': seed, 'ppm': 60.0})
        with driver(*rig.parameters()) as process:
            rig.count(1000, 30)
            began = due = time.monotonic()
            memory = []
            while time.monotonic() < began + 60 * minutes:
                row = SERIAL[rng.integers(len(SERIAL))]
                books[row].append(run(row, rig, process.pid, 2.0))
                due += _EVERY_S
                left = due - time.monotonic()
                if left > 3.0:
                    books[quiet].append(run(quiet, rig, process.pid, left - 3.0))
                if len(memory) < 1 and time.monotonic() > began + 60:
                    memory.append(memory_mib(process.pid))
            memory.append(memory_mib(process.pid))
        rig.end()
    return books, memory


def summed(books):
    """Add up books; the worst stamp and the slowest recovery of all."""
    told = [b for b, _ in books]
    slow = [ms for _, ms in books if ms is not None]
    sums = (sum(getattr(b, name) for b in told) for name in (
        'published', 'wrong', 'missing', 'said', 'estimated'))
    return Book(*sums, max(b.error_ms for b in told)), max(slow) if slow else None


def main():
    parse = argparse.ArgumentParser(description=__doc__)
    parse.add_argument('--minutes', type=float, default=30.0)
    parse.add_argument('--seed', type=int, default=1)
    parse.add_argument('--kills', type=int, default=200)
    options = parse.parse_args()
    wrong = []
    if options.minutes:
        wrong += links(options)
    if options.kills:
        wrong += sweeps(options)
    print(f'soak: wrong: {", ".join(wrong)}' if wrong else 'soak: nothing wrong', file=sys.stderr)
    return 1 if wrong else 0


def dated(options, what):
    """Return the line above a table."""
    return (f'{time.strftime("%Y-%m-%d")}, adxl_ros {version("adxl_ros")}, seed {options.seed}, '
            f'{what}.\n')


def links(options):
    """Run the links for a while, print their table, and return what went wrong."""
    books, memory = soak(options.minutes, options.seed)
    print(dated(options, f'{options.minutes:g} minutes'))
    print('| fault | times | published | wrong | missing | said | recovered within | '
          'worst stamp, ms |\n|---|---|---|---|---|---|---|---|')
    for row, told in sorted(books.items(), key=lambda item: item[0].name):
        parts = line(row, *summed(told)).split('|')
        print('|'.join([*parts[:2], f' {len(told)} ', *parts[2:]]))
    print('|'.join(['', ' all ', f' {sum(map(len, books.values()))} ', *line(
        Row('', None), *summed([b for told in books.values() for b in told])).split('|')[2:]]))
    print(f'\nMemory of the driver: {memory[0]:.1f} MiB after a minute, {memory[-1]:.1f} MiB at '
          'the end.')
    return [row.name for row, told in books.items() for b, _ in told
            if b.wrong or (row.exact and b.missing != b.said)]


def sweeps(options):
    """Kill a sweep again and again, print what came of it, and return what went wrong."""
    with tempfile.TemporaryDirectory() as folder, graph_of_own():
        told = kill(folder, os.environ | BY_UDP, options.kills, options.seed)
    print(dated(options, f'{told.kills} kills'))
    print('| killed while | times |\n|---|---|')
    for moment, times in sorted(told.moments.items()):
        print(f'| {moment} | {times} |')
    print(f'\n{told.poses} poses were acknowledged, {told.sweeps} sweeps came to their end; '
          f'lost or changed: {len(told.lost)}, broken files: {len(told.broken)}.')
    few = [f'only {told.sweeps} sweeps ended'] if told.sweeps < told.kills // 10 else []
    return [*told.lost, *told.broken, *few]


if __name__ == '__main__':
    sys.exit(main())
