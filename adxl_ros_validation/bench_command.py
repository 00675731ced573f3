# SPDX-License-Identifier: Apache-2.0

"""Measure the live nodes and the reading of recordings, beside a bare baseline."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, ExitStack, suppress
import os
from pathlib import Path
import subprocess
import sys
import tempfile
import time
from typing import Any, NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.files import cdr
from adxl_ros.nodes.jobs import executable, running, use_own_graph
from adxl_ros.nodes.topics import Inbox
from adxl_ros.tools import command_line as cli
from adxl_ros_validation.bench_jobs import offline_jobs, print_table, spread
import numpy as np
import pandas as pd
import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Imu

RATE_HZ = 1000.0
"""Sample rate of all measurements, Hz."""
_START_S = 20.0
"""Longest time until the first messages, s; chosen: a busy machine starts a node in 10 s."""
_FIRST_MESSAGES = 50
"""Messages after which a stream has begun."""
BARE_QUEUE = 10
"""Messages that a bare node keeps, the usual depth of ROS examples."""
_RELAY = 'bare publisher and relay'
"""The subject that driver and compensation are compared with."""


class Listener(Node):
    """Keeps the arrival time and the bytes of each message."""

    def __init__(self, topic: str) -> None:
        super().__init__('listener')
        self.messages: list[tuple[int, bytes]] = []  # Arrival time, ns, and serialized message
        # An executor of rclpy would take as much of a core as the nodes that are measured.
        # Messages of 1 s are kept while the listener is busy.
        self._inbox = Inbox(self, Imu, topic, round(RATE_HZ))

    def listen(self, seconds: float, limit: float = np.inf) -> None:
        """Keep the messages of some time."""
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s and len(self.messages) < limit:
            self._inbox.wait()
            self.messages += [(time.time_ns(), raw) for raw in self._inbox.take()]
        if not self.messages:
            raise UserError(f'no messages for {seconds:g} s')


@contextmanager
def _listening(topic: str) -> Iterator[Listener]:
    """Yield a listener of a topic."""
    rclpy.init(args=[])
    listener = Listener(topic)
    try:
        yield listener
    finally:
        listener.destroy_node()
        rclpy.try_shutdown()


class BarePublisher(Node):
    """The smallest node that publishes Imu at 1 kHz: a timer and one message."""

    def __init__(self) -> None:
        super().__init__('bare_publisher')
        self._message = Imu()
        self._publisher = self.create_publisher(Imu, 'bare', BARE_QUEUE)
        self.create_timer(1 / RATE_HZ, self._publish)

    def _publish(self) -> None:
        self._message.header.stamp = self.get_clock().now().to_msg()
        self._publisher.publish(self._message)


class BareRelay(Node):
    """The smallest node that passes Imu on."""

    def __init__(self) -> None:
        super().__init__('bare_relay')
        publisher = self.create_publisher(Imu, 'relayed', BARE_QUEUE)
        self.create_subscription(Imu, 'bare', publisher.publish, qos_profile_sensor_data)


def spin(make: Callable[[], Node]) -> None:
    """Spin a bare node until a signal ends it."""
    rclpy.init()
    executor = SingleThreadedExecutor()
    executor.add_node(make())
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        executor.spin()


class _Subject(NamedTuple):
    """What is measured: the last of its processes, behind those that feed it."""

    label: str  # Its name in the table
    topic: str  # Topic of its last node
    commands: Sequence[Sequence[str]]  # Commands of its processes
    feed: str = ''  # Topic of the process before the last one, if there is one


def measure_live(seconds: float, rounds: int, iiod: str | None) -> None:
    """Print rate, loss, age on arrival and processor time of each subject, of some rounds."""
    print(
        f'{RATE_HZ:g} Hz, {rounds} x {seconds:g} s: medians (range). '
        f'Load of the machine before: {os.getloadavg()[0]:.1f}'
    )
    print(
        f'{"":27} {"Hz":>6} {"lost":>4} {"p50 ms":>16} {"p99 ms":>17} {"first, s":>17}  CPU, %\n'
        'first: from the start of the last process of a row to its first sample',
        flush=True,
    )
    rows = []
    with ExitStack() as stack:
        for subject in _subjects(stack, iiod) * rounds:
            try:
                row = _measure(subject, seconds)
            except UserError as error:
                row = {'error': str(error)}
            rows.append({'label': subject.label, 'error': None, **row})
    load = {}
    for label, table in pd.DataFrame(rows).groupby('label', sort=False):
        if len(good := table[table.error.isna()]):
            load[label] = good.loads.map(sum).median()
            loads = ' + '.join(f'{100 * load:.1f}' for load in np.median([*good.loads], axis=0))
            print(
                f'{label:27} {good.rate_hz.median():6.0f} {good.missing.median():4.0f} '
                f'{spread(good.p50_ms, ".2f"):>16} {spread(good.p99_ms, ".2f"):>17} '
                f'{spread(good.first_s, ".2f"):>17}  {loads}'
            )
        if len(bad := table.error.dropna()):
            print(f'{label:27} failed in {len(bad)} of {rounds} rounds: {bad.iloc[-1]}')
    for label in load:
        if 'compensation' in label:
            print(
                f'CPU of {label} by that of the {_RELAY}: '
                f'{load[label] / load.get(_RELAY, np.nan):.2f}'
            )
    print(f'Load of the machine after: {os.getloadavg()[0]:.1f}', flush=True)


def _subjects(stack: ExitStack, iiod: str | None) -> list[_Subject]:
    """Return what is measured; `stack` ends the devices."""
    bare = [
        [
            sys.executable,
            '-c',
            f'from adxl_ros_validation import bench_command as bench; '
            f'bench.spin(bench.{node.__name__})',
        ]
        for node in (BarePublisher, BareRelay)
    ]
    port = stack.enter_context(_emulated_board())
    driver, compensation = executable('driver'), executable('compensation')
    drivers = {
        'sim': [driver],
        'serial': [
            driver,
            '--ros-args',
            '-p',
            'link.type:=serial',
            '-p',
            f'link.port:={port}',
            '-p',
            'link.channels:=x,y,supply,temperature',
        ],
    }
    if iiod is not None:
        uri = stack.enter_context(_iio_server(iiod))
        drivers['iio'] = [driver, '--ros-args', '-p', 'link.type:=iio', '-p', f'link.uri:={uri}']
    return [
        _Subject('bare publisher', 'bare', bare[:1]),
        _Subject(_RELAY, 'relayed', bare, 'bare'),
        *(
            _Subject(f'driver, {link}', 'imu/data_raw', [command])
            for link, command in drivers.items()
        ),
        *(
            _Subject(
                f'driver, {link}, compensation',
                'imu/data',
                [command, [compensation]],
                'imu/data_raw',
            )
            for link, command in drivers.items()
        ),
    ]


def cpu_time_s(pid: int) -> float:
    """Return the time that a process has spent on a core so far, s."""
    # Behind the name of the command, its user and system time are fields 11 and 12 (man 5 proc).
    fields = Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1].split()
    return sum(map(int, fields[11:13])) / os.sysconf('SC_CLK_TCK')


@contextmanager
def _emulated_board() -> Iterator[str]:
    """Give the port of an emulated board."""
    with tempfile.TemporaryDirectory() as folder:
        port = Path(folder, 'board')
        with running([[executable('simulate'), 'soak', '--port', str(port)]]):
            end_s = time.monotonic() + _START_S
            while not port.exists():
                if time.monotonic() > end_s:
                    raise UserError(
                        f'{port}: the emulated board has not begun after {_START_S:g} s'
                    )
                time.sleep(0.05)
            yield str(port)


@contextmanager
def _iio_server(iiod: str) -> Iterator[str]:
    """Give the URI of an IIOD with two axes and supply."""
    with subprocess.Popen([sys.executable, iiod], stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None, 'Popen makes the pipe'
        try:
            yield f'ip:127.0.0.1:{server.stdout.readline().strip()}'
        finally:
            server.kill()


def _measure(subject: _Subject, seconds: float) -> dict[str, Any]:
    """
    Measure a subject once, for a time, s.

    Return the time from the start of its last process to the first sample, messages by time,
    samples that did not come, the age of samples on arrival, and processor time by time, one for
    each process.
    """
    with ExitStack() as stack:
        processes = stack.enter_context(running(subject.commands[:-1]))

        def cpu_times_s() -> np.ndarray:
            return np.array([cpu_time_s(process.pid) for process in processes])

        try:
            if processes:
                with _listening(subject.feed) as fed:
                    fed.listen(_START_S, _FIRST_MESSAGES)
            listener = stack.enter_context(_listening(subject.topic))
            began_ns = time.time_ns()
            processes = processes + stack.enter_context(running(subject.commands[-1:]))
            listener.listen(_START_S, _FIRST_MESSAGES)
            first_s = (listener.messages[0][0] - began_ns) * 1e-9
            # A stream that has begun runs for 2 s before it is measured.
            listener.listen(2.0)
            listener.messages.clear()
            before_s, began_s = cpu_times_s(), time.monotonic()
            listener.listen(seconds)
            duration_s = time.monotonic() - began_s
            loads = (cpu_times_s() - before_s) / duration_s
        except UserError as error:
            ended = [
                f'{process.args!r} ended with status {process.returncode}'
                for process in processes
                if process.poll() is not None
            ]
            raise UserError(', '.join([*ended, str(error)])) from None
    arrived_ns, raw = zip(*listener.messages)
    stamps_ns = np.concatenate([table.stamp_ns() for table in cdr.tables(raw, cdr.imu)])
    age_ms = (np.array(arrived_ns) - stamps_ns) * 1e-6
    periods = np.rint(np.diff(np.sort(stamps_ns)) * 1e-9 * RATE_HZ)
    # The stamps of a bare timer wander: only steps of two periods and more are a loss.
    missing = int(np.sum(np.maximum(periods - 1, 0)))
    p50_ms, p99_ms = np.percentile(age_ms, [50, 99])
    return {
        'first_s': first_s,
        'rate_hz': len(stamps_ns) / duration_s,
        'missing': missing,
        'p50_ms': p50_ms,
        'p99_ms': p99_ms,
        'loads': tuple(loads),
    }


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parse = cli.argument_parser(
        'bench',
        __doc__,
        {
            'all measurements, ten minutes': '',
            'with recordings of 10 minutes, not 8 hours': '--hours 0.17',
            'only the live nodes': '--live',
            'a short look': '--live --seconds 5 --rounds 1',
        },
    )
    parse.add_argument(
        '--seconds',
        type=float,
        default=10.0,
        help='duration of each live measurement, s (default 10)',
    )
    parse.add_argument(
        '--rounds', type=int, default=3, help='measurements of each row (default 3)'
    )
    parse.add_argument(
        '--hours',
        type=float,
        default=8.0,
        help='duration of the recordings of the rows "apply, … h" (default 8: 30 GB of disk)',
    )
    parse.add_argument('--live', action='store_true', help='measure only the live nodes')
    parse.add_argument('--iiod', metavar='FILE', help="the tests' IIOD, for the link iio")
    return parse


def bench(options: argparse.Namespace) -> int:
    """Run the benchmark; see `parser`."""
    cli.check_least(options, seconds=0.1, rounds=1, hours=0.01)
    use_own_graph()
    measure_live(options.seconds, options.rounds, options.iiod)
    if not options.live:
        print_table(offline_jobs(options.hours), options.rounds)
    return 0


def main() -> int:
    """Run the tool on the command line."""
    return cli.run(parser(), bench)
