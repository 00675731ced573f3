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

"""A driver on a hurt device, and the book that is kept of its samples."""

from contextlib import contextmanager
from dataclasses import dataclass
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from adxl_ros.model.sensor import to_volts
from domain import own_domain
from faulty_board import mark
from graph import Graph, imu_table
import iiod
import numpy as np
from sensor_msgs.msg import Imu
from units import nominal

HERE = Path(__file__).resolve().parent


class Helper:
    """A process of the tests' own that answers lines with lines."""

    def __init__(self, script, *args):
        self.popen = subprocess.Popen(
            [sys.executable, HERE / script, *map(str, args)], text=True, bufsize=1,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True)
        self.first = self.popen.stdout.readline().strip()

    def __call__(self, line):
        self.popen.stdin.write(line + '\n')
        return json.loads(self.popen.stdout.readline())

    def kill(self):
        self.popen.kill()
        self.popen.wait()
        self.popen.stdin.close()
        self.popen.stdout.close()


@dataclass(frozen=True)
class Book:
    """What was published, and what the driver says of it."""

    published: int
    wrong: int
    missing: int
    said: int
    estimated: int
    error_ms: float

    @property
    def right(self):
        """Tell whether nothing was wrong, and the count exact."""
        return not self.wrong and self.missing == self.said


class Rig:
    """Keeps the samples of a driver; `who` tells which sample volts are, `when` its time, ns."""

    def __init__(self, graph, who, when):
        self.graph, self.who, self.when = graph, who, when
        self.raws = graph.listen(Imu, 'imu/data_raw', raw=True)
        self.numbers = np.zeros(0, np.int64)
        self.stamps = np.zeros(0, np.int64)
        self.errors = np.zeros(0)
        self.wrong = self.base = self.base_estimated = 0

    def take(self):
        """Enter what has come into the book."""
        if not self.raws:
            return
        stamps, accel = imu_table(self.raws)
        self.raws.clear()
        codes = to_volts(accel[:, :2], nominal()) / nominal().lsb_v
        numbers, wrong = self.who(codes, stamps)
        order = np.concatenate([self.stamps[-1:], stamps])
        before = np.concatenate([self.numbers[-1:], numbers])
        self.wrong += wrong + int((np.diff(order) <= 0).sum() + (np.diff(before) <= 0).sum())
        self.numbers = np.concatenate([self.numbers, numbers])
        self.stamps = np.concatenate([self.stamps, stamps])
        self.errors = np.concatenate([self.errors, (stamps - self.when(numbers)) * 1e-6])

    def said(self, key):
        """Return a number of the newest diagnostics."""
        return float(self.graph.value('driver', key)) if 'driver' in self.graph.diagnostics else 0

    def count(self, count, timeout_s, what='samples'):
        """Listen until so many more samples have come."""
        wanted = len(self.numbers) + count

        def there():
            self.take()
            return len(self.numbers) >= wanted
        self.graph.spin_until(there, timeout_s, what)

    def begin(self):
        """Begin a new page."""
        self.settle()
        keep = slice(len(self.numbers) - 1, None)
        self.numbers, self.stamps = self.numbers[keep], self.stamps[keep]
        self.errors = self.errors[keep]
        self.wrong = 0
        self.base, self.base_estimated = self.said('missing'), self.said('missing_estimated')

    def settle(self):
        """Wait for diagnostics that know all that has been published."""
        self.count(round(0.3 * self.setting.get('rate', 1000.0)), 30)
        self.graph.diagnostics.clear()
        self.graph.spin_until(lambda: 'driver' in self.graph.diagnostics, 10, 'diagnostics')
        self.graph.spin(0.05)
        self.take()

    def recovered_ms(self, back_ns):
        """Wait for a sample taken after a monotonic time; return how long after it came, ms."""
        ros_ns = back_ns + time.time_ns() - time.monotonic_ns()

        def there():
            self.take()
            return self.stamps[-1] >= ros_ns
        self.graph.spin_until(there, 20, 'a new sample')
        return (time.monotonic_ns() - back_ns) * 1e-6

    def close(self):
        """Return what stands on the page."""
        self.settle()
        return Book(len(self.numbers) - 1, self.wrong,
                    int(self.numbers[-1] - self.numbers[0]) - len(self.numbers) + 1,
                    round(self.said('missing') - self.base),
                    round(self.said('missing_estimated') - self.base_estimated),
                    float(np.abs(self.errors).max()))


class SerialRig(Rig):
    """A driver on a faulty board."""

    def __init__(self, graph, folder, setting=None):
        self.path = Path(folder) / 'board'
        self.setting = setting or {}
        self.board = Helper('faulty_board.py', self.path, json.dumps(self.setting))
        self.origin_ns = json.loads(self.board.first)['origin_ns']
        self.halted = [(0, 0)]
        super().__init__(graph, self.tell, self.taken)

    def end(self):
        """Take the board away, its name first: a terminal's number may soon be another's."""
        self.path.unlink(missing_ok=True)
        self.board.kill()
        self.raws.clear()

    def parameters(self):
        return ['-p', 'link.type:=serial', '-p', f'link.port:={self.path}', '-p',
                'link.channels:=x,y,supply']

    def tell(self, codes, stamps):
        """Return the numbers of samples by their codes, and how many make no sense."""
        low = np.rint(codes[:, 0]).astype(np.int64) - 1
        guess = (stamps - self.taken(np.array([0]))) * 1e-9 * self.setting.get('rate', 1000.0)
        number = low + np.rint((guess - low) / 65534).astype(np.int64) * 65534
        wrong = np.abs(codes - np.rint(codes)).max(axis=1) > 1e-3
        wrong |= np.rint(codes[:, 1]) != mark(number)
        return number, int(wrong.sum())

    def taken(self, number):
        """Return the ROS time at which samples were taken, ns."""
        held = sum(np.where(number >= k, ns, 0) for k, ns in self.halted)
        step = 1e9 / self.setting.get('rate', 1000.0) * (1 + self.setting.get('ppm', 0) * 1e-6)
        return (self.origin_ns + time.time_ns() - time.monotonic_ns() + held
                + np.rint(number * step).astype(np.int64))

    def tell_board(self, line):
        """Let the board do something; returns when it is done."""
        answer = self.board(line)
        if line.startswith('halt'):
            self.halted.append((answer['k'], float(line.split()[1]) * 1e9))
        return answer['at_ns']


class IioRig(Rig):
    """A driver on the IIOD of the tests."""

    def __init__(self, graph, setting=None):
        self.setting = {'port': 0, 'began_ns': time.monotonic_ns(), **(setting or {})}
        self.start()
        super().__init__(graph, self.tell, self.taken)

    def start(self):
        self.server = Helper('iiod.py', json.dumps(self.setting))
        self.setting['port'] = int(self.server.first)

    def end(self):
        """End the server."""
        self.server.kill()

    def parameters(self):
        return ['-p', 'link.type:=iio', '-p', f'link.uri:=ip:127.0.0.1:{self.setting["port"]}',
                '-p', 'link.device:=adc']

    def taken(self, number):
        """Return the ROS time at which samples were taken, ns."""
        return (self.setting['began_ns'] + time.time_ns() - time.monotonic_ns()
                + np.rint(number * 1e6).astype(np.int64))

    def tell(self, codes, stamps):
        """Return the numbers of samples by their codes, and how many make no sense."""
        numbers = np.rint(codes[:, 0]).astype(np.int64) - 1
        right = iiod.code(numbers, 1, 16) == np.rint(codes[:, 1])
        return numbers, int((~right).sum())


@contextmanager
def graph_of_own():
    """Give a graph outside pytest, in a domain of its own."""
    with own_domain() as domain:
        os.environ['ROS_DOMAIN_ID'] = str(domain)
        os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
        with Graph() as graph:
            yield graph


def hold(pid, seconds, graph):
    """Stop a process for so long, and listen meanwhile; returns when it goes on, ns."""
    os.kill(pid, signal.SIGSTOP)
    graph.spin(seconds)
    os.kill(pid, signal.SIGCONT)
    return time.monotonic_ns()


def memory_mib(pid):
    """Return what a process holds in memory, MiB."""
    text = Path(f'/proc/{pid}/status').read_text()
    return int(text.split('VmRSS:')[1].split()[0]) / 1024
