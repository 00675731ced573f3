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

"""Measure the live nodes and the reading of recordings, beside a bare baseline."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
import subprocess
import sys
import tempfile
import time

from adxl_ros.errors import UserError
from adxl_ros.files import cdr
from adxl_ros.nodes.support import offline_benchmark
from adxl_ros.nodes.support.node_help import program_parser
from adxl_ros.nodes.support.processes import cpu_time_s, executable, running, use_own_graph
import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data, QoSProfile
from sensor_msgs.msg import Imu

_RATE_HZ = 1000.0
"""Sample rate of all measurements, Hz."""
_SECONDS = 20.0
"""Default duration of one live measurement, s."""
_START_S = 20.0
"""Longest time until the first messages, s; chosen: a busy machine starts a node in 10 s."""
_FIRST_MESSAGES = 50
"""Messages after which a stream has begun."""
_WARM_UP_S = 2.0
"""Time between the begin of a stream and its measurement, s; chosen."""
_READ_BYTES = 65536
"""Most bytes of one read of the bare reader, as the serial link reads them."""
_QUEUE = 1000
"""Messages that the listener keeps while it is busy; chosen: 1 s."""
_BARE_QUEUE = 10
"""Messages that a bare node keeps, the usual depth of ROS examples."""


class Listener(Node):
    """
    Keeps the arrival time and the bytes of each message.

    Attributes
    ----------
    raw
        Serialized messages.
    arrived_ns
        Their arrival times, ns.

    """

    def __init__(self, topic: str) -> None:
        super().__init__('listener')
        self.raw: list[bytes] = []
        self.arrived_ns: list[int] = []
        self.create_subscription(Imu, topic, self._on_message,
                                 QoSProfile(depth=_QUEUE,
                                            reliability=qos_profile_sensor_data.reliability),
                                 raw=True)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)

    def _on_message(self, raw: bytes) -> None:
        self.arrived_ns.append(time.time_ns())
        self.raw.append(raw)

    def listen(self, seconds: float, limit: float = np.inf) -> None:
        """
        Keep the messages of some time.

        Parameters
        ----------
        seconds
            Duration, s.
        limit
            Number of messages after which it ends early.

        Raises
        ------
        UserError
            There is no message.

        """
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s and len(self.raw) < limit:
            self._executor.spin_once(timeout_sec=0.1)
        if not self.raw:
            raise UserError(f'no messages for {seconds:g} s')

    def clear(self) -> None:
        """Forget the messages so far."""
        self.raw.clear()
        self.arrived_ns.clear()


class BarePublisher(Node):
    """The smallest node that publishes Imu at 1 kHz: a timer and one message."""

    def __init__(self) -> None:
        super().__init__('bare_publisher')
        self._message = Imu()
        self._publisher = self.create_publisher(Imu, 'bare', _BARE_QUEUE)
        self.create_timer(1 / _RATE_HZ, self._publish)

    def _publish(self) -> None:
        self._message.header.stamp = self.get_clock().now().to_msg()
        self._publisher.publish(self._message)


class BareRelay(Node):
    """The smallest node that passes Imu on."""

    def __init__(self) -> None:
        super().__init__('bare_relay')
        publisher = self.create_publisher(Imu, 'relayed', _BARE_QUEUE)
        self.create_subscription(Imu, 'bare', publisher.publish, qos_profile_sensor_data)


_EXAMPLES = {'all measurements, four minutes': '',
             'a short look': '--seconds 5'}
"""Examples of arguments, by their purpose."""
_BARE_NODES = {'publisher': BarePublisher, 'relay': BareRelay}
"""Bare nodes by the value of the hidden option `--bare`, which runs one in its own process."""


def main() -> int:
    """Run the benchmark; return the exit status."""
    parser = program_parser('bench', __doc__, _EXAMPLES)
    parser.add_argument('--seconds', type=float, default=_SECONDS,
                        help=f'duration of each live measurement, s (default {_SECONDS:g})')
    parser.add_argument('--iiod', metavar='FILE', help="the tests' IIOD, for the link iio")
    parser.add_argument('--bare', choices=list(_BARE_NODES), help=argparse.SUPPRESS)
    parser.add_argument('--read', metavar='PORT', help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.bare:
        return _run_bare_node(_BARE_NODES[options.bare])
    if options.read:
        return _run_bare_reader(options.read)
    use_own_graph()
    try:
        _measure_nodes(options.seconds)
        _measure_serial(options.seconds)
        if options.iiod is not None:
            _measure_iio(options.iiod, options.seconds)
        offline_benchmark.measure_decoding()
        offline_benchmark.measure_recordings()
    except UserError as error:
        print(f'bench: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


def _run_bare_node(make: Callable[[], Node]) -> int:
    """Spin a node until a signal ends it."""
    rclpy.init()
    executor = SingleThreadedExecutor()
    executor.add_node(make())
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        executor.spin()
    return 0


def _run_bare_reader(port: str) -> int:
    """Read what a board sends, and do nothing with it."""
    with open(port, 'rb', buffering=0) as file, suppress(KeyboardInterrupt, OSError):
        while file.read(_READ_BYTES):
            pass
    return 0


def _measure_nodes(seconds: float) -> None:
    """Print the rows of bare nodes and of the package's nodes, each measured for a time, s."""
    title = f'1 kHz for {seconds:g} s'
    print(f'{title:36} {"rate Hz":>8} '
          f'{"missing":>8} {"p50 ms":>7} {"p99 ms":>7}   CPU of a core')
    bare = [[sys.executable, sys.argv[0], '--bare', kind] for kind in _BARE_NODES]
    driver, compensation = [executable('driver')], [executable('compensation')]
    _measure_stream('bare publisher', 'bare', bare[:1], seconds)
    _measure_stream('bare publisher and relay', 'relayed', bare, seconds)
    _measure_stream('driver', 'imu/data_raw', [driver], seconds)
    _measure_stream('driver and compensation', 'imu/data', [driver, compensation], seconds)


def _measure_serial(seconds: float) -> None:
    """Print the rows of an emulated board: a bare reader of its bytes, and the driver."""
    with tempfile.TemporaryDirectory() as folder:
        port = str(Path(folder, 'board'))
        with running([[executable('simulate'), 'soak', '--port', port]]):
            _wait_for_port(port)
            _measure_bare_reader(port, seconds)
            _measure_stream('driver, serial, 2 axes and 2 more', 'imu/data_raw', [[
                executable('driver'), '--ros-args', '-p', 'link.type:=serial', '-p',
                f'link.port:={port}', '-p', 'link.channels:=x,y,supply,temperature']], seconds)


def _wait_for_port(port: str) -> None:
    """Wait until the emulated board has made its pseudo-terminal."""
    end_s = time.monotonic() + _START_S
    while not Path(port).exists():
        if time.monotonic() > end_s:
            raise UserError(f'{port}: the emulated board has not begun after {_START_S:g} s')
        time.sleep(0.05)


def _measure_bare_reader(port: str, seconds: float) -> None:
    """Print the CPU load of a process that reads the bytes of a port for a time, s."""
    with running([[sys.executable, sys.argv[0], '--read', port]]) as (reader,):
        time.sleep(_WARM_UP_S)
        before_s = cpu_time_s(reader.pid)
        time.sleep(seconds)
        load = 100 * (cpu_time_s(reader.pid) - before_s) / seconds
    print(f'{"bare reader, decodes nothing":36} {"":8} {"":8} {"":7} {"":7}   {load:.1f} %',
          flush=True)


def _measure_iio(iiod: str, seconds: float) -> None:
    """Print the row of the driver on an IIOD, a Python file that prints its port."""
    with subprocess.Popen([sys.executable, iiod], stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None, 'Popen makes the pipe'
        try:
            uri = f'ip:127.0.0.1:{server.stdout.readline().strip()}'
            _measure_stream('driver, iio, 2 axes and supply', 'imu/data_raw', [[
                executable('driver'), '--ros-args', '-p', 'link.type:=iio', '-p',
                f'link.uri:={uri}']], seconds)
        except UserError as error:
            print(f'{"driver, iio":36} {error}: is libiio 0.x installed?')
        finally:
            server.kill()


def _measure_stream(label: str, topic: str, commands: Sequence[Sequence[str]], seconds: float
                    ) -> None:
    """Print one row: rate, missing samples, age on arrival, CPU of each process."""
    with running(commands) as processes:
        rclpy.init(args=[])
        listener = Listener(topic)
        try:
            listener.listen(_START_S, _FIRST_MESSAGES)
            listener.listen(_WARM_UP_S)
            listener.clear()
            before_s = [cpu_time_s(process.pid) for process in processes]
            began_s = time.monotonic()
            listener.listen(seconds)
            duration_s = time.monotonic() - began_s
            after_s = [cpu_time_s(process.pid) for process in processes]
        finally:
            listener.destroy_node()
            rclpy.try_shutdown()
    stamps_ns = np.concatenate([table.stamp_ns() for table in cdr.tables(listener.raw, cdr.imu)])
    age_ms = (np.array(listener.arrived_ns) - stamps_ns) * 1e-6
    periods = np.rint(np.diff(np.sort(stamps_ns)) * 1e-9 * _RATE_HZ)
    # The stamps of a bare timer wander: only steps of two periods and more are a loss.
    missing = int(np.sum(np.maximum(periods - 1, 0)))
    p50_ms, p99_ms = np.percentile(age_ms, [50, 99])
    loads = ' + '.join(f'{100 * (after - before) / duration_s:.1f} %'
                       for before, after in zip(before_s, after_s))
    print(f'{label:36} {len(stamps_ns) / duration_s:8.1f} {missing:8d} {p50_ms:7.2f} '
          f'{p99_ms:7.2f}   {loads}', flush=True)
