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
The matrix of faults: what is done to a device, and what its driver must have published then.

    make faults     every row for longer than in the tests, as a table
"""

from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
import subprocess
import sys
import tempfile
import time

from ament_index_python.packages import get_package_prefix
from rig import graph_of_own, hold, IioRig, SerialRig


@dataclass(frozen=True)
class Row:
    """
    A fault.

    Attributes
    ----------
    name
        For the table.
    act
        Does it, given the rig, the driver's process id and a time; returns when the device was
        well again, ns of the monotonic clock, or 0 where it has not been away.
    exact
        Whether the device's own count goes on, so that what is missing is known exactly.

    """

    name: str
    act: object
    exact: bool = True


def bytes_hurt(kind, rate):
    def act(rig, pid, seconds):
        rig.tell_board(f'fault {kind} {rate:g}')
        rig.graph.spin(seconds)
        rig.tell_board('clear')
        return 0
    return Row(f'{kind} {rate:g} a byte' if rate else 'wrong baud rate', act)


def told(name, command, exact=True):
    def act(rig, pid, seconds):
        return rig.tell_board(command)
    return Row(name, act, exact)


def board_stopped(rig, pid, seconds):
    hold(rig.board.popen.pid, 3.0, rig.graph)
    return 0


def driver_stopped(rig, pid, seconds):
    hold(pid, 3.0, rig.graph)
    return 0


def server_stopped(rig, pid, seconds):
    return hold(rig.server.popen.pid, 2.0, rig.graph)


def server_killed(rig, pid, seconds):
    rig.server.kill()
    rig.graph.spin(1.0)
    rig.start()
    return time.monotonic_ns()


SERIAL = (
    *(bytes_hurt(kind, rate) for kind in ('flip', 'lose', 'insert', 'burst')
      for rate in (1e-4, 1e-3)),
    bytes_hurt('baud', 0),
    told('100 kB without a delimiter', 'flat 100000'),
    told('200 kB of noise', 'noise 200000'),
    told('137 samples lost by the board', 'drop 137'),
    told('unplugged for 1 s, in a read', 'unplug 1'),
    told('reset, away for 0.5 s', 'reset 0.5', False),
    told('board and clock halted for 1 s', 'halt 1'),
    Row('board stopped for 3 s', board_stopped),
    Row('reader stopped for 3 s', driver_stopped),
)
IIO = (
    Row('iiod: SIGSTOP for 2 s', server_stopped, False),
    Row('iiod: SIGKILL, back after 1 s', server_killed, False),
    Row('iio: reader stopped for 3 s', driver_stopped, False),
)


@contextmanager
def driver(*parameters):
    """Run the installed driver; gives its process."""
    path = Path(get_package_prefix('adxl_ros')) / 'lib' / 'adxl_ros' / 'driver'
    popen = subprocess.Popen([path, '--ros-args', *map(str, parameters)],
                             stderr=subprocess.DEVNULL)
    try:
        yield popen
    finally:
        popen.terminate()
        popen.wait()


def run(row, rig, pid, seconds):
    """Do what a row says; return the book, and after how many ms samples flowed again."""
    rig.begin()
    back_ns = row.act(rig, pid, seconds)
    recovered_ms = rig.recovered_ms(back_ns) if back_ns else None
    rig.count(200, 20, f'samples after: {row.name}')
    return rig.close(), recovered_ms


def line(row, book, recovered_ms):
    """Write a row of the table."""
    known = f'{book.said}, {book.estimated} of them estimated' if book.estimated else \
        'exactly that' if book.missing == book.said else f'{book.said}'
    after = '' if recovered_ms is None else f'{recovered_ms:.0f} ms'
    return (f'| {row.name} | {book.published} | {book.wrong} | {book.missing} | {known} | '
            f'{after} | {book.error_ms:.2f} |')


HEAD = ('| fault | published | wrong | missing | said | recovered in | worst stamp, ms |\n'
        '|---|---|---|---|---|---|---|')


def main():
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 20.0
    print(HEAD)
    with tempfile.TemporaryDirectory() as folder:
        for rows, make in ((SERIAL, lambda graph: SerialRig(graph, folder, {'banner': True})),
                           (IIO, IioRig)):
            with graph_of_own() as graph:
                rig = make(graph)
                with driver(*rig.parameters()) as process:
                    rig.count(1000, 30)
                    for row in rows:
                        print(line(row, *run(row, rig, process.pid, seconds)), flush=True)
                rig.end()
    return 0


if __name__ == '__main__':
    sys.exit(main())
