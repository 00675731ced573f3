# SPDX-License-Identifier: Apache-2.0

"""A driver on an emulated device with faults, and a report of what it published."""

from dataclasses import dataclass
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from adxl_ros.model.sensor import to_volts
from faulty_board import CODES, mark
from graph import imu_table, QUEUE
import iiod
import numpy as np
from sensor_msgs.msg import Imu
from units import nominal

HERE = Path(__file__).resolve().parent
"""Folder of the scripts."""
KEPT = ('-p', f'qos_overrides./imu/data_raw.publisher.depth:={QUEUE}')


class ScriptProcess:
    """A script of this folder that answers lines with lines of JSON."""

    def __init__(self, script, *args):
        # The process
        self.popen = subprocess.Popen(
            [sys.executable, HERE / script, *map(str, args)],
            text=True,
            bufsize=1,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        self.first_line = self.popen.stdout.readline().strip()  # Its first line on stdout

    def ask(self, line):
        self.popen.stdin.write(line + '\n')
        return json.loads(self.popen.stdout.readline())

    def kill(self):
        self.popen.kill()
        self.popen.wait()
        self.popen.stdin.close()
        self.popen.stdout.close()


@dataclass(frozen=True)
class SampleReport:
    """What a driver has published, and what it reports about it."""

    wrong: int  # Samples with wrong values or in a wrong order
    missing: int  # Samples that the device took and that were not published
    counted: int  # Missing samples, as diagnostics report them
    estimated: int  # Part of `counted` that diagnostics call an estimate


class DriverRig:
    """Collects samples of a driver; `wrong` are those with wrong values or in a wrong order."""

    def __init__(self, graph, rate_hz):
        self.graph = graph
        self._rate_hz = rate_hz
        self._raws = graph.listen(Imu, 'imu/data_raw', raw=True)
        # numbers, stamps, errors: Number of each sample on the device, its stamp, ns, and the
        # error of the stamp, ms
        self.numbers = np.zeros(0, np.int64)
        self.stamps = np.zeros(0, np.int64)
        self.errors = np.zeros(0)
        self.wrong = self._counted_before = self._estimated_before = 0

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.end()

    def end(self):
        raise NotImplementedError

    def identify(self, codes, stamps):
        """Return the numbers of samples by codes and stamps, and how many codes are wrong."""
        raise NotImplementedError

    def taken_ns(self, numbers):
        """Return the ROS times at which the device took samples, ns."""
        raise NotImplementedError

    def numbered(self, codes, stamps):
        """Return the numbers of samples by their codes, which repeat after a minute."""
        remainder = np.rint(codes).astype(np.int64) - 1
        estimate = (stamps - self.taken_ns(np.array([0]))) * 1e-9 * self._rate_hz
        return remainder + np.rint((estimate - remainder) / CODES).astype(np.int64) * CODES

    def collect(self):
        if not self._raws:
            return
        stamps, accel = imu_table(self._raws)
        self._raws.clear()
        codes = to_volts(accel[:, :2], nominal()) / nominal().lsb_v
        numbers, wrong = self.identify(codes, stamps)
        stamp_steps = np.diff(np.concatenate([self.stamps[-1:], stamps]))
        number_steps = np.diff(np.concatenate([self.numbers[-1:], numbers]))
        self.wrong += wrong + int((stamp_steps <= 0).sum() + (number_steps <= 0).sum())
        self.numbers = np.concatenate([self.numbers, numbers])
        self.stamps = np.concatenate([self.stamps, stamps])
        self.errors = np.concatenate([self.errors, (stamps - self.taken_ns(numbers)) * 1e-6])

    def diagnostic(self, key):
        return float(self.graph.value('driver', key) or 0)

    def wait_for_samples(self, count, timeout_s, purpose='samples'):
        """Listen until so many further samples have come; fail with the purpose otherwise."""
        target = len(self.numbers) + count

        def complete():
            self.collect()
            return len(self.numbers) >= target

        self.graph.spin_until(complete, timeout_s, purpose)

    def begin_report(self):
        """Begin a new report with the next sample."""
        self._settle()
        last = slice(len(self.numbers) - 1, None)
        self.numbers, self.stamps = self.numbers[last], self.stamps[last]
        self.errors = self.errors[last]
        self.wrong = 0
        self._counted_before = self.diagnostic('missing')
        self._estimated_before = self.diagnostic('missing_estimated')

    def report(self):
        self._settle()
        expected = int(self.numbers[-1] - self.numbers[0]) + 1
        return SampleReport(
            self.wrong,
            expected - len(self.numbers),
            round(self.diagnostic('missing') - self._counted_before),
            round(self.diagnostic('missing_estimated') - self._estimated_before),
        )

    def _settle(self):
        """Wait for a sample of this moment, and for diagnostics that came after it."""
        self._wait_for_stamp(time.time_ns(), 30, 'a sample of now')
        sampled_ns = time.time_ns()
        self.graph.spin_until(
            lambda: self.graph.reported_ns.get('driver', 0) > sampled_ns, 10, 'diagnostics'
        )
        self.collect()

    def wait_for_recovery(self, back_ns, purpose):
        """Wait for a sample taken after a monotonic time; a second later it is late."""
        self._wait_for_stamp(
            back_ns + time.time_ns() - time.monotonic_ns(), 1, f'a new sample after: {purpose}'
        )

    def _wait_for_stamp(self, ros_ns, timeout_s, purpose):
        def reached():
            self.collect()
            return len(self.stamps) and self.stamps[-1] >= ros_ns

        self.graph.spin_until(reached, timeout_s, purpose)


class SerialRig(DriverRig):
    """A driver on a faulty board."""

    def __init__(self, graph, folder, options=None):
        options = options or {}
        super().__init__(graph, options.get('rate', 1000.0))
        self.path = Path(folder) / 'board'  # Port of the board
        # Process of the board
        self.board = ScriptProcess('faulty_board.py', self.path, json.dumps(options))
        self._origin_ns = json.loads(self.board.first_line)['origin_ns']
        self._period_ns = 1e9 / self._rate_hz * (1 + options.get('ppm', 0) * 1e-6)
        self._halts = [(0, 0)]

    def end(self):
        """Remove the name of the port first: another terminal may soon have the same number."""
        self.path.unlink(missing_ok=True)
        self.board.kill()
        self._raws.clear()

    def driver_parameters(self):
        return [
            *KEPT,
            '-p',
            'link.type:=serial',
            '-p',
            f'link.port:={self.path}',
            '-p',
            'link.channels:=x,y,supply',
        ]

    def identify(self, codes, stamps):
        numbers = self.numbered(codes[:, 0], stamps)
        wrong = np.abs(codes - np.rint(codes)).max(axis=1) > 1e-3
        wrong |= np.rint(codes[:, 1]) != mark(numbers)
        return numbers, int(wrong.sum())

    def taken_ns(self, numbers):
        halted_ns = sum(np.where(numbers >= first, ns, 0) for first, ns in self._halts)
        return (
            self._origin_ns
            + time.time_ns()
            - time.monotonic_ns()
            + halted_ns
            + np.rint(numbers * self._period_ns).astype(np.int64)
        )

    def command(self, line):
        """Send a command to the board; return the monotonic time at which it is done, ns."""
        answer = self.board.ask(line)
        if line.startswith('halt'):
            self._halts.append((answer['next_sample'], float(line.split()[1]) * 1e9))
        return answer['done_ns']


class IioRig(DriverRig):
    """A driver on the IIOD of the tests, whose process is `server`."""

    def __init__(self, graph):
        super().__init__(graph, 1000.0)
        self._options = {'port': 0, 'began_ns': time.monotonic_ns()}
        self.start()

    def start(self):
        self.server = ScriptProcess('iiod.py', json.dumps(self._options))
        self._options['port'] = int(self.server.first_line)

    def end(self):
        self.server.kill()

    def driver_parameters(self):
        return [
            *KEPT,
            '-p',
            'link.type:=iio',
            '-p',
            'link.device:=adc',
            '-p',
            f'link.uri:=ip:127.0.0.1:{self._options["port"]}',
        ]

    def identify(self, codes, stamps):
        numbers = self.numbered(codes[:, 0], stamps)
        wrong = iiod.code(numbers, 1, 16) != np.rint(codes[:, 1])
        return numbers, int(wrong.sum())

    def taken_ns(self, numbers):
        return (
            self._options['began_ns']
            + time.time_ns()
            - time.monotonic_ns()
            + np.rint(numbers * 1e6).astype(np.int64)
        )


def suspend(pid, duration_s, graph):
    """Stop a process for a time and listen meanwhile; return when it continues, ns."""
    os.kill(pid, signal.SIGSTOP)
    graph.spin(duration_s)
    os.kill(pid, signal.SIGCONT)
    return time.monotonic_ns()


def memory_mib(pid):
    text = Path(f'/proc/{pid}/status').read_text()
    return int(text.split('VmRSS:')[1].split()[0]) / 1024
